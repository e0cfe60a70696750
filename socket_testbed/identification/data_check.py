"""Is a trial's data good, and if not, which source needs a look? No model is needed.

Units are judged first: a source in another unit is named, and what else it seems to show is its
unit's doing. Then come the defects that the readings show (`trials.raw_check`), and the courses:

- A loaded limb presses the wall: over a trial every cluster's normal force and the limb's pose
  follow the force along the socket. This reveals a reversed sign, a late or dead source.
- Beside the load, the limb turns as its moments say and presses the wall towards which it moves
  (`limb_motion`). This reveals wrong axes, negated moments, exchanged clusters and short delays.
- Horizontal forces have the moments of a height above or below the load cell. This reveals mirrored
  forces, and moments in another unit.
- If all of that is good, sources that drift are named, or else the cluster that contradicts the
  force map of the others and the wrench.
- Each source alone: missing, frozen, clipped, noisy; single values and steps that no other source
  feels, poses that jump.

The thresholds leave a margin to 200 sound simulated trials of 20 to 300 s (four scenarios, soft and
stiff, 0.5 to 100 Hz). What a single trial cannot reveal stands in `docs/faults.md`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, compress, groupby

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, evenly, finite_quantile, gaps, usual_period
from socket_testbed.errors import IdentificationError
from socket_testbed.geometry.regions import axial_force, proximal_direction
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification import plausibility
from socket_testbed.identification.force_map import (
    NORMAL_QUANTILE,
    ForceMap,
    left_out_pressures,
)
from socket_testbed.identification.limb_motion import (
    AXES,
    NEGATED,
    OPPOSITE,
    LimbMotion,
    height_of_forces,
    limb_motion,
    mirrored_forces,
    misfit_of,
)
from socket_testbed.identification.noise import (
    ChannelNoise,
    channel_noise,
    deviations,
    measurement_errors,
)
from socket_testbed.samples import (
    GRAVITY,
    GROUPS,
    LOCAL_CHANNELS,
    MOMENTS,
    WRENCH_CHANNELS,
    Samples,
    Status,
    channel_unit,
    force_magnitude,
    local_channels,
)
from socket_testbed.settings.identification import ForceMapSettings

GOOD, CHECK = "data: good", "data: check "
LEAST_CHECKED = 30
MIN_LOAD_CHANGE = 15.0  # [N]; standard deviation of the load, to compare other sources with it
MIN_LOAD = 15.0  # [N]; to compare the clusters with each other
REVERSED = -0.2  # [-]; correlation with the load below which a sign is reversed; sound >= 0
MIN_CORRELATION = 0.2  # [-]; correlation with the load below which a source does not follow it
MIN_SIGNAL = 4.0  # [-]; standard deviation of a cluster over its noise, to compare it with the load
MIN_EXPLAINED = 0.4  # [-]; share of its variance explained by wrench and pose; sound >= 0.48
MAX_LAG = 3.5  # [s]; lag between sources; sound <= 2.8 (stiff tissue creeps)
MIN_LAG_GAIN = 0.03  # [-]; gain in correlation for a lag to count
MIN_LAG_FIT = 0.5  # [-]; correlation with the lag
MAX_POSE_LAG = 0.3  # [s]; of the pose behind the moments; sound <= 0.12
MIN_POSE_FIT = 0.8  # [-]; their correlation with that lag
MAX_CLUSTER_LAG = 0.6  # [s]; of a cluster behind load and indentation
MIN_DELAY_TIME, MIN_DELAY_SAMPLES = 30.0, 100  # [s], [1]; of a trial, to search it for delays
# [-]; of a cluster, and of a pose without pushes: share of the variance explained with that delay,
# and the fall of log(1 - share) / 2 by it; sound gains up to 0.36 and 0.18 of delays beyond 0.35 s
MIN_CLUSTER_DELAY = (0.8, 0.5)
MIN_POSE_DELAY = (0.6, 0.3)
SEARCHED_LAG = 10.0  # [s]
SEARCHED_SHARE = 0.2  # [-]; of a trial, at most
DELAY_STEP = 0.1  # [s]; at least
LAG_STEP = 0.04  # [s]; at least
MAX_MISSING = 0.05  # [-]; share of a source's samples; sound 0
# [-]; innovation of a cluster over its deviation; pressure is skewed: sound -1.4 to 2.8
INNOVATIONS = (-1.9, 3.5)
LOCAL_VARIATION = 4e3  # [Pa]; of pressure under a single tile, beyond what the map's prior knows
_USUAL_DEPARTURE = 0.97  # quantile of a channel's departures that are usual
_COMPARED_SAMPLES = 60  # samples under load on which a cluster is compared with the others
MAX_STILL = 2.0  # [s]; time without any change; sound two samples
STILL, CAPACITY = "not change for", "of its full scale"  # words of findings
WRITE_QUATERNIONS = "give quaternions as"  # start of the hint of a finding
MAX_CLIPPED = 0.05  # [-]; share of the samples at one end of a channel's range; sound 0.002
MAX_NOISE = {"N": 20.0, "N m": 3.0}  # by unit; sound 0.3 N, with the published errors 11 N
MAX_POSE_NOISE = (2e-3, 0.03)  # [m, rad]; sound 0.04 mm and 0.0008 rad
NOISIER = (8.0, 1.5)  # [-, N]; of a cluster than the others, and at least; sound 2.8, 0.3 N
# [-]; standard deviation of the clusters' total force over that of the load; the upper limit is
# relative to the clusters' share of the socket's area; sound 0.03 to 0.18, that is up to 3.4
LOCAL_SHARE = (0.001, 10.0)
MAX_BORNE = 20.0  # [-]; usual force on all clusters over the usual load; sound 0.05 to 0.3
MAX_HEIGHT = 2.0  # [m]; moment over horizontal force beside the load; sound 0.52
MIN_HEIGHT_FIT = 0.8  # [-]; of their correlation, to judge it
AREA_RATIO = (0.1, 10.0)  # [-]; squared distance of neighbouring tiles over their area; 1.5
MAX_PULL = 100.0  # [N]; of a socket towards its proximal end; sound none
PULL_QUANTILE = 0.05  # of the load, to judge that pull
MIN_DRIFT_TIME = 50.0  # [s]; of a trial, to judge drifts
MAX_DRIFT = 12e3  # [Pa]; of a cluster beside wrench and pose; sound 6 kPa
MAX_POSE_DRIFT = 2e-3  # [m]; of the limb across the socket beside the wrench; sound 0.3 mm
MIN_LEVER = 3e-4  # [m]; usual moment over usual load; sound 0.0076 and more
MIN_AXES_GAIN = 0.25  # [-]; in correlation of rotation and moment by other axes; sound below 0
MIN_CLEAR_GAIN = 0.1  # [-]; the same where other axes agree as well as while hands push
MIN_POSE_GAIN = 0.3  # [-]; in the clusters' fit to the pose, to say that its axes are wrong
MIN_AGREEMENT = 0.94  # [-]; of rotation and moment while hands push from all sides
MIN_PUSH = 0.5  # [N m]; standard deviation of a moment beside the load; of sway up to 0.2
MIN_MIRRORED_FIT = 0.6  # [-]; correlation of moments and forces in mirrored axes; sound <= 0.5
MIN_MIRRORED_GAIN = 0.3  # [-]; over that of the forces as they are; sound <= -0.05
# [-]; in the fit of two clusters by exchanging them, while pushed and otherwise; sound <= 0.63
MIN_EXCHANGE_GAIN = (0.4, 1.0)
MIN_SPIKE = 8.0  # [-]; of a single value from both neighbours, over the usual ones and the noise
FELT_SPIKE = 4.0  # [-]; of another source at the same sample, which then felt it as well
SPIKE_SHARE = 0.05  # [-]; of a wrench's spike in the usual size of its group; sound 0.026
POSE_SPIKES = (3e-4, 5e-3)  # [m, rad]; sound 0.05 mm and nothing
LEAST_SPIKES = 2
CLEAR_SPIKE = 2.5  # [-]; of a spike over these limits, if there is only one; sound ratio 15
MIN_STEP_RATIO = 8.0  # [-]; of a step over the usual ones and the noise; sound, if so large, 6.6
STEP_SHARE = 0.1  # [-]; of a wrench's step in the usual size of its group
POSE_STEPS = (1.5e-3, 0.01)  # [m, rad]; sound 0.3 mm
MIN_STEP = 2.0  # [N]; of the force on a cluster
_STEP_ALONE = 0.5  # [-]; of the steps before and after, in that between them
_KINK_NOISE = np.sqrt(5.0)  # [-]; root sum of squares of the weights of `_kinks`
POSE_JUMPS = (0.02, 0.15)  # [m, rad]; from one sample to the next
LOAD_RANGE = (0.12, 5.0)  # [-]; load over the weight of a stated mass; 0.10 for kgf when standing
MIN_SINKING = 0.5  # [-]; cosine between the limb's motion under load and the axis; sound >= 0.996
MAX_ROTATION = 0.7  # [rad]; of the limb from its mean attitude; sound 0.04


@dataclass(frozen=True)
class DataFinding:
    """A defect of a trial's data.

    Attributes:
        source: Where to look, such as `the wrench`, `the limb pose`, the name of a cluster or of
            a channel.
        fact: The defect in words, with its numbers and their units.
        hint: What to check.
    """

    source: str
    fact: str
    hint: str

    def __str__(self) -> str:
        return f"{CHECK}{self.source}: {self.fact}; {self.hint}"


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
    if whole:
        in_doubt = LOAD in unclear
        posed = _without_faulty_pose(counted, raw)
        found_over_time = [*_time_series(posed, geometry, noise, in_doubt)]
        found += found_over_time
        if not found_over_time and not in_doubt:
            found += [*_drifts(posed, geometry)] or [
                *_disagreements(counted, geometry, noise, prior_map)
            ]
    stopped = {each.source for each in raw if STILL in each.fact}
    found += [
        each
        for each in _channels(samples, noise, leave_out)
        if STILL not in each.fact or each.source.rpartition(".")[0] not in stopped
    ]
    found += [*_jumps(counted), *_spikes(counted), *_steps(counted)]
    notes = plausibility.outlier_notes(samples, outliers)
    found += [DataFinding("single values", note, "check cables and connectors") for note in notes]
    return tuple(found)


def _without_faulty_pose(samples: Samples, raw: tuple[DataFinding, ...]) -> Samples:
    """The samples, without poses that jump, stand still or are turned: these judge nothing."""
    of_pose = [each for each in raw if each.source == "the limb pose"]
    faulty = any(STILL in each.fact or each.hint.startswith(WRITE_QUATERNIONS) for each in of_pose)
    if not faulty and not any(_jumps(samples)):
        return samples
    nothing = np.full_like(samples.position, np.nan)
    return replace(samples, position=nothing, rotation=nothing)


MOMENT_CHANNELS = tuple(WRENCH_CHANNELS[MOMENTS])
LOAD = "load"  # stands for the size of the load among names of channels
POSE = "pose"  # stands for the limb's pose among names of channels


def still_limit(period: float) -> float:
    """Time for which a source may stand still [s], from the usual time between samples [s]."""
    return max(MAX_STILL, 4.0 * period)


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


@dataclass(frozen=True)
class _Courses:
    """The courses of load, clusters and limb over a trial's N samples, in which rules find defects.

    The load is the force along the socket, positive under load. A cluster's force is its normal
    force, positive in compression.

    Attributes:
        samples: The samples, without outliers and left-out channels, with rotations since the mean
            attitude.
        geometry: The socket.
        noise: Noise of the samples.
        load_in_doubt: Whether the size of the load is reported already.
    """

    samples: Samples
    geometry: SocketGeometry
    noise: ChannelNoise
    load_in_doubt: bool = False

    @cached_property
    def load(self) -> FloatArray:
        """The load as measured, shape (N,) [N]; NaN where a force of the load cell is missing."""
        return axial_force(self.geometry, self.samples.wrench)

    @cached_property
    def pressing(self) -> FloatArray:
        """The force on each of the c clusters, shape (N, c) [N]; NaN unless its status is OK."""
        return np.asarray(-self.samples.trusted_forces[:, :, 2])

    @cached_property
    def together(self) -> FloatArray:
        """The force on all clusters, missing values interpolated, shape (N,) [N]."""
        total = np.zeros(len(self.samples))
        for column in self.pressing.T:
            total += _filled(column, self.samples.time)
        return total

    @cached_property
    def down(self) -> FloatArray:
        """The limb's position towards the distal end, shape (N,) [m]; NaN where it is missing."""
        return np.asarray(-self.samples.position @ self.proximal)

    @cached_property
    def proximal(self) -> FloatArray:
        """Unit vector along the socket towards its proximal end in {S}, shape (3,) [-]."""
        return proximal_direction(self.geometry)

    @cached_property
    def period(self) -> float:
        """Usual time between samples [s]."""
        return usual_period(self.samples.time)

    @cached_property
    def load_change(self) -> float:
        """Standard deviation of the load [N]; 0 for an unknown load."""
        return float(np.nanstd(self.load)) if np.isfinite(self.load).any() else 0.0

    @cached_property
    def clusters_change(self) -> float:
        """Standard deviation of the force on all clusters [N]."""
        return float(np.nanstd(self.together))

    @cached_property
    def load_is_too_small(self) -> bool:
        """Whether the load changes far less than the force on the clusters."""
        tiles = [self.geometry.clusters[name] for name in self.samples.clusters]
        share = self.geometry.areas[tiles].sum() / self.geometry.areas.sum()
        limit = max(LOCAL_SHARE[1] * share * self.load_change, MIN_LOAD_CHANGE / 3)
        return bool(np.isfinite(self.load).any()) and self.clusters_change > limit

    @cached_property
    def bears_too_little(self) -> bool:
        """Whether the clusters bear many times what the load cell measures."""
        borne = finite_quantile(self.pressing.clip(0.0).sum(axis=1), 0.95)
        force = force_magnitude(self.samples.wrench)
        known = bool(np.isfinite(force).any())
        return known and borne > max(MAX_BORNE * finite_quantile(force, 0.95), MIN_LOAD)

    @cached_property
    def load_shows_others(self) -> bool:
        """Whether the load changes enough to judge others by it, and is not itself in doubt."""
        return self.load_change > MIN_LOAD_CHANGE and not self.load_is_too_small

    @cached_property
    def follows(self) -> FloatArray:
        """Correlation of each cluster with the load as measured, shape (c,) [-]."""
        return np.array([_correlation(column, self.load) for column in self.pressing.T])

    @cached_property
    def sign_note(self) -> str | None:
        """Why the wrench looks negated, in words; None if it does not."""
        note = plausibility.sign_note(self.samples, self.geometry)
        opposite = int((self.follows < REVERSED).sum()) if self.load_shows_others else 0
        if note is None and opposite > 1 and 2 * opposite > len(self.follows):
            return "the force on the clusters falls as the load rises"
        return note

    @cached_property
    def sense(self) -> float:
        """Factor that turns a negated load the right way: -1, otherwise 1 [-]."""
        return -1.0 if self.sign_note and np.nansum(self.follows) < 0.0 else 1.0

    @cached_property
    def lags(self) -> dict[str, float]:
        """Delays behind the load by source, of those that are too late or too early [s]."""
        if not self.load_shows_others:
            return {}
        reference = self.sense * self.load
        courses = {"the clusters": self.together, "the limb pose": self.down}
        found = {name: _lag(reference, course, self.period) for name, course in courses.items()}
        limit = max(MAX_LAG, 2.5 * self.period)
        return {name: lag for name, lag in found.items() if abs(lag) > limit}

    @cached_property
    def motion_lags(self) -> dict[str, float]:
        """Delays that the limb's motion beside the load shows, by source, as in `lags` [s].

        They are of the pose behind the moments, or else of single clusters behind load and pose.
        Tissue creeps under the load, hardly beside it, so that they may be short.
        """
        if self.pose_lag:
            return {"the limb pose": self.pose_lag}
        if self.motion is None or self.wrong_axes or self.exchanged or not self.is_long:
            return {}
        motion, period = self.motion, usual_period(self.motion.time)
        found = {}
        for column, name in enumerate(self.samples.clusters):
            causes = motion.causes[:, [0, 1, 2 + column]]
            delay = _delay(motion.measured[:, [column]], causes, period, MIN_CLUSTER_DELAY)
            if abs(delay) > max(MAX_CLUSTER_LAG, 2.5 * period):
                found[name] = delay
        if (
            len(found) == len(self.samples.clusters)
            and np.ptp([*found.values()]) <= MAX_CLUSTER_LAG
        ):
            return {"the clusters": float(np.median([*found.values()]))}
        return found

    @cached_property
    def pose_lag(self) -> float:
        """Delay of the limb's motion behind the wrench, beside the load; 0 if it is short [s].

        While hands push around the limb, a delay looks like turned axes: what fits better counts.
        """
        if self.motion is None or not self.is_regular:
            return 0.0
        motion, period = self.motion, usual_period(self.motion.time)
        moment, rotation = motion.moment[:, :2], motion.rotation[:, :2]
        if motion.agreement > 1.0 - MIN_LAG_GAIN:
            return 0.0  # no delay can fit clearly better
        lag, fit, at_once = _best_lag(moment, rotation, period)
        gain = max(0.0, motion.axes_of_moment()[1])
        clear = fit > max(at_once + max(gain, MIN_LAG_GAIN), MIN_POSE_FIT)
        if clear and abs(lag) > max(MAX_POSE_LAG, 1.5 * period):
            return lag
        return 0.0 if self.is_pushed else self._delay_of_pose

    @cached_property
    def _delay_of_pose(self) -> float:
        """Delay of the limb's horizontal motion behind the wrench; 0 if it is short [s]."""
        samples = self.samples
        known = samples.has_pose & np.isfinite(samples.wrench).all(axis=1)
        if not self.is_long:
            return 0.0
        causes = np.column_stack([samples.time, samples.wrench])[known]
        delay = _delay(samples.pose[known][:, [0, 1, 3, 4]], causes, self.period, MIN_POSE_DELAY)
        return delay if abs(delay) > max(MAX_CLUSTER_LAG, 2.5 * self.period) else 0.0

    @cached_property
    def is_long(self) -> bool:
        """Whether the motion is known long and regularly enough to search it for delays."""
        long_enough = float(self.samples.time[-1]) >= MIN_DELAY_TIME - self.period
        return self.is_regular and long_enough and len(self.samples) >= MIN_DELAY_SAMPLES

    @cached_property
    def are_simultaneous(self) -> bool:
        """Whether sources can be compared with the load sample by sample."""
        return self.load_shows_others and not self.lags

    @cached_property
    def motion(self) -> LimbMotion | None:
        """The limb's motion beside the load; None if it is not known, or not at the same times."""
        if self.sign_note or self.lags or self.sinking < MIN_SINKING:
            return None
        return limb_motion(self.samples, self.geometry)

    @cached_property
    def exchanged(self) -> tuple[int, ...]:
        """Columns of clusters, each of which fits the tile of the next; empty if all fit their own.

        A late cluster may fit another's tile, too: what fits better counts.
        """
        if self.motion is None or self.wrong_axes or self.pose_lag:
            return ()
        columns, gain = self.motion.exchanged()
        least = MIN_EXCHANGE_GAIN[0 if self.is_pushed else 1]
        return columns if gain > max(least, *map(self._gain_by_delay, columns)) else ()

    def _gain_by_delay(self, column: int) -> float:
        """How much better a cluster fits its tile with a delay: the fall of log(1 - r^2) / 2 [-].

        It is 0 where delays are not searched for.
        """
        if self.motion is None or not (self.is_pushed and self.is_regular):
            return 0.0
        tile, own = self.motion.indentation[:, column], self.motion.pressing[:, column]
        _, fit, at_once = _best_lag(tile, own, usual_period(self.motion.time))
        at_once_misfit, late_misfit = misfit_of(np.array([at_once, fit]))
        return float(at_once_misfit - late_misfit)

    @cached_property
    def is_pushed(self) -> bool:
        """Whether the limb is pushed around so much that its motion beside the load is clear."""
        if self.motion is None or self.motion.agreement < MIN_AGREEMENT:
            return False
        return float(self.motion.moment[:, :2].std(axis=0).max()) > MIN_PUSH

    @cached_property
    def is_regular(self) -> bool:
        """Whether the motion is known at nearly all samples, as a search for delays needs."""
        return self.motion is not None and len(self.motion.time) >= 0.9 * len(self.samples)

    @cached_property
    def wrong_axes(self) -> str:
        """The horizontal axes with which rotation and moment agree, in words; empty as they are."""
        if self.motion is None or self.pose_lag:
            return ""
        name, gain = self.motion.axes_of_moment()
        is_clear = self.motion.agreement + gain > MIN_AGREEMENT
        return name if gain > (MIN_CLEAR_GAIN if is_clear else MIN_AXES_GAIN) else ""

    @cached_property
    def sinking(self) -> float:
        """Cosine between the limb's motion under load and the axis; 1 if it is not known [-]."""
        if not self.are_simultaneous:
            return 1.0
        return _along(self.samples.position, self.sense * self.load, self.proximal)

    @cached_property
    def causes(self) -> FloatArray:
        """Wrench and pose, (N, 12), or without any pose the wrench, (N, 6) [N m, N, m, rad]."""
        samples = self.samples
        posed = samples.has_pose.any()
        return np.hstack([samples.wrench, samples.pose]) if posed else samples.wrench


