"""The storage files of a bag: which there are, what each one is, and what its metadata promise.

A recorder splits a long bag into numbered parts. People rename and unpack them, copy some of them,
or fetch the pointers of Git LFS in their place: every part that can be read is read.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from backports import zstd
from numpy.typing import NDArray

from socket_testbed.arrays import IntArray
from socket_testbed.documents import OTHER_FILE_START, load_yaml, other_file
from socket_testbed.errors import TestbedError, TrialError

BAG_METADATA = "metadata.yaml"  # of a closed bag
MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\0"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

COPY_AGAIN = "copy the trial again if it is whole elsewhere"
GIVE_BAG = "give an MCAP or SQLite bag of ROS 2"
HOLDS_NOTHING = (
    "holds nothing: its recorder ended before any data reached the disk",
    "remove it, or copy the trial again if it is complete elsewhere",
)
MAX_APART = 24 * 3600 * 10**9  # [ns]; of a time from the middle one of a trial

_ARCHIVE_NAME = re.compile(r"\.(gz|tgz|xz|bz2|lz4|zip|7z|rar|tar)$", re.IGNORECASE)
_PACKED_STORAGE_NAME = re.compile(r"\.(mcap|db3)(\.tar)?\.\w+$", re.IGNORECASE)
_SCHEMA_SIZE = 2**16  # [bytes]; within which SQLite names the tables of a small schema
_SQLITE_TABLES = (b"topics", b"messages")
_STORAGE_NAME = re.compile(r"\.(mcap|db3)(\.zstd?)?$", re.IGNORECASE)
_NUMBERED = re.compile(r"(?P<bag>.*_)(?P<number>\d{1,3})(?P<suffix>\.\w+)")
_PACKED_SUFFIX = re.compile(r"\.zstd?$", re.IGNORECASE)
# Starts of files that people take for a recording: what they are, and how to get the recording.
_OTHERS = {
    b"#ROSBAG V": ("is a bag of ROS 1", "convert it with 'rosbags-convert'"),
    b"<": ("is a web page or XML, not a recording", "download the recording itself"),
}


class Batch(NamedTuple):
    """Messages of a storage file, in the order of their times.

    Attributes:
        connections: Number of each message's topic in the file, its `Connection.id`, shape (k,).
        times: When the recorder received each message, since the epoch, shape (k,) [ns].
        contents: The serialised messages as they were written, which may be compressed, k of them.
    """

    connections: IntArray
    times: NDArray[np.uint64]
    contents: list[bytes]

    @classmethod
    def empty(cls) -> Batch:
        """No messages."""
        return cls(np.empty(0, np.int64), np.empty(0, np.uint64), [])

    def part(self, rows: slice) -> Batch:
        """Some of the messages."""
        return Batch(self.connections[rows], self.times[rows], self.contents[rows])

    def followed_by(self, later: Batch) -> Batch:
        """These messages and then others."""
        connections = np.append(self.connections, later.connections)
        times = np.append(self.times, later.times)
        return Batch(connections, times, self.contents + later.contents)


class ListedFile(NamedTuple):
    """A storage file as metadata.yaml lists it.

    Attributes:
        name: Its name, without folders.
        start: Recording time of its first message since the epoch [ns]; None if not stated.
        end: Recording time of its last message since the epoch [ns]; None if not stated.
        messages: Number of its messages; None if not stated.
    """

    name: str
    start: int | None = None
    end: int | None = None
    messages: int | None = None


class BagMetadata(NamedTuple):
    """What a bag's metadata.yaml promises.

    Attributes:
        files: The storage files, in the order of their recording.
        counts: Number of messages by the topic's full name.
        compression: Name of the program that compressed files or messages; empty for none.
    """

    files: tuple[ListedFile, ...]
    counts: dict[str, int]
    compression: str


def is_storage(file: Path) -> bool:
    """Whether a file's name is that of a bag's storage, compressed or not.

    Hidden files do not count: some systems put `._hold.mcap` beside `hold.mcap` on a copy.
    """
    return bool(_STORAGE_NAME.search(file.name)) and not file.name.startswith(".")


def is_packed_name(name: str) -> bool:
    """Whether a file's name ends as that of a file compressed with zstd."""
    return bool(_PACKED_SUFFIX.search(name))


def plain_name(name: str) -> str:
    """A storage file's name without the suffix of its compression: `a.mcap.zstd` gives `a.mcap`."""
    return _PACKED_SUFFIX.sub("", name)


