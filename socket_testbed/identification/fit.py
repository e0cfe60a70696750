"""From samples to a fitted model, and which channels look implausible.

The paper leaves channels out whose reconstructed magnitudes lie far above the applied load.
`find_implausible` proposes channels to leave out, over the samples of a segment. With the
load L the median magnitude of the measured force, it proposes

- a moment whose median magnitude exceeds L at twice the distance of the farthest tile from
  the load cell: no force between limb and socket has such a lever;
- a local force whose median magnitude exceeds L: one tile would carry more than all that is
  applied;
- a local normal force (Fz) in tension by more than `TENSION_SHARE` of L and `LEAST_TENSION` in
  the median: a wall pushes, it does not pull;
- all three channels of a cluster that is saturated or out of its calibrated range in more
  than `OUTSIDE_SHARE` of the samples in which it was read.

The first three need a load of at least `LEAST_LOAD`. Nothing is left out automatically: the
user decides with `--leave-out`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.box_qp import BoxSolution, solve_box_qp
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.evaluation import ChannelErrors, evaluate
from socket_testbed.identification.plausibility import (
    find_outliers,
    outlier_notes,
    sign_note,
)
from socket_testbed.identification.problem import (
    KILONEWTON_PER_METRE,
    Objective,
    Solution,
    StageTwoData,
    StageTwoMoments,
    build_objective,
    build_stage_one,
    build_stage_two,
    check_channels,
    recover_offsets,
    rest_positions_of,
)
from socket_testbed.identification.rigid_fit import solve_rigid
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples, Status, channel_names
from socket_testbed.settings.identification import (
    RIGID_VARIANTS,
    IdentificationSettings,
    Variant,
    check_solver,
)

LEAST_LOAD = 20.0  # [N]
LEVER_FACTOR = 2.0  # [-]; of the farthest tile's distance
TENSION_SHARE = 0.05  # [-]; of the load
LEAST_TENSION = 10.0  # [N]; 11 kPa on a cluster of 9 cm^2, more than a sensor's usual offset
OUTSIDE_SHARE = 0.5  # [-]; of the samples


@dataclass(frozen=True)
class Implausible:
    """A channel that `find_implausible` proposes to leave out of the objective.

    Attributes:
        channel: Name of the channel, such as Mx or distal.Fz.
        reason: Why, with the numbers.
    """

    channel: str
    reason: str


def find_implausible(samples: Samples, geometry: SocketGeometry) -> tuple[Implausible, ...]:
    """Propose channels to leave out of the objective, by the rule of this module.

    Args:
        samples: Samples of the segment, with the reconstructed forces of any status.
        geometry: Geometry of the socket.

    Returns:
        The proposals in the order of the channels, one per channel and reason.
    """
    load = _median(np.linalg.norm(samples.wrench[:, 3:], axis=1))
    found: list[Implausible] = []
    if load >= LEAST_LOAD:
        found += _implausible_moments(samples, geometry, load)
        found += _implausible_forces(samples, load)
    found += _outside_range(samples)
    return tuple(sorted(found, key=lambda proposal: samples.channels.index(proposal.channel)))


def implausible_notes(
    samples: Samples,
    geometry: SocketGeometry,
    leave_out: tuple[str, ...],
    start: int | None = None,
) -> list[str]:
    """Outliers, a negated wrench, and the proposals even for channels that are left out already.

    Args:
        samples: Samples of the segment.
        geometry: Geometry of the socket.
        leave_out: Channels that are not in the objective.
        start: Stamp of the trial's first sample [ns]; None for that of the segment.
    """
    outliers = find_outliers(samples, geometry, leave_out)
    notes = outlier_notes(samples, outliers, start)
    sign = sign_note(samples, geometry)
    notes += [sign] if sign else []
    for proposal in find_implausible(samples, geometry):
        name = proposal.channel
        advice = "is left out" if name in leave_out else f"consider --leave-out {name}"
        notes.append(f"{name} looks implausible: {proposal.reason}; {advice}")
    return notes


def _implausible_moments(
    samples: Samples, geometry: SocketGeometry, load: float
) -> Iterator[Implausible]:
    reach = float(np.linalg.norm(geometry.anchors, axis=1).max())
    for name, values in zip(WRENCH_CHANNELS[:3], samples.wrench.T, strict=False):
        moment = _median(np.abs(values))
        if moment > LEVER_FACTOR * reach * load:
            yield Implausible(
                name,
                f"the median magnitude of {moment:.3g} N m would take the load of {load:.3g} N at a"
                f" lever of {moment / load:.2g} m, where the farthest tile is {reach:.2g} m away",
            )


def _implausible_forces(samples: Samples, load: float) -> Iterator[Implausible]:
    limit = max(LEAST_TENSION, TENSION_SHARE * load)
    for name, force in zip(samples.channels[6:], samples.values[:, 6:].T, strict=True):
        # In a cluster's frame z points inwards, so that compression is along -z.
        size, pull = _median(np.abs(force)), _median(force)
        if size > load:
            yield Implausible(
                name,
                f"the median magnitude of {size:.3g} N on one tile is {size / load:.2g} times the"
                f" total load of {load:.3g} N",
            )
        if name.endswith(".Fz") and pull > limit:
            yield Implausible(
                name,
                f"the wall would pull at the limb with {pull:.3g} N in the median, more than"
                f" {limit:.3g} N under a load of {load:.3g} N",
            )


def _outside_range(samples: Samples) -> Iterator[Implausible]:
    for cluster, status in zip(samples.clusters, samples.status.T, strict=True):
        read = int((status != Status.MISSING).sum())
        outside = int(((status == Status.SATURATED) | (status == Status.OUT_OF_RANGE)).sum())
        if outside > OUTSIDE_SHARE * read:
            for channel in LOCAL_CHANNELS:
                yield Implausible(
                    f"{cluster}.{channel}",
                    f"{outside} of {read} readings are saturated or out of the calibrated range",
                )


def _median(values: FloatArray) -> float:
    """Median of the finite values; NaN, which exceeds nothing, without any."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else float("nan")


