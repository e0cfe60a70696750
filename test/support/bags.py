"""Trials made from another, message by message."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from socket_testbed.trials.bag import BagReader, BagWriter
from socket_testbed.trials.layout import decode, encode, message_class
from socket_testbed.trials.topics import EVENT, match_topics
from socket_testbed.trials.trial import CONFIGURATION_FILES, Trial


def rewrite(source: Path, target: Path, change: Callable[[str, Any], Any]) -> Path:
    """Copy a trial message by message; `change` maps (topic, message) to a message or None."""
    with BagReader(source) as old, BagWriter(target) as new:
        for topic, name in match_topics(old.counts, str(source)).items():
            new.add_topic(name, topic)
        for raw in old.messages():
            message = change(raw.topic, decode(raw.data, raw.type))
            if message is not None:
                new.write(raw.topic, raw.time, encode(message, raw.type))
    return copy_configuration(source, target)


def move_to_namespace(source: Path, target: Path, namespace: str) -> Path:
    """Copy a trial as if its graph had run in a namespace."""
    with BagReader(source) as old, BagWriter(target) as new:
        for topic, name in match_topics(old.counts, str(source)).items():
            new.add_topic(namespace + name, topic)
        for raw in old.messages():
            new.write(namespace + raw.topic, raw.time, raw.data)
    return copy_configuration(source, target)


def copy_configuration(source: Path, target: Path) -> Path:
    """Copy what a trial was recorded with."""
    for name in CONFIGURATION_FILES:
        shutil.copy(source / name, target)
    return target


def add_events(
    source: Path, target: Path, events: list[tuple[str, float, float]], namespace: str = ""
) -> Trial:
    """A copy of a trial with events: labels, stamps and times of recording [s] since its start.

    A stamp that is not finite is left out.
    """
    kind, stamp_of = message_class(EVENT.type), message_class("builtin_interfaces/msg/Time")
    header_of = message_class("std_msgs/msg/Header")
    first = int(Trial(source).samples().stamps[0])
    with BagReader(source) as old, BagWriter(target) as new:
        for topic, name in match_topics(old.counts, str(source)).items():
            new.add_topic(namespace + name, topic)
        new.add_topic(f"{namespace}/event", EVENT)
        for raw in old.messages():
            new.write(namespace + raw.topic, raw.time, raw.data)
        for label, stamp, time in events:
            nanoseconds = first + round(stamp * 1e9) if np.isfinite(stamp) else 0
            header = header_of(stamp_of(*divmod(nanoseconds, 10**9)), "load_cell")
            message = kind(header, label)
            new.write(f"{namespace}/event", first + round(time * 1e9), encode(message, EVENT.type))
    return Trial(copy_configuration(source, target))


def wrench_vector(wrench: Any) -> tuple[float, ...]:
    """[M; F] of a Wrench message [N m, N]."""
    torque, force = wrench.torque, wrench.force
    return (torque.x, torque.y, torque.z, force.x, force.y, force.z)


def pose_vector(pose: Any) -> tuple[float, ...]:
    """Position [m] and quaternion (x, y, z, w) of a Pose message."""
    p, q = pose.position, pose.orientation
    return (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
