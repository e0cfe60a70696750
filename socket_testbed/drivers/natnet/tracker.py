"""Markers and poses of the two bodies at a trigger's time, from the frames around it."""

from __future__ import annotations

import threading
from bisect import bisect_left, bisect_right
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed import clocks
from socket_testbed.arrays import BoolArray, FloatArray, IntArray, line_weights
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


class _Entry(NamedTuple):
    """A frame at its time [s], with the markers of each body, shape (k, 3) [m]."""

    time: float
    models: BodiesByName | None
    markers: tuple[FloatArray, ...]


@dataclass(frozen=True)
class MocapSample:
    """Socket and pylon, in this order, at the time of a trigger; NaN where they are not seen."""

    time: float  # time of the trigger on the steady clock [s]
    positions: FloatArray  # origins of the bodies in the world, shape (2, 3) [m]
    quaternions: FloatArray  # their orientations (x, y, z, w), shape (2, 4) [-]
    # their markers in the bodies' order, as labelled where they do not fit, shape (2, k, 3) [m],
    # where k is that of the body with more; beyond its own, a body's are NaN
    markers: FloatArray
    faults: tuple[str, str]  # why a body has no pose; empty if it has one
    frames: tuple[int, int]  # number of frames that make each pose [1]; 0 where there is none


