"""What the interior is found with: the axis, the view from the spine."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.meshes import FULL, open_cone, shell

from socket_testbed.socket_design.interior import fit_axis, lay_spine, look, spread_samples

UP = np.array([0.0, 0.0, 1.0])


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
    (axis, *_) = fit_axis(surface).likely()
    visibility = look(surface, spread_samples(surface), lay_spine(axis, surface))
    # The tubes' edges are seen past each other: what counts lies between them.
    amid = np.abs(surface.triangles_center[:, 2] - 0.1) < 0.05
    # The samples are random: a few faces in ten thousand are misjudged; `inner_wall` fills them.
    assert (visibility.seen != np.isin(which, seen))[amid].mean() < 1e-3
    assert (visibility.hidden != np.isin(which, hidden))[amid].mean() < 1e-3
    assert visibility.front_share == pytest.approx(share, abs=0.1)
    np.testing.assert_allclose(
        visibility.facing[amid], np.where(np.array(fronts)[which[amid]], 1.0, -1.0), atol=0.01
    )
