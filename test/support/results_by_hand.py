"""Results with known answers for a report on the scene: models, fronts and judgements by hand.

The report fits the first 48 samples of the scene, 0 to 11.75 s. There the factor F of the loads has
a mean of 1 - 0.5 / 48 = 0.98958, a mean square of 1.10417 and a deviation of 0.35340; in the other
half of the trial 1.01042, 1.14583 and 0.35340. The measured Fx is 14 + 10 sin N, one cycle; Fz is
-60 F N; Mz is 0.5 + 0.3 sin N m, 3.5 cycles, whose mean is 0.5 +- 0.3 * 0.08935 in either half.

Springs are as good as gates: their sharpness is 1 / um.

    stiffness       post_end 5000 N/m along z, compressed by 3 F mm: predicts Fz = -15 F N;
                    ant_prox 1 N/m along x, compressed while sin < 0.6: too soft to matter
    stiffness_bias  the same, with offsets of Fx 4 N, Fz -30 N, Mz 0.9 N m, and of brim_lateral
    rigid_bias      Fx = 14 + 5 sin N by its slope over the pose; left_prox 0.1 N/m always
                    compressed, right_prox 4000 N/m never
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.channel_errors import evaluate
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.fit import Fit
from socket_testbed.identification.pareto import Front, FrontPoint
from socket_testbed.identification.solver import BoxSolution, Certificate
from socket_testbed.identification.validation import (
    CLOSED,
    CONSTANT,
    FORCE_MAP,
    INVERSE_DISTANCE,
    Judgement,
)
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import IdentificationSettings
from support import scene

FRAMES = 48  # samples of the fits
THETAS = 4
_SHARPNESS = 1e6  # [1/m]


def tile(name: str) -> int:
    """The index of a tile."""
    return scene.TILES.index(name)


def _model(geometry: SocketGeometry, variant: Any) -> ContactModel:
    """The model of a variant, without springs."""
    return ContactModel(
        variant=variant,
        names=geometry.names,
        anchors=geometry.anchors,
        rotations=geometry.rotations,
        stiffness=np.zeros((len(geometry), 3)),
        rest_positions=np.zeros((len(geometry), 3)),
        sharpness=_SHARPNESS,
        wrench_bias=np.zeros(6),
        force_bias={},
        cluster_points=dict(geometry.clusters),
    )


def paper_model(geometry: SocketGeometry, variant: Any) -> ContactModel:
    """A model of one of the paper's variants, along the axes of {S}."""
    model = _model(geometry, variant)
    model.stiffness[tile("post_end"), 2] = 5000.0
    model.stiffness[tile("ant_prox"), 0] = 1.0
    model.rest_positions[:] = scene.CENTRE
    model.rest_positions[tile("ant_prox"), 0] = 0.5e-3
    model.rest_positions[tile("left_mid"), 1] = 1e-3
    if variant == "stiffness":
        return model
    model.stiffness[tile("left_mid"), 1] = 0.5
    offsets = {"brim_lateral": np.array([1.0, 2.0, -50.0])}
    return replace(
        model, wrench_bias=np.array([0.0, 0.0, 0.9, 4.0, 0.0, -30.0]), force_bias=offsets
    )


def rigid_model(geometry: SocketGeometry) -> ContactModel:
    """A model of a rigid limb, along the axes of the tiles."""
    model = _model(geometry, "rigid_bias")
    model.stiffness[tile("left_prox"), 2] = 0.1
    model.stiffness[tile("right_prox"), 2] = 4000.0
    model.rest_positions[tile("left_prox"), 2] = 0.02
    model.rest_positions[tile("right_prox"), 2] = -0.02
    model.rest_positions[tile("ant_mid"), 0] = 3e-3
    model.wrench_bias[3] = 7.0
    model.wrench_slope[3, 0] = 20e3  # of a motion of 0.35 + 0.25 sin mm
    return replace(model, reference_pose=np.append(scene.CENTRE, np.zeros(3)))


def _solution(residual: float, solver: str) -> BoxSolution:
    """A solution with three different residuals."""
    return BoxSolution(np.zeros(1), Certificate(residual, 2 * residual, 3 * residual), True, solver)


