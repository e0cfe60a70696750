"""A node that was killed and started again says that it recovered."""

import tempfile
from pathlib import Path

import pytest

from socket_testbed.live.processes import Graph

pytestmark = pytest.mark.graph

NODE = """
import os, signal, rclpy
from socket_testbed.live.processes import RESTARTED
from socket_testbed.nodes.base import OK
from socket_testbed.nodes.listeners import ListenerNode

rclpy.init()
node = ListenerNode("worker", lambda: None)
node.report(OK, "works")
if RESTARTED not in os.environ:
    os.kill(os.getpid(), signal.SIGKILL)
signal.pause()
"""


def test_its_first_ok_is_a_recovery(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "worker.py").write_text(NODE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    restarts: list[str] = []
    with tempfile.TemporaryFile("w+") as log:

        def said() -> list[str]:
            log.seek(0)
            return [line.rpartition("]: ")[2] for line in log.read().splitlines()]

        with Graph(log) as graph:
            graph.start_program("worker", "worker", [])
            graph.watch(lambda: len(said()) >= 2, restarts.append)
        assert said()[:2] == ["works", "recovered: works"]
    assert restarts == ["worker was ended by SIGKILL: started again"]
