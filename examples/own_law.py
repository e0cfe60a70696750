"""Does a contact law of my own predict the load better than the package's?

Own law: a rigid limb on a tissue that hardens, whose normal force grows quadratically with the
compression. It, the published law and the package's default are fitted while the socket is pushed
(0 to 60 s) and judged on the unseen rest. The default predicts the wrench by a regression with
memory of the pose, the other two by their springs. Printed: the RMSE of Fz of each. `own_law.png`
shows them with what was measured.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import socket_testbed as st
from socket_testbed.identification.contact import RigidLaw

SIZE = 0.005  # [m]; compression at which the stiffness has tripled


class Hardening(RigidLaw):
    """The law `rigid` with -k p (1 + p / size) along the normal in place of -k p."""

    REFINED = False  # both stages, without the joint refinement, which needs derivatives

    def columns(self, moved: np.ndarray) -> np.ndarray:
        """Forces per stiffness [m] in the tiles' frames, at displacements from rest [m]."""
        columns = super().columns(moved)
        columns[:, 2] *= 1.0 - columns[:, 2] / SIZE  # compression is negative
        return columns


st.register_law("hardening", Hardening, offsets=True)

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
trial = st.simulate(folder / "own_law", "multi_direction", replace=True)
force = trial.samples().to_dataframe()["Fz [N]"]
laws = "hardening", "stiffness_bias", "rigid_bias"
fits = {law: st.fit(trial, (0, 60), variant=law) for law in laws}
fits["hardening"].save(folder / "own_law.json")  # read by programs that register the law
predicted = {law: st.predict(trial, fitted)["Fz [N]"] for law, fitted in fits.items()}
predicted["constant"] = 0.0 * force + force.loc[:60.0].mean()
figure, axes = plt.subplots(figsize=(5, 3), layout="constrained")
axes.plot(force.loc[60.0:], "0.6", label="measured")
for name, values in predicted.items():
    error = (values - force).loc[60.0:]
    print(f"{name}: RMSE of Fz {np.sqrt((error**2).mean()):.1f} N")
    axes.plot(values.loc[60.0:], ":" if name == "constant" else "-", label=name, linewidth=1)
axes.set(xlabel="time [s]", ylabel="Fz on the socket [N]")
axes.legend(fontsize="small")
figure.savefig(folder / "own_law.png")
