"""All results that a report of a trial shows, computed once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from socket_testbed.arrays import BoolArray, FloatArray, gaps
from socket_testbed.errors import IdentificationError
from socket_testbed.identification import information
from socket_testbed.identification.channel_errors import summarise_errors
from socket_testbed.identification.checked import CheckedSamples
from socket_testbed.identification.fit import FittedModel
from socket_testbed.identification.pareto import Front, pareto_front
from socket_testbed.identification.survey_prior import SurveyPrior
from socket_testbed.results.data_quality import DataQuality, data_quality
from socket_testbed.results.models import Evaluation, fit_segment, judge, part_to_fit
from socket_testbed.results.pressure import TrialPressure, map_trial
from socket_testbed.results.stresses import TrialCourse, course_of
from socket_testbed.results.tradeoff import PaperTable, paper_table
from socket_testbed.results.validating import Recording, judge_recordings
from socket_testbed.results.validation import Validation
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import (
    PAPER_VARIANTS,
    VARIANTS,
    IdentificationSettings,
    Variant,
)
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.events import Event
from socket_testbed.trials.metadata import NO_SIDE, TrialMetadata
from socket_testbed.trials.segment import Segment, Span, specification_of
from socket_testbed.trials.trial import Trial

GIVEN = "given"
_STAGES = 5  # reading, fits, front, validation, pressure
_PRESSURE_SAMPLES = 150  # of the trial
_Found = TypeVar("_Found")


@dataclass(frozen=True, repr=False)
class Results:
    """The results of a trial that its report shows.

    It is no `Result` of its own: it has no single table, document or figure, but holds the results
    that do, each with its `to_dataframe`, `save` and `draw`: `fitted`, `paper`, `validation` and
    `pressure`. Like them it is a value, and drawing the report computes nothing more.

    Attributes:
        trial: The trial.
        metadata: What was stated on the trial, such as the side of the limb.
        events: Its events in the order of their times.
        checked: All N samples of the trial, judged once: as `measured`, and as `samples`, in which
            outliers are NaN; with their `noise` and `findings`, the worst first.
        quality: The quality of these samples in numbers.
        segment: The part used for the fits; with `frames` only its first samples.
        specification: The segment as requested, such as `plateau`.
        settings: The settings used; their variant is fitted in addition to the paper's.
        candidates: The models by label: those fitted here by their variant, then the given model,
            if any, as `given`; each judged on the segment and on the rest of the trial.
        fronts: The trade-off over theta of the paper's variants; may be empty.
        no_fronts: Reason for empty `fronts`; empty otherwise.
        paper: The figures of the paper's variants next to the published ones.
        plateaus: Plateaus of the trial, the longest first.
        bag_notes: Notes on the recording and on the models, without duplicates.
        notes: What to read before using the figures: the findings of the data check, the
            `bag_notes`, and what the results say about themselves.
        motion: Motion of the pose over the segment, relative to its noise.
        limb_position: Mean position of the limb over the segment in {S}, shape (3,) [m].
        validation: Estimates judged on held-out data of this trial; None without any.
        no_validation: Reason for no `validation`; empty otherwise.
        pressure: Pressure outputs over the whole segment, even if only its first samples are
            fitted; complete.
        course: Pressures of the socket, without its regions, at about 150 samples of the trial,
            including its peak and that of the segment.
    """

    trial: Trial
    metadata: TrialMetadata
    events: tuple[Event, ...]
    checked: CheckedSamples
    quality: DataQuality
    segment: Segment
    specification: str
    settings: EstimatorSettings
    candidates: dict[str, Evaluation]
    fronts: dict[Variant, Front]
    no_fronts: str
    paper: PaperTable
    plateaus: tuple[Segment, ...]
    bag_notes: tuple[str, ...]
    notes: tuple[str, ...]
    motion: information.Motion
    limb_position: FloatArray
    validation: Validation | None
    no_validation: str
    pressure: TrialPressure
    course: TrialCourse

    def __repr__(self) -> str:
        models = ", ".join(self.candidates)
        return f"Results({self.trial.name}, {self.segment}; models {models})"

    @property
    def samples(self) -> Samples:
        """All N samples of the trial with outliers as NaN."""
        return self.checked.samples

    @property
    def in_segment(self) -> BoolArray:
        """Samples of the segment, shape (N,)."""
        rows = np.zeros(len(self.samples), dtype=bool)
        rows[self.segment.rows] = True
        return rows

    @property
    def judged_on(self) -> str:
        """Relation of the segment to the fits, in words."""
        elsewhere = any(not candidate.in_sample for candidate in self.candidates.values())
        return f"in-sample{f', except for the {GIVEN} model' * elsewhere}"

    @property
    def fitted(self) -> dict[str, Evaluation]:
        """The models fitted here, by variant."""
        return {label: found for label, found in self.candidates.items() if label != GIVEN}

    def series(self, columns: Mapping[str, ArrayLike]) -> pd.DataFrame:
        """A table of columns of shape (N,), a row per sample of the trial, no named index.

        They are preceded by `stamp [ns]` since the epoch, `time [s]` since the first sample, and
        `in segment`, 1 or 0. Their titles hold their units.
        """
        first = {
            "stamp [ns]": self.samples.stamps,
            "time [s]": self.samples.time,
            "in segment": self.in_segment.astype(int),
        }
        return pd.DataFrame(first | dict(columns))

    def title(self, shown: str) -> str:
        """Title of a figure over the segment."""
        return f"{self.trial.name}: {shown}, {self.segment}"


def compute_results(
    trial: Trial,
    segment: str | Span | Segment,
    settings: EstimatorSettings,
    thetas: Sequence[float] | FloatArray,
    given: FittedModel | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    prior: SurveyPrior | None = None,
) -> Results:
    """Fit the variants on a segment of a trial, trace the fronts over theta, and judge both.

    Args:
        trial: The trial.
        segment: The part as in `Trial.select`; problems in the data become notes of the trial.
        settings: Settings of the fits, the plateaus and the force map; their variant is fitted in
            addition to the paper's.
        thetas: Ascending thetas of the fronts, 0 to 1 [-].
        given: A further model to show; None for none.
        progress: Called with the number of stages done and their total.
        prior: A survey of the limb as a prior of the force map; None for none.
    """
    identification, geometry = settings.identification, trial.geometry
    checked = trial.checked(identification.leave_out)
    whole, plateaus = trial.select(segment, settings), tuple(trial.plateaus(settings))
    fitted, chosen = part_to_fit(trial, whole, settings)
    progress(1, _STAGES)
    notes: list[str] = []
    fits = _fitted_models(trial, fitted, chosen, identification)
    if given is not None and {*given.settings.leave_out} != {*identification.leave_out}:
        notes.append(f"the {GIVEN} model leaves out what its fit did, outliers as well")
    models = fits if given is None else fits | {GIVEN: given}
    candidates = {label: judge(trial, model, fitted) for label, model in models.items()}
    progress(2, _STAGES)
    fronts, no_fronts = _or_reason(lambda: pareto_front(chosen, geometry, identification, thetas))
    progress(3, _STAGES)
    recording = Recording(trial.name, trial, settings, checked.counted, notes.append)
    validation, no_validation = _or_reason(
        lambda: judge_recordings([recording.with_prior(prior)], 1, lambda done, total: None)
    )
    progress(4, _STAGES)
    mapped = map_trial(trial, settings, prior=prior)
    pressure = mapped.part(whole).pressure().complete()
    peak = whole.rows.start + pressure.outputs.peak_row
    over_trial = mapped.course(_PRESSURE_SAMPLES, [peak])
    course = course_of(over_trial, geometry, int(checked.measured.stamps[0]))
    progress(_STAGES, _STAGES)
    bag_notes = tuple(dict.fromkeys([*trial.notes, *notes]))
    return Results(
        trial=trial,
        metadata=trial.metadata,
        events=tuple(trial.events()),
        checked=checked,
        quality=data_quality(checked, fitted, plateaus),
        segment=fitted,
        specification=specification_of(segment),
        settings=settings,
        candidates=candidates,
        fronts=fronts or {},
        no_fronts=no_fronts,
        paper=paper_table(trial, fitted, chosen, fits, fronts or {}),
        plateaus=plateaus,
        bag_notes=bag_notes,
        notes=(
            *map(str, checked.findings),
            *bag_notes,
            *notes_on(trial, checked.samples, len(chosen), candidates),
        ),
        motion=information.measure_motion(chosen, geometry, identification.pose_smoothing),
        limb_position=np.nanmean(chosen.position, axis=0),
        validation=validation,
        no_validation=no_validation,
        pressure=pressure,
        course=course,
    )


def _fitted_models(
    trial: Trial, segment: Segment, chosen: Samples, settings: IdentificationSettings
) -> dict[str, FittedModel]:
    """The paper's variants and that of the settings, fitted on the segment, by variant."""
    variants = [v for v in VARIANTS if v in PAPER_VARIANTS or v == settings.variant]
    return {
        variant: fit_segment(trial, segment, chosen, replace(settings, variant=variant)).fit
        for variant in variants
    }


