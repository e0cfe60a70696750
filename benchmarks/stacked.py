r"""Stage 2 as everyone writes it first: one row per sample and channel, offsets as variables.

The rows are weighted so that the objective is :math:`\|A z - y\|^2`, the same as the
package's own: z holds the 3n stiffnesses, then an offset for each channel of the wrench,
then one for each channel of the clusters, all in SI units until the columns are scaled.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from problems import StageTwoInput, gated_displacement
from scipy import sparse

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.identification.contact_law import wrench_map

_BLOCK = 512  # rows at a time where the objective is evaluated


@dataclass(frozen=True)
class Solution:
    """A solution of Stage 2 in SI units.

    Attributes:
        stiffness: Stiffnesses, shape (3n,) [N/m].
        wrench_bias: Offset of the wrench, shape (6,) [N m, N].
        channel_bias: Offset of each channel of the clusters, shape (12,) [N].
        status: The solver's own verdict.
    """

    stiffness: FloatArray
    wrench_bias: FloatArray
    channel_bias: FloatArray
    status: str


@dataclass(frozen=True)
class RowBlock:
    """Consecutive rows that share their columns.

    Attributes:
        values: Entries, weighted, shape (r, c) [1 over the unit of the column].
        columns: Column of each, shape (c,).
        target: Right-hand side y, shape (r,) [-].
    """

    values: FloatArray
    columns: IntArray
    target: FloatArray


def smoothness_rows(stage: StageTwoInput) -> FloatArray:
    """Rows D with ``|D k|^2 = lambda J_s``, shape (3e, 3n) [m/N]."""
    pairs = stage.geometry.neighbours
    difference = np.zeros((len(pairs), len(stage.geometry)))
    difference[np.arange(len(pairs)), pairs[:, 0]] = 1.0
    difference[np.arange(len(pairs)), pairs[:, 1]] = -1.0
    expected = stage.settings.stiffness_difference
    weight = stage.settings.smoothness / (3.0 * len(pairs) * expected**2)
    return np.sqrt(weight) * np.kron(difference, np.eye(3))


def row_blocks(stage: StageTwoInput) -> Iterator[RowBlock]:
    """All rows, one channel after the other."""
    objective, points = stage.objective, len(stage.geometry)
    count = len(objective.samples.position)
    s = gated_displacement(
        objective.samples.position, stage.rest_positions, stage.settings.gate_sharpness
    ).reshape(count, -1)
    mapping = wrench_map(stage.geometry.anchors)
    for row in range(6):
        root = np.sqrt(objective.wrench_weights[row] / count)
        columns = np.flatnonzero(mapping[row])
        springs = s[:, columns] * (root * mapping[row, columns])
        offset = np.full((count, 1), root)
        yield RowBlock(
            np.hstack([springs, offset]),
            np.append(columns, 3 * points + row),
            root * objective.wrench[:, row],
        )
    for number, channel in enumerate(objective.channels):
        root = np.sqrt(objective.channel_weights[number] / len(channel.force))
        columns = 3 * channel.point + np.arange(3)
        springs = s[np.ix_(channel.rows, columns)] * (root * channel.direction)
        offset = np.full((len(springs), 1), root)
        yield RowBlock(
            np.hstack([springs, offset]),
            np.append(columns, 3 * points + 6 + number),
            root * channel.force,
        )
    smoothness = smoothness_rows(stage)
    yield RowBlock(smoothness, np.arange(3 * points), np.zeros(len(smoothness)))


def stacked_shape(stage: StageTwoInput) -> tuple[int, int]:
    """Rows and columns of the stacked matrix."""
    channels = stage.objective.channels
    rows = 6 * len(stage.objective.samples.position) + sum(len(c.force) for c in channels)
    columns = 3 * len(stage.geometry) + 6 + len(channels)
    return rows + 3 * len(stage.geometry.neighbours), columns


def stack_dense(stage: StageTwoInput) -> tuple[FloatArray, FloatArray]:
    """The stacked matrix A and right-hand side y, dense, in SI units."""
    A = np.zeros(stacked_shape(stage))
    targets, start = [], 0
    for block in row_blocks(stage):
        A[start : start + len(block.values), block.columns] = block.values
        targets.append(block.target)
        start += len(block.values)
    return A, np.concatenate(targets)


def stack_sparse(stage: StageTwoInput) -> tuple[sparse.csr_array, FloatArray]:
    """The stacked matrix A without its zeros, and the right-hand side y, in SI units."""
    width = stacked_shape(stage)[1]
    parts, targets = [], []
    for block in row_blocks(stage):
        rows, entries = block.values.shape
        indices = np.tile(block.columns, rows)
        starts = entries * np.arange(rows + 1)
        part = sparse.csr_array((block.values.ravel(), indices, starts), shape=(rows, width))
        part.eliminate_zeros()
        parts.append(part)
        targets.append(block.target)
    return sparse.vstack(parts, format="csr"), np.concatenate(targets)


def bounds(stage: StageTwoInput) -> FloatArray:
    """Lower bounds: zero for a stiffness, none for an offset, shape (3n + 18,)."""
    springs = 3 * len(stage.geometry)
    offsets = stacked_shape(stage)[1] - springs
    return np.concatenate([np.zeros(springs), np.full(offsets, -np.inf)])


def to_solution(stage: StageTwoInput, z: FloatArray, status: str) -> Solution:
    """A point of the stacked problem in SI units, moved into its bounds."""
    stiffness, offsets = np.split(z, [3 * len(stage.geometry)])
    # A solver may leave the bounds by its tolerance, and would gain by it in the objective.
    return Solution(np.maximum(stiffness, 0.0), offsets[:6], offsets[6:], status)


def objective_value(stage: StageTwoInput, solution: Solution) -> float:
    """Objective of Stage 2 from the definition: no moments, no stacked matrix [-]."""
    objective = stage.objective
    count, points = len(objective.samples.position), len(stage.geometry)
    mapping = wrench_map(stage.geometry.anchors)
    by_point = solution.stiffness.reshape(points, 3)
    wrench_sum = np.zeros(6)
    tiles = [channel.point for channel in objective.channels]
    channel_forces = np.empty((count, len(tiles), 3))
    for start in range(0, count, _BLOCK):
        rows = slice(start, start + _BLOCK)
        forces = by_point * gated_displacement(
            objective.samples.position[rows], stage.rest_positions, stage.settings.gate_sharpness
        )
        model = forces.reshape(-1, 3 * points) @ mapping.T + solution.wrench_bias
        wrench_sum += ((model - objective.wrench[rows]) ** 2).sum(axis=0)
        channel_forces[rows] = forces[:, tiles]
    value = float(objective.wrench_weights @ wrench_sum) / count
    for number, channel in enumerate(objective.channels):
        model = channel_forces[channel.rows, number] @ channel.direction
        error = model + solution.channel_bias[number] - channel.force
        value += objective.channel_weights[number] * float(np.mean(error**2))
    roughness = smoothness_rows(stage) @ solution.stiffness
    return value + float(roughness @ roughness)
