"""Publishes one event into a running graph, in the time of its triggers."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from socket_testbed_msgs.msg import Event, Trigger
from std_msgs.msg import String

from socket_testbed.errors import TestbedError
from socket_testbed.nodes.base import is_acknowledged, publisher_qos, subscriber_qos
from socket_testbed.nodes.conversions import LOAD_CELL_FRAME, header_to_ros, stamp_from_ros
from socket_testbed.trials.topics import EVENT, RECORDED_TRIAL, TRIGGER, full_namespace

_FOUND_WITHIN = 6.0  # [s]; for a subscriber to be found on a busy machine
_TRIGGERED_WITHIN = 5.0  # [s]; for enough triggers
_LEAST = 1.0  # [s]; from the first trigger to the last
_HEARD_WITHIN = 5.0  # [s]; for the event to be acknowledged
_LOOK = 0.02  # [s]
_SLOW = 3.0  # [-]; how much longer than the call is ago the triggers of a slow testbed are heard
_LONGEST = 12.0  # [s]; but no longer
_REAL_TIME = 1e9  # [ns/s]
_ABOUT = 0.1  # [-]; triggers whose speed differs less from real time come in real time


@dataclass(frozen=True)
class Marked:
    """An event that was published and acknowledged.

    Attributes:
        subscribers: Number of programs that acknowledged it.
        trial: Name of the trial that is being recorded; empty if none is.
        triggered: Whether its stamp is in the time of triggers; else it is the system clock's.
    """

    subscribers: int
    trial: str
    triggered: bool

    def notes(self) -> list[str]:
        """What the person who marked it should know."""
        found = []
        if not self.trial:
            found.append("no trial is being recorded: call recorder/record")
        if not self.triggered:
            found.append("no trigger came: the stamp is the system clock's")
        return found


def publish_event(label: str, called: float, namespace: str = "/") -> Marked:
    """Publish an event, and wait until all subscribers have acknowledged it.

    Its stamp is when it was called, in the time of the triggers: a testbed may run on another
    computer, slower than real time, or be replayed, and its clock stays when the system's is set.

    Args:
        label: What happened.
        called: When, on this machine's monotonic clock [s].
        namespace: Namespace of the testbed.

    Raises:
        ConfigurationError: If the namespace cannot be one.
        TestbedError: If nobody subscribes, or it is not acknowledged.
    """
    namespace = full_namespace(namespace)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C is the verb's
    node = rclpy.create_node("event_marker", namespace=namespace)

    def wait(condition: Callable[[], bool], duration: float) -> bool:
        deadline = time.monotonic() + duration
        while not condition():
            if time.monotonic() > deadline:
                return False
            rclpy.spin_once(node, timeout_sec=_LOOK)
        return True

    try:
        return EventMarker(node, wait).mark(label, called)
    finally:
        node.destroy_node()
        rclpy.shutdown()


class EventMarker:
    """What events are published with, one after the other, for the life of a node.

    Args:
        node: The node that publishes them.
        wait: Waits until a condition holds, while the node is spun; returns whether it does within
            a duration [s].
    """

    def __init__(self, node: Node, wait: Callable[[Callable[[], bool], float], bool]) -> None:
        self._node = node
        self._wait = wait
        self._triggers: list[tuple[float, int]] = []  # arrival [s] and stamp [ns]
        self._trial: str | None = None
        self._publisher = node.create_publisher(Event, EVENT.name, publisher_qos(EVENT))
        node.create_subscription(
            String, RECORDED_TRIAL.name, self._on_trial, subscriber_qos(RECORDED_TRIAL)
        )

    def mark(self, label: str, called: float) -> Marked:
        """Publish an event, see `publish_event`; triggers are heard meanwhile alone."""
        self._triggers.clear()
        triggers = self._node.create_subscription(
            Trigger, TRIGGER.name, self._on_trigger, subscriber_qos(TRIGGER)
        )
        try:
            return self._mark(label, called)
        finally:
            self._node.destroy_subscription(triggers)

    def _mark(self, label: str, called: float) -> Marked:
        if not self._wait(self._is_linked, _FOUND_WITHIN):
            raise TestbedError(
                f"nobody subscribes to {self._publisher.topic_name}", self._where_else()
            )
        # The longer ago the call, the longer the triggers from which its time is reckoned.
        since = time.monotonic() - called
        self._wait(lambda: self._has_triggers(max(_LEAST, 0.5 * since)), _TRIGGERED_WITHIN)
        if len(self._triggers) > 1 and _speed(self._triggers) != _REAL_TIME:
            span = min(_SLOW * since, _LONGEST)
            self._wait(lambda: self._has_triggers(span), span)
        header = header_to_ros(self._stamp(called), LOAD_CELL_FRAME)
        self._publisher.publish(Event(header=header, label=label))
        if not self._wait(partial(is_acknowledged, self._publisher), _HEARD_WITHIN):
            raise TestbedError(
                f"the event was not acknowledged within {_HEARD_WITHIN:g} s",
                "check that the recorder runs, and 'info' of its trial for the event",
            )
        count = self._publisher.get_subscription_count()
        return Marked(count, self._trial or "", bool(self._triggers))

    def _has_triggers(self, span: float) -> bool:
        triggers = self._triggers
        return len(triggers) > 2 and triggers[-1][0] - triggers[0][0] >= span

    def _is_linked(self) -> bool:
        known = self._publisher.get_subscription_count()
        answered = self._trial is not None or not self._node.count_publishers(RECORDED_TRIAL.name)
        return answered and known >= max(1, self._node.count_subscribers(EVENT.name))

    def _stamp(self, called: float) -> int:
        """Stamp of a time of the monotonic clock [s], by the triggers [ns]."""
        if not self._triggers:
            return time.time_ns() - round((time.monotonic() - called) * 1e9)
        return stamp_by_triggers(called, self._triggers)

    def _where_else(self) -> str:
        """A hint at where an event would be heard."""
        others = [
            name.removesuffix(EVENT.name).rstrip("/")
            for name, types in self._node.get_topic_names_and_types()
            if name.endswith(f"/{EVENT.name}") and EVENT.type in types
            and self._node.count_subscribers(name)
        ]  # fmt: skip
        if others:
            return f"give --namespace {' or '.join(others)}"
        return (
            "start 'run --record DIR' or 'record DIR' on this ROS_DOMAIN_ID first"
            " (on another computer: docs/hardware.md, Network)"
        )

    def _on_trigger(self, message: Trigger) -> None:
        self._triggers.append((time.monotonic(), stamp_from_ros(message.header.stamp)))

    def _on_trial(self, message: String) -> None:
        self._trial = message.data


def stamp_by_triggers(called: float, triggers: Sequence[tuple[float, int]]) -> int:
    """Stamp of a time of the monotonic clock in the time of triggers [ns].

    The triggers' clock may run at another speed: that is the median between all that arrived long
    enough one after the other. A busy machine holds triggers up, none comes early: the one that was
    held up least says how far the clocks are apart.

    Args:
        called: The time [s].
        triggers: Arrival [s] and stamp [ns] of each, in their order; one at least.
    """
    arrivals, stamps = (np.array(values) for values in zip(*triggers, strict=True))
    ahead = np.round(_speed(triggers) * (called - arrivals)).astype(np.int64)
    return int((stamps + ahead).max())


def _speed(triggers: Sequence[tuple[float, int]]) -> float:
    """How fast the clock of triggers runs [ns/s]; exactly real time if it is about that."""
    arrivals, stamps = (np.array(values) for values in zip(*triggers, strict=True))
    passed = arrivals - arrivals[:, None]
    apart = passed >= max(0.5 * passed.max(), _LOOK)
    if not apart.any():
        return _REAL_TIME
    speed = float(np.median((stamps - stamps[:, None])[apart] / passed[apart]))
    return _REAL_TIME if abs(speed - _REAL_TIME) < _ABOUT * _REAL_TIME else speed
