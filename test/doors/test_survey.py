"""A survey worked out by hand, read in its table, its words, its JSON, the terminal and the page.

Trial `a` has a cluster on ant_prox, trial `b` one on post_mid; both tiles have 9 cm^2, so that 9 N
are 10 kPa. The map of `a` says 12 kPa where `b` measured 10, with a deviation of 1 kPa; the rival
says 5 kPa. The map of `b` says 3 kPa where `a` measured 4; the rival says 4 kPa.
"""

import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import scene
from support.pages import Page
from support.surveys import prior_by_hand

import socket_testbed as st
from socket_testbed.commands.pages import _show_survey
from socket_testbed.identification.survey import Field, Interval, JudgedPoint, Judgements
from socket_testbed.results.survey import Survey

STATES = 2
UP = np.tile([0.0, 0.0, 1.0], (STATES, 1))


def judged(
    number: int, tile: str, distance: float, measured: float, estimated: float, rival: float
) -> JudgedPoint:
    """A judged place with normal pressures [kPa] on 9 cm^2, a deviation of 1 kPa, and of shears."""
    to_force = -0.9  # [N/kPa]
    return JudgedPoint(
        trial=number,
        other=1 - number,
        cluster=0,
        tile=scene.TILES.index(tile),
        distance=distance,
        measured=measured * to_force * UP,
        estimated=estimated * to_force * UP,
        deviations=np.tile([0.3, 0.6, 0.9], (STATES, 1)),
        rival=rival * to_force * UP,
        expected=1.0,
        mapped=0.5,
    )


def field(pressure: float, deviation: float) -> Field:
    """A map with one pressure everywhere [kPa], half of it at the first state."""
    areas = scene.geometry().areas
    shares = np.array([0.5, 1.5])[:, None]
    forces, deviations = np.zeros((2, STATES, len(areas), 3))
    forces[..., 2] = -1e3 * pressure * areas * shares
    deviations[..., 2] = 1e3 * deviation * areas
    return Field(forces, deviations)


@pytest.fixture
def found() -> Survey:
    points = (
        judged(0, "post_mid", 0.1, 10.0, 12.0, 5.0),
        judged(1, "ant_prox", 0.05, 4.0, 3.0, 4.0),
    )
    return Survey(
        trials=("a", "b"),
        segments=("plateau 1.00 s to 9.00 s", "all"),
        geometry=scene.geometry(),
        clusters=({"one": "ant_prox"}, {"one": "post_mid"}),
        states=STATES,
        mismatch=0.0123,
        change=0.12,
        judgements=Judgements(
            points=points,
            error=Interval(0.314, 0.25, 0.382),
            completed=Interval(0.2, 0.15, 0.27),
            explained=Interval(0.333, 0.1, 1.0),
            repeated=0.15,
            repeats=2,
        ),
        single=(field(8.0, 2.0), field(6.0, 3.0)),
        completed=(field(7.5, 1.0), field(7.0, 1.5)),
        limb=field(7.25, 1.25),
        learnt=prior_by_hand(scene.geometry()),
        next_tiles=("left_mid", "right_end"),
        next_error=0.92,
        side="right",
        notes=("a note",),
    )


VERDICT = (
    "on this limb a map of 1 clusters is within 0.31 (0.25 to 0.38) of the force between them;"
    " 83 % of 6 measured values lie in its 95 % intervals; donning and sensors explain"
    " 33 % (10 to 100 %) of the judged square"
)
CONCLUSIONS = [
    "completed by 2 trials: within 0.20 (0.15 to 0.27) of the force on tiles that no trial"
    " measured",
    "a donning changes the forces by 0.12 of the limb's; what 2 pairs of clusters left in place"
    " measured differs by 0.15 of the force",
    "next trial: clusters on left_mid, right_end would lower the expected error of the limb's map"
    " by 8 %",
    "2 like loads, which differ by 1.2 % of the force between trials",
]


