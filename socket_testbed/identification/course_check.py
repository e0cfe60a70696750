"""Sources that contradict the load or each other over a trial, and sources that drift.

- Every cluster's normal force and the limb's pose follow the force along the socket. This reveals a
  reversed sign, a late or dead source.
- The limb's motion beside the load reveals wrong axes, negated moments, exchanged clusters and
  short delays.
- Horizontal forces have the moments of a height above or below the load cell. This reveals mirrored
  forces, and moments in another unit.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import chain

import numpy as np

from socket_testbed.arrays import finite_quantile
from socket_testbed.geometry.regions import proximal_direction
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.correlation import drift_of, explained_share
from socket_testbed.identification.courses import LOCAL_SHARE, MIN_SINKING, REVERSED, Courses
from socket_testbed.identification.data_finding import DataFinding
from socket_testbed.identification.limb_motion import (
    AXES,
    NEGATED,
    OPPOSITE,
    height_of_forces,
    mirrored_forces,
)
from socket_testbed.identification.noise import ChannelNoise
from socket_testbed.samples import Samples, force_magnitude

MIN_CORRELATION = 0.2  # [-]; correlation with the load below which a source does not follow it
MIN_SIGNAL = 4.0  # [-]; standard deviation of a cluster over its noise, to compare it with the load
MIN_EXPLAINED = 0.4  # [-]; share of its variance explained by wrench and pose; sound >= 0.48
MAX_HEIGHT = 2.0  # [m]; moment over horizontal force beside the load; sound 0.52
MIN_HEIGHT_FIT = 0.8  # [-]; of their correlation, to judge it
MAX_PULL = 100.0  # [N]; of a socket towards its proximal end; sound none
PULL_QUANTILE = 0.05  # of the load, to judge that pull
MIN_DRIFT_TIME = 50.0  # [s]; of a trial, to judge drifts
MAX_DRIFT = 12e3  # [Pa]; of a cluster beside wrench and pose; sound 6 kPa
MAX_POSE_DRIFT = 2e-3  # [m]; of the limb across the socket beside the wrench; sound 0.3 mm
MIN_POSE_GAIN = 0.3  # [-]; in the clusters' fit to the pose, to say that its axes are wrong
MIN_MIRRORED_FIT = 0.6  # [-]; correlation of moments and forces in mirrored axes; sound <= 0.5
MIN_MIRRORED_GAIN = 0.3  # [-]; over that of the forces as they are; sound <= -0.05


def _small_load(courses: Courses) -> Iterator[DataFinding]:
    """A wrench that changes far less than the forces on the clusters: `courses.LOCAL_SHARE`.

    Not if its size is reported already.
    """
    if courses.load_is_too_small and not courses.load_in_doubt:
        yield DataFinding(
            "the wrench",
            f"its force along the socket changes by {courses.load_change:.2g} N while those of the"
            f" clusters change by {courses.clusters_change:.2g} N",
            "check that forces are in N (kgf, kN?) and stresses in Pa, the load cell's channels,"
            " and the calibration",
        )


def _little_load(courses: Courses) -> Iterator[DataFinding]:
    """A wrench of far less force than the clusters bear, though it may hardly change.

    They bear `courses.MAX_BORNE` times as much. Not if its size is reported already.
    """
    if courses.load_in_doubt or courses.load_is_too_small:
        return
    if courses.bears_too_little:
        force = finite_quantile(force_magnitude(courses.samples.wrench), 0.95)
        borne = finite_quantile(courses.pressing.clip(0.0).sum(axis=1), 0.95)
        yield DataFinding(
            "the wrench",
            f"its force of {force:.2g} N is a small part of the {borne:.2g} N on the clusters",
            "check that forces are in N (kgf, kN?) and stresses in Pa, the load cell's channels,"
            " and the calibration",
        )


def _negated_wrench(courses: Courses) -> Iterator[DataFinding]:
    """A wrench that pulls at a pressed socket, or that falls as the clusters are pressed.

    It pulls by more than `plausibility.HANGING_WEIGHT`, or most clusters correlate with it below
    `courses.REVERSED`.
    """
    if courses.sign_note:
        hint = "check the sign of the load cell's channels"
        yield DataFinding("the wrench", courses.sign_note, hint)


def _pulling_wrench(courses: Courses) -> Iterator[DataFinding]:
    """A wrench that pulls at the socket for a while, as one that was tared under load.

    It pulls with `MAX_PULL` in `PULL_QUANTILE` of the samples. Not if it is negated, or its size is
    reported already.
    """
    if courses.sign_note or courses.load_in_doubt or not np.isfinite(courses.load).any():
        return
    pull = -finite_quantile(courses.load, PULL_QUANTILE)
    if pull > MAX_PULL:
        yield DataFinding(
            "the wrench",
            f"it pulls at the socket with {pull:.3g} N for {100.0 * PULL_QUANTILE:.0f} % of the"
            " samples, more than a hanging prosthesis",
            "check that it was tared without load (--tare T0:T1 takes another tare), unless the"
            " limb was pulled",
        )


def _small_clusters(courses: Courses) -> Iterator[DataFinding]:
    """Clusters that are loaded, but far less than the load: `courses.LOCAL_SHARE` of its change.

    The load must change by `courses.MIN_LOAD_CHANGE`.
    """
    if not courses.load_shows_others:
        return
    if 0.0 < courses.clusters_change < LOCAL_SHARE[0] * courses.load_change:
        yield DataFinding(
            "the clusters",
            f"their forces change by {courses.clusters_change:.2g} N while the load does by"
            f" {courses.load_change:.2g} N",
            "check that stresses are in Pa and forces in N, and the calibration",
        )


def _late_behind_the_load(courses: Courses) -> Iterator[DataFinding]:
    """All clusters, or the pose, late or early against the load by more than `courses.MAX_LAG`."""
    for name, lag in courses.lags.items():
        yield _late(name, lag, "the load cell")


def _late_beside_the_load(courses: Courses) -> Iterator[DataFinding]:
    """A pose or clusters that are late or early in the limb's motion beside the load.

    The limits are `courses.MAX_POSE_LAG` behind the moments, and else `courses.MAX_CLUSTER_LAG`
    behind load and pose.
    """
    for name, lag in courses.motion_lags.items():
        against = "the moments of the load cell" if name == "the limb pose" else "the limb's motion"
        yield _late(name, lag, against)


def _late(source: str, lag: float, against: str) -> DataFinding:
    """A source that is late by a lag, or early by a negative one [s]."""
    how = f"{'late' if lag > 0.0 else 'early'} by {abs(lag):.1f} s against {against}"
    return DataFinding(source, how, "check the clocks and the delays of the sources")


def _horizontal_axes(courses: Courses) -> Iterator[DataFinding]:
    """Horizontal axes of the load cell or of the marker bodies that do not agree.

    Rotation and moment correlate better in other axes, by `courses.MIN_AXES_GAIN`. The clusters
    say which of the two is wrong, if their fit differs by `MIN_POSE_GAIN`.
    """
    if not courses.wrong_axes or courses.motion is None:
        return
    axes = courses.wrong_axes
    of_pose = OPPOSITE[axes]
    gain = courses.motion.axes_misfit() - courses.motion.axes_misfit(AXES[of_pose])
    fact = f"the limb turns as if the horizontal axes of the moments were {axes}"
    if axes == NEGATED:
        fact += ", or the moments negated"
    if gain > MIN_POSE_GAIN:  # the clusters agree with the load cell
        yield DataFinding(
            "the limb pose",
            f"moments and clusters fit it as if its horizontal axes were {of_pose}",
            "check the registration of the marker bodies in socket.yaml",
        )
    elif gain < -MIN_POSE_GAIN:  # the clusters agree with the pose
        yield DataFinding(
            "the wrench",
            fact,
            "check the mounting of the load cell, the rows and signs of its matrix, and the signs"
            " of its moments",
        )
    else:
        yield DataFinding(
            "the wrench or the limb pose",
            fact,
            "check the mounting of the load cell, the signs of its moments, and the registration of"
            " the marker bodies",
        )


def _unlikely_heights(courses: Courses) -> Iterator[DataFinding]:
    """Horizontal forces whose moments would take a leg of more than `MAX_HEIGHT`.

    They are judged if they correlate by `MIN_HEIGHT_FIT`.
    """
    height, fit = height_of_forces(courses.samples)
    if fit > MIN_HEIGHT_FIT and height > MAX_HEIGHT:
        yield DataFinding(
            "the wrench",
            f"its horizontal forces have moments at a lever of {height:.2g} m",
            "check that moments are in N m (lbf in, N cm?) and forces in N (kgf?)",
        )


def _mirrored_forces(courses: Courses) -> Iterator[DataFinding]:
    """Horizontal forces that have no height at which their moments are those of the wrench.

    Mirrored, they correlate with the moments by `MIN_MIRRORED_FIT`, and by `MIN_MIRRORED_GAIN` more
    than as they are. Not if the sign or the axes of the wrench are reported already.
    """
    if courses.wrong_axes or courses.sign_note:
        return
    axes, mirrored, own = mirrored_forces(courses.samples)
    if mirrored > max(MIN_MIRRORED_FIT, own + MIN_MIRRORED_GAIN):
        yield DataFinding(
            "the wrench",
            f"its horizontal forces have its moments only if their axes were {axes} (correlation"
            f" {mirrored:.2f}, as they are {own:.2f})",
            "check the rows and signs of the load cell's matrix, and its bridges' wiring",
        )


def _exchanged_clusters(courses: Courses) -> Iterator[DataFinding]:
    """Clusters, each of which follows the motion of the limb at another one's tile.

    Their fit is better there by `courses.MIN_EXCHANGE_GAIN`.
    """
    names = [courses.samples.clusters[column] for column in courses.exchanged]
    if names:
        other = "the other's tile"
        if len(names) > 2:
            other = "the next one's tile, and the last as the first one's"
        yield DataFinding(
            f"{', '.join(names[:-1])} and {names[-1]}",
            f"each is pressed as the limb's motion presses {other}",
            "check whether their cables or names are exchanged, and their tiles in socket.yaml",
        )


def _reversed_clusters(courses: Courses) -> Iterator[DataFinding]:
    """Clusters that are pressed less while the limb is loaded more: correlation below `REVERSED`.

    Not if they are exchanged, or the sources are not simultaneous.
    """
    if not courses.are_simultaneous:
        return
    follows = courses.sense * courses.follows
    for column, (name, value) in enumerate(zip(courses.samples.clusters, follows, strict=True)):
        if value < REVERSED and column not in courses.exchanged:
            yield DataFinding(
                name,
                f"it is pressed less the more the limb is loaded (correlation {value:.2f})",
                "check the sign of its normal channel, or whether clusters are exchanged",
            )


def _idle_clusters(courses: Courses) -> Iterator[DataFinding]:
    """Clusters whose force follows neither the load nor any other motion or load of the limb.

    Its correlation with the load is below `MIN_CORRELATION`, wrench and pose explain less than
    `MIN_EXPLAINED` of it, and it varies by more than `MIN_SIGNAL` times its noise.
    """
    if not courses.are_simultaneous:
        return
    follows = courses.sense * courses.follows
    noises = courses.noise.local_forces[:, 2]
    sources = zip(courses.samples.clusters, follows, courses.pressing.T, noises, strict=True)
    for column, (name, value, force, noise) in enumerate(sources):
        if (
            column not in courses.exchanged
            and REVERSED <= value < MIN_CORRELATION
            and explained_share(force, courses.causes) < MIN_EXPLAINED
            and np.nanstd(force) > MIN_SIGNAL * noise  # else it is hardly loaded
        ):
            yield DataFinding(
                name,
                f"it does not follow the load (correlation {value:.2f})",
                "check its place, its cable and its calibration",
            )


def _motion_across(courses: Courses) -> Iterator[DataFinding]:
    """A limb that does not sink along the socket as it is loaded: cosine below `MIN_SINKING`."""
    if courses.sinking < MIN_SINKING:
        yield DataFinding(
            "the limb pose",
            "the limb does not sink as it is loaded: it moves at"
            f" {np.degrees(np.arccos(courses.sinking)):.0f} deg to the socket's axis",
            "check the axes and the registration of the marker bodies",
        )


_RULES_OF_COURSES = (
    _small_load,
    _little_load,
    _negated_wrench,
    _pulling_wrench,
    _small_clusters,
    _late_behind_the_load,
    _late_beside_the_load,
    _horizontal_axes,
    _unlikely_heights,
    _mirrored_forces,
    _exchanged_clusters,
    _reversed_clusters,
    _idle_clusters,
    _motion_across,
)


def check_courses(
    samples: Samples, geometry: SocketGeometry, noise: ChannelNoise, load_in_doubt: bool = False
) -> Iterator[DataFinding]:
    """Sizes, signs and lags, and whether each source follows the load.

    Args:
        samples: The samples, without outliers and left-out channels, with rotations since the mean
            attitude.
        geometry: The socket.
        noise: Noise of the samples.
        load_in_doubt: Whether the size of the load is reported already.
    """
    courses = Courses(samples, geometry, noise, load_in_doubt)
    return chain.from_iterable(rule(courses) for rule in _RULES_OF_COURSES)


def find_drifts(
    samples: Samples, geometry: SocketGeometry, stepped: Collection[str]
) -> Iterator[DataFinding]:
    """Sources that change steadily over the trial, beside what wrench and pose explain.

    A drift shows from `MIN_DRIFT_TIME` on. A pose that drifts explains no cluster.

    Args:
        samples: The samples, without outliers and left-out channels, with rotations since the mean
            attitude.
        geometry: The socket.
        stepped: Names of the sources that step, see `find_steps`: a step is no drift.
    """
    if samples.time[-1] < MIN_DRIFT_TIME:
        return
    found = [*_drifting_pose(samples, geometry, stepped)]
    yield from found or _drifting_clusters(samples, geometry, stepped)


def _drifting_pose(
    samples: Samples, geometry: SocketGeometry, stepped: Collection[str]
) -> Iterator[DataFinding]:
    """A limb that drifts across the socket by more than `MAX_POSE_DRIFT`, beside the wrench."""
    proximal = proximal_direction(geometry)
    across = samples.position - np.outer(samples.position @ proximal, proximal)
    drift = float(np.linalg.norm(drift_of(across, samples.wrench, samples.time)))
    if drift > MAX_POSE_DRIFT and "the limb pose" not in stepped:
        yield DataFinding(
            "the limb pose",
            f"it drifts by {1e3 * drift:.2g} mm across the socket over the trial, beside the load",
            "check that the marker bodies are tight, and the zero of the load cell's moments",
        )


def _drifting_clusters(
    samples: Samples, geometry: SocketGeometry, stepped: Collection[str]
) -> Iterator[DataFinding]:
    """Clusters whose pressure drifts by more than `MAX_DRIFT`, beside wrench and pose."""
    causes = np.hstack([samples.wrench, samples.pose])
    tiles = [geometry.clusters[name] for name in samples.clusters]
    pressures = -samples.trusted_forces[:, :, 2] / geometry.areas[tiles]
    drifts = drift_of(pressures, causes, samples.time).tolist()
    for name, drift in zip(samples.clusters, drifts, strict=True):
        if abs(drift) > MAX_DRIFT and name not in stepped:
            yield DataFinding(
                name,
                f"it drifts by {1e-3 * drift:.2g} kPa over the trial, beside load and pose",
                "take the drift off with --unloaded, and check the sensor",
            )
