"""The command line as a user calls it, with right and with wrong input."""

import os
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from support.bags import of_another_socket
from support.verbs import call, program, refused

import socket_testbed as st
from socket_testbed.__main__ import _parse, run
from socket_testbed.commands import demo
from socket_testbed.commands.arguments import Parser, add_options
from socket_testbed.commands.calls import CALLS
from socket_testbed.live.scheduling import MachineSpeed
from socket_testbed.settings.options import RECORDED
from socket_testbed.trials.reprocess import NO_TARE
from socket_testbed.trials.segment import NAMED
from socket_testbed.trials.trial import Trial


@pytest.mark.parametrize("verb", CALLS)
def test_every_verb_explains_its_options(verb: str, capsys) -> None:
    """Its example is understood, and what names an output file can replace it."""
    assert _parse([verb, *CALLS[verb].example.split()]).verb == verb
    with pytest.raises(SystemExit) as ended:
        run([verb, "--help"])
    out = capsys.readouterr().out
    assert ended.value.code == 0 and f"socket-testbed {verb} " in out
    words = {"--segment": "|".join(NAMED), "--tare": f"|{NO_TARE}|{RECORDED}"}
    if verb == "import":  # a tare of its own: of the drivers' wrench
        del words["--tare"]
    assert all(words[name] in out for name in words if f"[{name} " in out)
    add_options(parser := Parser(), CALLS[verb])
    options = {action.dest: action.help for action in parser._actions}
    assert all(options.values()), options
    if options.keys() & {"output", "figure"} and verb not in {"simulate", "import", "demo"}:
        assert "replace" in options


def test_help_imports_no_library() -> None:
    script = (
        "import sys, socket_testbed; from socket_testbed.__main__ import run\n"
        "import socket_testbed.live.processes\n"  # 'mark' takes its time after it
        "for words in (['--help'], ['fit', '--help']):\n"
        "    try: run(words)\n"
        "    except SystemExit: pass\n"
        "print({'numpy', 'scipy', 'pandas', 'matplotlib', 'rclpy'} & {*sys.modules})\n"
    )
    _, out, _ = program(sys.executable, "-c", script)
    assert "(default: 0.001)" in out and out.endswith("\nset()\n")


def test_a_page_imports_no_library_of_printed_figures(hold: Path, tmp_path: Path) -> None:
    words = ["report", str(hold), "-o", str(tmp_path / "page.html"), "--thetas", "3"]
    script = (
        "import sys; from socket_testbed.__main__ import run\n"
        f"print(run({words!r}), 'matplotlib' in sys.modules)\n"
    )
    _, out, _ = program(sys.executable, "-c", script)
    assert out.endswith("\n0 False\n")


