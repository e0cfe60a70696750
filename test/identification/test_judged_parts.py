"""Which part of a trial is judged, and how judgements, fits and residuals are brought together."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import scene
from support.problems import make_case, make_samples

from socket_testbed.api import validation as api
from socket_testbed.identification import pareto, validation
from socket_testbed.identification.solver import Certificate
from socket_testbed.results import validating
from socket_testbed.results.validating import Recording
from socket_testbed.settings.testbed import EstimatorSettings

COUNT = 80


@pytest.fixture
def loaded() -> Any:
    """Samples under a load that grows by the second."""
    force = np.outer(np.arange(COUNT) + 50.0, [0.0, 0.0, 0.0, 0.0, 0.0, -1.0])
    return make_samples(np.zeros((COUNT, 6)), force, {"distal": np.zeros((COUNT, 3))})


def test_tiles_are_judged_on_the_second_half(loaded: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    judged: list[Any] = []
    monkeypatch.setattr(validation, "judge_map", lambda *_: [])
    monkeypatch.setattr(validation, "fit_variants", lambda *_: {})

    def judge_tiles(samples: Any, socket: Any, truth: Any, *_: Any) -> list[Any]:
        judged.append((samples, truth))
        return []

    monkeypatch.setattr(validation, "judge_tiles", judge_tiles)
    truth = np.arange(COUNT)[:, None, None] * np.ones((1, 12, 3))
    validation.judge_samples(loaded, scene.geometry(), EstimatorSettings(), truth, "s", print)
    ((samples, true),) = judged
    assert samples.stamps.tolist() == loaded.stamps[COUNT // 2 :].tolist()
    assert true[:, 0, 0].tolist() == [*range(COUNT // 2, COUNT)]


def test_judgements_of_others_are_medians_by_trial() -> None:
    found = [
        validation.Judgement("wrench", "rigid", "other trial", f"t{skill}", "t", force_skill=skill)
        for skill in (0.1, 0.2, -9.0)
    ]
    table = validation.judgements_by_trial(found)
    assert table.loc["t", "wrench, other trial: rigid force skill [-]"] == 0.1


def test_others_are_tested_by_these_models(loaded: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validation, "fit_variants", lambda *_: {})
    trial: Any = SimpleNamespace(geometry=scene.geometry())
    first, second = (
        Recording(name, trial, EstimatorSettings(), loaded, print) for name in ("first", "second")
    )
    found = first.judge_others([second])
    assert {(each.fitted_on, each.tested_on) for each in found} == {("first", "second")}
    assert {each.test for each in found} == {"other trial"} and len(found) == 2


@pytest.mark.parametrize("worse", ["rest positions", "stiffnesses"])
def test_a_point_has_its_stages_worst_residual(worse: str, monkeypatch: pytest.MonkeyPatch) -> None:
    geometry, _, samples, settings = make_case(2)
    solve = pareto.solve_box_qp
    seen = set()

    def certified(program: Any, *given: Any) -> Any:
        first = "1" in program.name or "rest" in program.name
        seen.add(first)
        residual = 3e-9 if first is (worse == "rest positions") else 1e-12
        return replace(solve(program, *given), certificate=Certificate(0.0, residual, 0.0))

    monkeypatch.setattr(pareto, "solve_box_qp", certified)
    fronts = pareto.pareto_front(samples, geometry, settings, [0.5])
    assert seen == {True, False}
    assert [front.residual.tolist() for front in fronts.values()] == [[3e-9], [3e-9]]


@pytest.mark.parametrize("given", [("a", "b", "c"), (["a", "b", "c"],)], ids=["each", "a list"])
def test_models_are_judged_on_chosen_trials(
    given: tuple[Any, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two of three are fitted, the first and the last; of the other, the force map alone."""
    trial: Any = SimpleNamespace(geometry=scene.geometry(), path="nowhere", metadata=None)
    samples: Any = SimpleNamespace(stamps=None)
    read = [Recording(name, trial, EstimatorSettings(), samples, print) for name in "abc"]
    monkeypatch.setattr(api, "open_different", lambda given: given)
    monkeypatch.setattr(api, "_recordings", lambda *_: read)
    monkeypatch.setattr(validating, "_MAX_FITTED", 2)
    monkeypatch.setattr(validating, "read_true_forces", lambda *_: None)
    monkeypatch.setattr(Recording, "judge_others", lambda self, others: [f"others by {self.name}"])
    monkeypatch.setattr(
        validation, "judge_map", lambda _, geometry, settings, name, prior: [f"map of {name}"]
    )
    monkeypatch.setattr(
        validation,
        "judge_samples",
        lambda _, geometry, settings, truth, name, note, prior: [f"all of {name}"],
    )
    found = api.validate(*given)
    assert (found.trials, found.fitted) == (("a", "b", "c"), ("a", "c"))
    alone = ("all of a", "map of b", "all of c")
    assert found.judgements == (*alone, "others by a", "others by c")
