r"""Rest displacements and stiffnesses of the `rigid` variants: two stages, then both jointly.

The objective is that of the two stages with a Gaussian prior over the tiles instead of their
plain smoothness, all divided by what predicting zero would cost:

.. math:: \frac{\theta J_w + (1 - \theta) J_f}{J_0} + \lambda \frac{1}{3n} \sum_a
          (x_a - \bar x_a)^T Q (x_a - \bar x_a), \qquad Q = \epsilon I + D^T D

x_a are the stiffnesses along an axis of the tiles' frames over their expected value, with mean
1, and the rest displacements over the expected one, with mean 0; D takes the differences of
neighbours. The expected stiffnesses, normal and tangential, are those of the uniform bed that
best explains how the wrench changes with the pose; the expected rest displacement is the mean
load over that bed's stiffness. So no stiffness is assumed.

The wrench's quadratic term of both stages is :math:`(CB)^T W (CB) \circ S^T S`, with B the
tiles' rotations. `rigid` has no offsets. In `rigid_bias` each cluster has free ones, and what the
springs leave of the wrench is fitted afterwards by a constant and a slope over the pose: the
springs bear what they can of the load.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.identification.box_qp import (
    BoxQP,
    BoxSolution,
    is_definite,
    pivot,
    solve_box_qp,
)
from socket_testbed.identification.contact import ContactModel, wrench_map
from socket_testbed.identification.problem import Objective, Solution
from socket_testbed.identification.rigid_bed import (
    PAIRS,
    compression,
    displacement_map,
    force_changes,
    force_derivatives,
    gate_slope,
    mean_pose,
    relative_pose,
)
from socket_testbed.settings.identification import Variant

MOST_ROWS = 500  # samples; of more, means over equal blocks are fitted

PARAMETER_RANK = 16  # directions of the parameters' uncertainty that a model keeps

_RATIOS = (0.1, 0.15, 0.2, 0.3, 0.45, 0.7, 1.0)  # [-]; of tangential to normal stiffness
_LARGEST_SETTLING = 0.02  # [m]; of a limb under its load; a bed is at least that stiff
_LEAST_SETTLING = 1e-4  # [m]
_OWN = 0.3  # [-]; epsilon: how far a tile may be from the common mean, against its neighbours
_SLOPE_RIDGE = 0.003  # [-]; against the variance of the pose
_LEAST_CHANGE = 0.01  # [-]; of the force, against its size, that a slope needs
_STEPS = 100
_DAMPING = 1e-2  # [-]; of the first step, against the mean curvature
_ROUNDING = 1e-13  # [-]; of the objective's value
_FLAT = 1e-10  # [-]; least pivot of a step's program


@dataclass(frozen=True)
class _Channel:
    """A channel of a cluster: rows with a value, values in those, weight of its squared error."""

    cluster: str
    point: int
    axis: int
    rows: BoolArray
    force: FloatArray
    weight: float


@dataclass(frozen=True)
class _Terms:
    """The objective at a point, and its derivatives by the scaled parameters (6, n), flattened."""

    value: float
    data: float
    gradient: FloatArray
    gauss_newton: FloatArray
    curvature: FloatArray


def solve_rigid(objective: Objective) -> Solution:
    """Both stages of a `rigid` variant and the joint refinement of their solutions.

    Raises:
        IdentificationError: If a solution misses the KKT tolerance.
    """
    problem = RigidProblem(objective)
    settings = objective.settings
    tolerance = settings.solver_tolerance

    rest = solve_box_qp(problem.stage_one(), settings.solver, tolerance)
    x = problem.start.copy()
    x[3:] = rest.x.reshape(3, -1)
    springs = solve_box_qp(problem.stage_two(x), settings.solver, tolerance)
    x[:3] = springs.x.reshape(3, -1)
    x, joint = refine(problem, x, tolerance)
    return Solution(
        model=problem.model(x),
        determined=problem.determined_directions(x),
        stage_one=rest,
        stage_two=springs,
        joint=joint,
    )


class RigidProblem:
    """The objective of a `rigid` variant as a function of the scaled parameters.

    Args:
        objective: The samples and weights.

    Attributes:
        start: Parameters of the uniform bed, shape (6, n) [-].
        lower: Lower bounds of the flattened parameters, shape (6n,) [-].
    """

    def __init__(self, objective: Objective) -> None:
        self._objective = objective
        self._sharpness = objective.settings.contact_sharpness
        self._with_offsets = objective.settings.variant == "rigid_bias"
        self._gather(objective)
        stiffness, rest = self._expect()
        points = len(objective.geometry)
        self._scale = np.repeat([*stiffness, rest, rest, rest], points).reshape(6, points)
        self.start = np.repeat([1.0, 1.0, 1.0, 0.0, 0.0, 0.0], points).reshape(6, points)
        self.lower = np.repeat([0.0, -np.inf], 3 * points)
        differences = objective.laplacian * max(len(objective.geometry.neighbours), 1)
        self._own = _OWN * np.eye(points) + differences
        self._prior = objective.settings.prior / (3.0 * points) * self._own

    def _gather(self, objective: Objective) -> None:
        geometry = objective.geometry
        pose = objective.samples.pose
        self.reference = mean_pose(pose)
        size = -(-len(pose) // MOST_ROWS)
        relative = _block_means(relative_pose(pose, self.reference), size)
        mapping = displacement_map(geometry.anchors, geometry.rotations, self.reference[:3])
        self._relative, self._displacement_map = relative, mapping
        self._displacement = (relative @ mapping.T).reshape(len(relative), -1, 3)
        self._wrench = _block_means(objective.wrench, size)
        onto = wrench_map(geometry.anchors).reshape(6, -1, 3)
        self._onto = np.einsum("cni,nia->can", onto, geometry.rotations)  # from tiles' frames
        channels = []
        for channel, weight in zip(objective.channels, objective.channel_weights, strict=True):
            values = np.full(len(pose), np.nan)
            values[channel.rows] = channel.force
            force = _block_means(values, size)
            rows = np.isfinite(force)
            place = (channel.cluster, channel.point, channel.axis)
            channels.append(_Channel(*place, rows, force[rows], float(weight)))
        zero = float(objective.wrench_weights @ (self._wrench**2).mean(axis=0))
        zero += sum(c.weight * float(np.mean(c.force**2)) for c in channels)
        self._weights = objective.wrench_weights / zero
        self._channels = [replace(c, weight=c.weight / zero) for c in channels]
        weighted = self._weights[:, None, None] * self._onto
        self._metric = np.einsum("can,cbm->anbm", self._onto, weighted)
        self._adjoint = weighted

    def _expect(self) -> tuple[FloatArray, float]:
        """Expected stiffness along x, y, z [N/m] and rest displacement [m]: see the module."""
        points = self._displacement.shape[1]
        moved = self._displacement - self._displacement.mean(axis=0)
        target = self._wrench - self._wrench.mean(axis=0)
        shares = self._objective.wrench_shares
        best, stiffness = np.inf, np.zeros(3)
        for ratio in _RATIOS:
            along = np.array([ratio, ratio, 1.0])
            unit = np.einsum("can,tna->tc", self._onto, moved * along)
            power = float((unit**2).sum(axis=0) @ shares)
            normal = max(float((unit * target).sum(axis=0) @ shares), 0.0) / (power or 1.0)
            miss = float(((target - normal * unit) ** 2).sum(axis=0) @ shares)
            if miss < best:
                best, stiffness = miss, normal * along
        load = max(float(np.linalg.norm(self._wrench[:, 3:].mean(axis=0))), 1.0)
        least = load / (points * _LARGEST_SETTLING)
        if stiffness.mean() < least:  # the limb hardly moved
            stiffness = np.full(3, least) if not stiffness.any() else stiffness
            stiffness *= least / stiffness.mean()
        return stiffness, max(load / (points * float(stiffness.mean())), _LEAST_SETTLING)

    def stage_one(self) -> BoxQP:
        """Stage 1: scaled rest displacements, shape (3n,), for linear springs of one stiffness."""
        stiffness, scale = self._scale[:3], self._scale[3]
        moved = self._displacement.mean(axis=0).T  # (3, n)
        row = -(stiffness * scale) * self._onto  # of the wrench by the scaled rest
        row = row.reshape(6, -1)
        target = self._wrench.mean(axis=0) - np.einsum("can,an->c", self._onto, stiffness * moved)
        P = self._spread(3) + (row.T * self._weights) @ row
        q = -(row.T * self._weights) @ target
        points = moved.shape[1]
        for channel in self._channels if not self._with_offsets else ():
            place = channel.axis * points + channel.point
            gain = -stiffness[channel.axis, channel.point] * scale[channel.point]
            mean = self._displacement[channel.rows, channel.point, channel.axis].mean()
            miss = channel.force.mean() - stiffness[channel.axis, channel.point] * mean
            P[place, place] += channel.weight * gain**2
            q[place] -= channel.weight * gain * miss
        free = np.full(3 * points, np.inf)
        factor = len(P) / float(np.trace(P))
        return BoxQP(factor * P, factor * q, -free, free, "Stage 1 (rest displacements)")

    def stage_two(self, x: FloatArray) -> BoxQP:
        """Stage 2: scaled stiffnesses, shape (3n,), at the rest displacements of x."""
        terms, half = self.evaluate(x), self.lower.size // 2
        P = terms.gauss_newton[:half, :half] + self._spread(3)
        q = terms.gradient[:half] - P @ x[:3].reshape(-1)
        factor = len(P) / float(np.trace(P))
        upper = np.full(half, np.inf)
        return BoxQP(factor * P, factor * q, self.lower[:half], upper, "Stage 2 (stiffnesses)")

    def _spread(self, axes: int) -> FloatArray:
        """Quadratic term of the prior over some axes, shape (axes n, axes n)."""
        return np.asarray(np.kron(np.eye(axes), self._prior), dtype=np.float64)

    @property
    def prior(self) -> FloatArray:
        """Quadratic term of the prior, shape (6n, 6n) [-]."""
        return self._spread(6)

    def residuals(self, x: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        """What the springs leave of the wrench, shape (N, 6), and of the channels, (rows,) each."""
        forces = self._forces(x)[0]
        wrench = self._wrench - np.einsum("can,tan->tc", self._onto, forces)
        local = [c.force - forces[c.rows, c.axis, c.point] for c in self._channels]
        return wrench, local

    def value(self, x: FloatArray) -> float:
        """The objective, halved as in a quadratic program [-]."""
        return self._value(x, *self.residuals(x))[0]

    def _value(
        self, x: FloatArray, wrench: FloatArray, local: list[FloatArray]
    ) -> tuple[float, float]:
        data = float(self._weights @ (wrench**2).mean(axis=0))
        for channel, residual in zip(self._channels, local, strict=True):
            data += channel.weight * float(self._centred(residual) @ residual) / len(residual)
        away = x - self.start
        prior = float(np.einsum("an,nm,am->", away, self._prior, away))
        return 0.5 * (data + prior), data

    def _centred(self, values: FloatArray) -> FloatArray:
        return values - values.mean(axis=0) if self._with_offsets else values

    def _forces(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Forces (N, 3, n) in the tiles' frames, displacements from rest, compressions, gates."""
        parameters = x * self._scale
        moved = self._displacement.transpose(0, 2, 1) - parameters[3:]
        pressed, gate = compression(moved[:, 2], self._sharpness)
        forces = moved * gate[:, None]
        forces[:, 2] = -pressed
        return forces * parameters[:3], moved, pressed, gate

    def evaluate(self, x: FloatArray) -> _Terms:
        """The objective with its gradient, Gauss-Newton matrix and curvature of the law."""
        forces, moved, pressed, gate = self._forces(x)
        rows, _, points = forces.shape
        wrench, local = self.residuals(x)
        value, data = self._value(x, wrench, local)
        columns = self._columns(x, moved, pressed, gate)

        by_pair = columns.reshape(rows, -1)
        products = (by_pair.T @ by_pair).reshape(len(PAIRS), points, len(PAIRS), points) / rows
        normal = np.zeros((6, points, 6, points))
        for a, (axis, parameter) in enumerate(PAIRS):
            for b, (other_axis, other) in enumerate(PAIRS):
                normal[parameter, :, other] += products[a, :, b] * self._metric[axis, :, other_axis]
        # Forces that would make up for the errors, against which the law's derivatives count.
        lacking = -np.einsum("tc,can->tan", wrench, self._adjoint) / rows
        for channel, residual in zip(self._channels, local, strict=True):
            point, axis = channel.point, channel.axis
            share = channel.weight / len(residual)
            lacking[channel.rows, axis, point] -= share * self._centred(residual)
            pairs = [k for k, pair in enumerate(PAIRS) if pair[0] == axis]
            own = self._centred(columns[channel.rows][:, pairs, point])
            block = share * (own.T @ own)
            for k, row in zip(pairs, block, strict=True):
                for m, entry in zip(pairs, row.tolist(), strict=True):
                    normal[PAIRS[k][1], point, PAIRS[m][1], point] += entry
        gradient = self._prior_gradient(x)
        for k, (axis, parameter) in enumerate(PAIRS):
            gradient[parameter] += np.einsum("tn,tn->n", columns[:, k], lacking[:, axis])
        return _Terms(
            value=value,
            data=data,
            gradient=gradient.reshape(-1),
            gauss_newton=normal.reshape(6 * points, 6 * points),
            curvature=self._curvature(x, lacking, moved, gate),
        )

    def _prior_gradient(self, x: FloatArray) -> FloatArray:
        return (x - self.start) @ self._prior

    def _columns(
        self, x: FloatArray, moved: FloatArray, pressed: FloatArray, gate: FloatArray
    ) -> FloatArray:
        """Derivatives of the tiles' forces by the scaled parameters, (N, pairs, n)."""
        stiffness = x[:3] * self._scale[:3]
        columns = force_derivatives(moved, pressed, gate, stiffness, self._sharpness)
        return columns * self._scale[[parameter for _, parameter in PAIRS]]

    def _curvature(
        self, x: FloatArray, lacking: FloatArray, moved: FloatArray, gate: FloatArray
    ) -> FloatArray:
        """Second derivatives of the law times what is lacking, shape (6n, 6n): a block per tile."""
        stiffness = x[:3] * self._scale[:3]
        points = gate.shape[1]
        bend = gate_slope(gate, self._sharpness)
        twist = -2.0 * self._sharpness * bend * (1.0 - 2.0 * gate)
        block = np.zeros((6, 6, points))
        for axis in (0, 1):
            lack, slid = lacking[:, axis], moved[:, axis]
            block[axis, 3 + axis] = -(lack * gate).sum(axis=0)
            block[axis, 5] = -(lack * bend * slid).sum(axis=0)
            block[3 + axis, 5] = stiffness[axis] * (lack * bend).sum(axis=0)
            block[5, 5] += stiffness[axis] * (lack * twist * slid).sum(axis=0)
        block[2, 5] = -(lacking[:, 2] * gate).sum(axis=0)
        block[5, 5] += stiffness[2] * (lacking[:, 2] * bend).sum(axis=0)
        block += np.triu(np.ones((6, 6)), 1).T[:, :, None] * block.transpose(1, 0, 2)
        block *= self._scale[:, None] * self._scale[None]
        full = np.zeros((6, points, 6, points))
        full[:, np.arange(points), :, np.arange(points)] = block.transpose(2, 0, 1)
        return full.reshape(6 * points, 6 * points)

    def determined_directions(self, x: FloatArray) -> float:
        """Effective number of stiffnesses that the data determine: see `StageTwo`."""
        free = np.flatnonzero(x[:3].reshape(-1) > 0.0)
        data = self.evaluate(x).gauss_newton[np.ix_(free, free)]
        prior = self._spread(3)[np.ix_(free, free)]
        return float(np.trace(np.linalg.solve(data + prior, data))) if len(free) else 0.0

    def model(self, x: FloatArray) -> ContactModel:
        """The contact model that parameters stand for."""
        objective = self._objective
        geometry, settings = objective.geometry, objective.settings
        parameters = x * self._scale
        wrench, local = self.residuals(x)
        bias, slope = np.zeros(6), np.zeros((6, 6))
        force_bias: dict[str, FloatArray] = {}
        if self._with_offsets:
            bias, slope = self._remainder(wrench)
            for channel, residual in zip(self._channels, local, strict=True):
                offsets = force_bias.setdefault(channel.cluster, np.zeros(3))
                offsets[channel.axis] = residual.mean()
        return ContactModel(
            variant=cast(Variant, settings.variant),
            names=geometry.names,
            anchors=geometry.anchors,
            rotations=geometry.rotations,
            stiffness=parameters[:3].T.copy(),
            rest_positions=parameters[3:].T.copy(),
            sharpness=self._sharpness,
            wrench_bias=bias,
            force_bias=force_bias,
            cluster_points={name: geometry.clusters[name] for name in objective.samples.clusters},
            reference_pose=self.reference,
            wrench_slope=slope,
            parameter_factor=self.parameter_factor(x),
        )

    def parameter_factor(self, x: FloatArray) -> FloatArray:
        r"""Factor of the covariance of the parameters at a minimum, shape (6, n, r) [N/m, m].

        The posterior of the Gauss-Newton problem:

        .. math:: \Sigma^{-1} = \frac{N_e m}{J} J_x^T W J_x + Q

        with J the data's part of the objective at the minimum, which stands for the noise of the
        m channels, and N_e the number of independent samples by the autocorrelation of the
        residuals (a first-order process). The prior's standard deviation is the expected size
        of a parameter. Of this covariance the r directions that move the forces at the reference
        pose most are kept.
        """
        terms = self.evaluate(x)
        channels = int(np.count_nonzero(self._weights)) + len(self._channels)
        precision = np.kron(np.eye(6), self._own)
        precision += self._independent_samples(x) * channels / terms.data * terms.gauss_newton
        spread = np.linalg.inv(np.linalg.cholesky(precision)).T  # spread spread' = covariance
        points = x.shape[1]
        spread = self._scale[:, :, None] * spread.reshape(6, points, -1)
        at_rest = np.zeros((1, points, 3))
        stiffness, rest = (x * self._scale).reshape(2, 3, points)
        forces = force_changes(at_rest, stiffness, rest, self._sharpness, spread)
        towards = np.linalg.svd(forces.reshape(3 * points, -1), full_matrices=False)[2]
        factor: FloatArray = spread @ towards[:PARAMETER_RANK].T
        return factor

    def _independent_samples(self, x: FloatArray) -> float:
        """Number of independent samples by the residuals of the wrench, weighted [1]."""
        residual = self.residuals(x)[0] * np.sqrt(self._weights)
        residual = residual - residual.mean(axis=0)
        power = float((residual**2).sum())
        together = float((residual[1:] * residual[:-1]).sum()) / power if power > 0.0 else 0.0
        together = min(max(together, 0.0), 1.0 - 1.0 / len(residual))
        return len(residual) * (1.0 - together) / (1.0 + together)

    def _remainder(self, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Constant (6,) and slope (6, 6) of what the springs leave of the wrench, over the pose.

        Ridge regression on the standardised pose: no slope along what did not move, and hardly
        any where the force hardly changed. On a hold the limb creeps under one load, and a slope
        that fits this would cancel the springs.

        Args:
            residual: What the springs leave, shape (N, 6) [N m, N].
        """
        mean, spread = self._relative.mean(axis=0), self._relative.std(axis=0)
        inverse = np.where(spread > 0.0, 1.0 / np.where(spread > 0.0, spread, 1.0), 0.0)
        scaled = (self._relative - mean) * inverse
        left = np.where(self._objective.wrench_counts, residual, 0.0)
        force = self._wrench[:, 3:]
        change = float(np.sqrt(force.var(axis=0).sum()))
        size = float(np.sqrt((force**2).sum(axis=1).mean()))
        ridge = _SLOPE_RIDGE + (_LEAST_CHANGE * size / max(change, 1e-9)) ** 2
        gram = scaled.T @ scaled / len(scaled) + ridge * np.eye(6)
        slope = np.linalg.solve(gram, scaled.T @ (left - left.mean(axis=0)) / len(scaled)).T
        slope = slope * inverse
        return left.mean(axis=0) - slope @ mean, slope


def refine(
    problem: RigidProblem, x: FloatArray, tolerance: float
) -> tuple[FloatArray, BoxSolution]:
    """Minimise the joint objective over all parameters, from a start on.

    Each step minimises a quadratic model of the objective in the bounds: its gradient with the
    Hessian where that is definite, else with the Gauss-Newton matrix, damped after Levenberg and
    Marquardt (Nielsen's rule: Madsen, Nielsen & Tingleff, Methods for Non-Linear Least Squares
    Problems, 3.2). A step that does not lower the objective is taken back and damped more.

    Args:
        problem: The objective.
        x: Start, shape (6, n) [-].
        tolerance: Largest residual of the certificate [-].

    Returns:
        The minimum with its certificate. Where the noise of the poses leaves a long flat valley,
        the last and best point after `_STEPS` steps, which says so.
    """
    shape, prior = x.shape, problem.prior
    lower, upper = problem.lower, np.full(x.size, np.inf)
    damping, growth, terms = _DAMPING, 2.0, problem.evaluate(x)
    for _ in range(_STEPS):
        here = x.reshape(-1)
        hessian = terms.gauss_newton + prior
        factor = len(hessian) / float(np.trace(hessian))
        local = _quadratic(hessian, terms.gradient, here, lower, upper, factor)
        certificate = local.certificate(here)
        if certificate.worst <= tolerance:
            return x, BoxSolution(here, certificate, True, "joint refinement")
        ridge = damping / factor * np.eye(len(hessian))
        # A stiffness that is held at its bound does not move: its curvature does not count.
        free = (here > lower) | (terms.gradient <= 0.0)
        exact = hessian + np.where(np.outer(free, free), terms.curvature, 0.0)
        if is_definite(factor * (exact + ridge), _FLAT):
            hessian = exact
        program = _quadratic(hessian + ridge, terms.gradient, here, lower, upper, factor)
        step = pivot(program, here).x - here
        expected = -float(terms.gradient @ step + 0.5 * step @ hessian @ step)
        trial = (here + step).reshape(shape)
        gained = terms.value - problem.value(trial)
        if gained > 0.0 or abs(gained) <= _ROUNDING * terms.value:
            x, terms = trial, problem.evaluate(trial)
            ratio = min(gained / max(expected, _ROUNDING * terms.value), 1.0)
            damping *= max(0.1, 1.0 - (2.0 * ratio - 1.0) ** 3)
            growth = 2.0
        else:
            damping, growth = damping * growth, growth * 2.0
    return x, BoxSolution(x.reshape(-1), certificate, True, "joint refinement, stopped early")


def _quadratic(
    hessian: FloatArray,
    gradient: FloatArray,
    x: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    factor: float,
) -> BoxQP:
    q = factor * (gradient - hessian @ x)
    return BoxQP(factor * hessian, q, lower, upper, "joint refinement")


def _block_means(values: FloatArray, size: int) -> FloatArray:
    """Means over blocks of rows, of the values that are there; NaN where none is."""
    if size <= 1:
        return values
    starts = np.arange(0, len(values), size)
    known = np.isfinite(values)
    total = np.add.reduceat(np.where(known, values, 0.0), starts, axis=0)
    count = np.add.reduceat(known.astype(np.float64), starts, axis=0)
    return np.where(count > 0.0, total / np.maximum(count, 1.0), np.nan)
