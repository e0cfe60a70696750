"""A subscriber that watches a graph for the status line of a terminal.

No executor and no thread serve it: the program that draws the line takes what has come, twenty
times a second. At 100 Hz that takes 2 % of a core, where an executor takes 4 %.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from socket_testbed_msgs.msg import ContactModel
from std_msgs.msg import String
from std_srvs.srv import SetBool

from socket_testbed.live.graph_status import GraphStatus
from socket_testbed.nodes.base import PolledSubscription, subscriber_qos
from socket_testbed.nodes.conversions import (
    MessageReader,
    capacitance_reader,
    pose_reader,
    trigger_reader,
    wrench_reader,
)
from socket_testbed.samples import Status
from socket_testbed.trials.topics import (
    CAPACITANCE,
    ESTIMATED_WRENCH,
    PARAMETERS,
    PYLON_POSE,
    RECORDED_TRIAL,
    SOCKET_POSE,
    TRIGGER,
    WRENCH,
    Topic,
)

_STAMPED: dict[Topic, Callable[[], MessageReader[Any]]] = {
    TRIGGER: trigger_reader,
    CAPACITANCE: capacitance_reader,
    **dict.fromkeys((SOCKET_POSE, PYLON_POSE), pose_reader),
    **dict.fromkeys((WRENCH, ESTIMATED_WRENCH), wrench_reader),
}


class StatusListener:
    """Feeds a graph's status with serialised messages.

    Args:
        status: What is fed.
        namespace: Namespace of the graph.
        pause: Service that pauses a replay; empty for none.
    """

    def __init__(self, status: GraphStatus, namespace: str = "/", pause: str = "") -> None:
        self._status = status
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C is the verb's
        self._node = Node(
            "_status_listener",
            namespace=namespace,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self._readers = {topic: reader() for topic, reader in _STAMPED.items()}
        self._subscriptions = {
            topic: PolledSubscription(self._node, topic, subscriber_qos(topic))
            for topic in (*_STAMPED, PARAMETERS, RECORDED_TRIAL)
        }
        self._pause = self._node.create_client(SetBool, pause) if pause else None

    def take(self) -> None:
        """Take what has come since the last call."""
        for topic, subscription in self._subscriptions.items():
            for data in subscription.take():
                self.add(topic, data)

    def add(self, topic: Topic, data: bytes) -> None:
        """Feed a serialised message of a topic."""
        if topic is PARAMETERS:
            self._status.variant = deserialize_message(data, ContactModel).variant
        elif topic is RECORDED_TRIAL:
            self._status.trial = deserialize_message(data, String).data
        else:
            stamp, *_, values = self._readers[topic].read(data)
            if topic is TRIGGER:
                self._status.add_trigger(stamp)
            elif topic is ESTIMATED_WRENCH:
                self._status.add_prediction(stamp, values)
            else:
                if topic is WRENCH:
                    self._status.add_wrench(stamp, values)
                missing = values == Status.MISSING if topic is CAPACITANCE else np.isnan(values)
                if not missing.any():
                    self._status.add_measurement(topic, stamp)

    def set_paused(self, paused: bool) -> bool:
        """Pause the replay or let it go on; returns whether it was there to be asked."""
        if self._pause is None or not self._pause.service_is_ready():
            return False
        self._pause.call_async(SetBool.Request(data=paused))
        return True

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()
        rclpy.try_shutdown()