def test_info_states_what_a_trial_holds(hold: Path, capsys) -> None:
    code, out, _ = call(capsys, "info", hold)
    assert code == 0
    assert "/load_cell/wrench" in out and "240 samples at 4.00 Hz" in out
    assert "event placed (found): 10" in out
    assert "plateau" in out and "socket.yaml, calibration.yaml, testbed.yaml" in out


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time scales at which the demo has tried to record."""
    scales: list[float] = []
    monkeypatch.setattr(demo, "_run_live", lambda path, seed, scale, log: scales.append(scale))
    monkeypatch.setattr(demo, "summary", lambda path: "all there")
    monkeypatch.setattr(Trial, "samples", lambda trial: None)
    return scales


@pytest.mark.parametrize(
    ("speed", "complete", "scales"),
    [
        (1.0, [0.4, 0.8, 0.95], [1.0, 0.5, 0.25]),
        # At the slowest again and again, as a busy moment may pass; then with what there is.
        (0.04, [0.1, 0.2, 0.3, 0.4, 0.5], [0.25, 0.125, 0.0625, 0.0625, 0.0625]),
    ],
    ids=["fast", "slow"],
)
def test_the_demo_retries_at_half_speed(
    speed: float, complete: list[float], scales: list[float], tried: list[float],
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    left = [*complete]
    monkeypatch.setattr(demo, "measure_speed", lambda: MachineSpeed(0.0, speed))
    monkeypatch.setattr(demo, "_complete", lambda trial: left.pop(0))
    assert demo._record(Trial(tmp_path), 0, tmp_path)[1] == scales[-1] and tried == scales


@pytest.mark.usefixtures("tried")
def test_the_demo_refuses_a_recording_without_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo, "measure_speed", lambda: MachineSpeed(0.0, 0.04))
    monkeypatch.setattr(demo, "_complete", lambda trial: 0.0)
    with pytest.raises(st.TestbedError, match=r"only 0 % .* at a sixteenth of real time: this"):
        demo._record(Trial(tmp_path), 0, tmp_path)


WRONG = {
    "fit HOLD -o m --segment 900:999": ["900:999", "samples"],
    "fit nowhere -o m --theta 1.5": ["theta", "from 0 to 1"],
    "fit nowhere -o m --theta=-0.1": ["theta", "from 0 to 1"],
    "fit HOLD -o m --leave-out distal.fx": ["distal.fx", "distal.Fx"],
    "simulate -o HOLD": ["exists already"],
    "run --simulated --record home/trials/s01": ["home", "no such folder"],
    "run --simulated --fault mocap.dorp=1": ["did you mean 'mocap.drop'?"],
    "run --simulated --fault mocap.drop=2": ["from 0 to 1"],
    "run --simulated --fault mocap.drop=-1": ["from 0 to 1"],
    "run --simulated --fault limb.out=9": ["no such cluster", "1 to 4"],
    "run --simulated --leave-out distal.Fq": ["distal.F"],
    "run --simulated --view --view-host 192.0.2.1": ["cannot listen on 192.0.2.1"],
    "run --duration 1": ["load_cell_node: "],
    "run --simulated --time-scale 0": ["the time scale is 0", "from 0.01 to 1"],
    "run --simulated --time-scale 1.5": ["the time scale is 1.5", "from 0.01 to 1"],
    "annotate HOLD --mass 815": ["--mass is 815.0"],
    "annotate HOLD --mass 4": ["--mass is 4.0"],
    "export HOLD -o moved.csv --about 100 0 200": ["about is [100.0", "from -2 to 2"],
    "export HOLD -o moved.csv --about 0 0 -3": ["about is [0.0, 0.0, -3.0", "from -2 to 2"],
    "export nowhere -o all.foo": ["'.foo' is not the format of a trial's export", ".c3d"],
    "simulate -o HOLD --seed=-1": ["--seed is -1", "at least 0"],
    "pressure HOLD -o regions.foo": ["'.foo' is not the format of a table", ".csv"],
    "compare HOLD": ["trials to compare: 1", "2 to 200"],
    "view --tare none": ["--tare is for a trial"],
}


def words_of(line: str, **places: object) -> list[str]:
    for name, path in places.items():
        line = line.replace(name, str(path))
    return line.split()


def recorded_as(hold: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The demo records the hold, and the graph's estimates are those of the API."""
    found = st.force_map(hold, "all").estimate
    live = np.stack([found.normal_pressure, found.normal_pressure_standard_deviation])

    def recorded(trial: Trial, seed: int, log: Path):
        shutil.copytree(hold, trial.path)
        return trial.samples(), 1.0

    monkeypatch.setattr(demo, "_record", recorded)
    monkeypatch.setattr(demo, "_estimate", lambda *given: live)


def test_the_demo_compares_replay_with_truth(hold, tmp_path, monkeypatch, capsys) -> None:
    recorded_as(hold, monkeypatch)
    code, out, _ = call(capsys, "demo", "-o", tmp_path / "demo")
    assert code == 0 and (tmp_path / "demo" / "force_map.png").is_file()
    (held,) = re.findall(r"(\d+) % of the 95 % intervals contain the truth", out)
    assert int(held) > 80 and "Largest error: " in out


def test_the_demo_replaces_only_its_own_trial(hold, tmp_path, capsys) -> None:
    own = tmp_path / "own" / "trial"
    shutil.copytree(hold, own)
    refused(capsys, "demo", "-o", own.parent, named=["is not a trial of the demo"])
    assert own.is_dir()


