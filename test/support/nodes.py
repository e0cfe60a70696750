"""Single nodes, created without a graph: what they publish is caught instead of sent."""

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import pytest
import rclpy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions

from socket_testbed.nodes.base import TestbedNode

Sent = dict[str, list[Any]]
N = TypeVar("N", bound=TestbedNode[Any])


class Catcher:
    """Stands for a publisher with one subscriber, which has acknowledged everything."""

    def __init__(self, kind: Any, name: str, sent: list[Any]) -> None:
        self._kind, self.topic_name, self._sent = kind, name, sent

    def publish(self, message: Any) -> None:
        raw = isinstance(message, bytes)
        self._sent.append(deserialize_message(message, self._kind) if raw else message)

    def get_subscription_count(self) -> int:
        return 1

    def wait_for_all_acked(self, timeout: Any) -> bool:
        return True


class Maker:
    """Makes nodes with parameters.

    Attributes:
        sent: The messages by topic, as the node names it, in the order in which they were sent.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sent: Sent = defaultdict(list)
        self._patch, self._nodes = monkeypatch, list[TestbedNode[Any]]()

        def catch(node: TestbedNode[Any], kind: Any, name: str, *given: Any, **more: Any) -> Any:
            return Catcher(kind, name, self.sent[name])

        monkeypatch.setattr(TestbedNode, "create_publisher", catch)

    def __call__(self, kind: type[N], **parameters: Any) -> N:
        words = [word for n, v in parameters.items() for word in ("-p", f"{n}:={v}")]
        self._patch.setattr(TestbedNode, "arguments", ["--ros-args", *words] if words else [])
        node = kind()  # type: ignore[call-arg]
        self._nodes.append(node)
        return node

    def close(self) -> None:
        """End the nodes."""
        for node in self._nodes:
            node.close()
            node.destroy_node()

    def state(self) -> tuple[int, str]:
        """Level and text of the last node's diagnostics, as it would send them now."""
        self._nodes[-1]._publish_diagnostics()
        status = self.sent["/diagnostics"][-1].status[0]
        return status.level[0], status.message


@contextmanager
def running_ros() -> Iterator[None]:
    """ROS in this process, without any executor."""
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        yield
    finally:
        rclpy.try_shutdown()
