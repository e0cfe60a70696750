"""Words, flags and options of results: each is tested on either side, with the answer by hand."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from support import results_by_hand, scene

import socket_testbed as st
from socket_testbed import api
from socket_testbed.commands import pages, results, running
from socket_testbed.commands.calls import Fit
from socket_testbed.identification.channel_errors import ChannelErrors, evaluate
from socket_testbed.identification.data_finding import DataFinding
from socket_testbed.identification.differences import Conditions
from socket_testbed.results.comparing import values_table
from socket_testbed.results.comparison import Comparison
from socket_testbed.results.result import Result
from socket_testbed.trials.trial import Trial

# --- a model and its trial


def test_a_document_names_the_model_s_trial(scene_folder: Path, tmp_path: Path) -> None:
    found = st.evaluate(scene_folder, scene.model(tmp_path / "model.json", "another"), "all")
    document = found.document()
    assert document["trial"] == "scene"
    assert document["model"] == {"trial": "another", "variant": "stiffness_bias"}


@pytest.mark.parametrize(
    ("segment", "in_sample"),
    [("0:5", True), ("8:20", True), ("12:20", False), ("11.75:20", True)],
    ids=["inside", "partly", "after", "its last sample"],
)
def test_some_samples_of_the_fit_are_in_sample(
    segment: str, in_sample: bool, scene_folder: Path, tmp_path: Path
) -> None:
    """The model was fitted on the first 48 samples, until 11.75 s."""
    stored = st.read_model(scene.model(tmp_path / "model.json", "scene"))
    model = replace(stored, last_stamp=int(scene.STAMPS[47]))
    found = st.evaluate(scene_folder, model, segment)
    assert found.in_sample is found.document()["in_sample"] is in_sample
    assert results._evaluation_row(found)["in_sample"] == ("yes" if in_sample else "no")


@pytest.mark.parametrize(
    ("skills", "warned"),
    [((0.5, -0.1), True), ((0.5, 0.1), False), ((-1.0, -0.1), True)],
    ids=["one", "none", "all"],
)
def test_a_negative_skill_is_told(skills: tuple[float, ...], warned: bool) -> None:
    errors = [
        ChannelErrors(name, "N", 2.0, 1.5, 1.0, skill, 9, True)
        for name, skill in zip(("Fx", "Fz"), skills, strict=True)
    ]
    assert ("negative skill: the channel's mean" in results.errors_table(errors)) is warned


@pytest.mark.parametrize(
    ("determined", "warned"),
    [((True, True), False), ((True, False), True), ((False, True), True)],
    ids=["both", "stage 1 only", "stage 2 only"],
)
def test_a_solution_that_is_not_unique_is_told(
    determined: tuple[bool, bool], warned: bool, trial: Trial, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = trial.estimator.identification
    made = results_by_hand.fit_by_hand(trial.samples(), trial.geometry, settings)
    stages = (
        replace(stage, determined=known)
        for stage, known in zip((made.stage_one, made.stage_two), determined, strict=True)
    )
    judged = evaluate(trial.samples(), made.model)
    made = replace(made, stage_one=next(stages), stage_two=next(stages), errors=judged)
    found = api.TrialFit(trial, trial.select("all"), made)
    results._show_fit(found, Fit(Path("s01"), output=Path("model.json")))
    assert ("warning: the solution is not unique" in capsys.readouterr().out) is warned


# --- the data check and comparisons


def test_a_batch_tells_the_worst_finding() -> None:
    said: list[str] = []
    found = tuple(DataFinding(name, "is odd", "look at it") for name in ("worst", "mild"))
    trial: Any = SimpleNamespace(problems=lambda left: found, note=said.append)
    assert running.report_data(trial, good=False) == "check worst: is odd; look at it"
    assert said == [str(each) for each in found]


def compared(count: int, clear: int) -> Comparison:
    """Two trials with so many regions, of which the first ones differ."""
    rows: list[Any] = [
        {
            ("regions", f"r{n}", "shear [kPa]"): {**{"value": v, "low": v - 1.0, "high": v + 1.0}}
            for n in range(count)
            for v in [10.0 if second and n < clear else 1.0]
        }
        for second in (False, True)
    ]
    conditions = Conditions(("one", "two"), np.array([0, 1]))
    table = values_table(conditions, rows)
    return Comparison(conditions.grouped(conditions.names), "", (), table, None)


def test_chance_is_a_twentieth_of_all_intervals() -> None:
    assert compared(60, 2).differing()[0] == (
        "2 of 60 intervals of the regions' differences exclude 0; by chance alone up to about 3"
        " would"
    )


@pytest.mark.parametrize(
    ("texts", "line"),
    [(("gel", "gel"), "liner: gel"), (("gel", "sock"), "liner: one: gel; two: sock")],
    ids=["same", "different"],
)
def test_texts_that_differ_are_told_by_trial(
    texts: tuple[str, str],
    line: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = compared(1, 1)
    rows = pd.DataFrame(
        {"part": "metadata", "name": "liner", "item": ["one", "two"], "text": [*texts]}
    )
    found = replace(found, table=pd.concat([rows, found.table], ignore_index=True))
    index = pd.MultiIndex.from_tuples([("socket", "q [N]")], names=["name", "quantity"])
    monkeypatch.setattr(Comparison, "cells", lambda *_: pd.DataFrame({"one": "1"}, index))
    monkeypatch.setattr(pages, "_print", lambda *_: None)
    pages._show_comparison(found)
    assert line in capsys.readouterr().out.splitlines()


# --- figures and exports


@pytest.mark.parametrize("title", [True, False])
def test_a_drawn_result_has_the_asked_title(title: bool, tmp_path: Path) -> None:
    class Drawn(Result):
        def _figure(self, style: Any) -> Any:
            figure = style.figure(40.0)
            style.add_title(figure, "a title")
            made.append((figure.get_suptitle(), style.width))
            return figure

    made: list[tuple[str, float]] = []
    Drawn().draw(tmp_path / "a.png", 88, title)
    assert made == [("a title" if title else "", 88)]


def test_exported_cycles_are_those_of_the_segment(
    scene_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []

    def cycles(trial: Trial, table: pd.DataFrame, **given: Any) -> Any:
        asked.append((str(given["segment"]), given["by"], len(table)))
        return SimpleNamespace(to_dataframe=lambda: pd.DataFrame({"Fz mean [N]": [1.0]}))

    # The package's name `export` is that of the function.
    monkeypatch.setattr(sys.modules[st.export.__module__], "cycles_of", cycles)
    st.export(scene_folder, tmp_path / "a.csv", "12:14", cycles="step")
    assert asked == [("span 12.00 s to 14.00 s", "step", 9)]


def test_a_paper_like_trial_keeps_its_calibration(tmp_path: Path) -> None:
    """Without one it is the package's, whose ranges admit offsets as large as in the paper."""
    own = st.simulate(tmp_path / "usual", duration=1).path / "calibration.yaml"
    given = st.simulate(tmp_path / "given", duration=1, like_paper=True, calibration=own)
    usual = st.simulate(tmp_path / "paper", duration=1, like_paper=True)
    stored = [(trial.path / "calibration.yaml").read_text() for trial in (given, usual)]
    assert stored[0] == own.read_text() != stored[1]


