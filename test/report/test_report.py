"""What a report computes, says and refuses; the page of a socket."""

import dataclasses
import json
from dataclasses import dataclass
from unittest.mock import Mock

import numpy as np
import pytest
import trimesh
from support.pages import LABELS, MADE, NASTY, THETAS, Page
from support.problems import make_samples, ring_socket
from support.tabs import Tab, small_viewer
from support.wording import refused

import socket_testbed as st
from socket_testbed.arrays import within
from socket_testbed.errors import ConfigurationError
from socket_testbed.figures.wall import unrolled_tiles
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.channel_errors import summarise_errors
from socket_testbed.identification.model_file import read_model
from socket_testbed.report import fronts, validation, write
from socket_testbed.report.page import Pictures, Section, write_page, write_socket_page
from socket_testbed.report.pressure import page_data
from socket_testbed.report.write import check_page_path, summarise, write_report
from socket_testbed.results.report import GIVEN, Results, compute_results
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


def test_a_report_judges_each_model(results):
    assert [*results.candidates] == LABELS


def test_a_given_model_predicts_as_its_fit(results, hold_model):
    """It was fitted with the same settings on the same segment."""
    fitted, given = (results.candidates[label] for label in LABELS[-2:])
    stiffness = read_model(hold_model).model.stiffness
    np.testing.assert_array_equal(given.model.model.stiffness, stiffness)
    np.testing.assert_allclose(given.predicted, fitted.predicted, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("label", LABELS)
def test_the_summary_states_a_model_s_errors(label: str, results):
    candidate = results.candidates[label]
    found = {line.partition(": ")[0]: line for line in summarise(results)}
    in_sample, _, held_out = found[label].partition("; held-out: ")
    assert moment_rmse(candidate.errors) in in_sample
    assert moment_rmse(candidate.held_out) in held_out


def moment_rmse(errors) -> str:
    """What a summary says of errors."""
    return f"mean moment RMSE {summarise_errors(errors).mean_moment_rmse:.3g} N m"


def test_notes_state_a_model_s_weakness(results):
    """In a hold the offsets bear the load."""
    share = results.fitted[BIAS].load_shares()[1].springs
    only = f"only {100 * share:.0f} %"
    assert any(n.startswith(BIAS) and only in n for n in results.notes)


@dataclass
class Reduced:
    """The results of a spoilt trial without two channels, fitted on its first frames."""

    trial: Trial
    results: Results
    left_out: tuple[str, str] = ("Mz", f"{NASTY}.Fx")


@pytest.fixture(scope="module")
def reduced(spoilt) -> Reduced:
    trial = Trial(spoilt)
    trial.samples().wrench[:, 2] = np.nan
    with pytest.MonkeyPatch.context() as patch:
        place = "socket_testbed.identification.validation.VARIANTS"
        patch.setattr(place, ("stiffness", "stiffness_bias"))
        patch.setattr("socket_testbed.results.report.pareto_front", lambda *_, **__: {})
        return Reduced(trial, results_of(trial, *Reduced.left_out, frames=60))


def test_the_report_s_pressure_needs_no_fitted_frame(reduced):
    """It is of the whole segment, whatever the fit used."""
    results, pressure = reduced.results, st.pressure(reduced.trial, leave_out=reduced.left_out)
    assert len(results.samples[results.segment.rows]) == 60 < len(pressure.time)
    integrals = (found.outputs.regions.integral.value for found in (results.pressure, pressure))
    np.testing.assert_array_equal(*integrals)


def test_a_channel_never_measured_is_a_note(reduced):
    assert "Never measured over the segment: Mz." in reduced.results.notes


def test_a_channel_left_out_is_no_finding(reduced):
    assert not any(
        reduced.left_out[1] in str(finding) for finding in reduced.results.checked.findings
    )


def test_channels_left_out_are_marked(reduced):
    for candidate in reduced.results.candidates.values():
        assert candidate.held_out
        marked = [error.name for error in candidate.errors if not error.in_objective]
        assert marked == [*reduced.left_out]


@pytest.mark.usefixtures("few_variants")
@pytest.mark.parametrize(
    ("own", "words"), [(True, "in-sample"), (False, "over the segment")], ids=["own", "other"]
)
def test_a_given_model_is_judged_on_unused_samples(own, words, hold, hold_model, monkeypatch):
    """It was fitted on the plateau, of this trial or of another."""
    monkeypatch.setattr("socket_testbed.results.report.pareto_front", lambda *_, **__: {})
    trial, model = Trial(hold), read_model(hold_model)
    outside = ~within(trial.samples().time, 20.0, 40.0)
    fingerprint = trial.fingerprint if own else "of another trial"
    given = dataclasses.replace(model, fingerprint=fingerprint)
    found = compute_results(trial, "20:40", trial.estimator, THETAS, given)
    assert any(line.startswith(f"given: {words}: ") for line in summarise(found))
    rest = outside & ~given.used("hold", trial.fingerprint, trial.samples())
    assert max(e.samples for e in found.candidates[GIVEN].held_out) == rest.sum()


@pytest.mark.usefixtures("few_variants")
def test_a_report_needs_neither_front_nor_validation(hold):
    results = results_of(Trial(hold), "Mx", "My", "Mz", "Fx", "Fy", "Fz", segment="all")
    assert fronts.section(results).parts[0].startswith("None: ")
    lacking = "none of the 240 samples has a wrench, which a validation needs"
    assert lacking in validation.section(results).parts[0]
    assert "held-out the" not in " ".join(summarise(results))


def test_a_page_of_another_suffix_is_refused(tmp_path):
    with refused(ConfigurationError, "page.pdf", ".html"):
        check_page_path(tmp_path / "page.pdf")


@pytest.mark.parametrize("taken", ["page.html", "page_files"])
def test_a_page_replaces_no_folder(taken: str, results, tmp_path):
    (tmp_path / taken).mkdir()
    with refused(ConfigurationError, f"{taken} exists already"):
        write_report(results, tmp_path / "page.html", "", MADE)
    assert [path.name for path in tmp_path.iterdir()] == [taken]


def test_a_full_disk_leaves_no_page(results, tmp_path, monkeypatch):
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
    assert tab.text("#when") == f"at {found.peak_time:.2f} s, the peak in the plateau"
    assert tab.texts("strong")[0] == f"{peak:.1f} kPa"
    assert f"<b>peak {peak:.1f}</b>" in tab.picture("#map").notes
    tab.click('button[data-moment="mean"]')
    assert tab.text("#when") == f"mean over {found.segment}"
    assert f"<b>highest {mean:.1f}</b>" in tab.picture("#map").notes
    first = found.regions["mean pressure [kPa]"].iloc[0]
    assert tab.texts(".said")[0].startswith(f"{first:.1f} (")
    model = next(name for name in tab.options("#kind") if "stiffness along" in name)
    tab.choose("#kind", model)
    assert tab.picture("#map").heatmap().trace["colorbar"]["title"]["text"] == "N/m"


@pytest.fixture
def samples(rng):
    """200 samples at 4 Hz."""
    position, force, wrench = (rng.normal(size=(200, n)) for n in (3, 3, 6))
    return make_samples(position, wrench, {"a": force})


@pytest.mark.parametrize(
    ("times", "number", "end"),
    [
        (
            [0.0, 0.25, 0.5, 1.5, 1.75, 2.0, 5.0, 5.25, 5.6],
            2,
            "longest 3.000 s from 2.00 s, 1.000 s from 0.50 s",
        ),
        ([*np.arange(0.0, 40.0, 0.25), 79.75], 1, "periods: 1, the longest 40.000 s from 39.75 s"),
        ([*np.arange(0.0, 5.0, 0.05), *np.arange(5.0, 30.0, 0.25)], 0, ""),
    ],
    ids=["two gaps", "one gap", "another rate"],
)
def test_gaps_are_counted(times: list[float], number: int, end: str, samples):
    stamps = np.int64(1e9) * 10**9 + np.round(1e9 * np.array(times)).astype(np.int64)
    found = describe_samples(dataclasses.replace(samples[: len(times)], stamps=stamps))
    assert f"periods: {number}" in found and found.endswith(end)


@pytest.fixture
def lost(samples):
    """The drop-outs of a wrench, the limb's position and a cluster."""
    samples.wrench[10:20, 2] = np.nan
    samples.position[190:] = np.nan
    samples.status[30:33, 0] = 1
    samples.status[40:44, 0] = 2
    samples.status[60:65, 0] = 3
    return drop_outs(samples, slice(0, 17)).frame


def test_drop_outs_are_counted(lost):
    columns = ["missing [1]", "of them in the segment [1]", "missing [%]"]
    assert tuple(lost.loc["Mz", columns]) == pytest.approx((10, 7, 5.0))


def test_drop_outs_are_counted_by_their_status(lost):
    lost_of_a = lost.loc["a", ["missing [1]", "saturated [1]", "out of range [1]"]]
    assert tuple(lost_of_a) == (4, 3, 5)


def test_a_drop_out_lasts_until_the_next_value(lost):
    """From the last value, or to the end."""
    longest = lost.loc[["Mz", "limb position", "Mx"], "longest [s]"]
    assert longest.tolist() == pytest.approx([11 / 4.0, 10 / 4.0, 0.0])


# --- the page of a socket

MARKUP = f"</script>{NASTY}"


@dataclass
class SocketPage:
    """The page of a socket whose tile and cluster have the name of markup."""

    geometry: SocketGeometry
    mesh: trimesh.Trimesh
    text: str

    @property
    def page(self) -> Page:
        return Page(self.text)

    @property
    def shown(self) -> dict:
        return json.loads(self.page.script("page-data"))


@pytest.fixture(scope="module")
def socket_page(tmp_path_factory) -> SocketPage:
    geometry, mesh = ring_socket(), trimesh.creation.icosphere(3, radius=0.05)
    path, facts = tmp_path_factory.mktemp("page") / "socket.html", [(MARKUP, "1 < 2")]
    alone = dataclasses.replace(
        geometry,
        names=(MARKUP, *geometry.names[1:]),
        clusters={MARKUP: 0},
        neighbours=np.zeros((0, 2), dtype=np.int64),
    )
    write_socket_page(mesh, alone, path, MARKUP, [*facts, ("tiles", MARKUP)])
    return SocketPage(alone, mesh, path.read_text(encoding="utf-8"))


def test_a_socket_s_page_loads_nothing(socket_page):
    assert not socket_page.page.attributes("src", "href", "srcset", "data")


def test_a_socket_s_names_are_no_markup(socket_page):
    page = socket_page.page
    assert MARKUP not in socket_page.text
    assert page.said["title"] == page.said["h1"] == [MARKUP]
    assert MARKUP in socket_page.shown["socket"]["clusters"]


def test_a_socket_s_page_shows_its_tiles(socket_page):
    shown = socket_page.shown
    squares = np.array(shown["socket"]["squares"])[:, :4]
    np.testing.assert_allclose(
        squares, 1e3 * unrolled_tiles(socket_page.geometry).squares, atol=0.051
    )
    areas = shown["extras"]["area [mm^2]"]["values"]
    np.testing.assert_allclose(areas, 1e6 * socket_page.geometry.areas)


def test_a_socket_s_page_shows_its_surface(socket_page):
    points = np.array(socket_page.shown["socket"]["surface"]["points"])
    np.testing.assert_allclose(points, 1e3 * socket_page.mesh.vertices, atol=0.051)
