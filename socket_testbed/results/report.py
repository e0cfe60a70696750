"""All results that a report of a trial shows, computed once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.errors import IdentificationError
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification import information
from socket_testbed.identification.checked import CheckedSamples
from socket_testbed.identification.data_finding import DataFinding
from socket_testbed.identification.fit import FittedModel
from socket_testbed.identification.noise import ChannelNoise
from socket_testbed.identification.pareto import Front, pareto_front
from socket_testbed.identification.pressure import PressureOutputs
from socket_testbed.identification.survey_prior import SurveyPrior
from socket_testbed.identification.validation import Judgement, judge_samples
from socket_testbed.results.models import Evaluation, fit_segment, judge
from socket_testbed.results.pressure import TrialPressure, map_trial
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import (
    PAPER_VARIANTS,
    VARIANTS,
    IdentificationSettings,
    Variant,
)
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.events import Event
from socket_testbed.trials.metadata import TrialMetadata
from socket_testbed.trials.segment import Segment, first_frames
from socket_testbed.trials.trial import Trial
from socket_testbed.trials.truth import read_true_forces

GIVEN = "given"
_STAGES = 5  # reading, fits, front, validation, pressure
_PRESSURE_SAMPLES = 150  # of the trial


@dataclass(frozen=True)
class Results:
    """The results of a trial.

    Attributes:
        trial: The trial.
        metadata: What was stated on the trial, such as the side of the limb.
        events: Its events in the order of their times.
        measured: All N samples of the trial as measured.
        samples: These samples; outliers are NaN.
        noise: Noise of every channel over these samples.
        segment: The part used for the fits; with `frames` only its first samples.
        specification: The segment as requested, such as `plateau`.
        settings: The settings used; their variant is fitted in addition to the paper's.
        candidates: The models by label: those fitted here by their variant, then the given model,
            if any, as `given`; each judged on the segment.
        fronts: The trade-off over theta of the paper's variants; may be empty.
        no_fronts: Reason for empty `fronts`; empty otherwise.
        plateaus: Plateaus of the trial, the longest first.
        bag_notes: Notes on the recording and on the models, without duplicates.
        motion: Motion of the pose over the segment, relative to its noise.
        validation: Judgements of estimates on held-out data of this trial; may be empty.
        no_validation: Reason for empty `validation`; empty otherwise.
        pressure: Pressure outputs over the whole segment, even if only its first samples are
            fitted.
        over_trial: Pressure outputs of the socket alone, without its regions, at about 150 samples
            of the trial, including its peak and that of the segment.
        data: Findings of the data check, the worst first; empty for good data.
    """

    trial: Trial
    metadata: TrialMetadata
    events: tuple[Event, ...]
    measured: Samples
    samples: Samples
    noise: ChannelNoise
    segment: Segment
    specification: str
    settings: EstimatorSettings
    candidates: dict[str, Evaluation]
    fronts: dict[Variant, Front]
    no_fronts: str
    plateaus: tuple[Segment, ...]
    bag_notes: tuple[str, ...]
    motion: information.Motion
    validation: tuple[Judgement, ...]
    no_validation: str
    pressure: TrialPressure
    over_trial: PressureOutputs
    data: tuple[DataFinding, ...]

    @property
    def in_segment(self) -> BoolArray:
        """Samples of the segment, shape (N,)."""
        return _rows_of(self.segment, self.samples)

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


def _rows_of(segment: Segment, samples: Samples) -> BoolArray:
    rows = np.zeros(len(samples), dtype=bool)
    rows[segment.rows] = True
    return rows


def compute_results(
    trial: Trial,
    specification: str,
    settings: EstimatorSettings,
    thetas: Sequence[float] | FloatArray,
    given: FittedModel | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    prior: SurveyPrior | None = None,
) -> Results:
    """Fit the variants on a segment of a trial, trace the fronts over theta, and judge both.

    Args:
        trial: The trial.
        specification: The segment, as in `Trial.select`.
        settings: Settings of the fits, the plateaus and the force map; their variant is fitted in
            addition to the paper's.
        thetas: Ascending thetas of the fronts, 0 to 1 [-].
        given: A further model to show; None for none.
        progress: Called with the number of stages done and their total.
        prior: A survey of the limb as a prior of the force map; None for none.
    """
    identification = settings.identification
    checked = trial.checked(identification.leave_out)
    whole = trial.select(specification, settings)
    segment = first_frames(whole, checked.samples, identification.frames)
    chosen = checked.part(segment.rows)
    progress(1, _STAGES)
    notes: list[str] = []
    candidates = _judged_models(trial, segment, chosen, identification, given, notes.append)
    progress(2, _STAGES)
    fronts, no_fronts = _traced_fronts(chosen, trial.geometry, identification, thetas)
    progress(3, _STAGES)
    validation, no_validation = _validated(trial, checked, settings, prior, notes.append)
    progress(4, _STAGES)
    pressure, over_trial = _mapped_pressure(trial, whole, settings, prior)
    progress(_STAGES, _STAGES)
    return Results(
        trial=trial,
        metadata=trial.metadata,
        events=tuple(trial.events()),
        measured=checked.measured,
        samples=checked.samples,
        noise=checked.noise,
        segment=segment,
        specification=specification,
        settings=settings,
        candidates=candidates,
        fronts=fronts,
        no_fronts=no_fronts,
        plateaus=tuple(trial.plateaus(settings)),
        bag_notes=tuple(dict.fromkeys([*trial.notes, *notes])),
        data=checked.findings,
        motion=information.measure_motion(chosen, trial.geometry, identification.pose_smoothing),
        validation=validation,
        no_validation=no_validation,
        pressure=pressure,
        over_trial=over_trial,
    )


def _judged_models(
    trial: Trial,
    segment: Segment,
    chosen: Samples,
    identification: IdentificationSettings,
    given: FittedModel | None,
    notify: Callable[[str], None],
) -> dict[str, Evaluation]:
    """The paper's variants and that of the settings, fitted on the segment, then the given model.

    Each is judged on the segment, whose samples are `chosen`. A given model that leaves out other
    channels is notified.
    """
    variants = [v for v in VARIANTS if v in PAPER_VARIANTS or v == identification.variant]
    models: dict[str, FittedModel] = {
        variant: fit_segment(trial, segment, chosen, replace(identification, variant=variant)).fit
        for variant in variants
    }
    if given is not None:
        models[GIVEN] = given
        if {*given.settings.leave_out} != {*identification.leave_out}:
            notify(f"the {GIVEN} model leaves out what its fit did, outliers as well")
    return {label: judge(trial, model, segment) for label, model in models.items()}


def _traced_fronts(
    chosen: Samples,
    geometry: SocketGeometry,
    identification: IdentificationSettings,
    thetas: Sequence[float] | FloatArray,
) -> tuple[dict[Variant, Front], str]:
    """The fronts over theta on the samples of the segment, or none and the reason."""
    try:
        return pareto_front(chosen, geometry, identification, thetas), ""
    except IdentificationError as error:
        return {}, str(error)


def _validated(
    trial: Trial,
    checked: CheckedSamples,
    settings: EstimatorSettings,
    prior: SurveyPrior | None,
    notify: Callable[[str], None],
) -> tuple[tuple[Judgement, ...], str]:
    """Judgements on held-out data of the trial, or none and the reason."""
    truth = read_true_forces(trial.path, checked.samples.stamps, trial.geometry.names)
    try:
        prior_map = checked.prior_map(settings.force_map, prior)
        found = judge_samples(
            checked.counted, trial.geometry, settings, truth, trial.name, notify, prior_map
        )
    except IdentificationError as error:
        return (), str(error)
    return tuple(found), ""


def _mapped_pressure(
    trial: Trial, whole: Segment, settings: EstimatorSettings, prior: SurveyPrior | None
) -> tuple[TrialPressure, PressureOutputs]:
    """Pressure outputs over the whole segment, and those of the socket over the trial."""
    mapped = map_trial(trial, settings, prior=prior)
    pressure = mapped.part(whole).pressure()
    peak = whole.rows.start + pressure.outputs.peak_row
    return pressure, mapped.course(_PRESSURE_SAMPLES, [peak])
