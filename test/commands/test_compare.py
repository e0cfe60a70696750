"""`compare` as a user calls it, against each trial's own `pressure` and each model's own file."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from support.pages import Page

import socket_testbed as st
from socket_testbed.__main__ import run

SEGMENT = ("--segment", "15:20")


def call(capsys, *words: object) -> tuple[int, str, str]:
    code = run([str(word) for word in words])
    return code, *capsys.readouterr()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short trials, and a copy of one in another socket."""
    path = tmp_path_factory.mktemp("compared")
    for seed, name in enumerate(("gel", "sock")):
        st.simulate(path / "trials" / name, duration=30, seed=seed)
    other = shutil.copytree(path / "trials" / "gel", path / "wider")
    document = yaml.safe_load((other / "socket.yaml").read_text())
    for tile in document["tiles"].values():
        tile["anchor"][0] *= 1.1
    (other / "socket.yaml").write_text(yaml.safe_dump(document))
    return path


@pytest.fixture(scope="module")
def trials(folder: Path) -> tuple[Path, Path]:
    return folder / "trials" / "gel", folder / "trials" / "sock"


def own_outputs(capsys, trial: Path) -> dict:
    code, out, _ = call(capsys, "pressure", trial, *SEGMENT, "--json")
    assert code == 0
    return json.loads(out)


def test_differences_are_those_of_the_trials_own_outputs(trials, tmp_path, capsys) -> None:
    output = tmp_path / "compared.csv"
    code, out, _ = call(capsys, "compare", *trials, *SEGMENT, "-o", output)
    assert code == 0 and "gel" in out and "sock - gel" in out and f"written: {output}" in out
    table = pd.read_csv(output)
    first, second = (own_outputs(capsys, trial) for trial in trials)
    checked = 0
    for part in ("regions", "tiles"):
        rows = table[table["part"] == part].set_index(["name", "quantity", "unit", "item"])
        for name, outputs in second[part].items():
            for title, value in outputs.items():
                if not isinstance(value, dict):
                    continue
                quantity, unit = title.removesuffix("]").split(" [")
                row = rows.loc[(name, quantity, unit, "sock")]
                a, b = first[part][name][title], value
                if b["low"] is None:  # no output of a single tile
                    assert np.isnan(row["low"])
                    continue
                assert row["low"] == b["low"] and row["high"] == b["high"]
                if a["value"] is None or b["value"] is None:
                    assert np.isnan(row["difference"])
                    continue
                assert row["value"] == b["value"]
                if unit == "deg":
                    continue
                difference = b["value"] - a["value"]
                below = max(b["value"] - b["low"], 0.0) ** 2 + max(a["high"] - a["value"], 0.0) ** 2
                above = max(b["high"] - b["value"], 0.0) ** 2 + max(a["value"] - a["low"], 0.0) ** 2
                expected = (difference, difference - below**0.5, difference + above**0.5)
                found = row[["difference", "difference low", "difference high"]]
                np.testing.assert_allclose(found.astype(float), expected, atol=1e-9)
                checked += 1
    assert checked > 40
    ends = table[table["part"] == "regions"][["difference low", "difference high"]].dropna()
    ends = ends[ends.iloc[:, 1] > ends.iloc[:, 0]].to_numpy()
    clear = int((ends[:, 0] > 0.0).sum() + (ends[:, 1] < 0.0).sum())
    assert f"{clear} of {len(ends)} intervals of the regions' differences exclude 0" in out


def test_the_verb_the_api_and_the_files_hold_the_same(trials, tmp_path, capsys) -> None:
    code, out, _ = call(
        capsys, "compare", *trials, *SEGMENT, "--json", "-o", tmp_path / "c.parquet"
    )
    assert code == 0
    document = json.loads(out)
    found = st.compare(*trials, segment="15:20")
    assert found.document() == document
    assert document["items"] == ["gel", "sock"] and document["kind"] == "trials"
    same = pd.read_parquet(tmp_path / "c.parquet")
    same, table = (t.fillna({"text": ""}) for t in (same, found.to_dataframe()))
    pd.testing.assert_frame_equal(same, table, check_dtype=False)
    wrench = found.to_dataframe().query("part == 'wrench' and quantity == 'mean' and name == 'Fz'")
    for trial, value in zip(trials, wrench["value"], strict=True):
        samples = st.open_trial(trial).samples()
        rows = (samples.time >= 15.0) & (samples.time <= 20.0)
        assert value == pytest.approx(samples.wrench[rows, 5].mean())


