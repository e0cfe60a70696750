"""What a calibration file keeps of the bench: origin, range and errors, in plain numbers."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from socket_testbed.arrays import FloatArray
from socket_testbed.bench.calibrate import BenchCalibration
from socket_testbed.bench.columns import STRESSES
from socket_testbed.bench.drift import DRIFT_LIMIT, Drift

_DIGITS = 4  # of an error; more would say more than a bench knows


def bench_record(
    calibrated: BenchCalibration, date: str, limit: float, forced: bool, drift: Drift | None
) -> dict[str, Any]:
    """The content of `bench` in a cluster's section of `calibration.yaml`.

    Args:
        calibrated: The calibration.
        date: Its date.
        limit: Limit of the held-out errors [% of the full scale].
        forced: Whether it is kept although it exceeds the limit.
        drift: Drift over the bench run that was taken off; None if no baseline followed it.
    """
    record = {
        "date": date,
        "source": ", ".join(calibrated.bench.files),
        "readings": len(calibrated.bench),
        "units": "errors and stresses in Pa, percent of full_scale, intervals as coefficients",
        "forced": forced,
        "limit_percent": limit,
        "full_scale": _by_stress(calibrated.full_scale),
        "stress_range": dict(zip(STRESSES, map(_shorts, calibrated.stress_range), strict=True)),
        "held_out_by": str(calibrated.cross_validation.groups),
        "held_out": _errors(calibrated.held_out),
        "training": _errors(calibrated.training),
        "hysteresis_percent": _by_stress(calibrated.hysteresis),
        "repeatability_percent": _by_stress(calibrated.repeatability),
        "interval_95": {
            "normal": _shorts(calibrated.normal_half_width),
            "shear_x": _shorts(calibrated.shear_half_width[0]),
            "shear_y": _shorts(calibrated.shear_half_width[1]),
        },
        "outliers": [outlier.place for outlier in calibrated.outliers],
        "outliers_dropped": calibrated.dropped,
    }
    if drift is not None:
        record["drift"] = {
            "capacitance": _shorts(drift.capacitance),
            "stress": _by_stress(drift.stress),
            "limit": DRIFT_LIMIT,
            "flagged": drift.flagged,
        }
    return record


def _errors(errors: tuple[Any, ...]) -> dict[str, Any]:
    return {
        name: {key: _short(value) for key, value in asdict(error).items()}
        for name, error in zip(STRESSES, errors, strict=True)
    }


def _by_stress(values: FloatArray) -> dict[str, float | None]:
    return dict(zip(STRESSES, _shorts(values), strict=True))


def _shorts(values: FloatArray) -> list[float | None]:
    return [_short(value) for value in values.tolist()]


def _short(value: float) -> float | None:
    return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
