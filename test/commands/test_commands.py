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
from socket_testbed.__main__ import EXAMPLES, VERBS, _parse, run
from socket_testbed.commands import demo
from socket_testbed.commands.arguments import Parser, add_options
from socket_testbed.live.scheduling import MachineSpeed
from socket_testbed.trials.reprocess import NO_TARE, RECORDED
from socket_testbed.trials.segment import NAMED
from socket_testbed.trials.trial import Trial


def test_every_verb_explains_itself_and_each_of_its_options(capsys) -> None:
    """Its example is understood, and what names an output file can replace it."""
    for verb, module in VERBS.items():
        assert _parse([verb, *EXAMPLES[verb].split()]).verb == verb
        with pytest.raises(SystemExit) as ended:
            run([verb, "--help"])
        out = capsys.readouterr().out
        assert ended.value.code == 0 and f"socket-testbed {verb} " in out
        words = {"--segment": "|".join(NAMED), "--tare": f"|{NO_TARE}|{RECORDED}"}
        assert all(words[name] in out for name in words if f"[{name} " in out), verb
        add_options(parser := Parser(), f"commands.{module}.{verb}")
        options = {action.dest: action.help for action in parser._actions}
        assert all(options.values()), (verb, options)
        if options.keys() & {"output", "figure"} and verb not in {"simulate", "demo"}:
            assert "replace" in options, verb


def test_the_package_and_the_help_import_no_library() -> None:
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


def test_info_says_what_a_trial_holds(hold: Path, capsys) -> None:
    code, out, _ = call(capsys, "info", hold)
    assert code == 0
    assert "/load_cell/wrench" in out and "240 samples at 4.00 Hz" in out
    assert "event placed (found): 10" in out
    assert "plateau" in out and "socket.yaml, calibration.yaml, testbed.yaml" in out


def test_the_demo_retries_at_half_speed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []
    monkeypatch.setattr(demo, "_run_live", lambda path, seed, scale, log: tried.append(scale))
    monkeypatch.setattr(demo, "summary", lambda path: "all there")
    monkeypatch.setattr(Trial, "samples", lambda trial: None)
    for speed, complete, scales in (
        (1.0, [0.4, 0.8, 0.95], [1.0, 0.5, 0.25]),
        # At the slowest again and again, as a busy moment may pass; then with what there is.
        (0.04, [0.1, 0.2, 0.3, 0.4, 0.5], [0.25, 0.125, 0.0625, 0.0625, 0.0625]),
    ):
        tried.clear()
        monkeypatch.setattr(demo, "measure_speed", lambda speed=speed: MachineSpeed(0.0, speed))
        monkeypatch.setattr(demo, "_complete", lambda trial, left=complete: left.pop(0))
        assert demo._record(Trial(tmp_path), 0, tmp_path)[1] == scales[-1] and tried == scales
    monkeypatch.setattr(demo, "_complete", lambda trial: 0.0)
    with pytest.raises(st.TestbedError, match=r"only 0% .* at a sixteenth of real time: this"):
        demo._record(Trial(tmp_path), 0, tmp_path)


WRONG = {
    "fit HOLD -o m --segment 900:999": ["900:999", "samples"],
    "fit nowhere -o m --theta 1.5": ["theta", "from 0 to 1"],
    "fit HOLD -o m --leave-out distal.fx": ["distal.fx", "distal.Fx"],
    "simulate -o HOLD": ["exists already"],
    "run --simulated --record home/trials/s01": ["home", "no such folder"],
    "run --simulated --fault mocap.dorp=1": ["did you mean 'mocap.drop'?"],
    "run --simulated --fault mocap.drop=2": ["from 0 to 1"],
    "run --simulated --fault limb.out=9": ["no such cluster", "1 to 4"],
    "run --simulated --leave-out distal.Fq": ["distal.F"],
    "run --simulated --view --view-host 192.0.2.1": ["cannot listen on 192.0.2.1"],
    "run --duration 1": ["load_cell_node: "],
    "run --simulated --time-scale 0": ["the time scale is 0", "from 0.01 to 1"],
    "annotate HOLD --mass 815": ["--mass is 815.0"],
    "export HOLD -o moved.csv --about 100 0 200": ["about is [100.0", "from -2 to 2"],
    "pressure HOLD -o regions.foo": ["'.foo' is not the format of a table", ".csv"],
    "compare HOLD": ["trials to compare: 1", "2 to 12"],
    "view --tare none": ["--tare is for a trial"],
}


