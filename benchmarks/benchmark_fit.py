"""Stage 2 with offsets, built and solved: ours against stacked rows, in one run.

Usage:
    python benchmarks/benchmark_fit.py [--quick] [--points 100] [--samples 1000 10000]
        [--no-cvxpy] [--time-limit 300] [--smoothness 1e-3 1e-7]
        [--threads 1]

Needs requirements/benchmarks.txt unless --no-cvxpy is given. Compare ratios, not seconds.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from machine import describe_machine
from measure import Measurement, Task, measure_apart
from methods import METHODS

from socket_testbed.settings.identification import IdentificationSettings

# The default, with which hardly a stiffness of a hold is at its bound, and one so weak that a
# third and more are: a solver has to find them.
_SMOOTHNESS = (IdentificationSettings().smoothness, 1e-7)  # [-]
_HEADER = (
    f"{'method':38} {'time':>9} {'min..max':>17} {'runs':>4} {'/ ours':>9} {'/ S^T S':>9}"
    f" {'memory':>8} {'objective':>10} {'stiffness':>10}"
)
_UNITS = (
    f"{'':38} {'[s]':>9} {'[s]':>17} {'':>4} {'[-]':>9} {'[-]':>9}"
    f" {'[MB]':>8} {'above ours':>10} {'off':>10}"
)


def main() -> None:
    """Measure and print."""
    arguments = _parse_arguments()
    _limit_threads(arguments.threads)
    print(describe_machine(arguments.threads))
    _print_legend(list(_methods(arguments.no_cvxpy)))
    ours: dict[str, Measurement] = {}
    for task, methods in _tasks(arguments):
        print(_measure_table(task, methods, arguments.time_limit, ours), flush=True)


def _tasks(arguments: argparse.Namespace) -> Iterator[tuple[Task, tuple[str, ...]]]:
    """The problems, each with the methods that are measured on it."""
    points, budget = arguments.points, arguments.budget
    for smoothness in arguments.smoothness:
        for samples in arguments.samples:
            task = Task("ours", points, samples, "hold", smoothness, budget)
            yield task, _methods(arguments.no_cvxpy)
    for samples in arguments.samples:
        task = Task("ours", points, samples, "multi", arguments.smoothness[0], budget)
        yield task, ("product", "ours")


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="60 points, 1000 samples, few runs")
    parser.add_argument("--points", type=int, help="number of points of interest (100)")
    parser.add_argument("--samples", type=int, nargs="+", help="numbers of samples (1000 10000)")
    parser.add_argument("--no-cvxpy", action="store_true", help="leave CVXPY out")
    parser.add_argument("--threads", type=int, default=1, help="BLAS threads (1)")
    parser.add_argument("--time-limit", type=float, default=300.0, help="for one method [s]")
    parser.add_argument(
        "--smoothness",
        type=float,
        nargs="+",
        default=_SMOOTHNESS,
        help="weights of the smoothness over neighbouring tiles [-]",
    )
    arguments = parser.parse_args()
    arguments.points = arguments.points or (60 if arguments.quick else 100)
    arguments.samples = arguments.samples or ([1000] if arguments.quick else [1000, 10000])
    arguments.budget = 1.0 if arguments.quick else 6.0
    return arguments


def _limit_threads(threads: int) -> None:
    """Set the BLAS threads of the processes that measure; they inherit the environment.

    One is the default: numpy and scipy bring an OpenBLAS each, whose waiting threads take
    the cores from one another, and on two shared cores that stalls a run of 30 ms by up to
    500 ms.
    """
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ[name] = str(threads)


def _methods(no_cvxpy: bool) -> tuple[str, ...]:
    return tuple(key for key in METHODS if not (no_cvxpy and METHODS[key].module == "cvxpy"))


def _print_legend(methods: list[str]) -> None:
    print("\nWhat is timed, and the settings:")
    for key in methods:
        print(f"  {METHODS[key].label}: {METHODS[key].conditions}")
    print(
        "time: median after a warm-up; one run without a warm-up where it takes over 2 s.\n"
        "memory: peak resident memory (ru_maxrss) of a process that runs this method alone,"
        "\n  above its peak after imports, problem generation and Stage 1.\n"
        "objective above ours: J / J_ours - 1, J evaluated from its definition at the answer"
        "\n  moved into the bounds. stiffness off: largest difference from ours over the"
        " largest stiffness."
    )


def _measure_table(
    task: Task, methods: tuple[str, ...], time_limit: float, ours: dict[str, Measurement]
) -> str:
    """Measure the methods on one problem; leaves our measurement in `ours`."""
    outcomes: dict[str, Measurement | str] = {}
    for key in methods:
        progress = f"{task.motion}, N = {task.samples}, {task.smoothness:.0e}: {METHODS[key].label}"
        print(progress, file=sys.stderr, flush=True)
        outcomes[key] = measure_apart(replace(task, method=key), time_limit)
    reference, product = outcomes["ours"], outcomes["product"]
    if isinstance(reference, str) or isinstance(product, str):
        return f"\nno reference: ours {reference}, product {product}"
    ours[f"{task.motion} {task.smoothness:.0e} N={task.samples}"] = reference
    lines = ["", _title(task, reference), _HEADER, _UNITS]
    for key, outcome in outcomes.items():
        label = METHODS[key].label
        if isinstance(outcome, str):
            lines.append(f"{label:38} {outcome}")
        else:
            lines.append(f"{label:38} {_row(outcome, reference, product)}")
    lines += [
        f"  {METHODS[key].label}: {outcome.solution.status}"
        for key, outcome in outcomes.items()
        if isinstance(outcome, Measurement) and outcome.solution
    ]
    return "\n".join(lines)


def _title(task: Task, ours: Measurement) -> str:
    size = ours.size
    assert ours.solution is not None
    bound = np.mean(ours.solution.stiffness <= 0.0)
    return (
        f"== {task.motion}: n = {task.points} points, N = {task.samples} samples,"
        f" wrench + {size.channels} local channels, stiffness_bias,"
        f" smoothness {task.smoothness:.0e}\n"
        f"   stacked: {size.rows} rows x {size.columns} columns"
        f" ({size.rows * size.columns * 8e-6:.0f} MB dense); ours: {3 * task.points} variables,"
        f" {100 * bound:.0f} % at their bound"
    )


def _row(outcome: Measurement, ours: Measurement, product: Measurement) -> str:
    low, high = outcome.spread
    text = (
        f"{outcome.seconds:9.4f} {f'{low:.4f}..{high:.4f}':>17} {outcome.runs:4d}"
        f" {outcome.seconds / ours.seconds:9.2f} {outcome.seconds / product.seconds:9.2f}"
        f" {outcome.memory:8.0f}"
    )
    if outcome.solution is None or ours.solution is None:
        return text
    largest = ours.solution.stiffness.max()
    off = np.abs(outcome.solution.stiffness - ours.solution.stiffness).max() / largest
    return f"{text} {outcome.value / ours.value - 1.0:10.1e} {off:10.1e}"


if __name__ == "__main__":
    main()
