"""How fast a simulated testbed can run on this machine, from a measurement of a second."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from socket_testbed.live.scheduling import measure_lateness

SCALES = (1.0, 0.5, 0.25, 0.125, 0.0625)  # testbed seconds per real second [-]
SLOWEST = SCALES[-1]

_WATCHED = 0.5  # [s]; for each of the two measurements
_UNIT = 115e-6  # [s]; for the unit of work on an idle core of the machine that this was tried on
# Measured: with 0.034 of such a core for a busy process and threads that wake up 10 ms late, half
# of real time left 2 % of the samples incomplete, real time 30 %.
_ENOUGH = 0.13  # [-]; part of such a core that suffices for real time
_LATEST = 3e-3  # [s]; lateness that the drivers bridge in real time


@dataclass(frozen=True)
class MachineSpeed:
    """What one more process gets of this machine at present.

    Attributes:
        lateness: How late a thread wakes up from a short sleep, 90th percentile [s].
        speed: Work that a thread gets done, relative to an idle core of the reference [-].
    """

    lateness: float
    speed: float

    def time_scale(self) -> float:
        """The fastest scale at which a simulated testbed can be expected to keep up [-]."""
        fastest = min(self.speed / _ENOUGH, _LATEST / max(self.lateness, 1e-9))
        return next((scale for scale in SCALES if scale <= fastest), SLOWEST)


def measure_speed() -> MachineSpeed:
    """Measure what this machine manages; takes about a second."""
    lateness = measure_lateness(duration=_WATCHED)
    units = 0
    begin = now = time.perf_counter()
    while now - begin < _WATCHED:
        _work()
        units += 1
        now = time.perf_counter()
    return MachineSpeed(float(np.percentile(lateness, 90)), units * _UNIT / (now - begin))


def _work() -> int:
    total = 0
    for k in range(2000):
        total += k * k % 7
    return total


def pace(scale: float) -> str:
    """How fast a simulated testbed runs, in words: 'a quarter of real time'."""
    names = {1.0: "real time", 0.5: "half of real time", 0.25: "a quarter of real time"}
    names |= {0.125: "an eighth of real time", SLOWEST: "a sixteenth of real time"}
    return names.get(scale, f"{scale:g} of real time")


def busy_note(scale: float) -> str:
    """What to print when a scale was chosen; empty for real time."""
    if scale == 1.0:
        return ""
    return f"this machine is busy: the simulated testbed runs at {pace(scale)}"
