"""Whole lines that functions of the API refuse a call with, and their notes, by hand."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from support import scene

import socket_testbed as st
from socket_testbed.api import comparison, design, trials, validation
from socket_testbed.api.cycles import Cycles
from socket_testbed.api.design import CalibratedCluster
from socket_testbed.errors import TestbedError, TrialError
from socket_testbed.geometry.socket import write_socket
from socket_testbed.results import comparing, result, validating
from socket_testbed.settings.options import SettingsOptions
from socket_testbed.trials.events import Event
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial


def line(call: Callable[[], object]) -> str:
    """The error of a call."""
    with pytest.raises(TestbedError) as found:
        call()
    return str(found.value)


# --- compare


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two folders that may be trials, `a` and `b`."""
    for name in "ab":
        (tmp_path / name).mkdir()
    return tmp_path


COMPARED: dict[str, tuple[list[str], dict[str, list[str]] | None, str]] = {
    "both": (
        *(["a"], {"x": ["b"]}),
        "1 trials and also conditions are given: give each trial to a condition",
    ),
    "empty": ([], {"x": ["a"], "y": []}, "the condition 'y' has no trial: name its trials"),
    "one": (
        *([], {"x": ["a"]}),
        "conditions to compare: 1: give 2 to 200, or 'pressure FOLDER -o OUTPUT' for a table with"
        " all trials",
    ),
    "none": (
        *([], None),
        "trials to compare: 0: give 2 to 200, or 'pressure FOLDER -o OUTPUT' for a table with all"
        " trials",
    ),
    "model": (
        *(["a", "m.json"], None),
        "{}/m.json: compare takes trials: judge a model by 'evaluate TRIAL --model MODEL'",
    ),
    "twice": (["a", "b", "a"], None, "{}/a is given twice: give each trial once"),
}


@pytest.mark.parametrize("case", COMPARED)
def test_a_comparison_is_refused_with_this_line(case: str, folder: Path) -> None:
    items, conditions, expected = COMPARED[case]
    groups = conditions and {
        name: [folder / item for item in own] for name, own in conditions.items()
    }
    call = lambda: comparison.open_compared([folder / item for item in items], groups)  # noqa: E731
    assert line(call) == expected.format(folder)


def noted(
    sides: Any = ("right", "right"), subjects: Any = ("S01", "S01"), freedom: int = 0, same=True
) -> list[str]:
    """Notes on two trials of equal load and time; `b` has a region of its own."""
    both: Any = [
        SimpleNamespace(
            trial=SimpleNamespace(
                metadata=SimpleNamespace(side=side, subject=subject),
                geometry=SimpleNamespace(regions=regions),
            ),
            places=[],
            outputs=SimpleNamespace(integrated=20.0),
        )
        for side, subject, regions in zip(sides, subjects, ({}, {"heel": (1,)}), strict=True)
    ]
    row: Any = {("wrench", f"F{axis}", "mean [N]"): {"value": 9.0} for axis in "xyz"}
    return [*comparing._notes(both, ["a", "b"], [row, row], same, freedom)]


HEEL = "not compared, because these regions differ between trials: heel"


def test_a_comparison_s_notes_are_these_lines() -> None:
    assert noted() == [HEEL]
    assert noted(same=False)[0] == (
        "the trials are of different sockets: regions are sectors and thirds of each socket's own"
        " height, and differ in area"
    )
    assert noted(sides=("left", "right"))[0] == (
        "left and right legs are compared: medial with medial, lateral with lateral; tiles are"
        " compared where they are in the socket"
    )
    assert noted(sides=("left", None))[0] == (
        "b: no side is stated: the regions are left and right, not medial and lateral; state it"
        " with 'annotate TRIAL --side left|right'"
    )
    assert noted(sides=(None, None)) == [HEEL]
    assert noted(freedom=3)[1:] == [
        "values are means of repeated trials; spread: the standard deviation between donnings"
        " (degrees of freedom: 3), included in the intervals; detectable: the smallest difference"
        " that 80 % of such studies would tell from 0"
    ]
    assert noted(freedom=3, subjects=("S01", "S02"))[-1] == (
        "several limbs: the spread between donnings includes that between the limbs"
    )
    assert noted(freedom=3, subjects=(None, None))[-1] == (
        "no subject is stated: errors of one limb are assumed not to cancel in a difference; state"
        " it with 'annotate TRIAL --subject CODE'"
    )


