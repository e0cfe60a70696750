"""Recordings that were cut short or damaged: all that is whole is read, or an error."""

import io
import shutil
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as draw
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import breakup_chunk
from mcap.writer import IndexType, Writer

import socket_testbed as st
from socket_testbed.errors import TrialError
from socket_testbed.trials.bag import BagReader, BagWriter, RawMessage, holds_nothing
from socket_testbed.trials.trial import Trial
from socket_testbed.wire.topics import CAPACITANCE, WRENCH

START = 1_760_000_000_000_000_000  # [ns]
CHUNKS = 6
MESSAGES = 9  # a chunk


class Recording:
    """A recording of several chunks: its bytes, and by the MCAP library what each chunk holds."""

    def __init__(self, path: Path) -> None:
        self.data = path.read_bytes()
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        self.ends: list[int] = []  # of the chunks in the file [bytes]
        self.chunks: list[list[RawMessage]] = []
        kinds = {
            number: (channel.topic, summary.schemas[channel.schema_id].name)
            for number, channel in summary.channels.items()
        }
        for index in summary.chunk_indexes:
            self.ends.append(index.chunk_start_offset + index.chunk_length)
            content = self.data[index.chunk_start_offset + 9 : self.ends[-1]]
            found = breakup_chunk(Chunk.read(ReadDataStream(io.BytesIO(content))))
            messages = [m for m in found if isinstance(m, Message)]
            raws = [RawMessage(*kinds[m.channel_id], m.log_time, m.data) for m in messages]
            self.chunks.append(raws)

    def before(self, cut: int) -> list[RawMessage]:
        """The messages of the chunks that are whole before a cut, in the order of their times."""
        return self.first(sum(end <= cut for end in self.ends))

    def first(self, number: int) -> list[RawMessage]:
        return sorted((m for chunk in self.chunks[:number] for m in chunk), key=lambda m: m.time)


def make_messages() -> list[RawMessage]:
    """Messages of two topics, not quite in the order of their times, some with zeros last."""
    rng = np.random.default_rng(0)
    times = START + np.arange(CHUNKS * MESSAGES) * 10_000_000
    times[2::5] -= 25_000_000
    messages = []
    for time in times.tolist():
        topic = (WRENCH, CAPACITANCE)[int(rng.integers(2))]
        body = rng.bytes(int(rng.integers(20, 90))) + bytes(int(rng.integers(0, 9)))
        messages.append(RawMessage("/" + topic.name, topic.type, time, body))
    return messages


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("recording") / "bag"
    with BagWriter(path) as bag:
        for topic in (WRENCH, CAPACITANCE):
            bag.add_topic("/" + topic.name, topic)
        for number, message in enumerate(make_messages(), 1):
            bag.write(message.topic, message.time, message.data)
            if number % MESSAGES == 0:
                bag.flush()
    recording = Recording(path / "bag.mcap")
    assert len(recording.ends) == CHUNKS
    return recording


def written_by_mcap(path: Path, **options: Any) -> Path:
    """The same messages as another recorder writes them, in chunks of some 500 bytes."""
    path.parent.mkdir(exist_ok=True)
    with path.open("wb") as file:
        writer = Writer(file, 500, **options)
        writer.start("ros2")
        channels = {}
        for topic in (WRENCH, CAPACITANCE):
            schema = writer.register_schema(topic.type, "ros2msg", b"")
            channels["/" + topic.name] = writer.register_channel("/" + topic.name, "cdr", schema)
        for message in make_messages():
            channel = channels[message.topic]
            writer.add_message(channel, message.time, message.data, message.time)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


@pytest.fixture(scope="module")
def compressed(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return Recording(written_by_mcap(tmp_path_factory.mktemp("packed") / "bag.mcap"))


def read(path: Path) -> list[RawMessage]:
    with BagReader(path) as bag:
        messages = list(bag.messages())
        assert sum(bag.counts.values()) == len(messages)
    return messages


def write(folder: Path, data: bytes) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "bag.mcap").write_bytes(data)
    return folder


def header_end(data: bytes) -> int:
    """Where the first record of a recording ends [bytes]: behind the magic, 9 bytes and itself."""
    return 8 + 9 + int.from_bytes(data[9:17], "little")


