"""The trade-off between the wrench and the clusters: both stages, for one theta after another.

Stage 1 depends on theta, so that the gates do, too: each theta has rest positions of its own,
which both variants share. The data enters through statistics that are taken once
(`StageTwoData`), and each program starts from the solution of the theta before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.errors import ConfigurationError, IdentificationError
from socket_testbed.files import check_number
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.box_qp import (
    BoxQP,
    BoxSolution,
    UncertifiedSolutionError,
    solve_box_qp,
)
from socket_testbed.identification.contact import wrench_map
from socket_testbed.identification.fit import make_model, rest_positions_of
from socket_testbed.identification.front import Front, FrontPoint, make_front
from socket_testbed.identification.problem import (
    Objective,
    StageTwoData,
    StageTwoMoments,
    build_objective,
    build_stage_one,
    build_stage_two,
)
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples
from socket_testbed.settings.identification import VARIANTS, IdentificationSettings, Variant


def channel_mean_squares(
    objective: Objective,
    geometry: SocketGeometry,
    moments: StageTwoMoments,
    stiffness: FloatArray,
    with_bias: bool,
) -> tuple[FloatArray, FloatArray]:
    """Mean square errors of the channels over the samples of the objective.

    Args:
        objective: The samples; those of a channel left out are zeros.
        geometry: Geometry of the socket.
        moments: Moments of the data at the model's rest positions.
        stiffness: Stiffnesses, shape (n, 3) [N/m].
        with_bias: Whether the model has the offsets that suit it best.

    Returns:
        Those of the wrench, shape (6,) [(N m)^2, N^2], and of the clusters' channels in the
        objective, shape (m,) [N^2].
    """
    rows = wrench_map(geometry.anchors) * stiffness.reshape(-1)
    wrench = moments.wrench.mean_square_residuals(rows, with_bias)
    local = [
        of_channel.mean_square_residuals(
            (channel.direction * stiffness[channel.point])[None], with_bias
        )
        for channel, of_channel in zip(objective.channels, moments.channels, strict=True)
    ]
    return wrench, np.concatenate(local)


_STAGE_ONE = "Stage 1"


def pareto_front(
    samples: Samples,
    geometry: SocketGeometry,
    settings: IdentificationSettings,
    thetas: Sequence[float] | FloatArray,
    variants: Sequence[Variant] = VARIANTS,
    progress: Callable[[int, int], None] | None = None,
) -> dict[Variant, Front]:
    """Identify the contact model for every theta and variant.

    At theta 0 the wrench bears no weight, at theta 1 the clusters bear none: what the other
    group leaves open is then decided by the smoothness alone. A solution that is not
    certified, or that nothing decides, carries its flaw and is not on the front.

    Args:
        samples: Samples of the segment; those without a wrench or a limb position are
            passed over.
        geometry: Geometry of the socket.
        settings: Settings of the identification; its theta and variant do not matter.
        thetas: Weights of the wrench against the clusters, in [0, 1] and rising [-].
        variants: Which offsets the models carry, a front each.
        progress: Told the number of thetas done and of all.

    Raises:
        ConfigurationError: For an unknown channel, cluster or solver, or wrong thetas.
        IdentificationError: If the samples do not allow a fit, if one of the two groups has
            no channel in the objective, or if no solution at all is without flaw.
    """
    _check_thetas(thetas)
    objective = build_objective(samples, geometry, settings)
    _require_both_groups(objective)
    walk = _Walk(objective, geometry, settings, samples.clusters, len(thetas))
    points: dict[Variant, list[FrontPoint]] = {variant: [] for variant in variants}
    for done, theta in enumerate(thetas, start=1):
        for variant, point in walk.solve_at(float(theta), variants).items():
            points[variant].append(point)
        if progress is not None:
            progress(done, len(thetas))
    channels = _channels(objective)
    fronts = {variant: make_front(variant, channels, points[variant]) for variant in variants}
    _require_a_solution(fronts)
    return fronts


class _Walk:
    """Solves both stages at one theta after the other, each from the one before.

    Args:
        objective: The samples and weights.
        geometry: Geometry of the socket.
        settings: Settings of the identification.
        clusters: Names of the clusters that the models are to know.
        thetas: How many thetas there are.
    """

    def __init__(
        self,
        objective: Objective,
        geometry: SocketGeometry,
        settings: IdentificationSettings,
        clusters: tuple[str, ...],
        thetas: int,
    ) -> None:
        self._objective = objective
        self._geometry = geometry
        self._settings = settings
        self._of_variant = {variant: replace(settings, variant=variant) for variant in VARIANTS}
        self._clusters = clusters
        self._data = StageTwoData(objective, geometry, settings, sets=thetas)
        self._last: dict[str, FloatArray] = {}

    def solve_at(self, theta: float, variants: Sequence[Variant]) -> dict[Variant, FrontPoint]:
        """The solution of each variant at a theta."""
        objective = replace(self._objective, theta=theta)
        program = build_stage_one(objective, self._geometry, self._settings)
        try:
            rest = self._solve(program, _STAGE_ONE)
        except UncertifiedSolutionError as error:
            return {variant: self._flawed(theta, error) for variant in variants}
        rest_positions = rest_positions_of(rest, objective)
        moments = self._data.moments(rest_positions)
        points = {}
        for variant in variants:
            try:
                point = self._solve_springs(objective, variant, rest_positions, moments)
            except UncertifiedSolutionError as error:
                point = self._flawed(theta, error)
            flaw = point.flaw or _openness(program, rest)
            residual = float(np.max([point.residual, rest.certificate.worst]))
            points[variant] = replace(point, flaw=flaw, residual=residual)
        return points

    def _solve_springs(
        self,
        objective: Objective,
        variant: Variant,
        rest_positions: FloatArray,
        moments: StageTwoMoments,
    ) -> FrontPoint:
        settings = self._of_variant[variant]
        stage = build_stage_two(objective, self._geometry, settings, moments)
        springs = self._solve(stage.program, variant)
        model = make_model(
            objective, self._geometry, settings, self._clusters, rest_positions, stage, springs
        )
        wrench, local = channel_mean_squares(
            objective, self._geometry, moments, model.stiffness, variant == "stiffness_bias"
        )
        return FrontPoint(
            theta=objective.theta,
            model=model,
            rmse=np.sqrt(np.concatenate([wrench[objective.wrench_counts], local])),
            wrench_error=float(np.sqrt(objective.wrench_shares @ wrench)),
            local_error=float(np.sqrt(objective.channel_share * local.sum())),
            residual=springs.certificate.worst,
            flaw=_openness(stage.program, springs),
        )

    def _solve(self, program: BoxQP, name: str) -> BoxSolution:
        settings = self._settings
        near = self._last.get(name)
        solution = solve_box_qp(program, settings.solver, settings.solver_tolerance, near)
        self._last[name] = solution.x
        return solution

    def _flawed(self, theta: float, error: UncertifiedSolutionError) -> FrontPoint:
        nan = float("nan")
        residual = nan if error.x is None else error.problem.certificate(error.x).worst
        rmse = np.full(len(_channels(self._objective)), nan)
        return FrontPoint(theta, None, rmse, nan, nan, residual, error.fact)


def _openness(program: BoxQP, solution: BoxSolution) -> str:
    """What is said of a solution that is not the only one; nothing where it is."""
    if solution.determined:
        return ""
    return f"{program.name}: neither the data nor the smoothness determine all of them"


def _channels(objective: Objective) -> tuple[str, ...]:
    wrench = np.array(WRENCH_CHANNELS)[objective.wrench_counts].tolist()
    local = [f"{channel.cluster}.{LOCAL_CHANNELS[channel.axis]}" for channel in objective.channels]
    return (*wrench, *local)


def _check_thetas(thetas: Sequence[float] | FloatArray) -> None:
    for theta in thetas:
        check_number(float(theta), "theta", 0.0, 1.0)
    if len(thetas) == 0 or not (np.diff(thetas) > 0.0).all():
        raise ConfigurationError("the thetas do not rise", "give each once, in rising order")


def _require_both_groups(objective: Objective) -> None:
    for group, count in (
        ("wrench", int(objective.wrench_counts.sum())),
        ("clusters", len(objective.channels)),
    ):
        if count == 0:
            raise IdentificationError(
                f"no channel of the {group} is in the objective: there is nothing to trade off",
                "leave fewer channels out, or fit a single model with 'fit'",
            )


def _require_a_solution(fronts: dict[Variant, Front]) -> None:
    if any(front.sound.any() for front in fronts.values()):
        return
    flaw = next(iter(fronts.values())).flaws[-1]
    raise IdentificationError(
        f"no theta gives a solution without flaw: {flaw}",
        "give more smoothness, another solver or a longer segment",
    )