def test_what_is_detectable_is_told_in_kilopascals() -> None:
    """Two or three trials a condition; the larger of two items counts."""
    rows = [
        ("regions", "mean pressure", "socket", 1.26),
        ("regions", "mean pressure", "socket", 1.14),
        ("regions", "mean pressure", "anterior", 2.04),
        ("regions", "mean pressure", "posterior", 3.5),
        ("regions", "peak pressure", "posterior", 99.0),
    ]
    table = pd.DataFrame(rows, columns=["part", "quantity", "name", "detectable"])
    repeated: Any = SimpleNamespace(freedom=3, numbers=np.array([0, 0, 1, 1, 1]))
    assert comparing._detectable(table, repeated) == (
        "with 2 to 3 trials per condition, differences of at least 1.3 kPa are detectable in the"
        " socket's mean pressure, of 2.0 to 3.5 kPa in that of its regions; "
    )
    single: Any = SimpleNamespace(freedom=0)
    assert comparing._detectable(table, single) == ""


# --- cycles

TABLE = pd.DataFrame({"time [s]": np.arange(9.0), "load [N]": np.arange(9.0)})


@pytest.fixture
def walked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Trial:
    """A trial of 9 s that is placed at 1, 4 and 7 s."""
    samples = SimpleNamespace(to_dataframe=lambda: TABLE, time=TABLE["time [s]"].to_numpy())
    monkeypatch.setattr(Trial, "samples", lambda self: samples)
    found = [Event("placed", time, "found") for time in (1.0, 4.0, 7.0)]
    monkeypatch.setattr(Trial, "events", lambda self: found)
    return Trial(tmp_path)


def part(start: float, end: float) -> Segment:
    return Segment("span", start, end, slice(int(start), int(end) + 1))


def test_cycles_are_refused_with_these_lines(walked: Trial) -> None:
    assert line(lambda: st.cycles(walked, TABLE, segment=part(2.0, 6.0))) == (
        "no cycle by 'placed' lies within 2.00 s to 6.00 s: the trial has 2: give the segment"
        " 'all', or see 'info'"
    )
    assert line(lambda: st.cycles(walked, TABLE[["load [N]"]])) == (
        "the table has no column 'time [s]', or no rows: give one with a row per sample, such as"
        " trial.samples().to_dataframe()"
    )
    assert line(lambda: st.cycles(walked, TABLE[["time [s]"]])) == (
        "no quantity is given: name one, such as Fz"
    )
    assert line(lambda: st.cycles(walked, "laod")) == (
        "the trial has no channel 'laod': did you mean 'load'?"
    )