def _or_reason(make: Callable[[], _Found]) -> tuple[_Found | None, str]:
    """What is made, or None and the reason why the samples do not allow it."""
    try:
        return make(), ""
    except IdentificationError as error:
        return None, str(error)


def notes_on(
    trial: Trial, samples: Samples, inside: int, candidates: Mapping[str, Evaluation]
) -> Iterator[str]:
    """Notes on a trial and its models to read before using their figures.

    Args:
        trial: The trial.
        samples: All its samples.
        inside: Number of samples in the segment.
        candidates: The models by label, judged on the segment.
    """
    geometry, models = trial.geometry, [*candidates.values()]
    if count := gaps(samples.time).sum():
        yield f"Gaps between triggers: {count}, listed under Data quality."
    fits = [found.model.samples for label, found in candidates.items() if label != GIVEN]
    if unfitted := inside - max(fits):
        yield (
            f"{unfitted} of the segment's {inside} samples are not fitted: they lack the limb"
            " position or a wrench channel of the objective."
        )
    for label, found in candidates.items():
        if warning := information.share_warning(found.load_shares()):
            yield f"{label}: {warning}."
    if trial.metadata.side is None:
        yield f"{trial.name}: {NO_SIDE}."
    if not geometry.registration:
        yield f"{trial.name}: {geometry.bodies}."
    if bare := [name for name in geometry.clusters if name not in samples.clusters]:
        yield f"This trial has no readings of the clusters {', '.join(bare)}."
    if dead := summarise_errors(models[0].errors).without_value:
        yield f"Never measured over the segment: {', '.join(dead)}."
