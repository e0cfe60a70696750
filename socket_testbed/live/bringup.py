"""The nodes of a graph, their order and settings; starting and ending it.

`run` and `replay` start processes from this description, the launch files start actions.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import IO

from socket_testbed.calibration.model import read_calibration
from socket_testbed.clocks import shared_environment
from socket_testbed.drivers.clusters import reader as clusters
from socket_testbed.drivers.load_cell import load_cell
from socket_testbed.drivers.natnet.connection import server_address
from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.files import (
    CALIBRATION_FILE,
    SOCKET_FILE,
    check_new_folder,
    check_outputs,
    file_or_packaged,
    make_folder,
    packaged,
)
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.fit import check_names
from socket_testbed.identification.model_file import read_model
from socket_testbed.live.hardware import capacitive_chip, require_free
from socket_testbed.live.processes import Graph, GraphNode
from socket_testbed.live.sources import (
    absent_topics,
    check_sources,
    foreign_topics,
    refuse_own_topic,
)
from socket_testbed.settings.acquisition import TriggerSettings
from socket_testbed.settings.alignment import AlignSettings
from socket_testbed.settings.fields import Settings
from socket_testbed.settings.testbed import (
    CalibrationNodeSettings,
    EstimatorSettings,
    RecorderSettings,
    ReplaySettings,
    TestbedSettings,
    check_take_name,
    read_testbed,
    write_testbed,
)
from socket_testbed.simulation.testbed import Simulation
from socket_testbed.simulation.world import MAX_CLUSTERS, World
from socket_testbed.trials.metadata import (
    METADATA_FILE,
    TrialMetadata,
    change_metadata,
    read_metadata,
    write_metadata,
)
from socket_testbed.trials.trial import Trial, recorded_namespace
from socket_testbed.trials.truth import TRUTH_FILE
from socket_testbed.wire.topics import full_name, full_namespace

_START_TIMEOUT = 120.0  # [s]; for the simulation, on a busy machine
_DRAIN_TIME = 1.0  # [s] of the testbed; for the last sample to pass through


@dataclass(frozen=True)
class Testbed:
    """A testbed to bring up: settings of its nodes, files, simulation.

    Attributes:
        settings: Settings of its nodes.
        geometry: The socket's `socket.yaml`; it must know all clusters of the settings.
        calibration: The clusters' `calibration.yaml`; it must know all clusters of the settings.
        simulation: The simulated load and tissue; None on hardware.
        record: Folder of the new trial; None to record nothing.
        at_once: Whether to record from the start; otherwise trials are recorded on request, into
            the folder `record`.
        one_process: Whether all nodes except trigger_node and recorder_node share one process.
        metadata: Metadata of the new trial; they override those of the recorder's settings.
        namespace: Namespace of its nodes and topics.

    Raises:
        ConfigurationError: If there are too many clusters to simulate, a name or file is wrong, or
            a cluster is on no tile of the socket.
        CalibrationError: If the calibration lacks a cluster.
    """

    __test__ = False

    settings: TestbedSettings = field(default_factory=TestbedSettings)
    geometry: Path = field(default_factory=lambda: packaged("config", SOCKET_FILE))
    calibration: Path = field(default_factory=lambda: packaged("config", CALIBRATION_FILE))
    simulation: Simulation | None = None
    record: Path | None = None
    at_once: bool = True
    one_process: bool = False
    metadata: TrialMetadata = field(default_factory=TrialMetadata)
    namespace: str = "/"

    def __post_init__(self) -> None:
        names = self.settings.cluster_names
        if self.simulation is not None and len(names) > MAX_CLUSTERS:
            fact = f"names {len(names)} clusters, and {MAX_CLUSTERS} can be simulated"
            raise ConfigurationError(f"cluster_node: {fact}", "leave the others out")
        check_names(self.settings.estimator_node.identification, names)
        calibration, socket = read_calibration(self.calibration), read_socket(self.geometry)
        named = self.settings.align_node.clusters.names
        where = "align_node" if named and names == named else "cluster_node"
        calibration.require(names, where)
        socket.require(names, f"{where} (socket {self.geometry})")

    @property
    def time_scale(self) -> float:
        """Testbed seconds per real second [-]; 1 on hardware."""
        return self.simulation.time_scale if self.simulation else 1.0

    @property
    def use_sim_time(self) -> bool:
        """Whether its nodes take the time from /clock: if it is slower than real time."""
        return self.time_scale != 1.0

    def check_devices(self) -> None:
        """Check the device settings before anything starts.

        Raises:
            ConfigurationError: If they do not fit together, or name an unknown chip or server.
        """
        cluster_node, own = self.settings.cluster_node, self.settings.own_nodes
        namespace = full_namespace(self.namespace)
        check_sources(self.settings.align_node, namespace)
        if topic := self.settings.trigger_node.topic:
            refuse_own_topic(topic, "trigger_node: topic", namespace)
        if "cluster_node" in own:
            clusters.check_settings(cluster_node, capacitive_chip(cluster_node)[0])
        if "load_cell_node" in own:
            load_cell.check_settings(self.settings.load_cell_node)
            self._check_lines()
        if "mocap_node" in own and self.simulation is None:
            server_address(self.settings.mocap_node)

    def _check_lines(self) -> None:
        """Check that trigger and load cell use different lines of a chip."""
        trigger, cell = self.settings.trigger_node, self.settings.load_cell_node
        line = cell.data_ready_line
        is_shared = trigger.source == "gpio" and trigger.chip == cell.data_ready_chip
        if is_shared and line in {trigger.output_line, trigger.input_line}:
            fact = f"load_cell_node: data_ready_line is {line}, a line of the trigger"
            raise ConfigurationError(fact, "wire DRDY to a line of its own, or set it to -1")

    def nodes(self, folder: Path) -> list[GraphNode]:
        """The nodes of the testbed, in start order.

        The trigger waits for all others. A restarted node gets the same settings, and the load-cell
        node its tare, from `folder`, which exists as long as the testbed runs.
        """
        given = self.settings
        geometry, calibration = str(self.geometry), str(self.calibration)
        tare = given.load_cell_node.tare_file or str(folder / "tare.json")
        acquiring: dict[str, Settings] = {
            "cluster_node": given.cluster_node,
            "load_cell_node": replace(given.load_cell_node, tare_file=tare),
            "mocap_node": replace(given.mocap_node, geometry=geometry),
            "align_node": self._align_settings(folder),
            "calibration_node": CalibrationNodeSettings(calibration=calibration),
            "estimator_node": replace(given.estimator_node, geometry=geometry),
        }
        drivers = {"cluster_node", "load_cell_node", "mocap_node", "align_node"}
        running = {*self.settings.own_nodes, *(("align_node",) if given.align_node.is_used else ())}
        acquiring = {n: own for n, own in acquiring.items() if n not in drivers or n in running}
        wait_for = tuple(acquiring) if self.record is None else (*acquiring, "recorder_node")
        trigger = replace(given.trigger_node, wait_for=wait_for)
        namespace = full_namespace(self.namespace)
        process = "testbed" if self.one_process else ""
        nodes = [
            GraphNode("trigger_node", trigger, namespace, self.use_sim_time),
            *(
                GraphNode(name, own, namespace, self.use_sim_time, process)
                for name, own in acquiring.items()
            ),
        ]
        if self.record is None:
            return nodes
        stored = folder / "stored.yaml"
        used: dict[str, Settings] = {node.name: node.settings for node in nodes}
        if given.estimator_node.model:  # a replay has no model, so it must fit one
            used["estimator_node"] = replace(given.estimator_node, auto_fit=True)
        write_testbed(used, stored)
        recorder = replace(
            given.recorder_node,
            directory=str(self.record.resolve()),
            record=self.at_once,
            beside=foreign_topics(given.align_node, given.trigger_node.topic),
            absent=tuple(topic.name for topic in absent_topics(given.align_node)),
            geometry=geometry,
            calibration=calibration,
            parameters=str(stored),
            metadata=self._store_metadata(folder / METADATA_FILE),
        )
        return [GraphNode("recorder_node", recorder, namespace, self.use_sim_time), *nodes]

    def _align_settings(self, folder: Path) -> AlignSettings:
        """The settings of the align node, with the files and clusters of the testbed."""
        given = self.settings.align_node
        return replace(
            given,
            clusters=replace(given.clusters, names=self.settings.cluster_names),
            geometry=str(self.geometry),
            calibration=str(self.calibration),
            tare_file=given.tare_file or str(folder / "tare.json"),
        )

    def _store_metadata(self, path: Path) -> str:
        """Write the new trial's metadata; returns the path, or "" if nothing is stated."""
        given = self.settings.recorder_node.metadata
        metadata = read_metadata(Path(given)) if given else TrialMetadata()
        metadata = change_metadata(metadata, self.metadata.stated())
        if not metadata.stated():
            return ""
        write_metadata(metadata, path)
        return str(path)