def test_errors_of_a_calibration_are_told_apart() -> None:
    """Of the fit and of the readings held out: each column has its own numbers."""
    names = ["normal", "shear_x", "shear_y"]

    def errors(first: float) -> pd.DataFrame:
        titles = ("rmse", "mae", "r2", "percent")
        return pd.DataFrame({t: [first + k] * 3 for k, t in enumerate(titles)}, index=names)

    figures = pd.DataFrame({"hysteresis": 31.0, "repeatability": 32.0, "cross_talk": 33.0}, names)
    quality = SimpleNamespace(
        held_out=errors(10.0),
        training=errors(20.0),
        stress_range=np.array([[1.0, 2.0]] * 3),
        figures=figures,
    )
    found = api.CalibratedCluster("distal", quality, None, None, None, None)  # type: ignore[arg-type]
    assert found.to_dataframe().loc["shear_x"].to_dict() == {
        **{"from [Pa]": 1.0, "to [Pa]": 2.0},
        **{"held-out RMSE [Pa]": 10.0, "held-out RMSE [%]": 13.0, "held-out MAE [Pa]": 11.0},
        **{"held-out R2 [-]": 12.0, "training RMSE [Pa]": 20.0},
        **{"hysteresis [%]": 31.0, "repeatability [%]": 32.0, "cross-talk [%]": 33.0},
    }