def fit_by_hand(
    samples: Samples, geometry: SocketGeometry, settings: IdentificationSettings
) -> Fit:
    """Stands for `fit_contact_model`."""
    rigid = settings.variant == "rigid_bias"
    model = rigid_model(geometry) if rigid else paper_model(geometry, settings.variant)
    return Fit(
        model=model,
        geometry=geometry,
        settings=settings,
        samples=len(samples),
        first_stamp=int(samples.stamps[0]),
        last_stamp=int(samples.stamps[-1]),
        determined=20.0,
        wrench_rmse=np.full(6, np.nan),
        errors=evaluate(samples, model, settings.leave_out),
        status="solved by hand",
        stage_one=_solution(1e-12, "osqp"),
        stage_two=_solution(2e-11, "warm start"),
        joint=_solution(3e-10, "osqp") if rigid else None,
        wrench="",
    )


# theta, wrench error, local error; the third solution of `stiffness` is dominated by the second
_POINTS: dict[str, list[tuple[float, float, float]]] = {
    "stiffness": [(0.0, 1.0, 0.1), (0.4, 0.3, 0.2), (0.8, 0.35, 0.6), (1.0, 0.1, 1.0)],
    "stiffness_bias": [(0.0, 0.9, 0.08), (0.4, 0.2, 0.3), (0.8, 0.15, 0.4), (1.0, 0.05, 0.9)],
}


def fronts_by_hand(*given: Any) -> dict[Any, Front]:
    """Stands for `pareto_front`: errors of moments 4 to 1 N m, forces 40 to 10 N, local 5 to 8."""
    del given
    return {
        variant: Front(
            variant,  # type: ignore[arg-type]
            ("Fx", "distal.Fz"),
            [
                FrontPoint(
                    theta=theta,
                    residual=(number + 1) * 1e-12,
                    rmse=np.array([40.0 - 10.0 * number, 5.0 + number]),
                    wrench_error=wrench,
                    local_error=local,
                    mean_moment_rmse=4.0 - number,
                    mean_force_rmse=40.0 - 10.0 * number,
                    median_local_rmse=5.0 + number,
                )
                for number, (theta, wrench, local) in enumerate(points)
            ],
        )
        for variant, points in _POINTS.items()
    }


def judgements_by_hand(*given: Any) -> list[Judgement]:
    """Stands for `judge_samples`."""
    del given
    names = {"fitted_on": "scene", "tested_on": "scene"}
    found = []
    for predictor, errors in {
        INVERSE_DISTANCE: (0.9, 0.7, 0.8),
        CLOSED: (0.6, 0.4, 0.5),
        FORCE_MAP: (0.35, 0.25, 0.3),
    }.items():
        coverage = {"coverage": (0.55, 0.85, 0.97)} if predictor == FORCE_MAP else {}
        for cluster, error in zip(("brim_lateral", "distal", ""), errors, strict=True):
            found.append(
                Judgement(
                    "cluster",
                    predictor,
                    "left out",
                    "",
                    "scene",
                    cluster,
                    samples=96,
                    error=error,
                    **(coverage if not cluster else {}),  # type: ignore[arg-type]
                )
            )
    for predictor, moment, force in ((CONSTANT, 2.0, 20.0), ("rigid_bias", 0.5, 8.0)):
        for test, factor in (("second half", 1.0), ("in-sample", 0.5)):
            found.append(
                Judgement(
                    "wrench",
                    predictor,
                    test,  # type: ignore[arg-type]
                    **names,
                    samples=48,
                    moment_rmse=factor * moment,
                    force_rmse=factor * force,
                    moment_skill=1.0 - moment / 2.0,
                    force_skill=1.0 - force / 20.0,
                )
            )
    for predictor, error in ((INVERSE_DISTANCE, 1.2), (FORCE_MAP, 0.45)):
        coverage = {"coverage": (0.4, 0.7, 0.9)} if predictor == FORCE_MAP else {}
        found.append(
            Judgement(
                "tiles",
                predictor,
                "second half",
                "",
                "scene",
                samples=48,
                error=error,
                **coverage,  # type: ignore[arg-type]
            )
        )
    return found


def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the report fit, trade off and judge by hand."""
    for place, made in {
        "results.models.fit_contact_model": fit_by_hand,
        "results.report.pareto_front": fronts_by_hand,
        "identification.validation.judge_samples": judgements_by_hand,
    }.items():
        monkeypatch.setattr(f"socket_testbed.{place}", made)
