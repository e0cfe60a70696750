"""MCAP recordings: reads every intact chunk of a file, even if it is truncated or damaged.

A killed recorder, a power cut or a full disk leaves an MCAP file without index and end, often with
a torn last chunk; a bad disk or copy changes bytes anywhere. Chunks are found by their headers, or
by the file's index if that lists more of them. The MCAP library unpacks each chunk and verifies its
checksum; a chunk without one must consist of whole records. Lengths are checked before reading.
The file is never modified. The format: https://mcap.dev/spec.
"""

from __future__ import annotations

import io
import math
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Schema
from mcap.stream_reader import get_chunk_data_stream
from numpy.typing import NDArray

from socket_testbed.arrays import IntArray
from socket_testbed.errors import TrialError
from socket_testbed.trials.bag_parts import (
    COPY_AGAIN,
    GIVE_BAG,
    HOLDS_NOTHING,
    MAX_APART,
    Batch,
    describe_strays,
)
from socket_testbed.trials.bag_parts import MCAP_MAGIC as _MAGIC

_RECORD = struct.Struct("<BQ")  # opcode, length of the content [bytes]
_LENGTH = struct.Struct("<Q")  # of a record's content [bytes]
_MESSAGE = np.dtype(  # what precedes a message's data in its record
    [
        ("opcode", "u1"),
        ("length", "<u8"),  # [bytes]
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("time", "<u8"),  # of recording, since the epoch [ns]
        ("published", "<u8"),  # [ns]
    ]
)
_FOOTER = _RECORD.pack(Opcode.FOOTER, 20)
_END_SIZE = _RECORD.size + 20 + len(_MAGIC)
_CHUNK_OVERHEAD = 8 + 8 + 8 + 4 + 4 + 8  # [bytes] of a chunk without its data and compression name
_MAX_CHUNK_SIZE = 2**28  # [bytes]; recorders write 1 MiB, a larger length is corrupt
_MAX_LOOSE_SIZE = 2**20  # [bytes] of messages outside chunks that are grouped into one
_FIRST_PRIVATE_OPCODE = 0x80  # applications may use opcodes from here on


class _Place(NamedTuple):
    """Location of a chunk in its file, or of messages that some recorders write outside chunks.

    Attributes:
        start: Where its content begins, from the start of the file [bytes].
        end: Where its content ends, from the start of the file [bytes].
        index_end: Where the message indexes that follow it end, from the start of the file [bytes].
        packed: Whether it is a chunk; false for messages outside chunks.
    """

    start: int
    end: int
    index_end: int
    packed: bool = True


class Connection(NamedTuple):
    """A topic of a recording, with the field names of rosbags.

    Attributes:
        id: Number of its channel in the file.
        topic: Its full name in the recorded graph, such as `/trigger`.
        msgtype: Its message type, as `package/msg/Type`; `none` if the file states no type.
        msgcount: Number of its messages in readable chunks.
    """

    id: int
    topic: str
    msgtype: str
    msgcount: int


