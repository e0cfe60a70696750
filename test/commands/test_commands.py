"""The command line as a user calls it, with right and with wrong input."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from support.bags import rewrite
from support.verbs import call, refused

import socket_testbed as st
from socket_testbed.__main__ import VERBS, run
from socket_testbed.commands.signatures import options_of
from socket_testbed.simulation.trial import read_truth


def edit(path: Path, change) -> Path:
    """Change a YAML file in place."""
    document = yaml.safe_load(path.read_text())
    change(document)
    path.write_text(yaml.safe_dump(document))
    return path


@pytest.fixture
def trial(hold: Path, tmp_path: Path) -> Path:
    """A copy of the hold that a test may spoil."""
    return Path(shutil.copytree(hold, tmp_path / "hold"))


def test_every_verb_explains_itself(capsys) -> None:
    for verb in VERBS:
        with pytest.raises(SystemExit) as ended:
            run([verb, "--help"])
        assert ended.value.code == 0
        assert "show this help" in capsys.readouterr().out


def test_info_says_what_a_trial_holds(hold: Path, capsys) -> None:
    code, out, _ = call(capsys, "info", hold)
    assert code == 0
    assert "/load_cell/wrench" in out and "240 samples at 4.00 Hz" in out
    assert "event placed (found): 10" in out
    assert "plateau" in out and "socket.yaml, calibration.yaml, testbed.yaml" in out
    noise = {line.split("  ")[0]: line.split()[-1] for line in out.splitlines() if line}
    assert float(noise["force [N]"]) == pytest.approx(0.15, rel=0.2)  # the simulated load cell's
    assert 0.001 < float(noise["limb position [mm]"]) < 0.01  # 8 um a marker, averaged


def test_the_offsets_vanish_with_the_bias_variant(hold: Path, tmp_path: Path, capsys) -> None:
    channels = {}
    for variant in ("stiffness", "stiffness_bias"):
        model = tmp_path / f"{variant}.json"
        assert call(capsys, "fit", hold, "--variant", variant, "-o", model)[0] == 0
        code, out, _ = call(capsys, "evaluate", hold, "--model", model, "--json")
        assert code == 0
        report = json.loads(out)
        assert report["segment"]["kind"] == "plateau"
        channels[variant] = {c["name"]: c for c in report["channels"]}
    plain, bias = channels["stiffness"], channels["stiffness_bias"]
    local = [name for name in plain if "." in name]
    assert len(local) == 12
    for figures in (plain, bias):
        for c in figures.values():
            assert c["mae"] <= c["rmse"] + 1e-12 and c["sigma"] <= c["rmse"] + 1e-12
    # Without offsets the residuals stand still: sigma is much smaller than the RMSE.
    force = np.array([plain[n]["rmse"] for n in ("Fx", "Fy", "Fz")]).mean()
    assert np.array([bias[n]["rmse"] for n in ("Fx", "Fy", "Fz")]).mean() < 0.2 * force
    assert np.median([bias[n]["rmse"] for n in local]) < 0.3 * np.median(
        [plain[n]["rmse"] for n in local]
    )
    assert sum(plain[n]["sigma"] for n in local) < 0.4 * sum(plain[n]["rmse"] for n in local)
    for c in bias.values():
        assert c["sigma"] == pytest.approx(c["rmse"], rel=1e-3, abs=1e-6)


def test_a_left_out_channel_is_marked_and_bears_no_weight(hold, tmp_path, capsys) -> None:
    model = tmp_path / "model.json"
    code, out, _ = call(capsys, "fit", hold, "-o", model, "--leave-out", "distal.Fx", "Mz")
    assert code == 0 and out.count("not in objective") == 2
    stored = json.loads(model.read_text())
    assert stored["parameters"]["force_bias"]["distal"][0] == 0.0
    assert stored["parameters"]["wrench_bias"][2] == 0.0
    code, out, _ = call(capsys, "evaluate", hold, "--model", model)
    assert out.count("not in objective") == 2
    found = json.loads(call(capsys, "evaluate", hold, "--model", model, "--json")[1])
    local = [c["rmse"] for c in found["channels"] if "." in c["name"] and c["in_objective"]]
    median = np.median(local)  # as the paper counts: without distal.Fx
    assert len(local) == 11
    assert found["in_objective"]["median_local_rmse [N]"] == pytest.approx(median, rel=1e-12)
    assert f"median local RMSE {median:.3f} N, of the channels in the objective" in out


def test_a_spoilt_channel_is_named_and_can_be_left_out(hold, tmp_path, capsys) -> None:
    def spoil(topic: str, message):
        if topic == "/load_cell/wrench":
            message.wrench.torque.z = float("nan")
        if topic == "/clusters/capacitance":
            message.clusters[3].status = np.full(4, 2, dtype=np.uint8)
        return message

    spoilt = rewrite(hold, tmp_path / "spoilt", spoil)
    model = tmp_path / "model.json"
    code, _, err = call(capsys, "fit", spoilt, "-o", model)
    assert code == 1 and "Mz" in err and "--leave-out Mz" in err
    assert err.count("\n") == 1 and not model.exists()

    leave = ["--leave-out", "Mz"]
    code, _, err = call(capsys, "fit", spoilt, "-o", model, *leave)
    assert code == 1 and "--leave-out distal.Fx distal.Fy distal.Fz" in err

    leave += ["distal.Fx", "distal.Fy", "distal.Fz"]
    code, _, err = call(capsys, "fit", spoilt, "-o", model, *leave)
    assert code == 0, err
    assert model.exists()


def test_a_model_predicts_another_load_in_the_truth_s_units(hold, tmp_path, capsys) -> None:
    trial = tmp_path / "ramp"
    call(capsys, "simulate", "-o", trial, "--scenario", "ramp", "--duration", 60)
    model = tmp_path / "model.json"
    assert call(capsys, "fit", trial, "--segment", "all", "-o", model)[0] == 0
    words = ["evaluate", trial, "--model", model, "--segment", "30:60", "--json"]
    code, out, _ = call(capsys, *words)
    assert code == 0
    channels = {c["name"]: c for c in json.loads(out)["channels"]}
    assert channels["Fz"]["skill"] > 0.5
    assert np.ptp(read_truth(trial).wrench[:, 5]) > 150.0


@pytest.mark.slow
def test_all_but_the_graph_works_without_ros(tmp_path: Path) -> None:
    script = (
        "import sys\n"
        "for name in ('rclpy', 'socket_testbed_msgs', 'geometry_msgs', 'std_msgs'):\n"
        "    sys.modules[name] = None\n"
        "from socket_testbed.__main__ import run\n"
        "assert run(['simulate', '-o', 'hold', '--duration', '40']) == 0\n"
        "assert run(['info', 'hold']) == 0\n"
        "assert run(['fit', 'hold', '-o', 'model.json']) == 0\n"
        "assert run(['evaluate', 'hold', '--model', 'model.json']) == 0\n"
        "assert run(['replay', 'hold']) == 1\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], check=False, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "rclpy cannot be imported: run 'make setup'" in done.stderr


@pytest.mark.slow
def test_a_full_disk_leaves_nothing_that_looks_whole(tmp_path: Path) -> None:
    # A limit on the size of a file stands for the disk: writing fails in the middle.
    command = f"ulimit -f 64; {sys.executable} -m socket_testbed simulate -o hold --duration 60"
    done = subprocess.run(
        ["bash", "-c", command], check=False, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 1
    assert "hold: cannot be written" in done.stderr and "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_ground_truth_lies_beside_the_trial(hold: Path) -> None:
    with np.load(hold / "ground_truth.npz") as truth:
        assert truth["forces"].shape == (240, len(truth["names"]), 3)
        assert {"stamps", "wrench", "position"} <= set(truth.files)


def add_typo(trial: Path) -> None:
    edit(trial / "socket.yaml", lambda d: d.update(neighbors=d.pop("neighbours")))


def add_wrong_shape(trial: Path) -> None:
    edit(trial / "socket.yaml", lambda d: d["tiles"]["distal"].update(anchor=[0.0, 0.1]))


def add_wrong_unit(trial: Path) -> None:
    edit(trial / "socket.yaml", lambda d: d["tiles"]["distal"].update(area=900.0))


def add_other_clusters(trial: Path) -> None:
    edit(
        trial / "calibration.yaml",
        lambda d: d["clusters"].update(elsewhere=d["clusters"].pop("distal")),
    )


def add_unknown_parameter(trial: Path) -> None:
    parameters = {"estimator_node": {"ros__parameters": {"identification": {"thetta": 0.5}}}}
    (trial / "testbed.yaml").write_text(yaml.safe_dump(parameters))


def add_parameter_out_of_range(trial: Path) -> None:
    parameters = {"estimator_node": {"ros__parameters": {"identification": {"theta": 5}}}}
    (trial / "testbed.yaml").write_text(yaml.safe_dump(parameters))


def truncate(trial: Path) -> None:
    file = trial / "hold.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def break_metadata(trial: Path) -> None:
    (trial / "metadata.yaml").write_text("rosbag2: [")


def remove_storage(trial: Path) -> None:
    (trial / "hold.mcap").unlink()


@pytest.mark.parametrize(
    ("spoil", "names"),
    [
        (add_typo, ["socket.yaml", "'neighbors'", "did you mean 'neighbours'?"]),
        (add_wrong_shape, ["socket.yaml", "distal", "anchor", "a list of 3"]),
        (add_wrong_unit, ["socket.yaml", "distal", "area", "900", "[m^2]"]),
        (add_other_clusters, ["calibration", "distal", "elsewhere"]),
        (add_unknown_parameter, ["testbed.yaml", "thetta", "did you mean 'identification.theta'?"]),
        (add_parameter_out_of_range, ["testbed.yaml", "theta", "from 0 to 1"]),
        (truncate, ["hold.mcap", "truncated", "mcap recover"]),
        (break_metadata, ["metadata.yaml", "ros2 bag reindex"]),
        (remove_storage, ["hold.mcap", "not there"]),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_bad_input_gets_one_line_that_names_it(
    spoil, names, trial: Path, hold_model: Path, tmp_path: Path, capsys
) -> None:
    spoil(trial)
    output = tmp_path / "out.json"
    refused(capsys, "fit", trial, "-o", output, named=names)
    refused(capsys, "evaluate", trial, "--model", hold_model, named=names)
    refused(capsys, "replay", trial, "--estimate", named=names)
    assert not output.exists() and not list(tmp_path.glob(".*partial*"))


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (["info", "nowhere"], ["nowhere", "no such trial"]),
        (["fit", "HOLD", "-o", "m", "--segment", "900:999"], ["900:999", "samples"]),
        (["fit", "HOLD", "-o", "m", "--segment", "sometimes"], ["sometimes", "T0:T1"]),
        (["fit", "HOLD", "-o", "m", "--theta", "1.5"], ["theta", "from 0 to 1"]),
        (["fit", "HOLD", "-o", "m", "--leave-out", "distal.fx"], ["distal.fx", "distal.Fx"]),
        (["fit", "HOLD", "-o", "m", "--solver", "osqpp"], ["osqpp", "did you mean 'osqp'?"]),
        (["fit", "HOLD", "-o", "m", "--params", "none.yaml"], ["none.yaml", "no such file"]),
        (["evaluate", "HOLD", "--model", "none.json"], ["none.json", "no such model"]),
        (["evaluate", "HOLD", "--model", "HOLD/socket.yaml"], ["socket.yaml", "is not a model"]),
        (["simulate", "-o", "HOLD"], ["exists already"]),
        (["simulate", "-o", "x", "--rate", "0"], ["--rate", "from 0.1 to 1000"]),
        (["simulate", "-o", "x", "--seed", "-1"], ["--seed"]),
        (["replay", "HOLD", "--rate", "-1"], ["--rate"]),
        (["replay", "nowhere"], ["nowhere", "no such trial"]),
        (["record", "HOLD"], ["exists already"]),
        (["pareto", "HOLD", "-o", "front.xlsx"], ["front.xlsx", "name a .csv file"]),
        (["pressure", "nowhere"], ["nowhere", "no such trial"]),
        (["evaluate", "nowhere", "--model", "MODEL"], ["nowhere", "no such trial"]),
        (["info", "/dev/null"], ["/dev/null", "neither a folder nor a file"]),
        (["info", "HOLD", "--geometry", "HOLD"], ["hold", "cannot be read (Is a directory)"]),
        (["info", "HOLD", "--geometry", "HOLD/hold.mcap"], ["hold.mcap", "is not UTF-8 text"]),
        (["replay", "HOLD", "--geometry", "s.yaml"], ["--geometry", "add --estimate"]),
        (["replay", "HOLD", "--theta", "0.5"], ["--theta", "add --estimate"]),
        (["evaluate", "HOLD", "--model", "HOLD"], ["hold", "cannot be read (Is a directory)"]),
        (["evaluate", "HOLD", "--model", "HOLD/hold.mcap"], ["hold.mcap", "is not a model"]),
        (["fit", "HOLD", "-o", "/proc/model"], ["/proc/model", "cannot be written"]),
        (["fit", "HOLD", "-o", "modles/m.json"], ["modles", "no such folder"]),
        (["fit", "HOLD", "-o", "HOLD"], ["hold", "as a folder"]),
        (["simulate", "-o", "home/trials/s01"], ["home", "no such folder"]),
        (["record", "home/trials/s01"], ["home", "no such folder"]),
        (["run", "--simulated", "--record", "home/trials/s01"], ["home", "no such folder"]),
        (["demo", "-o", "home/trials/s01"], ["home", "no such folder"]),
        (["run", "--fault", "mocap.drop=1"], ["add --simulated"]),
        (["run", "--simulated", "--fault", "mocap.dorp=1"], ["did you mean 'mocap.drop'?"]),
        (["run", "--simulated", "--fault", "mocap.drop=often"], ["'often' is not a number"]),
        (["run", "--simulated", "--record", "HOLD"], ["exists already"]),
        (["run", "--simulated", "--record", "/proc/trial"], ["name another folder"]),
        (["run", "--simulated", "--fault", "clusters.nack=nan"], ["clusters.nack"]),
        (["run", "--simulated", "--period", "1"], ["--period"]),
        (["run", "--simulated", "--rate", "1e6"], ["rate"]),
        (["run", "--simulated", "--leave-out", "distal.Fq"], ["distal.F"]),
        (["run", "--simulated", "--time-scale", "2"], ["--time-scale is 2"]),
        (["run", "--simulated", "--time-scale", "slow"], ["'slow' is not a number"]),
        (["run", "--simulated", "--side", "left"], ["--side is for a trial that is recorded"]),
        (["run", "--time-scale", "0.5"], ["add --simulated"]),
        (["run", "--simulated", "--view-port", "8081"], ["is for a page: add --view"]),
        (
            ["run", "--simulated", "--view", "--view-host", "192.0.2.1"],
            ["cannot listen on 192.0.2.1"],
        ),
        (["run", "--duration", "1"], ["load_cell_node: "]),
        (["pressure", "HOLD", "--threshold", "-1"], ["--threshold is -1.0: give a number"]),
        (["pressure", "HOLD", "--share", "-0.1"], ["--share is -0.1: give a number"]),
        (["pressure", "HOLD", "--segment", "500:600"], ["holds 0 samples: give seconds within"]),
        (["pressure", "HOLD", "--leave-out", "distl.Fz"], ["did you mean 'distal.Fz'"]),
        (["pressure", "HOLD", "--over-time"], ["--over-time has no output"]),
        (["pressure", "HOLD", "-o", "regions.foo"], ["'.foo' is not a table format"]),
        (["pressure", "HOLD", "--figure", "map.bmp"], ["map.bmp", ".png"]),
        (["pareto", "HOLD", "--thetas", "1"], ["--thetas"]),
        (["pareto", "HOLD", "--figure", "front.jpg"], ["front.jpg"]),
        (["pareto", "HOLD", "--segment", "900:999"], ["900:999"]),
        (["map", "no_trial", "-o", "map.xlsx"], ["is not a table format"]),
    ],
    ids=lambda words: "-".join(words[:2] + words[-1:]).replace("/", "_"),
)
def test_a_wrong_call_gets_one_line(
    words, names, hold, hold_model, tmp_path, capsys, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = [word.replace("HOLD", str(hold)) for word in words]
    refused(capsys, *(word.replace("MODEL", str(hold_model)) for word in words), named=names)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [
        ["fit", "HOLD", "-o", "TAKEN"],
        ["evaluate", "HOLD", "--model", "MODEL", "-o", "TAKEN"],
        ["export", "HOLD", "-o", "TAKEN"],
        ["map", "HOLD", "-o", "TAKEN"],
        ["map", "HOLD", "-o", "new.csv", "--figure", "TAKEN.png"],
        ["pressure", "HOLD", "-o", "TAKEN"],
        ["pareto", "HOLD", "-o", "TAKEN"],
        ["pareto", "HOLD", "--figure", "TAKEN.png"],
        ["report", "HOLD", "-o", "TAKEN.html"],
        ["tile", "scan.stl", "-o", "TAKEN.yaml"],
        ["tile", "scan.stl", "-o", "bench.yaml"],
        ["register", "t.csv", "--landmarks", "l.yaml", "--socket", "s.yaml", "-o", "TAKEN"],
        ["calibrate", "b.csv", "--cluster", "c", "-o", "c.yaml", "--figure", "TAKEN.png"],
    ],
    ids=lambda words: "-".join(word for word in (words[0], *words[-2:])),
)
def test_no_output_replaces_a_file_unless_that_is_asked_for(
    words, hold, hold_model, tmp_path, capsys, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for suffix in (".csv", ".png", ".html"):
        (tmp_path / f"bench{suffix}").write_text("data of a day")
    taken = {name: (tmp_path / name).read_text() for name in ("bench.csv", "bench.png")}
    places = {"HOLD": hold, "MODEL": hold_model, "TAKEN.": "bench.", "TAKEN": "bench.csv"}
    for name, path in places.items():
        words = [word.replace(name, str(path)) for word in words]
    if words[-1] == "bench.yaml" and words[1] == "scan.stl":
        (tmp_path / "bench.html").unlink()  # what a tile's picture would replace
    refused(capsys, *words, named=["exists already"])
    assert {name: (tmp_path / name).read_text() for name in taken} == taken
    assert not (tmp_path / "new.csv").exists()


def test_a_model_replaces_an_older_one_where_that_is_asked_for(hold, tmp_path, capsys) -> None:
    model = tmp_path / "m.json"
    assert call(capsys, "fit", hold, "-o", model)[0] == 0
    older = model.read_text()
    code, _, err = call(capsys, "fit", hold, "-o", model, "--variant", "stiffness")
    assert code == 1 and "--replace" in err and model.read_text() == older
    words = ["fit", hold, "-o", model, "--variant", "stiffness", "--replace"]
    assert call(capsys, *words)[0] == 0
    assert model.read_text() != older


def test_every_verb_that_names_an_output_file_can_replace_it() -> None:
    for verb, module in VERBS.items():
        found = options_of(f"commands.{module}.{verb}").values()
        known = {option.name for options in found for option in options}
        if known & {"output", "figure"} and verb not in {"simulate", "demo"}:
            assert "replace" in known, verb


def test_a_trial_of_another_kind_is_shown_and_refused(shared_data: Path, capsys) -> None:
    code, out, err = call(capsys, "info", shared_data / "rosbag2" / "talker")
    assert code == 1
    assert "/topic" in out and " 10 " in out
    assert "has no topic 'trigger'" in err


def test_a_ramp_has_no_plateau_to_fit_on(tmp_path: Path, capsys) -> None:
    trial = tmp_path / "ramp"
    call(capsys, "simulate", "-o", trial, "--scenario", "ramp", "--duration", 40)
    code, _, err = call(capsys, "fit", trial, "-o", tmp_path / "m.json")
    assert code == 1 and "no plateau" in err and "(the part under load)" in err
    assert not (tmp_path / "m.json").exists()


def test_a_model_of_another_socket_is_refused(trial, hold_model, capsys) -> None:
    def rename(document) -> None:
        old = next(name for name in document["tiles"] if name.startswith("h"))
        document["tiles"]["renamed"] = document["tiles"].pop(old)
        document["neighbours"] = [
            ["renamed" if name == old else name for name in pair] for pair in document["neighbours"]
        ]

    edit(trial / "socket.yaml", rename)
    code, _, err = call(capsys, "evaluate", trial, "--model", hold_model)
    assert code == 1 and "another socket" in err


def test_the_map_has_every_tile_with_its_uncertainty(hold: Path, tmp_path: Path, capsys) -> None:
    """The verb, the function and the columns of `export` give the same."""
    output, figure = tmp_path / "map.csv", tmp_path / "map.png"
    code, out, _ = call(capsys, "map", hold, "--segment", "20:30", "-o", output, "--figure", figure)
    assert code == 0
    assert "measured: wrench, brim_lateral" in out
    assert figure.stat().st_size > 10_000
    written = pd.read_csv(output, index_col=0)
    found = st.force_map(st.open_trial(hold), "20:30")
    expected = found.to_dataframe()
    pd.testing.assert_frame_equal(written, expected)
    assert len(expected.columns) == 10 * len(found.trial.geometry)
    assert found.summary()["pressure [kPa]"].is_monotonic_decreasing
    exported = st.export(st.open_trial(hold), tmp_path / "all.csv", "20:30", force_map=True)
    shown = exported.filter(regex="^map")
    np.testing.assert_array_equal(shown.to_numpy(), expected.to_numpy())


@pytest.mark.parametrize("chosen", [None, "SUBNET"])
def test_a_graph_stays_on_this_machine_unless_told_otherwise(
    chosen: str | None, hold: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "ROS_AUTOMATIC_DISCOVERY_RANGE"
    monkeypatch.delenv(name)
    if chosen:
        monkeypatch.setenv(name, chosen)
    assert run(["info", str(hold)]) == 0
    assert os.environ[name] == (chosen or "LOCALHOST")
