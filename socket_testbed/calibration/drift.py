"""Load cycles, and the drift of a cluster between readings without load.

A cluster's channels drift by additive capacitances (temperature, humidity, creep of the
dielectric), so the capacitances without load give the correction.
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

_CYCLE = 0.25  # [-] of the load's span; a smaller move is no cycle
_BRANCH = 0.2  # [-] of the full scale; a smaller move is no branch
_ENDS = 0.05  # [-] of a branch at either end, where the stress may dwell

_LEAST_READINGS = 3  # of a baseline

RISING, FALLING, NEITHER = 1, -1, 0
DRIFT_LIMIT = 1000.0  # [Pa]; a larger drift during a run is flagged


def find_extremes(values: FloatArray, least: float) -> IntArray:
    """Indices of the alternating extremes between which a signal moves by a least amount.

    A single one if nothing moves so much.
    """
    extremes: list[int] = []
    lowest = highest = direction = 0
    for i, value in enumerate(values.tolist()):
        lowest = i if value < values[lowest] else lowest
        highest = i if value > values[highest] else highest
        if direction <= 0 and value - values[lowest] >= least:
            extremes.append(lowest)
            direction, highest = 1, i
        elif direction >= 0 and values[highest] - value >= least:
            extremes.append(highest)
            direction, lowest = -1, i
    extremes.append(highest if direction > 0 else lowest)
    return np.array(extremes, dtype=np.int64)


def _find_cycles(stress: FloatArray) -> IntArray:
    """Load cycles of one file: from one low point of the load to the next.

    The load is the length of the stress in parts of each one's full scale.
    """
    load = median_filter(np.linalg.norm(scaled_stress(stress), axis=1), 3)  # a spike is no cycle
    extremes = find_extremes(load, _CYCLE * float(np.ptp(load)))
    low = [
        i
        for k, i in enumerate(extremes)
        if 0 < k < len(extremes) - 1 and load[i] < load[extremes[k - 1]]
    ]
    return np.searchsorted(low, np.arange(len(load)), side="right").astype(np.int64)


def cycle_ids(bench: BenchData) -> IntArray:
    """Cycle of each row over all files, shape (N,): the file's own, or those that are found.

    One name for all rows of a file names no cycle.
    """
    ids = np.empty(len(bench), dtype=np.int64)
    first = 0
    for file in range(len(bench.files)):
        rows = np.flatnonzero(bench.file == file)
        named = (bench.cycle[rows] != UNNAMED).all() and np.ptp(bench.cycle[rows]) > 0
        cycles = bench.cycle[rows] if named else _find_cycles(bench.stress[rows])
        _, ids[rows] = np.unique(cycles, return_inverse=True)
        ids[rows] += first
        first = int(ids[rows].max(initial=first - 1)) + 1
    return ids


def find_branches(bench: BenchData) -> IntArray:
    """Whether each stress is rising, falling or neither in each row, shape (N, 3)."""
    branches = np.full(bench.stress.shape, NEITHER)
    for file in range(len(bench.files)):
        rows = np.flatnonzero(bench.file == file)
        for axis, least in enumerate((_BRANCH * bench.full_scale).tolist()):
            values = bench.stress[rows, axis]
            for start, end in pairwise(find_extremes(values, least)):
                travel = values[end] - values[start]
                progress = (values[start:end] - values[start]) / travel
                moving = (progress > _ENDS) & (progress < 1.0 - _ENDS)
                branches[rows[start:end][moving], axis] = RISING if travel > 0.0 else FALLING
    return branches


@dataclass(frozen=True)
class Baseline:
    """Capacitances of an unloaded cluster."""

    time: float  # when they were read, on the clock of what is corrected [s]
    capacitance: FloatArray  # capacitances by input; (4,) [pF]


@dataclass(frozen=True)
class Drift:
    """What changed between two baselines."""

    capacitance: FloatArray  # change by input; (4,) [pF]
    stress: FloatArray  # change of the calibrated stress of the unloaded cluster; (3,) [Pa]

    @property
    def flagged(self) -> bool:
        """Whether a stress drifted by more than `DRIFT_LIMIT`."""
        return bool((np.abs(self.stress) > DRIFT_LIMIT).any())


def average_baseline(time: float, capacitance: FloatArray, where: str) -> Baseline:
    """The medians of unloaded readings, which a single spike does not move."""
    complete = capacitance[np.isfinite(capacitance).all(axis=1)]
    if len(complete) < _LEAST_READINGS:
        raise CalibrationError(
            f"{where}: {len(complete)} complete readings are too few for a baseline",
            f"read the unloaded cluster {_LEAST_READINGS} times or more",
        )
    return Baseline(time, np.median(complete, axis=0))


def measure_drift(cluster: ClusterCalibration, before: Baseline, after: Baseline) -> Drift:
    """What changed between two baselines, in pF and, through the calibration, in Pa."""
    pair = predict_stress(cluster, np.stack([before.capacitance, after.capacitance]))
    return Drift(after.capacitance - before.capacitance, pair[1] - pair[0])


def correct_drift(
    capacitance: FloatArray,
    time: FloatArray,
    before: Baseline,
    after: Baseline | None = None,
    reference: FloatArray | None = None,
) -> FloatArray:
    """Bring readings by input, shape (N, 4) [pF], to the baseline that a calibration was made at.

    ``c(t) - (b(t) - reference)``, with b the baseline: linear in time (N,) [s] from before to after
    and constant outside of them; without a baseline after, it is the one before. The reference is
    the baseline of the calibration by input, shape (4,) [pF]; without it, it is the one before, so
    that only the drift since then is removed.
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
    part = np.clip((time - before.time) / (after.time - before.time), 0.0, 1.0)
    baseline = before.capacitance + part[:, None] * (after.capacitance - before.capacitance)
    return capacitance - (baseline - reference)


def correct_bench(bench: BenchData, before: Baseline, after: Baseline) -> BenchData:
    """Correct the readings of a bench run for its drift, to the baseline before."""
    if len(bench.files) > 1:
        raise CalibrationError(
            f"{len(bench.files)} bench files cannot share the drift between two baselines",
            "give the one file that was read between them, or the baseline before only",
        )
    if np.isnan(bench.time).any():
        raise CalibrationError(
            f"{bench.files[0]}: has no time, which the correction of the drift needs",
            "add a column 'time [s]', or give the baseline before only",
        )
    corrected = correct_drift(bench.capacitance, bench.time, before, after)
    return replace(bench, capacitance=corrected)