def read_metadata(file: Path) -> BagMetadata:
    """What a bag's metadata.yaml promises.

    Raises:
        TrialError: If the file is none of rosbag2.
    """
    try:
        if (other := what_else(file)) is not None:
            raise other
        content = load_yaml(file)["rosbag2_bagfile_information"]
        counts = {
            str(entry["topic_metadata"]["name"]): int(entry["message_count"])
            for entry in content.get("topics_with_message_count") or []
        }
        files = tuple(_listed_files(content))
        return BagMetadata(files, counts, str(content.get("compression_format") or ""))
    except TrialError:
        raise
    except Exception:  # the libraries may raise any exception
        raise TrialError(
            f"{file}: is not rosbag2 metadata", "write it again with 'ros2 bag reindex'"
        ) from None


def _listed_files(content: Any) -> Iterator[ListedFile]:
    """The files of a bag's metadata, with their times if its version has them."""
    entries = {_base_name(entry["path"]): entry for entry in content.get("files") or []}
    for name in dict.fromkeys(map(_base_name, content.get("relative_file_paths") or [])):
        entry = entries.get(name)
        if entry is None:
            yield ListedFile(name)
            continue
        messages = int(entry["message_count"])
        if not messages:  # its times are those of no message
            yield ListedFile(name, messages=0)
            continue
        start = int(entry["starting_time"]["nanoseconds_since_epoch"])
        end = start + int(entry["duration"]["nanoseconds"])
        yield ListedFile(name, start, end, messages)


def _base_name(path: object) -> str:
    """The name of a file without its folders, which Windows separates by another character."""
    return re.split(r"[/\\]", str(path))[-1]


def find_storage(bag: Path) -> list[Path]:
    """The storage files in a bag's folder, as numbered: bag_2 before bag_10.

    A file is one by its name, or under any other name by its first bytes. An unpacked file comes
    before its compressed one.
    """
    found = [
        file
        for file in bag.iterdir()
        if file.is_file() and (is_storage(file) or _holds_storage(file))
    ]
    return sorted(found, key=lambda file: (_by_number(plain_name(file.name)), len(file.name)))


def _holds_storage(file: Path) -> bool:
    """Whether a visible file of any other name begins as a recording, compressed or not.

    A database of another program, which has other tables, is none.
    """
    if file.name.startswith(".") or file.name == BAG_METADATA:
        return False
    try:
        with file.open("rb") as stream:
            start = stream.read(_SCHEMA_SIZE)
        if start.startswith(ZSTD_MAGIC):
            start = _unpacked_start(file)
    except OSError:  # a file beside the recording may belong to somebody else
        return False
    if start.startswith(SQLITE_MAGIC):
        return all(table in start for table in _SQLITE_TABLES)
    return start.startswith(MCAP_MAGIC)


def _unpacked_start(file: Path) -> bytes:
    """The first bytes of a file that is compressed with zstd; empty if it is damaged."""
    with suppress(EOFError, zstd.ZstdError), zstd.open(file, "rb") as stream:
        return stream.read(_SCHEMA_SIZE)
    return b""


def find_archives(folder: Path) -> list[Path]:
    """The archives in a folder by their names, such as `hold.mcap.gz` and `hold.zip`.

    Those named after a storage file come first.
    """
    found = [
        file
        for file in folder.iterdir()
        if _ARCHIVE_NAME.search(file.name) and not file.name.startswith(".") and file.is_file()
    ]
    return sorted(found, key=lambda file: (not is_packed_storage(file), _by_number(file.name)))


def is_packed_storage(file: Path) -> bool:
    """Whether a file's name is that of a storage file in an archive, such as `hold.mcap.gz`."""
    return bool(_ARCHIVE_NAME.search(file.name) and _PACKED_STORAGE_NAME.search(file.name))


def archive_content(archive: Path) -> tuple[str, str]:
    """What an archive is, and how to unpack it."""
    with suppress(OSError):
        if (known := known_content(archive)) is not None:
            return known
    return "is an archive by its name", "unpack it"


def is_bag(folder: Path) -> bool:
    """Whether a folder is a bag, even if broken or still written.

    It is one by a storage file, or by a metadata.yaml that may be that of a bag: a folder of trials
    may have one of another kind.
    """
    if not folder.is_dir():
        return False
    found = [*folder.iterdir()]
    return (
        any(map(is_storage, found))
        or any(path.name == BAG_METADATA and _may_describe_bag(path) for path in found)
        or any(path.is_file() and _holds_storage(path) for path in found)
    )


