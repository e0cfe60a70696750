"""`survey` as a user calls it, on simulated donnings whose forces are known."""

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.bags import of_another_socket
from support.pages import Page
from support.verbs import call, refused

import socket_testbed as st
from socket_testbed.files import packaged

PLACES = (
    ("brim_lateral", "mid_anterior", "posterior_distal", "distal"),
    ("h237_a238", "h262_a358", "h145_a145", "h065_a356"),
)
NAMES = PLACES[0]


def socket_with(places: tuple[str, ...], path: Path) -> Path:
    """The package's socket with its clusters on other tiles."""
    text = packaged("config", "socket.yaml").read_text()
    listed = ", ".join(f"{name}: {tile}" for name, tile in zip(NAMES, places, strict=True))
    path.write_text(re.sub(r"(?sm)^clusters: \{.*?\}", f"clusters: {{{listed}}}", text))
    return path


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Settings with few hypotheses, which are quick."""
    path = tmp_path_factory.mktemp("few") / "testbed.yaml"
    path.write_text("estimator_node: {ros__parameters: {force_map: {draws: 6}}}\n")
    return path


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three donnings of a limb: two with the clusters in place, one with moved ones."""
    folder = tmp_path_factory.mktemp("surveyed")
    found = []
    for number, places in enumerate((PLACES[0], PLACES[0], PLACES[1])):
        path = folder / f"d{number}"
        socket = socket_with(places, folder / f"{number}.yaml")
        st.simulate(path, duration=40, rate=1, seed=7, donning=number, geometry=socket)
        found.append(path)
    return found


def test_a_survey_says_how_wrong_the_map_is(trials, few, tmp_path, capsys) -> None:
    table, figure = tmp_path / "judged.csv", tmp_path / "maps.png"
    words = ("survey", *trials, "--params", few)
    code, out, _ = call(capsys, *words, "-o", table, "--figure", figure)
    found = st.survey(*trials, params=few)
    assert code == 0 and out.startswith(f"{found.verdict}\n")
    assert found.judgements.repeats == 4
    assert len(found.judgements.points) == 16  # four of d2 for two maps, eight for that of d2
    assert found.clusters[2] == dict(zip(NAMES, PLACES[1], strict=True))
    written = pd.read_csv(table)
    np.testing.assert_allclose(written["difference [N]"], found.to_dataframe()["difference [N]"])
    assert figure.stat().st_size > 10_000
    assert len({*found.next_tiles}) == 4
    assert not {*found.next_tiles} & {tile for each in PLACES for tile in each}


def test_json_and_page_hold_the_same_survey(trials, few, tmp_path, capsys) -> None:
    page = tmp_path / "survey.html"
    words = ("survey", *trials, "--params", few, "--clusters", 0)
    code, out, _ = call(capsys, *words, "-o", page, "--json")
    document = json.loads(out)
    assert code == 0 and document["next"] == {"tiles": [], "error [-]": None}
    assert document["verdict"][1:] in Page(page.read_text(encoding="utf-8")).text


def test_each_trial_takes_its_own_socket(trials, few, tmp_path, capsys) -> None:
    """The second trial's clusters are said to be elsewhere: there is no repeat any more."""
    sockets = [
        socket_with(places, tmp_path / f"{number}.yaml")
        for number, places in enumerate((PLACES[0], PLACES[1]))
    ]
    words = ("survey", *trials[:2], "--params", few, "--clusters", 0, "--json")
    code, out, _ = call(capsys, *words, "--geometry", *sockets)
    found = json.loads(out)
    assert code == 0 and found["repeats"] == 0
    assert found["trials"][1]["clusters"]["distal"] == PLACES[1][3]


def test_the_judged_error_is_near_the_true_one(trials) -> None:
    found = st.survey(*trials, clusters=0)
    truth = np.load(trials[0] / "ground_truth.npz")
    tiles = found.geometry.rotations
    true = np.einsum("nij,kni->knj", tiles, truth["forces"])[20:36].mean(axis=0)
    bare = ~found.surveyed.covered
    own = (found.single[0].forces.mean(axis=0) - true)[bare]
    error = np.sqrt((own**2).sum() / (true[bare] ** 2).sum())
    assert found.judgements.error.low < error < found.judgements.error.high


def test_wrong_surveys_are_refused(trials, few, tmp_path, capsys) -> None:
    refused(capsys, "survey", trials[0], named=["trials of a survey: 1", "give 2 to 12"])
    refused(capsys, "survey", trials[0], trials[0], named=["is given twice"])
    same = ("survey", *trials[:2], "--params", few)
    refused(capsys, *same, named=["on the same tiles", "--geometry"])
    refused(
        capsys, "survey", *trials, "--geometry", tmp_path / "x.yaml",
        named=["1 sockets for 3 trials"],
    )  # fmt: skip
    refused(
        capsys, "survey", trials[0], trials[2], "--clusters", 64, "--keep-out", "anterior",
        named=["64 clusters do not fit on 54 tiles", "--clusters"],
    )  # fmt: skip
    refused(
        capsys, "survey", trials[0], trials[2], "--keep-out", "nowhere",
        named=["no region or tile 'nowhere'"],
    )  # fmt: skip
    other = of_another_socket(trials[2], tmp_path / "wider")
    refused(capsys, "survey", trials[0], other, named=["another socket"])


def test_unlike_loads_are_refused(trials, tmp_path, capsys) -> None:
    """A hold of 200 s is still unloaded when one of 40 s is not."""
    socket = socket_with(PLACES[1], tmp_path / "moved.yaml")
    st.simulate(tmp_path / "later", duration=200, rate=1, seed=7, geometry=socket)
    refused(
        capsys, "survey", trials[0], tmp_path / "later", "--segment", "15:20",
        named=["no load of the first trial occurs in trial 2", "--segment"],
    )  # fmt: skip


def test_a_survey_serves_the_next_trial(trials, few, tmp_path, capsys) -> None:
    places = ("h239_a126", "h114_a080", "h113_a302", "h007_a054")
    socket = socket_with(places, tmp_path / "next.yaml")
    st.simulate(tmp_path / "next", duration=40, rate=1, seed=7, donning=5, geometry=socket)
    file = tmp_path / "survey.json"
    code, *_ = call(capsys, "survey", *trials, "--params", few, "-o", file)
    assert code == 0
    words = ("pressure", tmp_path / "next", "--params", few, "--prior", file, "--json")
    code, out, _ = call(capsys, *words)
    source = json.loads(out)["source"]
    assert code == 0 and source.startswith("prior: survey of d0, d1, d2, with ")
    found = st.survey(*trials, params=few, clusters=0)
    maps = [
        st.force_map(tmp_path / "next", params=few, prior=prior) for prior in (None, file, found)
    ]
    rows, geometry = maps[0].segment.rows, maps[0].trial.geometry
    taken = {geometry.names.index(tile) for each in (*PLACES, places) for tile in each}
    bare = np.setdiff1d(np.arange(len(geometry)), [*taken])
    truth = np.load(tmp_path / "next" / "ground_truth.npz")["forces"][rows][:, bare]
    plain, stored, kept = (
        np.linalg.norm(each.estimate.forces[:, bare] - truth) / np.linalg.norm(truth)
        for each in maps
    )
    assert stored == pytest.approx(kept, rel=1e-6)
    assert stored < plain
    refused(
        capsys, "pressure", trials[1], "--prior", file,
        named=["d1 is in the survey of d0, d1, d2 (d1)", "leave out --prior"],
    )  # fmt: skip
    refused(capsys, "pressure", trials[1], "--prior", socket, named=["is not a survey"])
