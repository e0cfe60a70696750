"""The whole testbed brought up as one graph, on hardware or in a simulated world, and ended."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from socket_testbed.calibration.model import read_calibration
from socket_testbed.drivers.clusters import reader as clusters
from socket_testbed.drivers.load_cell import bridges
from socket_testbed.drivers.natnet.connection import server_address
from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.files import closest, packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.live.processes import Graph
from socket_testbed.samples import Status
from socket_testbed.settings.acquisition import (
    ClusterSettings,
    LoadCellSettings,
    MocapSettings,
    TriggerSettings,
)
from socket_testbed.settings.fields import Settings
from socket_testbed.settings.testbed import (
    CalibrationNodeSettings,
    EstimatorSettings,
    RecorderSettings,
    read_parameters,
    write_parameters,
)
from socket_testbed.simulation.limb import Scenario
from socket_testbed.simulation.trial import TRUTH_FILE
from socket_testbed.simulation.world import World
from socket_testbed.trials.synchronise import read_samples
from socket_testbed.trials.trial import Trial

ACQUIRING = ("cluster_node", "load_cell_node", "mocap_node", "calibration_node", "estimator_node")

_UP_WITHIN = 30.0  # [s]; for the simulation
_DRAIN = 1.0  # [s]; for the last trigger's sample to pass


@dataclass(frozen=True)
class Simulation:
    """What is simulated.

    Attributes:
        scenario: The load history.
        period: Its duration, after which it starts anew [s].
        seed: Seed of all that is random.
        pace: How much faster the load changes than in the scenario [-].
        sway: How far the whole stand sways in the world [m].
    """

    scenario: Scenario = "static_hold"
    period: float = 120.0
    seed: int = 0
    pace: float = 1.0
    sway: float = 0.0


@dataclass(frozen=True)
class Testbed:
    """What is brought up.

    Attributes:
        trigger: Settings of the trigger node.
        clusters: Settings of the cluster node.
        load_cell: Settings of the load-cell node.
        mocap: Settings of the motion-capture node.
        estimator: Settings of the estimator node.
        geometry: Path of the `socket.yaml` in use.
        calibration: Path of the `calibration.yaml` in use.
        simulation: What is simulated; None on hardware.
        record: Folder of the new trial; None to record nothing.
        one_process: Whether all nodes but the trigger's and the recorder's share a process.

    Raises:
        TestbedError: If these do not belong together.
    """

    __test__ = False

    trigger: TriggerSettings
    clusters: ClusterSettings
    load_cell: LoadCellSettings
    mocap: MocapSettings
    estimator: EstimatorSettings
    geometry: Path
    calibration: Path
    simulation: Simulation | None = None
    record: Path | None = None
    one_process: bool = False

    def __post_init__(self) -> None:
        read_calibration(self.calibration).require(self.clusters.names, "cluster_node")
        tiles = read_socket(self.geometry).clusters
        for name in self.clusters.names:
            if name not in tiles:
                raise ConfigurationError(
                    f"cluster_node: the cluster '{name}' is on no tile of {self.geometry}",
                    closest(name, tiles),
                )

    def nodes(self) -> dict[str, Settings]:
        """Settings of the nodes but the recorder's, by their names."""
        wait_for = ACQUIRING if self.record is None else (*ACQUIRING, "recorder_node")
        geometry = str(self.geometry)
        return {
            "trigger_node": dataclasses.replace(self.trigger, wait_for=wait_for),
            "cluster_node": self.clusters,
            "load_cell_node": self.load_cell,
            "mocap_node": dataclasses.replace(self.mocap, geometry=geometry),
            "calibration_node": CalibrationNodeSettings(calibration=str(self.calibration)),
            "estimator_node": dataclasses.replace(self.estimator, geometry=geometry),
        }


def simulated_testbed(
    record: Path | None = None, rate: float = 4.0, simulation: Simulation | None = None
) -> Testbed:
    """The package's own testbed, simulated."""
    load_cell = read_parameters(packaged("config", "simulated.yaml"))["load_cell_node"]
    assert isinstance(load_cell, LoadCellSettings)
    return Testbed(
        trigger=TriggerSettings(rate=rate),
        clusters=ClusterSettings(),
        load_cell=load_cell,
        mocap=MocapSettings(),
        estimator=EstimatorSettings(),
        geometry=packaged("config", "socket.yaml"),
        calibration=packaged("config", "calibration.yaml"),
        simulation=simulation or Simulation(),
        record=record,
    )