def check(recording: Recording, data: bytes, folder: Path) -> None:
    """Whether a torn file gives the messages of the chunks that are whole in it, or an error."""
    whole = recording.data
    length = min(len(data), len(whole))
    alike = np.frombuffer(data[:length], np.uint8) == np.frombuffer(whole[:length], np.uint8)
    same = length if alike.all() else int(np.argmin(alike))
    expected = recording.before(same)
    try:
        assert read(write(folder, data)) == expected, same
    except TrialError as error:
        assert expected == [], same
        what = "holds nothing: " if len(data) <= header_end(whole) else "is truncated"
        assert f"bag.mcap: {what}" in str(error)


def test_a_torn_file_gives_exactly_its_whole_chunks(recording, tmp_path) -> None:
    """By a kill or a power cut: cut, zeros or old blocks behind, sectors never written."""
    whole, sizes = recording.data, draw.integers(0, len(recording.data) - 1)
    ends = draw.sampled_from([0, 8, header_end(whole), *recording.ends, len(whole) - 45])
    near = draw.builds(lambda end, shift: max(0, end + shift), ends, draw.integers(-45, 44))

    @given(
        cut=sizes | near,
        tail=draw.sampled_from(["nothing", "zeros", "old blocks", "no sectors"]),
        size=draw.integers(512, 5000),
    )
    @settings(max_examples=800, deadline=None, derandomize=True, database=None)
    def tear(cut: int, tail: str, size: int) -> None:
        if tail == "no sectors":
            cut = max(512, cut - cut % 512)
        elif tail == "old blocks":
            cut = max(cut, recording.ends[0])
        unwritten = bytes(len(whole) - cut)
        old = np.random.default_rng(size).bytes(size)
        tails = {"nothing": b"", "zeros": bytes(size), "old blocks": old, "no sectors": unwritten}
        check(recording, whole[:cut] + tails[tail], tmp_path / "bag")

    tear()


@pytest.mark.parametrize("place", ["record", "name", "data", "unpacked"])
def test_a_lying_length_takes_no_memory(place: str, recording: Recording, tmp_path: Path) -> None:
    """The last chunk is a zstd one with a length of 2 GiB somewhere."""
    length = 2**31
    frame = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(1000))
    content = (
        struct.pack("<QQQI", START, START, length if place == "unpacked" else 1000, 0)
        + struct.pack("<I", length if place == "name" else 4)
        + b"zstd"
        + struct.pack("<Q", length if place == "data" else len(frame))
        + frame
    )
    record = struct.pack("<BQ", 6, length if place == "record" else len(content)) + content
    folder = write(tmp_path / "bag", recording.data[: recording.ends[2]] + record)
    tracemalloc.start()
    messages = read(folder)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert messages == recording.first(3) and peak < 2**24