class _Chunk:
    """The content of a chunk.

    Attributes:
        place: Its location in the file.
        definitions: The message types and topics that it defines.
        sound: Whether it can be read completely; otherwise it counts as empty.
        checked: Whether a checksum confirms its content.
        edges: Where its records begin and the last one ends in its content, (k + 1,) [bytes].
        counts: Number of its messages by channel.
        strays: Number of its messages whose recording time is far from those of the file.
        first_time: Earliest recording time of its messages since the epoch [ns]; 0 without any.
        middle_time: Median recording time of its messages since the epoch [ns]; 0 without any.
        last_time: Latest recording time of its messages since the epoch [ns]; 0 without any.
    """

    def __init__(self, file: BinaryIO, place: _Place) -> None:
        self.place = place
        self.definitions: list[Schema | Channel] = []
        self.sound, self.checked = True, True
        self.edges = np.zeros(1, np.int32)
        channels, times = np.empty(0, np.uint16), np.empty(0, np.uint64)
        try:
            content, self.checked = _unpack(file, place)
            self.edges = _edges(content)
            records = _Records(content, self.edges)
            channels, times = records.channels, np.sort(records.times)
            for opcode, start, end in records.others:
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self.definitions.append(_definition(opcode, content[start:end]))
                elif opcode < _FIRST_PRIVATE_OPCODE:
                    raise ValueError("the chunk holds another record")
        except Exception:  # the libraries may raise any exception
            self.sound, self.definitions, channels, times = False, [], channels[:0], times[:0]
        self.counts = Counter(channels.tolist())
        self.strays = 0
        count = len(times)
        self.first_time = int(times[0]) if count else 0
        self.middle_time = int(times[(count - 1) // 2]) if count else 0
        self.last_time = int(times[-1]) if count else 0
        is_long = self.last_time - self.first_time > MAX_APART
        self._times: list[int] = times.tolist() if is_long else []

    def keep_within(self, low: int, high: int, before: int) -> None:
        """Limit the first and the last time to a range, and count the messages outside it.

        Args:
            low: Start of the range, since the epoch [ns].
            high: End of the range, since the epoch [ns].
            before: Stands for both times if no message lies within the range, since the epoch [ns].
        """
        if low <= self.first_time and self.last_time <= high:
            return
        inside = [time for time in self._times if low <= time <= high]
        self.strays = self.counts.total() - len(inside)
        self.first_time, self.last_time = (inside[0], inside[-1]) if inside else (before, before)


class McapFile:
    """The readable part of a recording in an open file; used like a reader of rosbags.

    Args:
        file: The open file, which stays open while messages are read.
        name: Path by which errors call the file, such as that of the compressed file it came from.

    Attributes:
        path: The open file's own path.
        checked: Whether checksums confirm all of its messages.
        lacks: Whether messages may be missing.
        ended: Whether the file has an end, as a closed recording has.
        start_time: Recording time of the first message since the epoch [ns]; 0 without any.
        end_time: Recording time of the last message, and 1 ns more, since the epoch [ns]; 0 without
            any.
        first_known: As `start_time`, but of the first message that the file is known to have held,
            readable or not.
        message_count: Number of readable messages.
        connections: The topics.
        definitions: Definitions of the message types (ros2msg), by name.

    Raises:
        TrialError: If a truncated or damaged file holds no complete chunk of messages, or its
            topics are lost.
    """

    def __init__(self, file: BinaryIO, name: Path) -> None:
        self.path, self._file, self._name = Path(file.name), file, name.name
        index = _Index(file)
        found = _find_chunks(file, index)
        self._found, self._index, self.ended = found, index, index.ended
        self._chunks = [chunk for chunk in found.chunks if chunk.sound]
        damaged = len(self._chunks) < len(found.chunks)
        self.lacks = damaged or not found.whole
        if self.lacks and not self._chunks:
            raise self._unreadable(name, index.ended)

        self.checked = all(chunk.checked for chunk in self._chunks)
        self._keep_within_a_day()
        # As in rosbags, the end is one nanosecond after the last message.
        self.start_time = min((chunk.first_time for chunk in self._chunks), default=0)
        self.end_time = max((chunk.last_time for chunk in self._chunks), default=-1) + 1

        counts = sum((chunk.counts for chunk in self._chunks), Counter[int]())
        self.message_count = counts.total()
        self.connections = _connections(found.definitions, counts)
        self.definitions = {
            record.name: record.data.decode(errors="replace")
            for record in found.definitions
            if isinstance(record, Schema) and record.encoding == "ros2msg"
        }
        if sum(connection.msgcount for connection in self.connections) < self.message_count:
            raise TrialError(f"{name}: is damaged, its topics are lost", COPY_AGAIN)

        starts = [self.start_time, index.start_time]
        self.first_known = int(min(time for time in starts if self._is_near(time)))
        self._damaged = damaged

    def _keep_within_a_day(self) -> None:
        """Find the messages whose time is days from the file's middle one, such as 2^64 - 1."""
        middles = sorted(chunk.middle_time for chunk in self._chunks)
        middle = middles[(len(middles) - 1) // 2] if middles else 0
        self._low, self._high = middle - MAX_APART, middle + MAX_APART
        within = (c.first_time for c in self._chunks if self._is_near(c.first_time))
        before = min(within, default=middle)
        for chunk in self._chunks:
            chunk.keep_within(self._low, self._high, before)
            before = chunk.last_time

    def _is_near(self, time: float) -> bool:
        """Whether a recording time [ns] is within a day of the file's middle one."""
        return not self._chunks or self._low <= time <= self._high

    def notes(self, first: int) -> list[str]:
        """What was not read or was changed, one line each.

        Args:
            first: The bag's first recording time, from which seconds count, since the epoch [ns].
        """
        notes = []
        if strays := sum(chunk.strays for chunk in self._chunks):
            notes.append(describe_strays(self._name, strays))
        if self.lacks and (self.ended or self._damaged):
            notes.append(self._describe_damage(self._found, self._index, first))
        elif self.lacks:
            notes.append(self._describe_cut(self._found, first))
        return notes

    def batches(self, connections: Collection[Connection]) -> Iterator[Batch]:
        """The messages of some of the file's topics, in the order of their times.

        A time that is days from the others is that of the message before.
        """
        wanted = [connection.id for connection in connections]
        chunks = [chunk for chunk in self._chunks if chunk.counts.keys() & wanted]
        chunks.sort(key=lambda chunk: chunk.first_time)
        next_times = (*(chunk.first_time for chunk in chunks[1:]), None)
        waiting, places = Batch.empty(), np.empty(0, np.int64)  # chunks may overlap in time
        for chunk, next_time in zip(chunks, next_times, strict=False):
            found = self._messages_of(chunk, wanted)
            places = np.append(places, np.full(len(found.times), chunk.place.start))
            waiting, places = _by_time(waiting.followed_by(found), places)
            ready = len(places)
            if next_time is not None:
                ready = int(np.searchsorted(waiting.times, np.uint64(next_time)))
            yield waiting.part(slice(None, ready))
            waiting, places = waiting.part(slice(ready, None)), places[ready:]

    def _messages_of(self, chunk: _Chunk, wanted: Sequence[int]) -> Batch:
        """The messages of a chunk on some channels, in the order of the file."""
        content, _ = _unpack(self._file, chunk.place)
        records = _Records(content, chunk.edges)
        times = records.times
        if chunk.strays:
            times = np.array([*self._near_times(times.tolist(), chunk.first_time)], np.uint64)
        kept = np.isin(records.channels, wanted)
        starts, ends = records.starts[kept].tolist(), records.ends[kept].tolist()
        contents = [content[start:end] for start, end in zip(starts, ends, strict=True)]
        return Batch(records.channels[kept], times[kept], contents)

    def _near_times(self, times: Iterable[int], before: int) -> Iterator[int]:
        """Recording times [ns], each that is days from the others replaced by the one before.

        Args:
            times: The times of a chunk since the epoch [ns].
            before: Stands for the time before the first one, since the epoch [ns].
        """
        for time in times:
            if self._is_near(time):
                before = time
            yield before

    def _unreadable(self, name: Path, ended: bool) -> TrialError:
        """The error for a file without a complete chunk of messages."""
        self._file.seek(0)
        magic = self._file.read(len(_MAGIC)).rstrip(b"\0")
        if is_empty(self.path):
            fact, hint = HOLDS_NOTHING
        elif ended:
            fact, hint = "is damaged, nothing in it can be read", COPY_AGAIN
        elif not _MAGIC.startswith(magic):
            fact = "cannot be read (it is not an MCAP file)"
            hint = GIVE_BAG
        else:
            fact = "is truncated (it has no end, and no complete chunk of messages)"
            hint = f"{COPY_AGAIN}; 'mcap recover' may still find a part of it"
        return TrialError(f"{name}: {fact}", hint)

    def _describe_cut(self, found: _Found, first: int) -> str:
        """A note on the saved and the lost messages of a recording without an end."""
        torn = found.size - self._chunks[-1].place.index_end  # [bytes] of the unread end
        until = datetime.fromtimestamp((self.end_time - 1) * 1e-9).strftime("%H:%M:%S")
        unread = f" ({torn} bytes cannot be read)" if torn else ""
        return (
            f"the recording {self._name} was cut short (no end): {self.message_count} messages"
            f" up to {until} ({(self.end_time - 1 - first) * 1e-9:.1f} s) were saved, "
            + ("none is missing" if found.complete else f"the newest may be missing{unread}")
        )

    def _describe_damage(self, found: _Found, index: _Index, start: int) -> str:
        """A note on the chunks that cannot be read, and on the times that they covered."""
        gaps = found.gaps(start)
        if not found.complete and not (index.sound and index.places) and found.chunks[-1].sound:
            gaps.append(f"anything after {_seconds_since(start, found.chunks[-1].last_time)}")
        lost = len(found.chunks) - len(self._chunks)
        counted = f"{lost} of its {len(found.chunks)} chunks cannot be read, " if lost else ""
        what = f"{counted}missing: {', '.join(gaps)}" if gaps else "no message is missing"
        return f"the recording {self._name} is damaged: {what} ({COPY_AGAIN})"


class _Found(NamedTuple):
    """What a file holds, readable or not.

    Attributes:
        size: Size of the file [bytes].
        chunks: The chunks with messages or damage, in the order of the file or of its index.
        definitions: The message types and topics, from the index and all chunks.
        complete: Whether the search for chunks reached the end of the data.
        whole: Whether nothing shows that a chunk was lost: the search was complete, the end of the
            file can be read, and its index, unless empty, lists the chunks that were found.
    """

    size: int
    chunks: list[_Chunk]
    definitions: list[Schema | Channel]
    complete: bool
    whole: bool

    def gaps(self, start: float) -> list[str]:
        """The times that runs of unreadable chunks covered, in words, since `start` [ns]."""
        runs = [list(run) for _, run in groupby(self.chunks, key=lambda chunk: chunk.sound)]
        gaps = []
        for before, run, after in zip([[], *runs], runs, [*runs[1:], []], strict=False):
            if not run[0].sound:
                begin = _seconds_since(start, before[-1].last_time) if before else "the start"
                end = _seconds_since(start, after[0].first_time) if after else "the end"
                gaps.append(f"from {begin} to {end}")
        return gaps


def _seconds_since(start: float, time: int) -> str:
    return f"{1e-9 * (time - start):.2f} s"


class _Index:
    """The index of chunks and topics at the end of a file; empty if it cannot be read.

    Attributes:
        places: Locations of the chunks.
        start_time: Recording time of the first message since the epoch [ns]; infinite if unknown.
        definitions: The message types and topics.
        ended: Whether the file has an end, as a closed recording has.
        sound: Whether the file has an end, and the index can be read and matches its checksum, if
            any.
    """

    def __init__(self, file: BinaryIO) -> None:
        self.places: list[_Place] = []
        self.start_time = math.inf
        self.definitions: list[Schema | Channel] = []
        footer_start = max(0, file.seek(0, io.SEEK_END) - _END_SIZE)
        file.seek(footer_start)
        end = file.read()
        self.ended = end.startswith(_FOOTER) and end.endswith(_MAGIC)
        self.sound = self.ended
        if self.ended:
            try:
                self._read(file, footer_start, *struct.unpack_from("<QQI", end, _RECORD.size))
            except Exception:  # the library may raise any exception
                self.sound, self.start_time = False, math.inf

    def _read(self, file: BinaryIO, stop: int, start: int, _: int, checksum: int) -> None:
        if not start:
            return
        if not 0 < start <= stop:
            raise ValueError("the index is nowhere")
        file.seek(start)
        content = file.read()[: -len(_MAGIC) - 4]
        if checksum and zlib.crc32(content) != checksum:
            raise ValueError("the index has another checksum")
        for opcode, first, end in _records(content[: stop - start]):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.definitions.append(_definition(opcode, content[first:end]))
            elif opcode == Opcode.CHUNK_INDEX:
                chunk = ChunkIndex.read(ReadDataStream(io.BytesIO(content[first:end])))
                chunk_end = chunk.chunk_start_offset + chunk.chunk_length
                place = chunk.chunk_start_offset + _RECORD.size, chunk_end
                self.places.append(_Place(*place, chunk_end + chunk.message_index_length))
                self.start_time = min(self.start_time, chunk.message_start_time)


def _find_chunks(file: BinaryIO, index: _Index) -> _Found:
    """The chunks of a file, by their headers or by its index, whichever leads to more messages."""
    size = file.seek(0, io.SEEK_END)
    places, complete = _walk(file, size)
    chunks = [_Chunk(file, place) for place in places]
    walked = [place for place in places if place.packed]
    if index.places != walked:
        listed = [_Chunk(file, place) for place in index.places]
        chunks = max(chunks, listed, key=_count_messages)
    if not index.ended and _drop_unflushed(chunks):
        complete = False
    return _Found(
        size=size,
        chunks=[chunk for chunk in chunks if chunk.counts or not chunk.sound],
        definitions=[*index.definitions, *(d for chunk in chunks for d in chunk.definitions)],
        complete=complete,
        whole=index.sound and complete and index.places in ([], walked),
    )


def _count_messages(chunks: list[_Chunk]) -> int:
    return sum(chunk.counts.total() for chunk in chunks)


def _drop_unflushed(chunks: list[_Chunk]) -> int:
    """Drop the unreadable chunks at the end of a recording without an end; returns their number.

    An unflushed chunk at the end may hold zeros or old disk blocks: it is no damage. Chunks before
    the last intact one were flushed.
    """
    before = len(chunks)
    while chunks and not chunks[-1].sound:
        chunks.pop()
    return before - len(chunks)


def _walk(file: BinaryIO, size: int) -> tuple[list[_Place], bool]:
    """The chunks found by record headers, and whether the walk reached the end of the data."""
    places: list[_Place] = []
    chunked = False
    position = len(_MAGIC)
    while position + _RECORD.size <= size:
        file.seek(position)
        opcode, length = _RECORD.unpack(file.read(_RECORD.size))
        start, position = position, position + _RECORD.size + length
        # A recorder that writes chunks writes no messages outside them.
        if position > size or opcode == 0 or (chunked and opcode == Opcode.MESSAGE):
            break
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return places, True
        if opcode == Opcode.CHUNK:
            chunked = True
            places.append(_Place(start + _RECORD.size, position, position))
        elif opcode == Opcode.MESSAGE_INDEX and places:
            places[-1] = places[-1]._replace(index_end=position)
        elif opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
            last = places.pop() if places else _Place(start, start, start, packed=False)
            if last.packed or last.end != start or last.end - last.start > _MAX_LOOSE_SIZE:
                places.append(last)
                last = _Place(start, start, start, packed=False)
            places.append(last._replace(end=position, index_end=position))
    return places, False


def is_empty(path: Path) -> bool:
    """Whether an MCAP file holds at most its first record, or a part of it."""
    with path.open("rb") as file:
        start = file.read(len(_MAGIC) + _RECORD.size)
    if len(start) < len(_MAGIC) + _RECORD.size:
        return _MAGIC.startswith(start[: len(_MAGIC)])
    opcode, length = _RECORD.unpack(start[len(_MAGIC) :])
    whole = path.stat().st_size <= len(start) + length
    return start.startswith(_MAGIC) and opcode == Opcode.HEADER and whole


def _unpack(file: BinaryIO, place: _Place) -> tuple[bytes, bool]:
    """The records of a chunk, and whether a checksum confirms them."""
    if not 0 <= place.end - place.start <= _MAX_CHUNK_SIZE:
        raise ValueError("the chunk is too large")
    file.seek(place.start)
    content = file.read(place.end - place.start)
    if not place.packed:
        return content, False
    chunk = Chunk.read(ReadDataStream(io.BytesIO(content)))
    if _CHUNK_OVERHEAD + len(chunk.compression) + len(chunk.data) != len(content):
        raise ValueError("the chunk does not fill its record")
    if chunk.uncompressed_size > _MAX_CHUNK_SIZE:
        raise ValueError("the chunk is too large once unpacked")
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    if length != chunk.uncompressed_size:
        raise ValueError("the chunk has another size")
    return stream.read(length), bool(chunk.uncompressed_crc)


def _by_time(batch: Batch, places: IntArray) -> tuple[Batch, IntArray]:
    """Messages in the order of their times; of equal ones in that of the file.

    Args:
        batch: The messages, those of a chunk in the order of the file.
        places: Start of each message's chunk in the file, shape (k,) [bytes].
    """
    order = np.lexsort((places, batch.times))
    if (order[1:] > order[:-1]).all():  # nearly always
        return batch, places
    contents = [batch.contents[row] for row in order.tolist()]
    return Batch(batch.connections[order], batch.times[order], contents), places[order]


class _Records:
    """The records of a chunk, whose k messages are read all at once.

    Args:
        content: The unpacked chunk.
        edges: Where its records begin and end, see `_edges`.

    Attributes:
        channels: Numbers of the messages' channels, k of them.
        times: Recording times of the messages since the epoch [ns], k of them.
        starts: Where the data of each message begin in the content [bytes], k of them.
        ends: Where they end [bytes], k of them.
        others: Opcode, start and end [bytes] of the content of every other record.

    Raises:
        ValueError: If a message is torn.
    """

    def __init__(self, content: bytes, edges: NDArray[np.int32]) -> None:
        starts, ends = edges[:-1], edges[1:]
        opcodes = np.frombuffer(content, np.uint8)[starts]
        is_message = opcodes == Opcode.MESSAGE
        others = (opcodes[~is_message], starts[~is_message] + _RECORD.size, ends[~is_message])
        self.others = [*zip(*(column.tolist() for column in others), strict=True)]
        starts, ends = starts[is_message], ends[is_message]
        if (ends - starts < _MESSAGE.itemsize).any():
            raise ValueError("the chunk holds a torn message")
        # A message may begin at any byte.
        anywhere = max(len(content) - _MESSAGE.itemsize + 1, 0)
        messages = np.ndarray((anywhere,), _MESSAGE, content, strides=(1,))
        self.channels, self.times = messages["channel"][starts], messages["time"][starts]
        self.starts, self.ends = starts + _MESSAGE.itemsize, ends


def _edges(content: bytes) -> NDArray[np.int32]:
    """Where each of k records begins, and the last one ends, shape (k + 1,) [bytes].

    Raises:
        ValueError: If a record is torn.
    """
    length_at, header, size = _LENGTH.unpack_from, _RECORD.size, len(content)  # for every record
    edge, edges = 0, [0]
    while edge < size:
        edge += header + length_at(content, edge + 1)[0]
        edges.append(edge)
    if edge > size:
        raise ValueError("a record is torn")
    return np.array(edges, np.int32)


def _records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of every record; raises an error if one is torn."""
    end = 0
    while end < len(content):
        opcode, size = _RECORD.unpack_from(content, end)
        start = end + _RECORD.size
        end = start + size
        if end > len(content):
            raise ValueError("a record is torn")
        yield opcode, start, end


def _definition(opcode: int, content: bytes) -> Schema | Channel:
    stream = ReadDataStream(io.BytesIO(content))
    return Schema.read(stream) if opcode == Opcode.SCHEMA else Channel.read(stream)


def _connections(definitions: list[Schema | Channel], counts: Counter[int]) -> list[Connection]:
    """The channels of known type, with their counts."""
    schemas = {record.id: record.name for record in definitions if isinstance(record, Schema)}
    schemas.setdefault(0, "none")  # 0: no schema, by the format
    channels = {record.id: record for record in definitions if isinstance(record, Channel)}
    return [
        Connection(channel.id, channel.topic, schemas[channel.schema_id], counts[channel.id])
        for channel in channels.values()
        if channel.schema_id in schemas
    ]
