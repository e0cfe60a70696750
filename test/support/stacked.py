"""The problems of both stages written out row by row, and what compares them with a fit."""

from dataclasses import dataclass
from itertools import product

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


def relative(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def stack_stage_one(
    samples: Samples, geometry: SocketGeometry, settings: IdentificationSettings
) -> StackedRows:
    """Stage 1 row by row, in the rest positions about q_ref [mm]."""
    reference = np.array(settings.reference_position or samples.position.mean(axis=0))
    # F = k0 (q - reference) - k0 u
    k0, moved = settings.initial_stiffness, np.tile(samples.position - reference, len(geometry))
    gain = np.full_like(moved, -k0 * MILLIMETRE)
    difference = settings.rest_position_difference / MILLIMETRE
    limit = settings.rest_position_limit / MILLIMETRE
    return _stack(samples, geometry, settings, gain, k0 * moved, difference, (-limit, limit), False)


def stack_stage_two(
    samples: Samples, geometry: SocketGeometry, settings: IdentificationSettings, rest: np.ndarray
) -> StackedRows:
    """Stage 2 row by row, in the stiffnesses [kN/m], with explicit offsets after them."""
    displacement = (samples.position[:, None] - rest).reshape(len(samples), -1)
    gain = KILONEWTON_PER_METRE * naive_gated(displacement, settings.gate_sharpness)
    difference = settings.stiffness_difference / KILONEWTON_PER_METRE
    with_bias, none = settings.variant == "stiffness_bias", np.zeros_like(gain)
    return _stack(samples, geometry, settings, gain, none, difference, (0.0, np.inf), with_bias)


def _stack(samples, geometry, settings, gain, constant, difference, bounds, with_bias):
    """Rows of theta J_w + (1 - theta) J_f + lambda J_s, with the forces F = gain x + constant."""
    measured, maps = samples.values, _channel_maps(samples, geometry)
    usable = np.isfinite(measured)
    usable[:, 6:] &= np.repeat(samples.status == 0, 3, axis=1)
    kept = np.array([name not in settings.leave_out for name in samples.channels])
    usable &= kept
    count = np.maximum(usable.sum(axis=0), 1)
    power = np.where(usable, measured, 0.0) ** 2
    weights = np.where(np.arange(len(kept)) < 6, settings.theta, 1.0 - settings.theta) / count
    if settings.weights == "raw":
        weights *= 2.0 / (power.sum(axis=0) / count).sum()
    else:
        for group, floor in ((slice(3), 0.1), (slice(3, 6), 1.0), (slice(6, None), 1.0)):
            size = power[:, group].sum() / max(usable[:, group].sum(), 1)
            weights[group] /= max(size, floor**2)
        for together in (slice(6), slice(6, None)):
            weights[together] /= max(kept[together].sum(), 1)
    root = np.sqrt(weights)

    rows = root[:, None] * maps * gain[:, None]  # by sample and channel
    targets = root * (measured - constant @ maps.T)
    offsets = root[:, None] * np.eye(len(kept))[:, kept if with_bias else []]
    offsets = np.broadcast_to(offsets, (len(rows), *offsets.shape))
    A = np.concatenate([rows, offsets], axis=2)[usable]
    smooth = np.sqrt(settings.smoothness / (3 * len(geometry.neighbours))) / difference
    differences = np.zeros((3 * len(geometry.neighbours), A.shape[1]))
    for k, ((a, b), axis) in enumerate(product(geometry.neighbours, range(3))):
        differences[k, [3 * a + axis, 3 * b + axis]] = smooth, -smooth
    free = np.arange(A.shape[1]) >= gain.shape[1]
    lower, upper = np.where(free, -np.inf, bounds[0]), np.where(free, np.inf, bounds[1])
    b = np.concatenate([targets[usable], np.zeros(len(differences))])
    return StackedRows(np.vstack([A, differences]), b, lower, upper)


def _channel_maps(samples: Samples, geometry: SocketGeometry) -> np.ndarray:
    """How the forces on all tiles in {S} make the channels, shape (6 + 3c, 3n)."""
    maps = np.zeros((len(samples.channels), len(geometry), 3))
    maps[:3] = np.cross(geometry.anchors[:, None], np.eye(3)).transpose(2, 0, 1)
    maps[3:6] = np.eye(3)[:, None]
    for k, name in enumerate(samples.clusters):
        tile = geometry.clusters[name]
        maps[6 + 3 * k : 9 + 3 * k, tile] = geometry.rotations[tile].T
    return maps.reshape(len(maps), -1)
