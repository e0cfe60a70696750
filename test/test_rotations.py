"""Conversions of rotations, against SciPy's and against turns known by hand."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from socket_testbed import rotations
from socket_testbed.arrays import FloatArray

HALF = np.sqrt(0.5)
# Near no turn, near half turns about each axis, and any other.
QUATERNIONS = np.vstack(
    [
        np.eye(4),
        np.eye(4) + 1e-9,
        np.eye(4) - 1e-3,
        [0.0, 0.0, HALF, HALF],
        np.random.default_rng(1).normal(size=(200, 4)),
    ]
)


def unsigned(quaternions: FloatArray) -> FloatArray:
    """The squares and products of quaternions, which their sign does not change."""
    return np.einsum("...i,...j->...ij", quaternions, quaternions)


def test_matrices_are_scipys() -> None:
    expected = Rotation.from_quat(QUATERNIONS).as_matrix()
    assert rotations.quaternions_to_matrices(QUATERNIONS) == pytest.approx(expected, abs=1e-15)
    one = rotations.quaternions_to_matrices(QUATERNIONS[-1])
    assert one == pytest.approx(expected[-1], abs=1e-15)


def test_quaternions_are_scipys_with_the_same_sign() -> None:
    matrices = Rotation.from_quat(QUATERNIONS).as_matrix()
    expected = Rotation.from_matrix(matrices).as_quat()
    assert rotations.matrices_to_quaternions(matrices) == pytest.approx(expected, abs=1e-15)
    assert rotations.matrices_to_quaternions(matrices[9]) == pytest.approx(expected[9], abs=1e-15)


def test_rotation_vectors_are_scipys_and_at_most_half_a_turn() -> None:
    quaternions = QUATERNIONS[QUATERNIONS[:, 3] != 0.0]  # half turns have two vectors
    for sign in (1.0, -2.0):
        found = rotations.quaternions_to_vectors(sign * quaternions)
        expected = Rotation.from_quat(quaternions).as_rotvec()
        assert found == pytest.approx(expected, abs=3e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-4, 1.0, 3.0, 7.0])
def test_quaternions_of_rotation_vectors_are_scipys(angle: float) -> None:
    vector = angle * np.array([2.0, -1.0, 2.0]) / 3.0
    found = rotations.vectors_to_quaternions(vector)
    expected = Rotation.from_rotvec(vector).as_quat()
    assert unsigned(found) == pytest.approx(unsigned(expected), abs=1e-15)


def test_the_second_rotation_is_applied_first() -> None:
    about_x, about_z = np.array([HALF, 0.0, 0.0, HALF]), np.array([0.0, 0.0, HALF, HALF])
    turned = rotations.quaternions_to_matrices(rotations.compose(about_x, about_z))
    # z turns x to y, and x then turns y to z.
    assert turned @ [1.0, 0.0, 0.0] == pytest.approx([0.0, 0.0, 1.0], abs=1e-15)


def test_an_inverted_rotation_turns_back() -> None:
    unit = QUATERNIONS / np.linalg.norm(QUATERNIONS, axis=1, keepdims=True)
    none = rotations.compose(unit, rotations.inverted(unit))
    assert unsigned(none) == pytest.approx(np.broadcast_to(np.diag([0, 0, 0, 1]), (213, 4, 4)))


@pytest.mark.parametrize(
    ("convert", "shape"),
    [
        (rotations.quaternions_to_matrices, (4,)),
        (rotations.matrices_to_quaternions, (3, 3)),
        (rotations.quaternions_to_vectors, (4,)),
        (rotations.vectors_to_quaternions, (3,)),
    ],
)
def test_an_unknown_rotation_stays_unknown_and_others_are_converted(
    convert: Callable[[FloatArray], FloatArray], shape: tuple[int, ...]
) -> None:
    known = np.eye(3) if shape == (3, 3) else np.full(shape, 0.5)
    both = convert(np.array([np.full(shape, np.nan), known]))
    assert np.isnan(both[0]).all()
    assert both[1] == pytest.approx(convert(known))
