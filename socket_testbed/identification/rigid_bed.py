r"""The contact law of the `rigid` variants: tiles that a rigid limb presses on.

With the pose of the limb relative to a reference pose (position c, rotation R_ref), that is its
displacement q - c and its rotation vector phi, the tile at a_i is displaced by

.. math:: u_i = q - c + \phi \times (a_i - c), \qquad v_i = R_i^T u_i, \qquad
          \delta_i = v_i - r_i

with v_i in the tile's own frame {L_i} (z along the inward normal) and r_i its rest displacement,
at which the tile bears nothing. Compression along the normal gates normal and shear alike:

.. math:: F_i = \left( k_x g \delta_x,\; k_y g \delta_y,\; -k_z p \right), \qquad
          p = \frac{\ln(1 + e^{-2 \alpha \delta_z})}{2 \alpha}, \qquad
          g = -\frac{dp}{d\delta_z} = \frac{1}{1 + e^{2 \alpha \delta_z}}

g is the paper's gate; p is its integral, so that a tile never pulls, and its stiffness grows over
the first 1 / alpha of compression as that of a layer that comes into contact bit by bit.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed.arrays import FloatArray

# Axis of a tile's force and the parameter that it depends on: 0 to 2 are the stiffnesses along
# x, y, z of the tile's frame, 3 to 5 the rest displacements.
PAIRS = ((0, 0), (0, 3), (0, 5), (1, 1), (1, 4), (1, 5), (2, 2), (2, 5))


def mean_pose(pose: FloatArray) -> FloatArray:
    """Mean of poses on SE(3), shape (6,) [m, rad].

    Args:
        pose: Position and rotation vector, shape (N, 6), without NaN [m, rad].
    """
    rotation = Rotation.from_rotvec(pose[:, 3:]).mean().as_rotvec()
    return np.concatenate([pose[:, :3].mean(axis=0), rotation])


def relative_pose(pose: FloatArray, reference: FloatArray) -> FloatArray:
    """Displacement and rotation vector since a reference pose, both in {S}.

    Args:
        pose: Position and rotation vector, shape (N, 6) [m, rad].
        reference: The same of the reference, shape (6,) [m, rad].

    Returns:
        ``[q - c, phi]`` with ``R = exp(phi) R_ref``, shape (N, 6) [m, rad]; NaN where the pose is.
    """
    # By quaternions (w, v): one pose takes a fifth of the time that scipy's rotations take.
    w, v = _quaternions(pose[:, 3:])
    w0, v0 = _quaternions(reference[None, 3:])
    (x, y, z), c = v0[0].tolist(), w0.item()
    turn = np.array([[c, z, -y], [-z, c, x], [y, -x, c]])  # v turn = c v + v0 x v
    w, v = w * w0 + v @ v0.T, v @ turn - w * v0
    size = np.sqrt((v * v).sum(axis=1, keepdims=True))
    angle = 2.0 * np.arctan2(size, np.abs(w)) * np.where(w < 0.0, -1.0, 1.0)
    turned = v * (angle / np.where(size > 0.0, size, 1.0))
    return np.hstack([pose[:, :3] - reference[:3], turned])


def _quaternions(rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Scalar parts, shape (N, 1), and vector parts, shape (N, 3), for rotation vectors (N, 3)."""
    half = 0.5 * np.sqrt((rotation * rotation).sum(axis=1, keepdims=True))
    return np.cos(half), 0.5 * np.sinc(half / np.pi) * rotation


def displacement_map(anchors: FloatArray, rotations: FloatArray, centre: FloatArray) -> FloatArray:
    """Map of a relative pose onto the tiles' displacements in their frames, ``v = J [d, phi]``.

    Args:
        anchors: Tiles' centres a_i, shape (n, 3) [m].
        rotations: Frames {L_i} of the tiles, shape (n, 3, 3) [-].
        centre: Position c of the reference pose, shape (3,) [m].

    Returns:
        Array of shape (3n, 6) [-, m].
    """
    arms = np.cross(np.eye(3)[None], (anchors - centre)[:, None])  # (n, 3, 3): e_j x arm
    turns = np.einsum("nia,nji->naj", rotations, arms)
    return np.concatenate([rotations.transpose(0, 2, 1), turns], axis=2).reshape(-1, 6)


