"""Measurements recomputed from raw data: wrenches from bridge ratios, poses from markers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from socket_testbed.arrays import FloatArray, within
from socket_testbed.drivers.load_cell import load_cell
from socket_testbed.drivers.load_cell.load_cell import Bridges
from socket_testbed.errors import TrialError, naming
from socket_testbed.geometry.marker_bodies import fit_body
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.settings.acquisition import LoadCellSettings
from socket_testbed.settings.testbed import read_testbed
from socket_testbed.trials.segment import parse_span
from socket_testbed.trials.synchronise import Measurements, marker_count

RECORDED = "recorded"
NO_TARE = "none"
_MARKER_TOLERANCE = 1e-6  # [m]
_WRENCH_TOLERANCE = 1e-6  # [-]; relative to full scale


def parse_tare(tare: str) -> tuple[float, float] | None:
    """The span of a tare given as `T0:T1` [s]; None for `recorded` and `none`."""
    fixed = tare in (RECORDED, NO_TARE)
    return None if fixed else parse_span(tare, "--tare", ", or none, recorded")


def read_load_cell(path: Path) -> LoadCellSettings:
    """Read the load cell's settings from a `testbed.yaml`."""
    settings = read_testbed(path).load_cell_node
    with naming(path):
        load_cell.check_settings(settings)
    return settings


def remake_wrenches(
    measured: Measurements,
    recorded: LoadCellSettings,
    given: LoadCellSettings | None,
    tare: str,
    where: str,
    notify: Callable[[str], None],
) -> Measurements:
    """Recompute wrenches with other load-cell settings or another tare.

    The given settings may assign other signs, gains, excitation or inputs to the measured voltages;
    the converter's own gain was set in hardware and stays. The recorded settings lack a matrix if
    the trial stores none. The tare is that of a `Trial`. `where` names the trial in errors.
    """
    offsets = measured.tares
    wrenches = measured.wrench + offsets
    if given is not None:
        new, ratios = Bridges(given), 1e3 * measured.ratios
        if recorded.matrix:
            old = Bridges(recorded)
            off = np.nan_to_num(np.abs(old.wrenches(ratios) - wrenches))
            if (off > _WRENCH_TOLERANCE * old.full_scale).any():
                raise TrialError(
                    f"{where}: its testbed.yaml's load cell does not match the recorded wrenches",
                    "remove load_cell_node from that file: the ratios are then used as they are",
                )
            offsets = new.wrenches(new.ratios_from(old, old.ratios_at(offsets)))
            ratios = new.ratios_from(old, ratios)
        elif tare == RECORDED and np.nan_to_num(offsets).any():
            raise TrialError(
                f"{where}: does not store the load cell's matrix, with which its tare was computed",
                "give --tare as well: T0:T1 without load, or none",
            )
        wrenches = new.wrenches(ratios)
    span = parse_tare(tare)
    if span is not None:
        offsets = _mean_load(measured.time, wrenches, span, given or recorded, where)
    elif tare == NO_TARE:
        offsets = np.zeros(6)
    last = np.broadcast_to(offsets, wrenches.shape)[np.isfinite(wrenches).all(axis=1)][-1:]
    used = "".join(map(load_cell.in_words, last))
    lost = int((np.isfinite(measured.wrench) & ~np.isfinite(wrenches)).all(axis=1).sum())
    lacking = f"; {lost} have no raw reading and are missing" * bool(lost)
    notify(f"the wrenches are recomputed from load_cell/raw, with the tare {tare}: {used}{lacking}")
    return replace(measured, wrench=wrenches - offsets)


def _mean_load(
    time: FloatArray,
    wrenches: FloatArray,
    span: tuple[float, float],
    limits: LoadCellSettings,
    where: str,
) -> FloatArray:
    """Mean of the wrenches in a span [s], shape (6,) [N m, N]; the load must be at rest there."""
    start, end = span
    rows = within(time, start, end) & np.isfinite(wrenches).all(axis=1)
    if not rows.any():
        raise TrialError(
            f"{where}: --tare {start:g}:{end:g} holds no wrench",
            f"give seconds since the first sample, from 0 to {time[-1]:g}",
        )
    if moving := load_cell.unrest(wrenches[rows], limits):
        hint = "give a span without load, at rest"
        raise TrialError(f"{where}: --tare {start:g}:{end:g}: {moving}", hint)
    return wrenches[rows].mean(axis=0)


def other_markers(recorded: SocketGeometry, given: SocketGeometry) -> tuple[str, ...]:
    """The bodies (`socket`, `pylon`) whose markers differ between two geometries."""

    def differs(body: str) -> bool:
        old, new = (geometry.markers[body] for geometry in (recorded, given))
        return old.shape != new.shape or not np.allclose(old, new, rtol=0.0, atol=_MARKER_TOLERANCE)

    return tuple(filter(differs, recorded.markers))


def refit_poses(
    measured: Measurements,
    geometry: SocketGeometry,
    bodies: tuple[str, ...],
    where: str,
    notify: Callable[[str], None],
) -> Measurements:
    """Refit poses of bodies to their recorded markers, as mocap_node fits those of a frame.

    A recorded pose is a mean over frames; a new one follows the markers at the trigger. `where`
    names the trial in errors; `notify` reports how far the poses of each body moved.
    """
    for body in bodies:
        reference = geometry.markers[body]
        seen = measured.markers.get(body, np.full((len(measured.stamps), *reference.shape), np.nan))
        count = marker_count(seen)
        if count > len(reference):
            raise TrialError(
                f"{where}: {count} markers of the {body} were recorded, and the geometry has"
                f" {len(reference)}",
                "give the socket.yaml of this trial's marker bodies with --geometry",
            )
        fitted = fit_body(reference, seen[:, : len(reference)]).pose
        recorded = Pose.from_vector(getattr(measured, body))
        notify(f"{body}: {_describe_shift(recorded, fitted)}")
        measured = replace(measured, **{body: fitted.vector})  # type: ignore[arg-type]
    return measured


def _describe_shift(recorded: Pose, fitted: Pose) -> str:
    """A note on the distance of N fitted poses from the recorded ones."""
    found, known = (np.isfinite(pose.translation[:, 0]) for pose in (fitted, recorded))
    text = (
        f"poses refitted to the recorded markers: {found.sum()} of {len(found)} found,"
        f" {(known & ~found).sum()} of the recorded ones refused, {(found & ~known).sum()} new"
    )
    both = found & known
    if not both.any():
        return text
    old, new = (Pose(pose.rotation[both], pose.translation[both]) for pose in (recorded, fitted))
    shifts = 1e3 * np.linalg.norm(new.translation - old.translation, axis=1)
    turns = 1e3 * np.linalg.norm((old.inverse() @ new).rotation_vector(), axis=1)
    return (
        f"{text}; moved by {np.median(shifts):.3g} mm and {np.median(turns):.3g} mrad (median),"
        f" {shifts.max():.3g} mm and {turns.max():.3g} mrad (largest)"
    )
