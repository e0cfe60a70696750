"""A recorded trial: what its messages say, its samples, errors that name what is wrong with it."""

import re
import shutil
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Self

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
from socket_testbed.samples import Samples, Status
from socket_testbed.trials import bag
from socket_testbed.trials import trial as trials
from socket_testbed.trials.bag import BagReader, BagWriter, RawMessage
from socket_testbed.trials.synchronise import Measurements, read_measurements
from socket_testbed.trials.trial import Trial, recorded_namespace
from socket_testbed.trials.truth import read_true_forces, read_truth
from socket_testbed.wire import messages, topics
from socket_testbed.wire.cdr import Layout, decode, stamp_of


@pytest.fixture(scope="module", autouse=True)
def small_blocks() -> Iterator[None]:
    """Blocks end often, and layouts are forgotten."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bag, "_BLOCK_SIZE", 7)
        patch.setattr(messages, "_MAX_LAYOUTS", 3)
        yield


@pytest.fixture(scope="module")
def samples(hold: Path) -> Samples:
    """The samples of the hold; nobody changes them."""
    return Trial(hold).samples()


CLUSTERS = ["brim_lateral", "mid_anterior", "posterior_distal", "distal"]


def test_most_samples_have_pose_and_wrench(samples: Samples) -> None:
    assert samples.has_pose_and_wrench.mean() > 0.95


def test_a_trial_is_read_once(hold: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Its check, its samples and its export need one reading; kept open, it is opened once."""
    opened: list[Path] = []

    class Counted(BagReader):
        def __enter__(self) -> Self:
            opened.append(self.path)
            return super().__enter__()

    monkeypatch.setattr(trials, "BagReader", Counted)
    trial = Trial(hold)
    assert trial.problems() == ()
    st.export(trial, tmp_path / "hold.csv")
    assert opened == [hold]
    with trial.kept_open() as bag, trial.open() as again:
        assert again is bag and len(opened) == 2
    with trial.open() as other:
        assert other is not bag and len(opened) == 3


def test_wrenches_agree_with_the_truth(hold: Path, samples: Samples) -> None:
    """Within the load cell's errors."""
    rows = samples.has_pose_and_wrench
    assert np.abs(samples.wrench[rows] - read_truth(hold).wrench[rows]).max() < 5.0


def test_positions_agree_with_the_truth(hold: Path, samples: Samples) -> None:
    """Within the errors of the motion capture, but for a constant shift."""
    rows = samples.has_pose_and_wrench
    shift = samples.position[rows] - read_truth(hold).position[rows]
    assert np.abs(shift - shift.mean(axis=0)).max() < 2e-3


@pytest.mark.parametrize("cluster", CLUSTERS)
def test_local_forces_agree_with_the_truth(cluster: str, hold: Path, samples: Samples) -> None:
    """Within the errors of the clusters."""
    geometry = Trial(hold).geometry
    forces = read_true_forces(hold, samples.stamps, geometry.names)
    assert forces is not None and forces.shape == (len(samples), len(geometry.names), 3)
    tile = geometry.clusters[cluster]
    actual = forces[:, tile] @ geometry.rotations[tile]
    found = samples.local_forces[:, samples.clusters.index(cluster)]
    assert np.abs(found - actual).max() < 8.0


def test_other_tiles_have_no_true_forces(hold: Path, samples: Samples) -> None:
    names = [*Trial(hold).geometry.names[:-1], "another"]
    assert read_true_forces(hold, samples.stamps, names) is None


# --- topics that are missing or empty


@dataclass
class Recording:
    """What a bag holds: the name of each topic, and the first messages."""

    names: dict[topics.Topic, str]
    raws: list[RawMessage]

    def without(self, topic: topics.Topic, path: Path, declared: bool) -> Path:
        """The recording without a topic's messages, or without the topic."""
        with BagWriter(path) as new:
            for kept, name in self.names.items():
                if kept is not topic or declared:
                    new.add_topic(name, kept)
            for raw in self.raws:
                if raw.topic != self.names[topic]:
                    new.write(raw.topic, raw.time, raw.data)
        return path


