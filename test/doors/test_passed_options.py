"""Settings that a result passes on, and what is said of models, tiles, outliers and trials."""

import inspect
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import results_by_hand, scene
from support.pages import MADE
from support.verbs import call

import socket_testbed as st
from socket_testbed import api
from socket_testbed.calibration.fit import Outlier
from socket_testbed.commands import design, results, running
from socket_testbed.errors import TestbedError
from socket_testbed.identification import validation
from socket_testbed.identification.channel_errors import evaluate
from socket_testbed.identification.data_finding import DataFinding
from socket_testbed.report import quality, write
from socket_testbed.results import models
from socket_testbed.results.report import compute_results
from socket_testbed.settings.options import TrialFiles
from socket_testbed.trials.trial import Trial


@pytest.mark.parametrize("window", [0.0, 1.5])
def test_motion_and_shares_are_of_averaged_poses(
    window: float, trial: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = replace(trial.estimator.identification, pose_smoothing=window)
    made = results_by_hand.fit_by_hand(trial.samples(), trial.geometry, settings)
    found = api.TrialFit(trial, trial.select("all"), made)
    asked: dict[str, Any] = {}

    def motion(samples: Any, geometry: Any, over: float = 0.0) -> None:
        asked["motion"] = over

    def averaged(samples: Any, over: float) -> str:
        asked["averaged over"] = over
        return "averaged"

    monkeypatch.setattr(models.information, "measure_motion", motion)
    monkeypatch.setattr(models, "smooth_poses", averaged)
    monkeypatch.setattr(models.information, "load_shares", lambda samples, model: samples)
    found.motion()
    assert found.load_shares() == "averaged"
    assert asked == {"motion": window, "averaged over": window}


def test_an_evaluation_averages_over_the_asked_window(scene_folder: Path, tmp_path: Path) -> None:
    path = scene.model(tmp_path / "model.json")
    assert st.evaluate(scene_folder, path, "all").model.settings.pose_smoothing == 0.0
    found = st.evaluate(scene_folder, path, "all", pose_smoothing=1.5)
    assert found.model.settings.pose_smoothing == 1.5


def test_the_paper_s_pipeline_has_its_defaults() -> None:
    """1000 samples with equal weights, as published."""
    defaults = {n: p.default for n, p in inspect.signature(st.paper).parameters.items()}
    assert (defaults["frames"], defaults["weights"], defaults["segment"]) == (
        1000,
        "raw",
        "plateau",
    )


@pytest.mark.parametrize("theta", [0.2, 0.5])
def test_the_report_fits_with_the_asked_theta(
    theta: float, scene_folder: Path, by_hand: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: list[Any] = []

    def fit(samples: Any, geometry: Any, settings: Any) -> Any:
        used.append((settings.variant, settings.theta))
        return results_by_hand.fit_by_hand(samples, geometry, settings)

    results_by_hand.stand_in(monkeypatch)
    monkeypatch.setattr("socket_testbed.results.models.fit_contact_model", fit)
    trial = Trial(scene_folder)
    asked = replace(trial.estimator.identification, theta=theta)
    settings = replace(trial.estimator, identification=asked)
    compute_results(trial, "all", settings, [0.0, 1.0])
    variants = ("stiffness", "stiffness_bias", "rigid_bias")
    assert used == [(variant, theta) for variant in variants]


def test_the_summary_begins_with_the_worst_finding(report) -> None:
    found = tuple(DataFinding(name, "is odd", "look") for name in ("worst", "mild"))
    samples = report.results.samples
    worse, good = (SimpleNamespace(findings=each, samples=samples) for each in (found, ()))
    said = write.summarise(replace(report.results, checked=worse))
    assert said[1] == "; ".join(map(str, found))
    assert write.summarise(replace(report.results, checked=good))[1] == "data: good"


def test_a_bench_record_has_source_and_date(report, trial: Trial) -> None:
    clusters = dict(trial.calibration.clusters)
    record = {"source": "bench.csv", "date": "2026-02-01"}
    clusters["distal"] = replace(clusters["distal"], bench=record)
    clusters["mid_anterior"] = replace(clusters["mid_anterior"], bench={"forced": True})
    calibration = replace(trial.calibration, clusters=clusters)
    own = Trial(trial.path)
    own.__dict__["calibration"] = calibration
    rows = dict(quality.provenance(replace(report.results, trial=own), "by hand", MADE))
    assert rows["calibration of distal"] == "bench.csv, 2026-02-01"
    assert rows["calibration of mid_anterior"] == "see its bench record"
    assert "calibration of brim_lateral" not in rows


@pytest.mark.parametrize(("name", "noted"), [("scene", True), ("another", False)])
def test_an_evaluation_in_the_sample_is_told(
    name: str,
    noted: bool,
    scene_folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = st.evaluate(scene_folder, scene.model(tmp_path / "model.json", name), "all")
    results._show_evaluation(found, {})
    assert ("in-sample where the model was fitted" in capsys.readouterr().out) is noted


def test_the_highest_tiles_are_printed(trial: Trial, capsys: pytest.CaptureFixture[str]) -> None:
    """Eight of twelve, from 40 kPa down to 8 kPa."""
    results._show_map(st.force_map(trial, "all"))
    out = capsys.readouterr().out
    rows = [line.split() for line in out.splitlines() if line.split()[:1] and "_" in line]
    tiles = [row[0] for row in rows if row[0] in scene.TILES]
    order = ("ant_mid", "right_prox", "post_mid", "post_prox", "ant_prox", "ant_end", "post_end")
    assert tiles == [*order, "left_prox"]
    assert "the 8 highest" in out and "12 tiles" in out


@pytest.mark.parametrize(
    ("dropped", "fate"),
    [
        (True, "1 outliers, left out of the fit:"),
        (False, "1 outliers, kept in the fit, but not in"),
    ],
    ids=["dropped", "kept"],
)
def test_outliers_have_their_fate(dropped: bool, fate: str) -> None:
    outlier = Outlier(4, "bench.csv line 6", 1, -1234.0, 560.0)
    found: Any = SimpleNamespace(outliers=(outlier,), dropped=dropped)
    lines = design._outliers(found).splitlines()
    assert lines[0].startswith(fate)
    assert lines[-1].split() == ["bench.csv", "line", "6", "shear_x", "-1234", "560"]
    assert design._outliers(SimpleNamespace(outliers=())) == "no outliers"  # type: ignore[arg-type]


def test_notes_name_their_trial_once(
    scene_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (opened,) = running.open_all([scene_folder], TrialFiles())
    opened.note("is odd")
    opened.note("scene: no side is stated")
    assert capsys.readouterr().err.splitlines() == [
        "note: scene: is odd",
        "note: scene: no side is stated",
    ]


@pytest.fixture(scope="module")
def odd(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two trials of a load of 100 N, under which persons of 200 kg and 250 kg are said to stand."""
    path = tmp_path_factory.mktemp("odd")
    folders = [scene.write(path / name / "hold") for name in ("first", "second")]
    for folder, mass in zip(folders, (200.0, 250.0), strict=True):
        st.annotate(folder, mass=mass)
    return folders


@pytest.fixture
def unjudged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Validations judge nothing, which they refuse after the notes."""
    monkeypatch.setattr(validation, "judge_samples", lambda *_: [])


SEVERAL = {"compare": st.compare, "validate": st.validate, "survey": st.survey}


@pytest.mark.parametrize("verb", SEVERAL)
@pytest.mark.usefixtures("unjudged")
def test_notes_on_several_trials_name_each(verb: str, odd: list[Path]) -> None:
    """By as much of their paths as it takes."""
    with warnings.catch_warnings(record=True) as sent, suppress(TestbedError):
        warnings.simplefilter("always")
        SEVERAL[verb](*odd, segment="all")  # no cluster moved, so that a survey is refused
    notes = [str(each.message) for each in sent if "stated" in str(each.message)]
    assert [note.partition(": ")[0] for note in notes] == ["first/hold", "second/hold"]
    assert all(mass in note for mass, note in zip(("200 kg", "250 kg"), notes, strict=True))


@pytest.mark.parametrize("verb", SEVERAL)
@pytest.mark.usefixtures("unjudged")
def test_a_verb_s_notes_name_each_trial_once(
    verb: str, odd: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    _, _, err = call(capsys, verb, *odd, "--segment", "all")
    notes = [line for line in err.splitlines() if "stated" in line]
    assert [note.count("hold: ") for note in notes] == [1, 1]
    assert [note.partition("data: ")[0] for note in notes] == ["note: hold: "] * 2


@pytest.mark.parametrize("worst", ["stage_one", "stage_two", "joint"])
def test_a_row_has_the_largest_residual_and_gap(worst: str, trial: Trial) -> None:
    settings = trial.estimator.identification
    made = results_by_hand.fit_by_hand(trial.samples(), trial.geometry, settings)
    stage = getattr(made, worst)
    certificate = replace(stage.certificate, primal=9e-3, stationarity=7e-3, gap=8e-3)
    made = replace(made, **{worst: replace(stage, certificate=certificate)})
    made = replace(made, errors=evaluate(trial.samples(), made.model))
    found = api.TrialFit(trial, trial.select("0:1"), made)
    row = results._fit_row(found)
    assert (row["kkt_residual [-]"], row["duality_gap [-]"]) == (7e-3, 8e-3)
    assert np.isfinite(float(row["theta [-]"]))  # type: ignore[arg-type]
