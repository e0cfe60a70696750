"""Base of all nodes of the testbed: settings, topics, services, diagnostics.

A node declares the parameters of its settings class, advertises and subscribes to topics, and
reports its state on /diagnostics, at 1 Hz and at once on a change of level, under its full name.
"""

from __future__ import annotations

import dataclasses
import math
import os
import platform
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from typing import Any, ClassVar, Generic, Self, TypeVar

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces import msg
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from rclpy.task import Future
from std_msgs.msg import Header

from socket_testbed import clocks, drivers
from socket_testbed.errors import ConfigurationError, TestbedError, TrialError
from socket_testbed.live.processes import RESTARTED
from socket_testbed.settings.fields import Settings, parameter_values
from socket_testbed.wire.messages import LOAD_CELL_FRAME, Reader, check_lengths
from socket_testbed.wire.topics import CLOCK, DIAGNOSTICS, RECORDED_TRIAL, Topic

OK, WARN, ERROR = drivers.OK, drivers.WARN, drivers.ERROR

# Diagnostics keys that other nodes read.
COUNTS = SAMPLES, TRIGGERS, MESSAGES = "samples", "triggers", "messages"  # they give a rate
WAITING_FOR = "waiting_for"
NEWEST_STAMP = "newest_stamp"
ELAPSED = "elapsed"  # [s]; of the recording
FREE = "free"  # [bytes]; on the recorder's disk
LINKS = "links"  # topic=number of matched subscribers, separated by blanks
HEARS = "hears"  # topics from which it needs a publisher, separated by blanks

_SUBSCRIBER_DEPTH = 2000  # [messages]; enough for a fast replay or a busy moment
REPORT_PERIOD = 1.0  # [s]
_CHECK_PERIOD = 0.1  # [s]; of links and node
_WAKE_PERIOD = 0.1  # [s]; of looks at the system clock
_WAKE_TOPIC = "_waker"  # hidden; nothing is published on it
_REPEAT_PERIOD = 10.0  # [s]; of a warning on messages that cannot be decoded

S = TypeVar("S", bound=Settings)


def publisher_qos(topic: Topic) -> QoSProfile:
    """Quality of service of a publisher: reliable, keep last `topic.depth`, volatile.

    Latched topics are transient local with depth 1: late subscribers get the last message.
    """
    durability = DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE
    return QoSProfile(
        depth=topic.depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability
    )


def subscriber_qos(topic: Topic) -> QoSProfile:
    """Quality of service of the testbed's own subscribers: as published, with a deep queue."""
    qos = publisher_qos(topic)
    qos.depth = _SUBSCRIBER_DEPTH
    return qos


def message_type(topic: Topic) -> Any:
    """Class of a topic's message type."""
    package, kind, name = topic.type.split("/")
    return getattr(import_module(f"{package}.{kind}"), name)


def decoded(topic: Topic, data: bytes) -> Any:
    """The ROS message of a topic.

    Args:
        topic: The topic, which gives the message type.
        data: The message, serialised (CDR).

    Raises:
        TrialError: If they are not such a message, as another program may send.
    """
    try:
        message = deserialize_message(data, message_type(topic))
        check_lengths(message, topic.type)
        return message
    except Exception as error:  # the middleware may raise any exception
        raise TrialError(
            f"a message on {topic.name} cannot be decoded ({error})",
            "end the program that sends it, or set another ROS_DOMAIN_ID",
        ) from None


def stamp_to_ros(stamp: int) -> Time:
    """A time since the epoch [ns] as a builtin_interfaces/Time."""
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    return Time(sec=seconds, nanosec=nanoseconds)


def header_to_ros(stamp: int, frame: str = LOAD_CELL_FRAME) -> Header:
    """A std_msgs/Header.

    Args:
        stamp: Its stamp since the epoch [ns].
        frame: Its frame, by default that of the load cell, {S}.
    """
    return Header(stamp=stamp_to_ros(stamp), frame_id=frame)


def is_acknowledged(publisher: Publisher) -> bool:
    """Whether all subscribers have acknowledged all messages.

    Does not wait: rclpy would hold the GIL, and so block all threads of the process.
    """
    return bool(publisher.wait_for_all_acked(Duration()))