@pytest.fixture(scope="module")
def recording(hold: Path) -> Recording:
    with BagReader(hold) as old:
        return Recording(topics.match_topics(old.types, "hold"), list(old.messages())[:700])


POSES = [topic for topic in topics.REQUIRED if topic in topics.POSES.values()]
OTHERS = [topic for topic in topics.REQUIRED if topic not in POSES]


@pytest.mark.parametrize("declared", [False, True], ids=["missing", "empty"])
@pytest.mark.parametrize("topic", OTHERS, ids=lambda topic: topic.name)
def test_a_topic_without_messages_is_named(
    topic: topics.Topic, declared: bool, recording: Recording, tmp_path: Path
) -> None:
    target = recording.without(topic, tmp_path / "cut", declared)
    says = "holds no message" if declared else f"has no topic '{topic.name}'"
    with refused(TrialError, target.name, says):
        Trial(target).samples()


@pytest.mark.parametrize("declared", [False, True], ids=["missing", "empty"])
@pytest.mark.parametrize("topic", POSES, ids=lambda topic: topic.name)
def test_pressure_needs_no_motion_capture(
    topic: topics.Topic, declared: bool, recording: Recording, hold: Path, tmp_path: Path
) -> None:
    """Without motion capture there is a map, but no motion."""
    target = recording.without(topic, tmp_path / "cut", declared)
    trial = Trial(target, hold / "socket.yaml", hold / "calibration.yaml")
    assert not trial.samples().has_pose.any()
    assert any("no limb positions" in note for note in trial.notes)
    assert st.pressure(trial, "all").regions["peak pressure [kPa]"].notna().all()


# --- metadata


@pytest.fixture
def copied(hold: Path, tmp_path: Path) -> Path:
    """A copy of the hold, to change."""
    return Path(shutil.copytree(hold, tmp_path / "hold"))


def change_metadata(trial: Path, text: str, other: str) -> None:
    file = trial / "metadata.yaml"
    before = file.read_text()
    assert text in before
    file.write_text(before.replace(text, other))


def test_a_trial_needs_no_bag_metadata(copied: Path) -> None:
    (copied / "metadata.yaml").unlink()
    assert len(Trial(copied).samples()) == 240


@pytest.mark.parametrize(
    ("text", "other", "says"),
    [
        ("message_count: 240", "message_count: 241", "lists 241 messages"),
        ("message_count: 240", "message_count: 239", "the files hold 240"),
        ("name: ", "nam: ", "is not rosbag2 metadata"),
    ],
    ids=["too few messages", "too many messages", "other format"],
)
def test_wrong_bag_metadata_are_a_note(text: str, other: str, says: str, copied: Path) -> None:
    change_metadata(copied, text, other)
    notes: list[str] = []
    assert len(Trial(copied, notify=notes.append).samples()) == 240
    (note,) = notes
    assert says in note and "ros2 bag " in note


def test_an_unknown_compression_is_refused(copied: Path) -> None:
    change_metadata(copied, "compression_format: ''", "compression_format: lz4")
    with refused(TrialError, str(copied), "is compressed with 'lz4'", "ros2 bag "):
        Trial(copied).samples()


def test_a_recording_cut_short_may_hold_fewer(copied: Path) -> None:
    change_metadata(copied, "message_count: 240", "message_count: 241")
    recording = copied / "hold.mcap"
    recording.write_bytes(recording.read_bytes()[:-1])
    with BagReader(copied) as bag:
        assert "cut short" in bag.notes[0] and "copy the trial again" in bag.notes[1]


# --- namespaces


def test_a_namespace_changes_no_sample(hold: Path, samples: Samples, tmp_path: Path) -> None:
    lab = bags.add_events(hold, tmp_path / "lab", [], "/lab")
    assert (recorded_namespace(lab), recorded_namespace(Trial(hold))) == ("/lab", "/")
    np.testing.assert_array_equal(lab.samples().values, samples.values)


