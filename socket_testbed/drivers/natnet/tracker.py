"""Markers and poses of the two bodies at a trigger's time, from the frames around it."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.drivers.averaging import line_weights
from socket_testbed.drivers.natnet.messages import BodiesByName, MocapFrame
from socket_testbed.geometry.marker_bodies import (
    EDGE_TOLERANCE,
    FEWEST_MARKERS,
    BodyFit,
    distances,
    fit_body,
)
from socket_testbed.geometry.pose import Pose
from socket_testbed.settings.acquisition import MocapSettings

_KEPT = 1.0  # [s]
_VOTES, _FEWEST = 20, 3  # fits that decide on the usual order of the labels
_LARGEST_STEP = 0.01  # [m]; of a marker between two frames, without a fit of its body

_Entry: TypeAlias = tuple[float, MocapFrame, BodiesByName | None]


@dataclass(frozen=True)
class MocapSample:
    """Socket and pylon, in this order, at the time of a trigger; NaN where they are not seen.

    Attributes:
        time: Time of the trigger on the steady clock [s].
        positions: Origins of the bodies in the world, shape (2, 3) [m].
        quaternions: Their orientations (x, y, z, w), shape (2, 4) [-].
        markers: Their markers in the bodies' order, shape (2, k, 3) [m], where k is that of the
            body with more; beyond its own, a body's are NaN.
        faults: Why a body has no pose; empty if it has one.
        frames: Number of frames that make each pose [1]; 0 where there is none.
    """

    time: float
    positions: FloatArray
    quaternions: FloatArray
    markers: FloatArray
    faults: tuple[str, str]
    frames: tuple[int, int]


class BodyTracker:
    """Keeps the frames of the last second, and interpolates between them or averages them.

    A window [s] is the span around a trigger whose frames are averaged; with 0 a pose is
    interpolated between two frames. Any thread may call any method.

    Args:
        settings: The settings.
        socket_markers: The socket's 3 to 8 markers in its body's frame, shape (k, 3) [m].
        pylon_markers: The pylon's markers, likewise.
    """

    def __init__(
        self,
        settings: MocapSettings,
        socket_markers: FloatArray,
        pylon_markers: FloatArray,
    ) -> None:
        self._stale = settings.stale
        self._bodies = (
            _TrackedBody(settings.socket_body, "socket_body", socket_markers),
            _TrackedBody(settings.pylon_body, "pylon_body", pylon_markers),
        )
        self._frames: deque[_Entry] = deque()
        self._changed = threading.Condition()

    def add(self, frame: MocapFrame, time: float, models: BodiesByName | None) -> None:
        """Add a frame.

        Args:
            frame: The frame.
            time: Middle of its exposure on the steady clock [s]; earlier ones are dropped.
            models: The rigid bodies that its ids stand for; None: not known.
        """
        with self._changed:
            if self._frames and time <= self._frames[-1][0]:
                return
            self._frames.append((time, frame, models))
            while self._frames[0][0] < time - _KEPT:
                self._frames.popleft()
            self._changed.notify_all()

    def ready(self, trigger: float, window: float = 0.0) -> bool:
        """Whether no later frame will make the sample of a trigger [s] better."""
        with self._changed:
            return self._is_ready(trigger, window)

    def wait(self, trigger: float, deadline: float, window: float = 0.0) -> bool:
        """Wait until `ready`, or until a time of the steady clock [s]; whether it is ready."""
        with self._changed:
            while not self._is_ready(trigger, window):
                left = deadline - clocks.monotonic()
                if left <= 0.0:
                    return False
                self._changed.wait(clocks.real(left))
            return True

    def sample(self, trigger: float, window: float = 0.0) -> MocapSample:
        """The bodies at a time of the steady clock [s], from the frames there are.

        A pose is the mean on SE(3) of the frames in the window: positions by their mean,
        rotations by the mean of their matrices (chordal). Frames are not even about the trigger,
        less so where some are missing; therefore the mean is carried to the trigger's time with
        the window's mean velocity, and does not lag. A body has a pose whenever it can be
        interpolated; the interpolated one stays if the frames would make a noisier mean.
        Markers are always interpolated.
        """
        with self._changed:
            before, after = self._around(trigger)
            inside = self._inside(trigger, window) if window > 0.0 else []
            bodies = [body.at(trigger, before, after, inside, self._stale) for body in self._bodies]
        positions, quaternions, seen, faults, frames = zip(*bodies, strict=True)
        markers = np.full((2, max(map(len, seen)), 3), np.nan)
        for own, places in zip(markers, seen, strict=True):
            own[: len(places)] = places
        return MocapSample(
            trigger,
            np.array(positions),
            np.array(quaternions),
            markers,
            (faults[0], faults[1]),
            (frames[0], frames[1]),
        )

    def _around(self, trigger: float) -> tuple[list[_Entry], list[_Entry]]:
        """The two frames before and the two after a time, the nearest first."""
        before: list[_Entry] = []
        after: list[_Entry] = []
        for entry in reversed(self._frames):
            if entry[0] >= trigger:
                after.insert(0, entry)
            else:
                before.append(entry)
                if len(before) == 2:
                    break
        return before, after[:2]

    def _inside(self, trigger: float, window: float) -> list[_Entry]:
        """The frames at most half a window from a time."""
        return [entry for entry in self._frames if abs(entry[0] - trigger) <= 0.5 * window]

    def _is_over(self, end: float) -> bool:
        """Whether the next frame will come after a time, as they follow each other at present."""
        times = [entry[0] for entry in islice(reversed(self._frames), 2)]
        return bool(times) and 2.0 * times[0] - times[-1] > end

    def _is_ready(self, trigger: float, window: float) -> bool:
        if window > 0.0 and not self._is_over(trigger + 0.5 * window):
            return False
        _, after = self._around(trigger)
        if not after or len(after) == 2 or after[-1][0] >= trigger + self._stale:
            return bool(after)
        # One more frame is worth the wait where a marker is not seen in this one.
        _, frame, models = after[0]
        return all(body.is_seen(frame, models) for body in self._bodies)


_Result: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, str, int]


class _TrackedBody:
    """One of the two bodies: where its markers are in a frame, and in what order."""

    def __init__(self, name: str, setting: str, reference: FloatArray) -> None:
        self._name = name
        self._setting = setting
        self._reference = np.asarray(reference, dtype=float)
        self._count = len(self._reference)
        self._distances = distances(self._reference)
        self._orders: deque[tuple[int, ...]] = deque(maxlen=_VOTES)  # of the labels, lately

    def is_seen(self, frame: MocapFrame, models: BodiesByName | None) -> bool:
        """Whether all its markers are seen, or never will be."""
        return bool(self._unknown(models) or np.isfinite(self._markers(frame, models)).all())

    def at(
        self,
        trigger: float,
        before: Sequence[_Entry],
        after: Sequence[_Entry],
        inside: Sequence[_Entry],
        stale: float,
    ) -> _Result:
        """Position [m], quaternion, markers [m], fault and number of frames at a time [s]."""
        nothing = (np.full(3, np.nan), np.full(4, np.nan), np.full((self._count, 3), np.nan))
        if not before or not after or after[0][0] - before[0][0] > stale:
            return *nothing, f"no two frames within {stale:g} s around the trigger", 0
        for _, _, models in (before[0], after[0]):
            if fault := self._unknown(models):
                return *nothing, fault, 0
        entries = [*before, *after, *inside]
        times = np.array([time for time, _, _ in entries])
        seen = np.array([self._markers(frame, models) for _, frame, models in entries])
        fit = fit_body(self._reference, seen)
        first, around = len(before), len(before) + len(after)
        for a in range(first):
            for b in range(first, around):
                if fit.found[a] and fit.found[b] and times[b] - times[a] <= stale:
                    weight = (trigger - times[a]) / (times[b] - times[a])
                    markers = self._interpolate_markers(fit, seen, (a, b), weight)
                    noise = weight**2 + (1.0 - weight) ** 2
                    mean = _mean(fit.pose, times - trigger, slice(around, None), noise)
                    position, quaternion, used = mean or _interpolate(fit.pose, (a, b), weight)
                    return position, quaternion, markers, "", used
        weight = (trigger - times[0]) / (times[first] - times[0])
        markers = self._by_label(fit, seen, (0, first), weight)
        return *nothing[:2], markers, self._fault(seen[[0, first]]), 0

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

    def _markers(self, frame: MocapFrame, models: BodiesByName | None) -> FloatArray:
        """Its markers by their labels, shape (k, 3) [m]; NaN where one is not seen."""
        markers = np.full((self._count, 3), np.nan)
        definition = models.get(self._name) if models is not None else None
        if definition is None:
            return markers
        own = sorted(marker for marker in frame.markers if marker.model == definition.id)
        for rank, marker in enumerate(own):
            slot = rank if len(own) == self._count else marker.member - 1
            if not (marker.occluded or marker.model_filled) and 0 <= slot < self._count:
                markers[slot] = marker.position
        return markers

    def _interpolate_markers(
        self, fit: BodyFit, seen: FloatArray, pair: tuple[int, int], weight: float
    ) -> FloatArray:
        whole = [row for row in pair if (fit.order[row] >= 0).all()]
        self._orders += [tuple(fit.order[row].tolist()) for row in whole]
        start, end = (_in_order(seen[row], fit.order[row]) for row in pair)
        return np.asarray(start + weight * (end - start))

    def _by_label(
        self, fit: BodyFit, seen: FloatArray, pair: tuple[int, int], weight: float
    ) -> FloatArray:
        """Markers that are seen in both frames and moved little, though a body has no fit."""
        known = self._usual_order()
        start, end = (
            _in_order(seen[row], fit.order[row])
            if fit.found[row]
            else self._labelled(seen[row], known)
            for row in pair
        )
        step = np.linalg.norm(end - start, axis=1)
        near = np.where(np.isfinite(step), step, np.inf) < _LARGEST_STEP
        return np.where(near[:, None], start + weight * (end - start), np.nan)

    def _usual_order(self) -> IntArray | None:
        """The order of most fits lately: a swap of labels that lasts must not be learnt."""
        if not self._orders:
            return None
        order, votes = Counter(self._orders).most_common(1)[0]
        return np.array(order) if votes >= max(_FEWEST, 0.75 * len(self._orders)) else None

    def _labelled(self, markers: FloatArray, order: IntArray | None) -> FloatArray:
        """Markers in the body's order by their labels; NaN where distances contradict them."""
        unknown = np.full((self._count, 3), np.nan)
        if order is None:
            return unknown
        mismatch = np.abs(distances(markers[order]) - self._distances)
        if (mismatch[np.isfinite(mismatch)] > EDGE_TOLERANCE).any():
            return unknown
        return np.asarray(markers[order])

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


