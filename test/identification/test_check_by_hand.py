"""Parts of the data check, by hand, and its limits a little below and above."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from support import scene
from support.problems import make_samples

from socket_testbed.identification import channel_check, courses, sudden_changes
from socket_testbed.identification import correlation as correlations
from socket_testbed.identification.checked import CheckedSamples
from socket_testbed.identification.correlation import (
    best_lag,
    clear_lag,
    correlation,
    drift_of,
    explained_share,
)
from socket_testbed.identification.data_check import check_data
from socket_testbed.identification.data_finding import DataFinding
from socket_testbed.samples import Samples, Status

NAN = float("nan")
GEOMETRY = scene.geometry()
COUNT = 96
FX, FZ = 3, 5


def scene_samples() -> Samples:
    limb, tiles = scene.limb(), [*GEOMETRY.clusters.values()]
    forces = scene.forces_in_tiles(scene.STAMPS)[:, tiles].swapaxes(0, 1)
    pose = np.hstack([limb.translation, limb.rotation_vector()])
    return make_samples(pose, scene.wrench(), dict(zip(GEOMETRY.clusters, forces, strict=True)))


def facts(samples: Samples, **more: object) -> list[tuple[str, str]]:
    return [(f.source, f.fact) for f in check_data(samples, GEOMETRY, **more)]


def test_a_finding_says_where_to_look() -> None:
    assert (
        str(DataFinding("Mz", "it is still", "check it")) == "data: check Mz: it is still; check it"
    )


def test_the_gate_s_noise_is_judged() -> None:
    checked = CheckedSamples(scene_samples(), GEOMETRY)
    found = checked.noise
    wrench = np.where(np.arange(6) == FX, 25.0, found.wrench)
    vars(checked)["noise"] = replace(found, wrench=wrench)
    assert ("Fx", "its noise is 25 N") in [(each.source, each.fact) for each in checked.findings]


# --- series


def test_missing_values_are_interpolated() -> None:
    course, time = np.array([NAN, 1.0, NAN, 3.0, NAN]), np.array([0.0, 1.0, 1.5, 3.0, 9.0])
    assert courses._filled(course, time).tolist() == [1.0, 1.0, 1.5, 3.0, 3.0]
    assert courses._filled(course[:1], time[:1]).tolist() == [0.0]


def test_correlation_needs_30_values() -> None:
    line = np.arange(40.0)
    assert correlation(line, 3.0 - 2.0 * line) == pytest.approx(-1.0)
    assert correlation(line, 0.0 * line) == 0.0
    known = np.where(line < 30, line, NAN)
    assert correlation(known, line) == pytest.approx(1.0)
    assert np.isnan(correlation(np.where(line < 29, line, NAN), line))


def test_correlation_is_that_of_numpy(rng) -> None:
    one, other = rng.normal(size=(2, 50)) + [[1.0], [5.0]]
    expected = np.corrcoef(one, other)[0, 1]
    assert correlation(one, other) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("way", "expected"),
    [
        pytest.param((3.0, 0.0, -4.0), 0.8, id="4 of 5 downwards"),
        pytest.param((1.0, 0.0, 0.0), 0.0, id="sideways"),
        pytest.param((0.0, 0.0, 2.0), -1.0, id="upwards"),
        pytest.param((NAN, NAN, NAN), 1.0, id="unknown"),
    ],
)
def test_sinking_is_a_cosine(way: tuple[float, ...], expected: float) -> None:
    """Of the motion under a rising load, downwards."""
    load = np.arange(40.0)
    found = courses._along(np.outer(load, way), load, np.array([0.0, 0.0, 1.0]))
    assert found == pytest.approx(expected, abs=1e-9)


def test_explained_is_a_share_of_variance() -> None:
    """A line plus a wave of the same variance that is orthogonal to it."""
    wave = np.sin(2.0 * np.pi * np.arange(64) / 64)
    other = np.cos(2.0 * np.pi * np.arange(64) / 64)
    assert explained_share(wave + other + 9.0, wave[:, None]) == pytest.approx(0.5)
    assert explained_share(wave, np.column_stack([wave, other])) == pytest.approx(1.0)
    assert explained_share(np.ones(64), wave[:, None]) == 0.0
    assert explained_share(wave[:29], wave[:29, None]) == 0.0


_STEPS = np.random.default_rng(0).normal(size=500)
WAVE = np.convolve(_STEPS, np.ones(15) / 15, "same")  # what is 15 samples apart is independent
LAGS = {
    # samples by which the course is late, period [s], lag [s]
    "none": (0, 0.25, 0.0),
    "late": (8, 0.25, 2.0),
    "early": (-8, 0.25, -2.0),
    "10 s": (40, 0.25, 10.0),
    "beyond what is searched": (56, 0.25, 0.0),
    "in steps of 40 ms": (40, 0.02, 0.8),
}


@pytest.mark.parametrize("case", LAGS)
def test_a_lag_is_of_the_course(case: str) -> None:
    shift, period, lag = LAGS[case]
    course = np.roll(WAVE, shift)[50:-50]
    assert clear_lag(WAVE[50:-50], course, period) == pytest.approx(lag)


def _with_gaps(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    values = rng.normal(size=shape).cumsum(axis=0)
    values[rng.random(shape) < 0.1] = NAN
    return values


@pytest.mark.parametrize("shape", [(90,), (90, 2)], ids=["series", "vectors"])
def test_the_best_lag_is_that_of_numpy(shape: tuple[int, ...], rng: np.random.Generator) -> None:
    """With values missing, against `correlation` of the shifted series, at 4 Hz."""
    reference, course = 7.0 + _with_gaps(rng, shape), _with_gaps(rng, shape)
    found = {
        lag: correlation(
            course[max(lag, 0) : 90 + min(lag, 0)].ravel(),
            reference[max(-lag, 0) : 90 - max(lag, 0)].ravel(),
        )
        for lag in range(-30, 31)
    }
    best = max(found, key=lambda lag: found[lag])
    expected = (0.25 * best, found[best], found[0])
    assert best_lag(reference, course, 0.25) == pytest.approx(expected, abs=1e-12)


def test_a_course_that_stands_still_has_no_lag() -> None:
    """From 20 samples on only what stands still is compared, whose spread is rounding."""
    course = np.full(90, 0.1)
    course[:20] += WAVE[:20]
    found = correlations._correlations(course, WAVE[:90], 30)
    assert all((found[lag] == 0.0) is (lag >= 20) for lag in found)


def test_drifts_are_of_each_course(rng: np.random.Generator) -> None:
    """2 and -3 over the trial, beside a cause, where courses lack different values or none."""
    time, cause = np.arange(80.0), rng.normal(size=(80, 1))
    courses = np.outer(time / time[-1], [2.0, -3.0]) + 5.0 * cause
    assert drift_of(courses, cause, time) == pytest.approx([2.0, -3.0])
    courses[:60, 0] = NAN  # 20 values are too few
    courses[3, 1] = NAN
    assert drift_of(courses, cause, time) == pytest.approx([0.0, -3.0])


def test_an_unclear_lag_is_none(rng) -> None:
    """A correlation of 0.5 at most, or a gain of 0.03 at most."""
    noise = rng.normal(size=100)
    assert clear_lag(WAVE[:100], noise, 0.25) == 0.0
    line = np.arange(100.0)
    assert clear_lag(line, line, 0.25) == 0.0


def test_a_reversed_course_is_not_late() -> None:
    """Half a period later a wave fits as well as reversed at once."""
    wave = np.sin(2.0 * np.pi * np.arange(120) / 40)
    noise = 0.05 * np.random.default_rng(0).normal(size=120)
    assert clear_lag(wave, -wave + noise, 0.25) == 0.0


@pytest.mark.parametrize(
    ("values", "longest"),
    [([1.0, 1.0, 2.0, 2.0, 2.0], 3), ([5.0], 1), ([1.0, 2.0, 1.0], 1), ([4.0] * 4 + [1.0], 4)],
    ids=["end", "one", "none", "start"],
)
def test_runs_are_of_equal_values(values: list[float], longest: int) -> None:
    assert channel_check._longest_run(np.array(values)) == longest


def test_a_kink_is_a_step_beyond_its_neighbours() -> None:
    """On a line of 2 per sample, a step of 10 more; slopes and gaps are none."""
    line = 2.0 * np.arange(40.0)[:, None] + [[0.0, 5.0]]
    line[:, 0] += np.where(np.arange(40) >= 20, 10.0, 0.0)
    regular = np.ones(39, dtype=bool)
    sizes, _ = sudden_changes._kinks(line, regular, np.zeros(2))
    assert np.flatnonzero(sizes[:, 0]).tolist() == [20] and sizes[20, 0] == pytest.approx(10.0)
    assert not sizes[:, 1].any()
    regular[19] = False
    assert not sudden_changes._kinks(line, regular, np.zeros(2))[0].any()


def test_a_spike_is_no_step() -> None:
    values = np.zeros((40, 1))
    values[20] = 10.0
    assert not sudden_changes._kinks(values, np.ones(39, dtype=bool), np.zeros(1))[0].any()


# --- limits


def put(name: str, value: object, *place: object) -> Callable[[Samples], Samples]:
    def change(samples: Samples) -> Samples:
        values = getattr(samples, name).copy()
        values[place] = value
        return replace(samples, **{name: values})

    return change


def scaled(name: str, factor: float, *place: object) -> Callable[[Samples], Samples]:
    def change(samples: Samples) -> Samples:
        values = getattr(samples, name).copy()
        values[place] = factor * values[place]
        return replace(samples, **{name: values})

    return change


def noisy(size: float, column: int) -> Callable[[Samples], Samples]:
    def change(samples: Samples) -> Samples:
        wrench = samples.wrench.copy()
        wrench[:, column] += np.random.default_rng(0).normal(0.0, size, COUNT)
        return replace(samples, wrench=wrench)

    return change


def rolled(seconds: float) -> Callable[[Samples], Samples]:
    """The limb later by so many seconds; its course goes around without a step."""
    shift = round(4 * seconds)

    def change(samples: Samples) -> Samples:
        return replace(
            samples,
            position=np.roll(samples.position, shift, axis=0),
            rotation=np.roll(samples.rotation, shift, axis=0),
        )

    return change


ALL = slice(None)
LIMITS: dict[str, tuple[Callable[[Samples], Samples], list[tuple[str, str]]]] = {
    # 5 % of 96 samples are 4.8
    "4 poses missing": (put("position", NAN, slice(40, 44)), []),
    "5 poses missing": (
        put("position", NAN, slice(40, 45)),
        [("the limb pose", "5 % of its samples are missing or out of range")],
    ),
    "5 moments missing": (
        put("wrench", NAN, slice(40, 45), 0),
        [("the wrench", "5 % of its samples are missing or out of range")],
    ),
    "no Mz": (
        put("wrench", NAN, ALL, 2),
        [("Mz", "100 % of its samples are missing or out of range")],
    ),
    # 2 s are 8 samples
    "still for 2 s": (put("wrench", 0.5, slice(40, 48), 2), []),
    "still for 2.25 s": (
        put("wrench", 0.5, slice(40, 49), 2),
        [("Mz", "it does not change for 2.2 s")],
    ),
    "pose still for 2 s": (put("position", 0.145, slice(40, 48), 2), []),
    "pose still for 2.25 s": (
        put("position", 0.145, slice(40, 49), 2),
        [("the limb pose", "it stands still")],
    ),
    "4 clipped": (put("wrench", 1.9, slice(0, 96, 24), 2), []),
    "5 clipped": (
        put("wrench", 1.9, slice(0, 96, 20), 2),
        [("Mz", "5 % of its values are at one end, 1.9 N m")],
    ),
    "noise of 16 N": (noisy(16.0, FX), []),
    "noise of 26 N": (noisy(26.0, FX), [("Fx", "its noise is 2")]),
    "noise of 2.5 N m": (noisy(2.5, 2), []),
    "noise of 3.5 N m": (noisy(3.5, 2), [("Mz", "its noise is 3")]),
    # Beside the load, the limb follows the moments at once: 1.5 samples are 0.375 s.
    "late by 0.25 s": (rolled(0.25), []),
    "late by 0.5 s": (
        rolled(0.5),
        [("the limb pose", "late by 0.5 s against the moments of the load cell")],
    ),
    "early by 0.5 s": (
        rolled(-0.5),
        [("the limb pose", "early by 0.5 s against the moments of the load cell")],
    ),
    # Without moments only the load shows a delay.
    "moments gone, late by 3.25 s": (
        lambda s: put("wrench", 0.0, ALL, slice(0, 3))(rolled(3.25)(s)),
        [(name, "it does not change for 24.0 s") for name in ("Mx", "My", "Mz")],
    ),
    "late by 3.75 s": (rolled(3.75), [("the limb pose", "late by 3.8 s against the load cell")]),
    "early by 3.75 s": (
        rolled(-3.75),
        [("the limb pose", "early by 3.8 s against the load cell")],
    ),
}


@pytest.mark.parametrize("case", LIMITS)
def test_a_limit_is_where_it_is_stated(case: str) -> None:
    change, expected = LIMITS[case]
    found = facts(change(scene_samples()))
    assert [source for source, _ in found] == [source for source, _ in expected], found
    assert all(part in fact for (_, fact), (_, part) in zip(found, expected, strict=True)), found


def test_30_samples_are_enough() -> None:
    samples = scene_samples()
    assert facts(samples[:29]) == [("the trial", "29 samples are too few to judge it")]
    assert "the trial" not in [source for source, _ in facts(samples[:30])]


@pytest.mark.parametrize(
    ("mass", "found"),
    # 91.3 N: 95 % of the samples have less
    [(77.0, False), (78.0, True), (1.87, False), (1.85, True)],
    ids=["light", "too light", "heavy", "too heavy"],
)
def test_weights_are_between_limits(mass: float, found: bool) -> None:
    """0.12 weights of 77.6 kg, 5 of 1.86 kg."""
    assert bool(facts(scene_samples(), mass=mass)) is found


def test_a_left_out_channel_is_not_checked() -> None:
    spoiled = put("wrench", 0.5, slice(40, 60), 2)(scene_samples())
    assert facts(spoiled) and not facts(spoiled, leave_out=("Mz",))


def test_a_window_is_not_compared_over_time() -> None:
    negated = replace(scene_samples(), wrench=-scene_samples().wrench)
    late = rolled(5.0)(scene_samples())
    assert facts(negated) and facts(late) and not facts(late, whole=False)


def test_lost_time_is_a_share() -> None:
    """5 % of 23.75 s are 1.19 s: four samples lose 1 s, five 1.25 s."""
    samples = scene_samples()
    few, many = (samples[np.r_[0:40, 40 + lost : COUNT]] for lost in (4, 5))
    assert facts(few) == []
    assert facts(many) == [("the trigger", "5 % of the time has no sample")]


def test_a_cluster_is_compared_in_kilopascal() -> None:
    """`distal` reads 14 kPa in the mean, and 61 kPa with the gain spoiled."""
    spoiled = scaled("local_forces", 4.4, ALL, 3, 2)(scene_samples())
    ((source, fact),) = facts(spoiled)
    assert source == "distal" and fact.startswith("it reads 61 kPa") and fact.endswith(" kPa")
    low, high = fact.split(" say ")[1][:-4].split(" to ")
    assert float(low) < 14.0 < float(high) < 50.0


@pytest.mark.parametrize(
    ("status", "found"), [(Status.OUT_OF_RANGE, True), (Status.MISSING, True), (Status.OK, False)]
)
def test_untrusted_clusters_are_named(status: Status, found: bool) -> None:
    spoiled = put("status", status, slice(30, 40), 1)(scene_samples())
    expected = [("mid_anterior", "10 % of its samples are missing or out of range")]
    assert facts(spoiled) == expected * found


def turned_limb(samples: Samples) -> Samples:
    rotation = samples.rotation.copy()
    rotation[:, 2] = np.where(np.arange(COUNT) % 2, 0.8, -0.8)
    return replace(samples, rotation=rotation)


HINTS: dict[str, tuple[Callable[[Samples], Samples], str, str]] = {
    # change, source, hint
    "few": (lambda s: s[:29], "the trial", "record 30 or more"),
    "lost": (
        lambda s: s[np.r_[0:40, 52:COUNT]],
        "the trigger",
        "see 'info' for the gaps, and the trigger's rate",
    ),
    "missing": (
        put("position", NAN, slice(40, 52)),
        "the limb pose",
        "see 'info' for the gaps, and 'doctor' for the wiring",
    ),
    "still pose": (
        put("position", 0.145, slice(30, 60)),
        "the limb pose",
        "check the cameras and the bodies' names",
    ),
    "still": (put("wrench", 0.5, slice(40, 60), 2), "Mz", "check the sensor and its driver"),
    "clipped": (
        put("wrench", 1.9, slice(0, 96, 8), 2),
        "Mz",
        "check the sensor's range: it is clipped",
    ),
    "noisy": (noisy(40.0, FX), "Fx", "check shields, connectors and the supply"),
    "spike": (put("wrench", 4e3, 44, FX), "single values", "check cables and connectors"),
    "late": (rolled(5.0), "the limb pose", "check the clocks and the delays of the sources"),
    "negated": (
        lambda s: replace(s, wrench=-s.wrench),
        "the wrench",
        "check the sign of the load cell's channels",
    ),
    "weak clusters": (
        scaled("local_forces", 1e-4, ALL),
        "the clusters",
        "check that stresses are in Pa and forces in N, and the calibration",
    ),
    "strong clusters": (
        scaled("local_forces", 2.1, ALL, ALL, 2),
        "the wrench",
        "check that forces are in N (kgf, kN?) and stresses in Pa, the load cell's channels, and"
        " the calibration",
    ),
    "sideways": (
        lambda s: replace(s, position=s.position[:, [2, 1, 0]]),
        "the limb pose",
        "check the axes and the registration of the marker bodies",
    ),
    "turned": (
        turned_limb,
        "the limb pose",
        "check the order of the quaternion (x, y, z, w), and the marker bodies",
    ),
    "disagreeing": (
        scaled("local_forces", 4.4, ALL, 3, 2),
        "distal",
        "check its calibration and its place, and whether clusters are exchanged",
    ),
    "reversed": (
        lambda s: put("local_forces", -72.0 - s.local_forces[:, 1, 2], ALL, 1, 2)(s),
        "mid_anterior",
        "check the sign of its normal channel, or whether clusters are exchanged",
    ),
    "pull": (
        put("local_forces", 45.0, ALL, 3, 2),
        "distal",
        "check its calibration, or leave it out (--leave-out distal.Fz)",
    ),
    "lever": (
        put("wrench", 80.0, ALL, 0),
        "the wrench",
        "check that moments are in N m and forces in N, and the load cell's channels",
    ),
}


@pytest.mark.parametrize("case", HINTS)
def test_a_finding_says_what_to_check(case: str) -> None:
    change, source, hint = HINTS[case]
    found = check_data(change(scene_samples()), GEOMETRY)
    assert (source, hint) in [(each.source, each.hint) for each in found], found


def test_a_mass_is_checked_with_the_force() -> None:
    (found,) = check_data(scene_samples(), GEOMETRY, mass=1e3)
    assert found.hint == "check that forces are in N (kgf, kN?), and the mass"
