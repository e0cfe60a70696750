"""Message types without ROS, from the same definitions that ROS builds."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from socket_testbed.files import packaged

_PACKAGE = "socket_testbed_msgs"


@cache
def typestore() -> Typestore:
    """The types of ROS 2 Jazzy and of this testbed."""
    store = get_typestore(Stores.ROS2_JAZZY)
    folder = packaged("msg", "Trigger.msg").parent
    types: dict[str, Any] = {}
    for path in sorted(Path(folder).glob("*.msg")):
        text = path.read_text(encoding="utf-8")
        types |= get_types_from_msg(text, f"{_PACKAGE}/msg/{path.stem}")
    store.register(types)
    return store


def message_class(name: str) -> Any:
    """The class of a message type, given as `package/msg/Type`."""
    return typestore().types[name]


def decode(raw: bytes | memoryview, message_type: str) -> Any:
    """A message from its serialised bytes."""
    return typestore().deserialize_cdr(raw, message_type)


def encode(message: Any, message_type: str) -> bytes:
    """The serialised bytes of a message."""
    return bytes(typestore().serialize_cdr(message, message_type))


def stamp_of(message: Any) -> int:
    """Stamp of a message's header since the epoch [ns]."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
