"""How fast a machine is said to be, what scheduling asks for, and what a testbed is made of."""

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import scene
from support.clocks import FakeClock
from support.wording import refused

from socket_testbed.drivers import DeviceBusyError, gpio
from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.geometry.socket import write_socket
from socket_testbed.live import bringup, hardware, scheduling
from socket_testbed.live.bringup import Testbed
from socket_testbed.live.scheduling import MachineSpeed
from socket_testbed.settings import acquisition
from socket_testbed.settings.testbed import (
    EstimatorSettings,
    RecorderSettings,
    ReplaySettings,
    TestbedSettings,
    read_testbed,
)
from socket_testbed.simulation.testbed import Simulation
from socket_testbed.simulation.world import World
from socket_testbed.trials.metadata import TrialMetadata, read_metadata
from socket_testbed.trials.trial import Trial

# --- the speed of the machine


@pytest.mark.parametrize(
    ("lateness", "speed", "scale"),
    [
        (1e-3, 1.0, 1.0),
        (3e-3, 0.13, 1.0),
        (3.1e-3, 1.0, 0.5),
        (1e-3, 0.129, 0.5),
        (1e-3, 0.064, 0.25),
        (13e-3, 1.0, 0.125),
        (1.0, 1.0, 0.0625),
        (0.0, 0.0, 0.0625),
    ],
)
def test_a_busy_machine_slows_the_testbed_down(lateness: float, speed: float, scale: float) -> None:
    """Threads may be 3 ms late; real time needs 0.13 of a core of the reference machine."""
    assert MachineSpeed(lateness, speed).time_scale() == scale


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (1.0, "real time"),
        (0.5, "half of real time"),
        (0.25, "a quarter of real time"),
        (0.125, "an eighth of real time"),
        (0.0625, "a sixteenth of real time"),
        (0.3, "0.3 of real time"),
    ],
)
def test_a_time_scale_has_a_name(scale: float, words: str) -> None:
    assert scheduling.speed_text(scale) == words
    note = f"this machine is busy: the simulated testbed runs at {words}"
    assert scheduling.busy_note(scale) == ("" if scale == 1.0 else note)


class Ticking:
    """Stands for `time`: sleeping takes a millisecond more, looking takes 10 us."""

    def __init__(self) -> None:
        self.now = 5.0

    def perf_counter(self) -> float:
        self.now += 1e-5
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds <= 0.002
        self.now += seconds + 1e-3


