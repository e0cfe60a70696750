"""Two clusters were exchanged in socket.yaml when a trial was recorded: is it lost?

Printed: what the data check says, then the pressure on a cluster's tile as recorded, as repaired
with the right geometry, and in truth. The trial never changes. `repair_trial.png` shows the
repaired map.
"""

import sys
from pathlib import Path

import yaml

import socket_testbed as st

ONE, OTHER = "posterior_distal", "mid_anterior"
folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
made = st.simulate(folder / "repair_trial", "multi_direction", duration=60, replace=True)
socket = made.path / "socket.yaml"
right = folder / "right.yaml"
right.write_text(socket.read_text())
written = yaml.safe_load(socket.read_text())
places = written["clusters"]  # the tile of each cluster
places[ONE], places[OTHER] = places[OTHER], places[ONE]  # the mistake
socket.write_text(yaml.safe_dump(written))

wrong = st.open_trial(made.path, notify=lambda note: None)
for finding in st.check_data(wrong):
    print(finding)
repaired = st.open_trial(made.path, geometry=right)
print(f"findings after the repair: {len(st.check_data(repaired))}")
for name, trial in (("as recorded", wrong), ("repaired", repaired)):
    pressure = st.pressure(trial, "all").tiles.loc[ONE, "mean pressure [kPa]"]
    print(f"mean pressure on {ONE}, {name}: {pressure:.1f} kPa")
tiles, tile = repaired.geometry, repaired.geometry.names.index(ONE)
force = repaired.truth().forces[:, tile].mean(axis=0)  # in the load cell's frame [N]
normal = -force @ tiles.rotations[tile, :, 2]  # against the tile's inward normal
print(f"in truth: {1e-3 * normal / tiles.areas[tile]:.1f} kPa")
st.force_map(repaired, "all").draw(folder / "repair_trial.png", width=88)
