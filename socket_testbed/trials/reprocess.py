"""Other measurements: wrenches from bridge ratios, poses from markers, clusters without drift."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import median_filter

from socket_testbed.arrays import FloatArray, within
from socket_testbed.calibration import drift
from socket_testbed.calibration.model import Calibration
from socket_testbed.drivers.load_cell import load_cell
from socket_testbed.drivers.load_cell.load_cell import Bridges
from socket_testbed.errors import ConfigurationError, TrialError, naming
from socket_testbed.geometry.marker_bodies import fit_body
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.samples import force_magnitude
from socket_testbed.settings.acquisition import LoadCellSettings
from socket_testbed.settings.options import RECORDED
from socket_testbed.settings.testbed import read_testbed
from socket_testbed.trials.segment import parse_span
from socket_testbed.trials.synchronise import Measurements, marker_count

NO_TARE = "none"
_MARKER_TOLERANCE = 1e-6  # [m]
_WRENCH_TOLERANCE = 1e-6  # [-]; relative to full scale


def parse_tare(tare: str) -> tuple[float, float] | None:
    """The span of a tare given as `T0:T1`, since the trial's first sample [s].

    None for `recorded` and `none`.

    Raises:
        ConfigurationError: If it is none of the three.
    """
    fixed = tare in (RECORDED, NO_TARE)
    return None if fixed else parse_span(tare, "--tare", ", or none, recorded")


def read_load_cell(path: Path) -> LoadCellSettings:
    """Read the load cell's settings from a `testbed.yaml`.

    Raises:
        ConfigurationError: If the file is wrong, or its load-cell settings do not fit together,
            such as without a matrix.
    """
    settings = read_testbed(path).load_cell_node
    with naming(path):
        load_cell.check_settings(settings)
    return settings


def wrench_mismatch(measured: Measurements, bridges: Bridges) -> FloatArray:
    """How far the recorded wrenches are from what the ratios and the tares say.

    Args:
        measured: The measurements as recorded, with their N ratios [mV/V] and tares [N m, N].
        bridges: The bridges by the settings stored with the trial.

    Returns:
        Sizes relative to the full scale of each channel, shape (N, 6) [-].
    """
    off = bridges.wrenches(measured.ratios) - measured.tares - measured.wrench
    return np.asarray(np.abs(off) / bridges.full_scale)


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
    the converter's own gain was set in hardware and stays.

    Args:
        measured: The measurements, with their ratios [mV/V] and tares [N m, N].
        recorded: The settings stored with the trial; without a matrix if the trial stores none.
        given: Other settings; None for a new tare only.
        tare: What to subtract: `recorded`, `none`, or an unloaded span `T0:T1` since the trial's
            first sample [s], as `Trial.tare`.
        where: Names the trial in errors.
        notify: Called with a note on the tare and on wrenches without a raw reading.

    Returns:
        The measurements with the new wrenches [M; F] in {S}, shape (N, 6) [N m, N].

    Raises:
        TrialError: If the recorded settings do not match the recorded wrenches, the recorded tare
            cannot be expressed in the given settings because the trial stores no matrix, or the
            tare's span holds no wrench or is not at rest.
    """
    offsets = measured.tares
    wrenches = measured.wrench + offsets
    if given is not None:
        new, ratios = Bridges(given), measured.ratios
        if np.isfinite(measured.wrench).any() and not np.isfinite(ratios).any():
            raise TrialError(
                f"{where}: its load_cell/raw holds no ratios of the bridges: another driver"
                " measured the wrench",
                "leave the other load cell out; --tare alone takes another tare",
            )
        if recorded.matrix:
            old = Bridges(recorded)
            if (np.nan_to_num(wrench_mismatch(measured, old)) > _WRENCH_TOLERANCE).any():
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
    """Mean of wrenches (N, 6) in a span [s], shape (6,) [N m, N]; the load must be at rest."""
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
    """The bodies (`socket`, `pylon`) whose markers differ between two geometries.

    Markers differ if their number does, or a coordinate in the body's frame by more than 1e-6 m.

    Args:
        recorded: The geometry stored with the trial.
        given: The geometry that replaces it.
    """

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

    A recorded pose is a mean over frames; a new one follows the markers at the trigger.

    Args:
        measured: The measurements, with the markers in the world [m].
        geometry: Gives the coordinates of the markers in their bodies' frames [m].
        bodies: The bodies to refit, of `socket` and `pylon`.
        where: Names the trial in errors.
        notify: Called once per body with how far its poses moved.

    Returns:
        The measurements with new poses of these bodies in the world, shape (N, 7); NaN where the
        markers give none.

    Raises:
        TrialError: If more markers of a body were recorded than the geometry has.
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


# --- drift of the clusters


def check_unloaded(spans: tuple[tuple[float, float], ...]) -> None:
    """Refuse unusable unloaded spans, given as start and end since the first sample [s].

    Raises:
        ConfigurationError: If there are more than two, or they are reversed, overlap or are not in
            the order of time.
    """
    if len(spans) > 2:
        raise ConfigurationError(
            f"--unloaded has {len(spans)} spans", "give one before, or one before and one after"
        )
    for start, end in spans:
        parse_span(f"{start}:{end}", "--unloaded")
    if len(spans) == 2 and not spans[0][1] < spans[1][0]:
        first, second = (f"{start:g}:{end:g}" for start, end in spans)
        raise ConfigurationError(
            f"--unloaded: {second} does not begin after {first}",
            "give the span before the load first, the one after it second",
        )


