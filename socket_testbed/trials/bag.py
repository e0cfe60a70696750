"""Bags: rosbag2 folders (MCAP or SQLite) and their message types, without ROS.

Storage files are read directly: a reader that trusts `metadata.yaml` silently yields nothing if
the two disagree on a topic's quality of service. Their message counts are compared instead.
"""

from __future__ import annotations

import os
import re
import zlib
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

from backports import zstd
from rosbags import interfaces
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from socket_testbed.documents import load_yaml
from socket_testbed.errors import TrialError
from socket_testbed.files import TemporaryFolder, hold, sync
from socket_testbed.trials.cdr import typestore
from socket_testbed.trials.mcap_file import COPY_AGAIN, GIVE_BAG, McapFile, is_empty
from socket_testbed.trials.topics import POSES, REQUIRED, TOPICS, Topic, match_topics

_COMPRESSED_SUFFIX = ".zstd"
_STORAGE_SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # an uncompressed message begins with a zero
_MAX_UNPACKED = 2**28  # [bytes]; size limit of an unpacked file, or
_MAX_RATIO = 500  # times the packed size; recorders reach 20
_BLOCK_SIZE = 4096  # messages decoded at once
_FOREVER = interfaces.QosTime(2147483647, 4294967295)
_CHUNK_SIZE = 2**20 - 2**10  # [bytes]; the library closes a chunk at 1 MiB
_CHUNK_SPAN = 10**9  # [ns]; damage loses a whole chunk
_INDEX_CHECKSUM_OFFSET = 4 + 8  # [bytes] from the end of the file
_CHUNK_CHECKSUM_OFFSET = 9 + 3 * 8  # [bytes] from the start of a chunk's record


class RawMessage(NamedTuple):
    """A recorded message.

    Attributes:
        topic: Its topic's full name in the recorded graph, such as `/trigger`.
        type: Its type, as `package/msg/Type`.
        time: When the recorder received it, since the epoch [ns]; not the stamp in its header.
        data: Its content, serialised (CDR) and uncompressed.
    """

    topic: str
    type: str
    time: int
    data: bytes


