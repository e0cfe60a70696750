"""Makes a trial of what other sensors recorded: one value of each source for every trigger.

Delays are those stated, or those that the load tells. `import.yaml` records what was done.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from socket_testbed.alignment.align import Aligned, align
from socket_testbed.alignment.delay import Delay, find_delay
from socket_testbed.alignment.series import ClusterSeries, PoseSeries, WrenchSeries
from socket_testbed.alignment.triggers import triggers_at
from socket_testbed.arrays import FloatArray, IntArray, StatusArray, usual_period, within
from socket_testbed.calibration.model import Calibration, invert_calibration, read_calibration
from socket_testbed.errors import TrialError, closest
from socket_testbed.files import CALIBRATION_FILE, SOCKET_FILE, file_or_packaged
from socket_testbed.geometry.regions import proximal_direction
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.samples import Status
from socket_testbed.settings.options import WrenchOf
from socket_testbed.trials import foreign, foreign_tables, imported
from socket_testbed.trials.bag import BagReader, RawMessage
from socket_testbed.trials.segment import parse_span
from socket_testbed.trials.trial import read_configuration

_CLEAR_LOAD = 50.0  # [N]; above which the load shows the sign of the wrench


@dataclass(frozen=True)
class ForeignRecording:
    """What other sensors recorded, whether in a bag or in tables.

    Attributes:
        name: Name of the bag or of the first table, for the record.
        sources: The measurements, on one clock.
        triggers: Times of the triggers of a topic, shape (N,) [ns]; None for the mapping's rate.
        messages: The messages from which the measurements come; the trial stores them unchanged.
        files: The tables from which they come, by name; the trial stores them unchanged.
        record: What `import.yaml` states of the tables.
    """

    name: str
    sources: Mapping[foreign.Source, foreign.ForeignSource]
    triggers: IntArray | None = None
    messages: Sequence[RawMessage] = ()
    files: Mapping[str, bytes] = field(default_factory=dict)
    record: Mapping[str, Any] = field(default_factory=dict)


def read_bag(
    source: Path, chosen: imported.SourceMapping, notify: Callable[[str], None]
) -> ForeignRecording:
    """Read what a bag's topics measured.

    Args:
        source: Folder or storage file of the bag.
        chosen: The mapping, whose topics are read; those that it does not name are found.
        notify: Called with each note on the bag.

    Raises:
        TrialError: If a topic is not in the bag, holds no message, or cannot be decoded.
    """
    with BagReader(source) as reader:
        for note in reader.notes:
            notify(note)
        stated = {name: getattr(chosen, name).topic for name in foreign.SOURCES}
        topics = {name: at for name, at in stated.items() if at is not None}
        named: dict[str, str] = {str(name): at for name, at in topics.items()}
        if chosen.trigger is not None:
            named["trigger"] = chosen.trigger
        foreign.refuse_lacking(reader, named)
        found = foreign.propose(reader, topics)
        if chosen.trigger is not None and not reader.counts.get(chosen.trigger):
            known = [name for name, count in reader.counts.items() if count]
            fact = f"{source}: the topic {chosen.trigger} of --trigger holds no message"
            raise TrialError(fact, closest(chosen.trigger, known))
        received = foreign.read_messages(reader, found, chosen.trigger)
    sources = {
        name: foreign.read_source(name, at, received, chosen.clusters.names)
        for name, at in found.items()
    }
    triggers = None
    if chosen.trigger is not None:
        triggers = foreign.read_stamps(received.get(chosen.trigger, ()))
        if not len(triggers):
            raise TrialError(f"{chosen.trigger}: no message can be decoded", "give --rate instead")
    messages = [message for each in received.values() for message in each]
    return ForeignRecording(source.name, sources, triggers, messages)


def read_tables(
    paths: Sequence[Path],
    chosen: imported.SourceMapping,
    geometry: Path | None,
    tap: str | tuple[float, float] | None,
    notify: Callable[[str], None],
) -> ForeignRecording:
    """Read what tables hold, on one clock.

    Args:
        paths: The tables, of which the first states the clock.
        chosen: The mapping, with offsets, rates, titles and units of the tables.
        geometry: A socket.yaml; None for the package's own.
        tap: Span since the start of each table in which the tap is, as `T0:T1` or a pair [s]; None
            for any time.
        notify: Called with each note on the tables.
    """
    span = None
    if tap is not None:
        text = ":".join(map(str, tap)) if isinstance(tap, tuple | list) else str(tap)
        span = parse_span(text, "--tap")
    socket = read_socket(file_or_packaged(geometry, SOCKET_FILE))
    tables = foreign_tables.read_tables(paths, chosen, socket, span)
    for note in tables.notes:
        notify(note)
    return ForeignRecording(paths[0].name, tables.sources, files=tables.files, record=tables.record)


def make_trial(
    recording: ForeignRecording,
    path: Path,
    chosen: imported.SourceMapping,
    geometry: Path | None = None,
    calibration: Path | None = None,
    *,
    notify: Callable[[str], None],
) -> None:
    """Make a trial of what other sensors recorded.

    Args:
        recording: What they recorded.
        path: Folder of the new trial.
        chosen: How it is brought to triggers; its topics do not matter here.
        geometry: A socket.yaml; None for the package's own.
        calibration: A calibration.yaml; None for the package's own.
        notify: Called with each note.

    Raises:
        TrialError: If a source has no value at any trigger, or the sources share no time.
        ConfigurationError: If a file is wrong, or the folder exists.
    """
    configuration = read_configuration(geometry, calibration)
    socket = read_socket(file_or_packaged(geometry, SOCKET_FILE))
    coefficients = read_calibration(file_or_packaged(calibration, CALIBRATION_FILE))
    sources = recording.sources
    for lacking in foreign.SOURCES:
        if lacking not in sources:
            notify(foreign.LACKING[lacking])
    for place, own in sources.items():
        notify(_in_words(place, own))
        for note in own.notes:
            notify(note)
    delays = _delays_of(sources, chosen, notify)
    triggers = recording.triggers
    if triggers is None:
        assert chosen.rate is not None
        named = {f"the {foreign.in_words(name)}": own.series for name, own in sources.items()}
        seconds = {f"the {foreign.in_words(name)}": own.delay for name, own in delays.items()}
        triggers = triggers_at(chosen.rate, named, seconds)
    period = 1e-9 * usual_period(triggers) if len(triggers) > 1 else 0.0
    settings = {name: getattr(chosen, name).settings(delays[name].delay) for name in sources}
    aligned: dict[foreign.Source, Aligned] = {
        name: align(own.series, triggers, settings[name], period) for name, own in sources.items()
    }
    _refuse_nothing(aligned, sources, triggers)
    record: dict[str, Any] = {"from": recording.name, **recording.record}
    record[imported.MAPPING] = imported.stated(_as_used(chosen, recording, delays))
    record["triggers"] = _trigger_record(chosen, triggers)
    for name, own in sources.items():
        window = settings[name].span(period)
        record[name] = {"topic": own.topic, "type": own.type}
        record[name] |= imported.described(aligned[name], settings[name], window)
        if getattr(chosen, name).delay == imported.AUTO:
            ends = delays[name].low, delays[name].high
            record[name]["delay_interval"] = [round(end, 6) for end in ends]
    record["notes"] = [note for own in sources.values() for note in own.notes]
    if "wrench" in aligned:
        values = aligned["wrench"].values
        if chosen.wrench.tare is not None:
            no_load = _no_load(sources["wrench"], chosen.wrench.tare, triggers, delays["wrench"])
            values = values - no_load
            record["wrench"]["tare"] = {
                "span": chosen.wrench.tare, "values": [round(v, 6) for v in no_load.tolist()]
            }  # fmt: skip
        values = imported.in_load_cell(values, chosen.wrench)
        aligned["wrench"] = replace(aligned["wrench"], values=values)
        record["wrench"]["of"] = chosen.wrench.of
        if chosen.wrench.pose is not None:
            record["wrench"]["pose"] = msgspec.to_builtins(chosen.wrench.pose)
        if doubt := _sign_doubt(values, socket, chosen.wrench.of):
            notify(doubt)
    cluster_values = _cluster_values(sources, aligned, coefficients, triggers, notify)
    files = {**configuration, **recording.files}
    imported.write_imported_trial(
        path,
        triggers,
        {str(name): own for name, own in aligned.items()},
        cluster_values,
        recording.messages,
        files,
        record,
    )


def _as_used(
    chosen: imported.SourceMapping,
    recording: ForeignRecording,
    delays: Mapping[foreign.Source, Delay],
) -> imported.SourceMapping:
    """The mapping for other recordings like this one: its topics, and the delays that were found.

    Tables are named anew for each recording; of a take the body stays. A tap is sought again.
    """
    parts = {name: foreign.topic_and_body(own.topic) for name, own in recording.sources.items()}
    takes = {file for file, body in parts.values() if body}
    for name, own in recording.sources.items():
        topic: str | None = own.topic
        if recording.files:
            topic = parts[name][1] or None if len(takes) == 1 else None
        source = getattr(chosen, name)
        changed = msgspec.structs.replace(source, topic=topic, delay=round(delays[name].delay, 6))
        chosen = msgspec.structs.replace(chosen, **{name: changed})
    return chosen


def _delays_of(
    sources: Mapping[foreign.Source, foreign.ForeignSource],
    chosen: imported.SourceMapping,
    notify: Callable[[str], None],
) -> dict[foreign.Source, Delay]:
    """Delays of the sources: those stated, and those that the load tells where they are `auto`."""
    delays: dict[foreign.Source, Delay] = {}
    sought: list[foreign.Source] = []
    for name in sources:
        stated = getattr(chosen, name).delay
        if stated == imported.AUTO:
            sought.append(name)
        else:
            delays[name] = Delay(stated, stated, stated, 1.0)
    if not sought:
        return delays
    if "wrench" not in sources:
        fact = f"the delay of the {foreign.in_words(sought[0])} is auto, and there is no wrench"
        raise TrialError(fact, "state the delay in seconds")
    followers: tuple[foreign.Source, ...] = "pylon_pose", "clusters"
    others = [name for name in followers if name in sources]
    if "wrench" in sought:
        others = [name for name in others if name not in sought]
        if not others:
            raise TrialError(
                "the delay of the wrench is auto, and no other source with a stated delay moves"
                " with the load",
                "state that of the pylon pose or of the clusters, or that of the wrench",
            )
        found = _delay_behind_load(others[0], sources)
        delays["wrench"] = found.reversed.later(delays[others[0]].delay)
        notify(f"delay of the wrench behind the {foreign.in_words(others[0])}: {found.reversed}")
    for name in sought:
        if name == "wrench":
            continue
        of: foreign.Source = "clusters" if name == "clusters" else "pylon_pose"
        if of not in sources:
            fact = "the delay of the socket pose is auto, and there is no pose of the pylon"
            raise TrialError(fact, "state the delay in seconds")
        found = _delay_behind_load(of, sources)
        delays[name] = found.later(delays["wrench"].delay)
        notify(f"delay of the {foreign.in_words(name)} behind the wrench: {found}")
    return delays


def _delay_behind_load(
    name: foreign.Source, sources: Mapping[foreign.Source, foreign.ForeignSource]
) -> Delay:
    """Delay of the pylon's pose or the clusters behind the wrench, by their stamps."""
    load, own = sources["wrench"].series, sources[name].series
    socket = sources["socket_pose"].series if "socket_pose" in sources else None
    assert isinstance(load, WrenchSeries) and not isinstance(own, WrenchSeries)
    if isinstance(own, ClusterSeries):
        return find_delay(load, own)
    assert socket is None or isinstance(socket, PoseSeries)
    return find_delay(load, own, socket)


