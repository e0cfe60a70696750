"""The launch files, with stand-ins for launch and launch_ros, which only a ROS installation has."""

import re
import runpy
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import yaml
from support import CHECKOUT
from support.bags import add_events
from support.clocks import FakeClock
from support.testbeds import simulated_parameters

from socket_testbed.drivers import DeviceBusyError
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import packaged
from socket_testbed.live import hardware
from socket_testbed.live.bringup import Testbed
from socket_testbed.live.processes import RESTARTED, STOP_TIMEOUT
from socket_testbed.settings.testbed import TestbedSettings, read_testbed
from socket_testbed.simulation.world import World


class Stub:
    """Stands for any class of launch: it keeps what it is made with."""

    def __init__(self, *positional: Any, **given: Any) -> None:
        self.positional, self.given = positional, given

    def perform(self, context: dict[str, str]) -> str:
        return context[self.positional[0]]


class Context(dict[str, str]):
    """The context of a launch: the arguments, and what groups around it have set."""

    launch_configurations: dict[str, str]


@pytest.fixture
def launch(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[Stub]]:
    """Runs a launch file with arguments; returns the actions that it gives."""

    class Anything(ModuleType):
        def __getattr__(self, attribute: str) -> type[Stub]:
            return Stub

    parts = ("actions", "event_handlers", "events", "events.process", "substitutions")
    for module in ("launch", "launch_ros", "launch_ros.actions", *(f"launch.{p}" for p in parts)):
        monkeypatch.setitem(sys.modules, module, Anything(module))
    kept = []

    def run(name: str, pushed: str = "", **arguments: object) -> list[Stub]:
        program = runpy.run_path(str(CHECKOUT / "launch" / f"{name}.launch.py"))
        kept.append(program)
        (actions,) = program["generate_launch_description"]().positional
        shared = {("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"), ("OPENBLAS_NUM_THREADS", "1")}
        assert shared <= {a.positional for a in actions}
        arguments_of = [a for a in actions if len(a.positional) == 1]
        assert all(action.given["description"] for action in arguments_of)
        declared = {a.positional[0]: a.given.get("default_value") for a in arguments_of}
        context = Context({key: str(value) for key, value in (declared | arguments).items()})
        context.launch_configurations = {"ros_namespace": pushed} if pushed else {}
        (bring_up,) = (a.given["function"] for a in actions if "function" in a.given)
        return bring_up(context)

    return run


def nodes(actions: list[Stub]) -> dict[str, Stub]:
    return {a.given["name"]: a for a in actions if "executable" in a.given}


def handler(actions: list[Stub]) -> dict[str, Any]:
    (found,) = (a.positional[0] for a in actions if a.positional and type(a.positional[0]) is Stub)
    return found.given


def parameters(action: Stub) -> dict[str, Any]:
    (file,) = action.given["parameters"]
    content = yaml.safe_load(Path(file).read_text())
    return content[f"/**/{action.given['name']}"]["ros__parameters"]


def environment(command: str) -> set[str]:
    """Environment of the process whose command contains these words."""
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if command in (process / "cmdline").read_text():
                return {*(process / "environ").read_text().split("\0")}
    raise AssertionError(f"no process {command}")


def test_the_testbed_is_launched_as_run_starts_it(launch, tmp_path: Path) -> None:
    record, calibration = tmp_path / "trial", tmp_path / "calibration.yaml"
    calibration.write_bytes(packaged("config", calibration.name).read_bytes())
    changed = {
        "mocap_node": {"server": "192.0.2.1"},
        "trigger_node": {"rate": 20},
        "calibration_node": {"calibration": str(calibration)},
        "recorder_node": {"record": True, "directory": str(record)},
    }
    params = simulated_parameters(tmp_path, **changed)
    launched, settings = nodes(launch("testbed", params=params)), read_testbed(params)
    described = Testbed(settings, calibration=calibration, record=record).nodes(tmp_path)
    assert list(launched) == [node.name for node in described]
    for node in described:
        action, found = launched[node.name], parameters(launched[node.name])
        on_exit, running = action.given["on_exit"], SimpleNamespace(is_shutdown=False)
        (again,) = on_exit(SimpleNamespace(returncode=-9), running)
        restarted = again.given["actions"][0].given
        assert restarted["executable"] == node.name and RESTARTED in restarted["additional_env"]
        assert RESTARTED not in action.given["additional_env"]
        (end,) = on_exit(SimpleNamespace(returncode=1), running)  # wrong input, if it is needed
        assert ("event" in end.given) != node.optional
        assert not on_exit(SimpleNamespace(returncode=1), SimpleNamespace(is_shutdown=True))
        assert not on_exit(SimpleNamespace(returncode=0), running), "it ended cleanly"
        assert not found.pop("use_sim_time")
        expected = node.settings.to_flat()
        assert set(found) == set(expected)
        for name, value in expected.items():
            if name not in {"tare_file", "parameters"}:  # in the launch's own folder
                assert found[name] == ([""] if value == [] else value), name
    assert "recorder_node" in parameters(launched["trigger_node"])["wait_for"]
    stored = Path(parameters(launched["recorder_node"])["parameters"])
    assert read_testbed(stored).trigger_node.rate == 20.0
    predicting = replace(settings.estimator_node, model="model.json", auto_fit=False)
    Testbed(replace(settings, estimator_node=predicting), record=record).nodes(tmp_path)
    stored = read_testbed(tmp_path / "stored.yaml").estimator_node
    assert stored.auto_fit, "a replay has no model, so it fits"


