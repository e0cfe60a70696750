"""Base of the nodes that measure at each trigger, in a thread of their own."""

from __future__ import annotations

import queue
import threading
from typing import Any

from socket_testbed import clocks
from socket_testbed.clocks import SteadyClock, TriggerPeriod, TriggerTime
from socket_testbed.nodes.base import ERROR, OK, SAMPLES, WARN, RecentFault, S, TestbedNode
from socket_testbed.wire.topics import TRIGGER

_IDLE_AFTER = 0.3  # [s]; without a trigger
_SETTLING_TIME = 5.0  # [s]; for a device to answer; then the testbed starts without it


class SensorNode(TestbedNode[S]):
    """Measures at each trigger, one after the other, in order.

    Subclasses override `measure` and `health`, and `idle` as needed. Subscribes: trigger.

    Args:
        name: Name of the node.
        kind: Class of its settings.

    Attributes:
        fault: The last fault of a measurement.
        samples: Number of measurements so far.
        missing: Number of measurements, or of their channels, without a value so far.
        busy_since: Start of the current measurement on the testbed's steady clock [s]; None between
            measurements.
        period: Period of the triggers up to the current one [s]; 0 while unknown.
        trigger_time: Converts stamps of triggers to the testbed's steady clock and back.
    """

    def __init__(self, name: str, kind: type[S]) -> None:
        super().__init__(name, kind, settle=_SETTLING_TIME)
        self.fault = RecentFault()
        self.samples = 0
        self.missing = 0
        self.busy_since: float | None = None
        self.period = 0.0
        self.trigger_time = TriggerTime(SteadyClock())
        self._trigger_period = TriggerPeriod()
        self._due: queue.SimpleQueue[tuple[int, float, float] | None] = queue.SimpleQueue()
        self._measuring = threading.Thread(target=self._run, name="measure")

    def measure(self, stamp: int, moment: float) -> None:
        """Measure and publish; called in the thread.

        Args:
            stamp: Stamp of the trigger since the epoch [ns], which the messages carry.
            moment: The trigger on the testbed's steady clock [s]; minus infinity while unknown.
        """
        raise NotImplementedError

    def health(self) -> tuple[int, str] | None:
        """Health of the device and its measurements; None before anything is known.

        Returns:
            The level (OK, WARN or ERROR), and fact and hint in one line.
        """
        raise NotImplementedError

    def idle(self) -> None:
        """Check the device while no trigger comes; called in the thread now and then."""

    def follow_triggers(self) -> None:
        """Start measuring."""
        self.follow(TRIGGER, self._on_trigger)
        self._measuring.start()

    def close(self) -> None:
        """Stop measuring, after all received triggers are processed."""
        if self._measuring.is_alive():
            self._due.put(None)
            self._measuring.join()
        super().close()

    def figures(self) -> dict[str, object]:
        """Numbers of measurements and of missing ones."""
        return {SAMPLES: self.samples, "missing": self.missing}

    def check(self) -> None:
        """Report the device's health, or that triggers had to be timed by their arrival."""
        if self._measuring.ident is not None and not self._measuring.is_alive():
            self.report(ERROR, "it stopped measuring: see what it printed, and start it again")
            return
        if (health := self.health()) is None:
            return
        level, message = health
        if level == OK and (shift := self.trigger_time.shift):
            level = WARN
            message = (
                f"the system clock was set by {-shift:.3f} s between the starts of nodes:"
                " triggers are timed by their arrival, within 1 ms"
            )
        self.report(level, message)

    def _on_trigger(self, stamp: int, sequence: Any) -> None:
        """Queue a measurement for a trigger, given its stamp since the epoch [ns] and number."""
        moment = self.trigger_time.steady(stamp, clocks.monotonic())
        self._due.put((stamp, moment, self._trigger_period.add(stamp, int(sequence))))

    def _run(self) -> None:
        """Measure at each queued trigger, in the order of their arrival."""
        with self.until_ros_ends():
            while True:
                try:
                    entry = self._due.get(timeout=clocks.real(_IDLE_AFTER))
                except queue.Empty:
                    self.idle()
                    continue
                if entry is None:
                    return
                self.busy_since = clocks.monotonic()
                stamp, moment, self.period = entry
                self.measure(stamp, moment)
                self.samples += 1
                self.busy_since = None
