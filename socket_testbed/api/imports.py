"""Trials from other laboratories' sensors."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import msgspec

from socket_testbed.alignment.common_clock import MAX_OFFSET
from socket_testbed.api.trials import as_path, open_trial
from socket_testbed.documents import check_number, path_of, read_document
from socket_testbed.errors import ConfigurationError, closest, option_of
from socket_testbed.files import CALIBRATION_FILE, SOCKET_FILE, check_new_folder
from socket_testbed.results.result import PathLike
from socket_testbed.settings.acquisition import TriggerSettings
from socket_testbed.settings.alignment import MAX_DELAY
from socket_testbed.settings.options import ImportOptions, WrenchOf
from socket_testbed.trials import foreign, foreign_recording, foreign_tables, imported
from socket_testbed.trials.segment import parse_span
from socket_testbed.trials.trial import Trial


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
    offset: Sequence[str] | Mapping[str, float | str] = (),
    tap: str | tuple[float, float] | None = None,
    columns: Sequence[str] | Mapping[str, str] = (),
    units: Sequence[str] | Mapping[str, str] = (),
    row_rate: Sequence[str] | Mapping[str, float] = (),
    delay: Iterable[str] | Mapping[str, float | str] = (),
    wrench_of: WrenchOf | None = None,
    tare: str | None = None,
    mapping: PathLike | None = None,
    like: PathLike | None = None,
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
        socket_pose: Topic of the pose of the socket's marker body, TOPIC:BODY for one of rigid
            bodies, tf:PARENT/CHILD for a transform, FILE:BODY of a take, or none (default: found by
            type and name).
        pylon_pose: Topic of the pose of the pylon's marker body, TOPIC:BODY for one of rigid
            bodies, tf:PARENT/CHILD for a transform, FILE:BODY of a take, or none (default: found by
            type and name).
        clusters: Topic or table of the clusters' capacitances or stresses, or none (default: found
            by type and name).
        names: Clusters of an array or table without names, in its order, four capacitances each.
        rate: Rate of triggers over the time that all sources share [Hz] (default: 4, unless a
            trigger is given).
        trigger: Topic whose stamps are the triggers.
        offset: What to add to the times of the table of wrench, socket_pose, pylon_pose or
            clusters, so that they count as those of the first table [s]; tap if both see one tap.
        tap: Seconds since the start of each table in which the tap is (default: any).
        columns: Titles of columns of tables, for time, Fx to Mz, or a channel such as distal.0.
        units: Units of tables, for time, force, moment, capacitance, stress or length; they
            override those of the titles.
        row_rate: Rate of the rows of a source's table without times [Hz].
        delay: Delay of the stamps of wrench, socket_pose, pylon_pose or clusters behind the
            measurement [s]; auto finds it against the load, from a minute of brisk pushing, see
            `alignment.delay.find_delay`.
        wrench_of: Whose force the wrench is: of the limb on the socket, as in a trial, or of the
            socket on the limb, which is negated (default: limb).
        tare: Span without load, since the first trigger [s], whose mean wrench is subtracted
            (default: none, for a load cell that is tared).
        mapping: A mapping.yaml with topics, windows, delays and the pose of the load cell in {S}.
        like: An imported trial, whose mapping, socket and calibration are used again, with the
            delays that were found; whatever else is given replaces its own.
        geometry: A socket.yaml (default: that of the trial to be like, or the package's own).
        calibration: A calibration.yaml (default: that of the trial to be like, or the package's
            own).
        notify: Called with each note, such as the topics used and what is missing; None issues
            warnings.

    Returns:
        The new trial, opened as by `st.open_trial`.

    Raises:
        TrialError: The bag cannot be read, a topic is not there or of another type, several topics
            suit, or the sources share no time.
        ConfigurationError: An option or a file is wrong, or the folder exists.

    >>> trial = st.import_trial("load_cell.csv", "trials/load_cell", rate=10)
    >>> found = trial.samples()
    >>> found.to_dataframe()["Fz [N]"].iloc[[0, -1]].round(1).to_list()
    [-10.0, -50.0]
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
        "delay": _by_source(delay, "delay", (-MAX_DELAY, MAX_DELAY), "0.02", imported.AUTO),
        "offset": _by_source(offset, "offset", (-MAX_OFFSET, MAX_OFFSET), "3", imported.TAP),
        "row_rate": _by_source(row_rate, "row_rate", (0.1, 20000.0), "100"),
    }
    socket, coefficients = as_path(geometry), as_path(calibration)
    model = None if like is None else path_of(like, "the trial of like")
    if model is not None:
        socket = socket or model / SOCKET_FILE
        coefficients = coefficients or model / CALIBRATION_FILE
    base = _base_mapping(as_path(mapping), model)
    chosen = _mapping(base, given, numbers, names, wrench_of)
    chosen = msgspec.structs.replace(
        chosen,
        columns={**chosen.columns, **_pairs(columns, "columns", "a column and its title")},
        units={**chosen.units, **_pairs(units, "units", "a quantity and its unit")},
    )
    if tare is not None:
        chosen = msgspec.structs.replace(
            chosen, wrench=msgspec.structs.replace(chosen.wrench, tare=tare)
        )
    if chosen.wrench.tare is not None:
        parse_span(chosen.wrench.tare, "--tare")
    chosen = _with_triggers(chosen, rate, trigger)
    if foreign_tables.are_tables(paths):
        recording = foreign_recording.read_tables(paths, chosen, socket, tap, notify)
    else:
        _refuse_options_of_tables(paths[0], chosen, tap)
        recording = foreign_recording.read_bag(paths[0], chosen, notify)
    foreign_recording.make_trial(recording, output, chosen, socket, coefficients, notify=notify)
    return open_trial(output, notify=notify)


def _refuse_options_of_tables(
    bag: Path, chosen: imported.SourceMapping, tap: str | tuple[float, float] | None
) -> None:
    """Refuse what only tables have, for a bag."""
    sources = [getattr(chosen, name) for name in foreign.SOURCES]
    given = {
        "offset": any(own.offset is not None for own in sources),
        "row_rate": any(own.row_rate is not None for own in sources),
        "columns": bool(chosen.columns),
        "units": bool(chosen.units),
        "tap": tap is not None,
    }
    for name, is_given in given.items():
        if is_given:
            fact = f"{option_of(name)} is for tables, and {bag} is a bag"
            raise ConfigurationError(fact, "leave it out; --delay corrects the stamps of a topic")


def _paths(source: PathLike | Sequence[PathLike]) -> list[Path]:
    """The bag, or the tables, that a user gives."""
    given: list[Any] = [source]
    if isinstance(source, Sequence) and not isinstance(source, str):
        given = [*source]
    paths = [path_of(each, "the bag") for each in given]
    if not paths:
        raise ConfigurationError("no bag or table is given", "name a bag, or tables")
    if len(paths) > 1 and not foreign_tables.are_tables(paths):
        fact = f"{paths[1]} is given beside {paths[0]}"
        raise ConfigurationError(fact, "import one bag, or several tables")
    return paths


def _base_mapping(file: Path | None, like: Path | None) -> imported.SourceMapping:
    """The mapping of a file, or of a trial that was imported; the usual one for neither."""
    if file is not None and like is not None:
        raise ConfigurationError("mapping and like are both given", "give one of them")
    if like is not None:
        return imported.read_mapping(like)
    if file is not None:
        return read_document(file, imported.SourceMapping)
    return imported.SourceMapping()


def _mapping(
    chosen: imported.SourceMapping,
    given: Mapping[str, str | None],
    numbers: Mapping[str, Mapping[str, float | str]],
    names: Sequence[str],
    wrench_of: WrenchOf | None,
) -> imported.SourceMapping:
    """A mapping, with what the options state."""
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
        own.settings(0.0)  # refuses a method or window that is wrong
        chosen = msgspec.structs.replace(chosen, **{name: own})
    return chosen


def _with_triggers(
    chosen: imported.SourceMapping, rate: float | None, trigger: str | None
) -> imported.SourceMapping:
    """The mapping with the triggers of the options, which replace those of the file."""
    if rate is not None and trigger is not None:
        raise ConfigurationError("rate and trigger are both given", "give one of them")
    if rate is not None:
        stated = ImportOptions(rate=rate)
        return msgspec.structs.replace(chosen, rate=stated.rate, trigger=None)
    if trigger is not None:
        return msgspec.structs.replace(chosen, rate=None, trigger=trigger)
    if chosen.rate is not None and chosen.trigger is not None:
        raise ConfigurationError("the mapping has both rate and trigger", "give one of them")
    if chosen.rate is None and chosen.trigger is None:
        return msgspec.structs.replace(chosen, rate=TriggerSettings.rate)
    return chosen


def _by_source(
    given: Iterable[str] | Mapping[str, Any],
    what: str,
    ends: tuple[float, float],
    example: str,
    word: str = "",
) -> dict[str, float | str]:
    """Numbers by source, of texts such as `wrench=0.02` or a mapping; a known word stays."""
    form = f"a source and a number, such as wrench={example}"
    form += f", or wrench={word}" if word else ""
    found: dict[str, float | str] = {}
    for name, value in _pairs(given, what, form).items():
        if name not in foreign.SOURCES:
            raise ConfigurationError(f"{what} names '{name}'", closest(name, foreign.SOURCES))
        if word and value == word:
            found[name] = word
            continue
        try:
            number = float(value)
        except (TypeError, ValueError):
            fact = f"the {what} of {name} is '{value}'"
            raise ConfigurationError(fact, f"give {form}") from None
        found[name] = check_number(number, f"the {what} of {name}", *ends)
    return found


def _pairs(given: Iterable[str] | Mapping[str, Any], what: str, form: str) -> dict[str, Any]:
    """Values by name, of texts such as `name=value` or a mapping."""
    if isinstance(given, Mapping):
        return {**given}
    texts = [given] if isinstance(given, str) else [*given]
    if wrong := [text for text in texts if "=" not in str(text)]:
        raise ConfigurationError(f"{what} is '{wrong[0]}'", f"give {form}")
    return {name.strip(): value.strip() for name, _, value in (t.partition("=") for t in texts)}