@pytest.mark.parametrize(
    ("pause", "left_out"), [(3.0, 0), (3.5, 1)], ids=["twice as long", "longer"]
)
def test_a_cycle_beyond_two_medians_is_left_out(
    pause: float, left_out: int, walked: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two cycles of 1.5 s and one more: the median is 1.5 s."""
    times = (0.0, 1.5, 3.0, 3.0 + pause)
    monkeypatch.setattr(
        Trial, "events", lambda self: [Event("placed", at, "found") for at in times]
    )
    found = st.cycles(walked, TABLE, segment=part(0.0, 8.0))
    assert (len(found), found.left_out) == (3 - left_out, left_out)


def test_numbers_without_a_mean_are_not_averaged(walked: Trial) -> None:
    """Directions, states and stamps."""
    left_out = ("Fz direction [deg]", "distal.status [-]", "stamp [ns]")
    table = TABLE.assign(**dict.fromkeys((*left_out, "engaged [1]"), 3.0))
    found = st.cycles(walked, table, segment=part(0.0, 8.0))
    assert found.titles == ("load [N]", "engaged [1]")
    assert list(found.to_dataframe())[-1] == "engaged n [-]"


def test_few_samples_of_a_cycle_are_noted(walked: Trial) -> None:
    notes: list[str] = []
    found = st.cycles(replace(walked, notify=notes.append), TABLE, segment=part(0.0, 8.0))
    assert found.spans.tolist() == [[1.0, 4.0], [4.0, 7.0]]
    assert notes == [
        "a cycle by 'placed' has 3 samples: the course between them is interpolated, record at a"
        " higher rate"
    ]


def test_cycles_are_drawn_by_these_rules(walked: Trial) -> None:
    """Of twelve quantities at most."""
    titles = tuple(f"q{k} [N]" for k in range(13))
    found = Cycles(walked, "placed", np.zeros((3, 2)), 0, titles, np.zeros((3, 101, 13)))
    assert line(found.figure) == (
        "a figure of 13 quantities: name 12 at most, such as st.cycles(trial, ['Fz', 'Mx'])"
    )
    axes = Figure().subplots()
    assert line(lambda: found.draw(ax=axes)) == (
        "axes show one of these 13 quantities: name one, such as st.cycles(trial, 'Fz')"
    )


# --- calibrate and tile


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    """A calibration of the scene's clusters."""
    from socket_testbed.calibration.model import write_calibration

    path = tmp_path / "calibration.yaml"
    write_calibration(scene.calibration(), path)
    return path


def test_a_calibration_is_refused_with_these_lines(calibration: Path, tmp_path: Path) -> None:
    bench = tmp_path / "bench.csv"

    def called(cluster: str = "distal", **given: Any) -> str:
        return line(lambda: st.calibrate(bench, cluster, **given))

    assert called(baseline=["a", "b", "c"]) == (
        "--baseline: 3 files: give one before and at most one after"
    )
    assert called(wiring=[0, 1, 2, 2]) == ("--wiring is [0, 1, 2, 2]: give each of 0, 1, 2, 3 once")
    assert called("distall", into=calibration) == (
        "--cluster is 'distall', which the calibration does not hold: did you mean 'distal'? For a"
        " new cluster choose a name less like it"
    )
    write_socket(scene.geometry(), tmp_path / "socket.yaml")
    assert called("dista", geometry=tmp_path / "socket.yaml") == (
        f"{tmp_path}/socket.yaml: has no cluster 'dista': did you mean 'distal'?"
    )


def test_equal_readings_of_two_clusters_are_noted() -> None:
    found = CalibratedCluster.__new__(CalibratedCluster)
    known = scene.calibration()
    own = known.clusters["distal"]
    others = {name: replace(own) for name in ("heel", "distal", "brim")}
    others["mid"] = replace(own, normal=own.normal * 1.01)
    made = {"name": "distal", "quality": SimpleNamespace(cluster=own)}
    vars(found).update(made, existing=replace(known, clusters=others))
    assert found.notes() == [
        "distal has the same bench readings as heel, brim: calibrate every cluster on a bench run"
        " of its own"
    ]
    vars(found).update(existing=replace(known, clusters={"mid": others["mid"]}))
    assert found.notes() == []


def test_a_registration_is_not_tiled_over(tmp_path: Path) -> None:
    path = tmp_path / "socket.yaml"
    write_socket(replace(scene.geometry(), registration="take.csv"), path)
    assert line(lambda: st.tile("none.stl", path)) == (
        f"{path} holds registered marker bodies (take.csv): keep them with --bodies {path}, or"
        " name another output"
    )
    design._check_socket_output(path, path)
    assert line(lambda: st.tile("none.stl", tmp_path / "socket.json")) == (
        f"{tmp_path}/socket.json: '.json' is not the format of a socket: name a .yaml or .yml file"
    )
    assert line(lambda: st.tile("none.stl", keep_out=["antreior"])).startswith(
        "--keep-out: there is no region or tile 'antreior': did you mean 'anterior"
    )


# --- export, validate and others

EXPORTS: dict[str, tuple[str, dict[str, Any], str]] = {
    "gait": (
        *("a.c3d", {"pressure": True}),
        "a.c3d: a .c3d holds only measured forces and markers: give .csv, .parquet or .mat for"
        " computed columns",
    ),
    "bag": (
        *("a.mcap", {"cycles": "placed"}),
        "a.mcap: a bag holds samples: give .csv for cycles",
    ),
    "suffix": (
        *("a.xls", {}),
        "a.xls: '.xls' is not the format of a trial's export: name a .csv, .parquet, .mat, .mot,"
        " .sto, .trc, .c3d or .mcap file",
    ),
    "no suffix": (
        *("table", {"cycles": "placed"}),
        "table: a name without a suffix is not the format of a trial's export: name a .csv,"
        " .parquet, .mat, .mot, .sto, .trc, .c3d or .mcap file",
    ),
    "point": (
        *("a.csv", {"about": [0.0, 2.1, 0.0]}),
        "about is [0.0, 2.1, 0.0]: give three numbers [m], from -2 to 2",
    ),
    "two numbers": (
        *("a.csv", {"about": [0.0, 1.0]}),
        "about is [0.0, 1.0]: give three numbers [m], from -2 to 2",
    ),
}


@pytest.mark.parametrize("case", EXPORTS)
def test_an_export_is_refused_with_this_line(case: str, tmp_path: Path) -> None:
    name, options, expected = EXPORTS[case]
    assert line(lambda: st.export(Trial(tmp_path), Path(name), **options)) == expected


OTHERS = {
    "no trial": (
        lambda: validation._recordings([], "all", SettingsOptions(), None),
        "no trial to validate on: give one or more trials",
    ),
    "no figure": (
        lambda: result.Result._figure(SimpleNamespace(), None),  # type: ignore[arg-type]
        "SimpleNamespace has no figure: plot its table: see to_dataframe()",
    ),
    "no panel": (
        lambda: result.Result._draw_into(SimpleNamespace(), None, (None, None)),  # type: ignore[arg-type]
        "SimpleNamespace has no single panel to draw: leave ax: see figure()",
    ),
    "duration": (
        lambda: st.simulate("nowhere", duration=0.5),
        "--duration is 0.5: give a number from 1 to 36000",
    ),
    "rate": (
        lambda: st.simulate("nowhere", rate=1001.0),
        "--rate is 1001.0: give a number from 0.1 to 1000",
    ),
    "triggers": (
        lambda: st.simulate("nowhere", duration=36000, rate=1000),
        "--duration times --rate is 36000000: give a number from 2 to 1e+06",
    ),
    "share of a donning": (
        lambda: st.simulate("nowhere", donning=1, donning_share=1.1),
        "--donning-share is 1.1: give a number from 0 to 1",
    ),
    "share without a donning": (
        lambda: st.simulate("nowhere", donning_share=0.5),
        "--donning-share is 0.5, but no donning is given: add --donning SEED: the nominal donning"
        " does not vary",
    ),
    "area": (
        lambda: st.calibrate("bench.csv", "distal", area=0.06),
        "--area is 0.06: give a number from 1e-08 to 0.05",
    ),
    "places": (
        lambda: st.tile("scan.stl", place=1001),
        "--place is 1001: give a whole number from 0 to 1000",
    ),
    "height": (
        lambda: st.tile("scan.stl", height=-2.1),
        "--height is -2.1: give a number from -2 to 2",
    ),
}


@pytest.mark.parametrize("case", OTHERS)
def test_a_call_is_refused_with_this_line(case: str) -> None:
    call, expected = OTHERS[case]
    assert line(call) == expected


@pytest.mark.parametrize("several", [True, False], ids=["several", "alone"])
def test_of_several_trials_one_is_passed_over(several: bool, tmp_path: Path) -> None:
    notes: list[str] = []
    trial = Trial(tmp_path, notify=notes.append)
    if not several:
        with pytest.raises(TrialError), validating.pass_over_failed("s01", trial, several):
            raise TrialError("no wrench", "record it")
        return
    with validating.pass_over_failed("s01", trial, several):
        raise TrialError("no wrench", "record it")
    assert notes == ["s01: passed over: no wrench: record it"]


def test_another_socket_s_trial_is_named(tmp_path: Path) -> None:
    geometry = scene.geometry()
    found = [Trial(tmp_path / name) for name in "ab"]
    for trial, own in zip(
        found, (geometry, replace(geometry, names=geometry.names[::-1])), strict=True
    ):
        vars(trial)["geometry"] = own
    assert line(lambda: trials.require_one_socket(found, "split them")) == (
        f"{tmp_path}/b is of another socket (12 tiles) than {tmp_path}/a (12 tiles): split them"
    )
