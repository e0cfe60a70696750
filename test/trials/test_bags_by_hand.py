"""Bags of a few messages at known times: durations, parts, counts, and what is wrong with them."""

import io
import zlib
from collections.abc import Sequence
from pathlib import Path

import mcap.writer
import numpy as np
import pytest
import rosbags.rosbag2
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from support import scene
from support.wording import refused

from socket_testbed.documents import load_yaml
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.trials import bag, bag_parts
from socket_testbed.trials.bag import BagReader, BagWriter
from socket_testbed.trials.trial import Trial, read_configuration, store_configuration
from socket_testbed.wire import cdr, messages, topics

START = scene.START
SECOND = 10**9  # [ns]
POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:1234\nsize 12345\n"


def write(path: Path, *times: float) -> Path:
    """A bag with triggers at some times [s]; their stamps are those of their recording."""
    pack = messages.trigger_packer()
    with BagWriter(path) as new:
        new.add_topic("/lab/trigger", topics.TRIGGER)
        new.add_topic("/lab/event", topics.EVENT)
        for number, second in enumerate(times):
            time = START + round(second * 1e9)
            new.write("/lab/trigger", time, pack(time, number))
    return path


def test_a_bag_s_duration_is_from_first_to_last(tmp_path: Path) -> None:
    with BagReader(write(tmp_path / "a", 0.5, 1.0, 3.25)) as found:
        assert found.duration == pytest.approx(2.75, abs=1e-12)
        assert found.counts == {"/lab/trigger": 3, "/lab/event": 0}
        assert found.types["/lab/event"] == "socket_testbed_msgs/msg/Event"
        assert [raw.time - START for raw in found.messages()] == [5 * 10**8, SECOND, 3.25 * SECOND]
        assert list(found.messages(["/lab/event"])) == [] and found.notes == []
    with BagReader(write(tmp_path / "b")) as found:
        assert found.duration == 0.0


def test_other_programs_read_a_bag(tmp_path: Path) -> None:
    """What metadata.yaml states, and the checksums of the chunks and of the index."""
    folder = write(tmp_path / "a", 0.5, 1.0, 3.25)
    assert {file.name for file in folder.iterdir()} == {"a.mcap", "metadata.yaml"}
    with rosbags.rosbag2.Reader(folder) as found:
        assert (found.message_count, found.start_time - START) == (3, SECOND // 2)
        assert found.duration == 2.75 * SECOND + 1
        assert [(each.topic, each.msgcount) for each in found.connections] == [
            ("/lab/trigger", 3),
            ("/lab/event", 0),
        ]
        (qos,) = found.connections[0].ext.offered_qos_profiles
        assert (qos.depth, qos.reliability.name, qos.durability.name) == (
            *(100, "RELIABLE", "VOLATILE"),
        )
    content = (folder / "a.mcap").read_bytes()
    records = StreamReader(io.BytesIO(content), emit_chunks=True).records
    chunks = [each for each in records if isinstance(each, Chunk)]
    assert len(chunks) == 2 and all(chunk.uncompressed_crc for chunk in chunks)
    reader = make_reader(io.BytesIO(content), validate_crcs=True)
    summary = reader.get_summary()
    assert summary is not None and len(summary.chunk_indexes) == 2
    index_checksum = int.from_bytes(content[-12:-8], "little")
    start_of_index = int.from_bytes(content[-28:-20], "little")
    assert index_checksum == zlib.crc32(content[start_of_index:-12])


def test_a_bag_never_writes_into_a_folder_that_exists(tmp_path: Path) -> None:
    with refused(ConfigurationError, "a exists already: another process", "name another folder"):
        write(write(tmp_path / "a", 0.0))
    with BagReader(tmp_path / "a") as found:
        assert found.counts["/lab/trigger"] == 1


@pytest.mark.parametrize(
    "times",
    [(0.3, 0.1, 0.2), (0.0, 5.0, 1.0, 6.0, 2.0)],
    ids=["within a chunk", "over chunks that overlap"],
)
def test_messages_are_in_the_order_of_their_times(times: Sequence[float], tmp_path: Path) -> None:
    with BagReader(write(tmp_path / "a", *times)) as found:
        read = [raw.time - START for raw in found.messages()]
    assert read == [round(second * 1e9) for second in sorted(times)]


def test_parts_of_bags_follow_their_numbers(tmp_path: Path) -> None:
    """Without metadata, 2 comes before 10."""
    folder = tmp_path / "a"
    folder.mkdir()
    for part, second in ((10, 2.0), (2, 1.0), (0, 0.0)):
        source = write(tmp_path / f"part_{part}", second)
        (source / f"part_{part}.mcap").rename(folder / f"a_{part}.mcap")
    with BagReader(folder) as found:
        assert [raw.time - START for raw in found.messages()] == [0, SECOND, 2 * SECOND]
        assert found.duration == pytest.approx(2.0)
        assert found.notes == [
            "no metadata.yaml: the storage files were read as they are",
            "a_1.mcap is not there, as the numbers of the other parts show; missing: 0.00 s to"
            " 1.00 s of the trial (copy all of the folder)",
            "a_3.mcap, a_4.mcap, a_5.mcap and 4 more are not there, as the numbers of the other"
            " parts show; missing: 1.00 s to 2.00 s of the trial (copy all of the folder)",
        ]


def test_blocks_are_by_topic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bag, "_BLOCK_SIZE", 2)
    with BagReader(write(tmp_path / "a", 0.0, 1.0, 2.0)) as found:
        blocks = [(name, len(own)) for name, own in found.blocks(["/lab/trigger"])]
    assert blocks == [("/lab/trigger", 2), ("/lab/trigger", 1)]


