"""What the times were measured on (cores, BLAS threads, versions), and how."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

_PACKAGES = ("numpy", "scipy", "osqp", "qpsolvers", "cvxpy")


def describe_machine(threads: int) -> str:
    """Lines that name the machine and the versions of what ran on it.

    Args:
        threads: BLAS threads of the processes that measure.
    """
    versions = ", ".join(f"{name} {_version(name)}" for name in _PACKAGES)
    return (
        f"machine: {platform.system()} {platform.machine()}, {_processor()},"
        f" {len(os.sched_getaffinity(0))} cores; BLAS threads: {threads}\n"
        f"versions: Python {sys.version.split()[0]}, {versions}"
    )


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


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