def _small_load(courses: _Courses) -> Iterator[DataFinding]:
    """A wrench that changes far less than the forces on the clusters."""
    if courses.load_is_too_small and not courses.load_in_doubt:
        yield DataFinding(
            "the wrench",
            f"its force along the socket changes by {courses.load_change:.2g} N while those of the"
            f" clusters change by {courses.clusters_change:.2g} N",
            "check that forces are in N (kgf, kN?) and stresses in Pa, the load cell's channels,"
            " and the calibration",
        )


def _little_load(courses: _Courses) -> Iterator[DataFinding]:
    """A wrench of far less force than the clusters bear, though it may hardly change."""
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


def _negated_wrench(courses: _Courses) -> Iterator[DataFinding]:
    """A wrench that pulls at a pressed socket, or that falls as the clusters are pressed."""
    if courses.sign_note:
        hint = "check the sign of the load cell's channels"
        yield DataFinding("the wrench", courses.sign_note, hint)


def _pulling_wrench(courses: _Courses) -> Iterator[DataFinding]:
    """A wrench that pulls at the socket for a while, as one that was tared under load."""
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


def _small_clusters(courses: _Courses) -> Iterator[DataFinding]:
    """Clusters that are loaded, but far less than the load."""
    if not courses.load_shows_others:
        return
    if 0.0 < courses.clusters_change < LOCAL_SHARE[0] * courses.load_change:
        yield DataFinding(
            "the clusters",
            f"their forces change by {courses.clusters_change:.2g} N while the load does by"
            f" {courses.load_change:.2g} N",
            "check that stresses are in Pa and forces in N, and the calibration",
        )


