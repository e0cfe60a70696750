"""What the interior is found with: samples, the axis, the view from the spine."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.meshes import FULL, open_cone, shell

from socket_testbed.socket_design.interior import (
    SurfaceSamples,
    Visibility,
    inner_wall,
    lay_spine,
    look,
    spread_samples,
)
from socket_testbed.socket_design.mesh import fit_axis, sample_surface

UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("spacing", [0.5, 0.04, 0.011])
def test_samples_lie_in_their_faces_evenly_and_as_close_as_asked(spacing):
    corners = np.random.default_rng(2).uniform(0.0, 0.1, (5, 3, 3))
    surface = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(15).reshape(5, 3), process=False)
    owners, points = sample_surface(surface, spacing)
    for face, triangle in enumerate(corners):
        own = points[owners == face]
        weights = np.linalg.solve(triangle.T, own.T).T
        # The triangle's plane misses the origin, so its points have weights that add up to one.
        np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-9)
        assert weights.min() > 0.0
        np.testing.assert_allclose(weights.mean(axis=0), 1.0 / 3.0, atol=1e-9)
        longest = np.linalg.norm(triangle - np.roll(triangle, 1, axis=0), axis=1).max()
        assert len(own) == np.ceil(longest / spacing) ** 2


@pytest.mark.parametrize(
    "mesh",
    [
        open_cone(0.04, 0.06, 0.2, 0.008, dome=True),
        open_cone(0.05, 0.05, 0.03, 0.008),
        open_cone(0.04, 0.06, 0.2, 0.008, arc=FULL / 5.0),
        shell(0.04, 0.06, 0.2, 0.008, 0.005),
    ],
    ids=["cup", "dish", "strip", "shell"],
)
def test_the_axis_of_a_surface_of_revolution_is_found_in_any_pose(mesh):
    turn, shift = Rotation.random(random_state=8), np.array([0.3, -0.2, 0.5])
    posed = trimesh.Trimesh(turn.apply(mesh.vertices) + shift, mesh.faces, process=False)
    best = fit_axis(posed).likely()[0]
    axis = turn.apply(UP)
    assert np.linalg.norm(np.cross(best.direction, axis)) < 0.01
    assert np.linalg.norm(np.cross(best.origin - shift, axis)) < 0.001


def tube(radius: float, front: bool) -> trimesh.Trimesh:
    """A tube that turns its front, or else its back, to the axis."""
    mesh = open_cone(radius, radius, 0.2, 0.006, closed=False)
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, :: 1 if front else -1], process=False)


@pytest.mark.parametrize(
    ("fronts", "seen", "hidden", "share"),
    [
        ((True,), [0], [], 1.0),
        ((False,), [], [], 0.0),
        ((True, False), [0], [1], 1.0),
        ((False, True), [], [], 0.0),
        ((True, False, True), [0], [1], 1.0),
    ],
)
def test_of_nested_tubes_the_first_front_is_seen_and_backs_behind_it_are_hidden(
    fronts, seen, hidden, share
):
    tubes = [tube(0.04 + 0.01 * i, front) for i, front in enumerate(fronts)]
    surface = trimesh.util.concatenate(tubes)
    which = np.repeat(np.arange(len(tubes)), [len(mesh.faces) for mesh in tubes])
    samples = SurfaceSamples(*sample_surface(surface, 0.003), 0.003)
    (axis, *_) = fit_axis(surface).likely()
    visibility = look(surface, samples, lay_spine(axis, surface))
    # The tubes' edges are seen past each other: what counts lies between them.
    amid = np.abs(surface.triangles_center[:, 2] - 0.1) < 0.05
    np.testing.assert_array_equal(visibility.seen[amid], np.isin(which, seen)[amid])
    np.testing.assert_array_equal(visibility.hidden[amid], np.isin(which, hidden)[amid])
    assert visibility.front_share == pytest.approx(share, abs=0.1)
    np.testing.assert_allclose(
        visibility.facing[amid], np.where(np.array(fronts)[which[amid]], 1.0, -1.0), atol=0.01
    )


def test_where_nothing_is_seen_there_is_no_wall():
    surface = tube(0.05, True)
    samples = spread_samples(surface)
    nothing = np.zeros(len(surface.faces), bool)
    assert not inner_wall(surface, samples, Visibility(nothing + 0.0, nothing, nothing, 0.0)).any()