def test_two_topics_of_one_name_are_refused() -> None:
    with refused(TrialError, "two topics"):
        topics.match_topics(dict.fromkeys(["/a/trigger", "/b/trigger"], topics.TRIGGER.type), "bag")


TYPES = {
    "/camera/trigger": "std_msgs/msg/Bool",
    "/lab/trigger": topics.TRIGGER.type,
    "/diagnostics": topics.DIAGNOSTICS.type,
    "/arm/diagnostics": topics.DIAGNOSTICS.type,
}


@pytest.mark.parametrize(
    "listed", [TYPES, dict(reversed(TYPES.items()))], ids=["forwards", "backwards"]
)
def test_topics_of_other_programs_are_passed_over(listed: dict[str, str]) -> None:
    assert topics.match_topics(listed, "bag")[topics.TRIGGER] == "/lab/trigger"


# --- stamps


def test_sound_stamps_need_no_note(hold: Path) -> None:
    notes: list[str] = []
    Trial(hold, notify=notes.append).samples()
    assert notes == []


def test_stamps_that_jump_back_are_counted(hold: Path, tmp_path: Path) -> None:
    notes: list[str] = []
    seen: list[int] = []

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


PACKED = [
    (storage, mode)
    for storage, mode in product(StoragePlugin, CompressionMode)
    # The storage of SQLite has no chunks.
    if (storage, mode) != (StoragePlugin.SQLITE3, CompressionMode.STORAGE)
]


@pytest.mark.parametrize(
    ("storage", "mode"), PACKED, ids=[f"{storage.name}-{mode.name}" for storage, mode in PACKED]
)
def test_compression_changes_no_sample(
    storage: StoragePlugin, mode: CompressionMode, hold: Path, samples: Samples, tmp_path: Path
) -> None:
    path = written(hold, tmp_path / "packed", storage, mode)
    np.testing.assert_array_equal(Trial(path).samples().values, samples.values)
    (path / "metadata.yaml").unlink()
    np.testing.assert_array_equal(Trial(path).samples().values, samples.values)


def test_a_journal_is_a_note(hold: Path, tmp_path: Path) -> None:
    path = written(hold, tmp_path / "packed", StoragePlugin.SQLITE3, CompressionMode.NONE)
    (path / "metadata.yaml").unlink()
    journal = path / "packed.db3-wal"
    journal.write_bytes(b"some messages")
    with BagReader(path) as reader:
        assert any(f"{journal.name}, which may hold" in note for note in reader.notes)


@pytest.fixture
def packed(hold: Path, tmp_path: Path) -> Path:
    """The compressed file of a trial."""
    path = written(hold, tmp_path / "packed", StoragePlugin.MCAP, CompressionMode.FILE)
    return path / "packed.mcap.zstd"


