"""Real-time scheduling of the processes that measure, and how late this machine wakes them up."""

from __future__ import annotations

import ctypes
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from socket_testbed.settings.acquisition import SchedulingSettings

_LIMITS = "/etc/security/limits.d/socket_testbed.conf"
# Of mlockall: what is there now, what comes, and each page only once it is used.
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_NAP = 0.002  # [s]; a conversion of the load cell's converter
_LATEST = 3e-3  # [s]; lateness that the drivers bridge
_OF_A_PERIOD = 0.25  # [-]; part of the trigger's period that a reading may be late


def schedule(settings: SchedulingSettings) -> list[str]:
    """Schedule all threads of this process as its settings want it; later threads inherit it.

    Returns:
        What was refused, a line each: the fact, and how to get the right to it.
    """
    refused = []
    if settings.cores:
        try:
            _change_threads(lambda thread: os.sched_setaffinity(thread, settings.cores))
        except OSError as error:
            refused.append(
                f"scheduling.cores {list(settings.cores)} is refused ({error.strerror}):"
                f" this machine has the cores 0 to {(os.cpu_count() or 1) - 1}"
            )
    if settings.priority:
        try:
            _change_threads(lambda thread: _set_priority(thread, settings.priority))
        except OSError as error:
            refused.append(
                f"scheduling.priority {settings.priority} is refused ({error.strerror}): put"
                f" 'USER - rtprio {settings.priority}' into {_LIMITS} and log in anew,"
                " or give the right CAP_SYS_NICE"
            )
    if settings.lock_memory:
        try:
            _lock_memory()
        except OSError as error:
            refused.append(
                f"scheduling.lock_memory is refused ({error.strerror}): put"
                f" 'USER - memlock unlimited' into {_LIMITS} and log in anew,"
                " or give the right CAP_IPC_LOCK"
            )
    return refused


def schedule_ordinarily() -> None:
    """Give a real-time priority that was inherited back."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _change_threads(change: Callable[[int], None]) -> None:
    """Change every thread of this process, given by its number."""
    for path in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # it has ended meanwhile
            change(int(path.name))


def _set_priority(thread: int, priority: int) -> None:
    os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))


def _lock_memory() -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


@dataclass(frozen=True)
class Lateness:
    """How late a thread wakes up from short sleeps.

    Attributes:
        p99: 99th percentile [s].
        worst: The longest [s].
    """

    p99: float
    worst: float

    def suffices(self, rate: float) -> bool:
        """Whether it is small enough for a trigger's rate [Hz]."""
        return self.p99 <= min(_LATEST, _OF_A_PERIOD / rate)


def measure_lateness(priority: int = 0, duration: float = 1.0) -> Lateness | None:
    """Measure how late a thread wakes up, for a while [s].

    Args:
        priority: Its real-time priority; 0 for an ordinary thread.
        duration: How long that is measured [s].

    Returns:
        The lateness; None where this process has no right to such a priority.
    """
    late: list[float] = []

    def nap() -> None:
        try:
            if priority:
                _set_priority(0, priority)  # of this thread alone
        except OSError:
            return
        due = time.perf_counter()
        ends = due + duration
        while due < ends:
            due = max(due + _NAP, time.perf_counter())
            time.sleep(max(0.0, due - time.perf_counter()))
            late.append(time.perf_counter() - due)

    thread = threading.Thread(target=nap, name="lateness")
    thread.start()
    thread.join()
    return Lateness(float(np.percentile(late, 99)), max(late)) if late else None
