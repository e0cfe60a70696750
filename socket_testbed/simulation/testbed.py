"""The live simulated testbed: the physics advances the world that the simulated chips sense.

Run as a process next to the nodes: `python -m socket_testbed.simulation.testbed`.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray
from socket_testbed.calibration.model import Calibration, read_calibration
from socket_testbed.clocks import SteadyClock
from socket_testbed.documents import check_number
from socket_testbed.errors import TestbedError
from socket_testbed.files import end_with_starter
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.settings.options import Scenario, SimulationOptions, TissueKind
from socket_testbed.simulation import sensors
from socket_testbed.simulation.devices.natnet_server import NatNetServer
from socket_testbed.simulation.limb import LoadedLimb, draw_donning, load_history
from socket_testbed.simulation.trial import random_streams
from socket_testbed.simulation.world import World
from socket_testbed.trials.truth import GroundTruth, save_truth

_PERIOD = 0.04  # [s]; time step of the physics, with linear interpolation
_LEAD = 0.2  # [s]; of the physics over the clock, as a buffer on busy machines
_SWITCH_INTERVAL = 5e-4  # [s]; longest wait of a due frame for the physics
_THUMB_PRESSURE = 15e3  # [Pa]; on a cluster


@dataclass(frozen=True)
class Simulation:
    """The simulated load and tissue.

    Attributes:
        scenario: The load history, see `load_history`.
        period: Duration of the load history, which then repeats [s].
        seed: Seed of the random numbers: of the limb, its load and all errors.
        pace: Speed at which the scenario's times pass: with 2 the mass is placed and the hands move
            twice as fast, within an unchanged period [-].
        sway: Amplitude of the stand's sway along each axis of the world [m].
        time_scale: Testbed seconds per real second, 0.01 to 1 [-].
        tissue: Kind of the limb's tissue, see `make_tissue`.
        noise: Noise of the load cell, relative to that of `SensorErrors` [-].
        donning: Seed of another donning of the same limb, with load, sensors and errors of its own;
            None for the nominal one.
        donning_share: How much such a donning differs, see `draw_donning` [-].
    """

    scenario: Scenario = SimulationOptions.scenario
    period: float = 120.0
    seed: int = SimulationOptions.seed
    pace: float = 1.0
    sway: float = 0.0
    time_scale: float = 1.0
    tissue: TissueKind = SimulationOptions.tissue
    noise: float = 1.0
    donning: int | None = SimulationOptions.donning
    donning_share: float = SimulationOptions.donning_share

    def __post_init__(self) -> None:
        check_number(self.time_scale, "the time scale", 0.01, 1.0)


class LiveTestbed:
    """The physics of a testbed, advanced state by state.

    Args:
        world: The world to advance; the noises of its converters are set.
        geometry: The nominal geometry of the lab, with the wired clusters only.
        calibration: The nominal calibration of the lab; one without a cluster of the geometry
            raises a `CalibrationError`.
        simulation: The load and the tissue.
        errors: Sizes of the sensors' errors.
        remembers: Whether to keep all states for `save`.
    """

    def __init__(
        self,
        world: World,
        geometry: SocketGeometry,
        calibration: Calibration,
        simulation: Simulation,
        errors: sensors.SensorErrors,
        remembers: bool = True,
    ) -> None:
        calibration.require(geometry.clusters, "the socket")
        streams = random_streams(simulation.seed, simulation.donning)
        tissue_rng, load_rng, cell_rng, cluster_rng, marker_rng, _, donning_rng = streams
        self._world = world
        world.capacitance_noise[:] = errors.capacitance_noise
        world.wrench_noise[:] = simulation.noise * errors.wrench_noise(1.0)
        self._geometry = geometry
        self._times = np.arange(0.0, simulation.period, _PERIOD)
        self._loads = load_history(simulation.scenario, simulation.pace * self._times, load_rng)
        self._sway = simulation.sway
        self._remembers = remembers
        donned = None
        if simulation.donning is not None:
            donned = draw_donning(simulation.donning_share, donning_rng)
        self._limb = LoadedLimb(geometry, self._loads[0], tissue_rng, simulation.tissue, donned)
        self._offset = sensors.wrench_offset(errors, cell_rng)
        self._sensors = {
            name: sensors.ClusterSensor(calibration.clusters[name], errors, cluster_rng)
            for name in geometry.clusters
        }
        self._bodies = sensors.MarkerBodies(geometry, errors, marker_rng)
        self._start = self._last = clocks.monotonic()
        self._history: list[dict[str, Any]] = []

    def advance(self, moment: float) -> None:
        """Advance the world to a time of the steady clock [s], later than that of the last call."""
        elapsed = moment - self._start
        load = self._loads[int(elapsed / _PERIOD) % len(self._loads)]
        if out := int(self._world.faults["limb.out"]):
            forces, load = self._pressed(out)
        else:
            forces = self._limb.step(load, max(moment - self._last, 1e-3))
        self._last = moment
        position, rotation = self._limb.position, self._limb.rotation
        now = np.array([elapsed])
        capacitance = np.vstack(
            [
                sensor.respond(sensors.cluster_stress(self._geometry, name, forces[None]), now)
                for name, sensor in self._sensors.items()
            ]
        )
        swayed = self._sway * np.sin(2.0 * np.pi * elapsed / np.array([3.0, 4.1, 5.3]))
        bodies = self._bodies.poses(position[None], rotation[None], load[None], swayed)
        poses = np.vstack([pose.vector for pose in bodies])
        self._world.push(moment, capacitance, load + self._offset, poses)
        if not self._remembers:
            return
        self._history.append(
            {
                "moment": moment,
                "forces": forces.astype(np.float32),
                "wrench": load,
                "position": position,
                "rotation": rotation,
                "felt_capacitance": capacitance,
                "felt_wrench": load + self._offset,
                "felt_markers": _padded([*markers_at(self._geometry, poses).values()]),
                "lateness": clocks.monotonic() - moment,
            }
        )

    def _pressed(self, number: int) -> tuple[FloatArray, FloatArray]:
        """Forces on the tiles (n, 3) [N] and the load (6,) for a thumb on the n-th cluster."""
        forces = np.zeros((len(self._geometry), 3))
        if number > 0:
            tile = [*self._geometry.clusters.values()][number - 1]
            inward = self._geometry.rotations[tile, :, 2]
            forces[tile] = -_THUMB_PRESSURE * self._geometry.areas[tile] * inward
        moments = np.cross(self._geometry.anchors, forces)
        return forces, np.concatenate([moments.sum(axis=0), forces.sum(axis=0)])

    def save(self, path: Path, clock: SteadyClock) -> None:
        """Write the true states and the noise-free sensor values, see `save_truth`.

        Further arrays, one row per state: `felt_capacitance` by cluster and input, (N, c, 4) [pF];
        `felt_wrench` [M; F] in {S} with the tare's offset, (N, 6) [N m, N]; `felt_markers` of
        socket and pylon in the world, (N, 2, k, 3) [m], the smaller body padded with NaN; and
        `lateness` of the state after its time, (N,) [s].

        Args:
            path: The file to write, a .npz.
            clock: Converts times of the steady clock to stamps.
        """
        columns = {
            name: np.array([state[name] for state in self._history], dtype=float)
            for name in self._history[0]
        }
        stamps = np.array([*map(clock.to_epoch, columns.pop("moment").tolist())])
        true = [columns.pop(name) for name in ("forces", "wrench", "position", "rotation")]
        save_truth(path, stamps, GroundTruth(self._geometry.names, *true), **columns)


def markers_at(geometry: SocketGeometry, poses: FloatArray) -> dict[str, FloatArray]:
    """Markers of socket and pylon in the world by body, shape (k, 3) each [m].

    Args:
        geometry: The socket, with the markers of both bodies in their own frames.
        poses: Poses of the marker bodies of socket and pylon, in this order, in the world: position
            [m], then unit quaternion (x, y, z, w), shape (2, 7).
    """
    bodies = zip(geometry.markers.items(), poses, strict=True)
    return {name: Pose.from_vector(pose).apply(markers) for (name, markers), pose in bodies}


def _padded(markers: list[FloatArray]) -> FloatArray:
    """Markers of both bodies, shape (2, k, 3) [m]; padded with NaN."""
    padded = np.full((len(markers), max(map(len, markers)), 3), np.nan)
    for row, own in zip(padded, markers, strict=True):
        row[: len(own)] = own
    return padded


def main() -> None:
    """Advance a world with the testbed's clock until the process is stopped.

    Arguments: the folder of the world, the `Simulation` and the names of the wired clusters as
    JSON, the paths of `socket.yaml` and `calibration.yaml`, and the file for the true states, empty
    for none.
    """
    folder, described, names, socket_file, calibration_file, truth = sys.argv[1:]
    simulation = Simulation(**json.loads(described))
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    end_with_starter()
    sys.setswitchinterval(_SWITCH_INTERVAL)
    clock = SteadyClock()
    world = World(Path(folder))
    errors = sensors.SensorErrors()
    socket = read_socket(Path(socket_file))
    geometry = replace(socket, clusters={name: socket.clusters[name] for name in json.loads(names)})
    calibration = read_calibration(Path(calibration_file))
    testbed = LiveTestbed(world, geometry, calibration, simulation, errors, bool(truth))

    def bodies(moment: float) -> list[tuple[str, FloatArray, FloatArray, FloatArray]]:
        poses = world.poses(moment)
        seen = markers_at(geometry, poses).items()
        return [(*body, pose[:3], pose[3:]) for body, pose in zip(seen, poses, strict=True)]

    moment = clocks.monotonic()
    testbed.advance(moment)
    server = NatNetServer(
        bodies, rate=sensors.CAMERA_RATE, faults=world.faults, noise=errors.marker_noise,
        seed=simulation.seed,
        address=("127.0.0.1", world.port),  # keeps its port after a restart
    )  # fmt: skip
    world.port = server.address[1]
    try:
        while not ended.is_set():
            moment = max(moment + _PERIOD, clocks.monotonic())
            testbed.advance(moment)
            ended.wait(clocks.real(max(0.0, moment - _LEAD - clocks.monotonic())))
    finally:
        server.close()
    if truth:
        try:
            testbed.save(Path(truth), clock)
        except OSError as error:
            print(f"error: {truth}: cannot be written ({error.strerror})", file=sys.stderr)


if __name__ == "__main__":
    try:
        main()
    except TestbedError as error:
        sys.exit(f"error: {error}")
