"""Every option of every method of a result has its effect; a new one without a case is an error."""

import inspect
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest
from matplotlib.figure import Figure
from support.benches import sensor_bench, write_bench

import socket_testbed as st
from socket_testbed.commands import results
from socket_testbed.errors import CalibrationError, ConfigurationError, TrialError
from socket_testbed.trials.trial import Trial

# Those with a test here, or in the module named.
COVERED = {
    "Result": {
        "save": {"path"},
        "figure": {"width", "title", "vmin", "vmax"},
        "draw": {"path", "width", "title", "vmin", "vmax", "ax"},
    },
    "TrialFit": {"save": {"path"}},
    "Evaluation": {"save": {"path"}},
    "TrialMap": {
        "at": {"time"},
        "draws": {"count"},
        "part": {"segment"},
        "outputs": {"rows", "threshold"},
        "pressure": {"threshold", "share"},
        "course": {"most", "also"},  # test_read_by_hand.py
    },
    "TrialPressure": {"save": {"path", "over_time"}, "to_long": {"over_time"}},
    "Comparison": {
        "cells": {"part", "quantity"},
        "difference_title": {"item"},
        "tile_pressures": {"columns"},  # test_comparison.py
    },
    "CalibratedCluster": {
        "calibration": {"limit", "force"},
        "save": {"path", "limit", "force", "replace"},
    },
}


@pytest.mark.parametrize("name", [name for name in st.__all__ if name[0].isupper()])
def test_every_option_has_a_test(name: str) -> None:
    kind = getattr(st, name)
    own: dict[str, set[str]] = {}
    for method, function in vars(kind).items():
        if inspect.isfunction(function) and method[0] != "_":
            options = {*inspect.signature(function).parameters} - {"self"}
            own |= {method: options} if options else {}
    assert own == COVERED.get(name, {})


class Drawn(st.Result):
    """A result whose figure shows how it was asked for."""

    def _figure(self, style: Any) -> Any:
        return style.width, style.titles

    def _draw_into(self, ax: Any, limits: Any) -> None:
        ax.set_title("drawn")


