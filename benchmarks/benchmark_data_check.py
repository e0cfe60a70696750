"""What the data check says of damaged copies of sound simulated trials, and of sound ones.

Usage:
    python benchmarks/benchmark_data_check.py [--trials ramp:soft ...] [--only WORDS] [--sound N]

Each copy has one error of a lab, in its bag or its configuration. It counts as named if the finding
that stands first speaks of the right source, as misleading if another one stands first, and as
silent without any. Reversed units and signs stand for whole families of errors.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from collections import Counter
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

import socket_testbed as st
from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.calibration.model import read_calibration
from socket_testbed.drivers.load_cell.load_cell import Bridges
from socket_testbed.errors import TestbedError
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.settings.options import Scenario, TissueKind
from socket_testbed.settings.testbed import read_testbed
from socket_testbed.simulation.limb import SCENARIOS, TISSUES
from socket_testbed.simulation.trial import simulate
from socket_testbed.trials.bag import BagWriter
from socket_testbed.wire import messages, topics

SPARE = 24  # samples before and after a trial, so that it may be late
FILES = ("socket.yaml", "calibration.yaml", "simulated.yaml")
BRIDGES = Bridges(read_testbed(packaged("config", "simulated.yaml")).load_cell_node)
BRIM, ANTERIOR, POSTERIOR, DISTAL = "brim_lateral", "mid_anterior", "posterior_distal", "distal"
UNLOADED = 5.0  # [pF]; of an input


@dataclass
class Recording:
    """What a trial recorded, with spare samples at either end, to be damaged in place.

    Attributes:
        stamps: Times of the triggers since the epoch, shape (N,) [ns].
        wrench: Wrench [M; F] in {S}, shape (N, 6) [N m, N].
        ratios: Ratios of the bridges, shape (N, 6) [mV/V]; None for those of the wrench.
        poses: Position [m] and quaternion of each body in the world, shape (N, 7) each.
        capacitance: By cluster and input, shape (N, 4) each [pF].
        files: Contents of `FILES`.
        mass: Mass of the person [kg]; None if it is not stated.
        lost: Samples whose messages are lost, by topic, shape (N,) each.
    """

    stamps: IntArray
    wrench: FloatArray
    ratios: FloatArray | None
    poses: dict[str, FloatArray]
    capacitance: dict[str, FloatArray]
    files: dict[str, Any]
    mass: float | None = None
    lost: dict[topics.Topic, BoolArray] = field(default_factory=dict)


def record(
    scenario: Scenario, tissue: TissueKind, rate: float, duration: float, seed: int
) -> Recording:
    """A sound trial.

    Args:
        scenario: The load history.
        tissue: Tissue of the limb.
        rate: Rate of the trigger [Hz].
        duration: Duration without the spare samples [s].
        seed: Seed of limb, load and errors.
    """
    geometry = read_socket(packaged("config", "socket.yaml"))
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    longer = duration + 2.0 * SPARE / rate
    trial = simulate(geometry, calibration, scenario, longer, rate, seed, tissue=tissue)
    poses = {name: pose.vector for name, pose in trial.poses.items()}
    files = {name: yaml.safe_load(packaged("config", name).read_text()) for name in FILES}
    return Recording(trial.stamps, trial.wrench, None, poses, dict(trial.capacitance), files)


def write(recording: Recording, path: Path) -> None:
    """Write a recording as a trial, without its spare samples."""
    rows = range(SPARE, len(recording.stamps) - SPARE)
    ratios = recording.ratios
    if ratios is None:
        ratios = BRIDGES.ratios_at(recording.wrench)
    inputs = np.stack([*recording.capacitance.values()], axis=1)
    status = np.where(np.isfinite(inputs), 0, 2).astype(np.uint8)
    pack_trigger, pack_wrench = messages.trigger_packer(), messages.wrench_packer()
    pack_raw, pack_pose = messages.load_cell_raw_packer(), messages.pose_packer()
    pack_inputs = messages.capacitance_packer([*recording.capacitance])
    with BagWriter(path) as bag:
        for topic in (topics.TRIGGER, topics.WRENCH, topics.LOAD_CELL_RAW, topics.SOCKET_POSE,
                      topics.PYLON_POSE, topics.CAPACITANCE):  # fmt: skip
            bag.add_topic("/" + topic.name, topic)
        for row in rows:
            stamp = int(recording.stamps[row])
            contents = {
                topics.TRIGGER: pack_trigger(stamp, row),
                topics.WRENCH: pack_wrench(stamp, recording.wrench[row]),
                topics.LOAD_CELL_RAW: pack_raw(stamp, ratios[row], np.zeros(6), 0, 0),
                topics.SOCKET_POSE: pack_pose(stamp, recording.poses["socket"][row]),
                topics.PYLON_POSE: pack_pose(stamp, recording.poses["pylon"][row]),
                topics.CAPACITANCE: pack_inputs(stamp, inputs[row], status[row]),
            }
            for topic, content in contents.items():
                if not (topic in recording.lost and recording.lost[topic][row]):
                    bag.write("/" + topic.name, stamp, content)
    for name, content in recording.files.items():
        stored = "testbed.yaml" if name == "simulated.yaml" else name
        (path / stored).write_text(yaml.safe_dump(content, sort_keys=False))
    if recording.mass is not None:
        (path / "trial.yaml").write_text(f"mass: {recording.mass}\n")


# --- changes of arrays (N, k)


Change = Callable[[FloatArray], FloatArray]
Damage = Callable[[Recording], object]


def times(*factors: float) -> Change:
    """Every channel by its factor."""
    return lambda values: values * np.array(factors)


def plus(*offsets: float) -> Change:
    """Every channel by its offset."""
    return lambda values: values + np.array(offsets)


def order(*places: int) -> Change:
    """Channels from other places."""
    return lambda values: values[:, places]


def late(samples: int) -> Change:
    """Later by some samples."""
    return lambda values: np.roll(values, samples, axis=0)


def slow_clock(share: float = 0.05) -> Change:
    """By a clock that is slow by a share of the time."""

    def change(values: FloatArray) -> FloatArray:
        rows = np.arange(len(values))
        at = SPARE + (rows - SPARE) * (1.0 - share)
        return np.column_stack([np.interp(at, rows, column) for column in values.T])

    return change


def still(*columns: int, seconds: tuple[int, int] | None = None) -> Change:
    """Some columns, or all of them, as at the first of some samples, or of all."""

    def change(values: FloatArray) -> FloatArray:
        rows = slice(*seconds) if seconds else slice(None)
        for column in columns or range(values.shape[1]):
            values[rows, column] = values[rows, column][0]
        return values

    return change


def repeated(values: FloatArray) -> FloatArray:
    """Every second one is that before."""
    values[1::2] = values[:-1:2]
    return values


def drift(size: float, *columns: int) -> Change:
    """Some columns by a line from 0 to a size."""

    def change(values: FloatArray) -> FloatArray:
        values[:, columns] += np.linspace(0.0, size, len(values))[:, None]
        return values

    return change


def step(size: float, *columns: int) -> Change:
    """Some columns by a size from six tenths of the trial on."""

    def change(values: FloatArray) -> FloatArray:
        values[int(0.6 * len(values)) :, columns] += size
        return values

    return change


def spikes(size: float, column: int, count: int = 5) -> Change:
    """Some single values of a column by a size, of either sign."""

    def change(values: FloatArray) -> FloatArray:
        rng = np.random.default_rng(3)
        rows = rng.choice(np.arange(SPARE + 3, len(values) - SPARE - 3), count, replace=False)
        values[rows, column] += size * rng.choice([-1.0, 1.0], count)
        return values

    return change


def noise(*sizes: float) -> Change:
    """Every channel by noise of its size."""
    return lambda values: values + np.random.default_rng(4).normal(0.0, 1.0, values.shape) * sizes


def turned(degrees: float) -> Change:
    """A wrench about z."""
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(degrees)])
    return lambda values: np.hstack([turn.apply(values[:, :3]), turn.apply(values[:, 3:])])


def about(*origin: float) -> Change:
    """A wrench about another origin [m]."""

    def change(values: FloatArray) -> FloatArray:
        moments = values[:, :3] - np.cross(origin, values[:, 3:])
        return np.hstack([moments, values[:, 3:]])

    return change


def gain(factor: float) -> Change:
    """Capacitances whose difference from the unloaded one has another gain."""
    return lambda values: UNLOADED + factor * (values - UNLOADED)


def at_most(share: float) -> Change:
    """Capacitances clipped at a share of their range."""
    return lambda values: np.minimum(values, UNLOADED + share * (values.max() - UNLOADED))


def gone(share: float) -> Change:
    """From a share of the trial on, nothing."""

    def change(values: FloatArray) -> FloatArray:
        values[int(share * len(values)) :] = np.nan
        return values

    return change


def vector_turned(*degrees: float) -> Change:
    """A body's axes in the body."""
    turn = Rotation.from_rotvec(np.radians(degrees))

    def change(values: FloatArray) -> FloatArray:
        turned = Rotation.from_quat(values[:, 3:]) * turn
        return np.hstack([values[:, :3], turned.as_quat()])

    return change


