"""What a terminal shows: tables, numbers, progress, and what a graph does now.

The status of a graph is one line that renews itself below the lines of what happened. The nodes
print into a file, from which the terminal gets whole lines: no node waits for a terminal that is
held up, and what one printed last is there after it has ended. Where the output is no terminal, the
nodes print into it themselves, and the status comes as a line a minute.
"""

from __future__ import annotations

import math
import os
import select
import shutil
import sys
import tempfile
import termios
import time
import tty
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from datetime import timedelta
from pathlib import Path
from typing import IO, TYPE_CHECKING, Self

from socket_testbed.live.graph_status import GraphStatus
from socket_testbed.tables import NOTHING, Table
from socket_testbed.trials.topics import full_namespace

if TYPE_CHECKING:
    from socket_testbed.nodes.controls import StatusListener

_PERIOD = 0.5  # [s]; between two drawings
_LOGGED_PERIOD = 60.0  # [s]; where nothing can be drawn over
_LOGGED_PROGRESS = 10.0  # [s]; likewise
_SILENCE = 5.0  # [s]; without a trigger
_KEYS = 0  # standard input
_CHUNK = 1 << 14  # [B]; of what the nodes have said
_WIDTH = 80  # columns of a terminal that does not say
_SEPARATOR = " | "
_CLEAR = "\x1b[K"  # to the end of the line


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table with numbers to the right and texts to the left."""
    columns = []
    for title, *cells in zip(header, *rows, strict=True):
        width = max(map(len, (title, *cells)))
        justify = str.rjust if all(map(_is_number, cells)) else str.ljust
        columns.append([justify(cell, width) for cell in (title, "-" * width, *cells)])
    return "\n".join("  ".join(row).rstrip() for row in zip(*columns, strict=True))


def text_of(found: Table) -> str:
    """A table of a page as a table on the terminal."""
    header = [found.frame.index.name or "", *(title for _, title, _ in found.columns)]
    rows = [[str(name), *("-" if c == NOTHING else c for c in cells)] for name, cells in found.rows]
    return table(header, rows)


def _is_number(cell: str) -> bool:
    return cell in {"", "-"} or cell.lstrip("-").replace(".", "", 1).isdigit()


def number(value: float | None, digits: int = 3) -> str:
    """A number for a table; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{round(value, digits) + 0.0:.{digits}f}"


def say(line: str) -> None:
    """Print a line of what happens on standard error."""
    print(line, file=sys.stderr, flush=True)


