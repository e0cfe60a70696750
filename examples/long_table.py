"""How do trials of several subjects reach my statistics?

Each of four simulated subjects stands once on soft and once on stiff tissue. `long_table.csv` is
the long table, a row per value, as R's lme4 or pandas read it. Printed: the paired difference of
the peak pressure of the socket, and its t test. `long_table.png` shows the pairs.
"""

import sys
from pathlib import Path

import pandas as pd
from scipy.stats import ttest_rel

import socket_testbed as st

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
tables = []
for seed in range(4):
    for tissue in ("soft", "stiff"):
        path = folder / f"S{seed:02}_{tissue}"
        trial = st.simulate(path, tissue=tissue, duration=40, seed=seed, replace=True)
        table = st.pressure(trial).to_long()
        tables.append(table.assign(subject=f"S{seed:02}", tissue=tissue))
table = pd.concat(tables, ignore_index=True)
table.to_csv(folder / "long_table.csv", index=False)
own = table.query("part == 'regions' and name == 'socket' and quantity == 'peak pressure'")
pairs = own.pivot(index="subject", columns="tissue", values="value")
print(pairs.round(1).to_string())
test = ttest_rel(pairs["stiff"], pairs["soft"])
difference = (pairs["stiff"] - pairs["soft"]).mean()
print(f"{len(table)} rows; stiff - soft: {difference:.1f} kPa, p = {test.pvalue:.3f}")
axes = pairs.T.plot(marker="o", ylabel="peak pressure [kPa]", figsize=(4, 3), xlim=(-0.2, 1.9))
axes.set_xticks([0, 1], pairs.columns)
axes.figure.savefig(folder / "long_table.png", bbox_inches="tight")
