"""A recorded trial: what its messages say, its samples, errors that name what is wrong with it."""

import re
import shutil
from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from backports import zstd
from numpy.lib.recfunctions import structured_to_unstructured
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from support import bags
from support.messages import Maker, encode, numbers_of, strings_of
from support.wording import refused

import socket_testbed as st
from socket_testbed.errors import TrialError
from socket_testbed.samples import Status
from socket_testbed.simulation.trial import read_true_forces, read_truth
from socket_testbed.trials import bag, messages, topics
from socket_testbed.trials.bag import BagReader, BagWriter, RawMessage
from socket_testbed.trials.cdr import Layout, decode, stamp_of
from socket_testbed.trials.trial import Trial, recorded_namespace


def test_samples_agree_with_the_truth_within_the_sensors_errors(hold: Path) -> None:
    samples, truth = Trial(hold).samples(), read_truth(hold)
    rows = samples.has_pose_and_wrench
    assert rows.mean() > 0.95
    assert np.abs(samples.wrench[rows] - truth.wrench[rows]).max() < 5.0
    shift = samples.position[rows] - truth.position[rows]
    assert np.abs(shift - shift.mean(axis=0)).max() < 2e-3
    geometry = Trial(hold).geometry
    forces = read_true_forces(hold, samples.stamps, geometry.names)
    assert forces is not None and forces.shape == (len(samples), len(geometry.names), 3)
    for column, cluster in enumerate(samples.clusters):
        tile = geometry.clusters[cluster]
        actual = forces[:, tile] @ geometry.rotations[tile]
        assert np.abs(samples.local_forces[:, column] - actual).max() < 8.0
    # True forces are those of the simulated tiles alone.
    assert read_true_forces(hold, samples.stamps, [*geometry.names[:-1], "another"]) is None


def test_a_topic_that_is_missing_or_empty_is_named(hold: Path, tmp_path: Path) -> None:
    with BagReader(hold) as old:
        names, raws = topics.match_topics(old.types, "hold"), list(old.messages())
    for topic in topics.REQUIRED:
        for declared, says in ((False, f"has no topic '{topic.name}'"), (True, "holds no message")):
            target = tmp_path / f"{topic.name.replace('/', '_')}_{declared}"
            with BagWriter(target) as new:
                for kept, name in names.items():
                    if kept is not topic or declared:
                        new.add_topic(name, kept)
                for raw in raws[:700]:
                    if raw.topic != names[topic]:
                        new.write(raw.topic, raw.time, raw.data)
            if topic not in topics.POSES.values():
                with refused(TrialError, target.name, says):
                    Trial(target).samples()
                continue
            # Without motion capture there is a map, but no motion.
            trial = Trial(target, hold / "socket.yaml", hold / "calibration.yaml")
            assert not trial.samples().has_pose.any()
            assert any("no limb positions" in note for note in trial.notes)
            assert st.pressure(trial, "all").regions["peak pressure [kPa]"].notna().all()


def test_metadata_that_is_missing_or_promises_other_counts(hold: Path, tmp_path: Path) -> None:
    target = Path(shutil.copytree(hold, tmp_path / "hold"))
    file, recording = target / "metadata.yaml", target / "hold.mcap"
    text, data = file.read_text(), recording.read_bytes()
    file.unlink()
    assert len(Trial(target).samples()) == 240
    lz4 = text.replace("compression_format: ''", "compression_format: lz4")
    for wrong, says in (
        (text.replace("message_count: 240", "message_count: 241"), "lists 241 messages"),
        (text.replace("message_count: 240", "message_count: 239"), "the storage file holds 240"),
        (text.replace("name: ", "nam: "), "is not rosbag2 metadata"),
        (lz4, "is compressed with 'lz4'"),
    ):
        file.write_text(wrong)
        with refused(TrialError, str(target), says, "ros2 bag "):
            Trial(target).samples()
    # A recording that was cut short may hold fewer.
    file.write_text(text.replace("message_count: 240", "message_count: 241"))
    recording.write_bytes(data[:-1])
    with BagReader(target) as bag:
        assert "cut short" in bag.notes[0] and "copy the trial again" in bag.notes[1]


