"""A running testbed seen and controlled from outside: status, events and services."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from socket_testbed_msgs.msg import Event
from std_srvs.srv import SetBool, Trigger

from socket_testbed import clocks
from socket_testbed.errors import ConfigurationError, TestbedError, TrialError, fact_and_hint
from socket_testbed.live.graph_status import GraphStatus
from socket_testbed.nodes import base
from socket_testbed.settings.testbed import NextTrialSettings
from socket_testbed.trials import events
from socket_testbed.wire.messages import Reader
from socket_testbed.wire.topics import (
    DIAGNOSTICS,
    ESTIMATED_WRENCH,
    EVENT,
    PARAMETERS,
    RECORDED_TRIAL,
    REQUIRED,
    TRIGGER,
    Service,
    Topic,
    full_name,
    full_namespace,
    namespace_of,
)

_POLL_INTERVAL = 0.02  # [s]
_STATES_TIMEOUT = 8.0  # [s]; nodes report once a second, after their discovery

# Events, in real time:
_LINK_TIMEOUT = 6.0  # [s]; to discover a subscriber on a busy machine
_TRIGGER_TIMEOUT = 5.0  # [s]; for enough triggers
_MIN_SPAN = 1.0  # [s]; from the first trigger to the last
_SPAN_FACTOR = 3.0  # [-]; span of a slow testbed's triggers, relative to the age of the call
_MAX_SPAN = 12.0  # [s]; upper limit of that span
_ACKNOWLEDGE_TIMEOUT = 5.0  # [s]

# Services:
_DISCOVERY_TIMEOUT = 3.0  # [s]
_ANSWER_TIMEOUT = 5.0  # [s] of the testbed
_FIT_TIMEOUT = 120.0  # [s]
_RETRY_INTERVAL = 2.5  # [s] of the testbed; the middleware can lose an answer

_STATUS_TOPICS = (*REQUIRED, ESTIMATED_WRENCH)  # measurements before their predictions

# Type of each service and the node that offers it.
_NEXT_TRIAL = "recorder_node/set_parameters_atomically"
_SERVICES = {
    Service.TARE: (Trigger, "load_cell_node"),
    Service.FIT: (Trigger, "estimator_node"),
    Service.ENABLE_TRIGGER: (SetBool, "trigger_node"),
    Service.RECORD: (SetBool, "recorder_node"),
    _NEXT_TRIAL: (SetParametersAtomically, "recorder_node"),
}
# Services that controls call with a fixed request.
_CALLS = {
    "tare": (Service.TARE, Trigger.Request()),
    "fit": (Service.FIT, Trigger.Request()),
    "trigger-on": (Service.ENABLE_TRIGGER, SetBool.Request(data=True)),
    "trigger-off": (Service.ENABLE_TRIGGER, SetBool.Request(data=False)),
    "stop recording": (Service.RECORD, SetBool.Request(data=False)),
}


@dataclass(frozen=True)
class Marked:
    """An event that was published and acknowledged.

    Attributes:
        subscribers: Number of programs that acknowledged it.
        trial: Name of the trial being recorded; empty if none.
        triggered: Whether its stamp follows the triggers; otherwise it is the system clock's.
    """

    subscribers: int
    trial: str
    triggered: bool

    def notes(self) -> list[str]:
        """Remarks for the user."""
        found = []
        if not self.trial:
            found.append("no trial is being recorded: call recorder/record")
        if not self.triggered:
            found.append("no trigger received: the stamp is the system clock's")
        return found


def publish_event(label: str, called: float, namespace: str = "/") -> Marked:
    """Publish an event and wait until all subscribers have acknowledged it.

    Its stamp is the time of the call, converted to trigger time: a testbed may run on another
    computer, slower than real time, or as a replay, and its clock does not follow changes of the
    system clock.

    Args:
        label: The event's label, see `check_label`.
        called: When it happened, on this machine's monotonic clock [s].
        namespace: Namespace of the testbed.

    Raises:
        TestbedError: If nobody subscribes, or does not acknowledge it.
        ConfigurationError: If ROS does not accept the namespace.
    """
    namespace = full_namespace(namespace)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # the verb handles Ctrl-C
    node = rclpy.create_node("event_marker", namespace=namespace)
    step = partial(rclpy.spin_once, node, timeout_sec=_POLL_INTERVAL)
    try:
        with base.Waker([node]):
            return EventMarker(node, partial(_wait, step=step)).mark(label, called)
    finally:
        node.destroy_node()
        rclpy.shutdown()


def reported_states(
    nodes: Collection[str], namespace: str = "/", within: float = _STATES_TIMEOUT
) -> dict[str, tuple[int, str]]:
    """Level and message of the running nodes, from /diagnostics.

    Args:
        nodes: Names of the nodes.
        namespace: Namespace of the testbed.
        within: How long to listen for nodes that say nothing [s].

    Returns:
        The newest level (OK, WARN or ERROR) and message of each node that reported, by its name.
    """
    wanted = {full_name(name, full_namespace(namespace)): name for name in nodes}
    found: dict[str, tuple[int, str]] = {}

    def note(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name in wanted:
                found[wanted[status.name]] = status.level[0], status.message

    context = rclpy.Context()
    # The verb handles Ctrl-C.
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("doctor", context=context)
    executor = SingleThreadedExecutor(context=context)
    try:
        qos = base.subscriber_qos(DIAGNOSTICS)
        node.create_subscription(DiagnosticArray, DIAGNOSTICS.name, note, qos)
        executor.add_node(node)
        step = partial(executor.spin_once, timeout_sec=_POLL_INTERVAL)
        _wait(lambda: len(found) == len(wanted), within, step)
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()
    return found


def _wait(
    condition: Callable[[], bool],
    duration: float,
    step: Callable[[], None] = lambda: time.sleep(_POLL_INTERVAL),
) -> bool:
    """Wait until a condition holds, at most a duration [s]; returns whether it does."""
    deadline = time.monotonic() + duration
    while not condition():
        if time.monotonic() > deadline:
            return False
        step()
    return True


class EventMarker:
    """Publishes events, one after the other, for the life of a node.

    Publishes: event. Subscribes: recorder/trial; trigger while an event is marked.

    Args:
        node: The node, in the namespace of the testbed.
        wait: Waits until a condition holds, at most a duration [s], while the node is spun; returns
            whether it does.
    """

    def __init__(self, node: Node, wait: Callable[[Callable[[], bool], float], bool]) -> None:
        self._node = node
        self._wait = wait
        self._triggers: list[tuple[float, int]] = []  # arrival [s] and stamp [ns]
        self._trial: str | None = None
        self._publisher = node.create_publisher(Event, EVENT.name, base.publisher_qos(EVENT))
        self._read_trigger = Reader(TRIGGER).read
        self._subscribe(RECORDED_TRIAL, self._on_trial)

    def mark(self, label: str, called: float) -> Marked:
        """Publish an event, and wait until all subscribers have acknowledged it.

        Args:
            label: The event's label.
            called: When it happened, on this machine's monotonic clock [s]; becomes a stamp in
                trigger time.

        Raises:
            TestbedError: If nobody subscribes, or does not acknowledge it.
        """
        self._triggers.clear()
        subscription = self._subscribe(TRIGGER, self._on_trigger)
        try:
            if not self._wait(self._is_linked, _LINK_TIMEOUT):
                raise TestbedError(
                    f"no subscriber to {self._publisher.topic_name}", self._where_else()
                )
            stamp = self._stamp_of(called)
        finally:
            self._node.destroy_subscription(subscription)
        self._publisher.publish(Event(header=base.header_to_ros(stamp), label=label))
        if not self._wait(partial(base.is_acknowledged, self._publisher), _ACKNOWLEDGE_TIMEOUT):
            raise TestbedError(
                f"the event was not acknowledged within {_ACKNOWLEDGE_TIMEOUT:g} s",
                "check that the recorder runs, and 'info' of its trial for the event",
            )
        count = self._publisher.get_subscription_count()
        trial = base.recorded_trial(self._node, self._trial or "")
        return Marked(count, trial, bool(self._triggers))

    def _stamp_of(self, called: float) -> int:
        """Stamp since the epoch [ns] of a monotonic time [s], from the triggers that arrive now."""
        # The older the call, the longer the span of triggers to extrapolate from.
        since = time.monotonic() - called
        self._wait(lambda: self._has_triggers(max(_MIN_SPAN, 0.5 * since)), _TRIGGER_TIMEOUT)
        if not self._triggers:
            return time.time_ns() - round((time.monotonic() - called) * 1e9)
        if events.trigger_speed(self._triggers) != events.REAL_TIME:
            span = min(_SPAN_FACTOR * since, _MAX_SPAN)
            self._wait(lambda: self._has_triggers(span), span)
        return events.stamp_by_triggers(called, self._triggers)

    def _has_triggers(self, span: float) -> bool:
        """Whether enough triggers have arrived, the last so long [s] after the first."""
        triggers = self._triggers
        return len(triggers) > 2 and triggers[-1][0] - triggers[0][0] >= span

    def _is_linked(self) -> bool:
        known = self._publisher.get_subscription_count()
        answered = self._trial is not None or not self._node.count_publishers(RECORDED_TRIAL.name)
        return answered and known >= max(1, self._node.count_subscribers(EVENT.name))

    def _where_else(self) -> str:
        """A hint naming namespaces with a subscriber for events."""
        others = [
            namespace_of(name, EVENT)
            for name, _ in self._node.get_topic_names_and_types()
            if name.endswith(f"/{EVENT.name}") and self._node.count_subscribers(name)
        ]
        if others:
            return f"give --namespace {' or '.join(others)}"
        return (
            "start 'run --record DIR' or 'record DIR' on this ROS_DOMAIN_ID first"
            " (on another computer: docs/hardware.md, Network)"
        )

    def _subscribe(self, topic: Topic, callback: Callable[[bytes], None]) -> Any:
        """Subscribe to serialised messages; those of another program's layout are dropped."""

        def receive(data: bytes) -> None:
            with suppress(TrialError):
                callback(data)

        kind, qos = base.message_type(topic), base.subscriber_qos(topic)
        return self._node.create_subscription(kind, topic.name, receive, qos, raw=True)

    def _on_trigger(self, data: bytes) -> None:
        """Note the arrival on the monotonic clock [s] and the stamp [ns] of a trigger."""
        arrival = time.monotonic()
        self._triggers.append((arrival, self._read_trigger(data)[0]))

    def _on_trial(self, data: bytes) -> None:
        """Note the name of the trial being recorded; empty if none."""
        self._trial = base.decoded(RECORDED_TRIAL, data).data


