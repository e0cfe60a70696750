"""Tables of other laboratories' load cells and clusters, read as series with their own times."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from socket_testbed.alignment.series import ClusterSeries, WrenchSeries
from socket_testbed.alignment.table_file import (
    Clock,
    TableFormat,
    has_column,
    named_column,
    read_clock,
    read_table,
    shown_titles,
    time_columns,
    unread,
    values_of,
)
from socket_testbed.alignment.units import WRITTEN, factor
from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.cells import TextTable, split_title
from socket_testbed.errors import ConfigurationError, naming

COMPONENTS = ("Mx", "My", "Mz", "Fx", "Fy", "Fz")
_WORDS = {"F": "force|f", "M": "moment|torque|mom|m|t"}
_BETWEEN = r"[ _./:-]*"
_STRESSES = ("normal", "shear_x", "shear_y")
CHANNEL = re.compile(r"(?P<cluster>.+?)[._/: -]?(?:(?:c|ch)(?=\d))?(?P<channel>[0-3])", re.I)
"""The title of a capacitance, such as `distal.0` or `distal c0`: cluster and converter input."""
_STRESS = re.compile(r"(?P<cluster>.+?)[._/: -]+(?P<stress>normal|shear[ _]?x|shear[ _]?y)", re.I)


@dataclass(frozen=True)
class TableSeries:
    """What a table measured.

    Attributes:
        name: The file's name, and the body after a colon.
        series: The measurements, at times of the table's own clock.
        is_dated: Whether the times count from 1970, or from a start that the table does not date.
        notes: What was assumed or left out, one line each.
    """

    name: str
    series: WrenchSeries | ClusterSeries
    is_dated: bool
    notes: tuple[str, ...]


class _Rows(NamedTuple):
    """Rows of a table that hold something: times [ns], values, and notes."""

    times: IntArray
    values: FloatArray
    notes: tuple[str, ...]


def read_wrench_table(
    path: Path, stated: TableFormat | None = None, table: TextTable | None = None
) -> TableSeries:
    """Read the wrench of a load cell from a table with a column for each component.

    Titles such as `Fx [N]`, `Force X (lbf)`, `fx_N`, `Mz [N mm]` or `/ft/wrench.torque.z` tell the
    component; units come from the titles, a row below them, or are stated.

    Args:
        path: The file.
        stated: What its titles do not tell.
        table: Its table, if it is read already.

    Raises:
        ConfigurationError: If the file cannot be read, a component, a unit or the time is missing
            or ambiguous, or a cell holds no number.
    """
    stated = stated or TableFormat()
    with naming(path.name):
        table = read_table(path) if table is None else table
        columns = _wrench_columns(table, stated.columns)
        if missing := [name for name in COMPONENTS if name not in columns]:
            raise ConfigurationError(
                f"no column for {', '.join(missing)} ({shown_titles(table)})",
                f"name it with --columns {' '.join(f'{name}=NAME' for name in missing)}",
            )
        kinds = {name: "force" if name[0] == "F" else "moment" for name in COMPONENTS}
        values = values_of(table, {name: columns[name] for name in COMPONENTS}, kinds, stated)
        clock = read_clock(table, stated)
    rows = _filled(path, table, clock, values)
    series = WrenchSeries(rows.times, rows.values, "")
    return TableSeries(path.name, series, clock.is_dated, rows.notes)


def _wrench_columns(table: TextTable, named: Mapping[str, str]) -> dict[str, int]:
    """Columns of the components of a wrench, as far as they are there."""
    names = [split_title(title, WRITTEN)[0] for title in table.titles]
    found: dict[str, int] = {}
    for component in COMPONENTS:
        if component in named:
            found[component] = named_column(table, named[component], component)
            continue
        word, axis = _WORDS[component[0]], component[1]
        form = rf"(?:(?:{word}){_BETWEEN}{axis}|{axis}{_BETWEEN}(?:{word.split('|m|')[0]}))"
        exact = [k for k, name in enumerate(names) if re.fullmatch(form, name, re.I)]
        ending = rf"(?:.*[^a-z])?{form}"
        matches = exact or [k for k, name in enumerate(names) if re.fullmatch(ending, name, re.I)]
        if len(matches) > 1:
            shown = ", ".join(f"'{table.titles[k]}'" for k in matches)
            alike = len({table.titles[k] for k in matches}) < len(matches)
            hint = "rename one" if alike else f"name it with --columns {component}=NAME"
            raise ConfigurationError(f"{shown} may each be {component}", hint)
        if matches:
            found[component] = matches[0]
    return found


def is_wrench(table: TextTable, stated: TableFormat) -> bool:
    """Whether a table has a column for each component of a wrench.

    Args:
        table: The table.
        stated: What its titles do not tell.

    Raises:
        ConfigurationError: If several columns may be one component.
    """
    named = {n: title for n, title in stated.columns.items() if has_column(table, title)}
    return len(_wrench_columns(table, named)) == len(COMPONENTS)


def are_clusters(table: TextTable, stated: TableFormat) -> bool:
    """Whether a table has channels of clusters, by titles with units, or in a stated order.

    Args:
        table: The table.
        stated: What its titles do not tell.
    """
    channels = [(title, channel_of(title, stated)) for title in table.titles]
    units = {*stated.units}
    for title, channel in channels:
        if channel and (split_title(title, WRITTEN)[1] or channel[1] in units):
            return True
        if channel and channel[0].rpartition(".")[0] in stated.names:
            return True
    if any("." in name and has_column(table, title) for name, title in stated.columns.items()):
        return True
    if not stated.names or is_wrench(table, stated):
        return False
    left = len(table.titles) - len(time_columns(table, stated))
    return left in (4 * len(stated.names), 3 * len(stated.names))


def read_cluster_table(
    path: Path, stated: TableFormat | None = None, table: TextTable | None = None
) -> TableSeries:
    """Read capacitances or stresses of clusters from a table with a column for each channel.

    Titles such as `distal.0 [pF]` or `distal c0 (fF)` tell cluster and converter input; a stress is
    `distal.normal [kPa]`, `distal.shear_x` or `distal.shear_y`. If titles name no cluster, the
    columns beside the time are those of the stated clusters in order, four capacitances or three
    stresses each.

    Args:
        path: The file.
        stated: What its titles do not tell.
        table: Its table, if it is read already.

    Raises:
        ConfigurationError: If the file cannot be read, a channel, a unit or the time is missing or
            ambiguous, or a cell holds no number.
    """
    stated = stated or TableFormat()
    with naming(path.name):
        table = read_table(path) if table is None else table
        columns, kind = _cluster_columns(table, stated)
        kinds = dict.fromkeys(columns, kind)
        values = values_of(table, columns, kinds, stated)
        clock = read_clock(table, stated)
    names = tuple(dict.fromkeys(name.rpartition(".")[0] for name in columns))
    width = 4 if kind == "capacitance" else 3
    places = [
        (names.index(name.rpartition(".")[0]), _channel(name.rpartition(".")[2]))
        for name in columns
    ]
    stacked = np.full((len(values), len(names), width), np.nan)
    for number, (cluster, channel) in enumerate(places):
        stacked[:, cluster, channel] = values[:, number]
    flat = stacked.reshape(len(values), -1)
    rows = _filled(path, table, clock, flat)
    shaped = rows.values.reshape(len(rows.times), len(names), width)
    series = ClusterSeries(rows.times, names, shaped)
    return TableSeries(path.name, series, clock.is_dated, rows.notes)


def _channel(name: str) -> int:
    return _STRESSES.index(name) if name in _STRESSES else int(name)


def _cluster_columns(table: TextTable, stated: TableFormat) -> tuple[dict[str, int], str]:
    """Columns by `cluster.channel`, in the table's order, and what they measure."""
    found: dict[str, dict[str, int]] = {"capacitance": {}, "stress": {}}
    taken = time_columns(table, stated)
    for name, title in stated.columns.items():
        if "." in name:
            kind = "stress" if name.rpartition(".")[2] in _STRESSES else "capacitance"
            found[kind][name] = named_column(table, title, name)
    for column, title in enumerate(table.titles):
        if column in taken or column in [*found["capacitance"].values(), *found["stress"].values()]:
            continue
        channel = channel_of(title, stated)
        if channel is None:
            continue
        name, kind = channel
        if name in found[kind]:
            shown = f"'{table.titles[found[kind][name]]}' and '{title}'"
            raise ConfigurationError(f"{shown} are both {name}", "rename one")
        found[kind][name] = column
    named = stated.names and {n.rpartition(".")[0] for own in found.values() for n in own}
    if stated.names and (not named or not {*named} & {*stated.names}):
        return _in_order(table, stated, taken)
    if found["capacitance"]:
        return found["capacitance"], "capacitance"
    if not found["stress"]:
        raise ConfigurationError(
            f"no column is a channel of a cluster ({shown_titles(table)})",
            "call them such as 'distal.0 [pF]', or name the clusters in order with --names",
        )
    for cluster in dict.fromkeys(name.rpartition(".")[0] for name in found["stress"]):
        lacking = [s for s in _STRESSES if f"{cluster}.{s}" not in found["stress"]]
        if lacking:
            fact = f"no column for {cluster}.{lacking[0]}"
            raise ConfigurationError(fact, "give all three stresses of a cluster")
    return found["stress"], "stress"


