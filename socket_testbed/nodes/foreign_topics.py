"""Topics of other programs, whose types and qualities of service are known once they are there."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from socket_testbed import clocks
from socket_testbed.clocks import SteadyClock
from socket_testbed.errors import ConfigurationError
from socket_testbed.live.doctor import HeardSource
from socket_testbed.live.sources import StreamedSource, TriggerStream, refuse_own_topic
from socket_testbed.settings.alignment import AlignSettings
from socket_testbed.trials import foreign
from socket_testbed.trials.bag import RawMessage
from socket_testbed.wire.cdr import define
from socket_testbed.wire.topics import full_name

_LISTEN_FOR = 4.0  # [s]
_LISTEN_PERIOD = 0.05  # [s]
_DEPTH = 2000  # [messages]; of a busy moment
_MAX_AGE = 10.0  # [s]; of a message that waited to be taken


def matching_qos(publishers: list[TopicEndpointInfo]) -> QoSProfile:
    """Quality of service of a subscriber that all of some publishers match.

    Reliable only if all of them are; volatile, which every durability matches.
    """
    reliable = all(own.qos_profile.reliability == ReliabilityPolicy.RELIABLE for own in publishers)
    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(depth=_DEPTH, reliability=reliability, durability=DurabilityPolicy.VOLATILE)


def type_class(name: str, topic: str) -> Any:
    """The class of a message type.

    Args:
        name: The type, as `package/msg/Type`.
        topic: Its topic, for errors.

    Raises:
        ConfigurationError: If its package cannot be imported.
    """
    package, _, message = name.partition("/msg/")
    try:
        return getattr(import_module(f"{package}.msg"), message)
    except (ImportError, AttributeError):
        fact = f"{topic} is a {name}, whose package cannot be imported"
        raise ConfigurationError(fact, f"source the workspace that holds {package}") from None


class ForeignTopic:
    """Receives a topic of other programs, whatever its quality of service.

    Args:
        node: A node without an executor, such as that of an `Inbox`; the middleware queues the
            messages until they are taken.
        name: The topic's absolute name.
        kinds: The types that are wanted, as `package/msg/Type`.

    Attributes:
        name: Its absolute name.
        type: Type of its messages; empty before a publisher is found.
        definition: Definition of the type, see `define`; empty for a type that needs none.
    """

    def __init__(self, node: Node, name: str, kinds: tuple[str, ...]) -> None:
        self.name = name
        self.type = ""
        self.definition = ""
        self._node = node
        self._kinds = kinds
        self._qos: QoSProfile | None = None
        self._subscription: Subscription | None = None

    def look(self) -> str:
        """Subscribe once there is a publisher, and again if its type or quality has changed.

        Returns:
            What is wrong with the topic, fact and hint in one line; empty if nothing is.
        """
        publishers = self._node.get_publishers_info_by_topic(self.name)
        if not publishers:
            return ""
        types = {own.topic_type for own in publishers}
        wanted = sorted(types.intersection(self._kinds))
        if not wanted:
            given = ", ".join(sorted(types))
            hint = foreign.another_topic(self.name, given, self._kinds)
            return f"{self.name} is a {given}: {hint}"
        if len(types) > 1:
            others = " and ".join(sorted(types))
            return f"{self.name} has publishers of {others}: rename one of the topics"
        qos = matching_qos(publishers)
        if wanted[0] == self.type and qos == self._qos:
            return ""
        try:
            kind = type_class(wanted[0], self.name)
            definition = define(wanted[0], lambda name: type_class(name, self.name))
        except ConfigurationError as error:
            return str(error)
        self.close()
        self._subscription = self._node.create_subscription(
            kind, self.name, lambda data: None, qos, raw=True
        )
        self.type, self.definition, self._qos = wanted[0], definition, qos
        return ""

    def take(self, now: Callable[[], int]) -> list[RawMessage]:
        """The messages received since the last call, in order; `time` is that of their arrival.

        Args:
            now: Returns the present time on the clock of the arrivals [ns].
        """
        if self._subscription is None:
            return []
        found: list[RawMessage] = []
        subscription = self._subscription
        with subscription.handle:
            while taken := subscription.handle.take_message(subscription.msg_type, True):
                data, info = taken
                waited = (time.time_ns() - info["received_timestamp"]) * 1e-9
                waited = waited if 0.0 <= waited < _MAX_AGE else 0.0
                arrival = now() - round(1e9 * waited * clocks.time_scale())
                found.append(RawMessage(self.name, self.type, arrival, data, self.definition))
        return found

    def close(self) -> None:
        """Unsubscribe."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None


def foreign_topic(node: Node, source: foreign.Source, topic: str, namespace: str) -> ForeignTopic:
    """The topic of a source, which must not be one that the testbed publishes.

    Args:
        node: A node without an executor.
        source: Which source.
        topic: Its topic, as the settings name it: absolute, or relative to the namespace; for a
            pose also `TOPIC:BODY` or `tf:PARENT/CHILD`.
        namespace: Absolute namespace of the testbed.

    Raises:
        ConfigurationError: If the testbed publishes a topic of that name.
    """
    name, _ = foreign.topic_and_body(topic)
    if not topic.startswith(foreign.TRANSFORM):
        refuse_own_topic(name, f"align_node: {source}.topic", namespace)
    return ForeignTopic(node, full_name(name, namespace), foreign.kinds_of(source, topic))


def trigger_topic(node: Node, topic: str, namespace: str) -> ForeignTopic:
    """The topic of triggers of another program.

    Args:
        node: A node without an executor.
        topic: Its topic, absolute or relative to the namespace.
        namespace: Absolute namespace of the testbed.

    Raises:
        ConfigurationError: If the testbed publishes a topic of that name.
    """
    refuse_own_topic(topic, "trigger_node: topic", namespace)
    return ForeignTopic(node, full_name(topic, namespace), foreign.TRIGGERS)


def hear_sources(
    settings: AlignSettings,
    trigger: str,
    clusters: Sequence[str],
    namespace: str = "/",
) -> list[HeardSource]:
    """Listen to the sources of other drivers, and to their triggers, for a while.

    Args:
        settings: The topics of the sources.
        trigger: Topic whose messages are the triggers; empty for triggers of our own.
        clusters: Names of the testbed's clusters.
        namespace: Absolute namespace of the testbed.

    Raises:
        ConfigurationError: If a topic is one that the testbed publishes.
    """
    context = rclpy.Context()
    # The verb handles Ctrl-C.
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("_doctor", context=context, start_parameter_services=False)
    clock = SteadyClock()
    try:
        heard: list[HeardSource] = []
        listening: list[ForeignTopic] = []
        if trigger:
            listening.append(trigger_topic(node, trigger, namespace))
            heard.append(HeardSource(TriggerStream(trigger)))
        for name in foreign.SOURCES:
            own = settings.sources[name]
            if own.is_foreign:
                listening.append(foreign_topic(node, name, own.topic, namespace))
                heard.append(HeardSource(StreamedSource(name, own, clusters)))
        ends = time.monotonic() + _LISTEN_FOR
        while time.monotonic() < ends:
            for topic, found in zip(listening, heard, strict=True):
                found.wrong, found.type = topic.look(), topic.type
                found.source.receive(topic.take(clock.now))
            time.sleep(_LISTEN_PERIOD)
        for found in heard:
            found.ended = clock.now()
        return heard
    finally:
        node.destroy_node()
        context.try_shutdown()
