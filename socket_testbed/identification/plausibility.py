"""Checks that samples are plausible in magnitude and sign for a limb in a socket.

- Units: if a quarter of the samples exceeds the load that a person can apply, or the limb lies
  outside the socket, the samples are in another unit or frame, and a fit is refused.
- Load: a wrench that is zero throughout says nothing about contact, and a fit is refused.
- Outliers: a single value beyond these limits, or far above the root mean square of its group
  of channels (moments, forces, cluster forces: `OUTLIER_RATIO`, `OUTLIER_SHARE`), would dominate
  the normalisation of its group; so would several spikes (`SPIKE_RATIO`), unless load cell and
  clusters feel them. They are left out with a note; too many outliers are refused.
- Sign: a wall pushes and a socket opens at its proximal end, so the force of the limb on the
  socket points to the distal end. If it points the other way and exceeds the weight of a
  prosthesis hanging on the limb, while the clusters are in compression, the wrench is negated.

The paper leaves out channels whose reconstructed magnitudes are far above the applied load.
`find_implausible` proposes channels to leave out, over the samples of a trial. With the load L
as the median magnitude of the measured force, it proposes

- a moment whose median magnitude exceeds L at twice the distance of the farthest tile from
  the load cell: no force between limb and socket has such a lever arm;
- a local force whose median magnitude exceeds L, as one tile would carry more than the whole
  load, or whose peak exceeds `PEAK_RATIO` times the peak of the measured force. The paper left
  out shear channels with peaks of more than 1000 N under about 300 N. To ignore spikes, a peak is
  the largest magnitude without the highest hundredth of the samples, at least one;
- a local normal force (Fz) in tension by more than `TENSION_SHARE` of L and `MIN_TENSION` in
  the median: a wall cannot pull;
- all three channels of a cluster that is saturated or out of its calibrated range in more
  than `OUTSIDE_SHARE` of the samples in which it was read.

The first three need a load of at least `MIN_LOAD`. Nothing is left out automatically: the
user decides with `--leave-out`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import median_filter

from socket_testbed.arrays import BoolArray, FloatArray, finite_quantile
from socket_testbed.errors import IdentificationError, listed
from socket_testbed.geometry.regions import proximal_direction
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.samples import (
    FORCES,
    GROUPS,
    WRENCH_CHANNELS,
    Samples,
    Status,
    channel_unit,
    force_magnitude,
    local_channels,
)
from socket_testbed.settings.identification import PlateauSettings

MAX_FORCE = 5000.0  # [N]; three times the weight of a person of 170 kg
MAX_MOMENT = 500.0  # [N m]; more than a leg transmits below the knee
MAX_STRESS = 2e6  # [Pa]; several times the highest pressures reported in sockets
MAX_DISTANCE = 2.0  # [-]; of the limb from the load cell, relative to the farthest tile's
UNIT_QUANTILE = 0.75  # [-]; of the magnitudes, compared with the limits
OUTLIER_RATIO = 200.0  # [-]; of a value's square to the mean square of its group of channels,
OUTLIER_SHARE = 1.0 / 3.0  # [-]; or to the sum of squares, whichever gives the lower limit
SPIKE_RATIO = 3.0  # [-]; of a single value to the usual ones of its group; 0.1 in sound trials
_RISE = 1.5  # [-]; of a short load, to its neighbours
_USUAL_QUANTILE = 0.95  # [-]; of the largest value of each sample
MIN_VALUES = 30  # [1]; in a group, to find outliers
MAX_OUTLIERS = 0.1  # [-]; of the samples
MIN_MOMENT = 0.1  # [N m]; lower limit when a channel group is normalised
MIN_FORCE = 1.0  # [N]
HANGING_WEIGHT = 50.0  # [N]; weight of a prosthesis below the load cell
MIN_LOAD = PlateauSettings.least_force  # [N]
PEAK_RATIO = 3.0  # [-]; of the load's own peak; 3.3 in the paper
PEAK_QUANTILE = 0.99  # [-]
LEVER_FACTOR = 2.0  # [-]; of the farthest tile's distance
TENSION_SHARE = 0.05  # [-]; of the load
MIN_TENSION = 10.0  # [N]; 11 kPa on a cluster of 9 cm^2, more than a sensor's usual offset
OUTSIDE_SHARE = 0.5  # [-]; of the samples
_MAX_NAMED = 3  # outliers of a channel in a note


@dataclass(frozen=True)
class Outliers:
    """Single implausible values of N samples.

    Attributes:
        position: Samples with an outlying limb position, shape (N,).
        values: Outlying values of the channels in the order of `Samples.channels`, shape
            (N, 6 + 3c).
    """

    position: BoolArray
    values: BoolArray

    @property
    def rows(self) -> BoolArray:
        """Samples with an outlier, shape (N,)."""
        return np.asarray(self.position | self.values.any(axis=1))

    def taken_from(self, samples: Samples) -> Samples:
        """The N samples with their outliers marked as not measured, that is NaN."""
        position = np.where(self.position[:, None], np.nan, samples.position)
        return dataclasses.replace(samples.blanked(self.values), position=position)


def find_outliers(
    samples: Samples, geometry: SocketGeometry, leave_out: tuple[str, ...] = ()
) -> Outliers:
    """Find single outliers by the rule of the module.

    Args:
        samples: N samples.
        geometry: The socket, whose tiles limit the forces and the limb's position.
        leave_out: Names of channels in which no outliers are sought, such as `distal.Fx`.
    """
    values = _counted(samples, leave_out)
    limits = channel_limits(geometry, samples.clusters)
    # A channel that is often beyond its limit has another unit: see `require_units`.
    found = beyond_a_person(values, limits) & (_usual_sizes(values) <= limits)
    known = np.nan_to_num(values)
    # A short load is felt by the load cell and by clusters.
    felt = _rises(known[:, FORCES]) & _rises(known[:, 6:])
    for group in (*GROUPS, slice(6, None)):
        found[:, group] |= _dominating(np.where(found[:, group], 0.0, known[:, group]))
        left = np.where(found[:, group], 0.0, known[:, group])
        found[:, group] |= _spikes(left) & ~felt[:, None]
    return Outliers(_beyond_the_socket(samples.position, geometry), found)


def beyond_a_person(values: FloatArray, limits: FloatArray) -> BoolArray:
    """Values that no person applies, shape (N, 6 + 3c); missing ones are none.

    It is the one rule for outliers that a single sample shows: the estimator has no other.

    Args:
        values: Values of the channels, shape (N, 6 + 3c) [N m, N].
        limits: Their `channel_limits`, shape (6 + 3c,) [N m, N].
    """
    return np.asarray(np.abs(values) > limits)


def _dominating(values: FloatArray) -> BoolArray:
    """Values of a group, (N, m), whose squares are too large a part of the group's sum of squares.

    A part above `OUTLIER_SHARE`, or `OUTLIER_RATIO` times the mean square, whichever is lower. The
    largest one is judged first, then the next one without it. A group needs `MIN_VALUES` values
    that are not 0.
    """
    squares = values**2
    found = np.zeros(values.shape, dtype=bool)
    count = int(np.count_nonzero(squares))
    share = min(OUTLIER_SHARE, OUTLIER_RATIO / max(count, 1))
    while count >= MIN_VALUES and squares.max() > share * squares.sum():
        place = np.unravel_index(squares.argmax(), squares.shape)
        squares[place] = 0.0
        found[place] = True
    return found


def _spikes(values: FloatArray) -> BoolArray:
    """Single values of a group, (N, m), far above its usual ones and above their neighbours.

    They exceed the `_USUAL_QUANTILE` of the samples' largest values by `SPIKE_RATIO`, and the
    median of the five values around them is less than half of them. Several spikes raise a sum of
    squares, which then hides them all.
    """
    sizes = np.abs(values)
    highest = sizes.max(axis=1, initial=0.0)
    if np.count_nonzero(highest) < MIN_VALUES:
        return np.zeros(values.shape, dtype=bool)
    usual = float(np.quantile(highest[highest > 0.0], _USUAL_QUANTILE))
    found = sizes > SPIKE_RATIO * usual
    if found.any():  # rarely, and the filter is slow
        found &= np.abs(median_filter(values, (5, 1), mode="mirror")) < 0.5 * sizes
    return found


def _rises(values: FloatArray) -> BoolArray:
    """Where vectors (N, m) are larger than their neighbours, (N,)."""
    size = np.linalg.norm(values, axis=1)
    return np.asarray(size > _RISE * median_filter(size, 5, mode="mirror"))


def outlier_notes(samples: Samples, outliers: Outliers) -> Iterator[str]:
    """A note per channel with outliers: their values, and their times since the first sample [s].

    Args:
        samples: N samples as they were measured.
        outliers: Their outliers.
    """
    values = [np.linalg.norm(samples.position, axis=1), *samples.values.T]
    found = [outliers.position, *outliers.values.T]
    for name, column, rows in zip(
        ("limb position", *samples.channels), values, map(np.flatnonzero, found), strict=True
    ):
        if len(rows):
            unit = channel_unit(name) if name in samples.channels else "m"
            parts = [f"{column[i]:.3g} {unit} at {samples.time[i]:.2f} s" for i in rows]
            number = "an outlier" if len(rows) == 1 else f"{len(rows)} outliers"
            yield f"{name} has {number} ({listed(parts, _MAX_NAMED)}): left out"


def require_few_outliers(
    samples: Samples, outliers: Outliers, rows: slice | BoolArray = slice(None)
) -> None:
    """Refuse samples of which too many hold an outlier.

    Args:
        samples: N samples as they were measured.
        outliers: Their outliers.
        rows: The rows to be used, as a slice or a mask of shape (N,).

    Raises:
        IdentificationError: If more than `MAX_OUTLIERS` of these samples hold an outlier.
    """
    among = outliers.rows[rows]
    count = int(among.sum())
    if count > MAX_OUTLIERS * len(among):
        within = Outliers(outliers.position[rows], outliers.values[rows])
        raise IdentificationError(
            f"{count} of {len(among)} samples are outliers:"
            f" {'; '.join(outlier_notes(samples[rows], within))}",
            "check these channels, leave them out (--leave-out), or give another segment",
        )


def sign_note(samples: Samples, geometry: SocketGeometry) -> str | None:
    """A note if the wrench looks negated; None without clear evidence.

    Args:
        samples: Samples under load; medians over them are judged.
        geometry: The socket; the x axes of its tiles point to the proximal end.
    """
    proximal = proximal_direction(geometry)
    opening = geometry.rotations[:, :, 2].mean(axis=0) @ proximal
    force = samples.wrench[:, 3:]
    force = force[np.isfinite(force).all(axis=1)]
    normal = samples.trusted_forces[:, :, 2]
    pressed = [-float(np.median(f[np.isfinite(f)])) for f in normal.T if np.isfinite(f).any()]
    if not len(force) or not pressed or opening <= 0.0:
        return None
    pull = float(np.median(force @ proximal))
    pressing = sum(p > 0.0 for p in pressed)
    if pull <= HANGING_WEIGHT or 2 * pressing <= len(pressed) or sum(pressed) <= 0.0:
        return None
    return (
        f"the wrench looks negated: its force would pull the socket towards the proximal end with"
        f" {pull:.3g} N in the median, while {pressing} of {len(pressed)} clusters are pressed"
        f" ({sum(pressed):.3g} N), and walls only push"
    )


@dataclass(frozen=True)
class Implausible:
    """A channel that `find_implausible` proposes to leave out of the objective.

    Attributes:
        channel: Name of the channel, such as `Mx` or `distal.Fz`.
        reason: Why, in words with the numbers and their units.
    """

    channel: str
    reason: str


def find_implausible(samples: Samples, geometry: SocketGeometry) -> tuple[Implausible, ...]:
    """Propose channels to leave out, by the rules of the module.

    Args:
        samples: The samples of a trial.
        geometry: The socket, whose farthest tile limits the moments.

    Returns:
        The proposals in the order of the channels, one for each channel and reason.
    """
    force = force_magnitude(samples.wrench)
    load, peak = finite_quantile(force, 0.5), _peak(force)
    found: list[Implausible] = []
    for name, values in zip(samples.channels, samples.values.T, strict=True):
        if load >= MIN_LOAD and name not in WRENCH_CHANNELS[FORCES]:
            channel = _LoadedChannel(name, values, load, peak, _reach(geometry))
            rules = _RULES_OF_A_MOMENT if name in WRENCH_CHANNELS else _RULES_OF_A_LOCAL_FORCE
            reasons = filter(None, (rule(channel) for rule in rules))
            found += [Implausible(name, reason) for reason in reasons]
    for cluster, reason in _often_out_of_range(samples):
        found += [Implausible(channel, reason) for channel in local_channels(cluster)]
    return tuple(sorted(found, key=lambda proposal: samples.channels.index(proposal.channel)))


@dataclass(frozen=True)
class _LoadedChannel:
    """A moment or a local force beside the load, in which rules find what is too large for it.

    Attributes:
        name: Name of the channel.
        values: Its values, shape (N,) [N m or N].
        load: Median magnitude of the measured force [N].
        largest_load: Its peak [N].
        reach: Distance of the farthest tile from the load cell [m].
    """

    name: str
    values: FloatArray
    load: float
    largest_load: float
    reach: float

    @cached_property
    def size(self) -> float:
        """Median magnitude of the values [N m or N]."""
        return finite_quantile(np.abs(self.values), 0.5)


def _too_long_lever(moment: _LoadedChannel) -> str | None:
    """A moment at a longer lever of the load than `LEVER_FACTOR` times the farthest tile's."""
    size, load = moment.size, moment.load
    if size <= LEVER_FACTOR * moment.reach * load:
        return None
    return (
        f"the median magnitude of {size:.3g} N m would take the load of {load:.3g} N at a lever of"
        f" {size / load:.2g} m, where the farthest tile is {moment.reach:.2g} m away"
    )


