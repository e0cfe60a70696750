"""Settings that the report and the validation pass on to fits, averages, maps and checks."""

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import results_by_hand, scene
from support.arrivals import Stage, changes
from support.surveys import prior_by_hand

from socket_testbed.identification import validation
from socket_testbed.identification.fit import FittedModel
from socket_testbed.identification.noise import measurement_errors
from socket_testbed.results.models import judge
from socket_testbed.results.report import Results, compute_results
from socket_testbed.samples import Samples
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial


@pytest.fixture
def stage(trial: Trial, monkeypatch: pytest.MonkeyPatch) -> Iterator[Stage]:
    """The stage for the functions below the API."""
    return Stage(monkeypatch, trial)


def settings_of(**changed: Any) -> EstimatorSettings:
    """The defaults, but for settings of the identification, a prior or a plateau."""
    usual = EstimatorSettings()
    for group, name in (("plateau", "least_force"), ("force_map", "length")):
        if name in changed:
            own = replace(getattr(usual, group), **{name: changed.pop(name)})
            usual = replace(usual, **{group: own})
    return replace(usual, identification=replace(usual.identification, **changed))


# ------------------------------------------------------------------ the report


def computed(
    stage: Stage, settings: EstimatorSettings, given: Any = None, survey: Any = None
) -> dict[str, Any]:
    """What arrives at the stages of a report on the scene."""
    stage.seen = {}
    stage.watch_trials()

    def fitted(samples: Samples, geometry: Any, own: Any) -> Any:
        stage.seen |= {"fitted": len(samples), "theta": own.theta}
        return results_by_hand.fit_by_hand(samples, geometry, own)

    def predicted(samples: Samples, model: Any, window: float, past: Any = None) -> np.ndarray:
        stage.seen[f"averaged to predict {len(samples)}"] = window
        return np.zeros((len(samples), 18))

    def evaluated(samples: Samples, predictions: Any, leave_out: Any) -> tuple[Any, ...]:
        stage.seen["judged without"] = leave_out
        stage.seen.setdefault("judged", len(samples))  # later the rest of the trial
        return (SimpleNamespace(samples=len(samples)),)

    def published(errors: Any, fronts: Any, samples: Samples, own: Any, geometry: Any) -> None:
        stage.seen |= {"published": len(samples), "published with": own.smoothness}

    def traced(samples: Samples, geometry: Any, own: Any, thetas: Any) -> dict[str, Any]:
        stage.seen |= {"traced": len(samples), "thetas": [*thetas], "traced with": own.smoothness}
        return {}

    def validated(
        samples: Samples, geometry: Any, own: Any, truth: Any, name: str, note: Any, prior_map: Any
    ):
        missing = np.flatnonzero(np.isnan(samples.wrench).all(axis=0))
        stage.seen |= {"validated": len(samples), "validated without": missing.tolist()}
        stage.seen |= {"validated above": own.plateau.least_force, "truth": truth is not None}
        stage.seen["validated after"] = prior_map.surveyed and prior_map.surveyed.name
        return ["judged"]

    def mapped(trial: Trial, own: EstimatorSettings, prior: Any) -> Any:
        stage.seen["mapped after"] = prior and prior.name
        stage.seen |= {"prior": own.force_map.length, "map without": own.identification.leave_out}

        def part(segment: Segment) -> Any:
            stage.seen["pressure over"] = str(segment)
            found = SimpleNamespace(outputs=SimpleNamespace(peak_row=5))
            pressure = SimpleNamespace(complete=lambda: found)
            return SimpleNamespace(pressure=lambda: pressure)

        def course(count: int, rows: list[int]) -> None:
            stage.seen["course with"] = rows

        return SimpleNamespace(part=part, course=course)

    stage.replace("results.models.fit_contact_model", fitted)
    stage.replace("identification.fit.predictions", predicted)
    stage.replace("results.models.evaluate", evaluated)
    stage.replace("results.report.pareto_front", traced)
    stage.patch.setattr(validation, "judge_samples", validated)
    stage.replace("results.report.map_trial", mapped)
    stage.replace("results.tradeoff.beside_published", published)
    stage.keep("results.report.course_of")
    stage.keep("results.report.data_quality")
    stage.keep("results.report.notes_on", returned=())
    stage.replace("results.models.smooth_poses", lambda samples, window: (len(samples), window))
    for name, places in {
        "measure_motion": ("", "", "averaged to move"),
        "load_shares": ("averaged to share", ""),
        "engagement": ("", "", "averaged to engage", ""),
    }.items():
        stage.keep(f"identification.information.{name}", *places)
    stage.patch.setattr(Trial, "plateaus", lambda trial, own: [own.plateau.least_force])
    found = compute_results(stage.trial, "2:5", settings, [0.0, 1.0], given, prior=survey)
    for judged in found.candidates.values():
        assert judged.held_out and judged.load_shares() is judged.engagement() is None
    stage.seen |= {"plateaus above": found.plateaus, "segment": str(found.segment)}
    stage.seen["notes"] = found.bag_notes
    return stage.seen


