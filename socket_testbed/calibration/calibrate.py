"""From bench data to a cluster's calibration, its quality, and its section of the file."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.calibration.bench_data import STRESSES, BenchData
from socket_testbed.calibration.drift import (
    DRIFT_LIMIT,
    NEITHER,
    Drift,
    cycle_ids,
    find_branches,
)
from socket_testbed.calibration.fit import (
    Outlier,
    check_excitation,
    find_outliers,
    fit_cluster,
    fit_polynomials,
    predict_stress,
    require_wiring,
)
from socket_testbed.calibration.model import SMALLEST_GAIN, ClusterCalibration
from socket_testbed.calibration.quality import (
    CrossValidation,
    StressErrors,
    choose_groups,
    cross_talk,
    cross_validate,
    half_widths,
    hysteresis,
    repeatability,
    stress_errors,
)
from socket_testbed.errors import CalibrationError

_MOST_DROPPED = 0.05  # [-]; more than that are no outliers but another law


@dataclass(frozen=True)
class BenchCalibration:
    """A cluster's calibration with its quality."""

    cluster: ClusterCalibration
    bench: BenchData  # the data that it was fitted to
    sound: BoolArray  # rows of it that are no outliers; (N,)
    outliers: tuple[Outlier, ...]  # readings far from the rest
    dropped: bool  # whether they were left out of the fit and of `bench`
    fitted: FloatArray  # stress by the calibration; (N, 3) [Pa]
    cross_validation: CrossValidation  # the fits without each group
    training: tuple[StressErrors, ...]  # errors on the data of the fit, one per stress
    held_out: tuple[StressErrors, ...]  # errors on held-out data, one per stress
    normal_half_width: FloatArray  # half widths of the 95 % intervals of `normal`; (2,)
    shear_half_width: FloatArray  # the same of `shear`; (2, 6)
    branches: IntArray  # `find_branches` of the sound rows; no branch of the others; (N, 3)
    hysteresis: FloatArray  # gap between rising and falling; (3,) [% of the full scale]
    repeatability: FloatArray  # spread of the cycles; (3,) [% of the full scale]
    # Apparent normal stress under pure shear and shear under pure normal stress, held out; (3,)
    # [% of the full scale]
    cross_talk: FloatArray

    @property
    def full_scale(self) -> FloatArray:
        """Largest size of each known stress in the sound rows, shape (3,) [Pa]."""
        return self.bench[self.sound].full_scale

    @property
    def stress_range(self) -> FloatArray:
        """Least and largest known stress in the sound rows, shape (3, 2) [Pa]."""
        stress = self.bench.stress[self.sound]
        return np.column_stack([stress.min(axis=0), stress.max(axis=0)])

    def require_gain(self) -> None:
        """Refuse a normal stress that does not grow with the capacitance."""
        gain = self.cluster.normal[1]
        if gain < SMALLEST_GAIN:
            raise CalibrationError(
                f"the gain of the normal stress comes out as {gain:g} Pa/pF, where compression"
                f" should give at least {SMALLEST_GAIN:g}",
                "give compression as positive normal stress, and check units and outliers",
            )

    def above(self, limit: float) -> tuple[str, ...]:
        """Stresses whose held-out RMSE is above a limit [% of the full scale]."""
        pairs = zip(STRESSES, self.held_out, strict=True)
        return tuple(name for name, errors in pairs if errors.percent > limit)

    def require_accuracy(self, limit: float) -> None:
        """Refuse a calibration that predicts unseen data badly."""
        errors = dict(zip(STRESSES, self.held_out, strict=True))
        bad = [
            f"{name} {errors[name].percent:.1f} % ({errors[name].rmse:.0f} Pa)"
            for name in self.above(limit)
        ]
        if bad:
            raise CalibrationError(
                f"the held-out RMSE exceeds {limit:g} % of the full scale: {', '.join(bad)}",
                "see --figure; --drop-outliers may help, and --force writes it all the same",
            )