class BagReader:
    """A bag (folder or one storage file), read in recording order; a context manager.

    Every intact chunk of a truncated or damaged recording is read.

    Attributes:
        path: The folder or storage file.
        notes: Damage and other remarks for the user, one line each; complete after entry.

    Raises:
        TrialError: On entry, if the bag is missing, unreadable, truncated before its first complete
            chunk, or its message counts differ from its metadata.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stack = ExitStack()
        self._readers: list[tuple[Path, Any]] = []  # of rosbags, or an McapFile
        self.notes: list[str] = []

    def __enter__(self) -> Self:
        metadata = _read_metadata(self.path)
        with self._stack:  # closes the files after an error
            for file in self._storage_files(metadata):
                self._readers.append((file, self._open(file)))
            if metadata is not None:
                self._compare(metadata[1])
            self._stack = self._stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    @property
    def counts(self) -> dict[str, int]:
        """Number of readable messages by the topic's full name, from the storage files."""
        counts: dict[str, int] = defaultdict(int)
        for _, reader in self._readers:
            for connection in reader.connections:
                counts[connection.topic] += connection.msgcount
        return dict(counts)

    @property
    def types(self) -> dict[str, str]:
        """Message type, as `package/msg/Type`, by the topic's full name."""
        return {c.topic: c.msgtype for _, reader in self._readers for c in reader.connections}

    @property
    def duration(self) -> float:
        """Time from the first to the last message [s]; 0 for an empty bag."""
        spans = [(r.start_time, r.end_time) for _, r in self._readers if r.message_count]
        if not spans:
            return 0.0
        return (max(end for _, end in spans) - min(start for start, _ in spans) - 1) * 1e-9

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """The messages of some topics, given by full name, or of all (None), in recording order.

        Raises:
            TrialError: If a storage file is damaged where it is read, or holds fewer messages than
                its index lists.
        """
        for file, reader in self._readers:
            connections = [c for c in reader.connections if topics is None or c.topic in topics]
            if not connections:
                continue
            left = {connection.id: connection.msgcount for connection in connections}
            try:
                for connection, time, data in reader.messages(connections):
                    left[connection.id] -= 1
                    content = bytes(data)
                    if content.startswith(_ZSTD_MAGIC):
                        content = zstd.decompress(content)
                    yield RawMessage(connection.topic, connection.msgtype, time, content)
            except Exception as error:  # the library may raise any exception
                raise _damaged(file, error) from None
            if lacking := sum(left.values()):
                raise TrialError(
                    f"{file}: is damaged: its index lists {lacking} more messages than can be read",
                    COPY_AGAIN,
                )

    def blocks(self, topics: Collection[str]) -> Iterator[tuple[str, list[bytes]]]:
        """The messages of some topics, given by full name, in blocks that bound the memory.

        Yields:
            A topic's full name, and the contents (CDR) of up to 4096 of its messages, in recording
            order within the topic.
        """
        blocks: dict[str, list[bytes]] = defaultdict(list)
        for topic, _, _, data in self.messages(topics):
            blocks[topic].append(data)
            if len(blocks[topic]) == _BLOCK_SIZE:
                yield topic, blocks.pop(topic)
        yield from blocks.items()

    def _storage_files(self, metadata: tuple[list[str], Any] | None) -> list[Path]:
        if self.path.is_file():
            return [self.path]
        if metadata is None:
            found = sorted(filter(is_storage, self.path.iterdir()), key=_by_number)
            files = [file for file in found if file.suffix != _COMPRESSED_SUFFIX] or found
            self.notes.append("no metadata.yaml: the storage files were read as they are")
        else:
            files = [self.path / name for name in metadata[0]]
        if not files:
            raise TrialError(f"{self.path}: holds no .mcap or .db3 file", "give a trial's folder")
        for file in files:
            if not file.is_file():
                hint = "copy all of the folder, or make metadata.yaml again with 'ros2 bag reindex'"
                raise TrialError(f"{file}: is named in metadata.yaml but is not there", hint)
        return files

    def _open(self, file: Path) -> Reader | McapFile:
        path = self._unpack(file) if file.suffix == _COMPRESSED_SUFFIX else file
        if path.suffix == ".mcap":
            recording = McapFile(self._stack.enter_context(path.open("rb")), file)
            self.notes += recording.notes
            return recording
        journal = file.with_name(file.name + "-wal")  # of SQLite
        if journal.exists() and journal.stat().st_size:
            self.notes.append(
                f"{journal.name}, which may hold the newest messages, is not read:"
                f" 'sqlite3 {file} vacuum' takes them in"
            )
        self.notes.append(f"{path.name} has no checksums: damage cannot be detected")
        try:
            return self._stack.enter_context(Reader(path))
        except Exception as error:  # the library may raise any exception
            raise _damaged(file, error) from None

    def _unpack(self, file: Path) -> Path:
        """A storage file, unpacked into a folder that lives as long as this reader."""
        folder = self._stack.enter_context(TemporaryFolder())
        unpacked = Path(folder) / file.stem
        left = max(_MAX_UNPACKED, _MAX_RATIO * file.stat().st_size)
        try:
            with zstd.open(file, "rb") as source, unpacked.open("wb") as target:
                while content := source.read(2**20):
                    left -= target.write(content)
                    if left < 0:
                        raise ValueError("it is too large once unpacked")
        except EOFError:
            raise TrialError(f"{file}: is truncated", "copy the trial again") from None
        except (OSError, ValueError, zstd.ZstdError) as error:
            raise _damaged(file, error) from None
        return unpacked

    def _compare(self, promised: Mapping[str, int]) -> None:
        """Compare the counts in metadata.yaml with those of the files."""
        counts = self.counts
        # A truncated or damaged recording has fewer messages, which its note reports.
        lacks = any(isinstance(r, McapFile) and r.lacks for _, r in self._readers)
        for name, count in promised.items():
            held = counts.get(name, 0)
            if held != count and not (lacks and held < count):
                raise TrialError(
                    f"{self.path}: metadata.yaml lists {count} messages on {name},"
                    f" the storage file holds {held}",
                    "copy the trial again, or write metadata.yaml again with 'ros2 bag reindex'",
                )
        if sum(promised.values()) > sum(counts.values()):
            self.notes.append(
                f"metadata.yaml lists {sum(promised.values())} messages: copy the trial again if it"
                " is complete elsewhere"
            )