SPAN = "span 2.00 s to 5.00 s"
WITHOUT = ("Mz",)
REPORT: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "theta": ({"theta": 0.25}, {"theta": 0.25}),
    "smoothness": ({"smoothness": 0.5}, {"traced with": 0.5, "published with": 0.5}),
    "window": (
        {"pose_smoothing": 1.5},
        {
            "averaged to predict 96": 1.5,
            "averaged to predict 13": 1.5,
            "averaged to move": 1.5,
            "averaged to share": (13, 1.5),
            "averaged to engage": 1.5,
        },
    ),
    "left out": (
        {"leave_out": WITHOUT},
        {
            "judged without": WITHOUT,
            "validated without": [2],
            "map without": WITHOUT,
            "selected without": WITHOUT,
            "sound without": WITHOUT,
            "checked without": WITHOUT,
        },
    ),
    "frames": (
        {"frames": 7},
        {
            "fitted": 7,
            "judged": 7,
            "traced": 7,
            "published": 7,
            "averaged to share": (7, 0.0),
            "segment": "span 2.00 s to 3.50 s",
        },
    ),
    "least force": (
        {"least_force": 35.0},
        {"least force": 35.0, "validated above": 35.0, "plateaus above": (35.0,)},
    ),
    "prior": ({"length": 0.05}, {"prior": 0.05}),
}


def test_a_report_passes_its_survey_on(stage: Stage) -> None:
    usual = computed(stage, settings_of())
    found = computed(stage, settings_of(), survey=prior_by_hand(scene.geometry()))
    expected = dict.fromkeys(("validated after", "mapped after"), "survey of a, b")
    assert changes(usual, found) == expected


@pytest.mark.parametrize("case", REPORT)
def test_a_report_passes_its_settings_on(case: str, stage: Stage) -> None:
    changed, expected = REPORT[case]
    usual = computed(stage, settings_of())
    assert (usual["pressure over"], usual["course with"]) == (SPAN, [8 + 5])
    assert (usual["validated"], usual["truth"], usual["sound without"]) == (96, True, ())
    assert changes(usual, computed(stage, settings_of(**changed))) == expected


NOTE = "the given model leaves out what its fit did, outliers as well"


@pytest.mark.parametrize(
    ("own", "given", "noted"),
    [
        (("Mz",), (), True),
        ((), ("Mz",), True),
        (("Mz", "Mx"), ("Mx", "Mz"), False),
        ((), (), False),
    ],
    ids=["more here", "more there", "other order", "none"],
)
def test_a_given_model_leaves_its_own_out(
    own: tuple[str, ...], given: tuple[str, ...], noted: bool, stage: Stage
) -> None:
    made = results_by_hand.fit_by_hand(
        stage.trial.samples(), stage.trial.geometry, settings_of(leave_out=given).identification
    )
    found = computed(stage, settings_of(leave_out=own), made)
    assert (NOTE in found["notes"]) is noted


@pytest.mark.parametrize(
    ("used", "judged", "inside"),
    [(slice(0, 12), 75, True), (slice(30, 40), 73, False), (slice(0, 0), 83, False)],
    ids=["overlapping", "elsewhere", "another trial"],
)
def test_a_given_model_is_held_out_elsewhere(
    used: slice, judged: int, inside: bool, stage: Stage
) -> None:
    """The segment has the samples 8 to 20: held out is what neither it nor the fit has used."""
    rows = np.zeros(96, dtype=bool)
    rows[used] = True
    made = results_by_hand.fit_by_hand(
        stage.trial.samples(), stage.trial.geometry, settings_of().identification
    )
    stage.patch.setattr(FittedModel, "used", lambda model, *trial: rows)
    found = judge(stage.trial, made, Segment("span", 2.0, 5.0, slice(8, 21)))
    assert found.held_out[0].samples == judged and found.errors[0].samples == 13
    assert found.in_sample is inside


