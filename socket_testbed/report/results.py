"""All results of a report, computed once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.errors import IdentificationError
from socket_testbed.identification import information
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.data_check import DataFinding
from socket_testbed.identification.fit import (
    ChannelErrors,
    Fit,
    evaluate,
    fit_contact_model,
    predictions,
)
from socket_testbed.identification.model_file import StoredModel
from socket_testbed.identification.noise import smooth_poses
from socket_testbed.identification.pareto import Front, pareto_front
from socket_testbed.identification.pressure import PressureOutputs
from socket_testbed.identification.validation import Judgement, judge_samples
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import PAPER_VARIANTS, VARIANTS, Variant
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.simulation.trial import read_true_forces
from socket_testbed.trials.pressure import SegmentPressure, mapped_trial
from socket_testbed.trials.segment import Segment, first_frames
from socket_testbed.trials.trial import Trial

GIVEN = "given"
_MIN_HELD_OUT = 10  # samples
_STAGES = 5  # reading, fits, front, validation, pressure
_PRESSURE_SAMPLES = 150  # of the trial


@dataclass(frozen=True)
class Candidate:
    """A model shown in the report."""

    label: str  # the variant fitted here, or `given`
    source: Fit | StoredModel
    predicted: FloatArray  # (N, 6 + 3c) [N m, N], over the trial
    errors: tuple[ChannelErrors, ...]  # over the segment
    in_sample: bool  # whether it was fitted on samples of the segment
    held_out: tuple[ChannelErrors, ...]  # over the rest, unused; empty with too few samples
    shares: tuple[information.LoadShare, ...]  # of the load over the segment
    engagement: information.Engagement  # of the springs over the trial

    @property
    def model(self) -> ContactModel:
        """The model."""
        return self.source.model

    @property
    def fit(self) -> Fit | None:
        """The fit; None for a given model."""
        return self.source if isinstance(self.source, Fit) else None


@dataclass(frozen=True)
class Results:
    """The results of a trial."""

    trial: Trial
    samples: Samples
    segment: Segment  # used for the fits
    specification: str  # of the segment, as requested
    settings: EstimatorSettings  # their variant is fitted in addition to the paper's
    candidates: tuple[Candidate, ...]  # the variants, then the given model, if any
    fronts: dict[Variant, Front]  # may be empty
    no_fronts: str  # reason for empty `fronts`
    plateaus: tuple[Segment, ...]  # the longest first
    bag_notes: tuple[str, ...]
    motion: information.Motion  # of the pose over the segment, relative to its noise
    validation: tuple[Judgement, ...]  # may be empty
    no_validation: str  # reason for empty `validation`
    pressure: SegmentPressure  # over the segment, even if its first frames alone are fitted
    # of the socket at samples of the trial, including the peaks of the trial and the segment
    over_trial: PressureOutputs
    data: tuple[DataFinding, ...]  # of the data check

    @property
    def in_segment(self) -> BoolArray:
        """Samples of the segment, shape (N,)."""
        return _rows_of(self.segment, self.samples)

    @property
    def judged_on(self) -> str:
        """Relation of the segment to the fits, in words."""
        elsewhere = any(not candidate.in_sample for candidate in self.candidates)
        return f"in-sample{f', except for the {GIVEN} model' * elsewhere}"

    @property
    def fitted(self) -> dict[str, Candidate]:
        """The models fitted here, by variant."""
        return {c.label: c for c in self.candidates if c.fit is not None}

    def series(self, columns: Mapping[str, ArrayLike]) -> pd.DataFrame:
        """Columns of shape (N,), preceded by stamps and times of the samples."""
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
    given: StoredModel | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Results:
    """Fit the variants on a segment of a trial, trace the fronts over theta, and judge both."""
    identification, leave_out = settings.identification, settings.identification.leave_out
    samples = trial.sound(leave_out)
    whole = trial.select(specification, settings)
    segment = first_frames(whole, samples, identification.frames)
    notes: list[str] = []
    chosen = samples[segment.rows]
    progress(1, _STAGES)
    candidates = []
    for variant in VARIANTS:
        if variant in PAPER_VARIANTS or variant == identification.variant:
            own = replace(identification, variant=variant)
            fit = fit_contact_model(chosen, trial.geometry, own)
            candidates.append(_judge(trial, segment, variant, fit))
    if given is not None:
        if {*given.settings.leave_out} != {*leave_out}:
            notes.append(f"the {GIVEN} model leaves out what its fit did, outliers as well")
        candidates.append(_judge(trial, segment, GIVEN, given))
    progress(2, _STAGES)
    # The report may lack a front or a validation.
    fronts, validation, no_fronts, no_validation = {}, [], "", ""
    try:
        fronts = pareto_front(chosen, trial.geometry, identification, thetas)
    except IdentificationError as error:
        no_fronts = str(error)
    progress(3, _STAGES)
    truth = read_true_forces(trial.path, samples.stamps, trial.geometry.names)
    try:
        validation = judge_samples(
            samples.without(leave_out), trial.geometry, settings, truth, trial.name, notes.append
        )
    except IdentificationError as error:
        no_validation = str(error)
    progress(4, _STAGES)
    mapped = mapped_trial(trial, settings)
    pressure = mapped.over(whole)
    peak = whole.rows.start + pressure.outputs.peak_row
    over_trial = mapped.course(_PRESSURE_SAMPLES, [peak])
    progress(_STAGES, _STAGES)
    return Results(
        trial=trial,
        samples=samples,
        segment=segment,
        specification=specification,
        settings=settings,
        candidates=tuple(candidates),
        fronts=fronts,
        no_fronts=no_fronts,
        plateaus=tuple(trial.plateaus(settings)),
        bag_notes=tuple(dict.fromkeys([*trial.notes, *notes])),
        data=trial.problems(leave_out),
        motion=information.measure_motion(chosen, trial.geometry, identification.pose_smoothing),
        validation=tuple(validation),
        no_validation=no_validation,
        pressure=pressure,
        over_trial=over_trial,
    )


def _judge(trial: Trial, segment: Segment, label: str, source: Fit | StoredModel) -> Candidate:
    """A model over the trial and over the samples of the segment, as in `st.evaluate`."""
    model, settings = source.model, source.settings
    window, leave_out = settings.pose_smoothing, settings.leave_out
    samples = trial.sound(leave_out)
    chosen = samples[segment.rows]
    predicted = predictions(samples, model, window)
    inside = _rows_of(segment, samples)
    used = (
        inside if isinstance(source, Fit) else source.used(trial.name, trial.fingerprint, samples)
    )
    rest = ~(inside | used)
    held_out = evaluate(samples[rest], predicted[rest], leave_out)
    enough = max(error.samples for error in held_out) >= _MIN_HELD_OUT
    return Candidate(
        label=label,
        source=source,
        predicted=predicted,
        errors=evaluate(chosen, predictions(chosen, model, window), leave_out),
        in_sample=bool(used[segment.rows].any()),
        held_out=held_out if enough else (),
        shares=information.load_shares(smooth_poses(chosen, window), model),
        engagement=information.engagement(samples, model, window, segment.rows),
    )