def test_a_survey_is_pickled(found: Survey) -> None:
    assert pickle.loads(pickle.dumps(found)).document() == found.document()


def test_the_verdict_comes_in_a_sentence(found: Survey) -> None:
    assert found.verdict == VERDICT
    assert found.conclusions() == CONCLUSIONS
    assert repr(found) == "Survey(2 trials a, b; 6 judged values, error 0.31)"


def test_clusters_that_always_moved_ask_for_a_repeat(found: Survey) -> None:
    share = Interval(0.2, np.nan, np.nan)
    moved = replace(found.judgements, repeated=np.nan, repeats=0, explained=share)
    shown = replace(found, judgements=moved, next_tiles=())
    assert shown.verdict.endswith("donning and sensors explain 20 % of the judged square")
    assert "no cluster was left in place" in shown.conclusions()[1]
    assert not any("next trial" in line for line in shown.conclusions())
    assert shown.document()["repeated [-]"] is None


def test_judged_places_are_in_their_units(found: Survey) -> None:
    first, second = found.to_dataframe().to_dict("records")
    assert first == {
        "map": "a",
        "measured in": "b",
        "cluster": "one",
        "tile": "post_mid",
        "region": "posterior",
        "distance [mm]": 100.0,
        "measured pressure [kPa]": pytest.approx(10.0),
        "pressure [kPa]": pytest.approx(12.0),
        "pressure sd [kPa]": pytest.approx(1.0),
        "rival pressure [kPa]": pytest.approx(5.0),
        "measured force [N]": pytest.approx(9.0),
        "difference [N]": pytest.approx(1.8),
        "rival difference [N]": pytest.approx(4.5),
        "within 50 % [-]": pytest.approx(2 / 3),  # both tangents are exact
        "within 80 % [-]": pytest.approx(2 / 3),
        "within 95 % [-]": pytest.approx(2 / 3),  # 2 deviations off
    }
    assert second["within 80 % [-]"] == 1.0  # 1 deviation off
    assert (second["map"], second["region"]) == ("b", "anterior")


SCORES = {
    # values, error, rival, bias
    "all": (6, 0.20762, 0.46424, 0.45 / 6.3),  # (1.8^2 + 0.9^2) over (9^2 + 3.6^2); 4.5^2
    "map of a": (3, 0.2, 0.5, 0.2),
    "map of b": (3, 0.25, 0.0, -0.25),
    "anterior": (3, 0.25, 0.0, -0.25),
    "posterior": (3, 0.2, 0.5, 0.2),
    "40 to 60 mm from a cluster": (3, 0.25, 0.0, -0.25),
    "60 mm and more from a cluster": (3, 0.2, 0.5, 0.2),
}


def test_scores_are_by_map_region_and_distance(found: Survey) -> None:
    scores = found.scores()
    assert [*scores.index] == [*SCORES]
    assert scores.loc["all"].iloc[-3:].tolist() == pytest.approx([4 / 6, 5 / 6, 5 / 6])


@pytest.mark.parametrize("judged", SCORES)
def test_a_score_has_error_rival_and_bias(judged: str, found: Survey) -> None:
    values, *expected = SCORES[judged]
    row = found.scores().loc[judged]
    assert row["values [1]"] == values
    shown = row[["error [-]", "rival [-]", "bias [-]"]].tolist()
    assert shown == pytest.approx(expected, abs=1e-5)


def test_pressures_are_means_over_like_loads(found: Survey) -> None:
    row = found.pressures().loc["left_prox"]  # of 16 cm^2
    assert row.to_dict() == pytest.approx(
        {
            "a own [kPa]": 8.0,
            "a own sd [kPa]": 2.0,
            "a completed [kPa]": 7.5,
            "a completed sd [kPa]": 1.0,
            "b own [kPa]": 6.0,
            "b own sd [kPa]": 3.0,
            "b completed [kPa]": 7.0,
            "b completed sd [kPa]": 1.5,
            "limb [kPa]": 7.25,
            "limb sd [kPa]": 1.25,
        }
    )


