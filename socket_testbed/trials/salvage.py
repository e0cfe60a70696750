"""Recordings that were cut short, read up to their last whole chunk as if they had an end.

A recorder that was killed, a power cut or a full disk leaves an MCAP file without its index and
end, often with a torn chunk last. The whole chunks are found by the headers of the records, and
the library is given the file up to the last of them with an index and an end from memory:
nothing is copied or written. The format: https://mcap.dev/spec.
"""

from __future__ import annotations

import io
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from rosbags.rosbag2.storage_mcap import decompress

from socket_testbed.errors import TrialError

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")  # opcode, length of the content [bytes]
_CHUNK = struct.Struct("<QQQII")  # first and last time [ns], size, checksum, length of a name
_FOOTER = _RECORD.pack(2, 20)
_END_SIZE = _RECORD.size + 20 + len(_MAGIC)
_LEAST_MESSAGE = 22  # [bytes]
_LONGEST_NAME = 16  # of a compression
_SECTOR = 512  # [bytes]; a disk has all of it or nothing


class _Opcode(IntEnum):
    HEADER = 1
    FOOTER = 2
    SCHEMA = 3
    CHANNEL = 4
    MESSAGE = 5
    CHUNK = 6
    MESSAGE_INDEX = 7
    CHUNK_INDEX = 8
    STATISTICS = 11
    DATA_END = 15


@dataclass
class _Chunk:
    """A chunk as its record says; offsets and sizes in bytes, times in ns."""

    start: int
    end: int
    first_time: int
    last_time: int
    size: int
    checksum: int
    compression: bytes
    data: int
    counts: dict[int, int]  # messages by channel
    index_end: int  # of the indexes of its messages, behind it


class SalvagedFile:
    """The whole part of a recording that was cut short; the library takes it for a path.

    Attributes:
        path: The file.
        messages: Number of messages saved.
        note: What was saved and what was not, in one line.
    """

    suffix = ".mcap"

    def __init__(self, path: Path, chunks: list[_Chunk], torn: int, complete: bool) -> None:
        self.path = path
        self.messages = sum(sum(chunk.counts.values()) for chunk in chunks)
        self.note = f"{self._saved(chunks)}, {_missing(torn, complete)}"
        self._length = chunks[-1].end
        self._end = _index_and_end(chunks)

    def __str__(self) -> str:
        return str(self.path)

    def _saved(self, chunks: list[_Chunk]) -> str:
        first = min(chunk.first_time for chunk in chunks if chunk.counts)
        last = max(chunk.last_time for chunk in chunks if chunk.counts)
        until = datetime.fromtimestamp(last * 1e-9).strftime("%H:%M:%S")
        return (
            f"the recording {self.path.name} was cut short (no end): {self.messages} messages"
            f" up to {until} ({(last - first) * 1e-9:.1f} s) were saved"
        )

    def exists(self) -> bool:
        """Whether there is such a file."""
        return self.path.exists()

    def is_dir(self) -> bool:
        """Whether it is a folder: never."""
        return False

    def open(self, mode: str = "rb") -> BinaryIO:
        """The file up to its last whole chunk, with an index and an end."""
        assert mode == "rb"
        file = self.path.open("rb", buffering=0)
        return io.BufferedReader(_Joined(file, self._length, self._end))


def _missing(torn: int, complete: bool) -> str:
    """What was not saved."""
    if complete:
        return "none is missing"
    unread = f" ({torn} bytes cannot be read)" if torn else ""
    return f"the last second may be missing{unread}"


class _Joined(io.RawIOBase):
    """The first bytes of a file, followed by others from memory."""

    def __init__(self, file: io.FileIO, length: int, end: bytes) -> None:
        self._file = file
        self._length = length
        self._end = end
        self._position = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        origin = (0, self._position, self._length + len(self._end))[whence]
        self._position = origin + offset
        return self._position

    def readinto(self, buffer: WriteableBuffer, /) -> int:
        view = memoryview(buffer).cast("B")
        left = self._length - self._position
        if left > 0:
            self._file.seek(self._position)
            count = self._file.readinto(view[:left])
        else:
            rest = self._end[-left : len(view) - left]
            count = len(rest)
            view[:count] = rest
        self._position += count
        return count

    def close(self) -> None:
        self._file.close()
        super().close()


def salvage(path: Path) -> SalvagedFile | None:
    """What can be read of an MCAP file that was cut short.

    Args:
        path: The file; it is only read.

    Returns:
        Its whole part; None for a file that has its end, or that is no MCAP file.

    Raises:
        TrialError: If not one whole chunk with a message is there.
        OSError: If the file cannot be read.
    """
    with path.open("rb") as file:
        size = file.seek(0, io.SEEK_END)
        if not _is_cut_short(file, size):
            return None
        chunks, complete = _find_chunks(file, size)
        # Before its size reaches the disk, a chunk may have zeros or old blocks for its content.
        # That is so only for what was not flushed: from the back, the first sound one ends it.
        while chunks and not _is_sound(file, chunks[-1]):
            chunks.pop()
            complete = False
        for chunk in chunks:
            if not chunk.counts:  # recorded without indexes
                _count_messages(file, chunk)
    if not any(chunk.counts for chunk in chunks):
        raise TrialError(
            f"{path}: is truncated (it has no end, and no whole chunk of messages)",
            "record the trial again; 'mcap recover' may still find a part of it",
        )
    return SalvagedFile(path, chunks, size - chunks[-1].index_end, complete)