@pytest.mark.parametrize(
    ("counts", "held_out"), [((3, 10), True), ((3, 9), False)], ids=["ten of one", "nine"]
)
def test_ten_held_out_samples_of_a_channel_count(
    counts: tuple[int, int], held_out: bool, stage: Stage
) -> None:
    errors = tuple(SimpleNamespace(samples=count) for count in counts)
    stage.replace("results.models.evaluate", lambda *given: errors)
    made = results_by_hand.fit_by_hand(
        stage.trial.samples(), stage.trial.geometry, settings_of().identification
    )
    found = judge(stage.trial, made, Segment("span", 2.0, 5.0, slice(8, 21)))
    assert found.held_out == (errors if held_out else ())


@pytest.mark.parametrize(
    ("inside", "words"),
    [((True, True), "in-sample"), ((True, False), "in-sample, except for the given model")],
    ids=["all", "but one"],
)
def test_the_relation_of_errors_is_in_words(inside: tuple[bool, ...], words: str) -> None:
    candidates = [SimpleNamespace(in_sample=each) for each in inside]
    own: Any = SimpleNamespace(candidates=dict(enumerate(candidates)))
    assert Results.judged_on.fget(own) == words  # type: ignore[attr-defined]


# ------------------------------------------------------------------ the validation


class Numbers(np.ndarray[Any, Any]):
    """Samples that are numbers, and their own wrenches."""

    @property
    def wrench(self) -> Any:
        return np.asarray(self)


def judged(stage: Stage, settings: EstimatorSettings) -> list[Any]:
    """The calls that the judgements of 40 samples make, which are numbers here."""
    calls: list[Any] = []
    halves = np.arange(20), np.arange(20, 40)

    def split(samples: Any, least_force: float) -> Any:
        calls.append(("split", least_force))
        return halves

    def smooth(samples: Any, window: float) -> Any:
        calls.append(("averaged", (samples[0], samples[-1]), window))
        return samples

    def fit(samples: Any, geometry: Any, own: Any, notify: Any) -> dict[str, Any]:
        calls.append(("fitted", (samples[0], samples[-1]), own.theta))
        return {"rigid": SimpleNamespace()}

    def predictors(seen: Any, models: Any) -> dict[str, Any]:
        return {f"of {seen[0]}: {seen[-1]}": lambda samples, rows: samples.wrench[rows] + 100}

    def wrench(
        measured: Any, predicted: Any, test: str, fitted_on: str, tested_on: str
    ) -> list[str]:
        found = {name: values.tolist() for name, values in predicted.items()}
        calls.append((test, measured.tolist(), found, fitted_on, tested_on))
        return [test]

    def tiles(samples: Any, geometry: Any, truth: Any, estimators: Any, name: str) -> list[str]:
        calls.append(("tiles", samples.tolist(), truth.tolist(), [*estimators], name))
        return ["tiles"]

    def fields(geometry: Any, own: Any, prior_map: Any) -> dict[str, Any]:
        calls.append(("prior", own.length))
        return {"map": None}

    def mapped(
        samples: Any, geometry: Any, own: EstimatorSettings, name: str, prior_map: Any
    ) -> list[str]:
        calls.append(("clusters", own.force_map.length, own.plateau.least_force, name))
        return ["clusters"]

    stands_for = {
        "split": split, "smooth_poses": smooth, "fit_variants": fit, "judge_wrench": wrench,
        "judge_tiles": tiles, "field_estimators": fields, "judge_map": mapped, "MAX_SAMPLES": 3,
        "_MAX_WRENCHES": 3, "wrench_predictors": predictors,
    }  # fmt: skip
    for name, stand_in in stands_for.items():
        stage.patch.setattr(validation, name, stand_in)
    found = validation.judge_samples(
        np.arange(40).view(Numbers),  # type: ignore[arg-type]
        None,
        settings,
        100 + np.arange(40),
        "scene",
        None,  # type: ignore[arg-type]
    )
    assert found == ["clusters", "in-sample", "second half", "tiles"]  # type: ignore[comparison-overlap]
    return calls