class Progress:
    """A line on standard error with the progress of long work."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._last = time.monotonic()
        self._shown = False

    def __call__(self, done: int, total: int) -> None:
        """Report how many steps are done."""
        terminal, end = sys.stderr.isatty(), done == total
        passed = time.monotonic() - self._last
        if (end and self._shown) or passed > (_PERIOD if terminal else _LOGGED_PROGRESS):
            self._last, self._shown = time.monotonic(), not end
            start, tail = "\r" * terminal, "\n" * (end or not terminal)
            print(f"{start}{self._what}: {100 * done // total} %", end=tail, file=sys.stderr)


class StatusLine:
    """The status of a graph on standard error; a context manager.

    Args:
        disk: Folder whose free space is shown; None for none.
        duration: Of what is replayed [s]; None where there is no end.
        pause: Service that pauses what is replayed: the space bar calls it; empty for none.
        paused: Whether it starts paused.

    Attributes:
        output: Where the graph's nodes are to print to; None for this process's own output.
    """

    def __init__(
        self,
        disk: Path | None = None,
        duration: float | None = None,
        pause: str = "",
        paused: bool = False,
    ) -> None:
        self._disk, self._duration = disk, duration
        self._pause = pause
        self._paused = self._asked = paused
        self._has_keys = bool(pause) and _in_foreground()
        self._listener: StatusListener | None = None
        self._status = GraphStatus()
        self._stack = ExitStack()
        self._renewed = time.monotonic()
        self._shown = False
        self._printed = 0  # [B]; of what the nodes said
        self._waiting = bytearray()  # what the terminal does not take yet
        self._renews = sys.stderr.isatty() and os.environ.get("TERM", "dumb") != "dumb"
        if sys.stderr.isatty():
            colours = self._renews and not os.environ.get("NO_COLOR")
            os.environ.setdefault("RCUTILS_COLORIZED_OUTPUT", str(int(colours)))
        self.output: IO[bytes] | None = None
        if self._renews:
            self._terminal = _without_waits(sys.stderr.fileno())
            self._stack.callback(os.close, self._terminal)
            self.output = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the others
            self._stack.enter_context(self.output)

    def __enter__(self) -> Self:
        if self._has_keys:
            before = termios.tcgetattr(_KEYS)
            self._stack.callback(termios.tcsetattr, _KEYS, termios.TCSADRAIN, before)
            tty.setcbreak(_KEYS)
        if self._paused:
            key = "press the space bar, or call " if self._has_keys else ""
            call = f"ros2 service call {self._pause} std_srvs/srv/SetBool '{{data: false}}'"
            self.say(f"paused; to go on: {key}{call}")
        return self

    def __exit__(self, *error: object) -> None:
        if self._renews:
            self._pass_on(everything=True)
            self._draw()
            self._write("\n" if self._shown else "")
            os.set_blocking(self._terminal, True)
            self._flush()
        self._stack.close()

    def follow(self, namespace: str = "/") -> None:
        """Count what the graph in a namespace measures, from now on."""
        # ROS is imported only where a graph runs: the rest works without it.
        from socket_testbed.nodes.controls import StatusListener

        self._listener = StatusListener(self._status, full_namespace(namespace), self._pause)
        self._stack.callback(self._listener.close)

    def say(self, line: str) -> None:
        """Print a line of what happened."""
        if self._renews:
            self._pass_on()
            self._write(f"\r{_CLEAR}{line}\n")
            self._draw()
        else:
            say(line)

    @property
    def triggered(self) -> bool:
        """Whether a trigger has come."""
        return self._status.triggers > 0

    def renew(self) -> None:
        """Print what the nodes have said meanwhile, and the status when it is due."""
        if self._is_pressed():
            self._paused = not self._paused
            self._draw()
        if self._listener is not None:
            self._listener.take()
            # Pressed before the replay is up, it counts as soon as it is.
            if self._paused != self._asked and self._listener.set_paused(self._paused):
                self._asked = self._paused
        passed = time.monotonic() - self._renewed
        if self._renews:
            if self._flush() and (self._pass_on() or passed > _PERIOD):
                self._draw()
        elif passed > _LOGGED_PERIOD:
            self._renewed = time.monotonic()
            self.say(_SEPARATOR.join(self._parts()))

    def _is_pressed(self) -> bool:
        """Whether the space bar was pressed since the last call, an odd number of times."""
        # A program in the background that reads from its terminal is stopped.
        if not self._has_keys or not _in_foreground():
            return False
        ready = select.select([_KEYS], [], [], 0.0)[0]
        return bool(ready) and os.read(_KEYS, _CHUNK).count(b" ") % 2 == 1

    def _pass_on(self, everything: bool = False) -> bool:
        """Print the lines that the nodes have completed; returns whether there are any."""
        assert self.output is not None
        file = self.output.fileno()
        size = os.fstat(file).st_size - self._printed if everything else _CHUNK
        data = os.pread(file, size, self._printed)
        if not everything:
            data = data[: data.rfind(b"\n") + 1]
        self._printed += len(data)
        for line in data.decode(errors="replace").splitlines():
            self._write(f"\r{_CLEAR}{line}\n")
        return bool(data)

    def _draw(self) -> None:
        if self._renews and (self.triggered or self._paused or self._shown):
            self._renewed, self._shown = time.monotonic(), True
            self._write(f"\r{fitted(self._parts(), _columns())}{_CLEAR}")

    def _write(self, text: str) -> None:
        self._waiting += text.encode(errors="replace")
        self._flush()

    def _flush(self) -> bool:
        """Give the terminal what it takes at once; returns whether that is all there was."""
        try:
            while self._waiting:
                del self._waiting[: os.write(self._terminal, self._waiting)]
        except BlockingIOError:
            return False
        except OSError:  # a terminal that is gone ends no recording
            self._waiting.clear()
        return True

    def _parts(self) -> list[str]:
        first = ["paused: press the space bar"] if self._paused and self._has_keys else []
        return first + status_parts(self._status, self._duration, self._disk)


def status_parts(
    status: GraphStatus, duration: float | None = None, disk: Path | None = None
) -> list[str]:
    """A status in words, the most important ones first; of a replay with its duration [s]."""
    elapsed = str(timedelta(seconds=int(status.elapsed)))
    if duration is not None:
        elapsed += f" of {timedelta(seconds=int(duration))}"
    parts = [elapsed, f"{status.triggers} triggers, {status.complete} complete"]
    if status.heard is not None and (silence := time.monotonic() - status.heard) > _SILENCE:
        parts.append(f"no trigger for {silence:.0f} s")
    if status.trial:
        parts.append(f"recording {''.join(c if c.isprintable() else '?' for c in status.trial)}")
    if disk is not None:
        with suppress(OSError):  # the recorder has not made it yet, or it is gone
            parts.append(f"{1e-9 * shutil.disk_usage(disk).free:.3g} GB free")
    if status.wrench is not None:
        moments, forces = status.wrench[:3], status.wrench[3:]
        parts.append(f"F {' '.join(f'{force:.0f}' for force in forces)} N")
        parts.append(f"M {' '.join(f'{moment:.1f}' for moment in moments)} N m")
    if status.variant:
        errors = status.errors()
        off = f" off by {errors[0]:.1f} N, {errors[1]:.2f} N m" if errors else ""
        parts.append(f"{status.variant}{off}")
    return parts


def fitted(parts: Sequence[str], columns: int) -> str:
    """As many of some parts as fit into a line with so many columns, none of them cut in two."""
    line = parts[0]
    for part in parts[1:]:
        # The last column stays free: some terminals go on to the next line after it.
        if len(line) + len(_SEPARATOR) + len(part) < columns:
            line += _SEPARATOR + part
    return line[: max(columns - 1, 0)]


def _in_foreground() -> bool:
    """Whether this program may read the keys of its terminal."""
    try:
        return os.isatty(_KEYS) and os.tcgetpgrp(_KEYS) == os.getpgrp()
    except OSError:
        return False


def _columns() -> int:
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns or _WIDTH
    except OSError:
        return _WIDTH


def _without_waits(terminal: int) -> int:
    """The terminal of a file descriptor, opened anew so that writing to it does not wait.

    It may be held up (Ctrl-S), or be a slow line. The descriptor itself is shared with others.
    """
    try:
        return os.open(os.ttyname(terminal), os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
    except OSError:  # another user's
        return os.dup(terminal)