def calibrate_bench(
    bench: BenchData, wiring: IntArray, wiring_stated: bool, drop_outliers: bool
) -> BenchCalibration:
    """Fit a cluster and judge the fit.

    Args:
        bench: The bench data.
        wiring: Input that holds each channel, shape (4,).
        wiring_stated: Whether it was given for this bench, so that it is kept even if the data
            contradicts it.
        drop_outliers: Whether outliers are left out.
    """
    check_excitation(bench.stress, ", ".join(bench.files))
    if not wiring_stated:
        require_wiring(bench, wiring)
    fit_polynomials(bench.capacitance[:, wiring], bench.stress)  # refuses what is singular
    outliers = find_outliers(bench, wiring)
    sound = np.ones(len(bench), dtype=bool)
    sound[[outlier.row for outlier in outliers]] = False
    if drop_outliers:
        if len(outliers) > _MOST_DROPPED * len(bench):
            raise CalibrationError(
                f"{len(outliers)} of {len(bench)} readings would be dropped, more than"
                f" {100 * _MOST_DROPPED:g} %: these are no outliers",
                "look at them with --figure, and leave --drop-outliers away",
            )
        bench, sound = bench[sound], sound[sound]
    cluster = fit_cluster(bench.capacitance, bench.stress, wiring, sound)
    fitted = predict_stress(cluster, bench.capacitance)
    groups = choose_groups(bench)
    checked = cross_validate(bench.capacitance[:, wiring], bench.stress, groups)
    full_scale = bench[sound].full_scale
    residual = (fitted - bench.stress)[sound]
    branches = np.full(bench.stress.shape, NEITHER)
    branches[sound] = find_branches(bench[sound])
    return BenchCalibration(
        cluster=cluster,
        bench=bench,
        sound=sound,
        outliers=outliers,
        dropped=drop_outliers,
        fitted=fitted,
        cross_validation=checked,
        training=stress_errors(bench.stress, fitted, full_scale),
        held_out=stress_errors(bench.stress, checked.predicted, full_scale),
        normal_half_width=half_widths(cluster.normal, checked.normal),
        shear_half_width=half_widths(cluster.shear, checked.shear),
        branches=branches,
        hysteresis=hysteresis(bench[sound], residual, branches[sound]),
        repeatability=repeatability(
            bench[sound], residual, branches[sound], cycle_ids(bench)[sound]
        ),
        cross_talk=cross_talk(bench[sound], (checked.predicted - bench.stress)[sound]),
    )


_DIGITS = 4  # of an error; a bench does not determine more


def bench_record(
    calibrated: BenchCalibration, date: str, limit: float, forced: bool, drift: Drift | None
) -> dict[str, Any]:
    """The content of `bench` in a cluster's section of `calibration.yaml`."""
    record: dict[str, Any] = {
        "date": date,
        "source": ", ".join(calibrated.bench.files),
        "readings": len(calibrated.bench),
        "units": "errors and stresses in Pa, percent of full_scale, intervals as coefficients",
        "forced": forced,
        "limit_percent": limit,
        "full_scale": _by_stress(calibrated.full_scale),
        "stress_range": _by_stress(calibrated.stress_range),
        "held_out_by": str(calibrated.cross_validation.groups),
        "held_out": _by_stress(calibrated.held_out),
        "training": _by_stress(calibrated.training),
        "hysteresis_percent": _by_stress(calibrated.hysteresis),
        "repeatability_percent": _by_stress(calibrated.repeatability),
        "cross_talk_percent": _by_stress(calibrated.cross_talk),
        "interval_95": {
            "normal": calibrated.normal_half_width,
            "shear_x": calibrated.shear_half_width[0],
            "shear_y": calibrated.shear_half_width[1],
        },
        "outliers": [outlier.place for outlier in calibrated.outliers],
        "outliers_dropped": calibrated.dropped,
    }
    if drift is not None:
        record["drift"] = {
            "capacitance": drift.capacitance,
            "stress": _by_stress(drift.stress),
            "limit": DRIFT_LIMIT,
            "flagged": drift.flagged,
        }
    return {**_plain(record), "limit_percent": limit}


def _by_stress(values: Iterable[Any]) -> dict[str, Any]:
    return dict(zip(STRESSES, values, strict=True))


def _plain(value: Any) -> Any:
    """A value as YAML has it: numbers of a few digits, lists, dictionaries; None for NaN."""
    if isinstance(value, StressErrors):
        value = asdict(value)
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | np.ndarray):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
    return value
