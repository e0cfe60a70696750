"""What a node reports of itself on /diagnostics: 1 Hz, and at once on a change of level."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from socket_testbed import clocks
from socket_testbed.nodes.runtime import publisher_qos
from socket_testbed.trials.topics import DIAGNOSTICS

_TOLD = 0.5  # [s]


class RecentFault:
    """The last fault that a node's thread saw."""

    def __init__(self) -> None:
        self._seen = ("", 0.0)  # one value: it is written in one thread and read in another

    def saw(self, text: str) -> None:
        """A fault was seen now."""
        self._seen = (text, clocks.monotonic())

    def text(self, told: float = _TOLD) -> str:
        """The fault, empty when it was seen longer ago than it is told [s]."""
        text, when = self._seen
        return text if clocks.monotonic() - when < told else ""


LEVELS = OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

WAITING_FOR = "waiting_for"
NEWEST_STAMP = "newest_stamp"
LINKS = "links"  # topic=number of matched subscribers, separated by blanks

SETTLE = 5.0  # [s]; for a device to answer before the testbed starts without it

_PERIOD = 1.0  # [s]
_LOOK = 0.1  # [s]; how often the links are looked at


def _without_figures(message: str) -> str:
    return re.sub(r"\d+(\.\d+)?", "#", message)


class Diagnostics:
    """The diagnostics of one node.

    Args:
        node: The node.
        values: Called for the figures to report, by name.
        inputs: Subscriptions that want a publisher.
        outputs: Publishers that want a subscriber.
        offered: Publishers that have subscribers or not, as users like.
        ready: Called to know whether the node itself is ready to work.
        look: Called ten times a second, for the node to look at itself and `report`.
        settle: How long the node counts as starting while it has not reported OK [s].
    """

    def __init__(
        self,
        node: Node,
        values: Callable[[], dict[str, object]],
        inputs: tuple[Subscription, ...] = (),
        outputs: tuple[Publisher, ...] = (),
        offered: tuple[Publisher, ...] = (),
        ready: Callable[[], bool] = lambda: True,
        look: Callable[[], None] = lambda: None,
        settle: float = 0.0,
    ) -> None:
        self._node = node
        self._values = values
        self._inputs = inputs
        self._outputs = outputs
        self._offered = offered
        self._ready = ready
        self._look_at_node = look
        self._settled_at = clocks.monotonic() + settle
        self._publisher = node.create_publisher(
            DiagnosticArray, DIAGNOSTICS.name, publisher_qos(DIAGNOSTICS)
        )
        self._level, self._message = OK, "started"
        self._waiting: list[str] | None = None
        self._ticks = 0
        # A steady clock: diagnostics go on when the system clock jumps or the replay pauses.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(_LOOK, self._look, clock=steady)

    def report(self, level: bytes, message: str) -> None:
        """Say how the node is; a new level or message goes out at once.

        Args:
            level: OK, WARN or ERROR.
            message: The fact and the hint in one line.
        """
        if level != OK and clocks.monotonic() < self._settled_at:
            level, message = WARN, f"starting: {message}"
        if (level, message) == (self._level, self._message):
            return
        # Figures in a message change all the time: they are no news for the log.
        known = _without_figures(message) == _without_figures(self._message)
        if level == OK:
            self._settled_at = 0.0
        changed = level != self._level
        self._level, self._message = level, message
        logger = self._node.get_logger()
        if not self._node.context.ok():  # ROS has ended: only the terminal is left
            print(f"[{logger.name}]: {message}", file=sys.stderr)
            return
        if known and not changed:
            return
        if level == ERROR:
            logger.error(message)
        elif level == WARN:
            logger.warning(message)
        else:
            logger.info(message)
        if changed:
            self._publish()

    def _look(self) -> None:
        try:
            self._look_at_node()
            waiting = self._unlinked()
            self._ticks += 1
            if waiting != self._waiting or self._ticks * _LOOK >= _PERIOD:
                self._waiting = waiting
                self._publish()
        except Exception:
            # ROS may have ended meanwhile, at any of these calls.
            if self._node.context.ok():
                raise

    def _unlinked(self) -> list[str]:
        """Topics without a counterpart in the graph, and the node while it starts."""
        waiting = [
            s.topic_name
            for s in self._inputs
            if s.get_publisher_count() < max(1, self._node.count_publishers(s.topic_name))
        ]
        waiting += [p.topic_name for p in self._outputs if p.get_subscription_count() == 0]
        waiting += [
            p.topic_name
            for p in self._offered
            if p.get_subscription_count() < self._node.count_subscribers(p.topic_name)
        ]
        settled = clocks.monotonic() >= self._settled_at
        return waiting if settled and self._ready() else [*waiting, "itself"]

    def _publish(self) -> None:
        self._ticks = 0
        links = [
            f"{publisher.topic_name}={publisher.get_subscription_count()}"
            for publisher in (*self._outputs, *self._offered)
        ]
        values = {
            WAITING_FOR: ", ".join(self._waiting or []),
            LINKS: " ".join(links),
            **self._values(),
        }
        if self._waiting is None:
            values[WAITING_FOR] = "(not looked yet)"
        status = DiagnosticStatus(
            level=self._level,
            name=self._node.get_name(),
            message=self._message,
            hardware_id="",
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
