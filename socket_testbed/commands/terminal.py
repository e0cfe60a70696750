"""Terminal output: tables, numbers, progress, and the status of a graph.

The status is a single line, redrawn below the log. Nodes print to a file, which is copied to the
terminal line by line: nodes never block on a stalled terminal, and their last output is kept.
Without a terminal, nodes print to the output directly, and the status follows once a minute.
"""

from __future__ import annotations

import os
import select
import shutil
import sys
import tempfile
import termios
import time
import tty
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Self

from socket_testbed.live.graph_status import GraphStatus
from socket_testbed.tables import NOTHING, Table, duration_text, number
from socket_testbed.wire.topics import Topic, full_namespace

if TYPE_CHECKING:
    from socket_testbed.nodes.controls import StatusListener

_DRAW_INTERVAL = 0.5  # [s]
_STATUS_LOG_INTERVAL = 60.0  # [s]; between status lines without a terminal
_PROGRESS_LOG_INTERVAL = 10.0  # [s]; between progress lines without a terminal
_SILENCE_LIMIT = 5.0  # [s]; without a trigger
_STDIN = 0
_CHUNK = 1 << 14  # [B]; of the nodes' output
_DEFAULT_WIDTH = 80  # columns
_SEPARATOR = " | "
_CLEAR = "\x1b[K"  # to the end of the line


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table with numbers right-aligned and text left-aligned.

    Args:
        header: Titles of the columns.
        rows: Cells of each row, one per column.
    """
    columns = []
    for title, *cells in zip(header, *rows, strict=True):
        width = max(map(len, (title, *cells)))
        justify = str.rjust if all(map(_is_number, cells)) else str.ljust
        columns.append([justify(cell, width) for cell in (title, "-" * width, *cells)])
    return "\n".join("  ".join(row).rstrip() for row in zip(*columns, strict=True))


def text_of(found: Table) -> str:
    """A table of a page as text for the terminal."""
    header = [found.frame.index.name or "", *(title for _, title, _ in found.columns)]
    rows = [[str(name), *map(_in_ascii, cells)] for name, cells in found.rows]
    return table(header, rows)


def _is_number(cell: str) -> bool:
    return cell in {"", "-"} or cell.lstrip("-").replace(".", "", 1).isdigit()


def decimals(value: float, digits: int = 3) -> str:
    """A number with fixed decimals; a dash for one that is not finite.

    Args:
        value: The number, in any unit.
        digits: Number of decimals.
    """
    return _in_ascii(number(value, f"z.{digits}f"))


def _in_ascii(cell: str) -> str:
    return "-" if cell == NOTHING else cell


def say(line: str) -> None:
    """Print a line on standard error."""
    print(line, file=sys.stderr, flush=True)


class Progress:
    """The progress of long work, as a line on standard error; see `Progress` of the API."""

    def __init__(self, task: str) -> None:
        self._task = task
        self._last = time.monotonic()
        self._shown = False

    def __call__(self, done: int, total: int) -> None:
        """Report progress, at most twice a second, without a terminal every ten seconds.

        Args:
            done: Number of steps done.
            total: Number of all steps.
        """
        terminal, end = sys.stderr.isatty(), done == total
        passed = time.monotonic() - self._last
        interval = _DRAW_INTERVAL if terminal else _PROGRESS_LOG_INTERVAL
        if (end and self._shown) or passed > interval:
            self._last, self._shown = time.monotonic(), not end
            start, tail = "\r" * terminal, "\n" * (end or not terminal)
            print(f"{start}{self._task}: {100 * done // total} %", end=tail, file=sys.stderr)


class StatusLine:
    """The status of a graph on standard error; a context manager.

    Args:
        disk: Folder whose free disk space is shown, if any.
        duration: Duration of the replayed trial [s]; None without an end.
        pause: Service that pauses the replay, called by the space bar; empty for none.
        paused: Whether the replay starts paused.

    Attributes:
        output: Output for the graph's nodes; None for this process's own output.
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
        self._printed = 0  # [B]; of the nodes' output
        self._pending = bytearray()  # not yet accepted by the terminal
        self._renews = sys.stderr.isatty() and os.environ.get("TERM", "dumb") != "dumb"
        if sys.stderr.isatty():
            colours = self._renews and not os.environ.get("NO_COLOR")
            os.environ.setdefault("RCUTILS_COLORIZED_OUTPUT", str(int(colours)))
        self.output: IO[bytes] | None = None
        if self._renews:
            self._terminal = _non_blocking(sys.stderr.fileno())
            self._stack.callback(os.close, self._terminal)
            self.output = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the others
            self._stack.enter_context(self.output)

    def __enter__(self) -> Self:
        if self._has_keys:
            before = termios.tcgetattr(_STDIN)
            self._stack.callback(termios.tcsetattr, _STDIN, termios.TCSADRAIN, before)
            tty.setcbreak(_STDIN)
        if self._paused:
            key = "press the space bar, or call " if self._has_keys else ""
            call = f"ros2 service call {self._pause} std_srvs/srv/SetBool '{{data: false}}'"
            self.say(f"paused; to continue: {key}{call}")
        return self

    def __exit__(self, *error: object) -> None:
        if self._renews:
            self._copy_output(everything=True)
            self._draw()
            self._write("\n" if self._shown else "")
            os.set_blocking(self._terminal, True)
            self._flush()
        self._stack.close()

    def follow(self, namespace: str = "/", absent: Iterable[Topic] = ()) -> None:
        """Follow the graph in a namespace from now on.

        Args:
            namespace: The namespace.
            absent: Topics of a sample that nobody measures in this graph.
        """
        self._status.absent = frozenset(absent)
        # Only verbs that run a graph need ROS.
        from socket_testbed.nodes.controls import StatusListener

        self._listener = StatusListener(self._status, full_namespace(namespace), self._pause)
        self._stack.callback(self._listener.close)

    def say(self, line: str) -> None:
        """Print a line above the status."""
        if self._renews:
            self._copy_output()
            self._write(f"\r{_CLEAR}{line}\n")
            self._draw()
        else:
            say(line)

    @property
    def triggered(self) -> bool:
        """Whether a trigger has been received."""
        return self._status.triggers > 0

    @property
    def trials(self) -> set[str]:
        """Names of all trials whose recording was announced."""
        return self._status.trials

    def renew(self) -> None:
        """Print new output of the nodes, and the status when due."""
        if self._is_pressed():
            self._paused = not self._paused
            self._draw()
        if self._listener is not None:
            self._listener.take()
            # A key pressed before the replay has started takes effect when it has.
            if self._paused != self._asked and self._listener.set_paused(self._paused):
                self._asked = self._paused
        passed = time.monotonic() - self._renewed
        if self._renews:
            if self._flush() and (self._copy_output() or passed > _DRAW_INTERVAL):
                self._draw()
        elif passed > _STATUS_LOG_INTERVAL:
            self._renewed = time.monotonic()
            self.say(_SEPARATOR.join(self._parts()))

    def _is_pressed(self) -> bool:
        """Whether the space bar was pressed an odd number of times since the last call."""
        # A background process that reads from its terminal is stopped.
        if not self._has_keys or not _in_foreground():
            return False
        ready = select.select([_STDIN], [], [], 0.0)[0]
        return bool(ready) and os.read(_STDIN, _CHUNK).count(b" ") % 2 == 1

    def _copy_output(self, everything: bool = False) -> bool:
        """Print complete lines from the nodes; returns whether there were any."""
        assert self.output is not None
        file = self.output.fileno()
        size = os.fstat(file).st_size - self._printed if everything else _CHUNK
        data = os.pread(file, size, self._printed)
        if not everything and (b"\n" in data or len(data) < _CHUNK):  # or a line without an end
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
        self._pending += text.encode(errors="replace")
        self._flush()

    def _flush(self) -> bool:
        """Write without blocking; returns whether everything was written."""
        try:
            while self._pending:
                del self._pending[: os.write(self._terminal, self._pending)]
        except BlockingIOError:
            return False
        except OSError:  # losing the terminal must not end a recording
            self._pending.clear()
        return True

    def _parts(self) -> list[str]:
        first = ["paused: press the space bar"] if self._paused and self._has_keys else []
        return first + status_parts(self._status, self._duration, self._disk)


