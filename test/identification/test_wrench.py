"""The wrench from the pose and its past: numbers by hand, an independent process, and files."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support import problems
from support.wording import refused

from socket_testbed.errors import ConfigurationError
from socket_testbed.identification import fit as fitting
from socket_testbed.identification import wrench
from socket_testbed.identification.model_file import read_model, write_model
from socket_testbed.settings.identification import IdentificationSettings

SECOND = 1_000_000_000  # [ns]
X = [0, 6, 12, 18]  # features of the first component: itself, both plays, less its mean


def along_x(*values):
    """Motions along x, shape (N, 6)."""
    return np.outer(values, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def trail_of(stamps, motions):
    """Features of the first component of each motion, shape (N, 4)."""
    times = np.round(np.asarray(stamps) * SECOND).astype(np.int64)
    return wrench.PoseTrail(np.ones(6)).add(times, motions)[:, X]


def test_a_trail_has_plays_and_a_mean():
    """Weights of the first sample: e^(-1/0.35) = 0.057433 and e^(-1/10) = 0.904837."""
    found = trail_of([5, 6], along_x(0.0, 2.0))
    assert found[0] == pytest.approx(0.0)
    # Means 2 / 1.057433 = 1.891373 and 2 / 1.904837 = 1.049958.
    assert found[1] == pytest.approx([2.0, 1.591373, 0.891373, 0.950042], abs=2e-6)


def test_a_play_keeps_its_place_within_the_backlash():
    """After long rests the recent mean is the motion itself."""
    found = trail_of([0, 20, 40, 60], along_x(0.0, 2.0, 1.5, -3.0))
    assert found[:, 1] == pytest.approx([0.0, 1.7, 1.7, -2.7], abs=1e-9)
    assert found[:, 2] == pytest.approx([0.0, 1.0, 1.0, -2.0], abs=1e-9)


@pytest.mark.parametrize(
    ("last", "forgets"), [(6.0, False), (6.1, True), (-1.0, True)], ids=["gap", "break", "back"]
)
def test_memory_ends_at_a_break(last, forgets):
    """Three usual steps are a gap, more are a break; so is a jump back in time."""
    found = trail_of([0, 1, 2, 3, last], along_x(0.0, 2.0, 4.0, 4.0, 1.0))[-1]
    alone = [1.0, 1.0, 1.0, 0.0]
    assert (found == pytest.approx(alone)) is forgets


def test_a_late_sample_keeps_the_memory():
    found = trail_of([0, 1, 2, 3, 2.5, 4], along_x(0.0, 2.0, 4.0, 4.0, 4.0, 4.0))
    assert found[-1, 3] > 0.5  # less than its mean would be 0 without a past


def test_samples_may_come_one_by_one(rng):
    """With a break, a late sample and two at the same time."""
    times = np.array([0, 1, 2, 3, 2.5, 4, 4, 30, 31]) * SECOND
    motions, scale = rng.normal(size=(9, 6)), np.array([1.0, 2.0, 0.5, 1.0, 1.0, np.inf])
    at_once = wrench.PoseTrail(scale).add(times.astype(np.int64), motions)
    trail, parts = wrench.PoseTrail(scale), np.split(np.arange(9), [1, 2, 2, 5])
    found = [trail.add(times[part].astype(np.int64), motions[part]) for part in parts]
    np.testing.assert_allclose(np.vstack(found), at_once, rtol=1e-12)


def test_a_long_trail_is_that_of_single_steps(rng):
    """Means and plays by their definitions, step by step; a rest of 100 s empties the memory."""
    count, rest = 700, 450
    times = 0.02 * np.arange(count) + 100.0 * (np.arange(count) >= rest)
    motions = 0.2 * np.cumsum(rng.normal(size=(count, 6)), axis=0)
    found = wrench.PoseTrail(np.ones(6)).add(np.round(times * SECOND).astype(np.int64), motions)
    for row in (0, 1, 140, rest - 1, rest, rest + 1, count - 1):
        first = rest if row >= rest else 0
        past = np.arange(first, row + 1)
        lasting = np.exp((times[past] - times[row]) / 10.0)
        mean = lasting @ motions[past] / lasting.sum()
        assert found[row, 18:] == pytest.approx(motions[row] - mean, abs=1e-9)
        for number, width in enumerate((0.3, 1.0)):
            at = motions[first].copy()
            for step in past:
                recent = np.exp((times[first : step + 1] - times[step]) / 0.35)
                pulled = recent @ motions[first : step + 1] / recent.sum()
                at = np.minimum(np.maximum(at, pulled - width), pulled + width)
            assert found[row, 6 + 6 * number : 12 + 6 * number] == pytest.approx(at, abs=1e-9)


def memory_of(support, left, **changes):
    """A process on standardised features with a length of 2 and a tenth of noise."""
    count = wrench.FEATURES
    made = wrench.MotionMemory(
        scale=np.ones(6),
        centre=np.zeros(count),
        spread=np.ones(count),
        support=np.asarray(support, float),
        left=np.asarray(left, float),
        length=2.0,
        noise=0.1,
        deviation=np.full(6, 2.0),
        widening=np.full(6, 1.5),
    )
    return replace(made, **changes)


def test_a_point_adds_nine_tenths_of_what_is_left():
    """At one support point 0.9 / (0.9 + 0.1), at two lengths e^-2 of it, far away nothing."""
    memory = memory_of(np.zeros((1, 24)), [[10.0] * 6])
    at = np.zeros((3, 24))
    at[:, 0] = [0.0, 4.0, 100.0]
    assert memory.mean(at)[:, 3] == pytest.approx([9.0, 9.0 * np.exp(-2.0), 0.0])
    # 2 * 1.5 of the share left: 1 - 0.9^2 = 0.19, 1 - (0.9 e^-2)^2, 1.
    expected = [3.0 * np.sqrt(0.19), 3.0 * np.sqrt(1.0 - 0.81 * np.exp(-4.0)), 3.0]
    assert memory.deviations(at)[:, 3] == pytest.approx(expected)


def test_the_process_is_that_of_the_book(rng):
    """Rasmussen & Williams, equations 2.25 and 2.26, sample by sample."""
    support, left = rng.normal(size=(20, 24)), rng.normal(size=(20, 6))
    memory, at = memory_of(support, left, length=4.0), rng.normal(size=(5, 24))

    def covariance(a, b):
        return 0.9 * np.exp(-np.sum((a - b) ** 2) / 32.0)

    K = np.array([[covariance(a, b) for b in support] for a in support]) + 0.1 * np.eye(20)
    for row, point in enumerate(at):
        k = np.array([covariance(point, b) for b in support])
        assert memory.mean(at)[row] == pytest.approx(k @ np.linalg.solve(K, left))
        variance = 1.0 - k @ np.linalg.solve(K, k)
        assert memory.deviations(at)[row] == pytest.approx(np.full(6, 3.0 * np.sqrt(variance)))


def sticking(count=240, memory=6.0, noise=0.05):
    """Samples at 4 Hz whose force sticks: a part follows a play of +-0.7 of the pose along x."""
    rng = np.random.default_rng(3)
    time = 0.25 * np.arange(count)
    pose = np.zeros((count, 6))
    for axis in range(6):
        pose[:, axis] = 0.05 * rng.normal(size=count)
    pose[:, 0] += np.sin(time / 2.0) + 0.5 * np.sin(time / 3.1)
    held, course = 0.0, []
    for x in pose[:, 0]:
        held = min(max(held, x - 0.7), x + 0.7)
        course.append(held)
    force = pose @ rng.normal(size=(6, 6)) + memory * np.outer(course, np.ones(6))
    force += noise * rng.normal(size=(count, 6)) + [0, 0, 0, 0, 0, -250.0]
    samples = problems.make_samples(1e-3 * pose, force, {"cluster_0": np.zeros((count, 3))})
    return replace(samples, stamps=250_000_000 * np.arange(count))


def test_memory_follows_what_sticks():
    samples = sticking()
    model, why = wrench.fit_wrench(samples[:160])
    assert model.name == "linear regression on the pose with memory of its past"
    assert why.startswith("on held-out blocks memory changes the error by -")
    unseen = slice(160, None)
    alone = replace(model, memory=None).predict(samples.pose)[unseen] - samples.wrench[unseen]
    missed = model.predict(samples.pose, samples.stamps)[unseen] - samples.wrench[unseen]
    assert np.sqrt((missed**2).mean()) < 0.7 * np.sqrt((alone**2).mean())
    sizes = np.abs(missed / model.deviations(samples.pose, samples.stamps)[unseen])
    assert (sizes < 1.96).mean() > 0.9


@pytest.mark.parametrize(
    ("ratio", "name", "why"),
    [
        (1.04, wrench.MEMORY, "on held-out blocks memory changes the error by +4 %"),
        (1.06, wrench.REGRESSION, "on held-out blocks memory changes the error by +6 %"),
    ],
    ids=["hardly worse", "worse"],
)
def test_a_memory_that_loses_is_not_used(ratio, name, why, monkeypatch):
    samples = sticking()

    def held_out(thinned, *_):
        missed = np.full((len(thinned), 6), 2.0)
        return missed, ratio * missed, 1.2 * np.ones_like(missed)

    monkeypatch.setattr(wrench, "_held_out", held_out)
    model, said = wrench.fit_wrench(samples)
    assert (model.name, said) == (name, why)
    assert model.deviation == pytest.approx(np.full(6, 2.0))
    if model.memory is not None:
        assert model.memory.widening == pytest.approx(np.full(6, 1.2))


def test_few_samples_have_no_memory():
    model, why = wrench.fit_wrench(sticking(39))
    assert model.memory is None
    assert why == "a memory of the past needs 40 samples, and there are 39"


def test_a_regression_states_its_deviation():
    samples = sticking(39)
    model, _ = wrench.fit_wrench(samples)
    pose = samples.pose[:2].copy()
    pose[1, 4] = np.nan
    found = model.deviations(pose)
    missed = model.predict(samples.pose) - samples.wrench
    assert found[0] == pytest.approx(missed.std(axis=0))
    assert np.isnan(found[1]).all() and np.isnan(model.predict(pose)[1]).all()


@pytest.mark.parametrize("missing", [False, True], ids=["whole", "with gaps"])
def test_sample_by_sample_is_as_at_once(missing):
    samples = sticking()
    model, _ = wrench.fit_wrench(samples)
    pose = samples.pose.copy()
    if missing:
        pose[[3, 50, 51, 100]] = np.nan
    together, trail = model.predict(pose, samples.stamps), model.trail()
    for row in range(len(samples)):
        one = slice(row, row + 1)
        found = model.predict(pose[one], samples.stamps[one], trail)
        np.testing.assert_allclose(found, together[one], rtol=1e-9)


def test_a_component_that_stands_still_does_not_matter():
    samples = sticking()
    still = replace(samples, rotation=np.tile([0.1, -0.2, 0.3], (len(samples), 1)))
    model, _ = wrench.fit_wrench(still)
    assert model.memory is not None and np.isinf(model.memory.scale[3:]).all()
    assert np.isfinite(model.predict(still.pose, still.stamps)).all()


@pytest.fixture(scope="module")
def fitted():
    """A socket and a fit whose wrench has a memory, with its samples."""
    rng = np.random.default_rng(8)
    geometry = problems.random_socket(rng)
    samples = sticking()
    forces = {name: rng.normal(size=(len(samples), 3)) for name in geometry.clusters}
    samples = replace(
        problems.make_samples(samples.pose, samples.wrench, forces), stamps=samples.stamps
    )
    # A hold's force hardly changes; this one does.
    samples.wrench[:, 3:] -= samples.wrench[:, 3:].mean(axis=0)
    fit = fitting.fit_contact_model(samples, geometry, IdentificationSettings())
    assert fit.model.of_wrench is not None and fit.model.of_wrench.memory is not None
    return geometry, samples, fit


def stored(fitted, path):
    """The document that the fit writes."""
    _, _, fit = fitted
    write_model(fit, path, {"name": "made up"})
    return json.loads(path.read_text())


def test_a_memory_comes_back_from_its_file(fitted, tmp_path):
    _, samples, fit = fitted
    path = tmp_path / "model.json"
    assert stored(fitted, path)["format"] == "socket_testbed model 2"
    model = read_model(path).model
    asked = samples.pose, samples.stamps
    np.testing.assert_array_equal(model.wrench(*asked), fit.model.wrench(*asked))
    deviations = [each.of_wrench.deviations(*asked) for each in (model, fit.model)]
    np.testing.assert_array_equal(*deviations)


def test_a_scale_of_what_stood_still_comes_back(fitted, tmp_path):
    path = tmp_path / "model.json"
    document = stored(fitted, path)
    document["parameters"]["of_wrench"]["memory"]["scale"][4] = None
    path.write_text(json.dumps(document))
    assert np.isinf(read_model(path).model.of_wrench.memory.scale).tolist() == [
        False, False, False, False, True, False
    ]  # fmt: skip


OLDER = {
    "variant": "rigid_bias",
    "sharpness": 20.0,
    "wrench_bias": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
    "force_bias": {},
    "clusters": [],
    "reference_pose": [0.0] * 6,
    "wrench_slope": [[0.0] * 6] * 3 + [[1000.0, 0.0, 0.0, 0.0, 0.0, 0.0]] * 3,
}


@pytest.mark.parametrize("stiff", [False, True], ids=["regression", "second bed"])
def test_older_predictors_are_read_or_named(stiff, fitted, tmp_path):
    path = tmp_path / "model.json"
    document = stored(fitted, path)
    tiles = len(fitted[0])
    rows = [[0.0, 0.0, 0.0]] * tiles
    older = OLDER | {"stiffness": rows, "rest_positions": rows}
    if stiff:
        older["stiffness"] = [[100.0, 0.0, 0.0]] * tiles
    document["format"] = "socket_testbed model 1"
    document["parameters"]["of_wrench"] = older
    document["settings"]["wrench_sharpness"] = [100.0, 20.0]
    path.write_text(json.dumps(document))
    if stiff:
        error = "the wrench is predicted by a second bed, as in an older version: fit the trial"
        with refused(ConfigurationError, str(path), error):
            read_model(path)
        return
    found = read_model(path).model.wrench(np.array([[2e-3, 0.0, 0.0, 0.0, 0.0, 0.0]]))
    assert found[0] == pytest.approx([1.0, 2.0, 3.0, 6.0, 7.0, 8.0])  # 1000 N/m over 2 mm


SPOILT = {
    "rows": (("left",), [[0.0] * 6], "left has 1 rows for 240 support points: fit the"),
    "features": (("centre",), [0.0], "centre"),
    "noise": (("noise",), 0.0, "noise is 0.0"),
    "unknown": (("colour",), 1.0, "colour"),
    "negative": (("deviation",), [-1.0] * 6, "deviation"),
}


@pytest.mark.parametrize(("place", "value", "error"), SPOILT.values(), ids=SPOILT)
def test_a_spoilt_memory_is_refused(fitted, tmp_path, place, value, error):
    path = tmp_path / "model.json"
    document = stored(fitted, path)
    document["parameters"]["of_wrench"]["memory"][place[0]] = value
    path.write_text(json.dumps(document))
    with refused(ConfigurationError, str(path), error):
        read_model(path)
