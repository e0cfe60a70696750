"""Frames of the bodies that carry marker triads.

A body without a frame of its own gets this one: origin at its first marker, x towards the
second, z along the normal of the plane of the three, ``z ~ x x (m3 - m1)``, and y = z x x.
"""

from __future__ import annotations

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import RegistrationError
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.rigid import fit_rigid
from socket_testbed.geometry.triad import TriadFit, edge_lengths, fit_triad, triad_fault


def own_frame(markers: FloatArray) -> Pose:
    """Pose of a triad's own frame (see above) in the frame of its markers.

    Args:
        markers: A triad that is not on one line, shape (3, 3) [m].
    """
    x = _direction(markers[1] - markers[0])
    z = _direction(np.cross(x, markers[2] - markers[0]))
    return Pose(np.column_stack([x, np.cross(z, x), z]), markers[0])


def fit_labels(observed: FloatArray, where: str) -> TriadFit:
    """Find which observed marker is which, from the edges that most of the frames agree on.

    Labels that are swapped in fewer than half of the frames are put right: `TriadFit.order`.

    Args:
        observed: The triad over N frames, shape (N, 3, 3) [m]; NaN where occluded.
        where: What names the triad in an error.

    Raises:
        RegistrationError: If no frame shows all three markers, or if their triangle is too
            small, flat or symmetric for a body.
    """
    edges = edge_lengths(observed)
    seen = np.isfinite(edges).all(axis=1)
    if not seen.any():
        raise RegistrationError(
            f"{where}: no frame shows all three markers", "check their labels in Motive"
        )
    usual = np.median(edges[seen], axis=0)
    fault = triad_fault(usual)
    if fault:
        raise RegistrationError(f"{where}: {fault[0]}", fault[1])
    return fit_triad(_triangle(usual), observed)


def relabel(observed: FloatArray, order: IntArray) -> FloatArray:
    """Triads in the order that a fit found, shape (N, 3, 3) [m]; as they are where it has none.

    Args:
        observed: The triad over N frames, shape (N, 3, 3) [m].
        order: `TriadFit.order`, shape (N, 3).
    """
    known = np.where(order < 0, np.arange(3), order)
    return np.take_along_axis(observed, known[:, :, None], axis=1)


def tracked_frame(markers: FloatArray, body: Pose, where: str) -> Pose:
    """Pose of a frame that was tracked over N frames, in which a triad stood still.

    The markers are taken into the tracked frame, where the median leaves out the frames in
    which the tracking went wrong, and the frame is fitted to the mean of the markers.

    Args:
        markers: The triad, shape (N, 3, 3) [m].
        body: N poses of the tracked frame in the frame of the markers; NaN where it was lost.
        where: What names the body in an error.

    Raises:
        RegistrationError: If the frame was tracked in less than half of the frames.
    """
    tracked = np.isfinite(body.rotation).all(axis=(1, 2)) & np.isfinite(body.translation).all(1)
    if 2 * tracked.sum() < len(markers):
        raise RegistrationError(
            f"{where}: Motive tracked its rigid body in {int(tracked.sum())} of {len(markers)}"
            " frames that show its markers",
            "name its three markers instead of 'rigid_body'",
        )
    arms = markers[tracked] - body.translation[tracked, None]
    in_body = np.median(arms @ body.rotation[tracked], axis=0)
    pose = fit_rigid(in_body, markers.mean(axis=0)[None])
    return Pose(pose.rotation[0], pose.translation[0])


def _direction(vector: FloatArray) -> FloatArray:
    return vector / np.linalg.norm(vector)


def _triangle(edges: FloatArray) -> FloatArray:
    """A triad in its own frame from its edges 0-1, 1-2 and 2-0, shape (3, 3) [m]."""
    base, opposite, side = edges
    x = (base**2 + side**2 - opposite**2) / (2.0 * base)
    y = np.sqrt(side**2 - x**2)
    return np.array([[0.0, 0.0, 0.0], [base, 0.0, 0.0], [x, y, 0.0]])