def _in_words(name: str, own: foreign.ForeignSource) -> str:
    times = own.series.times
    rate = f" at {1e9 * (len(times) - 1) / np.ptp(times):.3g} Hz" if len(times) > 1 else ""
    frame = getattr(own.series, "frame", "")
    return (
        f"{foreign.in_words(name)}: {own.topic} ({own.type}, {len(times)} readings{rate}"
        f"{f', frame {frame}' if frame else ''})"
    )


def _trigger_record(chosen: imported.SourceMapping, triggers: IntArray) -> dict[str, Any]:
    if chosen.trigger is not None:
        return {"topic": chosen.trigger, "number": len(triggers)}
    return {"rate": chosen.rate, "number": len(triggers)}


def _refuse_nothing(
    aligned: Mapping[foreign.Source, Aligned],
    sources: Mapping[foreign.Source, foreign.ForeignSource],
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


def _no_load(
    source: foreign.ForeignSource, tare: str, triggers: IntArray, delay: Delay
) -> FloatArray:
    """Mean wrench [M; F] in a span without load, in the frame of the messages, shape (6,)."""
    assert isinstance(source.series, WrenchSeries)
    start, end = parse_span(tare, "--tare")
    since = (source.series.times - triggers[0]) * 1e-9 - delay.delay
    inside = source.series.values[within(since, start, end)]
    inside = inside[np.isfinite(inside).all(axis=1)]
    if not len(inside):
        raise TrialError(
            f"{source.topic} has no reading in the span {tare} s of the tare",
            f"give a span between {since[0]:.3g} and {since[-1]:.3g} s",
        )
    return np.asarray(inside.mean(axis=0))


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
    sources: Mapping[foreign.Source, foreign.ForeignSource],
    aligned: Mapping[foreign.Source, Aligned],
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
