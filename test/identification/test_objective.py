"""Which channels and samples a fit rests on, and what it says where there are none."""

import dataclasses

import numpy as np
import pytest
from support.problems import make_case, make_samples, random_socket

from socket_testbed.errors import ConfigurationError, IdentificationError
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.objective import build_objective
from socket_testbed.settings.identification import IdentificationSettings


def test_weights_by_noise_follow_the_noise_above_the_models_error():
    rng = np.random.default_rng(15)
    geometry = random_socket(rng)
    noise = np.array([1.0, 2.0, 4.0, 10.0, 20.0, 40.0])  # [N m, N]; far above 1 % of the size
    local = np.array([0.5, 1.0, 2.0])  # [N]
    size = (1000, len(geometry.clusters), 3)
    samples = make_samples(
        rng.normal(0.0, 1e-3, (1000, 3)),
        rng.normal(0.0, noise, (1000, 6)),
        dict(zip(geometry.clusters, rng.normal(0.0, local, size).swapaxes(0, 1), strict=True)),
    )
    settings = IdentificationSettings(weights="noise")
    objective = build_objective(samples, geometry, settings)
    np.testing.assert_allclose(
        objective.wrench_shares / objective.wrench_shares[0], (noise[0] / noise) ** 2, rtol=0.2
    )
    shares = objective.channel_shares.reshape(-1, 3)
    np.testing.assert_allclose(shares / shares[0, 0], [(local[0] / local) ** 2] * 3, rtol=0.2)


def test_samples_without_a_wrench_or_a_position_do_not_count():
    geometry, _, samples, settings = make_case(93, gaps=True)
    lost = np.zeros(len(samples), dtype=bool)
    lost[[0, 7, 20]] = True
    expected = fit_contact_model(samples[~lost], geometry, settings).model
    samples.wrench[[0, 7], 2] = np.nan
    samples.position[20] = np.nan
    found = fit_contact_model(samples, geometry, settings).model
    np.testing.assert_array_equal(found.stiffness, expected.stiffness)
    np.testing.assert_array_equal(found.rest_positions, expected.rest_positions)


@pytest.mark.parametrize("lost", [("Mz",), ("Mx", "My", "Mz", "Fx", "Fy", "Fz")])
def test_what_a_left_out_wrench_channel_measured_does_not_matter(lost):
    geometry, _, samples, settings = make_case(77, leave_out=lost)
    expected = fit_contact_model(samples, geometry, settings)
    samples.wrench[:, [samples.channels.index(name) for name in lost]] = np.nan
    found = fit_contact_model(samples, geometry, settings)
    assert found.samples == expected.samples
    np.testing.assert_allclose(
        found.model.stiffness, expected.model.stiffness, rtol=1e-8, atol=1e-6
    )
    np.testing.assert_allclose(found.model.wrench_bias, expected.model.wrench_bias, atol=1e-8)
    assert {e.samples for e in found.errors if e.name in lost} == {0}


def test_a_channel_without_any_value_may_be_left_out():
    geometry, _, samples, settings = make_case(71, leave_out=("cluster_1.Fz",))
    samples.local_forces[:, 1, 2] = np.nan
    fit = fit_contact_model(samples, geometry, settings)
    errors = {e.name: e for e in fit.errors}
    assert errors["cluster_1.Fz"].samples == 0
    assert np.isfinite(fit.model.stiffness).all()


@pytest.mark.parametrize(
    ("array", "place", "value", "channel", "advice"),
    [
        ("local_forces", np.s_[:, 1, 2], np.nan, "cluster_1.Fz", "cluster_1.Fz"),
        ("status", np.s_[:, 1], 2, "cluster_1.Fx", "cluster_1.Fx"),
        ("wrench", np.s_[:, 2], np.nan, "Mz", "--leave-out Mz"),
    ],
    ids=["value", "status", "wrench"],
)
def test_a_channel_without_any_value_is_named_with_a_hint(array, place, value, channel, advice):
    geometry, _, samples, settings = make_case(71)
    getattr(samples, array)[place] = value
    with pytest.raises(IdentificationError) as caught:
        fit_contact_model(samples, geometry, settings)
    assert channel in caught.value.fact
    assert "leave it out" in caught.value.hint
    assert advice in caught.value.hint
    assert "\n" not in str(caught.value)


def test_a_fit_without_any_channel_is_refused():
    geometry, _, samples, _ = make_case(73)
    settings = IdentificationSettings(leave_out=samples.channels)
    with pytest.raises(IdentificationError, match="every channel is left out"):
        fit_contact_model(samples, geometry, settings)


@pytest.mark.parametrize("count", [0, 1])
def test_a_fit_without_samples_says_how_many_there_are(count):
    geometry, _, samples, settings = make_case(74)
    samples.position[count:] = np.nan
    with pytest.raises(IdentificationError, match=f"only {count} of {len(samples)} samples"):
        fit_contact_model(samples, geometry, settings)


def test_a_cluster_of_another_socket_is_named():
    geometry, _, samples, settings = make_case(75)
    other = dataclasses.replace(samples, clusters=("cluster_0", "brim", "cluster_2"))
    with pytest.raises(ConfigurationError, match="'brim'"):
        fit_contact_model(other, geometry, settings)


@pytest.mark.parametrize(
    ("setting", "value", "unknown", "meant"),
    [
        ("leave_out", ("cluster_1.Fq",), "cluster_1.Fq", "cluster_1.F"),
        ("leave_out", ("mz",), "mz", "Mz"),
        ("leave_out", ("Fw",), "Fw", "F"),
        ("solver", "osqq", "osqq", "osqp"),
    ],
)
def test_an_unknown_name_in_the_settings_is_named_with_a_likely_one(setting, value, unknown, meant):
    geometry, _, samples, settings = make_case(72, **{setting: value})
    with pytest.raises(ConfigurationError) as caught:
        fit_contact_model(samples, geometry, settings)
    assert f"'{unknown}'" in caught.value.fact
    assert setting in caught.value.fact
    assert meant in caught.value.hint
