"""A survey as a prior: against the joint map, a multivariate t, and values worked out by hand."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_t
from support.problems import GEOMETRY, make_samples
from support.surveys import prior_by_hand, write_survey_file

from socket_testbed.errors import ConfigurationError
from socket_testbed.identification.contact import wrench_map
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.identification.map_posterior import Family
from socket_testbed.identification.map_prior import Prior, hypotheses
from socket_testbed.identification.survey import Donned, JointMap
from socket_testbed.identification.survey_prior import SurveyPrior, learnt, read_survey
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import ForceMapSettings

ONE = ForceMapSettings(draws=1)
NAMES = tuple(GEOMETRY.clusters)
PLACES = ((0, 5, 9, 14), (2, 7, 11, 14), (1, 4, 12, 16))
LOAD = np.array([1.0, 2.0, 0.0, 0.0, 5.0, -200.0])
CHANGE = 0.3


def trials(similar: bool = True) -> list[Donned]:
    """Three trials at one load; similar forces make the third likely after the others."""
    rng = np.random.default_rng(3)
    spread = np.array([0.3, 0.3, 0.5]) if similar else np.array([4.0, 4.0, 12.0])
    found = []
    for tiles in PLACES:
        forces = rng.normal(0.0, spread, (1, 4, 3)) - [0.0, 0.0, 6.0]
        found.append(Donned(tiles, np.hstack([LOAD[None], forces.reshape(1, -1)])))
    return found


def samples_of(trial: Donned) -> Samples:
    forces = dict(zip(NAMES, np.swapaxes(trial.forces, 0, 1), strict=True))
    return make_samples(np.zeros((len(trial.values), 3)), trial.values[:, :6], forces)


def prior_of(surveyed: list[Donned], changes: tuple[float, ...] = (CHANGE,)) -> SurveyPrior:
    joint = JointMap(GEOMETRY, surveyed, ONE, changes)
    named = [(f"trial {n}", f"print {n}", NAMES) for n in range(len(surveyed))]
    return learnt(joint, GEOMETRY, named, surveyed)


def placed(trial: Donned) -> Any:
    return replace(GEOMETRY, clusters=dict(zip(NAMES, trial.tiles, strict=True)), turned={})


def mapped_after(
    surveyed: list[Donned], samples: Samples, changes: tuple[float, ...] = (CHANGE,)
) -> ForceMap:
    """The map of the last trial's samples, with a survey of the others as its prior."""
    *others, last = surveyed
    geometry = placed(last)
    expected = prior_of(others, changes).expected(geometry, NAMES)
    return ForceMap(geometry, NAMES, ONE, samples, expected)


@pytest.mark.parametrize("changes", [(CHANGE,), (0.4, 0.7)], ids=["one epsilon", "two epsilons"])
@pytest.mark.parametrize("similar", [True, False], ids=["similar", "unlike"])
def test_the_map_mixes_the_joint_and_the_ordinary(
    similar: bool, changes: tuple[float, ...]
) -> None:
    surveyed = trials(similar)
    last, samples = surveyed[-1], samples_of(surveyed[-1])
    mapped = mapped_after(surveyed, samples, changes)
    share = mapped.survey_probability(samples)
    joint = JointMap(GEOMETRY, surveyed, ONE, changes).field(2)
    alone = JointMap(GEOMETRY, [last], ONE).field(0)
    mean = share * joint.forces + (1.0 - share) * alone.forces
    square = share * (joint.deviations**2 + joint.forces**2)
    square += (1.0 - share) * (alone.deviations**2 + alone.forces**2)
    found = mapped.estimate(samples)
    np.testing.assert_allclose(
        found.forces, np.einsum("nij,snj->sni", GEOMETRY.rotations, mean), atol=1e-7
    )
    pressure_sd = np.sqrt(square - mean**2)[..., 2] / GEOMETRY.areas
    np.testing.assert_allclose(found.normal_pressure_standard_deviation, pressure_sd, rtol=1e-6)


