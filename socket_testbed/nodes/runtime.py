"""How every node is run: one executor, its services, clean ends, errors in one line."""

from __future__ import annotations

import gc
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from typing import Any, Protocol

import rclpy
from rclpy.executors import ExternalShutdownException, ShutdownException, SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future

from socket_testbed.errors import TestbedError
from socket_testbed.live.processes import follow_starter
from socket_testbed.trials.topics import PUBLISHER_DEPTH, Topic

_SWITCH = 5e-4  # [s]; a thread that is due waits no longer for one that computes
_TURN = 0.2  # [s]; how often the executor looks whether it is to end
_SUBSCRIBER_DEPTH = 2000  # [messages]; a fast replay or a busy moment loses nothing


class RunnableNode(Protocol):
    """What `run_node` needs of a node, besides being one.

    Attributes:
        finished: Set when the node has done its work.
    """

    finished: Future

    def close(self) -> None:
        """End what the node has begun: called once, before it is destroyed."""

    def destroy_node(self) -> None:
        """Leave the graph."""


def publisher_qos(topic: Topic) -> QoSProfile:
    """Quality of service of a publisher: reliable, keep last 100, volatile, unless latched."""
    if topic.latched:
        return latched_qos()
    return QoSProfile(
        depth=PUBLISHER_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE,
    )


def subscriber_qos(topic: Topic) -> QoSProfile:
    """Quality of service of the testbed's own subscribers: as offered, with a deep queue."""
    qos = publisher_qos(topic)
    qos.depth = _SUBSCRIBER_DEPTH
    return qos


def latched_qos() -> QoSProfile:
    """Quality of service of what late subscribers get at once: transient local, depth 1."""
    return QoSProfile(
        depth=1,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def message_type(topic: Topic) -> Any:
    """Class of a topic's message type."""
    package, kind, name = topic.type.split("/")
    return getattr(import_module(f"{package}.{kind}"), name)


def run_node(*makes: Callable[[], RunnableNode]) -> None:
    """Run a node, or several in one process, until one has finished or is told to end; exit.

    Args:
        makes: Each makes a node.
    """
    sys.exit(_run(makes))


def _run(makes: tuple[Callable[[], RunnableNode], ...]) -> int:
    # ROS ends its context on SIGINT. Python's KeyboardInterrupt on top of it could strike in the
    # middle of a callback, where nothing can catch it.
    signal.signal(signal.SIGINT, lambda number, frame: None)
    sys.setswitchinterval(_SWITCH)
    rclpy.init()
    follow_starter()
    nodes: list[RunnableNode] = []
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
        # Told to end while it starts or ends, a node finds ROS gone at any of its calls.
        if rclpy.ok():
            raise
    finally:
        rclpy.try_shutdown()
    return 0


def _spin(nodes: list[RunnableNode]) -> None:
    # What is there now stays: looking through it for garbage would hold up a trigger by 30 ms.
    gc.collect()
    gc.freeze()
    executor = EventsExecutor()
    for node in nodes:
        executor.add_node(node)
    with suppress(ExternalShutdownException):
        # spin() of this executor overflows its wait in Jazzy's release; turns do not.
        while rclpy.ok() and not any(node.finished.done() for node in nodes):
            executor.spin_until_future_complete(nodes[0].finished, timeout_sec=_TURN)


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
