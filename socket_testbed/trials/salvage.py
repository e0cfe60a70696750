"""Recordings that were cut short or damaged, of which every sound chunk is read.

A recorder that was killed, a power cut or a full disk leaves an MCAP file without its index and
end, often with a torn chunk last; a bad disk or copy changes bytes anywhere. The chunks are found
by their headers, or by the file's index where that has more of them, and read with the MCAP
library, which checks each chunk's checksum. What the library lacks is here: lengths are checked
before anything is read, and a chunk without a checksum has to consist of whole records. The file is
only read. The format: https://mcap.dev/spec.
"""

from __future__ import annotations

import heapq
import io
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import BinaryIO, Self

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Message, Schema
from mcap.stream_reader import get_chunk_data_stream
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)

from socket_testbed.errors import TrialError

_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")  # opcode, length of the content [bytes]
_FOOTER = _RECORD.pack(Opcode.FOOTER, 20)
_END_SIZE = _RECORD.size + 20 + len(_MAGIC)
_CHUNK_FIELDS = 8 + 8 + 8 + 4 + 4 + 8  # [bytes] of a chunk besides its data and a name
_LARGEST_CHUNK = 2**28  # [bytes]; recorders write 1 MiB, a larger length is a lie

_HINT = "copy the trial again if it is whole elsewhere"


class _Chunk:
    """A chunk of the file and what it holds."""

    def __init__(self, file: BinaryIO, start: int, end: int, index_end: int) -> None:
        self.start = start  # [bytes]; of its content
        self.end, self.index_end = end, index_end  # [bytes]; and of its messages' indexes behind it
        self.sound = True  # all of it can be read
        try:
            records = list(_read_chunk(file, start, end))
        except Exception:  # the libraries raise whatever the bytes lead them to
            records, self.sound = [], False
        messages = [record for record in records if isinstance(record, Message)]
        self.counts = Counter(message.channel_id for message in messages)
        self.first_time = min((message.log_time for message in messages), default=0)  # [ns]
        self.last_time = max((message.log_time for message in messages), default=0)  # [ns]
        self.definitions = [record for record in records if not isinstance(record, Message)]


