"""Samples that no limb in a socket gives: refused, or noted with what is wrong."""

import dataclasses

import numpy as np
import pytest
from support.problems import make_case, make_samples, random_socket

from socket_testbed.errors import IdentificationError
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.objective import LEAST_SAMPLES
from socket_testbed.identification.pareto import pareto_front
from socket_testbed.identification.plausibility import (
    HANGING,
    find_outliers,
    implausible_notes,
    sign_note,
)


def refused(samples, geometry, settings) -> IdentificationError:
    """The refusal, the same for a fit and for a front."""
    with pytest.raises(IdentificationError) as caught:
        fit_contact_model(samples, geometry, settings)
    with pytest.raises(IdentificationError) as again:
        pareto_front(samples, geometry, settings, (0.0, 1.0))
    assert str(again.value) == str(caught.value)
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize("count", [2, LEAST_SAMPLES - 1])
def test_a_fit_on_few_samples_is_refused_with_the_number_it_needs(count):
    geometry, _, samples, settings = make_case(1)
    error = refused(samples[:count], geometry, settings)
    assert f"only {count} of {count} samples" in error.fact
    assert f"needs {LEAST_SAMPLES}" in error.fact


def test_the_least_samples_are_fitted():
    geometry, _, samples, settings = make_case(1)
    assert fit_contact_model(samples[:LEAST_SAMPLES], geometry, settings).samples == LEAST_SAMPLES


@pytest.mark.parametrize("wrench", [0.0, 1e-4], ids=["zero", "noise"])
def test_a_wrench_without_a_load_is_refused(wrench):
    geometry, _, samples, settings = make_case(2)
    samples.wrench[:] = wrench
    assert "holds no load" in refused(samples, geometry, settings).fact


def test_a_wrench_that_is_left_out_may_be_zero():
    geometry, _, samples, settings = make_case(2, leave_out=("Mx", "My", "Mz", "Fx", "Fy", "Fz"))
    samples.wrench[:] = 0.0
    assert fit_contact_model(samples, geometry, settings).samples == len(samples)


@pytest.mark.parametrize(
    ("array", "column", "fact", "unit"),
    [
        ("position", np.s_[:], "limb position", "millimetres"),
        ("wrench", np.s_[:, 3:], "F", "millinewtons"),
        ("wrench", np.s_[:, :3], "M", "newton millimetres"),
        ("wrench", np.s_[:], "M", "newton millimetres"),
        ("local_forces", np.s_[:], "cluster_", "millinewtons"),
    ],
    ids=["position", "forces", "moments", "wrench", "clusters"],
)
def test_another_unit_is_refused_and_named(array, column, fact, unit):
    geometry, _, samples, settings = make_case(3)
    getattr(samples, array)[column] *= 1000.0
    error = refused(samples, geometry, settings)
    assert fact in error.fact
    assert f"likely in {unit}" in error.hint


def test_a_limb_far_from_the_socket_is_a_matter_of_frames():
    geometry, _, samples, settings = make_case(3)
    samples.position[:, 0] += 1e4
    error = refused(samples, geometry, settings)
    assert "limb position" in error.fact
    assert "frames" in error.hint and "millimetres" not in error.hint


def spoilt(array, place, value):
    geometry, _, samples, settings = make_case(4)
    sound = np.arange(len(samples)) != place[0]
    expected = fit_contact_model(samples[sound] if array != "local_forces" else samples,
                                 geometry, settings)  # fmt: skip
    getattr(samples, array)[place] = value
    return geometry, samples, settings, expected


@pytest.mark.parametrize("value", [-1e9, 2e3])
@pytest.mark.parametrize(
    ("array", "place", "name"),
    [
        ("wrench", (17, 4), "Fy has an outlier"),
        ("wrench", (17, 0), "Mx has an outlier"),
        ("local_forces", (17, 1, 2), "cluster_1.Fz has an outlier"),
        ("position", (17, 1), "limb position has an outlier"),
    ],
)
def test_an_outlier_is_left_out_and_noted_with_channel_and_time(array, place, name, value):
    geometry, samples, settings, expected = spoilt(array, place, value)
    (note,) = [n for n in implausible_notes(samples, geometry, ()) if "outlier" in n]
    assert note.startswith(name)
    assert "at 4.25 s" in note and note.endswith("left out")
    start = int(samples.stamps[0]) - 10 * 10**9
    assert any("at 14.25 s" in n for n in implausible_notes(samples, geometry, (), start))
    found = fit_contact_model(samples, geometry, settings)
    assert max(error.rmse for error in found.errors) < 100.0
    if array == "local_forces":
        errors = {error.name: error.samples for error in found.errors}
        assert errors["cluster_1.Fz"] == len(samples) - 1
    else:
        np.testing.assert_array_equal(found.model.stiffness, expected.model.stiffness)


def test_many_outliers_are_refused():
    geometry, _, samples, settings = make_case(4)
    samples.wrench[::8, 3] = 1e9
    error = refused(samples, geometry, settings)
    assert error.fact.startswith("5 of 40 samples are outliers: Fx has 5 outliers (1e+09 N at 0.00")
    assert "and 2 more" in error.fact


def test_an_outlier_of_a_channel_that_is_left_out_drops_no_sample():
    geometry, _, samples, settings = make_case(4, leave_out=("Mz",))
    samples.wrench[3, 2] = 1e9
    assert fit_contact_model(samples, geometry, settings).samples == len(samples)


def test_sound_samples_have_no_outlier():
    for seed in range(5):
        geometry, _, samples, _ = make_case(seed, gaps=True)
        assert not find_outliers(samples, geometry).rows.any()


@pytest.fixture
def loaded():
    """A socket that stands on its load cell under 200 N, its clusters pressed."""
    geometry = random_socket(np.random.default_rng(3))
    rng = np.random.default_rng(4)
    wrench = rng.normal([1.0, -2.0, 0.5, 3.0, -5.0, -200.0], 0.3, (100, 6))
    forces = {name: rng.normal([2.0, -1.0, -20.0], 0.3, (100, 3)) for name in geometry.clusters}
    return geometry, make_samples(rng.normal(0.0, 1e-4, (100, 3)), wrench, forces)


def negated(samples):
    return dataclasses.replace(samples, wrench=-samples.wrench)


def test_a_negated_wrench_is_noted(loaded):
    geometry, samples = loaded
    assert implausible_notes(samples, geometry, ()) == []
    (note,) = implausible_notes(negated(samples), geometry, ())
    assert note.startswith("the wrench looks negated")
    assert "200 N" in note and "3 of 3 clusters" in note


def test_the_sign_is_doubted_only_on_clear_evidence(loaded):
    geometry, samples = loaded
    hanging = dataclasses.replace(samples, wrench=samples.wrench * (-0.9 * HANGING / 200.0))
    assert sign_note(hanging, geometry) is None  # a prosthesis that hangs on the limb
    pulled = dataclasses.replace(negated(samples), local_forces=-samples.local_forces)
    assert sign_note(pulled, geometry) is None  # the clusters do not contradict it
    shift = np.array([0.0, 0.0, 150.0])  # [N]
    offset = dataclasses.replace(samples, local_forces=samples.local_forces + shift)
    assert sign_note(offset, geometry) is None  # offsets of the clusters alone
    unread = dataclasses.replace(negated(samples), status=np.full_like(samples.status, 2))
    assert sign_note(unread, geometry) is None