def test_lateness_is_the_delay_of_short_sleeps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wake-up is due every 2 ms and 1 ms late: 500 of them in a second."""
    monkeypatch.setattr(scheduling, "time", Ticking())
    late = scheduling.measure_lateness()
    assert np.median(late) == pytest.approx(1e-3, abs=5e-5)
    assert len(late) == pytest.approx(500, abs=3)


def test_speed_is_counted_in_units_of_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """A unit takes 10 us here, 115 us on the reference machine."""
    monkeypatch.setattr(scheduling, "time", Ticking())
    monkeypatch.setattr(scheduling, "_MEASURE_TIME", 0.02)
    found = scheduling.measure_speed()
    assert found.speed == pytest.approx(11.5, rel=1e-3)
    assert found.lateness == pytest.approx(1e-3, abs=5e-5)


def refuse(*given: Any) -> None:
    raise PermissionError(1, "Operation not permitted")


def test_refused_scheduling_tells_the_right_to_get(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    wanted = acquisition.SchedulingSettings(priority=7, cores=(2, 9))
    file = "/etc/security/limits.d/socket_testbed.conf"
    assert scheduling.schedule(wanted) == [
        "scheduling.cores [2, 9] is refused (Operation not permitted): this machine has the cores 0"
        " to 3",
        "scheduling.priority 7 is refused (Operation not permitted): put 'USER - rtprio 7' into"
        f" {file} and log in again, or grant CAP_SYS_NICE",
    ]
    assert scheduling.schedule(acquisition.SchedulingSettings()) == []


def test_memory_is_locked_on_first_use(monkeypatch: pytest.MonkeyPatch) -> None:
    """MCL_CURRENT, MCL_FUTURE and MCL_ONFAULT: 1 + 2 + 4."""
    flags: list[int] = []
    libc = SimpleNamespace(mlockall=lambda own: flags.append(own) or -1)
    monkeypatch.setattr(scheduling.ctypes, "CDLL", lambda *given, **more: libc)
    monkeypatch.setattr(scheduling.ctypes, "get_errno", lambda: 12)
    (line,) = scheduling.schedule(acquisition.SchedulingSettings(lock_memory=True))
    assert flags == [7]
    assert line.startswith(
        "scheduling.lock_memory is refused (Cannot allocate memory): put 'USER -"
    )
    assert "memlock unlimited" in line and line.endswith("or grant CAP_IPC_LOCK")


# --- the nodes of a testbed

ACQUIRING = ("cluster_node", "load_cell_node", "mocap_node", "calibration_node", "estimator_node")


def test_a_testbed_has_its_nodes_in_order(tmp_path: Path) -> None:
    found = Testbed(namespace="lab").nodes(tmp_path)
    assert [node.name for node in found] == ["trigger_node", *ACQUIRING]
    assert {node.namespace for node in found} == {"/lab"}
    assert {node.process for node in found} == {""}
    assert not any(node.use_sim_time for node in found)
    by_name = {node.name: node.settings for node in found}
    assert by_name["trigger_node"].wait_for == ACQUIRING
    assert by_name["load_cell_node"].tare_file == str(tmp_path / "tare.json")
    geometry, calibration = Testbed().geometry, Testbed().calibration
    assert by_name["mocap_node"].geometry == by_name["estimator_node"].geometry == str(geometry)
    assert by_name["calibration_node"].calibration == str(calibration)
    assert (geometry.name, calibration.name) == ("socket.yaml", "calibration.yaml")


def test_a_recorded_testbed_begins_with_its_recorder(tmp_path: Path) -> None:
    metadata = TrialMetadata(subject="S01", mass=61.2)
    testbed = Testbed(record=tmp_path / "s01", one_process=True, metadata=metadata)
    recorder, trigger, *others = testbed.nodes(tmp_path)
    assert (recorder.name, trigger.name) == ("recorder_node", "trigger_node")
    assert (recorder.process, trigger.process) == ("", "")
    assert {node.process for node in others} == {"testbed"}
    assert trigger.settings.wait_for == (*ACQUIRING, "recorder_node")
    own = recorder.settings
    assert (own.directory, own.record) == (str(tmp_path / "s01"), True)
    assert own.geometry == str(testbed.geometry) and own.calibration == str(testbed.calibration)
    assert read_metadata(Path(own.metadata)) == metadata
    assert read_testbed(Path(own.parameters)) == TestbedSettings()
    assert not replace(testbed, at_once=False).nodes(tmp_path)[0].settings.record


def test_a_trial_with_a_model_stores_fits(tmp_path: Path) -> None:
    """A replay of it has no model."""
    own = EstimatorSettings(model="model.json", auto_fit=False)
    testbed = Testbed(TestbedSettings(estimator_node=own), record=tmp_path / "s01")
    recorder = testbed.nodes(tmp_path)[0]
    stored = read_testbed(Path(recorder.settings.parameters)).estimator_node
    assert (stored.model, stored.auto_fit) == ("", True)
    assert recorder.settings.metadata == ""


def test_too_many_clusters_cannot_be_simulated() -> None:
    names = tuple(f"c{k}" for k in range(40))
    chosen = TestbedSettings(cluster_node=acquisition.ClusterSettings(names=names))
    with refused(ConfigurationError, "cluster_node: names 40 clusters, and", "can be simulated"):
        Testbed(chosen, simulation=Simulation())


def test_hardware_runs_in_real_time() -> None:
    assert Testbed().time_scale == 1.0
    assert Testbed(simulation=Simulation(time_scale=0.25)).time_scale == 0.25


@pytest.mark.parametrize("scale", [1.0, 0.25], ids=["real", "slow"])
def test_the_nodes_of_a_slow_testbed_follow_its_clock(scale: float, tmp_path: Path) -> None:
    testbed = Testbed(simulation=Simulation(time_scale=scale), record=tmp_path / "s01")
    assert {node.use_sim_time for node in testbed.nodes(tmp_path)} == {scale != 1.0}


def test_hardware_needs_load_cell_and_server(tmp_path: Path) -> None:
    """The package describes a simulated load cell only."""
    simulated = bringup.testbed_settings(None, Simulation())
    assert simulated.load_cell_node.full_scale == (1000.0, 1000.0, 2000.0, 50.0, 50.0, 50.0)
    assert bringup.testbed_settings(None, None) == TestbedSettings()
    file = tmp_path / "own.yaml"
    file.write_text("trigger_node: {ros__parameters: {rate: 9.0}}")
    own = bringup.testbed_settings(file, Simulation())
    assert own.trigger_node.rate == 9.0
    assert own.load_cell_node == simulated.load_cell_node
    assert not bringup.testbed_settings(file, None).load_cell_node.matrix
    with pytest.raises(ConfigurationError, match="load_cell_node"):
        Testbed().check_devices()
    with pytest.raises(ConfigurationError, match="server"):
        Testbed(simulated).check_devices()
    Testbed(simulated, simulation=Simulation()).check_devices()


def test_files_are_those_given_or_named() -> None:
    named = TestbedSettings(
        mocap_node=acquisition.MocapSettings(geometry="/m.yaml"),
        estimator_node=EstimatorSettings(geometry="/e.yaml"),
    )
    assert bringup.testbed_files(named, None, None)[0] == Path("/m.yaml")
    given = bringup.testbed_files(named, "/s.yaml", "/c.yaml")
    assert given == (Path("/s.yaml"), Path("/c.yaml"))
    without = replace(named, mocap_node=acquisition.MocapSettings())
    assert bringup.testbed_files(without, None, None)[0] == Path("/e.yaml")


def test_a_new_trial_is_where_it_is_recorded(tmp_path: Path) -> None:
    recording = TestbedSettings(recorder_node=RecorderSettings(directory="here", record=True))
    assert bringup.new_trial(TestbedSettings(), None) is None
    assert bringup.new_trial(recording, None) == Path("here")
    assert bringup.new_trial(recording, Path("there")) == Path("there")
    bringup.check_new_trial(tmp_path / "new" / "s01")
    assert (tmp_path / "new").is_dir() and not (tmp_path / "new" / "s01").exists()
    with refused(ConfigurationError, "new exists already"):
        bringup.check_new_trial(tmp_path / "new")


def test_the_package_s_testbed_is_simulated() -> None:
    found = bringup.simulated_testbed(Path("s01"), rate=20.0)
    assert found.simulation == Simulation() and found.record == Path("s01")
    assert found.settings.trigger_node.rate == 20.0
    assert bringup.simulated_testbed().settings.trigger_node.rate == 4.0


def test_a_stored_model_predicts_without_fits(tmp_path: Path) -> None:
    write_socket(scene.geometry(), tmp_path / "socket.yaml")
    model = scene.model(tmp_path / "model.json")
    own = EstimatorSettings()
    found = bringup.predict_with(model, own, tmp_path / "socket.yaml")
    assert found == replace(own, model=str(model), auto_fit=False)
    assert bringup.predict_with(None, own, tmp_path / "socket.yaml") is own


def test_a_replay_s_nodes_take_the_trial_s_files(hold: Path, tmp_path: Path) -> None:
    trial = Trial(hold, tare="0:5")
    calibration, estimator, replay = bringup.replay_nodes(
        trial, ReplaySettings(namespace="left", wait_for=("view_node",)), EstimatorSettings()
    )
    names = calibration.name, estimator.name, replay.name
    assert names == ("calibration_node", "estimator_node", "replay_node")
    assert calibration.use_sim_time and estimator.use_sim_time and not replay.use_sim_time
    assert {node.namespace for node in (calibration, estimator, replay)} == {"/left"}
    assert calibration.settings.calibration == str(hold / "calibration.yaml")
    assert estimator.settings.geometry == replay.settings.geometry == str(hold / "socket.yaml")
    own = replay.settings
    assert own.measured_only and (own.tare, own.load_cell) == ("0:5", "")
    assert own.wait_for == ("/left/calibration_node", "/left/estimator_node", "view_node")
    remade = replace(trial, load_cell_file=hold / "testbed.yaml")
    *_, replay = bringup.replay_nodes(remade, ReplaySettings(), EstimatorSettings())
    assert replay.settings.load_cell == str(hold / "testbed.yaml") and replay.namespace == "/"


class Graph:
    """Stands for the graph: what it was asked to do, in order."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.did = folder, list[tuple[Any, ...]]()
        self.clock: dict[str, str] = {}
        self.up = True

    def start_program(self, name: str, module: str, arguments: list[str]) -> None:
        self.did.append((name, module, arguments))
        if self.up:
            World(self.folder).port = 4711

    def start_nodes(self, nodes: list[Any]) -> None:
        self.did.append(("start", [node.name for node in nodes]))
        self.nodes = {node.name: node.settings for node in nodes}

    def keep_spare(self, namespace: str) -> None:
        self.did.append(("spare", namespace))

    def stop(self, name: str = "") -> None:
        self.did.append(("stop", name))

    def pause(self, seconds: float = 0.0) -> None:
        self.did.append(("pause", seconds))

    def check(self) -> None: ...