# --- damages of a recording


def wrench(change: Change) -> Damage:
    """Of the wrench, and of the ratios with it."""

    def damage(recording: Recording) -> None:
        recording.wrench = change(recording.wrench.copy())

    return damage


def bridges(change: Change) -> Damage:
    """Of the bridges, and of the wrench with them."""

    def damage(recording: Recording) -> None:
        recording.ratios = change(BRIDGES.ratios_at(recording.wrench))
        recording.wrench = BRIDGES.wrenches(recording.ratios)

    return damage


def pose(change: Change, *bodies: str) -> Damage:
    """Of some bodies' poses, or of both."""

    def damage(recording: Recording) -> None:
        for body in bodies or ("socket", "pylon"):
            recording.poses[body] = change(recording.poses[body].copy())

    return damage


def inputs(change: Change, *clusters: str) -> Damage:
    """Of some clusters' capacitances, or of all."""

    def damage(recording: Recording) -> None:
        for cluster in clusters or [*recording.capacitance]:
            recording.capacitance[cluster] = change(recording.capacitance[cluster].copy())

    return damage


def exchanged(*clusters: str) -> Damage:
    """Clusters that read the next one's sensor, the last one that of the first."""

    def damage(recording: Recording) -> None:
        read = dict(recording.capacitance)
        for cluster, other in zip(clusters, (*clusters[1:], clusters[0]), strict=True):
            recording.capacitance[cluster] = read[other]

    return damage