def compression(displacement: FloatArray, sharpness: float) -> tuple[FloatArray, FloatArray]:
    """Compression p [m] and gate g [-] for normal displacements from rest of any shape [m]."""
    growth = (2.0 * sharpness) * displacement
    with np.errstate(over="ignore", invalid="ignore"):
        gate = 1.0 / (1.0 + np.exp(growth))
        pressed = np.logaddexp(0.0, -growth) / (2.0 * sharpness)
    return pressed, gate


def spring_displacements(
    displacement: FloatArray, rest: FloatArray, sharpness: float
) -> FloatArray:
    """Gated displacements (g delta_x, g delta_y, -p), by which the stiffness is multiplied.

    Args:
        displacement: Tiles' displacements v in their frames, shape (N, n, 3) [m].
        rest: Rest displacements r, shape (n, 3) [m].
        sharpness: Sharpness alpha of the gate [1/m].

    Returns:
        Array of shape (N, n, 3) [m].
    """
    gated = displacement - rest
    pressed, gate = compression(gated[..., 2], sharpness)
    gated[..., :2] *= gate[..., None]
    gated[..., 2] = -pressed
    return gated


def gate_slope(gate: FloatArray, sharpness: float) -> FloatArray:
    """Derivative of gates g by delta_z, of the same shape [1/m]."""
    return -2.0 * sharpness * gate * (1.0 - gate)


def force_derivatives(
    moved: FloatArray,
    pressed: FloatArray,
    gate: FloatArray,
    stiffness: FloatArray,
    sharpness: float,
) -> FloatArray:
    """Derivatives of the tiles' forces in their frames by the parameters, in the order of `PAIRS`.

    Args:
        moved: Displacements delta from rest, shape (N, 3, n) [m].
        pressed: Compressions p, shape (N, n) [m].
        gate: Gates g, shape (N, n) [-].
        stiffness: Stiffnesses, shape (3, n) [N/m].
        sharpness: Sharpness alpha of the gate [1/m].

    Returns:
        Array of shape (N, 8, n) [m, N/m].
    """
    bend = gate_slope(gate, sharpness)
    columns = []
    for axis in (0, 1):
        columns.append(gate * moved[:, axis])
        columns.append(-gate * stiffness[axis])
        columns.append(-bend * moved[:, axis] * stiffness[axis])
    return np.stack([*columns, -pressed, -gate * stiffness[2]], axis=1)


def force_changes(
    displacement: FloatArray,
    stiffness: FloatArray,
    rest: FloatArray,
    sharpness: float,
    changes: FloatArray,
) -> FloatArray:
    """How small changes of the parameters change the forces, to first order.

    Args:
        displacement: Tiles' displacements in their frames, shape (N, n, 3) [m].
        stiffness: Stiffnesses, shape (3, n) [N/m].
        rest: Rest displacements, shape (3, n) [m].
        sharpness: Sharpness alpha of the gate [1/m].
        changes: Changes of stiffnesses and rest displacements, r of them, shape (6, n, r)
            [N/m, m].

    Returns:
        Changes of the forces in the tiles' frames, shape (N, n, 3, r) [N].
    """
    moved = displacement.transpose(0, 2, 1) - rest
    pressed, gate = compression(moved[:, 2], sharpness)
    columns = force_derivatives(moved, pressed, gate, stiffness, sharpness)
    changed = np.zeros((*displacement.shape, changes.shape[2]))
    for k, (axis, parameter) in enumerate(PAIRS):
        changed[:, :, axis] += columns[:, k, :, None] * changes[parameter]
    return changed
