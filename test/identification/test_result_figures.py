"""What fits, fronts, judgements and the paper's comparison say: titles, words and limits."""

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support import scene
from support.problems import make_samples

from socket_testbed.errors import IdentificationError
from socket_testbed.identification import fit, paper, pareto, validation
from socket_testbed.identification.channel_errors import (
    ChannelErrors,
    channel_errors,
    deviation,
    errors_to_dataframe,
    skill_of,
    summarise_errors,
)
from socket_testbed.identification.model_file import read_model
from socket_testbed.identification.noise import measurement_errors
from socket_testbed.identification.pareto import Front, FrontPoint
from socket_testbed.identification.validation import Judgement
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import ForceMapSettings, IdentificationSettings
from socket_testbed.settings.testbed import EstimatorSettings

NAN = float("nan")
GEOMETRY = scene.geometry()


def error_of(name: str, rmse: float, counts: bool = True, samples: int = 4) -> ChannelErrors:
    return ChannelErrors(
        name=name,
        unit="N m" if name[0] == "M" else "N",
        rmse=rmse,
        mae=0.5 * rmse,
        sigma=0.25 * rmse,
        skill=1.0 - 0.1 * rmse,
        samples=samples,
        in_objective=counts,
    )


ERRORS = (
    *(error_of(name, rmse) for name, rmse in zip(("Mx", "My", "Mz"), (1, 3, 100), strict=True)),
    *(error_of(name, rmse) for name, rmse in zip(("Fx", "Fy", "Fz"), (2, 4, 9), strict=True)),
    *(error_of(f"distal.{name}", rmse) for name, rmse in (("Fx", 6), ("Fy", 8), ("Fz", 7))),
)
# Mz is left out, Fz has no sample.
COUNTED = (
    *ERRORS[:2],
    replace(ERRORS[2], in_objective=False),
    *ERRORS[3:5],
    replace(ERRORS[5], samples=0, rmse=NAN, skill=NAN),
    *ERRORS[6:],
)


# --- errors of a fit


def test_errors_of_a_channel_are_by_hand() -> None:
    """Residuals 1, 3 and 2 of 10, 20 and 30; the best constant has sqrt(200 / 3)."""
    measured, predicted = np.array([10.0, 20.0, NAN, 30.0, 5.0]), np.array([11.0, 23, 9, 32, NAN])
    found = channel_errors("distal.Fz", measured, predicted, in_objective=False)
    rmse = np.sqrt(14.0 / 3.0)
    assert (found.name, found.unit, found.samples, found.in_objective) == (
        *("distal.Fz", "N"),
        *(3, False),
    )
    assert [found.rmse, found.mae, found.sigma] == pytest.approx([rmse, 2.0, np.sqrt(2.0 / 3.0)])
    assert found.skill == pytest.approx(1.0 - rmse / np.sqrt(200.0 / 3.0))


def test_errors_without_a_sample_are_unknown() -> None:
    found = channel_errors("Mx", np.array([NAN]), np.array([1.0]))
    assert (found.unit, found.samples, found.in_objective) == ("N m", 0, True)
    assert np.isnan([found.rmse, found.mae, found.sigma, found.skill]).all()


@pytest.mark.parametrize(
    ("values", "expected"),
    [([1.0, 3.0], 1.0), ([7.0, 7.0], 0.0), ([7.0, 7.0 + 1e-12], 0.0), ([1.0, NAN], NAN)],
    ids=["two", "constant", "rounding", "unknown"],
)
def test_deviation_is_of_the_best_constant(values: list[float], expected: float) -> None:
    assert deviation(np.array(values)) == pytest.approx(expected, abs=1e-15, nan_ok=True)


def test_skill_is_against_the_constant() -> None:
    assert skill_of(1.0, 4.0) == 0.75 and skill_of(8.0, 4.0) == -1.0
    assert np.isnan(skill_of(1.0, 0.0))