def calibrated(factor: float, *clusters: str) -> Damage:
    """Of the coefficients of some clusters, or of all."""

    def damage(recording: Recording) -> None:
        found = recording.files["calibration.yaml"]["clusters"]
        for cluster in clusters or found:
            for key in ("normal", "shear_x", "shear_y"):
                found[cluster][key] = [factor * value for value in found[cluster][key]]

    return damage


def tiles(change: Callable[[dict[str, Any]], object]) -> Damage:
    """Of every tile in `socket.yaml`."""

    def damage(recording: Recording) -> None:
        for tile in recording.files["socket.yaml"]["tiles"].values():
            change(tile)

    return damage


def socket_turned(degrees: float) -> Damage:
    """Of the socket, mounted turned about the load cell's axis."""
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(degrees)]).as_matrix()

    def change(tile: dict[str, Any]) -> None:
        tile["anchor"] = (turn @ tile["anchor"]).tolist()
        tile["frame"] = (turn @ np.array(tile["frame"])).tolist()

    return tiles(change)


def higher(tile: dict[str, Any]) -> None:
    """A tile 50 mm farther from the load cell."""
    tile["anchor"][2] += 0.05


def smaller(tile: dict[str, Any]) -> None:
    """A tile with a hundredth of its area."""
    tile["area"] *= 1e-2


def bodies_exchanged(recording: Recording) -> None:
    """The poses of socket and pylon, each under the other's name."""
    socket, pylon = recording.poses["socket"], recording.poses["pylon"]
    recording.poses = {"socket": pylon, "pylon": socket}


def lost(*own: topics.Topic) -> Damage:
    """A quarter of the messages of some topics."""

    def damage(recording: Recording) -> None:
        gaps = np.random.default_rng(6).uniform(size=len(recording.stamps)) < 0.25
        recording.lost |= dict.fromkeys(own, gaps)

    return damage