class ServiceControls:
    """Controls the testbed in a node's namespace, from any thread except the node's.

    Calls: load_cell/tare, estimator/fit, trigger/enable, recorder/record, and the setting of
    recorder_node's parameters `next.*`. Publishes: event.

    Args:
        node: A node in the namespace of the testbed, which is spun elsewhere.
    """

    def __init__(self, node: Node) -> None:
        self._clients = {
            name: node.create_client(kind, name) for name, (kind, _) in _SERVICES.items()
        }
        self._marker = EventMarker(node, _wait)
        self._marking, self._recording = threading.Lock(), threading.Lock()

    def act(self, what: str, given: Mapping[str, str]) -> str:
        """Perform a button's action; returns the outcome in one line.

        Args:
            what: `mark`, `record`, `stop recording`, `tare`, `fit`, `trigger-on` or `trigger-off`.
            given: Arguments by name, as text. `mark` takes a `label` and uses the time of this
                call; `record` takes a `trial` (by default named by date and time) and fields of the
                metadata, such as `mass` [kg].

        Raises:
            ConfigurationError: If there is no such action, or an argument is invalid.
            TestbedError: If a service refuses, does not answer, or is not offered, or an event is
                not acknowledged.
        """
        if what in _CALLS:
            return self._ask(*_CALLS[what])
        if what == "mark":
            return self._mark(given.get("label", "event"))
        if what == "record":
            return self._record(given)
        raise ConfigurationError(f"no button is called '{what}'", "load the page again")

    def _mark(self, label: str) -> str:
        called = time.monotonic()
        label = events.check_label(label)
        with self._marking:  # a later call waits but keeps its time
            marked = self._marker.mark(label, called)
        where = f" in the trial {marked.trial}" if marked.trial else ""
        return "; ".join([f"marked '{label}'{where}", *marked.notes()])

    def _record(self, given: Mapping[str, str]) -> str:
        wanted = NextTrialSettings().to_flat() | {"name": given.get("trial", "")}
        wanted |= {name: value for name, value in given.items() if name != "trial"}
        try:
            wanted["mass"] = float(wanted["mass"])
        except ValueError:
            hint = "give the body mass in kg"
            raise ConfigurationError(f"mass is '{wanted['mass']}'", hint) from None
        parameters = [
            Parameter(f"next.{name}", value=value).to_parameter_msg()
            for name, value in wanted.items()
        ]
        request = SetParametersAtomically.Request(parameters=parameters)
        with self._recording:  # one browser's settings must not reach another's trial
            result = self._call(_NEXT_TRIAL, request).result
            if not result.successful:
                raise _refusal(result.reason)
            return self._ask(Service.RECORD, SetBool.Request(data=True))

    def _ask(self, name: str, request: Any) -> str:
        """Call a service that returns success and a message; a failure becomes an error."""
        answer = self._call(name, request)
        if not answer.success:
            raise _refusal(answer.message)
        return str(answer.message)

    def _call(self, name: str, request: Any) -> Any:
        within, again = clocks.real(_ANSWER_TIMEOUT), clocks.real(_RETRY_INTERVAL)
        if name == Service.FIT:  # slow, so no retry
            within = again = clocks.real(_FIT_TIMEOUT)
        client, (_, offered_by) = self._clients[name], _SERVICES[name]
        if not _wait(client.service_is_ready, _DISCOVERY_TIMEOUT):
            hint = f"check that {offered_by} runs"
            if offered_by == "recorder_node":
                hint = "start 'run' with --record DIR, or 'record DIR' beside it"
            raise TestbedError(f"no node offers {name}", hint)
        asked: list[Future] = []
        for _ in range(math.ceil(within / again)):
            asked.append(client.call_async(request))
            if _wait(lambda: any(future.done() for future in asked), again):
                break
        for future in asked:
            client.remove_pending_request(future)
        answers = [future.result() for future in asked if future.done()]
        if not answers:
            hint = f"see what {offered_by} reports"
            raise TestbedError(f"{name} has not answered within {within:g} s", hint)
        return answers[0]


