"""Runs nodes: one executor, clean shutdown, one-line errors.

`python -m socket_testbed.nodes NODE... --ros-args ...` runs one or more nodes in one process; a
program named after a node, such as `ros2 run socket_testbed cluster_node`, runs that node.

`python -m socket_testbed.nodes spare --ros-args ...` stands by to replace a killed node, whose
arguments it then reads from standard input as a JSON list.
"""

from __future__ import annotations

import gc
import json
import os
import select
import signal
import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pkgutil import resolve_name
from typing import Any

if __name__ == "__main__" or sys.argv[0].endswith("_node"):
    # Ctrl-C during the other imports, which take a second, ends the program without a traceback.
    signal.signal(signal.SIGINT, lambda number, frame: os._exit(0))

try:
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from rclpy.experimental.events_executor import EventsExecutor

    from socket_testbed.errors import ConfigurationError, TestbedError, closest
    from socket_testbed.files import end_with_starter
    from socket_testbed.live.processes import RESTARTED, SPARE
    from socket_testbed.live.scheduling import schedule
    from socket_testbed.nodes.base import TestbedNode, Waker
    from socket_testbed.settings.acquisition import SchedulingSettings
    from socket_testbed.settings.testbed import TestbedSettings
except ModuleNotFoundError as error:
    sys.exit(
        f"error: {sys.executable} has no module '{error.name}': activate the environment that"
        " requirements/runtime.txt is installed in (README, colcon workspace)"
    )

_NOT_PRELOADED = ("view_node",)  # its imports need as much memory as all others together
_ENDING = (signal.SIGINT, signal.SIGTERM)  # signals that end the nodes cleanly
_POLL_INTERVAL = 0.2  # [s]
_SWITCH_INTERVAL = 5e-4  # [s]; longest wait of a thread for one that computes


def main() -> None:
    """Run the named nodes until one finishes or the process is asked to end, and exit."""
    program, *words = sys.argv
    name = program.rpartition("/")[2]
    if name in TestbedSettings().nodes():
        words = [name, *words]
    code = _run(_split(words)[0])
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    # At once: the interpreter would wait for the threads of a node that was interrupted while it
    # started, and a second Ctrl-C would strike meanwhile.
    os._exit(code)


def _split(words: list[str]) -> tuple[list[str], list[str]]:
    """The node names and the ROS arguments that follow."""
    names = words.index("--ros-args") if "--ros-args" in words else len(words)
    return words[:names], words[names:]


def _node_class(name: str) -> Callable[[], TestbedNode[Any]]:
    """Class of a node, such as CalibrationNode for calibration_node."""
    known = TestbedSettings().nodes()
    if name not in known:
        raise ConfigurationError(f"there is no node '{name}'", closest(name, known))
    kind = "".join(part.capitalize() for part in name.split("_"))
    found: Callable[[], TestbedNode[Any]] = resolve_name(f"socket_testbed.nodes.{name}:{kind}")
    return found


def _run(names: list[str]) -> int:
    # ROS shuts its context down on these signals. An additional KeyboardInterrupt could strike
    # inside a callback, where nothing can catch it.
    asked: list[int] = []
    for number in _ENDING:
        signal.signal(number, lambda number, frame: asked.append(number))
    sys.setswitchinterval(_SWITCH_INTERVAL)
    rclpy.init()
    end_with_starter()
    try:
        if asked:  # before ROS handled them
            return 0
        with ExitStack() as stack:
            ready = None
            if names == [SPARE]:
                # Other processes discover a process only while it has a node.
                ready = rclpy.create_node(
                    "_spare", start_parameter_services=False, enable_rosout=False
                )
                with Waker([ready]):
                    names, TestbedNode.arguments = _split(_await_replacement())
            nodes = []
            for name in names:
                nodes.append(_node_class(name)())
                stack.callback(nodes[-1].destroy_node)
                stack.callback(nodes[-1].close)
                # Nodes that measure set their scheduling; without permission, they continue.
                wanted = getattr(nodes[-1].settings, "scheduling", SchedulingSettings())
                for line in schedule(wanted):
                    nodes[-1].get_logger().warning(line)
            if ready is not None:
                ready.destroy_node()
            if nodes:
                _spin(nodes)
    except TestbedError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except Exception:
        # During start or shutdown, any ROS call fails once ROS has ended.
        if rclpy.ok():
            raise
    finally:
        rclpy.try_shutdown()
    return 0


def _await_replacement() -> list[str]:
    """Preload the nodes and wait for the arguments of a process to replace; empty if ROS ends."""
    for name in TestbedSettings().nodes():
        if name not in _NOT_PRELOADED:
            _node_class(name)
    while rclpy.ok() and not select.select([sys.stdin], [], [], _POLL_INTERVAL)[0]:
        pass
    words = json.loads(sys.stdin.read() or "[]") if rclpy.ok() else []
    os.environ[RESTARTED] = "1"
    return words


def _spin(nodes: list[TestbedNode[Any]]) -> None:
    # Scanning these long-lived objects for garbage would delay a trigger by 30 ms.
    gc.collect()
    gc.freeze()
    executor = EventsExecutor()
    for node in nodes:
        executor.add_node(node)
    with Waker(nodes), suppress(ExternalShutdownException):
        # In Jazzy, the wait of the events executor's spin() overflows; this call's does not. It
        # notices the end of the first node at once.
        while rclpy.ok() and not any(node.finished.done() for node in nodes):
            executor.spin_until_future_complete(nodes[0].finished, timeout_sec=_POLL_INTERVAL)


if __name__ == "__main__":
    main()