def _may_describe_bag(file: Path) -> bool:
    """Whether a metadata.yaml is that of rosbag2, or cannot be read."""
    try:
        content = load_yaml(file)
    except (TestbedError, OSError):
        return True
    return not isinstance(content, dict) or "rosbag2_bagfile_information" in content


def _by_number(name: str) -> list[tuple[int, str]]:
    """Orders names by the numbers in them."""
    parts = re.split(r"(\d+)", name)
    return [(int(part) if part.isdecimal() else 0, part) for part in parts]


def what_else(file: Path) -> TrialError | None:
    """The error for a file that is no recording but something known, such as a Git LFS pointer."""
    known = known_content(file)
    return None if known is None else TrialError(f"{file}: {known[0]}", known[1])


def known_content(file: Path) -> tuple[str, str] | None:
    """What a file is that is no recording but something known, and what to do; None otherwise."""
    with file.open("rb") as stream:
        start = stream.read(OTHER_FILE_START)
    if known := other_file(start):
        return known
    start = start.lstrip(b"\xef\xbb\xbf \t\r\n")
    found = (known for beginning, known in _OTHERS.items() if start.startswith(beginning))
    return next(found, None)


def storage_kind(file: Path) -> str:
    """What a storage file is by its first bytes: `.mcap`, `.db3`, `.zstd`, or else by its name."""
    with file.open("rb") as stream:
        start = stream.read(len(SQLITE_MAGIC))
    for magic, kind in ((MCAP_MAGIC, ".mcap"), (SQLITE_MAGIC, ".db3"), (ZSTD_MAGIC, ".zstd")):
        if start.startswith(magic):
            return kind
    return ".zstd" if is_packed_name(file.name) else Path(file.name).suffix.lower()


def missing_numbers(names: Sequence[str]) -> dict[str, str]:
    """Names of the parts that a bag's numbered parts leave out, such as `bag_1` between 0 and 2.

    Args:
        names: Names of the parts, without the suffix of their compression, as numbered.

    Returns:
        For each name left out the name of the part before it; empty if the names are not those of
        one numbered bag.
    """
    found = [match for name in names if (match := _NUMBERED.fullmatch(name))]
    bags = {(match["bag"], match["suffix"]) for match in found}
    if len(found) < len(names) or len(bags) != 1:
        return {}
    ((bag, suffix),) = bags
    numbers = {int(match["number"]): match[0] for match in found}
    left_out: dict[str, str] = {}
    before = ""
    for number in range(min(numbers), max(numbers) + 1):
        if number in numbers:
            before = numbers[number]
        else:
            left_out[f"{bag}{number}{suffix}"] = before
    return left_out


def number_of_parts(name: str, names: Sequence[str]) -> int:
    """Number of names that differ from a part's name at most in its number.

    Args:
        name: The part's name, without the suffix of its compression.
        names: All names in its folder, without the suffixes of their compression.
    """
    own = _NUMBERED.fullmatch(name)
    found = {
        other
        for other in names
        if (match := _NUMBERED.fullmatch(other))
        and own
        and (match["bag"], match["suffix"]) == (own["bag"], own["suffix"])
    }
    return len(found)


def span_in_words(start: int | None, end: int | None, first: int) -> str:
    """A missing span of a trial in words; empty if nothing shows it.

    Args:
        start: Recording time from which messages are missing, since the epoch [ns]; None if nothing
            shows it.
        end: Recording time up to which messages are missing, since the epoch [ns]; None if nothing
            shows it.
        first: Recording time of the first message that was read, since the epoch [ns].
    """
    if end is not None and end <= first:
        if start is None:
            return "anything before the first message"
        return f"{1e-9 * (first - start):.2f} s before the first message"
    if start is None:
        return ""
    begin = f"{1e-9 * (start - first):.2f} s"
    if end is None:
        return f"anything after {begin} of the trial"
    return f"{begin} to {1e-9 * (end - first):.2f} s of the trial"


def describe_strays(name: str, count: int) -> str:
    """A note on the messages of a file whose recording time is days from the others.

    Args:
        name: The file's name.
        count: Number of those messages.
    """
    what = "1 message of {} has" if count == 1 else f"{count} messages of {{}} have"
    return (
        f"{what.format(name)} a recording time days from the others, which is replaced by that of a"
        " neighbour"
    )
