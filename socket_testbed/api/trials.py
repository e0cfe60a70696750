"""Trials: opening, simulating, annotating and checking data."""

from __future__ import annotations

import os
import pickle
import warnings
from collections.abc import Callable, Iterable, Sequence
from itertools import count
from pathlib import Path
from typing import Any, TypeAlias

from socket_testbed.calibration.model import read_calibration
from socket_testbed.documents import (
    check_kind,
    check_number,
    described,
    path_of,
    plain,
    texts_of,
)
from socket_testbed.errors import ConfigurationError, TrialError, closest
from socket_testbed.files import (
    CALIBRATION_FILE,
    SOCKET_FILE,
    file_or_packaged,
    packaged,
)
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.data_finding import DataFinding
from socket_testbed.results.result import PathLike
from socket_testbed.settings.options import (
    RECORDED,
    Scenario,
    Side,
    SimulationOptions,
    TissueKind,
)
from socket_testbed.trials.bag_parts import is_bag
from socket_testbed.trials.metadata import (
    METADATA_FILE,
    TrialMetadata,
    change_metadata,
    read_metadata,
    write_metadata,
)
from socket_testbed.trials.segment import Span, parse_span
from socket_testbed.trials.trial import Trial, naming_notes

Progress: TypeAlias = Callable[[str], Callable[[int, int], None]]
"""Reports long work: called with a task's name, such as `tiling`.

It returns a function that is called after each step with the steps done and their total number.
"""

_SPAN_HINT = "give a span such as (0, 5) or '0:5' [s]"
_MAX_TRIGGERS = 1_000_000


def as_path(path: PathLike | None) -> Path | None:
    """Convert to a `Path`, passing None through."""
    return None if path is None else path_of(path, "the file")


def unique_names(trials: Sequence[Trial]) -> tuple[str, ...]:
    """Unique names of trials, in their order: as many trailing parts of their paths as that takes.

    Trials in `a/hold` and `b/hold` are called just that, those in `a/hold` and `a/walk` are called
    `hold` and `walk`.
    """
    parts = [trial.path.resolve().parts for trial in trials]
    tails = (tuple("/".join(part[-number:]) for part in parts) for number in count(1))
    return next(names for names in tails if len({*names}) == len(names))


def started(progress: Progress | None, task: str) -> Callable[[int, int], None]:
    """Start reporting progress; a no-op without a `progress`.

    Args:
        progress: See `Progress`; None reports nothing.
        task: Name of the task, such as `tiling`.

    Returns:
        A function to call after each step, with the steps done and their total number.
    """
    if progress is None:
        return lambda done, total: None
    check_kind(progress, Callable, "progress", "give a function that takes a task's name")  # type: ignore[arg-type]
    return progress(task)


class _Once:
    """Sends each note once; a copy in another process knows which were sent."""

    def __init__(self, notify: Callable[[str], object], sent: Iterable[str] = ()) -> None:
        self._notify = notify
        self._sent = {*sent}

    def __call__(self, note: str) -> None:
        if note not in self._sent:
            self._sent.add(note)
            self._notify(note)

    def __reduce__(self) -> tuple[Any, ...]:
        try:
            pickle.dumps(self._notify)
        except Exception:  # such as a function of a notebook: pickling may raise any error
            return _Once, (warnings.warn, sorted(self._sent))
        return _Once, (self._notify, sorted(self._sent))


