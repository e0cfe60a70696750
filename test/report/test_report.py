"""What a report computes, says and refuses; the page of a socket."""

import dataclasses
import json
from unittest.mock import Mock

import numpy as np
import pytest
import trimesh
from support.pages import MADE, NASTY, THETAS, Page
from support.problems import make_samples, ring_socket
from support.tabs import Tab, small_viewer
from support.wording import refused

import socket_testbed as st
from socket_testbed.arrays import within
from socket_testbed.errors import ConfigurationError
from socket_testbed.identification.fit import summarise_errors
from socket_testbed.identification.model_file import read_model
from socket_testbed.pages.wall import unrolled_tiles
from socket_testbed.report import fronts, validation, write
from socket_testbed.report.page import Pictures, Section, write_page, write_socket_page
from socket_testbed.report.pressure import page_data
from socket_testbed.report.quality import list_notes
from socket_testbed.report.results import Results, compute_results
from socket_testbed.report.write import check_page_path, summarise, write_report
from socket_testbed.settings.identification import PAPER_VARIANTS
from socket_testbed.trials.description import describe_samples, drop_outs
from socket_testbed.trials.trial import Trial

PLAIN, BIAS = PAPER_VARIANTS


def results_of(trial: Trial, *leave_out: str, segment="plateau", frames=0) -> Results:
    """The results of a trial with some channels left out, fitted on the first frames."""
    settings = trial.estimator
    chosen = dataclasses.replace(settings.identification, leave_out=leave_out, frames=frames)
    settings = dataclasses.replace(settings, identification=chosen)
    return compute_results(trial, segment, settings, THETAS)


def test_the_summary_has_the_numbers_of_every_model_and_its_weakness(results, hold_model):
    fitted, given = results.candidates[-2:]  # with the same settings on the same segment
    np.testing.assert_array_equal(given.model.stiffness, read_model(hold_model).model.stiffness)
    np.testing.assert_allclose(given.predicted, fitted.predicted, rtol=1e-6, atol=1e-6)
    found = {line.partition(": ")[0]: line for line in summarise(results)}
    for candidate in results.candidates:
        in_sample, _, held_out = found[candidate.label].partition("; held-out: ")
        for text, errors in ((in_sample, candidate.errors), (held_out, candidate.held_out)):
            assert f"mean moment RMSE {summarise_errors(errors).mean_moment_rmse:.3g} N m" in text
    share = results.fitted[BIAS].shares[1].springs  # in a hold the offsets bear the load
    only = f"only {100 * share:.0f} %"
    assert any(n.startswith(BIAS) and only in n for n in list_notes(results))


@pytest.mark.usefixtures("few_variants")
def test_what_is_left_out_is_marked_and_costs_no_sample(spoilt, monkeypatch):
    monkeypatch.setattr("socket_testbed.report.results.pareto_front", lambda *_, **__: {})
    channel, trial = f"{NASTY}.Fx", Trial(spoilt)
    trial.samples().wrench[:, 2] = np.nan
    results = results_of(trial, "Mz", channel, frames=60)
    pressure = st.pressure(trial, leave_out=("Mz", channel))  # of the whole segment
    assert len(results.samples[results.segment.rows]) == 60 < len(pressure.time)
    integrals = (found.outputs.regions.integral.value for found in (results.pressure, pressure))
    np.testing.assert_array_equal(*integrals)
    notes = [*list_notes(results)]
    assert "Never measured over the segment: Mz." in notes
    assert not any(channel in str(finding) for finding in results.data)
    for candidate in results.candidates:
        assert candidate.held_out
        assert [e.name for e in candidate.errors if not e.in_objective] == ["Mz", channel]


@pytest.mark.usefixtures("few_variants")
def test_a_given_model_is_judged_on_what_its_fit_has_not_used(hold, hold_model, monkeypatch):
    monkeypatch.setattr("socket_testbed.report.results.pareto_front", lambda *_, **__: {})
    trial, model = Trial(hold), read_model(hold_model)  # of the plateau
    outside = ~within(trial.samples().time, 20.0, 40.0)
    own = Trial(hold).fingerprint
    for fingerprint, words in ((own, "in-sample"), ("of another trial", "over the segment")):
        given = dataclasses.replace(model, fingerprint=fingerprint)
        found = compute_results(trial, "20:40", trial.estimator, THETAS, given)
        assert any(line.startswith(f"given: {words}: ") for line in summarise(found))
        rest = outside & ~given.used("hold", own, trial.samples())
        assert max(e.samples for e in found.candidates[-1].held_out) == rest.sum()


@pytest.mark.usefixtures("few_variants")
def test_without_a_front_or_a_validation_the_rest_stands(hold, monkeypatch):
    monkeypatch.setattr("socket_testbed.identification.validation.MIN_SAMPLES", 500)
    results = results_of(Trial(hold), "Mx", "My", "Mz", "Fx", "Fy", "Fz", segment="all")
    assert fronts.section(results).parts[0].startswith("None: ")
    assert "two halves" in validation.section(results).parts[0]
    assert "held-out the" not in " ".join(summarise(results))