class BodyTracker:
    """Keeps the frames of the last second, and interpolates between them or averages them.

    A window [s] is the span around a trigger whose frames are averaged; with 0 a pose is
    interpolated between two frames. Any thread may call any method.

    Args:
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
            _TrackedBody(settings.socket_body, "socket_body", socket_markers, settings.stale),
            _TrackedBody(settings.pylon_body, "pylon_body", pylon_markers, settings.stale),
        )
        self._frames: deque[_Entry] = deque()
        self._changed = threading.Condition()

    def add(self, frame: MocapFrame, time: float, models: BodiesByName | None) -> None:
        """Add a frame of a time [s] after all before, with the bodies that its ids stand for."""
        with self._changed:
            if self._frames and time <= self._frames[-1].time:
                return
            markers = tuple(body.markers(frame, models) for body in self._bodies)
            self._frames.append(_Entry(time, models, markers))
            while self._frames[0].time < time - _KEPT:
                self._frames.popleft()
            self._changed.notify_all()

    def ready(self, trigger: float, window: float = 0.0) -> bool:
        """Whether no later frame will make the sample of a trigger [s] better."""
        with self._changed:
            return self._is_ready(trigger, window)

    def wait(self, trigger: float, deadline: float, window: float = 0.0) -> bool:
        """Wait until `ready`, or until a time of the steady clock [s]; whether it is ready."""
        # No frame before the window's end can be the last one.
        clocks.sleep(max(0.0, min(trigger + 0.5 * window, deadline) - clocks.monotonic()))
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
            entries, before = self._around(trigger, 0.5 * window)
            offsets = np.array([entry.time - trigger for entry in entries])
            inside = (np.abs(offsets) <= 0.5 * window) & (window > 0.0)
            bodies = [
                body.at(entries, [entry.markers[k] for entry in entries], before, offsets, inside)
                for k, body in enumerate(self._bodies)
            ]
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

    def _around(self, trigger: float, half: float) -> tuple[list[_Entry], int]:
        """The frames at most half a window from a time, and two on either side of it."""
        frames = list(self._frames)
        times = [entry.time for entry in frames]
        middle = bisect_left(times, trigger)
        first = max(0, min(middle - 2, bisect_left(times, trigger - half)))
        last = max(middle + 2, bisect_right(times, trigger + half))
        return frames[first:last], middle - first

    def _is_over(self, end: float) -> bool:
        """Whether the next frame will come after a time, as they follow each other at present."""
        times = [entry.time for entry in islice(reversed(self._frames), 2)]
        return bool(times) and 2.0 * times[0] - times[-1] > end

    def _is_ready(self, trigger: float, window: float) -> bool:
        if window > 0.0 and not self._is_over(trigger + 0.5 * window):
            return False
        entries, before = self._around(trigger, 0.0)
        after = entries[before:]
        if not after or len(after) == 2 or after[-1].time >= trigger + self._stale:
            return bool(after)
        # One more frame is worth the wait where a marker is not seen in this one.
        return all(
            body.is_seen(markers, after[0].models)
            for body, markers in zip(self._bodies, after[0].markers, strict=True)
        )


_Result: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, str, int]


class _TrackedBody:
    """One of the two bodies: where its markers are in a frame, and in what order."""

    def __init__(self, name: str, setting: str, reference: FloatArray, stale: float) -> None:
        self._name = name
        self._stale = stale
        self._setting = setting
        self._reference = np.asarray(reference, dtype=float)
        self._count = len(self._reference)
        self._hidden = [(np.nan, np.nan, np.nan)] * self._count
        self._distances = distances(self._reference)
        self._orders: deque[tuple[int, ...]] = deque(maxlen=_VOTES)  # of the labels, lately

    def markers(self, frame: MocapFrame, models: BodiesByName | None) -> FloatArray:
        """Its markers by their labels, shape (k, 3) [m]; NaN where one is not seen."""
        markers = self._hidden.copy()
        definition = models.get(self._name) if models is not None else None
        if definition is not None:
            own = sorted(marker for marker in frame.markers if marker.model == definition.id)
            for rank, marker in enumerate(own):
                slot = rank if len(own) == self._count else marker.member - 1
                if not (marker.occluded or marker.model_filled) and 0 <= slot < self._count:
                    markers[slot] = marker.position
        return np.array(markers)

    def is_seen(self, markers: FloatArray, models: BodiesByName | None) -> bool:
        """Whether all its markers are seen, or never will be."""
        return bool(self._unknown(models) or np.isfinite(markers).all())

    def at(
        self,
        entries: Sequence[_Entry],
        markers: Sequence[FloatArray],
        first_after: int,
        offsets: FloatArray,
        inside: BoolArray,
    ) -> _Result:
        """Position [m], quaternion, markers [m], fault and number of frames at a time."""
        nothing = (np.full(3, np.nan), np.full(4, np.nan), np.full((self._count, 3), np.nan))
        nearest = (first_after - 1, first_after)
        if not 0 < first_after < len(entries) or _span(offsets, nearest) > self._stale:
            return *nothing, f"no two frames within {self._stale:g} s around the trigger", 0
        for row in nearest:
            if fault := self._unknown(entries[row].models):
                return *nothing, fault, 0
        seen = np.array(markers)
        fit = fit_body(self._reference, seen)
        found = fit.found
        for a in range(first_after - 1, max(first_after - 3, -1), -1):
            for b in range(first_after, min(first_after + 2, len(entries))):
                if found[a] and found[b] and _span(offsets, (a, b)) <= self._stale:
                    weight = -offsets[a] / (offsets[b] - offsets[a])
                    labelled = self._interpolate_markers(fit, seen, (a, b), weight)
                    noise = weight**2 + (1.0 - weight) ** 2
                    mean = _mean(fit.pose, offsets, inside & found, noise)
                    position, quaternion, used = mean or _interpolate(fit.pose, (a, b), weight)
                    return position, quaternion, labelled, "", used
        weight = -offsets[nearest[0]] / (offsets[nearest[1]] - offsets[nearest[0]])
        labelled = self._by_label(fit, seen, nearest, weight)
        return *nothing[:2], labelled, self._fault(seen[list(nearest)]), 0

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
        """Markers that are seen in both frames and moved little, though a body has no fit.

        All of a body whose markers are not where the geometry has them are kept as labelled: its
        poses can be fitted later, with the right geometry.
        """
        known = self._usual_order()
        start, end = (
            _in_order(seen[row], fit.order[row])
            if fit.found[row]
            else seen[row]
            if np.isfinite(seen[row]).all()
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


def _span(offsets: FloatArray, pair: tuple[int, int]) -> float:
    """Time between two frames [s]."""
    return float(offsets[pair[1]] - offsets[pair[0]])


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