def test_a_value_of_zero_has_a_difference_with_an_interval(trials, capsys) -> None:
    """Nothing is in contact above 200 kPa: areas are 0, and no share of that is a limit."""
    limit = ("--threshold", 200, "--json")
    code, out, _ = call(capsys, "compare", *trials, *SEGMENT, *limit)
    rows = pd.DataFrame(json.loads(out)["rows"]).query("item == 'sock'")
    areas = rows.query("part == 'regions' and quantity == 'contact area'").set_index("name")
    _, own, _ = call(capsys, "pressure", trials[1], *SEGMENT, *limit)
    regions = json.loads(own)["regions"]
    assert code == 0 and set(areas.index) == set(regions)
    for name, outputs in regions.items():
        high = outputs["contact area [cm^2]"]["high"]
        assert areas["high"][name] == high
        assert areas["difference low"][name] <= 0.0 <= areas["difference high"][name]


def test_a_folder_of_trials_stands_for_all_of_them(folder, capsys) -> None:
    code, out, _ = call(capsys, "compare", folder / "trials", *SEGMENT)
    assert code == 0 and out.startswith("trials gel, sock: segment 15:20")


def test_trials_of_different_sockets_are_compared_by_region_when_asked(
    folder, trials, capsys
) -> None:
    code, out, err = call(capsys, "compare", trials[1], folder / "wider", *SEGMENT)
    assert code == 1 and out == "" and err.count("error: ") == 1
    assert "wider is of another socket" in err and "--by-region" in err and "sock" in err
    own = ("--geometry", trials[0] / "socket.yaml")
    code, out, err = call(capsys, "compare", trials[1], folder / "wider", *SEGMENT, *own)
    assert code == 0 and "tiles with the largest differences" in out
    assert err.count("no side of the leg is stated") == 1  # of both
    words = ("--by-region", "--json")
    code, out, _ = call(capsys, "compare", trials[1], folder / "wider", *SEGMENT, *words)
    document = json.loads(out)
    assert code == 0 and {row["part"] for row in document["rows"]} >= {"regions", "wrench"}
    assert not any(row["part"] == "tiles" for row in document["rows"])
    assert "the trials are of different sockets" in document["notes"][0]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["gel"], ["only", "gel", "two or more"]),
        (["gel", "gel"], ["gel is given twice"]),
        (["gel", "model.json"], ["gel is one of the trials", "model.json one of the models"]),
        (["gel", "gel/socket.yaml"], ["one of the sockets", "compare trials with trials"]),
        (["gel", "nowhere"], ["nowhere", "no such trial"]),
        (["gel/socket.yaml", "nowhere.yaml"], ["nowhere.yaml", "no such file"]),
        (["gel", "sock", "--segment", "50:60"], ["gel: ", "50"]),
        (["gel", "sock", "--threshold", "-1"], ["--threshold", "-1"]),
        (["gel", "sock", "-o", "compared.txt"], ["compared.txt", "'.txt'"]),
        (["gel", "sock", "-o", "gel/socket.yaml"], ["'.yaml' is not a table format"]),
        (["gel"] * 13, ["13 are given", "12"]),
    ],
)
def test_what_cannot_be_compared_is_refused_by_name(
    words, says, trials, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(trials[0].parent)
    code, out, err = call(capsys, "compare", *words)
    assert code == 1 and out == ""
    *notes, error = err.splitlines()
    assert error.startswith("socket-testbed compare: error: "), err
    assert all(note.startswith("note: no side of the leg is stated") for note in notes)
    assert all(said in error for said in says), err


def test_legs_are_compared_by_anatomy_and_the_page_says_so(trials, tmp_path, capsys) -> None:
    legs = [shutil.copytree(trial, tmp_path / trial.name) for trial in trials]
    st.annotate(st.open_trial(legs[0]), side="left", liner="<b>gel</b>", subject="S01")
    code, out, _ = call(capsys, "compare", *legs, *SEGMENT, "--json")
    found = json.loads(out)
    assert code == 0 and any("no side is stated for sock" in note for note in found["notes"])
    assert {row["name"] for row in found["rows"] if row["part"] == "regions"} >= {
        "left middle",
        "right middle",
    }
    st.annotate(st.open_trial(legs[1]), side="right", mass=81.5)
    page = tmp_path / "legs.html"
    code, out, _ = call(capsys, "compare", *legs, *SEGMENT, "-o", page)
    assert code == 0 and "note: left and right legs are compared" in out
    assert "medial middle" in out and "liner: gel: <b>gel</b>; sock: not stated" in out
    # Medial of a left leg is where lateral of a right leg is: the first trial's tiles.
    regions = st.compare(*legs, segment="15:20").to_dataframe().query("part == 'regions'")
    assert "medial middle" in set(regions["name"]) and "left middle" not in set(regions["name"])
    written = Page(page.read_text())
    assert written.open == []
    assert "left and right legs are compared" in written.text
    assert "differences exclude 0; by chance" in written.text
    assert written.rows("metadata-table")["liner"] == ["<b>gel</b>", "not stated"]
    assert written.rows("metadata-table")["mass"] == ["not stated", "81.5 kg"]
    shown = written.rows("socket-table")["mean pressure [kPa]"]
    expected = st.compare(*legs, segment="15:20").cells("regions", "mean pressure").loc["socket"]
    assert shown == expected.tolist()
    assert len([a for tag, a in written.tags if tag == "img" and a["alt"]]) == 2
    assert all(link.startswith(("#", "data:")) for link in written.loads)
    code, _, err = call(capsys, "compare", *legs, *SEGMENT, "-o", page)
    assert code == 1 and "legs.html" in err and "exists" in err


@pytest.fixture(scope="module")
def models(trials, tmp_path_factory) -> Path:
    """Models of two laws."""
    path = tmp_path_factory.mktemp("models")
    for variant in ("stiffness", "stiffness_bias", "rigid"):
        st.fit(st.open_trial(trials[0]), variant=variant).save(path / f"{variant}.json")
    return path


def test_models_differ_by_their_files(models, tmp_path, capsys) -> None:
    paths = [models / "stiffness.json", models / "stiffness_bias.json"]
    code, out, _ = call(capsys, "compare", *paths, "-o", tmp_path / "models.csv")
    assert code == 0 and "variant: stiffness: stiffness; stiffness_bias: stiffness_bias" in out
    table = pd.read_csv(tmp_path / "models.csv")
    first, second = (json.loads(path.read_text()) for path in paths)
    tiles = list(first["geometry"]["tiles"])
    rows = table.query("part == 'tiles' and quantity == 'z stiffness' and item == 'stiffness_bias'")
    stiffness = [np.array(m["parameters"]["stiffness"])[:, 2] for m in (first, second)]
    assert rows["name"].tolist() == tiles
    np.testing.assert_allclose(rows["value"], 1e-3 * stiffness[1], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(rows["difference"], 1e-3 * (stiffness[1] - stiffness[0]), atol=1e-9)
    whole = table.query("part == 'regions' and name == 'socket' and quantity == 'z stiffness'")
    np.testing.assert_allclose(whole["value"], [1e-3 * k.sum() for k in stiffness])
    errors = table.query("part == 'errors' and quantity == 'RMSE in-sample' and name == 'Fz'")
    of_files = [m["quality"]["errors"][5]["rmse"] for m in (first, second)]
    np.testing.assert_allclose(errors["value"], of_files)
    differing = table.query("part == 'settings'")
    assert set(differing["name"]) == {"variant"}


def test_stiffnesses_along_other_axes_are_not_compared(models, capsys) -> None:
    paths = [models / "rigid.json", models / "stiffness.json"]
    code, out, _ = call(capsys, "compare", *paths)
    assert code == 0 and "they are not compared" in out and "N/mm" not in out


def test_sockets_differ_by_where_their_tiles_are(folder, trials, tmp_path, capsys) -> None:
    sockets = [trials[0] / "socket.yaml", folder / "wider" / "socket.yaml"]
    page = tmp_path / "sockets.html"
    code, out, _ = call(capsys, "compare", *sockets, "-o", page)
    assert code == 0 and out.startswith("sockets gel/socket, wider/socket: ")
    found = st.compare(*sockets).to_dataframe()
    first, second = (yaml.safe_load(path.read_text())["tiles"] for path in sockets)
    rows = found.query("part == 'tiles' and quantity == 'distance to the first'")
    rows = rows[rows["item"] == "wider/socket"].set_index("name")["value"]
    for name, tile in second.items():
        apart = np.linalg.norm(np.subtract(tile["anchor"], first[name]["anchor"]))
        assert rows[name] == pytest.approx(1e3 * apart)
    assert "distance to the first" in page.read_text()
    code, out, _ = call(capsys, "compare", sockets[0], trials[1] / "socket.yaml")
    assert code == 0 and "note: all have the same tiles at the same places" in out
