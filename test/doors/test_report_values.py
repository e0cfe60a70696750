"""The results of a report are values: complete when they are made, and the same in a copy."""

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import results_by_hand, scene
from support.pages import MADE
from support.results_by_hand import tile
from support.surveys import prior_by_hand

import socket_testbed as st
from socket_testbed.figures.style import DEFAULT_STYLE
from socket_testbed.identification import information, validation
from socket_testbed.identification.checked import CheckedSamples
from socket_testbed.identification.fit import FittedModel
from socket_testbed.report import pressure
from socket_testbed.report.write import files_folder, write_report
from socket_testbed.results import models, report, tradeoff
from socket_testbed.results import pressure as trial_pressure
from socket_testbed.results.report import Results, compute_results
from socket_testbed.results.stresses import mean_stresses
from socket_testbed.samples import Status
from socket_testbed.trials.trial import Trial

COMPUTING = [
    *((scene.HandMap, name) for name in ("estimate", "mean", "sample")),
    *((information, name) for name in ("engagement", "load_shares", "measure_motion")),
    *((report, name) for name in ("pareto_front", "data_quality", "course_of")),
    (tradeoff, "beside_published"),
    (validation, "judge_samples"),
    *((models, name) for name in ("evaluate", "fit_contact_model")),
    *((Trial, name) for name in ("_read", "select", "plateaus", "problems", "checked")),
    (FittedModel, "predictions"),
    (CheckedSamples, "part"),
    (trial_pressure, "find_suspension"),
]


@pytest.fixture
def made(scene_folder: Path, by_hand: None) -> Results:
    """Results of the scene that nobody has looked at."""
    trial = Trial(scene_folder)
    with pytest.MonkeyPatch.context() as patch:
        results_by_hand.stand_in(patch)
        return compute_results(trial, "2:20", trial.estimator, [0.0, 0.4, 0.8, 1.0])


def written(results: Results, page: Path) -> dict[str, bytes]:
    """The files of a report."""
    write_report(results, page, "by hand", MADE)
    paths = [page, *files_folder(page).iterdir()]
    return {path.name: path.read_bytes() for path in paths}


def test_the_report_computes_nothing(
    made: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def computed(*given: Any, **named: Any) -> None:
        pytest.fail("computed while the page is written")

    for place, name in COMPUTING:
        monkeypatch.setattr(place, name, computed)
    assert {"scene.html", "errors.csv", "validation.csv"} <= {
        *written(made, tmp_path / "scene.html")
    }
    assert pressure._overview(made).draw(DEFAULT_STYLE).axes


def test_a_copy_makes_the_same_report(made: Results, tmp_path: Path) -> None:
    copied = pickle.loads(pickle.dumps(made))
    (tmp_path / "copy").mkdir()
    own, other = (
        written(each, tmp_path / name / "scene.html")
        for each, name in ((made, "."), (copied, "copy"))
    )
    assert own == other


def test_results_are_told_in_a_line(made: Results) -> None:
    expected = (
        "Results(scene, span 2.00 s to 20.00 s; models stiffness, stiffness_bias, rigid_bias)"
    )
    assert repr(made) == expected


def test_results_hold_those_of_the_api(made: Results) -> None:
    kinds = {"paper": st.PaperTable, "validation": st.Validation, "pressure": st.TrialPressure}
    for name, kind in kinds.items():
        found = getattr(made, name)
        assert isinstance(found, kind) and len(found.to_dataframe()), name
    assert made.paper.segment == made.segment
    assert made.validation is not None and made.validation.trials == ("scene",)


def test_the_validation_names_its_survey(made: Results, scene_folder: Path) -> None:
    trial, survey = Trial(scene_folder), prior_by_hand(scene.geometry())
    with pytest.MonkeyPatch.context() as patch:
        results_by_hand.stand_in(patch)
        found = compute_results(trial, "2:20", trial.estimator, [0.0, 1.0], prior=survey)
    assert made.validation is not None and made.validation.priors == ()
    assert found.validation is not None
    assert found.validation.priors == ("scene: made by hand",)


def test_a_lost_reading_has_no_part_in_the_mean(trial: Trial) -> None:
    """One cluster lost half of its readings, another one all."""
    outputs = st.pressure(trial, "all").outputs
    status, names = outputs.samples.status.copy(), [*outputs.samples.clusters]
    half, lost = names.index("mid_anterior"), names.index("distal")
    status[::2, half] = status[:, lost] = Status.MISSING
    samples = replace(outputs.samples, status=status)
    found = mean_stresses(replace(outputs, samples=samples), scene.geometry())
    area = scene.geometry().areas[tile("ant_mid")]
    expected = -samples.local_forces[1::2, half, 2].mean() / area
    (measured,) = found.measured
    order = [*scene.geometry().clusters]
    assert measured[order.index("mid_anterior")] == pytest.approx(expected)
    assert np.isnan(measured[order.index("distal")])
    assert np.isfinite(measured).sum() == len(order) - 1


def test_the_course_holds_the_trial_s_peak(made: Results) -> None:
    """60 kPa on `ant_mid` at 12 s, under 90 N along the socket."""
    course = made.course
    (row,) = np.flatnonzero(course.stresses.time == course.highest_time)
    assert (course.highest, course.highest_time) == (pytest.approx(60e3), 12.0)
    assert course.stresses.pressure[row, tile("ant_mid")] == pytest.approx(60e3)
    assert course.peak.value[row] == pytest.approx(60e3)
    assert course.force[row] == pytest.approx(90.0)
    assert made.pressure.peak.time == made.pressure.peak_time
