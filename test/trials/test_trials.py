"""A recorded trial as a whole: its samples, and errors that name what is wrong with it."""

import shutil
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from backports import zstd
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from support.bags import copy_configuration, move_to_namespace, rewrite, written_by_rosbags
from support.wording import refused

from socket_testbed.errors import TrialError
from socket_testbed.simulation.trial import read_true_forces, read_truth
from socket_testbed.trials import bag
from socket_testbed.trials.bag import BagReader, BagWriter
from socket_testbed.trials.layout import stamp_of
from socket_testbed.trials.topics import REQUIRED, match_topics
from socket_testbed.trials.trial import Trial, recorded_namespace


def test_samples_agree_with_the_truth_within_the_sensors_errors(hold: Path) -> None:
    samples, truth = Trial(hold).samples(), read_truth(hold)
    rows = samples.complete
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
        names, raws = match_topics(old.counts, "hold"), list(old.messages())
    for topic in REQUIRED:
        for declared, says in ((False, f"has no topic '{topic.name}'"), (True, "holds no message")):
            target = tmp_path / f"{topic.name.replace('/', '_')}_{declared}"
            with BagWriter(target) as new:
                for kept, name in names.items():
                    if kept is not topic or declared:
                        new.add_topic(name, kept)
                for raw in raws[:700]:
                    if raw.topic != names[topic]:
                        new.write(raw.topic, raw.time, raw.data)
            with refused(TrialError, target.name, says):
                Trial(target).samples()


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


def test_topics_are_found_in_the_namespace_they_were_recorded_in(
    hold: Path, tmp_path: Path
) -> None:
    target = move_to_namespace(hold, tmp_path / "lab", "/lab")
    assert recorded_namespace(Trial(target)) == "/lab"
    assert recorded_namespace(Trial(hold)) == "/"
    np.testing.assert_array_equal(Trial(target).samples().values, Trial(hold).samples().values)
    with refused(TrialError, "two topics"):
        match_topics(["/a/trigger", "/b/trigger"], "bag")


def test_stamps_that_jump_back_are_counted_and_named(hold: Path, tmp_path: Path) -> None:
    notes: list[str] = []
    Trial(hold, notify=notes.append).samples()
    assert notes == []
    seen: list[int] = []

    def change(topic: str, message: Any) -> Any:
        if topic == "/load_cell/wrench":
            seen.append(stamp_of(message))
            if len(seen) > 40:
                message.header.stamp.sec -= 5
        return message

    target = rewrite(hold, tmp_path / "back", change)
    Trial(target, notify=notes.append).samples()
    back, doubled = notes
    assert back.startswith("the stamps of load_cell/wrench jump back, once (from 9.75 s to 5.0")
    assert doubled.startswith("the stamps of load_cell/wrench are doubled, 20 times (at 5.00 s")
    assert "20 earlier values are replaced" in doubled and "and 17 more" in doubled


# --- bags that were compressed by file, message or chunk


def written(source: Path, path: Path, *how: StoragePlugin | CompressionMode) -> Path:
    """A copy of a trial by another program, compressed."""
    with BagReader(source) as plain:
        written_by_rosbags(plain.messages(), path, *how)
    return copy_configuration(source, path)


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


def test_a_compressed_file_that_was_cut_or_is_too_large_names_itself(
    hold: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(hold, tmp_path / "packed", StoragePlugin.MCAP, CompressionMode.FILE)
    file = path / "packed.mcap.zstd"
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 3])
    with refused(TrialError, f"{file}: is truncated"):
        Trial(path).samples()
    file.write_bytes(zstd.compress(bytes(2**25)))
    monkeypatch.setattr(bag, "_LARGEST", 2**20)
    with refused(TrialError, str(file), "too large once unpacked"):
        Trial(path).samples()