@dataclass(frozen=True)
class Fit:
    """A fitted model with what is needed to judge it.

    Attributes:
        model: The contact model.
        settings: Settings of the identification.
        samples: Number of samples in the objective.
        last_stamp: Stamp of the newest of them [ns].
        determined: Effective number of stiffness directions that the data determine, of 3n;
            the smoothness determines the others [-].
        errors: Errors of every channel on the samples of the fit.
        stage_one: Certified solution of Stage 1.
        stage_two: Certified solution of Stage 2.
        joint: Certified joint refinement of both in the rigid variants, otherwise None.
    """

    model: ContactModel
    settings: IdentificationSettings
    samples: int
    last_stamp: int
    determined: float
    errors: tuple[ChannelErrors, ...]
    stage_one: BoxSolution
    stage_two: BoxSolution
    joint: BoxSolution | None = None

    @property
    def status(self) -> str:
        """The solver and the certificate of both stages, and of their refinement, in words."""
        stages = f"stage 1 {self.stage_one.status}; stage 2 {self.stage_two.status}"
        return stages if self.joint is None else f"{stages}; {self.joint.status}"


def check_names(settings: IdentificationSettings, clusters: tuple[str, ...]) -> None:
    """Check that settings name channels of these clusters and an installed solver.

    Raises:
        ConfigurationError: With the likely name.
    """
    check_solver(settings.solver)
    check_channels(settings.leave_out, channel_names(clusters))


def fit_contact_model(
    samples: Samples, geometry: SocketGeometry, settings: IdentificationSettings
) -> Fit:
    """Identify the contact model: rest positions, then stiffnesses and offsets.

    Args:
        samples: Samples of the segment; those without a wrench or a limb position are
            passed over, and so are outliers.
        geometry: Geometry of the socket.
        settings: Settings of the identification.

    Raises:
        ConfigurationError: For an unknown channel, cluster or solver.
        IdentificationError: If the samples do not allow a fit, or a solution misses the
            KKT tolerance.
    """
    objective = build_objective(samples, geometry, settings)
    solve = solve_rigid if settings.variant in RIGID_VARIANTS else _solve_stages
    found = solve(objective)
    used = objective.samples
    return Fit(
        model=found.model,
        settings=settings,
        samples=len(used),
        last_stamp=int(used.stamps[-1]),
        determined=found.determined,
        errors=evaluate(used, found.model, settings.leave_out),
        stage_one=found.stage_one,
        stage_two=found.stage_two,
        joint=found.joint,
    )


def _solve_stages(objective: Objective) -> Solution:
    """Both stages of the paper's variants."""
    solver, tolerance = objective.settings.solver, objective.settings.solver_tolerance
    rest = solve_box_qp(build_stage_one(objective), solver, tolerance)
    rest_positions = rest_positions_of(objective, rest.x)

    moments = StageTwoData(objective).moments(rest_positions)
    stage_two = build_stage_two(objective, moments)
    springs = solve_box_qp(stage_two.program, solver, tolerance)
    return Solution(
        model=make_model(objective, rest_positions, moments, springs.x),
        determined=stage_two.determined_directions(springs.x),
        stage_one=rest,
        stage_two=springs,
    )


def make_model(
    objective: Objective, rest_positions: FloatArray, moments: StageTwoMoments, x: FloatArray
) -> ContactModel:
    """The contact model that the solutions of both stages stand for.

    Args:
        objective: The samples and weights.
        rest_positions: Rest positions q_r of Stage 1, shape (n, 3) [m].
        moments: Moments of the data at these rest positions.
        x: Solution of Stage 2, shape (3n,) [kN/m].
    """
    geometry, settings = objective.geometry, objective.settings
    stiffness = KILONEWTON_PER_METRE * x.reshape(-1, 3)
    wrench_bias, force_bias = recover_offsets(objective, moments, stiffness)
    return ContactModel(
        variant=cast(Variant, settings.variant),
        names=geometry.names,
        anchors=geometry.anchors,
        rotations=geometry.rotations,
        stiffness=stiffness,
        rest_positions=rest_positions,
        sharpness=settings.gate_sharpness,
        wrench_bias=wrench_bias,
        force_bias=force_bias,
        cluster_points={name: geometry.clusters[name] for name in objective.samples.clusters},
    )