@pytest.mark.parametrize("line", WRONG)
def test_a_wrong_call_gets_one_line(line: str, hold, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    refused(capsys, *words_of(line, HOLD=hold), named=WRONG[line])
    assert list(tmp_path.iterdir()) == []


TAKEN = (
    "fit HOLD -o bench.json",
    "evaluate HOLD --model MODEL -o bench.csv",
    "map HOLD -o new.csv --figure bench.png",
    "pareto HOLD --figure bench.png",
    "compare HOLD HOLD -o bench.csv",
    "report HOLD -o bench.html",
    "tile scan.stl -o bench.yaml",  # beside it are a picture and a page
    "register t.csv --landmarks l.yaml --socket s.yaml -o bench.csv",
    "calibrate b.csv --cluster c -o c.yaml --figure bench.png",
)


@pytest.fixture
def taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with files that a call might replace."""
    monkeypatch.chdir(tmp_path)
    for suffix in (".csv", ".png", ".html", ".json"):
        (tmp_path / f"bench{suffix}").write_text("data of a day")
    return tmp_path


@pytest.mark.parametrize("line", TAKEN)
def test_no_output_replaces_a_file_unasked(line: str, taken, hold, hold_model, capsys) -> None:
    refused(capsys, *words_of(line, HOLD=hold, MODEL=hold_model), named=["exists already"])
    assert {file.read_text() for file in taken.iterdir()} == {"data of a day"}


@pytest.mark.usefixtures("taken")
def test_an_output_replaces_a_file_when_asked(hold: Path, capsys) -> None:
    words = ["fit", hold, "-o", "bench.json", "--variant", "stiffness"]
    assert call(capsys, *words, "--replace")[0] == 0
    assert st.read_model("bench.json").model.variant == "stiffness"


@pytest.fixture(scope="module")
def other_socket(hold: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The hold, recorded with another socket."""
    return of_another_socket(hold, tmp_path_factory.mktemp("other") / "hold")


@pytest.mark.parametrize(
    "line", ["evaluate", "export -o table.csv", "report -o page.html", "view --port 0"]
)
def test_a_model_of_another_socket_is_refused(
    line: str, other_socket: Path, hold_model: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    verb, *words = line.split()
    named = ["another socket"]
    refused(capsys, verb, other_socket, "--model", hold_model, *words, named=named)
    assert [*tmp_path.iterdir()] == []


RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"


@pytest.fixture
def unset(monkeypatch: pytest.MonkeyPatch) -> None:
    """An environment that says nothing of where a graph is found."""
    for variable in (RANGE, PROFILES, "FASTDDS_DEFAULT_PROFILES_FILE"):
        monkeypatch.delenv(variable, raising=False)


@pytest.mark.usefixtures("unset")
def test_a_graph_stays_on_this_machine(hold: Path) -> None:
    assert run(["info", str(hold)]) == 0
    assert os.environ[RANGE] == "LOCALHOST" and PROFILES in os.environ


@pytest.mark.usefixtures("unset")
def test_a_graph_opens_where_it_is_told(hold: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(RANGE, "SUBNET")
    assert run(["info", str(hold)]) == 0
    assert os.environ[RANGE] == "SUBNET" and PROFILES not in os.environ


MISTAKES = {
    "fitt": "unknown verb 'fitt': did you mean 'fit'?",
    "fit t -o m --varant rigid": "--varant: did you mean '--variant'?",
    "fit t -o m --variant rigd": "--variant: invalid choice: 'rigd'",
    "fit t -o m --theta x": "--theta: invalid float value: 'x'",
    "fit t -o m --theta 0,5": "invalid float value: '0,5': write decimals with a point",
    "pareto t --thetas 3.5": "--thetas: invalid int value: '3.5'",
    "fit t -o m --jobs 2 --dask a": "--dask: not allowed with",
    "run --simulated --time-scale abc": "--time-scale: invalid number value: 'abc'",
}


@pytest.mark.parametrize("line", MISTAKES)
def test_a_mistake_is_one_line(line: str, capsys) -> None:
    """With the likely word."""
    with pytest.raises(SystemExit) as ended:
        run(line.split())
    error = capsys.readouterr().err
    assert ended.value.code == 2 and MISTAKES[line] in error and error.count("\n") == 1
