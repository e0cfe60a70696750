"""Does a contact law of my own predict the load better than the package's?

Own law: the axial force grows exponentially with the limb's settling. Both are fitted while the
socket is pushed (0 to 60 s) and judged on the unseen rest. Printed: the RMSE of Fz of each.
`own_law.png` shows both with what was measured.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import curve_fit

import socket_testbed as st

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
trial = st.simulate(folder / "own_law", "multi_direction", replace=True)
table = trial.samples().to_dataframe()
settling = 1e3 * (table["q_z [m]"] - table["q_z [m]"].loc[:60.0].mean())  # [mm]
force = table["Fz [N]"]


def law(depth: np.ndarray, load: float, size: float, rest: float) -> np.ndarray:
    """Force on the socket [N] at a depth [mm]; it hardens over `size` [mm]."""
    return rest + load * np.exp(-depth / size)


seen = np.isfinite(settling) & np.isfinite(force) & (table.index < 60.0)
own, _ = curve_fit(law, settling[seen], force[seen], p0=(-100.0, 5.0, 0.0), maxfev=20000)
fitted = st.fit(trial, (0, 60))
predicted = {
    "own law": law(settling, *own),
    "st.fit": st.predict(trial, fitted)["Fz [N]"],
    "constant": 0.0 * force + force.loc[:60.0].mean(),
}
figure, axes = plt.subplots(figsize=(5, 3), layout="constrained")
axes.plot(force.loc[60.0:], "0.6", label="measured")
for name, values in predicted.items():
    error = (values - force).loc[60.0:]
    print(f"{name}: RMSE of Fz {np.sqrt((error**2).mean()):.1f} N")
    axes.plot(values.loc[60.0:], label=name, linewidth=1)
axes.set(xlabel="time [s]", ylabel="Fz on the socket [N]")
axes.legend(fontsize="small")
figure.savefig(folder / "own_law.png")