def test_two_publishers_of_a_topic_share_blocks(tmp_path: Path) -> None:
    """Each has a channel of its own in the file, number 7 and 3; they take turns."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = mcap.writer.Writer(file)
        writer.start()
        kind = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channels = [writer.register_channel("/said", "cdr", kind) for _ in range(8)]
        for number in range(4):
            channel = channels[(7, 3)[number % 2]]
            writer.add_message(channel, START + number, b"%d" % number, START + number)
        writer.finish()
    with BagReader(path) as found:
        assert [*found.blocks(["/said"])] == [("/said", [b"0", b"1", b"2", b"3"])]
        assert [raw.data for raw in found.messages()] == [b"0", b"1", b"2", b"3"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda text: text.replace("message_count: 3", "message_count: 4"),
            "metadata.yaml lists 4 messages on /lab/trigger, the files hold 3: copy the trial",
        ),
        (
            lambda text: text.replace("message_count: 3", "message_count: 2"),
            "metadata.yaml lists 2 messages on /lab/trigger, the files hold 3: copy the trial",
        ),
        (
            lambda text: text.replace("a.mcap", "b.mcap"),
            "metadata.yaml does not name a.mcap, read in place of b.mcap; all messages that it",
        ),
        (
            lambda text: "nothing: 1",
            "metadata.yaml is not rosbag2 metadata; the storage files were read as they are: write"
            " it again with 'ros2 bag reindex'",
        ),
        (
            lambda text: text[:35],
            "metadata.yaml is not rosbag2 metadata; the storage files were read as they are: write"
            " it again with 'ros2 bag reindex'",
        ),
        (
            lambda text: POINTER,
            "metadata.yaml is a Git LFS pointer, not the file itself; the storage files were"
            " read as they are: fetch the content with 'git lfs pull'",
        ),
    ],
    ids=["more", "fewer", "another file", "no metadata", "cut", "pointer"],
)
def test_metadata_that_disagree_are_a_note(change, words: str, tmp_path: Path) -> None:
    """All of the file is read, whatever metadata.yaml says."""
    file = write(tmp_path / "a", 0.0, 1.0, 2.0) / "metadata.yaml"
    file.write_text(change(file.read_text()))
    with BagReader(tmp_path / "a") as found:
        assert [raw.time - START for raw in found.messages()] == [0, SECOND, 2 * SECOND]
        (note,) = found.notes
    assert note.startswith(words)


def test_a_bag_offers_topics_as_published(tmp_path: Path) -> None:
    """ROS replays them with the quality of service that subscribers expect."""
    with BagWriter(tmp_path / "a") as new:
        new.add_topic("/parameters", topics.PARAMETERS)
        new.add_topic("/wrench", topics.WRENCH)
    content = load_yaml(tmp_path / "a" / "metadata.yaml")["rosbag2_bagfile_information"]
    assert content["version"] == 9 and content["storage_identifier"] == "mcap"
    found = {}
    for entry in content["topics_with_message_count"]:
        (offered,) = entry["topic_metadata"]["offered_qos_profiles"]
        found[entry["topic_metadata"]["name"]] = offered
    latched, usual = found["/parameters"], found["/wrench"]
    assert (latched["depth"], latched["durability"]) == (1, "transient_local")
    assert (usual["depth"], usual["durability"]) == (100, "volatile")
    for own in (latched, usual):
        assert (own["history"], own["reliability"]) == ("keep_last", "reliable")
        assert own["liveliness"] == "automatic" and not own["avoid_ros_namespace_conventions"]
        assert own["deadline"] == own["lifespan"] == own["liveliness_lease_duration"]
        assert own["deadline"] == {"sec": 2_147_483_647, "nsec": 4_294_967_295}


def test_what_is_no_bag_is_refused(tmp_path: Path) -> None:
    with refused(TrialError, "none: no such trial: check the path"), BagReader(tmp_path / "none"):
        pass
    empty = "holds no .mcap or .db3 file: give a trial's folder"
    with refused(TrialError, empty), BagReader(tmp_path):
        pass
    with refused(TrialError, "/dev/null: is neither a folder nor a file"):
        BagReader(Path("/dev/null")).__enter__()


def test_trials_are_found_below_a_folder(tmp_path: Path) -> None:
    """Not hidden ones; one that holds nothing is left out with a note."""
    for name in ("s02/walk", "s01/hold", ".hidden/x"):
        write(tmp_path / name, 0.0)
    (tmp_path / "s03").mkdir()
    (tmp_path / "s03" / "s03.mcap").touch()
    (tmp_path / "s01" / "again").symlink_to(tmp_path)
    notes: list[str] = []
    found = bag.find_trials(tmp_path, notes.append)
    assert found == {name: tmp_path / name for name in ("s01/hold", "s02/walk")}
    assert notes == ["s03 is left out: it holds nothing, its recorder was killed while it started"]
    assert bag.is_bag(tmp_path / "s01" / "hold") and not bag.is_bag(tmp_path)
    assert bag.holds_nothing(tmp_path / "s03")
    assert not bag.holds_nothing(tmp_path / "s01" / "hold")
    assert bag.find_trials(tmp_path / "s01" / "hold") == {}
    assert bag.find_trials(tmp_path / "none") == {}


@pytest.mark.parametrize(
    ("name", "is_storage"),
    [
        *((f"a{suffix}", True) for suffix in (".mcap", ".db3", ".MCAP", ".mcap.zstd", ".db3.zst")),
        *((name, False) for name in ("a", "._a.mcap", "a.mcap.part", "a.zst")),
    ],
)
def test_storage_is_known_by_its_suffix(name: str, is_storage: bool) -> None:
    assert bag_parts.is_storage(Path(name)) is is_storage


# --- a trial's files


def test_a_file_of_a_trial_needs_its_configuration(tmp_path: Path) -> None:
    """Beside a storage file lies its folder's, which is not taken by itself."""
    folder = write(tmp_path / "a", 0.0)
    own = folder / "a.mcap"
    with refused(
        TrialError,
        f"a.mcap: no socket.yaml is stored in this trial: give the trial's folder, {folder}, or the"
        " missing files with --geometry and --calibration",
    ):
        _ = Trial(own).geometry
    with refused(
        TrialError,
        "a: no calibration.yaml is stored in this trial: give the missing files with --geometry",
    ):
        _ = Trial(folder).calibration


