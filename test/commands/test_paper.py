"""`paper`: the published pipeline by one command, against fits by hand and the printed numbers."""

import json

import numpy as np
import pandas as pd
import pytest

import socket_testbed as st
from socket_testbed.__main__ import run
from socket_testbed.api import PaperTable

WITHOUT, WITH = ("this trial", "without offsets"), ("this trial", "with offsets")


@pytest.fixture(scope="module")
def figures(hold, tmp_path_factory) -> tuple[PaperTable, dict]:
    """The table of the first 50 samples, and the models of two plain fits."""
    folder = tmp_path_factory.mktemp("paper")
    frames = ["--frames", "50", "--leave-out", "distal.Fy", "--initial-stiffness", "auto"]
    models = {}
    for title, variant in ((WITHOUT, "stiffness"), (WITH, "stiffness_bias")):
        path = folder / f"{variant}.json"
        words = ["fit", str(hold), "-o", str(path), "--variant", variant, "--weights", "raw"]
        assert run([*words, *frames]) == 0
        models[title] = json.loads(path.read_text())
    trial = st.open_trial(hold)
    found = st.paper(trial, thetas=11, frames=50, leave_out=["distal.Fy"], initial_stiffness="auto")
    return found, models


def test_the_figures_are_those_of_the_paper_s_variants_on_the_first_frames(hold, figures) -> None:
    found, models = figures
    rows = found.to_dataframe()
    for title, model in models.items():
        rmse = {error["name"]: error["rmse"] for error in model["quality"]["errors"]}
        assert model["quality"]["samples"] <= 50
        for name, value in rmse.items():
            (row,) = (key for key in rows.index if key.startswith(f"RMSE of {name} ["))
            assert rows.loc[row, title] == pytest.approx(value)
        local = [v for name, v in rmse.items() if "." in name and name != "distal.Fy"]
        median = rows.loc["median RMSE of the clusters in the objective [N]", title]
        assert median == pytest.approx(np.median(local))
        forces = [rmse[name] for name in ("Fx", "Fy", "Fz")]
        assert rows.loc["mean RMSE of the forces [N]", title] == pytest.approx(np.mean(forces))
    samples = st.open_trial(hold).samples()
    start = st.select_segment(samples).rows.start
    span = f"plateau {samples.time[start]:.2f} s to {samples.time[start + 49]:.2f} s"
    assert str(found.segment) == span
    k0 = {model["settings"]["initial_stiffness"] for model in models.values()}
    assert len(k0) == 1 and k0 != {0.0}


def test_the_thetas_are_those_of_the_front(hold, figures) -> None:
    rows = figures[0].to_dataframe()
    trial = st.open_trial(hold)
    same = st.pareto(
        trial,
        figures[0].segment,
        thetas=11,
        leave_out=["distal.Fy"],
        weights="raw",
        initial_stiffness="auto",
    )
    for title, front in zip((WITHOUT, WITH), same.fronts.values(), strict=True):
        for mark in ("sensor-only", "knee", "wrench-only"):
            index = front.marks.get(mark)
            expected = np.nan if index is None else front.theta[index]
            np.testing.assert_equal(rows.loc[f"theta, {mark} [-]", title], expected)


def test_a_printed_number_stands_with_the_reason_why_it_is_not_comparable(figures) -> None:
    rows = figures[0].to_dataframe()
    printed = {
        "mean RMSE of the moments [N m]": (1.69, 0.44),
        "mean RMSE of the forces [N]": (5.94, 5.25),
        "RMSE of Mx [N m]": (3.99, 0.95),
        "median RMSE of the clusters in the objective [N]": (90.07, 3.76),
    }
    remarks = rows["", "remark"]
    for name, theirs in rows["the paper"].iterrows():
        np.testing.assert_equal((*theirs,), printed.get(name, (np.nan, np.nan)))
        if name in printed:
            assert "not comparable: 50 samples, 1000" in remarks[name]
        elif name != "RMSE of distal.Fy [N]":
            assert "the number is not in this package" in remarks[name]
    assert "11 of 12 channels counted, 9" in remarks[[*printed][3]]
    assert "left out of the objective" in remarks["RMSE of distal.Fy [N]"]


def test_the_command_prints_what_the_api_gives(hold, figures, capsys) -> None:
    rows = figures[0].to_dataframe()
    words = ["paper", str(hold), "--thetas", "11", "--frames", "50", "--leave-out", "distal.Fy"]
    words += ["--initial-stiffness", "auto"]
    assert run([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == figures[0].document()
    found = pd.DataFrame.from_dict(document["figures"], orient="index")
    np.testing.assert_array_equal(found.iloc[:, :4].astype(float), rows.iloc[:, :4])
    assert run(words) == 0
    out = capsys.readouterr().out
    shown = next(line for line in out.splitlines() if line.startswith("mean RMSE of the moments"))
    values = rows.loc["mean RMSE of the moments [N m]"]
    assert f"{values[WITHOUT]:.3f}" in shown and f"{values[WITH]:.3f}" in shown and "1.690" in shown
    assert "weights raw" in out and "8 mm of the mean limb position" in out
