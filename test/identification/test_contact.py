"""The contact laws against their definitions, and the models that use them."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.problems import moving_limb, naive_gated, random_bed, random_socket, uniform_bed

from socket_testbed.identification.contact import LAWS
from socket_testbed.identification.contact_law import gate, wrench_map
from socket_testbed.identification.rigid_law import relative_pose
from socket_testbed.settings.identification import PAPER_VARIANTS, VARIANTS

ALPHA = 2000.0  # [1/m]


@pytest.fixture
def rng():
    return np.random.default_rng(1)


def law_of(variant, geometry, sharpness=ALPHA, reference=(0.01, -0.02, 0.15, 0.02, 0.1, -0.05)):
    return LAWS[variant](geometry.anchors, geometry.rotations, sharpness, np.array(reference))


def test_gate_is_the_paper_s_open_in_compression_and_shut_in_tension():
    d = np.array([-1.0, -0.01, -1e-4, 0.0, 1e-4, 0.01, 1.0])
    with np.errstate(over="raise"):  # the law itself must keep its overflow quiet
        np.testing.assert_allclose(gate(d, ALPHA), 0.5 - 0.5 * np.tanh(ALPHA * d), atol=1e-15)


@pytest.mark.parametrize("sharpness", [1.0, 1e5])
def test_columns_of_the_paper_s_law_are_the_gated_displacements(rng, sharpness):
    law = law_of("stiffness", random_socket(rng), sharpness)
    moved = rng.uniform(-0.01, 0.01, (20, 3, 7))
    before = moved.copy()
    np.testing.assert_allclose(law.columns(moved), naive_gated(moved, sharpness), atol=1e-16)
    np.testing.assert_array_equal(moved, before)
    far = law.columns(np.full((1, 3, 1), 1e3))
    np.testing.assert_array_equal(far, np.zeros((1, 3, 1)))
    d = np.linspace(0.0, 10.0 / sharpness, 10_001)[:, None, None] * np.ones((1, 3, 1))
    # A property of the paper's gate: how much a spring can pull.
    assert law.columns(d).max() * sharpness == pytest.approx(0.139, abs=5e-4)


@pytest.mark.parametrize("variant", [v for v in VARIANTS if LAWS[v].REFINED])
def test_slopes_and_bends_are_the_derivatives_of_the_columns(rng, variant):
    law = law_of(variant, random_socket(rng), 300.0)
    moved, step = rng.uniform(-0.004, 0.004, (30, 3, 5)), 1e-7  # [m]
    slopes, bends = law.slopes(moved), law.bends(moved)
    for along in range(3):
        change = step * np.eye(3)[along][:, None]
        after, before = (law.columns(moved + sign * change) for sign in (1.0, -1.0))
        steeper, flatter = (law.slopes(moved + sign * change) for sign in (1.0, -1.0))
        for axis in range(3):
            expected = (after - before)[:, axis] / (2.0 * step)
            np.testing.assert_allclose(slopes.get((axis, along), 0.0), expected, atol=1e-6)
            for other in range(along + 1):
                none = np.zeros((30, 5))
                bend = steeper.get((axis, other), none) - flatter.get((axis, other), none)
                found = bends.get((axis, other, along), none)
                np.testing.assert_allclose(found, bend / (2.0 * step), atol=2e-4 * 300.0)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_motion_moves_the_tiles_as_a_limb_does(rng, variant):
    """The whole limb in the paper's law, a rigid body about the reference in the rigid ones."""
    geometry = random_socket(rng)
    law = law_of(variant, geometry)
    pose = law.reference_pose + rng.normal(0.0, [1e-3] * 3 + [1e-2] * 3, (5, 6))
    start = Rotation.from_rotvec(law.reference_pose[3:])
    turns = (Rotation.from_rotvec(pose[:, 3:]) * start.inv()).as_rotvec()
    found = law.displacements(law.motion(pose))
    for tile, anchor in enumerate(geometry.anchors):
        moved = pose[:, :3] - law.reference_pose[:3]
        if variant not in PAPER_VARIANTS:
            moved = moved + np.cross(turns, anchor - law.reference_pose[:3])
        np.testing.assert_allclose(found[:, :, tile], moved @ law.frames[tile], atol=1e-15)


def test_what_the_springs_leave_is_a_constant_and_a_slope_over_the_pose(rng):
    law = law_of("rigid_bias", random_socket(rng))
    motion, slope = rng.normal(0.0, 1e-3, (300, 6)), rng.normal(0.0, 1e4, (6, 6))
    residual = 5.0 + motion @ slope.T
    constant, found = law.wrench_offsets(motion, residual, 50.0 * motion)
    np.testing.assert_allclose(found, slope, atol=0.02 * np.abs(slope).max())
    np.testing.assert_allclose(constant, 5.0, atol=0.1)


