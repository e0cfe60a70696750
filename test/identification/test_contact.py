"""The contact law against its definition."""

import dataclasses

import numpy as np
import pytest
from support.problems import moving_limb, naive_gated, random_bed, random_socket

from socket_testbed.identification.contact import (
    gate,
    gated_displacement,
    gated_slope,
    wrench_map,
)
from socket_testbed.settings.identification import PAPER_VARIANTS, VARIANTS

ALPHA = 2000.0  # [1/m]


@pytest.fixture
def rng():
    return np.random.default_rng(1)


@pytest.mark.parametrize(
    ("displacement", "value"), [(-1.0, 1.0), (-0.01, 1.0), (0.0, 0.5), (0.01, 0.0), (1.0, 0.0)]
)
def test_gate_is_open_in_compression_and_shut_in_tension(displacement, value):
    assert gate(np.array(displacement), ALPHA) == pytest.approx(value, abs=1e-12)


def test_gate_falls_and_is_antisymmetric_about_one_half():
    d = np.linspace(-0.003, 0.003, 101)
    values = gate(d, ALPHA)
    assert (np.diff(values) < 0.0).all()
    np.testing.assert_allclose(values + gate(-d, ALPHA), 1.0, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("sharpness", [1.0, 300.0, 2000.0, 1e5])
def test_gated_displacement_equals_the_tanh_form(rng, sharpness):
    position = rng.uniform(-0.01, 0.01, (20, 3))
    rest = rng.uniform(-0.01, 0.01, (7, 3))
    displacement = position[:, None] - rest
    expected = naive_gated(displacement, sharpness)
    found = gated_displacement(position, rest, sharpness)
    # The tanh form cancels where the gate is shut: it is exact to rounding of the displacement.
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-16)


@pytest.mark.parametrize("sharpness", [2000.0, 1e6])
@pytest.mark.parametrize(("metre", "expected"), [(1.0, 0.0), (-1.0, -1.0)])
def test_gated_displacement_survives_a_metre(sharpness, metre, expected):
    with np.errstate(over="raise"):  # the law itself must keep its overflow quiet
        s = gated_displacement(np.full((2, 3), metre), np.zeros((1, 3)), sharpness)
    np.testing.assert_array_equal(s, np.full((2, 1, 3), expected))


@pytest.mark.parametrize("sharpness", [300.0, 2000.0])
def test_gated_slope_is_the_derivative_of_the_gated_displacement(rng, sharpness):
    position = rng.uniform(-0.004, 0.004, (50, 3))
    rest = rng.uniform(-0.004, 0.004, (7, 3))
    step = 1e-7  # [m]
    after, before = (gated_displacement(position + s, rest, sharpness) for s in (step, -step))
    found = gated_slope(position, rest, sharpness)
    np.testing.assert_allclose(found, (after - before) / (2.0 * step), atol=1e-6)
    far = gated_slope(np.array([[1.0, -1.0, 0.0]]), np.zeros((1, 3)), sharpness)
    np.testing.assert_array_equal(far, [[[0.0, 1.0, 0.5]]])


def test_gated_displacement_does_not_change_its_arguments(rng):
    position, rest = rng.normal(size=(5, 3)), rng.normal(size=(4, 3))
    before = position.copy(), rest.copy()
    gated_displacement(position, rest, ALPHA)
    np.testing.assert_array_equal(position, before[0])
    np.testing.assert_array_equal(rest, before[1])


def test_tension_is_bounded_by_the_laws_maximum():
    d = np.linspace(0.0, 0.01, 100_001)
    s = gated_displacement(np.repeat(d[:, None], 3, axis=1), np.zeros((1, 3)), ALPHA)
    assert s.max() * ALPHA == pytest.approx(0.139, abs=5e-4)  # a property of the paper's gate


def test_wrench_map_sums_the_moments_and_the_forces(rng):
    anchors, forces = rng.normal(size=(9, 3)), rng.normal(size=(9, 3))
    expected = np.concatenate([np.cross(anchors, forces).sum(axis=0), forces.sum(axis=0)])
    np.testing.assert_allclose(wrench_map(anchors) @ forces.reshape(-1), expected, rtol=1e-12)