def _in_order(markers: FloatArray, order: IntArray) -> FloatArray:
    """Markers in the body's order, shape (k, 3) [m]; NaN where it names none."""
    return np.where((order >= 0)[:, None], markers[order], np.nan)


def _interpolate(
    poses: Pose, pair: tuple[int, int], weight: float
) -> tuple[FloatArray, FloatArray, int]:
    """Position [m] and quaternion between two of N poses, and 2, their number."""
    start, end = poses.translation[list(pair)]
    before, after = Rotation.from_matrix(poses.rotation[list(pair)])
    # Slerp (Shoemake 1985, doi:10.1145/325165.325242); scipy's Slerp costs twice as much.
    rotation = before * (before.inv() * after) ** weight
    return start + weight * (end - start), rotation.as_quat(), 2


def _mean(
    poses: Pose, offsets: FloatArray, rows: slice, largest: float
) -> tuple[FloatArray, FloatArray, int] | None:
    """Mean of those of N poses that are in some rows and not NaN, at offset 0.

    Args:
        poses: The poses.
        offsets: Their times from that of the mean, shape (N,) [s].
        rows: Which to average.
        largest: Largest variance of the mean's noise, where a pose's is 1 [-].

    Returns:
        Position [m], quaternion and number of poses; None if the mean would be noisier.
    """
    usable = np.isfinite(poses.translation[rows, 0])
    weights = line_weights(offsets[rows][usable])
    if len(weights) < 2 or weights @ weights > largest:
        return None
    rotations = poses.rotation[rows][usable]
    # The rotation nearest to all: the chordal mean (Hartley 2013, doi:10.1007/s11263-012-0601-0).
    left, _, right = np.linalg.svd(rotations.mean(axis=0))
    mean = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    turns = Rotation.from_matrix(mean.T @ rotations).as_rotvec()
    rotation = Rotation.from_matrix(mean) * Rotation.from_rotvec(weights @ turns)
    return weights @ poses.translation[rows][usable], rotation.as_quat(), len(weights)