@pytest.mark.parametrize("similar", [True, False], ids=["similar", "unlike"])
def test_clusters_weigh_the_priors_after_the_wrench(similar: bool) -> None:
    surveyed = trials(similar)
    (sizes,) = hypotheses(ONE, GEOMETRY.tile_share)
    K = Prior(GEOMETRY, NAMES, sizes).covariance()
    wrench = np.einsum(
        "wni,nij->wnj", wrench_map(GEOMETRY.anchors).reshape(6, -1, 3), GEOMETRY.rotations
    ).reshape(6, -1)
    wrench /= sizes.share
    known = wrench @ K @ wrench.T
    known += 1e-3 * np.diag(np.diag(known))
    changed = CHANGE**2 * (K - K @ wrench.T @ np.linalg.solve(known, wrench @ K))
    rows, noise = [], []
    for each in surveyed:
        at = (3 * np.array(each.tiles)[:, None] + np.arange(3)).ravel()
        rows.append(np.vstack([wrench, np.eye(len(K))[at]]))
        of_clusters = sizes.cluster_error**2 + sizes.cluster_gain_error**2 * np.diag(K)[at]
        noise += [*[sizes.moment_error**2] * 3, *[sizes.force_error**2] * 3, *of_clusters]
    H, who = np.vstack(rows), np.repeat(np.arange(3), 18)
    total = H @ K @ H.T + (H @ changed @ H.T) * (who[:, None] == who) + np.diag(noise)
    alone = rows[-1] @ K @ rows[-1].T + np.diag(noise[-18:])
    y = np.hstack([each.values[0] for each in surveyed])

    def density(covariance: np.ndarray, values: np.ndarray) -> float:
        return float(multivariate_t(shape=covariance, df=2.0).logpdf(values))

    load = slice(0, 42)  # both earlier trials, and the last one's wrench
    odds = density(total, y) - density(total[load, load], y[load])
    odds -= density(alone, y[36:]) - density(alone[:6, :6], y[36:42])
    samples = samples_of(surveyed[-1])
    mapped = mapped_after(surveyed, samples)
    assert mapped.survey_probability(samples) == pytest.approx(1.0 / (1.0 + np.exp(-odds)))
    assert (odds > 2.0) == similar


@pytest.mark.parametrize("times", [1, 100], ids=["few samples", "many samples"])
def test_an_expected_force_is_updated_by_hand(times: int) -> None:
    # A force of variance 1 was measured as 2 with an error of variance 1: its mean is 1, its
    # variance 0.5. A donning adds 0.25; the channel has an error of 0.25.
    family = Family(
        total=np.array([[[1.0]]]),
        cross=np.full((1, 1, 4, 1), 0.75),
        variances=np.full((1, 1, 4), 0.75),
        forces=np.full((1, 1, 1, 4), 1.0),
        channels=np.array([[[1.0]]]),
        distances=np.array([[2.0]]),  # 2^2 / (1 + 1)
        earlier=1,
    )
    conditioned = family.conditioned(np.array([0]))
    values = np.tile([[2.0, 1.0], [2.0, 2.0]], (times, 1))
    mean, variance = (found[-2:] for found in conditioned.average(values, np.ones(1)))
    # 1 + 0.75 (2 - 1); at twice the load 2 is expected.
    np.testing.assert_allclose(mean[:, 0, 0], [1.75, 2.0])
    # (2 + 2 + 1) / (2 + 2 - 2) times 0.75 - 0.75^2; at twice the load (2 + 8 + 0) / 2.
    np.testing.assert_allclose(variance[:, 0, 0], [2.5 * 0.1875, 5.0 * 0.1875])


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        pytest.param({}, [1.0, 0.0], id="same"),
        pytest.param({5: -110.0}, [0.0, 1.1], id="half and a tenth"),
        pytest.param({5: -240.0, 1: 0.72}, [1.2, 0.0], id="a fifth more"),
        pytest.param({5: -320.0, 1: 0.96}, [0.0, 0.0], id="far more"),
        pytest.param({3: 29.0}, [1.0, 0.0], id="slightly aside"),
        pytest.param({3: 35.0}, [0.0, 0.0], id="aside"),
        pytest.param({1: 6.0}, [0.0, 0.0], id="another moment"),
        pytest.param({2: np.nan}, [1.0, 0.0], id="no Mz"),
        pytest.param({5: np.nan}, [0.0, 0.0], id="no Fz"),
    ],
)
def test_like_loads_count_in_proportion(change: dict[int, float], expected: list[float]) -> None:
    # The loads are Fz of -200 and -100 N, with My of 0.6 and 0.3 N m.
    values = np.array([[0.0, 0.6, 0.0, 0.0, 0.0, -200.0]])
    for channel, value in change.items():
        values[0, channel] = value
    found = prior_by_hand(GEOMETRY).expected(GEOMETRY, NAMES).loads(values)
    np.testing.assert_allclose(found[0], expected, atol=0.02)
    assert (found[0] > 0.0).tolist() == [value > 0.0 for value in expected]


