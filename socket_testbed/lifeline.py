"""Processes that end with the one that started them, whatever ended that."""

from __future__ import annotations

import ctypes
import os
import signal

PARENT = "SOCKET_TESTBED_PARENT"

_PR_SET_PDEATHSIG = 1


def end_with_parent(number: signal.Signals) -> None:
    """Ask the kernel to send this process a signal when its parent ends (Linux)."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)


def follow_starter() -> None:
    """End cleanly with the command that started this node, if one did."""
    starter = os.environ.get(PARENT)
    if starter is None:
        return
    end_with_parent(signal.SIGTERM)
    if os.getppid() != int(starter):  # it ended before the kernel was asked
        os.kill(os.getpid(), signal.SIGTERM)
