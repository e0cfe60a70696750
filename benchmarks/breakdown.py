"""The parts of the package's own fit, each to be timed by itself."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from problems import StageTwoInput

from socket_testbed.identification.box_qp import solve_box_qp
from socket_testbed.identification.contact import gated_displacement
from socket_testbed.identification.evaluation import evaluate
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.moments import Method
from socket_testbed.identification.problem import (
    KILONEWTON_PER_METRE,
    StageTwoData,
    StageTwoMoments,
    build_objective,
    build_stage_one,
    build_stage_two,
    recover_offsets,
)


def parts_of_fit(stage: StageTwoInput) -> dict[str, Callable[[], object]]:
    """What the parts are called, and what runs each of them."""
    settings, objective, rest = stage.settings, stage.objective, stage.rest_positions
    gate = (objective.position, rest, settings.gate_sharpness)
    solver = (settings.solver, settings.solver_tolerance)
    stage_one = build_stage_one(objective)

    def moments(method: Method = "auto") -> StageTwoMoments:
        return StageTwoData(objective, method=method).moments(rest)

    taken = moments()
    built = build_stage_two(objective, taken)
    stiffness = KILONEWTON_PER_METRE * np.reshape(solve_box_qp(built.program, *solver).x, (-1, 3))
    model = fit_contact_model(stage.samples, stage.geometry, settings).model
    return {
        "build_objective": lambda: build_objective(stage.samples, stage.geometry, settings),
        "stage 1: build": lambda: build_stage_one(objective),
        "stage 1: solve_box_qp": lambda: solve_box_qp(stage_one, *solver),
        "stage 2: moments (auto)": moments,
        "stage 2: build": lambda: build_stage_two(objective, taken),
        "stage 2: solve_box_qp": lambda: solve_box_qp(built.program, *solver),
        "stage 2: recover_offsets": lambda: recover_offsets(objective, taken, stiffness),
        "errors of all channels": lambda: evaluate(objective.samples, model),
        "fit_contact_model": lambda: fit_contact_model(stage.samples, stage.geometry, settings),
        "moments, series": lambda: moments("series"),
        "moments, direct": lambda: moments("direct"),
        "gate pass alone (S)": lambda: gated_displacement(*gate),
    }
