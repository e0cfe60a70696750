"""A trial: a bag with the geometry, calibration and parameters of its recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from hashlib import sha256
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from socket_testbed.calibration.model import Calibration, read_calibration
from socket_testbed.documents import check_kind
from socket_testbed.errors import ConfigurationError, TestbedError, TrialError
from socket_testbed.files import (
    CALIBRATION_FILE,
    PARAMETERS_FILE,
    SOCKET_FILE,
    file_or_packaged,
    sync,
)
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.samples import WRENCH_CHANNELS, Samples, Status, named_channels
from socket_testbed.settings.options import RECORDED, SettingsOptions
from socket_testbed.settings.testbed import (
    EstimatorSettings,
    TestbedSettings,
    estimator_settings,
    read_testbed,
)
from socket_testbed.tables import split_unit, stacked
from socket_testbed.trials import reprocess, synchronise
from socket_testbed.trials.bag import BagReader, required_topics
from socket_testbed.trials.events import Event, find_events, join_events, read_events
from socket_testbed.trials.metadata import METADATA_FILE, TrialMetadata, read_metadata
from socket_testbed.trials.segment import (
    Segment,
    Span,
    find_plateaus,
    select_segment,
    specification_of,
)
from socket_testbed.trials.tares import RecordedTare, find_tares
from socket_testbed.trials.truth import GroundTruth, read_truth
from socket_testbed.wire import topics
from socket_testbed.wire.messages import Reader

if TYPE_CHECKING:
    import pandas as pd

    from socket_testbed.identification.checked import CheckedSamples, Evidence
    from socket_testbed.identification.data_finding import DataFinding

_CHECKED = 20  # [messages]; at the start of a trial
_FINGERPRINT_SPAN = 30.0  # [s]; a copy that was cut later has the same fingerprint


@dataclass
class _Kept:
    """What a trial keeps of its readings, so that later calls need no other one.

    Attributes:
        bag: The bag within `Trial.kept_open`; None otherwise.
        read: The measurements, without those that only the check of the data needs, and the
            samples; None before the first reading.
        fingerprint: The fingerprint; empty before the first reading.
        tares: The recorded tares.
        events: The recorded events, in recording order.
        checked: The judged samples, by left-out channels.
        raw: The problems that the measurements show, and what nodes reported.
        notes: The notes on readings as keys, in their order, without duplicates.
    """

    bag: BagReader | None = None
    read: tuple[synchronise.Measurements, Samples] | None = None
    fingerprint: str = ""
    tares: tuple[RecordedTare, ...] = ()
    events: tuple[Event, ...] = ()
    checked: dict[tuple[str, ...], CheckedSamples] = field(default_factory=dict)
    raw: tuple[DataFinding, ...] = ()
    notes: dict[str, None] = field(default_factory=dict)


@dataclass(frozen=True)
class Trial:
    """A recorded trial.

    Attributes:
        path: Its folder, or one storage file.
        socket_file: A `socket.yaml` instead of the trial's own. Poses of a body whose markers
            differ are refitted to its recorded markers.
        calibration_file: A `calibration.yaml` instead of the trial's own.
        notify: Called with each note, one line each: those that are kept in `notes`, and those that
            functions send with `note`; None to hear none.
        unloaded: Start and end of unloaded spans since the first sample [s]: none, one before the
            load, or another one after it, from which the clusters' drift is corrected.
        load_cell_file: A `testbed.yaml` with load-cell settings from which the wrenches are
            recomputed; None for the recorded wrenches.
        tare: The tare of the wrenches: `recorded`, `none`, or `T0:T1`, an unloaded span since the
            first sample [s].

    Raises:
        ConfigurationError: If the spans or the tare are wrong, see `check_unloaded`, `parse_tare`.
    """

    path: Path
    socket_file: Path | None = None
    calibration_file: Path | None = None
    notify: Callable[[str], None] | None = None
    unloaded: tuple[tuple[float, float], ...] = ()
    load_cell_file: Path | None = None
    tare: str = RECORDED
    _kept: _Kept = field(default_factory=_Kept, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        reprocess.check_unloaded(self.unloaded)
        reprocess.parse_tare(self.tare)

    def __repr__(self) -> str:
        return f"Trial({str(self.path)!r})"

    @property
    def name(self) -> str:
        """Name of the trial's folder."""
        return self.path.resolve().name

    @contextmanager
    def open(self) -> Iterator[BagReader]:
        """Open the trial's bag, unless it is kept open; its notes go to `notify`."""
        if self._kept.bag is not None:
            yield self._kept.bag
            return
        with BagReader(self.path) as bag:
            for note in bag.notes:
                self._note_reading(note)
            yield bag

    @contextmanager
    def kept_open(self) -> Iterator[BagReader]:
        """Open the trial's bag once for all readings meanwhile, as opening it scans its files.

        Meanwhile the trial serves a single thread.
        """
        with self.open() as bag:
            self._kept.bag = bag
            try:
                yield bag
            finally:
                self._kept.bag = None

    @property
    def remade(self) -> tuple[topics.Topic, ...]:
        """The raw topics that replace recorded measurements, because files or tare differ."""
        other_wrenches = self.load_cell_file is not None or self.tare != RECORDED
        return (topics.LOAD_CELL_RAW,) * other_wrenches + (topics.MARKERS,) * bool(
            self._other_markers
        )

    @cached_property
    def _other_markers(self) -> tuple[str, ...]:
        """The bodies whose markers in the geometry differ from those of the recording."""
        if self.socket_file is None:
            return ()
        try:
            recorded = read_socket(self.path / SOCKET_FILE)
        except ConfigurationError as error:
            self._note_reading(f"the poses stay as recorded, with unknown markers: {error}")
            return ()
        return reprocess.other_markers(recorded, self.geometry)

    def measurements(self) -> synchronise.Measurements:
        """The measurements, recomputed where `remade` says so, corrected for drift; not cached.

        Raises:
            TrialError: If the trial cannot be read or lacks a topic, an unloaded span is under
                load, or measurements cannot be recomputed.
            ConfigurationError: If an input file is wrong.
            CalibrationError: If the calibration lacks a cluster of the trial, or an unloaded span
                holds too few readings.
        """
        with self.open() as bag:
            recorded = self._recorded(bag)
        return self._corrected(self._remade(recorded))

    def _recorded(self, bag: BagReader) -> synchronise.Measurements:
        """The measurements as recorded, with the bridges' ratios if there are any."""
        name = required_topics(bag).get(topics.LOAD_CELL_RAW, "")
        more = {*self.remade} | ({topics.LOAD_CELL_RAW} if bag.counts.get(name) else set())
        measured = synchronise.read_measurements(bag, self._note_reading, more)
        self._kept.fingerprint = _fingerprint(measured)
        self._kept.tares = tuple(find_tares(measured))
        return self._without_strangers(measured)

    def _remade(self, measured: synchronise.Measurements) -> synchronise.Measurements:
        """The measurements, recomputed where `remade` says so."""
        where = str(self.path)
        if topics.LOAD_CELL_RAW in self.remade:
            given = reprocess.read_load_cell(self.load_cell_file) if self.load_cell_file else None
            recorded = self._parameters.load_cell_node
            measured = reprocess.remake_wrenches(
                measured, recorded, given, self.tare, where, self._note_reading
            )
        if self._other_markers and measured.markers:
            bodies = self._other_markers
            measured = reprocess.refit_poses(
                measured, self.geometry, bodies, where, self._note_reading
            )
        return measured

    def _corrected(self, measured: synchronise.Measurements) -> synchronise.Measurements:
        """The measurements, corrected for drift."""
        if not self.unloaded:
            return measured
        self._require_clusters(measured.clusters)
        least_force, where = self.estimator.plateau.least_force, str(self.path)
        return reprocess.correct_measurements(
            measured, self.unloaded, self.calibration, least_force, where, self._note_reading
        )

    def samples(self) -> Samples:
        """The synchronised samples, one per trigger, in the order of their stamps; cached.

        The stresses are computed from the capacitances with the trial's calibration. Missing values
        are NaN.

        Raises:
            TestbedError: As in `measurements`, or if a cluster of the trial is on no tile.
        """
        return self.measurements_and_samples()[1]

    def _strangers(self, clusters: Collection[str]) -> list[str]:
        """The clusters that the configuration does not know; none if it knows none of them."""
        try:
            known = self.calibration.clusters.keys() & self.geometry.clusters.keys()
        except TestbedError:  # the caller may need neither
            return []
        strangers = [name for name in clusters if name not in known]
        return strangers if len(strangers) < len(clusters) else []

    def _without_strangers(self, measured: synchronise.Measurements) -> synchronise.Measurements:
        """Leave out clusters that the configuration does not know, unless it knows none of them.

        If it knows none, the configuration is of another testbed, which is an error.
        """
        strangers = self._strangers(measured.clusters)
        if not strangers:
            return measured
        counts = (measured.status != Status.MISSING).any(axis=2).sum(axis=0).tolist()
        kept = [i for i, name in enumerate(measured.clusters) if name not in strangers]
        for name in strangers:
            count = counts[measured.clusters.index(name)]
            self._note_reading(
                f"{count} of {len(measured.stamps)} samples name a cluster '{name}', which the"
                " calibration or the socket does not know: left out"
            )
        return replace(
            measured,
            clusters=tuple(measured.clusters[i] for i in kept),
            capacitance=measured.capacitance[:, kept],
            status=measured.status[:, kept],
        )

    def checked(self, leave_out: str | Sequence[str] | None = None) -> CheckedSamples:
        """The samples, judged once: outliers, findings, noise and force maps; cached.

        Its `samples` are those of the trial with outliers as NaN.

        Args:
            leave_out: Channels that are not judged and keep their values, such as `distal.Fz`, or
                `distal` for all of a cluster; None stands for those of the trial's settings.
        """
        from socket_testbed.identification.checked import CheckedSamples  # not needed by a replay

        if leave_out is None:
            leave_out = self.estimator.identification.leave_out
        left, kept = self.channels(leave_out), self._kept.checked
        if left not in kept:
            samples = self.samples()
            kept[left] = CheckedSamples(samples, self.geometry, left, evidence=self._evidence)
        return kept[left]

    def _evidence(self) -> Evidence:
        """What is known of the trial beside its samples."""
        from socket_testbed.identification.checked import Evidence  # not needed by a replay

        return Evidence(self.metadata.mass, self._kept.raw)

    def channels(self, names: str | Sequence[str]) -> tuple[str, ...]:
        """The channels of names such as `Mz`, `distal.Fx`, or `distal` for all three of a cluster.

        Raises:
            ConfigurationError: If the names are not texts.
        """
        listed = named_channels(names, ())
        plain = all("." in name or name in WRENCH_CHANNELS for name in listed)
        return listed if plain else named_channels(listed, self.geometry.clusters)

    def problems(self, leave_out: str | Sequence[str] | None = None) -> tuple[DataFinding, ...]:
        """Problems in the data, worst first; empty if it is good, see `check_data`; cached.

        Left-out channels, such as `distal.Fz`, are not checked; None stands for those of the
        trial's settings.
        """
        return self.checked(leave_out).findings

    def to_dataframe(self) -> pd.DataFrame:
        """The samples as a pandas table, see `Samples.to_dataframe`."""
        return self.samples().to_dataframe()

    def to_long(self) -> pd.DataFrame:
        """The samples in long form, a row per value; no named index.

        Columns: `trial`, its name; `time [s]` since the first sample; `source`, `wrench`, `limb` or
        a cluster; `quantity` and `unit`, such as `Fx` and `N`; and the `value`, NaN if missing.
        Frames and quantities are those of `Samples.to_dataframe`.
        """
        table = self.to_dataframe()
        parts = [split_unit(title) for title in table]
        places = [name.rpartition(".") for name, _ in parts]
        motion = ("q_", "phi_")
        usual = ["limb" if name.startswith(motion) else "wrench" for _, _, name in places]
        columns = {
            "trial": [self.name] * len(parts),
            "time [s]": table.index.to_numpy(),
            "source": [place or own for (place, _, _), own in zip(places, usual, strict=True)],
            "quantity": [name for _, _, name in places],
            "unit": [unit for _, unit in parts],
            "value": table.to_numpy(dtype=float),
        }
        return stacked(columns, len(table))

    def measurements_and_samples(self) -> tuple[synchronise.Measurements, Samples]:
        """`measurements`, without ratios, tares and markers, and `samples`; cached."""
        if self._kept.read is None:
            self._kept.read = self._read()
        return self._kept.read

    def _read(self) -> tuple[synchronise.Measurements, Samples]:
        """Measurements and samples, and the problems that only the measurements show."""
        from socket_testbed.trials import raw_check  # not needed by a replay

        with self.open() as bag:
            recorded = self._recorded(bag)
            turned = [*raw_check.check_orientations(bag, self.geometry)]
            reports = raw_check.check_reports(bag, recorded.stamps)
            self._kept.events = tuple(read_events(bag, recorded.stamps, self._note_reading))
        remade = self._remade(recorded)
        measured = self._corrected(remade)
        self._require_clusters(measured.clusters)
        cell = self._parameters.load_cell_node
        if self.load_cell_file is not None:
            cell = reprocess.read_load_cell(self.load_cell_file)
        judged = replace(recorded, wrench=remade.wrench)
        readings = raw_check.check_readings(judged, self.geometry, cell)
        of_cell = any(each.source == "the load cell" for each in readings)
        others = (
            [] if of_cell else [*raw_check.check_wrench(recorded, self._parameters.load_cell_node)]
        )
        self._kept.raw = (*readings, *others, *turned, *reports)
        samples = synchronise.make_samples(measured, self.calibration, self.geometry)
        return measured.without_raw(), samples

    def require_usable(self) -> tuple[str, ...]:
        """Refuse an unusable trial before long work or the start of a graph, by its first messages.

        Returns:
            The names of the trial's clusters.

        Raises:
            TrialError: If the trial cannot be read, lacks a topic, or has a cluster on no tile.
            ConfigurationError: If an input file is wrong.
            CalibrationError: If the calibration lacks a cluster of the trial.
        """
        with self.open() as bag:
            name = required_topics(bag)[topics.CAPACITANCE]
            first = [raw.data for raw in islice(bag.messages([name]), _CHECKED)]
        reader = Reader(topics.CAPACITANCE, self.path)
        counts = Counter({v.names: len(places) for places, _, v in reader.parts(first)})
        if not counts:
            raise reader.refused[0]
        clusters: tuple[str, ...] = counts.most_common(1)[0][0]
        strangers = self._strangers(clusters)
        clusters = tuple(name for name in clusters if name not in strangers)
        self._require_clusters(clusters)
        return clusters

    @property
    def fingerprint(self) -> str:
        """Identifies the recording by its first readings, whatever its folder is called."""
        self.samples()  # keeps it
        return self._kept.fingerprint

    @property
    def tares(self) -> tuple[RecordedTare, ...]:
        """The recorded tares, in the order of the samples; empty if none is recorded."""
        self.samples()  # keeps them
        return self._kept.tares

    def _require_clusters(self, clusters: Collection[str]) -> None:
        self.calibration.require(clusters, f"the trial {self.path}")
        try:
            self.geometry.require(clusters, f"the trial {self.path}")
        except ConfigurationError as error:
            hint = "give the socket.yaml of this trial with --geometry"
            raise TrialError(error.fact, hint) from None

    @property
    def notes(self) -> list[str]:
        """Notes on the recording and on recomputed measurements so far, without duplicates.

        Those that other functions send with `note`, such as findings of the data check, are not
        among them.
        """
        return [*self._kept.notes]

    def note(self, text: str) -> None:
        """Send a note on the trial to `notify`, if any."""
        if self.notify is not None:
            self.notify(text)

    def _note_reading(self, note: str) -> None:
        self._kept.notes[note] = None
        self.note(note)

    @property
    def metadata(self) -> TrialMetadata:
        """The current metadata of the trial; empty, with a note, if `trial.yaml` is invalid."""
        stored = self.path / METADATA_FILE
        if not stored.is_file():
            return TrialMetadata()
        try:
            return read_metadata(stored)
        except ConfigurationError as error:
            self._note_reading(f"the metadata are left out: {error}")
            return TrialMetadata()

    def events(self) -> list[Event]:
        """The events in the order of their times.

        Events marked during the recording, and those detected in the load, see `find_events`.
        Detected events whose label was also recorded are left out.
        """
        return list(self._events)

    @cached_property
    def _events(self) -> list[Event]:
        samples = self.samples()
        return join_events(self._kept.events, find_events(samples, self.estimator.plateau))

    def select(
        self,
        segment: str | Span | Segment = "plateau",
        settings: EstimatorSettings | None = None,
    ) -> Segment:
        """Select a part of the trial, by its own limits, events and left-out channels.

        Args:
            segment: `plateau`, the longest; `hold`, the longest while the load is placed; `auto`,
                the hold or, failing that, the part under load; `all`; `T0:T1` in seconds since the
                first sample, or the span as a tuple, such as `(10, 20)`; `event:A:B` between
                events, such as `event:placed+5:removed-2`, with event labels, `push#2` for the
                second push, or seconds at either end; or a `Segment` of this trial.
            settings: Limits of a plateau and of loads, and the channels that they ignore; None for
                those stored with the trial.

        Returns:
            The segment: `start` and `end` [s] since the first sample, and `rows`, a slice of the
            samples.

        Raises:
            ConfigurationError: If the specification cannot be parsed.
            TrialError: If there is no such segment.
        """
        settings = self.estimator if settings is None else settings
        hint = "leave it, or give that of trial.estimator"
        check_kind(settings, EstimatorSettings, "the argument settings", hint)
        if isinstance(segment, Segment):
            return self._own(segment)
        specification = specification_of(segment)
        limits, leave_out = settings.plateau, settings.identification.leave_out
        samples = self.checked(leave_out).samples
        return select_segment(samples, specification, limits, leave_out, self.events)

    def _own(self, segment: Segment) -> Segment:
        """A segment, which must be of this trial."""
        time, rows = self.samples().time, segment.rows
        own = rows.stop <= len(time) and np.allclose(
            time[[rows.start, rows.stop - 1]], [segment.start, segment.end], rtol=0.0, atol=1e-6
        )
        if not own:
            fact = f"{segment} is no part of the trial {self.path}"
            raise TrialError(fact, "select it from this trial: trial.select(...)")
        return segment

    def truth(self) -> GroundTruth:
        """The true motion and forces of a simulated trial at the times of its `samples`.

        Trials of `simulate` and of `run --simulated --record` hold it, linear between the simulated
        times.

        Raises:
            TrialError: If the trial was not simulated, or its ground truth is damaged.
        """
        folder = self.path if self.path.is_dir() else self.path.parent
        return read_truth(folder, self.samples().stamps)

    def plateaus(self, settings: EstimatorSettings) -> list[Segment]:
        """The plateaus by the criteria of some settings, longest first."""
        leave_out = settings.identification.leave_out
        return find_plateaus(self.checked(leave_out).samples, settings.plateau, leave_out)

    @property
    def replaced(self) -> dict[str, Any]:
        """What the measurements are corrected with: unloaded spans [s], tare and load cell."""
        return {
            "unloaded": [list(span) for span in self.unloaded],
            "tare": self.tare,
            "load_cell": str(self.load_cell_file or "recorded"),
        }

    @property
    def geometry_path(self) -> Path:
        """Path of the `socket.yaml` in use.

        Raises:
            TrialError: If none is given, and none is stored in the trial.
        """
        return self.socket_file or self._stored(SOCKET_FILE)

    @property
    def calibration_path(self) -> Path:
        """Path of the `calibration.yaml` in use.

        Raises:
            TrialError: If none is given, and none is stored in the trial.
        """
        return self.calibration_file or self._stored(CALIBRATION_FILE)

    def _stored(self, name: str) -> Path:
        stored = self.path / name
        if not stored.is_file():
            with self.open():
                pass  # raises the proper error if this is not a trial
            hint = "give the missing files with --geometry and --calibration"
            if self.path.is_file():
                hint = (
                    f"give the trial's folder, {self.path.parent}, or {hint.removeprefix('give ')}"
                )
            raise TrialError(f"{self.path}: no {name} is stored in this trial", hint)
        return stored

    @cached_property
    def geometry(self) -> SocketGeometry:
        """Geometry of the socket, from `geometry_path`."""
        return read_socket(self.geometry_path)

    @cached_property
    def calibration(self) -> Calibration:
        """Calibration of the clusters, from `calibration_path`."""
        return read_calibration(self.calibration_path)

    @cached_property
    def estimator(self) -> EstimatorSettings:
        """The estimator settings stored with the trial, or the defaults.

        `identification.leave_out` names channels, also where it was stored with a cluster's name.
        """
        return self._with_channels(self._parameters.estimator_node)

    def settings_for(self, options: SettingsOptions) -> EstimatorSettings:
        """The settings of the trial, or those of `options.params`, with what the options override.

        Args:
            options: Options of a call; where one is None, the setting stays.

        Raises:
            ConfigurationError: If the file or an option is wrong.
        """
        overrides = options.overrides()
        if "leave_out" in overrides:
            overrides["leave_out"] = self.channels(overrides["leave_out"])
        settings = estimator_settings(self.estimator, overrides, options.params)
        return self._with_channels(settings)

    def note_problems(self, leave_out: tuple[str, ...] | None = None) -> None:
        """Note the problems in the data; each is a note, sent to `notify`.

        Args:
            leave_out: Names of channels that are not checked, such as `distal.Fx` or `Mz`; None
                stands for those of the trial's settings.
        """
        for found in self.problems(leave_out):
            self.note(str(found))

    def _with_channels(self, settings: EstimatorSettings) -> EstimatorSettings:
        """Settings whose `leave_out` names channels, see `channels`."""
        named = settings.identification.leave_out
        channels = self.channels(named)
        if channels == named:
            return settings
        return replace(
            settings, identification=replace(settings.identification, leave_out=channels)
        )

    @cached_property
    def _parameters(self) -> TestbedSettings:
        stored = self.path / PARAMETERS_FILE
        return read_testbed(stored) if stored.is_file() else TestbedSettings()