def test_a_compressed_file_that_was_cut_is_named(packed: Path) -> None:
    whole = packed.read_bytes()
    packed.write_bytes(whole[: len(whole) // 3])
    with refused(TrialError, f"{packed}: is truncated"):
        Trial(packed.parent).samples()


def test_a_file_too_large_once_unpacked_is_named(
    packed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    packed.write_bytes(zstd.compress(bytes(2**25)))
    monkeypatch.setattr(bag, "_MAX_UNPACKED", 2**20)
    with refused(TrialError, str(packed), "too large once unpacked"):
        Trial(packed.parent).samples()


# --- messages in blocks are read as the library decodes them, one by one


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


@pytest.fixture(scope="module")
def mixed_trial(hold: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mixed") / "mixed"
    with BagReader(hold) as bag:
        bags.written_by_rosbags(mixed(bag.messages()), path, StoragePlugin.SQLITE3)
    return bags.copy_configuration(hold, path)


@pytest.fixture(scope="module")
def expected(mixed_trial: Path) -> dict[str, dict[int, Any]]:
    """The numbers of mixed messages as the library reads them."""
    return plainly_read(mixed_trial)


@pytest.fixture(scope="module")
def found(mixed_trial: Path) -> Measurements:
    """The numbers of mixed messages as the product reads them."""
    return Trial(mixed_trial).measurements()


def tables_of(found: Measurements) -> dict[str, np.ndarray]:
    """Rows by stamp, for each topic and cluster."""
    readings = np.concatenate([found.capacitance, found.status], axis=2)
    return {
        topics.WRENCH.name: found.wrench,
        topics.SOCKET_POSE.name: found.socket,
        topics.PYLON_POSE.name: found.pylon,
        topics.TRIGGER.name: np.empty((len(found.stamps), 0)),
        **dict(zip(found.clusters, readings.swapaxes(0, 1), strict=True)),
    }


SOURCES = [topics.WRENCH, topics.SOCKET_POSE, topics.PYLON_POSE, topics.TRIGGER]


def test_mixed_messages_have_the_library_s_stamps(expected: dict, found: Measurements) -> None:
    assert expected.keys() == tables_of(found).keys() == {*CLUSTERS, *(t.name for t in SOURCES)}
    assert found.stamps.tolist() == sorted({stamp for own in expected.values() for stamp in own})


@pytest.mark.parametrize("name", [*(topic.name for topic in SOURCES), *CLUSTERS])
def test_mixed_messages_have_the_library_s_numbers(
    name: str, expected: dict, found: Measurements
) -> None:
    table = tables_of(found)[name]
    missing = [np.nan] * table.shape[1]
    if name in found.clusters:
        missing[4:] = [Status.MISSING] * 4
    rows = [expected[name].get(stamp, missing) for stamp in found.stamps.tolist()]
    np.testing.assert_array_equal(table, np.array(rows).reshape(table.shape))


def test_a_message_that_cannot_be_decoded_is_named(
    hold: Path, samples: Samples, tmp_path: Path
) -> None:
    with bags.copying(hold, tmp_path / "torn") as (old, new):
        for number, raw in enumerate(old.messages()):
            new.write(raw.topic, raw.time, raw.data[:-9] if number == 500 else raw.data)
    trial = st.open_trial(tmp_path / "torn", notify=None)
    assert len(trial.samples()) == len(samples)
    (note,) = trial.notes
    assert re.search(r"^1 times .*torn: a message on \S+ cannot be decoded.*: left out$", note)


def test_an_event_that_cannot_be_decoded_is_left_out(hold: Path, tmp_path: Path) -> None:
    """The other events keep their labels and times."""
    marks = [(label, when, when) for label, when in (("push", 10.0), ("twist", 20.0))]
    bags.add_events(hold, tmp_path / "whole", marks)
    with bags.copying(tmp_path / "whole", tmp_path / "torn") as (old, new):
        new.add_topic("/event", topics.EVENT)
        for raw in old.messages():
            is_push = raw.topic == "/event" and b"push" in raw.data
            new.write(raw.topic, raw.time, raw.data[:-3] if is_push else raw.data)
    trial = st.open_trial(tmp_path / "torn", notify=None)
    recorded = [(each.label, each.time) for each in trial.events() if each.source == "recorded"]
    assert recorded == [("twist", pytest.approx(20.0))]
    (note,) = trial.notes
    assert re.search(r"torn: a message on event cannot be decoded.*: left out$", note)


def test_a_torn_trigger_beside_an_event_without_a_stamp_loses_no_trial(
    hold: Path, tmp_path: Path
) -> None:
    """The event's time is found between the other triggers."""
    bags.add_events(hold, tmp_path / "whole", [("push", float("nan"), 10.0)])
    with bags.copying(tmp_path / "whole", tmp_path / "torn") as (old, new):
        new.add_topic("/event", topics.EVENT)
        torn = 0
        for raw in old.messages():
            is_trigger = raw.topic == "/trigger"
            torn += is_trigger
            new.write(
                raw.topic, raw.time, raw.data[:-9] if is_trigger and torn == 100 else raw.data
            )
    trial = st.open_trial(tmp_path / "torn", notify=None)
    assert len(trial.samples()) == len(Trial(hold).samples())
    (found,) = [each for each in trial.events() if each.source == "recorded"]
    assert (found.label, found.time) == ("push", pytest.approx(10.0, abs=0.2))


def test_a_trial_is_opened_once(hold: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For its samples, findings, noise, plateaus and events together."""
    opened: list[Path] = []
    enter = BagReader.__enter__

    def counted(bag: BagReader) -> BagReader:
        opened.append(bag.path)
        return enter(bag)

    monkeypatch.setattr(BagReader, "__enter__", counted)
    trial = Trial(hold)
    trial.checked()
    trial.select("hold")
    trial.events()
    assert opened == [hold]


def test_a_layout_fits_messages_of_its_form() -> None:
    kind = topics.CAPACITANCE.type
    message = Maker(7, 0).message(kind)
    raw = encode(message, kind, True)
    other = encode(message, kind, False)
    records, fits = Layout(raw, kind).records([raw[:-1], raw, b"", other, raw])
    assert fits.tolist() == [False, True, False, False, True] and len(records) == 2


def test_changed_bytes_are_read_as_by_the_library() -> None:
    """A message with one byte changed fits if only numbers or what aligns them changed."""
    kind = topics.CAPACITANCE.type
    message = Maker(7, 0).message(kind)
    raw = encode(message, kind, True)
    layout, before = Layout(raw, kind), strings_of(decode(raw, kind), kind)
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


def test_a_stray_cluster_is_left_out(hold: Path, tmp_path: Path) -> None:
    """Messages of another program name 'heel', which the trial's calibration does not know.

    The first message is one of them, on which a replay decides.
    """
    count = 0

    def stray(topic: str, message: Any) -> Any:
        nonlocal count
        if topic.endswith("clusters/capacitance"):
            count += 1
            if count in (1, 7):
                message.clusters[0].name = "heel"
        return message

    trial = Trial(bags.rewrite(hold, tmp_path / "stray", stray))
    samples, sound = trial.samples(), Trial(hold).samples()
    assert sorted(samples.clusters) == sorted(sound.clusters)
    assert trial.require_usable() == sound.clusters
    order = [samples.clusters.index(name) for name in sound.clusters]
    status, forces = samples.status[:, order], samples.local_forces[:, order]
    assert (status[:, 0] != sound.status[:, 0]).nonzero()[0].tolist() == [0, 6]
    np.testing.assert_array_equal(forces[:, 1:], sound.local_forces[:, 1:])
    words = "2 of 240 samples name a cluster 'heel', which the calibration or the socket does not"
    assert [note for note in trial.notes if note.startswith(words)]


def test_a_cluster_renamed_throughout_is_left_out(hold: Path, tmp_path: Path) -> None:
    """All messages call the first cluster 'heel': the others are read as before."""

    def rename(topic: str, message: Any) -> Any:
        if topic.endswith("clusters/capacitance"):
            message.clusters[0].name = "heel"
        return message

    trial, sound = Trial(bags.rewrite(hold, tmp_path / "renamed", rename)), Trial(hold).samples()
    samples = trial.samples()
    assert samples.clusters == trial.require_usable() == sound.clusters[1:]
    np.testing.assert_array_equal(samples.local_forces, sound.local_forces[:, 1:])
    words = "240 of 240 samples name a cluster 'heel', which the calibration or the socket does not"
    assert [note for note in trial.notes if note.startswith(words)]


def test_a_body_of_many_markers_is_cut(hold: Path, tmp_path: Path) -> None:
    """Another program's rigid body has 40 markers."""

    def crowded(topic: str, message: Any) -> Any:
        if topic.endswith("mocap/markers"):
            message.bodies[0].markers = message.bodies[0].markers[:1] * 40
        return message

    path = bags.rewrite(hold, tmp_path / "crowded", crowded)
    with Trial(path).open() as opened:
        read = read_measurements(opened, print, [topics.MARKERS])
    assert {len(markers) for markers in read.markers.values()} == {240}