SUMMARY = {
    "mean_moment_rmse": 2.0,  # 1 and 3
    "mean_force_rmse": 3.0,  # 2 and 4
    "median_local_rmse": 7.0,  # of 6, 8 and 7
    "skill": 0.6,  # of 0.9, 0.7, 0.8, 0.6, 0.4, 0.2, 0.3
    "wrench_skill": 0.75,  # of 0.9, 0.7, 0.8, 0.6
    "local_skill": 0.3,
}


@pytest.mark.parametrize("figure", SUMMARY)
def test_the_summary_is_of_counted_channels(figure: str) -> None:
    assert getattr(summarise_errors(COUNTED), figure) == pytest.approx(SUMMARY[figure])


def test_the_summary_is_said_with_units() -> None:
    found = summarise_errors(COUNTED)
    assert found.without_value == ("Fz",)
    assert found.in_words(lambda value: f"{value:g}") == (
        "mean moment RMSE 2 N m, mean force RMSE 3 N, median local RMSE 7 N"
    )


def test_the_table_of_errors_has_its_titles() -> None:
    table = errors_to_dataframe(COUNTED)
    assert table.index.name == "channel"
    assert [*table.columns] == [
        *("unit", "RMSE", "MAE", "sigma", "skill", "samples", "in objective")
    ]
    row = table.loc["distal.Fy"]
    assert row.tolist() == ["N", 8.0, 4.0, 2.0, pytest.approx(0.2), 4, True]


def test_the_status_names_both_stages() -> None:
    one, two, joint = (SimpleNamespace(status=f"solved {name}") for name in "abc")
    assert fit._status(one, two, None) == "stage 1 solved a; stage 2 solved b"
    assert fit._status(one, two, joint) == "stage 1 solved a; stage 2 solved b; solved c"


# --- a front


def front(*errors: tuple[float, float], flaws: dict[int, str] | None = None) -> Front:
    """A front of pairs of errors of wrench and clusters, at evenly spaced thetas."""
    thetas = np.linspace(0.0, 1.0, len(errors))
    points = [
        FrontPoint(
            theta=float(theta),
            residual=1e-9 * (k + 1),
            rmse=np.array([1.0 + k, 2.0 + k, 3.0 + k]),
            flaw=(flaws or {}).get(k, ""),
            wrench_error=pair[0],
            local_error=pair[1],
            mean_moment_rmse=4.0 + k,
            mean_force_rmse=5.0 + k,
            median_local_rmse=6.0 + k,
        )
        for k, (theta, pair) in enumerate(zip(thetas, errors, strict=True))
    ]
    return Front("stiffness", ("Mx", "Fx", "distal.Fz"), points)


BENT = front((0.9, 0.1), (0.3, 0.2), (0.1, 0.9))


def test_a_table_of_a_front_has_units() -> None:
    table = BENT.to_dataframe()
    assert [*table.columns] == [
        *("variant", "theta [-]", "wrench error [-]", "local error [-]", "non-dominated", "mark"),
        *("mean moment RMSE [N m]", "mean force RMSE [N]", "median local RMSE [N]"),
        *("KKT residual or gap [-]", "flaw"),
        *("RMSE Mx [N m]", "RMSE Fx [N]", "RMSE distal.Fz [N]"),
    ]
    assert table.loc[1].tolist() == [
        *("stiffness", 0.5, 0.3, 0.2, 1, "knee", 5.0, 6.0, 7.0, 2e-9, "", 2.0, 3.0, 4.0)
    ]
    assert table["mark"].tolist() == ["sensor-only", "knee", "wrench-only"]


def test_a_document_of_a_front_has_its_keys() -> None:
    """Below the chord by 1 - (0.2 / 0.8 + 0.1 / 0.8) = 0.625 of the span."""
    document = pareto.front_document(BENT)
    assert document["variant"] == "stiffness" and document["non_dominated"] == 3
    assert document["worst_residual"] == pytest.approx(3e-9)
    knee = document["knee"]
    assert knee["theta"] == 0.5 and knee["depth"] == pytest.approx(0.625)
    assert knee["span"] == pytest.approx((0.8, 0.8))
    assert knee["verdict"] == "knee of depth 0.62: the front spans 0.8 by 0.8"
    assert document["solutions"][2] == {
        "theta": 1.0,
        "wrench_error": 0.1,
        "local_error": 0.9,
        "mean_moment_rmse": 6.0,
        "mean_force_rmse": 7.0,
        "median_local_rmse": 8.0,
        "residual": pytest.approx(3e-9),
        "rmse": {"Mx": 3.0, "Fx": 4.0, "distal.Fz": 5.0},
        "non_dominated": True,
        "flaw": None,
    }
    assert document["marks"]["wrench-only"] == document["solutions"][2]


