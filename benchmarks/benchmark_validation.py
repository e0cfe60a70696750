"""The tables of docs/validation.md: simulated trials that no choice was based on.

Usage:
    python benchmarks/benchmark_validation.py [--seeds 100 ... 104] [--duration 120]

Wrench: mean RMSE of moments [N m] and forces [N] on the unseen half, from the pose alone. Tiles and
left-out clusters: RMSE of the forces over their RMS, pooled over the samples of a trial, and the
share of the true forces within the 95 % intervals; means over the trials.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import warnings
from pathlib import Path

import pandas as pd
from machine import describe_machine

import socket_testbed as st
from socket_testbed.simulation.limb import TISSUES

SCENARIOS = ("multi_direction", "protocol", "static_hold")
_KEYS = ["question", "predictor", "cluster"]


def main() -> None:
    """Simulate, judge and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(100, 105)))
    parser.add_argument("--duration", type=float, default=120.0, help="of a trial [s]")
    arguments = parser.parse_args()
    print(describe_machine(1))
    found = []
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # notes on the data of each trial
        for tissue in TISSUES:
            for scenario in SCENARIOS:
                for seed in arguments.seeds:
                    path = Path(folder) / f"{tissue}_{scenario}_{seed}"
                    trial = st.simulate(
                        path, scenario, tissue=tissue, seed=seed, duration=arguments.duration
                    )
                    judged = st.validate(trial).to_dataframe()
                    found.append(judged.assign(tissue=tissue, scenario=scenario))
                    print(f"\r{len(found)} trials", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    _print(pd.concat(found, ignore_index=True))


def _print(judged: pd.DataFrame) -> None:
    wrench = judged[(judged["question"] == "wrench") & (judged["test"] == "second half")]
    figures = ["moment RMSE [N m]", "force RMSE [N]"]
    by_trial = wrench.groupby(["tissue", "scenario", "predictor"])[figures].mean()
    print("\nwrench on the unseen half, moments [N m], forces [N]")
    for figure in figures:
        table = by_trial[figure].unstack("predictor")
        print(f"\n{figure}\n{table.round(3).to_string()}")
        print(f"mean of all\n{table.mean().round(3).to_string()}")
    local = judged[judged["question"] != "wrench"]
    for tissue, rows in local.groupby("tissue"):
        table = rows.groupby(_KEYS)[["error [-]", "within 95 % [-]"]].agg(["mean", "max"])
        print(f"\n{tissue}\n{table.round(3).to_string()}")


if __name__ == "__main__":
    main()