def channel_of(title: str, stated: TableFormat | None = None) -> tuple[str, str] | None:
    """Channel, such as `distal.0` or `distal.normal`, and what it measures; None for no channel.

    Args:
        title: The title of a column.
        stated: What a user states of the table.
    """
    name, unit = split_title(title, WRITTEN)
    units = {} if stated is None else stated.units
    if found := _STRESS.fullmatch(name):
        stress = re.sub(r"shear[ _]?", "shear_", found["stress"].lower())
        return f"{found['cluster'].strip()}.{stress}", "stress"
    found = CHANNEL.fullmatch(name)
    if found is None:
        return None
    if unit and factor("capacitance", unit) is None and "capacitance" not in units:
        return None
    return f"{found['cluster'].strip()}.{found['channel']}", "capacitance"


def _in_order(
    table: TextTable, stated: TableFormat, taken: Sequence[int]
) -> tuple[dict[str, int], str]:
    """Columns of clusters in the stated order, of a table that does not name them."""
    left = [
        k
        for k, title in enumerate(table.titles)
        if k not in taken and (title or not table.columns[k].isna().all())
    ]
    units = [split_title(table.titles[k], WRITTEN)[1] for k in left]
    are_stresses = "stress" in stated.units or any(
        unit and factor("stress", unit) is not None for unit in units
    )
    kind = "stress" if are_stresses else "capacitance"
    channels = _STRESSES if are_stresses else tuple("0123")
    names = [f"{cluster}.{channel}" for cluster in stated.names for channel in channels]
    if len(left) != len(names):
        raise ConfigurationError(
            f"has {len(left)} columns beside the time, and {len(stated.names)} clusters with"
            f" {len(channels)} channels each are named",
            "name the clusters in the order of the columns with --names, or channels by title",
        )
    return dict(zip(names, left, strict=True)), kind


def _filled(path: Path, table: TextTable, clock: Clock, values: FloatArray) -> _Rows:
    """The rows that hold something."""
    own = values[clock.kept]
    filled = ~unread(own)
    if not filled.any():
        raise ConfigurationError(f"{path.name}: holds no reading", "check the columns")
    notes = tuple(f"{path.name}: {note}" for note in (*table.notes, *clock.notes))
    return _Rows(clock.times[filled], own[filled], notes)
