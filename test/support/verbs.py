"""Verbs called as on the command line, and what a refusal has to be."""

import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from socket_testbed.__main__ import run
from support.wording import check_line

COMMAND = (sys.executable, "-m", "socket_testbed")
_LONGEST = 500.0  # [s]
_ENDS_WITHIN = 20.0  # [s]; when asked


class Running(subprocess.Popen[str]):
    """A process that is ended at the end: a test that failed would wait for its own.

    By SIGTERM: for two seconds after a kill, Fast DDS repairs the shared memory of all others, and
    a process that takes down its own node just then can crash.
    """

    def __exit__(self, *error: Any) -> None:
        self.terminate()
        with suppress(subprocess.TimeoutExpired):
            self.wait(_ENDS_WITHIN)
        self.kill()
        super().__exit__(*error)


def program(*words: object, folder: Path | None = None, **environment: str) -> tuple[int, str, str]:
    """Exit code and outputs of a program in a process of its own, which prints no traceback."""
    done = subprocess.run(
        [str(word) for word in words], check=False, cwd=folder, env=os.environ | environment,
        capture_output=True, text=True, timeout=_LONGEST,
    )  # fmt: skip
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode, done.stdout, done.stderr


def call(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a call."""
    capsys.readouterr()
    code = run([str(word) for word in words])
    return code, *capsys.readouterr()


def refused(capsys: pytest.CaptureFixture[str], *words: object, named: Sequence[str]) -> str:
    """The one line, after notes, that refuses a call: these names, and what to do."""
    code, _, err = call(capsys, *words)
    *notes, line = err.splitlines()
    assert code == 1 and all(note.startswith("note: ") for note in notes), err
    check_line(line.removeprefix(f"socket-testbed {words[0]}: error: "), *named)
    return line