@pytest.fixture
def devices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the device files of the default buses."""
    folder = tmp_path / "dev"
    folder.mkdir()
    for name in ("i2c-1", "spidev0.0"):
        (folder / name).touch()
    monkeypatch.setattr(hardware, "_DEVICES", folder)
    return folder


@contextmanager
def held(path: Path) -> Iterator[None]:
    """A lock on a file, as another program has it."""
    file = os.open(path, os.O_RDWR)
    fcntl.flock(file, fcntl.LOCK_EX)
    try:
        yield
    finally:
        os.close(file)


@pytest.mark.parametrize("name", ["i2c-1", "spidev0.0"])
def test_a_testbed_beside_another_is_refused(
    name: str, devices: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before any of its nodes starts; it starts when the other one has ended."""
    graph = Graph(tmp_path)
    settings = replace(
        bringup.simulated_testbed().settings,
        mocap_node=acquisition.MocapSettings(server="127.0.0.1"),
    )
    testbed = bringup.Testbed(settings)
    words = f"another program uses {name} (process {os.getpid()}, "
    FakeClock().install(monkeypatch)
    with held(devices / name), refused(DeviceBusyError, words, "systemctl stop"):
        bringup.start(graph, testbed)
    assert not graph.did
    bringup.start(graph, testbed)
    assert graph.did


