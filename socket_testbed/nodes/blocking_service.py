"""A service whose answer takes long, beside a node that must not wait for it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from rclpy.executors import ExternalShutdownException, ShutdownException, SingleThreadedExecutor
from rclpy.node import Node


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
