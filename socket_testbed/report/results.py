r"""All that a report says of a trial, computed once, with the quality of its data.

The decorrelation time of a series sampled every :math:`\Delta t` is

.. math:: \tau = \Delta t \Bigl(1 + 2 \sum_{k=1}^{M} \rho_k\Bigr)

with rho_k the autocorrelation at lag k, and M the smallest lag that is `_WINDOW` times the
sum (Sokal, Monte Carlo Methods in Statistical Mechanics, 1997, section 3). The mean of N
samples is as uncertain as that of N Delta t / tau independent ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy.fft import irfft, next_fast_len, rfft

from socket_testbed.arrays import BoolArray, FloatArray, StatusArray
from socket_testbed.errors import IdentificationError
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.evaluation import (
    ChannelErrors,
    evaluate_predictions,
    predict_channels,
    trusted_values,
)
from socket_testbed.identification.fit import Fit, Implausible, find_implausible, fit_contact_model
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
    find_outliers,
    outlier_notes,
    sign_note,
    without_outliers,
)
from socket_testbed.identification.validation import Judgement, judge_samples
from socket_testbed.report.pressure import PressureResults, read_pressure
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples, Status
from socket_testbed.settings.identification import PAPER_VARIANTS, VARIANTS, Variant
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.simulation.trial import read_true_forces
from socket_testbed.trials.events import Event
from socket_testbed.trials.segment import Segment, find_plateaus, select_segment
from socket_testbed.trials.trial import Trial

GIVEN = "given"
_LEAST_HELD_OUT = 10  # samples
_GAP = 1.5  # [-]; of the usual period
_WINDOW = 5.0  # [-]; of the decorrelation time: Sokal's choice
_PADDING = 4  # [-]; of the samples: all that the gaps between them may add
_LEAST_SAMPLES = 8
_ROUNDING = 1e-24  # [-]; mean square of residuals that are constant, against their size


@dataclass(frozen=True)
class Gap:
    """A time without triggers.

    Attributes:
        start: Of the last trigger before it, since the first sample [s].
        duration: To the next trigger [s].
    """

    start: float
    duration: float


def usual_period(time: FloatArray) -> float:
    """Median time between triggers [s]; NaN for fewer than two."""
    return float(np.median(np.diff(time))) if len(time) > 1 else float("nan")


def find_gaps(time: FloatArray) -> tuple[Gap, ...]:
    """Times between triggers of more than one and a half usual periods, the longest first.

    Args:
        time: Times of the triggers, rising, shape (N,) [s].
    """
    periods = np.diff(time)
    if not len(periods):
        return ()
    gaps = np.flatnonzero(periods > _GAP * usual_period(time))
    longest_first = gaps[np.argsort(-periods[gaps], kind="stable")]
    return tuple(Gap(float(time[i]), float(periods[i])) for i in longest_first)


@dataclass(frozen=True)
class Autocorrelation:
    """What the residuals of one channel have in common.

    Attributes:
        samples: Number of residuals.
        lag_one: Autocorrelation of successive samples [-].
        decorrelation: Time tau after which a sample counts as a new one [s].
        effective: Number of independent samples that they are worth [1], at most `samples`.
    """

    samples: int
    lag_one: float
    decorrelation: float
    effective: float


def autocorrelation(time: FloatArray, residual: FloatArray) -> Autocorrelation:
    """Autocorrelation of the residuals of a channel; NaN where they are too few or constant.

    Args:
        time: Times, rising, shape (N,) [s].
        residual: Residuals in any unit, shape (N,); NaN where there is none.
    """
    finite = np.isfinite(residual)
    count = int(finite.sum())
    unknown = Autocorrelation(count, *([float("nan")] * 3))
    if count < _LEAST_SAMPLES:
        return unknown
    centred = np.where(finite, residual - residual[finite].mean(), 0.0)
    if (centred @ centred) / count <= _ROUNDING * float(np.abs(residual[finite]).max()) ** 2:
        return unknown
    period = usual_period(time)
    rho = _correlations(_on_grid(time, period, centred), _on_grid(time, period, 1.0 * finite))
    worth = _integrate(rho)
    effective = min(count / worth, float(count))
    return Autocorrelation(count, float(rho[1]), period * worth, effective)


def _on_grid(time: FloatArray, period: float, values: FloatArray) -> FloatArray:
    """Values in places that are a period apart, zero in the gaps; long gaps are shortened."""
    steps = np.round(np.diff(time) / period)
    gaps = max(1, int((steps > 1.0).sum()))
    steps = np.clip(steps, 1.0, 1 + _PADDING * len(time) // gaps)
    place = np.concatenate([[0], np.cumsum(steps)]).astype(np.int64)
    grid = np.zeros(place[-1] + 1)
    grid[place] = values
    return grid


def _correlations(values: FloatArray, present: FloatArray) -> FloatArray:
    """Autocorrelation at every lag: the mean over the pairs that were measured."""
    pairs = np.round(_products(present))
    covariance = _products(values) / np.maximum(pairs, 1.0)
    return np.where(pairs > 0.0, covariance / covariance[0], 0.0)


def _products(values: FloatArray) -> FloatArray:
    """Sums of the products of values k places apart, for every k."""
    length = next_fast_len(2 * len(values), real=True)
    power = np.abs(rfft(values, length)) ** 2
    return np.asarray(irfft(power, length)[: len(values)])


def _integrate(rho: FloatArray) -> float:
    """The sum of the autocorrelations on both sides, over a window that fits itself."""
    sums = 1.0 + 2.0 * np.cumsum(rho[1:])
    lags = np.arange(1, len(rho))
    within = np.flatnonzero(lags >= _WINDOW * sums)
    last = int(within[0]) if len(within) else len(sums) - 1
    # Residuals that alternate would be worth more than they are; they count as independent.
    return max(float(sums[last]), 1.0)


@dataclass(frozen=True)
class Triggers:
    """The triggers of a trial.

    Attributes:
        count: Number of samples, one per trigger.
        complete: Number of those with a wrench and a limb position.
        duration: From the first to the last [s].
        period: Usual time between them [s]; NaN for a single one.
        gaps: Longer times between them, the longest first.
    """

    count: int
    complete: int
    duration: float
    period: float
    gaps: tuple[Gap, ...]


@dataclass(frozen=True)
class Steadiness:
    """How steady the load is over a part of a trial.

    Attributes:
        force: Magnitude of the mean force [N].
        moment: Magnitude of the mean moment [N m].
        force_sigma: Standard deviation of the magnitude of the force [N].
        moment_sigma: Standard deviation of the magnitude of the moment [N m].
    """

    force: float
    moment: float
    force_sigma: float
    moment_sigma: float


def describe_triggers(samples: Samples) -> Triggers:
    """Count the triggers of a trial and find its gaps."""
    return Triggers(
        count=len(samples),
        complete=int(samples.complete.sum()),
        duration=float(samples.time[-1]),
        period=usual_period(samples.time),
        gaps=find_gaps(samples.time),
    )


def unusable(samples: Samples) -> dict[str, BoolArray]:
    """Samples in which a measurement cannot be used, shape (N,) each, by its name."""
    return _missing(samples) | {
        name: np.asarray(status != Status.OK) for name, status in _statuses(samples).items()
    }


def find_drop_outs(samples: Samples, segment: Segment) -> pd.DataFrame:
    """What each measurement lacks: a row per channel of the wrench, limb position and cluster.

    Returns:
        `missing [1]` and `missing [%]` of the samples, `of them in the segment [1]`, the `longest
        [s]` time without it, and `saturated [1]` and `out of range [1]` of the clusters, NaN for
        the others.
    """
    statuses = _statuses(samples)
    rows = {
        name: {
            "missing [1]": missing.sum(),
            "missing [%]": 100.0 * missing.mean(),
            "of them in the segment [1]": missing[segment.rows].sum(),
            "longest [s]": _longest(missing, samples.time),
            "saturated [1]": _count(statuses.get(name), Status.SATURATED),
            "out of range [1]": _count(statuses.get(name), Status.OUT_OF_RANGE),
        }
        for name, missing in _missing(samples).items()
    }
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("measurement")


def _missing(samples: Samples) -> dict[str, BoolArray]:
    """Samples without a measurement, shape (N,) each, by its name."""
    nothing: dict[str, BoolArray] = {
        name: np.isnan(samples.wrench[:, i]) for i, name in enumerate(WRENCH_CHANNELS)
    }
    nothing["limb position"] = np.asarray(np.isnan(samples.position).any(axis=1))
    return nothing | {
        name: np.asarray(status == Status.MISSING) for name, status in _statuses(samples).items()
    }


def _statuses(samples: Samples) -> dict[str, StatusArray]:
    """Status of each cluster's channels, which come together, shape (N,) each."""
    return {
        f"{name} ({', '.join(LOCAL_CHANNELS)})": samples.status[:, column]
        for column, name in enumerate(samples.clusters)
    }


