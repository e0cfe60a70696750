"""A trial: a bag with the geometry, calibration and parameters it was recorded with."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from socket_testbed.calibration.model import Calibration, read_calibration
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.samples import Samples
from socket_testbed.settings.testbed import EstimatorSettings, TestbedSettings, read_testbed
from socket_testbed.trials.bag import BagReader, required_topics, sync
from socket_testbed.trials.messages import Reader
from socket_testbed.trials.metadata import METADATA_FILE, TrialMetadata, read_metadata
from socket_testbed.trials.reprocess import (
    RECORDED,
    other_markers,
    parse_tare,
    read_load_cell,
    refit_poses,
    remake_wrenches,
)
from socket_testbed.trials.segment import Event, find_events, join_events, read_events
from socket_testbed.trials.synchronise import (
    Measurements,
    check_unloaded,
    correct_measurements,
    make_samples,
    read_measurements,
)
from socket_testbed.trials.topics import (
    CAPACITANCE,
    LOAD_CELL_RAW,
    MARKERS,
    TRIGGER,
    Topic,
    namespace_of,
)

if TYPE_CHECKING:
    import pandas as pd

    from socket_testbed.identification.data_check import DataFinding

SOCKET_FILE = "socket.yaml"
CALIBRATION_FILE = "calibration.yaml"
PARAMETERS_FILE = "testbed.yaml"
CONFIGURATION_FILES = (SOCKET_FILE, CALIBRATION_FILE, PARAMETERS_FILE)


@dataclass(frozen=True)
class Trial:
    """A recorded trial.

    Raises:
        ConfigurationError: If the spans or the tare are wrong, see `check_unloaded`, `parse_tare`.
    """

    path: Path  # its folder
    # A `socket.yaml` instead of the trial's own. Poses of a body whose markers differ are fitted
    # anew to its recorded markers
    socket_file: Path | None = None
    calibration_file: Path | None = None  # a `calibration.yaml` instead of the trial's own
    notify: Callable[[str], None] | None = None  # called with each note on the bag and on drift
    # Spans without load, before and after, by which the clusters' drift is corrected [s]
    unloaded: tuple[tuple[float, float], ...] = ()
    load_cell_file: Path | None = None  # a `testbed.yaml` whose load cell is used instead
    tare: str = RECORDED  # or `none`, or `T0:T1`, a span without load [s]
    _noted: dict[str, None] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_unloaded(self.unloaded)
        parse_tare(self.tare)

    def __repr__(self) -> str:
        return f"Trial({str(self.path)!r})"

    @property
    def name(self) -> str:
        """Name of the trial: that of its folder."""
        return self.path.resolve().name

    @contextmanager
    def open(self) -> Iterator[BagReader]:
        """The trial's bag, open; its notes go to `notify`."""
        with BagReader(self.path) as bag:
            for note in bag.notes:
                self._notify(note)
            yield bag

    @property
    def remade(self) -> tuple[Topic, ...]:
        """The raw topics that measurements are made anew from, as the files or the tare differ."""
        other_wrenches = self.load_cell_file is not None or self.tare != RECORDED
        return (LOAD_CELL_RAW,) * other_wrenches + (MARKERS,) * bool(self._other_markers)

    @cached_property
    def _other_markers(self) -> tuple[str, ...]:
        """The bodies whose markers in the geometry are not those of the recording."""
        if self.socket_file is None:
            return ()
        try:
            recorded = read_socket(self.path / SOCKET_FILE)
        except ConfigurationError as error:
            self._notify(f"the poses stay as recorded, with markers that are not known: {error}")
            return ()
        return other_markers(recorded, self.geometry)

    def measurements(self) -> Measurements:
        """The measurements, with what is replaced made anew, corrected for drift; read anew.

        Raises:
            TrialError: If the trial cannot be read or lacks a topic, the load cell measured a
                load in a span without load, or what is replaced cannot be made anew.
            ConfigurationError: If a file that is used is wrong.
            CalibrationError: If the calibration lacks a cluster of the trial, or a span without
                load holds too few readings.
        """
        with self.open() as bag:
            measured = read_measurements(bag, self._notify, self.remade)
        where = str(self.path)
        if LOAD_CELL_RAW in self.remade:
            given = read_load_cell(self.load_cell_file) if self.load_cell_file else None
            recorded = self._parameters.load_cell_node
            measured = remake_wrenches(measured, recorded, given, self.tare, where, self._notify)
        if self._other_markers:
            measured = refit_poses(
                measured, self.geometry, self._other_markers, where, self._notify
            )
        if not self.unloaded:
            return measured
        self._require_clusters(measured.clusters)
        least_force = self.estimator.plateau.least_force
        return correct_measurements(
            measured, self.unloaded, self.calibration, least_force, where, self._notify
        )

    def samples(self) -> Samples:
        """The synchronised samples, one per trigger, in the order of their stamps; read once.

        The stresses are computed from the capacitances with the trial's calibration. What is
        missing at a trigger is NaN.

        Raises:
            TestbedError: As `measurements`, or if a cluster of the trial is on no tile.
        """
        return self._samples

    @cached_property
    def _samples(self) -> Samples:
        return self.measurements_and_samples()[1]

    @cached_property
    def findings(self) -> tuple[DataFinding, ...]:
        """What to look at in its data, the worst first; empty if it is good: see `check_data`."""
        from socket_testbed.identification.data_check import check_data  # a replay needs it not

        return check_data(self.samples(), self.geometry, self.metadata.mass)

    def to_dataframe(self) -> pd.DataFrame:
        """The samples as a pandas table, see `Samples.to_dataframe`."""
        return self.samples().to_dataframe()

    def measurements_and_samples(self) -> tuple[Measurements, Samples]:
        """`measurements` and `samples` from one reading."""
        measured = self.measurements()
        self._require_clusters(measured.clusters)
        samples = make_samples(measured, self.calibration, self.geometry)
        return measured, self.__dict__.setdefault("_samples", samples)

    def check(self) -> tuple[str, ...]:
        """Refuse a trial that cannot be worked on, before long work or a graph is started.

        It raises what `samples` would; it returns the names of the trial's clusters.
        """
        with self.open() as bag:
            name = required_topics(bag)[CAPACITANCE]
            first = next(bag.messages([name]))
        clusters: tuple[str, ...] = Reader(CAPACITANCE, self.path).read(first.data)[1].names
        self._require_clusters(clusters)
        return clusters

    def _require_clusters(self, clusters: Collection[str]) -> None:
        self.calibration.require(clusters, f"the trial {self.path}")
        for name in clusters:
            if name not in self.geometry.clusters:
                raise TrialError(
                    f"{self.path}: its cluster '{name}' is on no tile of the socket"
                    f" (which has {', '.join(self.geometry.clusters)})",
                    "give the socket.yaml of this trial with --geometry",
                )

    @property
    def notes(self) -> list[str]:
        """The notes on the trial so far, each once."""
        return [*self._noted]

    def _notify(self, note: str) -> None:
        self._noted[note] = None
        if self.notify is not None:
            self.notify(note)

    @property
    def metadata(self) -> TrialMetadata:
        """What is stated about the trial now; nothing, with a note, if `trial.yaml` is broken."""
        stored = self.path / METADATA_FILE
        if not stored.is_file():
            return TrialMetadata()
        try:
            return read_metadata(stored)
        except ConfigurationError as error:
            self._notify(f"the metadata are left out: {error}")
            return TrialMetadata()

    def events(self) -> list[Event]:
        """The events in the order of their times.

        Recorded ones, which anybody may mark while a trial is recorded, and those found in the
        load: `placed` and `removed`. Found ones of a label that was recorded are left out.
        """
        return list(self._events)

    @cached_property
    def _events(self) -> list[Event]:
        samples = self.samples()
        with self.open() as bag:
            recorded = read_events(bag, samples)
        return join_events(recorded, find_events(samples, self.estimator.plateau))

    @property
    def geometry_path(self) -> Path:
        """Path of the `socket.yaml` in use; a TrialError if there is none."""
        return self.socket_file or self._stored(SOCKET_FILE)

    @property
    def calibration_path(self) -> Path:
        """Path of the `calibration.yaml` in use; a TrialError if there is none."""
        return self.calibration_file or self._stored(CALIBRATION_FILE)

    def _stored(self, name: str) -> Path:
        stored = self.path / name
        if not stored.is_file():
            with self.open():
                pass  # says what is wrong if it is not a trial
            raise TrialError(
                f"{self.path}: no {name} is stored in this trial",
                "give the files that it lacks with --geometry and --calibration",
            )
        return stored

    @cached_property
    def geometry(self) -> SocketGeometry:
        """Geometry of the socket."""
        return read_socket(self.geometry_path)

    @cached_property
    def calibration(self) -> Calibration:
        """Calibration of the clusters."""
        return read_calibration(self.calibration_path)

    @cached_property
    def estimator(self) -> EstimatorSettings:
        """Settings of the estimator with which the trial was recorded, or the defaults."""
        return self._parameters.estimator_node

    @cached_property
    def _parameters(self) -> TestbedSettings:
        stored = self.path / PARAMETERS_FILE
        return read_testbed(stored) if stored.is_file() else TestbedSettings()


