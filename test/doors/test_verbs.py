"""What verbs print and accept beside their tables: numbers, progress, status, faults, the demo."""

import functools
import io
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.layout_engine import ConstrainedLayoutEngine
from support import results_by_hand, scene
from support.clocks import FakeClock

from socket_testbed import api
from socket_testbed.__main__ import run
from socket_testbed.commands import demo, live, pages, running, terminal, trials
from socket_testbed.commands.calls import BatchOptions, Evaluate, Report, SimulatedOptions
from socket_testbed.commands.terminal import Progress, decimals, fitted, status_parts, table
from socket_testbed.errors import ConfigurationError
from socket_testbed.identification.channel_errors import ChannelErrors, evaluate
from socket_testbed.identification.fit import predictions
from socket_testbed.live.graph_status import GraphStatus
from socket_testbed.settings.options import option
from socket_testbed.simulation.testbed import Simulation
from socket_testbed.trials.metadata import TrialMetadata
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial
from socket_testbed.wire import topics


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> FakeClock:
    """The time of the terminal."""
    found = FakeClock(100.0)
    monkeypatch.setattr(terminal, "time", SimpleNamespace(monotonic=found))
    return found


def printed(*words: object) -> list[str]:
    """What a verb prints, with runs of blanks as one."""
    out = io.StringIO()
    with redirect_stdout(out), redirect_stderr(io.StringIO()):
        assert run([str(word) for word in words]) == 0
    return [" ".join(line.split()) for line in out.getvalue().splitlines()]


# --- tables and numbers


def test_numbers_of_a_table_are_right_aligned() -> None:
    """A column with a single word is text."""
    rows = [["a", "-1.5", "1", ""], ["bcd", "10", "x 1", "2"], ["e", "-", "", "33"]]
    assert table(["name", "size", "mixed", "n"], rows).splitlines() == [
        "name  size  mixed   n",
        "----  ----  -----  --",
        "a     -1.5  1",
        "bcd     10  x 1     2",
        "e        -         33",
    ]


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (1.23456, 3, "1.235"),
        (-0.0001, 2, "0.00"),
        (2.5, 0, "2"),
        (np.nan, 1, "-"),
        (-7.0, 1, "-7.0"),
    ],
)
def test_numbers_have_fixed_decimals(value: float, digits: int, text: str) -> None:
    assert decimals(value, digits) == text


# --- progress


