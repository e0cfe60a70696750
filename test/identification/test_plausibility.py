"""Samples that no limb in a socket gives are refused or noted; what to leave out is proposed."""

import dataclasses
import itertools

import numpy as np
import pytest
from support.problems import make_case, make_samples, random_socket

from socket_testbed.errors import IdentificationError
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.pareto import pareto_front
from socket_testbed.identification.plausibility import (
    HANGING,
    LEAST_LOAD,
    LEAST_TENSION,
    LEVER_FACTOR,
    find_implausible,
    find_outliers,
    implausible_notes,
    sign_note,
)
from socket_testbed.samples import Status

LOAD, COUNT = 200.0, 100  # [N], samples


def refusal(samples, geometry, settings) -> IdentificationError:
    """The refusal, the same for a fit and for a front."""
    with pytest.raises(IdentificationError) as caught:
        fit_contact_model(samples, geometry, settings)
    with pytest.raises(IdentificationError) as again:
        pareto_front(samples, geometry, settings, (0.0, 1.0))
    assert str(again.value) == str(caught.value)
    assert "\n" not in str(caught.value)
    return caught.value


def test_a_wrench_without_a_load_is_refused_unless_it_is_left_out():
    geometry, _, samples, settings = make_case(2)
    for wrench in (1e-4, 0.0):
        samples.wrench[:] = wrench
        assert "holds no load" in refusal(samples, geometry, settings).fact
    settings = dataclasses.replace(settings, leave_out=("Mx", "My", "Mz", "Fx", "Fy", "Fz"))
    assert fit_contact_model(samples, geometry, settings).samples == len(samples)


def test_another_unit_is_refused_and_named():
    for array, column, fact, unit in (
        ("position", np.s_[:], "limb position", "millimetres"),
        ("wrench", np.s_[:, 3:], "F", "millinewtons"),
        ("wrench", np.s_[:, :3], "M", "newton millimetres"),
        ("wrench", np.s_[:], "M", "newton millimetres"),
        ("local_forces", np.s_[:], "cluster_", "millinewtons"),
    ):
        geometry, _, samples, settings = make_case(3)
        getattr(samples, array)[column] *= 1000.0
        error = refusal(samples, geometry, settings)
        assert fact in error.fact
        assert f"likely in {unit}" in error.hint
    geometry, _, samples, settings = make_case(3)
    samples.position[:, 0] += 1e4
    error = refusal(samples, geometry, settings)
    assert "limb position" in error.fact
    assert "frames" in error.hint and "millimetres" not in error.hint


@pytest.mark.parametrize(
    ("array", "place", "value", "name"),
    [
        ("wrench", (17, 4), 2e3, "Fy has an outlier"),
        ("local_forces", (17, 1, 2), -1e9, "cluster_1.Fz has an outlier"),
        ("position", (17, 1), -1e9, "limb position has an outlier"),
    ],
)
def test_an_outlier_is_left_out_and_noted_with_channel_and_time(array, place, value, name):
    geometry, _, samples, settings = make_case(4)
    assert not find_outliers(samples, geometry).rows.any()
    sound = fit_contact_model(samples[np.arange(len(samples)) != 17], geometry, settings)
    getattr(samples, array)[place] = value
    (note,) = [n for n in implausible_notes(samples, geometry, ()) if "outlier" in n]
    assert note.startswith(name)
    assert "at 4.25 s" in note and note.endswith("left out")
    found = fit_contact_model(samples, geometry, settings)
    assert max(error.rmse for error in found.errors) < 100.0
    if array == "local_forces":
        errors = {error.name: error.samples for error in found.errors}
        assert errors["cluster_1.Fz"] == len(samples) - 1
    else:
        np.testing.assert_array_equal(found.model.stiffness, sound.model.stiffness)


def test_many_outliers_are_refused():
    geometry, _, samples, settings = make_case(4)
    samples.wrench[::8, 3] = 1e9
    error = refusal(samples, geometry, settings)
    assert error.fact.startswith("5 of 40 samples are outliers: Fx has 5 outliers (1e+09 N at 0.00")
    assert "and 2 more" in error.fact
    settings = dataclasses.replace(settings, leave_out=("Fx",))  # then it drops no sample
    assert fit_contact_model(samples, geometry, settings).samples == len(samples)


@pytest.fixture
def geometry():
    return random_socket(np.random.default_rng(3))


@pytest.fixture
def samples(geometry):
    """A steady load, with every cluster pressed by a tenth of it."""
    rng = np.random.default_rng(4)
    wrench = rng.normal([1.0, -2.0, 0.5, 3.0, -5.0, -LOAD], 0.3, (COUNT, 6))
    forces = {
        name: rng.normal([2.0, -1.0, -0.1 * LOAD], 0.3, (COUNT, 3)) for name in geometry.clusters
    }
    return make_samples(rng.normal(0.0, 1e-4, (COUNT, 3)), wrench, forces)


def scaled(samples, column, axis, factor):
    forces = samples.local_forces.copy()
    forces[:, column, axis] *= factor
    return dataclasses.replace(samples, local_forces=forces)