def _late_sources(courses: _Courses) -> Iterator[DataFinding]:
    """Sources that follow the load too late or too early."""
    for name, lag in courses.lags.items():
        how = f"{'late' if lag > 0.0 else 'early'} by {abs(lag):.1f} s against the load cell"
        yield DataFinding(name, how, "check the clocks and the delays of the sources")
    for name, lag in courses.motion_lags.items():
        against = "the moments of the load cell" if name == "the limb pose" else "the limb's motion"
        how = f"{'late' if lag > 0.0 else 'early'} by {abs(lag):.1f} s against {against}"
        yield DataFinding(name, how, "check the clocks and the delays of the sources")


def _horizontal_axes(courses: _Courses) -> Iterator[DataFinding]:
    """Horizontal axes of the load cell or of the marker bodies that do not agree."""
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


def _unlikely_heights(courses: _Courses) -> Iterator[DataFinding]:
    """Horizontal forces whose moments would take a leg of several metres."""
    height, fit = height_of_forces(courses.samples)
    if fit > MIN_HEIGHT_FIT and height > MAX_HEIGHT:
        yield DataFinding(
            "the wrench",
            f"its horizontal forces have moments at a lever of {height:.2g} m",
            "check that moments are in N m (lbf in, N cm?) and forces in N (kgf?)",
        )


