"""A front over theta, both variants: ours against the same work done otherwise, in one run.

Usage:
    python benchmarks/benchmark_pareto.py [--quick] [--points 100] [--samples 1000 10000]
        [--thetas 101] [--no-cvxpy] [--threads 1]

Needs requirements/benchmarks.txt unless --no-cvxpy is given. Compare ratios, not seconds.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from front_methods import METHODS, FrontMeasurement, FrontTask, measure_front
from machine import describe_machine
from problems import MOTIONS

_HEADER = (
    f"{'method':42} {'time':>9} {'min..max':>17} {'runs':>4} {'/ ours':>8} {'stiffness':>10}\n"
    f"{'':42} {'[s]':>9} {'[s]':>17} {'':>4} {'[-]':>8} {'off':>10}"
)


def main() -> None:
    """Measure and print."""
    arguments = _parse_arguments()
    # The processes that measure inherit it: numpy and scipy bring an OpenBLAS each, whose
    # waiting threads take the cores from one another.
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ[name] = str(arguments.threads)
    print(describe_machine(arguments.threads))
    methods = [key for key in METHODS if not (arguments.no_cvxpy and "cvxpy" in key)]
    print("\nWhat is timed:")
    for key in methods:
        print(f"  {METHODS[key].label}: {METHODS[key].work}")
    print(
        "time: median processor time after a warm-up; one run without where it is slow.\n"
        "few thetas: five from 0.1 to 0.9. stiffness off: largest difference from ours over the"
        " largest stiffness,\n  over all solutions; nan where there was no answer."
    )
    for motion in MOTIONS:
        for samples in arguments.samples:
            _measure_table(arguments, motion, samples, methods)


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="60 points, 1000 samples, few runs")
    parser.add_argument("--points", type=int, help="number of points of interest (100)")
    parser.add_argument("--samples", type=int, nargs="+", help="numbers of samples (1000 10000)")
    parser.add_argument("--thetas", type=int, default=101, help="values from 0 to 1 (101)")
    parser.add_argument("--no-cvxpy", action="store_true", help="leave CVXPY out")
    parser.add_argument("--threads", type=int, default=1, help="BLAS threads (1)")
    arguments = parser.parse_args()
    arguments.points = arguments.points or (60 if arguments.quick else 100)
    arguments.samples = arguments.samples or ([1000] if arguments.quick else [1000, 10000])
    arguments.budget = 3.0 if arguments.quick else 15.0
    return arguments


def _measure_table(
    arguments: argparse.Namespace, motion: str, samples: int, methods: list[str]
) -> None:
    print(
        f"\n== {motion}: n = {arguments.points} points, N = {samples} samples,"
        f" {arguments.thetas} thetas, both variants\n{_HEADER}"
    )
    ours: FrontMeasurement | None = None
    for key in methods:
        print(f"{motion}, N = {samples}: {METHODS[key].label}", file=sys.stderr, flush=True)
        size = (arguments.points, samples, motion, arguments.thetas, arguments.budget)
        outcome = _measure_apart(FrontTask(key, *size))
        ours = ours or outcome
        print(f"{METHODS[key].label:42} {_row(outcome, ours)}", flush=True)


def _measure_apart(task: FrontTask) -> FrontMeasurement:
    """Measure in a new process, where the number of threads counts."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=1, mp_context=context) as pool:
        return pool.submit(measure_front, task).result()


def _row(outcome: FrontMeasurement, ours: FrontMeasurement) -> str:
    low, high = outcome.spread
    off = [
        np.abs(stiffness - ours.stiffness[key]).max() / ours.stiffness[key].max()
        for key, stiffness in outcome.stiffness.items()
    ]
    text = (
        f"{outcome.seconds:9.3f} {f'{low:.3f}..{high:.3f}':>17} {outcome.runs:4d}"
        f" {outcome.seconds / ours.seconds:8.2f}"
    )
    return f"{text} {np.max(off):10.1e}" if off else text


if __name__ == "__main__":
    main()
