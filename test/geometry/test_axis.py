"""The socket's axis: where a tile is, in height and angle."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.ring_socket import ring_socket

from socket_testbed.geometry.axis import axis_through, proximal_direction, socket_axis


@pytest.fixture(scope="module")
def geometry():
    return ring_socket()


def test_tiles_in_rings_are_at_their_heights_and_angles(geometry):
    axis = socket_axis(geometry)
    np.testing.assert_allclose(axis.proximal, [0.0, 0.0, 1.0], atol=0.03)
    wall = [i for i, name in enumerate(geometry.names) if name.startswith("ring")]
    anchors = geometry.anchors[wall]
    expected = np.arctan2(anchors[:, 1], anchors[:, 0])
    turned = (axis.angles(anchors) - expected + np.pi) % (2.0 * np.pi) - np.pi
    np.testing.assert_allclose(turned, 0.0, atol=np.radians(4.0))
    heights = anchors[:, 2] - geometry.anchors[:, 2].min()
    np.testing.assert_allclose(axis.heights(anchors), heights, atol=0.003)
    np.testing.assert_allclose(axis.radii(anchors), np.hypot(*anchors[:, :2].T), atol=0.004)
    assert np.isclose(axis.heights(geometry.anchors).min(), 0.0)


def test_angles_count_from_anterior_towards_left():
    axis = axis_through(np.array([0.01, 0.02, 0.08]), np.array([0.0, 0.0, 2.0]))
    steps = np.array([[0.05, 0.0, 0.1], [0.0, 0.05, 0.0], [-0.05, 0.001, 0.0], [0.0, -1.0, 0.0]])
    around = axis.end + steps
    np.testing.assert_allclose(np.degrees(axis.angles(around)), [0, 90, 179, -90], atol=0.2)
    np.testing.assert_allclose(axis.heights(around), [0.1, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(axis.radii(around[0]), 0.05)
    for proximal in ([1.0, 0.0, 0.0], [0.6, 0.0, 0.8]):  # anterior is across any axis
        axis = axis_through(np.zeros(3), np.array(proximal))
        frame = np.stack([axis.anterior, axis.left, axis.proximal])
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)


def test_the_axis_turns_with_the_socket(geometry):
    turn = Rotation.from_euler("xyz", [50.0, -70.0, 120.0], degrees=True).as_matrix()
    turned = dataclasses.replace(
        geometry, rotations=turn @ geometry.rotations, anchors=geometry.anchors @ turn.T
    )
    np.testing.assert_allclose(
        proximal_direction(turned), turn @ proximal_direction(geometry), atol=1e-12
    )
    heights = socket_axis(geometry).heights(geometry.anchors)
    np.testing.assert_allclose(socket_axis(turned).heights(turned.anchors), heights, atol=1e-12)


def test_tiles_on_the_distal_end_or_around_a_point_have_the_axis_of_the_load_cell(geometry):
    quarters = Rotation.from_euler("z", [[0.0], [90.0], [180.0], [270.0]], degrees=True)
    for turns in (np.tile(np.diag([-1.0, -1.0, 1.0]), (len(geometry), 1, 1)), quarters.as_matrix()):
        end = dataclasses.replace(geometry, rotations=turns)
        np.testing.assert_array_equal(proximal_direction(end), [0.0, 0.0, 1.0])
