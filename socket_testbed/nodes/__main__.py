"""Runs nodes: one executor, clean ends, errors in one line.

`python -m socket_testbed.nodes NODE... --ros-args ...` runs one node or several in one process; a
program with the name of a node, such as `ros2 run socket_testbed cluster_node`, runs that node.

`python -m socket_testbed.nodes spare --ros-args ...` waits, ready for the place of a node that is
killed: its standard input then gets that one's arguments, as a JSON list.
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
from importlib import import_module
from pathlib import Path
from typing import Any

try:
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from rclpy.experimental.events_executor import EventsExecutor

    from socket_testbed.errors import ConfigurationError, TestbedError, closest
    from socket_testbed.live.processes import RESTARTED, SPARE, end_with_starter, schedule
    from socket_testbed.nodes.base import TestbedNode
    from socket_testbed.settings.acquisition import SchedulingSettings
    from socket_testbed.settings.testbed import TestbedSettings
except ModuleNotFoundError as error:
    sys.exit(
        f"error: {sys.executable} has no module '{error.name}': activate the environment that"
        " requirements/runtime.txt is installed in (README, colcon workspace)"
    )

_RARE = ("view_node",)  # its imports take as much memory as all others
_POLL = 0.2  # [s]
_SWITCH = 5e-4  # [s]; a thread that is due waits no longer for one that computes


def main() -> None:
    """Run the nodes that are named until one has finished or the process is to end, and exit."""
    program, *words = sys.argv
    if Path(program).name in TestbedSettings().nodes():
        words = [Path(program).name, *words]
    sys.exit(_run(_split(words)[0]))


def _split(words: list[str]) -> tuple[list[str], list[str]]:
    """The names of nodes, and the ROS arguments after them."""
    names = words.index("--ros-args") if "--ros-args" in words else len(words)
    return words[:names], words[names:]


def _node_class(name: str) -> Callable[[], TestbedNode[Any]]:
    """Class of a node: CalibrationNode of calibration_node."""
    known = TestbedSettings().nodes()
    if name not in known:
        raise ConfigurationError(f"there is no node '{name}'", closest(name, known))
    kind = "".join(part.capitalize() for part in name.split("_"))
    found: Callable[[], TestbedNode[Any]] = getattr(
        import_module(f"socket_testbed.nodes.{name}"), kind
    )
    return found


def _run(names: list[str]) -> int:
    # ROS ends its context on SIGINT. Python's KeyboardInterrupt on top of it could strike in the
    # middle of a callback, where nothing can catch it.
    signal.signal(signal.SIGINT, lambda number, frame: None)
    sys.setswitchinterval(_SWITCH)
    rclpy.init()
    end_with_starter()
    try:
        with ExitStack() as stack:
            ready = None
            if names == [SPARE]:
                # The others know a process that has a node, and as long as it has one.
                ready = rclpy.create_node(
                    "_spare", start_parameter_services=False, enable_rosout=False
                )
                names, TestbedNode.arguments = _split(_await_place())
            nodes = []
            for name in names:
                nodes.append(_node_class(name)())
                stack.callback(nodes[-1].destroy_node)
                stack.callback(nodes[-1].close)
                # As a node that measures wants it; without the right, it goes on.
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
        # Ended while it starts or closes, a node finds ROS gone at any of its calls.
        if rclpy.ok():
            raise
    finally:
        rclpy.try_shutdown()
    return 0


def _await_place() -> list[str]:
    """Be ready until another process's place is to be taken: its arguments; empty if ROS ends."""
    for name in TestbedSettings().nodes():
        if name not in _RARE:
            _node_class(name)
    while rclpy.ok() and not select.select([sys.stdin], [], [], _POLL)[0]:
        pass
    words = json.loads(sys.stdin.read() or "[]") if rclpy.ok() else []
    os.environ[RESTARTED] = "1"
    return words


def _spin(nodes: list[TestbedNode[Any]]) -> None:
    # What is there now stays: looking through it for garbage would hold up a trigger by 30 ms.
    gc.collect()
    gc.freeze()
    executor = EventsExecutor()
    for node in nodes:
        executor.add_node(node)
    with suppress(ExternalShutdownException):
        # spin() of the events executor overflows its wait in Jazzy's release; this does not. The
        # end of the first node is noticed at once.
        while rclpy.ok() and not any(node.finished.done() for node in nodes):
            executor.spin_until_future_complete(nodes[0].finished, timeout_sec=_POLL)


if __name__ == "__main__":
    main()
