"""A trial: a bag with the geometry, calibration and parameters it was recorded with."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from pathlib import Path

from socket_testbed.calibration.model import Calibration, read_calibration
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.samples import Samples
from socket_testbed.settings.testbed import EstimatorSettings, read_testbed
from socket_testbed.trials.bag import BagReader, sync
from socket_testbed.trials.metadata import METADATA_FILE, TrialMetadata, read_metadata
from socket_testbed.trials.topics import REQUIRED, TOPICS, TRIGGER, Topic, match_topics

SOCKET_FILE = "socket.yaml"
CALIBRATION_FILE = "calibration.yaml"
PARAMETERS_FILE = "testbed.yaml"
CONFIGURATION_FILES = (SOCKET_FILE, CALIBRATION_FILE, PARAMETERS_FILE)


@dataclass(frozen=True)
class Trial:
    """A recorded trial.

    Attributes:
        path: Folder of the trial.
        socket_file: A `socket.yaml` to use instead of the trial's own.
        calibration_file: A `calibration.yaml` to use instead of the trial's own.
        notify: Called with each note on the trial: on its bag, whenever it is opened, and on drift.
        unloaded: Spans without load, before and after, by which the clusters' drift is
            corrected; seconds since the first sample.

    Raises:
        ConfigurationError: If the spans are wrong, see `check_unloaded`.
    """

    path: Path
    socket_file: Path | None = None
    calibration_file: Path | None = None
    notify: Callable[[str], None] | None = None
    unloaded: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        check_unloaded(self.unloaded)

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
            if self.notify is not None:
                for note in bag.notes:
                    self.notify(note)
            yield bag

    def samples(self) -> Samples:
        """The synchronised samples, one per trigger, read once: see `read_samples`."""
        return self._samples

    @cached_property
    def _samples(self) -> Samples:
        from socket_testbed.trials.synchronise import read_samples  # it reads trials

        return read_samples(self)

    @property
    def metadata(self) -> TrialMetadata:
        """What is stated about the trial now; nothing, with a note, if `trial.yaml` is broken."""
        stored = self.path / METADATA_FILE
        if not stored.is_file():
            return TrialMetadata()
        try:
            return read_metadata(stored)
        except ConfigurationError as error:
            if self.notify is not None:
                self.notify(f"the metadata are left out: {error}")
            return TrialMetadata()

    @property
    def geometry_path(self) -> Path:
        """Path of the `socket.yaml` in use; a TrialError if there is none."""
        return self.socket_file or self._stored(SOCKET_FILE, "--geometry")

    @property
    def calibration_path(self) -> Path:
        """Path of the `calibration.yaml` in use; a TrialError if there is none."""
        return self.calibration_file or self._stored(CALIBRATION_FILE, "--calibration")

    def _stored(self, name: str, option: str) -> Path:
        stored = self.path / name
        if not stored.is_file():
            raise TrialError(
                f"{self.path}: no {name} is stored in this trial", f"give one with {option}"
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
        stored = self.path / PARAMETERS_FILE
        return read_testbed(stored).estimator_node if stored.is_file() else EstimatorSettings()


def check_unloaded(spans: tuple[tuple[float, float], ...]) -> None:
    """Refuse spans without load that are more than two, reversed, overlapping or out of order.

    Args:
        spans: Their starts and ends [s].

    Raises:
        ConfigurationError: Naming the spans.
    """
    if len(spans) > 2:
        raise ConfigurationError(
            f"--unloaded has {len(spans)} spans", "give one before, or one before and one after"
        )
    for start, end in spans:
        if not start < end:
            raise ConfigurationError(
                f"--unloaded is '{start:g}:{end:g}'", "give seconds as T0:T1, with T0 before T1"
            )
    if len(spans) == 2 and not spans[0][1] < spans[1][0]:
        first, second = (f"{start:g}:{end:g}" for start, end in spans)
        raise ConfigurationError(
            f"--unloaded: {second} does not begin after {first}",
            "give the span before the load first, the one after it second",
        )


def required_topics(bag: BagReader) -> dict[Topic, str]:
    """Names in the bag of the topics that offline work needs, each with messages.

    Raises:
        TrialError: For an empty bag, a topic that is missing or empty, or one of another
            type than the testbed's.
    """
    topics = match_topics(bag.counts, str(bag.path))
    if not any(bag.counts.values()):
        raise TrialError(f"{bag.path}: holds no message", "record the trial again")
    for topic in REQUIRED:
        if topic not in topics:
            raise TrialError(
                f"{bag.path}: has no topic '{topic.name}'",
                "record all topics of the testbed with 'record'",
            )
        name = topics[topic]
        if bag.counts[name] == 0:
            raise TrialError(
                f"{bag.path}: '{name}' holds no message", "check that its node ran and record again"
            )
        if bag.types[name] != topic.type:
            raise TrialError(
                f"{bag.path}: '{name}' is a {bag.types[name]}", f"record it as {topic.type}"
            )
    return {topic: topics[topic] for topic in TOPICS if topic in topics}


def recorded_namespace(trial: Trial) -> str:
    """Namespace of the testbed in the graph that was recorded, such as / or /lab."""
    with trial.open() as bag:
        name = required_topics(bag)[TRIGGER]
    return name.removesuffix(TRIGGER.name).rstrip("/") or "/"


def beside_cut_short(path: Path) -> Path:
    """Where to go on when a recording into this folder was cut short: `path`_2, `path`_3, ...

    Args:
        path: Folder of a trial.

    Returns:
        The first of these names that is free; the path itself if it holds no such recording.
    """
    cut_short = any(path.glob("*.mcap")) and not (path / "metadata.yaml").exists()
    if not cut_short:
        return path
    names = (path.parent / f"{path.name}_{number}" for number in count(2))
    return next(name for name in names if not name.exists())


def store_configuration(
    folder: Path,
    geometry: Path | None = None,
    calibration: Path | None = None,
    parameters: Path | None = None,
    metadata: Path | None = None,
) -> None:
    """Copy the configuration a trial is recorded with, and its metadata, into its folder.

    Args:
        folder: Folder of the trial.
        geometry: A `socket.yaml`; None for the package's own.
        calibration: A `calibration.yaml`; None for the package's own.
        parameters: A `testbed.yaml`; None for the package's own.
        metadata: A `trial.yaml`; None for none.
    """
    for source, name in zip((geometry, calibration, parameters), CONFIGURATION_FILES, strict=True):
        shutil.copyfile(source or packaged("config", name), folder / name)
        sync(folder / name)
    if metadata is not None:
        shutil.copyfile(metadata, folder / METADATA_FILE)
        sync(folder / METADATA_FILE)
