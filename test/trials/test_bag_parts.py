"""Bags in parts of known times, of which some were renamed, packed, emptied, cut or lost.

Four parts hold two triggers each, at 0 and 1 s, 2 and 3 s, 4 and 5 s, 6 and 7 s.
"""

import bz2
import gzip
import lzma
import shutil
import sqlite3
import tarfile
import zipfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from backports import zstd
from rosbags.rosbag2 import StoragePlugin
from support import scene
from support.bags import written_by_rosbags
from support.wording import refused

from socket_testbed.documents import dump_yaml, load_yaml
from socket_testbed.errors import TrialError
from socket_testbed.trials.bag import BagReader, BagWriter, RawMessage, find_trials
from socket_testbed.trials.bag_parts import is_bag, missing_numbers, span_in_words
from socket_testbed.wire import messages, topics

START = scene.START
SECOND = 10**9  # [ns]
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:1234\nsize 12345\n"
COPY = "copy all of the folder, or make metadata.yaml again with 'ros2 bag reindex'"
HELD = "metadata.yaml lists 8 messages, {} of them can be read: copy the trial again if it is whole"


def trigger(second: float, number: int) -> RawMessage:
    time = START + round(second * 1e9)
    data = messages.trigger_packer()(time, number)
    return RawMessage("/trigger", topics.TRIGGER.type, time, data)


def write_mcap(path: Path, *times: float) -> bytes:
    """An MCAP file with a chunk for each of its triggers, at some times [s]."""
    with BagWriter(path) as new:
        new.add_topic("/trigger", topics.TRIGGER)
        for number, second in enumerate(times):
            raw = trigger(second, number)
            new.write(raw.topic, raw.time, raw.data)
            new.flush()
    return (path / f"{path.name}.mcap").read_bytes()


def write_sqlite(path: Path, *times: float) -> bytes:
    raws = [trigger(second, number) for number, second in enumerate(times)]
    written_by_rosbags(raws, path, StoragePlugin.SQLITE3)
    return (path / f"{path.name}.db3").read_bytes()


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return make_bag(tmp_path / "bag", write_mcap, ".mcap")


def make_bag(bag: Path, write: Callable[..., bytes], suffix: str) -> Path:
    """A bag of four parts with metadata as recorders write them since version 5."""
    bag.mkdir()
    files = []
    for part in range(4):
        name = f"bag_{part}{suffix}"
        piece = bag.parent / f"piece_{part}"
        (bag / name).write_bytes(write(piece, 2.0 * part, 2.0 * part + 1.0))
        start = {"nanoseconds_since_epoch": START + 2 * part * SECOND}
        duration = {"nanoseconds": SECOND}
        files.append(
            {"path": name, "starting_time": start, "duration": duration, "message_count": 2}
        )
    content = load_yaml(piece / "metadata.yaml")
    information = content["rosbag2_bagfile_information"]
    information["relative_file_paths"] = [file["path"] for file in files]
    information["files"] = files
    information["message_count"] = 8
    information["topics_with_message_count"][0]["message_count"] = 8
    (bag / "metadata.yaml").write_text(dump_yaml(content))
    return bag


def change(bag: Path, **fields: Any) -> None:
    content = load_yaml(bag / "metadata.yaml")
    content["rosbag2_bagfile_information"] |= fields
    (bag / "metadata.yaml").write_text(dump_yaml(content))


def read(path: Path) -> tuple[list[float], list[str]]:
    """Times of the messages since the first one ever written [s], and the notes."""
    with BagReader(path) as found:
        times = [(raw.time - START) * 1e-9 for raw in found.messages()]
        assert sum(found.counts.values()) == len(times)
        return times, found.notes


ALL = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]


def test_a_whole_bag_needs_no_note(bag: Path) -> None:
    assert read(bag) == (ALL, [])


# --- renamed, unpacked, packed


