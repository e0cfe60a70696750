"""The graph as processes: each node started with its settings, watched, and ended cleanly."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Self

import yaml

from socket_testbed.checked import Settings, parameter_values
from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.lifeline import PARENT

_GRACE = 8.0  # [s]; for a node to end by itself
_LOOK = 0.05  # [s]


class NodeFailedError(TestbedError):
    """A node ended by itself with an error."""


class Graph:
    """Node processes that live and end together; a context manager.

    Args:
        output: Where the nodes print to; None for this process's own output.

    Raises:
        ConfigurationError: On entry, if ROS 2 cannot be imported.
    """

    def __init__(self, output: IO[str] | None = None) -> None:
        self._output = output
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._folder = tempfile.TemporaryDirectory(prefix="socket_testbed_")

    def __enter__(self) -> Self:
        for package in ("rclpy", "socket_testbed_msgs"):
            if importlib.util.find_spec(package) is None:
                raise ConfigurationError(
                    f"{package} cannot be imported",
                    "run 'make setup', or source the ROS 2 workspace that holds this package",
                )
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()
        self._folder.cleanup()

    def start(
        self, node: str, settings: Settings, namespace: str = "/", use_sim_time: bool = False
    ) -> None:
        """Start a node.

        Args:
            node: Its name, such as estimator_node.
            settings: Its settings.
            namespace: Its namespace.
            use_sim_time: Whether it takes its time from /clock.
        """
        file = Path(self._folder.name) / f"{node}.yaml"
        file.write_text(yaml.safe_dump(parameter_file(settings, use_sim_time)))
        command = [sys.executable, "-m", f"socket_testbed.nodes.{node}"]
        # In a session of its own, Ctrl-C reaches a node once: from this process.
        self._processes[node] = subprocess.Popen(
            [*command, "--ros-args", "-r", f"__ns:={namespace}", "--params-file", str(file)],
            stdout=self._output,
            stderr=self._output,
            start_new_session=True,
            env={**os.environ, PARENT: str(os.getpid())},
        )

    def wait(self, node: str) -> None:
        """Wait until a node has done its work.

        Raises:
            NodeFailedError: If it, or another meanwhile, ended with an error.
        """
        while self._processes[node].poll() is None:
            for name, process in self._processes.items():
                if name != node and process.poll() is not None:
                    raise NodeFailedError(
                        f"{name} ended with exit code {process.returncode}", "see what it printed"
                    )
            time.sleep(_LOOK)
        code = self._processes[node].returncode
        if code != 0:
            raise NodeFailedError(f"{node} ended with exit code {code}", "see what it printed")

    def stop(self) -> None:
        """End all nodes: ask, then insist."""
        # Before ROS has taken over, SIGTERM ends a node without a word; afterwards cleanly.
        for number in (signal.SIGTERM, signal.SIGKILL):
            running = [p for p in self._processes.values() if p.poll() is None]
            for process in running:
                with suppress(ProcessLookupError):
                    process.send_signal(number)
            deadline = time.monotonic() + _GRACE
            for process in running:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(max(0.0, deadline - time.monotonic()))


def parameter_file(settings: Settings, use_sim_time: bool) -> dict[str, Any]:
    """Content of a ROS parameter file that starts a node, of any name, with these settings."""
    values = {"use_sim_time": use_sim_time, **parameter_values(settings)}
    return {"/**": {"ros__parameters": values}}
