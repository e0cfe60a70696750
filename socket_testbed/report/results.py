"""All that a report says of a trial, computed once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.errors import IdentificationError
from socket_testbed.geometry.regions import Region, Side, all_regions
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.engagement import Engagement, engagement
from socket_testbed.identification.evaluation import (
    ChannelErrors,
    evaluate_predictions,
    predict_channels,
)
from socket_testbed.identification.fit import Fit, fit_contact_model
from socket_testbed.identification.force_map import ForceMap, MapEstimate, without_untrusted
from socket_testbed.identification.information import (
    LoadShare,
    Motion,
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
    without_outliers,
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
_INSTANTS = 60  # of the trial, at which the pressure is shown in 3D


@dataclass(frozen=True)
class PressureResults:
    """Pressure over the segment, and at instants of the trial.

    Attributes:
        side: The leg that wears the socket; None where that is not stated.
        places: The regions; the last one is the socket.
        time: Times of the segment's samples since the first one of the trial, shape (N,) [s].
        outputs: The outputs of the places and the tiles over the segment.
        instants: Times spread over the trial, that of the peak among them, shape (k,) [s].
        over_trial: The force map at the instants.
    """

    side: Side | None
    places: tuple[Region, ...]
    time: FloatArray
    outputs: PressureOutputs
    instants: FloatArray
    over_trial: MapEstimate

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
    """A model whose predictions are shown.

    Attributes:
        label: The variant that was fitted here, or `given`.
        model: The model.
        leave_out: Channels that were not in the objective of its fit.
        predicted: What it predicts over the trial, in the order of the samples' channels,
            shape (N, 6 + 3c) [N m, N].
        errors: Its errors over the segment.
        held_out: Its errors over the rest of the trial; empty where there is too little.
        shares: Shares of the load over the segment that its springs and offsets bear.
        known: Number of stiffness directions that the segment shows despite all noise [-].
        engagement: Its engaged springs over the trial; their share of the time over the segment.
        fit: The fit over the segment; None for a model that was given.
        given: The model that was given; None for one that was fitted here.
    """

    label: str
    model: ContactModel
    leave_out: tuple[str, ...]
    predicted: FloatArray
    errors: tuple[ChannelErrors, ...]
    held_out: tuple[ChannelErrors, ...]
    shares: tuple[LoadShare, ...]
    known: float
    engagement: Engagement
    fit: Fit | None = None
    given: StoredModel | None = None


@dataclass(frozen=True)
class Results:
    """The results of a trial.

    Attributes:
        trial: The trial.
        samples: Its samples.
        segment: The segment that was fitted.
        specification: How the segment was asked for.
        settings: Settings of the estimator; its variant is fitted beside the paper's.
        candidates: The models: the variants, then one that was given, if any.
        fronts: The trade-off fronts by variant; empty where there are none.
        no_fronts: Why there are none; empty where there are.
        implausible: Channels that are proposed to be left out.
        plateaus: Steady stretches of the trial, the longest first.
        events: Events of the trial in the order of their times.
        bag_notes: What a reader must know of the trial's bag.
        motion: How the pose moves over the segment, against its noise.
        validation: Estimates judged on what they have not seen of the trial; empty where it does
            not allow that.
        no_validation: Why not; empty where it does.
        pressure: Pressure on all tiles and regions over the segment.
    """

    trial: Trial
    samples: Samples
    segment: Segment
    specification: str
    settings: EstimatorSettings
    candidates: tuple[Candidate, ...]
    fronts: dict[Variant, Front]
    no_fronts: str
    implausible: tuple[Implausible, ...]
    plateaus: tuple[Segment, ...]
    events: tuple[Event, ...]
    bag_notes: tuple[str, ...]
    motion: Motion
    validation: tuple[Judgement, ...]
    no_validation: str
    pressure: PressureResults

    @property
    def in_segment(self) -> BoolArray:
        """Samples of the segment, shape (N,)."""
        rows = np.zeros(len(self.samples), dtype=bool)
        rows[self.segment.rows] = True
        return rows

    @property
    def fitted(self) -> dict[str, Candidate]:
        """The models that were fitted here, by variant."""
        return {c.label: c for c in self.candidates if c.fit is not None}

    @property
    def fits(self) -> dict[str, Fit]:
        """The fits of these models, by variant."""
        return {c.label: c.fit for c in self.candidates if c.fit is not None}

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


def compute_results(
    trial: Trial,
    specification: str,
    settings: EstimatorSettings,
    thetas: Sequence[float] | FloatArray,
    given: StoredModel | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Results:
    """Fit the variants on a segment of a trial, walk along theta, and judge all of it.

    Args:
        trial: The trial.
        specification: The segment, see `select_segment`.
        settings: Settings of the estimator; its variant is fitted beside the paper's.
        thetas: Weights of the wrench against the clusters, rising [-].
        given: A model to be shown as well.
        progress: Called with the number of thetas done and of all.

    Raises:
        TrialError: If the trial cannot be read or holds no such segment.
        ConfigurationError: For wrong settings or thetas, or a model of another socket.
        IdentificationError: If the segment does not allow a fit.
    """
    if given is not None:
        given.require_socket(trial.geometry)
    notes: list[str] = []
    noting = replace(trial, notify=notes.append)
    samples = measured = noting.samples()
    leave_out = settings.identification.leave_out
    segment = select_segment(samples, specification, settings.plateau, leave_out, noting.events)
    segment = first_frames(segment, samples, settings.identification.frames)
    sign = sign_note(samples[segment.rows], trial.geometry)
    outliers = find_outliers(samples, trial.geometry, leave_out)
    notes += [*outlier_notes(samples, outliers), *([sign] if sign else [])]
    samples = without_outliers(samples, outliers)
    chosen = samples[segment.rows]
    chosen_variant = settings.identification.variant
    variants = [v for v in VARIANTS if v in PAPER_VARIANTS or v == chosen_variant]
    candidates = [_fit(samples, segment, trial, settings, variant) for variant in variants]
    if given is not None:
        candidates.append(_judge(samples, segment, GIVEN, given))
    fronts: dict[Variant, Front] = {}
    no_fronts = ""
    try:
        fronts = pareto_front(
            chosen, trial.geometry, settings.identification, thetas, progress=progress
        )
    except IdentificationError as error:  # the rest of the report stands without it
        no_fronts = str(error)
    validation, no_validation = _validate(trial, samples, settings, notes.append)
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
        events=tuple(noting.events()),
        bag_notes=tuple(dict.fromkeys(notes)),
        motion=measure_motion(chosen, trial.geometry, settings.identification.pose_smoothing),
        validation=validation,
        no_validation=no_validation,
        pressure=_read_pressure(measured, segment, trial.geometry, settings, trial.metadata.side),
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
    outside = np.ones(len(samples), dtype=bool)
    outside[segment.rows] = False
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
    samples: Samples,
    segment: Segment,
    geometry: SocketGeometry,
    settings: EstimatorSettings,
    side: Side | None,
) -> PressureResults:
    """Pressure over a segment and at instants of the trial, from the force map."""
    leave_out = settings.identification.leave_out
    every = without_untrusted(samples, geometry, leave_out)
    chosen = without_untrusted(samples[segment.rows], geometry, leave_out)
    force_map = ForceMap(geometry, samples.clusters, settings.force_map)
    places = all_regions(geometry, side)
    outputs = pressure_outputs(force_map, chosen, geometry, places, THRESHOLD)
    spread = np.linspace(0, len(samples) - 1, min(len(samples), _INSTANTS)).round()
    rows = np.union1d(spread.astype(np.int64), [segment.rows.start + outputs.peak_row])
    return PressureResults(
        side=side,
        places=places,
        time=samples.time[segment.rows],
        outputs=outputs,
        instants=samples.time[rows],
        over_trial=force_map.estimate(every[rows]),
    )
