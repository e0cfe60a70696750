"""The problems of both stages written out row by row, and what compares them with a fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import IdentificationSettings
from support.problems import naive_gated

KILONEWTON_PER_METRE = 1e3  # [N/m]
MILLIMETRE = 1e-3  # [m]
OPTIMUM = 1e-6  # [-]; what two solvers of one convex problem may differ by


@dataclass(frozen=True)
class StackedRows:
    """A least-squares problem ``min |A x - b|^2`` in bounds, every sample a block of rows."""

    A: np.ndarray  # rows, shape (m, p)
    b: np.ndarray  # targets, shape (m,)
    lower: np.ndarray  # lower bounds, shape (p,)
    upper: np.ndarray  # upper bounds, shape (p,)

    def solve(self) -> np.ndarray:
        """All unknowns at the optimum, by an active-set method on the rows themselves."""
        bounds = (self.lower, self.upper)
        answer = lsq_linear(self.A, self.b, bounds, method="bvls", tol=1e-15, max_iter=1000)
        assert answer.success
        return answer.x


def stack_stage_one(
    samples: Samples, geometry: SocketGeometry, settings: IdentificationSettings
) -> StackedRows:
    """Stage 1 row by row, in the rest positions about q_ref [mm]."""
    reference = np.array(settings.reference_position or samples.position.mean(axis=0))
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


def relative(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


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
    if settings.weights == "raw":
        power = np.nansum(np.where(usable, measured, np.nan) ** 2, axis=0) / usable.sum(axis=0)
        group_weight = np.where(np.arange(len(names)) < 6, settings.theta, 1.0 - settings.theta)
        raw = group_weight * 2.0 / power[kept].sum() / usable.sum(axis=0)
        root[kept] = np.sqrt(raw[kept])

    maps = [channel_row(samples, geometry, i) for i in range(len(names))]
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
    weight = settings.smoothness / (3 * len(geometry.neighbours)) / difference**2
    for a, b in geometry.neighbours:
        for axis in range(3):
            row = np.zeros(columns + len(free))
            row[3 * a + axis], row[3 * b + axis] = 1.0, -1.0
            rows.append(np.sqrt(weight) * row)
            targets.append(0.0)
    lower, upper = np.concatenate([bounds[0], -free]), np.concatenate([bounds[1], free])
    return StackedRows(np.array(rows), np.array(targets), lower, upper)


def channel_row(samples: Samples, geometry: SocketGeometry, channel: int) -> np.ndarray:
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
