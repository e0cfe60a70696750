"""Random sockets, spring beds and samples, and the problems written out row by row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from socket_testbed.contact import ContactModel, Variant
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.samples import Samples
from socket_testbed.settings import IdentificationSettings

SOCKET_TRIAD = np.array([[0.0, 0.0, 0.0], [0.09, 0.0, 0.01], [-0.01, 0.045, 0.0]])  # [m]
PYLON_TRIAD = np.array([[0.0, 0.01, 0.0], [0.07, 0.0, 0.0], [0.01, 0.05, 0.02]])  # [m]
KILONEWTON_PER_METRE = 1e3  # [N/m]
MILLIMETRE = 1e-3  # [m]


def random_pose(rng: np.random.Generator, reach: float = 0.3, count: int | None = None) -> Pose:
    """A random pose, or `count` of them, within `reach` [m]."""
    shape = (3,) if count is None else (count, 3)
    return Pose(Rotation.random(count, rng=rng).as_matrix(), rng.uniform(-reach, reach, shape))


def random_socket(
    rng: np.random.Generator, rings: int = 2, columns: int = 4, clusters: int = 3
) -> SocketGeometry:
    """A cone of rings x columns tiles around z of {S}, z pointing to the proximal end.

    The clusters lie on random tiles; the neighbours are those along the ring and the column.
    """
    names, anchors, rotations, pairs = [], [], [], []
    cone = rng.uniform(0.05, 0.2)  # [rad]
    for ring in range(rings):
        for column in range(columns):
            angle = 2.0 * np.pi * (column + rng.uniform(-0.1, 0.1)) / columns
            outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
            upwards = np.array([0.0, 0.0, 1.0])
            z = -np.cos(cone) * outwards + np.sin(cone) * upwards
            x = np.sin(cone) * outwards + np.cos(cone) * upwards
            radius = 0.045 + 0.01 * ring + rng.uniform(-0.002, 0.002)
            names.append(f"tile_{ring}_{column}")
            anchors.append(radius * outwards + (0.1 + 0.06 * ring) * upwards)
            rotations.append(np.column_stack([x, np.cross(z, x), z]))
            tile = ring * columns + column
            pairs.append(sorted((tile, ring * columns + (column + 1) % columns)))
            if ring + 1 < rings:
                pairs.append([tile, tile + columns])
    covered = rng.permutation(len(names))[:clusters].tolist()
    return SocketGeometry(
        names=tuple(names),
        anchors=np.array(anchors),
        rotations=np.array(rotations),
        areas=np.full(len(names), 9e-4),
        neighbours=np.unique(np.array(pairs), axis=0),
        clusters={f"cluster_{i}": int(tile) for i, tile in enumerate(covered)},
        socket_markers=SOCKET_TRIAD,
        pylon_markers=PYLON_TRIAD,
        socket_body=random_pose(rng),
        limb=random_pose(rng),
    )


def random_bed(
    rng: np.random.Generator,
    geometry: SocketGeometry,
    variant: Variant = "stiffness",
    untouched: float = 0.0,
) -> ContactModel:
    """A spring bed, a fraction of it `untouched` (stiffness 0); offsets in the bias variant."""
    n = len(geometry)
    with_bias = variant == "stiffness_bias"
    return ContactModel(
        variant=variant,
        names=geometry.names,
        anchors=geometry.anchors,
        rotations=geometry.rotations,
        stiffness=rng.uniform(500.0, 8000.0, (n, 3)) * (rng.random((n, 3)) >= untouched),
        rest_positions=rng.uniform(-0.002, 0.002, (n, 3)),
        sharpness=2000.0,
        wrench_bias=with_bias * rng.normal(0.0, [1.0, 1.0, 1.0, 10.0, 10.0, 10.0]),
        force_bias={name: rng.normal(0.0, 5.0, 3) for name in geometry.clusters if with_bias},
        cluster_points=dict(geometry.clusters),
    )


def moving_limb(rng: np.random.Generator, count: int, amplitude: float = 0.003) -> np.ndarray:
    """Limb positions that cross the gates of all axes on ways of their own, (N, 3) [m]."""
    phase = np.linspace(0.0, 2.0 * np.pi, count)[:, None] * [1.0, 2.0, 3.0]
    way = amplitude * np.sin(phase + rng.uniform(0.0, 2.0 * np.pi, 3))
    return way + rng.normal(0.0, 0.1 * amplitude, (count, 3))


def make_samples(
    position: np.ndarray,
    wrench: np.ndarray,
    forces: dict[str, np.ndarray],
) -> Samples:
    """Complete samples at 4 Hz."""
    count = len(position)
    return Samples(
        stamps=np.int64(10**18) + 250_000_000 * np.arange(count, dtype=np.int64),
        position=position,
        wrench=wrench,
        clusters=tuple(forces),
        local_forces=np.stack([*forces.values()], axis=1) if forces else np.zeros((count, 0, 3)),
        status=np.zeros((count, len(forces)), dtype=np.uint8),
    )


def samples_of_bed(
    rng: np.random.Generator, bed: ContactModel, position: np.ndarray, noise: float = 0.0
) -> Samples:
    """What perfect sensors would measure on a bed, plus `noise` relative to 1 N and 0.1 N m."""
    wrench, forces = bed.wrench(position), bed.cluster_forces(position)
    wrench = wrench + noise * rng.normal(0.0, [0.1] * 3 + [1.0] * 3, wrench.shape)
    forces = {name: f + noise * rng.normal(0.0, 1.0, f.shape) for name, f in forces.items()}
    return make_samples(position, wrench, forces)


def naive_gated(displacement: np.ndarray, sharpness: float) -> np.ndarray:
    """The paper's form of s: (1/2 - 1/2 tanh(alpha d)) d."""
    return (0.5 - 0.5 * np.tanh(sharpness * displacement)) * displacement