def _larger_than_the_load(force: _LoadedChannel) -> str | None:
    """A force on one tile whose median magnitude is above that of the whole load."""
    size, load = force.size, force.load
    if size <= load:
        return None
    return (
        f"the median magnitude of {size:.3g} N on one tile is {size / load:.2g} times the total"
        f" load of {load:.3g} N"
    )


def _higher_peaks_than_the_load(force: _LoadedChannel) -> str | None:
    """A force on one tile with peaks above `PEAK_RATIO` times those of the load.

    Not if its median says so already.
    """
    if force.size > force.load:
        return None
    peak, largest = _peak(force.values), force.largest_load
    if peak <= PEAK_RATIO * largest:
        return None
    return (
        f"its peaks of {peak:.3g} N on one tile are {peak / largest:.2g} times the largest load of"
        f" {largest:.3g} N"
    )


def _pulling_wall(force: _LoadedChannel) -> str | None:
    """A normal force in tension by more than `TENSION_SHARE` of the load and `MIN_TENSION`.

    In a tile's frame z points inwards: compression is along -z.
    """
    if not force.name.endswith(".Fz"):
        return None
    pull, limit = finite_quantile(force.values, 0.5), max(MIN_TENSION, TENSION_SHARE * force.load)
    if pull <= limit:
        return None
    return (
        f"the wall would pull at the limb with {pull:.3g} N in the median, more than {limit:.3g} N"
        f" under a load of {force.load:.3g} N"
    )


