"""A subscriber that watches a running graph for a status line."""

from __future__ import annotations

import rclpy
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from socket_testbed_msgs.msg import ContactModel
from std_msgs.msg import String
from std_srvs.srv import SetBool

from socket_testbed.live.graph_status import MEASURED, GraphStatus
from socket_testbed.nodes.base import Inbox, subscriber_qos
from socket_testbed.trials.messages import Reader
from socket_testbed.trials.topics import (
    ESTIMATED_WRENCH,
    FORCE_MAP,
    LOCAL_FORCES,
    PARAMETERS,
    RECORDED_TRIAL,
    TRIGGER,
    Topic,
)

_ESTIMATES = (ESTIMATED_WRENCH, LOCAL_FORCES, FORCE_MAP)
_WATCHED = (TRIGGER, ESTIMATED_WRENCH, *MEASURED)


class StatusListener:
    """Feeds a graph's status with serialised messages; `pause` names a replay's service, if any.

    The program that draws the status line takes what has come, twenty times a second.
    """

    def __init__(self, status: GraphStatus, namespace: str = "/", pause: str = "") -> None:
        self._status = status
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C is the verb's
        node = Node(
            "_status_listener",
            namespace=namespace,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self._readers = {topic: Reader(topic) for topic in _WATCHED}
        self._topics = (*_WATCHED, PARAMETERS, RECORDED_TRIAL)
        self._inbox = Inbox(node, {topic: subscriber_qos(topic) for topic in self._topics})
        self._pause = node.create_client(SetBool, pause) if pause else None

    def take(self) -> None:
        """Take what has come since the last call."""
        for topic in self._topics:
            for data in self._inbox.take(topic):
                self.add(topic, data)

    def add(self, topic: Topic, data: bytes) -> None:
        """Feed a serialised message of a topic."""
        if topic is PARAMETERS:
            self._status.variant = deserialize_message(data, ContactModel).variant
        elif topic is RECORDED_TRIAL:
            self._status.trial = deserialize_message(data, String).data
        else:
            self._status.add(topic, *self._readers[topic].read(data))

    def set_paused(self, paused: bool) -> bool:
        """Pause the replay or let it go on; returns whether it was there to be asked."""
        if self._pause is None or not self._pause.service_is_ready():
            return False
        self._pause.call_async(SetBool.Request(data=paused))
        return True

    def close(self) -> None:
        """Leave the graph."""
        self._inbox.close()
        rclpy.try_shutdown()