def _fingerprint(measured: synchronise.Measurements) -> str:
    """The fingerprint of a recording: a hash of its first capacitances, as recorded."""
    early = measured.capacitance[measured.time <= _FINGERPRINT_SPAN]
    return sha256(early.tobytes()).hexdigest()[:16]


def recorded_namespace(trial: Trial) -> str:
    """Namespace of the testbed in the recorded graph, such as / or /lab."""
    with trial.open() as bag:
        name = required_topics(bag)[topics.TRIGGER]
    return topics.namespace_of(name, topics.TRIGGER) or "/"


def naming_notes(trial: Trial, name: str) -> Trial:
    """A trial that was not read yet, with notes that begin with a name: `hold: data: good`.

    Args:
        trial: The trial.
        name: The name; a note that begins with it stays as it is.
    """
    if trial.notify is None:
        return trial
    return replace(trial, notify=partial(_send_named, name, trial.notify))


def _send_named(name: str, notify: Callable[[str], None], note: str) -> None:
    """Send a note that begins with a name."""
    own = f"{name}: "
    notify(note if note.startswith(own) else own + note)


def read_configuration(
    geometry: Path | None = None, calibration: Path | None = None, parameters: Path | None = None
) -> dict[str, bytes]:
    """The configuration to store in new trials: contents of its files, by name.

    Args:
        geometry: A `socket.yaml`; None for the package's own.
        calibration: A `calibration.yaml`; None for the package's own.
        parameters: A `testbed.yaml`; None for the package's own.

    Raises:
        ConfigurationError: If a file is missing or wrong.
    """
    files: tuple[tuple[str, Path | None, Callable[[Path], object]], ...] = (
        (SOCKET_FILE, geometry, read_socket),
        (CALIBRATION_FILE, calibration, read_calibration),
        (PARAMETERS_FILE, parameters, read_testbed),
    )
    contents = {}
    for name, given, read in files:
        source = file_or_packaged(given, name)
        read(source)  # refuses an invalid file
        contents[name] = source.read_bytes()
    return contents


def store_configuration(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Store files in a trial's folder, flushed to the disk.

    Args:
        folder: The trial's folder, which exists.
        contents: Contents by file name, see `read_configuration`.
    """
    for name, content in contents.items():
        (folder / name).write_bytes(content)
        sync(folder / name)