def testbed_settings(
    params: Path | None, simulation: Simulation | None, namespace: str = "/"
) -> TestbedSettings:
    """Settings of the nodes.

    The package describes a simulated load cell; a real one needs its owner's description.

    Args:
        params: A `testbed.yaml`, which replaces defaults; None for the defaults alone.
        simulation: The simulated load and tissue, whose load cell the defaults then describe; None
            on hardware.
        namespace: Namespace of the testbed, which chooses among the sections of the file.
    """
    settings = TestbedSettings()
    if simulation is not None:
        settings = read_testbed(packaged("config", "simulated.yaml"))
    if params is None:
        return settings
    return read_testbed(params, settings, full_namespace(namespace))


def testbed_files(
    settings: TestbedSettings, geometry: Path | str | None, calibration: Path | str | None
) -> tuple[Path, Path]:
    """Absolute paths of the geometry and calibration of a `Testbed`.

    Args:
        settings: Settings of the nodes, which may name the files.
        geometry: A `socket.yaml`; None for that of mocap_node or estimator_node in the settings,
            or the package's own.
        calibration: A `calibration.yaml`; None for that of calibration_node in the settings, or the
            package's own.

    Returns:
        The `socket.yaml` and the `calibration.yaml`.
    """
    geometry = geometry or settings.mocap_node.geometry or settings.estimator_node.geometry
    calibration = calibration or settings.calibration_node.calibration
    socket = file_or_packaged(geometry, SOCKET_FILE).resolve()
    return socket, file_or_packaged(calibration, CALIBRATION_FILE).resolve()