def test_topics_are_found_in_the_namespace_of_the_recording(hold: Path, tmp_path: Path) -> None:
    lab = bags.add_events(hold, tmp_path / "lab", [], "/lab")
    assert (recorded_namespace(lab), recorded_namespace(Trial(hold))) == ("/lab", "/")
    np.testing.assert_array_equal(lab.samples().values, Trial(hold).samples().values)
    with refused(TrialError, "two topics"):
        topics.match_topics(dict.fromkeys(["/a/trigger", "/b/trigger"], topics.TRIGGER.type), "bag")
    types = {"/camera/trigger": "std_msgs/msg/Bool", "/lab/trigger": topics.TRIGGER.type}
    types |= {f"{arm}/diagnostics": topics.DIAGNOSTICS.type for arm in ("", "/arm")}
    for listed in (types, dict(reversed(types.items()))):  # another program's counts for nothing
        assert topics.match_topics(listed, "bag")[topics.TRIGGER] == "/lab/trigger"


def test_stamps_that_jump_back_are_counted_and_named(hold: Path, tmp_path: Path) -> None:
    notes, seen = [], []
    Trial(hold, notify=notes.append).samples()
    assert notes == []

    def change(topic: str, message: Any) -> Any:
        if topic == "/load_cell/wrench":
            seen.append(stamp_of(message))
            if len(seen) > 40:
                message.header.stamp.sec -= 5
            if len(seen) == 3:
                message.header.stamp.sec = 0  # a clock that was not set
        return message

    target = bags.rewrite(hold, tmp_path / "back", change)
    Trial(target, notify=notes.append).samples()
    stray, back, doubled = notes
    assert stray.endswith("days from the others are left out: load_cell/wrench (1)")
    assert back.startswith("the stamps of load_cell/wrench jump back, once (from 9.75 s to 5.0")
    assert doubled.startswith("the stamps of load_cell/wrench are doubled, 20 times (at 5.00 s")
    assert "20 earlier values are replaced" in doubled and "and 17 more" in doubled


# --- bags that were compressed by file, message or chunk


def written(source: Path, path: Path, *how: StoragePlugin | CompressionMode) -> Path:
    with BagReader(source) as plain:
        bags.written_by_rosbags(plain.messages(), path, *how)
    return bags.copy_configuration(source, path)


def test_a_compressed_trial_gives_the_samples_of_the_plain_one(hold: Path, tmp_path: Path) -> None:
    expected = Trial(hold).samples().values
    for storage, mode in product(StoragePlugin, CompressionMode):
        if (storage, mode) == (StoragePlugin.SQLITE3, CompressionMode.STORAGE):
            continue  # its storage has no chunks
        path = written(hold, tmp_path / f"{storage.name}_{mode.name}", storage, mode)
        np.testing.assert_array_equal(Trial(path).samples().values, expected)
        (path / "metadata.yaml").unlink()
        np.testing.assert_array_equal(Trial(path).samples().values, expected)
    journal = tmp_path / "SQLITE3_NONE" / "SQLITE3_NONE.db3-wal"
    journal.write_bytes(b"some messages")
    with BagReader(journal.parent) as reader:
        assert any(f"{journal.name}, which may hold" in note for note in reader.notes)


def test_a_compressed_file_that_was_cut_or_is_too_large_names_itself(hold, tmp_path, monkeypatch):
    path = written(hold, tmp_path / "packed", StoragePlugin.MCAP, CompressionMode.FILE)
    file = path / "packed.mcap.zstd"
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 3])
    with refused(TrialError, f"{file}: is truncated"):
        Trial(path).samples()
    file.write_bytes(zstd.compress(bytes(2**25)))
    monkeypatch.setattr(bag, "_MAX_UNPACKED", 2**20)
    with refused(TrialError, str(file), "too large once unpacked"):
        Trial(path).samples()


