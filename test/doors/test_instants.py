"""A force map at an instant and its draws, and the outputs of a trial in one line, by hand.

At 12.0 s all forces are 1.5 times their means. The first twentieth of the draws are 1.96 standard
deviations away: pressures of 1 kPa, shear along x of 0.5 kPa.
"""

import json
from typing import Any

import numpy as np
import pytest
from support import scene

import socket_testbed as st
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.trials.trial import Trial

ANT_MID, RIGHT_PROX = scene.TILES.index("ant_mid"), scene.TILES.index("right_prox")


@pytest.fixture(scope="module")
def mapped(trial: Trial) -> st.TrialMap:
    return st.force_map(trial, "6:18")


@pytest.fixture(scope="module")
def draws(mapped: st.TrialMap) -> np.ndarray:
    return mapped.at(12.0).draws(20)


@pytest.mark.parametrize(
    ("tile", "stress"),
    [(ANT_MID, (-4.5, 6.0, 60.0)), (RIGHT_PROX, (-12.0, 9.0, 45.0))],
    ids=["ant_mid", "right_prox"],
)
def test_draws_are_shear_x_shear_y_and_pressure(
    tile: int, stress: tuple[float, ...], draws: np.ndarray
) -> None:
    """Positive in compression, in Pa."""
    assert draws.shape == (1, 20, 12, 3)
    assert 1e-3 * draws[0, 5, tile] == pytest.approx(stress)
    np.testing.assert_allclose(1e-3 * draws[0, :, tile].mean(axis=0), stress)


def test_draws_have_both_signs_of_an_error(draws: np.ndarray) -> None:
    one, other = 1e-3 * (draws[0, [0, 10], ANT_MID] - draws[0, 5, ANT_MID])
    assert np.abs(one) == pytest.approx([0.98, 0.0, 1.96])
    assert other == pytest.approx(-one)


@pytest.mark.parametrize(("count", "fact"), [(3, "3 draws"), (0, "count")])
def test_draws_come_in_pairs(count: int, fact: str, mapped: st.TrialMap) -> None:
    with pytest.raises(ConfigurationError, match=fact):
        mapped.draws(count)


def test_an_instant_is_a_row_of_the_trial(mapped: st.TrialMap) -> None:
    """The sample before 12.1 s is number 48 of the trial, 24 of the map."""
    found = mapped.at(12.1)
    assert (found.segment.start, found.segment.end) == (12.0, 12.0)
    assert found.segment.rows == slice(48, 49) and found.samples.stamps[0] == scene.STAMPS[48]
    with pytest.raises(TrialError) as error:
        mapped.at(5.9)
    assert error.value.fact == "the map has no sample at 5.9 s"
    assert error.value.hint == "give a time between 6.00 s and 18.00 s"


def test_a_map_s_document_holds_means_and_rows(mapped: st.TrialMap) -> None:
    """From 6 to 18 s, 49 samples; the factor's mean is 1 + sum / 98, all but 1 of it above 1."""
    document = json.loads(mapped.to_json())
    assert document["trial"] == "scene" and document["segment"]["start"] == 6.0
    assert len(document["rows"]) == 49 and document["rows"][24]["time [s]"] == 12.0
    assert document["rows"][24]["ant_mid.pressure [Pa]"] == pytest.approx(60e3)
    first = document["tiles"][0]
    assert (first["tile"], first["cluster"]) == ("ant_mid", "mid_anterior")
    cosines = np.cos(2.0 * np.pi * (6.0 + 0.25 * np.arange(49)) / 24.0)
    assert first["pressure [kPa]"] == pytest.approx(40.0 * (1.0 - 0.5 * cosines.mean()))


def test_results_are_shown_in_one_line(trial: Trial, mapped: st.TrialMap) -> None:
    whole = st.force_map(trial, "all")
    assert repr(whole) == (
        "TrialMap(scene, all 0.00 s to 23.75 s; 96 samples, highest mean pressure 40.0 +- 1.0 kPa"
        " on ant_mid)"
    )
    found = st.pressure(trial, "all")
    assert repr(found) == (
        "TrialPressure(scene, all 0.00 s to 23.75 s; 23 regions, peak pressure 57.6 to 62.5 kPa)"
    )
    assert found.map.estimate.normal_pressure[48, ANT_MID] == pytest.approx(60e3)
    assert repr(st.cycles(trial, "Fz", by="placed:removed")) == (
        "Cycles(1 cycle from each 'placed' to the next 'removed', 11.75 s (11.75 to 11.75 s))"
    )


# --- the document of pressures


@pytest.fixture(scope="module")
def document(trial: Trial) -> dict[str, Any]:
    return json.loads(st.pressure(trial, "all", share=0.05).to_json())


def test_a_pressure_s_document_says_what_it_is_of(document: dict[str, Any]) -> None:
    assert document["trial"] == "scene" and document["samples"] == 96
    assert document["segment"] == {"kind": "all", "start": 0.0, "end": 23.75}
    assert document["threshold [kPa]"] == 5.0
    assert document["largest reach of an interval [-]"] == 0.05
    assert document["integrated time [s]"] == pytest.approx(23.75)
    assert document["source"] == "made by hand"


def test_a_pressure_s_document_holds_its_regions(document: dict[str, Any]) -> None:
    own = document["regions"]["anterior"]
    assert own["tiles"] == ["ant_prox", "ant_mid", "ant_end"] and own["nearest tile"] == "ant_mid"
    peak = own["peak pressure [kPa]"]
    ends = [peak[end] for end in ("low", "value", "high")]
    assert ends == pytest.approx([57.55, 60.0, 62.45]) and peak["uncertain"] is False
    assert own["share of load [%]"]["high"] == pytest.approx(34.5745, rel=1e-5)
    pulled = document["regions"]["lateral middle"]
    assert pulled["nearest tile"] is None
    assert pulled["centre of pressure x [mm]"]["value"] is None
    assert pulled["centre of pressure x [mm]"]["uncertain"] is True


def test_a_pressure_s_document_holds_tiles_and_limb(document: dict[str, Any]) -> None:
    assert document["tiles"]["left_prox"]["shear direction [deg]"]["value"] == pytest.approx(90.0)
    assert document["tiles"]["ant_mid"]["mean pressure [kPa]"]["low"] == pytest.approx(38.04)
    assert document["limb"]["stiffness Fx [N/mm]"]["value"] == pytest.approx(40.0, rel=0.01)


def test_regions_can_be_given(trial: Trial) -> None:
    """(40 - 1) / 2 kPa; the standard regions stay."""
    found = st.pressure(trial, "all", regions={"own": ["ant_mid", "right_mid"]})
    assert found.regions.loc["own", "mean pressure [kPa]"] == pytest.approx(19.5)
    assert "tibia" not in found.regions.index and "anterior" in found.regions.index


@pytest.mark.parametrize(
    ("choices", "fact"),
    [
        ({"threshold": -0.1}, "--threshold"),
        ({"threshold": 500.1}, "--threshold"),
        ({"share": -0.1}, "--share"),
        ({"share": 5.1}, "--share"),
    ],
)
def test_a_pressure_has_limits(choices: dict[str, float], fact: str, trial: Trial) -> None:
    with pytest.raises(ConfigurationError, match=fact):
        st.pressure(trial, "all", **choices)  # type: ignore[arg-type]
