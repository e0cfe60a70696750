"""Whether a trial's data is good, or what to look at: each source judged by itself and the others.

A limb that is loaded presses the wall: over a trial every cluster's normal force follows the force
along the socket, and the limb's pose does. So a reversed sign, a late or a dead source and a wrong
unit show without a model. Where all of that is good, each cluster is compared with what the force
map makes of the others and the wrench. The thresholds keep a margin to sound simulated trials of 30
to 120 s (four scenarios, soft and stiff, 4 and 25 Hz, also with the errors of the published
experiment). No single trial shows a gain or an offset that the wrench allows, a turned load cell,
or two clusters exchanged that are loaded alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray, usual_period
from socket_testbed.errors import IdentificationError
from socket_testbed.geometry.axis import proximal_direction
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.noise import channel_noise
from socket_testbed.identification.plausibility import (
    find_implausible,
    find_outliers,
    finite_quantile,
    outlier_notes,
    require_position,
    require_units,
    sign_note,
)
from socket_testbed.identification.pressure import NORMAL_QUANTILE
from socket_testbed.identification.validation import (
    left_out_pressures,
    loaded_rows,
    measurement_errors,
    thinned,
)
from socket_testbed.samples import GRAVITY, WRENCH_CHANNELS, Samples, Status, channel_unit
from socket_testbed.settings.identification import ForceMapSettings

GOOD, LOOK = "data: good", "data: look at "
LEAST_SAMPLES = 30
LEAST_CHANGE = 15.0  # [N]; standard deviation of the load, to judge what follows it
OPPOSITE = -0.2  # correlation with the load from which a sign is reversed; sound 0 and more [-]
UNRELATED = 0.2  # correlation below which a source does not follow, [-]
QUIET = 4.0  # change of a cluster over its noise, from which it has something to follow [-]
EXPLAINED = 0.4  # of its variance by wrench and pose at least; sound 0.48 and more [-]
LATEST = 3.5  # lag of one source to another, sound 2.8 at most (stiff tissue creeps) [s]
CLEARER = 0.03  # correlation that a lag gains, at least [-]
LONGEST_LAG = 10.0  # [s]
LAG_STEP = 0.04  # [s]; at least
MISSING = 0.05  # share of the samples that a source lacks, sound 0 [-]
DISAGREEMENT = 3.5  # innovation of a cluster over its deviation, sound 3.3 at most [-]
_JUDGED = 60  # samples under load, on which a cluster is compared with the others
STILL = 2.0  # time that a value never changes, sound two samples [s]
CLIPPED = 0.05  # share of the samples at one end of a channel's range, sound 0.002 [-]
NOISE = {"N": 20.0, "N m": 3.0}  # sound 0.3 N, like the published experiment 11 N; by unit
# Change of all clusters' forces over that of the load, sound 0.03 to 0.15 [-].
STRESS_SHARE = (0.001, 3.0)
WEIGHTS = (0.02, 5.0)  # size of the load in weights of a stated mass [-]
SINKING = 0.5  # cosine of the limb's motion under load to the axis; sound 0.996 and more [-]
ROTATION = 0.7  # of the limb from its mean attitude, sound 0.04 [rad]


@dataclass(frozen=True)
class DataFinding:
    """Something about a trial's data that should be looked at."""

    source: str  # what: the wrench, the limb pose, a cluster or a channel
    fact: str  # what is wrong with it
    hint: str  # what to check

    def __str__(self) -> str:
        return f"{LOOK}{self.source}: {self.fact}; {self.hint}"


def check_data(
    samples: Samples,
    geometry: SocketGeometry,
    mass: float | None = None,
    leave_out: tuple[str, ...] = (),
    whole: bool = True,
) -> tuple[DataFinding, ...]:
    """What to look at in the data of a trial, the worst first; empty if it is good.

    The mass is that of the person [kg], if it is stated. Channels that are left out are not looked
    at one by one. In a window instead of a `whole` trial the limb may just be pushed: no course is
    compared with another.
    """
    if len(samples) < LEAST_SAMPLES:
        fact = f"{len(samples)} samples are too few to judge it by"
        return (DataFinding("the trial", fact, f"record {LEAST_SAMPLES} or more"),)
    found = [*_sizes(samples, geometry, mass)]
    if whole:
        found += [*_courses(samples, geometry)] or [*_disagreements(samples, geometry)]
    found += [finding for finding in _channels(samples) if finding.source not in leave_out]
    spikes = outlier_notes(samples, find_outliers(samples, geometry, leave_out))
    found += [DataFinding("single values", note, "check cables and connectors") for note in spikes]
    return tuple(found)