def _mirrored_forces(courses: _Courses) -> Iterator[DataFinding]:
    """Horizontal forces that have no height at which their moments are those of the wrench."""
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


def _exchanged_clusters(courses: _Courses) -> Iterator[DataFinding]:
    """Clusters, each of which follows the motion of the limb at another one's tile."""
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


def _reversed_clusters(courses: _Courses) -> Iterator[DataFinding]:
    """Clusters that are pressed less while the limb is loaded more."""
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


def _idle_clusters(courses: _Courses) -> Iterator[DataFinding]:
    """Clusters whose force follows neither the load nor any other motion or load of the limb."""
    if not courses.are_simultaneous:
        return
    follows = courses.sense * courses.follows
    noises = courses.noise.local_forces[:, 2]
    sources = zip(courses.samples.clusters, follows, courses.pressing.T, noises, strict=True)
    for column, (name, value, force, noise) in enumerate(sources):
        if (
            column not in courses.exchanged
            and REVERSED <= value < MIN_CORRELATION
            and _explained(force, courses.causes) < MIN_EXPLAINED
            and np.nanstd(force) > MIN_SIGNAL * noise  # else it is hardly loaded
        ):
            yield DataFinding(
                name,
                f"it does not follow the load (correlation {value:.2f})",
                "check its place, its cable and its calibration",
            )


