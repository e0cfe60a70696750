"""Trials from other laboratories' sensors."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np

from socket_testbed.alignment.align import Aligned, align
from socket_testbed.alignment.common_clock import (
    MAX_OFFSET,
    clocks_in_words,
    stated_offsets,
    to_common_clock,
)
from socket_testbed.alignment.series import ClusterSeries
from socket_testbed.alignment.table_file import TableFormat
from socket_testbed.alignment.triggers import triggers_at
from socket_testbed.api.trials import as_path, open_trial
from socket_testbed.arrays import FloatArray, IntArray, StatusArray, usual_period
from socket_testbed.calibration.model import Calibration, read_calibration
from socket_testbed.documents import check_number, path_of, read_document
from socket_testbed.errors import ConfigurationError, TrialError, closest
from socket_testbed.files import CALIBRATION_FILE, SOCKET_FILE, check_new_folder, file_or_packaged
from socket_testbed.geometry.regions import proximal_direction
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.results.result import PathLike
from socket_testbed.samples import Status
from socket_testbed.settings.acquisition import TriggerSettings, averaging_span
from socket_testbed.settings.alignment import MAX_DELAY
from socket_testbed.settings.options import WrenchOf
from socket_testbed.trials import foreign, foreign_tables, imported
from socket_testbed.trials.bag import BagReader, RawMessage
from socket_testbed.trials.trial import Trial, read_configuration

_CLEAR_LOAD = 50.0  # [N]; above which the load shows the sign of the wrench


def import_trial(
    source: PathLike | Sequence[PathLike],
    path: PathLike,
    *,
    wrench: str | None = None,
    socket_pose: str | None = None,
    pylon_pose: str | None = None,
    clusters: str | None = None,
    names: Sequence[str] = (),
    rate: float | None = None,
    trigger: str | None = None,
    offset: Sequence[str] | Mapping[str, float] = (),
    columns: Sequence[str] | Mapping[str, str] = (),
    units: Sequence[str] | Mapping[str, str] = (),
    row_rate: Sequence[str] | Mapping[str, float] = (),
    delay: Iterable[str] | Mapping[str, float] = (),
    wrench_of: WrenchOf | None = None,
    mapping: PathLike | None = None,
    geometry: PathLike | None = None,
    calibration: PathLike | None = None,
    notify: Callable[[str], None] | None = None,
) -> Trial:
    """Make a trial from other sensors' topics in a bag, or tables; they stay as they are.

    The values at each trigger come from the readings in a window around it, see
    `socket_testbed.alignment`. The trial also holds the messages that were read, or copies of the
    tables, and `import.yaml`, which states topics or files, offsets, delays and windows.

    Args:
        source: Folder or storage file of the bag; or tables, one or more: of a load cell, of
            capacitances or stresses, and takes of motion capture, which their columns tell apart.
        path: Folder of the new trial.
        wrench: Topic or table of the load cell's wrench, or none (default: found by its type).
        socket_pose: Topic of the pose of the socket's marker body, tf:PARENT/CHILD for a transform,
            FILE:BODY of a take, or none (default: found by type and name).
        pylon_pose: Topic of the pose of the pylon's marker body, tf:PARENT/CHILD for a transform,
            FILE:BODY of a take, or none (default: found by type and name).
        clusters: Topic or table of the clusters' capacitances or stresses, or none (default: found
            by type and name).
        names: Clusters of an array or table without names, in its order, four capacitances each.
        rate: Rate of triggers over the time that all sources share [Hz] (default: 4, unless a
            trigger is given).
        trigger: Topic whose stamps are the triggers.
        offset: What to add to the times of the table of wrench, socket_pose, pylon_pose or
            clusters, so that they count as those of the first table [s].
        columns: Titles of columns of tables, for time, Fx to Mz, or a channel such as distal.0.
        units: Units of tables, for time, force, moment, capacitance or stress; they override those
            of the titles.
        row_rate: Rate of the rows of a source's table without times [Hz].
        delay: Delay of the stamps of wrench, socket_pose, pylon_pose or clusters behind the
            measurement [s].
        wrench_of: Whose force the wrench is: of the limb on the socket, as in a trial, or of the
            socket on the limb, which is negated (default: limb).
        mapping: A mapping.yaml with topics, windows, delays and the pose of the load cell in {S}.
        geometry: A socket.yaml (default: the package's own).
        calibration: A calibration.yaml (default: the package's own).
        notify: Called with each note, such as the topics used and what is missing; None issues
            warnings.

    Returns:
        The new trial, opened as by `st.open_trial`.

    Raises:
        TrialError: The bag cannot be read, a topic is not there or of another type, several topics
            suit, or the sources share no time.
        ConfigurationError: An option or a file is wrong, or the folder exists.
    """
    notify = warnings.warn if notify is None else notify
    paths = _paths(source)
    output = path_of(path, "the folder of the trial")
    check_new_folder(output)
    given = {
        "wrench": wrench,
        "socket_pose": socket_pose,
        "pylon_pose": pylon_pose,
        "clusters": clusters,
    }
    numbers = {
        "delay": _by_source(delay, "delay", -MAX_DELAY, MAX_DELAY),
        "offset": _by_source(offset, "offset", -MAX_OFFSET, MAX_OFFSET),
        "row_rate": _by_source(row_rate, "row_rate", 0.1, 20000.0),
    }
    chosen = _mapping(as_path(mapping), given, numbers, names, wrench_of)
    chosen = msgspec.structs.replace(
        chosen,
        columns={**chosen.columns, **_pairs(columns, "columns", "a column and its title")},
        units={**chosen.units, **_pairs(units, "units", "a quantity and its unit")},
    )
    chosen = _with_triggers(chosen, rate, trigger)
    files = as_path(geometry), as_path(calibration)
    configuration = read_configuration(*files)
    socket = read_socket(file_or_packaged(files[0], SOCKET_FILE))
    coefficients = read_calibration(file_or_packaged(files[1], CALIBRATION_FILE))
    tables = foreign_tables.are_tables(paths)
    read = _from_tables(paths, chosen, socket) if tables else _from_bag(paths[0], chosen)
    sources, received = read.sources, read.messages
    for note in read.notes:
        notify(note)
    for lacking in foreign.SOURCES:
        if lacking not in sources:
            notify(foreign.LACKING[lacking])
    for place, own in sources.items():
        notify(_in_words(place, own))
        for note in own.notes:
            notify(note)
    triggers = _triggers(chosen, sources, received)
    period = 1e-9 * usual_period(triggers) if len(triggers) > 1 else 0.0
    aligned: dict[str, Aligned] = {
        name: align(own.series, triggers, getattr(chosen, name).settings, period)
        for name, own in sources.items()
    }
    _refuse_nothing(aligned, sources, triggers)
    record: dict[str, Any] = {**read.record, "triggers": _trigger_record(chosen, triggers)}
    for place, values_of in aligned.items():
        settings = getattr(chosen, place).settings
        window = averaging_span(settings.window, period)
        record[place] = {
            "topic": sources[place].topic,
            "type": sources[place].type,
            **imported.described(values_of, settings, window),
        }
    record["notes"] = [note for own in sources.values() for note in own.notes]
    if "wrench" in aligned:
        values = imported.in_load_cell(aligned["wrench"].values, chosen.wrench)
        aligned["wrench"] = _replaced(aligned["wrench"], values)
        record["wrench"]["of"] = chosen.wrench.of
        if chosen.wrench.pose is not None:
            record["wrench"]["pose"] = msgspec.to_builtins(chosen.wrench.pose)
        if doubt := _sign_doubt(values, socket, chosen.wrench.of):
            notify(doubt)
    cluster_values = _cluster_values(sources, aligned, coefficients, triggers, notify)
    originals = (message for each in received.values() for message in each)
    imported.write_imported_trial(
        output,
        triggers,
        aligned,
        cluster_values,
        [*originals],
        configuration,
        record,
        paths if tables else (),
    )
    return open_trial(output, notify=notify)


@dataclass(frozen=True)
class _Read:
    """What was read from a bag or tables.

    Attributes:
        sources: What each source measured, by its name, on one clock.
        messages: The messages of a bag by topic.
        record: What `import.yaml` states of where it is from.
        notes: Remarks for the user.
    """

    sources: Mapping[str, foreign.ForeignSource]
    messages: Mapping[str, Sequence[RawMessage]]
    record: Mapping[str, Any]
    notes: Sequence[str]


def _paths(source: PathLike | Sequence[PathLike]) -> list[Path]:
    """The bag, or the tables, that a user gives."""
    several = isinstance(source, Sequence) and not isinstance(source, str)
    paths = [path_of(each, "the bag") for each in (source if several else [source])]
    if not paths:
        raise ConfigurationError("no bag or table is given", "name a bag, or tables")
    if len(paths) > 1 and not foreign_tables.are_tables(paths):
        fact = f"{paths[1]} is given beside {paths[0]}"
        raise ConfigurationError(fact, "import one bag, or several tables")
    return paths


def _from_bag(path: Path, chosen: imported.SourceMapping) -> _Read:
    """The sources of a bag."""
    with BagReader(path) as reader:
        notes = list(reader.notes)
        stated = {name: getattr(chosen, name).topic for name in foreign.SOURCES}
        found = foreign.propose(reader, {name: at for name, at in stated.items() if at is not None})
        if chosen.trigger is not None and not reader.counts.get(chosen.trigger):
            known = [name for name, count in reader.counts.items() if count]
            fact = f"{path}: the topic {chosen.trigger} of --trigger holds no message"
            raise TrialError(fact, closest(chosen.trigger, known))
        received = foreign.read_messages(reader, found, chosen.trigger)
    sources = {
        name: foreign.read_source(name, at, received, chosen.clusters.names)
        for name, at in found.items()
    }
    return _Read(sources, received, {"bag": path.name}, notes)


def _from_tables(
    paths: Sequence[Path], chosen: imported.SourceMapping, socket: SocketGeometry
) -> _Read:
    """The sources of tables, on one clock."""
    if chosen.trigger is not None:
        raise ConfigurationError("tables hold no topic for --trigger", "give --rate instead")
    at = {name: getattr(chosen, name) for name in foreign.SOURCES}
    formats = {
        name: TableFormat(chosen.columns, chosen.units, own.row_rate, chosen.clusters.names)
        for name, own in at.items()
    }
    named = {name: own.topic for name, own in at.items() if own.topic is not None}
    files = foreign_tables.read_files(paths)
    parts = foreign_tables.propose_tables(files, named, formats["clusters"])
    sources, clocks = foreign_tables.read_table_sources(parts, files, formats, socket)
    stated = {name: own.offset for name, own in at.items() if own.offset is not None}
    offsets = stated_offsets(clocks, stated)
    are_dated = all(clock.is_dated for clock in clocks)
    on_one = {
        name: replace(
            sources[name],
            series=to_common_clock(sources[name].series, clock, offsets[clock.file], are_dated),
        )
        for clock in clocks
        for name in clock.sources
    }
    record = {
        "files": [path.name for path in paths],
        "clocks": {
            file: {"offset": own.seconds, "how": own.how}
            | ({} if np.isnan(own.error) else {"error": round(own.error, 6)})
            for file, own in offsets.items()
        },
    }
    notes = [] if len(clocks) == 1 else [clocks_in_words(clocks, offsets)]
    if not are_dated:
        notes.append("no date is known for all tables: times count from 2000-01-01")
    ordered = {name: on_one[name] for name in foreign.SOURCES if name in on_one}
    return _Read(ordered, {}, record, notes)


def _mapping(
    file: Path | None,
    given: Mapping[str, str | None],
    numbers: Mapping[str, Mapping[str, float]],
    names: Sequence[str],
    wrench_of: WrenchOf | None,
) -> imported.SourceMapping:
    """The mapping of a file, with what the options state."""
    chosen = (
        imported.SourceMapping() if file is None else read_document(file, imported.SourceMapping)
    )
    for name in foreign.SOURCES:
        changes: dict[str, Any] = {}
        if given[name] is not None:
            changes["topic"] = given[name]
        changes |= {field: own[name] for field, own in numbers.items() if name in own}
        if name == "clusters" and names:
            changes["names"] = tuple(names)
        if name == "wrench" and wrench_of is not None:
            known = get_args(WrenchOf)
            if wrench_of not in known:
                raise ConfigurationError(f"wrench_of is '{wrench_of}'", closest(wrench_of, known))
            changes["of"] = wrench_of
        own = msgspec.structs.replace(getattr(chosen, name), **changes)
        own.settings  # noqa: B018  (refuses a method or window that is wrong)
        chosen = msgspec.structs.replace(chosen, **{name: own})
    return chosen


def _with_triggers(
    chosen: imported.SourceMapping, rate: float | None, trigger: str | None
) -> imported.SourceMapping:
    """The mapping with the triggers of the options, which replace those of the file."""
    if rate is not None and trigger is not None:
        raise ConfigurationError("rate and trigger are both given", "give one of them")
    if rate is not None:
        check_number(rate, "--rate", 0.1, 1000.0)
        return msgspec.structs.replace(chosen, rate=rate, trigger=None)
    if trigger is not None:
        return msgspec.structs.replace(chosen, rate=None, trigger=trigger)
    if chosen.rate is not None and chosen.trigger is not None:
        raise ConfigurationError("the mapping has both rate and trigger", "give one of them")
    if chosen.rate is None and chosen.trigger is None:
        return msgspec.structs.replace(chosen, rate=TriggerSettings.rate)
    return chosen


def _by_source(
    given: Iterable[str] | Mapping[str, float], what: str, low: float, high: float
) -> dict[str, float]:
    """Numbers by source, of texts such as `wrench=0.02` or a mapping."""
    found: dict[str, float] = {}
    form = "a source and a number, such as wrench=0.02"
    for name, value in _pairs(given, what, form).items():
        if name not in foreign.SOURCES:
            raise ConfigurationError(f"{what} names '{name}'", closest(name, foreign.SOURCES))
        try:
            number = float(value)
        except (TypeError, ValueError):
            fact = f"the {what} of {name} is '{value}'"
            raise ConfigurationError(fact, f"give {form}") from None
        found[name] = check_number(number, f"the {what} of {name}", low, high)
    return found


def _pairs(given: Iterable[str] | Mapping[str, Any], what: str, form: str) -> dict[str, Any]:
    """Values by name, of texts such as `name=value` or a mapping."""
    if isinstance(given, Mapping):
        return {**given}
    texts = [given] if isinstance(given, str) else [*given]
    if wrong := [text for text in texts if "=" not in str(text)]:
        raise ConfigurationError(f"{what} is '{wrong[0]}'", f"give {form}")
    return {name.strip(): value.strip() for name, _, value in (t.partition("=") for t in texts)}


def _in_words(name: str, own: foreign.ForeignSource) -> str:
    times = own.series.times
    rate = f" at {1e9 * (len(times) - 1) / np.ptp(times):.3g} Hz" if len(times) > 1 else ""
    frame = getattr(own.series, "frame", "")
    return (
        f"{foreign.in_words(name)}: {own.topic} ({own.type}, {len(times)} readings{rate}"
        f"{f', frame {frame}' if frame else ''})"
    )


def _triggers(
    chosen: imported.SourceMapping,
    sources: Mapping[str, foreign.ForeignSource],
    received: Mapping[str, Sequence[Any]],
) -> IntArray:
    """Times of the triggers, shape (N,) [ns]."""
    if chosen.trigger is not None:
        triggers = foreign.read_stamps(received.get(chosen.trigger, ()))
        if not len(triggers):
            raise TrialError(f"{chosen.trigger}: no message can be decoded", "give --rate instead")
        return triggers
    assert chosen.rate is not None
    delays = {f"the {foreign.in_words(n)}": getattr(chosen, n).delay for n in sources}
    series = {f"the {foreign.in_words(name)}": own.series for name, own in sources.items()}
    return triggers_at(chosen.rate, series, delays)


def _trigger_record(chosen: imported.SourceMapping, triggers: IntArray) -> dict[str, Any]:
    if chosen.trigger is not None:
        return {"topic": chosen.trigger, "number": len(triggers)}
    return {"rate": chosen.rate, "number": len(triggers)}


def _refuse_nothing(
    aligned: Mapping[str, Aligned],
    sources: Mapping[str, foreign.ForeignSource],
    triggers: IntArray,
) -> None:
    """Refuse a source that has a value at no trigger."""
    for name, own in aligned.items():
        if (own.status != Status.OK).all():
            times = sources[name].series.times
            start, end = (times[[0, -1]] - triggers[0]) * 1e-9
            raise TrialError(
                f"{sources[name].topic}: no trigger has readings of the {foreign.in_words(name)}"
                f" around it (they last from {start:.3g} to {end:.3g} s after the first trigger)",
                "check its clock and delay, or set its stale in a mapping.yaml",
            )


def _replaced(aligned: Aligned, values: FloatArray) -> Aligned:
    return Aligned(
        values, aligned.status, aligned.count, aligned.age, aligned.spread, aligned.deviation
    )


def _sign_doubt(values: FloatArray, socket: SocketGeometry, of: WrenchOf) -> str:
    """A note if the largest loads pull the limb out of the socket; empty if they push it in."""
    along = values[:, 3:] @ proximal_direction(socket)
    along = along[np.isfinite(along)]
    if not len(along) or np.abs(along).max() < _CLEAR_LOAD:
        return ""
    heavy = along[np.abs(along) > 0.5 * np.abs(along).max()]
    if np.median(heavy) < 0.0:
        return ""
    other = "socket" if of == "limb" else "limb"
    return (
        f"the load pulls the limb out of the socket ({np.median(heavy):+.0f} N towards the brim):"
        f" if it is a person's, give --wrench-of {other}, or state the pose of the load cell"
    )


def _cluster_values(
    sources: Mapping[str, foreign.ForeignSource],
    aligned: Mapping[str, Aligned],
    calibration: Calibration,
    triggers: IntArray,
    notify: Callable[[str], None],
) -> tuple[Sequence[str], FloatArray, StatusArray]:
    """Names of the clusters, capacitances (N, C, 4) [pF], and their statuses."""
    if "clusters" not in sources:
        nothing = np.empty((len(triggers), 0, 4))
        return (), nothing, nothing.astype(np.uint8)
    series = sources["clusters"].series
    assert isinstance(series, ClusterSeries)
    values = aligned["clusters"].values
    calibration.require(series.clusters, f"the topic {sources['clusters'].topic}")
    if series.are_stresses:
        from socket_testbed.simulation.sensors import invert_calibration

        stress, shape = values, (*values.shape[:2], 4)
        values = np.full(shape, np.nan)
        for column, name in enumerate(series.clusters):
            known = np.isfinite(stress[:, column]).all(axis=1)
            own = calibration.clusters[name]
            values[known, column] = invert_calibration(own, stress[known, column])
        notify(
            "the stresses are stored as the capacitances that the calibration turns back into them:"
            " do not replace it"
        )
    status = np.where(np.isfinite(values), Status.OK, Status.MISSING).astype(np.uint8)
    return series.clusters, values, status