def status_parts(
    status: GraphStatus, duration: float | None = None, disk: Path | None = None
) -> list[str]:
    """A status in words, the most important first.

    Args:
        status: What was heard of the graph: times [s], and the newest wrench [M; F] [N m, N].
        duration: Duration of a replayed trial [s]; None without an end.
        disk: Folder whose free disk space is shown; None to show none.
    """
    elapsed = duration_text(status.elapsed)
    if duration is not None:
        elapsed += f" of {duration_text(duration)}"
    parts = [elapsed, f"{status.triggers} triggers, {status.complete} complete"]
    silence = 0.0 if status.heard is None else time.monotonic() - status.heard
    if silence > max(_SILENCE_LIMIT, 3.0 * status.elapsed / max(status.triggers - 1, 1)):
        parts.append(f"no trigger for {silence:.0f} s")
    if status.trial:
        parts.append(f"recording {''.join(c if c.isprintable() else '?' for c in status.trial)}")
    if disk is not None:
        with suppress(OSError):  # the folder does not exist yet, or was removed
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
    """As many whole parts as fit into a line.

    Args:
        parts: The parts, the most important first; the first one is cut if it is too long.
        columns: Number of columns of the terminal.
    """
    line = parts[0]
    for part in parts[1:]:
        # The last column stays free: some terminals wrap after it.
        if len(line) + len(_SEPARATOR) + len(part) < columns:
            line += _SEPARATOR + part
    return line[: max(columns - 1, 0)]


def _in_foreground() -> bool:
    """Whether this process may read keys from its terminal."""
    try:
        return os.isatty(_STDIN) and os.tcgetpgrp(_STDIN) == os.getpgrp()
    except OSError:
        return False


def _columns() -> int:
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns or _DEFAULT_WIDTH
    except OSError:
        return _DEFAULT_WIDTH


def _non_blocking(terminal: int) -> int:
    """Reopen the terminal of a file descriptor for non-blocking writes.

    It may be stalled (Ctrl-S) or slow. The descriptor itself is shared with other processes.
    """
    try:
        return os.open(os.ttyname(terminal), os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
    except OSError:  # another user's
        return os.dup(terminal)