KNEES = {
    # errors, verdict
    "deep": (
        ((0.9, 0.1), (0.46, 0.46), (0.1, 0.9)),
        "knee of depth 0.10: the front spans 0.8 by 0.8",
    ),
    "shallow": (
        ((0.9, 0.1), (0.49, 0.49), (0.1, 0.9)),
        "no knee: the front spans 0.8 by 0.8 and is straight",
    ),
    "short": (
        ((0.9, 0.1), (0.8995, 0.2), (0.8991, 0.9)),
        "no knee: the front spans 0.0009 by 0.8, nothing to trade off",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", KNEES)
def test_a_knee_is_deep_enough(case: str) -> None:
    errors, verdict = KNEES[case]
    assert front(*errors).knee.verdict == verdict


def test_a_flawed_point_is_no_mark() -> None:
    flawed = front((0.9, 0.1), (0.3, 0.2), (0.1, 0.9), flaws={2: "not unique"})
    assert [*flawed.marks] == ["sensor-only"]
    assert flawed.worst_residual == pytest.approx(2e-9)
    assert pareto.front_document(flawed)["solutions"][2]["flaw"] == "not unique"


@pytest.mark.parametrize(
    ("leave_out", "group"),
    [
        (("Mx", "My", "Mz", "Fx", "Fy", "Fz"), "wrench"),
        (tuple(f"{c}.F{a}" for c in scene.CLUSTERS for a in "xyz"), "clusters"),
    ],
    ids=["wrench", "clusters"],
)
def test_both_groups_are_traded_off(leave_out: tuple[str, ...], group: str) -> None:
    settings = IdentificationSettings(leave_out=leave_out)
    with pytest.raises(IdentificationError, match=f"no channel of the {group} is in the objective"):
        pareto.pareto_front(scene_samples(), GEOMETRY, settings, [0.5])


def scene_samples() -> Samples:
    limb = scene.limb()
    tiles = [*GEOMETRY.clusters.values()]
    forces = scene.forces_in_tiles(scene.STAMPS)[:, tiles]
    named = dict(zip(GEOMETRY.clusters, forces.swapaxes(0, 1), strict=True))
    pose = np.hstack([limb.translation, limb.rotation_vector()])
    return make_samples(pose, scene.wrench(), named)


# --- judgements


JUDGED = [
    Judgement("cluster", "force map", "left out", "", "one", "distal", 9, 0.9),
    Judgement("cluster", "force map", "left out", "", "one", "", 9, 0.2, coverage=(0.4, 0.7, 0.9)),
    Judgement("cluster", "force map", "left out", "", "two", "", 7, 0.6, coverage=(0.6, 0.9, 1.0)),
    Judgement("wrench", "rigid", "other trial", "two", "one", "", 8, NAN, 1.0, 10.0, 0.5, 0.1),
    Judgement("wrench", "rigid", "other trial", "three", "one", "", 8, NAN, 3.0, 30.0, 0.7, 0.2),
    Judgement("wrench", "rigid", "other trial", "one", "two", "", 8, NAN, 8.0, 80.0, -3.0, 0.9),
]


def test_judgements_are_tabled_with_units() -> None:
    table = validation.judgements_table(JUDGED)
    assert [*table.columns] == [
        *("question", "predictor", "test", "fitted on", "tested on", "cluster", "samples [1]"),
        *("error [-]", "moment RMSE [N m]", "force RMSE [N]", "moment skill [-]"),
        *("force skill [-]", "within 50 % [-]", "within 80 % [-]", "within 95 % [-]"),
    ]
    assert table.iloc[1, 6:].tolist()[:2] == [9, 0.2]
    assert table.iloc[1, 12:].tolist() == [0.4, 0.7, 0.9]
    assert table.iloc[4, 8:12].tolist() == [3.0, 30.0, 0.7, 0.2]


def test_a_summary_is_without_single_clusters() -> None:
    table = validation.summarise_judgements(JUDGED)
    assert [*table.columns] == [
        *("judged [1]", "samples [1]", "error [-]", "worst error [-]", "moment RMSE [N m]"),
        *("force RMSE [N]", "moment skill [-]", "force skill [-]"),
        *("within 50 % [-]", "within 80 % [-]", "within 95 % [-]"),
        *("median moment skill [-]", "median force skill [-]"),
    ]
    maps = table.loc["cluster", "left out", "force map"]
    assert maps.iloc[:4].tolist() == pytest.approx([2, 8.0, 0.4, 0.6])
    assert maps["within 80 % [-]"] == pytest.approx(0.8)
    rigid = table.loc["wrench", "other trial", "rigid"]
    assert rigid.iloc[4:8].tolist() == pytest.approx([4.0, 40.0, -0.6, 0.4])
    assert rigid.iloc[-2:].tolist() == pytest.approx([0.5, 0.2])


def test_a_trials_row_has_medians() -> None:
    table = validation.judgements_by_trial(JUDGED)
    assert [*table.index] == ["one", "two"] and table.index.name == "trial"
    row = table.loc["one"].dropna()
    assert row.to_dict() == pytest.approx(
        {
            "cluster, left out: force map error [-]": 0.2,
            "cluster, left out: force map within 50 % [-]": 0.4,
            "cluster, left out: force map within 80 % [-]": 0.7,
            "cluster, left out: force map within 95 % [-]": 0.9,
            "wrench, other trial: rigid moment RMSE [N m]": 2.0,
            "wrench, other trial: rigid force RMSE [N]": 20.0,
            "wrench, other trial: rigid moment skill [-]": 0.6,
            "wrench, other trial: rigid force skill [-]": 0.15,
        }
    )


def test_coverage_is_of_the_levels() -> None:
    """50, 80 and 95 % lie within 0.674, 1.282 and 1.960 standard deviations."""
    spread = np.full((5, 1, 1), 2.0)
    off = 2.0 * np.array([0.66, -0.69, 1.27, -1.95, 1.97])[:, None, None]
    figures = validation._figures([(np.zeros((5, 1, 1)), off, spread)], 4.0)
    assert figures["samples"] == 5 and figures["coverage"] == pytest.approx((0.2, 0.6, 0.8))
    assert figures["error"] == pytest.approx(np.sqrt(np.mean(off**2)) / 4.0)


def test_without_intervals_there_is_no_coverage() -> None:
    none = np.full((2, 1, 3), NAN)
    figures = validation._figures([(np.zeros((2, 1, 3)), np.ones((2, 1, 3)), none)], 0.0)
    assert np.isnan(figures["coverage"]).all() and np.isnan(figures["error"])


def test_two_halves_need_24_samples() -> None:
    """The scene has 96 samples; 31.9 N is the least force of its 24 heaviest."""
    samples = scene_samples()
    first, second = validation.split(samples[:24], 0.0)
    assert (len(first), len(second)) == (12, 12)
    with pytest.raises(IdentificationError) as refusal:
        validation.split(samples[:23], 5.0)
    assert refusal.value.fact == (
        "only 23 of 23 samples have a pose and a wrench under load (5 N or more), and two halves to"
        " fit and to test need 24"
    )


def test_a_cluster_has_its_measurement_error() -> None:
    """The offset's or the noise, whichever is larger, and a share of the RMS in quadrature."""
    settings = replace(ForceMapSettings(), cluster_error=0.5, cluster_gain_error=0.1)
    forces = np.zeros((4, 1, 3))
    forces[:, 0] = [3.0, -4.0, 12.0]
    samples = make_samples(np.zeros((4, 3)), np.zeros((4, 6)), {"distal": forces[:, 0]})
    found = measurement_errors(samples, np.array([[0.1, NAN, 0.9]]), settings)
    assert found[0].tolist() == pytest.approx(
        [np.hypot(0.5, 0.3), np.hypot(0.5, 0.4), np.hypot(0.9, 1.2)]
    )


def test_variants_without_a_fit_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def fitted(samples: Samples, geometry: object, settings: IdentificationSettings):
        if settings.variant.startswith("rigid"):
            raise IdentificationError(f"{settings.variant} fails", "try another")
        return SimpleNamespace(model=settings.variant)

    monkeypatch.setattr(fit, "fit_contact_model", fitted)
    notes: list[str] = []
    samples, settings = scene_samples(), IdentificationSettings()
    found = validation.fit_variants(samples, GEOMETRY, settings, notes.append)
    assert found == {"stiffness": "stiffness", "stiffness_bias": "stiffness_bias"}
    assert [note.partition(":")[0] for note in notes] == [
        *("rigid is not judged", "rigid_bias is not judged")
    ]
    monkeypatch.setattr(validation, "VARIANTS", ("rigid", "rigid_bias"))
    with pytest.raises(IdentificationError, match="rigid fails"):
        validation.fit_variants(samples, GEOMETRY, settings, notes.append)


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> list[Judgement]:
    """The scene, whose forces are known, with the scene's model in place of fits."""
    path = scene.model(tmp_path_factory.mktemp("models") / "model.json")
    settings = EstimatorSettings()
    forces = scene.forces_in_tiles(scene.STAMPS)
    truth = np.einsum("nij,knj->kni", GEOMETRY.rotations, forces)
    model = read_model(path).model
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(validation, "fit_variants", lambda *_: {"stiffness_bias": model})
        return validation.judge_samples(
            scene_samples(), GEOMETRY, settings, truth, "scene", lambda _: None
        )


def test_all_three_questions_are_answered(judged: list[Judgement]) -> None:
    """Three estimators on four clusters and all of them; three predictors twice; four on tiles."""
    counts = Counter((each.question, each.test, each.fitted_on) for each in judged)
    assert counts == {
        ("cluster", "left out", ""): 15,
        ("wrench", "in-sample", "scene"): 3,
        ("wrench", "second half", "scene"): 3,
        ("tiles", "second half", ""): 4,
    }
    assert {each.tested_on for each in judged} == {"scene"}


def test_halves_are_in_their_order(judged: list[Judgement]) -> None:
    """All 96 samples are under load: the constant is fitted on the first 48, off on the rest."""
    found = {(each.test, each.predictor): each for each in judged if each.question == "wrench"}
    seen, unseen = (found[half, "best constant"] for half in ("in-sample", "second half"))
    assert (seen.samples, unseen.samples) == (48, 48)
    wrench = scene.wrench()
    mean = wrench[:48].mean(axis=0)
    for half, judgement in ((wrench[:48], seen), (wrench[48:], unseen)):
        rmse = np.sqrt(np.mean((half - mean) ** 2, axis=0))
        assert judgement.moment_rmse == pytest.approx(rmse[:3].mean())
        assert judgement.force_rmse == pytest.approx(rmse[3:].mean())


def test_tiles_are_judged_without_sensors(judged: list[Judgement]) -> None:
    """The model has a force on one measured tile alone: it misses all of the others."""
    (found,) = (e for e in judged if (e.question, e.predictor) == ("tiles", "stiffness_bias"))
    assert found.error == pytest.approx(1.0) and found.samples == 48
    assert np.isnan(found.coverage).all()


# --- beside the paper


def hold(load: float = 300.0, change: float = 0.0, frames: int = 1000, rate: float = 4.0):
    """A hold as published, or one that differs: load [N], its deviation [N], frames, rate [Hz]."""
    wrench = np.zeros((frames, 6))
    wrench[:, 5] = -load + change * np.where(np.arange(frames) % 2, 1.0, -1.0)
    samples = make_samples(np.zeros((frames, 6)), wrench, {})
    step = round(1e9 / rate)
    return replace(samples, stamps=np.int64(10**18) + step * np.arange(frames, dtype=np.int64))


AS_PUBLISHED = IdentificationSettings(weights="raw", rest_position_limit=0.008)
CONDITIONS = {
    "as published": ({}, {}, []),
    "lighter": ({"load": 239.0}, {}, ["load of 239 N, about 300 N"]),
    "a little lighter": ({"load": 241.0}, {}, []),
    "heavier": ({"load": 361.0}, {}, ["load of 361 N, about 300 N"]),
    "steady": ({"change": 9.9}, {}, []),
    "unsteady": ({"change": 10.5}, {}, ["load that varies by 10 N, a hold"]),
    "shorter": ({"frames": 998}, {}, ["998 samples, 1000"]),
    "faster": ({"rate": 4.25}, {}, ["4.25 Hz, 4 Hz"]),
    "a little faster": ({"rate": 4.15}, {}, []),
    "slower": ({"rate": 3.75}, {}, ["3.75 Hz, 4 Hz"]),
    "other weights": ({}, {"weights": "size"}, ["weights size, raw"]),
    "another box": ({}, {"rest_position_limit": 0.01}, ["rest_position_limit 0.01, 0.008"]),
}


@pytest.mark.parametrize("case", CONDITIONS)
def test_conditions_differ_from_the_papers(case: str) -> None:
    trial, settings, expected = CONDITIONS[case]
    found = paper.differing_conditions(hold(**trial), replace(AS_PUBLISHED, **settings))
    assert [*found] == expected


def beside(counted: int = 9, **trial: float):
    """The paper's table for errors whose offsets halve them; of so many clusters' channels."""
    clusters = [
        error_of(f"{name}.F{axis}", 10.0, 3 * k + j < counted)
        for k, name in enumerate(scene.CLUSTERS)
        for j, axis in enumerate("xyz")
    ]
    plain = [*ERRORS[:6], *clusters]
    halved = [replace(e, rmse=0.5 * e.rmse, sigma=0.5 * e.sigma) for e in plain]
    left_out = tuple(e.name for e in plain if not e.in_objective)
    return paper.beside_published(
        {"stiffness": plain, "stiffness_bias": halved},
        {"stiffness": BENT, "stiffness_bias": front((0.9, 0.1), (0.1, 0.9))},
        hold(**trial),
        replace(AS_PUBLISHED, leave_out=left_out),
        scene.geometry(),
    )


ALONE = "not printed in the paper"
FIGURES = {
    # without and with offsets, of this trial and the paper; remark
    "mean moment RMSE [N m]": ((104 / 3, 52 / 3, 1.69, 0.44), ""),
    "mean force RMSE [N]": ((5.0, 2.5, 5.94, 5.25), ""),
    "median local RMSE [N]": ((10.0, 5.0, 90.07, 3.76), ""),
    "RMSE of Mx [N m]": ((1.0, 0.5, 3.99, 0.95), ""),
    "RMSE of distal.Fx [N]": (
        (10.0, 5.0, NAN, NAN),
        "not comparable: left out of the objective",
    ),
    "RMSE of Mz [N m]": ((100.0, 50.0, NAN, 0.25), f"{ALONE} without offsets"),
    "RMSE of Fx [N]": ((2.0, 1.0, NAN, NAN), ALONE),
    "RMSE of Fy [N]": ((4.0, 2.0, 6.76, NAN), f"{ALONE} with offsets"),
    "RMSE of Fz [N]": ((9.0, 4.5, 7.85, 8.03), ""),
    "RMSE of posterior_distal.Fx [N]": (
        (10.0, 5.0, NAN, NAN),
        f"{ALONE}: left out of its objective",
    ),
    "sigma of Fz [N]": ((2.25, 1.125, NAN, NAN), ALONE),
    "theta, sensor-only [-]": ((0.0, 0.0, NAN, NAN), ALONE),
    "theta, knee [-]": ((0.5, NAN, NAN, NAN), ALONE),
    "theta, wrench-only [-]": ((1.0, 1.0, NAN, NAN), ALONE),
    # conditions: the hold() of 300 N without clusters, the scene's geometry
    "load [N]": ((300.0, 300.0, 300.0, 300.0), "about, in the paper"),
    "mass placed on the pylon [kg]": ((NAN, NAN, 19.0, 19.0), "not known from a trial"),
    "samples [1]": ((1000.0, 1000.0, 1000.0, 1000.0), ""),
    "rate [Hz]": ((4.0, 4.0, 4.0, 4.0), ""),
    "rest position limit [mm]": (
        (8.0, 8.0, 8.0, 8.0),
        "about, in the paper; its largest compression",
    ),
    "edge of a tile [mm]": ((30.0, 30.0, 30.0, 30.0), ""),
    "cluster channels in the objective [1]": ((9.0, 9.0, 9.0, 9.0), ""),
}


@pytest.mark.parametrize("figure", FIGURES)
def test_figures_stand_beside_the_papers(figure: str) -> None:
    values, remark = FIGURES[figure]
    row = beside().loc[figure].tolist()
    assert row[:4] == pytest.approx(values, nan_ok=True) and row[4] == remark


PRINTED = {
    # by figure: without and with offsets, as the paper prints them
    "mean moment RMSE [N m]": ("1.69", "0.44"),
    "mean force RMSE [N]": ("5.94", "5.25"),
    "median local RMSE [N]": ("90.07", "3.76"),
    "RMSE of Mx [N m]": ("3.99", "0.95"),
    "RMSE of My [N m]": (None, "0.13"),
    "RMSE of Mz [N m]": (None, "0.25"),
    "RMSE of Fy [N]": ("6.76", None),
    "RMSE of Fz [N]": ("7.85", "8.03"),
    "RMSE of brim_lateral.Fx [N]": ("46.90", "8.85"),
    "RMSE of brim_lateral.Fy [N]": ("34.26", None),
    "RMSE of brim_lateral.Fz [N]": ("57.86", "2.39"),
    "RMSE of mid_anterior.Fx [N]": ("136.52", "7.78"),
    "RMSE of mid_anterior.Fz [N]": ("90.07", "2.52"),
    "RMSE of posterior_distal.Fy [N]": (None, "112.83"),
    "RMSE of posterior_distal.Fz [N]": ("107.99", "2.21"),
    "RMSE of distal.Fz [N]": ("153.04", "0.99"),
    "sigma of Mx [N m]": ("0.83", None),
}


@pytest.mark.parametrize("figure", PRINTED)
def test_published_figures_are_the_printed_ones(figure: str) -> None:
    expected = [NAN if text is None else float(text) for text in PRINTED[figure]]
    assert paper.PUBLISHED[figure] == pytest.approx(expected, nan_ok=True)
    assert paper.PUBLISHED.keys() == PRINTED.keys()


SOURCE = Path(__file__).parents[3] / "shared" / "paper" / "paper.tex.txt"


@pytest.mark.skipif(not SOURCE.is_file(), reason="the paper's source is not here")
def test_the_source_prints_each_result() -> None:
    """Every number of a result with a unit, and no other."""
    text = SOURCE.read_text()
    results = text[text.index(r"\section{Results}") : text.index("Acknowledgment")]
    number, unit = r"\\SI\{([\d.]+)\}", r"\{(Nm|\\newton)\}"
    printed = set(re.findall(number + unit, results))
    known = {
        (text, "Nm" if figure.endswith("[N m]") else r"\newton")
        for figure, texts in PRINTED.items()
        for text in texts
        if text
    }
    conditions = {("1000", r"\newton"), ("300", r"\newton"), ("1", "Nm")}
    assert printed == known | conditions


def test_the_papers_table_has_its_columns() -> None:
    table = beside()
    assert [*table.columns] == [
        *(("this trial", "without offsets"), ("this trial", "with offsets")),
        *(("the paper", "without offsets"), ("the paper", "with offsets"), ("", "remark")),
    ]
    assert table.index.name == "figure" and "sigma of distal.Fx [N]" not in table.index


def test_what_does_not_compare_is_remarked() -> None:
    table = beside(counted=8, load=200.0)
    remark = "not comparable: load of 200 N, about 300 N"
    assert table.loc["mean force RMSE [N]"].iloc[4] == f"{remark} in the paper"
    assert table.loc["median local RMSE [N]"].iloc[4] == (
        f"{remark}; 8 of 12 channels counted, 9 in the paper"
    )
