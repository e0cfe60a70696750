"""Fits: both stages, which some laws refine jointly."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.channel_errors import ChannelErrors, evaluate
from socket_testbed.identification.contact import ContactModel, relative_change
from socket_testbed.identification.noise import smooth_poses
from socket_testbed.identification.problem import Problem, build_objective
from socket_testbed.identification.solver import (
    BoxQP,
    BoxSolution,
    is_definite,
    pivot,
    solve_box_qp,
    solve_cold,
)
from socket_testbed.identification.wrench import fit_wrench
from socket_testbed.samples import (
    Samples,
    channel_names,
    refuse_unknown_channels,
)
from socket_testbed.settings.identification import IdentificationSettings, check_solver

OWN_SPRINGS = "the bed's own springs"
_MIN_CHANGE = 0.1  # [-]; of the force, relative to its RMS
_MAX_STEPS = 100
_DAMPING = 1e-2  # [-]; of the first step, relative to the mean curvature
_ROUNDING = 1e-13  # [-]; of the objective's value
_MIN_PIVOT = 1e-10  # [-]; for the Hessian in a step's program


def predictions(
    samples: Samples, model: ContactModel, window: float, past: Samples | None = None
) -> FloatArray:
    """Predictions of all channels in the order of `Samples.channels`, (N, 6 + 3c) [N m, N].

    Args:
        samples: N samples, of which the stamps, the poses and the names of the c clusters matter.
        model: The model, which has these clusters.
        window: Width of the centred window over which poses are averaged [s]; 0: not averaged.
        past: The samples before these, which a model with memory needs; None for no past.
    """
    trail = model.trail()
    if past is not None and trail is not None:
        model.wrench(smooth_poses(past, window).pose, past.stamps, trail)
    pose = smooth_poses(samples, window).pose
    return model.predict(pose, samples.clusters, samples.stamps, trail)


@dataclass(frozen=True, kw_only=True, repr=False)
class FittedModel:
    """A fitted model with its errors, its socket, and the trial that it came from.

    A fit is one, and so is what `model_file.read_model` reads.

    Attributes:
        model: The contact model.
        geometry: Geometry of the socket it was fitted on.
        settings: Settings of the identification, with the `initial_stiffness` used.
        samples: Number of samples in the objective.
        first_stamp: Time of the oldest of these samples since the epoch [ns]; 0 in a model of an
            older version.
        last_stamp: Time of the newest of these samples since the epoch [ns].
        wrench_rmse: RMSE of the wrench [M; F] in {S} on these samples, shape (6,) [N m, N]; NaN for
            a channel without values.
        errors: Errors of every channel on these samples, the wrench's six first, then three per
            cluster; empty in a model of an older version.
        status: Solver and certificate of both stages and of their refinement, in words.
        trial: Name of the trial it was fitted on; empty for samples of no trial.
        fingerprint: Fingerprint of that trial; empty in a model of an older version.
        unloaded: Start and end of the spans in which the limb was unloaded, used to correct the
            clusters' drift, since the first sample of the trial [s].
        segment: The segment of the fit, such as `plateau 12.00 s to 31.50 s`; empty in a model of
            an older version.
    """

    model: ContactModel
    geometry: SocketGeometry
    settings: IdentificationSettings
    samples: int
    first_stamp: int
    last_stamp: int
    wrench_rmse: FloatArray
    errors: tuple[ChannelErrors, ...]
    status: str
    trial: str = ""
    fingerprint: str = ""
    unloaded: tuple[tuple[float, float], ...] = ()
    segment: str = ""

    def predictions(self, samples: Samples, past: Samples | None = None) -> FloatArray:
        """Predictions of all channels, shape (N, 6 + 3c) [N m, N], in the samples' order of them.

        Args:
            samples: N samples, whose poses are averaged as in the fit.
            past: The samples before these, which a model with memory needs; None for no past.
        """
        return predictions(samples, self.model, self.settings.pose_smoothing, past)

    def used(self, trial: str, fingerprint: str, samples: Samples) -> BoolArray:
        """Which samples of a trial are in the span of the fit, shape (N,); none of another trial.

        Args:
            trial: Name of the trial, which identifies it for a model of an older version.
            fingerprint: Fingerprint of the trial, which identifies it otherwise.
            samples: N samples of the trial, of which the stamps matter.
        """
        stamps = samples.stamps
        same = fingerprint == self.fingerprint if self.fingerprint else trial == self.trial
        own = same and self.last_stamp in stamps
        return own & (stamps >= self.first_stamp) & (stamps <= self.last_stamp)

    def __repr__(self) -> str:
        origin = f" of {self.trial}" if self.trial else ""
        return (
            f"{type(self).__name__}({self.model.variant}{origin}, {self.samples} samples,"
            f" {len(self.geometry)} tiles)"
        )

    def require_socket(self, geometry: SocketGeometry) -> None:
        """Check that the model was fitted on this socket.

        Raises:
            ConfigurationError: If the tiles differ, or a cluster is on another tile or has another
                area.
        """
        if not self.geometry.same_tiles(geometry):
            raise ConfigurationError(
                f"the model of {self.trial} was fitted on another socket ({len(self.geometry)}"
                f" tiles) than the one that it is used on ({len(geometry)} tiles)",
                "fit a model on this socket, or give the socket.yaml of the model's trial",
            )
        own = self.geometry
        for name in own.clusters.keys() & geometry.clusters.keys():
            tile, other = own.clusters[name], geometry.clusters[name]
            if tile != other or not np.isclose(own.areas[tile], geometry.areas[other]):
                raise ConfigurationError(
                    f"{name} had another tile or area in the socket of the model of {self.trial}",
                    "fit the model again with this socket.yaml",
                )


@dataclass(frozen=True, kw_only=True, repr=False)
class Fit(FittedModel):
    """A model that was fitted here, with the certificates of its programs.

    Attributes:
        determined: Effective number of directions among the 3n stiffnesses that the data
            determines, 0 to 3n [-]; the prior (smoothness) determines the others.
        stage_one: Certified solution of Stage 1, scaled rest displacements, shape (3n,) [-].
        stage_two: Certified solution of Stage 2, scaled stiffnesses, shape (3n,) [-].
        joint: Certified joint refinement of both in the rigid variants, shape (6n,) [-]; None in
            the paper's variants.
        wrench: What predicts the wrench with `rigid_bias`, and why, in words; empty for a variant
            without a choice.
    """

    determined: float
    stage_one: BoxSolution
    stage_two: BoxSolution
    joint: BoxSolution | None
    wrench: str


def check_names(settings: IdentificationSettings, clusters: tuple[str, ...]) -> None:
    """Check that settings name channels of these clusters and an installed solver.

    Otherwise it raises a `ConfigurationError`.

    Args:
        settings: Settings of a fit, of which `solver` and `leave_out` are checked.
        clusters: Names of the clusters of the samples to fit.
    """
    check_solver(settings.solver)
    refuse_unknown_channels(settings.leave_out, channel_names(clusters))


def fit_contact_model(
    samples: Samples, geometry: SocketGeometry, settings: IdentificationSettings
) -> Fit:
    """Identify the contact model: rest positions, then stiffnesses and offsets.

    Skips samples without a wrench or a limb position. Values are believed: see
    `checked.CheckedSamples.part` for samples that may hold outliers or another unit.

    Args:
        samples: Samples of a loaded segment, outliers as NaN; poses are averaged as the settings
            say.
        geometry: The socket, which has the clusters of the samples.
        settings: Settings of the fit.

    Raises:
        IdentificationError: From the steps of the fit, if the samples are too few or unloaded, or
            if a program has no certified solution.
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
        x, joint = _refine(problem, x, solver, tolerance)
        moments = problem.moments(x)
    used = problem.objective.samples
    model, chosen = _with_wrench_model(problem.model(x), used, settings)
    errors = evaluate(used, model, settings.leave_out)
    return Fit(
        model=model,
        geometry=geometry,
        settings=problem.settings,
        samples=len(used),
        first_stamp=int(used.stamps[0]),
        last_stamp=int(used.stamps[-1]),
        determined=problem.determined_directions(x, moments),
        wrench_rmse=np.array([error.rmse for error in errors[:6]]),
        errors=errors,
        status=_status(rest, springs, joint),
        stage_one=rest,
        stage_two=springs,
        joint=joint,
        wrench=chosen,
    )