def test_a_renamed_part_is_read(bag: Path) -> None:
    (bag / "bag_1.mcap").rename(bag / "a new name.mcap")
    note = (
        "metadata.yaml does not name a new name.mcap, read in place of bag_1.mcap; all messages"
        " that it lists were read"
    )
    assert read(bag) == (ALL, [note])


def test_renamed_parts_are_read_by_their_times(bag: Path) -> None:
    """Their new names are in another order."""
    for part in range(4):
        (bag / f"bag_{part}.mcap").rename(bag / f"walk {9 - part}.mcap")
    times, (note,) = read(bag)
    assert times == ALL
    assert note == (
        "metadata.yaml does not name walk 9.mcap, walk 8.mcap, walk 7.mcap and 1 more, read in"
        " place of bag_0.mcap, bag_1.mcap, bag_2.mcap and 1 more; all messages that it lists were"
        " read"
    )


def test_of_renamed_parts_the_missing_one_is_named(bag: Path) -> None:
    for part in range(4):
        (bag / f"bag_{part}.mcap").rename(bag / f"walk_{part}.mcap")
    (bag / "walk_2.mcap").unlink()
    times, notes = read(bag)
    assert times == [0.0, 1.0, 2.0, 3.0, 6.0, 7.0]
    assert notes[0] == (
        "metadata.yaml does not name walk_0.mcap, walk_1.mcap, walk_3.mcap, read in place of"
        " bag_0.mcap, bag_1.mcap, bag_3.mcap"
    )
    assert notes[1] == (
        "bag_2.mcap is named in metadata.yaml but is not there; missing: 4.00 s to 5.00 s of the"
        f" trial, 2 messages ({COPY})"
    )
    assert notes[2].startswith(HELD.format(6))


def test_a_public_bag_is_read_renamed(shared_data: Path, tmp_path: Path) -> None:
    """Its ten messages on two topics; metadata.yaml of version 4."""
    copy = Path(shutil.copytree(shared_data / "rosbag2" / "talker", tmp_path / "talker"))
    (copy / "talker.mcap").rename(copy / "hello.mcap")
    with BagReader(copy) as found:
        assert found.counts == {"/topic": 10, "/rosout": 10, "/parameter_events": 0}
        assert found.duration == pytest.approx(4.531096768, abs=1e-9)
        assert found.notes == [
            "metadata.yaml does not name hello.mcap, read in place of talker.mcap; all messages"
            " that it lists were read"
        ]


@pytest.mark.parametrize("suffix", [".zstd", ".zst"])
@pytest.mark.parametrize("storage", [".mcap", ".db3"])
def test_compressed_parts_are_read(suffix: str, storage: str, tmp_path: Path) -> None:
    """As they were listed, and packed or unpacked by hand, with and without metadata."""
    write = write_mcap if storage == ".mcap" else write_sqlite
    bag = make_bag(tmp_path / "bag", write, storage)
    for part in (0, 1, 2):
        file = bag / f"bag_{part}{storage}"
        file.with_name(file.name + suffix).write_bytes(zstd.compress(file.read_bytes()))
        file.unlink()
    listed = [f"bag_{part}{storage}{suffix}" for part in range(4)]
    for names in ([f"bag_{part}{storage}" for part in range(4)], listed):
        change(bag, relative_file_paths=names)
        times, notes = read(bag)
        assert times == ALL and all("has no checksums" in n or "have no" in n for n in notes)
    (bag / "metadata.yaml").unlink()
    assert read(bag)[0] == ALL


def test_a_file_is_what_it_holds(bag: Path) -> None:
    """Neither another suffix nor an unusual path changes that."""
    database = write_sqlite(bag.parent / "piece", 2.0, 3.0)
    (bag / "bag_1.mcap").write_bytes(database)
    (bag / "bag_2.mcap").rename(bag / "50% #2?.db3")
    assert read(bag)[0] == ALL
    odd = bag.parent / "100%25 #1?"
    shutil.copytree(bag, odd)
    assert read(odd)[0] == ALL


