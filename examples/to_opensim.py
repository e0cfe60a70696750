"""How do loads and markers reach OpenSim?

Loads go to `to_opensim.mot` with moments about a point of your choice, markers to
`to_opensim.trc`. Printed: the rows of both, the mean load, and what was left out. `to_opensim.png`
shows the loads as OpenSim reads them.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt

import socket_testbed as st

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
trial = st.simulate(folder / "to_opensim", "ramp", duration=60, rate=10, replace=True)
knee = (0.0, 0.0, 0.25)  # in the load cell's frame [m]
loads = st.export(trial, folder / "to_opensim.mot", about=knee)
markers = st.export(trial, folder / "to_opensim.trc")
print(f"{len(loads)} samples of loads: {', '.join(loads.columns)}")
print(f"{len(markers)} samples of {len(markers.columns) // 3} markers")
print(f"mean vertical force: {trial.samples().wrench[:, 5].mean():.1f} N")
for note in (*loads.attrs["notes"], *markers.attrs["notes"]):
    print("note:", note)
forces = loads.filter(like="force_v")  # along the axes of the load cell's frame
forces.plot(xlabel="time [s]", ylabel="force on the socket [N]", figsize=(5, 3))
plt.legend(loc="upper right", bbox_to_anchor=(1.0, 0.9), fontsize="small")
plt.tight_layout()
plt.savefig(folder / "to_opensim.png")