def _status(rest: BoxSolution, springs: BoxSolution, joint: BoxSolution | None) -> str:
    """Solver and certificate of both stages and of their refinement, in words."""
    stages = f"stage 1 {rest.status}; stage 2 {springs.status}"
    return stages if joint is None else f"{stages}; {joint.status}"


def _with_wrench_model(
    model: ContactModel, used: Samples, settings: IdentificationSettings
) -> tuple[ContactModel, str]:
    """The model with its predictor of the wrench, and which one it is and why, in words.

    With `rigid_bias` a regression on the pose, with or without memory, predicts the wrench if the
    force changes enough: see `wrench`. Otherwise the springs do. The words are empty for a variant
    without a choice.

    Args:
        model: The fitted model.
        used: The samples of the fit, with a pose and a wrench.
        settings: Settings of the fit.
    """
    if settings.variant != "rigid_bias":
        return model, ""
    complete = np.isfinite(used.wrench).all() and used.counted(settings.leave_out)[:6].all()
    if not complete:
        return model, f"{OWN_SPRINGS}: a channel of the wrench is missing or left out"
    # At constant load no sample shows how a prediction extrapolates.
    if not relative_change(used.wrench[:, 3:]) > _MIN_CHANGE:
        return model, f"{OWN_SPRINGS}: the force changes by less than a tenth"
    chosen, reason = fit_wrench(used)
    return replace(model, of_wrench=chosen), f"{chosen.name}: {reason}"