def open_trial(
    path: PathLike,
    geometry: PathLike | None = None,
    calibration: PathLike | None = None,
    unloaded: Iterable[Span | str | float] = (),
    notify: Callable[[str], None] | None = None,
    *,
    load_cell: PathLike | None = None,
    tare: str | Span = RECORDED,
) -> Trial:
    """Open a trial: a folder written by `record`, `run --record` or `simulate`.

    Spans of `unloaded` and `tare` are texts, `"0:5"`, or pairs, `(0, 5)`; a single unloaded span
    needs no list.

    Args:
        path: Folder of the trial.
        geometry: A `socket.yaml` to use instead of the trial's own. If a body's markers differ
            there, its poses are refitted to the recorded markers.
        calibration: A `calibration.yaml` to use instead of the trial's own.
        unloaded: Unloaded spans before and after the load, used to correct the drift of the
            clusters; seconds since the first sample.
        notify: Called once with each note on the trial, such as problems in its data; None issues
            warnings. A trial or result that was pickled sends only new ones, as warnings where the
            function cannot be pickled.
        load_cell: A `testbed.yaml` whose load cell (matrix, signs, gains, ...) replaces the trial's
            own and is applied to the recorded bridge ratios.
        tare: Tare to subtract from the wrenches: the `recorded` one, `none`, or the mean of
            `T0:T1`, an unloaded span in seconds since the first sample.

    Returns:
        The trial: `trial.samples()` returns its synchronised samples, `trial.events()` its events,
        `trial.geometry` is its socket. Nothing but the folder's existence is checked yet: errors of
        the data are raised by what first reads them.

    Raises:
        TrialError: There is no trial at the path.
        ConfigurationError: The unloaded spans or the tare are wrong.

    >>> trial = st.open_trial("trials/hold")
    >>> trial
    Trial('trials/hold')
    >>> trial.samples()
    Samples(160 samples in 39.75 s, ... complete; clusters brim_lateral, ..., distal)
    >>> list(trial.samples().to_dataframe())[:4]
    ['Mx [N m]', 'My [N m]', 'Mz [N m]', 'Fx [N]']
    >>> [event.label for event in trial.events()]
    ['placed', 'removed']
    >>> trial.select("event:placed+5:removed-2")
    Segment(event:placed+5:removed-2 12.25 s to 30.75 s)
    >>> segment = trial.select((10, 20))
    >>> len(trial.samples()[segment.rows])
    41
    """
    spans = _spans(unloaded)
    if not isinstance(tare, str):
        tare = _span_text(tare, "tare")
    notify = warnings.warn if notify is None else notify
    check_kind(notify, Callable, "notify", "give a function that takes a text, such as print")  # type: ignore[arg-type]
    notify = _Once(notify)
    files = as_path(geometry), as_path(calibration)
    trial = Trial(path_of(path, "the trial"), *files, notify, spans, as_path(load_cell), tare)
    if not trial.path.is_dir():
        with trial.open():
            pass  # raises the error
    return trial


def _spans(given: object) -> tuple[Span, ...]:
    """Spans [s] given as one or several, each as a text or a pair of numbers."""
    listed = plain(given)
    if isinstance(listed, str) or (isinstance(listed, list) and _is_pair(listed)):
        listed = [listed]
    if not isinstance(listed, Iterable):
        raise ConfigurationError(f"unloaded is {described(given)}", _SPAN_HINT)
    return tuple(parse_span(_span_text(each, "unloaded"), "--unloaded") for each in listed)


def _is_pair(given: Sequence[object]) -> bool:
    return len(given) == 2 and not any(isinstance(each, list | tuple | str) for each in given)


def _span_text(span: object, what: str) -> str:
    """A span as `T0:T1`, given so or as a pair of numbers [s]."""
    given = plain(span)
    if isinstance(given, str):
        return given
    if isinstance(given, list) and _is_pair(given):
        start, end = (check_number(each, f"a time of {what}") for each in given)
        return f"{start}:{end}"
    raise ConfigurationError(f"{what} is {described(span)}", _SPAN_HINT)


def as_trial(trial: Trial | PathLike) -> Trial:
    """The trial itself, or the one at the path.

    Raises:
        ConfigurationError: It is neither.
        TrialError: There is no trial at the path.
    """
    if isinstance(trial, Trial):
        return trial
    hint = "give one of st.open_trial, or the path of its folder"
    check_kind(trial, (str, os.PathLike), "the trial", hint)
    return open_trial(trial)