def _refusal(words: str) -> TestbedError:
    """A refusal by a service or node, fact and hint, as an error."""
    fact, hint = fact_and_hint(words)
    return TestbedError(fact, hint) if hint else TestbedError("refused", words)


class StatusListener:
    """Feeds a graph's status with serialised messages.

    The program that draws the status line calls `take` twenty times a second. Subscribes: the
    topics that samples require, estimate/wrench, estimate/parameters, recorder/trial.

    Args:
        status: The status to feed.
        namespace: Absolute namespace of the testbed.
        pause: Full name of a replay's service; empty if there is none.
    """

    def __init__(self, status: GraphStatus, namespace: str = "/", pause: str = "") -> None:
        self._status, self._announced = status, ""
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)  # the verb's task
        self._readers = {topic: Reader(topic) for topic in _STATUS_TOPICS}
        self._topics = (*_STATUS_TOPICS, PARAMETERS, RECORDED_TRIAL)
        qos = {topic: base.subscriber_qos(topic) for topic in self._topics}
        self._inbox = base.Inbox("status_listener", namespace, qos)
        self._waker = base.Waker([self._inbox.node]).__enter__()
        self._pause = self._inbox.node.create_client(SetBool, pause) if pause else None

    def take(self) -> None:
        """Process the messages received since the last call."""
        for topic in self._topics:
            for data in self._inbox.take(topic):
                with suppress(TrialError):  # another program's layout
                    self.add(topic, data)
        self._status.trial = base.recorded_trial(self._inbox.node, self._announced)

    def add(self, topic: Topic, data: bytes) -> None:
        """Process a message.

        Args:
            topic: One of the topics that this listener subscribes to.
            data: The message, serialised (CDR).

        Raises:
            TrialError: If the message cannot be decoded.
        """
        if topic is PARAMETERS:
            self._status.variant = base.decoded(topic, data).variant
        elif topic is RECORDED_TRIAL:
            self._announced = base.decoded(topic, data).data
            self._status.trials |= {self._announced} - {""}
        else:
            self._status.add(topic, *self._readers[topic].read(data))

    def set_paused(self, paused: bool) -> bool:
        """Pause or resume the replay; returns whether its service was available."""
        if self._pause is None or not self._pause.service_is_ready():
            return False
        self._pause.call_async(SetBool.Request(data=paused))
        return True

    def close(self) -> None:
        """Disconnect from the graph."""
        self._waker.__exit__()
        self._inbox.close()
        rclpy.try_shutdown()