def parse_unloaded(spans: list[str]) -> tuple[tuple[float, float], ...]:
    """Starts and ends of spans given as `T0:T1`, since the trial's first sample [s].

    Raises:
        ConfigurationError: If one does not have this form.
    """
    return tuple(parse_span(span, "--unloaded") for span in spans)


def correct_measurements(
    measured: Measurements,
    spans: Sequence[tuple[float, float]],
    calibration: Calibration,
    least_force: float,
    where: str,
    notify: Callable[[str], None],
) -> Measurements:
    """Shift the clusters' readings to the baseline of their calibration.

    The drift is taken as linear between two unloaded spans. A calibration's baseline is that of an
    unloaded cluster. If it stores none, or the load cell measured more than `least_force` in the
    first span (even a pylon alone has weight), only the drift since that span is corrected.

    Args:
        measured: The measurements, with the wrenches that show the load.
        spans: Start and end of the unloaded spans since the trial's first sample [s], one or two.
        calibration: Gives the baseline and, for the notes, the stress of each cluster.
        least_force: Magnitude of the force on the load cell from which a span is loaded [N].
        where: Names the trial in errors.
        notify: Called with notes on loaded spans, on each cluster's drift between two spans, and on
            uncorrected clusters.

    Returns:
        The measurements with corrected capacitances, shape (N, c, 4) [pF].

    Raises:
        TrialError: If a span is under load.
        CalibrationError: If a span holds fewer than three complete readings of a cluster.
    """
    loads = _unloaded_forces(measured, spans, least_force, where)
    stored = any(calibration.clusters[name].baseline is not None for name in measured.clusters)
    free = not loads or loads[0] <= least_force
    borne = zip(loads, spans, strict=False)  # no loads without a wrench
    loaded = [f"{load:.0f} N in {a:g}:{b:g}" for load, (a, b) in borne if load > least_force]
    if loaded:
        unused = "; the stored baseline is not used" * (stored and not free)
        notify(
            f"the load cell measured {', '.join(loaded)}: creep of the limb there counts as drift"
            f" of the clusters; give spans with the limb out of the socket{unused}"
        )
    time = measured.time
    capacitance = measured.capacitance.copy()
    unchanged = []
    for column, name in enumerate(measured.clusters):
        readings = capacitance[:, column]
        baselines = []
        for start, end in spans:
            rows = within(time, start, end) & np.isfinite(readings).all(axis=1)
            middle = float(np.median(time[rows])) if rows.any() else start
            of_span = f"{where}: {name} from {start:g} s to {end:g} s"
            baselines.append(drift.average_baseline(middle, readings[rows], of_span))
        cluster = calibration.clusters[name]
        before, after = baselines[0], baselines[1] if len(baselines) > 1 else None
        reference = cluster.baseline if free else None
        capacitance[:, column] = drift.correct_drift(readings, time, before, after, reference)
        if after is not None:
            notify(f"{name} {_describe(drift.measure_drift(cluster, before, after))}")
        elif reference is None:
            unchanged.append(name)
    if unchanged:
        notify(
            f"one span without load and no stored baseline in use: the drift of"
            f" {', '.join(unchanged)} is not corrected: give a second span, after the load"
        )
    return replace(measured, capacitance=capacitance)


_MIN_REST = 1.0  # [s]; shorter pauses are not unloaded spans


def _unloaded_forces(
    measured: Measurements, spans: Sequence[tuple[float, float]], least_force: float, where: str
) -> list[float]:
    """Median force in each span [N], empty if no force is known; refuses a loaded span."""
    force = force_magnitude(measured.wrench)
    known = np.isfinite(force)
    time, force = measured.time[known], force[known]
    if len(force) == 0:
        return []
    width = max(3, int(_MIN_REST * len(time) / max(float(time[-1] - time[0]), _MIN_REST)))
    steady = median_filter(force, width, mode="nearest")
    least = float(steady.min())
    loads = []
    for start, end in spans:
        forces = force[within(time, start, end)]
        load = float(np.median(forces)) if len(forces) else least
        if load > least + least_force:
            raise TrialError(
                f"{where}: {start:g}:{end:g} is not without load, the load cell measured"
                f" {load:.0f} N there",
                f"give a span as at {time[steady.argmin()]:.1f} s, where it measured {least:.0f} N",
            )
        loads.append(load)
    return loads


def _describe(found: drift.Drift) -> str:
    normal, shear_x, shear_y = 1e-3 * found.stress
    flag = f", more than {1e-3 * drift.DRIFT_LIMIT:g} kPa" if found.flagged else ""
    return (
        f"drifted by {normal:+.2f} kPa normal, {shear_x:+.2f} and {shear_y:+.2f} kPa shear between"
        f" the spans, corrected{flag}"
    )