@pytest.mark.parametrize("name", ["bag_1.bin", "bag_1.mcap.bak", "bag_1.sqlite", "bag_1"])
def test_a_part_of_another_suffix_is_read(bag: Path, name: str) -> None:
    (bag / "bag_1.mcap").rename(bag / name)
    note = (
        f"metadata.yaml does not name {name}, read in place of bag_1.mcap; all messages that it"
        " lists were read"
    )
    assert read(bag) == (ALL, [note])


# --- missing, empty, truncated, pointers


def spoil_by_cut(file: Path) -> None:
    """The first chunk is whole, the second one torn."""
    content = file.read_bytes()
    file.write_bytes(content[: content.index((START + 5 * SECOND).to_bytes(8, "little"))])


UNREADABLE: dict[str, tuple[Callable[[Path], Any], str]] = {
    "missing": (Path.unlink, "is named in metadata.yaml but is not there"),
    "empty": (lambda file: file.write_bytes(b""), "holds nothing: its recorder ended before any"),
    "zeros": (lambda file: file.write_bytes(bytes(900)), "is truncated (it has no end"),
    "pointer": (
        lambda file: file.write_bytes(POINTER),
        "is a Git LFS pointer, not the file itself",
    ),
    "web page": (lambda file: file.write_bytes(b"<!DOCTYPE html>"), "is a web page or XML, not a"),
    "no bag": (lambda file: file.write_bytes(b"hello"), "cannot be read (it is not an MCAP file)"),
    "another bag": (lambda file: file.write_bytes(b"#ROSBAG V2.0\n"), "is a bag of ROS 1"),
}


@pytest.mark.parametrize("kind", UNREADABLE)
@pytest.mark.parametrize(
    ("part", "span", "left"),
    [
        (0, "2.00 s before the first message", ALL[2:]),
        (2, "4.00 s to 5.00 s of the trial", [*ALL[:4], *ALL[6:]]),
        (3, "6.00 s to 7.00 s of the trial", ALL[:6]),
    ],
    ids=["first", "middle", "last"],
)
def test_one_unreadable_part_costs_itself_alone(
    kind: str, part: int, span: str, left: list[float], bag: Path
) -> None:
    """Its note names it, the seconds of the trial and the number of messages."""
    spoil, fact = UNREADABLE[kind]
    spoil(bag / f"bag_{part}.mcap")
    times, (note, counts) = read(bag)
    assert times == left
    assert note.startswith(f"bag_{part}.mcap {fact}")
    assert f"; missing: {span}, 2 messages (" in note
    assert counts.startswith(HELD.format(6))


def test_without_times_neighbours_limit_a_part(bag: Path) -> None:
    """The metadata of older recorders list no times of the files."""
    change(bag, files=[], version=4)
    (bag / "bag_1.mcap").unlink()
    (bag / "bag_2.mcap").unlink()
    times, notes = read(bag)
    assert times == [0.0, 1.0, 6.0, 7.0]
    assert notes[0] == (
        "bag_1.mcap, bag_2.mcap are named in metadata.yaml but are not there; missing: 1.00 s to"
        f" 6.00 s of the trial ({COPY})"
    )


def test_a_part_that_was_cut_keeps_its_chunks(bag: Path) -> None:
    spoil_by_cut(bag / "bag_2.mcap")
    times, notes = read(bag)
    assert times == [*ALL[:5], *ALL[6:]]
    assert notes[0].startswith("the recording bag_2.mcap was cut short (no end): 1 messages up to ")
    assert "(4.0 s) were saved" in notes[0]
    assert notes[1] == (
        "bag_2.mcap was cut short; missing: 4.00 s to 5.00 s of the trial, 1 messages (copy the"
        " trial again if it is whole elsewhere)"
    )
    assert notes[2].startswith(HELD.format(7))