def reported_values(status: DiagnosticStatus) -> dict[str, str]:
    """Values by key of a diagnostic status, of any program's node."""
    return {entry.key: entry.value for entry in status.values}


def reported_number(values: Mapping[str, str], key: str) -> float:
    """A number among the values of a diagnostic status; NaN where it is missing or a text.

    Args:
        values: Values by key; /diagnostics is shared with other programs, so they may be any text.
        key: The key of the number, whose unit it has.
    """
    try:
        return float(values[key])
    except (KeyError, ValueError):
        return math.nan


class Inbox:
    """A hidden node without an executor: the middleware queues messages until they are taken.

    At 100 Hz this needs 2 % of a core; an executor needs 4 %.

    Args:
        name: The node's name, to which an underscore is prefixed.
        namespace: Its absolute namespace.
        topics: The topics to queue, with the quality of service of each subscription.

    Attributes:
        node: The hidden node.
    """

    def __init__(self, name: str, namespace: str, topics: Mapping[Topic, QoSProfile]) -> None:
        self.node = Node(
            f"_{name}",
            namespace=namespace,
            start_parameter_services=False,
            enable_rosout=False,
            use_global_arguments=False,
        )
        self._subscriptions = {
            topic: self.node.create_subscription(
                message_type(topic), topic.name, lambda data: None, qos, raw=True
            )
            for topic, qos in topics.items()
        }

    def take(self, topic: Topic) -> list[bytes]:
        """The serialised messages received since the last call, in order."""
        found, subscription = [], self._subscriptions[topic]
        with subscription.handle:
            while taken := subscription.handle.take_message(subscription.msg_type, True):
                found.append(taken[0])
        return found

    def close(self) -> None:
        """Unsubscribe and destroy the node."""
        self.node.destroy_node()


def recorded_trial(node: Node, announced: str) -> str:
    """Name of the trial being recorded; empty if none is.

    Args:
        node: A node in the recorder's namespace.
        announced: The last message on recorder/trial, which does not count if its recorder has
            ended since; empty if none.
    """
    return announced if node.count_publishers(RECORDED_TRIAL.name) else ""


