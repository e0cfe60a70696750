"""Tables of other laboratories' sensors: which file is what, and what each measured."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from socket_testbed.alignment.common_clock import (
    Offset,
    OwnClock,
    clocks_in_words,
    offset_by_tap,
    stated_offsets,
    to_common_clock,
)
from socket_testbed.alignment.events import find_tap
from socket_testbed.alignment.table_file import (
    TableFormat,
    has_column,
    read_table,
    shown_titles,
    table_text,
)
from socket_testbed.alignment.tables import (
    COMPONENTS,
    are_clusters,
    is_wrench,
    read_cluster_table,
    read_wrench_table,
)
from socket_testbed.alignment.takes import (
    Take,
    is_take,
    pose_columns,
    read_take,
    table_take,
    take_poses,
)
from socket_testbed.alignment.units import UNITS, factor
from socket_testbed.cells import TextTable
from socket_testbed.errors import ConfigurationError, TrialError, closest, listed, naming, option_of
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.settings.alignment import NONE
from socket_testbed.trials import imported
from socket_testbed.trials.foreign import SOURCES, WORDS, ForeignSource, Source, in_words

SUFFIXES = (".csv", ".tsv", ".txt", ".lvm", ".dat", ".log", ".asc")
"""Suffixes of files that are taken for tables."""

_POSES: dict[Source, str] = {"socket_pose": "socket", "pylon_pose": "pylon"}  # marker bodies
_MAX_LISTED = 6


@dataclass(frozen=True)
class TablePart:
    """The part of a file that a source is read from.

    Attributes:
        path: The file.
        body: The body of a take; empty for other tables.
    """

    path: Path
    body: str = ""

    def __str__(self) -> str:
        return f"{self.path.name}:{self.body}" if self.body else self.path.name


def are_tables(paths: Sequence[Path]) -> bool:
    """Whether files are tables by their suffixes.

    Args:
        paths: One or more paths that a user gave.

    Raises:
        TrialError: If some are and others are not.
    """
    tables = [path for path in paths if path.suffix.lower() in SUFFIXES and not path.is_dir()]
    if tables and len(tables) < len(paths):
        other = next(path for path in paths if path not in tables)
        fact = f"{other} is no table ({', '.join(SUFFIXES)}), {tables[0]} is one"
        raise TrialError(fact, "import one bag, or tables only")
    return bool(tables)


@dataclass(frozen=True)
class TableFiles:
    """What some files hold; one may hold poses and a table of a load cell or clusters.

    Attributes:
        paths: The files.
        takes: Poses or markers, by file.
        tables: Other tables, by file.
    """

    paths: tuple[Path, ...]
    takes: Mapping[Path, Take]
    tables: Mapping[Path, TextTable]


def read_files(paths: Sequence[Path], stated: TableFormat) -> TableFiles:
    """Read files as what they are.

    Args:
        paths: The files.
        stated: What the titles of a table of poses do not tell.

    Raises:
        TrialError: If two files have one name.
        ConfigurationError: If a file cannot be read.
        RegistrationError: If a take is not complete.
    """
    names = [path.name for path in paths]
    if again := [name for name in names if names.count(name) > 1]:
        raise TrialError(f"two tables are called {again[0]}", "rename one")
    takes: dict[Path, Take] = {}
    tables: dict[Path, TextTable] = {}
    for path in paths:
        if is_take(table_text(path)[:4096]):
            takes[path] = read_take(path)
            continue
        with naming(path.name):
            tables[path] = read_table(path)
            if pose_columns(tables[path]):
                takes[path] = table_take(path, tables[path], stated)
    return TableFiles((*paths,), takes, tables)


def propose_tables(
    files: TableFiles, chosen: Mapping[Source, str], stated: TableFormat
) -> dict[Source, TablePart]:
    """The file of each source: those chosen, and for others what the columns tell.

    Args:
        files: The tables, see `read_files`.
        chosen: By source a file's name, `FILE:BODY` or a body of the only take; `none` for a source
            that is left out.
        stated: What the titles do not tell.

    Returns:
        Parts by source; sources that the tables lack are left out.

    Raises:
        TrialError: If a chosen file or body is not there, several suit, or a file is none of them.
    """
    takes, tables = files.takes, files.tables
    _refuse_unknown_names(tables, stated)
    found: dict[Source, TablePart] = {}
    for source, text in chosen.items():
        if text != NONE:
            found[source] = _chosen(source, text, files.paths, takes)
    for source in SOURCES:
        if source not in chosen:
            own = _suited(source, takes, tables, stated, [str(part) for part in found.values()])
            if own is not None:
                found[source] = own
    _refuse_unclear_bodies(takes, found, chosen)
    used = {part.path for part in found.values()}
    for path in files.paths:
        if path not in used:
            what = (
                listed(takes[path].names, _MAX_LISTED)
                if path in takes
                else shown_titles(tables[path])
            )
            raise TrialError(
                f"{path.name}: is none of the sources (it has {what})",
                f"state what it is, such as {option_of('wrench')} {path.name}, or leave it out",
            )
    return {source: found[source] for source in SOURCES if source in found}


def _refuse_unknown_names(tables: Mapping[Path, TextTable], stated: TableFormat) -> None:
    """Refuse columns and units of quantities that nothing has, and titles that no table has."""
    for quantity, unit in stated.units.items():
        if quantity not in UNITS:
            raise ConfigurationError(f"units names '{quantity}'", closest(quantity, UNITS))
        if factor(quantity, unit) is None:
            known = ", ".join(UNITS[quantity])
            raise ConfigurationError(f"'{unit}' is no unit of {quantity}", f"use one of {known}")
    for what, title in stated.columns.items():
        if what != "time" and what not in COMPONENTS and "." not in what:
            hint = "name time, Fx to Mz, or a channel such as distal.0"
            raise ConfigurationError(f"columns names '{what}'", hint)
        if not any(has_column(table, title) for table in tables.values()):
            names = ", ".join(path.name for path in tables)
            fact = f"no column is called '{title}', named for {what}, in {names}"
            raise ConfigurationError(fact, "check its title")


def _chosen(
    source: Source, text: str, paths: Collection[Path], takes: Mapping[Path, Take]
) -> TablePart:
    """The part that a user names."""
    option = option_of(source)
    names = {path.name: path for path in paths} | {str(path): path for path in paths}
    file, _, body = text.partition(":")
    if file in names:
        path = names[file]
        if source not in _POSES or path not in takes:
            return TablePart(path)
        if not body:
            body = _body_of(source, takes[path]) or ""
        if not body:
            bodies = listed(takes[path].names, _MAX_LISTED) or "none"
            raise TrialError(
                f"{path.name}: cannot tell which body is the {in_words(source)} (it has {bodies})",
                f"name it with {option} {path.name}:BODY",
            )
        return TablePart(path, body)
    if source in _POSES and len(takes) == 1:
        return TablePart(next(iter(takes)), text)
    raise TrialError(f"{text} of {option} is none of the tables", closest(file, {*names}))


def _body_of(source: Source, take: Take) -> str | None:
    """The body of a take whose name says the source, or None.

    Raises:
        TrialError: If several do.
    """
    suited = [name for name in take.names if any(w in name.lower() for w in WORDS[source])]
    if len(suited) > 1:
        raise TrialError(
            f"{take.path.name}: {listed(suited, _MAX_LISTED)} may each be the {in_words(source)}",
            f"choose with {option_of(source)} {take.path.name}:BODY",
        )
    return suited[0] if suited else None


def _suited(
    source: Source,
    takes: Mapping[Path, Take],
    tables: Mapping[Path, TextTable],
    stated: TableFormat,
    taken: Collection[str],
) -> TablePart | None:
    """The part whose columns or bodies tell that it is a source; None if there is none."""
    if source in _POSES:
        parts = [TablePart(path, _body_of(source, take) or "") for path, take in takes.items()]
        suited = [part for part in parts if part.body and str(part) not in taken]
    else:
        is_own = is_wrench if source == "wrench" else are_clusters
        suited = []
        for path, table in tables.items():
            with naming(path.name):
                if is_own(table, stated):
                    suited.append(TablePart(path))
    if len(suited) > 1:
        raise TrialError(
            f"{listed([str(part) for part in suited], _MAX_LISTED)} may each be the"
            f" {in_words(source)}",
            f"choose with {option_of(source)} FILE, or leave it out with {option_of(source)} none",
        )
    return suited[0] if suited else None


def _refuse_unclear_bodies(
    takes: Mapping[Path, Take], found: Mapping[Source, TablePart], chosen: Mapping[Source, str]
) -> None:
    """Ask which body is which where names do not tell it."""
    lacking: list[Source] = [s for s in _POSES if s not in found and s not in chosen]
    taken = {str(part) for part in found.values()}
    for path, take in takes.items():
        left = [name for name in take.names if str(TablePart(path, name)) not in taken]
        if left and lacking:
            options = " and ".join(f"{option_of(source)} {path.name}:BODY" for source in lacking)
            raise TrialError(
                f"{path.name}: cannot tell whose pose {listed(left, _MAX_LISTED)} is",
                f"state it with {options}, or none instead of a body",
            )


@dataclass(frozen=True)
class TableRecording:
    """What tables hold, on one clock.

    Attributes:
        sources: What each source measured.
        record: What `import.yaml` states of the files and their clocks.
        notes: Remarks for the user.
        files: Contents of the tables, by the names under which a trial stores them.
    """

    sources: dict[Source, ForeignSource]
    record: dict[str, Any]
    notes: tuple[str, ...]
    files: dict[str, bytes]


def read_tables(
    paths: Sequence[Path],
    chosen: imported.SourceMapping,
    geometry: SocketGeometry,
    tap: tuple[float, float] | None = None,
) -> TableRecording:
    """Read tables and bring them to one clock.

    Args:
        paths: The files.
        chosen: What each is, where that is stated, with offsets, columns and units.
        geometry: The socket, for the markers of its bodies.
        tap: Seconds since the start of each table in which a tap is looked for; None for all of it.

    Raises:
        TrialError: If files do not tell what they are, or see no tap.
        ConfigurationError: If a file cannot be read, or an offset is missing.
    """
    if chosen.trigger is not None:
        raise ConfigurationError("tables hold no topic for --trigger", "give --rate instead")
    own = {name: getattr(chosen, name) for name in SOURCES}
    formats = {
        name: TableFormat(chosen.columns, chosen.units, stated.row_rate, chosen.clusters.names)
        for name, stated in own.items()
    }
    named = {name: stated.topic for name, stated in own.items() if stated.topic is not None}
    pose_rate = own["socket_pose"].row_rate or own["pylon_pose"].row_rate
    files = read_files(paths, replace(formats["pylon_pose"], rate=pose_rate))
    parts = propose_tables(files, named, formats["clusters"])
    sources, clocks = read_table_sources(parts, files, formats, geometry)
    stated = {name: at.offset for name, at in own.items() if at.offset is not None}
    by_tap = {str(name) for name, offset in stated.items() if offset == imported.TAP}
    numbers = {str(name): float(v) for name, v in stated.items() if v != imported.TAP}
    if tap is not None and not by_tap:
        fact = "--tap is given, and no offset is to be found from a tap"
        raise ConfigurationError(fact, "give --offset SOURCE=tap too, or leave it out")
    offsets = stated_offsets(clocks, numbers, by_tap)
    if by_tap:
        offsets |= _offsets_by_tap(clocks, sources, by_tap, offsets, tap)
    clock_of = {name: clock for clock in clocks for name in clock.sources}
    for name, source in sources.items():
        clock = clock_of[name]
        series = to_common_clock(source.series, clock, offsets[clock.file], clocks[0])
        sources[name] = replace(source, series=series)
    notes = [clocks_in_words(clocks, offsets)] if len(clocks) > 1 else []
    if not clocks[0].is_dated:
        notes.append(f"{clocks[0].file} tells no date: the trial's times count from 2000-01-01")
    return TableRecording(
        {name: sources[name] for name in SOURCES if name in sources},
        {"files": [path.name for path in paths], "clocks": _clock_record(offsets)},
        tuple(notes),
        {f"{imported.ORIGINALS}/{path.name}": path.read_bytes() for path in paths},
    )


def _offsets_by_tap(
    clocks: Sequence[OwnClock],
    sources: Mapping[Source, ForeignSource],
    by_tap: set[str],
    offsets: Mapping[str, Offset],
    span: tuple[float, float] | None,
) -> dict[str, Offset]:
    """Offsets of the files whose tap is to agree with that of the first file."""
    reference, *others = clocks
    found: dict[str, Offset] = {}
    taps = {}
    wanted = [clock for clock in others if by_tap & {*clock.sources}]
    for clock in (reference, *wanted):
        with naming(clock.file):
            held = [name for name in sources if name in clock.sources]
            seen = next((name for name in held if name in by_tap), held[0])
            taps[clock.file] = find_tap(sources[seen].series, span)
    for clock in wanted:
        found[clock.file] = offset_by_tap(
            (reference, taps[reference.file]), (clock, taps[clock.file])
        )
    return found


def _clock_record(offsets: Mapping[str, Offset]) -> dict[str, dict[str, Any]]:
    """Offsets as `import.yaml` states them [s]."""
    record: dict[str, dict[str, Any]] = {}
    for file, own in offsets.items():
        record[file] = {"offset": round(own.seconds, 6), "how": own.how}
        if np.isfinite(own.error):
            record[file]["error"] = round(own.error, 6)
    return record


def read_table_sources(
    parts: Mapping[Source, TablePart],
    files: TableFiles,
    stated: Mapping[Source, TableFormat],
    geometry: SocketGeometry,
) -> tuple[dict[Source, ForeignSource], list[OwnClock]]:
    """What each source measured, at times of its own file, and the clocks of the files.

    Args:
        parts: The part of a file that each source is read from, see `propose_tables`.
        files: What the files hold.
        stated: What the titles do not tell, by source.
        geometry: The socket, for the markers of its bodies.

    Returns:
        The sources, and the clocks, that of the first source first.

    Raises:
        ConfigurationError: If a file cannot be read as such a source.
    """
    sources: dict[Source, ForeignSource] = {}
    held: dict[str, list[tuple[Source, bool, int]]] = {}
    noted: set[Path] = set()
    for source, part in parts.items():
        if source in _POSES:
            take = files.takes.get(part.path)
            if take is None:
                raise ConfigurationError(
                    f"{part.path.name}: holds no poses, for {option_of(source)}",
                    "export a take with its header, or columns such as 'socket.x [m]' to"
                    " 'socket.qw'",
                )
            series, notes = take_poses(take, part.body, geometry.markers[_POSES[source]])
            notes = notes if part.path in noted else (*take.notes, *notes)
            noted.add(part.path)
            is_dated = take.is_dated
            kind = f"{take.program} take" if take.program else "table"
            sources[source] = ForeignSource(str(part), kind, series, notes)
        elif part.path not in files.tables:
            raise ConfigurationError(
                f"{part.path.name}: is a take of motion capture, not the {in_words(source)}",
                f"name another file with {option_of(source)}",
            )
        else:
            read = read_wrench_table if source == "wrench" else read_cluster_table
            own = read(part.path, stated[source], files.tables[part.path])
            is_dated = own.is_dated
            sources[source] = ForeignSource(str(part), "table", own.series, own.notes)
        start = int(sources[source].series.times[0])
        held.setdefault(part.path.name, []).append((source, is_dated, start))
    clocks = [
        OwnClock(
            file,
            tuple(source for source, _, _ in own),
            all(is_dated for _, is_dated, _ in own),
            min(start for _, _, start in own),
        )
        for file, own in held.items()
    ]
    return sources, clocks