def recorded_namespace(trial: Trial) -> str:
    """Namespace of the testbed in the graph that was recorded, such as / or /lab."""
    with trial.open() as bag:
        name = required_topics(bag)[TRIGGER]
    return namespace_of(name, TRIGGER) or "/"


def beside(path: Path) -> Path:
    """The first of the names `path`_2, `path`_3, ... that is free."""
    names = (path.parent / f"{path.name}_{number}" for number in count(2))
    return next(name for name in names if not name.exists())


def read_configuration(
    geometry: Path | None = None, calibration: Path | None = None, parameters: Path | None = None
) -> dict[str, bytes]:
    """The configuration that trials are recorded with: the files' contents by their names in one.

    A `socket.yaml`, `calibration.yaml` or `testbed.yaml` that is not given is the package's own.
    """
    files: tuple[tuple[str, Path | None, Callable[[Path], object]], ...] = (
        (SOCKET_FILE, geometry, read_socket),
        (CALIBRATION_FILE, calibration, read_calibration),
        (PARAMETERS_FILE, parameters, read_testbed),
    )
    contents = {}
    for name, given, read in files:
        source = given or packaged("config", name)
        read(source)  # refuses any other file
        contents[name] = source.read_bytes()
    return contents


def store_configuration(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Store files in a trial's folder, given by their names, on the disk before it returns."""
    for name, content in contents.items():
        (folder / name).write_bytes(content)
        sync(folder / name)
