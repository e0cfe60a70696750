"""`compare` as a user calls it, against each trial's own `pressure`."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.bags import edited, of_another_socket
from support.pages import Page
from support.verbs import call, refused

import socket_testbed as st

SEGMENT = ("--segment", "15:17")


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two short trials."""
    path = tmp_path_factory.mktemp("compared")
    for seed, name in enumerate(("gel", "sock")):
        st.simulate(path / name, duration=30, seed=seed)
    return path / "gel", path / "sock"


def test_values_are_those_of_each_trial_s_pressure(trials, capsys) -> None:
    """What a difference is made of them: test_comparison.py."""
    code, out, _ = call(capsys, "compare", *trials, *SEGMENT, "--json")
    found = st.compare(*trials, segment="15:17")
    assert code == 0 and found.document() == json.loads(out)
    rows = found.to_dataframe().set_index(["part", "name", "quantity", "item"]).sort_index()
    outputs = st.pressure(trials[1], "15:17")
    for (part, name, title), value in outputs.rows().items():
        row = rows.loc[(part, name, title.split(" [")[0], "sock")]
        ends = ["value", "low", "high"]
        np.testing.assert_array_equal(row[ends].astype(float), [value[end] for end in ends])


def test_repeated_donnings_give_their_spread(trials, tmp_path, capsys) -> None:
    again = st.simulate(tmp_path / "sock2", duration=30, seed=2)
    words = ["--condition", f"gel={trials[0]}", "--condition", f"sock={trials[1]}"]
    words += ["--condition", f"sock={tmp_path}", *SEGMENT]  # a folder of trials
    code, out, _ = call(capsys, "compare", *words)
    found = st.compare(conditions={"gel": trials[:1], "sock": [trials[1], again]}, segment="15:17")
    assert code == 0 and out.startswith(f"conditions gel, sock: {found.title}\n")
    assert found.document()["conditions"] == {"gel": ["gel"], "sock": ["sock", "sock2"]}
    rows = found.to_dataframe().set_index(["part", "name", "quantity", "item"])
    mean = rows.loc[("regions", "socket", "mean pressure", "sock")]
    assert f"differences of at least {mean['detectable']:.1f} kPa" in found.title
    outputs = [st.pressure(trial, "15:17").tiles for trial in (trials[1], again)]
    values = np.array([output["peak pressure [kPa]"] for output in outputs])
    shown = rows.loc["tiles"].xs(("peak pressure", "sock"), level=("quantity", "item"))
    np.testing.assert_allclose(shown["value"], values.mean(axis=0))
    np.testing.assert_allclose(shown["spread"], values.std(axis=0, ddof=1))


def test_regions_of_one_name_are_compared_where_alike(trials, tmp_path) -> None:
    def add_regions(document) -> None:
        number, tiles = len([*tmp_path.iterdir()]) - 1, [*document["tiles"]]
        document["regions"] = {"same": tiles[:3], "other": tiles[number : number + 3]}
        document["regions"] |= {} if number else {"alone": tiles[:1]}

    copies = [edited(trial, tmp_path / trial.name, add_regions) for trial in trials]
    found = st.compare(*copies, segment="15:17")
    names = {*found.to_dataframe()["name"]}
    assert "same" in names and not names & {"other", "alone"}
    assert "these regions differ between trials: alone, other" in found.notes[0]


def test_different_sockets_are_compared_by_region(trials, tmp_path, capsys) -> None:
    words = ("compare", trials[1], of_another_socket(trials[0], tmp_path / "wider"), *SEGMENT)
    refused(capsys, *words, named=["wider is of another socket", "--by-region", "sock"])
    document = json.loads(call(capsys, *words, "--by-region", "--json")[1])
    assert {row["part"] for row in document["rows"]} >= {"regions", "wrench"}


def test_legs_are_compared_by_anatomy(trials, tmp_path, capsys) -> None:
    legs = [shutil.copytree(trial, tmp_path / trial.name) for trial in trials]
    st.annotate(legs[0], side="left", liner="<b>gel</b>", subject="S01")
    st.annotate(legs[1], side="right", mass=81.5, subject="S01")
    page = tmp_path / "legs.html"
    code, out, _ = call(capsys, "compare", tmp_path, *SEGMENT, "-o", page)  # a folder of both
    assert code == 0 and out.startswith("trials gel, sock: segment 15:17") and "sock - gel" in out
    assert "medial middle" in out
    # Medial of a left leg is where lateral of a right leg is: the first trial's tiles.
    found = st.compare(*legs, segment="15:17")
    st.annotate(legs[1], subject="S02")  # the legs of one person are two limbs, too
    others = st.compare(*legs, segment="15:17").to_dataframe()
    ends = ["difference low", "difference high"]
    pd.testing.assert_frame_equal(found.to_dataframe()[ends], others[ends])
    names = {*found.to_dataframe()["name"]}
    assert "medial middle" in names and "left middle" not in names
    written = Page(page.read_text())
    assert written.open == []
    assert "left and right legs are compared" in written.text
    expected = found.cells("regions", "mean pressure").loc["socket"]
    assert written.rows("socket-table")["mean pressure [kPa]"] == expected.tolist()
    assert len(json.loads(written.script("page-data"))["maps"]) == 3
