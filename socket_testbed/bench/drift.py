"""Drift of a cluster between readings without load, before and after: seen, and taken off.

A cluster's channels drift by additive capacitances (temperature, humidity, creep of the
dielectric), so the unloaded capacitances tell what to subtract.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.bench.bench_data import BenchData
from socket_testbed.bench.fit import predict_stress
from socket_testbed.calibration import ClusterCalibration
from socket_testbed.errors import CalibrationError

DRIFT_LIMIT = 1000.0  # [Pa]; a cluster that drifts more during a run is flagged
_LEAST_READINGS = 3


@dataclass(frozen=True)
class Baseline:
    """Capacitances of an unloaded cluster.

    Attributes:
        time: When they were read, on the clock of what is corrected [s].
        capacitance: Capacitances by input, shape (4,) [pF].
    """

    time: float
    capacitance: FloatArray


@dataclass(frozen=True)
class Drift:
    """What changed between two baselines.

    Attributes:
        capacitance: Change by input, shape (4,) [pF].
        stress: Change of the calibrated stress of the unloaded cluster, shape (3,) [Pa].
    """

    capacitance: FloatArray
    stress: FloatArray

    @property
    def flagged(self) -> bool:
        """Whether a stress drifted by more than `DRIFT_LIMIT`."""
        return bool((np.abs(self.stress) > DRIFT_LIMIT).any())


def average_baseline(time: float, capacitance: FloatArray, where: str) -> Baseline:
    """The medians of unloaded readings, which a single spike does not move.

    Args:
        time: When they were read [s].
        capacitance: Capacitances by input, shape (N, 4) [pF]; rows with a NaN do not count.
        where: The readings, for the error.

    Raises:
        CalibrationError: If fewer than three readings are whole.
    """
    whole = capacitance[np.isfinite(capacitance).all(axis=1)]
    if len(whole) < _LEAST_READINGS:
        raise CalibrationError(
            f"{where}: {len(whole)} whole readings are too few for a baseline",
            f"read the unloaded cluster {_LEAST_READINGS} times or more",
        )
    return Baseline(time, np.median(whole, axis=0))


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
    """Bring readings to the baseline that a calibration was made at.

    ``c(t) - (b(t) - reference)``, with b the baseline: linear in time from before to after and
    constant outside of them, or all the time the one before.

    Args:
        capacitance: Capacitances by input, shape (N, 4) [pF]; NaN stays NaN.
        time: Their times, shape (N,) [s].
        before: The baseline before.
        after: The baseline after; None if there was none.
        reference: Baseline of the calibration by input, shape (4,) [pF]; None takes the one
            before, so that only the drift since then is taken off.

    Returns:
        Corrected capacitances, shape (N, 4) [pF].

    Raises:
        CalibrationError: If the baseline after is not later than the one before.
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
    """Take the drift over a bench run off its readings, which come to the baseline before.

    Raises:
        CalibrationError: If the run is not one file with times.
    """
    if len(bench.files) > 1:
        raise CalibrationError(
            f"{len(bench.files)} bench files cannot share the drift between two baselines",
            "give the one file that was read between them, or the baseline before only",
        )
    if np.isnan(bench.time).any():
        raise CalibrationError(
            f"{bench.files[0]}: has no time, by which the drift would be taken off",
            "add a column 'time [s]', or give the baseline before only",
        )
    corrected = correct_drift(bench.capacitance, bench.time, before, after)
    return replace(bench, capacitance=corrected)
