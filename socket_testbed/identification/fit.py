"""The identification from samples to a fitted model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

from socket_testbed.arrays import FloatArray
from socket_testbed.contact import ContactModel, Variant
from socket_testbed.evaluation import ChannelErrors, evaluate
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.box_qp import BoxSolution, check_solver, solve_box_qp
from socket_testbed.identification.objective import Objective, build_objective, check_channels
from socket_testbed.identification.stages import (
    KILONEWTON_PER_METRE,
    MILLIMETRE,
    StageTwo,
    build_stage_one,
    build_stage_two,
    recover_offsets,
    stage_one_reference,
)
from socket_testbed.samples import Samples, channel_names
from socket_testbed.settings import IdentificationSettings


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
    """

    model: ContactModel
    settings: IdentificationSettings
    samples: int
    last_stamp: int
    determined: float
    errors: tuple[ChannelErrors, ...]
    stage_one: BoxSolution
    stage_two: BoxSolution

    @property
    def status(self) -> str:
        """The solver's verdict with the certificate of both stages, in words."""
        return f"stage 1 {self.stage_one.status}; stage 2 {self.stage_two.status}"


def check_names(settings: IdentificationSettings, clusters: tuple[str, ...]) -> None:
    """Refuse settings that name no channel of these clusters, or no solver.

    Raises:
        ConfigurationError: Naming the likely one.
    """
    check_solver(settings.solver)
    check_channels(settings.leave_out, channel_names(clusters))


def fit_contact_model(
    samples: Samples, geometry: SocketGeometry, settings: IdentificationSettings
) -> Fit:
    """Identify the contact model: rest positions, then stiffnesses and offsets.

    Args:
        samples: Samples of the segment; those without a wrench or a limb position are
            passed over.
        geometry: Geometry of the socket.
        settings: Settings of the identification.

    Raises:
        ConfigurationError: For an unknown channel, cluster or solver.
        IdentificationError: If the samples do not allow a fit, or a solution misses the
            KKT tolerance.
    """
    objective = build_objective(samples, geometry, settings)
    samples = samples[objective.rows]

    rest_program = build_stage_one(objective, geometry, settings)
    rest = solve_box_qp(rest_program, settings.solver, settings.solver_tolerance)
    rest_positions = rest_positions_of(rest, objective)

    stage_two = build_stage_two(objective, geometry, settings, rest_positions)
    springs = solve_box_qp(stage_two.program, settings.solver, settings.solver_tolerance)
    model = make_model(
        objective, geometry, settings, samples.clusters, rest_positions, stage_two, springs
    )
    return Fit(
        model=model,
        settings=settings,
        samples=len(samples),
        last_stamp=int(samples.stamps[-1]),
        determined=stage_two.determined_directions(springs.x),
        errors=evaluate(samples, model, settings.leave_out),
        stage_one=rest,
        stage_two=springs,
    )


def rest_positions_of(solution: BoxSolution, objective: Objective) -> FloatArray:
    """Rest positions q_r that a solution of Stage 1 stands for, shape (n, 3) [m]."""
    return stage_one_reference(objective) + MILLIMETRE * solution.x.reshape(-1, 3)


def make_model(
    objective: Objective,
    geometry: SocketGeometry,
    settings: IdentificationSettings,
    clusters: tuple[str, ...],
    rest_positions: FloatArray,
    stage_two: StageTwo,
    springs: BoxSolution,
) -> ContactModel:
    """The contact model that the solutions of both stages stand for.

    Args:
        objective: The samples and weights.
        geometry: Geometry of the socket.
        settings: Settings of the identification.
        clusters: Names of the clusters that the model is to know.
        rest_positions: Rest positions q_r of Stage 1, shape (n, 3) [m].
        stage_two: Stage 2 at these rest positions.
        springs: Its solution.
    """
    stiffness = KILONEWTON_PER_METRE * springs.x.reshape(-1, 3)
    wrench_bias, force_bias = recover_offsets(objective, geometry, settings, stage_two, stiffness)
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
        cluster_points={name: geometry.clusters[name] for name in clusters},
    )