@dataclass(frozen=True)
class StackedRows:
    """A least-squares problem ``min |A x - b|^2`` in bounds, every sample a block of rows.

    Attributes:
        A: Rows, shape (m, p).
        b: Targets, shape (m,).
        lower: Lower bounds, shape (p,).
        upper: Upper bounds, shape (p,).
        parameters: How many of the p unknowns come first; the offsets follow.
    """

    A: np.ndarray
    b: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    parameters: int

    def solve(self) -> np.ndarray:
        """All unknowns at the optimum, by an active-set method on the rows themselves."""
        answer = lsq_linear(
            self.A, self.b, (self.lower, self.upper), method="bvls", tol=1e-15, max_iter=1000
        )
        assert answer.success
        return answer.x

    def cost(self, parameters: np.ndarray) -> float:
        """|A x - b|^2 at given parameters, with the best offsets for them."""
        residual = self.b - self.A[:, : self.parameters] @ parameters
        offsets = self.A[:, self.parameters :]
        residual = residual - offsets @ np.linalg.lstsq(offsets, residual, rcond=None)[0]
        return float(residual @ residual)


def stack_stage_one(
    samples: Samples, geometry: SocketGeometry, settings: IdentificationSettings
) -> StackedRows:
    """Stage 1 row by row, in the rest positions about the mean limb position [mm]."""
    reference = samples.position.mean(axis=0)
    n, k0 = len(geometry), settings.initial_stiffness

    def springs(k: int) -> tuple[np.ndarray, np.ndarray]:
        # F = k0 (q - reference) - k0 u
        at_reference = np.tile(k0 * (samples.position[k] - reference), n)
        return -k0 * MILLIMETRE * np.eye(3 * n), at_reference

    difference = settings.rest_position_difference / MILLIMETRE
    limit = np.full(3 * n, settings.rest_position_limit / MILLIMETRE)
    return _stack(samples, geometry, settings, springs, difference, (-limit, limit), False)


