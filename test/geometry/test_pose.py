"""Poses: against scipy's rotations and homogeneous matrices."""

import numpy as np
from scipy.spatial.transform import Rotation
from support.problems import random_pose

from socket_testbed.geometry.pose import (
    Pose,
    rotation_of,
    rotation_vector,
    rotation_vectors,
    turned_quaternion,
)


def homogeneous(pose: Pose) -> np.ndarray:
    """Poses as 4 x 4 matrices, (4, 4) or (N, 4, 4)."""
    matrix = np.zeros((*pose.rotation.shape[:-2], 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = pose.rotation, pose.translation, 1
    return matrix


def test_quaternions_of_any_length_are_rotations_and_nothing_is_not() -> None:
    rng = np.random.default_rng(0)
    quaternions = rng.normal(size=(200, 4)) * 10.0 ** rng.integers(-6, 7, (200, 1))
    bad = [[0.0] * 4, [np.nan, 0.0, 0.0, 1.0], [np.inf, 0.0, 0.0, 1.0], [np.nan] * 4]
    quaternions[[3, 50, 51, 199]] = bad
    unusable = np.isin(np.arange(200), [3, 50, 51, 199])
    with np.errstate(all="raise"):
        pose = Pose.from_quaternion(rng.normal(size=(200, 3)), quaternions)
    expected = Rotation.from_quat(quaternions[~unusable]).as_matrix()
    np.testing.assert_allclose(pose.rotation[~unusable], expected, atol=3e-15, rtol=0.0)
    assert np.isnan(pose.rotation[unusable]).all()
    for values in (pose.quaternion(), pose.rotation_vector()):
        np.testing.assert_array_equal(np.isnan(values).all(axis=1), unusable)
    back = Pose.from_quaternion(pose.translation, pose.quaternion())
    np.testing.assert_allclose(back.rotation, pose.rotation, atol=1e-14)
    single = Pose(pose.rotation[0], pose.translation[0])
    np.testing.assert_allclose(single.quaternion(), pose.quaternion()[0], atol=1e-15)


def test_quaternions_are_ordered_x_y_z_w() -> None:
    half = np.sqrt(0.5)
    pose = Pose.from_quaternion(np.zeros((1, 3)), np.array([[0.0, 0.0, half, half]]))
    turned = pose.apply(np.array([[1.0, 0.0, 0.0]]))  # a quarter turn about z
    np.testing.assert_allclose(turned, [[0.0, 1.0, 0.0]], atol=1e-15)


def test_rotation_vectors_and_products_are_scipys_even_of_rounded_matrices() -> None:
    rng = np.random.default_rng(1)
    angles = np.concatenate([rng.uniform(0.0, np.pi, 50), [0.0, 1e-12, 1e-7, np.pi - 1e-7]])
    axes = rng.normal(size=(len(angles), 3))
    turns = Rotation.from_rotvec(angles[:, None] * axes / np.linalg.norm(axes, axis=1)[:, None])
    matrices = turns.as_matrix()
    np.testing.assert_allclose(rotation_vectors(matrices), turns.as_rotvec(), atol=1e-13)
    for matrix in (*matrices, *np.round(matrices[:50], 9)):
        expected = Rotation.from_matrix(matrix).as_rotvec()
        np.testing.assert_allclose(rotation_vector(matrix), expected, atol=1e-14, rtol=0.0)
    assert np.isnan(rotation_vector(np.full((3, 3), np.nan))).all()
    first = Rotation.random(rng=rng)
    for turn in turns:
        quaternion = turned_quaternion(first.as_matrix(), turn.as_rotvec())
        expected = (first * turn).as_matrix()
        np.testing.assert_allclose(rotation_of(quaternion), expected, atol=1e-14)


def test_poses_compose_and_invert_as_homogeneous_matrices_singly_and_in_batches() -> None:
    rng = np.random.default_rng(2)
    for first, second in (
        (random_pose(rng), random_pose(rng)),
        (random_pose(rng, count=10), random_pose(rng, count=10)),
        (random_pose(rng), random_pose(rng, count=4)),
    ):
        product = homogeneous(first) @ homogeneous(second)
        np.testing.assert_allclose(homogeneous(first @ second), product, atol=1e-14)
        inverse = np.linalg.inv(homogeneous(second))
        np.testing.assert_allclose(homogeneous(second.inverse()), inverse, atol=1e-14)
        points = rng.normal(size=second.translation.shape)
        back = second.inverse().apply(second.apply(points))
        np.testing.assert_allclose(back, points, atol=1e-14)
