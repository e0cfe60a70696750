"""Every option of the verbs that run a graph, a page or the demo arrives where it has its effect.

A case holds the words of an option and what they change at the next layer, compared with the call
without them. A new option without a case is an error.
"""

import shutil
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.arrivals import (
    Stage,
    call_verb,
    changes,
    defaults_of_verb,
    joined,
    plain,
    write_files,
)

from socket_testbed import api
from socket_testbed.commands import demo, live
from socket_testbed.commands.calls import CALLS
from socket_testbed.errors import TestbedError
from socket_testbed.live.bringup import Testbed
from socket_testbed.live.processes import GraphNode
from socket_testbed.trials.trial import Trial

START = 100.0  # [s] on the clock


@pytest.fixture(scope="module")
def folder(scene_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the scene twice, its files, a model, and settings; calls are made in it."""
    path = tmp_path_factory.mktemp("live")
    for name in ("scene", "second"):
        (path / name).mkdir()
        for file in scene_folder.iterdir():
            (path / name / file.name).symlink_to(file)
    for name in ("socket.yaml", "calibration.yaml"):
        shutil.copy(scene_folder / name, path / name)
    write_files(path)
    return path


@pytest.fixture
def stage(folder: Path, trial: Trial, monkeypatch: pytest.MonkeyPatch) -> Iterator[Stage]:
    """The stage for calls of one verb, in the folder of the files."""
    monkeypatch.chdir(folder)
    return Stage(monkeypatch, trial)


class Clock:
    """A clock that sleeping, and each look at a graph, moves on."""

    def __init__(self) -> None:
        self.now = START

    def monotonic(self) -> float:
        return self.now

    def sleep(self, duration: float) -> None:
        self.now += duration


def keep_nodes(stage: Stage, nodes: list[GraphNode]) -> None:
    """Keep the settings, namespaces and processes of nodes."""
    for node in nodes:
        flat = node.settings.to_flat()
        stage.seen |= {f"{node.name}.{name}": plain(value) for name, value in flat.items()}
        stage.seen |= {f"namespace of {node.name}": node.namespace}


def graph_on(stage: Stage, clock: Clock) -> type:
    """A graph that starts nothing, and that is watched once a second for 1000 s at most."""

    class Graph:
        folder = Path("graph")

        def __init__(self, *given: Any) -> None: ...

        def __enter__(self) -> "Graph":
            self.folder.mkdir(exist_ok=True)
            return self

        def __exit__(self, *error: object) -> None: ...

        def start(self, name: str, settings: Any, namespace: str = "/") -> None:
            keep_nodes(stage, [GraphNode(name, settings, namespace)])

        def start_nodes(self, nodes: list[GraphNode]) -> None:
            keep_nodes(stage, nodes)

        def watch(self, over: Callable[[], bool], say: Any) -> None:
            while not over() and clock.now < START + 1000.0:
                clock.sleep(1.0)
            stage.seen["ends after"] = clock.now - START

        def wait(self, name: str) -> None: ...

    return Graph


def status_on(stage: Stage) -> type:
    """A status that has seen a trigger, and keeps what it is given."""

    class Status:
        output, renew, triggered = None, None, True
        trials: frozenset[str] = frozenset()

        def __init__(self, disk: Any = None, **given: Any) -> None:
            stage.seen |= {"disk": plain(disk)} | {f"status {n}": v for n, v in given.items()}

        def __enter__(self) -> "Status":
            return self

        def __exit__(self, *error: object) -> None: ...

        def say(self, line: str) -> None: ...

        def follow(self, namespace: str = "/", absent: object = ()) -> None:
            stage.seen["followed"] = namespace

    return Status


def keep_testbed(stage: Stage, testbed: Testbed) -> None:
    """Keep all of a testbed."""
    for name, settings in testbed.settings.nodes().items():
        stage.seen |= {f"{name}.{key}": plain(value) for key, value in settings.to_flat().items()}
    stage.seen |= {"socket": plain(testbed.geometry), "calibration": plain(testbed.calibration)}
    stage.seen |= {"record": plain(testbed.record), "at once": testbed.at_once}
    stage.seen |= {"one process": testbed.one_process} | testbed.metadata.stated()
    if testbed.simulation is not None:
        stage.seen |= {f"simulated {k}": v for k, v in asdict(testbed.simulation).items()}


class World:
    """A world that keeps its faults."""

    def __init__(self, stage: Stage) -> None:
        self.faults = SimpleNamespace(switch=lambda name, to: stage.seen.update({name: to}))


Prepare = Callable[[Stage, Clock], None]
PREPARE: dict[str, Prepare] = {}


def prepares(function: Prepare) -> Prepare:
    """Register the preparation of a verb by its name, without `prepare_`."""
    PREPARE[function.__name__.removeprefix("prepare_")] = function
    return function


@prepares
def prepare_demo(stage: Stage, clock: Clock) -> None:
    def recorded(trial: Trial, seed: int, log: Path) -> None:
        stage.seen |= {"trial": plain(trial.path), "seed": seed, "log": plain(log), "code": 1}
        raise TestbedError("that is all", "look at what has arrived")

    stage.keep("commands.demo._prepare_folder", "folder")
    stage.replace("commands.demo._record", recorded)


@prepares
def prepare_run(stage: Stage, clock: Clock) -> None:
    def started(graph: Any, testbed: Testbed) -> World:
        keep_testbed(stage, testbed)
        return World(stage)

    fakes = {"time": clock, "StatusLine": status_on(stage), "Graph": graph_on(stage, clock)}
    for name, fake in fakes.items():
        stage.patch.setattr(live, name, fake)
    stage.patch.setattr(live.bringup, "start", started)
    stage.keep("commands.live._summarise", "")
    stage.patch.setattr(live.bringup, "end", lambda graph, testbed: None)
    stage.replace("pages.server.listen", lambda host, port: SimpleNamespace(close=lambda: None))


@prepares
def prepare_doctor(stage: Stage, clock: Clock) -> None:
    def simulated(graph: Any, testbed: Testbed, simulation: Any) -> tuple[Testbed, World]:
        stage.seen["hardware"] = "simulated"
        return testbed, World(stage)

    def examined(testbed: Testbed, *ask: Any) -> list[Any]:
        keep_testbed(stage, testbed)
        stage.seen["pressed"] = bool(ask)
        return []

    stage.patch.setattr(live, "Graph", graph_on(stage, clock))
    stage.patch.setattr(live.bringup, "simulate_hardware", simulated)
    stage.replace("commands.live.examine", examined)
    stage.replace("commands.live.press_test", examined)


@prepares
def prepare_record(stage: Stage, clock: Clock) -> None:
    stage.patch.setattr(live, "Graph", graph_on(stage, clock))
    stage.patch.setattr(live, "StatusLine", status_on(stage))
    stage.keep("commands.live._require_disk", "")
    stage.keep("commands.live._require_end", "ended")

    def written(metadata: Any, file: Path) -> None:
        stage.seen |= metadata.stated()

    stage.replace("commands.live.write_metadata", written)


@prepares
def prepare_replay(stage: Stage, clock: Clock) -> None:
    stage.watch_trials()
    stage.patch.setattr(live, "Graph", graph_on(stage, clock))
    stage.patch.setattr(live, "StatusLine", status_on(stage))


@prepares
def prepare_mark(stage: Stage, clock: Clock) -> None:
    marked = SimpleNamespace(trial="", subscribers=1, notes=lambda: ())
    stage.keep("live.processes.require_ros")
    stage.keep("nodes.controls.publish_event", "label", "", "namespace", returned=marked)


@prepares
def prepare_view(stage: Stage, clock: Clock) -> None:
    stage.watch_trials()
    stage.replace("commands.pages.time", clock)
    stage.patch.setattr(live, "time", clock)
    stage.replace("commands.pages.Graph", graph_on(stage, clock))
    stage.replace("pages.server.listen", lambda host, port: SimpleNamespace(close=lambda: None))

    def viewed(trial: Trial, model: Any, **served: Any) -> Any:
        files = (trial.path, trial.socket_file, trial.calibration_file, trial.load_cell_file)
        names = ("trial", "socket", "calibration", "load cell")
        stage.seen |= {name: plain(file) for name, file in zip(names, files, strict=True)}
        stage.seen |= {"tare": trial.tare, "model": plain(model)} | plain(served)
        return nullcontext(SimpleNamespace(url="http://here"))

    stage.patch.setattr(api, "view", viewed)


Cases = dict[str, tuple[Any, ...]]


class Some(dict[str, Any]):
    """Some of what an option changes, for one that changes nearly all."""


LEAST: dict[str, dict[str, str]] = {
    "demo": {},
    "run": {"simulated": "--simulated", "duration": "--duration 10"},
    "doctor": {"simulated": "--simulated"},
    "record": {"directory": "new"},
    "mark": {"label": "push"},
    "view": {"duration": "--duration 10"},
    "replay": {"trial": "scene", "estimate": "--estimate"},
}
RECORD = {"record": "--record new"}
VIEW = {"view": "--view"}
ESTIMATOR = "estimator_node.identification"
METADATA: Cases = {
    "subject": ("--subject S02", {"subject": "S02"}),
    "side": ("--side left", {"side": "left"}),
    "socket": ("--socket PTB", {"socket": "PTB"}),
    "liner": ("--liner gel", {"liner": "gel"}),
    "mass": ("--mass 82.5", {"mass": 82.5}),
    "operator": ("--operator JD", {"operator": "JD"}),
    "protocol": ("--protocol P1", {"protocol": "P1"}),
    "notes": ("--notes warm", {"notes": "warm"}),
}
SIMULATED: Cases = {
    "scenario": ("--scenario ramp", {"simulated scenario": "ramp"}),
    "period": ("--period 60", {"simulated period": 60.0}),
    "tissue": ("--tissue stiff", {"simulated tissue": "stiff"}),
    "seed": ("--seed 5", {"simulated seed": 5}),
    "donning": ("--donning 3", {"simulated donning": 3}),
    "donning_share": (
        "--donning-share 0.2",
        {"simulated donning_share": 0.2},
        {"donning": "--donning 3"},
    ),
    "fault": (
        "--fault mocap.drop=0.5 --fault limb.out=2",
        {"mocap.drop": 0.5, "limb.out": 2.0},
    ),
}
FILES: Cases = {
    "geometry": ("--geometry socket.yaml", {"socket": "socket.yaml"}),
    "calibration": ("--calibration calibration.yaml", {"calibration": "calibration.yaml"}),
}
FITTED: Cases = {
    "variant": ("--variant stiffness", {f"{ESTIMATOR}.variant": "stiffness"}),
    "theta": ("--theta 0.25", {f"{ESTIMATOR}.theta": 0.25}),
    "weights": ("--weights noise", {f"{ESTIMATOR}.weights": "noise"}),
    "smoothness": ("--smoothness 0.5", {f"{ESTIMATOR}.smoothness": 0.5}),
    "leave_out": ("--leave-out Mz", {f"{ESTIMATOR}.leave_out": ["Mz"]}),
    "solver": ("--solver clarabel", {f"{ESTIMATOR}.solver": "clarabel"}),
}
PARAMS = {
    f"{ESTIMATOR}.theta": 0.2,
    "estimator_node.plateau.least_force": 30.0,
    "estimator_node.force_map.length": 0.05,
}
CASES: dict[str, Cases] = {
    "demo": {
        "output": (
            "-o other",
            {"folder": "other", "trial": "other/trial", "log": "other/live.log"},
        ),
        "seed": ("--seed 5", {"seed": 5}),
    },
    "run": {
        "record": ("--record new", {"record": "new", "disk": "."}),
        "model": (
            "--model model.json",
            {"estimator_node.model": "model.json", "estimator_node.auto_fit": False},
            {"files": "--geometry socket.yaml --calibration calibration.yaml"},
        ),
        "rate": ("--rate 8", {"trigger_node.rate": 8.0}),
        "duration": ("--duration 20", {"ends after": 20.0}),
        "one_process": ("--one-process", {"one process": True}),
        "view": (
            "--view",
            {
                "at once": False,
                "record": "trials",
                "view_node.geometry": "socket.yaml",
                "namespace of view_node": "/",
            },
            {"files": "--geometry socket.yaml"},
        ),
        "view_host": ("--view-host 0.0.0.0", {"view_node.host": "0.0.0.0"}, VIEW),
        "view_port": ("--view-port 8081", {"view_node.port": 8081}, VIEW),
        "time_scale": (
            "--time-scale 0.5",
            {"simulated time_scale": 0.5, "ends after": 20.0},
        ),
        **FILES,
        "params": ("--params params.yaml", PARAMS),
        **FITTED,
        **{name: (*case, RECORD) for name, case in METADATA.items()},
        "simulated": ("", Some({"simulated scenario": "nothing"})),
        **SIMULATED,
    },
    "doctor": {
        "press": ("--press", {"pressed": True}),
        **FILES,
        "params": ("--params params.yaml", PARAMS),
        "simulated": ("", Some({"simulated scenario": "nothing", "hardware": "nothing"})),
        **SIMULATED,
    },
    "record": {
        "directory": ("other", {"recorder_node.directory": "other", "ended": "other"}),
        "geometry": ("--geometry socket.yaml", {"recorder_node.geometry": "socket.yaml"}),
        "calibration": (
            "--calibration calibration.yaml",
            {"recorder_node.calibration": "calibration.yaml"},
        ),
        "params": ("--params params.yaml", {"recorder_node.parameters": "params.yaml"}),
        **{
            name: (words, expected | {"recorder_node.metadata": "graph/trial.yaml"})
            for name, (words, expected) in METADATA.items()
        },
    },
    "mark": {
        "label": ("other", {"label": "other"}),
        "namespace": ("--namespace /left", {"namespace": "/left"}),
    },
    "view": {
        "trial": ("scene", Some({"trial": "scene", "view_node.host": "nothing"})),
        "namespace": ("--namespace /left", {"namespace of view_node": "/left"}),
        "duration": ("--duration 20", {"ends after": 20.0}),
        "host": ("--host 0.0.0.0", {"view_node.host": "0.0.0.0"}),
        "port": ("--port 8081", {"view_node.port": 8081}),
        "allow_host": (
            "--allow-host lab --allow-host lab.local",
            {"view_node.names": ["lab", "lab.local"]},
        ),
        "buttons": ("--buttons", {"view_node.buttons": True}),
        "geometry": ("--geometry socket.yaml", {"view_node.geometry": "socket.yaml"}),
        "model": ("--model model.json", {"model": "model.json"}, {"trial": "scene"}),
        "calibration": (
            "--calibration calibration.yaml",
            {"calibration": "calibration.yaml"},
            {"trial": "scene"},
        ),
        "load_cell": ("--load-cell params.yaml", {"load cell": "params.yaml"}, {"trial": "scene"}),
        "tare": ("--tare none", {"tare": "none"}, {"trial": "scene"}),
        "prior": ("--prior survey.json", {"prior": "survey.json"}, {"trial": "scene"}),
    },
    "replay": {
        "trial": ("second", {"replay_node.trial": "second"}),
        "rate": ("--rate 2", {"replay_node.rate": 2.0}),
        "loop": ("--loop", {"replay_node.loop": True}),
        "paused": ("--paused", {"replay_node.paused": True, "status paused": True}),
        "estimate": ("", Some({"estimator_node.model": "nothing"})),
        "model": (
            "--model model.json",
            {"estimator_node.model": "model.json", "estimator_node.auto_fit": False},
        ),
        "geometry": (
            "--geometry socket.yaml",
            {"replay_node.geometry": "socket.yaml", "estimator_node.geometry": "socket.yaml"},
        ),
        "calibration": (
            "--calibration calibration.yaml",
            {"calibration_node.calibration": "calibration.yaml"},
        ),
        "load_cell": ("--load-cell params.yaml", {"replay_node.load_cell": "params.yaml"}),
        "tare": ("--tare none", {"replay_node.tare": "none"}),
        "params": ("--params params.yaml", PARAMS),
        **FITTED,
        "leave_out": (
            "--leave-out Mz",
            {f"{ESTIMATOR}.leave_out": ["Mz"], "checked without": ("Mz",)},
        ),
    },
}


@pytest.mark.parametrize("verb", CASES)
def test_every_option_has_a_case(verb: str) -> None:
    assert {*defaults_of_verb(verb)} == {*CASES[verb]}


@pytest.mark.parametrize(
    ("verb", "option"), [(verb, option) for verb, cases in CASES.items() for option in cases]
)
def test_an_option_arrives(verb: str, option: str, stage: Stage) -> None:
    words, expected, *beside = CASES[verb][option]
    PREPARE[verb](stage, clock := Clock())
    usual = stage.usually(joined(verb, LEAST[verb], *beside), lambda w: call_verb(stage, *w))
    clock.now = START
    found = call_verb(stage, *joined(verb, LEAST[verb], *beside, {option: words}))
    changed = changes(usual, found)
    if isinstance(expected, Some):
        changed = {name: changed.get(name) for name in expected}
    assert changed == expected


def test_a_run_summarises_its_own_trials(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not one of an earlier run in the same folder, but a second one of its own."""
    PREPARE["run"](stage, Clock())

    def recorded(name: str) -> None:
        folder = Path("days") / name
        folder.mkdir(parents=True)
        (folder / "part.mcap").touch()

    def started(graph: Any, testbed: Testbed) -> World:
        recorded("walk")
        recorded("walk_3")
        return World(stage)

    summarised: list[str] = []
    monkeypatch.setattr(live.bringup, "start", started)
    monkeypatch.setattr(live, "_summarise", lambda found: summarised.extend(map(str, found)))
    recorded("walk_2")
    call_verb(stage, *joined("run", LEAST["run"], {"record": "--record days/walk"}))
    assert summarised == ["days/walk", "days/walk_3"]


@pytest.mark.parametrize(
    ("recorded", "speed"), [(0.5, 1.25), (0.2, 1.0)], ids=["slower now", "slower then"]
)
def test_a_demo_replays_at_the_lower_speed(
    recorded: float, speed: float, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five times the share of real time that the machine kept up with, now a quarter."""
    machine = SimpleNamespace(time_scale=lambda: 0.25)
    monkeypatch.setattr(demo, "measure_speed", lambda: machine)
    monkeypatch.setattr(demo, "_prepare_folder", lambda folder: None)
    monkeypatch.setattr(demo, "_record", lambda trial, seed, log: ("samples", recorded))

    def estimated(trial: Trial, samples: Any, speed: float, log: Path) -> None:
        stage.seen |= {"speed": speed, "code": 1}
        raise TestbedError("that is all", "look at what has arrived")

    monkeypatch.setattr(demo, "_estimate", estimated)
    assert call_verb(stage, "demo")["speed"] == speed


def test_a_replay_checks_no_channel_left_out(stage: Stage) -> None:
    PREPARE["replay"](stage, Clock())
    words = joined("replay", LEAST["replay"], {"params": "--params without.yaml"})
    assert call_verb(stage, *words)["checked without"] == ("Mz", "distal.Fx")


def test_a_replay_leaves_out_a_cluster_by_its_name(stage: Stage) -> None:
    """As `fit` does; the node knows channels alone."""
    PREPARE["replay"](stage, Clock())
    words = joined("replay", LEAST["replay"], {"leave_out": "--leave-out distal"})
    found = call_verb(stage, *words)
    assert found[f"{ESTIMATOR}.leave_out"] == ["distal.Fx", "distal.Fy", "distal.Fz"]


DEFAULTS: dict[str, dict[str, Any]] = {
    "calibrate": {"limit": 10.0},
    "compare": {"segment": "plateau", "threshold": 5.0},
    "survey": {"segment": "plateau"},
    "demo": {"output": Path("demo"), "seed": 0},
    "doctor": {"scenario": "static_hold", "period": 120.0, "tissue": "soft", "seed": 0}
    | {"donning_share": 0.1},
    "evaluate": {"segment": "plateau"},
    "export": {"segment": "all"},
    "fit": {"segment": "plateau"},
    "map": {"segment": "plateau"},
    "mark": {"namespace": "/"},
    "paper": {"segment": "plateau", "thetas": 101, "weights": "raw", "frames": 1000},
    "pareto": {"segment": "plateau", "thetas": 101},
    "pressure": {"segment": "plateau", "threshold": 5.0, "share": 0.5},
    "replay": {"rate": 1.0},
    "report": {"segment": "plateau", "thetas": 101},
    "run": {
        "time_scale": 1.0,
        "scenario": "static_hold",
        "period": 120.0,
        "tissue": "soft",
        "seed": 0,
        "donning_share": 0.1,
    },
    "simulate": {
        "scenario": "static_hold",
        "tissue": "soft",
        "duration": 120.0,
        "rate": 4.0,
        "seed": 0,
        "donning_share": 0.1,
    },
    "tile": {"height": 80.0, "size": 30.0, "flatness": 8.0, "rounds": 300, "seed": 0, "place": 0},
    "validate": {"segment": "all"},
    "view": {"host": "127.0.0.1", "port": 8080},
}
SHARED = {"tare": "recorded", "width": 180, "title": True}  # by several verbs


@pytest.mark.parametrize("verb", CALLS)
def test_defaults_are_the_documented_ones(verb: str) -> None:
    """Other options are not given by default."""
    own = defaults_of_verb(verb)
    given = {name: value for name, value in own.items() if value is not None and value != ()}
    given = {name: value for name, value in given.items() if value is not False}
    shared = {name: value for name, value in SHARED.items() if own.get(name) is not None}
    assert given == shared | DEFAULTS.get(verb, {})
