"""A clock for tests that never wait, and how fast others let a simulated testbed run."""

import shutil
import struct
import subprocess
from pathlib import Path
from typing import Self

import pytest

from socket_testbed import clocks
from socket_testbed.live.scheduling import SLOWEST, measure_speed


def careful_time_scale() -> float:
    """What this machine manages, on a busy one with a reserve for what starts meanwhile [-]."""
    scale = measure_speed().time_scale()
    return scale if scale == 1.0 else max(0.5 * scale, SLOWEST)


class FakeClock:
    """A steady clock [s] that only sleeping moves on, and looking at it if that takes time."""

    def __init__(self, now: float = 100.0, look: float = 0.0) -> None:
        self.now = now
        self._look = look

    def __call__(self) -> float:
        self.now += self._look
        return self.now

    def sleep(self, duration: float) -> None:
        assert duration >= 0.0
        self.now += duration

    def install(self, monkeypatch: pytest.MonkeyPatch) -> Self:
        """Let all of this process go by it."""
        monkeypatch.setattr(clocks, "monotonic", self)
        monkeypatch.setattr(clocks, "sleep", self.sleep)
        return self


class SystemClock:
    """A system clock of other processes, which a test sets; skips the test without a compiler.

    The machine's own clock is left alone: `set_clock.c` stands between the processes and the C
    library.

    Args:
        folder: An existing folder for its files.

    Attributes:
        environment: Environment variables of the processes that go by it.
    """

    def __init__(self, folder: Path) -> None:
        if not (compiler := shutil.which("gcc")):
            pytest.skip("gcc is not installed: it compiles the system clock that is set")
        library, self._shift = folder / "set_clock.so", folder / "shift"
        source = Path(__file__).with_name("set_clock.c")
        words = [compiler, "-shared", "-fPIC", "-O1", source, "-o", library, "-ldl", "-lpthread"]
        subprocess.run(words, check=True)
        self.environment = {"LD_PRELOAD": str(library), "SET_CLOCK": str(self._shift)}
        self._shift.write_bytes(bytes(8))
        self.set(0.0)

    def set(self, shift: float) -> None:
        """Set it to the machine's own time, shifted by so many seconds."""
        with self._shift.open("r+b") as file:
            file.write(struct.pack("q", round(1e9 * shift)))
