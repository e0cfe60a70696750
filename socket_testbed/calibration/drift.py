"""Load cycles, and the drift of a cluster between readings without load.

Temperature, humidity and creep of the dielectric add offsets to a cluster's capacitances, so
unloaded readings give the correction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import median_filter

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.calibration.bench_data import UNNAMED, BenchData, scaled_stress
from socket_testbed.calibration.fit import predict_stress
from socket_testbed.calibration.model import ClusterCalibration
from socket_testbed.errors import CalibrationError

_MIN_CYCLE = 0.25  # of the load's span
_MIN_BRANCH = 0.2  # of full scale
_END_MARGIN = 0.05  # of a branch at either end, where the stress may dwell

_MIN_READINGS = 3  # for a baseline

RISING, FALLING, NEITHER = 1, -1, 0
DRIFT_LIMIT = 1000.0  # [Pa]; a larger drift during a run is flagged


def find_extremes(values: FloatArray, threshold: float) -> IntArray:
    """Indices of alternating minima and maxima that differ by at least a threshold.

    A single index if the signal never moves that far.
    """
    extremes: list[int] = []
    lowest = highest = direction = 0
    for i, value in enumerate(values.tolist()):
        lowest = i if value < values[lowest] else lowest
        highest = i if value > values[highest] else highest
        if direction <= 0 and value - values[lowest] >= threshold:
            extremes.append(lowest)
            direction, highest = 1, i
        elif direction >= 0 and values[highest] - value >= threshold:
            extremes.append(highest)
            direction, lowest = -1, i
    extremes.append(highest if direction > 0 else lowest)
    return np.array(extremes, dtype=np.int64)


def _find_cycles(stress: FloatArray) -> IntArray:
    """Load cycles of one file, from one minimum of the load to the next.

    The load is the norm of the stress vector, each component scaled by its full scale.
    """
    load = median_filter(np.linalg.norm(scaled_stress(stress), axis=1), 3)  # removes spikes
    extremes = find_extremes(load, _MIN_CYCLE * float(np.ptp(load)))
    low = [
        i
        for k, i in enumerate(extremes)
        if 0 < k < len(extremes) - 1 and load[i] < load[extremes[k - 1]]
    ]
    return np.searchsorted(low, np.arange(len(load)), side="right").astype(np.int64)


def cycle_ids(bench: BenchData) -> IntArray:
    """Cycle of each row over all files, shape (N,): named in the file, or found from the load.

    A single name for all rows of a file is ignored.
    """
    ids = np.empty(len(bench), dtype=np.int64)
    first = 0
    for file in np.unique(bench.file):
        rows = np.flatnonzero(bench.file == file)
        named = (bench.cycle[rows] != UNNAMED).all() and np.ptp(bench.cycle[rows]) > 0
        cycles = bench.cycle[rows] if named else _find_cycles(bench.stress[rows])
        _, ids[rows] = np.unique(cycles, return_inverse=True)
        ids[rows] += first
        first = int(ids[rows].max()) + 1
    return ids


def find_branches(bench: BenchData) -> IntArray:
    """Whether each stress is rising, falling or neither in each row, shape (N, 3)."""
    branches = np.full(bench.stress.shape, NEITHER)
    for file in range(len(bench.files)):
        rows = np.flatnonzero(bench.file == file)
        for axis, threshold in enumerate((_MIN_BRANCH * bench.full_scale).tolist()):
            values = bench.stress[rows, axis]
            for start, end in pairwise(find_extremes(values, threshold)):
                travel = values[end] - values[start]
                progress = (values[start:end] - values[start]) / travel
                moving = (progress > _END_MARGIN) & (progress < 1.0 - _END_MARGIN)
                branches[rows[start:end][moving], axis] = RISING if travel > 0.0 else FALLING
    return branches


@dataclass(frozen=True)
class Baseline:
    """Capacitances of an unloaded cluster."""

    time: float  # when they were read, on the clock of the readings to correct [s]
    capacitance: FloatArray  # capacitances by input; (4,) [pF]


@dataclass(frozen=True)
class Drift:
    """Change between two baselines."""

    capacitance: FloatArray  # change by input; (4,) [pF]
    stress: FloatArray  # change of the calibrated stress of the unloaded cluster; (3,) [Pa]

    @property
    def flagged(self) -> bool:
        """Whether a stress drifted by more than `DRIFT_LIMIT`."""
        return bool((np.abs(self.stress) > DRIFT_LIMIT).any())


def average_baseline(time: float, capacitance: FloatArray, where: str) -> Baseline:
    """Median of unloaded readings, robust to single spikes."""
    complete = capacitance[np.isfinite(capacitance).all(axis=1)]
    if len(complete) < _MIN_READINGS:
        raise CalibrationError(
            f"{where}: {len(complete)} complete readings are too few for a baseline",
            f"read the unloaded cluster {_MIN_READINGS} times or more",
        )
    return Baseline(time, np.median(complete, axis=0))


def measure_drift(cluster: ClusterCalibration, before: Baseline, after: Baseline) -> Drift:
    """Change between two baselines, in pF and, through the calibration, in Pa."""
    pair = predict_stress(cluster, np.stack([before.capacitance, after.capacitance]))
    return Drift(after.capacitance - before.capacitance, pair[1] - pair[0])


def correct_drift(
    capacitance: FloatArray,
    time: FloatArray,
    before: Baseline,
    after: Baseline | None = None,
    reference: FloatArray | None = None,
) -> FloatArray:
    """Correct readings by input, shape (N, 4) [pF], to the baseline of a calibration.

    ``c(t) - (b(t) - reference)``: the baseline b is linear in time (N,) [s] between `before` and
    `after` and constant outside; without `after` it equals `before`. The reference is the
    calibration's baseline by input, shape (4,) [pF]; it defaults to `before`, which removes only
    the drift since then.
    """
    if reference is None:
        reference = before.capacitance
    if after is None:
        return capacitance - (before.capacitance - reference)
    if not after.time > before.time:
        raise CalibrationError(
            f"the baseline after ({after.time:g} s) is not later than the one before"
            f" ({before.time:g} s)",
            "give the unloaded readings before first, those after second",
        )
    fraction = np.clip((time - before.time) / (after.time - before.time), 0.0, 1.0)
    baseline = before.capacitance + fraction[:, None] * (after.capacitance - before.capacitance)
    return capacitance - (baseline - reference)


def correct_bench(bench: BenchData, before: Baseline, after: Baseline) -> BenchData:
    """Correct the drift of a bench run back to the baseline before it."""
    if len(bench.files) > 1:
        raise CalibrationError(
            f"{len(bench.files)} bench files cannot share the drift between two baselines",
            "give the one file that was read between them, or the baseline before only",
        )
    if np.isnan(bench.time).any():
        raise CalibrationError(
            f"{bench.files[0]}: has no time, which the drift correction needs",
            "add a column 'time [s]', or give the baseline before only",
        )
    corrected = correct_drift(bench.capacitance, bench.time, before, after)
    return replace(bench, capacitance=corrected)