class Waker:
    """Keeps ROS from standing still after the system clock was set back; a context manager.

    ROS from wheels waits on the system clock: timers, timeouts and the middleware's announcements
    stand still for as long as the step, and a process that sends nothing else is forgotten after
    20 s. A wait that begins after the step is right, so one wake-up is enough. A thread of its own
    compares the system clock with the steady clock.

    Args:
        nodes: The nodes of the process, at least one.
    """

    def __init__(self, nodes: Sequence[Node]) -> None:
        self._nodes = nodes
        self._ended = False
        self._waking = threading.Lock()
        self._steps = clocks.StepsBack()

    def __enter__(self) -> Self:
        threading.Thread(target=self._run, name="waker", daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        with self._waking:  # the nodes may be destroyed from now on
            self._ended = True

    def _run(self) -> None:
        stepped = False
        while not self._ended:
            # Other waits of Python may use the system clock, depending on its build.
            time.sleep(_WAKE_PERIOD)
            # The second time for a wait that began during the step.
            before, stepped = stepped, self._steps.noticed()
            if before or stepped:
                with self._waking:
                    if not self._ended:
                        self.wake()

    def wake(self) -> None:
        """Let all timers and the middleware of the process begin their waits again."""
        node = self._nodes[0]
        try:
            # The middleware's thread for timed events begins its wait again with each new endpoint.
            node.destroy_publisher(node.create_publisher(Header, _WAKE_TOPIC, 1))
            for timer in [timer for node in self._nodes for timer in node.timers]:
                timer.reset()
        except Exception:
            if node.context.ok():  # Ctrl-C ends ROS at any moment
                raise


class RecentFault:
    """The last fault in a node's thread."""

    def __init__(self) -> None:
        self._last = ("", 0.0)  # one tuple, because threads share it without a lock

    def note(self, text: str) -> None:
        """Note a fault that occurs now."""
        self._last = (text, clocks.monotonic())

    def text(self, at_least: float = 0.0) -> str:
        """The fault; empty if it is older than both `drivers.RECENT` and a duration [s]."""
        text, when = self._last
        return text if clocks.monotonic() - when < max(drivers.RECENT, at_least) else ""


class TestbedNode(Node, Generic[S]):
    """A node with settings, topics, services and diagnostics.

    Nodes override `figures`, `check`, `ready` and `close` as needed. Publishes /diagnostics
    (DiagnosticArray), at 1 Hz and at once on a change of level.

    Args:
        name: Name of the node.
        kind: Class of its settings, which are its parameters and validate changes.
        settle: Duration for which a node that has not reported OK counts as starting [s].

    Attributes:
        arguments: ROS arguments in addition to those of the process, of all nodes of the process.
        device: The attached device, such as `i2c-1`; empty if none.
        finished: A future that is done when the node's work is.
        settings: The current settings.
    """

    __test__ = False
    arguments: ClassVar[list[str]] = []

    def __init__(self, name: str, kind: type[S], settle: float = 0.0) -> None:
        super().__init__(name, cli_args=self.arguments)
        self.device = ""
        self.finished = Future()
        self._kind = kind
        fields = kind.flat()
        for parameter, value in parameter_values(kind()).items():
            self.declare_parameter(parameter, value, _descriptor(parameter, fields[parameter]))
        self.settings = self._read_settings({})
        self.add_on_set_parameters_callback(self._check_settings)
        self.add_post_set_parameters_callback(self._change_settings)

        self._inputs: list[Subscription] = []
        self._outputs: list[tuple[Publisher, bool]] = []
        self._slow_services: list[SlowService] = []
        self._settled_at = clocks.monotonic() + settle
        again = RESTARTED in os.environ
        self._level, self._message = (WARN, "started again") if again else (OK, "started")
        self._has_worked = again  # its first OK is a recovery
        self._waiting: list[str] | None = None
        self._checks = 0
        self._diagnostics = self.create_publisher(
            DiagnosticArray, DIAGNOSTICS.name, publisher_qos(DIAGNOSTICS)
        )
        self.repeat(_CHECK_PERIOD, self._check)

    # Nodes override these.

    def figures(self) -> dict[str, object]:
        """Figures for the diagnostics, by name."""
        return {}

    def check(self) -> None:
        """Check the node and `report`; called ten times a second."""

    def ready(self) -> bool:
        """Whether the node itself is ready to work."""
        return True

    def close(self) -> None:
        """Release the node's resources; called once, before it is destroyed."""
        for service in self._slow_services:
            service.thread.shutdown()

    # Nodes call these.

    @contextmanager
    def until_ros_ends(self) -> Iterator[None]:
        """Ignore errors once ROS has ended: Ctrl-C destroys publishers before threads end."""
        try:
            yield
        except Exception:
            if self.context.ok():
                raise

    def repeat(self, period: float, callback: Callable[[], None]) -> None:
        """Call back periodically, even if the system clock jumps or a replay pauses.

        With ROS from wheels this needs a `Waker` in the process.

        Args:
            period: Time between two calls, on the steady clock of the machine [s].
            callback: Called without arguments.
        """
        self.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def advertise(self, topic: Topic, name: str = "", needed: bool = False) -> Publisher:
        """A publisher of a topic, with the quality of service of `publisher_qos`.

        Args:
            topic: The topic, which gives the message type.
            name: Another name in the graph; empty for the topic's own.
            needed: Whether the node waits until it has a subscriber.
        """
        publisher = self.create_publisher(
            message_type(topic), name or topic.name, publisher_qos(topic)
        )
        self._outputs.append((publisher, needed))
        return publisher

    def sender(self, topic: Topic, pack: Callable[..., bytes]) -> Callable[..., None]:
        """A function that publishes on a topic the message packed from its arguments.

        Args:
            topic: The topic, which gives the message type.
            pack: Packs a serialised message, such as `wrench_packer()`: its arguments, with their
                units and shapes, are those of the returned function.
        """
        publisher = self.advertise(topic)
        return lambda *values: publisher.publish(pack(*values))

    def listen(
        self,
        topic: Topic,
        callback: Callable[[Any], None],
        name: str = "",
        needed: bool = True,
        raw: bool = False,
    ) -> None:
        """Subscribe to a topic, with a deep queue.

        A message of another program that cannot be decoded is reported and dropped.

        Args:
            topic: The topic, which gives the message type.
            callback: Called with each message, in order.
            name: Another name in the graph; empty for the topic's own.
            needed: Whether the node waits until it has a publisher.
            raw: Whether the callback gets serialised messages (bytes, CDR).
        """

        def receive(data: bytes) -> None:
            with self.until_ros_ends():
                try:
                    message = data if raw else decoded(topic, data)
                except TrialError as error:
                    self._drop(str(error))
                else:
                    callback(message)

        # Always as bytes: a typed subscription would end the node with a message like that.
        subscription = self.create_subscription(
            message_type(topic), name or topic.name, receive, subscriber_qos(topic), raw=True
        )
        if needed:
            self._inputs.append(subscription)

    def follow(
        self, topic: Topic, callback: Callable[[int, Any], None], needed: bool = True
    ) -> None:
        """Subscribe to a topic with a header, and decode its messages.

        A message that cannot be decoded, of another program, is reported and dropped.

        Args:
            topic: The topic, which gives the message type.
            callback: Called with the stamp of each message since the epoch [ns] and its values,
                whose shapes, units and frames `Reader` lists.
            needed: Whether the node waits until it has a publisher.
        """
        reader = Reader(topic)

        def receive(data: bytes) -> None:
            try:
                stamp, values = reader.read(data)
            except TrialError as error:
                self._drop(str(error))
            else:
                callback(stamp, values)

        self.listen(topic, receive, needed=needed, raw=True)

    def _drop(self, text: str) -> None:
        """Report that a message was dropped, not too often."""
        self.get_logger().warning(text, throttle_duration_sec=_REPEAT_PERIOD)

    def serve(self, kind: Any, name: str, answer: Callable[..., str], slow: bool = False) -> None:
        """Offer a SetBool or Trigger service.

        Args:
            kind: Class of the service.
            name: Its name, relative to the node's namespace.
            answer: Called with the request's data (SetBool) or nothing (Trigger); returns the
                response's message. A TestbedError that it raises makes the response a failure with
                that message.
            slow: Whether it answers from a thread of its own.
        """

        def respond(request: Any, response: Any) -> Any:
            given = (request.data,) if hasattr(request, "data") else ()
            try:
                response.message = answer(*given)
                response.success = True
            except TestbedError as error:
                response.message = str(error)
            return response

        if slow:
            self._slow_services.append(SlowService(self, kind, name, respond))
        else:
            self.create_service(kind, name, respond)

    def report(self, level: int, message: str) -> None:
        """Report the node's state; a new level is published at once.

        Args:
            level: OK, WARN or ERROR.
            message: Fact and hint in one line. A change in its numbers alone is not logged.
        """
        if level != OK and clocks.monotonic() < self._settled_at:
            level, message = WARN, f"starting: {message}"
        before = self._level, self._message
        if (level, message) == before:
            return
        self._level, self._message = level, message
        recovered = level == OK != before[0] and self._has_worked
        if level == OK:
            self._settled_at = 0.0
            self._has_worked = True
        logger = self.get_logger()
        if not self.context.ok():  # ROS has ended; only the terminal remains
            print(f"[{logger.name}]: {message}", file=sys.stderr)
            return
        if level != before[0]:
            self._publish_diagnostics()
        elif _without_figures(message) == _without_figures(before[1]):
            return  # only numbers changed: do not log
        # Separate lines: rclpy refuses different severities from one line.
        if level == ERROR:
            logger.error(message)
        elif level == WARN:
            logger.warning(message)
        else:
            logger.info(f"recovered: {message}" if recovered else message)

    def _read_settings(self, changes: dict[str, Any]) -> S:
        values = {
            name: _from_ros(changes.get(name, self.get_parameter(name).value))
            for name in self._kind.flat()
        }
        return self._kind.from_flat(values, self.get_name())

    def _check_settings(self, changes: list[Parameter]) -> msg.SetParametersResult:
        try:
            for change in changes:
                if change.type_ == Parameter.Type.NOT_SET:
                    hint = "set it to another value"
                    raise ConfigurationError(f"{change.name} cannot be deleted", hint)
            self._read_settings({change.name: change.value for change in changes})
        except ConfigurationError as error:
            return msg.SetParametersResult(successful=False, reason=str(error))
        return msg.SetParametersResult(successful=True)

    def _change_settings(self, changes: list[Parameter]) -> None:
        del changes
        self.settings = self._read_settings({})

    def _check(self) -> None:
        with self.until_ros_ends():
            self.check()
            waiting = self._waiting_for()
            self._checks += 1
            # A replay advances with the progress that its followers report; a slowed simulation
            # also publishes /clock, and does not.
            replayed = clocks.time_scale() == 1.0 and self.count_publishers(CLOCK.name) > 0
            due = self._checks * _CHECK_PERIOD >= REPORT_PERIOD
            if replayed or due or waiting != self._waiting:
                self._waiting = waiting
                self._publish_diagnostics()

    def links(self) -> dict[str, tuple[int, int]]:
        """Numbers of matched and of expected subscribers, by the topic of each publisher."""
        expected = {
            p: max(needed, self.count_subscribers(p.topic_name)) for p, needed in self._outputs
        }
        return {p.topic_name: (p.get_subscription_count(), n) for p, n in expected.items()}

    def _waiting_for(self) -> list[str]:
        """Topics without a counterpart in the graph, and the node itself while it starts."""
        waiting = [
            s.topic_name
            for s in self._inputs
            if s.get_publisher_count() < max(1, self.count_publishers(s.topic_name))
        ]
        waiting += [topic for topic, (known, there) in self.links().items() if known < there]
        settled = clocks.monotonic() >= self._settled_at
        return waiting if settled and self.ready() else [*waiting, "itself"]

    def _publish_diagnostics(self) -> None:
        self._checks = 0
        waiting = "(not checked yet)" if self._waiting is None else ", ".join(self._waiting)
        links = [f"{topic}={known}" for topic, (known, _) in self.links().items()]
        hears = " ".join(s.topic_name for s in self._inputs)
        values = {WAITING_FOR: waiting, LINKS: " ".join(links), HEARS: hears, **self.figures()}
        status = DiagnosticStatus(
            level=bytes([self._level]),
            name=self.get_fully_qualified_name(),
            message=self._message,
            hardware_id=f"{platform.node()} {self.device}".strip(),
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header = header_to_ros(self.get_clock().now().nanoseconds, "")
        self._diagnostics.publish(message)


class SlowService:
    """A service that answers from its own thread, one request after the other.

    The events executor does not support coroutines, and rclpy has no public way to answer later: it
    passes the callback's result to the service's `send_response`, whatever the callback returns.
    Here both only forward the request to the thread, which answers. Another executor for these
    services would need a second node, which every list of nodes would show.

    Args:
        node: The node that offers it.
        kind: Class of the service.
        name: Its name, relative to the node's namespace.
        respond: Called in the thread with the request and a blank response, which it fills in and
            returns.

    Attributes:
        thread: Runs the answers, one after the other.
    """

    def __init__(
        self, node: TestbedNode[Any], kind: Any, name: str, respond: Callable[..., Any]
    ) -> None:
        self._node, self._respond = node, respond
        self.thread = ThreadPoolExecutor(1, thread_name_prefix=name)
        service = node.create_service(kind, name, lambda *given: given)
        self._send, service.send_response = service.send_response, self._forward

    def _forward(self, given: Any, header: Any) -> None:
        answered = self.thread.submit(self._answer, given, header)
        answered.add_done_callback(lambda done: done.result())  # raises its error, to be printed

    def _answer(self, given: Any, header: Any) -> None:
        with self._node.until_ros_ends():
            self._send(self._respond(*given), header)


def _without_figures(message: str) -> str:
    return re.sub(r"\d+(\.\d+)?", "#", message)


def _descriptor(name: str, item: dataclasses.Field[Any]) -> msg.ParameterDescriptor:
    limits = item.metadata
    text = limits["description"]
    if limits["choices"]:
        text += "; one of " + ", ".join(limits["choices"])
    # Dynamic typing allows an integer for a double; the settings check everything else.
    descriptor = msg.ParameterDescriptor(
        name=name, description=text, dynamic_typing=True, read_only=limits["fixed"]
    )
    kind = type(item.default)
    if kind in (int, float):
        span = {"from_value": kind(limits["low"]), "to_value": kind(limits["high"])}
        if kind is int:
            descriptor.integer_range = [msg.IntegerRange(**span, step=1)]
        else:
            descriptor.floating_point_range = [msg.FloatingPointRange(**span)]
    return descriptor


def _from_ros(value: Any) -> Any:
    if isinstance(value, str | bool | int | float):
        return value
    return [entry for entry in (value or ()) if entry != ""]
