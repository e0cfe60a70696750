"""`pareto` and `paper`: the front and the published pipeline, against fits by hand."""

import numpy as np
import pandas as pd
import pytest
from support.verbs import call

import socket_testbed as st
from socket_testbed.identification.pareto import KNEE, SENSOR_ONLY, WRENCH_ONLY
from socket_testbed.settings.identification import PAPER_VARIANTS

TITLES = ("this trial", "without offsets"), ("this trial", "with offsets")


def test_the_verb_prints_and_writes_both_fronts(hold, tmp_path, capsys):
    table, figure = tmp_path / "front.csv", tmp_path / "front.png"
    code, out, _ = call(capsys, "pareto", hold, "--thetas", 11, "-o", table, "--figure", figure)
    assert code == 0
    for text in (*PAPER_VARIANTS, SENSOR_ONLY, KNEE, WRENCH_ONLY, "[N m]", "of 11", "plateau"):
        assert text in out
    assert len(pd.read_csv(table)) == 2 * 11 and figure.read_bytes().startswith(b"\x89PNG")


def test_the_figures_are_those_of_the_paper_s_variants_on_the_first_frames(
    hold, tmp_path, capsys
) -> None:
    """And a printed number stands with the reason why it is not comparable."""
    chosen = {"leave_out": ["distal.Fy"], "initial_stiffness": "auto"}
    trial = st.open_trial(hold)
    found = st.paper(trial, thetas=11, frames=50, **chosen)
    rows = found.to_dataframe()
    same = st.pareto(trial, found.segment, thetas=11, weights="raw", **chosen)
    for title, variant in zip(TITLES, PAPER_VARIANTS, strict=True):
        fitted = st.fit(trial, variant=variant, weights="raw", frames=50, **chosen)
        rmse = {error.name: error.rmse for error in fitted.fit.errors}
        assert fitted.fit.samples <= 50 and fitted.segment == found.segment
        for name, value in rmse.items():
            (row,) = (key for key in rows.index if key.startswith(f"RMSE of {name} ["))
            assert rows.loc[row, title] == pytest.approx(value)
        local = [v for name, v in rmse.items() if "." in name and name != "distal.Fy"]
        median = rows.loc["median RMSE of the clusters in the objective [N]", title]
        assert median == pytest.approx(np.median(local))
        front = same.fronts[variant]
        ends = rows.loc["theta, wrench-only [-]", title], front.theta[front.marks[WRENCH_ONLY]]
        assert ends[0] == ends[1]
    name, remarks = "mean RMSE of the moments [N m]", rows["", "remark"]
    assert rows.loc[name, "the paper"].tolist() == [1.69, 0.44]
    assert "not comparable: 50 samples, 1000" in remarks[name]
    assert "the number is not in this package" in remarks["RMSE of Fy [N]"]
    assert "left out of the objective" in remarks["RMSE of distal.Fy [N]"]

    words = ["--thetas", 11, "--frames", 50, "--leave-out", "distal.Fy"]
    words += ["--initial-stiffness", "auto", "-o", tmp_path / "paper.csv"]
    code, out, _ = call(capsys, "paper", hold, *words)
    assert code == 0 and len(pd.read_csv(tmp_path / "paper.csv")) == len(rows)
    assert all(f"{rows.loc[name, title]:.3f}" in out for title in TITLES)
