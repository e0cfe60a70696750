"""The quality of a trial's data: triggers and gaps, what is missing, and the plateaus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.calibration import Status
from socket_testbed.report.gaps import Gap, find_gaps, usual_period
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples
from socket_testbed.trials.segment import Segment


@dataclass(frozen=True)
class Triggers:
    """The triggers of a trial.

    Attributes:
        count: Number of samples, one a trigger.
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
class DropOuts:
    """What one measurement lacks.

    Attributes:
        name: The measurement: a channel, or several that come together.
        missing: Samples of the trial without it.
        missing_in_segment: Samples of the segment without it.
        longest: Longest time without it [s].
        saturated: Samples in which it was saturated; None where that is not known.
        out_of_range: Samples in which it was out of its calibrated range; likewise.
    """

    name: str
    missing: int
    missing_in_segment: int
    longest: float
    saturated: int | None = None
    out_of_range: int | None = None


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
    lacking: dict[str, BoolArray] = {
        name: np.isnan(samples.wrench[:, i]) for i, name in enumerate(WRENCH_CHANNELS)
    }
    lacking["limb position"] = np.asarray(np.isnan(samples.position).any(axis=1))
    for column, cluster in enumerate(samples.clusters):
        lacking[_cluster_row(cluster)] = samples.status[:, column] != Status.OK
    return lacking


def count_drop_outs(samples: Samples, segment: Segment) -> tuple[DropOuts, ...]:
    """What each measurement lacks, in the trial and in the segment."""
    lacking = unusable(samples)
    counted = [
        _drop_outs(name, lacking[name], samples.time, segment)
        for name in (*WRENCH_CHANNELS, "limb position")
    ]
    for column, cluster in enumerate(samples.clusters):
        status = samples.status[:, column]
        counted.append(
            _drop_outs(
                _cluster_row(cluster),
                status == Status.MISSING,
                samples.time,
                segment,
                saturated=int((status == Status.SATURATED).sum()),
                out_of_range=int((status == Status.OUT_OF_RANGE).sum()),
            )
        )
    return tuple(counted)


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


def _cluster_row(cluster: str) -> str:
    return f"{cluster} ({', '.join(LOCAL_CHANNELS)})"


def _drop_outs(
    name: str, missing: BoolArray, time: FloatArray, segment: Segment, **counts: int
) -> DropOuts:
    return DropOuts(
        name=name,
        missing=int(missing.sum()),
        missing_in_segment=int(missing[segment.rows].sum()),
        longest=_longest(missing, time),
        **counts,
    )


def _longest(missing: BoolArray, time: FloatArray) -> float:
    """Longest time without a value, from the last one to the next, within the trial [s]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], missing, [False]]).astype(np.int8)))
    first, after = edges[::2], edges[1::2]
    before = np.maximum(first - 1, 0)
    return float((time[np.minimum(after, len(time) - 1)] - time[before]).max(initial=0.0))
