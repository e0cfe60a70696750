"""Trials made from another, message by message."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from socket_testbed.trials.bag import BagReader, BagWriter, decode, encode
from socket_testbed.trials.topics import match_topics
from socket_testbed.trials.trial import CONFIGURATION_FILES


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
