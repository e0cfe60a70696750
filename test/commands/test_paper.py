"""`pareto` and `paper`: the front and the published pipeline, against fits by hand."""

import dataclasses

import numpy as np
import pandas as pd
import pytest
from support.verbs import call

import socket_testbed as st
from socket_testbed.api import tradeoff
from socket_testbed.identification.pareto import KNEE, SENSOR_ONLY, WRENCH_ONLY, Front
from socket_testbed.settings.identification import PAPER_VARIANTS

WITHOUT, WITH = ("this trial", "without offsets"), ("this trial", "with offsets")


def test_the_verb_prints_and_writes_both_fronts(hold, tmp_path, capsys):
    table, figure = tmp_path / "front.csv", tmp_path / "front.png"
    code, out, _ = call(capsys, "pareto", hold, "--thetas", 11, "-o", table, "--figure", figure)
    assert code == 0
    for text in (*PAPER_VARIANTS, SENSOR_ONLY, KNEE, WRENCH_ONLY, "[N m]", "of 11", "plateau"):
        assert text in out
    assert len(pd.read_csv(table)) == 2 * 11 and figure.read_bytes().startswith(b"\x89PNG")
    assert sorted(tmp_path.iterdir()) == [table, figure]


def test_flawed_solutions_are_named_with_their_thetas(hold, monkeypatch, capsys):
    solve = tradeoff.pareto_front

    def spoil(*args, **kwargs):
        flaws = ("not determined", "", "not certified", "not certified", "")
        fronts = solve(*args, **kwargs)
        for variant, front in fronts.items():
            points = zip(front.points, flaws, strict=True)
            spoilt = [dataclasses.replace(point, flaw=flaw) for point, flaw in points]
            fronts[variant] = Front(variant, front.channels, spoilt)
        return fronts

    monkeypatch.setattr(tradeoff, "pareto_front", spoil)
    lines = call(capsys, "pareto", hold, "--thetas", 5)[1].splitlines()
    rows = [line for line in lines if SENSOR_ONLY in line]
    assert len(rows) == 2 and all(row.endswith("-  not determined") for row in rows)
    assert sum("left out: 1 at theta 0: not determined" in line for line in lines) == 2
    assert sum("left out: 2 at theta 0.5 to 0.75: not certified" in line for line in lines) == 2


@pytest.fixture(scope="module")
def figures(hold):
    """The figures of the first 50 samples, and two plain fits on them, by their titles."""
    chosen = {"frames": 50, "leave_out": ["distal.Fy"], "initial_stiffness": "auto"}
    trial = st.open_trial(hold)
    fits = [st.fit(trial, variant=v, weights="raw", **chosen) for v in PAPER_VARIANTS]
    found = st.paper(trial, thetas=11, **chosen)
    return found, dict(zip((WITHOUT, WITH), fits, strict=True))


def test_the_figures_are_those_of_the_paper_s_variants_on_the_first_frames(hold, figures) -> None:
    found, fits = figures
    rows = found.to_dataframe()
    for title, fitted in fits.items():
        rmse = {error.name: error.rmse for error in fitted.fit.errors}
        assert fitted.fit.samples <= 50 and fitted.segment == found.segment
        for name, value in rmse.items():
            (row,) = (key for key in rows.index if key.startswith(f"RMSE of {name} ["))
            assert rows.loc[row, title] == pytest.approx(value)
        local = [v for name, v in rmse.items() if "." in name and name != "distal.Fy"]
        median = rows.loc["median RMSE of the clusters in the objective [N]", title]
        assert median == pytest.approx(np.median(local))
        forces = [rmse[name] for name in ("Fx", "Fy", "Fz")]
        assert rows.loc["mean RMSE of the forces [N]", title] == pytest.approx(np.mean(forces))
    k0 = {fitted.fit.settings.initial_stiffness for fitted in fits.values()}
    assert len(k0) == 1 and k0 != {0.0}
    chosen = {"leave_out": ["distal.Fy"], "weights": "raw", "initial_stiffness": "auto"}
    same = st.pareto(st.open_trial(hold), found.segment, thetas=11, **chosen)
    for title, front in zip((WITHOUT, WITH), same.fronts.values(), strict=True):
        for mark in ("sensor-only", "knee", "wrench-only"):
            index = front.marks.get(mark)
            expected = np.nan if index is None else front.theta[index]
            np.testing.assert_equal(rows.loc[f"theta, {mark} [-]", title], expected)


def test_a_printed_number_stands_with_the_reason_why_it_is_not_comparable(figures) -> None:
    rows = figures[0].to_dataframe()
    name, remarks = "mean RMSE of the moments [N m]", rows["", "remark"]
    assert rows.loc[name, "the paper"].tolist() == [1.69, 0.44]
    assert "not comparable: 50 samples, 1000" in remarks[name]
    assert "the number is not in this package" in remarks["RMSE of Fy [N]"]
    assert "left out of the objective" in remarks["RMSE of distal.Fy [N]"]


def test_the_command_prints_what_the_api_gives(hold, figures, capsys) -> None:
    rows = figures[0].to_dataframe()
    words = ["paper", hold, "--thetas", 11, "--frames", 50, "--leave-out", "distal.Fy"]
    words += ["--initial-stiffness", "auto"]
    code, out, _ = call(capsys, *words)
    shown = next(line for line in out.splitlines() if line.startswith("mean RMSE of the moments"))
    values = rows.loc["mean RMSE of the moments [N m]"]
    assert code == 0 and f"{values[WITHOUT]:.3f}" in shown
    assert f"{values[WITH]:.3f}" in shown and "1.690" in shown
