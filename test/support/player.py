"""A foreign bag as its topics arrive live: in real time, with stamps of the present."""

import struct
import threading
import time
from pathlib import Path
from typing import Self

from rclpy.qos import QoSProfile, qos_profile_sensor_data

from socket_testbed.nodes.foreign_topics import type_class
from socket_testbed.trials.bag import BagReader, RawMessage
from support.graph import Probe

STAMPED = ("geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/PoseStamped")


def _quality(kind: str) -> QoSProfile:
    return qos_profile_sensor_data if "Wrench" in kind else QoSProfile(depth=100)


class Player:
    """Publishes the messages of a bag in real time, with stamps of the present.

    Args:
        probe: Publishes them: wrenches as sensors, with best effort; all others reliably.
        bag: The bag.

    Attributes:
        stopped: Topics that are not published any more.
    """

    def __init__(self, probe: Probe, bag: Path) -> None:
        self.stopped: set[str] = set()
        with BagReader(bag) as reader:
            self._messages = [*reader.messages(reader.types)]
        self._publishers = {
            name: probe.node.create_publisher(type_class(kind, name), name, _quality(kind))
            for name, kind in {message.topic: message.type for message in self._messages}.items()
        }
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        """Publish all, again and again."""
        while not self._ended.is_set():
            shift = time.time_ns() - self._messages[0].time
            for message in self._messages:
                ahead = 1e-9 * (message.time + shift - time.time_ns())
                if self._ended.wait(ahead) if ahead > 0.0 else self._ended.is_set():
                    return
                if message.topic not in self.stopped:
                    self._publishers[message.topic].publish(_moved(message, shift))


def _moved(message: RawMessage, shift: int) -> bytes:
    """The content of a message, whose stamp is later [ns] if it has one."""
    data = bytearray(message.data)
    if message.type in STAMPED:
        seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
        stamp = seconds * 1_000_000_000 + nanoseconds + shift
        struct.pack_into("<iI", data, 4, *divmod(stamp, 1_000_000_000))
    return bytes(data)
