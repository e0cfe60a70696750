"""Scheduling, lateness and speed of this machine, and the time scale that follows from them."""

from __future__ import annotations

import ctypes
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.settings.acquisition import SchedulingSettings

SCALES = {  # testbed seconds per real second [-]
    1.0: "real time",
    0.5: "half of real time",
    0.25: "a quarter of real time",
    0.125: "an eighth of real time",
    0.0625: "a sixteenth of real time",
}
SLOWEST = min(SCALES)
LATEST = 3e-3  # [s]; lateness that the drivers bridge in real time

_LIMITS = "/etc/security/limits.d/socket_testbed.conf"
# Of mlockall: present and future memory, each page only once it is used.
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_NAP = 0.002  # [s]; a conversion of the load cell's converter
_WATCHED = 0.5  # [s]; for each of the two measurements of the speed
_UNIT = 115e-6  # [s]; for the unit of work on an idle core of the machine that this was tried on
# Measured: with 0.034 of such a core for a busy process and threads that wake up 10 ms late, half
# of real time left 2 % of the samples incomplete, real time 30 %.
_ENOUGH = 0.13  # [-]; part of such a core that suffices for real time


def schedule(settings: SchedulingSettings) -> list[str]:
    """Schedule all threads of this process as its settings want it; later threads inherit it.

    Returns:
        What was refused, a line each: the fact, and how to get the right to it.
    """
    cores, priority = settings.cores, settings.priority
    refused = []

    def change(what: str, hint: str, call: Callable[..., None], *values: Any) -> None:
        try:
            for thread in Path("/proc/self/task").iterdir():
                with suppress(ProcessLookupError):  # it has ended meanwhile
                    call(int(thread.name), *values)
        except OSError as error:
            refused.append(f"scheduling.{what} is refused ({error.strerror}): {hint}")

    if cores:
        hint = f"this machine has the cores 0 to {(os.cpu_count() or 1) - 1}"
        change(f"cores {list(cores)}", hint, os.sched_setaffinity, cores)
    if priority:
        hint = _right(f"rtprio {priority}", "CAP_SYS_NICE")
        policy = (os.SCHED_FIFO, os.sched_param(priority))
        change(f"priority {priority}", hint, os.sched_setscheduler, *policy)
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
    """Measure for a while [s] how late a thread wakes up from short sleeps, each time [s].

    Its real-time priority is 0 for an ordinary thread; without the right to one there is no value.
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


@dataclass(frozen=True)
class MachineSpeed:
    """The share of this machine that one more process gets at present."""

    lateness: float  # how late a thread wakes up from a short sleep, 90th percentile [s]
    speed: float  # work that a thread gets done, relative to an idle core of the reference [-]

    def time_scale(self) -> float:
        """The fastest scale at which a simulated testbed can be expected to keep up [-]."""
        fastest = min(self.speed / _ENOUGH, LATEST / max(self.lateness, 1e-9))
        return next((scale for scale in SCALES if scale <= fastest), SLOWEST)


def measure_speed() -> MachineSpeed:
    """Measure this machine for about a second."""
    lateness = measure_lateness(duration=_WATCHED)
    units = 0
    begin = now = time.perf_counter()
    while now - begin < _WATCHED:
        total = 0
        for k in range(2000):  # the unit of work
            total += k * k % 7
        units += 1
        now = time.perf_counter()
    return MachineSpeed(float(np.percentile(lateness, 90)), units * _UNIT / (now - begin))


def pace(scale: float) -> str:
    """How fast a simulated testbed runs, in words: 'a quarter of real time'."""
    return SCALES.get(scale, f"{scale:g} of real time")


def busy_note(scale: float) -> str:
    """A note on the scale that was chosen; empty for real time."""
    if scale == 1.0:
        return ""
    return f"this machine is busy: the simulated testbed runs at {pace(scale)}"