def test_a_page_that_cannot_be_written_leaves_nothing(results, tmp_path, monkeypatch):
    with refused(ConfigurationError, "page.pdf", ".html"):
        check_page_path(tmp_path / "page.pdf")
    for taken in ("page.html", "page_files"):
        (tmp_path / taken).mkdir()
        with refused(ConfigurationError, f"{taken} exists already"):
            write_report(results, tmp_path / "page.html", "", MADE)
        (tmp_path / taken).rmdir()

    full = Mock(side_effect=OSError(28, "No space left on device"))
    monkeypatch.setattr(write, "SECTIONS", {"Data": (write.models.errors_section,)})
    monkeypatch.setattr(write, "write_table", full)
    with refused(ConfigurationError, "No space left"):
        write_report(results, tmp_path / "page.html", "", MADE)
    assert not [*tmp_path.iterdir()]


def test_page_shows_peak_mean_and_models(results):
    with small_viewer() as folder:
        section = Section("socket", "", [Pictures("The socket")])
        write_page(folder / "page.html", "", "", {"": [section]}, page_data(results))
        tab = Tab((folder / "page.html").read_text(encoding="utf-8"))
    found = results.pressure
    peak = 1e-3 * found.outputs.peak_map.normal_pressure.max()
    mean = 1e-3 * found.outputs.tiles.mean.value.max()
    assert tab.text("#when") == f"at {found.peak_time:.2f} s"
    assert tab.texts("strong")[0] == f"{peak:.1f} kPa"
    assert f"<b>peak {peak:.1f}</b>" in tab.picture("#map").notes
    tab.click('button[data-moment="mean"]')
    assert tab.text("#when") == f"mean over {found.segment}"
    assert f"<b>peak {mean:.1f}</b>" in tab.picture("#map").notes
    first = found.regions["mean pressure [kPa]"].iloc[0]
    assert tab.texts(".said")[0].startswith(f"{first:.1f} (")
    model = next(name for name in tab.options("#kind") if "stiffness along" in name)
    tab.choose("#kind", model)
    assert tab.picture("#map").heatmap().trace["colorbar"]["title"]["text"] == "N/m"


def test_gaps_and_drop_outs_are_counted(rng):
    position, force, wrench = (rng.normal(size=(200, n)) for n in (3, 3, 6))
    samples = make_samples(position, wrench, {"a": force})  # at 4 Hz

    def said(*parts):
        time = np.concatenate(parts)
        stamps = np.int64(1e9) * 10**9 + np.round(1e9 * time).astype(np.int64)
        return describe_samples(dataclasses.replace(samples[: len(time)], stamps=stamps))

    found = said([0.0, 0.25, 0.5, 1.5, 1.75, 2.0, 5.0, 5.25, 5.6])
    assert "periods: 2" in found and found.endswith(
        "longest 3.000 s from 2.00 s, 1.000 s from 0.50 s"
    )
    assert said(np.arange(0.0, 40.0, 0.25), [79.75]).endswith(
        "periods: 1, the longest 40.000 s from 39.75 s"
    )
    assert "periods: 0" in said(
        np.arange(0.0, 5.0, 0.05), np.arange(5.0, 30.0, 0.25)
    )  # another rate
    samples.wrench[10:20, 2] = np.nan
    samples.position[190:] = np.nan
    for code, rows in ((1, slice(30, 33)), (2, slice(40, 44)), (3, slice(60, 65))):
        samples.status[rows, 0] = code
    lost = drop_outs(samples, slice(0, 17)).frame
    columns = ["missing [1]", "of them in the segment [1]", "missing [%]"]
    assert tuple(lost.loc["Mz", columns]) == pytest.approx((10, 7, 5.0))
    # From the last value to the next, or to the end.
    longest = lost.loc[["Mz", "limb position", "Mx"], "longest [s]"]
    assert longest.tolist() == pytest.approx([11 / 4.0, 10 / 4.0, 0.0])
    lost_of_a = lost.loc["a", ["missing [1]", "saturated [1]", "out of range [1]"]]
    assert tuple(lost_of_a) == (4, 3, 5)


def test_a_page_shows_tiles_and_surface_loads_nothing_and_its_names_are_no_markup(tmp_path) -> None:
    geometry, nasty = ring_socket(), f"</script>{NASTY}"
    path, facts = tmp_path / "socket.html", [(nasty, "1 < 2"), ("tiles", nasty)]
    alone = dataclasses.replace(
        geometry,
        names=(nasty, *geometry.names[1:]),
        clusters={nasty: 0},
        neighbours=np.zeros((0, 2), dtype=np.int64),
    )
    mesh = trimesh.creation.icosphere(3, radius=0.05)
    write_socket_page(mesh, alone, path, nasty, facts)
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert not page.attributes("src", "href", "srcset", "data") and nasty not in text
    assert page.said["title"] == page.said["h1"] == [nasty]
    shown = json.loads(page.script("page-data"))
    assert nasty in shown["socket"]["clusters"]
    squares = np.array(shown["socket"]["squares"])[:, :4]
    np.testing.assert_allclose(squares, 1e3 * unrolled_tiles(alone).squares, atol=0.051)
    points = np.array(shown["socket"]["surface"]["points"])
    np.testing.assert_allclose(points, 1e3 * mesh.vertices, atol=0.051)
    np.testing.assert_allclose(shown["extras"]["area [mm^2]"]["values"], 1e6 * geometry.areas)
