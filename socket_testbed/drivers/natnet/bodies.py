"""Whether the markers of the frames agree with the rigid bodies as the server defined them."""

from __future__ import annotations

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.drivers.natnet.messages import (
    BodiesByName,
    LabelledMarker,
    MocapFrame,
    RigidBodyDefinition,
)
from socket_testbed.geometry.marker_bodies import EDGE_TOLERANCE, MIN_MARKERS, distances

_CHECK_INTERVAL = 0.1  # [s]; between frames that are checked
_PATIENCE = 1.0  # [s]; without a frame that agrees
_MAX_INTERVAL = 30.0  # [s]; between requests that change nothing
_REPORTED = 3.0  # [s]; how long a change is reported
_MAX_EXTENT = 3.0  # [m]; of a rigid body


class BodyWatch:
    """Notices that the rigid bodies of the frames are no longer those that the server defined.

    Motive flags changed bodies for a moment, and the flag can be lost or missing. So the distances
    between the markers of each body are compared with those of its definition. A body that has not
    fitted them for a second makes the definitions `stale`. If new ones change nothing, the next
    request waits longer, up to half a minute: the body has other markers than when it was defined,
    which is no fault of the link.
    """

    def __init__(self) -> None:
        self._next_check = 0.0  # [s]
        self._misfit: dict[str, float] = {}  # since when a body has not fitted, by name [s]
        self._agreed: dict[str, float] = {}  # when a body last fitted, by name [s]
        self._next_request, self._interval = 0.0, _PATIENCE  # [s]
        self._last_labelled: float | None = None  # last frame with a marker of a body [s]
        self._untracked = False  # whether the last frame had no rigid body either
        self._extent, self._largest = 0.0, ""  # of the largest body [m], and its name
        self._changed_at, self._changes = -np.inf, ""  # [s]

    def observe(self, frame: MocapFrame, models: BodiesByName, now: float) -> None:
        """Compare a frame with the definitions; a frame soon after another is not checked.

        Args:
            frame: The frame.
            models: The server's rigid bodies by name.
            now: When the frame arrived, on the steady clock [s].
        """
        if now < self._next_check:
            return
        self._next_check = now + _CHECK_INTERVAL
        by_id = {body.id: body for body in models.values()}
        markers: dict[str, list[LabelledMarker]] = {name: [] for name in models}
        for marker in frame.markers:
            if marker.model in by_id:
                markers[by_id[marker.model].name].append(marker)
        if any(markers.values()) or self._last_labelled is None:
            self._last_labelled = now
        self._untracked = not frame.bodies
        self._extent = 0.0
        for name, own in markers.items():
            self._note_extent(name, own)
            fits = _fit(models[name], own)
            if fits:
                self._agreed[name] = now
                self._misfit.pop(name, None)
                if not self._misfit:
                    self._interval = _PATIENCE
            elif fits is not None:
                self._misfit.setdefault(name, now)
        self._misfit = {name: at for name, at in self._misfit.items() if name in models}

    def _note_extent(self, name: str, markers: list[LabelledMarker]) -> None:
        places = np.array([marker.position for marker in markers if marker.seen])
        if len(places) > 1 and (extent := float(distances(places).max())) > self._extent:
            self._extent, self._largest = extent, name

    def stale(self, now: float) -> bool:
        """Whether to ask for the definitions again, at a time of the steady clock [s].

        True once; the next request has to wait.
        """
        since = min(self._misfit.values(), default=now)
        if now - since < _PATIENCE or now < self._next_request:
            return False
        self._next_request = now + self._interval
        self._interval = min(2.0 * self._interval, _MAX_INTERVAL)
        return True

    def renewed(self, before: BodiesByName | None, after: BodiesByName, now: float) -> None:
        """Note new definitions, and which bodies have other ids.

        Args:
            before: The rigid bodies by name until now; None if they were not known.
            after: The rigid bodies by name from now on.
            now: When they arrived, on the steady clock [s].
        """
        if before == after:
            return
        renumbered = {
            name: (before[name].id, body.id)
            for name, body in after.items()
            if before and name in before and before[name].id != body.id
        }
        if renumbered:
            ids = ", ".join(
                f"{name} {new} instead of {old}" for name, (old, new) in renumbered.items()
            )
            lost = now - min(self._agreed.get(name, now) for name in renumbered)
            self._changed_at = now
            self._changes = (
                f"Motive has changed the ids of its rigid bodies ({ids}): they are read again,"
                f" after {lost:.1f} s without poses"
            )
        self._misfit.clear()
        self._next_request, self._interval = 0.0, _PATIENCE

    def warning(self, now: float) -> str:
        """What is wrong with the bodies of the frames at a time of the steady clock [s].

        One line; empty if nothing is.
        """
        if self._extent > _MAX_EXTENT:
            return (
                f"the markers of rigid body '{self._largest}' are {self._extent:.3g} m apart, so"
                " the stream is not in metres, but in millimetres or the like: set Motive's"
                " streaming units to metres (Data Streaming, Units; or Scale 1)"
            )
        if now - self._changed_at < _REPORTED:
            return self._changes
        if self._last_labelled is not None and now - self._last_labelled > _PATIENCE:
            if self._untracked:
                return (
                    "the frames hold no rigid body: check that Motive is live and sees the bodies,"
                    " that they are ticked in its Assets, and that Data Streaming has Rigid Bodies"
                    " and Labeled Markers switched on"
                )
            return (
                "the frames hold rigid bodies but none of their markers: switch Labeled Markers on"
                " in Motive's Data Streaming"
            )
        return ""


def _fit(body: RigidBodyDefinition, markers: list[LabelledMarker]) -> bool | None:
    """Whether a body's labelled markers fit its definition; None if too few are seen to tell."""
    count = len(body.markers)
    if not count:
        return None
    if any(marker.member > count for marker in markers) or len(markers) > count:
        return False
    seen = sorted(marker for marker in markers if marker.seen)
    if len(seen) < min(MIN_MARKERS, count) or len(seen) < 2:
        return None
    places = np.array([marker.position for marker in seen])
    if len(seen) == count:
        return fits_definition(places, body)
    expected = distances(np.array(body.markers)[[marker.member - 1 for marker in seen]])
    return bool(np.abs(distances(places) - expected).max() <= EDGE_TOLERANCE)


def fits_definition(markers: FloatArray, body: RigidBodyDefinition) -> bool:
    """Whether all markers of a body are as far apart as defined, whatever the order of the labels.

    Args:
        markers: The markers in any frame, shape (k, 3) [m], all seen.
        body: The server's definition, with any number of markers.
    """
    if len(markers) != len(body.markers):
        return False
    found, defined = (
        np.sort(distances(each), axis=None) for each in (markers, np.array(body.markers))
    )
    return bool(np.abs(found - defined).max() <= EDGE_TOLERANCE)