def open_different(items: Sequence[Trial | PathLike]) -> list[Trial]:
    """Different trials: those given, and those at the paths, whose notes begin with their names.

    A given trial keeps its own `notify`.

    Raises:
        ConfigurationError: One is neither, or a trial is given twice.
        TrialError: There is no trial at a path.
    """
    opened = [as_trial(item) for item in items]
    require_different(opened)
    named = zip(unique_names(opened), opened, items, strict=True)
    return [trial if trial is item else naming_notes(trial, name) for name, trial, item in named]


def trials_of(items: Sequence[Any]) -> list[Any]:
    """The trials of a call, given one by one or in a single list."""
    if len(items) == 1 and isinstance(items[0], list | tuple):
        return [*items[0]]
    return [*items]


def require_different(trials: Sequence[Trial]) -> None:
    """Raise an error if a trial is given twice.

    Raises:
        ConfigurationError: Two of the trials are in one folder.
    """
    paths = [trial.path.resolve() for trial in trials]
    for number, trial in enumerate(trials):
        if paths[number] in paths[:number]:
            raise ConfigurationError(f"{trial.path} is given twice", "give each trial once")


def require_one_socket(trials: Sequence[Trial], hint: str) -> None:
    """Raise an error unless all trials are of one socket: equal tiles in equal places.

    Args:
        trials: The trials, compared with the first one.
        hint: What to do about another socket, for the error.

    Raises:
        ConfigurationError: A trial is of another socket than the first one.
    """
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
    """Set metadata of a trial in its `trial.yaml`; no other file is written.

    Fields not given stay unchanged.

    Args:
        trial: The trial.
        subject: Code of the subject, such as `S01`; never a name.
        side: Side of the residual limb, `left` or `right`.
        socket: The socket, such as `PTB 3`.
        liner: Liner or sock.
        mass: Body mass of the subject [kg].
        operator: Initials or code of the operator.
        protocol: The protocol followed.
        notes: Any further remarks.
        remove: A field, or several, to remove.

    Returns:
        All metadata of the trial, the new value of `trial.metadata`; None for fields not stated.

    Raises:
        TrialError: The path is no folder of a single trial.
        ConfigurationError: A value or a field to remove is wrong, or `trial.yaml` is invalid.

    >>> trial = st.open_trial("trials/hold")
    >>> st.annotate(trial, subject="S01", side="left", mass=82.5).columns()
    {'subject': 'S01', 'side': 'left', 'socket': None, 'liner': None, 'mass [kg]': 82.5, ...}
    >>> st.annotate(trial, remove=["mass"]).mass
    """
    trial = as_trial(trial)
    stated = TrialMetadata(
        subject=subject, side=side, socket=socket, liner=liner, mass=mass, operator=operator,
        protocol=protocol, notes=notes,
    )  # fmt: skip
    if not is_bag(trial.path):
        raise TrialError(f"{trial.path}: is not a trial folder", "give the folder of one trial")
    path = trial.path / METADATA_FILE
    stored = read_metadata(path) if path.exists() else TrialMetadata()
    metadata = change_metadata(stored, stated.stated(), texts_of(remove, "remove"))
    if metadata != stored:
        write_metadata(metadata, path)
    return metadata


def check_data(trial: Trial | PathLike) -> tuple[DataFinding, ...]:
    """Check whether a trial's data is good; returns the findings, the worst first.

    Checks signs, lags, units, and dead, clipped, noisy and missing sources, each alone and against
    the others: see `socket_testbed.identification.data_check`. Channels that the trial's settings
    leave out are not checked.

    Returns:
        A finding per defect: its `source` (the wrench, the limb pose, a cluster or a channel), the
        `fact`, and the `hint`, what to check; empty for good data.

    >>> st.check_data(st.open_trial("trials/hold"))
    ()
    """
    return as_trial(trial).problems()


