"""The drift of a cluster between readings without load.

Temperature, humidity and creep of the dielectric add offsets to a cluster's capacitances, so
unloaded readings give the correction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.calibration.bench_data import BenchData
from socket_testbed.calibration.fit import predict_stress
from socket_testbed.calibration.model import ClusterCalibration
from socket_testbed.errors import CalibrationError

_MIN_READINGS = 3  # for a baseline

DRIFT_LIMIT = 1000.0  # [Pa]; a larger drift during a run is flagged


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
