"""Whole lines that verbs print beside their numbers: refusals with their hints, endings, notes."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from socket_testbed import api
from socket_testbed.calibration.drift import Drift
from socket_testbed.calibration.fit import Outlier
from socket_testbed.commands import demo, design, live, mark, pages, results, running, trials
from socket_testbed.commands.arguments import Parser
from socket_testbed.commands.calls import Fit, Pressure, SimulatedOptions
from socket_testbed.commands.terminal import StatusLine
from socket_testbed.errors import ConfigurationError, TestbedError, TrialError
from socket_testbed.geometry.pose import Pose
from socket_testbed.identification.channel_errors import ChannelErrors
from socket_testbed.settings.options import MetadataOptions
from socket_testbed.trials.metadata import TrialMetadata

SCAN, OUT = Path("scan.stl"), Path("socket.yaml")
CLUSTERS: Any = SimpleNamespace(settings=SimpleNamespace(cluster_names=("a", "b", "c", "d")))
FILES = {"geometry": None, "calibration": None, "load_cell": None, "tare": "recorded"}
NO_TESTBED: Any = None
FOLDER: Any = None  # a verb that does not begin

REFUSALS: dict[str, tuple[Callable[[], Any], str]] = {
    "unknown fault": (
        lambda: live._fault("mocap.dorp=1"),
        "--fault mocap.dorp=1: unknown fault 'mocap.dorp': did you mean 'mocap.drop'?",
    ),
    "fault without a number": (
        lambda: live._fault("mocap.drop=much"),
        "--fault mocap.drop=much: 'much' is not a number: mocap.drop takes probability that a"
        " datagram is dropped [-]",
    ),
    "fault without a value": (
        lambda: live._fault("mocap.drop"),
        "--fault: 'mocap.drop' is not NAME=VALUE: write it as load_cell.flipped_bits=0.01",
    ),
    "limb out": (
        lambda: live._fault("limb.out=-2"),
        "--fault limb.out is -2.0: give a number from -1 to 1e+06",
    ),
    "probability": (
        lambda: live._fault("mocap.drop=1.5"),
        "--fault mocap.drop is 1.5: give a number from 0 to 1",
    ),
    "cluster that is missing": (
        lambda: live._check_faults({"clusters.nack": 5.0}, CLUSTERS),
        "--fault clusters.nack=5: there is no such cluster: give 1 to 4: clusters.nack takes"
        " number of the cluster, from 1, whose chip does not answer (EREMOTEIO)",
    ),
    "scenario": (
        lambda: live.simulated(SimulatedOptions(scenario="ramp")),
        "--scenario is for simulated hardware: add --simulated",
    ),
    "period": (
        lambda: live.simulated(SimulatedOptions(simulated=True, period=4.0)),
        "--period is 4.0: give a number from 5 to 3600",
    ),
    "time scale": (
        lambda: live.run(time_scale=0.5),
        "--time-scale is for simulated hardware: add --simulated",
    ),
    "duration of a run": (
        lambda: live.run(duration=0.05),
        "--duration is 0.05: give a number from 0.1 to 1e+06",
    ),
    "address of a page": (
        lambda: live._page(NO_TESTBED, False, "0.0.0.0", None),
        "--view-host is for a page: add --view",
    ),
    "port of a page": (
        lambda: live._page(NO_TESTBED, False, None, 8090),
        "--view-port is for a page: add --view",
    ),
    "quantity": (
        lambda: design._assignments(["normal=kPa", "force=N"], "--units"),
        "--units: no quantity 'force': use one of c0, c1, c2, c3, cycle, normal, shear_x, shear_y,"
        " time",
    ),
    "quantity given twice": (
        lambda: design._assignments(["normal=kPa", "normal=Pa"], "--units"),
        "--units: normal is given twice: give it once",
    ),
    "quantity without a unit": (
        lambda: design._assignments(["normal"], "--columns"),
        "--columns: 'normal' is not NAME=VALUE: write it as normal=kPa, after the bench files",
    ),
    "height": (
        lambda: design.tile(SCAN, output=OUT, height=1001.0),
        "--height is 1001.0: give a number from 0 to 1000",
    ),
    "size": (
        lambda: design.tile(SCAN, output=OUT, size=4.0),
        "--size is 4.0: give a number from 5 to 100",
    ),
    "flatness": (  # half an edge of 30 mm
        lambda: design.tile(SCAN, output=OUT, flatness=20.0),
        "--flatness is 20.0: give a number from 0.1 to 15",
    ),
    "rounds": (
        lambda: design.tile(SCAN, output=OUT, rounds=-1),
        "--rounds is -1: give a whole number from 0 to 100000",
    ),
    "limit": (
        lambda: design.calibrate([], output=OUT, cluster="a", limit=101.0),
        "--limit is 101.0: give a number from 0 to 100",
    ),
    "model as a table": (
        lambda: results.fit(Path("a"), output=Path("m.csv")),
        "m.csv: a model is not a .csv: name a .json",
    ),
    "table over time": (
        lambda: results.pressure(Path("a"), over_time=True, output=None),
        "--over-time has no output: name its table with -o FILE.csv",
    ),
    "duration of a page": (
        lambda: pages.view(duration=0.05),
        "--duration is 0.05: give a number from 0.1 to 1e+06",
    ),
    "namespace of a trial": (
        lambda: pages.view(Path("a"), namespace="left"),
        "--namespace is for the running testbed: leave out the trial",
    ),
    "buttons of a trial": (
        lambda: pages.view(Path("a"), buttons=True),
        "--buttons is for the running testbed: leave out the trial",
    ),
    "model of a testbed": (
        lambda: pages.view(model=Path("m.json"), **FILES),
        "--model is for a trial: give the folder of the trial",
    ),
    "load cell of a testbed": (
        lambda: pages.view(**FILES | {"load_cell": Path("t.yaml")}),
        "--load-cell is for a trial: give the folder of the trial",
    ),
    "condition": (
        lambda: pages._conditions(["gel"]),
        "--condition: 'gel' is not NAME=VALUE: write it as gel=trials/gel1,trials/gel2",
    ),
    "segment of any trial": (
        lambda: running.check_settings(Pressure(Path("nowhere"), segment="plateu")),
        "unknown segment 'plateu': did you mean 'plateau'? give plateau, hold, auto, all, T0:T1 in"
        " seconds, or event:A:B",
    ),
    "ends of any trial": (
        lambda: running.check_settings(Pressure(Path("nowhere"), segment="event:placed")),
        "the segment 'event:placed' does not have two ends: give event:A:B, such as"
        " event:placed+5:removed-2 or event:push#2:80",
    ),
    "threshold": (
        lambda: Pressure(Path("nowhere"), threshold=-1.0),
        "--threshold is -1.0: give a number from 0 to 500",
    ),
    "jobs of a trial": (
        lambda: running.on_trials(FOLDER, Pressure(Path("nowhere"), jobs=2)),
        "--jobs is for a folder of trials: leave it out",
    ),
    "repetition of a trial": (
        lambda: running.on_trials(FOLDER, Pressure(Path("nowhere"), again=True)),
        "--again is for a folder of trials: leave it out",
    ),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_a_wrong_option_has_this_line(case: str) -> None:
    call, line = REFUSALS[case]
    with pytest.raises(ConfigurationError) as found:
        call()
    assert str(found.value) == line


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--thetta", "0.5"], "unknown option --thetta: did you mean '--theta'?"),
        (["--xyz"], "unknown option --xyz: see 'verb --help'"),
        (["--theta", "0,5"], "argument --theta: invalid float value: '0,5': write decimals with"
         " a point"),
        (["--theta", "much"], "argument --theta: invalid float value: 'much': see 'verb --help'"),
        (["--side", "lfet"], "argument --side: invalid choice: 'lfet' (choose from 'left',"
         " 'right'): did you mean 'left'?"),
    ],
    ids=["misspelt", "unknown", "comma", "no number", "choice"],
)  # fmt: skip
def test_a_wrong_word_has_this_line(
    words: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    parser = Parser(prog="verb")
    parser.add_argument("--theta", type=float)
    parser.add_argument("--side", choices=("left", "right"))
    parser.words = words
    with pytest.raises(SystemExit) as ended:
        parser.parse_args(words)
    assert ended.value.code == 2
    assert capsys.readouterr().err == f"verb: error: {line}\n"


# --- a folder of trials, and trials that ended early


def test_a_folder_of_trials_needs_a_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(running, "find_trials", lambda folder, note: {"a": 1, "b": 2, "c": 3})
    with pytest.raises(ConfigurationError) as found:
        running.on_trials(FOLDER, Pressure(Path("study"), output=tmp_path, json=True))
    assert str(found.value) == (
        "study holds 3 trials: give -o FOLDER without --json and --figure, or one trial"
    )


def test_a_recording_that_ended_early_is_an_error(tmp_path: Path) -> None:
    def line(trial: Path) -> str:
        with pytest.raises(TrialError) as found:
            live._require_end(trial)
        return str(found.value)

    assert line(tmp_path / "none") == (
        f"{tmp_path}/none: the recording stopped early; the trial keeps the data so far: read the"
        " recorder's messages on the cause, such as a full or unplugged disk"
    )
    assert line(tmp_path) == (
        f"{tmp_path}: the recording stopped early; the trial keeps the data so far: read the"
        " recorder's messages on the cause, such as a full or unplugged disk"
    )
    (tmp_path / "metadata.yaml").touch()
    live._require_end(tmp_path)


@pytest.mark.parametrize(("keys", "press"), [(True, "press the space bar, or call "), (False, "")])
def test_a_paused_replay_says_how_to_go_on(
    keys: bool, press: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    status = StatusLine(pause="/left/replay/pause", paused=True)
    status._has_keys = keys
    monkeypatch.setattr("socket_testbed.commands.terminal.termios.tcgetattr", lambda number: [])
    monkeypatch.setattr("socket_testbed.commands.terminal.termios.tcsetattr", lambda *given: None)
    monkeypatch.setattr("socket_testbed.commands.terminal.tty.setcbreak", lambda number: None)
    with status:
        assert status._parts()[0] == ("paused: press the space bar" if keys else "0:00:00")
    assert capsys.readouterr().err == (
        f"paused; to continue: {press}ros2 service call /left/replay/pause std_srvs/srv/SetBool"
        " '{data: false}'\n"
    )


@pytest.mark.parametrize(
    ("trial", "subscribers", "line"),
    [
        ("s01", 1, "marked 'push' in the trial s01, acknowledged by 1 subscriber"),
        ("", 2, "marked 'push' for this graph, acknowledged by 2 subscribers"),
    ],
    ids=["recorded", "alone"],
)
def test_a_mark_says_who_has_it(
    trial: str,
    subscribers: int,
    line: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked: list[Any] = []
    found = SimpleNamespace(trial=trial, subscribers=subscribers, notes=lambda: ["late"])
    controls = SimpleNamespace(publish_event=lambda *given: asked.append(given) or found)
    monkeypatch.setattr("socket_testbed.live.processes.require_ros", lambda: None)
    monkeypatch.setitem(__import__("sys").modules, "socket_testbed.nodes.controls", controls)
    mark.mark("push", namespace="/left")
    assert capsys.readouterr() == (f"{line}\n", "note: late\n")
    assert asked[0][0] == "push" and asked[0][2] == "/left"


# --- tile, register, calibrate


def test_frames_that_were_left_out_are_counted() -> None:
    """Ten, of which six are used: two were mislabelled, one jumped, so one was occluded."""
    still: Any = SimpleNamespace(used=np.arange(10) < 6, mislabelled=2, jumped=1)
    assert design._frames("socket and load_cell", still) == (
        "socket and load_cell: 6 frames used, 4 left out (1 occluded, 2 mislabelled, 1 jumped)"
    )


def test_a_fit_s_residual_and_noise_are_in_millimetres() -> None:
    fit: Any = SimpleNamespace(names=("a", "b", "c", "d"), rms=0.5e-3, degrees=6, noise=0.25e-3)
    assert design._fit("limb", fit) == (
        "limb: 4 landmarks, residual 0.500 mm rms (6 degrees of freedom), so 1 sigma of a"
        " coordinate is 0.250 mm"
    )


@pytest.mark.parametrize(
    ("turned", "line"),
    [(0.5, "turned by 28.65 deg about (0.000, 0.000, 1.000)"),
     (0.0, "turned by 0.00 deg about (0.000, 0.000, 0.000)")],
    ids=["about z", "not at all"],
)  # fmt: skip
def test_a_place_has_its_own_deviations(turned: float, line: str) -> None:
    """Positions of 1, 2 and 3 mm, rotations of 0.01, 0.02 and 0.03 rad."""
    cosine, sine = np.cos(turned), np.sin(turned)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    pose = Pose(rotation, np.array([0.01, -0.02, 0.03]))
    position, turn = np.diag([1e-6, 4e-6, 9e-6]), np.diag([1e-4, 4e-4, 9e-4])
    assert design._place("limb in the pylon's body", pose, position, turn).splitlines() == [
        f"limb in the pylon's body: at (10.00, -20.00, 30.00) mm, {line}",
        "  1 sigma: (1.00, 2.00, 3.00) mm, (0.573, 1.146, 1.719) deg about x, y, z",
    ]


@pytest.mark.parametrize(
    ("dropped", "fate"),
    [(True, "left out of the fit"), (False, "kept in the fit, but not in its range")],
    ids=["dropped", "kept"],
)
def test_ten_outliers_are_shown(dropped: bool, fate: str) -> None:
    outliers = [Outlier(k, f"bench.csv line {k + 2}", k % 3, 1e3 * k, 2e3) for k in range(12)]
    calibrated: Any = SimpleNamespace(outliers=outliers, dropped=dropped)
    lines = design._outliers(calibrated).splitlines()
    assert lines[0] == f"12 outliers, {fate}:"
    assert [" ".join(line.split()) for line in (lines[1], *lines[3:6], lines[12])] == [
        "reading stress known Pa by robust fit Pa",
        "bench.csv line 2 normal 0 2000",
        "bench.csv line 3 shear_x 1000 2000",
        "bench.csv line 4 shear_y 2000 2000",
        "bench.csv line 11 normal 9000 2000",
    ]
    assert lines[13] == "and 2 more" and len(lines) == 14
    calibrated.outliers = outliers[:10]
    assert "more" not in design._outliers(calibrated)


@pytest.mark.parametrize(
    ("stress", "verdict"), [(-1001.0, "above"), (999.0, "within")], ids=["above", "within"]
)
def test_a_drift_is_beside_its_limit(stress: float, verdict: str) -> None:
    drift = Drift(np.array([0.1, -0.02, 0.003, -0.0004]), np.array([120.0, stress, -3.0]))
    assert design._drift(drift) == (
        "drift, corrected: +0.1000 -0.0200 +0.0030 -0.0004 pF, normal +120 Pa, shear_x"
        f" {stress:+.0f} Pa, shear_y -3 Pa: {verdict} the limit of 1000 Pa"
    )


def test_cross_talk_without_a_pure_load_is_named() -> None:
    frame = pd.DataFrame(
        {"cross-talk [%]": [np.nan, np.nan, 0.5]}, index=["normal", "shear_x", "shear_y"]
    )
    found: Any = SimpleNamespace(to_dataframe=frame.copy)
    shown = [" ".join(line.split()) for line in design._errors(found).splitlines()]
    assert shown[-3:] == ["normal no pure shear", "shear_x no pure normal", "shear_y 0.500"]


# --- the demo


@pytest.mark.parametrize("logged", [True, False], ids=["of a demo", "another"])
def test_only_a_demo_s_trial_is_removed(logged: bool, tmp_path: Path) -> None:
    trial = tmp_path / "trial"
    trial.mkdir()
    (tmp_path / "notes.txt").touch()
    if logged:
        (tmp_path / demo._LOG).touch()
        demo._prepare_folder(tmp_path)
        assert not trial.exists() and (tmp_path / "notes.txt").exists()
        return
    with pytest.raises(ConfigurationError) as found:
        demo._prepare_folder(tmp_path)
    assert str(found.value) == f"{trial} is not a trial of the demo: name another folder with -o"
    assert trial.exists()


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> Callable[[list[float]], Any]:
    """Records trials of which these fractions are complete, on a machine at 0.4 of real time."""
    runs: list[float] = []

    def record(shares: list[float]) -> tuple[Any, list[float]]:
        left = iter(shares)
        monkeypatch.setattr(demo, "_complete", lambda trial: next(left))
        trial: Any = SimpleNamespace(path=Path("nowhere/trial"), samples=lambda: "samples")
        return demo._record(trial, 0, Path("log")), runs

    speed = SimpleNamespace(time_scale=lambda: 0.4)
    monkeypatch.setattr(demo, "measure_speed", lambda: speed)
    monkeypatch.setattr(demo, "busy_note", lambda scale: "busy")
    monkeypatch.setattr(demo, "summary", lambda path: "recorded")
    monkeypatch.setattr(demo, "_run_live", lambda path, seed, scale, log: runs.append(scale))
    return record


def test_an_incomplete_demo_runs_at_half_speed(
    tried: Callable[[list[float]], Any], capsys: pytest.CaptureFixture[str]
) -> None:
    found, runs = tried([0.89, 0.9])
    assert found == ("samples", 0.2) and runs == [0.4, 0.2]
    assert capsys.readouterr().out.splitlines() == [
        "   busy",
        "   only 89 % of the samples are complete: again at 0.2 of real time",
        "   recorded",
    ]


def test_the_last_attempt_of_a_demo_needs_a_third(tried: Callable[[list[float]], Any]) -> None:
    assert tried([0.1, 0.1, 0.1, 0.1, 0.3])[0][0] == "samples"
    with pytest.raises(TrialError) as found:
        tried([0.1, 0.1, 0.1, 0.1, 0.29])
    assert str(found.value) == (
        "only 29 % of the samples are complete, even at a sixteenth of real time: this machine is"
        " too busy: end other programs, or try again later"
    )


def test_the_demo_s_table_explains_its_marks() -> None:
    assert demo._LEGEND.split("\n") == [
        "",
        "*: best. Tiles, clusters: rms error over the rms of the force; predicting zero gives 1.",
        "M, F: RMSE of the wrench from the pose alone, fitted on the first half (pushed around),",
        "judged on the second (held, unloaded)",
    ]


# --- fit, evaluate, pareto, map


def channel(name: str, skill: float, samples: int = 9) -> ChannelErrors:
    return ChannelErrors(name, "N", 2.0, 1.5, 1.0, skill, samples, True)


def test_a_negative_skill_is_explained() -> None:
    told = "negative skill: the channel's mean would have been a better prediction"
    assert told in results.errors_table([channel("Fx", 0.5), channel("Fy", -0.1)]).splitlines()
    assert told not in results.errors_table([channel("Fx", 0.5), channel("Fy", 0.0)])


def test_channels_without_a_value_are_named() -> None:
    errors = [channel("Fx", 0.5), channel("distal.Fz", float("nan"), 0)]
    lines = results.errors_table(errors).splitlines()
    assert lines[-1] == "without a value, not included: distal.Fz"


def test_a_fit_prints_its_warnings(capsys: pytest.CaptureFixture[str]) -> None:
    """k0 of the paper's variant, a solution that is not unique, springs with a small share."""
    stage = SimpleNamespace(determined=False)
    fit = SimpleNamespace(
        model=SimpleNamespace(stiffness=np.ones((12, 3)), variant="stiffness_bias"),
        settings=SimpleNamespace(theta=0.25, weights="noise", initial_stiffness=1234.56),
        samples=41, determined=20.4, stage_one=SimpleNamespace(determined=True), stage_two=stage,
        wrench="", status="solved", errors=[channel("Fx", 0.5)],
    )  # fmt: skip
    share = SimpleNamespace
    shares = (
        share(name="Fz", springs=0.2, offsets=0.8),
        share(name="force", springs=0.3, offsets=0.7),
        share(name="moment", springs=0.4, offsets=0.6),
    )
    found: Any = SimpleNamespace(
        fit=fit, segment="hold 10.00 s to 20.00 s", load_shares=lambda: shares,
        trial=SimpleNamespace(name="s01", samples=lambda: range(96)),
        motion=lambda: SimpleNamespace(directions=2, excitations=("position z: 3 mm",)),
    )  # fmt: skip
    results._show_fit(found, Fit(Path("s01"), output=Path("m.json")))
    lines = capsys.readouterr().out.splitlines()
    assert lines[:5] == [
        "s01: hold 10.00 s to 20.00 s, 41 of 96 samples",
        "variant stiffness_bias, theta 0.25, weights by noise; in 20 of 36 stiffness directions"
        " the data outweigh the smoothness",
        "stiffness k0 of Stage 1: 1235 N/m",
        "warning: the solution is not unique: give a --smoothness above 0",
        "solved",
    ]
    assert lines[-6:] == [
        "share of the measured load carried by the springs: Fz 20 %, force 30 %, moment 40 %",
        "warning: the springs bear only 30 % of the measured force (20 % of Fz), the offsets 70 %:"
        " the model says little about another load",
        "the pose moves by 3 times its noise or more in 2 of 6 independent directions",
        "  position z: 3 mm",
        "",
        "model in m.json",
    ]