def test_progress_without_a_terminal_is_rare(
    clock: FakeClock, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every ten seconds; the end only if something was shown."""
    progress = Progress("tiling")
    for now, done in ((109.9, 1), (110.1, 2), (115.0, 3), (120.2, 6), (121.0, 8)):
        clock.now = now
        progress(done, 8)
    assert capsys.readouterr().err == "tiling: 25 %\ntiling: 75 %\ntiling: 100 %\n"
    Progress("fast")(8, 8)
    assert capsys.readouterr().err == ""


def test_progress_in_a_terminal_is_one_line(
    clock: FakeClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twice a second."""
    stream = io.StringIO()
    monkeypatch.setattr(stream, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stderr", stream)
    progress = Progress("tiling")
    for now, done in ((100.4, 1), (100.6, 2), (101.0, 3), (101.2, 4)):
        clock.now = now
        progress(done, 4)
    assert stream.getvalue() == "\rtiling: 50 %\rtiling: 100 %\n"


# --- the status


def status(triggers: int = 31, heard: float = 99.0) -> GraphStatus:
    """31 triggers over 3 s, of which two are complete."""
    found = GraphStatus()
    found._first, found._last = 10**18, 10**18 + 3 * 10**9
    found.triggers, found.complete, found.heard = triggers, 2, heard
    return found


def test_a_status_is_in_its_units(clock: FakeClock) -> None:
    own = status()
    own.trial, own.variant = "s01", "rigid_bias"
    own.wrench = np.array([0.12, -3.46, 1.0, 10.4, -20.6, -600.0])
    own._measured = {10**18: own.wrench}
    own.add(topics.ESTIMATED_WRENCH, 10**18, own.wrench + np.array([0.3, 0.4, 0, 6, 0, 8]))
    assert status_parts(own, 3723.0) == [
        "0:00:03 of 1:02:03",
        "31 triggers, 2 complete",
        "recording s01",
        "F 10 -21 -600 N",
        "M 0.1 -3.5 1.0 N m",
        # sqrt(100 / 3) N, sqrt(0.25 / 3) N m
        "rigid_bias off by 5.8 N, 0.29 N m",
    ]


@pytest.mark.parametrize(
    ("triggers", "heard", "silent"),
    [(31, 95.1, False), (31, 94.9, True), (2, 91.5, False), (2, 90.9, True)],
    ids=["4.9 s", "5.1 s", "slow 8.5 s", "slow 9.1 s"],
)
def test_a_silent_trigger_is_noted(
    triggers: int, heard: float, silent: bool, clock: FakeClock
) -> None:
    """After 5 s, or three periods: 2 triggers in 3 s have a period of 3 s."""
    parts = status_parts(status(triggers, heard))
    assert (f"no trigger for {100.0 - heard:.0f} s" in parts) is silent


def test_free_space_is_in_gigabytes(
    clock: FakeClock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = SimpleNamespace(free=12_340_000_000, used=1, total=2)
    monkeypatch.setattr(terminal.shutil, "disk_usage", lambda folder: usage)
    assert status_parts(status(), disk=tmp_path)[2:] == ["12.3 GB free"]


@pytest.mark.parametrize(
    ("columns", "line"), [(12, "abc | defgh"), (11, "abc"), (6, "abc"), (3, "ab"), (0, "")]
)
def test_a_line_leaves_the_last_column_free(columns: int, line: str) -> None:
    assert fitted(["abc", "defgh"], columns) == line


# --- faults and simulated hardware


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("mocap.drop=0.25", 0.25),
        ("mocap.drop=1", 1.0),
        ("limb.out=-1", -1.0),
        ("clock.step=-3600", -3600.0),
        ("trigger.late=0.5", 0.5),
        ("mocap.restart=3", 3.0),
    ],
)
def test_a_fault_has_its_value(word: str, value: float) -> None:
    assert live._fault(word) == (word.partition("=")[0], value)


@pytest.mark.parametrize(
    "word",
    ["mocap.drop=1.1", "trigger.late=-1", "limb.out=-2", "clock.step=-1e7", "clock.step=1e7",
     "mocap.drop=much", "mocap.drop", "mocap.drop=", "=1", "limb.out=0", "limb.out=1.5",
     "limb.out=-0.5", "clusters.nack=0", "clusters.rail=-1", "clusters.shifted=2.5",
     "load_cell.rail=0", "mocap.occlude=0.5", "clusters.nack=nan"],
)  # fmt: skip
def test_a_wrong_fault_is_refused(word: str) -> None:
    with pytest.raises(ConfigurationError, match="--fault"):
        live._fault(word)


def test_simulated_hardware_is_as_stated() -> None:
    found, faults = live.simulated(
        SimulatedOptions(
            simulated=True,
            scenario="ramp",
            period=30.0,
            tissue="stiff",
            seed=4,
            fault=["limb.out=2"],
        )
    )
    assert found == Simulation("ramp", 30.0, 4, tissue="stiff") and faults == {"limb.out": 2.0}
    assert live.simulated(SimulatedOptions()) == (None, {})


@pytest.mark.parametrize(
    ("given", "option"),
    [
        ({"scenario": "ramp"}, "--scenario"),
        ({"period": 30.0}, "--period"),
        ({"seed": 1}, "--seed"),
        ({"tissue": "stiff"}, "--tissue"),
        ({"donning": 2}, "--donning"),
        ({"donning_share": 0.2}, "--donning-share"),
        ({"simulated": True, "donning_share": 0.2}, "--donning-share"),
        ({"simulated": True, "donning": -1}, "--donning"),
        ({"simulated": True, "donning": 1, "donning_share": 1.1}, "--donning-share"),
        ({"fault": ["limb.out=1"]}, "--fault"),
        ({"simulated": True, "period": 4.9}, "--period"),
        ({"simulated": True, "period": 3601.0}, "--period"),
        ({"simulated": True, "seed": -1}, "--seed"),
    ],
)
def test_options_of_simulated_hardware_are_checked(given: dict[str, Any], option: str) -> None:
    with pytest.raises(ConfigurationError, match=f"{option} is"):
        live.simulated(SimulatedOptions(**given))


@pytest.mark.parametrize(
    ("fault", "refused"),
    [
        ({"clusters.nack": 4.0}, False),
        ({"clusters.nack": 5.0}, True),
        ({"limb.out": 5.0}, True),
        ({"limb.out": -1.0}, False),
        ({"mocap.occlude": 5.0}, False),
    ],
)
def test_a_fault_of_a_missing_cluster_is_refused(fault: dict[str, float], refused: bool) -> None:
    settings = SimpleNamespace(cluster_names=("a", "b", "c", "d"))
    testbed: Any = SimpleNamespace(settings=settings)
    if not refused:
        live._check_faults(fault, testbed)
        return
    with pytest.raises(ConfigurationError, match="there is no such cluster") as found:
        live._check_faults(fault, testbed)
    assert "give 1 to 4" in found.value.hint


@pytest.mark.parametrize(
    ("request_", "number"), [("press on b", 2), ("press on a", 1), ("let go", -1)]
)
def test_a_simulated_thumb_presses_what_is_asked(
    request_: str, number: int, capsys: pytest.CaptureFixture[str]
) -> None:
    switched: list[Any] = []
    world: Any = SimpleNamespace(faults=SimpleNamespace(switch=lambda *on: switched.append(on)))
    live._ask(world, ("a", "b"), request_)
    assert switched == [("limb.out", number)] and capsys.readouterr().err == f"{request_}\n"


@pytest.mark.parametrize(
    ("scale", "text"),
    [(1.0, ""), (0.5, "the simulated testbed runs at half of real time\n"), (0.0, "")],
)
def test_a_slower_testbed_is_noted(
    scale: float, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert live._time_scale(scale) == scale
    assert capsys.readouterr().err == text


# --- options of several verbs


def test_a_summary_has_the_segment_s_columns() -> None:
    found = running.segment_columns(41, Segment("span", 10.0, 20.0, slice(40, 81)))
    assert found == {
        "samples": 41, "segment": "span", "segment_start [s]": 10.0, "segment_end [s]": 20.0
    }  # fmt: skip


def test_an_option_has_name_and_value() -> None:
    assert running.name_and_value("a=b=c", "--x", "y=z") == ("a", "b=c")


@pytest.mark.parametrize("word", ["a", "a=", "=b"], ids=["name", "no value", "no name"])
def test_half_an_option_is_refused(word: str) -> None:
    with pytest.raises(ConfigurationError) as found:
        running.name_and_value(word, "--x", "y=z")
    assert found.value.fact == f"--x: '{word}' is not NAME=VALUE"
    assert found.value.hint == "write it as y=z"


def test_options_left_as_they_are_pass() -> None:
    running.refuse_given({"model": None, "tare": "recorded"}, "x", "y")


@pytest.mark.parametrize(
    ("name", "value", "shown"),
    [("tare", "none", "--tare"), ("view_port", 0, "--view-port")],
    ids=["text", "zero"],
)
def test_given_options_are_refused(name: str, value: object, shown: str) -> None:
    with pytest.raises(ConfigurationError, match=f"{shown} is for x"):
        running.refuse_given({name: value}, "x", "y")


# --- simulate, info, annotate


def test_events_are_cut_after_eight(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = [SimpleNamespace(label="step", source="marked", time=float(k)) for k in range(9)]
    placed = SimpleNamespace(label="placed", source="found", time=6.678)
    trial: Any = SimpleNamespace(events=lambda: [*steps[:8], placed])
    assert trials._events(trial).splitlines() == [
        "event step (marked): 0.00, 1.00, 2.00, 3.00, 4.00, 5.00, 6.00, 7.00 s",
        "event placed (found): 6.68 s",
    ]
    trial = SimpleNamespace(events=lambda: steps)
    assert trials._events(trial).endswith("6.00, 7.00 s ... (9 times)")
    assert trials._events(SimpleNamespace(events=list)) == "no events"  # type: ignore[arg-type]


def test_metadata_is_listed_with_units() -> None:
    found = trials._metadata(TrialMetadata(subject="S01", mass=61.2)).splitlines()
    assert [line.split() for line in found[:4:3]] == [["metadata", "value"], ["mass", "61.2", "kg"]]
    assert "side" in found[-1]  # which is not stated
    assert trials._metadata(TrialMetadata()).startswith("no metadata: ")
    assert "\n" not in trials._metadata(TrialMetadata(side="left")).splitlines()[-1]


# --- fit


def known_fit(samples: Any, geometry: Any, settings: Any) -> Any:
    """Stands for `fit_contact_model`; the errors are those of the model."""
    found = results_by_hand.fit_by_hand(samples, geometry, settings)
    judged = evaluate(samples, predictions(samples, found.model, 0.0), settings.leave_out)
    return replace(found, errors=judged, wrench="constants")


@pytest.fixture(scope="module")
def fit_lines(
    scene_folder: Path, by_hand: None, tmp_path_factory: pytest.TempPathFactory
) -> list[str]:
    """What `fit` prints of a model by hand: see `support.results_by_hand`."""
    output = tmp_path_factory.mktemp("fit") / "model.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("socket_testbed.results.models.fit_contact_model", known_fit)
        words = ["fit", scene_folder, "-o", output, "--segment", "all", "--variant", "stiffness"]
        return printed(*words)


@pytest.mark.parametrize(
    "line",
    [
        "scene: all 0.00 s to 23.75 s, 96 of 96 samples",
        "variant stiffness, theta 0.5, weights by size; in 20 of 36 stiffness directions the data"
        " outweigh the smoothness",
        "the wrench is predicted by constants",
        "Fx N 15.684 14.000 7.071 -1.22",  # 14 + 10 sin N, and none is predicted
        "Fz N 47.730 45.000 15.910 -1.25",  # 45 of 60 F N are missing
    ],
    ids=["samples", "settings", "wrench", "Fx", "Fz"],
)
def test_fit_prints_what_is_known(line: str, fit_lines: list[str]) -> None:
    assert line in fit_lines
    assert not any("not unique" in each for each in fit_lines)


# --- the demo

JUDGED = pd.DataFrame(
    [
        # question, test, predictor, error, moment and force RMSE
        ("tiles", "second half", "force map", 0.25, np.nan, np.nan),
        ("tiles", "second half", "inverse distance, wrench met", 0.5, np.nan, np.nan),
        ("cluster", "left out", "force map", 0.75, np.nan, np.nan),
        ("cluster", "left out", "inverse distance, wrench met", 0.5, np.nan, np.nan),
        ("wrench", "in-sample", "rigid_bias", np.nan, 0.01, 0.1),
        ("wrench", "second half", "rigid_bias", np.nan, 0.5, 12.34),
        ("wrench", "second half", "regression", np.nan, 0.75, 8.0),
    ],
    columns=["question", "test", "predictor", "error [-]", "moment RMSE [N m]", "force RMSE [N]"],
).set_index(["question", "test", "predictor"])


def test_the_demo_s_table_marks_the_best(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "REGRESSION", "regression")
    monkeypatch.setattr(demo, "_ESTIMATES", (*demo._ESTIMATES[:3], "regression"))
    found: Any = SimpleNamespace(summary=lambda: JUDGED)
    lines = [" ".join(line.split()) for line in demo._error_table(found).splitlines()]
    assert lines[0] == "estimate tiles without sensor left-out clusters M [N m] F [N]"
    assert lines[2:6] == [
        "force map 0.25* 0.75 - -",
        "inverse distance, wrench met 0.50 0.50* - -",
        "rigid_bias - - 0.50* 12.3",
        "regression - - 0.75 8.0*",
    ]


@pytest.fixture(scope="module")
def conclusion() -> demo._Conclusion:
    """The scene's pressures, estimated exactly but on `post_prox`, which comes out 3 kPa too low.

    So 7 of the 8 tiles without a cluster are within +-1.96 kPa.
    """
    made = demo._Conclusion.__new__(demo._Conclusion)
    made._geometry = scene.geometry()
    truth = np.array([own[0] for own in scene.STRESS.values()])
    made._truth, made._estimate = truth, truth.copy()
    made._estimate[scene.TILES.index("post_prox")] -= 3.0
    made._error, made._reach = made._estimate - truth, np.full(12, 1.96)
    made._names = ["brim_lateral", "mid_anterior", "distal"]
    made._left_out = np.array([[30.0, 28.0, 5.0], [40.0, 39.0, 4.0], [14.0, 20.0, 3.0]])
    wrench = np.tile([0.0, 0.0, 0.0, 30.0, 0.0, -40.0], (3, 1))
    made._hold = SimpleNamespace(wrench=wrench)  # type: ignore[assignment]
    return made


def test_the_demo_compares_means_over_the_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two samples with half and 1.5 times the forces; the live map is 3 kPa too high."""
    given: Any = SimpleNamespace(
        geometry=scene.geometry(), select=lambda *_: SimpleNamespace(rows=slice(0, 49, 48))
    )
    local = scene.forces_in_tiles(scene.STAMPS)
    truth: Any = SimpleNamespace(
        forces=np.einsum("nij,knj->kni", scene.geometry().rotations, local)
    )
    pressures = 1e3 * scene.FACTOR[:, None] * [own[0] for own in scene.STRESS.values()]
    live = np.stack([pressures + 3e3, np.full_like(pressures, 1e3)])
    judged = ("distal", np.array([13e3, 15e3]), np.array([20e3, 21e3]), np.array([2e3, 2e3]))
    monkeypatch.setattr(demo, "left_out_pressures", lambda *_: iter([judged]))
    samples: Any = np.arange(len(scene.TIME))
    found = demo._Conclusion(given, samples, truth, live)
    tile = scene.TILES.index("ant_mid")
    assert (found._truth[tile], found._estimate[tile]) == pytest.approx((40.0, 43.0))
    assert found._error == pytest.approx([3.0] * 12)
    assert found._reach == pytest.approx([1.96] * 12, rel=1e-4)
    assert found._left_out == pytest.approx(np.array([[14.0, 20.5, 3.92]]), abs=1e-3)


def test_the_demo_concludes_in_kilopascals(conclusion: demo._Conclusion) -> None:
    """The highest estimate between the clusters is the 17 kPa on `post_prox`, before 16 kPa."""
    assert conclusion.sentences()[:4] == [
        "Highest pressure measured over the hold, under 50 N: cluster mid_anterior, 40.0 kPa.",
        "Highest between the clusters: posterior proximal, 17.0 kPa (95 %: 15.0 to 19.0), 20.0 in"
        " truth; 88 % of the 95 % intervals contain the truth.",
        "Largest error: posterior proximal, 17.0 kPa (95 %: 15.0 to 19.0), 20.0 in truth.",
        "Largest error without its cluster: distal, 20.0 kPa (95 %: 17.0 to 23.0), 14.0 measured.",
    ]


def test_the_demo_draws_map_truth_and_error(
    conclusion: demo._Conclusion, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the fixed scale to 50 kPa, and +-3 kPa, the largest error."""
    monkeypatch.setattr(ConstrainedLayoutEngine, "execute", lambda *_: None)
    figure = conclusion.draw()
    bars = [axis.get_ylim() for axis in figure.axes if axis.get_ylabel() == "normal pressure [kPa]"]
    assert bars == [(0.0, 50.0), (0.0, 50.0), (-3.0, 3.0)]
    (left_out,) = [axis for axis in figure.axes if axis.get_xlabel() == "normal pressure [kPa]"]
    assert [label.get_text().strip() for label in left_out.get_yticklabels()] == conclusion._names
    measured = next(line for line in left_out.lines if line.get_label() == "measured")
    assert measured.get_xdata().tolist() == [30.0, 40.0, 14.0]
    (errors,) = left_out.containers
    line, _, bars_of = errors.lines
    assert line.get_xdata().tolist() == [28.0, 39.0, 20.0]
    ends = [segment[:, 0].tolist() for segment in bars_of[0].get_segments()]
    assert ends == [[23.0, 33.0], [35.0, 43.0], [17.0, 23.0]]
    assert left_out.get_ylim() == (2.5, -0.5)


@pytest.mark.parametrize(
    ("complete", "count", "share"), [(270, 540, 0.5), (600, 600, 1.0), (540, 540, 1.0)]
)
def test_the_demo_expects_54_seconds(
    complete: int, count: int, share: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """At 10 Hz, of 60 s without 6 s to start."""

    class Samples:
        def __init__(self) -> None:
            self.complete = np.arange(count) < complete

        def __len__(self) -> int:
            return count

    monkeypatch.setattr(Trial, "samples", lambda self: Samples())
    assert demo._complete(Trial(tmp_path)) == share


# --- compare and report


def test_compare_by_region_prints_three_outputs(
    scene_folder: Path, by_hand: None, tmp_path: Path
) -> None:
    second = scene.write(tmp_path / "later" / "second", second=True)
    lines = printed("compare", scene_folder, second, "--segment", "all", "--by-region")
    for title in ("mean pressure [kPa]", "peak pressure [kPa]", "share of load [%]"):
        assert any(title in line for line in lines), title
    assert not any("ant_mid" in line for line in lines)
    row = "anterior 23.7 (21.7 to 25.6) 29.6 (27.6 to 31.5) +5.9 (4.4 to 7.4) *"
    assert row in lines


def errors(skill: float) -> tuple[ChannelErrors, ...]:
    names = ("Mx", "My", "Mz", "Fx", "Fy", "Fz", "distal.Fz")
    return tuple(
        ChannelErrors(name, "N m" if name[0] == "M" else "N", 2.0, 1.5, 1.0, skill, 9, True)
        for name in names
    )


def test_a_report_s_row_judges_both_halves() -> None:
    """Skills in the sample and on the other half, and complete samples of the segment."""
    candidates = {"rigid": SimpleNamespace(errors=errors(0.75), held_out=errors(0.25))}
    complete = np.array([True, False, True])

    class Samples:
        def __getitem__(self, rows: slice) -> Any:
            return SimpleNamespace(has_pose_and_wrench=complete[rows])

    segment = Segment("all", 0.0, 1.0, slice(0, 2))
    results: Any = SimpleNamespace(samples=Samples(), segment=segment, fitted=candidates)
    row = pages._report_row(results)
    assert row["samples"] == 1 and row["segment_end [s]"] == 1.0
    assert row["rigid median_wrench_skill_in_sample [-]"] == 0.75
    assert row["rigid median_wrench_skill_held_out [-]"] == 0.25
    assert row["rigid Fz_rmse [N]"] == 2.0 and row["rigid Fz_mae [N]"] == 1.5


@pytest.mark.parametrize(
    ("alone", "replace", "replaced"),
    [(True, False, False), (True, True, True), (False, False, True)],
    ids=["alone", "replacing", "of a folder"],
)
def test_a_report_of_many_replaces_and_is_silent(
    alone: bool, replace: bool, replaced: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The batch itself decides what is repeated."""
    made: dict[str, Any] = {}

    @functools.wraps(api.write_report)
    def write_report(trial: Any, page: Path, **chosen: Any) -> None:
        made.update(chosen, page=page)

    monkeypatch.setattr(api, "write_report", write_report)
    trial: Any = None
    given = Report(
        Path("s01"), alone=alone, replace=replace, output=Path("a.html"), thetas=7, jobs=2
    )
    pages._report(trial, given)
    assert "jobs" not in made and made.items() >= {
        "page": Path("a.html"), "thetas": 7, "replace": replaced,
        "progress": Progress if alone else None,
    }.items()  # fmt: skip


# --- a folder of trials


@pytest.fixture
def batch(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[tuple[Any, ...]]:
    """What is asked of a batch of two trials, instead of running it."""
    asked: list[tuple[Any, ...]] = []
    found = {"a": tmp_path / "a", "b": tmp_path / "b"}
    monkeypatch.setattr(running, "find_trials", lambda folder, note: found)
    monkeypatch.setattr(running, "run_batch", lambda *given: asked.append(given))
    monkeypatch.setattr(running, "plan_jobs", lambda *given: given)
    return asked


@dataclass(frozen=True, kw_only=True)
class Judge(BatchOptions):
    """Options of a verb that judges trials."""

    threshold: float = option(0.5, "threshold [-]")
    params: Path | None = option(None, "settings")
    json: bool = option(False, "print JSON")
    figure: Path | None = option(None, "draw it")


VERB: Any = running.TrialVerb("judge", ".judged.csv", None, None, None, ("side",))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("again", "replace"), [(True, False), (False, True)], ids=["again", "replace"]
)
def test_a_batch_is_done_as_stated(
    again: bool, replace: bool, batch: list[Any], tmp_path: Path
) -> None:
    """Outputs depend on settings and stated metadata, not on files or options of the output."""
    call = Judge(
        tmp_path, output=tmp_path / "out", jobs=2, again=again, replace=replace, threshold=0.25
    )
    running.on_trials(VERB, call)
    ((task, (opened, output, suffix, files), _, _, jobs, dask),) = batch
    assert (task.verb, task.folder) == ("judge", tmp_path / "out")
    assert (task.again, task.replace) == (again, replace)
    usual = {"tare": "recorded", "unloaded": ()}
    assert task.settings == usual | {"threshold": 0.25} and task.metadata == ("side", "mass")
    assert [*opened] == ["a", "b"] and opened["b"].path == tmp_path / "b"
    assert (output, suffix, files) == (tmp_path / "out", ".judged.csv", {})
    assert (jobs, dask) == (2, None)


@pytest.mark.parametrize(
    "choices",
    [{}, {"output": "out", "json": True}, {"output": "out", "figure": "a.png"},
     {"output": "out", "jobs": 0}],
    ids=["no output", "JSON", "figure", "no job"],
)  # fmt: skip
def test_a_folder_has_a_folder_of_outputs(
    choices: dict[str, Any], batch: list[Any], tmp_path: Path
) -> None:
    with pytest.raises(ConfigurationError):
        running.on_trials(VERB, Judge(tmp_path, **_paths(choices)))
    assert not batch


def _paths(choices: dict[str, Any]) -> dict[str, Any]:
    return {
        name: Path(value) if isinstance(value, str) else value for name, value in choices.items()
    }


@pytest.mark.parametrize("option", ["jobs", "dask", "again"])
def test_a_trial_has_no_options_of_folders(
    option: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(running, "find_trials", lambda folder, note: {})
    value: dict[str, Any] = {"jobs": 2, "dask": "tcp://a:1", "again": True}
    with pytest.raises(ConfigurationError, match=f"--{option} is for a folder of trials"):
        running.on_trials(VERB, Judge(tmp_path, **{option: value[option]}))


def test_an_evaluation_s_check_ignores_what_the_fit_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    models: Any = {Path("m.json"): SimpleNamespace(settings=SimpleNamespace(leave_out=("Mz",)))}
    monkeypatch.setattr(running, "read_model", models.get)
    trial: Any = None
    assert running.left_out(trial, Evaluate(Path("a"), model=Path("m.json"))) == ("Mz",)


def test_a_job_s_row_begins_with_its_data(monkeypatch: pytest.MonkeyPatch) -> None:
    """The work and the check are given the files and the output of the job."""
    monkeypatch.setattr(running, "left_out", lambda trial, given: given.params)
    monkeypatch.setattr(running, "report_data", lambda trial, good, leave_out: leave_out)
    verb: Any = SimpleNamespace(
        work=lambda trial, given: (trial, given.output, given.params),
        row=lambda found: {"found": found},
    )
    job: Any = SimpleNamespace(trial="t", files={"params": "its"}, output="own")
    row = running._run_job(verb, Judge(Path("study"), output=Path("folder")), job)
    assert row == {"data": "its", "found": ("t", "own", "its")} and next(iter(row)) == "data"
