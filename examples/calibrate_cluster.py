"""How do I calibrate a cluster from bench data, and how good is it?

The bench file is made here from a sensor of 0.05 pF/kPa; bring your own CSV. Printed: range and
held-out errors of each stress, and the gain. `calibrate_cluster.png` shows the residuals.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

import socket_testbed as st

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
ramp = np.concatenate([np.linspace(0, 1, 8), np.linspace(1, 0, 8)])
directions = [(1.0, 0.0, 0.0)]  # normal alone, then shear in eight directions under it
for angle in np.radians(np.arange(0, 360, 45)):
    directions += [(0.5, np.cos(angle), np.sin(angle)), (0.0, np.cos(angle), np.sin(angle))]
cycle = np.concatenate([np.outer(ramp, direction) for direction in directions])
normal, shear_x, shear_y = (np.tile(cycle, (3, 1)) * [60.0, 15.0, 15.0]).T  # [kPa]
rng = np.random.default_rng(1)
bench = pd.DataFrame({"normal [kPa]": normal, "shear_x [kPa]": shear_x, "shear_y [kPa]": shear_y})
bench["cycle"] = np.repeat([1, 2, 3], len(cycle))
for channel, (x, y) in enumerate([(-1, 1), (1, 1), (-1, -1), (1, -1)]):
    clean = 5.0 + 0.05 * normal + 0.02 * (x * shear_x + y * shear_y)
    bench[f"c{channel} [pF]"] = clean + rng.normal(0.0, 0.02, len(bench))
bench.to_csv(folder / "bench.csv", index=False)

found = st.calibrate(folder / "bench.csv", "distal")
print(found.to_dataframe().iloc[:, :4].round(2).to_string())
print(f"normal stress per capacitance: {1e-3 * found.quality.cluster.normal[1]:.2f} kPa/pF")
found.save(folder / "calibration.yaml", replace=True)
found.draw(folder / "calibrate_cluster.png", width=88)