@pytest.mark.parametrize("in_sample", [True, False], ids=["in-sample", "another trial"])
def test_an_evaluation_says_what_it_is_of(
    in_sample: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    model = SimpleNamespace(trial="s02", model=SimpleNamespace(variant="rigid"))
    found: Any = SimpleNamespace(
        trial=SimpleNamespace(name="s01"), segment="all", samples=96, model=model,
        errors=[channel("Fx", 0.5)], in_sample=in_sample, pressure="regions",
    )  # fmt: skip
    monkeypatch.setattr(results, "pressure_tables", lambda pressure: f"tables of {pressure}")
    results._show_evaluation(found, {})
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["s01: all, 96 samples", "model rigid of s02"]
    told = "in-sample where the model was fitted: errors on another trial may be far larger"
    assert (told in lines) is in_sample
    assert lines[-4:] == ["", "from the force map, not from the model:", "", "tables of regions"]


def test_a_front_names_what_it_leaves_out() -> None:
    front: Any = SimpleNamespace(
        theta=np.array([0.0, 0.25, 0.5, 0.75, 1.0]), variant="stiffness",
        knee=SimpleNamespace(verdict="a clear knee at theta 0.5"),
        non_dominated=np.array([True, True, False, False, True]), worst_residual=1.26e-8,
        flaws=("no clusters", "", "", "no wrench", "no wrench"),
    )  # fmt: skip
    assert results._describe_front(front).splitlines() == [
        "stiffness: a clear knee at theta 0.5",
        "  3 of 5 solutions not dominated, largest KKT residual or gap 1.3e-08",
        "  left out: 1 at theta 0: no clusters",
        "  left out: 2 at theta 0.75 to 1: no wrench",
    ]


def test_a_map_shows_the_highest_eight(capsys: pytest.CaptureFixture[str]) -> None:
    table = pd.DataFrame({"pressure [kPa]": np.arange(12.0)}, index=[f"t{k}" for k in range(12)])
    found: Any = SimpleNamespace(
        trial=SimpleNamespace(name="s01"), segment="all", time=range(96),
        summary=lambda: table.rename_axis("tile"), estimate=SimpleNamespace(source="from all"),
    )  # fmt: skip
    results._show_map(found)
    lines = capsys.readouterr().out.splitlines()
    assert lines[:3] == ["s01: all, 96 samples, 12 tiles", "from all", ""]
    assert [line.split()[0] for line in lines[5:13]] == [f"t{k}" for k in range(8)]
    assert lines[13:] == ["", "means over the segment, the 8 highest; sd: standard deviation"]


def test_the_front_s_table_is_explained() -> None:
    assert results._FRONT_LEGEND.split("\n") == [
        "wrench error, local error: roots of the weighted squares of the objective, J_w and J_f;",
        "RMSE: of the channels in the objective;",
        "dominated: another theta is better in both, which is possible with two successive stages",
    ]


# --- simulate, annotate, info, view


def test_a_simulated_trial_is_told_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Geometry:
        clusters = ("a", "b", "c")

        def __len__(self) -> int:
            return 12

    made = SimpleNamespace(path=Path("s01"), geometry=Geometry())
    monkeypatch.setattr(api, "simulate", lambda output, **given: made)
    monkeypatch.setattr(trials, "read_truth", lambda path: SimpleNamespace(wrench=range(240)))
    trials.simulate(output=Path("s01"), scenario="ramp", tissue="stiff", rate=4.0, seed=7)
    assert capsys.readouterr().out == (
        "s01: ramp, stiff tissue, 240 triggers at 4 Hz, 12 tiles, 3 clusters, seed 7; truth in"
        " s01/ground_truth.npz\n"
    )


def test_missing_metadata_say_how_to_state_them() -> None:
    assert trials._metadata(TrialMetadata()).splitlines() == [
        "no metadata: 'annotate' states them",
        "no side is stated: the regions are left and right, not medial and lateral; state it with"
        " 'annotate TRIAL --side left|right'",
    ]


def test_wrong_metadata_name_their_option() -> None:
    wrong = dict.fromkeys(running.FIELDS) | {"mass": -1.0}
    with pytest.raises(TestbedError) as found:
        running.check_metadata(MetadataOptions(**wrong))
    assert str(found.value).startswith("--mass is -1.0: give a number")


def test_a_shown_trial_says_where(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Page:
        url = "http://127.0.0.1:8080/"

        def __enter__(self) -> "Page":
            return self

        def __exit__(self, *error: object) -> None:
            """Nothing was opened."""

    asked: list[Any] = []
    monkeypatch.setattr(pages, "open_given", lambda trial, options: trial)
    monkeypatch.setattr(pages, "report_data", lambda trial: "")
    monkeypatch.setattr(api, "view", lambda *given, **at: asked.append((given, at)) or Page())
    monkeypatch.setattr(pages, "_INTERVAL", 0.01)
    pages.view(Path("s01"), duration=0.1, port=8081, allow_host=["lab"], model=Path("m.json"))
    assert capsys.readouterr().err == (
        "the trial is shown at http://127.0.0.1:8080/; Ctrl-C ends it\n"
    )
    ((given, at),) = asked
    assert given == (Path("s01"), Path("m.json"))
    assert at == {"host": "127.0.0.1", "port": 8081, "names": ("lab",), "prior": None}
