"""Messages of a running graph for the status line of a terminal."""

from __future__ import annotations

import rclpy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from socket_testbed_msgs.msg import ContactModel
from std_msgs.msg import String
from std_srvs.srv import SetBool

from socket_testbed.live.graph_status import GraphStatus
from socket_testbed.nodes import base
from socket_testbed.trials.messages import Reader
from socket_testbed.trials.topics import (
    ESTIMATED_WRENCH,
    PARAMETERS,
    RECORDED_TRIAL,
    REQUIRED,
    Topic,
)

_STATUS_TOPICS = (*REQUIRED, ESTIMATED_WRENCH)  # measurements before their predictions


class StatusListener:
    """Feeds a graph's status with serialised messages; `pause` names a replay's service, if any.

    The program that draws the status line calls `take` twenty times a second.
    """

    def __init__(self, status: GraphStatus, namespace: str = "/", pause: str = "") -> None:
        self._status, self._announced = status, ""
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)  # the verb's task
        self._readers = {topic: Reader(topic) for topic in _STATUS_TOPICS}
        self._topics = (*_STATUS_TOPICS, PARAMETERS, RECORDED_TRIAL)
        qos = {topic: base.subscriber_qos(topic) for topic in self._topics}
        self._inbox = base.Inbox("status_listener", namespace, qos)
        self._pause = self._inbox.node.create_client(SetBool, pause) if pause else None

    def take(self) -> None:
        """Process the messages received since the last call."""
        for topic in self._topics:
            for data in self._inbox.take(topic):
                self.add(topic, data)
        self._status.trial = base.recorded_trial(self._inbox.node, self._announced)

    def add(self, topic: Topic, data: bytes) -> None:
        """Process a serialised message of a topic."""
        if topic is PARAMETERS:
            self._status.variant = deserialize_message(data, ContactModel).variant
        elif topic is RECORDED_TRIAL:
            self._announced = deserialize_message(data, String).data
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
        self._inbox.close()
        rclpy.try_shutdown()