def test_a_relative_pose_is_none_where_the_pose_is_none(rng):
    pose = rng.normal(size=(4, 6))
    pose[1, 2] = pose[2, 4] = np.nan
    found = relative_pose(pose, pose[0])
    np.testing.assert_allclose(found[0], 0.0, atol=1e-15)
    assert np.isnan(found[1:3]).all() and np.isfinite(found[3]).all()
    assert np.isnan(relative_pose(pose[1:3], pose[0])).all()


def test_wrench_map_sums_the_moments_and_the_forces(rng):
    anchors, forces = rng.normal(size=(9, 3)), rng.normal(size=(9, 3))
    expected = np.concatenate([np.cross(anchors, forces).sum(axis=0), forces.sum(axis=0)])
    np.testing.assert_allclose(wrench_map(anchors) @ forces.reshape(-1), expected, rtol=1e-12)


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_the_paper_s_model_is_its_springs_with_their_offsets(rng, variant):
    geometry = random_socket(rng)
    bed = random_bed(rng, geometry, variant)
    q = moving_limb(rng, 15)
    springs = bed.stiffness * naive_gated(q[:, None] - bed.rest_positions, bed.sharpness)
    moment = np.cross(geometry.anchors, springs).sum(axis=1)
    wrench = np.hstack([moment, springs.sum(axis=1)]) + bed.wrench_bias
    np.testing.assert_allclose(bed.wrench(q), wrench, atol=1e-10)
    forces, local = bed.forces(q), bed.cluster_forces(q)
    assert set(local) == set(geometry.clusters)
    for tile in range(len(geometry)):
        offset = np.zeros(3)
        for name in (name for name, point in geometry.clusters.items() if point == tile):
            offset = geometry.rotations[tile] @ bed.force_bias.get(name, np.zeros(3))
            expected = (springs[:, tile] + offset) @ geometry.rotations[tile]
            np.testing.assert_allclose(local[name], expected, atol=1e-10)
        np.testing.assert_allclose(forces[:, tile], springs[:, tile] + offset, atol=1e-10)


def test_a_rigid_model_gates_in_the_tile_s_frame_and_never_pulls(rng):
    geometry = random_socket(rng)
    bed = uniform_bed(geometry, [2000.0, 1500.0, 6000.0])
    pose = np.hstack([rng.normal(0.0, 0.004, (40, 3)), rng.normal(0.0, 0.02, (40, 3))])
    forces, alpha = bed.forces(pose), bed.sharpness
    for tile, (anchor, frame) in enumerate(zip(bed.anchors, bed.rotations, strict=True)):
        moved = pose[:, :3] + np.cross(pose[:, 3:], anchor)
        x, y, z = (moved @ frame - bed.rest_positions[tile]).T
        opened = 0.5 - 0.5 * np.tanh(alpha * z)
        normal = -6000.0 * np.log1p(np.exp(-2.0 * alpha * z)) / (2.0 * alpha)
        expected = np.stack([2000.0 * opened * x, 1500.0 * opened * y, normal], axis=1)
        np.testing.assert_allclose(forces[:, tile] @ frame, expected, rtol=1e-9, atol=1e-9)
        assert normal.max() <= 0.0


def test_forces_of_a_rigid_model_do_not_depend_on_the_frame_of_the_load_cell(rng):
    """The bed in a rotated {S} gives the rotated forces."""
    bed = uniform_bed(
        random_socket(rng), [2e3, 2e3, 6e3], reference_pose=np.array([0, 0, 0.1, 0.1, 0, 0.2])
    )
    pose = bed.reference_pose + rng.normal(0.0, 0.01, (5, 6))
    turn = Rotation.from_rotvec([0.3, -0.8, 0.5])
    R = turn.as_matrix()

    def turned(pose):
        rotated = (turn * Rotation.from_rotvec(pose[..., 3:])).as_rotvec()
        return np.concatenate([pose[..., :3] @ R.T, rotated], axis=-1)

    other = dataclasses.replace(
        bed,
        anchors=bed.anchors @ R.T,
        rotations=R @ bed.rotations,
        reference_pose=turned(bed.reference_pose),
    )
    np.testing.assert_allclose(other.forces(turned(pose)), bed.forces(pose) @ R.T, atol=1e-9)


@pytest.mark.parametrize("variant", VARIANTS)
def test_predict_is_the_wrench_and_the_forces_and_nothing_without_a_pose(rng, variant):
    bed = random_bed(rng, random_socket(rng), variant)
    pose = np.hstack([moving_limb(rng, 10), rng.normal(0.0, 0.02, (10, 3))])
    pose[4] = np.nan
    wrench, forces = bed.predict(pose)
    np.testing.assert_allclose(wrench, bed.wrench(pose), rtol=1e-12)
    np.testing.assert_allclose(forces, bed.forces(pose), rtol=1e-12)
    for values in (wrench, forces.reshape(10, -1), *bed.cluster_forces(pose).values()):
        assert np.isnan(values[4]).all() and np.isfinite(np.delete(values, 4, axis=0)).all()