def _motion_across(courses: _Courses) -> Iterator[DataFinding]:
    """A limb that does not sink along the socket as it is loaded."""
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
    _late_sources,
    _horizontal_axes,
    _unlikely_heights,
    _mirrored_forces,
    _exchanged_clusters,
    _reversed_clusters,
    _idle_clusters,
    _motion_across,
)


def _time_series(
    samples: Samples, geometry: SocketGeometry, noise: ChannelNoise, load_in_doubt: bool = False
) -> Iterator[DataFinding]:
    """Sizes, signs and lags, and whether each source follows the load."""
    courses = _Courses(samples, geometry, noise, load_in_doubt)
    return chain.from_iterable(rule(courses) for rule in _RULES_OF_COURSES)


def _drifts(samples: Samples, geometry: SocketGeometry) -> Iterator[DataFinding]:
    """Sources that change steadily over the trial, beside what wrench and pose explain."""
    time = samples.time
    if time[-1] < MIN_DRIFT_TIME:
        return
    stepped = {each.source for each in _steps(samples)}
    proximal = proximal_direction(geometry)
    across = samples.position - np.outer(samples.position @ proximal, proximal)
    drift = float(np.linalg.norm(_drift(across, samples.wrench, time)))
    if drift > MAX_POSE_DRIFT and "the limb pose" not in stepped:
        yield DataFinding(
            "the limb pose",
            f"it drifts by {1e3 * drift:.2g} mm across the socket over the trial, beside the load",
            "check that the marker bodies are tight, and the zero of the load cell's moments",
        )
        return
    causes = np.hstack([samples.wrench, samples.pose])
    for column, name in enumerate(samples.clusters):
        pressure = -samples.trusted_forces[:, [column], 2] / geometry.areas[geometry.clusters[name]]
        drift = float(_drift(pressure, causes, time)[0])
        if abs(drift) > MAX_DRIFT and name not in stepped:
            yield DataFinding(
                name,
                f"it drifts by {1e-3 * drift:.2g} kPa over the trial, beside load and pose",
                "take the drift off with --unloaded, and check the sensor",
            )


def _drift(courses: FloatArray, causes: FloatArray, time: FloatArray) -> FloatArray:
    """Change of courses (N, k) over their times (N,) beside what is linear in causes (N, m), (k,).

    It is 0 if too few samples are known. Times are in s.
    """
    known = np.isfinite(courses).all(axis=1) & np.isfinite(causes).all(axis=1)
    if known.sum() < LEAST_CHECKED:
        return np.zeros(courses.shape[1])
    scaled = causes[known] - causes[known].mean(axis=0)
    scaled /= np.maximum(scaled.std(axis=0), 1e-12)
    columns = np.column_stack([np.ones(len(scaled)), time[known] / time[-1], scaled])
    return np.asarray(np.linalg.lstsq(columns, courses[known], rcond=1e-8)[0][1])


def _disagreements(
    samples: Samples,
    geometry: SocketGeometry,
    noise: ChannelNoise,
    prior_map: Callable[[ForceMapSettings], ForceMap] | None = None,
) -> Iterator[DataFinding]:
    """The cluster, if any, that contradicts the others and the wrench most."""
    loaded = samples[samples.under_load(MIN_LOAD)]
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