_RULES_OF_A_MOMENT = (_too_long_lever,)
_RULES_OF_A_LOCAL_FORCE = (_larger_than_the_load, _higher_peaks_than_the_load, _pulling_wall)


def _often_out_of_range(samples: Samples) -> Iterator[tuple[str, str]]:
    """Clusters saturated or out of range in `OUTSIDE_SHARE` of their readings, each with why."""
    for cluster, status in zip(samples.clusters, samples.status.T, strict=True):
        read = int((status != Status.MISSING).sum())
        outside = int(np.isin(status, (Status.SATURATED, Status.OUT_OF_RANGE)).sum())
        if outside > OUTSIDE_SHARE * read:
            yield (
                cluster,
                f"{outside} of {read} readings are saturated or out of the calibrated range",
            )


def _usual_sizes(values: FloatArray) -> FloatArray:
    """The `UNIT_QUANTILE` of the magnitudes of each channel, (C,) of (N, C)."""
    return np.array([finite_quantile(np.abs(column), UNIT_QUANTILE) for column in values.T])


def _peak(values: FloatArray) -> float:
    """The `PEAK_QUANTILE` of the magnitudes, rounded down to one of them; 0 without a value."""
    finite = np.abs(values[np.isfinite(values)])
    return float(np.quantile(finite, PEAK_QUANTILE, method="lower")) if len(finite) else 0.0


