"""Markers and poses of the two bodies at a trigger, from the frames around it."""

from __future__ import annotations

import threading
from bisect import bisect_left, bisect_right
from collections import Counter, deque
from itertools import islice
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from socket_testbed import clocks
from socket_testbed.arrays import BoolArray, FloatArray, IntArray, line_weights
from socket_testbed.drivers.natnet.bodies import fits_definition
from socket_testbed.drivers.natnet.messages import (
    BodiesByName,
    MocapFrame,
    RigidBodyDefinition,
)
from socket_testbed.geometry.marker_bodies import EDGE_TOLERANCE, MIN_MARKERS, distances, fit_body
from socket_testbed.geometry.pose import Pose, weighted_pose
from socket_testbed.settings.acquisition import MAX_STALE, MocapSettings

_HISTORY = MAX_STALE  # [s]
_MAX_VOTES, _MIN_VOTES = 20, 3  # fits that determine the usual order of the labels
_NOWHERE = np.full(7, np.nan)  # the pose of a body that has none
_UNITS = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 1.0 / 0.0254}  # in a metre
_MAX_STEP = 0.01  # [m]; of a marker between two frames, if its body was not fitted


class SeenBody(NamedTuple):
    """A body at the time of a trigger.

    Attributes:
        markers: Its k markers in the world, in the order of the geometry file, or as labelled if
            they fit only the server's definition, shape (k, 3) [m]; NaN if not seen.
        pose: Its pose in the world as `Pose.vector`: position of the body's origin [m], then
            quaternion (x, y, z, w) [-], shape (7,); all NaN if unknown.
        frames: Number of frames used for the pose; 0 without a pose.
        fault: Why there is no pose, in one line; empty if there is one.
    """

    markers: FloatArray
    pose: FloatArray
    frames: int = 0
    fault: str = ""


class BodyTracker:
    """Keeps the frames of the last second, and interpolates or averages them.

    All methods are thread-safe.

    Args:
        settings: Names of the two bodies in Motive, and the largest gap between frames.
        socket_markers: The socket's 3 to 8 markers in its body's frame, shape (k, 3) [m].
        pylon_markers: The pylon's 3 to 8 markers in its body's frame, shape (k, 3) [m].
    """

    def __init__(
        self, settings: MocapSettings, socket_markers: FloatArray, pylon_markers: FloatArray
    ) -> None:
        self._bodies = (
            _TrackedBody(settings.socket_body, "socket_body", socket_markers, settings.stale),
            _TrackedBody(settings.pylon_body, "pylon_body", pylon_markers, settings.stale),
        )
        self._changed = threading.Condition()  # its lock is reentrant

    def add(self, frame: MocapFrame, time: float, models: BodiesByName | None) -> None:
        """Add a frame; one that is not later than all before is ignored.

        Args:
            frame: The frame.
            time: Middle of its exposure on the steady clock [s].
            models: The server's rigid bodies by name, which tell whose the markers are; None if not
                known yet.
        """
        with self._changed:
            for body in self._bodies:
                body.add(frame, time, models)
            self._changed.notify_all()

    def ready(self, trigger: float, window: float = 0.0) -> bool:
        """Whether later frames cannot improve the sample at a trigger.

        Args:
            trigger: Time of the trigger on the steady clock [s].
            window: Span centred on the trigger whose frames are averaged [s]; 0 to interpolate.
        """
        with self._changed:
            return all(body.ready(trigger, window) for body in self._bodies)

    def wait(self, trigger: float, deadline: float, window: float = 0.0) -> bool:
        """Wait until `ready` or a deadline; returns whether ready.

        Args:
            trigger: Time of the trigger on the steady clock [s].
            deadline: When to give up, on the steady clock [s].
            window: Span centred on the trigger whose frames are averaged [s]; 0 to interpolate.
        """
        # The last frame cannot arrive before the end of the window.
        clocks.sleep(max(0.0, min(trigger + 0.5 * window, deadline) - clocks.monotonic()))
        with self._changed:
            left = clocks.real(deadline - clocks.monotonic())
            return self._changed.wait_for(lambda: self.ready(trigger, window), left)

    def sample(self, trigger: float, window: float = 0.0) -> tuple[SeenBody, SeenBody]:
        """Socket and pylon at a trigger, in this order, from the available frames.

        A pose is the mean on SE(3) of the frames in the window: the mean of the positions and the
        chordal mean of the rotations. Frames are not symmetric about the trigger, especially if
        some are missing, so the mean velocity in the window carries the mean to the trigger's
        time without lag. A body has a pose whenever it can be interpolated; the interpolated pose
        is kept if the mean would be noisier. Markers are always interpolated.

        Args:
            trigger: Time of the trigger on the steady clock [s].
            window: Span centred on the trigger whose frames are averaged [s]; 0 to interpolate
                between the two frames around it.
        """
        with self._changed:
            socket, pylon = (body.at(trigger, window) for body in self._bodies)
        return socket, pylon