def _refine(
    problem: Problem, x: FloatArray, solver: str, tolerance: float
) -> tuple[FloatArray, BoxSolution]:
    """Minimise the joint objective over all parameters, starting from x of shape (6, n) [-].

    Each step minimises a quadratic model of the objective within the bounds: its gradient with the
    Hessian if that is definite, else with the Gauss-Newton matrix, with Levenberg-Marquardt damping
    (Nielsen's rule: Madsen, Nielsen & Tingleff, Methods for Non-Linear Least Squares Problems,
    3.2). A step that does not lower the objective is rejected and the damping raised. The solver
    computes the first step; each later one starts from the previous active set.

    The minimum comes with its certificate. In a long flat valley, caused by noise of the poses,
    the refinement stops after `_MAX_STEPS` steps and says so.
    """
    shape, prior = x.shape, problem.prior
    lower, upper = problem.lower.reshape(-1), problem.upper.reshape(-1)
    damping, growth, value = _DAMPING, 2.0, problem.value(x)
    terms = problem.evaluate(x)
    first: BoxSolution | None = None
    exchanges = 0

    def quadratic(hessian: FloatArray, gradient: FloatArray, at: FloatArray) -> BoxQP:
        q = factor * (gradient - hessian @ at)
        return BoxQP(factor * hessian, q, lower, upper, "joint refinement")

    for done in range(_MAX_STEPS + 1):
        here = x.reshape(-1)
        hessian = terms.gauss_newton + prior
        factor = len(hessian) / float(np.trace(hessian))
        local = quadratic(hessian, terms.gradient, here)
        certificate = local.certificate(here)
        if certificate.worst <= tolerance or done == _MAX_STEPS:
            break
        ridge = damping / factor * np.eye(len(hessian))
        # The curvature along stiffnesses at an active bound does not matter.
        free = (here > lower) | (terms.gradient <= 0.0)
        exact = hessian + np.where(np.outer(free, free), terms.curvature, 0.0)
        if is_definite(factor * (exact + ridge), _MIN_PIVOT):
            hessian = exact
        program = quadratic(hessian + ridge, terms.gradient, here)
        found = pivot(program, here) if first else solve_cold(program, solver)
        first, exchanges = first or found, exchanges + found.exchanges
        step = found.x - here
        expected = -float(terms.gradient @ step + 0.5 * step @ hessian @ step)
        trial = (here + step).reshape(shape)
        trial_value = problem.value(trial)
        gained = value - trial_value
        if gained > 0.0 or abs(gained) <= _ROUNDING * value:
            x, value, terms = trial, trial_value, problem.evaluate(trial)
            ratio = min(gained / max(expected, _ROUNDING * value), 1.0)
            damping *= max(0.1, 1.0 - (2.0 * ratio - 1.0) ** 3)
            growth = 2.0
        else:
            damping, growth = damping * growth, growth * 2.0
    early = "" if certificate.worst <= tolerance else ", stopped early"
    course = f"joint refinement in {done} steps{early}"
    solved = first or BoxSolution(here, certificate)
    return x, replace(solved, x=here, certificate=certificate, exchanges=exchanges, course=course)