def required_topics(bag: BagReader) -> dict[Topic, str]:
    """The bag's full name of each of the testbed's topics that it holds.

    A trial without motion capture has no poses: clusters and load cell give a force map alone.

    Raises:
        TrialError: If the bag holds no message, or a required topic other than a pose is missing,
            empty or of another type.
    """
    topics, counts, types = match_topics(bag.types, str(bag.path)), bag.counts, bag.types
    if not any(counts.values()):
        raise TrialError(f"{bag.path}: holds no message", "record the trial again")
    for topic in REQUIRED:
        if topic in POSES.values() and not counts.get(topics.get(topic, "")):
            continue
        if topic not in topics:
            fact, hint = f"has no topic '{topic.name}'", "record all of them with 'record'"
        elif counts[name := topics[topic]] == 0:
            fact, hint = f"'{name}' holds no message", "check that its node ran and record again"
        elif types[name] != topic.type:
            fact, hint = f"'{name}' is a {types[name]}", f"record it as {topic.type}"
        else:
            continue
        raise TrialError(f"{bag.path}: {fact}", hint)
    return {topic: topics[topic] for topic in TOPICS if topic in topics}


def _by_number(file: Path) -> list[tuple[int, str]]:
    """Orders the parts of a bag as written: bag_2 before bag_10."""
    parts = re.split(r"(\d+)", file.name)
    return [(int(part) if part.isdecimal() else 0, part) for part in parts]


def _read_metadata(bag: Path) -> tuple[list[str], dict[str, int]] | None:
    """Names of a bag's files and message counts by topic; None without metadata.yaml."""
    if not (bag.is_dir() or bag.is_file()):
        fact = "is neither a folder nor a file" if bag.exists() else "no such trial"
        raise TrialError(f"{bag}: {fact}", "check the path")
    file = bag / BAG_METADATA
    if not file.exists():
        return None
    try:
        content = load_yaml(file)["rosbag2_bagfile_information"]
        counts = {
            str(entry["topic_metadata"]["name"]): int(entry["message_count"])
            for entry in content.get("topics_with_message_count") or []
        }
        files = [Path(str(name)).name for name in content.get("relative_file_paths") or []]
        compression = str(content.get("compression_format") or "zstd")
    except Exception:  # the libraries may raise any exception
        raise TrialError(
            f"{file}: is not rosbag2 metadata", "write it again with 'ros2 bag reindex'"
        ) from None
    if compression != "zstd":
        raise TrialError(
            f"{bag}: is compressed with '{compression}'",
            "unpack it with 'ros2 bag convert', to zstd or to no compression",
        )
    return files, counts


BAG_METADATA = "metadata.yaml"  # of a closed bag


def is_bag(folder: Path) -> bool:
    """Whether a folder is a bag, even if broken or still written."""
    return folder.is_dir() and any(
        f.name == BAG_METADATA or is_storage(f) for f in folder.iterdir()
    )


def holds_nothing(folder: Path) -> bool:
    """Whether a recording was truncated before any message reached the disk.

    This happens when a recorder is killed during its start. A folder with a `metadata.yaml` does
    not count: its files may be complete elsewhere.
    """
    files = list(folder.glob("*.mcap"))
    return bool(files) and not (folder / BAG_METADATA).exists() and all(map(is_empty, files))


def find_trials(folder: Path, notify: Callable[[str], None] = lambda note: None) -> dict[str, Path]:
    """Find the trials below a folder, at any depth.

    Hidden folders and folders inside a trial are skipped; links are followed. Empty recordings,
    whose recorder was killed during its start, are left out with a note.

    Args:
        folder: Where to look; it may itself be a trial, a file, or missing.
        notify: Called with one line for each empty recording; by default they are left out
            silently.

    Returns:
        The trials' folders by name, which is the path below the folder, such as `s01/hold`. Empty
        if the folder is itself a trial or is not a folder.

    Raises:
        TrialError: If a folder cannot be read.
    """
    try:
        if not folder.is_dir() or is_bag(folder):
            return {}
        found = {path.relative_to(folder).as_posix(): path for path in _walk(folder, ())}
        empty = sorted(name for name, path in found.items() if holds_nothing(path))
    except OSError as error:
        fact = f"{error.filename}: cannot be read ({error.strerror})"
        raise TrialError(fact, "check the permissions") from None
    for name in empty:
        notify(f"{name} is left out: it holds nothing, its recorder was killed while it started")
        del found[name]
    return dict(sorted(found.items()))


def _walk(folder: Path, above: tuple[Path, ...]) -> Iterator[Path]:
    real = folder.resolve()
    if real in above:  # a link to a parent
        return
    for path in folder.iterdir():
        if path.name.startswith(".") or not path.is_dir():
            continue
        if is_bag(path):
            yield path
        else:
            yield from _walk(path, (*above, real))


