"""One method on one problem in a process of its own: time, memory, accuracy."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import resource
import statistics
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection

from methods import METHODS
from problems import Motion, StageTwoInput, make_problem
from stacked import Solution, objective_value, stacked_shape

_MOST_RUNS = 25


@dataclass(frozen=True)
class Task:
    """What is measured.

    Attributes:
        method: Key of the method.
        points: Number n of points of interest.
        samples: Number N of samples.
        motion: Motion of the limb.
        smoothness: Weight lambda of the smoothness [-].
        budget: Time to spend on repetitions [s].
    """

    method: str
    points: int
    samples: int
    motion: Motion
    smoothness: float
    budget: float


@dataclass(frozen=True)
class ProblemSize:
    """How big the problem of a measurement was.

    Attributes:
        rows: Rows of the stacked matrix.
        columns: Columns of it.
        channels: Channels of the clusters.
    """

    rows: int
    columns: int
    channels: int


@dataclass(frozen=True)
class Measurement:
    """What came out of it.

    Attributes:
        size: Size of the problem.
        seconds: Median time of a run [s].
        spread: Fastest and slowest run [s].
        runs: Runs in the median; 1 is a run without a warm-up.
        memory: Peak resident memory above that after imports and set-up [MB].
        value: Objective reached [-]; NaN for the product.
        solution: The solution; None for the product.
    """

    size: ProblemSize
    seconds: float
    spread: tuple[float, float]
    runs: int
    memory: float
    value: float
    solution: Solution | None


def measure_apart(task: Task, time_limit: float) -> Measurement | str:
    """Measure in a new process, so that memory is the method's own and a limit can be kept.

    The peak memory of a process starts at that of the one that started it: this one must
    not build a problem itself.

    Args:
        task: What to measure.
        time_limit: Time after which the process is killed [s].

    Returns:
        The measurement, or in words why there is none.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_measure, args=(task, sender))
    process.start()
    sender.close()
    try:
        if not receiver.poll(time_limit):
            return f"killed after {time_limit:.0f} s"
        outcome: Measurement | str = receiver.recv()
        return outcome
    except EOFError:
        process.join()
        return f"died (exit code {process.exitcode})"
    finally:
        process.kill()
        process.join()


def _measure(task: Task, sender: Connection) -> None:
    # What the solvers warn of shows in the accuracy; printed, it splits the table. OSQP prints
    # from C, past sys.stdout.
    warnings.simplefilter("ignore")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    method = METHODS[task.method]
    importlib.import_module(method.module)
    stage = make_problem(task.points, task.samples, task.motion, task.smoothness)
    baseline = _peak_memory()
    run = method.prepare(stage)
    try:
        solution = run()
        times = repeat(run, task.budget)
    except ArithmeticError as error:
        sender.send(f"failed: {error}")
        return
    memory = _peak_memory() - baseline
    sender.send(
        Measurement(
            size=_size(stage),
            seconds=statistics.median(times),
            spread=(min(times), max(times)),
            runs=len(times),
            memory=memory,
            value=objective_value(stage, solution) if solution else float("nan"),
            solution=solution,
        )
    )


def _size(stage: StageTwoInput) -> ProblemSize:
    rows, columns = stacked_shape(stage)
    return ProblemSize(rows, columns, len(stage.objective.channels))


def repeat(run: Callable[[], object], budget: float) -> list[float]:
    """Times of repeated runs after a warm-up; of one run alone where it is slow.

    Args:
        run: What to time.
        budget: Time to spend [s]; a run that takes a third of it is not repeated.

    Returns:
        Wall times [s].
    """
    times = [_seconds(run)]
    if times[0] > budget / 3.0:
        return times
    times.clear()
    while len(times) < _MOST_RUNS and (len(times) < 3 or sum(times) < budget):
        times.append(_seconds(run))
    return times


def _seconds(run: Callable[[], object]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def _peak_memory() -> float:
    """Peak resident memory of this process [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0  # Linux counts in kB