def mass(stated: float) -> Damage:
    """Of the stated mass [kg]."""
    return lambda recording: setattr(recording, "mass", stated)


def both(*damages: Damage) -> Damage:
    """One after the other."""
    return lambda recording: [damage(recording) for damage in damages]


def without(cluster: str) -> Damage:
    """A cluster that no message contains."""
    return lambda recording: recording.capacitance.pop(cluster)


POSES = (topics.SOCKET_POSE, topics.PYLON_POSE)
CELL = r"the wrench|the load cell|the units: [MF]|[MF][xyz]:"
LIMB = r"the limb pose|the wrench or the limb pose|the units: the limb"
AXES, LATE = f"{CELL}|{LIMB}", ".* (late|early) by"


def of(*clusters: str) -> str:
    """Findings on clusters, or on any of them."""
    names = "|".join(clusters or (BRIM, ANTERIOR, POSTERIOR, DISTAL))
    return rf"{names}|the clusters|the units: ({names})|.*({names})|.*calibration.yaml"


# By copy: what a true finding starts with, and the damage.
DAMAGED: dict[str, tuple[str, Damage]] = {
    "wrench negated": (CELL, wrench(times(-1.0))),
    "forces negated": (CELL, wrench(times(1, 1, 1, -1, -1, -1))),
    "moments negated": (AXES, wrench(times(-1, -1, -1, 1, 1, 1))),
    "Fx negated": (CELL, wrench(times(1, 1, 1, -1, 1, 1))),
    "Fz negated": (CELL, wrench(times(1, 1, 1, 1, 1, -1))),
    "Mx negated": (AXES, wrench(times(-1, 1, 1, 1, 1, 1))),
    "Mz negated": (CELL, wrench(times(1, 1, -1, 1, 1, 1))),
    "forces in kN": (CELL, wrench(times(1, 1, 1, 1e-3, 1e-3, 1e-3))),
    "wrench in kgf, kgf m": (CELL, wrench(times(1 / 9.81))),
    "the same, 28 kg stated": (CELL, both(wrench(times(1 / 9.81)), mass(28.0))),
    "wrench in lbf, lbf ft": (CELL, wrench(times(*[0.738] * 3, *[0.225] * 3))),
    "moments in N mm": (CELL, wrench(times(1e3, 1e3, 1e3, 1, 1, 1))),
    "moments in N cm": (CELL, wrench(times(1e2, 1e2, 1e2, 1, 1, 1))),
    "moments in lbf in": (CELL, wrench(times(8.85, 8.85, 8.85, 1, 1, 1))),
    "moments in kN m": (CELL, wrench(times(1e-3, 1e-3, 1e-3, 1, 1, 1))),
    "x and y exchanged": (AXES, wrench(order(1, 0, 2, 4, 3, 5))),
    "Fx and Fy exchanged": (CELL, wrench(order(0, 1, 2, 4, 3, 5))),
    "Mx and My exchanged": (AXES, wrench(order(1, 0, 2, 3, 4, 5))),
    "Fy and Fz exchanged": (CELL, wrench(order(0, 1, 2, 3, 5, 4))),
    "forces before moments": (CELL, wrench(order(3, 4, 5, 0, 1, 2))),
    "load cell turned by 45 deg": (AXES, wrench(turned(45.0))),
    "load cell turned by 90 deg": (AXES, wrench(turned(90.0))),
    "load cell turned by 180 deg": (AXES, wrench(turned(180.0))),
    "load cell left-handed": (AXES, wrench(times(1, -1, 1, 1, -1, 1))),
    "load cell upside down": (CELL, wrench(times(1, -1, -1, 1, -1, -1))),
    "Fz dead": (CELL, wrench(times(1, 1, 1, 1, 1, 0))),
    "Mx dead": (CELL, wrench(times(0, 1, 1, 1, 1, 1))),
    "bridge 3 dead": (CELL, bridges(times(1, 1, 0, 1, 1, 1))),
    "bridge 1 constant": (CELL, bridges(still(0))),
    "bridge 3 halved": (CELL, bridges(times(1, 1, 0.5, 1, 1, 1))),
    "bridge 3 doubled": (CELL, bridges(times(1, 1, 2, 1, 1, 1))),
    "bridge 5 halved": (CELL, bridges(times(1, 1, 1, 1, 0.5, 1))),
    "bridges 1 and 2 exchanged": (CELL, bridges(order(1, 0, 2, 3, 4, 5))),
    "bridges 4 and 5 exchanged": (AXES, bridges(order(0, 1, 2, 4, 3, 5))),
    "bridges 1 and 4 exchanged": (AXES, bridges(order(3, 1, 2, 0, 4, 5))),
    "wrench halved": (CELL, wrench(times(0.5))),
    "wrench doubled": (CELL, wrench(times(2.0))),
    "wrench unlike its ratios": (CELL, both(bridges(times(1)), wrench(times(0.8)))),
    "tared under load": (CELL, wrench(lambda values: values - values[len(values) // 2])),
    "Fz offset by 50 N": (CELL, wrench(plus(0, 0, 0, 0, 0, 50))),
    "Fz drifts by 60 N": (CELL, wrench(drift(60.0, 5))),
    "My drifts by 3 N m": (CELL, wrench(drift(3.0, 1))),
    "Fz steps by 100 N": (CELL, wrench(step(100.0, 5))),
    "My steps by 3 N m": (CELL, wrench(step(3.0, 1))),
    "5 spikes of 60 N": (CELL, wrench(spikes(60.0, 5))),
    "a spike of 400 N": (CELL + "|single", wrench(spikes(400.0, 5, 1))),
    "noise of 30 N": (CELL, wrench(noise(0.5, 0.5, 0.5, 30, 30, 30))),
    "moments 150 mm lower": (CELL, wrench(about(0.0, 0.0, -0.15))),
    "moments 30 mm aside": (CELL, wrench(about(0.03, 0.0, 0.0))),
    "wrench late by 1": (LATE, wrench(late(1))),
    "wrench late by 5": (LATE, wrench(late(5))),
    "wrench late by 20": (LATE, wrench(late(20))),
    "slow clock of the load cell": (LATE, wrench(slow_clock())),
    "wrench every second time": (CELL, wrench(repeated)),
    "wrench still for 10 s": (CELL, wrench(still(seconds=(100, 140)))),
    "a quarter of wrenches lost": (CELL, lost(topics.WRENCH, topics.LOAD_CELL_RAW)),
    "mass a fifth": (CELL, mass(5.5)),
    "mass tenfold": (CELL, mass(280.0)),
    "positions in mm": (LIMB, pose(times(1e3, 1e3, 1e3, 1, 1, 1, 1))),
    "positions in cm": (LIMB, pose(times(1e2, 1e2, 1e2, 1, 1, 1, 1))),
    "positions 1.25 times": (LIMB, pose(times(1.25, 1.25, 1.25, 1, 1, 1, 1))),
    "quaternion w first": (LIMB, pose(order(0, 1, 2, 6, 3, 4, 5))),
    "quaternion inverted": (LIMB, pose(times(1, 1, 1, -1, -1, -1, 1))),
    "world left-handed": (LIMB, pose(times(1, -1, 1, -1, 1, -1, 1))),
    "z of positions reversed": (LIMB, pose(times(1, 1, -1, 1, 1, 1, 1))),
    "bodies exchanged": (LIMB, bodies_exchanged),
    "socket still for 10 s": (LIMB, pose(still(seconds=(100, 140)), "socket")),
    "pylon still throughout": (LIMB, pose(still(), "pylon")),
    "pylon moved by 20 mm": (LIMB, pose(step(0.02, 0), "pylon")),
    "pylon moved by 8 mm": (LIMB, pose(step(0.008, 0), "pylon")),
    "pylon drifts by 5 mm": (LIMB, pose(drift(0.005, 0), "pylon")),
    "pylon's axes turned by 10 deg": (LIMB, pose(vector_turned(0.0, 10.0, 0.0), "pylon")),
    "5 spikes of 3 mm": (LIMB, pose(spikes(0.003, 0), "pylon")),
    "noise of 3 mm": (LIMB, pose(noise(0.003, 0.003, 0.003, 0, 0, 0, 0), "pylon")),
    "poses late by 1": (f"{LIMB}|{LATE}", pose(late(1))),
    "poses late by 5": (f"{LIMB}|{LATE}", pose(late(5))),
    "poses late by 20": (f"{LIMB}|{LATE}", pose(late(20))),
    "slow clock of the poses": (f"{LIMB}|{LATE}", pose(slow_clock())),
    "poses every second time": (LIMB, pose(repeated)),
    "a quarter of poses lost": (LIMB, lost(*POSES)),
    "brim and posterior exchanged": (of(BRIM, POSTERIOR), exchanged(BRIM, POSTERIOR)),
    "anterior and distal exchanged": (of(ANTERIOR, DISTAL), exchanged(ANTERIOR, DISTAL)),
    "three exchanged": (of(BRIM, ANTERIOR, POSTERIOR), exchanged(BRIM, ANTERIOR, POSTERIOR)),
    "two inputs exchanged": (of(ANTERIOR), inputs(order(1, 0, 2, 3), ANTERIOR)),
    "capacitances in fF": (of(), inputs(times(1e3))),
    "capacitances in nF": (of(), inputs(times(1e-3))),
    "an input constant": (of(ANTERIOR), inputs(still(1), ANTERIOR)),
    "an input still for 10 s": (of(ANTERIOR), inputs(still(1, seconds=(100, 140)), ANTERIOR)),
    "an input 0": (of(POSTERIOR), inputs(times(1, 1, 0, 1), POSTERIOR)),
    "an input reads another": (of(POSTERIOR), inputs(order(0, 0, 2, 3), POSTERIOR)),
    "an input off by 0.5 pF": (of(ANTERIOR), inputs(plus(0, 0.5, 0, 0), ANTERIOR)),
    "an input steps by 3.1 pF": (of(POSTERIOR), inputs(step(3.125, 2), POSTERIOR)),
    "noise of an input": (of(POSTERIOR), inputs(noise(0, 0, 0.1, 0), POSTERIOR)),
    "noise of a cluster": (of(POSTERIOR), inputs(noise(0.2), POSTERIOR)),
    "a cluster clipped at half": (of(ANTERIOR), inputs(at_most(0.5), ANTERIOR)),
    "a cluster reversed": (of(POSTERIOR), inputs(lambda v: 2.0 * v.mean(axis=0) - v, POSTERIOR)),
    "a cluster halved": (of(ANTERIOR), inputs(gain(0.5), ANTERIOR)),
    "a cluster doubled": (of(ANTERIOR), inputs(gain(2.0), ANTERIOR)),
    "a cluster trebled": (of(POSTERIOR), inputs(gain(3.0), POSTERIOR)),
    "all clusters halved": (of(), inputs(gain(0.5))),
    "all clusters doubled": (of(), inputs(gain(2.0))),
    "a cluster off by 20 kPa": (of(POSTERIOR), inputs(plus(0.75), POSTERIOR)),
    "a cluster drifts by 20 kPa": (of(POSTERIOR), inputs(drift(0.75, 0, 1, 2, 3), POSTERIOR)),
    "all drift by 20 kPa": (of(), inputs(drift(0.75, 0, 1, 2, 3))),
    "a cluster steps by 20 kPa": (of(POSTERIOR), inputs(step(0.75, 0, 1, 2, 3), POSTERIOR)),
    "5 spikes of 1 pF": (of(POSTERIOR), inputs(spikes(1.0, 2), POSTERIOR)),
    "a cluster late by 1": (of(ANTERIOR), inputs(late(1), ANTERIOR)),
    "a cluster late by 5": (of(ANTERIOR), inputs(late(5), ANTERIOR)),
    "a cluster late by 20": (of(ANTERIOR), inputs(late(20), ANTERIOR)),
    "the clusters late by 5": (LATE, inputs(late(5))),
    "the clusters late by 20": (LATE, inputs(late(20))),
    "slow clock of the clusters": (LATE, inputs(slow_clock())),
    "clusters every second time": (of(), inputs(repeated)),
    "a cluster still for 10 s": (of(POSTERIOR), inputs(still(seconds=(100, 140)), POSTERIOR)),
    "a cluster reads another": (
        of(BRIM, ANTERIOR),
        lambda r: r.capacitance.update({BRIM: r.capacitance[ANTERIOR]}),
    ),
    "a quarter of clusters lost": (of(), lost(topics.CAPACITANCE)),
    "a cluster in no message": (of(POSTERIOR), without(POSTERIOR)),
    "a cluster unplugged": (of(POSTERIOR), inputs(gone(0.5), POSTERIOR)),
    "calibration in kPa": (of(), calibrated(1e-3)),
    "calibration in mmHg": (of(), calibrated(1 / 133.3)),
    "a calibration 1.5 times": (of(POSTERIOR), calibrated(1.5, POSTERIOR)),
    "socket turned by 90 deg": (".", socket_turned(90.0)),
    "socket turned by 20 deg": (".", socket_turned(20.0)),
    "socket 50 mm higher": (".", tiles(higher)),
    "areas in another unit": ("the socket|the clusters", tiles(smaller)),
}  # fmt: skip


def findings(recording: Recording, path: Path) -> list[str]:
    """What the data check says of a recording; a refusal is a finding."""
    write(recording, path)
    try:
        return [str(found) for found in st.check_data(path)]
    except TestbedError as error:
        return [f"data: check {error}"]


def judge(found: list[str], right: str) -> str:
    """The verdict on the findings of a damaged copy."""
    if not found:
        return "silent"
    return "named" if re.match(f"data: check ({right})", found[0]) else "misleading"


def sound_trials(count: int, folder: Path) -> list[str]:
    """Findings on sound trials of all scenarios, tissues and rates, 20 to 300 s long."""
    rng = np.random.default_rng(2026)
    alarms = []
    for number in range(count):
        rate = float(rng.choice([1.0, 4.0, 4.0, 25.0, 100.0]))
        least, most = max(20.0, 31.0 / rate), min(300.0, 4000.0 / rate)
        duration = float(np.exp(rng.uniform(np.log(least), np.log(most))))
        trial = st.simulate(
            folder / f"sound_{number}",
            SCENARIOS[number % 4],
            tissue=TISSUES[number // 4 % 2],
            duration=duration,
            rate=rate,
            seed=3000 + number,
            donning=number if number % 5 == 1 else None,
        )
        alarms += [f"{trial}: {found}" for found in trial.problems()]
    return alarms


def main() -> None:
    """Damage a trial of every scenario, check all copies, then sound trials, and count."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    trials = ["protocol:soft", "static_hold:stiff"]
    parser.add_argument("--trials", nargs="+", default=trials, help="scenarios and tissues")
    parser.add_argument("--duration", type=float, default=120.0, help="of a trial [s]")
    parser.add_argument("--seed", type=int, default=71, help="of the limbs")
    parser.add_argument("--only", default="", help="copies whose name contains this expression")
    parser.add_argument("--sound", type=int, default=200, help="number of sound trials")
    options = parser.parse_args()
    names = [name for name in DAMAGED if re.search(options.only, name)]
    print(__doc__)
    with threadpool_limits(1), tempfile.TemporaryDirectory() as folder:
        for scenario, tissue in (trial.split(":") for trial in options.trials):
            base = record(scenario, tissue, 4.0, options.duration, options.seed)
            counts: Counter[str] = Counter()
            for name in names:
                copy = deepcopy(base)
                right, damage = DAMAGED[name]
                damage(copy)
                found = findings(copy, Path(folder) / f"{scenario} {name}")
                verdict = judge(found, right)
                counts[verdict] += 1
                words = found[0].removeprefix("data: check ")[:100] if found else ""
                print(f"{scenario:<15} {name:<30} {verdict:<10} {words}", flush=True)
            print(
                f"{scenario} ({tissue}): {counts['named']} of {len(names)} damaged copies named,"
                f" {counts['misleading']} misleading, {counts['silent']} silent"
            )
        alarms = sound_trials(options.sound, Path(folder))
    print(*alarms, sep="\n")
    print(f"sound: {len(alarms)} findings on {options.sound} trials")


if __name__ == "__main__":
    main()
