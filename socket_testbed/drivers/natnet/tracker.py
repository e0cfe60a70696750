"""Markers and poses of the two bodies at a trigger's time, from the frames around it."""

from __future__ import annotations

import threading
from bisect import bisect_left, bisect_right
from collections import Counter, deque
from itertools import islice
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed import clocks
from socket_testbed.arrays import BoolArray, FloatArray, IntArray, line_weights
from socket_testbed.drivers.natnet.messages import BodiesByName, MocapFrame
from socket_testbed.geometry.marker_bodies import (
    EDGE_TOLERANCE,
    FEWEST_MARKERS,
    distances,
    fit_body,
)
from socket_testbed.geometry.pose import Pose
from socket_testbed.settings.acquisition import MocapSettings

_KEPT = 1.0  # [s]
_VOTES, _FEWEST = 20, 3  # fits that decide on the usual order of the labels
_LARGEST_STEP = 0.01  # [m]; of a marker between two frames, without a fit of its body


class SeenBody(NamedTuple):
    """A body at the time of a trigger."""

    # its k markers in its own order, as labelled where they do not fit, shape (k, 3) [m]; NaN
    # where one is not seen
    markers: FloatArray
    position: FloatArray  # of its origin in the world, shape (3,) [m]; NaN where it has no pose
    quaternion: FloatArray  # its orientation (x, y, z, w), shape (4,) [-]; likewise
    frames: int = 0  # number of frames that make the pose [1]
    fault: str = ""  # why it has no pose; empty if it has one


class BodyTracker:
    """Keeps the frames of the last second, and interpolates between them or averages them.

    A window [s] is the span around a trigger whose frames are averaged; with 0 a pose is
    interpolated between two frames. Any thread may call any method. Each body has 3 to 8 markers
    in its own frame, shape (k, 3) [m].
    """

    def __init__(
        self, settings: MocapSettings, socket_markers: FloatArray, pylon_markers: FloatArray
    ) -> None:
        self._bodies = (
            _TrackedBody(settings.socket_body, "socket_body", socket_markers, settings.stale),
            _TrackedBody(settings.pylon_body, "pylon_body", pylon_markers, settings.stale),
        )
        self._changed = threading.Condition()  # its lock may be taken again by its holder

    def add(self, frame: MocapFrame, time: float, models: BodiesByName | None) -> None:
        """Add a frame of a time [s] after all before, with the bodies that its ids stand for."""
        with self._changed:
            for body in self._bodies:
                body.add(frame, time, models)
            self._changed.notify_all()

    def ready(self, trigger: float, window: float = 0.0) -> bool:
        """Whether no later frame will make the sample of a trigger [s] better."""
        with self._changed:
            return all(body.ready(trigger, window) for body in self._bodies)

    def wait(self, trigger: float, deadline: float, window: float = 0.0) -> bool:
        """Wait until `ready`, or until a time of the steady clock [s]; whether it is ready."""
        # No frame before the window's end can be the last one.
        clocks.sleep(max(0.0, min(trigger + 0.5 * window, deadline) - clocks.monotonic()))
        with self._changed:
            while not self.ready(trigger, window):
                left = deadline - clocks.monotonic()
                if left <= 0.0:
                    return False
                self._changed.wait(clocks.real(left))
            return True

    def sample(self, trigger: float, window: float = 0.0) -> tuple[SeenBody, SeenBody]:
        """Socket and pylon at a time of the steady clock [s], from the frames there are.

        A pose is the mean on SE(3) of the frames in the window: positions by their mean,
        rotations by the mean of their matrices (chordal). Frames are not even about the trigger,
        less so where some are missing; therefore the mean is carried to the trigger's time with
        the window's mean velocity, and does not lag. A body has a pose whenever it can be
        interpolated; the interpolated one stays if the frames would make a noisier mean.
        Markers are always interpolated.
        """
        with self._changed:
            socket, pylon = (body.at(trigger, window) for body in self._bodies)
        return socket, pylon


class _Frame(NamedTuple):
    time: float  # [s]
    markers: FloatArray  # of the body by their labels, shape (k, 3) [m]; NaN where one is not seen
    unknown: str  # why none of the server's rigid bodies is this one; empty: one is


