"""A survey as a prior: every door takes it, and tells in a line which prior was used."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.surveys import prior_by_hand, write_survey_file

import socket_testbed as st
from socket_testbed.__main__ import run
from socket_testbed.errors import ConfigurationError
from socket_testbed.identification.survey_prior import read_survey
from socket_testbed.pages.player import Player
from socket_testbed.trials.trial import Trial

PART = "6:9"  # 13 samples
LINE = re.compile(
    r"prior: survey of a, b, with \d+ % probability in (\d+) of (\d+) samples, whose loads are like"
    r" the survey's; otherwise mean zero; measured: wrench, brim_lateral, "
)


@pytest.fixture(scope="module")
def opened(scene_folder: Path) -> Trial:
    return st.open_trial(scene_folder, notify=lambda note: None)


@pytest.fixture(scope="module")
def survey(opened: Trial, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A survey whose first load is that of the eighth second, the second half of it.

    Its two trials measured what two of the trial's clusters did then.
    """
    samples = opened.samples()
    tiles = [opened.geometry.clusters[name] for name in samples.clusters[:2]]
    load, forces = samples.wrench[32].tolist(), samples.local_forces[32, :2].tolist()
    prior = prior_by_hand(opened.geometry, (tiles[0], tiles[1]), load, forces)
    return write_survey_file(tmp_path_factory.mktemp("survey") / "survey.json", prior)


def test_pressure_tells_its_prior(
    opened: Trial, survey: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = st.pressure(opened, PART, prior=survey)
    like, count = map(int, LINE.match(found.document()["source"]).groups())  # type: ignore[union-attr]
    assert (0 < like < count) and count == 13
    assert run(["pressure", str(opened.path), "--segment", PART, "--prior", str(survey)]) == 0
    assert f"\n{found.outputs.source}\n" in capsys.readouterr().out


def test_the_survey_changes_the_map(opened: Trial, survey: Path, tmp_path: Path) -> None:
    own, after = (st.force_map(opened, PART, prior=each).mean for each in (None, survey))
    assert LINE.match(after.source)
    assert own.source.startswith("prior: mean zero; measured: ")
    assert not np.allclose(own.forces, after.forces, atol=0.01)
    words = ["map", str(opened.path), "--segment", PART, "--prior", str(survey)]
    assert run([*words, "-o", str(tmp_path / "map.csv")]) == 0
    table = np.loadtxt(tmp_path / "map.csv", delimiter=",", skiprows=1)
    expected = st.force_map(opened, PART, prior=survey).to_dataframe()
    np.testing.assert_allclose(table[:, 1:], expected, rtol=1e-6, atol=1e-6)


def test_an_export_notes_its_prior(opened: Trial, survey: Path, tmp_path: Path) -> None:
    table = st.export(opened, tmp_path / "a.csv", PART, pressure=True, prior=survey)
    (note,) = table.attrs["notes"]
    assert LINE.match(note)
    usual = st.export(opened, tmp_path / "b.csv", PART, pressure=True)
    assert usual.attrs["notes"] == ()
    assert not np.allclose(
        table["pressure.socket.mean pressure [kPa]"],
        usual["pressure.socket.mean pressure [kPa]"],
        atol=1e-3,
    )


def test_a_prior_needs_a_column(opened: Trial, survey: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="add --map or --pressure"):
        st.export(opened, tmp_path / "a.csv", PART, prior=survey)


def test_validation_tells_the_prior(opened: Trial, survey: Path) -> None:
    found = st.validate(opened, prior=survey)
    (line,) = found.priors
    assert line.startswith("scene: ")
    assert LINE.match(line.removeprefix("scene: "))
    assert found.document()["priors"] == [line]

    def error(judged: st.Validation) -> float:
        table = judged.summary().xs(("cluster", "force map"), level=("question", "predictor"))
        return float(table["error [-]"].iloc[0])

    usual = st.validate(opened)
    assert usual.priors == ()
    assert error(found) != pytest.approx(error(usual), abs=1e-4)


def test_a_page_tells_the_prior(opened: Trial, survey: Path) -> None:
    learnt = read_survey(survey)
    shown = Player(opened, prior=learnt).start()["facts"]
    assert LINE.match(shown["map from"])
    assert "map from" not in Player(opened).start()["facts"]


def test_each_trial_of_a_folder_notes_its_prior(
    scene_folder: Path, survey: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for name in ("first", "second"):
        shutil.copytree(scene_folder, tmp_path / "study" / name)
    words = ["pressure", str(tmp_path / "study"), "--segment", PART, "--prior", str(survey)]
    assert run([*words, "-o", str(tmp_path / "out"), "--jobs", "1"]) == 0
    told = "".join(capfd.readouterr())
    for name in ("first", "second"):
        assert f"{name}: prior: survey of a, b, with " in told


def test_a_trial_of_the_survey_is_refused(opened: Trial, survey: Path, tmp_path: Path) -> None:
    prior = read_survey(survey)
    trials = prior.document()["trials"]
    trials[1]["fingerprint"] = opened.fingerprint
    own = write_survey_file(tmp_path / "own.json", prior, trials=trials)
    with pytest.raises(ConfigurationError, match=r"scene is in the survey of a, b \(b\)"):
        st.pressure(opened, PART, prior=own)


def test_another_kind_of_prior_is_refused(opened: Trial) -> None:
    with pytest.raises(ConfigurationError, match=r"the prior is 3: give a result of st.survey"):
        st.pressure(opened, PART, prior=3)  # type: ignore[arg-type]