def require_position(samples: Samples, geometry: SocketGeometry) -> None:
    """Refuse limb positions in another unit or frame.

    Args:
        samples: Samples, of which the poses matter; without any pose nothing is refused.
        geometry: The socket, whose farthest tile limits the positions.

    Raises:
        IdentificationError: If the limb is too far from the load cell, or moves too far.
    """
    position = samples.position[samples.has_pose]
    if not len(position):
        return
    centre, reach = np.median(position, axis=0), _reach(geometry)
    distance = float(np.linalg.norm(centre))
    spread = finite_quantile(np.linalg.norm(position - centre, axis=1), UNIT_QUANTILE)
    excess = max(distance / MAX_DISTANCE, spread) / reach
    if excess > 1.0:
        likely = "it is likely in millimetres: divide it by 1000, or " if excess <= 1e3 else ""
        raise IdentificationError(
            f"the limb position is {distance:.3g} m from the load cell and moves by {spread:.3g} m,"
            f" where the farthest tile is {reach:.3g} m away",
            f"{likely}check the marker bodies and their frames in socket.yaml",
        )


def require_units(
    samples: Samples, geometry: SocketGeometry, leave_out: tuple[str, ...] = ()
) -> None:
    """Refuse samples, the limb positions first, in another unit or frame.

    Args:
        samples: N samples.
        geometry: The socket, whose tiles limit the forces and the limb's position.
        leave_out: Names of channels that may exceed their limits, such as `distal.Fx`.

    Raises:
        IdentificationError: If the limb position is implausible (`require_position`), or a quarter
            of the values of a channel exceed what a person can apply.
    """
    require_position(samples, geometry)
    for _, error in wrong_units(samples, geometry, leave_out):
        raise error


