"""The page of a report as its readers open it: complete, and it says what the evaluation says."""

import io
import json
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from itertools import product
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest
from matplotlib.layout_engine import ConstrainedLayoutEngine
from support.pages import MADE, NASTY, Page

import socket_testbed as st
from socket_testbed.__main__ import run
from socket_testbed.identification.fit import evaluate, summarise_errors
from socket_testbed.identification.pressure import TITLES, interval_end
from socket_testbed.report import style
from socket_testbed.report.results import Results
from socket_testbed.report.write import files_folder, write_report
from socket_testbed.settings.identification import PAPER_VARIANTS
from socket_testbed.tables import UNCERTAIN

PLAIN, BIAS = PAPER_VARIANTS
MOST_BYTES = 5e6

pytestmark = pytest.mark.slow  # all figures are drawn and saved


@pytest.fixture(scope="module")
def page_path(results: Results, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("report") / "my report.html"
    with pytest.MonkeyPatch.context() as patch:
        # Layout, fonts and pixels take most of the time: the tests of the figures look at them.
        patch.setattr(ConstrainedLayoutEngine, "execute", lambda *_: None)
        patch.setitem(style._STYLE, "pdf.fonttype", 3)
        patch.setattr("socket_testbed.report.page.save_figure", partial(style.save_figure, dpi=50))
        write_report(results, path, "socket-testbed report <hold>", MADE, style=style.DEFAULT_STYLE)
    return path


@pytest.fixture(scope="module")
def page(page_path: Path) -> Page:
    found = Page(page_path.read_text(encoding="utf-8"))
    assert not found.open
    return found


def test_the_page_loads_nothing_shows_pictures_first_and_says_what_they_show(page, page_path):
    assert page.policy.startswith("default-src 'none'")
    assert "http" not in page.policy and "*" not in page.policy
    assert not {tag for tag, _ in page.tags} & {"link", "iframe", "object", "embed", "base"}
    assert not page.attributes("src") and "url(" not in page.said["style"][0]
    assert page_path.stat().st_size < MOST_BYTES

    ids = page.attributes("id")
    assert len(ids) == len(set(ids)) and ids.index("cards") < ids.index("map")
    pictures = [a for _, a in page.tags if a.get("role") == "img"]
    assert len(pictures) >= 7 and all(len(a["aria-label"]) > 20 for a in pictures)


def test_the_errors_on_page_and_in_file_are_those_of_the_evaluation(page, page_path, results):
    found = pd.read_csv(files_folder(page_path) / "errors.csv").groupby(["model", "samples of"])
    for table, part, rows_of in (
        ("errors", "segment", results.in_segment),
        ("held-out", "rest", ~results.in_segment),
    ):
        rows = page.rows(table)
        for column, candidate in enumerate(results.candidates):
            settings = candidate.source.settings
            errors = evaluate(results.samples[rows_of], candidate.model, settings.leave_out)
            for error in errors:
                unit, *cells = rows[error.name]
                shown = np.array(cells[4 * column : 4 * column + 4], dtype=float)
                expected = [error.rmse, error.mae, error.sigma, error.skill]
                assert unit == error.unit
                np.testing.assert_allclose(shown, expected, rtol=0.0, atol=5.001e-4)
            value = summarise_errors(errors).median_local_rmse
            title = "median local RMSE in the objective"
            assert float(rows[title][1 + 4 * column]) == pytest.approx(value, abs=5.001e-4)
            written = found.get_group((candidate.label, part)).set_index("channel")["RMSE"]
            assert [*written.index] == [error.name for error in errors]
            np.testing.assert_allclose(written, [error.rmse for error in errors], rtol=1e-9)


def printed(text: str):
    """The number that was printed so, within half of its last digit."""
    return pytest.approx(float(text), abs=0.501 * 10.0 ** -len(text.partition(".")[2]))


def test_the_pressure_on_the_page_is_that_of_the_api(page, page_path, results):
    found = st.pressure(results.trial).regions
    ends = ("low", "high")
    names = {title: [title, *(interval_end(title, end) for end in ends)] for title in TITLES}
    for table in ("pressure-regions", "pressure-shear"):
        header, *rows = page.tables[table]
        assert [row[0] for row in rows] == list(found.index)
        for number, title in enumerate(header[1:], start=1):
            of_title = found[names[title.replace("²", "^2")]].to_numpy()
            for row, expected in zip(rows, of_title, strict=True):
                value, interval = row[number].split("\n")
                ends = interval.removesuffix(UNCERTAIN).split(" to ")
                assert [printed(text) for text in (value, *ends)] == expected.tolist()
    written = pd.read_csv(files_folder(page_path) / "pressure.csv", index_col="region")
    of_all = [name for of_title in names.values() for name in of_title]
    np.testing.assert_allclose(written[of_all], found[of_all], rtol=1e-9)


def test_every_figure_is_there_as_pdf_and_png_with_its_data(page, page_path):
    folder = files_folder(page_path)
    figures = {path.stem for path in folder.glob("*.pdf")}
    assert folder.name == "my report_files" and len(figures) >= 10
    linked = {unquote(link) for link in page.attributes("href") if not link.startswith("#")}
    expected = product(figures, ("pdf", "png", "csv"))
    assert linked == {f"{folder.name}/{name}.{kind}" for name, kind in expected}
    assert linked <= {f"{folder.name}/{path.name}" for path in folder.iterdir()}


def test_the_files_hold_series_and_parameters_as_they_are(page_path, results):
    samples, measured = results.samples, results.samples.trusted_values
    files = {path.stem: pd.read_csv(path) for path in files_folder(page_path).glob("*.csv")}
    errors = results.candidates[0].errors
    for i, (name, error) in enumerate(zip(samples.channels, errors, strict=True)):
        found = files["wrench" if i < 6 else "local_forces"]
        expected = {f"measured [{error.unit}]": measured[:, i]} | {
            f"predicted {c.label} [{error.unit}]": c.predicted[:, i] for c in results.candidates
        }
        for column, values in expected.items():
            np.testing.assert_allclose(found[f"{name} {column}"], values, rtol=1e-9)
    for name in ("wrench", "local_forces", "overview", "engaged_springs"):
        assert files[name]["stamp [ns]"].tolist() == samples.stamps.tolist()
        np.testing.assert_allclose(files[name]["time [s]"], samples.time)
        assert (files[name]["in segment"] == 1).tolist() == results.in_segment.tolist()
    pose = samples.pose[results.in_segment]
    mean = np.nanmean(samples.position[results.in_segment], axis=0)
    for candidate in results.candidates:
        model, label = candidate.model, candidate.label
        found = files[f"tile_stiffness_{label}"]
        assert found["tile"].tolist() == list(results.trial.geometry.names)
        axes = found[[f"stiffness {axis} [N/m]" for axis in "xyz"]]
        np.testing.assert_allclose(axes, model.stiffness, rtol=1e-9)
        shares = files["engaged_tiles"].filter(like=f"{label}.")
        displacement, _ = model.gate_displacements(pose, np.eye(6))
        np.testing.assert_allclose(shares, (displacement < 0.0).mean(axis=0), rtol=1e-9)
        if label in PAPER_VARIANTS:
            rest = files["rest_positions"].filter(like="from the mean limb position")
            expected = 1e3 * (model.rest_positions - mean)
            np.testing.assert_allclose(rest, expected, rtol=1e-6, atol=1e-9)
        if label != PLAIN:
            biases = map(model.force_bias.get, samples.clusters)
            assert files["offsets"]["channel"].tolist() == list(samples.channels)
            shown = files["offsets"][f"offset {label} [unit of the row]"]
            np.testing.assert_allclose(shown, [*model.wrench_bias, *np.ravel([*biases])], rtol=1e-9)


def test_the_cards_and_the_map_say_what_the_tables_say(page, results):
    shown = json.loads(page.script("page-data"))
    regions = page.rows("pressure-regions")
    for card, region in zip(shown["cards"], ("socket", "unmeasured wall"), strict=False):
        value, interval = regions[region][0].split("\n")
        assert card["value"] == f"{value} kPa"
        assert card["interval"] == interval.removesuffix(UNCERTAIN)
    (peak,) = [m for m in shown["moments"] if abs(m["time"] - shown["start"]) < 2e-3]
    assert f"{max(peak['pressure']):.1f} kPa" == shown["cards"][0]["value"]
    for name, values in shown["extras"].items():
        label, _, title = name.partition(": ")
        if title.startswith("stiffness along z"):
            (model,) = (c.model for c in results.candidates if c.label == label)
            np.testing.assert_allclose(values["values"], model.stiffness[:, 2], atol=5.1e-3)


def test_a_spoilt_trial_is_told_and_its_names_are_no_markup(spoilt, tmp_path):
    path, out, err = tmp_path / "page.html", io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        words = ["report", str(spoilt), "-o", str(path), "--thetas", "3"]
        assert run([*words, "--leave-out", f"{NASTY}.Fy"]) == 0
    assert (
        f"note: data: look at {NASTY}: {NASTY}.Fx: the " in err.getvalue()
        and str(path) in out.getvalue()
    )
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert page.said["h1"] == [NASTY] and page.said["b"] == ["left", NASTY]
    assert NASTY not in text
    assert f"data: look at {NASTY}: {NASTY}.Fx: the " in page.text
    assert "not in objective" not in page.rows("errors")[f"{NASTY}.Fx"]
    assert "not in objective" in page.rows("errors")[f"{NASTY}.Fy"]
    assert "gaps longer than 1.5 periods: 1, the longest 2.250 s" in page.text
    rows = page.rows("drop-outs")
    assert int(rows[NASTY][0]) > 10 and int(rows["Mx"][0]) == 0
