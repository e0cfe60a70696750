"""Trials made from another, message by message."""

import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from socket_testbed.files import CONFIGURATION_FILES
from socket_testbed.trials.bag import BagReader, BagWriter, RawMessage
from socket_testbed.trials.trial import Trial
from socket_testbed.wire.cdr import decode, encode, make_message, typestore
from socket_testbed.wire.topics import EVENT, match_topics


@contextmanager
def copying(source: Path, target: Path, namespace="") -> Iterator[tuple[BagReader, BagWriter]]:
    """A trial and a new one with its topics and configuration; its messages are the caller's."""
    with BagReader(source) as old, BagWriter(target) as new:
        for topic, name in match_topics(old.types, str(source)).items():
            new.add_topic(namespace + name, topic)
        yield old, new
    copy_configuration(source, target)


def rewrite(source: Path, target: Path, change: Callable[[str, Any], Any]) -> Path:
    """Copy a trial message by message; `change` maps (topic, message) to a message or None."""
    with copying(source, target) as (old, new):
        for raw in old.messages():
            message = change(raw.topic, decode(raw.data, raw.type))
            if message is not None:
                new.write(raw.topic, raw.time, encode(message, raw.type))
    return target


def written_by_rosbags(
    messages: Iterable[RawMessage],
    target: Path,
    storage: StoragePlugin = StoragePlugin.MCAP,
    mode: CompressionMode = CompressionMode.NONE,
) -> Path:
    writer = Writer(target, version=9, storage_plugin=storage)
    if mode is not CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    connections, types = {}, typestore()
    with writer:
        for raw in messages:
            if raw.topic not in connections:
                connections[raw.topic] = writer.add_connection(raw.topic, raw.type, typestore=types)
            writer.write(connections[raw.topic], raw.time, raw.data)
    return target


def copy_configuration(source: Path, target: Path) -> Path:
    for name in CONFIGURATION_FILES:
        shutil.copy(source / name, target)
    return target


def add_events(
    source: Path, target: Path, events: list[tuple[str, float, float]], namespace: str = ""
) -> Trial:
    """A copy in a namespace with events: labels, stamps (NaN: none) and times [s] of the trial."""
    first = int(Trial(source).samples().stamps[0])
    with copying(source, target, namespace) as (old, new):
        new.add_topic(f"{namespace}/event", EVENT)
        for raw in old.messages():
            new.write(namespace + raw.topic, raw.time, raw.data)
        for label, stamp, time in events:
            nanoseconds = first + round(stamp * 1e9) if np.isfinite(stamp) else 0
            at = dict(zip(("sec", "nanosec"), divmod(nanoseconds, 10**9), strict=True))
            message = make_message(EVENT.type, header={"stamp": at}, label=label)
            new.write(f"{namespace}/event", first + round(time * 1e9), encode(message, EVENT.type))
    return Trial(target)


def edited(
    source: Path, target: Path, change: Callable[[Any], object], name: str = "socket.yaml"
) -> Path:
    """A copy of a trial; `change` is given what one of its YAML files holds."""
    copy = Path(shutil.copytree(source, target))
    document = yaml.safe_load((copy / name).read_text())
    change(document)
    (copy / name).write_text(yaml.safe_dump(document, sort_keys=False))
    return copy


def of_another_socket(source: Path, target: Path) -> Path:
    """A copy of a trial in whose socket a tile is elsewhere."""

    def move(document: Any) -> None:
        document["tiles"]["distal"]["anchor"][2] += 0.01

    return edited(source, target, move)


def wrench_vector(wrench: Any) -> tuple[float, ...]:
    """[M; F] of a Wrench message [N m, N]."""
    torque, force = wrench.torque, wrench.force
    return (torque.x, torque.y, torque.z, force.x, force.y, force.z)
