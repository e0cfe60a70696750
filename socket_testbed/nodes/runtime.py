"""How every node runs: one executor, its services, clean ends, errors in one line."""

from __future__ import annotations

import gc
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, ShutdownException, SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.task import Future

from socket_testbed.errors import TestbedError
from socket_testbed.live.processes import end_with_starter
from socket_testbed.nodes.base import TestbedNode

_SWITCH = 5e-4  # [s]; a thread that is due waits no longer for one that computes
_LOOK = 0.2  # [s]; how often the executor looks whether it is to end


def run_node(*makes: Callable[[], TestbedNode[Any]]) -> None:
    """Run a node, or several in one process, until one has finished or the process is to end; exit.

    Args:
        makes: Each makes a node.
    """
    sys.exit(_run(makes))


def _run(makes: tuple[Callable[[], TestbedNode[Any]], ...]) -> int:
    # ROS ends its context on SIGINT. Python's KeyboardInterrupt on top of it could strike in the
    # middle of a callback, where nothing can catch it.
    signal.signal(signal.SIGINT, lambda number, frame: None)
    sys.setswitchinterval(_SWITCH)
    rclpy.init()
    end_with_starter()
    nodes: list[TestbedNode[Any]] = []
    try:
        try:
            for make in makes:
                nodes.append(make())  # noqa: PERF401 - those made are closed if the next fails
            _spin(nodes)
        finally:
            for node in nodes:
                node.close()
            for node in nodes:
                node.destroy_node()
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


def _spin(nodes: list[TestbedNode[Any]]) -> None:
    # What is there now stays: looking through it for garbage would hold up a trigger by 30 ms.
    gc.collect()
    gc.freeze()
    executor = EventsExecutor()
    for node in nodes:
        executor.add_node(node)
    spin(executor, lambda: any(node.finished.done() for node in nodes), nodes[0].finished)


def spin(executor: EventsExecutor, done: Callable[[], bool], future: Future) -> None:
    """Work until it is done, until a future is, which is noticed at once, or until ROS ends."""
    with suppress(ExternalShutdownException):
        # spin() of this executor overflows its wait in Jazzy's release; limited waits do not.
        while rclpy.ok() and not done():
            executor.spin_until_future_complete(future, timeout_sec=_LOOK)


class BlockingService:
    """A service on a node and a thread of its own: the events executor knows no coroutines.

    Args:
        node: The node that the service belongs to.
        kind: Type of the service.
        name: Name of the service, relative to the node's namespace.
        callback: Called in the service's thread; it may take its time.
    """

    def __init__(
        self, node: Node, kind: Any, name: str, callback: Callable[[Any, Any], Any]
    ) -> None:
        self._node = Node(
            f"{node.get_name()}_services",
            namespace=node.get_namespace(),
            context=node.context,
            start_parameter_services=False,
            use_global_arguments=False,
        )
        self._service = self._node.create_service(kind, name, callback)
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name=name)
        self._thread.start()

    def close(self) -> None:
        """Stop answering."""
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except (ExternalShutdownException, ShutdownException):
            return
        except Exception:
            # ROS may have ended in the middle of a wait.
            if self._node.context.ok():
                raise
