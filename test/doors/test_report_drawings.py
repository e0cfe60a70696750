"""What the report draws for print and notes: greys, gaps, events, and the reach of its colours."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import QuadMesh
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from support import scene

from socket_testbed.figures import pressure, tiles
from socket_testbed.figures.overview import overview_figure
from socket_testbed.figures.style import DEFAULT_STYLE
from socket_testbed.identification.pressure import Quantity
from socket_testbed.identification.validation import Judgement
from socket_testbed.report import validation
from socket_testbed.results.report import notes_on
from socket_testbed.results.validation import Validation
from socket_testbed.trials.segment import Segment

PLATEAU = Segment("plateau", 1.0, 9.0, slice(4, 37))
SEGMENT = Segment("span", 3.0, 5.0, slice(12, 21))


@pytest.fixture
def overview() -> Figure:
    """The overview of the scene with a gap between 12 and 18 s."""
    kept = (scene.TIME < 12.0) | (scene.TIME >= 18.0)
    ones = np.ones(kept.sum())
    lacking = {"Mx": np.zeros(kept.sum(), dtype=bool), "distal": scene.TIME[kept] < 3.0}
    loads = {"force magnitude [N]": ones, "moment magnitude [N m]": ones}
    return overview_figure(scene.TIME[kept], loads, lacking, [PLATEAU], SEGMENT, DEFAULT_STYLE)


def test_the_segment_is_darker_than_plateaus(overview: Figure) -> None:
    spans = {
        (patch.get_x(), patch.get_x() + patch.get_width()): to_hex(patch.get_facecolor())
        for patch in overview.axes[0].patches
        if isinstance(patch, Rectangle)
    }
    assert {*spans} == {(1.0, 9.0), (3.0, 5.0)}
    assert spans[3.0, 5.0] < spans[1.0, 9.0]


def test_a_gap_is_not_usable(overview: Figure) -> None:
    (mesh,) = [part for part in overview.axes[2].collections if isinstance(part, QuadMesh)]
    share, places = np.asarray(mesh.get_array()), mesh.get_coordinates()[0, :, 0]
    middle = 0.5 * (places[1:] + places[:-1])
    rows = share.reshape(2, -1)
    assert (rows[:, (middle > 12.5) & (middle < 17.5)] == 1.0).all()
    assert (rows[0, middle < 11.0] == 0.0).all()
    assert (rows[1, middle < 2.5] == 1.0).all()
    assert (rows[1, (middle > 4.0) & (middle < 11.0)] == 0.0).all()


@pytest.mark.parametrize(
    ("used", "note"),
    [((48, 48), None), ((48, 40), None), ((40, 44), "4 of the segment's 48 samples")],
    ids=["all", "one variant", "none"],
)
def test_samples_that_no_variant_fits_are_noted(
    used: tuple[int, int], note: str | None, report
) -> None:
    pairs = zip(report.results.candidates.items(), used, strict=False)
    candidates = {
        label: replace(found, model=replace(found.model, samples=count))
        for (label, found), count in pairs
    }
    trial, samples = report.results.trial, report.results.samples
    notes = notes_on(trial, samples, 48, candidates)
    found = [line for line in notes if " not fitted" in line]
    assert [line.split(" are not")[0] for line in found] == ([note] if note else [])


def test_events_of_the_segment_alone_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(pressure, "_mark_events", lambda panel, events: drawn.append(events))
    time = np.linspace(10.0, 20.0, 5)
    level = np.ones((5, 1))
    events = [(9.9, "early"), (10.0, "first"), (20.0, "last"), (20.1, "late")]
    figure = Figure(layout="constrained")
    pressure.draw_regions(
        figure, time, Quantity(level, level, level, level), {"anterior": 0}, events, DEFAULT_STYLE
    )
    assert drawn == [[(10.0, 1), (20.0, 2)]]
    assert figure.get_supxlabel() == "bands: 95 % intervals, events: 1 first, 2 last"


def test_a_map_is_grey_by_its_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    """2 kPa of standard deviation reach 3.92 kPa; the deviation itself is certain."""
    asked: dict[str, Any] = {}
    monkeypatch.setattr(pressure, "tile_map_figure", lambda *_, **given: asked.update(given))
    ones = np.ones((1, 12))
    estimate: Any = SimpleNamespace(
        normal_pressure=20e3 * ones,
        normal_pressure_standard_deviation=2e3 * ones,
        pressure_reach=1.959964 * 2e3 * ones,
    )
    pressure.force_map_figure(scene.geometry(), estimate, "", DEFAULT_STYLE, None)
    reach = asked["reach"]
    assert reach["normal pressure"] == pytest.approx(3.919928 * ones[0])
    assert (reach["its standard deviation"] == 0.0).all()


@pytest.mark.parametrize(
    ("limits", "reach", "linear"),
    [
        ((0.0, 60.0), True, False),
        ((-5.0, 60.0), True, False),
        ((-60.0, 60.0), True, True),
        ((0.0, 60.0), False, True),
    ],
    ids=["pressures", "a little pull", "differences", "other values"],
)
def test_differences_have_linear_colours(
    limits: tuple[float, float], reach: bool, linear: bool
) -> None:
    values = np.linspace(*limits, 12)
    paint = tiles.paint_tiles(scene.geometry(), values, limits, np.ones(12) if reach else None)
    middle = 0.5 * (limits[0] + limits[1])
    assert (float(paint.scale.norm(middle)) == pytest.approx(0.5)) is linear


@pytest.mark.parametrize(
    ("trials", "titles"),
    [
        (("a",), {"error [-]"}),
        (("a", "b"), {"error [-]", "worst error [-]", "judged [1]"}),
    ],
    ids=["one trial", "some with two"],
)
def test_several_trials_have_their_worst_error(trials: tuple[str, ...], titles: set[str]) -> None:
    """One predictor is judged on all trials, another on the first alone."""
    shares = {"coverage": (0.5, 0.8, 0.95), "error": 0.5, "samples": 9}
    found = [
        Judgement("tiles", predictor, "second half", "", name, **shares)  # type: ignore[arg-type]
        for predictor, names in (("force map", trials), ("rigid", trials[:1]))
        for name in names
    ]
    names = ("a", "b")
    (table,) = validation.judged_tables(Validation(names, names, tuple(found), ()))
    assert isinstance(table.frame, pd.DataFrame)
    assert {*table.frame} - {"in 50 % [%]", "in 80 % [%]", "in 95 % [%]"} == titles
