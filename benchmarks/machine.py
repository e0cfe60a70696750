"""What was measured on (cores, BLAS threads, versions), and how times and memory are taken."""

from __future__ import annotations

import multiprocessing
import os
import platform
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from importlib import metadata
from pathlib import Path
from typing import Any

_PACKAGES = ("numpy", "scipy", "osqp", "qpsolvers")


def describe_machine(threads: int) -> str:
    """Lines that name the machine and the versions of what ran on it.

    Args:
        threads: BLAS threads of the processes that measure.
    """
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in _PACKAGES)
    return (
        f"machine: {platform.system()} {platform.machine()}, {_processor()},"
        f" {len(os.sched_getaffinity(0))} cores; BLAS threads: {threads}\n"
        f"versions: Python {sys.version.split()[0]}, {versions}"
    )


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return "unknown processor"


def repeat(run: Callable[[], object], budget: float) -> list[float]:
    """Processor times [s] of runs within a budget [s]; of one alone that takes a third of it."""
    times: list[float] = []
    while len(times) < 25 and (len(times) < 4 or sum(times) < budget):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
        if times[0] > budget / 3.0:
            return times
    return times[1:]  # the first warms up


def measured(work: Callable[..., object], *arguments: Any) -> tuple[float, float]:
    """Seconds of the processor and peak memory [MB] of some work in this process."""
    start = time.process_time()
    work(*arguments)
    seconds = time.process_time() - start
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return seconds, int(status.partition("VmHWM:")[2].split()[0]) / 1024.0


def apart(work: Callable[..., object], *arguments: Any) -> tuple[float, float]:
    """The same in a process of its own."""
    # An executor waits for its process; a pool ends it while it still reads, with a traceback.
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as executor:
        return executor.submit(measured, work, *arguments).result()


def processes() -> dict[int, tuple[int, float]]:
    """The parent of every process, and its processor time [s]."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it has ended meanwhile
        ticks = int(fields[11]) + int(fields[12])
        found[int(folder.name)] = int(fields[1]), ticks / os.sysconf("SC_CLK_TCK")
    return found