def new_trial(settings: TestbedSettings, record: Path | None) -> Path | None:
    """Folder of the new trial; None to record nothing.

    Args:
        settings: Settings of the nodes; those of the recorder may name a folder.
        record: The folder; None for that of the settings, if they record from the start.
    """
    recorder = settings.recorder_node
    return record or (Path(recorder.directory) if recorder.record else None)


def check_new_trial(path: Path) -> None:
    """Check that the folder of a new trial can be made, before any node starts.

    Raises:
        ConfigurationError: If it exists, cannot be made, or its name cannot be that of a trial.
    """
    check_new_folder(path)
    check_take_name(path.resolve().name)
    make_folder(path.parent)
    check_outputs(path, replace=False)


def simulated_testbed(
    record: Path | None = None,
    rate: float = TriggerSettings.rate,
    simulation: Simulation | None = None,
) -> Testbed:
    """The package's own simulated testbed.

    Args:
        record: Folder of the new trial; None to record nothing.
        rate: Triggers per second of the testbed [Hz].
        simulation: The simulated load and tissue; None for the defaults.
    """
    simulation = simulation or Simulation()
    settings = testbed_settings(None, simulation)
    settings = replace(settings, trigger_node=replace(settings.trigger_node, rate=rate))
    return Testbed(settings, simulation=simulation, record=record)


def start(graph: Graph, testbed: Testbed) -> World | None:
    """Bring a testbed up.

    Args:
        graph: An entered graph, which runs the processes.
        testbed: The testbed.

    Returns:
        The simulated world; None on hardware.

    Raises:
        ConfigurationError: If the device settings do not fit together.
        DeviceBusyError: If another program uses a bus of the testbed.
    """
    testbed.check_devices()
    world = None
    if testbed.simulation is None:
        require_free(testbed.settings)
    else:
        testbed, world = simulate_hardware(graph, testbed, testbed.simulation)
    graph.start_nodes(testbed.nodes(graph.folder))
    graph.keep_spare(full_namespace(testbed.namespace))
    return world


def end(graph: Graph, testbed: Testbed) -> None:
    """End a testbed after completing the last sample and closing the trial.

    Args:
        graph: The graph that runs its processes.
        testbed: The testbed that `start` brought up.
    """
    graph.stop("trigger_node")
    graph.pause(_DRAIN_TIME / testbed.time_scale)
    if testbed.record is not None:
        graph.stop("recorder_node")
    graph.stop()