def test_evidence_counts_in_full_for_epsilon_alone() -> None:
    # One hypothesis with two epsilons, and a second one: 0.3 + 0.3 and 0.4. The first epsilon has
    # three times the evidence, the second hypothesis twice.
    prior = prior_by_hand(GEOMETRY)
    twice = replace(
        prior, hypotheses=prior.hypotheses * 2, weights=np.array([[0.3, 0.3], [0.0, 0.4]])
    )
    found = twice.expected(GEOMETRY, NAMES).weighed(np.log([3.0, 1.0, 2.0]))
    # Mean evidence of both hypotheses is 2: their weights follow those of two trials of three.
    shares = np.array([0.6, 0.4]) ** (2.0 / 3.0)
    shares /= shares.sum()
    np.testing.assert_allclose(found, [0.75 * shares[0], 0.25 * shares[0], shares[1]])


def test_joint_draws_have_the_map_s_moments() -> None:
    surveyed = trials()
    samples = samples_of(surveyed[-1])
    mapped = mapped_after(surveyed, samples)
    estimate = mapped.estimate(samples)
    (draws,) = mapped.sample(samples, 4000)
    values = draws.values()[0].reshape(4000, -1, 3)
    normal = -estimate.normal_pressure[0] * GEOMETRY.areas
    np.testing.assert_allclose(values[..., 2].mean(axis=0), normal, atol=0.05)
    ratio = values[..., 2].std(axis=0) / GEOMETRY.areas
    ratio /= estimate.normal_pressure_standard_deviation[0]
    assert ratio.mean() == pytest.approx(1.0, abs=0.03)
    assert np.abs(ratio - 1.0).max() < 0.2


def test_other_loads_have_the_ordinary_map() -> None:
    surveyed = trials()
    double = replace(
        surveyed[-1], values=np.vstack([surveyed[-1].values, 3.0 * LOAD[[*range(6)] * 3]])
    )
    samples = samples_of(double)
    geometry = placed(double)
    mapped = mapped_after([*surveyed[:2], double], samples)
    ordinary = ForceMap(geometry, NAMES, ONE, samples)
    found, plain = mapped.estimate(samples), ordinary.estimate(samples)
    assert np.abs(found.forces - plain.forces).max(axis=(1, 2))[0] > 0.1
    np.testing.assert_array_equal(found.forces[1], plain.forces[1])
    share = 100.0 * mapped.survey_probability(samples)
    assert mapped.source(samples).startswith(
        f"prior: survey of trial 0, trial 1, with {share:.0f} % probability in 1 of 2 samples,"
        " whose loads are like the survey's; otherwise mean zero; measured: wrench, "
    )
    assert ordinary.source(samples).startswith("prior: mean zero; measured: wrench, ")


def repeated_by(normal: float) -> SurveyPrior:
    """A survey with one cluster left in place, which measured -8 N, then another normal force."""
    return prior_by_hand(GEOMETRY, tiles=(0, 0), forces=((0.5, 0.0, -8.0), (0.5, 0.0, normal)))


@pytest.mark.parametrize(
    ("prior", "doubt"),
    [
        pytest.param(prior_by_hand(GEOMETRY), "", id="no repeat"),
        pytest.param(repeated_by(-12.0), "", id="0.39"),  # 4 / sqrt((64.25 + 144.25) / 2)
        pytest.param(
            repeated_by(-13.0),  # 5 / sqrt((64.25 + 169.25) / 2)
            "its repeats in place differ by 0.46 of the force, so that it may make the map worse",
            id="0.46",
        ),
    ],
)
def test_unlike_repeats_put_a_survey_in_doubt(prior: SurveyPrior, doubt: str) -> None:
    assert prior.doubt == doubt
    samples = samples_of(trials()[-1])
    geometry = placed(trials()[-1])
    mapped = ForceMap(geometry, NAMES, ONE, samples, prior.expected(geometry, NAMES))
    assert doubt in mapped.source(samples)
    assert ("repeats in place" in mapped.source(samples)) == bool(doubt)


# ------------------------------------------------------------------ the file


