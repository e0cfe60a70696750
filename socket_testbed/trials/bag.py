"""Bags: rosbag2 folders (MCAP or SQLite) and their message types, without ROS.

Storage files are read directly: a reader that trusts `metadata.yaml` silently yields nothing if
the two disagree on a topic's quality of service. Their message counts are compared instead. Every
part that can be read is read, whatever its name; notes name the parts that are missing.
"""

from __future__ import annotations

import errno
import math
import os
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeAlias

import numpy as np
from backports import zstd
from mcap.writer import CompressionType, Writer

from socket_testbed.documents import dump_yaml
from socket_testbed.errors import ConfigurationError, TrialError, listed
from socket_testbed.files import TemporaryFolder, disk_hint, hold, sync
from socket_testbed.trials.bag_parts import (
    BAG_METADATA,
    COPY_AGAIN,
    GIVE_BAG,
    HOLDS_NOTHING,
    MAX_APART,
    ZSTD_MAGIC,
    BagMetadata,
    Batch,
    ListedFile,
    archive_content,
    find_archives,
    find_storage,
    is_bag,
    is_packed_storage,
    known_content,
    missing_numbers,
    number_of_parts,
    plain_name,
    read_metadata,
    span_in_words,
    storage_kind,
    what_else,
)
from socket_testbed.trials.mcap_file import McapFile, is_empty
from socket_testbed.trials.sqlite_file import SqliteFile
from socket_testbed.version import __version__
from socket_testbed.wire.cdr import types_of, typestore
from socket_testbed.wire.topics import POSES, REQUIRED, TOPICS, Topic, match_topics

_MAX_UNPACKED = 2**28  # [bytes]; size limit of an unpacked file, or
_MAX_RATIO = 500  # times the packed size; recorders reach 20
_BLOCK_SIZE = 4096  # messages decoded at once
_MAX_LISTED = 3  # names in a note
_MAX_PARTS_APART = 30 * MAX_APART  # [ns]; beyond it a clock was not set
_SAME_START = 10**7  # [ns]; between the starts of a part and of what metadata.yaml lists
_FOREVER = {"sec": 2147483647, "nsec": 4294967295}  # [s, ns]; as ROS 2 states no limit
_NO_START = 2**63 - 1  # [ns]; as rosbag2 states it of a bag without a message
_CHUNK_SIZE = 2**20  # [bytes]; a chunk is closed by the message that exceeds it
_CHUNK_SPAN = 10**9  # [ns]; longest chunk


class RawMessage(NamedTuple):
    """A recorded message.

    Attributes:
        topic: Its topic's full name in the recorded graph, such as `/trigger`.
        type: Its type, as `package/msg/Type`.
        time: When the recorder received it, since the epoch [ns]; not the stamp in its header.
        data: Its content, serialised (CDR) and uncompressed.
        definition: Definition of its type (ros2msg), if the recording states it; empty for a type
            that needs none, as `typestore` holds it.
    """

    topic: str
    type: str
    time: int
    data: bytes
    definition: str = ""


Storage: TypeAlias = McapFile | SqliteFile
"""An open storage file."""


class _Part(NamedTuple):
    """A storage file of a bag, readable or not.

    Attributes:
        name: Its name.
        stated: What metadata.yaml states of it; its name alone without metadata.
        promised: Whether metadata.yaml lists it.
        there: Whether there is a file.
        storage: The open file; None if it cannot be read.
        error: Why it cannot be read; None if it can.
    """

    name: str
    stated: ListedFile
    promised: bool
    there: bool = True
    storage: Storage | None = None
    error: TrialError | None = None

    @property
    def held(self) -> int:
        """Number of its messages that can be read."""
        return self.storage.message_count if self.storage is not None else 0

    @property
    def start(self) -> int | None:
        """Recording time of its first message since the epoch [ns]; None if nothing shows it."""
        return self.storage.start_time if self.storage and self.held else self.stated.start

    @property
    def end(self) -> int | None:
        """Recording time of its last message since the epoch [ns]; None if nothing shows it."""
        return self.storage.end_time - 1 if self.storage and self.held else self.stated.end

    @property
    def is_cut(self) -> bool:
        """Whether it has no end, so that its newest messages may be missing."""
        return self.storage is not None and not self.storage.ended


