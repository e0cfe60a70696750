"""Trials: opened, simulated, and their segments."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from socket_testbed.batch import is_trial
from socket_testbed.calibration.model import read_calibration
from socket_testbed.documents import check_number
from socket_testbed.errors import ConfigurationError, TrialError, closest
from socket_testbed.files import check_new_folder, packaged
from socket_testbed.geometry.axis import Side
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.data_check import DataFinding
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import PlateauSettings
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials import segment as segments
from socket_testbed.trials.metadata import (
    METADATA_FILE,
    TrialMetadata,
    change_metadata,
    read_metadata,
    write_metadata,
)
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    from socket_testbed.simulation.limb import Scenario, TissueKind

PathLike: TypeAlias = str | os.PathLike[str]
Progress: TypeAlias = Callable[[str], Callable[[int, int], None]]
"""Called with what is being done; the result is called with the steps done and their number."""

_MOST_TRIGGERS = 1_000_000


def as_path(path: PathLike | None) -> Path | None:
    """The path, if there is one."""
    return None if path is None else Path(path)


def started(progress: Progress | None, what: str) -> Callable[[int, int], None]:
    """A progress that has started; one that nobody sees if there is none."""
    return (lambda done, total: None) if progress is None else progress(what)


def open_trial(
    path: PathLike,
    geometry: PathLike | None = None,
    calibration: PathLike | None = None,
    unloaded: Iterable[tuple[float, float]] = (),
    notify: Callable[[str], None] | None = None,
    *,
    load_cell: PathLike | None = None,
    tare: str = "recorded",
) -> Trial:
    """Open a trial: a folder that `record`, `run --record` or `simulate` wrote.

    Args:
        path: Folder of the trial.
        geometry: A `socket.yaml` to use instead of the trial's own. Where a body's markers differ
            in it, its poses are fitted anew to the recorded markers.
        calibration: A `calibration.yaml` to use instead of the trial's own.
        unloaded: Spans without load, before and after, by which the drift of the clusters is
            corrected; seconds since the first sample.
        notify: Called with each note on the trial once, such as on channels that look implausible;
            None for warnings.
        load_cell: A `testbed.yaml` whose load cell (matrix, signs, gains, ...) is used instead of
            the trial's own, on the recorded ratios of the bridges.
        tare: What is subtracted from the wrenches: the tare that was `recorded`, `none`, or the
            mean of `T0:T1`, seconds without load since the first sample.

    Returns:
        The trial. `trial.samples()` are its synchronised samples, `trial.events()` its events,
        `trial.geometry` is its socket.

    >>> trial = st.open_trial("trials/hold")
    >>> trial
    Trial('trials/hold')
    >>> trial.samples()
    Samples(160 samples in 39.75 s, ... complete; clusters brim_lateral, ..., distal)
    >>> list(trial.samples().to_dataframe())[:4]
    ['Mx [N m]', 'My [N m]', 'Mz [N m]', 'Fx [N]']
    >>> [event.label for event in trial.events()]
    ['placed', 'removed']
    """
    spans = tuple((float(start), float(end)) for start, end in unloaded)
    notify = cache(notify or _warn)
    files = as_path(geometry), as_path(calibration)
    trial = Trial(Path(path), *files, notify, spans, as_path(load_cell), tare)
    if not trial.path.is_dir():
        with trial.open():
            pass  # says what is wrong
    return trial


def as_trial(trial: Trial | PathLike) -> Trial:
    """The trial, which may be given by its path."""
    return trial if isinstance(trial, Trial) else open_trial(trial)


def note(trial: Trial, text: str) -> None:
    """Say what a reader of a trial's results must know, if somebody listens."""
    if trial.notify is not None:
        trial.notify(text)


def require_different(trials: Sequence[Trial]) -> None:
    """Refuse a trial that is given twice."""
    paths = [trial.path.resolve() for trial in trials]
    for number, trial in enumerate(trials):
        if paths[number] in paths[:number]:
            raise ConfigurationError(f"{trial.path} is given twice", "give each trial once")


def require_one_socket(trials: Sequence[Trial], hint: str) -> None:
    """Refuse a trial of another socket than the first one's."""
    for trial in trials:
        if not trial.geometry.same_tiles(trials[0].geometry):
            raise ConfigurationError(
                f"{trial.path} is of another socket ({len(trial.geometry)} tiles) than"
                f" {trials[0].path} ({len(trials[0].geometry)} tiles)",
                hint,
            )


def annotate(
    trial: Trial | PathLike,
    *,
    subject: str | None = None,
    side: Side | None = None,
    socket: str | None = None,
    liner: str | None = None,
    mass: float | None = None,
    operator: str | None = None,
    protocol: str | None = None,
    notes: str | None = None,
    remove: Iterable[str] = (),
) -> TrialMetadata:
    """State metadata of a trial, in the `trial.yaml` in its folder; nothing else is written.

    What is not given stays as it is.

    Args:
        trial: The trial.
        subject: Code of the subject, such as `S01`; never a name.
        side: Side of the residual limb, `left` or `right`.
        socket: The socket, such as `PTB 3`.
        liner: Liner or sock.
        mass: Body mass of the subject [kg].
        operator: Initials or a code of who recorded it.
        protocol: The protocol that it follows.
        notes: Anything else.
        remove: Fields to remove.

    Returns:
        All metadata of the trial, as `trial.metadata` gives them from now on.

    >>> trial = st.open_trial("trials/hold")
    >>> st.annotate(trial, subject="S01", side="left", mass=82.5).columns()
    {'subject': 'S01', 'side': 'left', 'socket': None, 'liner': None, 'mass [kg]': 82.5, ...}
    >>> st.annotate(trial, remove=["mass"]).mass
    """
    trial = as_trial(trial)
    changes = {
        "subject": subject,
        "side": side,
        "socket": socket,
        "liner": liner,
        "mass": mass,
        "operator": operator,
        "protocol": protocol,
        "notes": notes,
    }
    if not (trial.path.is_dir() and is_trial(trial.path)):
        raise TrialError(f"{trial.path}: is no folder of a trial", "give the folder of one trial")
    path = trial.path / METADATA_FILE
    stored = read_metadata(path) if path.exists() else TrialMetadata()
    metadata = change_metadata(stored, changes, remove)
    if metadata != stored:
        write_metadata(metadata, path)
    return metadata


