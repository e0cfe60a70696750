"""A node of the tests' own, spinning in a thread, that waits on conditions with a deadline."""

import threading
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any, Self

import rclpy
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.parameter import Parameter
from rclpy.task import Future

from socket_testbed.nodes.base import message_type, publisher_qos, subscriber_qos
from socket_testbed.wire.topics import DIAGNOSTICS, Topic
from support import HANGS

_ASK_AGAIN = 3.0  # [s]


class Probe:
    """Subscribes, publishes and calls services as another program would."""

    def __enter__(self) -> Self:
        self.context = Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("probe", context=self.context)
        self.received: dict[str, list[Any]] = defaultdict(list)
        self._clients: dict[str, Any] = {}
        self._answered: set[str] = set()
        self._news = threading.Condition()
        self._done = Future()
        self._executor = EventsExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set_result(None)
        self._thread.join()
        self._executor.remove_node(self.node)  # it holds on to the node's entities
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)

    def _spin(self) -> None:
        self._failure: BaseException | None = None
        try:
            while not self._done.done():
                self._executor.spin_until_future_complete(self._done, timeout_sec=0.1)
        except BaseException as error:
            self._failure = error  # of whoever waits
            raise

    def listen(self, topic: Topic, name: str | None = None) -> list[Any]:
        """Subscribe to a topic; returns the list that its messages go to."""
        received = self.received[name or topic.name]

        def on_message(message: Any) -> None:
            with self._news:
                received.append(message)
                self._news.notify_all()

        kind, qos = message_type(topic), subscriber_qos(topic)
        self.node.create_subscription(kind, name or topic.name, on_message, qos)
        return received

    def said(self, node: str, words: str = "") -> list[Any]:
        """What a node has reported of itself in such words; it is heard from the first call on."""
        if DIAGNOSTICS.name not in self.received:
            self.listen(DIAGNOSTICS)
        found = (s for message in self.received[DIAGNOSTICS.name] for s in message.status)
        return [s for s in found if s.name == f"/{node}" and words in s.message]

    def figure(self, node: str, key: str) -> float:
        """A figure that a node has reported last, 0 where there is none yet."""
        newest = {v.key: v.value for s in self.said(node)[-1:] for v in s.values}
        return float(newest.get(key, 0.0))

    def publisher(self, topic: Topic, subscribers: int = 1) -> Any:
        """A publisher, once so many subscribers are matched."""
        kind, qos = message_type(topic), publisher_qos(topic)
        publisher = self.node.create_publisher(kind, topic.name, qos)
        self.wait(lambda: publisher.get_subscription_count() >= subscribers, topic.name)
        return publisher

    def wait(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + HANGS
        # Asked without the lock: a condition may itself wait for what the thread that takes the
        # messages brings, such as a service's answer.
        while not condition():
            if not self._thread.is_alive():
                raise AssertionError(f"the probe hears nothing more: {what}") from self._failure
            left = deadline - time.monotonic()
            assert left > 0.0, f"not within {HANGS:g} s: {what}"
            with self._news:
                self._news.wait(min(left, 0.02))

    def refusals(self, node: str, **values: Any) -> list[str]:
        """Set parameters of a node (a__b for a.b); returns why some are refused."""
        given = [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
        request = SetParameters.Request(parameters=[entry.to_parameter_msg() for entry in given])
        results = self.call(SetParameters, f"{node}/set_parameters", request).results
        return [result.reason for result in results if not result.successful]

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """Call a service and return its answer.

        The middleware can lose the answer to a new client: it is kept, and asks again; for a fit,
        which takes its time, only until it has had an answer.
        """
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
        client, asked = self._clients[name], []
        self.wait(client.service_is_ready, f"service {name}")

        def answered() -> bool:
            late = time.monotonic() > began + _ASK_AGAIN * len(asked)
            if not asked or (late and not (name.endswith("/fit") and name in self._answered)):
                asked.append(client.call_async(request))
            return any(future.done() for future in asked)

        began = time.monotonic()
        self.wait(answered, f"answer of {name}")
        self._answered.add(name)
        return next(future for future in asked if future.done()).result()
