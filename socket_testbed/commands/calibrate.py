"""`calibrate`: coefficients of a cluster from bench data, with the quality of their fit."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from socket_testbed import api
from socket_testbed.api import CalibratedCluster
from socket_testbed.arrays import FloatArray
from socket_testbed.calibration.bench_data import STRESSES, UNITS
from socket_testbed.calibration.calibrate import BenchCalibration
from socket_testbed.calibration.drift import DRIFT_LIMIT, Drift
from socket_testbed.calibration.model import SHEAR_TERMS
from socket_testbed.commands.arguments import takes
from socket_testbed.commands.options import check_files, draw, given, print_note
from socket_testbed.commands.terminal import number, table
from socket_testbed.documents import check_number
from socket_testbed.errors import ConfigurationError, closest

_SHOWN = 10  # outliers
_AREAS = (1e-6, 0.05)  # [m^2]
_UNITS = ("Pa", *["Pa/pF"] * 2, *["Pa/pF^2"] * 3)


@takes("calibrate", "commands.options.draw", "files.check_outputs", exclusive="area geometry")
def calibrate(
    bench: list[Path],
    *,
    output: Path,
    cluster: str,
    into: Path | None = None,
    columns: Sequence[str] = (),
    units: Sequence[str] = (),
    wiring: tuple[int, int, int, int] | None = None,
    baseline: Sequence[Path] = (),
    limit: float = 10.0,
    force: bool = False,
    figure: Path | None = None,
    replace: bool = False,
    **options: Any,
) -> None:
    """Fit a cluster's coefficients to bench data and show their quality.

    Args:
        output: The calibration; an older one keeps its other clusters.
        limit: Largest held-out RMSE in percent of the full scale.
        force: Write above the limit, too.
        figure: Draw the fit.
    """
    check_number(limit, "--limit", 0.0, 100.0)
    if options["area"] is not None:
        check_number(options["area"], "--area", *_AREAS)
    check_files(None, figure, replace=replace)
    found = api.calibrate(
        bench,
        cluster,
        **given(options, api.calibrate),
        into=into or (output if output.exists() else None),
        baseline=baseline,
        columns=_assignments(columns, "--columns"),
        units=_assignments(units, "--units"),
        wiring=wiring,
    )
    for note in found.notes():
        print_note(note)
    print(_report(found))
    draw(found, figure, **options)
    found.save(output, limit, force)
    old = found.existing.clusters if found.existing else {}
    others = [name for name in old if name != found.name]
    kept = f"; kept: {', '.join(others)}" if others else ""
    verb = "replaced" if found.name in old else "added"
    print(f"\n{found.name} {verb} in {output}{kept}")


def _assignments(words: Sequence[str], option: str) -> dict[str, str]:
    found: dict[str, str] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals or not value:
            raise ConfigurationError(
                f"{option}: '{word}' is not QUANTITY=VALUE",
                "write it such as normal=kPa, and the bench files before the options",
            )
        if name not in UNITS:
            raise ConfigurationError(f"{option}: no quantity '{name}'", closest(name, UNITS))
        if name in found:
            raise ConfigurationError(f"{option}: {name} is given twice", "give it once")
        found[name] = value
    return found


def _report(found: CalibratedCluster) -> str:
    """The quality of a cluster's calibration."""
    calibrated = found.quality
    bench, cluster = calibrated.bench, calibrated.cluster
    parts = [
        f"{found.name}: {len(bench)} readings of {', '.join(bench.files)};"
        f" {calibrated.cross_validation.groups} held out in turn",
        _coefficients(calibrated),
        _errors(calibrated),
        f"calibrated range: mean {_span(cluster.mean_range)} pF, differences"
        f" {_span(cluster.difference_range)} pF",
        _outliers(calibrated),
    ]
    if found.drift is not None:
        parts.append(_drift(found.drift))
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
            number(talk, 2) if isfinite(talk) else f"no pure {'normal' if axis else 'shear'}",
        ]
        for axis, (name, held_out, talk) in enumerate(
            zip(STRESSES, calibrated.held_out, calibrated.cross_talk.tolist(), strict=True)
        )
    ]
    header = ["stress", "from Pa", "to Pa", "held-out RMSE Pa", "% FS", "MAE Pa", "R2"]
    header += ["training RMSE Pa", "hysteresis % FS", "repeatability % FS", "cross-talk % FS"]
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
    return f"drift, corrected: {inputs} pF, {stress}: {verdict} the limit of {DRIFT_LIMIT:g} Pa"


def _span(limits: FloatArray) -> str:
    return f"{limits[0]:.3f} to {limits[1]:.3f}"
