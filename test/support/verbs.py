"""Verbs called as on the command line, and what a refusal has to be."""

from collections.abc import Sequence

import pytest

from socket_testbed.__main__ import run


def call(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a call."""
    capsys.readouterr()
    code = run([str(word) for word in words])
    return code, *capsys.readouterr()


def refused(capsys: pytest.CaptureFixture[str], *words: object, named: Sequence[str]) -> str:
    """The one line, after notes, that refuses a call: these names, and what to do."""
    code, _, err = call(capsys, *words)
    *notes, line = err.splitlines()
    assert code == 1 and line.startswith(f"socket-testbed {words[0]}: error: "), err
    assert all(note.startswith("note: ") for note in notes) and line.rpartition(": ")[2].strip(), (
        err
    )
    assert not [name for name in named if name not in line], err
    return line
