"""SQLite recordings, read by rosbags; their times are checked, their content has no checksums.

Of a truncated file the messages before the cut are read. Newest messages that a killed recorder
left in its journal (`-wal`) are read from there. The files themselves are never modified.
"""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Collection, Iterator
from contextlib import ExitStack, closing, suppress
from itertools import islice
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from rosbags.interfaces import MessageDefinitionFormat

from socket_testbed.errors import TrialError
from socket_testbed.files import TemporaryFolder
from socket_testbed.trials.bag_parts import GIVE_BAG, MAX_APART, Batch, describe_strays

_BATCH_SIZE = 1000  # messages read at once
_SPECIAL = set("?#%")  # in a path that the library takes for a URI


class SqliteFile:
    """A recording in an SQLite file; used like an `McapFile`.

    Args:
        stack: Closes the file.
        file: The file, whatever its suffix.
        name: Path by which errors call the file, such as that of the compressed file it came from.

    Attributes:
        checked: Whether checksums confirm its content: never.
        lacks: Whether messages are missing, as the file cannot be read to its end.
        ended: Whether the file can be read to its end.
        start_time: Recording time of the first message since the epoch [ns]; 0 without any.
        end_time: Recording time of the last message, and 1 ns more, since the epoch [ns]; 0 without
            any.
        first_known: The same as `start_time`.
        message_count: Number of messages.
        connections: The topics, as rosbags lists them.
        definitions: Definitions of the message types (ros2msg), by name; ROS 2 Humble writes none.

    Raises:
        TrialError: If the file is damaged, truncated or no recording.
    """

    def __init__(self, stack: ExitStack, file: Path, name: Path) -> None:
        self._name = name
        self.checked, self.lacks, self.ended = False, False, True
        journal = name.with_name(name.name + "-wal")
        self._journal = journal if journal.exists() and journal.stat().st_size else None
        self._joined = False  # whether the journal's messages are read
        if self._journal is not None:
            copy = _with_journal(stack, file, self._journal)
            file, self._joined = (file, False) if copy is None else (copy, True)
        try:
            self._open(stack, file)
        except Exception as error:  # the libraries may raise any exception
            salvaged = _salvage(stack, file)
            if salvaged is None:
                reason = str(error).rstrip(".").replace(str(file), name.name)
                raise TrialError(f"{name}: cannot be read ({reason})", GIVE_BAG) from None
            self._open(stack, salvaged)
            self.lacks, self.ended = True, False
        self.connections: list[Any] = list(self._reader.connections)
        self.definitions = {
            connection.msgtype: connection.msgdef.data
            for connection in self.connections
            if connection.msgdef.format == MessageDefinitionFormat.MSG
        }
        self.message_count = self._reader.message_count
        self.start_time = self.first_known = self._first
        self.end_time = self._last + 1 if self.message_count else 0

    def _open(self, stack: ExitStack, file: Path) -> None:
        from rosbags.rosbag2 import Reader  # 30 ms, which an MCAP file need not wait

        self._reader = stack.enter_context(Reader(_as_database(stack, file)))
        self._first, self._last, self._strays = _times(file)

    def batches(self, connections: Collection[Any]) -> Iterator[Batch]:
        """The messages of some of the file's topics, in the order of their times.

        A time that is days from the others is the nearest of them.
        """
        messages = self._reader.messages(connections)
        while found := [*islice(messages, _BATCH_SIZE)]:
            numbers = np.array([connection.id for connection, _, _ in found])
            times = np.array([time for _, time, _ in found], np.int64)
            times = times.clip(self._first, self._last)
            yield Batch(numbers, times.astype(np.uint64), [bytes(data) for _, _, data in found])

    def notes(self, first: int) -> list[str]:
        """What was not read or was changed, one line each.

        Args:
            first: The bag's first recording time, from which seconds count, since the epoch [ns].
        """
        notes = []
        if self._joined and self._journal is not None:
            notes.append(f"the newest messages of {self._name.name} come from {self._journal.name}")
        elif self._journal is not None:
            notes.append(
                f"{self._journal.name}, which may hold the newest messages, cannot be read:"
                f" 'sqlite3 {self._name} vacuum' may take them in"
            )
        if self.lacks:
            until = (self._last - first) * 1e-9
            notes.append(
                f"the recording {self._name.name} was cut short or is damaged: {self.message_count}"
                f" messages up to {until:.1f} s were saved"
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


def _with_journal(stack: ExitStack, file: Path, journal: Path) -> Path | None:
    """A copy of the file with the messages of its journal; None if the journal holds none."""
    copy = Path(stack.enter_context(TemporaryFolder())) / "bag.db3"
    shutil.copyfile(file, copy)
    shutil.copyfile(journal, copy.with_name("bag.db3-wal"))
    with suppress(sqlite3.Error), closing(sqlite3.connect(copy)) as database:
        _, _, pages = database.execute("PRAGMA wal_checkpoint(FULL)").fetchone()
        return copy if pages > 0 else None
    return None


def _salvage(stack: ExitStack, file: Path) -> Path | None:
    """A new file with the rows that can be read of a truncated one; None if no message can."""
    copy = Path(stack.enter_context(TemporaryFolder())) / "bag.db3"
    with (
        suppress(sqlite3.Error),
        closing(sqlite3.connect(_read_only(file), uri=True)) as source,
        closing(sqlite3.connect(copy)) as target,
    ):
        source.execute("PRAGMA writable_schema = ON")  # opens a file shorter than its header says
        tables = "SELECT name, sql FROM sqlite_master WHERE type = 'table' AND sql NOT NULL"
        for name, definition in source.execute(tables).fetchall():
            target.execute(definition)
            with suppress(sqlite3.Error):
                for row in source.execute(f'SELECT * FROM "{name}" ORDER BY rowid'):
                    places = ", ".join("?" * len(row))
                    target.execute(f'INSERT INTO "{name}" VALUES ({places})', row)
        target.commit()
        if target.execute("SELECT COUNT(*) FROM messages").fetchone()[0]:
            return copy
    return None


def _read_only(file: Path) -> str:
    """The URI by which SQLite reads a file without a change or a lock."""
    return f"file:{quote(str(file.resolve()))}?immutable=1"


def _times(file: Path) -> tuple[int, int, int]:
    """Earliest and latest time within a day of the middle one [ns], and the number of others."""
    with closing(sqlite3.connect(_read_only(file), uri=True)) as database:

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
