"""What `calibrate` says of a cluster: coefficients, errors, range and outliers as tables."""

from __future__ import annotations

from socket_testbed.arrays import FloatArray
from socket_testbed.bench.calibrate import BenchCalibration
from socket_testbed.bench.columns import STRESSES
from socket_testbed.bench.drift import DRIFT_LIMIT, Drift
from socket_testbed.calibration import SHEAR_TERMS
from socket_testbed.commands.text import number, table

_SHOWN = 10  # outliers
_UNITS = ("Pa", *["Pa/pF"] * 2, *["Pa/pF^2"] * 3)


def quality_report(name: str, calibrated: BenchCalibration, drift: Drift | None) -> str:
    """All that is to be known of a cluster's calibration."""
    bench = calibrated.bench
    cluster = calibrated.cluster
    parts = [
        f"{name}: {len(bench)} readings of {', '.join(bench.files)};"
        f" {calibrated.cross_validation.groups} held out in turn",
        _coefficients(calibrated),
        _errors(calibrated),
        f"calibrated range: mean {_span(cluster.mean_range)} pF, differences"
        f" {_span(cluster.difference_range)} pF",
        _outliers(calibrated),
    ]
    if drift is not None:
        parts.append(_drift(drift))
    return "\n\n".join(parts)


def _coefficients(calibrated: BenchCalibration) -> str:
    cluster = calibrated.cluster
    groups = [
        ("normal", ("1", "mean"), cluster.normal, calibrated.normal_half_width),
        ("shear_x", SHEAR_TERMS, cluster.shear[0], calibrated.shear_half_width[0]),
        ("shear_y", SHEAR_TERMS, cluster.shear[1], calibrated.shear_half_width[1]),
    ]
    rows = [
        [stress, term, number(value, 1), number(width, 1), unit]
        for stress, terms, values, widths in groups
        for term, value, width, unit in zip(terms, values, widths, _UNITS, strict=False)
    ]
    return table(["stress", "term", "coefficient", "+- (95 %)", "unit"], rows)


def _errors(calibrated: BenchCalibration) -> str:
    ranges = calibrated.stress_range
    rows = [
        [
            name,
            number(float(ranges[axis, 0]), 0),
            number(float(ranges[axis, 1]), 0),
            number(held_out.rmse, 1),
            number(held_out.percent, 2),
            number(held_out.mae, 1),
            number(held_out.r2, 4),
            number(calibrated.training[axis].rmse, 1),
            number(float(calibrated.hysteresis[axis]), 2),
            number(float(calibrated.repeatability[axis]), 2),
        ]
        for axis, (name, held_out) in enumerate(zip(STRESSES, calibrated.held_out, strict=True))
    ]
    header = ["stress", "from Pa", "to Pa", "held-out RMSE Pa", "% FS", "MAE Pa", "R2"]
    header += ["training RMSE Pa", "hysteresis % FS", "repeatability % FS"]
    return table(header, rows)


def _outliers(calibrated: BenchCalibration) -> str:
    outliers = calibrated.outliers
    if not outliers:
        return "no outliers"
    rows = [
        [o.place, STRESSES[o.axis], number(o.known, 0), number(o.fitted, 0)]
        for o in outliers[:_SHOWN]
    ]
    fate = "left out of the fit" if calibrated.dropped else "kept in the fit, but not in its range"
    more = f"\nand {len(outliers) - _SHOWN} more" if len(outliers) > _SHOWN else ""
    listed = table(["reading", "stress", "known Pa", "by robust fit Pa"], rows)
    return f"{len(outliers)} outliers, {fate}:\n{listed}{more}"


def _drift(drift: Drift) -> str:
    verdict = "above" if drift.flagged else "within"
    inputs = " ".join(f"{value:+.4f}" for value in drift.capacitance)
    stress = ", ".join(
        f"{name} {value:+.0f} Pa" for name, value in zip(STRESSES, drift.stress, strict=True)
    )
    return f"drift, taken off: {inputs} pF, {stress}: {verdict} the limit of {DRIFT_LIMIT:g} Pa"


def _span(limits: FloatArray) -> str:
    return f"{limits[0]:.3f} to {limits[1]:.3f}"
