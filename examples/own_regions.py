"""How much pressure do regions of my own carry, such as the patellar tendon's?

A region is a list of tiles, here chosen by height and angle. Printed: each region's mean pressure
with its 95 % interval, and the simulated truth. `own_regions.png` shows both.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import socket_testbed as st

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
trial = st.simulate(folder / "own_regions", duration=40, replace=True)
socket = trial.geometry
x, y, z = socket.anchors.T  # centres of the tiles in the load cell's frame: anterior, left, up [m]
angle = np.degrees(np.arctan2(y - y.mean(), x - x.mean()))  # from anterior towards left
height = (z - z.min()) / np.ptp(z)
chosen = {
    "patellar tendon": (abs(angle) < 30) & (height > 0.5) & (height < 0.85),
    "popliteal": (abs(angle) > 140) & (height > 0.5),
    "distal quarter": height < 0.25,
}
regions = {name: [socket.names[i] for i in np.flatnonzero(tiles)] for name, tiles in chosen.items()}
pressure = st.pressure(trial, regions=regions)
forces = trial.truth().forces[pressure.segment.rows]  # (N, n, 3) [N]
true = -np.einsum("kni,ni->n", forces, socket.rotations[:, :, 2]) / len(forces) / socket.areas
figure, axes = plt.subplots(figsize=(5, 3), layout="constrained")
for name, tiles in chosen.items():
    mean, low, high = pressure.regions.loc[name].filter(like="mean pressure")
    truth = 1e-3 * np.average(true[tiles], weights=socket.areas[tiles])
    print(f"{name}: {mean:.1f} kPa ({low:.1f} to {high:.1f}), in truth {truth:.1f} kPa")
    first = name == next(iter(chosen))
    reach = [[mean - low], [high - mean]]
    axes.errorbar(name, mean, reach, fmt="ok", capsize=4, label="estimate, 95 %" if first else None)
    axes.plot(name, truth, "xr", markersize=9, label="truth" if first else None)
axes.set(ylabel="mean pressure [kPa]", ylim=(0, None))
axes.margins(x=0.15)
axes.legend()
figure.savefig(folder / "own_regions.png")
