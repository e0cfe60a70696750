"""Services that tare a wrench, for the nodes that publish one."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from socket_testbed_msgs.msg import Event
from std_msgs.msg import String
from std_srvs.srv import Trigger as TriggerService

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray
from socket_testbed.clocks import TriggerTime
from socket_testbed.drivers.load_cell.load_cell import in_words, pressed
from socket_testbed.errors import DeviceError
from socket_testbed.nodes.base import TestbedNode, header_to_ros, recorded_trial
from socket_testbed.settings.acquisition import TareSettings
from socket_testbed.wire.topics import EVENT, RECORDED_TRIAL, STRESS, TARE, Service

# Older stresses of the clusters do not count at a tare:
_RECENT = 1.0  # [s]
_RECENT_PERIODS = 3.0  # [-]; of the trigger


class TareServices:
    """Offers load_cell/tare and load_cell/force_tare, and publishes each tare on event.

    A tare is refused while a trial is being recorded or a cluster is pressed, unless it is forced.

    Args:
        node: The node that publishes the wrench. Its settings are a `TareSettings`.
        tare: Called with the present time since the epoch [ns], and whether the tare is forced;
            returns the removed load [M; F], shape (6,) [N m, N], or raises a DeviceError.
        trigger_time: Gives the stamps of the testbed.
        period: Returns the period of the triggers [s].
    """

    def __init__(
        self,
        node: TestbedNode[Any],
        tare: Callable[[int, bool], FloatArray],
        trigger_time: TriggerTime,
        period: Callable[[], float],
    ) -> None:
        self._node, self._tare = node, tare
        self._trigger_time, self._period = trigger_time, period
        self._stresses: tuple[dict[str, Any], float] = {}, -math.inf  # newest, arrival [s]
        node.follow(STRESS, self._on_stress, needed=False)
        self._events = node.advertise(EVENT)
        self._trial = ""  # being recorded
        node.listen(RECORDED_TRIAL, self._on_recorded, needed=False)
        node.serve(TriggerService, Service.TARE, self.tare, slow=True)
        node.serve(TriggerService, Service.FORCE_TARE, partial(self.tare, forced=True), slow=True)

    def tare(self, forced: bool = False) -> str:
        """Tare, and publish it as an event for the recorder, with the removed wrench [N, N m].

        Args:
            forced: Whether to tare even while a trial is recorded or a cluster pressed.

        Raises:
            DeviceError: If a trial is being recorded or a cluster is pressed, and the tare is not
                forced, or the wrench cannot be tared now.
        """
        settings: TareSettings = self._node.settings
        trial = recorded_trial(self._node, self._trial)
        if trial and not forced:
            raise DeviceError(
                f"cannot tare: the trial {trial} is being recorded",
                "stop the recording, or force it (load_cell/force_tare)",
            )
        stresses, arrival = self._stresses
        now = clocks.monotonic()
        if now - arrival > max(_RECENT, _RECENT_PERIODS * self._period()):
            stresses = {}
        if (found := pressed(stresses, settings)) and not forced:
            raise DeviceError(
                f"cannot tare: {found}",
                "take the limb out of the socket; if nothing touches them, force it"
                " (load_cell/force_tare)",
            )
        stamp = self._trigger_time.stamp(now)
        removed = f"removed {in_words(self._tare(stamp, forced))}"
        self._events.publish(Event(header=header_to_ros(stamp), label=f"{TARE} {removed}"))
        return f"tared: {removed}"

    def _on_stress(self, stamp: int, stresses: dict[str, Any]) -> None:
        """Note the newest stresses by cluster [Pa], and when they arrived [s]."""
        self._stresses = stresses, clocks.monotonic()

    def _on_recorded(self, message: String) -> None:
        """Note the name of the trial being recorded; empty if none."""
        self._trial = message.data