def found(samples, geometry) -> list[str]:
    return [proposal.channel for proposal in find_implausible(samples, geometry)]


def test_a_negated_wrench_is_noted_on_clear_evidence_alone(geometry, samples):
    negated = dataclasses.replace(samples, wrench=-samples.wrench)
    (note,) = implausible_notes(negated, geometry, ())
    assert note.startswith("the wrench looks negated")
    assert "200 N" in note and "3 of 3 clusters" in note
    hanging = dataclasses.replace(samples, wrench=samples.wrench * (-0.9 * HANGING / LOAD))
    pulled = dataclasses.replace(negated, local_forces=-samples.local_forces)
    shifted = samples.local_forces + np.array([0.0, 0.0, 150.0])
    offset = dataclasses.replace(samples, local_forces=shifted)
    unread = dataclasses.replace(negated, status=np.full_like(samples.status, 2))
    for doubtful in (hanging, pulled, offset, unread):
        assert sign_note(doubtful, geometry) is None


def test_a_tile_that_bears_more_than_the_load_is_proposed_with_its_numbers(samples, geometry):
    assert implausible_notes(samples, geometry, ()) == []
    load = np.median(np.linalg.norm(samples.wrench[:, 3:], axis=1))
    for axis in range(3):
        size = np.median(np.abs(samples.local_forces[:, 1, axis]))
        assert found(scaled(samples, 1, axis, 0.99 * load / size), geometry) == []
        (proposal,) = find_implausible(scaled(samples, 1, axis, 10.0 * load / size), geometry)
        assert proposal.channel == f"cluster_1.F{'xyz'[axis]}"
        assert "10 times" in proposal.reason
    unloaded = dataclasses.replace(samples, wrench=samples.wrench * (0.9 * LEAST_LOAD / LOAD))
    assert found(scaled(unloaded, 1, 0, 1e4), geometry) == []  # nothing is too large for no load
    heavy = scaled(samples, 1, 0, 1e4)
    for left_out, said in (((), "--leave-out cluster_1.Fx"), (("cluster_1.Fx",), "is left out")):
        (note,) = implausible_notes(heavy, geometry, left_out)
        assert note.startswith("cluster_1.Fx") and said in note


def test_peaks_above_1000_n_under_300_n_are_proposed_but_not_a_single_spike(geometry):
    """The paper's decision: it left out three shear channels for such peaks."""
    rng, count = np.random.default_rng(5), 1000
    wrench = rng.normal([1.0, -2.0, 0.5, 3.0, -5.0, -300.0], 0.3, (count, 6))
    forces = {name: rng.normal([20.0, -9.0, -30.0], 3.0, (count, 3)) for name in geometry.clusters}
    for peaks, expected in ((1, []), (2 + count // 50, ["cluster_0.Fx", "cluster_1.Fy"])):
        forces["cluster_0"][:peaks, 0] = 1010.0
        forces["cluster_1"][-peaks:, 1] = -1010.0
        forces["cluster_2"][:peaks, 0] = 600.0  # twice the load: a cluster may have an offset
        samples = make_samples(rng.normal(0.0, 1e-4, (count, 3)), wrench, forces)
        assert found(samples, geometry) == expected


def test_a_wall_does_not_pull(samples, geometry):
    pulled = scaled(samples, 2, 2, -1.0)  # as much tension as there was compression
    (proposal,) = find_implausible(pulled, geometry)
    assert proposal.channel == "cluster_2.Fz" and "pull" in proposal.reason
    slack = scaled(samples, 2, 2, -0.9 * LEAST_TENSION / (0.1 * LOAD))
    sideways = scaled(samples, 2, 0, -20.0)  # 40 N of shear have a sign, and no meaning
    assert found(slack, geometry) == found(sideways, geometry) == []


def test_a_cluster_outside_its_range_most_of_the_time_is_proposed_with_all_channels(
    samples, geometry
):
    for state in (Status.SATURATED, Status.OUT_OF_RANGE):
        status = samples.status.copy()
        status[:10, 0] = Status.MISSING  # which says nothing of the range
        status[10:54, 0] = state  # 44 of 90
        assert found(dataclasses.replace(samples, status=status), geometry) == []
        status[10:56, 0] = state  # 46 of 90
        proposals = find_implausible(dataclasses.replace(samples, status=status), geometry)
        assert [p.channel for p in proposals] == [f"cluster_0.F{axis}" for axis in "xyz"]
        assert all("46 of 90" in p.reason for p in proposals)


def test_a_moment_needs_a_lever(samples, geometry):
    load = np.median(np.linalg.norm(samples.wrench[:, 3:], axis=1))
    reach = np.linalg.norm(geometry.anchors, axis=1).max()
    for axis, share in itertools.product(range(3), (0.99, 1.01)):
        wrench = samples.wrench.copy()
        wrench[:, axis] = -share * LEVER_FACTOR * reach * load
        expected = [f"M{'xyz'[axis]}"] if share > 1.0 else []
        assert found(dataclasses.replace(samples, wrench=wrench), geometry) == expected