def _warn(note: str) -> None:
    warnings.warn(note, stacklevel=2)


def check_data(trial: Trial | PathLike) -> tuple[DataFinding, ...]:
    """Check whether a trial's data is good: what to look at, the worst first.

    Signs, lags, units, dead, clipped, noisy and missing sources, each judged by itself and by the
    others: see `socket_testbed.identification.data_check`.

    >>> st.check_data(st.open_trial("trials/hold"))
    ()
    """
    return as_trial(trial).findings


def select_segment(samples: Samples, specification: str = "plateau") -> Segment:
    """Select a part of a trial: a plateau, what is under load, a span of seconds or of events.

    The functions below take a specification as well. They find the plateau by the limits that are
    stored in the trial, and know its recorded events; here only those in the load are known.

    Args:
        samples: The samples of the trial.
        specification: `plateau`, the longest; `hold`, the longest while the load is placed; `auto`,
            the hold or, without one, the part under load; `all`; `T0:T1` in seconds since the first
            sample; or `event:A:B` between events, such as `event:placed+5:removed-2`, with labels
            of the trial's events, `push#2` for the second push, or seconds at either end.

    >>> samples = st.open_trial("trials/hold").samples()
    >>> segment = st.select_segment(samples, "10:20")
    >>> segment
    Segment(span 10.00 s to 20.00 s)
    >>> len(samples[segment.rows])
    41
    >>> st.select_segment(samples, "event:placed+5:removed-2")
    Segment(event:placed+5:removed-2 12.25 s to 30.75 s)
    """
    return segments.select_segment(samples, specification, PlateauSettings())


def require_segment(specification: str | None) -> str:
    """The specification of a segment; an error if there is none."""
    if specification is None:
        raise ConfigurationError("segment is None", "give 'plateau', 'all' or 'T0:T1', or leave it")
    return specification


def select(trial: Trial, segment: str | Segment | None, settings: EstimatorSettings) -> Segment:
    """The segment of a trial that is given itself or by its specification."""
    if isinstance(segment, Segment):
        return segment
    specification = require_segment(segment)
    leave_out = settings.identification.leave_out
    return segments.select_segment(
        trial.samples(), specification, settings.plateau, leave_out, trial.events
    )


def simulate(
    path: PathLike,
    scenario: Scenario = "static_hold",
    *,
    tissue: TissueKind = "soft",
    like_paper: bool = False,
    duration: float = 120.0,
    rate: float = 4.0,
    seed: int = 0,
    geometry: PathLike | None = None,
    calibration: PathLike | None = None,
    progress: Progress | None = None,
) -> Trial:
    """Write a simulated trial with its ground truth.

    Its physics is not the estimator's law: stiffening, sticking, creeping tissue, see
    `socket_testbed.simulation.limb`.

    Args:
        path: Folder of the new trial.
        scenario: The load history: `static_hold`, `ramp`, `multi_direction` or `protocol`.
        tissue: The limb's tissue: `soft` like the published experiment's silicone, or `stiff`.
        like_paper: Whether the load cell's creep and vibration and the clusters' offsets are as
            large as in the published experiment, with a calibration whose ranges admit them.
        duration: Duration [s].
        rate: Rate of the trigger [Hz].
        seed: Seed of the random numbers.
        geometry: A `socket.yaml` (default: the package's own).
        calibration: A `calibration.yaml` (default: the package's own, `config/like_paper.yaml` with
            `like_paper`).
        progress: See `Progress`.

    >>> st.simulate("trials/short", "ramp", duration=30, seed=1)
    Trial('trials/short')
    """
    from socket_testbed.simulation.limb import SCENARIOS, TISSUES
    from socket_testbed.simulation.sensors import LIKE_PAPER
    from socket_testbed.simulation.trial import simulate as simulate_trial
    from socket_testbed.simulation.trial import write_simulated_trial

    folder, socket_file, calibration_file = Path(path), as_path(geometry), as_path(calibration)
    if scenario not in SCENARIOS:
        raise ConfigurationError(f"unknown scenario '{scenario}'", closest(scenario, SCENARIOS))
    if tissue not in TISSUES:
        raise ConfigurationError(f"unknown tissue '{tissue}'", closest(tissue, TISSUES))
    check_number(duration, "--duration", 1.0, 36000.0)
    check_number(rate, "--rate", 0.1, 1000.0)
    check_number(seed, "--seed", 0)
    check_number(duration * rate, "--duration times --rate", 2, _MOST_TRIGGERS)
    check_new_folder(folder)
    if like_paper and calibration_file is None:
        calibration_file = packaged("config", "like_paper.yaml")
    simulated = simulate_trial(
        read_socket(socket_file or packaged("config", "socket.yaml")),
        read_calibration(calibration_file or packaged("config", "calibration.yaml")),
        scenario,
        duration,
        rate,
        seed,
        LIKE_PAPER if like_paper else None,
        progress=started(progress, "simulating"),
        tissue=tissue,
    )
    write_simulated_trial(simulated, folder, socket_file, calibration_file)
    return open_trial(folder)