def test_a_configuration_is_stored_as_it_was(tmp_path: Path) -> None:
    found = read_configuration()
    assert [*found] == ["socket.yaml", "calibration.yaml", "testbed.yaml"]
    store_configuration(tmp_path, found)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == found


# --- layouts of messages


def test_times_are_in_nanoseconds() -> None:
    message = cdr.make_message(topics.TRIGGER.type, header={"stamp": {"sec": 3, "nanosec": 7}})
    assert cdr.stamp_of(message) == 3_000_000_007
    raws = [cdr.encode(message, topics.TRIGGER.type)] * 2
    records, fits = cdr.Layout(raws[0], topics.TRIGGER.type).records(raws)
    assert cdr.stamps_of(records).tolist() == [3_000_000_007] * 2 and fits.tolist() == [True, True]


def test_a_message_of_another_length_has_another_layout() -> None:
    def wrench(frame: str) -> bytes:
        content = {"header": {"frame_id": frame}}
        return cdr.encode(cdr.make_message(topics.WRENCH.type, **content), topics.WRENCH.type)

    layout = cdr.Layout(wrench("abcd"), topics.WRENCH.type)
    assert layout.record(wrench("abcd")) is not None
    assert layout.record(wrench("abce")) is None and layout.record(wrench("abcdefghijkl")) is None
    raws = [wrench(name) for name in ("abcd", "abce", "abcd", "abcdefghijkl")]
    records, fits = layout.records(raws)
    assert len(records) == 2 and fits.tolist() == [True, False, True, False]


def test_a_blank_message_is_zero_and_fills_in() -> None:
    content, numbers = cdr.blank(topics.LOAD_CELL_RAW.type)
    numbers["ratios"] = np.arange(6.0)
    numbers["status"] = 2
    message = cdr.decode(content, topics.LOAD_CELL_RAW.type)
    assert message.ratios.tolist() == [0, 1, 2, 3, 4, 5] and message.status == 2
    assert message.tare.force.x == 0.0 and cdr.nanoseconds(message.tared) == 0


@pytest.mark.parametrize("cut", [1, 4, 9])
def test_a_short_message_is_refused(cut: int) -> None:
    raw = cdr.encode(cdr.make_message(topics.TRIGGER.type), topics.TRIGGER.type)
    with pytest.raises(ValueError, match="too short"):
        cdr.Layout(raw[:-cut], topics.TRIGGER.type)
    with pytest.raises(ValueError, match=r"not a .*Trigger: the message has another length"):
        cdr.Layout(raw + bytes(4), topics.TRIGGER.type)
    cdr.Layout(raw + bytes(3), topics.TRIGGER.type)
