"""The rule that proposes channels to leave out, on data with known answers."""

import dataclasses

import numpy as np
import pytest
from support.problems import make_samples, random_socket

from socket_testbed.identification.plausibility import (
    LEAST_LOAD,
    LEAST_TENSION,
    LEVER_FACTOR,
    find_implausible,
    implausible_notes,
)

LOAD, COUNT = 200.0, 100  # [N], samples


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


def test_plausible_channels_are_left_in_peace(samples, geometry):
    assert found(samples, geometry) == []
    assert implausible_notes(samples, geometry, ()) == []


@pytest.mark.parametrize("axis", range(3))
def test_a_tile_that_bears_ten_times_the_load_is_proposed_with_its_numbers(samples, geometry, axis):
    size = np.median(np.abs(samples.local_forces[:, 1, axis]))
    samples = scaled(samples, 1, axis, 10.0 * LOAD / size)
    (proposal,) = find_implausible(samples, geometry)
    assert proposal.channel == f"cluster_1.F{'xyz'[axis]}"
    assert "10 times" in proposal.reason and "N" in proposal.reason


def test_the_border_is_the_total_load(samples, geometry):
    load = np.median(np.linalg.norm(samples.wrench[:, 3:], axis=1))
    size = np.median(np.abs(samples.local_forces[:, 0, 2]))
    assert found(scaled(samples, 0, 2, 0.99 * load / size), geometry) == []
    assert found(scaled(samples, 0, 2, 1.01 * load / size), geometry) == ["cluster_0.Fz"]


@pytest.mark.parametrize("count", [12, COUNT, 1000])
def test_peaks_above_1000_n_under_300_n_are_proposed_but_not_a_single_spike(geometry, count):
    """The paper's decision: it left out three shear channels for such peaks."""
    rng = np.random.default_rng(5)
    wrench = rng.normal([1.0, -2.0, 0.5, 3.0, -5.0, -300.0], 0.3, (count, 6))
    forces = {name: rng.normal([20.0, -9.0, -30.0], 3.0, (count, 3)) for name in geometry.clusters}
    for peaks, expected in ((1, []), (2 + count // 50, ["cluster_0.Fx", "cluster_1.Fy"])):
        forces["cluster_0"][:peaks, 0] = 1010.0
        forces["cluster_1"][-peaks:, 1] = -1010.0
        forces["cluster_2"][:peaks, 0] = 600.0  # twice the load: a cluster may have an offset
        samples = make_samples(rng.normal(0.0, 1e-4, (count, 3)), wrench, forces)
        assert found(samples, geometry) == expected
    assert "1.01e+03 N" in find_implausible(samples, geometry)[0].reason


def test_a_wall_does_not_pull(samples, geometry):
    pulled = scaled(samples, 2, 2, -1.0)  # as much tension as there was compression
    (proposal,) = find_implausible(pulled, geometry)
    assert proposal.channel == "cluster_2.Fz" and "pull" in proposal.reason
    slack = scaled(samples, 2, 2, -0.9 * LEAST_TENSION / (0.1 * LOAD))
    assert found(slack, geometry) == []
    sideways = scaled(samples, 2, 0, -20.0)  # 40 N of shear have a sign, and no meaning
    assert found(sideways, geometry) == []


@pytest.mark.parametrize("state", [1, 3])  # saturated, out of range
def test_a_cluster_outside_its_range_most_of_the_time_is_proposed_with_all_channels(
    samples, geometry, state
):
    status = samples.status.copy()
    status[:10, 0] = 2  # missing ones say nothing of the range
    status[10:54, 0] = state  # 44 of 90
    assert found(dataclasses.replace(samples, status=status), geometry) == []
    status[10:56, 0] = state  # 46 of 90
    proposals = find_implausible(dataclasses.replace(samples, status=status), geometry)
    assert [p.channel for p in proposals] == [f"cluster_0.F{axis}" for axis in "xyz"]
    assert all("46 of 90" in p.reason for p in proposals)


@pytest.mark.parametrize("axis", range(3))
def test_a_moment_needs_a_lever(samples, geometry, axis):
    load = np.median(np.linalg.norm(samples.wrench[:, 3:], axis=1))
    reach = np.linalg.norm(geometry.anchors, axis=1).max()
    for share, expected in ((0.99, []), (1.01, [f"M{'xyz'[axis]}"])):
        wrench = samples.wrench.copy()
        wrench[:, axis] = -share * LEVER_FACTOR * reach * load
        assert found(dataclasses.replace(samples, wrench=wrench), geometry) == expected


def test_without_a_load_nothing_is_too_large(samples, geometry):
    unloaded = dataclasses.replace(samples, wrench=samples.wrench * (0.9 * LEAST_LOAD / LOAD))
    assert found(scaled(unloaded, 1, 0, 1e4), geometry) == []
    nothing = dataclasses.replace(
        samples,
        wrench=np.full((COUNT, 6), np.nan),
        local_forces=np.full_like(samples.local_forces, np.nan),
        status=np.full_like(samples.status, 2),
    )
    assert found(nothing, geometry) == []


def test_a_note_says_what_to_do_and_stays_when_it_was_done(samples, geometry):
    samples = scaled(samples, 1, 0, 1e4)
    (note,) = implausible_notes(samples, geometry, ())
    assert note.startswith("cluster_1.Fx") and "--leave-out cluster_1.Fx" in note
    (note,) = implausible_notes(samples, geometry, ("cluster_1.Fx",))
    assert note.startswith("cluster_1.Fx") and note.endswith("is left out")
