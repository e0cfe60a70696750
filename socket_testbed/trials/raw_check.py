"""Defects that only a trial's measurements show, before calibration, map and fit hide them.

Three good inputs hide a dead one in the stress of their cluster, and the noise of one marker body
hides that the other one stands still. So every source is judged by what it measured: the inputs
of a cluster, the bridges of the load cell, and each marker body.

- A source that stands still for longer than two seconds and four samples has stopped.
- A source that repeats its previous reading has sent old values. Readings in coarse steps repeat by
  chance, and come back later: these do not count.
- A declared cluster without a message, and a load above the capacity of the load cell, are faults
  whatever else was measured.
- No two inputs read the same.
- A wrench is its bridges' ratios times the matrix, less the tare.
- The quaternions of a marker body turn as its markers do.
- What the nodes reported as an ERROR during the recording is told again.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, islice

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray, gaps, runs, usual_period
from socket_testbed.drivers import ERROR
from socket_testbed.drivers.load_cell import load_cell
from socket_testbed.drivers.load_cell.load_cell import Bridges
from socket_testbed.errors import ConfigurationError, TrialError, fact_and_hint
from socket_testbed.geometry.marker_bodies import fit_body
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.channel_check import MAX_MISSING, still_limit
from socket_testbed.identification.data_finding import LEAST_CHECKED, DataFinding
from socket_testbed.identification.noise import deviations
from socket_testbed.settings.acquisition import LoadCellSettings
from socket_testbed.trials.bag import BagReader, required_topics
from socket_testbed.trials.reprocess import wrench_mismatch
from socket_testbed.trials.synchronise import Measurements
from socket_testbed.wire import topics
from socket_testbed.wire.cdr import decode, stamp_of
from socket_testbed.wire.messages import Reader

MAX_MISMATCH = 0.002  # [-]; of a wrench from its ratios, relative to the full scale; sound 1e-6
MAX_SAME = 0.5  # [-]; share of its changes in which an input reads as another; sound 0.0
MAX_REPEATED = 0.1  # [-]; share of readings that repeat the one before; sound 0.0
NOISE_RATIO = 8.0  # [-]; of an input's noise to that of its cluster's others; sound up to 1.6
MIN_INPUT_NOISE = 0.01  # [pF]; sound 0.002
_MAX_RETURNS = 1.2  # [-]; runs of equal readings per distinct reading; coarse steps have more
_OTHERS = ("estimator_node", "calibration_node", "view_node", "replay_node")  # measure nothing
_OVERLOADED = 3  # samples beyond the capacity for an overload; fewer may be spikes
_LONGEST_REPETITION = 20  # repetitions in a row; more stand still


def check_readings(
    measured: Measurements, geometry: SocketGeometry, cell: LoadCellSettings
) -> tuple[DataFinding, ...]:
    """Defects that the measurements of a trial show, source by source.

    Args:
        measured: The measurements, N of them, with the bridges' ratios if they were recorded.
        geometry: The socket, which declares the clusters.
        cell: The settings of the load cell; without a full scale no overload is found.
    """
    found = [*_silent_clusters(measured, geometry), *_overload(measured, cell)]
    if len(measured.stamps) >= LEAST_CHECKED:
        found += [
            *_stopped_clusters(measured),
            *_noisy_inputs(measured),
            *_same_inputs(measured),
            *_stopped_bodies(measured),
        ]
        found += [*_stopped_bridges(measured), *_missing_bridges(measured)]
        found += _repetitions(measured)
    return tuple(found)


def check_wrench(measured: Measurements, cell: LoadCellSettings) -> Iterator[DataFinding]:
    """Recorded wrenches that are not those of the recorded ratios, by the trial's own settings.

    Args:
        measured: The measurements as recorded, N of them.
        cell: The settings of the load cell stored with the trial; without a matrix nothing is
            found.
    """
    if not cell.matrix or not len(measured.ratios):
        return
    try:
        bridges = Bridges(cell)
    except ConfigurationError:  # who needs the matrix reports it
        return
    off = wrench_mismatch(measured, bridges).max(axis=1)
    off = off[np.isfinite(off)]
    share = float(np.mean(off > MAX_MISMATCH)) if len(off) >= LEAST_CHECKED else 0.0
    if share > MAX_MISSING:
        yield DataFinding(
            "the load cell",
            f"{100.0 * share:.0f} % of the wrenches are not what its ratios and its matrix say, by"
            f" up to {100.0 * off.max():.2g} % of the full scale",
            "check the matrix, signs and inputs in the trial's testbed.yaml, and where the wrench"
            " comes from",
        )


def check_reports(bag: BagReader, stamps: IntArray) -> list[DataFinding]:
    """What the nodes of the testbed reported as an ERROR while a trial was recorded.

    Nodes that only compute from the measurements do not count.

    Args:
        bag: The open bag; without diagnostics nothing is found.
        stamps: Stamps of the trial's N samples, shape (N,) [ns], ascending; earlier and later
            reports are left out.

    Returns:
        A finding per node, with its most frequent report.
    """
    if not len(stamps):
        return []
    first, last = int(stamps[0]), int(stamps[-1])
    names = [name for name, kind in bag.types.items() if name.endswith(topics.DIAGNOSTICS.name)
             and kind == topics.DIAGNOSTICS.type]  # fmt: skip
    reports: dict[str, list[tuple[int, str]]] = {}
    for raw in bag.messages(names) if names else ():
        if not _may_hold_error(raw.data):
            continue
        try:
            message = decode(raw.data, raw.type)
        except Exception:  # the library may raise any exception; somebody else's message
            continue
        stamp = stamp_of(message)
        for status in message.status:
            node = status.name.rpartition("/")[2]
            if int(status.level) == ERROR and first <= stamp <= last and node not in _OTHERS:
                reports.setdefault(node, []).append((stamp, status.message))
    found = []
    for node, own in reports.items():
        texts = [text for _, text in own]
        fact, hint = fact_and_hint(max(dict.fromkeys(texts), key=texts.count))
        begin, end = (1e-9 * (stamp - first) for stamp in (own[0][0], own[-1][0]))
        when = f"at {begin:.0f} s" if len(own) == 1 else f"from {begin:.0f} to {end:.0f} s"
        finding = DataFinding(
            node or "/diagnostics",
            f"it reported an ERROR {when}: {fact or hint}",
            hint if fact else "see docs/faults.md",
        )
        found.append(finding)
    return found


_COMPARED_POSES = 60  # at the start of a trial, of which each is compared with its markers
_LEAST_POSES = 10
_MAX_TURN = 0.1  # [rad]; of a pose from its markers; a marker's noise makes some mrad
# How others write the quaternion (x, y, z, w) of a body in the world: places of x, y, z and w in
# theirs, and the sign of the first three.
_QUATERNIONS = {
    "written as (w, x, y, z)": ([1, 2, 3, 0], 1.0),
    "written as (y, z, w, x)": ([3, 0, 1, 2], 1.0),
    "those of the world in the body": ([0, 1, 2, 3], -1.0),
    "those of the world in the body, written as (w, x, y, z)": ([1, 2, 3, 0], -1.0),
}


def check_orientations(bag: BagReader, geometry: SocketGeometry) -> Iterator[DataFinding]:
    """Poses whose quaternions are written in another way, as their markers show.

    Args:
        bag: The open bag; without markers nothing is found.
        geometry: The socket, with the markers in their bodies' frames.

    Yields:
        A finding per marker body.
    """
    names = required_topics(bag)
    if not bag.counts.get(names.get(topics.MARKERS, "")):
        return
    judged = (topics.MARKERS, *topics.POSES.values())
    wanted = {names[topic]: topic for topic in judged if topic in names}
    readers = {topic: Reader(topic, bag.path) for topic in wanted.values()}
    poses: dict[str, dict[int, FloatArray]] = {body: {} for body in topics.POSES}
    markers: dict[str, dict[int, FloatArray]] = {body: {} for body in topics.POSES}
    bodies = {topic: body for body, topic in topics.POSES.items()}
    for raw in islice(bag.messages([*wanted]), len(wanted) * _COMPARED_POSES):
        topic = wanted[raw.topic]
        try:
            stamp, values = readers[topic].read(raw.data)
        except TrialError:  # those who read all of them report it
            continue
        if topic in bodies:
            poses[bodies[topic]][stamp] = values
            continue
        for body, seen in values:
            if body in markers:
                markers[body][stamp] = seen
    for body, own in poses.items():
        stamps = [stamp for stamp in own if stamp in markers[body]]
        quaternions = np.array([own[stamp][3:] for stamp in stamps]).reshape(-1, 4)
        seen = np.full((len(stamps), len(geometry.markers[body]), 3), np.nan)
        for row, stamp in enumerate(stamps):
            there = markers[body][stamp][: seen.shape[1]]
            seen[row, : len(there)] = there
        if how := _other_quaternion(quaternions, fit_body(geometry.markers[body], seen).pose):
            yield DataFinding(
                "the limb pose",
                f"the {body} turns as its markers do if its quaternions are {how}",
                "give quaternions as (x, y, z, w), of the body in the world",
                "quaternions",
            )


def _other_quaternion(quaternions: FloatArray, shown: Pose) -> str:
    """How quaternions, (N, 4) [-], are written if they fit the shown poses only so; else empty."""

    def turn(given: FloatArray) -> float:
        """Median angle between the poses [rad]; infinite if too few are known."""
        rotation = Pose.from_quaternion(shown.translation, given).rotation
        trace = np.einsum("nij,nij->n", rotation, shown.rotation)
        known = trace[np.isfinite(trace)]
        if len(known) < _LEAST_POSES:
            return np.inf
        return float(np.median(np.arccos(np.clip((known - 1.0) / 2.0, -1.0, 1.0))))

    if not _MAX_TURN < turn(quaternions) < np.inf:
        return ""
    turns = {
        how: turn(quaternions[:, places] * [sign, sign, sign, 1.0])
        for how, (places, sign) in _QUATERNIONS.items()
    }
    best = min(turns, key=lambda how: turns[how])
    return best if turns[best] <= _MAX_TURN else ""


def _may_hold_error(data: bytes) -> bool:
    """Whether serialised diagnostics may hold an ERROR; a quick look at a single status."""
    if data[1:2] != b"\x01" or len(data) < 16:
        return True
    after_frame = 16 + int.from_bytes(data[12:16], "little")
    count = 4 + -(-(after_frame - 4) // 4) * 4
    several = int.from_bytes(data[count : count + 4], "little") != 1
    return several or data[count + 4 : count + 5] == bytes([ERROR])


def _silent_clusters(measured: Measurements, geometry: SocketGeometry) -> Iterator[DataFinding]:
    """Clusters that the socket declares and no message contains; one finding for all of them."""
    if len(geometry.clusters) > 1 and not measured.clusters:
        yield DataFinding(
            "the clusters",
            f"no message contains any of the {len(geometry.clusters)} that socket.yaml declares, so"
            " the force map comes from the wrench alone",
            "check their buses and names in testbed.yaml, or go without",
        )
        return
    for name in geometry.clusters:
        if name not in measured.clusters:
            yield DataFinding(
                name,
                "socket.yaml declares it, and no message contains it",
                "check its bus and its name in testbed.yaml, or take it out of socket.yaml",
            )


def _overload(measured: Measurements, cell: LoadCellSettings) -> Iterator[DataFinding]:
    """A wrench beyond the capacity of the load cell, judged as the running node judges it."""
    known = measured.wrench[np.isfinite(measured.wrench).all(axis=1)]
    if len(cell.full_scale) != len(measured.wrench.T) or not len(known):
        return
    # Single values may be spikes.
    peak = np.sort(np.abs(known), axis=0)[-min(_OVERLOADED, len(known))]
    level, text = load_cell.overload(peak, load_cell.full_scale_of(cell))
    if level == ERROR:
        fact, _ = fact_and_hint(text)
        hint = "check the cell's calibration after an overload, and full_scale in testbed.yaml"
        yield DataFinding("the load cell", fact, hint, "capacity")


def _stopped_clusters(measured: Measurements) -> Iterator[DataFinding]:
    """Inputs of clusters that stand still."""
    for column, name in enumerate(measured.clusters):
        readings = measured.capacitance[:, column]
        stopped = [_still_for(measured, readings[:, [channel]]) for channel in range(4)]
        dead = [channel for channel, span in enumerate(stopped) if span]
        if not dead:
            continue
        inputs = f"input {dead[0]}" if len(dead) == 1 else f"inputs {', '.join(map(str, dead))}"
        does = "does" if len(dead) == 1 else "do"
        span = min(stopped[channel] for channel in dead)
        yield DataFinding(
            name,
            f"its {inputs} {does} not change for {span:.1f} s",
            "check the plug and the wires of the input: its stress is wrong without it",
            "still",
        )


def _noisy_inputs(measured: Measurements) -> Iterator[DataFinding]:
    """Inputs far noisier than the other ones of their cluster."""
    usual = ~gaps(measured.stamps)
    for column, name in enumerate(measured.clusters):
        noise = deviations(measured.capacitance[:, column], usual)
        known = noise[np.isfinite(noise)]
        if len(known) < len(noise):  # missing, or standing still: reported elsewhere
            continue
        worst = int(noise.argmax())
        others = float(np.median(np.delete(noise, worst)))
        if noise[worst] > max(NOISE_RATIO * others, MIN_INPUT_NOISE):
            ratio = noise[worst] / others
            yield DataFinding(
                name,
                f"the noise of its input {worst} is {noise[worst]:.2g} pF, {ratio:.0f} times that"
                " of its others",
                "check the shield, the plug and the wires of the input",
            )


def _same_inputs(measured: Measurements) -> Iterator[DataFinding]:
    """Inputs that read the same as another one of their cluster, or as all four of an earlier one.

    Only values that change count: coarse readings of clusters at rest may well be equal.
    """
    names = [(name, channel) for name in measured.clusters for channel in range(4)]
    columns = measured.capacitance.reshape(len(measured.stamps), -1).T
    found: dict[tuple[str, str], list[int]] = {}
    for (one, (name, channel)), (other, (its, _)) in combinations(enumerate(names), 2):
        if np.count_nonzero(columns[one] == columns[other]) <= MAX_SAME * LEAST_CHECKED:
            continue  # quick, as for nearly all pairs
        known = np.isfinite(columns[[one, other]]).all(axis=0)
        own, its_own = columns[one][known], columns[other][known]
        changed = np.flatnonzero(np.diff(own)) + 1  # standing still is reported elsewhere
        if len(changed) < LEAST_CHECKED:
            continue
        if np.mean(own[changed] == its_own[changed]) > MAX_SAME:
            found.setdefault((its, name), []).append(channel)
    for (name, its), channels in found.items():
        if its != name and len(channels) < 4:  # one may be equal by chance
            continue
        inputs = "an input reads" if len(channels) == 1 else f"{len(channels)} inputs read"
        yield DataFinding(
            name,
            f"{inputs} the same as {'another one' if its == name else f'those of {its}'}",
            "check the multiplexer and the wires: two names read one sensor",
        )


def _stopped_bridges(measured: Measurements) -> Iterator[DataFinding]:
    """Bridges of the load cell that stand still."""
    for bridge, ratios in enumerate(measured.ratios.T, start=1):
        if span := _still_for(measured, ratios[:, None]):
            yield DataFinding(
                "the load cell",
                f"the ratio of bridge {bridge} does not change for {span:.1f} s",
                "check the bridge and its wiring: every axis of the wrench needs it",
                "still",
            )


def _missing_bridges(measured: Measurements) -> Iterator[DataFinding]:
    """Bridges without a ratio at samples whose wrench and other bridges are known."""
    known = np.isfinite(measured.ratios)
    if not len(known):  # not recorded
        return
    sound = np.isfinite(measured.wrench).all(axis=1) & known.any(axis=1)
    if sound.sum() < LEAST_CHECKED:
        return
    for bridge, share in enumerate(1.0 - known[sound].mean(axis=0), start=1):
        if share > MAX_MISSING:
            yield DataFinding(
                "the load cell",
                f"{100.0 * share:.0f} % of the ratios of bridge {bridge} are missing beside a"
                " complete wrench",
                "check the bridge and its wiring, and where the wrench comes from",
            )


def _stopped_bodies(measured: Measurements) -> Iterator[DataFinding]:
    """Marker bodies that stand still, whatever the noise of the other one does."""
    for body in topics.POSES:
        pose = getattr(measured, body)
        spans = [_still_for(measured, part) for part in (pose[:, :3], pose[:, 3:])]
        if span := max(spans):
            yield DataFinding(
                "the limb pose",
                f"the pose of the {body} does not change for {span:.1f} s",
                f"check the cameras' view of the {body}'s markers, and the body's name",
                "still",
            )


def _repetitions(measured: Measurements) -> Iterator[DataFinding]:
    """Sources whose readings often repeat the one before."""
    sources = {"the wrench": measured.wrench}
    for column, name in enumerate(measured.clusters):
        sources[name] = measured.capacitance[:, column]
    shares = {name: _repeated(values) for name, values in sources.items()}
    shares["the limb pose"] = max(_repeated(getattr(measured, body)) for body in topics.POSES)
    for name, share in shares.items():
        if share > MAX_REPEATED:
            yield DataFinding(
                name,
                f"{100.0 * share:.0f} % of its readings repeat the one before",
                "its source is slower than the trigger or sends old values: check its rate",
            )


def _still_for(measured: Measurements, values: FloatArray) -> float:
    """Longest time for which all k columns of a source, (N, k), stand still; 0 if it is short [s].

    Missing readings interrupt nothing: what is the same before and after them stood still.
    """
    known = np.isfinite(values).all(axis=1)
    if known.sum() < LEAST_CHECKED:
        return 0.0
    time, kept = measured.time[known], values[known]
    equal = (np.diff(kept, axis=0) == 0.0).all(axis=1)
    spans = [float(time[end] - time[start]) for start, end in runs(equal)]
    longest = max(spans, default=0.0)
    return longest if longest > still_limit(usual_period(measured.time)) else 0.0


def _repeated(values: FloatArray) -> float:
    """Share of the readings, (N, k), that repeat the one before in single steps [-].

    It is 0 for values in coarse steps, which come back after others, and for standing still.
    """
    kept = values[np.isfinite(values).all(axis=1)]
    if len(kept) < LEAST_CHECKED:
        return 0.0
    equal = (np.diff(kept, axis=0) == 0.0).all(axis=1)
    if equal.mean() <= MAX_REPEATED:
        return 0.0
    own_runs = len(kept) - int(equal.sum())
    if own_runs > _MAX_RETURNS * len(np.unique(kept, axis=0)):
        return 0.0
    short = runs(equal)
    counted = sum(int(end - start) for start, end in short if end - start <= _LONGEST_REPETITION)
    return counted / len(kept)