def simulate(
    path: PathLike,
    scenario: Scenario = SimulationOptions.scenario,
    *,
    tissue: TissueKind = SimulationOptions.tissue,
    like_paper: bool = False,
    duration: float = SimulationOptions.duration,
    rate: float = SimulationOptions.rate,
    seed: int = SimulationOptions.seed,
    donning: int | None = SimulationOptions.donning,
    donning_share: float = SimulationOptions.donning_share,
    geometry: PathLike | None = None,
    calibration: PathLike | None = None,
    replace: bool = False,
    progress: Progress | None = None,
) -> Trial:
    """Write a simulated trial with its ground truth.

    Its physics differ from the estimator's law: the tissue stiffens, sticks and creeps, see
    `socket_testbed.simulation.limb`.

    Args:
        path: Folder of the new trial.
        scenario: The load history: `static_hold`, `ramp`, `multi_direction` or `protocol`.
        tissue: Tissue of the limb: `soft` like the published experiment's silicone, or `stiff`.
        like_paper: Whether to make the errors of load cell and clusters as large as in the
            published experiment, with a calibration whose ranges admit them; the settings stored
            with the trial leave out the three channels that the paper leaves out.
        duration: Duration [s].
        rate: Trigger rate [Hz].
        seed: Seed of the random numbers: of the limb, its load and all errors.
        donning: Put the limb of this seed on again: seed of the donning, with other load, sensors
            and errors (default: the nominal donning).
        donning_share: How much a donning differs: about the standard deviation of a tile's force
            over its rms; at 0.1 tissue shifts by 2.5 mm and 2.3 degrees, and the mean compression
            changes by 10 % [-].
        geometry: A `socket.yaml` (default: the package's own).
        calibration: A `calibration.yaml` (default: the package's own, `config/like_paper.yaml` with
            `like_paper`).
        replace: Replace an older simulated trial in that folder, and nothing else.
        progress: See `Progress`.

    Returns:
        The new trial, opened as by `st.open_trial`. Its folder also holds the ground truth.

    Raises:
        ConfigurationError: The scenario or tissue is unknown, a number is out of its range, or the
            folder exists and is not to be replaced.

    >>> st.simulate("trials/short", "ramp", duration=30, seed=1)
    Trial('trials/short')
    """
    from socket_testbed.simulation.limb import SCENARIOS, TISSUES, check_donning
    from socket_testbed.simulation.sensors import LIKE_PAPER, LIKE_PAPER_LEFT_OUT
    from socket_testbed.simulation.trial import check_trial_folder, write_simulated_trial
    from socket_testbed.simulation.trial import simulate as simulate_trial

    folder = path_of(path, "the folder of the trial")
    socket_file, calibration_file = as_path(geometry), as_path(calibration)
    for kind, name, known in (("scenario", scenario, SCENARIOS), ("tissue", tissue, TISSUES)):
        if name not in known:
            raise ConfigurationError(f"unknown {kind} '{name}'", closest(str(name), known))
    chosen = SimulationOptions(duration=duration, rate=rate, seed=seed)
    donning = check_donning(donning, donning_share)
    check_number(duration * rate, "--duration times --rate", 2, _MAX_TRIGGERS)
    check_trial_folder(folder, replace)
    if like_paper and calibration_file is None:
        calibration_file = packaged("config", "like_paper.yaml")
    simulated = simulate_trial(
        read_socket(file_or_packaged(socket_file, SOCKET_FILE)),
        read_calibration(file_or_packaged(calibration_file, CALIBRATION_FILE)),
        scenario,
        chosen.duration,
        chosen.rate,
        chosen.seed,
        LIKE_PAPER if like_paper else None,
        progress=started(progress, "simulating"),
        tissue=tissue,
        donning=donning,
        donning_share=donning_share,
    )
    left_out = LIKE_PAPER_LEFT_OUT if like_paper else ()
    write_simulated_trial(simulated, folder, socket_file, calibration_file, left_out, replace)
    return open_trial(folder)
