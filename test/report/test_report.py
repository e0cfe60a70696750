"""What a report says of a trial, and what it refuses."""

from __future__ import annotations

import dataclasses
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.bags import rewrite
from support.pages import MADE, NASTY, THETAS

from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.identification.evaluation import summarise_errors
from socket_testbed.identification.model_file import read_model
from socket_testbed.identification.validation import CONSTANT, FORCE_MAP, REGRESSION
from socket_testbed.report.results import compute_results
from socket_testbed.report.sections import page_content, provenance
from socket_testbed.report.summary import list_notes, summarise
from socket_testbed.report.write import check_page_path, write_report
from socket_testbed.settings.identification import PAPER_VARIANTS
from socket_testbed.trials.trial import Trial

PLAIN, BIAS = PAPER_VARIANTS


def settings_of(path: Path):
    return Trial(path).estimator


def test_the_given_model_is_the_one_that_was_given(results, hold_model):
    given = results.candidates[-1]
    stored = read_model(hold_model)
    np.testing.assert_array_equal(given.model.stiffness, stored.model.stiffness)
    fitted = results.candidates[-2]  # with the same settings on the same segment
    np.testing.assert_allclose(given.predicted, fitted.predicted, rtol=1e-6, atol=1e-6)


def test_the_digests_are_those_of_the_files(results, hold, tmp_path):
    before = dict(provenance(results, "", MADE))
    copy = Path(shutil.copytree(hold, tmp_path / "copy"))
    (copy / "socket.yaml").write_text((copy / "socket.yaml").read_text() + "# more\n")
    changed = dataclasses.replace(results, trial=Trial(copy))
    after = dict(provenance(changed, "", MADE))
    assert before["geometry"] != after["geometry"]
    assert before["calibration"] == after["calibration"]


def test_the_paper_s_story_shows_on_a_hold(results):
    plain, bias = (summarise_errors(results.fitted[v].errors) for v in PAPER_VARIANTS)
    # Without bias steady offsets and a knee; with bias neither.
    assert plain.local_unsteadiness < 0.5
    assert bias.local_unsteadiness == pytest.approx(1.0, abs=1e-3)
    assert bias.moment_rmse <= plain.moment_rmse and bias.force_rmse < 0.2 * plain.force_rmse
    assert bias.local_rmse < 0.3 * plain.local_rmse
    spans = [np.hypot(*results.fronts[v].knee.span) for v in PAPER_VARIANTS]
    assert results.fronts[PLAIN].knee.index is not None and spans[1] < 1e-2 * spans[0]
    said = " ".join(summarise(results))
    assert (
        "steady offsets" in said
        and "times smaller" in said
        and "hardly more of most channels" in said
    )
    assert 3 <= len(summarise(results)) <= 7


def test_what_was_not_seen_is_judged_beside_rivals(results):
    content = page_content(results, "", MADE)
    found = {(j.question, j.test, j.predictor): j for j in results.validation if not j.cluster}
    forces = content["tables"]["validation-forces"].frame["a cluster left out"]
    chosen = found["cluster", "left out", FORCE_MAP]
    assert forces.loc[FORCE_MAP].tolist() == [chosen.error, *(100.0 * np.array(chosen.coverage))]
    wrench = content["tables"]["validation-wrench"].frame["the other half"]
    chosen = found["wrench", "second half", REGRESSION]
    assert wrench.loc[REGRESSION].tolist()[:2] == [chosen.moment_rmse, chosen.force_rmse]
    assert {CONSTANT, REGRESSION, *PAPER_VARIANTS} <= set(wrench.index)


def test_a_trial_that_is_too_short_says_so_and_the_rest_stands(hold, monkeypatch):
    monkeypatch.setattr("socket_testbed.report.results.pareto_front", lambda *_, **__: {})
    monkeypatch.setattr("socket_testbed.identification.validation.LEAST_SAMPLES", 500)
    results = compute_results(Trial(hold), "plateau", settings_of(hold), THETAS)
    assert results.validation == () and "two halves" in results.no_validation
    tables = page_content(results, "", MADE)["tables"]
    assert "validation-forces" not in tables and "shares" in tables


def test_springs_that_bear_little_are_noted(results):
    springs = results.fitted[BIAS].shares[1].springs
    assert springs < 0.5  # a hold
    notes = [note for note in list_notes(results) if "springs bear" in note]
    little = {c.label: c.shares[1].springs for c in results.candidates if c.shares[1].springs < 0.5}
    assert little[BIAS] == springs
    for note, (label, share) in zip(notes, little.items(), strict=True):
        assert note.startswith(f"{label}: ") and f"only {100 * share:.0f} %" in note


