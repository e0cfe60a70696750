"""Is a trial's data good, and if not, which source needs a look? No model is needed.

Units are judged first: a source in another unit is named, and what else it seems to show is its
unit's doing. Then come the defects that the readings show (`trials.raw_check`), and the courses
against the load and each other (`course_check`). If all of that is good, sources that drift are
named, or else the cluster that contradicts the force map of the others and the wrench. Last comes
each source alone (`channel_check`), and what changes suddenly (`sudden_changes`).

The thresholds of all checks leave a margin to 200 sound simulated trials of 20 to 300 s (four
scenarios, soft and stiff, 0.5 to 100 Hz). What a single trial cannot reveal stands in
`docs/faults.md`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import chain, groupby

import numpy as np

from socket_testbed.arrays import evenly, finite_quantile
from socket_testbed.errors import IdentificationError
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification import plausibility
from socket_testbed.identification.channel_check import check_channels
from socket_testbed.identification.course_check import check_courses, find_drifts
from socket_testbed.identification.courses import MIN_COMPARED_LOAD
from socket_testbed.identification.data_finding import (
    LEAST_CHECKED,
    STILL,
    WRITE_QUATERNIONS,
    DataFinding,
)
from socket_testbed.identification.force_map import (
    NORMAL_QUANTILE,
    ForceMap,
    left_out_pressures,
)
from socket_testbed.identification.noise import ChannelNoise, channel_noise, measurement_errors
from socket_testbed.identification.sudden_changes import find_jumps, find_spikes, find_steps
from socket_testbed.samples import (
    GRAVITY,
    MOMENTS,
    WRENCH_CHANNELS,
    Samples,
    force_magnitude,
    local_channels,
)
from socket_testbed.settings.identification import ForceMapSettings

# [-]; innovation of a cluster over its deviation; pressure is skewed: sound -1.4 to 2.8
INNOVATIONS = (-1.9, 3.5)
LOCAL_VARIATION = 4e3  # [Pa]; of pressure under a single tile, beyond what the map's prior knows
_COMPARED_SAMPLES = 60  # samples under load on which a cluster is compared with the others
CAPACITY = "of its full scale"  # words of a finding
AREA_RATIO = (0.1, 10.0)  # [-]; squared distance of neighbouring tiles over their area; 1.5
MIN_LEVER = 3e-4  # [m]; usual moment over usual load; sound 0.0076 and more
LOAD_RANGE = (0.12, 5.0)  # [-]; load over the weight of a stated mass; 0.10 for kgf when standing
MAX_ROTATION = 0.7  # [rad]; of the limb from its mean attitude; sound 0.04
MOMENT_CHANNELS = tuple(WRENCH_CHANNELS[MOMENTS])
LOAD = "load"  # stands for the size of the load among names of channels
POSE = "pose"  # stands for the limb's pose among names of channels


def check_data(
    samples: Samples,
    geometry: SocketGeometry,
    mass: float | None = None,
    leave_out: tuple[str, ...] = (),
    whole: bool = True,
    raw: tuple[DataFinding, ...] = (),
    outliers: plausibility.Outliers | None = None,
    prior_map: Callable[[ForceMapSettings], ForceMap] | None = None,
    noise: ChannelNoise | None = None,
) -> tuple[DataFinding, ...]:
    """Defects of a trial's data, the worst first; empty if it is good.

    Args:
        samples: The samples of the trial, or of a window of it, N of them.
        geometry: The socket, which has the clusters of the samples.
        mass: Mass of the person, to judge the size of the load [kg]; None if it is unknown.
        leave_out: Names of channels that are not checked, such as `Mz` or `distal.Fx`.
        whole: Whether the samples are a whole trial. In a window the limb may just be pushed, so
            sources are not compared over time.
        raw: What the measurements from which the samples were made show, see
            `trials.raw_check`; findings on units go before it, others after it.
        outliers: Outliers of the samples outside the left-out channels; None to find them here.
        prior_map: Returns the force map of the samples' clusters for settings of its prior; None
            to make it here.
        noise: Noise of the samples without their outliers; None to estimate it here.
    """
    if len(samples) < LEAST_CHECKED:
        fact = f"{len(samples)} samples are too few to judge it"
        return (DataFinding("the trial", fact, f"record {LEAST_CHECKED} or more"),)
    units = [*_areas(geometry), *_units(samples.centred(), geometry, mass, leave_out)]
    found = [finding for finding, _ in units]
    # Whatever else a channel in another unit seems to show, its unit causes.
    unclear = tuple(chain.from_iterable(channels for _, channels in units))
    leave_out = (*leave_out, *unclear)
    found += _known(raw, leave_out, unclear)
    if outliers is None or unclear:
        outliers = plausibility.find_outliers(samples, geometry, leave_out)
    counted = outliers.taken_from(samples).without(leave_out).centred()
    if POSE in unclear:
        nothing = np.full_like(samples.position, np.nan)
        counted = replace(counted, position=nothing, rotation=nothing)
    if noise is None or unclear:
        noise = channel_noise(counted)
    steps = [*find_steps(counted, noise)]
    if whole:
        in_doubt = LOAD in unclear
        posed = _without_faulty_pose(counted, raw)
        found_over_time = [*check_courses(posed, geometry, noise, in_doubt)]
        found += found_over_time
        if not found_over_time and not in_doubt:
            of_posed = steps if posed is counted else find_steps(posed, noise)
            stepped = {each.source for each in of_posed}
            found += [*find_drifts(posed, geometry, stepped)] or [
                *_disagreements(counted, geometry, noise, prior_map)
            ]
    stopped = {each.source for each in raw if STILL in each.fact}
    found += [
        each
        for each in check_channels(samples, noise, leave_out)
        if STILL not in each.fact or each.source.rpartition(".")[0] not in stopped
    ]
    found += [*find_jumps(counted), *find_spikes(counted, noise), *steps]
    notes = plausibility.outlier_notes(samples, outliers)
    found += [DataFinding("single values", note, "check cables and connectors") for note in notes]
    return tuple(found)


def _without_faulty_pose(samples: Samples, raw: tuple[DataFinding, ...]) -> Samples:
    """The samples, without poses that jump, stand still or are turned: these judge nothing."""
    of_pose = [each for each in raw if each.source == "the limb pose"]
    faulty = any(STILL in each.fact or each.hint.startswith(WRITE_QUATERNIONS) for each in of_pose)
    if not faulty and not any(find_jumps(samples)):
        return samples
    nothing = np.full_like(samples.position, np.nan)
    return replace(samples, position=nothing, rotation=nothing)


def _known(
    raw: tuple[DataFinding, ...], leave_out: tuple[str, ...], unclear: tuple[str, ...]
) -> Iterator[DataFinding]:
    """The findings of the measurements, without those of sources that are left out.

    A load in another unit exceeds the load cell's capacity only because of its unit.
    """
    for finding in raw:
        of_cell = finding.source in ("the wrench", "the load cell")
        own = {*(WRENCH_CHANNELS if of_cell else local_channels(finding.source))}
        by_unit = CAPACITY in finding.fact and own & {*unclear}
        if not own <= {*leave_out} and not by_unit:
            yield finding


def _areas(geometry: SocketGeometry) -> Iterator[tuple[DataFinding, tuple[str, ...]]]:
    """Areas of tiles that do not fit their distances; with no channel, as in `_units`."""
    one, other = geometry.neighbours.T
    if not len(one):
        return
    squares = ((geometry.anchors[one] - geometry.anchors[other]) ** 2).sum(axis=1)
    areas = np.sqrt(geometry.areas[one] * geometry.areas[other])
    ratio = float(np.median(squares / areas))
    if not AREA_RATIO[0] <= ratio <= AREA_RATIO[1]:
        area, distance = 1e4 * np.median(areas), 1e3 * np.sqrt(np.median(squares))
        finding = DataFinding(
            "the socket",
            f"its tiles have {area:.2g} cm^2, and the next one is {distance:.2g} mm away",
            "check that areas are in m^2 and anchors in m in socket.yaml",
        )
        yield finding, ()


def _units(
    samples: Samples, geometry: SocketGeometry, mass: float | None, leave_out: tuple[str, ...]
) -> Iterator[tuple[DataFinding, tuple[str, ...]]]:
    """Units and frames, which show in sizes: of single channels, the force and the rotation.

    Each finding comes with the names of the channels whose unit it doubts.
    """
    try:
        plausibility.require_position(samples, geometry)
    except IdentificationError as error:
        yield DataFinding("the units", error.fact, error.hint), (POSE,)
    wrong = [*plausibility.wrong_units(samples, geometry, leave_out)]
    for channels, excess in wrong:
        yield DataFinding("the units", excess.fact, excess.hint), channels
    if wrong:
        return
    proposed = plausibility.find_implausible(samples, geometry)
    implausible = [each for each in proposed if each.channel not in leave_out]
    for source, group in groupby(implausible, lambda each: each.channel.rpartition(".")[0]):
        own = [*group]  # of the wrench, then of each cluster
        channels = tuple(dict.fromkeys(each.channel for each in own))
        hint = "check that moments are in N m and forces in N, and the load cell's channels"
        if source:
            hint = f"check its calibration, or leave it out (--leave-out {' '.join(channels)})"
        finding = DataFinding(source or "the wrench", f"{own[0].channel}: {own[0].reason}", hint)
        yield finding, () if source else MOMENT_CHANNELS
    size = finite_quantile(force_magnitude(samples.wrench), 0.95)
    moment = finite_quantile(np.linalg.norm(samples.wrench[:, MOMENTS], axis=1), 0.95)
    counted = not {*MOMENT_CHANNELS} & {*leave_out}
    if counted and size > plausibility.MIN_LOAD and 0.0 < moment < MIN_LEVER * size:
        finding = DataFinding(
            "the wrench",
            f"its moment of {moment:.2g} N m is that of its force of {size:.3g} N at a lever of"
            f" {1e3 * moment / size:.2g} mm",
            "check that moments are in N m (kN m?), and the load cell's matrix",
        )
        yield finding, MOMENT_CHANNELS
    weights = size / (GRAVITY * mass) if mass and samples.has_wrench.any() else 1.0
    if not LOAD_RANGE[0] <= weights <= LOAD_RANGE[1]:
        finding = DataFinding(
            "the wrench",
            f"its force of {size:.3g} N is {weights:.2g} weights of the stated {mass:g} kg",
            "check that forces are in N (kgf, kN?), and the mass",
        )
        yield finding, (LOAD,)
    angle = finite_quantile(np.linalg.norm(samples.rotation, axis=1), 0.95)
    if angle > MAX_ROTATION:
        finding = DataFinding(
            "the limb pose",
            f"the limb turns by {np.degrees(angle):.0f} deg in the socket",
            "check the order of the quaternion (x, y, z, w), and the marker bodies",
        )
        yield finding, (POSE,)


def _disagreements(
    samples: Samples,
    geometry: SocketGeometry,
    noise: ChannelNoise,
    prior_map: Callable[[ForceMapSettings], ForceMap] | None = None,
) -> Iterator[DataFinding]:
    """The cluster, if any, that contradicts the others and the wrench most."""
    loaded = samples[samples.under_load(MIN_COMPARED_LOAD)]
    if not len(loaded):
        return
    compared = loaded[evenly(len(loaded), _COMPARED_SAMPLES)]
    prior = ForceMapSettings()  # the data is judged alike, whatever the trial's settings
    errors = measurement_errors(samples, noise.local_forces, prior)
    force_map = None if prior_map is None else prior_map(prior)
    worst = (1.0, "", "")
    pressures = left_out_pressures(compared, geometry, force_map)
    for error, (name, measured, expected, deviation) in zip(errors, pressures, strict=True):
        if np.isfinite(measured).any():
            own = np.nan_to_num(error[2]) / geometry.areas[geometry.clusters[name]]
            scale = np.hypot(np.hypot(deviation, own), LOCAL_VARIATION)
            off = float(np.nanmean((measured - expected) / scale))
            off /= INNOVATIONS[1] if off > 0.0 else INNOVATIONS[0]
            means = (np.nanmean(of) for of in (measured, expected, NORMAL_QUANTILE * scale))
            value, middle, reach = (1e-3 * float(mean) for mean in means)
            words = f"{value:.0f} kPa where the others and the wrench say {middle - reach:.0f} to"
            worst = max(worst, (off, name, f"it reads {words} {middle + reach:.0f} kPa"))
    _, name, fact = worst
    if name:
        hint = "check its calibration and its place, and whether clusters are exchanged"
        yield DataFinding(name, fact, hint)