def is_storage(file: Path) -> bool:
    """Whether a file's name is that of a bag's storage."""
    return file.name.endswith(_STORAGE_SUFFIXES)


def _damaged(file: Path, error: Exception) -> TrialError:
    reason = str(error).rstrip(".")
    return TrialError(f"{file}: cannot be read ({reason})", GIVE_BAG)


class BagWriter:
    """Writes a new MCAP bag into a folder that must not exist; a context manager.

    Attributes:
        path: The folder, which entry creates.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._connections: dict[str, interfaces.Connection] = {}
        self._chunk_time: int | None = None  # [ns]; of its first message
        self._lock = -1  # descriptor that locks the folder while it is written

    def __enter__(self) -> Self:
        self._writer.open()
        self._lock = hold(self.path)
        with suppress(OSError):  # unsupported on network drives
            sync(self.path)
            sync(self.path.parent)
        return self

    def __exit__(self, *error: object) -> None:
        # Even after an error: the messages so far make a complete bag.
        self._close_chunk()
        self._writer.close()
        recording = self.path / f"{self.path.name}.mcap"
        self._write_index_checksum(recording)
        for file in (recording, self._writer.metapath):
            sync(file)
        os.close(self._lock)

    def _write_index_checksum(self, file: Path) -> None:
        """Write the checksum of the index; the library leaves it zero (unchecked)."""
        with file.open("r+b") as stream:
            place = stream.seek(-_INDEX_CHECKSUM_OFFSET, os.SEEK_END)
            stream.seek(place - 16)
            start = int.from_bytes(stream.read(8), "little")
            stream.seek(start)
            stream.write(zlib.crc32(stream.read(place - start)).to_bytes(4, "little"))

    def abandon(self) -> None:
        """Leave the bag unfinished after its storage failed; readers recover its content."""
        for end in (self._writer.abort, partial(os.close, self._lock)):
            with suppress(OSError):
                end()

    def add_topic(self, name: str, topic: Topic) -> None:
        """Declare a topic; messages are written to it afterwards.

        Args:
            name: Its full name in the graph, such as `/left/trigger`.
            topic: The testbed's topic, which gives the type and the quality of service.
        """
        keep, alive = interfaces.QosHistory.KEEP_LAST, interfaces.QosLiveliness.AUTOMATIC
        reliable, lasting = interfaces.QosReliability.RELIABLE, interfaces.QosDurability
        durability = lasting.TRANSIENT_LOCAL if topic.latched else lasting.VOLATILE
        behaviour = reliable, durability, _FOREVER, _FOREVER, alive, _FOREVER, False
        qos = interfaces.Qos(keep, topic.depth, *behaviour)
        self._connections[name] = self._writer.add_connection(
            name, topic.type, typestore=typestore(), offered_qos_profiles=[qos]
        )

    def write(self, name: str, time: int, data: bytes) -> None:
        """Append a message to a declared topic.

        Args:
            name: The topic's full name, as given to `add_topic`.
            time: When the message was received, since the epoch [ns].
            data: The message, serialised (CDR).
        """
        since = time if self._chunk_time is None else self._chunk_time
        full = self._storage.chunk.bio.tell() + len(data) > _CHUNK_SIZE
        if full or abs(time - since) >= _CHUNK_SPAN:
            self._close_chunk()
        if self._chunk_time is None:
            self._chunk_time = time
        self._writer.write(self._connections[name], time, data)

    def flush(self) -> None:
        """Flush all messages so far to the disk as a chunk that survives a power cut."""
        self._close_chunk()
        self._storage.bio.flush()
        os.fsync(self._storage.bio.fileno())

    @property
    def _storage(self) -> Any:
        """The library's internal storage; its version is pinned because this is not public API."""
        return self._writer.storage

    def _close_chunk(self) -> None:
        """Write the chunk and its checksum, which the library leaves zero (unchecked)."""
        self._chunk_time = None
        storage = self._storage
        if not storage.chunk.bio.tell():
            return
        checksum = zlib.crc32(storage.chunk.bio.getbuffer())
        start = storage.bio.tell()
        storage.close_chunk()
        storage.bio.seek(start + _CHUNK_CHECKSUM_OFFSET)
        storage.bio.write(checksum.to_bytes(4, "little"))
        storage.bio.seek(0, os.SEEK_END)
