"""How a validation is computed: what is judged on each trial, and on which others."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from socket_testbed.arrays import evenly
from socket_testbed.errors import IdentificationError, TrialError
from socket_testbed.identification import validation
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.identification.noise import smooth_poses
from socket_testbed.identification.problem import MIN_SAMPLES
from socket_testbed.identification.survey_prior import SurveyPrior
from socket_testbed.results.validation import Validation
from socket_testbed.samples import Samples
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial
from socket_testbed.trials.truth import read_true_forces

_MAX_FITTED = 12  # trials to fit models on, and trials to test each of them on


@dataclass(frozen=True, eq=False)
class Recording:
    """A trial ready to be judged.

    Attributes:
        name: Its name among the trials.
        trial: The trial.
        settings: The settings of its map and of its fits.
        samples: The samples of its segment, without outliers and left-out channels.
        note: Called with a text for each model that cannot be fitted.
        prior_map: Its force map with the prior that is judged; None to make it from the samples.
        used: What the map used of a survey, in words; empty without one.
    """

    name: str
    trial: Trial
    settings: EstimatorSettings
    samples: Samples
    note: Callable[[str], None]
    prior_map: ForceMap | None = None
    used: str = ""

    @classmethod
    def of(
        cls, name: str, trial: Trial, settings: EstimatorSettings, segment: Segment
    ) -> Recording:
        """The samples of a segment, and a note on each problem of the trial's data.

        Args:
            name: Name of the trial among the others.
            trial: The trial.
            settings: The settings of its map and of its fits.
            segment: The part of the trial.

        Raises:
            IdentificationError: If the samples under load are in another unit or frame, or if too
                many of them hold an outlier.
        """
        leave_out, rows = settings.identification.leave_out, segment.rows
        checked = trial.checked(leave_out)
        trial.note_problems(leave_out)
        samples = checked.counted[rows]
        loaded = np.zeros(len(checked.measured), dtype=bool)
        loaded[rows] = samples.under_load(settings.plateau.least_force)
        checked.part(loaded)  # refuses another unit
        return cls(name, trial, settings, samples, lambda text: trial.note(f"{name}: {text}"))

    def with_prior(self, prior: SurveyPrior | None) -> Recording:
        """The recording with the map of its trial, whose prior is a survey, or the ordinary one."""
        checked = self.trial.checked(self.settings.identification.leave_out)
        prior_map = checked.prior_map(self.settings.force_map, prior)
        used = "" if prior is None else f"{self.name}: {prior_map.source(self.loaded)}"
        return replace(self, prior_map=prior_map, used=used)

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
            self.note,
            self.prior_map,
        )

    def judge_others(self, others: Sequence[Recording]) -> list[validation.Judgement]:
        """Judgements of predictions for other trials by models fitted on all of this one."""
        settings = self.settings.identification
        models = validation.fit_variants(self.loaded, self.trial.geometry, settings, self.note)
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

    @property
    def loaded(self) -> Samples:
        """The samples under load."""
        return self.samples[self.samples.under_load(self.settings.plateau.least_force)]

    @property
    def smooth(self) -> Samples:
        """The samples under load, with poses averaged as in a fit."""
        return smooth_poses(self.loaded, self.settings.identification.pose_smoothing)


def judge_recordings(
    recordings: Sequence[Recording], given: int, report: Callable[[int, int], None]
) -> Validation:
    """Judge each trial alone, and with several also by models of the others.

    Args:
        recordings: The trials that could be read.
        given: Number of trials that were given. Among several, those that cannot be judged are
            passed over with a note.
        report: Called after each step, with the steps done and their number.

    Raises:
        TrialError: If none of several trials can be judged.
        IdentificationError: If a single trial cannot be judged.
    """
    several, chosen = given > 1, _selected(recordings)
    done, total = count(1), len(recordings) + several * len(chosen)
    judgements: list[validation.Judgement] = []
    fitted: list[Recording] = []
    for recording in recordings:
        with pass_over_failed(recording.name, recording.trial, several):
            judgements += recording.judge(with_models=recording in chosen)
            fitted += [recording] if recording in chosen else []
        report(next(done), total)
    if not judgements:
        raise TrialError(f"none of the {given} trials can be judged", "see the notes")
    for recording in chosen if several else ():
        if recording in fitted:
            others = _selected([other for other in recordings if other is not recording])
            with pass_over_failed(recording.name, recording.trial, several):
                judgements += recording.judge_others(others)
        report(next(done), total)
    names, fitted_names = (tuple(r.name for r in listed) for listed in (recordings, fitted))
    metadata = tuple(recording.trial.metadata for recording in recordings)
    priors = tuple(recording.used for recording in recordings if recording.used)
    return Validation(names, fitted_names, tuple(judgements), metadata, priors)


@contextmanager
def pass_over_failed(name: str, trial: Trial, several: bool) -> Iterator[None]:
    """Among several trials, report the error of one and continue.

    Args:
        name: Name of the trial.
        trial: The trial, which gets the note.
        several: Whether there are several; an error of a single one is raised.
    """
    try:
        yield
    except (IdentificationError, TrialError) as error:
        if not several:
            raise
        trial.note(f"{name}: passed over: {error}")


def _selected(recordings: Sequence[Recording]) -> list[Recording]:
    """At most `_MAX_FITTED` recordings, evenly spread."""
    return [recordings[number] for number in evenly(len(recordings), _MAX_FITTED)]
