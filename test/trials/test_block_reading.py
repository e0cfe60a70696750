"""Reading in blocks gives what the library decodes, message by message."""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
from support.bags import (
    copy_configuration,
    copying,
    pose_vector,
    wrench_vector,
    written_by_rosbags,
)
from support.messages import Maker, encode, numbers_in, numbers_of, strings_of

from socket_testbed.errors import TrialError
from socket_testbed.samples import Status
from socket_testbed.trials import bag, messages
from socket_testbed.trials.bag import BagReader, RawMessage
from socket_testbed.trials.layout import Layout, decode, stamp_of
from socket_testbed.trials.topics import (
    CAPACITANCE,
    PYLON_POSE,
    SOCKET_POSE,
    TRIGGER,
    WRENCH,
)
from socket_testbed.trials.trial import Trial


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks end often, and layouts are forgotten."""
    monkeypatch.setattr(bag, "_BLOCK", 7)
    monkeypatch.setattr(messages, "_LAYOUTS", 3)


def plainly_read(path: Path) -> dict[str, dict[int, Any]]:
    """By topic, or cluster, and stamp: the numbers of the last message, as a user would read it."""
    found: dict[str, dict[int, Any]] = defaultdict(dict)
    with BagReader(path) as bag:
        for raw in bag.messages():
            message = decode(raw.data, raw.type)
            stamp = stamp_of(message)
            if raw.topic.endswith(CAPACITANCE.name):
                for cluster in message.clusters:
                    found[cluster.name][stamp] = [*cluster.capacitance, *cluster.status]
            elif raw.topic.endswith(WRENCH.name):
                found[WRENCH.name][stamp] = wrench_vector(message.wrench)
            elif raw.topic.endswith("/pose"):
                found[raw.topic.removeprefix("/")][stamp] = pose_vector(message.pose)
            elif raw.topic.endswith(TRIGGER.name):
                found[TRIGGER.name][stamp] = ()
    return found


def mixed(messages: Iterable[RawMessage]) -> Iterator[RawMessage]:
    """Other byte orders and frames; clusters lost and doubled; stamps lost and doubled."""
    for number, raw in enumerate(messages):
        rng = np.random.default_rng(number)
        decoded = decode(raw.data, raw.type)
        if raw.topic.endswith(CAPACITANCE.name):
            order = rng.integers(4, size=rng.integers(1, 12))
            decoded.clusters = [decoded.clusters[i] for i in order]
        if rng.random() < 0.3:
            decoded.header.frame_id += "_" * int(rng.integers(3))
        if rng.random() < 0.9:
            yield replace(raw, data=encode(decoded, raw.type, little=rng.random() < 0.5))
        if rng.random() < 0.1:
            if raw.topic.endswith(WRENCH.name):
                decoded.wrench.force.x += 1.0
            data = encode(decoded, raw.type, little=True)
            yield replace(raw, time=raw.time + 1, data=data)


def test_measurements_of_mixed_messages(hold: Path, tmp_path: Path) -> None:
    with BagReader(hold) as bag:
        path = written_by_rosbags(mixed(bag.messages()), tmp_path / "mixed", StoragePlugin.SQLITE3)
    copy_configuration(hold, path)
    expected, found = plainly_read(path), Trial(path).measurements()
    tables = {WRENCH.name: found.wrench, SOCKET_POSE.name: found.socket}
    tables |= {PYLON_POSE.name: found.pylon, TRIGGER.name: np.empty((len(found.stamps), 0))}
    readings = np.concatenate([found.capacitance, found.status], axis=2)
    tables |= dict(zip(found.clusters, readings.swapaxes(0, 1), strict=True))
    assert expected.keys() == tables.keys()
    assert found.stamps.tolist() == sorted({stamp for own in expected.values() for stamp in own})
    for name, table in tables.items():
        missing = [np.nan] * table.shape[1]
        if name in found.clusters:
            missing[4:] = [Status.MISSING] * 4
        rows = [expected[name].get(stamp, missing) for stamp in found.stamps.tolist()]
        np.testing.assert_array_equal(table, np.array(rows).reshape(table.shape), name)


def test_a_message_that_cannot_be_decoded_is_named(hold: Path, tmp_path: Path) -> None:
    with copying(hold, tmp_path / "torn") as (old, new):
        for number, raw in enumerate(old.messages()):
            new.write(raw.topic, raw.time, raw.data[:-9] if number == 500 else raw.data)
    with pytest.raises(TrialError, match=r"torn: a message on \S+ cannot be decoded"):
        Trial(tmp_path / "torn").samples()


def test_any_other_byte_is_read_as_the_library_reads_it() -> None:
    """A message with one byte changed fits if only numbers or what aligns them changed."""
    kind = CAPACITANCE.type
    message = Maker(7, 0).message(kind)
    raw = encode(message, kind, True)
    layout, before = Layout(raw, kind), strings_of(decode(raw, kind), kind)
    records, fits = layout.records([raw[:-1], raw, b"", encode(message, kind, False), raw])
    assert fits.tolist() == [False, True, False, False, True] and len(records) == 2
    outcomes = set()
    for at in range(len(raw)):
        changed = bytearray(raw)
        changed[at] ^= 0xA5
        record = layout.record(changed)
        try:
            message = decode(bytes(changed), kind)
            same = strings_of(message, kind) == before
        except Exception:
            same = False
        assert (record is not None) == same
        if record is not None:
            np.testing.assert_array_equal(numbers_in(record), numbers_of(message, kind))
        outcomes.add(same)
    assert outcomes == {True, False}
