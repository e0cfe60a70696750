"""The graph as processes: what it needs, what it does without, and what it starts again."""

import tempfile
from pathlib import Path

import pytest

from socket_testbed.errors import TestbedError
from socket_testbed.live.processes import Graph

pytestmark = pytest.mark.graph

NODE = """
import os, signal, rclpy
from socket_testbed.live.processes import RESTARTED
from socket_testbed.nodes.base import OK, TestbedNode
from socket_testbed.settings.fields import Settings

rclpy.init()
node = TestbedNode("worker", Settings)
node.report(OK, "works")
if RESTARTED not in os.environ:
    os.kill(os.getpid(), signal.SIGKILL)
signal.pause()
"""


def test_a_graph_ends_with_what_it_needs_and_goes_on_without_what_is_optional(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first OK of a node that was killed is a recovery."""
    (tmp_path / "worker.py").write_text(NODE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    restarts: list[str] = []
    with tempfile.TemporaryFile("w+") as log, Graph(log) as graph:

        def said() -> list[str]:
            log.seek(0)
            return [line.rpartition("]: ")[2] for line in log if "works" in line]

        graph.start_program("page", "socket_testbed.nodes", ["no_such_node"], optional=True)
        graph.start_program("worker", "worker", [])
        graph.watch(lambda: len(said()) >= 2 and len(restarts) >= 2, restarts.append)
        assert [line.strip() for line in said()] == ["works", "recovered: works"]
        assert {"page ended with exit code 1: started again"} < set(restarts)
        assert "worker was ended by SIGKILL: started again" in restarts
        graph.start_program("needed", "socket_testbed.nodes", ["no_such_node"])
        with pytest.raises(TestbedError, match="needed ended with exit code 1"):
            graph.watch(lambda: False, restarts.append)
