"""From bench data to a cluster's calibration, its quality, and its section of the file."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.calibration.bench_data import STRESSES, BenchData, scaled_stress
from socket_testbed.calibration.drift import (
    DRIFT_LIMIT,
    NEITHER,
    Drift,
    cycle_ids,
    find_branches,
)
from socket_testbed.calibration.model import (
    SMALLEST_GAIN,
    ClusterCalibration,
    channel_features,
)
from socket_testbed.calibration.outliers import Outlier, find_outliers
from socket_testbed.calibration.polynomials import (
    check_excitation,
    fit_cluster,
    fit_polynomials,
    predict_stress,
)
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

_CORNERS = np.sign(np.column_stack(channel_features(np.eye(4))[1:]))  # (4, 2), sides of channels
_LEAST_RESPONSE = 0.1  # [-] of the inputs' variance; less is noise
_BULK = (1.0, 99.0)  # [%]; a spike beyond them must not decide


def find_wiring(capacitance: FloatArray, stress: FloatArray) -> IntArray:
    """Find the wiring for which a shear stress raises the channels on its own side.

    Args:
        capacitance: Capacitances by input, shape (N, 4) [pF].
        stress: Known normal stress, shear x and shear y, shape (N, 3) [Pa].

    Returns:
        Input that holds each channel, shape (4,).
    """
    slopes = np.linalg.lstsq(*_response(capacitance, stress), rcond=None)[0][2:]
    slopes = slopes - slopes.mean(axis=1, keepdims=True)
    slopes = slopes / np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1e-12)
    return linear_sum_assignment(_CORNERS @ slopes, maximize=True)[1].astype(np.int64)


def _response(capacitance: FloatArray, stress: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The design matrix of the scaled stresses, (N, 4), and the inputs without spikes, (N, 4)."""
    design = np.column_stack([np.ones(len(stress)), scaled_stress(stress)])
    return design, np.clip(capacitance, *np.percentile(capacitance, _BULK, axis=0))


def shear_response(capacitance: FloatArray, stress: FloatArray) -> FloatArray:
    """How well the inputs follow each shear stress, beside the two other stresses.

    Args:
        capacitance: Capacitances by input, shape (N, 4) [pF].
        stress: Known normal stress, shear x and shear y, shape (N, 3) [Pa].

    Returns:
        For shear x and shear y the partial R^2 of the inputs less their mean, shape (2,) [-].
    """
    design, inputs = _response(capacitance, stress)
    differences = inputs - inputs.mean(axis=1, keepdims=True)

    def unexplained(columns: FloatArray) -> float:
        fitted = columns @ np.linalg.lstsq(columns, differences, rcond=None)[0]
        return float(((differences - fitted) ** 2).sum())

    all_of_it = unexplained(design)
    without = [unexplained(np.delete(design, axis, axis=1)) for axis in (2, 3)]
    return np.array([1.0 - all_of_it / max(part, 1e-300) for part in without])


def require_wiring(bench: BenchData, wiring: IntArray) -> None:
    """Refuse a default wiring that the bench data contradicts.

    Raises:
        CalibrationError: Naming the wiring that agrees with the data, or the shear that the inputs
            do not follow, so that no wiring can be read from it.
    """
    response = shear_response(bench.capacitance, bench.stress)
    for axis, (name, part) in enumerate(zip(STRESSES[1:], response, strict=True), start=1):
        if part < _LEAST_RESPONSE:
            raise CalibrationError(
                f"{', '.join(bench.files)}: no input follows {name}, of"
                f" {bench.full_scale[axis]:.0f} Pa at most: it is no more than noise",
                f"apply {name} on the bench; the wiring and its coefficients need it",
            )
    found = find_wiring(bench.capacitance, bench.stress)
    if not np.array_equal(found, wiring):
        raise CalibrationError(
            f"{', '.join(bench.files)}: the shear stresses do not raise the channels on their own"
            f" side with the wiring {_words(wiring)}, but do with {_words(found)}",
            f"give --wiring {_words(found)}, or --wiring {_words(wiring)} to keep it",
        )


def _words(wiring: IntArray) -> str:
    return " ".join(map(str, wiring.tolist()))


@dataclass(frozen=True)
class BenchCalibration:
    """A cluster's calibration with its quality.

    Attributes:
        cluster: The calibration.
        bench: The data that it was fitted to.
        sound: Rows of it that are no outliers, shape (N,).
        outliers: Readings far from the rest.
        dropped: Whether they were left out of the fit and of `bench`.
        fitted: Stress by the calibration, shape (N, 3) [Pa].
        cross_validation: The fits without each group.
        training: Errors on the data of the fit, one per stress.
        held_out: Errors on held-out data, one per stress.
        normal_half_width: Half widths of the 95 % intervals of `normal`, shape (2,).
        shear_half_width: The same of `shear`, shape (2, 6).
        branches: `find_branches` of the sound rows; no branch of the others, shape (N, 3).
        hysteresis: Gap between rising and falling, shape (3,) [% of the full scale].
        repeatability: Spread of the cycles, shape (3,) [% of the full scale].
        cross_talk: Apparent normal stress under pure shear and shear under pure normal stress,
            held out, shape (3,) [% of the full scale].
    """

    cluster: ClusterCalibration
    bench: BenchData
    sound: BoolArray
    outliers: tuple[Outlier, ...]
    dropped: bool
    fitted: FloatArray
    cross_validation: CrossValidation
    training: tuple[StressErrors, ...]
    held_out: tuple[StressErrors, ...]
    normal_half_width: FloatArray
    shear_half_width: FloatArray
    branches: IntArray
    hysteresis: FloatArray
    repeatability: FloatArray
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
        """Refuse a normal stress that does not grow with the capacitance.

        Raises:
            CalibrationError: If the gain is none that a calibration file may hold.
        """
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
        """Refuse a calibration that predicts unseen data badly.

        Args:
            limit: Largest held-out RMSE [% of the full scale].

        Raises:
            CalibrationError: Naming the stresses with their errors.
        """
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

    Raises:
        CalibrationError: If the data does not determine the fit or its check, contradicts the
            wiring, or would lose too many readings as outliers.
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
    """The content of `bench` in a cluster's section of `calibration.yaml`.

    Args:
        calibrated: The calibration.
        date: Its date.
        limit: Limit of the held-out errors [% of the full scale].
        forced: Whether it is kept although it exceeds the limit.
        drift: Drift over the bench run that was corrected; None if no baseline followed it.
    """
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