def test_a_file_gives_the_survey_back(tmp_path: Path) -> None:
    prior = prior_by_hand(GEOMETRY)
    prior.donned[0].values[:, 6:] = np.nan  # a cluster that measured nothing
    found = read_survey(write_survey_file(tmp_path / "survey.json", prior))
    assert found.name == "survey of a, b"
    assert found.geometry.same_tiles(GEOMETRY)
    for name in ("trials", "fingerprints", "clusters", "hypotheses"):
        assert getattr(found, name) == getattr(prior, name)
    for name in ("changes", "weights"):
        np.testing.assert_array_equal(getattr(found, name), getattr(prior, name))
    for own, read in zip(prior.donned, found.donned, strict=True):
        assert own.tiles == read.tiles
        np.testing.assert_array_equal(own.values, read.values)


def one_wrong(key: str, change: Callable[[Any], Any]) -> dict[str, Any]:
    """A part of the prior's document after a change."""
    part = json.loads(json.dumps(prior_by_hand(GEOMETRY).document()[key]))
    change(part)
    return {key: part}


WRONG = {
    "missing": (
        lambda: one_wrong("trials", lambda t: t[1].pop("forces")),
        "forces",
    ),
    "other units": (
        lambda: one_wrong("units", lambda u: u.update(forces="in {S} [kN]")),
        "is in other units or frames",
    ),
    "one trial": (lambda: one_wrong("trials", lambda t: t.pop()), "trials"),
    "a text": (
        lambda: one_wrong("trials", lambda t: t[0]["wrenches"][0].__setitem__(5, "x")),
        "wrenches",
    ),
    "fewer loads": (
        lambda: one_wrong("trials", lambda t: t[1]["wrenches"].pop()),
        "trials: b: has another number of loads",
    ),
    "no force": (
        lambda: one_wrong("trials", lambda t: t[1]["wrenches"][0].__setitem__(5, None)),
        "trials: b: a load has no force",
    ),
    "two forces": (
        lambda: one_wrong("trials", lambda t: t[0]["clusters"].update(two="x")),
        "no tile 'x'",
    ),
    "no tile": (
        lambda: one_wrong("trials", lambda t: t[0]["clusters"].clear()),
        "trials: a: has no force for each",
    ),
    "a weight too many": (
        lambda: one_wrong("hypotheses", lambda h: h[0]["weights"].append(0.0)),
        "hypotheses: 0",
    ),
    "no weight": (
        lambda: one_wrong("hypotheses", lambda h: h[0].update(weights=[0.0, 0.0])),
        "no hypothesis has a weight",
    ),
    "another size": (
        lambda: one_wrong("hypotheses", lambda h: h[0]["sizes"].update(other=1.0)),
        "hypotheses: 0",
    ),
    "no length": (
        lambda: one_wrong("hypotheses", lambda h: h[0]["sizes"].update(length=0.0)),
        "hypotheses: 0",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_part_is_named(case: str, tmp_path: Path) -> None:
    wrong, named = WRONG[case]
    path = write_survey_file(tmp_path / "survey.json", prior_by_hand(GEOMETRY), **wrong())
    with pytest.raises(ConfigurationError) as refused:
        read_survey(path)
    assert str(refused.value).startswith(f"{path}: prior: ")
    assert named in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        pytest.param("[", "is not a survey", id="no JSON"),
        pytest.param("[]", "not a survey: give a file that 'survey -o FILE.json' wrote", id="list"),
        pytest.param('{"verdict": ""}', "is not a survey", id="no format"),
        pytest.param(
            '{"format": "socket_testbed model 2"}', "is of the format 'socket_testbed model 2'",
            id="a model",
        ),
        pytest.param('{"format": "socket_testbed survey 1"}', "prior", id="no prior"),
    ],
)  # fmt: skip
def test_other_files_are_refused(content: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "survey.json"
    path.write_text(content)
    with pytest.raises(ConfigurationError, match=r"is not a|is of the|prior") as refused:
        read_survey(path)
    assert expected in str(refused.value)


def test_another_socket_is_refused() -> None:
    moved = replace(GEOMETRY, anchors=GEOMETRY.anchors + 1e-3)
    with pytest.raises(ConfigurationError, match=r"t is of another socket \(79 tiles\) than the "):
        prior_by_hand(GEOMETRY).require("t", moved, "of t")


def test_a_trial_of_the_survey_is_refused() -> None:
    prior = prior_by_hand(GEOMETRY)
    prior.require("t", GEOMETRY, "of t")
    with pytest.raises(ConfigurationError, match=r"t is in the survey of a, b \(b\)"):
        prior.require("t", GEOMETRY, "of b")