class _TrackedBody:
    """One of the two bodies: where its markers are in the frames of the last second."""

    def __init__(self, name: str, setting: str, reference: FloatArray, stale: float) -> None:
        self._name = name
        self._stale = stale
        self._setting = setting
        self._reference = np.asarray(reference, dtype=float)
        self._count = len(self._reference)
        self._distances = distances(self._reference)
        self._frames: deque[_Frame] = deque()
        self._orders: deque[tuple[int, ...]] = deque(maxlen=_VOTES)  # of the labels, lately

    def add(self, frame: MocapFrame, time: float, models: BodiesByName | None) -> None:
        """Add a frame, unless it is not after all before."""
        if self._frames and time <= self._frames[-1].time:
            return
        markers = [(np.nan, np.nan, np.nan)] * self._count
        definition = (models or {}).get(self._name)
        if definition is not None:
            own = sorted(marker for marker in frame.markers if marker.model == definition.id)
            for rank, marker in enumerate(own):
                slot = rank if len(own) == self._count else marker.member - 1
                if marker.seen and 0 <= slot < self._count:
                    markers[slot] = marker.position
        self._frames.append(_Frame(time, np.array(markers), self._unknown(models)))
        while self._frames[0].time < time - _KEPT:
            self._frames.popleft()

    def ready(self, trigger: float, window: float) -> bool:
        """Whether no later frame will make it better at a trigger [s]."""
        if window > 0.0:
            # As frames follow each other at present, the next one comes after the window's end.
            times = [frame.time for frame in islice(reversed(self._frames), 2)]
            if not times or 2.0 * times[0] - times[-1] <= trigger + 0.5 * window:
                return False
        frames, before = self._around(trigger, 0.0)
        after = frames[before:]
        if not after or len(after) == 2 or after[-1].time >= trigger + self._stale:
            return bool(after)
        # One more frame is worth the wait where a marker is not seen in this one, but may be.
        return bool(after[0].unknown or np.isfinite(after[0].markers).all())

    def at(self, trigger: float, window: float) -> SeenBody:
        """The body at a trigger [s]."""
        frames, after = self._around(trigger, 0.5 * window)
        offsets = np.array([frame.time - trigger for frame in frames])
        nowhere = np.full(3, np.nan), np.full(4, np.nan)
        nothing = SeenBody(np.full((self._count, 3), np.nan), *nowhere)
        if not 0 < after < len(frames) or offsets[after] - offsets[after - 1] > self._stale:
            return nothing._replace(
                fault=f"no two frames within {self._stale:g} s around the trigger"
            )
        if fault := frames[after - 1].unknown or frames[after].unknown:
            return nothing._replace(fault=fault)
        seen = np.array([frame.markers for frame in frames])
        fit = fit_body(self._reference, seen)
        pairs = [
            (a, b)
            for a in range(after - 1, max(after - 3, -1), -1)
            for b in range(after, min(after + 2, len(frames)))
            if fit.found[a] and fit.found[b] and offsets[b] - offsets[a] <= self._stale
        ]
        a, b = pair = pairs[0] if pairs else (after - 1, after)
        weight = -offsets[a] / (offsets[b] - offsets[a])
        if pairs:
            whole = [fit.order[row] for row in pair if (fit.order[row] >= 0).all()]
            self._orders += [tuple(order.tolist()) for order in whole]
        start, end = (self._in_order(seen[row], fit.order[row]) for row in pair)
        markers = start + weight * (end - start)
        if pairs:
            inside = (np.abs(offsets) <= 0.5 * window) & (window > 0.0)
            noise = weight**2 + (1.0 - weight) ** 2
            mean = _mean(fit.pose, offsets, inside & fit.found, noise)
            return SeenBody(markers, *(mean or _interpolate(fit.pose, pair, weight)))
        near = np.linalg.norm(end - start, axis=1) < _LARGEST_STEP
        markers = np.where(near[:, None], markers, np.nan)
        return SeenBody(markers, *nowhere, fault=self._fault(seen[list(pair)]))

    def _around(self, trigger: float, half: float) -> tuple[list[_Frame], int]:
        """The frames at most half a window from a time, and two on either side of it."""
        frames, time = self._frames, attrgetter("time")
        middle = bisect_left(frames, trigger, key=time)
        first = max(0, min(middle - 2, bisect_left(frames, trigger - half, key=time)))
        last = max(middle + 2, bisect_right(frames, trigger + half, key=time))
        return list(islice(frames, first, last)), middle - first

    def _unknown(self, models: BodiesByName | None) -> str:
        """Why none of the server's rigid bodies is this one; empty: one is."""
        if models is None:
            return "Motive has not sent its rigid bodies yet"
        definition = models.get(self._name)
        if definition is None:
            there = ", ".join(sorted(models)) or "none"
            return (
                f"Motive has no rigid body '{self._name}' (there are: {there}):"
                f" name it so there, or set {self._setting}"
            )
        if definition.markers and len(definition.markers) != self._count:
            return (
                f"rigid body '{self._name}' has {len(definition.markers)} markers in Motive, and"
                f" {self._count} in the geometry file: give both the same, or register it anew"
            )
        return ""

    def _in_order(self, markers: FloatArray, order: IntArray) -> FloatArray:
        """A frame's markers in the body's order, shape (k, 3) [m]; NaN where that is not known.

        All of a body whose markers are not where the geometry has them are kept as labelled: its
        poses can be fitted later, with the right geometry. Those that are left of a body without
        a fit are in the usual order of the labels, if their distances do not contradict it.
        """
        if (order >= 0).any():
            return np.where((order >= 0)[:, None], markers[order], np.nan)
        if np.isfinite(markers).all():
            return markers
        # A swap of labels that lasts must not be learnt.
        usual, votes = Counter(self._orders).most_common(1)[0] if self._orders else ((), 0)
        if votes >= max(_FEWEST, 0.75 * len(self._orders)):
            markers = markers[list(usual)]
            mismatch = np.abs(distances(markers) - self._distances)
            if not (mismatch > EDGE_TOLERANCE).any():
                return markers
        return np.full((self._count, 3), np.nan)

    def _fault(self, seen: FloatArray) -> str:
        hidden = np.isnan(seen).any(axis=(0, 2))
        if hidden.any():
            members = ", ".join(str(slot + 1) for slot in np.flatnonzero(hidden))
            fault = f"marker {members} of rigid body '{self._name}' is occluded"
            few = self._count == FEWEST_MARKERS or (~hidden).sum() < FEWEST_MARKERS
            return fault if few else f"{fault}, and the others do not make its pose certain"
        kind = "triad" if self._count == FEWEST_MARKERS else "distances"
        return (
            f"the markers of rigid body '{self._name}' do not fit its {kind}: check the geometry"
            " file, or that no other marker is taken for one of them"
        )


def _interpolate(
    poses: Pose, pair: tuple[int, int], weight: float
) -> tuple[FloatArray, FloatArray, int]:
    """Position [m] and quaternion between two of N poses, and 2, their number."""
    start, end = poses.translation[list(pair)]
    before, after = Rotation.from_matrix(poses.rotation[list(pair)])
    # Slerp (Shoemake 1985, doi:10.1145/325165.325242).
    between = before * (before.inv() * after) ** weight
    return start + weight * (end - start), between.as_quat(), 2


def _mean(
    poses: Pose, offsets: FloatArray, usable: BoolArray, largest: float
) -> tuple[FloatArray, FloatArray, int] | None:
    """Mean of some of N poses, at offset 0."""
    weights = line_weights(offsets[usable])
    if len(weights) < 2 or weights @ weights > largest:
        return None
    rotations = Rotation.from_matrix(poses.rotation[usable])
    # The rotation nearest to all: the chordal mean (Hartley 2013, doi:10.1007/s11263-012-0601-0).
    mean = rotations.mean()
    turn = Rotation.from_rotvec(weights @ (mean.inv() * rotations).as_rotvec())
    return weights @ poses.translation[usable], (mean * turn).as_quat(), len(weights)
