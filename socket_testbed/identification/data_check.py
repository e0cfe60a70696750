"""Is a trial's data good, and if not, which source needs a look? No model is needed.

Units are judged first (`unit_check`): a source in another unit is named, and what else it seems to
show is its unit's doing. Then come the defects that the readings show (`trials.raw_check`), and the
courses against the load and each other (`course_check`). If all of that is good, sources that drift
are named, or else the cluster that contradicts the force map of the others and the wrench. Last
comes each source alone (`channel_check`), and what changes suddenly (`sudden_changes`).

The thresholds of all checks leave a margin to 200 sound simulated trials of 20 to 300 s (four
scenarios, soft and stiff, 0.5 to 100 Hz). What a single trial cannot reveal stands in
`docs/faults.md`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import chain

import numpy as np

from socket_testbed.arrays import NORMAL_QUANTILE, evenly
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification import plausibility
from socket_testbed.identification.channel_check import check_channels
from socket_testbed.identification.course_check import check_courses, find_drifts
from socket_testbed.identification.courses import MIN_COMPARED_LOAD
from socket_testbed.identification.data_finding import LEAST_CHECKED, DataFinding
from socket_testbed.identification.force_map import ForceMap, left_out_pressures
from socket_testbed.identification.noise import ChannelNoise, channel_noise, measurement_errors
from socket_testbed.identification.sudden_changes import find_jumps, find_spikes, find_steps
from socket_testbed.identification.unit_check import LOAD, POSE, check_units
from socket_testbed.samples import WRENCH_CHANNELS, Samples, local_channels
from socket_testbed.settings.identification import ForceMapSettings

# [-]; innovation of a cluster over its deviation; pressure is skewed: sound -1.4 to 2.8
INNOVATIONS = (-1.9, 3.5)
LOCAL_VARIATION = 4e3  # [Pa]; of pressure under a single tile, beyond what the map's prior knows
_COMPARED_SAMPLES = 60  # samples under load on which a cluster is compared with the others


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
    doubts = check_units(samples.centred(), geometry, mass, leave_out)
    found = [each.finding for each in doubts]
    # Whatever else a channel in another unit seems to show, its unit causes.
    unclear = tuple(chain.from_iterable(each.channels for each in doubts))
    leave_out = (*leave_out, *unclear)
    found += _known(raw, leave_out, unclear)
    if outliers is None or unclear:
        outliers = plausibility.find_outliers(samples, geometry, leave_out)
    counted = outliers.taken_from(samples).without(leave_out).centred()
    if POSE in unclear:
        counted = _without_pose(counted)
    if noise is None or unclear:
        noise = channel_noise(counted)
    steps = [*find_steps(counted, noise)]
    if whole:
        found += _over_time(counted, geometry, noise, LOAD in unclear, raw, steps, prior_map)
    found += _not_stopped(check_channels(samples, noise, leave_out), raw)
    found += [*find_jumps(counted), *find_spikes(counted, noise), *steps]
    notes = plausibility.outlier_notes(samples, outliers)
    found += [DataFinding("single values", note, "check cables and connectors") for note in notes]
    return tuple(found)


def _over_time(
    samples: Samples,
    geometry: SocketGeometry,
    noise: ChannelNoise,
    load_in_doubt: bool,
    raw: tuple[DataFinding, ...],
    steps: list[DataFinding],
    prior_map: Callable[[ForceMapSettings], ForceMap] | None,
) -> list[DataFinding]:
    """Sources that contradict the load or each other; else those that drift; else the cluster.

    Each is judged only if what goes before is good, as it would show there as well.
    """
    posed = _without_faulty_pose(samples, raw)
    found = [*check_courses(posed, geometry, noise, load_in_doubt)]
    if found or load_in_doubt:
        return found
    if posed is not samples:
        steps = [*find_steps(posed, noise)]
    drifts = [*find_drifts(posed, geometry, {each.source for each in steps})]
    return drifts or [*_contradicting_cluster(samples, geometry, noise, prior_map)]


def _not_stopped(
    found: Iterable[DataFinding], raw: tuple[DataFinding, ...]
) -> Iterator[DataFinding]:
    """The findings, without channels that stand still because a reading of their source does."""
    stopped = {each.source for each in raw if each.kind == "still"}
    for finding in found:
        if finding.kind != "still" or finding.source.rpartition(".")[0] not in stopped:
            yield finding


def _without_faulty_pose(samples: Samples, raw: tuple[DataFinding, ...]) -> Samples:
    """The samples, without poses that jump, stand still or are turned: these judge nothing."""
    of_pose = [each for each in raw if each.source == "the limb pose"]
    faulty = any(each.kind in ("still", "quaternions") for each in of_pose)
    if not faulty and not any(find_jumps(samples)):
        return samples
    return _without_pose(samples)


def _without_pose(samples: Samples) -> Samples:
    """The samples, without any pose."""
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
        by_unit = finding.kind == "capacity" and own & {*unclear}
        if not own <= {*leave_out} and not by_unit:
            yield finding


def _contradicting_cluster(
    samples: Samples,
    geometry: SocketGeometry,
    noise: ChannelNoise,
    prior_map: Callable[[ForceMapSettings], ForceMap] | None = None,
) -> Iterator[DataFinding]:
    """The cluster, if any, that contradicts the others and the wrench most.

    Its mean pressure under load lies outside `INNOVATIONS`, in standard deviations from what the
    force map expects there without it; these include its own error and `LOCAL_VARIATION`. At least
    one sample needs a load of `MIN_COMPARED_LOAD`.
    """
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