def _channels(
    samples: Samples, noise: ChannelNoise, leave_out: tuple[str, ...]
) -> Iterator[DataFinding]:
    """Sources and channels that are missing, frozen, clipped or noisy."""
    period, counts = usual_period(samples.time), samples.counted(leave_out)
    measured = np.isfinite(samples.wrench[:, counts[:6]])
    names = compress(WRENCH_CHANNELS, counts)
    lacking = [name for name, column in zip(names, measured.T, strict=False) if not column.any()]
    sources = {
        lacking[0] if len(lacking) == 1 else "the wrench": measured.all(axis=1),
        "the limb pose": samples.has_pose,
    }
    for k, name in enumerate(samples.clusters):
        if counts[6 + 3 * k : 9 + 3 * k].any():
            sources[name] = samples.status[:, k] == Status.OK
    for name, present in sources.items():
        share = float(np.mean(~present))
        if share > MAX_MISSING:
            yield DataFinding(
                name,
                f"{100.0 * share:.0f} % of its samples are missing or out of range",
                "see 'info' for the gaps, and 'doctor' for the wiring",
            )
    steps = np.diff(samples.time)
    lost = float(np.maximum(steps[gaps(samples.time)] - period, 0.0).sum())
    if lost > MAX_MISSING * samples.time[-1]:
        share = 100.0 * lost / samples.time[-1]
        fact = f"{share:.0f} % of the time has no sample"
        yield DataFinding("the trigger", fact, "see 'info' for the gaps, and the trigger's rate")
    # An averaged or extrapolated pose still varies in its last digits.
    poses = samples.pose[samples.has_pose]
    limit = still_limit(period)
    if period * max(map(_longest_run, poses.T)) > limit:
        yield DataFinding(
            "the limb pose", "it stands still", "check the cameras and the bodies' names"
        )
    yield from _noisy_pose(noise)
    yield from _noisy_clusters(samples, noise, leave_out)
    values = samples.trusted_values
    noises = noise.values.tolist()
    for name, column, own_noise in zip(samples.channels, values.T, noises, strict=True):
        known = column[np.isfinite(column)]
        if len(known) < LEAST_CHECKED or name in leave_out:
            continue
        still = period * _longest_run(known)
        at_end, end = max((np.mean(known == end), end) for end in (known.min(), known.max()))
        unit = channel_unit(name)
        if still > limit:
            fact, hint = f"it does {STILL} {still:.1f} s", "check the sensor and its driver"
        elif at_end > MAX_CLIPPED:
            fact = f"{100.0 * at_end:.0f} % of its values are at one end, {end:.3g} {unit}"
            hint = "check the sensor's range: it is clipped"
        elif own_noise > MAX_NOISE[unit]:
            fact = f"its noise is {own_noise:.3g} {unit}"
            hint = "check shields, connectors and the supply"
        else:
            continue
        yield DataFinding(name, fact, hint)


def _noisy_pose(noise: ChannelNoise) -> Iterator[DataFinding]:
    """A pose with more noise than markers have."""
    position, rotation = np.nan_to_num(noise.pose).reshape(2, 3).max(axis=1)
    if position > MAX_POSE_NOISE[0] or rotation > MAX_POSE_NOISE[1]:
        yield DataFinding(
            "the limb pose",
            f"its noise is {1e3 * position:.2g} mm and {np.degrees(rotation):.2g} deg",
            "check the markers, the cameras' calibration, and reflections",
        )


def _noisy_clusters(
    samples: Samples, noise: ChannelNoise, leave_out: tuple[str, ...]
) -> Iterator[DataFinding]:
    """Clusters with far more noise than the others."""
    own = noise.local_forces[:, 2]
    for column, name in enumerate(samples.clusters):
        others = np.delete(own, column)
        others = others[np.isfinite(others)]
        if not len(others) or f"{name}.Fz" in leave_out:
            continue
        limit = max(NOISIER[0] * float(np.median(others)), NOISIER[1])
        if limit < own[column] <= MAX_NOISE["N"]:
            yield DataFinding(
                name,
                f"its noise is {own[column]:.2g} N, that of the others {np.median(others):.2g} N",
                "check its shield, its plug and its supply",
            )


