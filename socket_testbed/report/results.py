"""All that a report says of a trial, computed once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from socket_testbed.arrays import BoolArray, FloatArray, evenly
from socket_testbed.errors import IdentificationError
from socket_testbed.geometry.axis import Region, Side, all_regions
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.data_check import Finding
from socket_testbed.identification.evaluation import (
    ChannelErrors,
    evaluate_predictions,
    predict_channels,
)
from socket_testbed.identification.fit import Fit, fit_contact_model
from socket_testbed.identification.force_map import map_trial
from socket_testbed.identification.information import (
    Engagement,
    LoadShare,
    Motion,
    Suspension,
    engagement,
    find_suspension,
    known_directions,
    load_shares,
    measure_motion,
)
from socket_testbed.identification.model_file import StoredModel
from socket_testbed.identification.noise import smooth_poses
from socket_testbed.identification.pareto import Front, pareto_front
from socket_testbed.identification.plausibility import (
    Implausible,
    find_implausible,
    find_outliers,
    outlier_notes,
    sign_note,
)
from socket_testbed.identification.pressure import (
    THRESHOLD,
    PressureOutputs,
    pressure_outputs,
)
from socket_testbed.identification.validation import Judgement, judge_samples
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import PAPER_VARIANTS, VARIANTS, Variant
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.simulation.trial import read_true_forces
from socket_testbed.trials.events import Event
from socket_testbed.trials.segment import Segment, find_plateaus, first_frames, select_segment
from socket_testbed.trials.trial import Trial

GIVEN = "given"
_LEAST_HELD_OUT = 10  # samples
_STAGES = 5  # reading, fits, front, validation, pressure
_INSTANTS = 150  # of the trial, at which the pressure is shown


@dataclass(frozen=True)
class PressureResults:
    """Pressure over the segment, and at instants of the trial."""

    side: Side | None  # the leg that wears the socket, if that is stated
    places: tuple[Region, ...]  # the last one is the socket
    time: FloatArray  # (N,) [s], of the segment's samples since the first one of the trial
    outputs: PressureOutputs  # over the segment
    over_trial: PressureOutputs  # at instants that are spread over the trial, with that of the peak
    suspension: Suspension | None  # of the limb in the socket over the segment

    @property
    def peak_time(self) -> float:
        """When a tile has the highest pressure, since the first sample of the trial [s]."""
        return float(self.time[self.outputs.peak_row])

    @property
    def peak_tile(self) -> int:
        """The tile with the highest pressure."""
        return int(self.outputs.peak_map.normal_pressure[0].argmax())


@dataclass(frozen=True)
class Candidate:
    """A model whose predictions are shown."""

    label: str  # the variant that was fitted here, or `given`
    model: ContactModel
    predicted: FloatArray  # (N, 6 + 3c) [N m, N], over the trial
    errors: tuple[ChannelErrors, ...]  # over the segment
    held_out: tuple[ChannelErrors, ...]  # over the rest; empty where there is too little
    shares: tuple[LoadShare, ...]  # of the load over the segment
    known: float  # [-], stiffness directions that the segment shows despite all noise
    engagement: Engagement  # of the springs over the trial
    leave_out: tuple[str, ...]  # channels that were not in the objective of the fit
    fit: Fit | None = None  # None for a model that was given
    given: StoredModel | None = None  # None for one that was fitted here


@dataclass(frozen=True)
class Results:
    """The results of a trial."""

    trial: Trial
    samples: Samples
    segment: Segment  # that was fitted
    specification: str  # by which the segment was asked for
    settings: EstimatorSettings  # its variant is fitted beside the paper's
    candidates: tuple[Candidate, ...]  # the variants, then the model that was given, if any
    fronts: dict[Variant, Front]  # empty where there are none,
    no_fronts: str  # for this reason
    implausible: tuple[Implausible, ...]  # channels that are proposed to be left out
    plateaus: tuple[Segment, ...]  # the longest first
    events: tuple[Event, ...]
    bag_notes: tuple[str, ...]
    motion: Motion  # of the pose over the segment, against its noise
    validation: tuple[Judgement, ...]  # empty where the trial does not allow it,
    no_validation: str  # for this reason
    pressure: PressureResults
    data: tuple[Finding, ...]  # what to look at in the data

    @property
    def in_segment(self) -> BoolArray:
        """Samples of the segment, shape (N,)."""
        return _rows_of(self.segment, self.samples)

    @property
    def fitted(self) -> dict[str, Candidate]:
        """The models that were fitted here, by variant."""
        return {c.label: c for c in self.candidates if c.fit is not None}

    def series(self, columns: Mapping[str, ArrayLike]) -> pd.DataFrame:
        """Columns of the samples, shape (N,) each, behind their stamps and times."""
        first = {
            "stamp [ns]": self.samples.stamps,
            "time [s]": self.samples.time,
            "in segment": self.in_segment.astype(int),
        }
        return pd.DataFrame(first | dict(columns))

    def title(self, shown: str) -> str:
        """The title of a figure over the segment."""
        return f"{self.trial.name}: {shown}, {self.segment}"

    @property
    def mean_position(self) -> FloatArray:
        """Mean limb position over the segment in {S}, shape (3,) [m]."""
        return np.asarray(np.nanmean(self.samples.position[self.segment.rows], axis=0))


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
    progress: Callable[[int, int], None] | None = None,
) -> Results:
    """Fit the variants on a segment of a trial, walk along theta, and judge all of it."""

    def reach(stage: int) -> None:
        if progress is not None:
            progress(stage, _STAGES)

    if given is not None:
        given.require_socket(trial.geometry)
    samples = measured = trial.samples()
    events = trial.events()
    notes = trial.notes
    leave_out = settings.identification.leave_out
    segment = select_segment(samples, specification, settings.plateau, leave_out, trial.events)
    segment = first_frames(segment, samples, settings.identification.frames)
    sign = sign_note(samples[segment.rows], trial.geometry)
    outliers = find_outliers(samples, trial.geometry, leave_out)
    notes += [*outlier_notes(samples, outliers), *([sign] if sign else [])]
    samples = outliers.taken_from(samples)
    reach(1)
    chosen = samples[segment.rows]
    chosen_variant = settings.identification.variant
    variants = [v for v in VARIANTS if v in PAPER_VARIANTS or v == chosen_variant]
    candidates = [_fit(samples, segment, trial, settings, variant) for variant in variants]
    if given is not None:
        candidates.append(_judge(samples, segment, GIVEN, given))
    reach(2)
    fronts: dict[Variant, Front] = {}
    no_fronts = ""
    try:
        fronts = pareto_front(chosen, trial.geometry, settings.identification, thetas)
    except IdentificationError as error:  # the rest of the report stands without it
        no_fronts = str(error)
    reach(3)
    validation, no_validation = _validate(trial, samples, settings, notes.append)
    reach(4)
    pressure = _read_pressure(trial, measured, segment, settings)
    reach(_STAGES)
    return Results(
        trial=trial,
        samples=samples,
        segment=segment,
        specification=specification,
        settings=settings,
        candidates=tuple(candidates),
        fronts=fronts,
        no_fronts=no_fronts,
        implausible=find_implausible(chosen, trial.geometry),
        plateaus=tuple(find_plateaus(samples, settings.plateau, leave_out)),
        events=tuple(events),
        bag_notes=tuple(dict.fromkeys(notes)),
        data=trial.findings,
        motion=measure_motion(chosen, trial.geometry, settings.identification.pose_smoothing),
        validation=validation,
        no_validation=no_validation,
        pressure=pressure,
    )


def _validate(
    trial: Trial, samples: Samples, settings: EstimatorSettings, notify: Callable[[str], None]
) -> tuple[tuple[Judgement, ...], str]:
    """The trial's judgements, or why there are none."""
    truth = read_true_forces(trial.path, samples.stamps, trial.geometry.names)
    try:
        judged = judge_samples(samples, trial.geometry, settings, truth, trial.name, notify)
        return tuple(judged), ""
    except IdentificationError as error:
        return (), str(error)


