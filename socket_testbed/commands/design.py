"""`tile`, `register` and `calibrate`: the socket, its marker bodies and its clusters."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

import numpy as np

from socket_testbed import api
from socket_testbed.api import CalibratedCluster
from socket_testbed.arrays import FloatArray
from socket_testbed.calibration.bench_data import STRESSES, UNITS
from socket_testbed.calibration.calibrate import BenchCalibration
from socket_testbed.calibration.drift import DRIFT_LIMIT, Drift
from socket_testbed.calibration.model import SHEAR_TERMS
from socket_testbed.commands import calls
from socket_testbed.commands.calls import takes
from socket_testbed.commands.running import check_files, draw, name_and_value, print_note
from socket_testbed.commands.terminal import Progress, decimals, table, text_of
from socket_testbed.documents import check_number
from socket_testbed.errors import ConfigurationError, closest
from socket_testbed.files import check_outputs
from socket_testbed.geometry.pose import Pose
from socket_testbed.settings.options import TileOptions, given
from socket_testbed.socket_design import registration
from socket_testbed.socket_design.design import parse_point
from socket_testbed.socket_design.tiling import TilingSettings
from socket_testbed.tables import Table

_MM = 1e3

_MAX_SHOWN = 10  # outliers
_UNITS = ("Pa", *["Pa/pF"] * 2, *["Pa/pF^2"] * 3)


@takes(calls.Tile)
def tile(call: calls.Tile) -> None:
    """Turn a scan into tiles, frames and neighbours."""
    output = call.output
    settings = TilingSettings(
        edge=1e-3 * call.size,
        flatness=1e-3 * check_number(call.flatness, "--flatness", 0.1, call.size / 2.0),
        rounds=call.rounds,
        seed=call.seed,
    )
    picked = [parse_point(point, "--points") for point in call.points or ()]
    extras = [output.with_suffix(suffix) for suffix in (".png", ".html")]
    check_outputs(output, *extras, replace=call.replace)
    design = api.tile(
        call.scan,
        output,
        **given(call, TileOptions),
        height=1e-3 * call.height,
        points=np.array(picked) if picked else None,
        settings=settings,
        progress=Progress,
    )
    picture, page = (path.name for path in extras)
    print(f"{output}, {picture} and {page} written")
    for note in design.notes:
        print_note(note)
    if not design.geometry.registration:
        print_note(design.geometry.bodies)
    width = max(len(name) for name, _ in design.facts())
    for name, value in design.facts():
        print(f"{name.ljust(width)}  {value}")


@takes(calls.Register)
def register(call: calls.Register) -> None:
    """Locate the marker bodies' frames from a static take and landmarks."""
    output = call.output or call.socket
    if output != call.socket:
        check_outputs(output, replace=call.replace)
    found = api.register(call.take, call.landmarks, call.socket, output, force=call.force)
    for note in found.notes:
        print_note(note)
    print(f"{_registration(found)}\n\nregistered socket in {output}")


def _registration(found: registration.Registration) -> str:
    take, geometry = found.take, found.geometry
    limb, single = _MM * _sigma(found.covariance), _MM * _sigma(found.single)
    bodies = {"load_cell": found.socket, "limb": found.pylon}
    in_cell, in_pylon = found.socket_body_covariances(), found.limb_covariances()
    return "\n".join(
        [
            f"{take.path}: {len(take)} frames at {take.frame_rate:g} Hz, format {take.version},"
            f" lengths in {take.units.lower()}",
            _frames("socket and load_cell", found.socket.still),
            _frames("pylon and limb", found.pylon.still),
            f"\n{_markers(*bodies.values())}\n",
            *(_fit(name, body.landmarks) for name, body in bodies.items()),
            "",
            _place("socket body in {S}", geometry.socket_body, *in_cell),
            _place("limb in the pylon's body", geometry.limb, *in_pylon),
            f"limb position q in {{S}}: {_vector(_MM * found.limb_position)} mm",
            f"  1 sigma: {_vector(limb)} mm, {np.linalg.norm(limb):.2f} mm in all;"
            f" noise of a single frame: {np.linalg.norm(single):.2f} mm",
        ]
    )


def _frames(name: str, still: registration.StillMarkers) -> str:
    used, count = int(still.used.sum()), len(still.used)
    occluded = count - used - still.mislabelled - still.jumped
    return (
        f"{name}: {used} frames used, {count - used} left out ({occluded} occluded,"
        f" {still.mislabelled} mislabelled, {still.jumped} jumped)"
    )