def _changes(
    samples: Samples, found_by: Callable[[FloatArray, BoolArray], tuple[FloatArray, FloatArray]]
) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Sudden changes of single sources: what a limb does is felt by several of them.

    Args:
        samples: N samples without outliers and left-out channels.
        found_by: Returns sizes and ratios of changes, such as `_departures`.

    Yields:
        A source, the sizes of the changes in the units of its k channels, and the sizes over the
        usual ones [-], shape (N, k) each; the latter are 0 where another source changes as well.
    """
    values = {"the wrench": samples.wrench, "the limb pose": samples.pose}
    forces = samples.trusted_forces
    values |= {name: forces[:, column] for column, name in enumerate(samples.clusters)}
    regular = ~gaps(samples.stamps)
    found = {name: found_by(own, regular) for name, own in values.items()}
    sharp = {name: ratios.max(axis=1) for name, (_, ratios) in found.items()}
    for name, (sizes, ratios) in found.items():
        others = np.max([own for other, own in sharp.items() if other != name], axis=0)
        yield name, sizes, np.where((others < FELT_SPIKE)[:, None], ratios, 0.0)


def _least_change(
    samples: Samples, source: str, share: float, of_pose: tuple[float, float], force: float
) -> FloatArray:
    """Sizes of the channels of a source from which a change counts, shape (k,) [N m, N, m, rad].

    Args:
        samples: The samples, whose usual moment and force limit the changes of the wrench.
        source: The source.
        share: Of the usual moment and force [-].
        of_pose: Of the limb's position [m] and rotation [rad].
        force: Of the force on a cluster [N].
    """
    if source == "the limb pose":
        return np.repeat(of_pose, 3)
    if source != "the wrench":
        return np.full(3, force)
    moments_and_forces = (samples.wrench[:, group] for group in GROUPS)
    usual = [finite_quantile(np.linalg.norm(own, axis=1), 0.95) for own in moments_and_forces]
    return share * np.repeat(usual, 3)


def _spikes(samples: Samples) -> Iterator[DataFinding]:
    """Single values within the range that leave the course of their channel and come back."""
    for name, sizes, ratios in _changes(samples, _departures):
        least = _least_change(samples, name, SPIKE_SHARE, POSE_SPIKES, 0.0)
        single = (ratios > MIN_SPIKE) & (sizes > least)
        clear = (ratios > CLEAR_SPIKE * MIN_SPIKE) & (sizes > CLEAR_SPIKE * least)
        rows = np.flatnonzero(single.any(axis=1))
        if len(rows) < LEAST_SPIKES and not clear.any():
            continue
        row, column = np.unravel_index((single * ratios).argmax(), ratios.shape)
        size = _in_words(name, int(column), float(sizes[row, column]))
        number = "a single value jumps and comes back,"
        if len(rows) > 1:
            number = f"{len(rows)} single values jump and come back, such as"
        yield DataFinding(
            name,
            f"{number} {size} at {samples.time[row]:.2f} s, which no other source feels",
            "check cables, connectors and shields, or the markers",
        )


def _steps(samples: Samples) -> Iterator[DataFinding]:
    """Channels that step from one sample to the next and stay there, while no other source moves.

    Poses that jump far are found without a comparison, see `_jumps`.
    """
    jumps = any(_jumps(samples))
    for name, sizes, ratios in _changes(samples, _kinks):
        least = _least_change(samples, name, STEP_SHARE, POSE_STEPS, MIN_STEP)
        steps = np.where(sizes > least, ratios, 0.0)
        row, column = np.unravel_index(steps.argmax(), steps.shape)
        if steps[row, column] <= MIN_STEP_RATIO or (jumps and name == "the limb pose"):
            continue
        size = _in_words(name, int(column), float(sizes[row, column]))
        yield DataFinding(
            name,
            f"it steps: {size} at {samples.time[row]:.2f} s, which no other source feels",
            "check its cables, mounting and supply, and whether it was tared or moved",
        )


def _in_words(source: str, column: int, size: float) -> str:
    """A channel of a source with a size in its unit."""
    if source == "the limb pose":
        axis = "xyz"[column % 3]
        turns = f"the rotation about {axis} by {np.degrees(size):.2g} deg"
        return turns if column > 2 else f"{axis} by {1e3 * size:.2g} mm"
    names = WRENCH_CHANNELS if source == "the wrench" else LOCAL_CHANNELS
    return f"{names[column]} by {size:.3g} {channel_unit(names[column])}"


def _departures(values: FloatArray, regular: BoolArray) -> tuple[FloatArray, FloatArray]:
    """How far each value lies beyond both its neighbours, on one side of both.

    Args:
        values: Channels of one source, shape (N, k), in their units.
        regular: Which of the steps between samples are of the usual length, shape (N - 1,).

    Returns:
        The distances from the nearer neighbour in the channels' units, 0 between the neighbours or
        where one is missing, and the same relative to the usual ones or the noise [-], (N, k) each.
    """
    steps = np.where(regular[:, None], np.diff(values, axis=0), np.nan)
    into, out = steps[:-1], -steps[1:]
    sizes = np.zeros(values.shape)
    beyond = into * out > 0.0
    sizes[1:-1][beyond] = np.minimum(np.abs(into), np.abs(out))[beyond]
    usual = np.quantile(sizes, _USUAL_DEPARTURE, axis=0)
    noise = np.nan_to_num(deviations(values, regular))
    scale = np.maximum(usual, noise)
    return sizes, np.divide(sizes, scale, out=np.zeros(sizes.shape), where=scale > 0.0)


def _kinks(values: FloatArray, regular: BoolArray) -> tuple[FloatArray, FloatArray]:
    """How far each value steps from the one before, beyond the mean of the steps around it.

    Args:
        values: Channels of one source, shape (N, k), in their units.
        regular: Which of the steps between samples are of the usual length, shape (N - 1,).

    Returns:
        The sizes of the steps in the channels' units, 0 where a value nearby is missing or where
        the next or previous one is as large, and the same relative to the usual ones or the noise
        [-], (N, k) each.
    """
    steps = np.where(regular[:, None], np.diff(values, axis=0), np.nan)
    before, own, after = steps[:-2], steps[1:-1], steps[2:]
    beyond = np.abs(own - 0.5 * (before + after))
    alone = np.maximum(np.abs(before), np.abs(after)) < _STEP_ALONE * np.abs(own)
    sizes = np.zeros(values.shape)
    sizes[2:-1] = np.nan_to_num(beyond)
    usual = np.quantile(sizes, _USUAL_DEPARTURE, axis=0)
    sizes[2:-1][~alone] = 0.0
    noise = _KINK_NOISE * np.nan_to_num(deviations(values, regular))
    scale = np.maximum(usual, noise)
    return sizes, np.divide(sizes, scale, out=np.zeros(sizes.shape), where=scale > 0.0)


def _jumps(samples: Samples) -> Iterator[DataFinding]:
    """Poses that jump from one sample to the next and stay there."""
    known = samples.pose[samples.has_pose]
    time = samples.time[samples.has_pose]
    for which, part, limit in zip("qr", (known[:, :3], known[:, 3:]), POSE_JUMPS, strict=True):
        jumped = np.linalg.norm(np.diff(part, axis=0), axis=1)
        if len(jumped) and jumped.max() > limit:
            row = int((jumped > limit).argmax())  # the first one
            size = jumped[row]
            words = f"{1e3 * size:.3g} mm" if which == "q" else f"{np.degrees(size):.3g} deg"
            yield DataFinding(
                "the limb pose",
                f"it jumps by {words} at {time[row + 1]:.2f} s",
                "check whether markers are exchanged or hidden, and whether a body was moved",
            )
            return


def _filled(course: FloatArray, time: FloatArray) -> FloatArray:
    """A series of N values with the missing ones interpolated, (N,); zeros if all are missing.

    Times have the shape (N,) [s].
    """
    known = np.isfinite(course)
    return np.interp(time, time[known], course[known]) if known.any() else np.zeros(len(course))


def _correlation(one: FloatArray, other: FloatArray) -> float:
    """Correlation of two series (N,) where both are known [-]: 0 if one is constant.

    It is NaN if fewer than `LEAST_CHECKED` values are known in both.
    """
    known = np.isfinite(one) & np.isfinite(other)
    if known.sum() < LEAST_CHECKED:
        return float("nan")
    a, b = one[known] - one[known].mean(), other[known] - other[known].mean()
    size = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / size) if size > 0.0 else 0.0


def _along(position: FloatArray, load: FloatArray, proximal: FloatArray) -> float:
    """Cosine of the angle between the limb's motion under load and the distal direction [-].

    From positions (N, 3) [m], loads (N,) [N] and the proximal direction (3,); 1 if too few are
    known.
    """
    known = np.isfinite(position).all(axis=1) & np.isfinite(load)
    if known.sum() < LEAST_CHECKED:
        return 1.0
    moved = (load[known] - load[known].mean()) @ (position[known] - position[known].mean(axis=0))
    return float(-moved @ proximal / max(np.linalg.norm(moved), 1e-12))


def _explained(course: FloatArray, by: FloatArray) -> float:
    """Share of the variance of a series (N,) that is linear in others (N, k) [-]."""
    known = np.isfinite(course) & np.isfinite(by).all(axis=1)
    if known.sum() < LEAST_CHECKED or not np.ptp(course[known]) > 0.0:
        return 0.0
    scaled = by[known] / np.maximum(by[known].std(axis=0), 1e-12)
    columns = np.column_stack([scaled, np.ones(len(scaled))])
    left = course[known] - columns @ np.linalg.lstsq(columns, course[known], rcond=None)[0]
    return float(1.0 - left.var() / course[known].var())


def _lag(reference: FloatArray, course: FloatArray, period: float) -> float:
    """Delay of a series (N,) behind another [s]; 0 unless a lag is clearly better.

    One that moves against the other at once is reversed rather than late. The period is the time
    between values [s].
    """
    best, fit, at_once = _best_lag(reference, course, period)
    return best if fit > max(abs(at_once) + MIN_LAG_GAIN, MIN_LAG_FIT) else 0.0


def _best_lag(
    reference: FloatArray, course: FloatArray, period: float
) -> tuple[float, float, float]:
    """Delay of a series behind another with the highest correlation.

    Args:
        reference: The other series, shape (N,), or (N, k) of vectors with mean zero.
        course: The series, of the same shape.
        period: Time between the values [s].

    Returns:
        The delay [s], the correlation with it, and that without a delay [-]; zeros if unknown.
    """
    step = max(1, round(LAG_STEP / period))
    reference, course, period = reference[::step], course[::step], step * period
    limit = min(round(SEARCHED_LAG / period), len(course) // 3)
    found = {
        lag: _correlation(course[max(lag, 0) : len(course) + min(lag, 0)].ravel(),
                          reference[max(-lag, 0) : len(course) - max(lag, 0)].ravel())
        for lag in range(-limit, limit + 1)
    }  # fmt: skip
    found = {lag: value for lag, value in found.items() if np.isfinite(value)}
    if 0 not in found:
        return 0.0, 0.0, 0.0
    best = max(found, key=lambda lag: (found[lag], -abs(lag)))
    return best * period, found[best], found[0]


def _delay(
    courses: FloatArray, causes: FloatArray, period: float, least: tuple[float, float]
) -> float:
    """Delay with which courses are explained by causes far better than at once.

    Args:
        courses: The courses, shape (N, k); each counts by its variance.
        causes: What explains them linearly, shape (N, m), with the times.
        period: Time between the values [s].
        least: The least share of the variance that is explained with the delay, and the least fall
            of log(1 - share) / 2 by it [-].

    Returns:
        The delay [s], negative for courses that are early; 0 without a clear one.
    """
    step = max(1, round(DELAY_STEP / period))
    courses, causes, period = courses[::step], causes[::step], step * period
    limit = round(min(SEARCHED_LAG, SEARCHED_SHARE * len(courses) * period) / period)
    middle = slice(limit, len(courses) - limit)
    scaled = causes[middle] - causes[middle].mean(axis=0)
    scaled /= np.maximum(scaled.std(axis=0), 1e-12)
    basis, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
    basis = basis[:, sizes > 1e-6 * sizes.max()]
    courses = courses / np.maximum(courses.std(axis=0), 1e-12)

    def unexplained(lag: int) -> float:
        moved = courses[middle.start + lag : middle.stop + lag]
        moved = moved - moved.mean(axis=0)
        explained = ((basis.T @ moved) ** 2).sum() / max(float((moved**2).sum()), 1e-12)
        return max(1.0 - float(explained), 1e-6)

    left = {lag: unexplained(lag) for lag in range(-limit, limit + 1)}
    best = min(left, key=lambda lag: (left[lag], abs(lag)))
    gain = 0.5 * np.log(left[0] / left[best])
    return best * period if 1.0 - left[best] > least[0] and gain > least[1] else 0.0


def _longest_run(values: FloatArray) -> int:
    """Number of values in the longest run of equal ones, of a series (N,)."""
    ends = np.flatnonzero(np.append(np.diff(values) != 0.0, True))
    return int(np.diff(np.append(-1, ends)).max())
