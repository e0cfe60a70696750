"""From samples to a fitted model."""

from __future__ import annotations

from dataclasses import dataclass

from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.box_qp import BoxSolution, solve_box_qp
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.evaluation import ChannelErrors, evaluate
from socket_testbed.identification.objective import build_objective, check_channels
from socket_testbed.identification.problem import Problem
from socket_testbed.identification.refinement import refine
from socket_testbed.samples import Samples, channel_names
from socket_testbed.settings.identification import (
    IdentificationSettings,
    check_solver,
)


@dataclass(frozen=True)
class Fit:
    """A fitted model with what is needed to judge it.

    Attributes:
        model: The contact model.
        settings: Settings of the identification, `initial_stiffness` as it was used.
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
    problem = Problem(build_objective(samples, geometry, settings))
    solver, tolerance = settings.solver, settings.solver_tolerance
    rest = solve_box_qp(problem.stage_one(), solver, tolerance)
    x = problem.start.copy()
    x[3:] = rest.x.reshape(3, -1)
    moments = problem.moments(x)
    springs = solve_box_qp(problem.stage_two(moments), solver, tolerance)
    x[:3] = springs.x.reshape(3, -1)
    joint = None
    if problem.law.REFINED:
        x, joint = refine(problem, x, solver, tolerance)
        moments = problem.moments(x)
    model, used = problem.model(x), problem.objective.samples
    return Fit(
        model=model,
        settings=problem.settings,
        samples=len(used),
        last_stamp=int(used.stamps[-1]),
        determined=problem.determined_directions(x, moments),
        errors=evaluate(used, model, settings.leave_out),
        stage_one=rest,
        stage_two=springs,
        joint=joint,
    )
