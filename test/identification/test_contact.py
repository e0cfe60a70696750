"""The contact laws against their definitions, and the models that use them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.problems import moving_limb, naive_gated, random_bed, random_socket

from socket_testbed.identification.contact import LAWS
from socket_testbed.settings.identification import PAPER_VARIANTS, VARIANTS

REFERENCE = np.array([0.01, -0.02, 0.15, 0.02, 0.1, -0.05])  # [m, rad]


def law_of(variant, geometry):
    return LAWS[variant](geometry.anchors, geometry.rotations, 2000.0, REFERENCE)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_motion_moves_the_tiles_as_a_limb_does_and_no_pose_predicts_nothing(rng, variant):
    """The whole limb in the paper's law, a rigid body about the reference in the rigid ones."""
    geometry = random_socket(rng)
    law = law_of(variant, geometry)
    pose = REFERENCE + rng.normal(0.0, [1e-3] * 3 + [1e-2] * 3, (5, 6))
    start = Rotation.from_rotvec(REFERENCE[3:])
    turns = (Rotation.from_rotvec(pose[:, 3:]) * start.inv()).as_rotvec()
    found = law.displacements(law.motion(pose))
    for tile, anchor in enumerate(geometry.anchors):
        moved = pose[:, :3] - REFERENCE[:3]
        if variant not in PAPER_VARIANTS:
            moved = moved + np.cross(turns, anchor - REFERENCE[:3])
        np.testing.assert_allclose(found[:, :, tile], moved @ law.frames[tile], atol=1e-15)
    bed, pose[4] = random_bed(rng, geometry, variant), np.nan
    forces = bed.forces(pose).reshape(5, -1)
    for values in (bed.wrench(pose), forces, *bed.cluster_forces(pose).values()):
        assert np.isnan(values[4]).all() and np.isfinite(values[:4]).all()


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_the_paper_s_model_is_its_springs_with_their_offsets(rng, variant):
    geometry = random_socket(rng)
    bed = random_bed(rng, geometry, variant)
    q = moving_limb(rng, 15)
    springs = bed.stiffness * naive_gated(q[:, None] - bed.rest_positions, bed.sharpness)
    moment = np.cross(geometry.anchors, springs).sum(axis=1)
    wrench = np.hstack([moment, springs.sum(axis=1)]) + bed.wrench_bias
    np.testing.assert_allclose(bed.wrench(q), wrench, atol=1e-10)
    local = bed.cluster_forces(q)
    assert set(local) == set(geometry.clusters)
    for name, tile in geometry.clusters.items():
        offset = geometry.rotations[tile] @ bed.force_bias.get(name, np.zeros(3))
        springs[:, tile] += offset
        expected = springs[:, tile] @ geometry.rotations[tile]
        np.testing.assert_allclose(local[name], expected, atol=1e-10)
    np.testing.assert_allclose(bed.forces(q), springs, atol=1e-10)
    with np.errstate(over="raise"):  # far out of contact the law keeps its overflow quiet
        assert (law_of(variant, geometry).columns(np.full((1, 3, 1), 1e3)) == 0.0).all()


def test_a_rigid_model_gates_in_the_tile_s_frame_and_never_pulls(rng):
    bed = random_bed(rng, random_socket(rng), "rigid")
    pose = np.hstack([rng.normal(0.0, 0.004, (40, 3)), rng.normal(0.0, 0.02, (40, 3))])
    forces, alpha = bed.forces(pose), bed.sharpness
    for tile, (kx, ky, kz) in enumerate(bed.stiffness):
        anchor, frame = bed.anchors[tile], bed.rotations[tile]
        moved = pose[:, :3] + np.cross(pose[:, 3:], anchor)
        x, y, z = (moved @ frame - bed.rest_positions[tile]).T
        opened = 0.5 - 0.5 * np.tanh(alpha * z)
        normal = -kz * np.log1p(np.exp(-2.0 * alpha * z)) / (2.0 * alpha)
        expected = np.stack([kx * opened * x, ky * opened * y, normal], axis=1)
        np.testing.assert_allclose(forces[:, tile] @ frame, expected, rtol=1e-9, atol=1e-9)
        assert normal.max() <= 0.0
