"""What a report computes, says and refuses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.bags import rewrite
from support.pages import MADE, NASTY, THETAS
from support.problems import make_samples
from support.wording import refused

from socket_testbed.errors import ConfigurationError
from socket_testbed.identification.fit import summarise_errors
from socket_testbed.identification.model_file import read_model
from socket_testbed.report import fronts, validation, write
from socket_testbed.report.quality import find_drop_outs, find_gaps
from socket_testbed.report.results import Results, compute_results
from socket_testbed.report.summary import list_notes, summarise
from socket_testbed.report.write import check_page_path, write_report
from socket_testbed.settings.identification import PAPER_VARIANTS
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial

PLAIN, BIAS = PAPER_VARIANTS


def results_of(path, *leave_out: str, segment: str = "plateau") -> Results:
    """The results of a trial with some channels left out."""
    settings = Trial(path).estimator
    chosen = dataclasses.replace(settings.identification, leave_out=leave_out)
    settings = dataclasses.replace(settings, identification=chosen)
    return compute_results(Trial(path), segment, settings, THETAS)


def test_the_summary_has_the_numbers_of_every_model_and_its_weakness(results, hold_model):
    fitted, given = results.candidates[-2:]  # with the same settings on the same segment
    np.testing.assert_array_equal(given.model.stiffness, read_model(hold_model).model.stiffness)
    np.testing.assert_allclose(given.predicted, fitted.predicted, rtol=1e-6, atol=1e-6)
    found = {line.partition(": ")[0]: line for line in summarise(results)}
    for candidate in results.candidates:
        in_sample, _, held_out = found[candidate.label].partition("; held-out ")
        for text, errors in ((in_sample, candidate.errors), (held_out, candidate.held_out)):
            quoted = summarise_errors(errors)
            assert f"moments {quoted.moment_rmse:.3g} N m" in text
            assert f"forces {quoted.force_rmse:.3g} N" in text
        assert "in-sample" in in_sample
    offset = np.linalg.norm(results.fitted[BIAS].model.wrench_bias[3:])
    assert f"which no tile bears, {offset:.3g} N" in found[BIAS]
    assert "no tile bears" not in found[PLAIN]
    notes = [note for note in list_notes(results) if "springs bear" in note]
    little = {c.label: c.shares[1].springs for c in results.candidates if c.shares[1].springs < 0.5}
    assert BIAS in little  # a hold
    for note, (label, share) in zip(notes, little.items(), strict=True):
        assert note.startswith(f"{label}: ") and f"only {100 * share:.0f} %" in note


@pytest.mark.usefixtures("few_variants")
def test_what_is_left_out_is_marked_and_a_dead_channel_then_costs_no_sample(
    spoilt, tmp_path, monkeypatch
):
    monkeypatch.setattr("socket_testbed.report.results.pareto_front", lambda *_, **__: {})

    def kill(topic: str, message):
        if topic == "/load_cell/wrench":
            message.wrench.torque.z = float("nan")
        return message

    channel = f"{NASTY}.Fx"
    results = results_of(rewrite(spoilt, tmp_path / "dead", kill), "Mz", channel)
    notes = list_notes(results)
    lost = int(np.isnan(results.samples.position[results.in_segment]).any(axis=1).sum())
    noted = [note.split()[0] for note in notes if "are in no fit" in note]
    assert noted == [str(lost)] * (lost > 0)
    assert "Never measured over the segment: Mz." in notes
    (note,) = [note for note in notes if "implausible" in note]
    assert "left out of the objective" in note
    assert "mean moment \N{EN DASH} N m" in summarise(results)[2]
    for candidate in results.candidates:
        assert candidate.held_out
        assert [e.name for e in candidate.errors if not e.in_objective] == ["Mz", channel]


@pytest.mark.usefixtures("few_variants")
def test_without_a_front_or_a_validation_the_rest_stands(hold, monkeypatch):
    monkeypatch.setattr("socket_testbed.identification.validation.MIN_SAMPLES", 500)
    results = results_of(hold, "Mx", "My", "Mz", "Fx", "Fy", "Fz", segment="all")
    assert fronts.section(results).parts[0].startswith("None: ")
    assert "two halves" in validation.section(results).parts[0]
    assert "held-out the" not in " ".join(summarise(results))


def test_a_page_that_cannot_be_written_is_refused_and_nothing_is_left(
    results, tmp_path, monkeypatch
):
    for name in ("page", "page.pdf"):
        with refused(ConfigurationError, name, ".html"):
            check_page_path(tmp_path / name)
    for taken in ("page.html", "page_files"):
        (tmp_path / taken).mkdir()
        with refused(ConfigurationError, f"{taken} exists already"):
            write_report(results, tmp_path / "page.html", "", MADE)
        (tmp_path / taken).rmdir()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(write, "SECTIONS", {"Data": (write.channels.errors_section,)})
    monkeypatch.setattr(write, "write_table", full)
    with refused(ConfigurationError, "No space left"):
        write_report(results, tmp_path / "page.html", "", MADE)
    assert not [*tmp_path.iterdir()]


def test_gaps_and_drop_outs_are_counted():
    time = np.array([0.0, 0.25, 0.5, 1.5, 1.75, 2.0, 5.0, 5.25, 5.6])
    assert find_gaps(time) == [(2.0, 3.0), (0.5, 1.0)]  # the longest first
    assert find_gaps(np.array([1.0])) == []
    rng = np.random.default_rng(8)
    position, force, wrench = (rng.normal(size=(200, n)) for n in (3, 3, 6))
    samples = make_samples(position, wrench, {"a": force})  # at 4 Hz
    samples.wrench[10:20, 2] = np.nan
    samples.position[190:] = np.nan
    for code, rows in ((1, slice(30, 33)), (2, slice(40, 44)), (3, slice(60, 65))):
        samples.status[rows, 0] = code
    lost = find_drop_outs(samples, Segment("span", 0.0, 4.0, slice(0, 17)))
    columns = ["missing [1]", "of them in the segment [1]", "missing [%]"]
    assert tuple(lost.loc["Mz", columns]) == pytest.approx((10, 7, 5.0))
    # From the last value to the next, or to the end.
    longest = lost.loc[["Mz", "limb position", "Mx"], "longest [s]"]
    assert longest.tolist() == pytest.approx([11 / 4.0, 10 / 4.0, 0.0])
    counts = ["missing [1]", "saturated [1]", "out of range [1]"]
    assert tuple(lost.loc["a (Fx, Fy, Fz)", counts]) == (4, 3, 5)
