"""Priority and cores of the nodes, and how fast this machine can run a testbed."""

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

_LIMITS_FILE = "/etc/security/limits.d/socket_testbed.conf"
# mlockall: current and future memory, each page on first use.
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_SLEEP_TIME = 0.002  # [s]; conversion time of the load cell's converter
SCALES = {  # testbed seconds per real second [-]
    1.0: "real time",
    0.5: "half of real time",
    0.25: "a quarter of real time",
    0.125: "an eighth of real time",
    0.0625: "a sixteenth of real time",
}
SLOWEST = min(SCALES)
LATEST = 3e-3  # [s]; lateness that the drivers tolerate in real time
_MEASURE_TIME = 0.5  # [s]; for each of the two measurements of the speed
_WORK_TIME = 115e-6  # [s]; for the unit of work on an idle core of the reference machine
# Measured with 0.034 of such a core for a busy process and threads that wake up 10 ms late: at half
# of real time 2 % of the samples were incomplete, in real time 30 %.
_MIN_SPEED = 0.13  # [-]; fraction of such a core required for real time


def schedule(settings: SchedulingSettings) -> list[str]:
    """Apply scheduling settings to all threads of this process; later threads inherit them.

    Returns a line for each refused setting: the fact, and how to get the permission.
    """
    cores, priority = settings.cores, settings.priority
    refused = []

    def change(what: str, hint: str, call: Callable[..., None], *values: Any) -> None:
        try:
            for thread in Path("/proc/self/task").iterdir():
                with suppress(ProcessLookupError):  # it has ended
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
    return f"put 'USER - {limit}' into {_LIMITS_FILE} and log in again, or grant {capability}"


def measure_lateness(priority: int = 0, duration: float = 1.0) -> FloatArray:
    """Measure how late a thread wakes up from short sleeps.

    Args:
        priority: Real-time priority of the thread (SCHED_FIFO); 0 for an ordinary thread.
        duration: Length of the measurement [s].

    Returns:
        The delay of each of the k wake-ups, shape (k,) [s]; empty without permission for the
        priority.
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
            due = max(due + _SLEEP_TIME, time.perf_counter())
            time.sleep(max(0.0, due - time.perf_counter()))
            late.append(time.perf_counter() - due)

    thread = threading.Thread(target=nap, name="lateness")
    thread.start()
    thread.join()
    return np.array(late)


@dataclass(frozen=True)
class MachineSpeed:
    """The share of this machine currently available to one more process.

    Attributes:
        lateness: Delay of threads that wake up from a short sleep, 90th percentile [s].
        speed: Speed of a thread, relative to an idle core of the reference machine [-].
    """

    lateness: float
    speed: float

    def time_scale(self) -> float:
        """The fastest time scale of `SCALES` at which a simulated testbed should keep up [-]."""
        fastest = min(self.speed / _MIN_SPEED, LATEST / max(self.lateness, 1e-9))
        return next((scale for scale in SCALES if scale <= fastest), SLOWEST)


def measure_speed() -> MachineSpeed:
    """Measure this machine for about a second."""
    lateness = measure_lateness(duration=_MEASURE_TIME)
    units = 0
    begin = now = time.perf_counter()
    while now - begin < _MEASURE_TIME:
        total = 0
        for k in range(2000):  # the unit of work
            total += k * k % 7
        units += 1
        now = time.perf_counter()
    return MachineSpeed(float(np.percentile(lateness, 90)), units * _WORK_TIME / (now - begin))


def speed_text(scale: float) -> str:
    """Speed of a simulated testbed from its time scale [-], such as 'a quarter of real time'."""
    return SCALES.get(scale, f"{scale:g} of real time")


def busy_note(scale: float) -> str:
    """A note on the chosen time scale [-]; empty for real time."""
    if scale == 1.0:
        return ""
    return f"this machine is busy: the simulated testbed runs at {speed_text(scale)}"