def _sizes(samples: Samples, geometry: SocketGeometry, mass: float | None) -> Iterator[DataFinding]:
    """Units and frames."""
    for require in (require_position, require_units):
        try:
            require(samples, geometry)
        except IdentificationError as error:
            yield DataFinding("the units", error.fact, error.hint)
            return
    for found in find_implausible(samples, geometry):
        if found.channel in WRENCH_CHANNELS:
            hint = "check that moments are in N m and forces in N, and the load cell's channels"
            yield DataFinding("the wrench", f"{found.channel}: {found.reason}", hint)
            break
    size = finite_quantile(_norm(samples.wrench[:, 3:]), 0.95)
    weights = size / (GRAVITY * mass) if mass else 1.0
    if not WEIGHTS[0] <= weights <= WEIGHTS[1]:
        yield DataFinding(
            "the wrench",
            f"its force of {size:.3g} N is {weights:.2g} weights of the stated {mass:g} kg",
            "check that forces are in N, and the mass",
        )
    rotation = _known(samples.rotation)
    angle = finite_quantile(_norm(rotation - rotation.mean(axis=0)), 0.95)
    if angle > ROTATION:
        yield DataFinding(
            "the limb pose",
            f"the limb turns by {np.degrees(angle):.0f} deg in the socket",
            "check the order of the quaternion (x, y, z, w), and the marker bodies",
        )


def _courses(samples: Samples, geometry: SocketGeometry) -> Iterator[DataFinding]:
    """Signs, lags, and what follows the load and what does not."""
    proximal = proximal_direction(geometry)
    load = -samples.wrench[:, 3:] @ proximal
    pressing = -samples.trusted_forces[:, :, 2]
    period = usual_period(samples.time)
    together = np.nansum(pressing, axis=1)
    if not np.isfinite(load).any():
        return
    changes = [float(np.nanstd(course)) for course in (together, load)]
    if changes[0] > max(STRESS_SHARE[1] * changes[1], LEAST_CHANGE / 5):
        yield DataFinding(
            "the wrench",
            f"its force along the socket changes by {changes[1]:.2g} N while those of the clusters"
            f" change by {changes[0]:.2g} N",
            "check that forces are in N and stresses in Pa, the load cell's channels, and the"
            " calibration",
        )
        return
    if not changes[1] > LEAST_CHANGE:
        return
    note = sign_note(samples, geometry)
    follows = [_correlation(column, load) for column in pressing.T]
    opposite = sum(value < OPPOSITE for value in follows)
    if note or (opposite > 1 and 2 * opposite > len(follows)):
        fact = "the clusters are pressed less the more the load cell is"
        yield DataFinding("the wrench", note or fact, "check the sign of the load cell's channels")
        return
    if 0.0 < changes[0] < STRESS_SHARE[0] * changes[1]:
        yield DataFinding(
            "the clusters",
            f"their forces change by {changes[0]:.2g} N while the load does by {changes[1]:.2g} N",
            "check that stresses are in Pa and forces in N, and the calibration",
        )
    down = -samples.position @ proximal
    for name, course in (("the clusters", together), ("the limb pose", down)):
        lag = _lag(load, course, period)
        if abs(lag) > max(LATEST, 2.5 * period):
            how = f"{'late' if lag > 0.0 else 'early'} by {abs(lag):.1f} s against the load cell"
            yield DataFinding(name, how, "check the clocks and the delays of the sources")
            return
    noises = channel_noise(samples).local_forces[:, 2]
    posed = np.isfinite(samples.pose).any()
    causes = np.hstack([samples.wrench, samples.pose]) if posed else samples.wrench
    for name, value, column, noise in zip(
        samples.clusters, follows, pressing.T, noises, strict=True
    ):
        if value < OPPOSITE:
            yield DataFinding(
                name,
                f"it is pressed less the more the limb is loaded (correlation {value:.2f})",
                "check the sign of its normal channel, or whether clusters are exchanged",
            )
        elif (
            value < UNRELATED
            and _explained(column, causes) < EXPLAINED
            and np.nanstd(column) > QUIET * noise  # or it is hardly loaded
        ):
            yield DataFinding(
                name,
                f"it does not follow the load (correlation {value:.2f})",
                "check its place, its cable and its calibration",
            )
    along = _along(samples.position, load, proximal)
    if along < SINKING:
        yield DataFinding(
            "the limb pose",
            "the limb does not sink as it is loaded: it moves at"
            f" {np.degrees(np.arccos(along)):.0f} deg to the socket's axis",
            "check the axes and the registration of the marker bodies",
        )


def _disagreements(samples: Samples, geometry: SocketGeometry) -> Iterator[DataFinding]:
    """The cluster, if any, that reads what the others and the wrench do not expect."""
    rows = thinned(loaded_rows(samples, LEAST_CHANGE), _JUDGED)
    if not len(rows):
        return
    noise = measurement_errors(samples, channel_noise(samples).local_forces, ForceMapSettings())
    worst = (DISAGREEMENT, "", "")
    compared = left_out_pressures(samples[rows], geometry)
    for error, (name, measured, expected, deviation) in zip(noise, compared, strict=True):
        if np.isfinite(measured).any():
            own = np.nan_to_num(error[2]) / geometry.areas[geometry.clusters[name]]
            scale = np.hypot(deviation, own)
            off = abs(float(np.nanmean((measured - expected) / scale)))
            means = (np.nanmean(of) for of in (measured, expected, NORMAL_QUANTILE * scale))
            value, middle, reach = (1e-3 * float(mean) for mean in means)
            words = f"{value:.0f} kPa where the others and the wrench say {middle - reach:.0f} to"
            worst = max(worst, (off, name, f"it reads {words} {middle + reach:.0f} kPa"))
    _, name, fact = worst
    if name:
        hint = "check its calibration and its place, and whether clusters are exchanged"
        yield DataFinding(name, fact, hint)


