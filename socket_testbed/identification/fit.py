"""The identification from samples to a fitted model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

from socket_testbed.contact import ContactModel, Variant
from socket_testbed.evaluation import ChannelErrors, evaluate
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.box_qp import BoxSolution, check_solver, solve_box_qp
from socket_testbed.identification.objective import build_objective, check_channels
from socket_testbed.identification.stages import (
    KILONEWTON_PER_METRE,
    MILLIMETRE,
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
    offsets = MILLIMETRE * rest.x.reshape(-1, 3)
    rest_positions = stage_one_reference(objective) + offsets

    stage_two = build_stage_two(objective, geometry, settings, rest_positions)
    springs = solve_box_qp(stage_two.program, settings.solver, settings.solver_tolerance)
    stiffness = KILONEWTON_PER_METRE * springs.x.reshape(-1, 3)

    wrench_bias, force_bias = recover_offsets(objective, geometry, settings, stage_two, stiffness)
    model = ContactModel(
        variant=cast(Variant, settings.variant),
        names=geometry.names,
        anchors=geometry.anchors,
        rotations=geometry.rotations,
        stiffness=stiffness,
        rest_positions=rest_positions,
        sharpness=settings.gate_sharpness,
        wrench_bias=wrench_bias,
        force_bias=force_bias,
        cluster_points={name: geometry.clusters[name] for name in samples.clusters},
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
