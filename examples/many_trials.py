"""How do I run my own analysis over a folder of trials on all cores?

Trials and results can be sent to other processes: joblib here, Dask in the same way (see the last
lines). Printed: a row per trial, the highest pressure and where it is.
"""

import sys
from pathlib import Path

import pandas as pd
from joblib import Parallel, delayed

import socket_testbed as st

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".") / "many_trials"


def analyse(path: Path) -> dict[str, object]:
    """The row of a trial."""
    pressure = st.pressure(path)
    tile = pressure.tiles["peak pressure [kPa]"].idxmax()
    return {
        "trial": path.name,
        "peak [kPa]": pressure.regions.loc["socket", "peak pressure [kPa]"],
        "tile": tile,
        "pistoning [mm]": pressure.limb().loc["pistoning [mm]", "value"],
    }


if __name__ == "__main__":
    folder.mkdir(exist_ok=True)
    for seed in range(4):
        st.simulate(folder / f"s{seed:02}", duration=40, seed=seed, replace=True)
    paths = sorted(path for path in folder.iterdir() if path.is_dir())
    rows = Parallel(n_jobs=2)(delayed(analyse)(path) for path in paths)
    table = pd.DataFrame(rows).set_index("trial")
    print(table.round(1).to_string())
    table.to_csv(folder / "summary.csv")
    # On a Dask cluster whose machines share the folder:
    #   rows = Client("tcp://host:8786").gather(client.map(analyse, paths))