# --- messages in blocks are read as the library decodes them, one by one


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks end often, and layouts are forgotten."""
    monkeypatch.setattr(bag, "_BLOCK_SIZE", 7)
    monkeypatch.setattr(messages, "_MAX_LAYOUTS", 3)


def plainly_read(path: Path) -> dict[str, dict[int, Any]]:
    """By topic, or cluster, and stamp: the numbers of the last message, as a user would read it.

    Two clusters of one name in a message are missing: nobody knows which is which.
    """
    found: dict[str, dict[int, Any]] = defaultdict(dict)
    with BagReader(path) as bag:
        for raw in bag.messages():
            message = decode(raw.data, raw.type)
            stamp = stamp_of(message)
            if raw.topic.endswith(topics.CAPACITANCE.name):
                names = [cluster.name for cluster in message.clusters]
                for cluster in message.clusters:
                    reading = [*cluster.capacitance, *cluster.status]
                    if names.count(cluster.name) > 1:
                        reading = [*[np.nan] * 4, *[Status.MISSING] * 4]
                    found[cluster.name][stamp] = reading
            elif raw.topic.endswith(topics.WRENCH.name):
                found[topics.WRENCH.name][stamp] = bags.wrench_vector(message.wrench)
            elif raw.topic.endswith("/pose"):
                found[raw.topic.removeprefix("/")][stamp] = numbers_of(message, raw.type)[2:]
            elif raw.topic.endswith(topics.TRIGGER.name):
                found[topics.TRIGGER.name][stamp] = ()
    return found


def mixed(messages: Iterable[RawMessage]) -> Iterator[RawMessage]:
    """Other byte orders and frames; clusters lost and doubled; stamps lost and doubled."""
    for number, raw in enumerate(messages):
        rng = np.random.default_rng(number)
        decoded = decode(raw.data, raw.type)
        if raw.topic.endswith(topics.CAPACITANCE.name):
            order = rng.integers(4, size=rng.integers(1, 12))
            decoded.clusters = [decoded.clusters[i] for i in order]
        if rng.random() < 0.3:
            decoded.header.frame_id += "_" * int(rng.integers(3))
        if rng.random() < 0.9:
            yield raw._replace(data=encode(decoded, raw.type, little=rng.random() < 0.5))
        if rng.random() < 0.1:
            if raw.topic.endswith(topics.WRENCH.name):
                decoded.wrench.force.x += 1.0
            data = encode(decoded, raw.type, little=True)
            yield raw._replace(time=raw.time + 1, data=data)


def test_measurements_of_mixed_messages(hold: Path, tmp_path: Path) -> None:
    with BagReader(hold) as bag:
        messages = mixed(bag.messages())
        path = bags.written_by_rosbags(messages, tmp_path / "mixed", StoragePlugin.SQLITE3)
    bags.copy_configuration(hold, path)
    expected, found = plainly_read(path), Trial(path).measurements()
    tables = {topics.WRENCH.name: found.wrench, topics.SOCKET_POSE.name: found.socket}
    tables[topics.PYLON_POSE.name] = found.pylon
    tables[topics.TRIGGER.name] = np.empty((len(found.stamps), 0))
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
    with bags.copying(hold, tmp_path / "torn") as (old, new):
        for number, raw in enumerate(old.messages()):
            new.write(raw.topic, raw.time, raw.data[:-9] if number == 500 else raw.data)
    trial = st.open_trial(tmp_path / "torn", notify=None)
    assert len(trial.samples()) == len(Trial(hold).samples())
    (note,) = trial.notes
    assert re.search(r"^1 times .*torn: a message on \S+ cannot be decoded.*: left out$", note)


def test_any_other_byte_is_read_as_the_library_reads_it() -> None:
    """A message with one byte changed fits if only numbers or what aligns them changed."""
    kind = topics.CAPACITANCE.type
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
            numbers = structured_to_unstructured(record)
            np.testing.assert_array_equal(numbers, numbers_of(message, kind))
        outcomes.add(same)
    assert outcomes == {True, False}