def start(graph: Graph, testbed: Testbed) -> World | None:
    """Bring a testbed up.

    Returns:
        The simulated world, or None on hardware.

    Raises:
        TestbedError: If a device's settings are wrong, or the simulation does not come up.
    """
    clusters.check_settings(testbed.clusters)
    bridges.check_settings(testbed.load_cell)
    world = None
    if testbed.simulation is None:
        server_address(testbed.mocap)
    else:
        testbed, world = simulate_hardware(graph, testbed, testbed.simulation)
    if not testbed.load_cell.tare_file:
        # A node that is started again must not forget the tare.
        kept = dataclasses.replace(testbed.load_cell, tare_file=str(graph.folder / "tare.json"))
        testbed = dataclasses.replace(testbed, load_cell=kept)
    nodes = testbed.nodes()
    if testbed.record is not None:
        parameters = graph.folder / "stored.yaml"
        write_parameters(nodes, parameters)
        recorder = RecorderSettings(
            directory=str(testbed.record.resolve()),
            record=True,
            geometry=str(testbed.geometry),
            calibration=str(testbed.calibration),
            parameters=str(parameters),
        )
        graph.start("recorder_node", recorder)
    graph.start("trigger_node", nodes.pop("trigger_node"))
    if testbed.one_process:
        graph.start_together("testbed", nodes)
    else:
        for name, settings in nodes.items():
            graph.start(name, settings)
    return world


def end(graph: Graph, testbed: Testbed) -> None:
    """End a testbed so that the last trigger's sample is whole and the trial is closed."""
    graph.stop("trigger_node")
    time.sleep(_DRAIN)
    if testbed.record is not None:
        graph.stop("recorder_node")
    graph.stop()


def summary(path: Path) -> str:
    """What a trial holds, in a line.

    Raises:
        TrialError: If it holds no trigger or cannot be read.
    """
    samples = read_samples(Trial(path))
    missing = {
        "wrench": ~np.isfinite(samples.wrench).all(axis=1),
        "limb position": ~np.isfinite(samples.position).all(axis=1),
        **{name: samples.status[:, i] == Status.MISSING for i, name in enumerate(samples.clusters)},
    }
    lacking = [f"{name} missing {count}" for name, rows in missing.items() if (count := rows.sum())]
    whole = f"all {len(samples)} complete" if not lacking else ", ".join(lacking)
    return f"{path}: {len(samples)} triggers, {whole}"


def simulate_hardware(
    graph: Graph, testbed: Testbed, simulation: Simulation
) -> tuple[Testbed, World]:
    """Start a simulated world and put a testbed into it.

    Returns:
        The testbed, with the simulated world in the place of hardware, and the world.

    Raises:
        TestbedError: If the simulation does not come up.
    """
    folder = graph.folder
    world = World(folder, create=True)
    arguments = [str(folder), "--scenario", simulation.scenario]
    arguments += ["--duration", str(simulation.period), "--seed", str(simulation.seed)]
    arguments += ["--pace", str(simulation.pace), "--sway", str(simulation.sway)]
    arguments += ["--geometry", str(testbed.geometry), "--calibration", str(testbed.calibration)]
    if testbed.record is not None:
        arguments += ["--truth", str(testbed.record.resolve() / TRUTH_FILE)]
    graph.start_program("simulation", "socket_testbed.live.simulated_world", arguments)
    deadline = time.monotonic() + _UP_WITHIN
    while not world.port:
        graph.check()
        if time.monotonic() > deadline:
            raise TestbedError(
                f"the simulation is not up after {_UP_WITHIN:g} s", "see what it printed"
            )
        time.sleep(0.02)
    mocap = {"server": "127.0.0.1", "command_port": world.port, "multicast": ""}
    simulated = dataclasses.replace(
        testbed,
        trigger=dataclasses.replace(testbed.trigger, simulation=str(folder)),
        clusters=dataclasses.replace(testbed.clusters, simulation=str(folder)),
        load_cell=dataclasses.replace(testbed.load_cell, simulation=str(folder)),
        mocap=dataclasses.replace(testbed.mocap, **mocap),  # type: ignore[arg-type]
    )
    return simulated, world
