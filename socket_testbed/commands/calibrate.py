"""`calibrate`: coefficients of a cluster from bench data, with the quality of their fit."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from math import isfinite
from pathlib import Path

from socket_testbed import api
from socket_testbed.api import CalibratedCluster
from socket_testbed.arrays import FloatArray
from socket_testbed.calibration.bench_data import STRESSES, UNITS
from socket_testbed.calibration.calibrate import BenchCalibration
from socket_testbed.calibration.drift import DRIFT_LIMIT, Drift
from socket_testbed.calibration.model import SHEAR_TERMS
from socket_testbed.commands.options import (
    add_figure,
    add_replace,
    check_figure,
    figure_choices,
    print_note,
)
from socket_testbed.commands.text import number, table
from socket_testbed.documents import check_number
from socket_testbed.errors import ConfigurationError, closest
from socket_testbed.files import check_outputs

_SHOWN = 10  # outliers
_AREAS = (1e-6, 0.05)  # [m^2]
_UNITS = ("Pa", *["Pa/pF"] * 2, *["Pa/pF^2"] * 3)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "bench", type=Path, nargs="+", metavar="BENCH.csv", help="bench data of one cluster"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="CALIBRATION.yaml")
    parser.add_argument("--cluster", required=True, metavar="NAME", help="name of the cluster")
    parser.add_argument(
        "--into",
        type=Path,
        metavar="EXISTING.yaml",
        help="calibration whose other clusters are kept (default: the output, if it exists)",
    )
    _add_reading(parser)
    parser.add_argument(
        "--baseline",
        type=Path,
        nargs="+",
        default=[],
        metavar="FILE.csv",
        help="unloaded readings before the bench run, and, to take its drift off, after it",
    )
    parser.add_argument(
        "--limit",
        type=float,
        default=10.0,
        metavar="PERCENT",
        help="largest held-out RMSE in percent of the full scale (default: 10)",
    )
    parser.add_argument("--force", action="store_true", help="write above the limit, too")
    parser.add_argument(
        "--drop-outliers", action="store_true", help="leave the outliers out of the fit"
    )
    add_figure(parser, "FILE", "draw the fit")
    add_replace(parser, "a figure that exists")
    parser.set_defaults(run=run)


def _add_reading(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--columns",
        action="extend",
        nargs="+",
        default=[],
        metavar="QUANTITY=HEADER",
        help=f"what the header calls a quantity: {', '.join(UNITS)}",
    )
    parser.add_argument(
        "--units",
        action="extend",
        nargs="+",
        default=[],
        metavar="QUANTITY=UNIT",
        help="units instead of the header's: Pa, kPa, MPa, N, kN; pF, fF, nF, counts of an FDC1004;"
        " s, ms",
    )
    area = parser.add_mutually_exclusive_group()
    area.add_argument("--area", type=float, metavar="M2", help="area of stresses in N [m^2]")
    area.add_argument(
        "--geometry", type=Path, metavar="SOCKET.yaml", help="take the area of the cluster's tile"
    )
    parser.add_argument(
        "--wiring",
        type=int,
        nargs=4,
        metavar=("C", "C", "C", "C"),
        help="input of each channel (-x,+y) (+x,+y) (-x,-y) (+x,-y) (default: the existing"
        " cluster's, else 0 1 2 3)",
    )


def run(options: argparse.Namespace) -> None:
    """Fit, report and write."""
    check_number(options.limit, "--limit", 0.0, 100.0)
    if options.area is not None:
        check_number(options.area, "--area", *_AREAS)
    check_figure(options)
    check_outputs(options.figure, replace=options.replace)
    into = options.into or (options.output if options.output.exists() else None)
    found = api.calibrate(
        options.bench,
        options.cluster,
        into=into,
        baseline=options.baseline,
        columns=_assignments(options.columns, "--columns"),
        units=_assignments(options.units, "--units"),
        area=options.area,
        geometry=options.geometry,
        wiring=options.wiring,
        drop_outliers=options.drop_outliers,
    )
    for note in found.notes():
        print_note(note)
    print(_report(found))
    if options.figure is not None:
        found.draw(options.figure, **figure_choices(options))
    found.save(options.output, options.limit, options.force)
    old = found.existing.clusters if found.existing else {}
    others = [name for name in old if name != found.name]
    kept = f"; kept: {', '.join(others)}" if others else ""
    verb = "replaced" if found.name in old else "added"
    print(f"\n{found.name} {verb} in {options.output}{kept}")


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