def stack_stage_two(
    samples: Samples,
    geometry: SocketGeometry,
    settings: IdentificationSettings,
    rest_positions: np.ndarray,
) -> StackedRows:
    """Stage 2 row by row, in the stiffnesses [kN/m], with explicit offsets after them."""

    def springs(k: int) -> tuple[np.ndarray, np.ndarray]:
        displacement = (samples.position[k] - rest_positions).reshape(-1)
        s = naive_gated(displacement, settings.gate_sharpness)
        return KILONEWTON_PER_METRE * np.diag(s), np.zeros(3 * len(geometry))

    difference = settings.stiffness_difference / KILONEWTON_PER_METRE
    bounds = (np.zeros(3 * len(geometry)), np.full(3 * len(geometry), np.inf))
    with_bias = settings.variant == "stiffness_bias"
    return _stack(samples, geometry, settings, springs, difference, bounds, with_bias)


def _stack(samples, geometry, settings, springs, difference, bounds, with_bias) -> StackedRows:
    """Rows of theta J_w + (1 - theta) J_f + lambda J_s; `springs(k)` gives F = G x + h."""
    names, measured = samples.channels, samples.values
    usable = np.isfinite(measured)
    usable[:, 6:] &= np.repeat(samples.status == 0, 3, axis=1)
    kept = [i for i, name in enumerate(names) if name not in settings.leave_out]
    moments, forces = [i for i in kept if i < 3], [i for i in kept if 3 <= i < 6]
    local = [i for i in kept if i >= 6]
    wrench_share = settings.theta / max(len(moments) + len(forces), 1)
    local_share = (1.0 - settings.theta) / max(len(local), 1)
    root = np.zeros(len(names))  # of the weight of a squared error
    for group, floor, share in (
        (moments, 0.1, wrench_share),
        (forces, 1.0, wrench_share),
        (local, 1.0, local_share),
    ):
        values = measured[:, group][usable[:, group]]
        size = max(np.sqrt(np.mean(values**2)) if values.size else 0.0, floor)
        root[group] = np.sqrt(share / usable[:, group].sum(axis=0)) / size

    maps = [_channel_row(samples, geometry, i) for i in range(len(names))]
    offset_rows = np.zeros((len(names), len(kept) if with_bias else 0))
    if with_bias:
        offset_rows[kept, range(len(kept))] = 1.0
    rows, targets = [], []
    for k in range(len(samples)):
        G, h = springs(k)
        for i in kept:
            if usable[k, i]:
                rows.append(root[i] * np.concatenate([maps[i] @ G, offset_rows[i]]))
                targets.append(root[i] * (measured[k, i] - maps[i] @ h))
    columns = 3 * len(geometry)
    free = np.full(offset_rows.shape[1], np.inf)
    for a, b in geometry.neighbours:
        for axis in range(3):
            row = np.zeros(columns + len(free))
            row[3 * a + axis], row[3 * b + axis] = 1.0, -1.0
            weight = settings.smoothness / (3 * len(geometry.neighbours)) / difference**2
            rows.append(np.sqrt(weight) * row)
            targets.append(0.0)
    return StackedRows(
        np.array(rows),
        np.array(targets),
        np.concatenate([bounds[0], -free]),
        np.concatenate([bounds[1], free]),
        columns,
    )


def _channel_row(samples: Samples, geometry: SocketGeometry, channel: int) -> np.ndarray:
    """How the forces on all tiles in {S} make one channel, shape (3n,)."""
    row = np.zeros((len(geometry), 3))
    for tile in range(len(geometry)):
        for axis, force in enumerate(np.eye(3)):
            if channel < 3:
                row[tile, axis] = np.cross(geometry.anchors[tile], force)[channel]
            elif channel < 6:
                row[tile, axis] = force[channel - 3]
            elif geometry.clusters[samples.clusters[(channel - 6) // 3]] == tile:
                row[tile, axis] = (geometry.rotations[tile].T @ force)[channel % 3]
    return row.reshape(-1)