def _markers(*bodies: registration.RegisteredBody) -> str:
    rows = []
    for body in bodies:
        still = body.still
        residuals = [np.nan] * len(body.markers) + body.landmarks.residual.tolist()
        lengths = _MM * np.column_stack([still.spread, still.drift, residuals])
        for name, occluded, row in zip(still.names, still.occluded, lengths, strict=True):
            rows.append([name, str(occluded), *map(decimals, row)])
    return table(["marker", "occluded", "spread [mm]", "drift [mm]", "residual [mm]"], rows)


def _fit(name: str, fit: registration.LandmarkFit) -> str:
    return (
        f"{name}: {len(fit.names)} landmarks, residual {_MM * fit.rms:.3f} mm rms"
        f" ({fit.degrees} degrees of freedom), so 1 sigma of a coordinate is"
        f" {_MM * fit.noise:.3f} mm"
    )


def _place(name: str, pose: Pose, position: FloatArray, rotation: FloatArray) -> str:
    turn = pose.rotation_vector()
    angle = float(np.linalg.norm(turn))
    axis = turn / angle if angle > 0.0 else turn
    return (
        f"{name}: at {_vector(_MM * pose.translation)} mm, turned by {np.degrees(angle):.2f} deg"
        f" about {_vector(axis, 3)}\n"
        f"  1 sigma: {_vector(_MM * _sigma(position))} mm,"
        f" {_vector(np.degrees(_sigma(rotation)), 3)} deg about x, y, z"
    )


def _sigma(covariance: FloatArray) -> FloatArray:
    """1 sigma along each axis, shape (3,)."""
    return np.sqrt(np.diag(covariance))


def _vector(values: FloatArray, digits: int = 2) -> str:
    return f"({', '.join(decimals(value, digits) for value in values)})"


@takes(calls.Calibrate)
def calibrate(call: calls.Calibrate) -> None:
    """Fit a cluster's coefficients to bench data and show their quality."""
    output, into = call.output, call.into
    new = into is not None and into.resolve() != output.resolve()
    check_files(output if new else None, call.figure, replace=call.replace, table=False)
    found = api.calibrate(
        call.bench,
        call.cluster,
        into=into or (output if output.exists() else None),
        baseline=call.baseline,
        columns=_assignments(call.columns, "--columns"),
        units=_assignments(call.units, "--units"),
        area=call.area,
        geometry=call.geometry,
        wiring=call.wiring,
        drop_outliers=call.drop_outliers,
    )
    for note in found.notes():
        print_note(note)
    print(_calibration(found))
    draw(found, **given(call, draw))
    found.save(output, call.limit, call.force, call.replace)
    old = found.existing.clusters if found.existing else {}
    others = [name for name in old if name != found.name]
    kept = f"; kept: {', '.join(others)}" if others else ""
    verb = "replaced" if found.name in old else "added"
    print(f"\n{found.name} {verb} in {output}{kept}")


def _assignments(words: Sequence[str], option: str) -> dict[str, str]:
    found: dict[str, str] = {}
    for word in words:
        name, value = name_and_value(word, option, "normal=kPa, after the bench files")
        if name not in UNITS:
            raise ConfigurationError(f"{option}: no quantity '{name}'", closest(name, UNITS))
        if name in found:
            raise ConfigurationError(f"{option}: {name} is given twice", "give it once")
        found[name] = value
    return found


def _calibration(found: CalibratedCluster) -> str:
    calibrated = found.quality
    bench, cluster = calibrated.bench, calibrated.cluster
    parts = [
        f"{found.name}: {len(bench)} readings of {', '.join(bench.files)};"
        f" {calibrated.cross_validation.groups} held out in turn",
        _coefficients(calibrated),
        _errors(found),
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
        [stress, term, decimals(value, 1), decimals(width, 1), unit]
        for stress, terms, values, widths in groups
        for term, value, width, unit in zip(terms, values, widths, _UNITS, strict=False)
    ]
    return table(["stress", "term", "coefficient", "+- (95 %)", "unit"], rows)


def _errors(found: CalibratedCluster) -> str:
    frame = found.to_dataframe()
    frame["cross-talk [%]"] = [
        decimals(value, 3) if isfinite(value) else f"no pure {'normal' if axis else 'shear'}"
        for axis, value in enumerate(frame["cross-talk [%]"])
    ]
    return text_of(Table("errors", "", frame))


def _outliers(calibrated: BenchCalibration) -> str:
    outliers = calibrated.outliers
    if not outliers:
        return "no outliers"
    rows = [
        [o.place, STRESSES[o.axis], decimals(o.known, 0), decimals(o.fitted, 0)]
        for o in outliers[:_MAX_SHOWN]
    ]
    fate = "left out of the fit" if calibrated.dropped else "kept in the fit, but not in its range"
    more = f"\nand {len(outliers) - _MAX_SHOWN} more" if len(outliers) > _MAX_SHOWN else ""
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
