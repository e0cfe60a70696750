"""The real graph: nodes in processes of their own, DDS between them, a subscriber outside."""

import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, SetParameters
from socket_testbed_msgs.msg import ClusterCapacitance, ClusterCapacitanceArray
from std_srvs.srv import Trigger as TriggerService
from support import HANGS
from support.bags import move_to_namespace, wrench_vector
from support.graph import Probe
from support.pace import careful_time_scale

from socket_testbed.api import simulate
from socket_testbed.calibration.model import read_calibration
from socket_testbed.errors import TestbedError
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.identification.model_file import read_model
from socket_testbed.live.bringup import replay_with_estimator
from socket_testbed.live.processes import Graph
from socket_testbed.nodes.listeners import EstimateListener
from socket_testbed.settings.testbed import (
    CalibrationNodeSettings,
    EstimatorSettings,
    ReplaySettings,
    WindowSettings,
)
from socket_testbed.trials.layout import stamp_of
from socket_testbed.trials.messages import stress_packer, wrench_packer
from socket_testbed.trials.topics import (
    CAPACITANCE,
    DIAGNOSTICS,
    ESTIMATED_WRENCH,
    FORCE_MAP,
    LOCAL_FORCES,
    PARAMETERS,
    PRESSURE_MAP,
    STRESS,
    TRIGGER,
    WRENCH,
)
from socket_testbed.trials.trial import Trial

pytestmark = pytest.mark.graph

NO_FIT = EstimatorSettings(auto_fit=False)


def last(diagnostics: list, node: str) -> list:
    """The values of a node's newest diagnostics."""
    found = [s.values for m in diagnostics for s in m.status if s.name == f"/{node}"]
    return found[-1] if found else []


def last_count(diagnostics: list, node: str, key: str) -> int:
    """A figure of a node's newest diagnostics, 0 where there is none yet."""
    return int({v.key: v.value for v in last(diagnostics, node)}.get(key, 0))


def test_every_sample_is_predicted_as_the_model_does_offline(hold: Path, hold_model: Path) -> None:
    trial = Trial(hold)
    settings = dataclasses.replace(NO_FIT, model=str(hold_model))
    replay = ReplaySettings(trial=str(hold), rate=50.0, wait_for=(EstimateListener.NAME,))
    with EstimateListener() as listener:
        replay_with_estimator(trial, replay, settings)
        stamps = trial.samples().stamps.tolist()
        assert [len(found) for found in listener.estimates.values()] == [240, 240, 240]
        wrench, forces, maps = (listener.series(topic, stamps) for topic in listener.estimates)
        assert listener.models == 1
    model = read_model(hold_model).model
    samples = trial.samples()
    np.testing.assert_allclose(wrench, model.wrench(samples.pose), atol=1e-9)
    np.testing.assert_allclose(forces, model.forces(samples.pose), atol=1e-9)
    # Where a marker was occluded the prediction is NaN, never an old one.
    assert np.isnan(wrench[np.isnan(samples.pose).any(axis=1)]).all()
    # The force map is the same as offline, and asks for no marker.
    offline = ForceMap(trial.geometry, samples.clusters).estimate(samples)
    np.testing.assert_allclose(maps[:, 0, :, :3], offline.forces, atol=1e-9)
    np.testing.assert_allclose(maps[:, 1, :, :3], offline.standard_deviations, atol=1e-9)
    np.testing.assert_allclose(maps[:, 0, :, 3], offline.normal_pressure)


def test_a_map_needs_neither_a_model_nor_the_motion_capture() -> None:
    """Two topics of one stamp are enough for the force map and its picture."""
    geometry = read_socket(packaged("config", "socket.yaml"))
    count = len(geometry.clusters)
    stress = np.tile([1e4, 500.0, -500.0], (count, 1))
    wrench = np.array([1.0, 2.0, 0.0, 5.0, 0.0, -200.0])
    pack_stress, pack_wrench = stress_packer(list(geometry.clusters)), wrench_packer()
    with Graph() as graph, Probe() as probe:
        maps, pictures = probe.listen(FORCE_MAP), probe.listen(PRESSURE_MAP)
        graph.start("estimator_node", NO_FIT)
        publishers = [probe.publisher(topic) for topic in (STRESS, WRENCH)]
        sent = 0

        def send_until_heard() -> bool:
            nonlocal sent
            sent += 1
            stamp = sent * 250_000_000
            publishers[0].publish(pack_stress(stamp, stress, np.zeros(count, dtype=np.uint8)))
            publishers[1].publish(pack_wrench(stamp, wrench))
            return len(maps) > 0 and len(pictures) > 0

        probe.wait(send_until_heard, "a map")
    found = maps[0]
    forces = np.array(
        [geometry.cluster_force(c, s) for c, s in zip(geometry.clusters, stress, strict=True)]
    )
    expected = ForceMap(geometry, tuple(geometry.clusters)).update(
        wrench, forces, np.zeros(count, dtype=np.uint8)
    )
    assert found.header.frame_id == "load_cell" and tuple(found.names) == geometry.names
    np.testing.assert_allclose([(f.x, f.y, f.z) for f in found.forces], expected.forces[0])
    np.testing.assert_allclose(found.normal_pressure, expected.normal_pressure[0])
    assert len(pictures[0].markers) == 2 * len(geometry)