@pytest.mark.parametrize(("count", "amplitude"), [(15, 0.003), (3000, 0.003), (3000, 1e-4)])
@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_wrench_is_that_of_the_spring_forces_and_its_own_offset(rng, variant, count, amplitude):
    geometry = random_socket(rng)
    bed = random_bed(rng, geometry, variant)
    q = moving_limb(rng, count, amplitude)
    q[7] = np.nan
    springs = bed.stiffness * naive_gated(q[:, None] - bed.rest_positions, bed.sharpness)
    moment = np.cross(geometry.anchors, springs).sum(axis=1) + bed.wrench_bias[:3]
    force = springs.sum(axis=1) + bed.wrench_bias[3:]
    np.testing.assert_allclose(bed.wrench(q), np.hstack([moment, force]), atol=1e-10)


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_cluster_forces_are_in_their_frame_with_their_offset(rng, variant):
    geometry = random_socket(rng)
    bed = random_bed(rng, geometry, variant)
    q = moving_limb(rng, 15)
    springs = bed.stiffness * naive_gated(q[:, None] - bed.rest_positions, bed.sharpness)
    forces = bed.cluster_forces(q)
    assert set(forces) == set(geometry.clusters)
    for name, point in geometry.clusters.items():
        for axis in range(3):  # each component is the projection on the frame's own axis
            along = springs[:, point] @ geometry.rotations[point][:, axis]
            offset = bed.force_bias[name][axis] if variant == "stiffness_bias" else 0.0
            np.testing.assert_allclose(forces[name][:, axis], along + offset, atol=1e-10)


def test_offsets_of_the_clusters_are_no_part_of_the_wrench(rng):
    bed = random_bed(rng, random_socket(rng), "stiffness_bias")
    q = moving_limb(rng, 8)
    louder = dataclasses.replace(
        bed, force_bias={name: f + 100.0 for name, f in bed.force_bias.items()}
    )
    np.testing.assert_array_equal(louder.wrench(q), bed.wrench(q))
    point = next(iter(bed.cluster_points.values()))
    assert np.linalg.norm(louder.forces(q)[:, point] - bed.forces(q)[:, point], axis=1).min() > 100


def test_offset_touches_only_the_tiles_under_clusters(rng):
    bed = random_bed(rng, random_socket(rng), "stiffness_bias")
    bare = dataclasses.replace(bed, force_bias={}, wrench_bias=np.zeros(6))
    q = moving_limb(rng, 8)
    touched = np.abs(bed.forces(q) - bare.forces(q)).max(axis=(0, 2)) > 0.0
    assert set(np.flatnonzero(touched)) == set(bed.cluster_points.values())


@pytest.mark.parametrize("axis", range(3))
def test_force_on_the_socket_points_where_the_limb_pushes(rng, axis):
    bed = random_bed(rng, random_socket(rng))
    q = np.full((1, 3), 0.1)  # out of every spring but along one axis
    q[0, axis] = bed.rest_positions[:, axis].min() - 0.005
    forces = bed.forces(q)[0]
    assert (forces[:, axis] < 0.0).all()
    np.testing.assert_allclose(np.delete(forces, axis, axis=1), 0.0, atol=1e-9)


def test_force_of_a_compressed_spring_grows_with_the_stiffness_and_the_depth(rng):
    bed = random_bed(rng, random_socket(rng))
    depth = np.array([0.004, 0.008])
    q = np.tile(bed.rest_positions[2], (2, 1)) - depth[:, None]
    force = bed.forces(q)[:, 2]
    # At 4 mm the gate has opened to 1 - 1e-7.
    np.testing.assert_allclose(force, -depth[:, None] * bed.stiffness[2], rtol=1e-6)


@pytest.mark.parametrize("variant", VARIANTS)
def test_predict_is_the_wrench_and_the_forces(rng, variant):
    bed = random_bed(rng, random_socket(rng), variant)
    q = np.hstack([moving_limb(rng, 10), rng.normal(0.0, 0.02, (10, 3))])
    wrench, forces = bed.predict(q)
    np.testing.assert_allclose(wrench, bed.wrench(q), rtol=1e-12)
    np.testing.assert_allclose(forces, bed.forces(q), rtol=1e-12)


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_an_unknown_position_gives_no_force(rng, variant):
    bed = random_bed(rng, random_socket(rng), variant)
    q = moving_limb(rng, 3)
    q[1] = np.nan
    wrench, forces = bed.predict(q)
    assert np.isnan(wrench[1]).all()
    assert np.isnan(forces[1]).all()
    for local in bed.cluster_forces(q).values():
        np.testing.assert_array_equal(np.isnan(local).any(axis=1), [False, True, False])
    assert np.isfinite(wrench[[0, 2]]).all()
    assert np.isfinite(forces[[0, 2]]).all()
