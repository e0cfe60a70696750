"""Poses of rigid bodies from their markers, and the uncertainty of the poses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.geometry.pose import Pose


@dataclass(frozen=True)
class PoseUncertainty:
    """First-order uncertainty of a pose that was fitted to points of a body.

    The fitted pose misplaces a point p of the body by ``d + w x (p - c)``, with an independent
    shift d and small rotation w, all in the axes of the body.

    Attributes:
        centroid: Centroid c of the fitted points in the body's frame, shape (3,) [m].
        shift: Covariance of d, shape (3, 3) [m^2].
        rotation: Covariance of w, shape (3, 3) [rad^2].
    """

    centroid: FloatArray
    shift: FloatArray
    rotation: FloatArray

    def at(self, point: FloatArray) -> FloatArray:
        """Covariance of a point fixed to the body, shape (3, 3) [m^2], in the body's axes.

        The point is in the body's frame, shape (3,) [m].
        """
        lever = np.cross(np.eye(3), point - self.centroid).T  # lever @ w = w x r
        return self.shift + lever @ self.rotation @ lever.T


def pose_uncertainty(points: FloatArray, noise: float) -> PoseUncertainty:
    """Uncertainty of a least-squares pose from equal, independent noise of the coordinates.

    With r the points relative to their centroid, the covariances are ``sigma^2 / k I`` of the shift
    and ``sigma^2 (sum(|r|^2 I - r r^T))^-1`` of the rotation. Their sum at a point is the target
    registration error of Fitzpatrick, West and Maurer 1998, doi:10.1109/42.736021, whose squared
    localisation error is ``3 sigma^2``.

    Args:
        points: The k points in the body's frame, not collinear, shape (k, 3) [m].
        noise: 1-sigma noise of a coordinate [m]; for the mean of N independent frames, that of one
            frame over sqrt(N).
    """
    centroid = points.mean(axis=0)
    arms = points - centroid
    inertia = (arms**2).sum() * np.eye(3) - arms.T @ arms
    shift = noise**2 / len(points) * np.eye(3)
    return PoseUncertainty(centroid, shift, noise**2 * np.linalg.inv(inertia))


def fit_rigid(points: FloatArray, observed: FloatArray) -> Pose:
    """Least-squares poses of a body from its points (Kabsch 1976, doi:10.1107/S0567739476001873).

    Args:
        points: The points in the body's frame, shape (k, 3) [m].
        observed: The same points in another frame, such as `world`, once, shape (k, 3) [m], or M
            times, shape (M, k, 3) [m].

    Returns:
        The pose of the body in the frame of the observations, or M of them.
    """
    centre_points = points.mean(axis=0)
    centre_observed = observed.mean(axis=-2)
    offsets = observed - centre_observed[..., None, :]
    covariance = np.swapaxes(offsets, -1, -2) @ (points - centre_points)
    rotation = nearest_rotations(covariance)
    return Pose(rotation, centre_observed - rotation @ centre_points)


def nearest_rotations(matrices: FloatArray) -> FloatArray:
    """The rotation nearest to each matrix (Frobenius norm), shape (..., 3, 3) [-]."""
    left, _, right = np.linalg.svd(matrices)
    # Coplanar points leave the sign of the normal open: choose the proper rotation.
    left[..., 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    return np.asarray(left @ right)


def misfit(points: FloatArray, observed: FloatArray, pose: Pose) -> FloatArray:
    """Distances of observed points from those placed by the poses, shape (..., k) [m].

    Args:
        points: The points in the body's frame, shape (k, 3) [m].
        observed: The points as observed, once or M times, shape ([M,] k, 3) [m].
        pose: The pose of the body in the frame of the observations, or M of them.
    """
    return np.linalg.norm(observed - pose.place(points), axis=-1)


EDGE_TOLERANCE = 0.002  # [m]; well above the noise of a marker
_MIN_DISTANCE = 0.01  # [m]; between two markers, and of one from the line of the others
_MIN_TRIAD_WIDTH = 0.002  # [m]; the latter for three markers, which are all needed for a pose
_TIGHT = 0.25  # of the tolerance
MIN_MARKERS = 3  # per body
MAX_MARKERS = 8


@dataclass(frozen=True)
class BodyFit:
    """Rigid fits of a body's k markers to N frames.

    Attributes:
        pose: N poses of the body in the frame of the observations; NaN where none was found.
        residual: RMS distance of the markers from the fit in each frame, shape (N,) [m]; NaN
            without a pose.
        order: Index of the observed marker for each marker of the body, shape (N, k); -1 without a
            pose, and for markers not used in the fit.
    """

    pose: Pose
    residual: FloatArray
    order: IntArray

    @property
    def found(self) -> BoolArray:
        """Which frames have a pose, shape (N,)."""
        return np.isfinite(self.residual)

    @property
    def noise(self) -> float:
        """1-sigma noise of a marker's coordinate, pooled over the frames [m]; NaN without poses.

        With m markers, each frame has 3 m - 6 degrees of freedom; the expected sum of squares per
        degree of freedom is sigma^2. `pose_uncertainty(reference, noise)` is then the uncertainty
        of the pose of one frame. Errors of the reference itself also count as noise.
        """
        used = (self.order[self.found] >= 0).sum(axis=1)
        if not len(used):
            return math.nan
        squares = used @ self.residual[self.found] ** 2
        return float(np.sqrt(squares / (3 * used - 6).sum()))


def distances(markers: FloatArray) -> FloatArray:
    """Distances between k markers, shape (..., k, k) of (..., k, 3) [m]; NaN if one is occluded."""
    return np.linalg.norm(markers[..., :, None, :] - markers[..., None, :, :], axis=-1)


def body_fault(markers: FloatArray) -> tuple[str, str] | None:
    """Why a body's markers, shape (k, 3) [m], are unusable, and the hint; None if they are usable.

    They may be in any frame. The reason is that two are too close to each other, that all are on
    one line, or that exchanged labels could not be detected.
    """
    between = distances(markers)
    a, b = np.unravel_index((between + np.diag([np.inf] * len(markers))).argmin(), between.shape)
    if between[a, b] < _MIN_DISTANCE:
        return (
            f"markers {a + 1} and {b + 1} are {1e3 * between[a, b]:.1f} mm apart",
            f"move them {1e3 * _MIN_DISTANCE:g} mm apart or more",
        )
    width = _MIN_DISTANCE if len(markers) > MIN_MARKERS else _MIN_TRIAD_WIDTH
    if _width(markers) < width:
        return (
            "the markers are on one line",
            f"move a marker {1e3 * width:g} mm or more away from the line",
        )
    alike = [m for m in _matches(between, between, 2.0 * EDGE_TOLERANCE) if _swaps(m)]
    if alike:
        swapped = ", ".join(str(seen + 1) for own, seen in alike[0] if own != seen)
        return (
            f"the markers look alike with labels {swapped} exchanged, so swapped labels cannot be"
            " found",
            "move one of them until all its distances differ by"
            f" {2e3 * EDGE_TOLERANCE:g} mm or more",
        )
    return None


def fit_body(reference: FloatArray, observed: FloatArray) -> BodyFit:
    """Fit a body to its markers in each frame, for any order of their labels.

    A triad needs all its markers. For larger bodies, the pose is fitted to at least three seen
    markers whose distances agree with the body's. Labels are kept if their distances agree.
    Otherwise the distances identify the markers: the largest agreeing set is used if it is unique
    and holds most of the markers seen; relabelled sets need all markers of a triad, or at least
    four. A subset has no pose if it is collinear or could be another part of the body. The rotation
    is the least-squares one (`fit_rigid`). Distances agree within `EDGE_TOLERANCE`.

    Args:
        reference: The markers in the body's frame, shape (k, 3) [m].
        observed: The markers in N recorded frames, in coordinates of `world`, shape (N, k, 3) [m];
            NaN if occluded.
    """
    own = distances(reference)
    count, size = observed.shape[:2]
    if (np.abs(distances(observed) - own) <= EDGE_TOLERANCE).all():  # as usual: quickly
        pose = fit_rigid(reference, observed)
        residual = _residuals(reference, observed, pose)
        if (residual <= EDGE_TOLERANCE).all():
            return BodyFit(pose, residual, np.tile(np.arange(size), (count, 1)))
    order = np.full((count, size), -1)
    seen = np.isfinite(observed).all(axis=2).sum(axis=1)
    waiting = seen >= MIN_MARKERS
    trial: IntArray | None = np.arange(size)  # the labels' own order
    while trial is not None:
        markers = np.where((trial >= 0)[:, None], observed[:, trial], np.nan)
        there = np.isfinite(markers.sum(axis=2))
        off = np.nan_to_num(np.abs(distances(markers) - own)).max(axis=(1, 2))
        agree = waiting & (off <= EDGE_TOLERANCE) & (there.sum(axis=1) >= MIN_MARKERS)
        order[agree] = np.where(there[agree], trial, -1)
        waiting &= ~agree
        trial = None
        for frame in sorted(np.flatnonzero(waiting), key=lambda k: -seen[k]):
            found = _matches(own, distances(observed[frame]), EDGE_TOLERANCE)
            if len(found) == 1 and _is_sure(found[0], int(seen[frame]), size):
                trial = np.full(size, -1)
                trial[[i for i, _ in found[0]]] = [label for _, label in found[0]]
                break
            waiting[frame] = False
    return _fit_ordered(reference, observed, order)


def _fit_ordered(reference: FloatArray, observed: FloatArray, order: IntArray) -> BodyFit:
    """Fit each frame to the markers in its order; frames with equal markers at once."""
    count = len(observed)
    rotation, translation = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
    residual = np.full(count, np.nan)
    own = distances(reference)
    named = order >= 0
    for used in np.unique(named, axis=0):
        if not _is_unique(reference, own, used):
            continue
        rows = np.flatnonzero((named == used).all(axis=1))
        markers = np.take_along_axis(observed[rows], order[rows][:, used][:, :, None], axis=1)
        pose = fit_rigid(reference[used], markers)
        off = _residuals(reference[used], markers, pose)
        # Mirrored markers have correct distances; three of a larger set easily agree by chance.
        is_subset = used.sum() == MIN_MARKERS < len(used)
        fits = off <= (_TIGHT if is_subset else 1.0) * EDGE_TOLERANCE
        rows = rows[fits]
        rotation[rows], translation[rows] = pose.rotation[fits], pose.translation[fits]
        residual[rows] = off[fits]
    order = np.where(np.isfinite(residual)[:, None], order, -1)
    return BodyFit(Pose(rotation, translation), residual, order)


def _residuals(points: FloatArray, observed: FloatArray, pose: Pose) -> FloatArray:
    """RMS distance of observed points from those placed by the poses, shape (N,) [m]."""
    return np.asarray(np.sqrt((misfit(points, observed, pose) ** 2).mean(axis=1)))


def _is_unique(reference: FloatArray, own: FloatArray, used: BoolArray) -> bool:
    """Whether some markers of a body determine a pose and cannot be confused with others."""
    if used.all():
        return True
    if used.sum() < MIN_MARKERS or _width(reference[used]) < _MIN_DISTANCE:
        return False
    return len(_matches(own, own[np.ix_(used, used)], EDGE_TOLERANCE)) == 1


def _width(markers: FloatArray) -> float:
    """Largest distance of a marker from the line through the two farthest apart [m]."""
    a, b = np.unravel_index(distances(markers).argmax(), (len(markers), len(markers)))
    along = (markers[b] - markers[a]) / np.linalg.norm(markers[b] - markers[a])
    return float(np.linalg.norm(np.cross(markers - markers[a], along), axis=1).max())


_Match: TypeAlias = tuple[tuple[int, int], ...]  # pairs of (marker of the body, marker seen)


def _swaps(match: _Match) -> bool:
    return any(own != seen for own, seen in match)


def _is_sure(match: _Match, seen: int, size: int) -> bool:
    """Whether enough of the markers seen agree to exclude chance; matching labels count as one.

    All markers of a body suffice; three of a larger body do not.
    """
    majority = 2 * len(match) > seen and len(match) + (not _swaps(match)) > MIN_MARKERS
    return majority or len(match) == size


def _matches(own: FloatArray, seen: FloatArray, tolerance: float) -> list[_Match]:
    """One or two of the largest sets of pairs whose distances, (k, k) and (m, m), agree."""
    difference = np.abs(own[:, None, :, None] - seen[None, :, None, :])
    agree = np.nan_to_num(difference, nan=np.inf) <= tolerance  # of the pairs (i, a) and (j, b)
    count = len(seen)
    best: list[_Match] = [()]

    def extend(match: _Match, begin: int, allowed: BoolArray) -> None:
        """Add pairs of the markers seen from `begin` on; `allowed` pairs agree with the match."""
        if len(match) > len(best[0]):
            best[:] = [match]
        elif len(match) == len(best[0]) and len(best) < 2 and match not in best:
            best.append(match)
        for a in range(begin, count):
            bound = len(match) + int(allowed[:, a:].any(axis=0).sum())
            if bound < len(best[0]) or (bound == len(best[0]) and len(best) > 1):
                return
            for i in np.flatnonzero(allowed[:, a]):
                remaining = allowed & agree[i, a]
                remaining[i], remaining[:, a] = False, False
                extend((*match, (int(i), a)), a + 1, remaining)

    extend((), 0, np.broadcast_to(np.isfinite(np.diagonal(seen)), (len(own), count)))
    return best
