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
    """Capacitances of an unloaded cluster.

    Attributes:
        time: When they were read, on the clock of the readings to correct [s]; may be NaN if no
            drift between two baselines is corrected.
        capacitance: Capacitances by input of the converter, shape (4,) [pF].
    """

    time: float
    capacitance: FloatArray


@dataclass(frozen=True)
class Drift:
    """Change between two baselines, the later minus the earlier.

    Attributes:
        capacitance: Change of the capacitances by input of the converter, shape (4,) [pF].
        stress: Change of the unloaded cluster's calibrated stress: normal (positive in
            compression), shear x and shear y, shape (3,) [Pa].
    """

    capacitance: FloatArray
    stress: FloatArray

    @property
    def flagged(self) -> bool:
        """Whether a stress drifted by more than `DRIFT_LIMIT`."""
        return bool((np.abs(self.stress) > DRIFT_LIMIT).any())


def average_baseline(time: float, capacitance: FloatArray, where: str) -> Baseline:
    """Median of unloaded readings, robust to single spikes.

    Args:
        time: When they were read, on the clock of the readings to correct [s].
        capacitance: The readings by input of the converter, shape (N, 4) [pF]; rows with NaN do not
            count.
        where: Start of the error, such as the file.

    Raises:
        CalibrationError: If fewer than three readings are complete.
    """
    complete = capacitance[np.isfinite(capacitance).all(axis=1)]
    if len(complete) < _MIN_READINGS:
        raise CalibrationError(
            f"{where}: {len(complete)} complete readings are too few for a baseline",
            f"read the unloaded cluster {_MIN_READINGS} times or more",
        )
    return Baseline(time, np.median(complete, axis=0))


def measure_drift(cluster: ClusterCalibration, before: Baseline, after: Baseline) -> Drift:
    """Change between two baselines, in pF and, through the calibration, in Pa.

    Args:
        cluster: The cluster's calibration.
        before: The earlier baseline.
        after: The later baseline.
    """
    pair = predict_stress(cluster, np.stack([before.capacitance, after.capacitance]))
    return Drift(after.capacitance - before.capacitance, pair[1] - pair[0])


def correct_drift(
    capacitance: FloatArray,
    time: FloatArray,
    before: Baseline,
    after: Baseline | None = None,
    reference: FloatArray | None = None,
) -> FloatArray:
    """Correct readings to the baseline of a calibration.

    ``c(t) - (b(t) - reference)``: the baseline b is linear in time between `before` and `after` and
    constant outside; without `after` it equals `before`.

    Args:
        capacitance: The readings c by input of the converter, shape (N, 4) [pF].
        time: Times t of the readings, shape (N,) [s].
        before: The earlier baseline, on the clock of the readings.
        after: The later baseline, on the clock of the readings; None if there is only one.
        reference: The calibration's baseline by input, shape (4,) [pF]; None stands for `before`,
            which removes only the drift since then.

    Returns:
        The corrected readings by input, shape (N, 4) [pF].

    Raises:
        CalibrationError: If `after` is not later than `before`.
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
    """Correct the drift of a bench run back to the baseline before it.

    Args:
        bench: The readings of one file with times.
        before: Baseline at the start of the run, on the file's clock.
        after: Baseline at the end of the run, on the file's clock.

    Raises:
        CalibrationError: If the readings are from several files, have no times, or `after` is not
            later than `before`.
    """
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