def test_json_holds_all_of_it(found: Survey) -> None:
    document = json.loads(found.to_json())
    assert document["verdict"] == VERDICT
    assert document["conclusions"] == CONCLUSIONS
    assert document["trials"][1] == {
        "name": "b",
        "segment": "all",
        "clusters": {"one": "post_mid"},
    }
    assert document["error [-]"] == {"value": 0.314, "low": 0.25, "high": 0.382}
    assert document["completed error [-]"]["value"] == 0.2
    assert document["explained [-]"]["high"] == 1.0
    assert document["next"] == {"tiles": ["left_mid", "right_end"], "error [-]": 0.92}
    assert (document["states"], document["mismatch [-]"]) == (2, 0.0123)
    assert (document["repeated [-]"], document["repeats"], document["change [-]"]) == (
        *(0.15, 2),
        0.12,
    )
    assert document["scores"][0]["judged"] == "all"
    assert document["judged"][0]["tile"] == "post_mid"
    assert len(document["tiles"]) == 12 and document["tiles"][1]["tile"] == "left_prox"
    assert document["notes"] == ["a note"]


def test_the_terminal_begins_with_the_verdict(
    found: Survey, capsys: pytest.CaptureFixture[str]
) -> None:
    _show_survey(found)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == VERDICT
    assert lines[2:6] == [f"- {line}" for line in CONCLUSIONS]
    assert lines[6] == "note: a note"
    (whole,) = (line.split() for line in lines if line.startswith("all "))
    assert whole == ["all", "6", "0.21", "0.46", "7", "67", "83", "83"]
    places = [line.split() for line in lines if " post_mid " in line or " ant_prox " in line]
    assert places == [
        ["a", "b", "post_mid", "posterior", "100", "10.0", "12.0", "1.0", "1.8", "9.0"],
        ["b", "a", "ant_prox", "anterior", "50", "4.0", "3.0", "1.0", "0.9", "3.6"],
    ]


def test_the_page_shows_maps_beside_each_other(found: Survey, tmp_path: Path) -> None:
    st.write_survey(found, tmp_path / "survey.html", "by hand")
    page = Page((tmp_path / "survey.html").read_text(encoding="utf-8"))
    assert f"O{VERDICT[1:]}." in page.text
    assert [line for line in CONCLUSIONS if line not in page.text] == []
    data = json.loads(page.script("page-data"))
    assert [card["value"] for card in data["cards"]] == ["31 %", "20 %", "33 %"]
    assert [card["interval"] for card in data["cards"]] == [
        "25 to 38 %",
        "15 to 27 %",
        "10 to 100 %",
    ]
    shown = [shown["moment"]["pressure"][1] for shown in data["maps"]]
    assert shown == [8.0, 7.5, 6.0, 7.0, 7.25]
    assert data["maps"][0]["moment"]["reach"][1] == pytest.approx(3.92)
    titles = ("a own", "a completed", "b own", "b completed", "limb")
    assert [title for title in titles if title not in page.text] == []
    assert page.rows("scores")["all"] == ["6", "0.21", "0.46", "7", "67", "83", "83"]
    assert page.said["h2"] == [
        *("Verdict", "Notes", "Own and completed maps", "Judged"),
        *("Numbers", "Judged places", "Tile by tile", "Data", "Trials", "Provenance"),
    ]
    assert page.rows("trials-table")["b"] == ["all; one on post_mid"]
    assert page.rows("provenance-table")["command"] == ["by hand"]


def test_pictures_outline_all_measured_tiles(found: Survey) -> None:
    assert found.surveyed.clusters == {
        "ant_prox": scene.TILES.index("ant_prox"),
        "post_mid": scene.TILES.index("post_mid"),
    }
    headings = {text.get_text() for axis in found.figure().axes for text in [axis.title]} | {
        axis.get_title(loc="left") for axis in found.figure().axes
    }
    assert {"a own", "a completed", "b own", "b completed", "limb"} <= headings
