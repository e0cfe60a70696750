"""The status line in a terminal that is a pseudo-terminal, and where there is none."""

import os
import pty
import re
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from support import HANGS
from support.verbs import COMMAND

from socket_testbed.commands import terminal as module
from socket_testbed.commands.terminal import StatusLine, fitted
from socket_testbed.live.graph_status import GraphStatus


class Terminal:
    """A pseudo-terminal, and what is on its screen."""

    def __init__(self, columns: int = 100) -> None:
        self.master, self.slave = pty.openpty()
        self.seen = b""
        termios.tcsetwinsize(self.slave, (24, columns))

    def read(self) -> None:
        while select.select([self.master], [], [], 0.0)[0]:
            try:
                self.seen += os.read(self.master, 1 << 16)
            except OSError:  # nobody has it open any more
                return

    def screen(self) -> list[str]:
        """The lines: what was written last on each, since every writing clears the rest."""
        self.read()
        rows = re.sub(r"\x1b\[\d*m", "", self.seen.decode()).split("\n")
        parts = ([part for part in re.split(r"\r|\x1b\[K", row) if part] for row in rows)
        return [shown[-1] if shown else "" for shown in parts]

    def wait(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + HANGS
        while not condition():
            assert time.monotonic() < deadline, f"{what}: {self.screen()}"
            select.select([self.master], [], [], 0.05)
            self.read()


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminal]:
    """A terminal of a kind that can go back in a line; the line is drawn at every call."""
    monkeypatch.setattr(module, "_DRAW_INTERVAL", 0.0)
    found = Terminal()
    monkeypatch.setenv("TERM", "xterm")
    for name in ("NO_COLOR", "RCUTILS_COLORIZED_OUTPUT"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    with open(found.slave, "w", closefd=False) as found.stream:
        yield found
    os.close(found.master)
    os.close(found.slave)


def test_lines_of_nodes_stand_above_the_status(terminal, monkeypatch):
    """Half ones too, and those of a node that was killed."""
    monkeypatch.setattr(module, "_CHUNK", 31)
    monkeypatch.setattr(sys, "stderr", terminal.stream)
    with StatusLine() as status:
        assert os.environ["RCUTILS_COLORIZED_OUTPUT"] == "1" and status.output is not None
        for count in (1, 300):
            status._status.triggers = count
            status.renew()
            for said in (f"echo node says {count}; printf half >&2", "echo ' a line'"):
                call = ["sh", "-c", said]
                subprocess.run(call, check=True, stdout=status.output, stderr=status.output)
                status.renew()
        long = ["echo", "a line that is too long to be read at once"]
        subprocess.run(long, check=True, stdout=status.output)
        for _ in range(2):
            status.renew()
        script = "echo one; printf 'two, cut off'; kill -9 $$"
        ended = subprocess.run(["sh", "-c", script], check=False, stdout=status.output)
        assert ended.returncode == -signal.SIGKILL
    *said, last, end = terminal.screen()
    expected = [line for count in (1, 300) for line in (f"node says {count}", "half a line")]
    expected += ["a line that is too long to be r", "ead at once"]
    assert said == [*expected, "one", "two, cut off"]
    assert last == "0:00:00 | 300 triggers, 0 complete" and end == ""


def test_a_name_cannot_steer_the_terminal() -> None:
    status = GraphStatus()
    status.trial = "s01\x1b[2J"
    assert "recording s01?[2J" in module.status_parts(status)


def test_no_number_is_cut_in_two() -> None:
    assert fitted(["abc", "defgh", "ij"], 10) == "abc | ij"


@pytest.mark.slow
@pytest.mark.graph
def test_the_space_bar_resumes_a_paused_replay(hold: Path) -> None:
    """The replay names it."""
    terminal = Terminal(200)
    words = ["replay", str(hold), "--paused", "--rate", "100"]
    pid = os.fork()
    if pid == 0:
        os.login_tty(terminal.slave)
        os.environ["TERM"] = "xterm"
        os.execv(sys.executable, [*COMMAND, *words])
    before = termios.tcgetattr(terminal.slave)
    terminal.wait(lambda: "paused: press the space bar" in terminal.screen()[-1], "paused")
    terminal.wait(lambda: any("replaying" in line for line in terminal.screen()), "replaying")
    os.write(terminal.master, b"x ")
    terminal.wait(lambda: os.waitpid(pid, os.WNOHANG) == (pid, 0), "the end")
    *said, last, end = terminal.screen()
    assert len(said) == 3 and end == ""  # the data, replaying, paused
    assert re.match(r"0:00:\d\d of 0:00:59 \| \d+ triggers, \d+ complete \| F ", last), last
    assert termios.tcgetattr(terminal.slave) == before