def _channels(samples: Samples) -> Iterator[DataFinding]:
    """Sources and channels that are missing, stand still, are clipped or noisy."""
    period = usual_period(samples.time)
    sources = {
        "the wrench": np.isfinite(samples.wrench).all(axis=1),
        "the limb pose": np.isfinite(samples.pose).all(axis=1),
        **{name: samples.status[:, k] == Status.OK for k, name in enumerate(samples.clusters)},
    }
    for name, present in sources.items():
        lacking = float(np.mean(~present))
        if lacking > MISSING:
            yield DataFinding(
                name,
                f"{100.0 * lacking:.0f} % of its samples are missing or out of range",
                "see 'info' for the gaps, and 'doctor' for the wiring",
            )
    # A pose that is averaged or extrapolated still moves in its last digits.
    if period * max(map(_longest_run, _known(samples.pose).T)) > max(STILL, 4.0 * period):
        yield DataFinding(
            "the limb pose", "it stands still", "check the cameras and the bodies' names"
        )
    values = samples.trusted_values
    noises = channel_noise(samples).values.tolist()
    for name, column, noise in zip(samples.channels, values.T, noises, strict=True):
        known = column[np.isfinite(column)]
        if len(known) < LEAST_SAMPLES:
            continue
        still = period * _longest_run(known)
        at_end = max(np.mean(known == known.max()), np.mean(known == known.min()))
        unit = channel_unit(name)
        if still > max(STILL, 4.0 * period):
            fact, hint = f"it does not change for {still:.1f} s", "check the sensor and its driver"
        elif at_end > CLIPPED:
            fact = f"{100.0 * at_end:.0f} % of its values are at one end, {known.max():.3g} {unit}"
            hint = "check the sensor's range: it is clipped"
        elif noise > NOISE[unit]:
            fact = f"its noise is {noise:.3g} {unit}"
            hint = "check shields, connectors and the supply"
        else:
            continue
        yield DataFinding(name, fact, hint)


def _known(vectors: FloatArray) -> FloatArray:
    """The vectors without a missing component; a missing one if there is none."""
    known = vectors[np.isfinite(vectors).all(axis=1)]
    return known if len(known) else vectors[:1]


def _norm(vectors: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(vectors, axis=1))


def _correlation(one: FloatArray, other: FloatArray) -> float:
    """Correlation of two courses where both are known; 0 where one does not change."""
    known = np.isfinite(one) & np.isfinite(other)
    if known.sum() < LEAST_SAMPLES:
        return 1.0  # too little to say anything
    a, b = one[known] - one[known].mean(), other[known] - other[known].mean()
    size = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / size) if size > 0.0 else 0.0


def _along(position: FloatArray, load: FloatArray, proximal: FloatArray) -> float:
    """Cosine of the angle between the limb's motion under load and the distal direction [-]."""
    known = np.isfinite(position).all(axis=1) & np.isfinite(load)
    if known.sum() < LEAST_SAMPLES:
        return 1.0
    moved = (load[known] - load[known].mean()) @ (position[known] - position[known].mean(axis=0))
    return float(-moved @ proximal / max(np.linalg.norm(moved), 1e-12))


def _explained(course: FloatArray, by: FloatArray) -> float:
    """Share of the variance of a course (N,) that is linear in others (N, k) [-]."""
    known = np.isfinite(course) & np.isfinite(by).all(axis=1)
    if known.sum() < LEAST_SAMPLES or not np.ptp(course[known]) > 0.0:
        return 0.0
    columns = np.column_stack([by[known], np.ones(int(known.sum()))])
    spread = np.maximum(columns.std(axis=0), 1e-12)
    spread[-1] = 1.0
    fit = np.linalg.lstsq(columns / spread, course[known], rcond=None)[0]
    left = course[known] - columns / spread @ fit
    return float(1.0 - left.var() / course[known].var())


def _lag(reference: FloatArray, course: FloatArray, period: float) -> float:
    """Time by which a course follows another, 0 unless a lag is clearly better [s]."""
    step = max(1, round(LAG_STEP / period))
    reference, course, period = reference[::step], course[::step], step * period
    most = min(round(LONGEST_LAG / period), len(course) // 3)
    found = {
        lag: _correlation(course[max(lag, 0) : len(course) + min(lag, 0)],
                          reference[max(-lag, 0) : len(course) - max(lag, 0)])
        for lag in range(-most, most + 1)
    }  # fmt: skip
    best = max(found, key=lambda lag: (found[lag], -abs(lag)))
    clear = found[best] > max(found[0] + CLEARER, 0.5)
    return best * period if clear else 0.0


def _longest_run(values: FloatArray) -> int:
    ends = np.flatnonzero(np.append(np.diff(values) != 0.0, True))
    return int(np.diff(np.append(-1, ends)).max())