def test_judgements_are_made_with_the_settings(stage: Stage) -> None:
    """Fits have whole halves, errors of the wrench and of tiles three samples of each."""
    own = settings_of(pose_smoothing=1.5, theta=0.25, least_force=35.0, length=0.05)
    assert judged(stage, own) == [
        ("split", 35.0),
        ("clusters", 0.05, 35.0, "scene"),
        ("fitted", (0, 19), 0.25),
        ("averaged", (0, 39), 1.5),
        ("in-sample", [0, 9, 19], {"of 0: 19": [100, 109, 119]}, "scene", "scene"),
        ("second half", [20, 29, 39], {"of 0: 19": [120, 129, 139]}, "scene", "scene"),
        ("prior", 0.05),
        ("tiles", [20, 29, 39], [120, 129, 139], ["map", "rigid"], "scene"),
    ]


def test_an_unseen_half_has_the_settings(stage: Stage) -> None:
    """All samples with a pose and a wrench count, also without load."""
    calls: list[Any] = []

    def split(samples: Samples, least_force: float) -> Any:
        calls.append(("split", least_force))
        return np.arange(40), np.arange(40, 96)

    def fit(samples: Samples, geometry: Any, own: Any) -> Any:
        calls.append(("fitted", len(samples), own.theta))
        return SimpleNamespace(model="a model")

    def predicted(samples: Samples, model: Any, window: float, past: Any = None) -> Any:
        calls.append((model, len(samples), window))
        return np.arange(96)

    stage.patch.setattr(validation, "split", split)
    stage.patch.setattr(validation.fit, "fit_contact_model", fit)
    stage.patch.setattr(validation.fit, "predictions", predicted)
    stage.patch.setattr(validation, "evaluate", lambda *given: given)
    own = settings_of(pose_smoothing=1.5, theta=0.25, leave_out=WITHOUT).identification
    found = validation.judge_unseen_half(stage.trial.samples(), stage.trial.geometry, own)
    samples, values, left_out = found
    assert len(samples) == 56 and left_out == WITHOUT  # type: ignore[arg-type, comparison-overlap]
    assert values.tolist() == [*range(40, 96)]  # type: ignore[attr-defined]
    assert calls == [("split", 0.0), ("fitted", 40, 0.25), ("a model", 96, 1.5)]


@pytest.mark.parametrize("least_force", [20.0, 70.0])
def test_clusters_are_judged_under_load(least_force: float, stage: Stage) -> None:
    """The force is 70 N or more in 40 of the scene's 96 samples, and always above 20 N."""
    seen: dict[str, Any] = {}

    def judge(samples: Samples, geometry: Any, estimators: Any, noise: Any, name: str) -> list[Any]:
        seen.update({"samples": len(samples), "estimators": estimators, "noise": noise})
        return [name]

    stage.patch.setattr(validation, "judge_clusters", judge)
    stage.patch.setattr(validation, "field_estimators", lambda geometry, own, given: own.length)
    stage.patch.setattr(validation, "measurement_errors", lambda samples, noise, own: own.length)
    own = settings_of(least_force=least_force, length=0.05)
    samples = stage.trial.samples()
    assert validation.judge_map(samples, stage.trial.geometry, own, "scene") == ["scene"]
    count = {20.0: 96, 70.0: 40}[least_force]
    assert seen == {"samples": count, "estimators": 0.05, "noise": 0.05}


# ------------------------------------------------------------------ the wrench that is met


def test_a_channel_without_any_value_is_not_met() -> None:
    """Fx is never known: all else is met; a sample with another gap has no forces."""
    geometry = scene.geometry()
    wrench = np.array([[1.0, -2.0, 0.5, np.nan, 3.0, -60.0], [1.0, -2.0, 0.5, np.nan, 3.0, np.nan]])
    found = validation.close_wrench(geometry, np.zeros((2, 12, 3)), wrench)
    assert np.isnan(found[1]).all()
    force, moment = found[0].sum(axis=0), np.cross(geometry.anchors, found[0]).sum(axis=0)
    assert np.allclose([*moment, *force[1:]], [1.0, -2.0, 0.5, 3.0, -60.0])


def test_each_cluster_has_its_own_noise() -> None:
    """Offsets of 0.2 N, a gain of 10 %, and an RMS of 10 N on the second cluster alone."""
    forces = np.zeros((3, 2, 3))
    forces[:, 1, 2] = 10.0
    samples: Any = SimpleNamespace(trusted_forces=forces)
    own = replace(EstimatorSettings().force_map, cluster_error=0.2, cluster_gain_error=0.1)
    noise = np.array([[0.5, np.nan, 0.1], [0.1, 0.1, 0.3]])
    found = measurement_errors(samples, noise, own)
    assert np.allclose(found, [[0.5, 0.2, 0.2], [0.2, 0.2, np.hypot(0.3, 1.0)]])