def wrong_units(
    samples: Samples, geometry: SocketGeometry, leave_out: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], IdentificationError]]:
    """Sources whose values are in another unit: the moments, the forces, and each cluster.

    Args:
        samples: N samples.
        geometry: The socket, whose tiles limit the forces.
        leave_out: Names of channels that may exceed their limits, such as `distal.Fx`.

    Yields:
        The channels of a source, all of which have its unit, and the error about the first one that
        exceeds its limit.
    """
    sizes = _usual_sizes(_counted(samples, leave_out))
    limits = channel_limits(geometry, samples.clusters)
    for first in range(0, len(samples.channels), 3):
        own = samples.channels[first : first + 3]
        places = slice(first, first + 3)
        for name, size, limit in zip(own, sizes[places], limits[places], strict=True):
            if size > limit:
                unit = channel_unit(name)
                likely = {"N": "millinewtons", "N m": "newton millimetres"}[unit]
                yield (
                    own,
                    IdentificationError(
                        f"{name} reaches {size:.3g} {unit} in a quarter of the samples, but no"
                        f" person applies more than {limit:.3g} {unit}",
                        f"it is likely in {likely}: divide it by 1000 (or leave it out with"
                        f" --leave-out {name})",
                    ),
                )
                break


def require_load(samples: Samples, wrench_counts: BoolArray) -> None:
    """Refuse a wrench within a load cell's noise, or without any force or moment.

    Args:
        samples: Samples of a fit, complete in the channels of the objective.
        wrench_counts: Channels [M; F] of the wrench in the objective, shape (6,); the others do not
            matter, and without any nothing is refused.

    Raises:
        IdentificationError: If the wrench holds no load.
    """
    if not wrench_counts.any():
        return
    sizes = np.where(wrench_counts, np.abs(samples.wrench).max(axis=0), 0.0)
    moment, force = (float(sizes[group].max()) for group in GROUPS)
    dead = [wrench_counts[group].any() and not sizes[group].any() for group in GROUPS]
    if any(dead) or (moment < MIN_MOMENT and force < MIN_FORCE):
        raise IdentificationError(
            f"the wrench never exceeds {force:.3g} N and {moment:.3g} N m in {len(samples)} samples"
            " and so holds no load",
            "check the load cell and that its values are in N and N m, give a loaded segment, or"
            " leave its channels out (--leave-out)",
        )


