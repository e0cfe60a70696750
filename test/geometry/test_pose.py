"""Poses against scipy's rotations."""

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed.geometry.pose import Pose, rotation_vector


def test_quaternions_of_any_length_are_rotations_and_nothing_is_not() -> None:
    rng = np.random.default_rng(0)
    quaternions = rng.normal(size=(200, 4)) * 10.0 ** rng.integers(-3, 4, (200, 1))
    found = Pose.from_quaternion(np.zeros((200, 3)), quaternions).rotation
    expected = Rotation.from_quat(quaternions).as_matrix()
    np.testing.assert_allclose(found, expected, atol=3e-15, rtol=0.0)
    unusable = [[0.0] * 4, [np.nan, 0.0, 0.0, 1.0], [np.inf, 0.0, 0.0, 1.0]]
    with np.errstate(all="raise"):
        nothing = Pose.from_quaternion(np.zeros((3, 3)), np.array(unusable)).rotation
    assert np.isnan(nothing).all()


def test_a_rotation_vector_is_scipys_even_of_a_rounded_matrix() -> None:
    rng = np.random.default_rng(1)
    angles = np.concatenate([rng.uniform(0.0, np.pi, 200), [0.0, 1e-12, 1e-7, np.pi - 1e-7]])
    axes = rng.normal(size=(len(angles), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    matrices = Rotation.from_rotvec(angles[:, None] * axes).as_matrix()
    for matrix in (*matrices, *np.round(matrices[:200], 9)):
        expected = Rotation.from_matrix(matrix).as_rotvec()
        np.testing.assert_allclose(rotation_vector(matrix), expected, atol=1e-14, rtol=0.0)
    assert np.isnan(rotation_vector(np.full((3, 3), np.nan))).all()