def test_the_summary_says_what_the_constants_bear(results):
    offset = np.linalg.norm(results.fitted[BIAS].model.wrench_bias[3:])
    assert f"constant of the wrench's force is {offset:.3g} N" in " ".join(summarise(results))


def test_a_dead_channel_that_was_left_out_costs_no_sample(hold, tmp_path, monkeypatch):
    def spoil(topic: str, message):
        if topic == "/load_cell/wrench":
            message.wrench.torque.z = float("nan")
        return message

    monkeypatch.setattr("socket_testbed.report.results.pareto_front", lambda *_, **__: {})
    settings = settings_of(hold)
    left_out = dataclasses.replace(settings.identification, leave_out=("Mz",))
    results = compute_results(
        Trial(rewrite(hold, tmp_path / "dead", spoil)),
        "plateau",
        dataclasses.replace(settings, identification=left_out),
        THETAS,
    )
    lost = np.isnan(results.samples.position[results.in_segment]).any(axis=1).sum()
    told = re.findall(r"(\d+) of the segment's", " ".join(list_notes(results)))
    assert told == ([str(lost)] if lost else [])
    assert "Never measured over the segment: Mz." in list_notes(results)
    said = " ".join(summarise(results))
    assert "mean force of" in said and "mean moment of" not in said
    assert all(candidate.held_out for candidate in results.candidates)


def test_what_is_left_out_is_marked_and_its_note_stays(spoilt, monkeypatch):
    monkeypatch.setattr("socket_testbed.report.results.pareto_front", lambda *_, **__: {})
    settings = settings_of(spoilt)
    left_out = dataclasses.replace(settings.identification, leave_out=(f"{NASTY}.Fx",))
    results = compute_results(
        Trial(spoilt),
        "plateau",
        dataclasses.replace(settings, identification=left_out),
        [0.0, 1.0],
    )
    (note,) = [note for note in list_notes(results) if "implausible" in note]
    assert "left out of the objective" in note
    for candidate in results.candidates:
        states = {error.name: error.in_objective for error in candidate.errors}
        assert [name for name, counts in states.items() if not counts] == [f"{NASTY}.Fx"]


def test_without_a_front_the_rest_stands(hold):
    settings = settings_of(hold)
    wrench = ("Mx", "My", "Mz", "Fx", "Fy", "Fz")
    no_wrench = dataclasses.replace(settings.identification, leave_out=wrench)
    results = compute_results(
        Trial(hold),
        "all",
        dataclasses.replace(settings, identification=no_wrench),
        THETAS,
    )
    assert results.fronts == {} and "wrench" in results.no_fronts
    assert all(candidate.held_out == () for candidate in results.candidates)
    assert len(summarise(results)) >= 3


@pytest.mark.parametrize("name", ["page", "page.pdf", "page.html.gz"])
def test_a_page_is_an_html_file(tmp_path, name):
    with pytest.raises(ConfigurationError, match=r"page.*\.html"):
        check_page_path(tmp_path / name)


@pytest.mark.parametrize("taken", ["page.html", "page_files"])
def test_nothing_is_written_over(results, tmp_path, taken):
    (tmp_path / taken).mkdir()
    with pytest.raises(ConfigurationError, match=f"{taken} exists already"):
        write_report(results, tmp_path / "page.html", "", MADE)
    assert [path.name for path in tmp_path.iterdir()] == [taken]


def test_a_bad_folder_is_named_before_and_nothing_is_left(results, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigurationError, match="cannot be written"):
        write_report(results, tmp_path / "file" / "page.html", "", MADE)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


class HalfAFigure:
    """A figure that leaves a file."""

    def write(self, folder, *_):
        (folder / "figure.png").write_text("half a figure")


def test_what_fails_in_the_middle_leaves_nothing(results, tmp_path, monkeypatch):
    def full(_, path):
        assert [p.name for p in path.parent.iterdir()] == ["figure.png"]
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("socket_testbed.report.write.write_table", full)
    monkeypatch.setattr("socket_testbed.report.write.draw_figures", lambda _: {"": [HalfAFigure()]})
    with pytest.raises(ConfigurationError, match="No space left"):
        write_report(results, tmp_path / "page.html", "", MADE)
    assert list(tmp_path.iterdir()) == []


def test_a_model_of_another_socket_is_refused(results, hold, hold_model):
    stored = read_model(hold_model)
    moved = dataclasses.replace(stored.geometry, anchors=stored.geometry.anchors + 0.01)
    with pytest.raises(TestbedError, match="another socket"):
        compute_results(
            Trial(hold),
            "plateau",
            settings_of(hold),
            THETAS,
            dataclasses.replace(stored, geometry=moved),
        )