def test_a_damaged_chunk_is_named_by_the_trial_s_seconds(bag: Path) -> None:
    file = bag / "bag_2.mcap"
    content = file.read_bytes()
    place = content.index(trigger(5.0, 1).data)
    file.write_bytes(content[:place] + b"?" + content[place + 1 :])
    _, notes = read(bag)
    assert "bag_2.mcap is damaged: 1 of its 2 chunks cannot be read" in notes[0]
    assert "from 4.00 s to the end" in notes[0]


def test_a_truncated_compressed_part_gives_its_blocks(tmp_path: Path) -> None:
    """Its chunks are larger than a block of the compression, 128 KiB."""
    folder = tmp_path / "a"
    with BagWriter(folder) as new:
        new.add_topic("/trigger", topics.TRIGGER)
        for second in range(8):
            new.write(
                "/trigger", START + second * SECOND, np.random.default_rng(second).bytes(150_000)
            )
    plain = folder / "a.mcap"
    packed = zstd.compress(plain.read_bytes())
    plain.unlink()
    (folder / "a.mcap.zst").write_bytes(packed[: len(packed) // 2])
    times, notes = read(folder)
    assert times == ALL[: len(times)] and 0 < len(times) < 8
    assert notes[0].startswith("the recording a.mcap.zst was cut short")


# --- in archives, or known by their content alone


def packed_by(suffix: str, file: Path) -> Path:
    """An archive beside a file, which goes."""
    archive = file.with_name(file.name + suffix)
    match suffix:
        case ".gz":
            archive.write_bytes(gzip.compress(file.read_bytes()))
        case ".xz":
            archive.write_bytes(lzma.compress(file.read_bytes()))
        case ".bz2":
            archive.write_bytes(bz2.compress(file.read_bytes()))
        case ".zip":
            with zipfile.ZipFile(archive, "w") as new:
                new.write(file, file.name)
        case ".tar":
            with tarfile.open(archive, "w") as new_tar:
                new_tar.add(file, file.name)
        case ".tar.zst":
            plain = packed_by(".tar", file)
            archive.write_bytes(zstd.compress(plain.read_bytes()))
            plain.unlink()
    file.unlink(missing_ok=True)
    return archive


ARCHIVES = {
    ".gz": "is compressed with gzip: unpack it with 'gunzip'",
    ".xz": "is compressed with xz: unpack it with 'unxz'",
    ".bz2": "is compressed with bzip2: unpack it with 'bunzip2'",
    ".zip": "is a ZIP archive: unpack it",
    ".tar": "is a tar archive: unpack it with 'tar -xf'",
}


@pytest.mark.parametrize("suffix", ARCHIVES)
@pytest.mark.parametrize("described", [True, False], ids=["metadata", "alone"])
def test_a_recording_in_an_archive_is_named(suffix: str, described: bool, tmp_path: Path) -> None:
    write_mcap(tmp_path / "a", 0.0)
    archive = packed_by(suffix, tmp_path / "a" / "a.mcap")
    line = f"{archive}: {ARCHIVES[suffix]}"
    if described:
        line = f"{tmp_path}/a/a.mcap: is not there, but a.mcap{suffix}, which {ARCHIVES[suffix]}"
    else:
        (tmp_path / "a" / "metadata.yaml").unlink()
    for path, expected in ((tmp_path / "a", line), (archive, f"{archive}: {ARCHIVES[suffix]}")):
        with pytest.raises(TrialError) as found:
            read(path)
        assert str(found.value) == expected


def test_an_archive_that_is_compressed_is_named(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a", 0.0)
    archive = packed_by(".tar.zst", tmp_path / "a" / "a.mcap")
    with refused(TrialError, f"{archive}: is a tar archive once it is unpacked: unpack it with"):
        read(archive)


def test_a_part_in_an_archive_costs_itself_alone(bag: Path) -> None:
    packed_by(".gz", bag / "bag_1.mcap")
    times, (note, _) = read(bag)
    assert times == [0.0, 1.0, *ALL[4:]]
    assert note == (
        "bag_1.mcap is not there, but bag_1.mcap.gz, which is compressed with gzip; missing: 2.00 s"
        " to 3.00 s of the trial, 2 messages (unpack it with 'gunzip')"
    )


def test_trials_in_archives_are_left_out_by_name(tmp_path: Path) -> None:
    for name in ("hold", "walk"):
        write_mcap(tmp_path / name, 0.0)
    packed_by(".zip", tmp_path / "walk" / "walk.mcap")
    (tmp_path / "walk" / "metadata.yaml").unlink()
    (tmp_path / "figures.zip").touch()
    notes: list[str] = []
    assert [*find_trials(tmp_path, notes.append)] == ["hold"]
    assert notes == ["walk/walk.mcap.zip is left out: it is a ZIP archive: unpack it"]


@pytest.mark.parametrize("packed", [False, True], ids=["plain", "zstd"])
@pytest.mark.parametrize(
    ("write", "suffix"), [(write_mcap, ".mcap"), (write_sqlite, ".db3")], ids=["mcap", "sqlite"]
)
def test_a_recording_of_another_name_is_a_bag(
    write: Callable[..., bytes], suffix: str, packed: bool, tmp_path: Path
) -> None:
    content = write(tmp_path / "a", 0.0, 1.0)
    for file in (tmp_path / "a").iterdir():
        file.unlink()
    (tmp_path / "a" / "walk.dat").write_bytes(zstd.compress(content) if packed else content)
    assert is_bag(tmp_path / "a") and [*find_trials(tmp_path)] == ["a"]
    assert read(tmp_path / "a")[0] == [0.0, 1.0]


def test_a_renamed_compressed_part_is_read(bag: Path) -> None:
    file = bag / "bag_2.mcap"
    (bag / "the rest").write_bytes(zstd.compress(file.read_bytes()))
    file.unlink()
    assert read(bag)[0] == ALL


def test_files_of_others_make_no_bag(tmp_path: Path) -> None:
    """A data set's metadata.yaml and another program's database beside trials."""
    write_mcap(tmp_path / "study" / "hold", 0.0)
    study = tmp_path / "study"
    (study / "metadata.yaml").write_text("title: gait\nlicence: CC-BY\n")
    with closing(sqlite3.connect(study / "lab.sqlite")) as base:
        base.execute("CREATE TABLE subjects (name TEXT)")
        base.commit()
    (study / "pages.zst").write_bytes(zstd.compress(b"hello"))
    assert not is_bag(study) and [*find_trials(study)] == ["hold"]


@pytest.mark.parametrize(
    "content",
    [b"", b"rosbag2_bagfile_information: {", b"\xff\xfe", POINTER, b"rosbag2"],
    ids=["empty", "torn", "binary", "pointer", "word"],
)
def test_unreadable_metadata_may_be_a_bag_s(content: bytes, tmp_path: Path) -> None:
    """So that a trial whose files are lost is reported."""
    (tmp_path / "metadata.yaml").write_bytes(content)
    assert is_bag(tmp_path)


def test_pointers_alone_are_refused_by_name(bag: Path) -> None:
    for file in bag.glob("*.mcap"):
        file.write_bytes(POINTER)
    words = "bag_0.mcap: is a Git LFS pointer, not the file itself: fetch the content with 'git lfs"
    with refused(TrialError, words):
        read(bag)


def test_a_damaged_database_costs_itself_alone(tmp_path: Path) -> None:
    bag = make_bag(tmp_path / "bag", write_sqlite, ".db3")
    file = bag / "bag_1.db3"
    file.write_bytes(file.read_bytes()[:9000])
    times, notes = read(bag)
    assert times == [0.0, 1.0, *ALL[4:]]
    assert notes[0] == (
        "bag_0.db3, bag_2.db3, bag_3.db3 have no checksums: damage cannot be detected"
    )
    assert notes[1].startswith("bag_1.db3 cannot be read (Cannot open database bag_1.db3: ")
    assert "; missing: 2.00 s to 3.00 s of the trial, 2 messages (" in notes[1]


def test_a_truncated_database_gives_what_was_before(tmp_path: Path) -> None:
    """Of 400 triggers at 10 Hz those in whole pages, from the first one on."""
    write_sqlite(tmp_path / "a", *(0.1 * number for number in range(400)))
    file = tmp_path / "a" / "a.db3"
    content = file.read_bytes()
    place = content.index(trigger(30.0, 300).data)
    file.write_bytes(content[:place])
    times, notes = read(tmp_path / "a")
    assert 200 < len(times) <= 300
    assert times == pytest.approx([0.1 * number for number in range(len(times))], abs=1e-6)
    assert notes[1] == (
        f"the recording a.db3 was cut short or is damaged: {len(times)} messages up to"
        f" {times[-1]:.1f} s were saved"
    )
    assert notes[2].startswith(f"a.db3 was cut short; missing: {times[-1]:.2f} s to 39.90 s of the")
    assert notes[3].startswith(f"metadata.yaml lists 400 messages, {len(times)} of them can be")
    assert file.read_bytes() == content[:place]


def test_a_journal_gives_the_newest_messages(tmp_path: Path) -> None:
    """A killed recorder leaves them beside the file."""
    write_sqlite(tmp_path / "a", *ALL[:7])
    file = tmp_path / "a" / "a.db3"
    journal = file.with_name("a.db3-wal")
    database = sqlite3.connect(file)
    database.execute("PRAGMA journal_mode = WAL")
    raw = trigger(7.0, 7)
    row = (database.execute("SELECT id FROM topics").fetchone()[0], raw.time, raw.data)
    database.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", row)
    database.commit()
    killed = tmp_path / "killed"
    shutil.copytree(tmp_path / "a", killed)  # the recorder still runs
    database.close()
    (killed / "metadata.yaml").unlink()
    assert not journal.exists()
    before = (killed / "a.db3").read_bytes()
    times, notes = read(killed)
    assert times == ALL
    assert "the newest messages of a.db3 come from a.db3-wal" in notes
    assert (killed / "a.db3").read_bytes() == before


# --- copies, and files of other programs


def test_a_copy_of_a_part_is_left_out(bag: Path) -> None:
    (bag / "metadata.yaml").unlink()
    shutil.copy(bag / "bag_1.mcap", bag / "bag_1 (1).mcap")
    times, notes = read(bag)
    assert times == ALL
    assert notes[1] == (
        "bag_1 (1).mcap is left out: it begins as bag_1.mcap, of which it is a copy or a piece"
    )


def test_a_recovered_file_replaces_the_damaged_one(bag: Path) -> None:
    """The damaged one holds fewer messages than metadata.yaml lists."""
    shutil.copy(bag / "bag_2.mcap", bag / "recovered.mcap")
    (bag / "bag_2.mcap").write_bytes(b"")
    times, (note,) = read(bag)
    assert times == ALL
    assert note == (
        "metadata.yaml does not name recovered.mcap, read in place of bag_2.mcap; all messages that"
        " it lists were read"
    )


def test_hidden_files_are_no_parts(bag: Path) -> None:
    """A copy by macOS puts `._bag_0.mcap` beside `bag_0.mcap`."""
    (bag / "metadata.yaml").unlink()
    (bag / "._bag_0.mcap").write_bytes(b"\0\5\26\7")
    assert read(bag) == (ALL, ["no metadata.yaml: the storage files were read as they are"])
    assert find_trials(bag.parent)["bag"] == bag


def test_files_that_nobody_listed_are_named(bag: Path) -> None:
    """The metadata, with all that they list, are enough."""
    (bag / "more.mcap").write_bytes(write_mcap(bag.parent / "more", 9.0))
    assert read(bag) == (ALL, ["not named in metadata.yaml, and not read: more.mcap"])


# --- a file in place of the folder


def test_a_single_part_points_to_its_folder(bag: Path) -> None:
    times, notes = read(bag / "bag_1.mcap")
    assert times == [2.0, 3.0]
    assert notes == ["bag_1.mcap is one of 4 parts of a recording: give its folder for all"]


def test_metadata_are_no_recording(bag: Path) -> None:
    words = f"metadata.yaml: describes a bag, and is no recording: give its folder, {bag}"
    with refused(TrialError, words):
        read(bag / "metadata.yaml")


# --- recording times that are none


@pytest.mark.parametrize("wild", [0, 2**63, 2**64 - 1])
@pytest.mark.parametrize("place", [0, 3, 7], ids=["first", "middle", "last"])
def test_a_wild_time_leaves_the_duration(wild: int, place: int, tmp_path: Path) -> None:
    """Its message is read at its place in the file; a trial of eight seconds keeps them."""
    with BagWriter(tmp_path / "a") as new:
        new.add_topic("/trigger", topics.TRIGGER)
        for number in range(8):
            raw = trigger(float(number), number)
            new.write(raw.topic, wild if number == place else raw.time, raw.data)
    with BagReader(tmp_path / "a") as found:
        numbers = [raw.data for raw in found.messages()]
        assert numbers == [trigger(float(number), number).data for number in range(8)]
        assert found.duration == (7.0 if place == 3 else 6.0)
        assert found.notes == [
            "1 message of a.mcap has a recording time days from the others, which is replaced by"
            " that of a neighbour"
        ]


@pytest.mark.parametrize("wild", [-(2**63), 0, 2**63 - 1])
def test_a_wild_time_in_a_database_counts_not(wild: int, tmp_path: Path) -> None:
    write_sqlite(tmp_path / "a", *ALL)
    with sqlite3.connect(tmp_path / "a" / "a.db3") as database:
        database.execute("UPDATE messages SET timestamp = ? WHERE id = 4", (wild,))
    with BagReader(tmp_path / "a") as found:
        times = [(raw.time - START) * 1e-9 for raw in found.messages()]
        assert len(times) == 8 and (min(times), max(times)) == (0.0, 7.0)
        assert found.duration == 7.0
        assert "1 message of a.db3 has a recording time days from the others" in found.notes[1]


def test_a_part_of_another_year_leaves_the_duration(bag: Path) -> None:
    """The clock was set after the first part."""
    (bag / "bag_0.mcap").write_bytes(write_mcap(bag.parent / "old", -1e9, -1e9 + 1.0))
    with BagReader(bag) as found:
        assert found.duration == 5.0 and sum(found.counts.values()) == 8
        assert found.notes == [
            "bag_0.mcap was recorded at times far from the other parts, which do not count in the"
            " duration: check the clock of the recording"
        ]


# --- words


def test_missing_numbers_are_those_between_others() -> None:
    assert missing_numbers(["a_0.mcap", "a_2.mcap"]) == {"a_1.mcap": "a_0.mcap"}
    assert missing_numbers(["a_2.mcap", "a_3.mcap"]) == {}
    assert missing_numbers(["a_0.mcap", "b_2.mcap"]) == missing_numbers([]) == {}
    assert missing_numbers(["day_20261101.mcap", "day_20261128.mcap"]) == {}


@pytest.mark.parametrize(
    ("start", "end", "words"),
    [
        (START, START + SECOND, "0.00 s to 1.00 s of the trial"),
        (START - SECOND, START, "1.00 s before the first message"),
        (None, START, "anything before the first message"),
        (START, None, "anything after 0.00 s of the trial"),
        (None, None, ""),
    ],
)
def test_a_missing_span_in_words(start: int | None, end: int | None, words: str) -> None:
    assert span_in_words(start, end, START) == words
