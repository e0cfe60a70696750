"""`validate` on one trial and on several, and `paper` against fits by hand."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from support.bags import of_another_socket
from support.verbs import call, refused

import socket_testbed as st
from socket_testbed.settings.identification import PAPER_VARIANTS
from socket_testbed.trials.trial import Trial


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short trials that move."""
    path = tmp_path_factory.mktemp("moving")
    for seed in range(2):
        st.simulate(path / f"s{seed}", "multi_direction", duration=20, seed=seed)
    return path


def test_one_trial_is_judged_on_its_other_half(folder: Path, capsys) -> None:
    code, out, _ = call(capsys, "validate", folder / "s0")
    assert code == 0
    assert out.startswith("s0: ") and "IN-SAMPLE" in out and "another trial" not in out
    found = st.validate(folder / "s0").summary()
    wrench = found.loc["wrench", "second half"]
    assert wrench["force skill [-]"]["best constant"] <= 0.0  # no constant beats the best one
    errors = found.loc["tiles"].droplevel(0)["error [-]"]
    names = ["force map", "inverse distance, wrench met", "inverse distance"]
    assert 0.1 < errors[names[0]] < errors[names[1]] < errors[names[2]] < 1.0
    assert f"{errors['force map']:.2f}" in out


LEFT_OUT = ["Mx", "brim_lateral.Fx", "brim_lateral.Fy", "brim_lateral.Fz"]


@pytest.fixture(scope="module")
def spoilt(folder: Path) -> tuple[Trial, Trial]:
    """A trial, and the same with wrong values in the channels that are left out."""
    sound, spoilt = (st.open_trial(folder / "s0") for _ in range(2))
    assert spoilt.samples().clusters[0] == "brim_lateral"
    spoilt.samples().local_forces[:, 0] = 40.0
    spoilt.samples().wrench[:, 0] = np.nan
    return sound, spoilt


@pytest.mark.usefixtures("few_variants")
def test_left_out_channels_change_no_judgement(spoilt: tuple[Trial, Trial]) -> None:
    found = [st.validate(trial, leave_out=LEFT_OUT).to_dataframe() for trial in spoilt]
    pd.testing.assert_frame_equal(*found)


def test_left_out_channels_change_no_pressure(spoilt: tuple[Trial, Trial]) -> None:
    found = [st.pressure(trial, "all", leave_out=LEFT_OUT).regions for trial in spoilt]
    pd.testing.assert_frame_equal(*found)


@pytest.mark.usefixtures("few_variants")
def test_trials_predict_each_other(folder: Path, tmp_path, capsys) -> None:
    study, output = shutil.copytree(folder, tmp_path / "study"), tmp_path / "study.csv"
    st.annotate(st.open_trial(study / "s1"), liner="gel", mass=80.0)
    found = st.validate(*(st.open_trial(study / name) for name in ("s0", "s1")))
    code, out, _ = call(capsys, "validate", study, "-o", output)  # a folder of trials
    assert code == 0 and f"written: {output}" in out and "median force skill [-]" in out
    pairs = {(j.fitted_on, j.tested_on) for j in found.judgements if j.test == "other trial"}
    assert pairs == {("s0", "s1"), ("s1", "s0")}
    table = pd.read_csv(output).set_index("trial")
    assert table["liner"].to_dict()["s1"] == "gel" and table["mass [kg]"]["s1"] == 80.0
    judged = "wrench, second half: stiffness force skill [-]"
    np.testing.assert_allclose(table[judged], found.by_trial()[judged].astype(float))


def test_trials_of_different_sockets_are_refused(folder: Path, tmp_path: Path, capsys) -> None:
    other = of_another_socket(folder / "s1", tmp_path / "other")
    named = ["/other is of another socket", "/s0"]
    refused(capsys, "validate", folder / "s0", other, named=named)


def test_a_trial_given_twice_is_refused(folder: Path, capsys) -> None:
    refused(capsys, "validate", folder / "s0", folder, named=["s0 is given twice"])


@pytest.mark.usefixtures("few_variants")
def test_what_cannot_be_judged_is_passed_over(folder: Path, tmp_path: Path, capsys) -> None:
    short = st.simulate(tmp_path / "short", "multi_direction", duration=5, seed=7).path
    (tmp_path / "broken").mkdir()
    recorded = shutil.copytree(folder / "s1", tmp_path / "s1")
    (recorded / "ground_truth.npz").unlink()  # it has no truth to compare with
    trials = folder / "s0", tmp_path / "broken", recorded, short
    code, out, err = call(capsys, "validate", *trials)
    assert code == 0 and "note: short: passed over: only 20 of 20 samples" in err
    assert "note: broken: passed over: " in err and "to fit and to test need 24" in err
    assert out.startswith("3 trials, means over them; models fitted on 2: s0, s1")


# --- the paper's figures on the first frames

CHOSEN = {"leave_out": ["distal.Fy"], "initial_stiffness": "auto"}
TITLES = {
    PAPER_VARIANTS[0]: ("this trial", "without offsets"),
    PAPER_VARIANTS[1]: ("this trial", "with offsets"),
}


@pytest.fixture(scope="module")
def trial(hold: Path) -> Trial:
    return st.open_trial(hold)


@pytest.fixture(scope="module")
def paper(trial: Trial) -> Any:
    return st.paper(trial, thetas=11, frames=50, **CHOSEN)


def test_the_paper_has_two_variants() -> None:
    assert [*TITLES] == [*PAPER_VARIANTS]


@pytest.mark.parametrize("variant", TITLES)
def test_the_figures_are_those_of_a_fit(variant: str, trial: Trial, paper: Any) -> None:
    rows, title = paper.to_dataframe(), TITLES[variant]
    fitted = st.fit(trial, variant=variant, weights="raw", frames=50, **CHOSEN)
    rmse = {error.name: error.rmse for error in fitted.fit.errors}
    assert fitted.fit.samples <= 50 and fitted.segment == paper.segment
    for name, value in rmse.items():
        (row,) = (key for key in rows.index if key.startswith(f"RMSE of {name} ["))
        assert rows.loc[row, title] == pytest.approx(value)
    local = [v for name, v in rmse.items() if "." in name and name != "distal.Fy"]
    median = rows.loc["median local RMSE [N]", title]
    assert median == pytest.approx(np.median(local))


MOMENT = "mean moment RMSE [N m]"


def test_a_printed_number_states_why_it_differs(paper: Any) -> None:
    """It is not comparable."""
    rows = paper.to_dataframe()
    assert rows.loc[MOMENT, "the paper"].tolist() == [1.69, 0.44]
    assert "not comparable: 50 samples, 1000" in rows["", "remark"][MOMENT]


def test_the_verb_prints_the_figures(hold: Path, paper: Any, tmp_path: Path, capsys) -> None:
    rows = paper.to_dataframe()
    words = ["--thetas", 11, "--frames", 50, "--leave-out", "distal.Fy"]
    words += ["--initial-stiffness", "auto", "-o", tmp_path / "paper.csv"]
    code, out, _ = call(capsys, "paper", hold, *words)
    assert code == 0 and len(pd.read_csv(tmp_path / "paper.csv")) == len(rows)
    assert all(f"{rows.loc[MOMENT, title]:.3f}" in out for title in TITLES.values())