def _is_cut_short(file: BinaryIO, size: int) -> bool:
    """Whether a file starts as MCAP, if anything of its start is there, and does not end so."""
    file.seek(0)
    if not _MAGIC.startswith(file.read(len(_MAGIC)).rstrip(b"\0")):
        return False
    if size < len(_MAGIC) + _END_SIZE:
        return True
    file.seek(-_END_SIZE, io.SEEK_END)
    end = file.read()
    return not (end.startswith(_FOOTER) and end.endswith(_MAGIC))


def _find_chunks(file: BinaryIO, size: int) -> tuple[list[_Chunk], bool]:
    """The chunks by their headers, and whether all messages are before the end of the file."""
    chunks: list[_Chunk] = []
    for opcode, start, end in _records(file, len(_MAGIC), size):
        if opcode in (_Opcode.DATA_END, _Opcode.FOOTER):
            return chunks, True
        if opcode == _Opcode.CHUNK:
            chunk = _read_chunk(file, start, end)
            if chunk is None:
                break
            chunks.append(chunk)
        elif opcode == _Opcode.MESSAGE_INDEX and chunks:
            channel = int.from_bytes(file.read(2), "little")
            chunks[-1].counts[channel] = (end - start - _RECORD.size - 6) // 16
            chunks[-1].index_end = end
    return chunks, False


def _records(file: BinaryIO, start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end [bytes] of each whole record, up to the first that is none.

    Whenever one is yielded, the file stands at its content.
    """
    while start + _RECORD.size <= end:
        file.seek(start)
        opcode, length = _RECORD.unpack(file.read(_RECORD.size))
        following = start + _RECORD.size + length
        if opcode == 0 or following > end:
            return
        yield opcode, start, following
        start = following


def _read_chunk(file: BinaryIO, start: int, end: int) -> _Chunk | None:
    """The header of a chunk without its counts; None if it contradicts its record."""
    if end - start < _RECORD.size + _CHUNK.size + 8:
        return None
    first, last, size, checksum, name_length = _CHUNK.unpack(file.read(_CHUNK.size))
    if name_length > _LONGEST_NAME:
        return None
    name = file.read(name_length)
    data = start + _RECORD.size + _CHUNK.size + name_length + 8
    if data + int.from_bytes(file.read(8), "little") != end:
        return None
    return _Chunk(start, end, first, last, size, checksum, name, data, {}, end)


def _is_sound(file: BinaryIO, chunk: _Chunk) -> bool:
    """Whether the last chunk's content is whole; it is counted, because its index may be torn."""
    return not _may_end_in_a_gap(file, chunk) and _count_messages(file, chunk)


def _may_end_in_a_gap(file: BinaryIO, chunk: _Chunk) -> bool:
    """Whether zeros at the end of a chunk may be what a power cut left of its last message."""
    file.seek(chunk.data)
    content = file.read(chunk.end - chunk.data)
    zeros_from = chunk.data + len(content.rstrip(b"\0"))
    if zeros_from == chunk.end:
        return False
    following = file.read(1)
    last_sector = (chunk.end - 1) // _SECTOR * _SECTOR
    return following == b"\0" or (following == b"" and zeros_from <= last_sector)


def _count_messages(file: BinaryIO, chunk: _Chunk) -> bool:
    """Count a chunk's messages by channel; False if its content is no sequence of records."""
    file.seek(chunk.data)
    data = file.read(chunk.end - chunk.data)
    try:
        records = decompress(data, chunk.compression.decode(), chunk.size, chunk.checksum)
    except Exception:  # the libraries raise whatever the bytes lead them to
        return False
    content = io.BytesIO(records)
    chunk.counts = Counter()
    whole = 0
    for opcode, start, end in _records(content, 0, len(records)):
        if opcode == _Opcode.MESSAGE and end - start >= _RECORD.size + _LEAST_MESSAGE:
            chunk.counts[int.from_bytes(content.read(2), "little")] += 1
        elif opcode not in (_Opcode.SCHEMA, _Opcode.CHANNEL):
            return False
        whole = end
    return whole == len(records)


def _index_and_end(chunks: list[_Chunk]) -> bytes:
    """What a recorder that closes the file after these chunks would write, but for the counts.

    With statistics but no schema here, the library goes through the chunks, one at a time, for
    schemas, channels and counts; it then reads in the order of time by this index.
    """
    records = [_record(_Opcode.CHUNK_INDEX, _index_entry(chunk)) for chunk in chunks]
    records.append(_record(_Opcode.STATISTICS, bytes(46)))
    records.append(_record(_Opcode.FOOTER, struct.pack("<QQI", chunks[-1].end, 0, 0)))
    return b"".join([*records, _MAGIC])


def _index_entry(chunk: _Chunk) -> bytes:
    """A chunk index, with the messages' own indexes where they belong, behind the chunk."""
    offsets, position = b"", chunk.end
    for channel, count in chunk.counts.items():
        offsets += struct.pack("<HQ", channel, position)
        position += _RECORD.size + 6 + 16 * count
    fields = (
        struct.pack("<QQ", chunk.first_time, chunk.last_time),
        struct.pack("<QQ", chunk.start, chunk.end - chunk.start),
        struct.pack("<I", len(offsets)) + offsets,
        struct.pack("<QI", position - chunk.end, len(chunk.compression)) + chunk.compression,
        struct.pack("<QQ", chunk.end - chunk.data, chunk.size),
    )
    return b"".join(fields)


def _record(opcode: int, content: bytes) -> bytes:
    return _RECORD.pack(opcode, len(content)) + content
