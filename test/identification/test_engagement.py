"""The engaged springs against the definition, spring by spring, and against drawn noise."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.problems import make_samples, moving_limb, random_bed, random_socket

from socket_testbed.identification import information as module
from socket_testbed.identification.contact_law import gate
from socket_testbed.identification.information import engagement


def samples_of(position, rotation=None):
    samples = make_samples(position, np.zeros((len(position), 6)), {})
    return samples if rotation is None else dataclasses.replace(samples, rotation=rotation)


def test_a_spring_is_engaged_where_its_gate_is_half_open_and_it_is_stiff(monkeypatch):
    rng = np.random.default_rng(3)
    monkeypatch.setattr(module, "_BLOCK", 7)
    bed = random_bed(rng, random_socket(rng), untouched=0.3)
    q = moving_limb(rng, 40)
    q[5] = np.nan
    found = engagement(samples_of(q), bed, rows=slice(4, 24))
    expected = np.zeros((40, *bed.stiffness.shape), dtype=bool)
    for k, i, j in np.ndindex(expected.shape):
        open_gate = gate(q[k, j] - bed.rest_positions[i, j], bed.sharpness) > 0.5
        expected[k, i, j] = open_gate and bed.stiffness[i, j] > 0.0
    numbers = np.where(np.arange(40) == 5, np.nan, expected.sum(axis=(1, 2)))
    np.testing.assert_array_equal(found.engaged, numbers)
    share = found.columns("")["engaged_share [-]"]
    np.testing.assert_array_equal(share, numbers / bed.stiffness.size)
    chosen = np.delete(expected, 5, axis=0)[4:23]
    np.testing.assert_allclose(found.time_share, chosen.mean(axis=0), rtol=1e-12)
    assert found.switching == (chosen.any(axis=0) & ~chosen.all(axis=0)).sum() > 0


@pytest.mark.parametrize("variant", ["stiffness", "rigid_bias"])
def test_springs_are_uncertain_within_the_spread_of_drawn_poses(variant):
    """A limb at rest, turned far from {S}, whose pose has noise: no formula but the motion."""
    rng = np.random.default_rng(8)
    count, centre = 3000, np.array([0.01, -0.02, 0.13])
    bed = dataclasses.replace(
        random_bed(rng, random_socket(rng, 4, 8), variant),
        reference_pose=np.array([*centre, 1.6, -0.9, 1.2]) * (variant != "stiffness"),
        rest_positions=rng.uniform(-4e-4, 4e-4, (32, 3)) + centre * (variant == "stiffness"),
    )
    shifts, turns = rng.normal(0.0, 1e-4, (count, 3)), rng.normal(0.0, 2e-3, (count, 3))
    turned = Rotation.from_rotvec(turns) * Rotation.from_rotvec([1.6, -0.9, 1.2])
    found = engagement(samples_of(centre + shifts, turned.as_rotvec()), bed)
    if variant == "stiffness":
        delta = (centre + shifts)[:, None] - bed.rest_positions
    else:  # along the normal of each tile, at its centre
        arms = np.stack([Rotation.from_rotvec(turns).apply(a - centre) for a in bed.anchors], 1)
        moved = shifts[:, None] + arms - (bed.anchors - centre)
        normals, rest = bed.rotations[:, :, 2], bed.rest_positions[:, 2]
        delta = (np.einsum("kni,ni->kn", moved, normals) - rest)[..., None]
    expected = (np.abs(delta) < delta.std(axis=0)).sum(axis=(1, 2))
    assert expected.mean() > 2.0
    assert found.uncertain.mean() == pytest.approx(expected.mean(), rel=0.04)
    assert found.engaged.mean() == pytest.approx((delta < 0.0).sum(axis=(1, 2)).mean(), rel=1e-3)
    assert found.springs == delta[0].size


def test_averaged_poses_leave_fewer_springs_uncertain():
    rng = np.random.default_rng(2)
    bed = random_bed(rng, random_socket(rng, 4, 8))
    samples = samples_of(1e-4 * rng.normal(size=(400, 3)))
    single, averaged = (engagement(samples, bed, window).uncertain.mean() for window in (0.0, 4.0))
    assert averaged < 0.5 * single


def test_too_few_samples_leave_the_uncertainty_unknown():
    rng = np.random.default_rng(4)
    found = engagement(samples_of(moving_limb(rng, 8)), random_bed(rng, random_socket(rng)))
    assert np.isnan(found.uncertain).all() and np.isfinite(found.engaged).all()