def _beyond_the_socket(position: FloatArray, geometry: SocketGeometry) -> BoolArray:
    """Single samples whose limb position is outside the socket, shape (N,).

    It is farther from the usual position than the farthest tile is from the load cell, or from the
    load cell than `MAX_DISTANCE` times that. If half of the samples are, it has another unit.
    """
    known = np.isfinite(position).all(axis=1)
    reach = _reach(geometry)
    centre = np.median(position[known], axis=0) if known.any() else np.full(3, np.nan)
    shift = np.linalg.norm(position - centre, axis=1)
    far = np.linalg.norm(position, axis=1) > MAX_DISTANCE * reach
    found = known & ((shift > reach) | far)
    single = 2 * found.sum() < known.sum()  # else the unit is wrong: see `require_position`
    return np.asarray(found & single)


def _reach(geometry: SocketGeometry) -> float:
    """Distance of the farthest tile from the load cell [m]."""
    return float(np.linalg.norm(geometry.anchors, axis=1).max())


def channel_limits(geometry: SocketGeometry, clusters: tuple[str, ...]) -> FloatArray:
    """Largest size of each channel that a person can apply, shape (6 + 3c,) [N m, N].

    Args:
        geometry: The socket; the area of a cluster's tile limits its forces.
        clusters: Names of the c clusters in the order of their channels. If one is not on the
            socket, there are no limits: all are infinite.
    """
    wrench = np.repeat([MAX_MOMENT, MAX_FORCE], 3)
    tiles = [geometry.clusters[name] for name in clusters if name in geometry.clusters]
    if len(tiles) < len(clusters):  # another socket's: reported elsewhere
        return np.full(6 + 3 * len(clusters), np.inf)
    areas = geometry.areas[np.array(tiles, dtype=np.int64)]
    return np.concatenate([wrench, np.repeat(MAX_STRESS * areas, 3)])


def _counted(samples: Samples, leave_out: tuple[str, ...]) -> FloatArray:
    """Values of the channels not in `leave_out`, NaN elsewhere, shape (N, 6 + 3c) [N m, N]."""
    values = samples.trusted_values
    return np.where(samples.counted(leave_out) & np.isfinite(values), values, np.nan)