def test_buses_that_are_not_there_are_free(devices: Path) -> None:
    """Their nodes report them."""
    for name in ("i2c-1", "spidev0.0"):
        (devices / name).unlink()
    assert hardware.find_user(TestbedSettings()) is None


@pytest.mark.parametrize("line", [17, 27])
def test_drdy_on_a_line_of_the_trigger_is_refused(line: int) -> None:
    settings = bringup.simulated_testbed().settings
    cell = replace(settings.load_cell_node, data_ready_line=line)
    testbed = bringup.Testbed(replace(settings, load_cell_node=cell), simulation=Simulation())
    with refused(ConfigurationError, f"data_ready_line is {line}, a line of the trigger"):
        testbed.check_devices()


def test_a_simulated_testbed_starts_with_its_world(tmp_path: Path) -> None:
    graph = Graph(tmp_path)
    simulation = Simulation(time_scale=0.5, seed=3)
    testbed = replace(bringup.simulated_testbed(tmp_path / "s01", simulation=simulation))
    world = bringup.start(graph, testbed)
    assert world is not None and world.port == 4711
    (name, module, arguments), (_, started), spare = graph.did
    assert (name, module) == ("simulation", "socket_testbed.simulation.testbed")
    assert arguments[0] == str(tmp_path) and '"seed": 3' in arguments[1]
    assert arguments[2] == '["brim_lateral", "mid_anterior", "posterior_distal", "distal"]'
    assert arguments[3:5] == [str(testbed.geometry), str(testbed.calibration)]
    assert arguments[5] == str(tmp_path / "s01" / "ground_truth.npz")
    assert started[:2] == ["recorder_node", "trigger_node"] and spare == ("spare", "/")
    mocap = graph.nodes["mocap_node"]
    assert (mocap.server, mocap.command_port, mocap.multicast) == ("127.0.0.1", 4711, "")
    assert (mocap.socket_body, mocap.pylon_body) == ("socket", "pylon")
    for node in ("trigger_node", "cluster_node", "load_cell_node"):
        assert graph.nodes[node].simulation == str(tmp_path)
    assert graph.clock["SOCKET_TESTBED_TIME_SCALE"] == "0.5"


def test_a_simulation_that_fails_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph, passed = Graph(tmp_path), iter((0.0, 119.0, 121.0, 130.0))
    graph.up = False
    monkeypatch.setattr(bringup, "time", SimpleNamespace(monotonic=lambda: next(passed)))
    with refused(TestbedError, "the simulation is not up after 120 s: see what it printed"):
        bringup.start(graph, bringup.simulated_testbed())
    assert ("pause", 0.0) in graph.did


def test_a_testbed_ends_after_its_last_sample(tmp_path: Path) -> None:
    """A second of the testbed is two at half of real time."""
    graph = Graph(tmp_path)
    simulation = Simulation(time_scale=0.5)
    bringup.end(graph, bringup.simulated_testbed(tmp_path / "s01", simulation=simulation))
    assert graph.did == [
        *(("stop", "trigger_node"), ("pause", 2.0)),
        *(("stop", "recorder_node"), ("stop", "")),
    ]