class BagReader:
    """A bag (folder or one storage file), read in recording order; a context manager.

    Every part that can be read is read, with every intact chunk of a truncated or damaged one.

    Attributes:
        path: The folder or storage file.
        notes: Damage, missing parts, differences from the metadata and other remarks for the user,
            one line each; complete after entry.

    Raises:
        TrialError: On entry, if the bag is missing, or nothing in it can be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stack = ExitStack()
        self._readers: list[tuple[Path, Storage]] = []
        self.notes: list[str] = []

    def __enter__(self) -> Self:
        if not (self.path.is_dir() or self.path.is_file()):
            fact = "is neither a folder nor a file" if self.path.exists() else "no such trial"
            raise TrialError(f"{self.path}: {fact}", "check the path")
        with self._stack:  # closes the files after an error
            metadata = self._read_metadata()
            parts, ordered = self._open_parts(metadata)
            self._readers = [(self.path / p.name, p.storage) for p in parts if p.storage]
            if not any(part.held for part in parts):
                # The error of a file that is there says more.
                for part in sorted(parts, key=lambda part: not part.there):
                    if part.error is not None:
                        raise part.error
            self._describe(parts, ordered, metadata)
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
        readers = [reader for _, reader in self._of_one_time()]
        if not readers:
            return 0.0
        first = min(reader.start_time for reader in readers)
        return (max(reader.end_time for reader in readers) - first - 1) * 1e-9

    def _of_one_time(self) -> list[tuple[Path, Storage]]:
        """The parts with messages that start within 30 days of the middle one."""
        held = [(file, reader) for file, reader in self._readers if reader.message_count]
        starts = sorted(reader.start_time for _, reader in held)
        return [
            (file, reader)
            for file, reader in held
            if abs(reader.start_time - starts[len(starts) // 2]) <= _MAX_PARTS_APART
        ]

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """The messages of some topics, given by full name, or of all (None), in recording order.

        Raises:
            TrialError: If a storage file is damaged where it is read, or holds fewer messages than
                its index lists.
        """
        for file, reader in self._readers:
            known = typestore().fielddefs
            definitions = {
                kind: text for kind, text in reader.definitions.items() if kind not in known
            }
            by_number = {connection.id: connection for connection in reader.connections}
            for batch in _batches(file, reader, topics):
                columns = batch.connections.tolist(), batch.times.tolist(), batch.contents
                for number, time, content in zip(*columns, strict=True):
                    connection = by_number[number]
                    kind = connection.msgtype
                    definition = definitions.get(kind, "")
                    yield RawMessage(connection.topic, kind, time, content, definition)

    def blocks(self, topics: Collection[str]) -> Iterator[tuple[str, list[bytes]]]:
        """The messages of some topics, given by full name, in blocks that bound the memory.

        Yields:
            A topic's full name, and the contents (CDR) of up to 4096 of its messages, in recording
            order within the topic.
        """
        names = [*topics]
        blocks: dict[str, list[bytes]] = {name: [] for name in names}
        for file, reader in self._readers:
            # Publishers of a topic have connections of their own.
            places = np.full(max((c.id for c in reader.connections), default=0) + 1, -1)
            for connection in reader.connections:
                if connection.topic in blocks:
                    places[connection.id] = names.index(connection.topic)
            for batch in _batches(file, reader, topics):
                place_of = places[batch.connections]
                for place, topic in enumerate(names):
                    rows = np.flatnonzero(place_of == place).tolist()
                    block = blocks[topic]
                    block += [batch.contents[row] for row in rows]
                    while len(block) >= _BLOCK_SIZE:
                        yield topic, block[:_BLOCK_SIZE]
                        del block[:_BLOCK_SIZE]
        yield from ((topic, block) for topic, block in blocks.items() if block)

    def _read_metadata(self) -> BagMetadata | None:
        """What metadata.yaml promises; None, with a note, if it is missing or unreadable."""
        file = self.path / BAG_METADATA
        if not self.path.is_dir():
            return None
        if not file.is_file():
            self.notes.append("no metadata.yaml: the storage files were read as they are")
            return None
        try:
            metadata = read_metadata(file)
        except TrialError as error:
            if not find_storage(self.path):
                raise
            fact = error.fact.removeprefix(f"{self.path}/").replace(": ", " ", 1)
            self.notes.append(f"{fact}; the storage files were read as they are: {error.hint}")
            return None
        if metadata.compression not in {"", "zstd"}:
            raise TrialError(
                f"{self.path}: is compressed with '{metadata.compression}'",
                "unpack it with 'ros2 bag convert', to zstd or to no compression",
            )
        return metadata

    def _open_parts(self, metadata: BagMetadata | None) -> tuple[list[_Part], bool]:
        """All parts, readable or not, and whether they are known to be in recording order."""
        if self.path.is_file():
            self._note_other_parts()
            return [self._open_part(ListedFile(self.path.name), [self.path])], True
        stored: dict[str, list[Path]] = defaultdict(list)
        for file in find_storage(self.path):
            stored[plain_name(file.name)].append(file)
        listed_parts = []
        for stated in metadata.files if metadata is not None else ():
            own = self.path / stated.name
            others = [other for other in stored.pop(plain_name(own.name), []) if other != own]
            files = [own, *others] if own.is_file() else others
            listed_parts.append(self._open_part(stated, files, promised=True))
        if listed_parts and all(part.storage is not None for part in listed_parts):
            if stored:
                self.notes.append(
                    f"not named in metadata.yaml, and not read: {listed([*stored], _MAX_LISTED)}"
                )
            return listed_parts, True
        more = [self._open_part(ListedFile(name), files) for name, files in stored.items()]
        if not (listed_parts or more):
            for archive in find_archives(self.path):
                fact, hint = archive_content(archive)
                raise TrialError(f"{archive}: {fact}", hint)
            raise TrialError(f"{self.path}: holds no .mcap or .db3 file", "give a trial's folder")
        parts = self._without_copies([*listed_parts, *more])
        if listed_parts and len(parts) == len(listed_parts):
            return parts, True
        if not listed_parts:
            parts = _with_left_out(parts, self.path)
        starts = [part.start for part in parts if part.start is not None]
        if not listed_parts and starts == sorted(starts):
            return parts, True
        parts.sort(key=lambda part: math.inf if part.start is None else part.start)
        return parts, False

    def _note_other_parts(self) -> None:
        """Refuse metadata.yaml itself, and note that a single file is one of several parts."""
        folder = self.path.parent
        if self.path.name == BAG_METADATA:
            fact = f"{self.path}: describes a bag, and is no recording"
            raise TrialError(fact, f"give its folder, {folder}")
        names = [plain_name(file.name) for file in find_storage(folder)]
        if (count := number_of_parts(plain_name(self.path.name), names)) > 1:
            self.notes.append(
                f"{self.path.name} is one of {count} parts of a recording: give its folder for all"
            )

    def _open_part(
        self, stated: ListedFile, files: Sequence[Path], promised: bool = False
    ) -> _Part:
        """The first readable one of some files that may hold a part, packed or not."""
        error = None
        for file in files:
            try:
                return _Part(file.name, stated, promised, storage=self._open(file))
            except OSError as failure:
                fact = f"{file}: cannot be read ({failure.strerror})"
                error = error or TrialError(fact, disk_hint(failure))
            except TrialError as failure:
                error = error or failure
        if error is None:
            error = self._absent(stated.name)
        return _Part(stated.name, stated, promised, bool(files), error=error)

    def _absent(self, name: str) -> TrialError:
        """The error for a part that is not there, unless in an archive."""
        for archive in find_archives(self.path):
            if archive.name.startswith(name) or not is_packed_storage(archive):
                fact, hint = archive_content(archive)
                there = f"is not there, but {archive.name}, which {fact}"
                return TrialError(f"{self.path / name}: {there}", hint)
        return TrialError(
            f"{self.path / name}: is named in metadata.yaml but is not there",
            "copy all of the folder, or make metadata.yaml again with 'ros2 bag reindex'",
        )

    def _without_copies(self, parts: list[_Part]) -> list[_Part]:
        """The parts without the shorter ones of those that begin at the same nanosecond."""
        longest: dict[int | None, _Part] = {}
        for part in parts:
            before = longest.get(part.start)
            if part.held and (before is None or _holds_more(part, before)):
                longest[part.start] = part
        kept = []
        for part in parts:
            if not part.held or longest[part.start] is part:
                kept.append(part)
            else:
                self.notes.append(
                    f"{part.name} is left out: it begins as {longest[part.start].name}, of which it"
                    " is a copy or a piece"
                )
        return kept

    def _open(self, file: Path) -> Storage:
        """A storage file, whatever its name says; unpacked if it is compressed."""
        if not file.stat().st_size:
            fact, hint = HOLDS_NOTHING
            raise TrialError(f"{file}: {fact}", hint)
        if (other := what_else(file)) is not None:
            raise other
        path, kind = file, storage_kind(file)
        if kind == ".zstd":
            path = self._unpack(file)
            kind = storage_kind(path)
            if (inside := known_content(path)) is not None:
                raise TrialError(f"{file}: {inside[0]} once it is unpacked", inside[1])
        if kind == ".mcap":
            return McapFile(self._stack.enter_context(path.open("rb")), file)
        if kind == ".db3":
            return SqliteFile(self._stack, path, file)
        raise TrialError(f"{file}: cannot be read (it is neither MCAP nor SQLite)", GIVE_BAG)

    def _unpack(self, file: Path) -> Path:
        """A storage file, unpacked into a folder that lives as long as this reader.

        Of a truncated one all complete blocks are unpacked.
        """
        folder = self._stack.enter_context(TemporaryFolder())
        unpacked = Path(folder) / plain_name(file.name)
        left = max(_MAX_UNPACKED, _MAX_RATIO * file.stat().st_size)
        try:
            with (
                zstd.open(file, "rb") as source,
                unpacked.open("wb") as target,
                suppress(EOFError),
            ):
                while content := source.read1():
                    left -= target.write(content)
                    if left < 0:
                        raise ValueError("it is too large once unpacked")
        except (OSError, ValueError, zstd.ZstdError) as error:
            raise _damaged(file, error) from None
        if not unpacked.stat().st_size:
            raise TrialError(f"{file}: is truncated", "copy the trial again")
        return unpacked

    def _describe(self, parts: list[_Part], ordered: bool, metadata: BagMetadata | None) -> None:
        """Note what the parts lack, which are missing, and how their counts differ."""
        near = self._of_one_time()
        first = min((reader.first_known for _, reader in near), default=0)
        if bare := [file.name for file, reader in self._readers if not reader.checked]:
            have = "has" if len(bare) == 1 else "have"
            self.notes.append(
                f"{listed(bare, _MAX_LISTED)} {have} no checksums: damage cannot be detected"
            )
        for file, reader in self._readers:
            self.notes += reader.notes(first)
            if reader.message_count and (file, reader) not in near:
                self.notes.append(
                    f"{file.name} was recorded at times far from the other parts, which do not"
                    " count in the duration: check the clock of the recording"
                )
        counts = self.counts
        promised = metadata.counts if metadata is not None else {}
        if promised and all(counts.get(name, 0) == count for name, count in promised.items()):
            self.notes += _read_instead(parts, complete=True)
            return
        if metadata is not None:
            self.notes += _read_instead(parts, complete=False)
        self.notes += _missing_spans(parts, ordered, first, self.path)
        lacks = any(part.storage is None or part.storage.lacks for part in parts)
        self._compare(promised, lacks)

    def _compare(self, promised: Mapping[str, int], lacks: bool) -> None:
        """Note how the counts in metadata.yaml differ from those of the files.

        Args:
            promised: The counts in metadata.yaml, by topic.
            lacks: Whether another note says what is missing.
        """
        counts = self.counts
        total, held = sum(promised.values()), sum(counts.get(name, 0) for name in promised)
        if lacks and held <= total:
            if held < total:
                self.notes.append(
                    f"metadata.yaml lists {total} messages, {held} of them can be read:"
                    f" {COPY_AGAIN}"
                )
            return
        differences = [
            f"{count} messages on {name}, the files hold {counts.get(name, 0)}"
            for name, count in promised.items()
            if counts.get(name, 0) != count
        ]
        if differences:
            self.notes.append(
                f"metadata.yaml lists {listed(differences, _MAX_LISTED)}: {COPY_AGAIN}, or write"
                " metadata.yaml again with 'ros2 bag reindex'"
            )


def _batches(file: Path, reader: Storage, topics: Collection[str] | None) -> Iterator[Batch]:
    """The messages of some topics of a storage file, given by full name, or of all (None).

    Yields:
        Messages in recording order, uncompressed.

    Raises:
        TrialError: As `BagReader.messages`.
    """
    connections = [c for c in reader.connections if topics is None or c.topic in topics]
    if not connections:
        return
    left = sum(connection.msgcount for connection in connections)
    try:
        for batch in reader.batches(connections):
            left -= len(batch.contents)
            if ZSTD_MAGIC in {content[: len(ZSTD_MAGIC)] for content in batch.contents}:
                yield batch._replace(contents=[*map(_uncompressed, batch.contents)])
            else:
                yield batch
    except Exception as error:  # the library may raise any exception
        raise _damaged(file, error) from None
    if left:
        fact = f"{file}: is damaged: its index lists {left} more messages than can be read"
        raise TrialError(fact, COPY_AGAIN)


def _uncompressed(content: bytes) -> bytes:
    return zstd.decompress(content) if content.startswith(ZSTD_MAGIC) else content


def _holds_more(part: _Part, other: _Part) -> bool:
    """Whether a part of two that begin alike is the longer one, or else the copied one."""
    return (part.held, -len(part.name)) > (other.held, -len(other.name))


def _with_left_out(parts: list[_Part], folder: Path) -> list[_Part]:
    """The parts, and where the numbers in their names leave one out a part that is not there."""
    left_out = missing_numbers([part.stated.name for part in parts])
    complete = []
    for part in parts:
        complete.append(part)
        for name, before in left_out.items():
            if before == part.stated.name:
                fact = f"{folder / name}: is not there, as the numbers of the other parts show"
                error = TrialError(fact, "copy all of the folder")
                complete.append(_Part(name, ListedFile(name), False, False, error=error))
    return complete


def _read_instead(parts: list[_Part], complete: bool) -> Iterator[str]:
    """A note on files that were read although metadata.yaml does not list them.

    Args:
        parts: The parts.
        complete: Whether all messages that metadata.yaml lists were read.
    """
    found = [part for part in parts if not part.promised and part.storage is not None]
    starts = [part.start for part in found]
    lost = [
        part.name
        for part in parts
        if part.promised and part.storage is None and (complete or _may_be_renamed(part, starts))
    ]
    if found:
        names = listed([part.name for part in found], _MAX_LISTED)
        place = f", read in place of {listed(lost, _MAX_LISTED)}" if lost else ", read as well"
        rest = "; all messages that it lists were read" if complete else ""
        yield f"metadata.yaml does not name {names}{place}{rest}"


def _missing_spans(parts: list[_Part], ordered: bool, first: int, folder: Path) -> Iterator[str]:
    """A note on each part that is missing, unreadable or cut short, with its span of the trial.

    Args:
        parts: The parts.
        ordered: Whether they are in recording order, so that neighbours limit a missing one.
        first: Recording time of the trial's first message since the epoch [ns].
        folder: The bag's folder, which is left out of the notes.
    """
    found = [part.start for part in parts if part.storage is not None and not part.promised]
    lacking = [
        part
        for part in parts
        if (part.is_cut and part.held != part.stated.messages)
        or (
            part.error is not None
            and part.stated.messages != 0
            and not (found and _may_be_renamed(part, found))
        )
    ]
    for fact, group in groupby(parts, key=lambda part: part in lacking and _fact(part, folder)):
        own = list(group)
        if not fact:
            continue
        start = own[0].end if own[0].is_cut else own[0].stated.start
        end = own[-1].stated.end
        if ordered:
            before = reversed(parts[: parts.index(own[0])])
            after = parts[parts.index(own[-1]) + 1 :]
            if start is None:
                start = next((part.end for part in before if part.end is not None), None)
            if end is None:
                end = next((part.start for part in after if part.start is not None), None)
        start, end = (
            None if time is None or abs(time - first) > _MAX_PARTS_APART else time
            for time in (start, end)
        )
        names = listed([part.name for part in own], _MAX_LISTED)
        verb = fact if len(own) == 1 else fact.replace("is ", "are ").replace("was ", "were ")
        span = span_in_words(start, end, first)
        messages = sum((part.stated.messages or 0) - part.held for part in own)
        count = f", {messages} messages" if messages > 0 else ""
        if own[0].error is not None:
            hint = own[0].error.hint
            yield f"{names} {verb}; missing: {span or 'an unknown span'}{count} ({hint})"
        elif start is not None and end is not None and end > start:
            yield f"{names} {verb}; missing: {span}{count} ({COPY_AGAIN})"


def _fact(part: _Part, folder: Path) -> str:
    """Why a part lacks messages, without its name."""
    if part.error is None:
        return "was cut short"
    return part.error.fact.removeprefix(f"{folder}/").partition(": ")[2]


def _may_be_renamed(part: _Part, found: Sequence[int | None]) -> bool:
    """Whether a part that is not there may be one of the files that nobody listed.

    Args:
        part: The part.
        found: The times at which those files start, since the epoch [ns].
    """
    start = part.stated.start
    return (
        part.promised
        and not part.there
        and (
            start is None
            or any(other is not None and abs(other - start) <= _SAME_START for other in found)
        )
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
        notify: Called with one line for each empty recording, and each in an archive; by default
            they are left out silently.

    Returns:
        The trials' folders by name, which is the path below the folder, such as `s01/hold`. Empty
        if the folder is itself a trial or is not a folder.

    Raises:
        TrialError: If a folder cannot be read.
    """
    try:
        if not folder.is_dir() or is_bag(folder):
            return {}
        packed: list[Path] = []
        found = {path.relative_to(folder).as_posix(): path for path in _walk(folder, (), packed)}
        empty = sorted(name for name, path in found.items() if holds_nothing(path))
    except OSError as error:
        fact = f"{error.filename}: cannot be read ({error.strerror})"
        raise TrialError(fact, disk_hint(error)) from None
    for archive in packed:
        fact, hint = archive_content(archive)
        notify(f"{archive.relative_to(folder).as_posix()} is left out: it {fact}: {hint}")
    for name in empty:
        notify(f"{name} is left out: it holds nothing, its recorder was killed while it started")
        del found[name]
    return dict(sorted(found.items()))


