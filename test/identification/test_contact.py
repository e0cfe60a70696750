"""The contact laws against their definitions, and the models that use them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.problems import moving_limb, naive_gated, random_bed, random_socket

from socket_testbed.identification.contact import LAWS
from socket_testbed.settings.identification import PAPER_VARIANTS

REFERENCE = np.array([0.01, -0.02, 0.15, 0.02, 0.1, -0.05])  # [m, rad]


def law_of(variant, geometry):
    return LAWS[variant](geometry.anchors, geometry.rotations, 2000.0, REFERENCE)


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
    """A rigid body about the reference, far from {S}."""
    bed = replace(random_bed(rng, random_socket(rng), "rigid"), reference_pose=REFERENCE)
    shifts, turns = rng.normal(0.0, 0.004, (40, 3)), rng.normal(0.0, 0.02, (40, 3))
    turned = Rotation.from_rotvec(turns) * Rotation.from_rotvec(REFERENCE[3:])
    pose = np.hstack([REFERENCE[:3] + shifts, turned.as_rotvec()])
    forces, alpha = bed.forces(pose), bed.sharpness
    for tile, (kx, ky, kz) in enumerate(bed.stiffness):
        moved = shifts + np.cross(turns, bed.anchors[tile] - REFERENCE[:3])
        x, y, z = (moved @ bed.rotations[tile] - bed.rest_positions[tile]).T
        opened = 0.5 - 0.5 * np.tanh(alpha * z)
        normal = -kz * np.log1p(np.exp(-2.0 * alpha * z)) / (2.0 * alpha)
        expected = np.stack([kx * opened * x, ky * opened * y, normal], axis=1)
        found = forces[:, tile] @ bed.rotations[tile]
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
        assert normal.max() <= 0.0
    pose[4] = np.nan  # no pose predicts nothing
    predicted = np.hstack([bed.predict(pose, [*bed.cluster_points]), bed.forces(pose)[:, 0]])
    assert np.flatnonzero(np.isnan(predicted).any(axis=1)).tolist() == [4]
    assert np.isnan(predicted[4]).all()