class _Frame(NamedTuple):
    time: float  # mid-exposure on the steady clock [s]
    markers: FloatArray  # of the body by label, shape (k, 3) [m]; NaN if not seen
    unknown: str  # why the body is not among the server's; empty if it is
    definition: RigidBodyDefinition | None  # of the server; None if not known


class _TrackedBody:
    """One of the two bodies: its markers in the frames of the last second."""

    def __init__(self, name: str, setting: str, reference: FloatArray, stale: float) -> None:
        self._name = name
        self._stale = stale
        self._setting = setting
        self._reference = np.asarray(reference, dtype=float)
        self._count = len(self._reference)
        self._distances = distances(self._reference)
        self._frames: deque[_Frame] = deque()
        self._orders: deque[tuple[int, ...]] = deque(maxlen=_MAX_VOTES)  # recent label orders

    def add(self, frame: MocapFrame, time: float, models: BodiesByName | None) -> None:
        """Add a frame if it is later than all before."""
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
        self._frames.append(_Frame(time, np.array(markers), self._unknown(models), definition))
        while self._frames[0].time < time - _HISTORY:
            self._frames.popleft()

    def ready(self, trigger: float, window: float) -> bool:
        """Whether later frames cannot improve the body at a trigger [s]."""
        if window > 0.0:
            # At the current frame rate, the next frame must lie beyond the window.
            times = [frame.time for frame in islice(reversed(self._frames), 2)]
            if not times or 2.0 * times[0] - times[-1] <= trigger + 0.5 * window:
                return False
        frames, before = self._around(trigger, 0.0)
        after = frames[before:]
        if not after or len(after) == 2 or after[-1].time >= trigger + self._stale:
            return bool(after)
        # Wait for one more frame if a marker is not seen in this one.
        return bool(after[0].unknown or np.isfinite(after[0].markers).all())

    def at(self, trigger: float, window: float) -> SeenBody:
        """The body at a trigger [s]."""
        frames, after = self._around(trigger, 0.5 * window)
        offsets = np.array([frame.time - trigger for frame in frames])
        nothing = SeenBody(np.full((self._count, 3), np.nan), _NOWHERE)
        if not 0 < after < len(frames) or offsets[after] - offsets[after - 1] > self._stale:
            fault = f"no two frames within {self._stale:g} s around the trigger"
            return nothing._replace(fault=fault)
        if fault := frames[after - 1].unknown or frames[after].unknown:
            return nothing._replace(fault=fault)
        seen = np.array([frame.markers for frame in frames])
        fit = fit_body(self._reference, seen)
        fitted = self._fitted_pair(fit.found, offsets, after)
        a, b = pair = list(fitted or (after - 1, after))
        weight = -offsets[a] / (offsets[b] - offsets[a])
        fault = self._fault(seen[pair]) if fitted is None else ""
        if fitted is None:
            seen[[k for k in pair if not self._owns(frames[k])]] = np.nan
        markers = self._between(seen[pair], fit.order[pair], weight, fitted is not None)
        if fitted is None:
            return SeenBody(markers, _NOWHERE, fault=fault)
        inside = (np.abs(offsets) <= 0.5 * window) & (window > 0.0)
        noise = weight**2 + (1.0 - weight) ** 2
        mean = _mean(fit.pose, offsets, inside & fit.found, noise)
        return SeenBody(markers, *(mean or _interpolate(fit.pose, pair, weight)))

    def _fitted_pair(
        self, found: BoolArray, offsets: FloatArray, after: int
    ) -> tuple[int, int] | None:
        """The closest frames with a pose before and after the trigger, of the two on each side."""
        pairs = (
            (a, b)
            for a in range(after - 1, max(after - 3, -1), -1)
            for b in range(after, min(after + 2, len(offsets)))
            if found[a] and found[b] and offsets[b] - offsets[a] <= self._stale
        )
        return next(pairs, None)

    def _between(
        self, seen: FloatArray, orders: IntArray, weight: float, fitted: bool
    ) -> FloatArray:
        """Markers between two frames, shape (k, 3) [m]; unless fitted, those that hardly moved."""
        if fitted:
            self._orders += [tuple(order.tolist()) for order in orders if (order >= 0).all()]
        start, end = map(self._in_order, seen, orders)
        markers = start + weight * (end - start)
        if not fitted:
            markers[np.linalg.norm(end - start, axis=1) >= _MAX_STEP] = np.nan
        return markers

    def _around(self, trigger: float, half: float) -> tuple[list[_Frame], int]:
        """Frames within half a window of a time, at least two on either side if there are."""
        frames, time = self._frames, attrgetter("time")
        middle = bisect_left(frames, trigger, key=time)
        first = max(0, min(middle - 2, bisect_left(frames, trigger - half, key=time)))
        last = max(middle + 2, bisect_right(frames, trigger + half, key=time))
        return list(islice(frames, first, last)), middle - first

    def _unknown(self, models: BodiesByName | None) -> str:
        """Why the body is not among the server's rigid bodies; empty if it is."""
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

    def _owns(self, frame: _Frame) -> bool:
        """Whether complete markers are the body's, in metres, though they may not fit the geometry.

        They are not if they do not fit the server's definition either, such as after an exchange of
        ids.
        """
        definition = frame.definition
        if not np.isfinite(frame.markers).all() or definition is None or not definition.markers:
            return True
        fits = fits_definition(frame.markers, definition)
        return fits and self._foreign_unit(frame.markers[None]) is None

    def _in_order(self, markers: FloatArray, order: IntArray) -> FloatArray:
        """A frame's markers in the body's order, shape (k, 3) [m]; NaN if the order is unknown.

        Complete markers that do not fit the geometry are kept as labelled if they fit the server's
        definition, so that poses can be fitted later with the right geometry. Incomplete markers
        without a fit are put in the usual order of the labels, unless their distances contradict
        it.
        """
        if (order >= 0).any():
            return np.where((order >= 0)[:, None], markers[order], np.nan)
        if np.isfinite(markers).all():
            return markers
        # Require a large majority, so that lasting label swaps are not learnt.
        usual, votes = Counter(self._orders).most_common(1)[0] if self._orders else ((), 0)
        if votes >= max(_MIN_VOTES, 0.75 * len(self._orders)):
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
            few = self._count == MIN_MARKERS or (~hidden).sum() < MIN_MARKERS
            return fault if few else f"{fault}, and the others do not make its pose certain"
        if (unit := self._foreign_unit(seen)) is not None:
            return (
                f"the markers of rigid body '{self._name}' are {unit[1]:g} times as far apart as in"
                f" the geometry file, so Motive streams in {unit[0]}: set its streaming units to"
                " metres (Data Streaming, Units; or Scale 1)"
            )
        kind = "triad" if self._count == MIN_MARKERS else "distances"
        return (
            f"the markers of rigid body '{self._name}' do not fit its {kind}: check the geometry"
            " file, or that no other marker is taken for one of them"
        )

    def _foreign_unit(self, seen: FloatArray) -> tuple[str, float] | None:
        """The unit other than metres in which a frame fits, and how many are a metre; if any.

        The order of the labels does not matter.
        """
        found = np.sort(distances(seen).reshape(len(seen), -1))
        own = np.sort(self._distances, axis=None)
        for unit, per_metre in _UNITS.items():
            if (np.abs(found / per_metre - own) <= EDGE_TOLERANCE).all(axis=-1).any():
                return unit, per_metre
        return None


def _interpolate(poses: Pose, pair: list[int], weight: float) -> tuple[FloatArray, int]:
    """The vector of a pose between two of N poses, and their number (2)."""
    between = weighted_pose(poses.vector[pair], np.array([1.0 - weight, weight]))
    return between, len(pair)


def _mean(
    poses: Pose, offsets: FloatArray, usable: BoolArray, max_variance: float
) -> tuple[FloatArray, int] | None:
    """Vector of the usable poses' mean at offset 0, and their number; None if too noisy."""
    weights = line_weights(offsets[usable])
    if len(weights) < 2 or weights @ weights > max_variance:
        return None
    chosen = Pose(poses.rotation[usable], poses.translation[usable])
    return weighted_pose(chosen.vector, weights), len(weights)
