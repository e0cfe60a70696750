"""SQLite recordings, read by rosbags; their times are checked, their content has no checksums."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rosbags.rosbag2 import Reader

from socket_testbed.errors import TrialError
from socket_testbed.files import TemporaryFolder
from socket_testbed.trials.bag_parts import GIVE_BAG, MAX_APART, describe_strays

_SPECIAL = set("?#%")  # in a path that the library takes for a URI


class SqliteFile:
    """A recording in an SQLite file; used like an `McapFile`.

    Args:
        stack: Closes the file.
        file: The file, whatever its suffix.
        name: Path by which errors call the file, such as that of the compressed file it came from.

    Attributes:
        checked: Whether checksums confirm its content: never.
        lacks: Whether messages may be missing: never known.
        ended: Whether the file has an end, as every SQLite file has.
        start_time: Recording time of the first message since the epoch [ns]; 0 without any.
        end_time: Recording time of the last message, and 1 ns more, since the epoch [ns]; 0 without
            any.
        first_known: The same as `start_time`.
        message_count: Number of messages.
        connections: The topics, as rosbags lists them.

    Raises:
        TrialError: If the file is damaged, truncated or no recording.
    """

    def __init__(self, stack: ExitStack, file: Path, name: Path) -> None:
        self._name = name
        self.checked, self.lacks, self.ended = False, False, True
        try:
            self._reader = stack.enter_context(Reader(_as_database(stack, file)))
            self._first, self._last, self._strays = _times(file)
        except Exception as error:  # the libraries may raise any exception
            reason = str(error).rstrip(".").replace(str(file), name.name)
            raise TrialError(f"{name}: cannot be read ({reason})", GIVE_BAG) from None
        self.connections: list[Any] = list(self._reader.connections)
        self.message_count = self._reader.message_count
        self.start_time = self.first_known = self._first
        self.end_time = self._last + 1 if self.message_count else 0

    def messages(self, connections: Collection[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """The messages of some of the file's topics, in the order of their times.

        Yields:
            The topic, the recording time since the epoch [ns], and the message as it was written,
            which may be compressed. A time that is days from the others is the nearest of them.
        """
        for connection, time, data in self._reader.messages(connections):
            yield connection, min(max(time, self._first), self._last), data

    def notes(self, first: int) -> list[str]:
        """What was not read or was changed, one line each.

        Args:
            first: The bag's first recording time since the epoch [ns]; no line states a time.
        """
        notes = []
        journal = self._name.with_name(self._name.name + "-wal")
        if journal.exists() and journal.stat().st_size:
            notes.append(
                f"{journal.name}, which may hold the newest messages, is not read:"
                f" 'sqlite3 {self._name} vacuum' takes them in"
            )
        if self._strays:
            notes.append(describe_strays(self._name.name, self._strays))
        return notes


def _as_database(stack: ExitStack, file: Path) -> Path:
    """A path to the file by which the library opens it: with its suffix, and without `?#%`."""
    if file.suffix == ".db3" and _SPECIAL.isdisjoint(str(file)):
        return file
    link = Path(stack.enter_context(TemporaryFolder())) / "bag.db3"
    link.symlink_to(file.resolve())
    return link


def _times(file: Path) -> tuple[int, int, int]:
    """Earliest and latest time within a day of the middle one [ns], and the number of others."""
    place = f"file:{quote(str(file.resolve()))}?immutable=1"
    with closing(sqlite3.connect(place, uri=True)) as database:

        def ask(query: str, *values: int) -> Any:
            return database.execute(f"SELECT {query}", values).fetchone()

        (count,) = ask("COUNT(*) FROM messages")
        if not count:
            return 0, 0, 0
        (middle,) = ask(
            "timestamp FROM messages ORDER BY timestamp LIMIT 1 OFFSET ?", (count - 1) // 2
        )
        first, last, near = ask(
            "MIN(timestamp), MAX(timestamp), COUNT(*) FROM messages"
            " WHERE timestamp BETWEEN ? AND ?",
            max(middle - MAX_APART, -(2**63)),
            min(middle + MAX_APART, 2**63 - 1),
        )
    return first, last, count - near
