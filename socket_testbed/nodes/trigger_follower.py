"""Work that follows each trigger, in a thread of its own."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

from rclpy.node import Node
from socket_testbed_msgs.msg import Trigger

from socket_testbed import clocks
from socket_testbed.clocks import SteadyClock, TriggerTime
from socket_testbed.nodes.conversions import stamp_from_ros
from socket_testbed.nodes.runtime import subscriber_qos
from socket_testbed.trials.topics import TRIGGER

_IDLE = 0.3  # [s]; without a trigger


class TriggerFollower:
    """Calls for each trigger, one after the other, in their order.

    Args:
        node: The node whose subscription it uses.
        follow: Called in the thread with the stamp [ns] of a trigger and its time on the
            steady clock [s].
        idle: Called in the thread now and then while no trigger comes.

    Attributes:
        subscription: The subscription to the trigger.
        triggers: Number of triggers received.
        busy_since: When the work on the trigger in hand began on the steady clock [s], or None.
    """

    def __init__(
        self,
        node: Node,
        follow: Callable[[int, float], None],
        idle: Callable[[], None] = lambda: None,
    ) -> None:
        self._node = node
        self._follow = follow
        self._idle = idle
        self._time = TriggerTime(SteadyClock())
        self._queue: queue.SimpleQueue[tuple[int, float] | None] = queue.SimpleQueue()
        self.triggers = 0
        self.busy_since: float | None = None
        self.subscription = node.create_subscription(
            Trigger, TRIGGER.name, self._on_trigger, subscriber_qos(TRIGGER)
        )
        self._thread = threading.Thread(target=self._run, name="trigger_follower")
        self._thread.start()

    @property
    def note(self) -> str:
        """What is to be said of the clocks; empty as a rule."""
        if not self._time.shift:
            return ""
        return (
            f"the system clock was set by {-self._time.shift:.3f} s between the starts of nodes:"
            " triggers are placed by their arrival, within 1 ms"
        )

    def close(self) -> None:
        """Stop following; what has come is worked off."""
        self._queue.put(None)
        self._thread.join()

    def _on_trigger(self, message: Trigger) -> None:
        stamp = stamp_from_ros(message.header.stamp)
        self.triggers += 1
        self._queue.put((stamp, self._time.steady(stamp, clocks.monotonic())))

    def _run(self) -> None:
        try:
            while True:
                try:
                    entry = self._queue.get(timeout=clocks.real(_IDLE))
                except queue.Empty:
                    self._idle()
                    continue
                if entry is None:
                    return
                self.busy_since = clocks.monotonic()
                self._follow(*entry)
                self.busy_since = None
        except Exception:
            # After Ctrl-C the publishers go before this thread does.
            if self._node.context.ok():
                raise