@pytest.fixture(scope="module")
def stiff_hold(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hold of a limb that hardly creeps, which a model of its first half predicts."""
    path = tmp_path_factory.mktemp("stiff") / "hold"
    simulate(path, duration=60.0, seed=3, tissue="stiff")
    return path


def test_another_process_subscribes_while_the_command_replays_and_estimates(
    stiff_hold: Path,
) -> None:
    """What the README says: `replay --estimate` in one terminal, a subscriber in another."""
    hold = stiff_hold
    with Probe() as probe:
        wrenches = probe.listen(ESTIMATED_WRENCH)
        forces = probe.listen(LOCAL_FORCES)
        models = probe.listen(PARAMETERS)
        maps = probe.listen(PRESSURE_MAP)
        stresses = probe.listen(STRESS)
        command = [sys.executable, "-m", "socket_testbed", "replay", str(hold)]
        # The first fit takes a busy machine many seconds: the replay takes 15 to 60 s.
        rate = max(4.0 * careful_time_scale(), 1.0)
        done = subprocess.run(
            [*command, "--rate", str(rate), "--estimate", "--variant", "stiffness_bias"],
            check=False,
            capture_output=True,
            timeout=HANGS,
        )
        assert done.returncode == 0, done.stderr.decode()
        probe.wait(lambda: all((wrenches, forces, models, maps, stresses)), "the estimates")
    assert [m.variant for m in models] == ["stiffness_bias"] * len(models) != []
    tiles = Trial(hold).geometry.names
    assert list(models[0].names) == list(forces[0].names) == list(tiles)
    assert models[0].samples >= WindowSettings().least_samples
    assert set(models[0].bias_names) == set(Trial(hold).geometry.clusters)
    assert "KKT" in models[0].solver_status
    assert maps and len(maps[0].markers) == 2 * len(tiles)
    stamps = [stamp_of(m) for m in wrenches]
    assert stamps == sorted(stamps) and set(stamps) <= set(Trial(hold).samples().stamps)
    assert {m.header.frame_id for m in wrenches + forces} == {"load_cell"}
    # On the hold, the live prediction is the load.
    samples = Trial(hold).samples()
    measured = dict(zip(samples.stamps.tolist(), samples.wrench, strict=True))
    errors = [
        wrench_vector(m.wrench) - measured[s]
        for s, m in zip(stamps, wrenches, strict=True)
        if measured[s][5] < -250.0
    ]
    assert np.sqrt(np.nanmean(np.square(errors), axis=0))[3:].max() < 5.0


def test_a_fit_when_asked_answers_and_predicts(hold: Path) -> None:
    with Graph() as graph, Probe() as probe:
        models = probe.listen(PARAMETERS)
        wrenches = probe.listen(ESTIMATED_WRENCH)
        diagnostics = probe.listen(DIAGNOSTICS)
        graph.start("calibration_node", CalibrationNodeSettings(), use_sim_time=True)
        graph.start("estimator_node", NO_FIT, use_sim_time=True)
        answer = probe.call(TriggerService, "estimator/fit", TriggerService.Request())
        assert not answer.success and "only 0 of 0 samples" in answer.message
        # Each round starts the window anew: one lasts long enough for 60 samples and the fit.
        replay = ReplaySettings(
            trial=str(hold), rate=4.0, wait_for=("calibration_node", "estimator_node")
        )
        graph.start("replay_node", dataclasses.replace(replay, loop=True))

        probe.wait(lambda: last_count(diagnostics, "estimator_node", "window") > 60, "samples")
        assert not models and not wrenches
        answer = probe.call(TriggerService, "estimator/fit", TriggerService.Request())
        assert answer.success, answer.message
        probe.wait(lambda: len(models) == 1 and len(wrenches) > 50, "predictions")
        assert models[0].samples > 50
        probe.listen(PARAMETERS)
        probe.wait(lambda: len(models) == 2, "the model for a late subscriber")
        assert models[1] == models[0]


def test_the_calibration_node_says_what_it_could_not_read() -> None:
    nan = float("nan")
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    messages = {
        "brim_lateral": ([5.1, 5.2, 5.3, 5.2], [0, 0, 0, 0]),
        "mid_anterior": ([5.1, nan, 5.3, 5.2], [0, 2, 0, 0]),
        "posterior_distal": ([5.1, nan, 5.3, 5.2], [0, 1, 0, 0]),
        "distal": ([50.1, 50.2, 50.3, 50.2], [0, 0, 0, 0]),
        "unknown": ([5.1, 5.2, 5.3, 5.2], [0, 0, 0, 0]),
    }
    with Graph() as graph, Probe() as probe:
        stresses = probe.listen(STRESS)
        diagnostics = probe.listen(DIAGNOSTICS)
        graph.start("calibration_node", CalibrationNodeSettings())
        publisher = probe.publisher(CAPACITANCE)
        probe.wait(lambda: probe.node.count_publishers("/clusters/stress") == 1, "the node")
        message = ClusterCapacitanceArray()
        message.header.stamp.sec = 7
        message.clusters = [
            ClusterCapacitance(name=name, capacitance=c, status=s)
            for name, (c, s) in messages.items()
        ]

        def send_until_heard() -> bool:
            publisher.publish(message)
            return len(stresses) > 0

        probe.wait(send_until_heard, "stresses")
        probe.wait(
            lambda: any(
                "no calibration for unknown" in s.message for m in diagnostics for s in m.status
            ),
            "a diagnostics message",
        )
        levels = {s.level for m in diagnostics for s in m.status if "unknown" in s.message}
        assert levels == {DiagnosticStatus.ERROR}
    by_name = {c.name: c for c in stresses[0].clusters}
    assert stresses[0].header.stamp.sec == 7
    assert [by_name[name].status for name in messages] == [0, 2, 1, 3, 2]
    for name in ("mid_anterior", "posterior_distal", "unknown"):
        assert np.isnan([by_name[name].normal, by_name[name].shear_x, by_name[name].shear_y]).all()
    expected, _ = calibration.clusters["brim_lateral"].apply(
        np.array(messages["brim_lateral"][0]), np.zeros(4, dtype=np.uint8)
    )
    got = by_name["brim_lateral"]
    np.testing.assert_allclose([got.normal, got.shear_x, got.shear_y], expected)


def test_parameters_are_described_checked_and_changed_at_run_time() -> None:
    def setting(name: str, **value: object) -> Parameter:
        return Parameter(name=name, value=ParameterValue(**value))

    double, integer, text = (
        ParameterType.PARAMETER_DOUBLE,
        ParameterType.PARAMETER_INTEGER,
        ParameterType.PARAMETER_STRING,
    )
    with Graph() as graph, Probe() as probe:
        graph.start("estimator_node", EstimatorSettings())

        def change(parameter: Parameter):
            request = SetParameters.Request(parameters=[parameter])
            return probe.call(SetParameters, "estimator_node/set_parameters", request).results[0]

        theta = "identification.theta"
        described = probe.call(
            DescribeParameters,
            "estimator_node/describe_parameters",
            DescribeParameters.Request(names=[theta]),
        ).descriptors[0]
        assert "wrench" in described.description
        assert (
            described.floating_point_range[0].from_value,
            described.floating_point_range[0].to_value,
        ) == (0, 1)
        assert change(setting(theta, type=double, double_value=0.25)).successful
        assert change(setting(theta, type=integer, integer_value=1)).successful
        refused = change(setting(theta, type=double, double_value=1.5))
        assert not refused.successful and refused.reason
        refused = change(setting("identification.variant", type=text, string_value="stifness_bias"))
        assert not refused.successful and "did you mean 'stiffness_bias'?" in refused.reason
        refused = change(setting("identification.solver", type=text, string_value="osqqp"))
        assert not refused.successful and "did you mean 'osqp'?" in refused.reason


@pytest.mark.parametrize(
    ("node", "parameters", "names"),
    [
        ("estimator_node", {"identification.variant": "stifness"}, ["variant", "stifness"]),
        (
            "estimator_node",
            {"identification.solver": "osqqp"},
            ["'osqqp' is not installed", "'osqp'"],
        ),
        ("estimator_node", {"geometry": "nowhere.yaml"}, ["nowhere.yaml"]),
        ("calibration_node", {"calibration": "nowhere.yaml"}, ["nowhere.yaml"]),
        ("replay_node", {}, ["trial is empty"]),
        ("replay_node", {"trial": "nowhere"}, ["nowhere", "no such trial"]),
        ("recorder_node", {"record": "true", "directory": "/proc/trial"}, ["/proc/trial"]),
        ("recoder_node", {}, ["there is no node", "did you mean 'recorder_node'?"]),
    ],
)
def test_a_node_that_cannot_start_says_why_in_one_line(node, parameters, names) -> None:
    words = [word for k, v in parameters.items() for word in ("-p", f"{k}:={v}")]
    done = subprocess.run(
        [sys.executable, "-m", "socket_testbed.nodes", node, "--ros-args", *words],
        check=False,
        capture_output=True,
        text=True,
        timeout=HANGS,
    )
    assert done.returncode == 1
    assert "Traceback" not in done.stderr and done.stderr.count("error: ") == 1, done.stderr
    for name in names:
        assert name in done.stderr


def test_a_program_with_a_node_s_name_runs_that_node() -> None:
    """What `ros2 run socket_testbed calibration_node` does."""
    words = ["/bin/calibration_node", "--ros-args", "-p", "calibration:=nowhere.yaml"]
    script = (
        f"import sys; sys.argv = {words}\nfrom socket_testbed.nodes.__main__ import main\nmain()"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], check=False, capture_output=True, text=True, timeout=HANGS
    )
    assert done.returncode == 1 and "nowhere.yaml" in done.stderr, done.stderr


def test_a_trial_that_breaks_off_ends_its_replay_with_one_line(hold, tmp_path: Path) -> None:
    broken = Path(shutil.copytree(hold, tmp_path / "hold"))
    data = bytearray((broken / "hold.mcap").read_bytes())
    middle = len(data) // 3
    data[middle : middle + 4000] = b"\xff" * 4000
    (broken / "hold.mcap").write_bytes(data)
    done = subprocess.run(
        [sys.executable, "-m", "socket_testbed", "replay", str(broken), "--rate", "100"],
        check=False,
        capture_output=True,
        text=True,
        timeout=HANGS,
    )
    assert done.returncode == 1
    assert "hold.mcap: " in done.stderr and "Traceback" not in done.stderr
    assert "replay_node ended with exit code 1" in done.stderr


def test_a_killed_command_leaves_no_node(hold: Path) -> None:
    with Probe() as probe:
        diagnostics = probe.listen(DIAGNOSTICS)
        command = [sys.executable, "-m", "socket_testbed", "replay", str(hold), "--estimate"]
        replay = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        probe.wait(lambda: len(last(diagnostics, "estimator_node")) > 0, "the estimator")
        replay.kill()
        # The pipe closes when the last process that holds it has ended.
        replay.communicate(timeout=HANGS)


@pytest.mark.parametrize("given", ["", "left"])
def test_a_trial_is_estimated_where_it_was_recorded_or_in_a_given_namespace(
    hold: Path, hold_model: Path, tmp_path: Path, given: str
) -> None:
    target = move_to_namespace(hold, tmp_path / "lab", "/lab")
    namespace = f"/{given or 'lab'}"
    with Probe() as probe:
        forces = probe.listen(LOCAL_FORCES, f"{namespace}/estimate/local_forces")
        triggers = {name: probe.listen(TRIGGER, f"{name}/trigger") for name in ("/lab", "/left")}
        settings = dataclasses.replace(NO_FIT, model=str(hold_model))
        replay = ReplaySettings(trial=str(target), rate=20.0, namespace=given)
        replay_with_estimator(Trial(target), replay, settings)
        probe.wait(lambda: len(forces) > 0, "forces in the namespace")
        assert [name for name, messages in triggers.items() if messages] == [namespace]
    assert len(forces[0].forces) == len(Trial(hold).geometry)


def test_a_node_that_dies_ends_the_command_with_its_name(hold: Path, tmp_path: Path) -> None:
    document = json.loads((hold.parent / "model.json").read_text())
    document["format"] = "another"
    spoilt = tmp_path / "model.json"
    spoilt.write_text(json.dumps(document))
    settings = dataclasses.replace(NO_FIT, model=str(spoilt))
    with pytest.raises(TestbedError, match="estimator_node ended with exit code 1"):
        replay_with_estimator(Trial(hold), ReplaySettings(trial=str(hold), rate=50.0), settings)