class SalvagedRecording:
    """The complete part of a recording that was cut short; it is used like a reader of rosbags.

    Attributes:
        path: The file.
        note: What was read and what was not, in one line.
        connections: The topics with their message types and counts.
        message_count: Number of messages saved.
        start_time: Time of the first message since the epoch [ns].
        end_time: Time of the last message since the epoch, and one [ns].

    Raises:
        TrialError: If there is no complete chunk with a message, or what its topics are is lost.
        OSError: If the file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("rb")
        try:
            size = self._file.seek(0, io.SEEK_END)
            found, complete = self._find_chunks(size)
        except BaseException:
            self._file.close()
            raise
        self._chunks = [chunk for chunk in found if chunk.sound]
        self.start_time = min(chunk.first_time for chunk in self._chunks if chunk.counts)
        self.end_time = max(chunk.last_time for chunk in self._chunks if chunk.counts) + 1
        definitions = [r for chunk in self._chunks for r in chunk.definitions]
        self.connections = _connections(self._index.definitions + definitions, self._chunks, self)
        self.message_count = sum(chunk.counts.total() for chunk in self._chunks)
        if sum(connection.msgcount for connection in self.connections) < self.message_count:
            self._file.close()
            raise TrialError(f"{path}: is damaged, what its topics are is lost", _HINT)
        torn = size - self._chunks[-1].index_end
        self.note = self._describe_cut(torn, complete)
        if self._index.ended or len(found) > len(self._chunks):
            self.note = self._describe_damage(found)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def messages(
        self, connections: Collection[Connection]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """The messages of some connections in the order of their times [ns], chunk by chunk."""
        wanted = {connection.id: connection for connection in connections}
        parts = [self._messages_of(chunk, wanted) for chunk in self._chunks]
        for time, message in heapq.merge(*parts, key=lambda part: part[0]):
            if message is not None:
                yield wanted[message.channel_id], time, message.data

    def _messages_of(
        self, chunk: _Chunk, wanted: Collection[int]
    ) -> Iterator[tuple[int, Message | None]]:
        """The messages of a chunk, with their times; first its time, for which it is not read."""
        yield chunk.first_time, None
        records = _read_chunk(self._file, chunk.start, chunk.end)
        messages = [r for r in records if isinstance(r, Message) and r.channel_id in wanted]
        for message in sorted(messages, key=lambda message: message.log_time):
            yield message.log_time, message

    def _find_chunks(self, size: int) -> tuple[list[_Chunk], bool]:
        """The chunks up to the last sound one, and whether that is all of the recording."""
        self._index = _Index(self._file)
        ranges, complete = _walk(self._file, size)
        chunks = [_Chunk(self._file, *place) for place in ranges]
        if self._index.ranges != ranges:
            listed = [_Chunk(self._file, *place) for place in self._index.ranges]
            if sum(c.counts.total() for c in listed) > sum(c.counts.total() for c in chunks):
                chunks = listed
        if not self._index.ended:
            # Before its size reaches the disk, a chunk may have zeros or old blocks for content.
            # That is so only for what was not flushed: from the back, the first sound one ends it.
            while chunks and not chunks[-1].sound:
                chunks.pop()
                complete = False
        if not any(chunk.counts for chunk in chunks):
            if _ends_with_its_header(self._file):
                raise TrialError(
                    f"{self.path}: holds nothing: its recorder was ended before anything was on the"
                    " disk",
                    "remove it, or copy the trial again if it is complete elsewhere",
                )
            if self._index.ended:
                raise TrialError(f"{self.path}: is damaged, nothing in it can be read", _HINT)
            raise TrialError(
                f"{self.path}: is truncated (it has no end, and no complete chunk of messages)",
                "record the trial again; 'mcap recover' may still find a part of it",
            )
        return chunks, complete

    def _describe_cut(self, torn: int, complete: bool) -> str:
        """What was saved and what was not; torn is what follows the chunks [bytes]."""
        until = datetime.fromtimestamp((self.end_time - 1) * 1e-9).strftime("%H:%M:%S")
        unread = f" ({torn} bytes cannot be read)" if torn else ""
        return (
            f"the recording {self.path.name} was cut short (no end): {self.message_count} messages"
            f" up to {until} ({(self.end_time - 1 - self.start_time) * 1e-9:.1f} s) were saved, "
            + ("none is missing" if complete else f"the last second may be missing{unread}")
        )

    def _describe_damage(self, found: list[_Chunk]) -> str:
        """What is missing where chunks cannot be read."""
        gaps: list[str] = []
        end = "the start"
        known = self._index.times if self._index.sound else []
        start = min([self.start_time, *(time for time, _ in known)])
        for sound, run in groupby(found, key=lambda chunk: chunk.sound):
            chunks = list(run)
            first, last = (
                f"{1e-9 * (time - start):.2f} s"
                for time in (chunks[0].first_time, chunks[-1].last_time)
            )
            if sound:
                gaps = [gap.replace("...", first) for gap in gaps]
                end = last
            else:
                gaps.append(f"from {end} to ...")
        lost = len(found) - len(self._chunks)
        missing = ", ".join(gaps).replace("...", "the end")
        return f"the recording {self.path.name} is damaged: " + (
            f"{lost} of its {len(found)} chunks cannot be read, what is missing is {missing}"
            f" ({_HINT})"
            if lost
            else f"no message is missing ({_HINT})"
        )


class _Index:
    """What the end of a file says of its chunks and topics; nothing where it cannot be read.

    Attributes:
        ended: Whether the file has its end.
        sound: Whether its checksum is right, where it has one.
        ranges: Starts and ends of the chunks' contents and ends of their indexes [bytes].
        definitions: The schemas and channels.
    """

    def __init__(self, file: BinaryIO) -> None:
        self.ranges: list[tuple[int, int, int]] = []
        self.times: list[tuple[int, int]] = []
        self.definitions: list[Schema | Channel] = []
        self.sound = self.ended = _has_end(file)
        if not self.ended:
            return
        try:
            self._read(file)
        except Exception:  # the library raises whatever the bytes lead it to
            self.sound = False

    def _read(self, file: BinaryIO) -> None:
        end = file.seek(-len(_MAGIC) - 4, io.SEEK_END)
        footer_start = file.seek(-_END_SIZE, io.SEEK_END)
        start, _, checksum = struct.unpack("<QQI", file.read(_END_SIZE)[_RECORD.size :][:20])
        if not start:
            return
        if not 0 < start <= footer_start:
            raise ValueError("the index is nowhere")
        file.seek(start)
        content = file.read(end - start)
        if checksum and zlib.crc32(content) != checksum:
            raise ValueError("the index has another checksum")
        stream = ReadDataStream(io.BytesIO(content))
        while stream.count < footer_start - start:
            opcode, size = stream.read1(), stream.read8()
            record = ReadDataStream(io.BytesIO(stream.read(size)))
            if opcode == Opcode.SCHEMA:
                self.definitions.append(Schema.read(record))
            elif opcode == Opcode.CHANNEL:
                self.definitions.append(Channel.read(record))
            elif opcode == Opcode.CHUNK_INDEX:
                chunk = ChunkIndex.read(record)
                stop = chunk.chunk_start_offset + chunk.chunk_length
                place = chunk.chunk_start_offset + _RECORD.size, stop
                self.ranges.append((*place, stop + chunk.message_index_length))
                self.times.append((chunk.message_start_time, chunk.message_end_time))


def _has_end(file: BinaryIO) -> bool:
    if file.seek(0, io.SEEK_END) < len(_MAGIC) + _END_SIZE:
        return False
    file.seek(-_END_SIZE, io.SEEK_END)
    end = file.read()
    return end.startswith(_FOOTER) and end.endswith(_MAGIC)


def _walk(file: BinaryIO, size: int) -> tuple[list[tuple[int, int, int]], bool]:
    """The chunks by the headers of the records, and whether all messages are before the end."""
    ranges: list[tuple[int, int, int]] = []
    position = len(_MAGIC)
    while position + _RECORD.size <= size:
        file.seek(position)
        opcode, length = _RECORD.unpack(file.read(_RECORD.size))
        start, position = position + _RECORD.size, position + _RECORD.size + length
        # A recorder that writes chunks writes no messages beside them.
        if position > size or opcode in (0, Opcode.MESSAGE):
            break
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return ranges, True
        if opcode == Opcode.CHUNK:
            ranges.append((start, position, position))
        elif opcode == Opcode.MESSAGE_INDEX and ranges:
            ranges[-1] = (*ranges[-1][:2], position)
    return ranges, False


def check_sums(path: Path) -> tuple[bool, bool]:
    """Whether an MCAP file is sound, with its end and right checksums, and whether it has these.

    What is no MCAP file is not judged.
    """
    with path.open("rb") as file:
        if not _MAGIC.startswith(file.read(len(_MAGIC)).rstrip(b"\0")) and not _has_end(file):
            return True, True
        index = _Index(file)
        ranges, complete = _walk(file, file.seek(0, io.SEEK_END))
        if not (index.sound and complete) or index.ranges not in ([], ranges):
            return False, False
        try:
            chunks = [_unpack(file, start, end)[0] for start, end, _ in ranges]
        except Exception:  # the libraries raise whatever the bytes lead them to
            return False, False
        times = [(chunk.message_start_time, chunk.message_end_time) for chunk in chunks]
        return index.times in ([], times), all(chunk.uncompressed_crc for chunk in chunks)


def holds_nothing(folder: Path) -> bool:
    """Whether a recording was cut short before anything of a message was on the disk.

    So does a recorder leave it that is killed while it starts. A folder with a `metadata.yaml` is
    none of them: its files may be complete elsewhere.
    """
    files = list(folder.glob("*.mcap"))
    if not files or (folder / "metadata.yaml").exists():
        return False
    for path in files:
        with path.open("rb") as file:
            if not _ends_with_its_header(file):
                return False
    return True


def _ends_with_its_header(file: BinaryIO) -> bool:
    """Whether there is no more of an MCAP file than its first record, or a part of that."""
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    start = file.read(len(_MAGIC) + _RECORD.size)
    if len(start) < len(_MAGIC) + _RECORD.size:
        return _MAGIC.startswith(start[: len(_MAGIC)])
    opcode, length = _RECORD.unpack(start[len(_MAGIC) :])
    return start.startswith(_MAGIC) and opcode == Opcode.HEADER and size <= len(start) + length


def _read_chunk(file: BinaryIO, start: int, end: int) -> Iterator[Schema | Channel | Message]:
    """The records of the chunk whose content stands there; raises unless all of it is sound.

    The library's `breakup_chunk` accepts a torn last record and leaves out unknown ones.
    """
    _, stream, length = _unpack(file, start, end)
    while stream.count < length:
        opcode, size = stream.read1(), stream.read8()
        end = stream.count + size
        record: Schema | Channel | Message
        if opcode == Opcode.MESSAGE:
            record = Message.read(stream, size)
        elif opcode == Opcode.CHANNEL:
            record = Channel.read(stream)
        elif opcode == Opcode.SCHEMA:
            record = Schema.read(stream)
        else:
            raise ValueError("the chunk holds another record")
        if not stream.count <= end <= length:
            raise ValueError("the chunk ends within a record")
        stream.read(end - stream.count)  # fields of a later version of the format
        yield record


def _unpack(file: BinaryIO, start: int, end: int) -> tuple[Chunk, ReadDataStream, int]:
    """The chunk whose content stands there, its records and their length [bytes]."""
    file.seek(start)
    if not 0 <= end - start <= _LARGEST_CHUNK:
        raise ValueError("the chunk is too large")
    chunk = Chunk.read(ReadDataStream(io.BytesIO(file.read(end - start))))
    if _CHUNK_FIELDS + len(chunk.compression) + len(chunk.data) != end - start:
        raise ValueError("the chunk does not fill its record")
    if chunk.uncompressed_size > _LARGEST_CHUNK:
        raise ValueError("the chunk is too large once unpacked")
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    if length != chunk.uncompressed_size:
        raise ValueError("the chunk has another size")
    chunk.data = b""
    return chunk, stream, length


def _connections(
    definitions: list[Schema | Channel], chunks: list[_Chunk], owner: object
) -> list[Connection]:
    """The channels of some chunks as rosbags describes them, with their counts."""
    schemas = {record.id: record.name for record in definitions if isinstance(record, Schema)}
    channels = {record.id: record for record in definitions if isinstance(record, Channel)}
    counts = sum((chunk.counts for chunk in chunks), Counter[int]())
    return [
        Connection(
            id=channel.id,
            topic=channel.topic,
            msgtype=schemas[channel.schema_id],
            msgdef=MessageDefinition(MessageDefinitionFormat.NONE, ""),
            digest="",
            msgcount=counts[channel.id],
            ext=ConnectionExtRosbag2(channel.message_encoding, []),
            owner=owner,
        )
        for channel in channels.values()
    ]