def words_of(line: str, **places: object) -> list[str]:
    for name, path in places.items():
        line = line.replace(name, str(path))
    return line.split()


def test_the_demo_compares_the_replay_with_the_truth(hold, tmp_path, monkeypatch, capsys) -> None:
    found = st.force_map(hold, "all").estimate
    live = np.stack([found.normal_pressure, found.normal_pressure_standard_deviation])

    def recorded(trial: Trial, seed: int, log: Path):
        shutil.copytree(hold, trial.path)
        return trial.samples(), 1.0

    monkeypatch.setattr(demo, "_record", recorded)
    monkeypatch.setattr(demo, "_estimate", lambda *given: live)
    code, out, _ = call(capsys, "demo", "-o", tmp_path / "demo")
    assert code == 0 and (tmp_path / "demo" / "force_map.png").is_file()
    own = tmp_path / "own" / "trial"
    shutil.copytree(hold, own)
    refused(capsys, "demo", "-o", own.parent, named=["is not a trial of the demo"])
    assert own.is_dir()  # only a trial of the demo is replaced
    (held,) = re.findall(r"(\d+) % of the 95 % intervals contain the truth", out)
    assert int(held) > 80 and "Largest error: " in out


def test_a_wrong_call_gets_one_line(hold, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for line, named in WRONG.items():
        refused(capsys, *words_of(line, HOLD=hold), named=named)
        assert list(tmp_path.iterdir()) == [], line


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


def test_no_output_replaces_a_file_unasked(hold, hold_model, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for suffix in (".csv", ".png", ".html", ".json"):
        (tmp_path / f"bench{suffix}").write_text("data of a day")
    for line in TAKEN:
        refused(capsys, *words_of(line, HOLD=hold, MODEL=hold_model), named=["exists already"])
        assert {file.read_text() for file in tmp_path.iterdir()} == {"data of a day"}, line
    words = ["fit", hold, "-o", "bench.json", "--variant", "stiffness"]
    assert call(capsys, *words, "--replace")[0] == 0
    assert st.read_model("bench.json").model.variant == "stiffness"


def test_a_model_of_another_socket_is_refused(hold, hold_model, tmp_path, capsys) -> None:
    trial = of_another_socket(hold, tmp_path / "hold")
    for verb, *words in (
        ("evaluate",),
        ("export", "-o", tmp_path / "table.csv"),
        ("report", "-o", tmp_path / "page.html"),
        ("view", "--port", 0),
    ):
        refused(capsys, verb, trial, "--model", hold_model, *words, named=["another socket"])
    assert [*tmp_path.iterdir()] == [trial]


def test_a_graph_stays_on_this_machine_unless_told_otherwise(hold: Path, monkeypatch) -> None:
    name, profiles = "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE"
    for chosen in ("", "SUBNET"):
        for variable in (name, profiles, "FASTDDS_DEFAULT_PROFILES_FILE"):
            monkeypatch.delenv(variable, raising=False)
        if chosen:
            monkeypatch.setenv(name, chosen)
        assert run(["info", str(hold)]) == 0
        assert os.environ[name] == (chosen or "LOCALHOST")
        assert (profiles in os.environ) is not bool(chosen)


def test_a_mistake_is_one_line_with_the_likely_word(capsys) -> None:
    for line, named in (
        ("fitt", "unknown verb 'fitt': did you mean 'fit'?"),
        ("fit t -o m --varant rigid", "--varant: did you mean '--variant'?"),
        ("fit t -o m --variant rigd", "--variant: invalid choice: 'rigd'"),
        ("fit t -o m --theta x", "--theta: invalid float value: 'x'"),
        ("fit t -o m --theta 0,5", "invalid float value: '0,5': write decimals with a point"),
        ("pareto t --thetas 3.5", "--thetas: invalid int value: '3.5'"),
        ("fit t -o m --jobs 2 --dask a", "--dask: not allowed with"),
        ("run --simulated --time-scale abc", "--time-scale: invalid number value: 'abc'"),
    ):
        with pytest.raises(SystemExit) as ended:
            run(line.split())
        error = capsys.readouterr().err
        assert ended.value.code == 2 and named in error and error.count("\n") == 1