def _walk(folder: Path, above: tuple[Path, ...], packed: list[Path]) -> Iterator[Path]:
    """The bags below a folder that is none.

    Args:
        folder: The folder.
        above: The folders above it, without links.
        packed: Receives the storage files in archives, none of which is read.
    """
    real = folder.resolve()
    if real in above:  # a link to a parent
        return
    packed += filter(is_packed_storage, find_archives(folder))
    for path in folder.iterdir():
        if path.name.startswith(".") or not path.is_dir():
            continue
        if is_bag(path):
            yield path
        else:
            yield from _walk(path, (*above, real), packed)


def _damaged(file: Path, error: Exception) -> TrialError:
    reason = str(error).rstrip(".")
    return TrialError(f"{file}: cannot be read ({reason})", GIVE_BAG)


class BagWriter:
    """Writes a new MCAP bag into a folder that must not exist; a context manager.

    Chunks and the index have checksums. A chunk holds at most a second and about a megabyte,
    because damage loses a whole chunk.

    Attributes:
        path: The folder, which entry creates.

    Raises:
        ConfigurationError: At once or on entry, if the folder exists, as another process may have
            made it meanwhile.
        OSError: On entry, if the folder cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._topics: dict[str, _WrittenTopic] = {}
        self._schemas: dict[str, int] = {}  # numbers of the types in the file, by their names
        self._start: int | None = None  # [ns]; of the first message
        self._end = 0  # [ns]; of the last message
        self._chunk_start: int | None = None  # [ns]; of the chunk's first message
        self._lock = -1  # descriptor that locks the folder while it is written

    def __enter__(self) -> Self:
        try:
            self.path.mkdir(parents=True)
        except FileExistsError:
            fact = f"{self.path} exists already: another process made it meanwhile"
            raise ConfigurationError(fact, "name another folder") from None
        self._file = self._recording.open("xb")
        # Any: the library leaves some of its methods untyped.
        self._writer: Any = Writer(self._file, _CHUNK_SIZE, CompressionType.NONE)
        self._writer.start("ros2", f"socket_testbed {__version__}")
        self._lock = hold(self.path)
        with suppress(OSError):  # unsupported on network drives
            sync(self.path)
            sync(self.path.parent)
        return self

    @property
    def _recording(self) -> Path:
        return self.path / f"{self.path.name}.mcap"

    def __exit__(self, *error: object) -> None:
        # Even after an error: the messages so far make a complete bag.
        content = self._metadata()
        self._writer.flush()
        self._writer.add_metadata("rosbag2", {"serialized_metadata": dump_yaml(content).strip()})
        self._writer.finish()
        self._file.close()
        described = self.path / BAG_METADATA
        staging = described.with_suffix(".tmp")
        staging.write_text(dump_yaml({"rosbag2_bagfile_information": content}), encoding="utf-8")
        for file in (self._recording, staging):
            sync(file)
        staging.replace(described)
        os.close(self._lock)

    def _metadata(self) -> dict[str, Any]:
        """The content of `metadata.yaml`, version 9, as ROS 2 Jazzy writes it."""
        start = _NO_START if self._start is None else self._start
        content = {
            "starting_time": {"nanoseconds_since_epoch": start},
            "duration": {"nanoseconds": max(0, self._end - start)},
            "message_count": sum(topic.count for topic in self._topics.values()),
        }
        return {
            "version": 9,
            "storage_identifier": "mcap",
            "relative_file_paths": [self._recording.name],
            **content,
            "topics_with_message_count": [
                {"topic_metadata": topic.stated, "message_count": topic.count}
                for topic in self._topics.values()
            ],
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": self._recording.name, **content}],
            "custom_data": None,
            "ros_distro": "jazzy",
        }

    def abandon(self) -> None:
        """Leave the bag unfinished after its storage failed; readers recover its content."""
        for end in (self._file.close, partial(os.close, self._lock)):
            with suppress(OSError):
                end()

    def add_topic(self, name: str, topic: Topic, definition: str = "") -> None:
        """Declare a topic; messages are written to it afterwards.

        Args:
            name: Its full name in the graph, such as `/left/trigger`.
            topic: The testbed's topic, which gives the type and the quality of service.
            definition: Definition of its type, see `types_of`.
        """
        types = types_of(topic.type, definition)
        if topic.type not in self._schemas:
            text, _ = types.generate_msgdef(topic.type, ros_version=2)
            self._schemas[topic.type] = self._writer.register_schema(
                topic.type, "ros2msg", text.encode()
            )
        qos = [_quality_of_service(topic)]
        channel = self._writer.register_channel(
            name, "cdr", self._schemas[topic.type], {"offered_qos_profiles": dump_yaml(qos).strip()}
        )
        stated = {
            "name": name,
            "type": topic.type,
            "serialization_format": "cdr",
            "offered_qos_profiles": qos,
            "type_description_hash": types.hash_rihs01(topic.type),
        }
        self._topics[name] = _WrittenTopic(channel, stated)

    def write(self, name: str, time: int, data: bytes) -> None:
        """Append a message to a declared topic.

        Args:
            name: The topic's full name, as given to `add_topic`.
            time: When the message was received, since the epoch [ns].
            data: The message, serialised (CDR).
        """
        if self._chunk_start is not None and abs(time - self._chunk_start) >= _CHUNK_SPAN:
            self._close_chunk()
        if self._chunk_start is None:
            self._chunk_start = time
        topic = self._topics[name]
        self._writer.add_message(topic.channel, time, data, time)
        topic.count += 1
        self._start = time if self._start is None else min(time, self._start)
        self._end = max(time, self._end)

    def _close_chunk(self) -> None:
        self._writer.flush()
        self._chunk_start = None

    def flush(self) -> None:
        """Flush all messages so far to the disk as a chunk that survives a power cut.

        Raises:
            OSError: If the disk does not take them.
            FileNotFoundError: If the bag was removed meanwhile.
        """
        self._close_chunk()
        file = self._file.fileno()
        os.fsync(file)
        # A bag that was moved meanwhile still has its name, elsewhere.
        if not os.fstat(file).st_nlink and not self.path.exists():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self.path))


@dataclass
class _WrittenTopic:
    """A topic of a bag that is being written.

    Attributes:
        channel: Its number in the file.
        stated: What `metadata.yaml` states of it.
        count: Number of its messages so far.
    """

    channel: int
    stated: dict[str, Any]
    count: int = 0


def _quality_of_service(topic: Topic) -> dict[str, Any]:
    """The quality of service of a topic's publisher, as rosbag2 writes it."""
    return {
        "history": "keep_last",
        "depth": topic.depth,
        "reliability": "reliable",
        "durability": "transient_local" if topic.latched else "volatile",
        "deadline": dict(_FOREVER),
        "lifespan": dict(_FOREVER),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(_FOREVER),
        "avoid_ros_namespace_conventions": False,
    }