def _fit(
    samples: Samples, segment: Segment, trial: Trial, settings: EstimatorSettings, variant: Variant
) -> Candidate:
    identification = replace(settings.identification, variant=variant)
    fit = fit_contact_model(samples[segment.rows], trial.geometry, identification)
    return _judge(samples, segment, variant, fit)


def _judge(samples: Samples, segment: Segment, label: str, source: Fit | StoredModel) -> Candidate:
    model, leave_out = source.model, source.settings.leave_out
    smooth = smooth_poses(samples, source.settings.pose_smoothing)
    predicted = predict_channels(model, smooth.pose, samples.clusters)
    outside = ~_rows_of(segment, samples)
    held_out = evaluate_predictions(samples[outside], predicted[outside], leave_out)
    enough = max(error.samples for error in held_out) >= _LEAST_HELD_OUT
    chosen = samples[segment.rows]
    return Candidate(
        label=label,
        model=model,
        leave_out=leave_out,
        predicted=predicted,
        errors=evaluate_predictions(chosen, predicted[segment.rows], leave_out),
        held_out=held_out if enough else (),
        shares=load_shares(smooth[segment.rows], model),
        known=known_directions(
            chosen, model, source.settings.stiffness_difference, source.settings.pose_smoothing
        ),
        engagement=engagement(samples, model, source.settings.pose_smoothing, segment.rows),
        fit=source if isinstance(source, Fit) else None,
        given=source if isinstance(source, StoredModel) else None,
    )


def _read_pressure(
    trial: Trial, samples: Samples, segment: Segment, settings: EstimatorSettings
) -> PressureResults:
    """Pressure over a segment and at instants of the trial, from the force map."""
    geometry, side = trial.geometry, trial.metadata.side
    leave_out = settings.identification.leave_out
    force_map, usable = map_trial(samples, geometry, settings.force_map, leave_out)
    places = all_regions(geometry, side)
    outputs = pressure_outputs(force_map, usable[segment.rows], geometry, places, THRESHOLD)
    spread = evenly(len(samples), _INSTANTS)
    rows = np.union1d(spread, [segment.rows.start + outputs.peak_row])
    over_trial = pressure_outputs(force_map, usable[rows], geometry, places, THRESHOLD)
    suspension = find_suspension(samples[segment.rows], geometry)
    return PressureResults(
        side, places, samples.time[segment.rows], outputs, over_trial, suspension
    )
