"""Synthetic fitting problems: tiles on a cylinder, a spring law as truth, offsets and noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.box_qp import solve_box_qp
from socket_testbed.identification.contact import ContactModel, gate
from socket_testbed.identification.problem import Objective, Problem, build_objective
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import IdentificationSettings

Motion = Literal["hold", "multi"]
MOTIONS: tuple[Motion, ...] = get_args(Motion)

CLUSTERS = ("brim_lateral", "mid_anterior", "posterior_distal", "distal")

_AMPLITUDE = {"hold": 1e-4, "multi": 3e-3}  # [m]; of the limb's motion along each axis
_RADIUS, _HEIGHT = 0.055, 0.22  # [m]; of the cylinder
_TILE_AREA = 9e-4  # [m^2]
_RATE = 4.0  # [Hz]; of the trigger
_LIMB = np.array([0.004, -0.003, 0.150])  # [m]; mean position of the limb in {S}
_WRENCH_NOISE = np.repeat([0.05, 0.5], 3)  # [N m, N]; standard deviations
_FORCE_NOISE = 0.2  # [N]; standard deviation in a cluster's channel
_WRENCH_OFFSET = np.array([0.6, -0.4, 0.2, 8.0, -5.0, 12.0])  # [N m, N]
_FORCE_OFFSET = 2.0  # [N]; standard deviation over the clusters' channels
_BLOCK = 256  # samples; a big temporary here would hide the memory of what is measured


@dataclass(frozen=True)
class StageTwoInput:
    """What every method is given: the weighted samples and the rest positions of Stage 1.

    Attributes:
        samples: The samples before they were weighted.
        geometry: Geometry of the socket.
        settings: Settings of the identification, of the variant with offsets.
        objective: The samples with the weight of each channel.
        rest_positions: Rest positions q_r of Stage 1, shape (n, 3) [m].
    """

    samples: Samples
    geometry: SocketGeometry
    settings: IdentificationSettings
    objective: Objective
    rest_positions: FloatArray


def make_problem(
    points: int, count: int, motion: Motion, smoothness: float, seed: int = 7
) -> StageTwoInput:
    """Build a seeded problem and solve its Stage 1.

    Args:
        points: Number n of points of interest.
        count: Number N of samples.
        motion: `hold` vibrates by 0.1 mm, `multi` moves by 3 mm along every axis.
        smoothness: Weight lambda of the smoothness [-].
        seed: Seed of the random numbers.
    """
    geometry = cylinder(points)
    samples = simulate(geometry, count, motion, np.random.default_rng(seed))
    settings = IdentificationSettings(variant="stiffness_bias", smoothness=smoothness)
    objective = build_objective(samples, geometry, settings)
    problem = Problem(objective)
    rest = solve_box_qp(problem.stage_one(), settings.solver, settings.solver_tolerance)
    rest_positions = problem.law.reference_pose[:3] + MILLIMETRE * rest.x.reshape(3, -1).T
    return StageTwoInput(samples, geometry, settings, objective, rest_positions)


MILLIMETRE = 1e-3  # [m]; scale of the rest positions


def with_rest(problem: Problem, rest_positions: FloatArray) -> FloatArray:
    """Parameters with these rest positions, shape (6, n) [-]."""
    x = problem.start.copy()
    x[3:] = (rest_positions - problem.law.reference_pose[:3]).T / MILLIMETRE
    return x


def gated_displacement(
    position: FloatArray, rest_positions: FloatArray, sharpness: float
) -> FloatArray:
    """Gated displacements of the paper's law, shape (N, n, 3) [m]."""
    displacement = position[:, None] - rest_positions
    return displacement * gate(displacement, sharpness)