@pytest.mark.parametrize(
    ("options", "expected"),
    [({}, (180, True)), ({"width": 88}, (88, True)), ({"title": False}, (180, False))],
    ids=["default", "width", "title"],
)
def test_a_figure_has_the_asked_style(
    options: Any, expected: tuple[int, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[Any] = []
    monkeypatch.setattr(
        "socket_testbed.results.result.save_figure",
        lambda figure, path: written.append((figure, str(path))),
    )
    assert Drawn().figure(**options) == expected
    Drawn().draw("new.svg", **options)
    assert written == [(expected, "new.svg")]


def test_axes_are_drawn_into_without_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    ax = Figure().subplots()
    Drawn().draw(ax=ax)
    assert ax.get_title() == "drawn"


@pytest.mark.parametrize(
    ("over_time", "first"), [(False, "region"), (True, "time [s]")], ids=["regions", "over time"]
)
def test_the_asked_table_is_saved(
    over_time: bool, first: str, trial: Trial, tmp_path: Path
) -> None:
    found = st.pressure(trial, "2:5")
    found.save(tmp_path / "new.csv", over_time=over_time)
    table = pd.read_csv(tmp_path / "new.csv")
    assert table.columns[0] == first and len(table) == (13 if over_time else len(found.places))


def test_as_many_draws_as_asked(trial: Trial) -> None:
    found = st.force_map(trial, "2:5")
    assert found.draws(20).shape == (13, 20, 12, 3)
    assert found.at(3.1).draws().shape == (1, 200, 12, 3)
    with pytest.raises(ConfigurationError, match="7 draws: an odd number: give an even number"):
        found.draws(7)


@pytest.mark.parametrize(
    ("time", "row"), [(2.0, 8), (3.1, 12), (5.0, 20), (5.7, 20)], ids=["first", "mid", "last", "on"]
)
def test_an_instant_is_the_latest_sample(time: float, row: int, trial: Trial) -> None:
    instant = st.force_map(trial, "2:5").at(time)
    assert (instant.segment.kind, instant.segment.rows) == ("instant", slice(row, row + 1))
    assert instant.time.tolist() == [0.25 * row] == [instant.segment.start]
    assert instant.samples.stamps.tolist() == trial.samples().stamps[row : row + 1].tolist()


def test_a_part_of_a_map_is_that_of_the_trial(trial: Trial) -> None:
    part = st.force_map(trial, "2:8").part(trial.select("3:5"))
    own = st.force_map(trial, "3:5")
    assert part.segment == own.segment and part.time.tolist() == own.time.tolist()
    assert part.samples.stamps.tolist() == own.samples.stamps.tolist()
    pd.testing.assert_frame_equal(part.to_dataframe(), own.to_dataframe())


@pytest.mark.parametrize("segment", ["1:5", "3:9", "all"], ids=["before", "after", "all"])
def test_a_part_beyond_the_map_is_an_error(segment: str, trial: Trial) -> None:
    with pytest.raises(TrialError, match=r"beyond that of the map, span 2\.00 s to 8\.00 s"):
        st.force_map(trial, "2:8").part(trial.select(segment))


def test_a_map_gives_its_pressure(trial: Trial) -> None:
    mapped, own = st.force_map(trial, "2:5"), st.pressure(trial, "2:5", threshold=17.0, share=0.3)
    found = mapped.pressure(17.0, share=0.3)
    pd.testing.assert_frame_equal(found.regions, own.regions)
    assert (found.threshold, found.share) == (17.0, 0.3)
    assert mapped.outputs(slice(2, 4), threshold=17.0).threshold == 17e3
    assert len(mapped.outputs(slice(2, 4)).samples) == 2


@pytest.mark.parametrize("threshold", [0.0021, 3.3, 5.0, 12.3456, 17.0])
def test_a_threshold_is_read_as_it_was_given(threshold: float, trial: Trial) -> None:
    found = st.force_map(trial, "2:5").pressure(threshold)
    assert found.threshold == found.document()["threshold [kPa]"] == threshold
    assert found.outputs.threshold == pytest.approx(1e3 * threshold)
    assert f"above {threshold:g} kPa" in found.contact


@pytest.mark.parametrize("time", [1.9, 5.9], ids=["before", "after"])
def test_an_instant_outside_is_an_error(time: float, trial: Trial) -> None:
    with pytest.raises(TrialError) as raised:
        st.force_map(trial, "2:5").at(time)
    assert str(raised.value) == (
        f"the map has no sample at {time:g} s: give a time between 2.00 s and 5.00 s"
    )


# ------------------------------------------------------------------ a calibrated cluster


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> st.CalibratedCluster:
    """A cluster calibrated from a simulated bench, into the package's own calibration."""
    path = tmp_path_factory.mktemp("bench") / "bench.csv"
    write_bench(path, sensor_bench(play=0.04))
    return st.calibrate(path, "distal", wiring=(2, 3, 0, 1))


def test_a_cluster_above_the_limit_is_refused(calibrated: st.CalibratedCluster) -> None:
    worst = calibrated.to_dataframe()["held-out RMSE [%]"].max()
    assert calibrated.calibration(worst + 0.01).clusters["distal"].bench["forced"] is False
    with pytest.raises(CalibrationError):
        calibrated.calibration(worst - 0.01)
    forced = calibrated.calibration(worst - 0.01, force=True).clusters["distal"].bench
    assert (forced["forced"], forced["limit_percent"]) == (True, worst - 0.01)


def test_a_calibration_replaces_only_its_own(
    calibrated: st.CalibratedCluster, tmp_path: Path
) -> None:
    path = tmp_path / "new.yaml"
    path.write_text("old")
    with pytest.raises(ConfigurationError, match="exists already"):
        calibrated.save(path)
    with pytest.raises(CalibrationError):
        calibrated.save(path, limit=1e-6, replace=True)
    assert path.read_text() == "old"
    replace(calibrated, existing_file=path).save(path)
    assert path.read_text() != "old"
    path.write_text("old")
    calibrated.save(path, 1e-6, True, True)
    assert "forced: true" in path.read_text()


# ------------------------------------------------------------------ pressure over cycles


MAIN = [
    *("anterior", "posterior", "medial", "lateral"),
    *("proximal", "middle", "distal"),
    *("tibia", "fibula"),
]


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ({"output": Path("new.csv")}, {"saved": "new.csv"}),
        ({"figure": Path("new.pdf")}, {"drawn": ("new.pdf", 88, False), "quantities": MAIN}),
        ({}, {}),
    ],
    ids=["table", "figure", "neither"],
)
def test_pressures_are_brought_to_cycles(
    asked: dict[str, Any], expected: dict[str, Any], trial: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = st.pressure(trial, "2:5")
    seen: dict[str, Any] = {}

    def cycles(opened: Trial, table: pd.DataFrame, *, by: str, segment: Any) -> Any:
        assert (opened, by, str(segment)) == (trial, "push", "span 2.00 s to 5.00 s")
        quantities = [title.removesuffix(".mean pressure [kPa]") for title in table]

        def draw(path: Path, width: int, title: bool) -> None:
            seen.update({"drawn": (str(path), width, title), "quantities": quantities})

        return SimpleNamespace(save=lambda path: seen.update({"saved": str(path)}), draw=draw)

    monkeypatch.setattr(results.api, "cycles", cycles)
    options = {"output": None, "figure": None, "width": 88, "title": False} | asked
    results._bring_to_cycles(found, cycles="push", **options)
    assert seen == expected