@pytest.mark.parametrize(
    ("kind", "places"), [("recording", 400), ("compressed", 100)], ids=["plain", "compressed"]
)
def test_a_changed_byte_costs_its_chunk_alone(
    kind: str, places: int, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """Anywhere in a complete file: what is read is as it was written."""
    whole: Recording = request.getfixturevalue(kind)
    rng, costs = np.random.default_rng(5), []
    count = len(whole.chunks)
    for place in rng.integers(0, len(whole.data), places).tolist():
        changed = bytes([whole.data[place] ^ int(rng.integers(1, 256))])
        folder = write(tmp_path / "bag", whole.data[:place] + changed + whole.data[place + 1 :])
        with BagReader(folder) as bag:
            found, notes = list(bag.messages()), bag.notes
        kept = [chunk for chunk in whole.chunks if chunk[0] in found]
        expected = sorted((m for chunk in kept for m in chunk), key=lambda m: m.time)
        assert found == expected, place
        costs.append(count - len(kept))
        if costs[-1]:
            assert f"is damaged: 1 of its {count} chunks cannot be read" in notes[-1]
        folder = write(tmp_path / "bag", whole.data[: max(place, whole.ends[0])])
        assert read(folder) == whole.before(max(place, whole.ends[0]))
    assert max(costs) == 1 and costs.count(0) > 0


@pytest.mark.parametrize(
    ("chunk", "span"),
    [
        (0, "from the start to 0.10 s"),
        (2, "from 0.17 s to 0.25 s"),
        (5, "from 0.45 s to the end"),
    ],
    ids=["first", "middle", "last"],
)
def test_a_note_names_the_missing_span(
    chunk: int, span: str, recording: Recording, tmp_path: Path
) -> None:
    place = recording.data.index(recording.chunks[chunk][3].data)
    data = recording.data[:place] + b"?" + recording.data[place + 1 :]
    with BagReader(write(tmp_path / "bag", data)) as bag:
        assert len(list(bag.messages())) == (CHUNKS - 1) * MESSAGES
        assert span in bag.notes[-1], bag.notes


def test_a_note_names_what_was_saved(recording: Recording, tmp_path: Path) -> None:
    cut = recording.ends[2] + 5
    folder = write(tmp_path / "bag", recording.data[:cut])
    with BagReader(folder) as bag:
        _, note = bag.notes
    assert (folder / "bag.mcap").read_bytes() == recording.data[:cut]  # it is only read
    assert f"cut short (no end): {3 * MESSAGES} messages up to " in note
    assert "(0.3 s) were saved, the newest may be missing (5 bytes cannot be read)" in note
    assert read(folder / "bag.mcap") == recording.before(cut)  # a single file


def test_what_is_no_mcap_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TrialError, match="cannot be read"):
        read(write(tmp_path / "bag", b"no MCAP at all, whatever its name says: " * 9))


@pytest.mark.parametrize("chunked", [False, True], ids=["bare", "chunked"])
def test_a_file_without_an_index_is_read(chunked: bool, tmp_path: Path) -> None:
    """As `ros2 bag record` writes it with the profile fastwrite, also if it was cut short."""
    bare = {"use_statistics": False, "repeat_channels": False, "repeat_schemas": False}
    expected = sorted(make_messages(), key=lambda message: message.time)
    options = {"use_chunking": chunked, "index_types": IndexType.NONE, **bare}
    path = written_by_mcap(tmp_path / "bag" / "bag.mcap", **options)
    assert read(path) == expected
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    assert 20 < len(read(path)) < 40


def test_a_trial_cut_short_gives_its_samples(hold, tmp_path) -> None:
    """They are those of the whole one; the note comes once, however often it is read."""
    trial, file = Path(shutil.copytree(hold, tmp_path / "hold")), tmp_path / "hold" / "hold.mcap"
    (trial / "metadata.yaml").unlink()
    file.write_bytes(file.read_bytes()[: Recording(file).ends[-8] - 4000])
    notes: list[str] = []
    cut = st.open_trial(trial, notify=notes.append)
    samples, whole = cut.samples(), Trial(hold).samples()
    assert 150 <= len(samples) < 235
    np.testing.assert_array_equal(samples.values, whole.values[: len(samples)])
    assert st.fit(cut).segment and cut.events()
    (note,) = (note for note in notes if "cut short" in note)
    assert note.startswith("the recording hold.mcap was cut short (no end): ")


@pytest.mark.parametrize("size", [0, 1, 8, 12, "header - 1", "header"])
def test_a_recording_without_messages_holds_nothing(
    size: int | str, recording: Recording, tmp_path: Path
) -> None:
    """It was killed while it started."""
    header = header_end(recording.data)
    end = {"header - 1": header - 1, "header": header}[size] if isinstance(size, str) else size
    trial = write(tmp_path / "trial", recording.data[:end])
    with pytest.raises(TrialError, match="holds nothing: "), BagReader(trial):
        pass
    assert holds_nothing(trial)


def test_a_piece_of_a_chunk_is_something(recording: Recording, tmp_path: Path) -> None:
    header = header_end(recording.data)
    assert not holds_nothing(write(tmp_path / "trial", recording.data[: header + 1000]))


def test_a_listed_file_is_something_even_empty(tmp_path: Path) -> None:
    """It is a copy of what metadata.yaml lists."""
    trial = write(tmp_path / "trial", b"")
    (trial / "metadata.yaml").touch()
    assert not holds_nothing(trial)