def cylinder(points: int) -> SocketGeometry:
    """Tiles on a cylinder about the z axis of {S}, each a neighbour of those around it."""
    rings = max(d for d in range(1, math.isqrt(points) + 1) if points % d == 0)
    around = points // rings
    ring, column = np.divmod(np.arange(points), around)
    angle = 2.0 * np.pi * column / around
    radial = np.stack([np.cos(angle), np.sin(angle), np.zeros(points)], axis=1)
    height = 0.04 + _HEIGHT * (ring + 0.5) / rings
    x = np.tile([0.0, 0.0, 1.0], (points, 1))
    z = -radial
    frames = np.stack([x, np.cross(z, x), z], axis=2)
    triad = np.array([[0.0, 0.0, 0.0], [0.06, 0.0, 0.0], [0.0, 0.04, 0.0]])
    still = Pose(np.eye(3), np.zeros(3))
    return SocketGeometry(
        names=tuple(f"tile_{i:03d}" for i in range(points)),
        anchors=_RADIUS * radial + height[:, None] * x,
        rotations=frames,
        areas=np.full(points, _TILE_AREA),
        neighbours=_grid_neighbours(rings, around),
        clusters=_cluster_tiles(points),
        socket_markers=triad,
        pylon_markers=triad,
        socket_body=still,
        limb=still,
    )


def _grid_neighbours(rings: int, around: int) -> IntArray:
    index = np.arange(rings * around).reshape(rings, around)
    sideways = np.stack([index, np.roll(index, -1, axis=1)], axis=-1).reshape(-1, 2)
    upwards = np.stack([index[:-1], index[1:]], axis=-1).reshape(-1, 2)
    return np.unique(np.sort(np.vstack([sideways, upwards]), axis=1), axis=0).astype(np.int64)


def _cluster_tiles(points: int) -> dict[str, int]:
    fractions = (0.93, 0.62, 0.34, 0.08)
    return {name: int(f * points) for name, f in zip(CLUSTERS, fractions, strict=True)}


def simulate(
    geometry: SocketGeometry, count: int, motion: Motion, random: np.random.Generator
) -> Samples:
    """Samples of a spring bed with smooth stiffness, with offsets and white noise."""
    truth = _truth(geometry, random)
    position = _LIMB + _AMPLITUDE[motion] * _unit_motion(count, random)
    wrench = np.empty((count, 6))
    local = np.empty((count, len(CLUSTERS), 3))
    for start in range(0, count, _BLOCK):
        rows = slice(start, start + _BLOCK)
        wrench[rows] = truth.wrench(position[rows])
        forces = truth.cluster_forces(position[rows])
        local[rows] = np.stack([forces[name] for name in CLUSTERS], axis=1)
    wrench += _WRENCH_NOISE * random.standard_normal(wrench.shape)
    local += _FORCE_NOISE * random.standard_normal(local.shape)
    stamps = np.round(np.arange(count) / _RATE * 1e9).astype(np.int64)
    status = np.zeros((count, len(CLUSTERS)), dtype=np.uint8)
    rotation = np.zeros_like(position)
    return Samples(stamps, position, rotation, wrench, CLUSTERS, local, status)


def _unit_motion(count: int, random: np.random.Generator) -> FloatArray:
    """Two sines an axis with a tenth of white noise, of amplitude 1, shape (N, 3) [-]."""
    time = np.arange(count)[:, None] / _RATE
    motion = 0.1 * random.standard_normal((count, 3))
    for amplitude, frequencies in ((0.7, (0.11, 0.17, 0.13)), (0.3, (0.71, 0.53, 0.83))):
        phase = random.uniform(0.0, 2.0 * np.pi, 3)
        motion += amplitude * np.sin(2.0 * np.pi * np.array(frequencies) * time + phase)
    return motion


def _truth(geometry: SocketGeometry, random: np.random.Generator) -> ContactModel:
    points = len(geometry)
    x, y, z = (geometry.anchors / np.array([_RADIUS, _RADIUS, _HEIGHT])).T
    waves = np.stack([x + z, y - z, np.sin(3.0 * z)], axis=1)
    waves -= waves.mean(axis=0)
    # A third of the springs is slack: bounds that nothing touches would make an easy problem.
    stiffness = 1000.0 + 4000.0 * waves + 200.0 * random.standard_normal((points, 3))
    slack = 0.0015 * waves[:, ::-1] + 0.0005 * random.standard_normal((points, 3))
    return ContactModel(
        variant="stiffness_bias",
        names=geometry.names,
        anchors=geometry.anchors,
        rotations=geometry.rotations,
        stiffness=np.maximum(stiffness, 0.0),
        rest_positions=_LIMB + slack,
        sharpness=IdentificationSettings().gate_sharpness,
        wrench_bias=_WRENCH_OFFSET,
        force_bias={c: _FORCE_OFFSET * random.standard_normal(3) for c in CLUSTERS},
        cluster_points=geometry.clusters,
    )