def simulate_hardware(
    graph: Graph, testbed: Testbed, simulation: Simulation
) -> tuple[Testbed, World]:
    """Start a simulated world, before the nodes of its testbed.

    Args:
        graph: An entered graph; all its further processes follow the simulation's clock.
        testbed: The testbed.
        simulation: The load and tissue to simulate.

    Returns:
        The testbed with simulated hardware, and the world.

    Raises:
        TestbedError: If the simulation fails or is not up after two minutes.
    """
    graph.clock = shared_environment(simulation.time_scale)
    folder = graph.folder
    world = World(folder, create=True)
    recorded = testbed.record if testbed.at_once else None
    truth = str(recorded.resolve() / TRUTH_FILE) if recorded else ""
    described = json.dumps(asdict(simulation))
    names = json.dumps(testbed.settings.cluster_node.names)
    files = str(testbed.geometry), str(testbed.calibration), truth
    arguments = [str(folder), described, names, *files]
    graph.start_program("simulation", "socket_testbed.simulation.testbed", arguments)
    deadline = time.monotonic() + _START_TIMEOUT
    while not world.port:
        graph.check()
        if time.monotonic() > deadline:
            fact = f"the simulation is not up after {_START_TIMEOUT:g} s"
            raise TestbedError(fact, "see what it printed")
        graph.pause()
    given, place = testbed.settings, str(folder)
    streamed = replace(
        given.mocap_node, server="127.0.0.1", command_port=world.port, multicast="",
        socket_body="socket", pylon_body="pylon",  # as the world names them
    )  # fmt: skip
    wired = ("trigger_node", "cluster_node", "load_cell_node")
    simulated = {name: replace(getattr(given, name), simulation=place) for name in wired}
    settings = replace(given, mocap_node=streamed, **simulated)
    return replace(testbed, settings=settings), world


def predict_with(
    model: Path | None, estimator: EstimatorSettings, geometry: Path
) -> EstimatorSettings:
    """Estimator settings to predict with a stored model, without fitting.

    Args:
        model: The model file; None to return the settings as they are.
        estimator: The estimator's settings.
        geometry: The `socket.yaml` of the socket that it runs on, which the model must fit.
    """
    if model is None:
        return estimator
    read_model(model, read_socket(geometry))
    return replace(estimator, model=str(model.resolve()), auto_fit=False)


def replay_nodes(
    trial: Trial, replay: ReplaySettings, estimator: EstimatorSettings
) -> list[GraphNode]:
    """The nodes that replay a trial through calibration and estimator, in start order.

    They use the trial's geometry, calibration, load cell and tare.

    Args:
        trial: The trial, which is checked first.
        replay: Settings of replay_node; without a namespace, all nodes are in the recorded one.
        estimator: Settings of estimator_node.
    """
    check_names(estimator.identification, trial.require_usable())
    namespace = full_namespace(replay.namespace or recorded_namespace(trial))
    calibration = CalibrationNodeSettings(calibration=str(trial.calibration_path.resolve()))
    geometry = str(trial.geometry_path.resolve())
    estimator = replace(estimator, geometry=geometry)
    estimating = [
        GraphNode("calibration_node", calibration, namespace, use_sim_time=True),
        GraphNode("estimator_node", estimator, namespace, use_sim_time=True),
    ]
    wait_for = (*(full_name(node.name, namespace) for node in estimating), *replay.wait_for)
    load_cell = str(trial.load_cell_file.resolve()) if trial.load_cell_file else ""
    replay = replace(
        replay, measured_only=True, wait_for=wait_for, geometry=geometry, load_cell=load_cell,
        tare=trial.tare,
    )  # fmt: skip
    return [*estimating, GraphNode("replay_node", replay, full_namespace(replay.namespace))]


def record_estimates(
    trial: Trial,
    replay: ReplaySettings,
    estimator: EstimatorSettings,
    record: Path,
    output: IO[str] | None = None,
) -> None:
    """Replay a trial through the nodes of `replay_nodes`, and record everything they publish.

    Args:
        trial: The trial.
        replay: Settings of replay_node.
        estimator: Settings of estimator_node.
        record: Folder of the new trial, with the estimates.
        output: An open file to which the nodes print; None for that of this process.
    """
    replay = replace(replay, wait_for=("recorder_node", *replay.wait_for))
    nodes = replay_nodes(trial, replay, estimator)
    recorder = RecorderSettings(directory=str(record.resolve()), record=True, everything=True)
    with Graph(output) as graph:
        graph.start_nodes([GraphNode("recorder_node", recorder, nodes[-1].namespace), *nodes])
        graph.wait("replay_node")
        graph.pause(_DRAIN_TIME)
