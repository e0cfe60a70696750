"""Real-time scheduling of the processes that measure, and how late this machine wakes them up."""

from __future__ import annotations

import ctypes
import os
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.settings.acquisition import SchedulingSettings

_LIMITS = "/etc/security/limits.d/socket_testbed.conf"
# Of mlockall: what is there now, what comes, and each page only once it is used.
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_NAP = 0.002  # [s]; a conversion of the load cell's converter


def schedule(settings: SchedulingSettings) -> list[str]:
    """Schedule all threads of this process as its settings want it; later threads inherit it.

    Returns:
        What was refused, a line each: the fact, and how to get the right to it.
    """
    cores, priority = settings.cores, settings.priority
    wanted: list[tuple[str, Any, str]] = []
    if cores:
        hint = f"this machine has the cores 0 to {(os.cpu_count() or 1) - 1}"
        wanted.append((f"cores {list(cores)}", (os.sched_setaffinity, cores), hint))
    if priority:
        change = (os.sched_setscheduler, os.SCHED_FIFO, os.sched_param(priority))
        wanted.append(
            (f"priority {priority}", change, _right(f"rtprio {priority}", "CAP_SYS_NICE"))
        )
    refused = []
    for what, (call, *values), hint in wanted:
        try:
            for thread in Path("/proc/self/task").iterdir():
                with suppress(ProcessLookupError):  # it has ended meanwhile
                    call(int(thread.name), *values)
        except OSError as error:
            refused.append(f"scheduling.{what} is refused ({error.strerror}): {hint}")
    libc = ctypes.CDLL(None, use_errno=True)
    if settings.lock_memory and libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        reason, hint = os.strerror(ctypes.get_errno()), _right("memlock unlimited", "CAP_IPC_LOCK")
        refused.append(f"scheduling.lock_memory is refused ({reason}): {hint}")
    return refused


def _right(limit: str, capability: str) -> str:
    return f"put 'USER - {limit}' into {_LIMITS} and log in anew, or give the right {capability}"


def schedule_ordinarily() -> None:
    """Give a real-time priority that was inherited back."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def measure_lateness(priority: int = 0, duration: float = 1.0) -> FloatArray:
    """Measure for a while [s] how late a thread wakes up from short sleeps.

    Args:
        priority: Its real-time priority; 0 for an ordinary thread.
        duration: How long that is measured [s].

    Returns:
        How late it was each time [s]; none where this process has no right to such a priority.
    """
    late: list[float] = []

    def nap() -> None:
        if priority:
            try:
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))  # of this thread
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
    return np.array(late)