@pytest.mark.graph
def test_a_simulated_testbed_is_launched_with_its_world(launch, capsys) -> None:
    actions = launch("testbed", simulated="true", namespace="left", time_scale="0.5")
    launched = nodes(actions)
    try:
        clock = [a.positional for a in actions if len(a.positional) == 2]
        assert ("SOCKET_TESTBED_TIME_SCALE", "0.5") in clock
        assert all(action.given["namespace"] == "/left" for action in launched.values())
        simulated = ("trigger_node", "cluster_node", "load_cell_node")
        (folder,) = {parameters(launched[name])["simulation"] for name in simulated}
        assert World(Path(folder)).port, "the world is up"
        inherited = environment(f"socket_testbed.simulation.testbed\0{folder}")
        assert {f"{name}={value}" for name, value in clock} <= inherited, "one origin for all"
    finally:
        handler(actions)["on_shutdown"](None, None)
    assert "Traceback" not in capsys.readouterr().err


def test_a_launch_s_files_outweigh_the_parameters(launch, tmp_path: Path) -> None:
    own = {name: tmp_path / f"own_{name}.yaml" for name in ("socket", "calibration")}
    for name, file in own.items():
        file.write_bytes(packaged("config", f"{name}.yaml").read_bytes())
    files = {"geometry": own["socket"], "calibration": own["calibration"]}
    params = simulated_parameters(tmp_path, mocap_node={"server": "192.0.2.1"})
    launched = nodes(launch("testbed", params=params, **files))
    found = {name: parameters(action) for name, action in launched.items()}
    assert found["mocap_node"]["geometry"] == str(own["socket"])
    assert found["estimator_node"]["geometry"] == str(own["socket"])
    assert found["calibration_node"]["calibration"] == str(own["calibration"])


@pytest.mark.parametrize("scale", ["0.5", "2.0"], ids=["slower", "faster"])
def test_a_time_scale_without_simulation_is_refused(launch, scale: str) -> None:
    words = "time_scale is for simulated hardware: add simulated:=true"
    with pytest.raises(ConfigurationError, match=words):
        launch("testbed", time_scale=scale)


def test_a_launch_beside_another_testbed_is_refused(
    launch, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is waited for 3 s, in which a testbed that is ending frees its buses."""
    tried: list[float] = []

    def find_user(settings: TestbedSettings) -> DeviceBusyError:
        tried.append(clock.now)
        return DeviceBusyError("i2c-1", "process 4711, socket-testbed run")

    clock = FakeClock().install(monkeypatch)
    monkeypatch.setattr(hardware, "find_user", find_user)
    words = r"another program uses i2c-1 \(process 4711, socket-testbed run\): end it first"
    params = simulated_parameters(tmp_path, mocap_node={"server": "192.0.2.1"})
    with pytest.raises(DeviceBusyError, match=words):
        launch("testbed", params=params)
    assert tried[-1] - tried[0] == pytest.approx(3.0, abs=0.2)


def test_a_wrong_parameter_ends_a_launch(launch, tmp_path: Path) -> None:
    """Before any node starts."""
    given = {"identification": {"leave_out": ["Fzz"]}}
    params = simulated_parameters(tmp_path, estimator_node=given)
    with pytest.raises(ConfigurationError, match="Fz"):
        launch("testbed", params=params, simulated="true")


def test_a_trial_is_replayed_in_its_namespace(launch, hold: Path, tmp_path: Path) -> None:
    lab = add_events(hold, tmp_path / "lab", [], "/lab").path
    own = packaged("config", "calibration.yaml")
    actions = launch("replay", trial=lab, rate="2", loop="true", calibration=own)
    launched = nodes(actions)
    assert list(launched) == ["calibration_node", "estimator_node", "replay_node"]
    assert launched["estimator_node"].given["namespace"] == "/lab"
    found = {name: parameters(action) for name, action in launched.items()}
    replay = found["replay_node"]
    assert (replay["trial"], replay["rate"], replay["loop"]) == (str(lab), 2.0, True)
    assert replay["wait_for"] == ["/lab/calibration_node", "/lab/estimator_node"]
    assert found["calibration_node"]["use_sim_time"] and found["estimator_node"]["use_sim_time"]
    assert found["calibration_node"]["calibration"] == str(own)
    assert handler(actions)["target_action"] is launched["replay_node"]  # its end ends the launch


@pytest.mark.parametrize(
    ("given", "pushed", "expected"),
    [
        ("", "", "/"),
        ("left", "", "/left"),
        ("", "/lab", "/lab"),
        ("left", "/lab", "/lab/left"),
        ("/left", "/lab", "/left"),
    ],
    ids=["none", "given", "group", "in group", "absolute"],
)
def test_a_group_s_namespace_precedes_a_relative_one(
    given: str, pushed: str, expected: str, launch, hold: Path, tmp_path: Path
) -> None:
    params = simulated_parameters(tmp_path, mocap_node={"server": "192.0.2.1"})
    actions = launch("testbed", pushed, params=params, namespace=given)
    assert {action.given["namespace"] for action in nodes(actions).values()} == {expected}
    launched = nodes(launch("replay", pushed, trial=hold, namespace=given))
    assert {action.given["namespace"] for action in launched.values()} == {expected}
    followers = parameters(launched["replay_node"])["wait_for"]
    assert followers[0] == f"{expected.rstrip('/')}/calibration_node"


def test_systemd_waits_for_three_stops_of_a_graph() -> None:
    text = (CHECKOUT / "config/socket_testbed.service").read_text()
    (limit,) = re.findall(r"^TimeoutStopSec=(\d+)$", text, re.MULTILINE)
    assert float(limit) >= 3 * STOP_TIMEOUT
