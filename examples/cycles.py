"""How does the pressure on a tile run over a load cycle, and what is its time integral?

Cycles run from each placing of the load to the next. Printed: the cycles, the highest mean, and
the pressure-time integral of one cycle, by hand and by the package. `cycles.png` shows the curve.
"""

import sys
from pathlib import Path

import numpy as np

import socket_testbed as st

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
trial = st.simulate(folder / "cycles", "ramp", duration=130, rate=10, replace=True)
series = st.pressure(trial, "all").over_time()[["tile distal.pressure [kPa]"]]
found = st.cycles(trial, series, by="placed")
print(found)
print(f"highest mean of the cycles: {np.nanmax(found.mean):.1f} kPa")
time = np.linspace(0.0, 1.0, 101) * found.durations[0]
by_hand = np.trapezoid(found.curves[0, :, 0], time)  # also while the tile is hardly touched
print(f"integral over cycle 1, by hand: {by_hand:.0f} kPa s")
first = tuple(found.spans[0])
integral, low, high = st.pressure(trial, first).tiles.loc["distal"].filter(like="integral")
print(f"by the package: {integral:.0f} kPa s ({low:.0f} to {high:.0f})")
found.draw(folder / "cycles.png", width=88)
