"""Validation: estimates judged on held-out data, against simple rivals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count

import numpy as np
from threadpoolctl import threadpool_limits

from socket_testbed.api.pressure import prior_for
from socket_testbed.api.trials import (
    Progress,
    as_path,
    as_trial,
    require_different,
    require_one_socket,
    started,
    trials_of,
    unique_names,
)
from socket_testbed.arrays import evenly
from socket_testbed.errors import ConfigurationError, IdentificationError, TrialError
from socket_testbed.identification import validation
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.identification.noise import smooth_poses
from socket_testbed.identification.problem import MIN_SAMPLES
from socket_testbed.results.result import PathLike
from socket_testbed.results.survey import Survey
from socket_testbed.results.validation import Validation
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import Weights
from socket_testbed.settings.options import EstimationOptions
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.segment import Segment, Span
from socket_testbed.trials.trial import Trial
from socket_testbed.trials.truth import read_true_forces

_MAX_FITTED = 12  # trials to fit models on, and trials to test each of them on


def validate(
    *trials: Trial | PathLike,
    segment: str | Span | Segment = "all",
    params: PathLike | None = None,
    theta: float | None = None,
    weights: Weights | None = None,
    smoothness: float | None = None,
    leave_out: Sequence[str] | None = None,
    pose_smoothing: float | None = None,
    solver: str | None = None,
    prior: Survey | PathLike | None = None,
    progress: Progress | None = None,
) -> Validation:
    """Judge estimates of tile forces and wrench on held-out data.

    - Each cluster is left out and its force is predicted from the other clusters and the wrench.
    - Every model variant is fitted on the first half of the loaded part of a trial and predicts the
      wrench of the second half from the pose alone; with several trials, it is also fitted on all
      of that part and predicts the others. With more than 12 trials, models are fitted on 12
      evenly spread ones, and each predicts 12 others.
    - If a trial has a simulated ground truth, forces on tiles without a sensor are compared with
      it.

    Simple rivals answer the same questions; see `socket_testbed.identification.validation`.
    Among several trials, those that cannot be judged are skipped with a note.

    Args:
        trials: Trials of one socket.
        segment: As in `fit`.
        params: A `testbed.yaml` to use instead of each trial's own.
        theta: As in `fit`.
        weights: As in `fit`.
        smoothness: As in `fit`.
        leave_out: As in `fit`.
        pose_smoothing: As in `fit`.
        solver: As in `fit`.
        prior: A survey of this limb in this socket, such as the file of `survey -o FILE.json`, as a
            prior of the force map; the trial must not be in it.
        progress: See `Progress`.

    Returns:
        The validation: `summary()` has the means over the trials, `to_dataframe()` every judgement,
        `by_trial()` a row per trial.

    Raises:
        ConfigurationError: No trial is given, one is given twice, they are of different sockets, or
            a setting is wrong, or the survey is of another socket or holds a trial.
        TrialError: A single trial cannot be read or has no such segment; none of several can be
            judged.
        IdentificationError: A single trial has too few samples under load to fit and to test.

    >>> found = st.validate(st.open_trial("trials/hold"), st.open_trial("trials/walk"))
    >>> found
    Validation(2 trials, models fitted on 2; ... judgements)
    >>> left_out = found.summary().query("question == 'cluster'")
    >>> bool((left_out["error [-]"] > 0.0).all())
    True
    """
    options = EstimationOptions(
        params=as_path(params),
        theta=theta,
        weights=weights,
        smoothness=smoothness,
        leave_out=leave_out,
        pose_smoothing=pose_smoothing,
        solver=solver,
    )
    opened = [*map(as_trial, trials_of(trials))]
    recordings = _recordings(opened, segment, options, prior)
    several, chosen = len(trials) > 1, _selected(recordings)
    report, done = started(progress, "validating"), count(1)
    total = len(recordings) + several * len(chosen)
    judgements: list[validation.Judgement] = []
    fitted: list[_Recording] = []
    with threadpool_limits(1):
        for recording in recordings:
            with _skip_failed(recording.name, recording.trial, several):
                judgements += recording.judge(with_models=recording in chosen)
                fitted += [recording] if recording in chosen else []
            report(next(done), total)
        if not judgements:
            raise TrialError(f"none of the {len(trials)} trials can be judged", "see the notes")
        for recording in chosen if several else ():
            if recording in fitted:
                others = _selected([other for other in recordings if other is not recording])
                with _skip_failed(recording.name, recording.trial, several):
                    judgements += recording.judge_others(others)
            report(next(done), total)
    names, fitted_names = (tuple(r.name for r in listed) for listed in (recordings, fitted))
    metadata = tuple(recording.trial.metadata for recording in recordings)
    priors = tuple(recording.used for recording in recordings if recording.used)
    return Validation(names, fitted_names, tuple(judgements), metadata, priors)


@contextmanager
def _skip_failed(name: str, trial: Trial, several: bool) -> Iterator[None]:
    """Among several trials, report the error of one and continue."""
    try:
        yield
    except (IdentificationError, TrialError) as error:
        if not several:
            raise
        trial.note(f"{name}: passed over: {error}")


def _selected(recordings: Sequence[_Recording]) -> list[_Recording]:
    """At most `_MAX_FITTED` recordings, evenly spread."""
    return [recordings[number] for number in evenly(len(recordings), _MAX_FITTED)]


@dataclass(frozen=True, eq=False)
class _Recording:
    """A trial ready to be judged."""

    name: str
    trial: Trial
    settings: EstimatorSettings
    samples: Samples
    prior_map: ForceMap | None = None
    used: str = ""

    def judge(self, with_models: bool) -> list[validation.Judgement]:
        """Judgements on this trial alone, with or without model fits."""
        geometry = self.trial.geometry
        if not with_models:
            return validation.judge_map(
                self.samples, geometry, self.settings, self.name, self.prior_map
            )
        truth = read_true_forces(self.trial.path, self.samples.stamps, geometry.names)
        return validation.judge_samples(
            self.samples,
            geometry,
            self.settings,
            truth,
            self.name,
            self._note,
            self.prior_map,
        )

    def judge_others(self, others: Sequence[_Recording]) -> list[validation.Judgement]:
        """Judgements of predictions for other trials by models fitted on all of this one."""
        settings = self.settings.identification
        models = validation.fit_variants(self.loaded, self.trial.geometry, settings, self._note)
        predictors = validation.wrench_predictors(self.smooth, models)
        found: list[validation.Judgement] = []
        for other in others:
            samples = other.smooth
            every = np.arange(len(samples))
            if len(samples) >= MIN_SAMPLES:
                predicted = {who: predict(samples, every) for who, predict in predictors.items()}
                found += validation.judge_wrench(
                    samples.wrench, predicted, "other trial", self.name, other.name
                )
        return found

    def _note(self, text: str) -> None:
        self.trial.note(f"{self.name}: {text}")

    @property
    def loaded(self) -> Samples:
        """The samples under load."""
        return self.samples[self.samples.under_load(self.settings.plateau.least_force)]

    @property
    def smooth(self) -> Samples:
        """The samples under load, with poses averaged as in a fit."""
        return smooth_poses(self.loaded, self.settings.identification.pose_smoothing)


def _recordings(
    trials: Sequence[Trial],
    segment: str | Span | Segment,
    options: EstimationOptions,
    prior: Survey | PathLike | None,
) -> list[_Recording]:
    """Read the trials, which must be different and of one socket."""
    if not trials:
        raise ConfigurationError("no trial to validate on", "give one or more trials")
    require_different(trials)
    found = []
    for name, trial in zip(unique_names(trials), trials, strict=True):
        with _skip_failed(name, trial, len(trials) > 1):
            settings = trial.settings_for(options)
            rows = trial.select(segment, settings).rows
            checked = trial.checked(settings.identification.leave_out)
            trial.note_problems(settings.identification.leave_out)
            samples = checked.counted[rows]
            loaded = np.zeros(len(checked.measured), dtype=bool)
            loaded[rows] = samples.under_load(settings.plateau.least_force)
            checked.part(loaded)  # refuses another unit
            learnt = prior_for(trial, prior)
            prior_map = checked.prior_map(settings.force_map, learnt)
            used = "" if learnt is None else f"{name}: {prior_map.source(samples[loaded[rows]])}"
            found.append(_Recording(name, trial, settings, samples, prior_map, used))
    read = [recording.trial for recording in found]
    require_one_socket(read, "validate the trials of one socket at a time")
    return found
