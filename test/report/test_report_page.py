"""The page of a report as its readers open it: complete, and it says what the evaluation says."""

import io
import json
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest
from matplotlib.layout_engine import ConstrainedLayoutEngine
from support.pages import LABELS, MADE, NASTY, Page

import socket_testbed as st
from socket_testbed.__main__ import run
from socket_testbed.figures import style
from socket_testbed.identification.channel_errors import evaluate, summarise_errors
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.pressure import TITLES, interval_end
from socket_testbed.report.write import files_folder, write_report
from socket_testbed.results.report import Results
from socket_testbed.settings.identification import PAPER_VARIANTS
from socket_testbed.tables import UNCERTAIN

PLAIN, BIAS = PAPER_VARIANTS
MOST_BYTES = 5e6

pytestmark = pytest.mark.slow  # all figures are drawn and saved


@pytest.fixture(scope="module")
def drawn() -> list[tuple[int, int]]:
    """Numbers of figures drawn, and their total, as they were reported."""
    return []


@pytest.fixture(scope="module")
def page_path(results: Results, drawn: list[tuple[int, int]], tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("report") / "my report.html"
    with pytest.MonkeyPatch.context() as patch:
        # Layout, fonts and pixels take most of the time: the tests of the figures look at them.
        patch.setattr(ConstrainedLayoutEngine, "execute", lambda *_: None)
        patch.setitem(style._STYLE, "pdf.fonttype", 3)
        patch.setattr("socket_testbed.report.page.save_figure", partial(style.save_figure, dpi=50))
        command = "socket-testbed report <hold>"
        told = lambda *numbers: drawn.append(numbers)  # noqa: E731
        write_report(results, path, command, MADE, told, style=style.DEFAULT_STYLE)
    return path


@pytest.fixture(scope="module")
def page(page_path: Path) -> Page:
    found = Page(page_path.read_text(encoding="utf-8"))
    assert not found.open
    return found


def test_progress_counts_the_figures_drawn(page_path: Path, drawn: list[tuple[int, int]]):
    number = len([*files_folder(page_path).glob("*.pdf")])
    assert drawn == [(done, number) for done in range(1, number + 1)] and number >= 7


def test_the_page_loads_nothing(page):
    assert page.policy.startswith("default-src 'none'")
    assert "http" not in page.policy and "*" not in page.policy
    assert not {tag for tag, _ in page.tags} & {"link", "iframe", "object", "embed", "base"}
    assert not page.attributes("src") and "url(" not in page.said["style"][0]


def test_the_page_is_small(page_path):
    assert page_path.stat().st_size < MOST_BYTES


def test_the_page_begins_with_cards(page):
    ids = page.attributes("id")
    assert len(ids) == len(set(ids)) and ids.index("cards") < ids.index("map")


def test_pictures_are_described(page):
    """For those who do not see them."""
    pictures = [a for _, a in page.tags if a.get("role") == "img"]
    assert len(pictures) >= 7 and all(len(a["aria-label"]) > 20 for a in pictures)


PARTS = {"errors": "segment", "held-out": "rest"}


@pytest.mark.parametrize("label", LABELS)
@pytest.mark.parametrize("table", PARTS)
def test_errors_are_those_of_the_evaluation(table, label, page, page_path, results):
    """On the page and in its file."""
    column, rows, part = LABELS.index(label), page.rows(table), PARTS[table]
    rows_of = results.in_segment if part == "segment" else ~results.in_segment
    fitted = results.candidates[label].model
    errors = evaluate(results.samples[rows_of], fitted.model, fitted.settings.leave_out)
    for error in errors:
        unit, *cells = rows[error.name]
        shown = np.array(cells[4 * column : 4 * column + 4], dtype=float)
        expected = [error.rmse, error.mae, error.sigma, error.skill]
        assert unit == error.unit
        np.testing.assert_allclose(shown, expected, rtol=0.0, atol=5.001e-4)
    value = summarise_errors(errors).median_local_rmse
    title = "median local RMSE in the objective"
    assert float(rows[title][1 + 4 * column]) == pytest.approx(value, abs=5.001e-4)
    file = pd.read_csv(files_folder(page_path) / "errors.csv").groupby(["model", "samples of"])
    written = file.get_group((label, part)).set_index("channel")["RMSE"]
    assert [*written.index] == [error.name for error in errors]
    np.testing.assert_allclose(written, [error.rmse for error in errors], rtol=1e-9)


def printed(text: str):
    """The number that was printed so, within half of its last digit."""
    return pytest.approx(float(text), abs=0.501 * 10.0 ** -len(text.partition(".")[2]))


NAMES = {title: [title, *(interval_end(title, end) for end in ("low", "high"))] for title in TITLES}


@pytest.fixture(scope="module")
def regions(results: Results) -> pd.DataFrame:
    """The pressure of the regions, as the API gives it."""
    return st.pressure(results.trial).regions


@pytest.mark.parametrize("table", ["pressure-regions", "pressure-shear"])
def test_pressure_on_the_page_is_the_api_s(table: str, page: Page, regions: pd.DataFrame):
    header, *rows = page.tables[table]
    assert [row[0] for row in rows] == list(regions.index)
    for number, title in enumerate(header[1:], start=1):
        of_title = regions[NAMES[title.replace("²", "^2")]].to_numpy()
        for row, expected in zip(rows, of_title, strict=True):
            value, interval = row[number].split("\n")
            ends = interval.removesuffix(UNCERTAIN).split(" to ")
            assert [printed(text) for text in (value, *ends)] == expected.tolist()


def test_pressure_in_the_file_is_the_api_s(page_path: Path, regions: pd.DataFrame):
    written = pd.read_csv(files_folder(page_path) / "pressure.csv", index_col="region")
    of_all = [name for of_title in NAMES.values() for name in of_title]
    np.testing.assert_allclose(written[of_all], regions[of_all], rtol=1e-9)


def test_every_figure_has_its_files(page, page_path):
    folder = files_folder(page_path)
    figures = {path.stem for path in folder.glob("*.pdf")}
    assert folder.name == "my report_files" and len(figures) >= 10
    linked = {unquote(link) for link in page.attributes("href") if not link.startswith("#")}
    expected = product(figures, ("pdf", "png", "csv"))
    assert linked == {f"{folder.name}/{name}.{kind}" for name, kind in expected}
    assert linked <= {f"{folder.name}/{path.name}" for path in folder.iterdir()}


Files = dict[str, pd.DataFrame]


@pytest.fixture(scope="module")
def files(page_path: Path) -> Files:
    """The tables beside the page, by their names."""
    return {path.stem: pd.read_csv(path) for path in files_folder(page_path).glob("*.csv")}


def test_files_hold_measured_and_predicted_values(files: Files, results: Results):
    samples, measured = results.samples, results.samples.trusted_values
    errors = results.candidates[LABELS[0]].errors
    for i, (name, error) in enumerate(zip(samples.channels, errors, strict=True)):
        table = files["wrench" if i < 6 else "local_forces"]
        expected = {f"measured [{error.unit}]": measured[:, i]} | {
            f"predicted {label} [{error.unit}]": found.predicted[:, i]
            for label, found in results.candidates.items()
        }
        for column, values in expected.items():
            np.testing.assert_allclose(table[f"{name} {column}"], values, rtol=1e-9)


@pytest.mark.parametrize("name", ["wrench", "local_forces", "overview", "engaged_springs"])
def test_series_have_the_stamps_of_the_samples(name: str, files: Files, results: Results):
    samples = results.samples
    assert files[name]["stamp [ns]"].tolist() == samples.stamps.tolist()
    np.testing.assert_allclose(files[name]["time [s]"], samples.time)
    assert (files[name]["in segment"] == 1).tolist() == results.in_segment.tolist()


def model_of(results: Results, label: str) -> ContactModel:
    return results.candidates[label].model.model


@pytest.mark.parametrize("label", LABELS)
def test_files_hold_a_model_s_stiffness(label: str, files: Files, results: Results):
    found = files[f"tile_stiffness_{label}"]
    assert found["tile"].tolist() == list(results.trial.geometry.names)
    axes = found[[f"stiffness {axis} [N/m]" for axis in "xyz"]]
    np.testing.assert_allclose(axes, model_of(results, label).stiffness, rtol=1e-9)


@pytest.mark.parametrize("label", LABELS)
def test_files_hold_the_shares_of_engaged_springs(label: str, files: Files, results: Results):
    shares = files["engaged_tiles"].filter(like=f"{label}.")
    pose = results.samples.pose[results.in_segment]
    displacement, _ = model_of(results, label).gate_displacements(pose, np.eye(6))
    np.testing.assert_allclose(shares, (displacement < 0.0).mean(axis=0), rtol=1e-9)


@pytest.mark.parametrize("label", PAPER_VARIANTS)
def test_files_hold_a_model_s_rest_positions(label: str, files: Files, results: Results):
    """One file for all: the first stage is the same."""
    mean = np.nanmean(results.samples.position[results.in_segment], axis=0)
    rest = files["rest_positions"].filter(like="from the mean limb position")
    expected = 1e3 * (model_of(results, label).rest_positions - mean)
    np.testing.assert_allclose(rest, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("label", [label for label in LABELS if label != PLAIN])
def test_files_hold_a_model_s_offsets(label: str, files: Files, results: Results):
    model, samples = model_of(results, label), results.samples
    biases = map(model.force_bias.get, samples.clusters)
    assert files["offsets"]["channel"].tolist() == list(samples.channels)
    shown = files["offsets"][f"offset {label} [unit of the row]"]
    np.testing.assert_allclose(shown, [*model.wrench_bias, *np.ravel([*biases])], rtol=1e-9)


# --- cards and map


@pytest.fixture(scope="module")
def shown(page: Page) -> dict[str, Any]:
    """The data that the page draws."""
    found: dict[str, Any] = json.loads(page.script("page-data"))
    return found


@pytest.mark.parametrize(
    ("number", "region"), [(0, "socket"), (1, "unmeasured wall")], ids=["socket", "wall"]
)
def test_a_card_shows_its_row_of_the_table(number, region, shown, page):
    value, interval = page.rows("pressure-regions")[region][0].split("\n")
    card = shown["cards"][number]
    assert card["value"] == f"{value} kPa"
    assert card["interval"] == interval.removesuffix(UNCERTAIN)


def test_the_map_opens_at_the_card_s_peak(shown):
    (peak,) = [m for m in shown["moments"] if abs(m["time"] - shown["start"]) < 2e-3]
    assert f"{max(peak['pressure']):.1f} kPa" == shown["cards"][0]["value"]


def test_the_map_shows_each_model_s_stiffness(shown, results):
    for name, values in shown["extras"].items():
        label, _, title = name.partition(": ")
        if title.startswith("stiffness along z"):
            model = model_of(results, label)
            np.testing.assert_allclose(values["values"], model.stiffness[:, 2], atol=5.1e-3)


# --- a trial of a nasty name, with wrong data


@dataclass
class Spoilt:
    """What a report of a spoilt trial printed, and its page."""

    path: Path
    out: str
    err: str

    @property
    def page(self) -> Page:
        return Page(self.path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def reported(spoilt: Path, tmp_path_factory: pytest.TempPathFactory) -> Spoilt:
    path, out, err = tmp_path_factory.mktemp("page") / "page.html", io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        words = ["report", str(spoilt), "-o", str(path), "--thetas", "3"]
        assert run([*words, "--leave-out", f"{NASTY}.Fy"]) == 0
    return Spoilt(path, out.getvalue(), err.getvalue())


def test_the_verb_names_its_page(reported: Spoilt):
    assert str(reported.path) in reported.out


def test_wrong_data_are_named_before_the_report(reported: Spoilt):
    found = f"data: check {NASTY}: {NASTY}.Fx: the "
    assert f"note: {found}" in reported.err
    assert found in reported.page.text


def test_a_trial_s_names_are_no_markup(reported: Spoilt):
    page = reported.page
    assert page.said["h1"] == [NASTY] and page.said["b"] == ["left", NASTY]
    assert NASTY not in reported.path.read_text(encoding="utf-8")


def test_a_channel_left_out_is_marked(reported: Spoilt):
    errors = reported.page.rows("errors")
    assert "not in objective" not in errors[f"{NASTY}.Fx"]
    assert "not in objective" in errors[f"{NASTY}.Fy"]


def test_gaps_are_on_the_page(reported: Spoilt):
    assert "gaps longer than 1.5 periods: 1, the longest 2.250 s" in reported.page.text


def test_drop_outs_are_on_the_page(reported: Spoilt):
    rows = reported.page.rows("drop-outs")
    assert int(rows[NASTY][0]) > 10 and int(rows["Mx"][0]) == 0