def _count(statuses: StatusArray | None, status: Status) -> float:
    return np.nan if statuses is None else float((statuses == status).sum())


def _longest(missing: BoolArray, time: FloatArray) -> float:
    """Longest time without a value, from the last one to the next, within the trial [s]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], missing, [False]]).astype(np.int8)))
    first, after = edges[::2], edges[1::2]
    before = np.maximum(first - 1, 0)
    return float((time[np.minimum(after, len(time) - 1)] - time[before]).max(initial=0.0))


def measure_steadiness(samples: Samples) -> Steadiness:
    """How steady the measured load is over some samples; NaN where it was not measured."""
    moment, moment_sigma = _mean_and_sigma(samples.wrench[:, :3])
    force, force_sigma = _mean_and_sigma(samples.wrench[:, 3:])
    return Steadiness(force, moment, force_sigma, moment_sigma)


def _mean_and_sigma(vectors: FloatArray) -> tuple[float, float]:
    """Magnitude of the mean of the whole vectors, and the spread of their magnitudes."""
    vectors = vectors[np.isfinite(vectors).all(axis=1)]
    if not len(vectors):
        return float("nan"), float("nan")
    magnitude = float(np.linalg.norm(vectors.mean(axis=0)))
    return magnitude, float(np.linalg.norm(vectors, axis=1).std())


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
        residuals: What its residuals over the segment have in common, per channel.
        shares: Shares of the load over the segment that its springs and offsets bear.
        known: Number of stiffness directions that the segment shows despite all noise [-].
        fit: The fit over the segment; None for a model that was given.
        given: The model that was given; None for one that was fitted here.
    """

    label: str
    model: ContactModel
    leave_out: tuple[str, ...]
    predicted: FloatArray
    errors: tuple[ChannelErrors, ...]
    held_out: tuple[ChannelErrors, ...]
    residuals: tuple[Autocorrelation, ...]
    shares: tuple[LoadShare, ...]
    known: float
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
        pressure=read_pressure(measured, segment, trial.geometry, settings, trial.metadata.side),
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
    residuals = trusted_values(chosen) - predicted[segment.rows]
    return Candidate(
        label=label,
        model=model,
        leave_out=leave_out,
        predicted=predicted,
        errors=evaluate_predictions(chosen, predicted[segment.rows], leave_out),
        held_out=held_out if enough else (),
        residuals=tuple(autocorrelation(chosen.time, column) for column in residuals.T),
        shares=load_shares(smooth[segment.rows], model),
        known=known_directions(
            chosen, model, source.settings.stiffness_difference, source.settings.pose_smoothing
        ),
        fit=source if isinstance(source, Fit) else None,
        given=source if isinstance(source, StoredModel) else None,
    )


def effective_samples(candidate: Candidate) -> tuple[float, float]:
    """Least and median number of independent samples, over the channels [1]; NaN for none."""
    known = [r.effective for r in candidate.residuals if np.isfinite(r.effective)]
    return (min(known), float(np.median(known))) if known else (float("nan"), float("nan"))