# --- simulated devices behind the drivers


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A world with capacitances 1 to 8 pF of two clusters, and a load of 90 N."""
    found = World(tmp_path, create=True)
    capacitance = np.arange(1.0, 9.0).reshape(2, 4)
    poses = np.tile(np.eye(7)[6], (2, 1))
    found.push(0.0, capacitance, np.array([0.0, 0.0, 0.0, 0.0, 0.0, -90.0]), poses)
    return found


def opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """What the simulated clusters sense, by cluster, input and time."""
    sensed: list[Any] = []

    class Hardware:
        def __init__(self, settings: Any, chip: Any, capacitance: Any, faults: Any) -> None:
            assert settings.names and chip.__name__ == "SimulatedFdc1004"
            sensed.append(capacitance)

        def open_bus(self, number: int) -> None: ...

    monkeypatch.setattr(hardware, "SimulatedClusterHardware", Hardware)
    hardware.i2c_opener(acquisition.ClusterSettings(simulation=str(tmp_path)))
    return sensed[0]


def test_simulated_clusters_sense_the_world(
    tmp_path: Path, world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    sense = opened(tmp_path, monkeypatch)
    assert (sense(0, 0, 1.0), sense(0, 3, 1.0), sense(1, 2, 1.0)) == (1.0, 4.0, 7.0)
    world.faults.switch("clusters.exchanged", 1)
    assert (sense(0, 0, 1.0), sense(1, 0, 1.0)) == (5.0, 1.0)
    assert sense(2, 0, 1.0) == 0.0  # others stay
    world.faults.switch("clusters.exchanged", 0)
    world.capacitance_noise[0] = 0.5
    noisy = np.array([sense(0, 0, 1.0) for _ in range(2000)])
    assert noisy.mean() == pytest.approx(1.0, abs=0.05)
    assert noisy.std() == pytest.approx(0.5, rel=0.1)


def test_the_wall_clock_is_system_or_world(tmp_path: Path, world: World) -> None:
    assert hardware.wall_clock(acquisition.TriggerSettings()) is time.time_ns
    world.faults.switch("clock.step", 3600.0)
    simulated = hardware.wall_clock(acquisition.TriggerSettings(simulation=str(tmp_path)))
    assert simulated() - time.time_ns() == pytest.approx(3600e9, abs=60e9)


def test_a_trigger_is_a_timer_or_lines(tmp_path: Path, world: World) -> None:
    timer = hardware.make_trigger(acquisition.TriggerSettings(source="timer"))
    assert isinstance(timer, gpio.TimerTrigger)
    simulated = hardware.make_trigger(acquisition.TriggerSettings(simulation=str(tmp_path)))
    assert isinstance(simulated, gpio.GpioTrigger)
    assert simulated.fire() == pytest.approx(time.monotonic(), abs=60.0)


def test_lines_are_claimed_for_their_uses(monkeypatch: pytest.MonkeyPatch) -> None:
    claimed: list[tuple[Any, ...]] = []
    monkeypatch.setattr(gpio, "GpiodLines", lambda *given: claimed.append(given))
    monkeypatch.setattr(gpio, "GpioTrigger", lambda lines, settings: settings)
    hardware.make_trigger(acquisition.TriggerSettings(output_line=5, input_line=6))
    assert claimed == [
        ("pinctrl-rp1", {5: "output", 6: "rising"}, "trigger_node", "chip", "source to timer")
    ]


def test_a_converter_s_line_is_opened_where_wired(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    monkeypatch.setattr(hardware, "LoadCell", lambda settings, reader: reader)
    monkeypatch.setattr(
        hardware, "ConverterReader", lambda settings, opened, open_line: made.append(open_line)
    )
    monkeypatch.setattr(hardware, "spi_opener", lambda settings: lambda: "device")
    claimed: list[tuple[Any, ...]] = []
    monkeypatch.setattr(gpio, "GpiodLines", lambda *given: claimed.append(given))
    for line, place in ((-1, ""), (0, ""), (22, "world")):
        own = acquisition.LoadCellSettings(data_ready_line=line, simulation=place)
        hardware.make_load_cell(own)
    assert made[0] is None and made[2]() == "device"
    made[1]()
    uses = {0: "falling"}
    names = ("load_cell_node", "data_ready_chip", "data_ready_line to -1")
    assert claimed == [("pinctrl-rp1", uses, *names)]


def test_an_unknown_chip_is_refused() -> None:
    with refused(ConfigurationError, "cluster_node: chip is 'fdc1005': did you mean 'fdc1004'?"):
        hardware.capacitive_chip(acquisition.ClusterSettings(chip="fdc1005"))
