"""Where does a limb feel another socket: which regions differ?

A scan, 6 % wider, becomes a second socket; a limb stands in each. Printed: the peak pressure by
height in both, with the difference. `two_sockets.png` shows the mean pressure in both.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
from socket_scan import make_socket_scan

import socket_testbed as st

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
make_socket_scan(edge=6.0).apply_scale(1.06).export(folder / "two_sockets.stl")
st.tile(folder / "two_sockets.stl", folder / "two_sockets.yaml", anterior="+z")
usual = st.simulate(folder / "usual", duration=40, replace=True)
scanned = st.simulate(
    folder / "scanned", duration=40, geometry=folder / "two_sockets.yaml", replace=True
)
comparison = st.compare(usual, scanned, by_region=True)  # tiles differ, regions have equal names
cells = comparison.cells("regions", "peak pressure")
print(cells.loc[["proximal", "middle", "distal", "socket"]].to_string())
figure, axes = plt.subplots(2, 1, figsize=(6, 7), layout="constrained")
for axis, trial in zip(axes, (usual, scanned), strict=True):
    st.force_map(trial).draw(ax=axis, vmax=50)
    axis.set_title(trial.name)
figure.savefig(folder / "two_sockets.png")
