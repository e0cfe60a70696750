"""The fit, the loads it needs, and its wiring."""

import itertools

import numpy as np
from support.benches import FULL_SCALE, exact_bench, load_path, nominal, sensor_bench
from support.wording import refused

from socket_testbed.calibration.fit import (
    check_excitation,
    find_wiring,
    fit_cluster,
    fit_polynomials,
    predict_stress,
)
from socket_testbed.calibration.model import channel_features
from socket_testbed.errors import CalibrationError
from socket_testbed.samples import Status

ALL = np.ones(len(exact_bench()), dtype=bool)
WIRING = nominal().wiring


def test_the_coefficients_of_exact_data_are_recovered():
    rng = np.random.default_rng(2)
    near = rng.uniform(5.0, 9.0, (200, 4))
    # Differences of 5 +- 0.1 pF make the columns nearly parallel.
    far = rng.uniform(-0.1, 0.1, (500, 4)) + np.array([5.0, 10.0, 5.0, 10.0])
    for name, channels, rtol in (("brim_lateral", near, 1e-9), ("distal", far, 1e-6)):
        cluster = nominal(name)
        stress = predict_stress(cluster, channels[:, np.argsort(cluster.wiring)])
        normal, shear = fit_polynomials(channels, stress)
        np.testing.assert_allclose(normal, cluster.normal, rtol=rtol)
        np.testing.assert_allclose(shear, cluster.shear, rtol=rtol)
    bench = exact_bench()
    with refused(CalibrationError, "always go together", "input of its own"):
        fit_polynomials(bench.capacitance[:, [0, 0, 2, 2]], bench.stress)


def test_the_residual_is_orthogonal_to_every_term():
    bench = sensor_bench(play=0.05)
    found = fit_cluster(bench.capacitance, bench.stress, WIRING, ALL)
    residual = (predict_stress(found, bench.capacitance) - bench.stress) / FULL_SCALE
    mean, x, y = channel_features(bench.capacitance[:, WIRING])
    for term, axes in ((mean, [0]), (x, [1, 2]), (y, [1, 2]), (x * y, [1, 2]), (x * x, [1, 2])):
        correlation = term @ residual[:, axes] / np.linalg.norm(term)
        np.testing.assert_allclose(correlation, 0.0, atol=1e-10 * len(bench))
    np.testing.assert_allclose(residual.mean(axis=0), 0.0, atol=1e-12)


def test_the_range_is_that_of_both_differences():
    bench = exact_bench()
    mean, x, y = channel_features(bench.capacitance[:, WIRING])
    found = fit_cluster(bench.capacitance, bench.stress, WIRING, ALL)
    np.testing.assert_array_equal(found.mean_range, [mean.min(), mean.max()])
    both = [max(x.min(), y.min()), min(x.max(), y.max())]
    np.testing.assert_array_equal(found.difference_range, both)
    some = mean < np.median(mean)
    narrow = fit_cluster(bench.capacitance, bench.stress, WIRING, some)
    assert narrow.mean_range[1] == mean[some].max()
    np.testing.assert_array_equal(narrow.normal, found.normal)
    _, status = narrow.apply(bench.capacitance, np.zeros(bench.capacitance.shape, dtype=np.uint8))
    assert (status[~some] == Status.OUT_OF_RANGE).all()


def with_column(axis: int, values: np.ndarray) -> np.ndarray:
    stress = load_path()
    stress[:, axis] = values
    return stress


def test_the_stress_that_is_missing_is_named():
    ramp = np.concatenate([np.linspace(0.0, 1.0, 25), np.linspace(1.0, 0.0, 25)])
    directions = [[1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
    crossed = np.concatenate([np.outer(ramp, FULL_SCALE * direction) for direction in directions])
    noise = np.random.default_rng(5).normal(0.0, 0.005, (250, 3)) * FULL_SCALE
    path = load_path()
    for stress, *named in (
        (path[:29], "29 readings are too few", "several"),
        (with_column(0, 5e3), "normal spans only 0 Pa", "apply normal"),
        (path / 1e3, "normal spans only 60 Pa", "--units normal=UNIT"),
        (with_column(0, path[:, 1] * 2 + 30e3), "normal always goes with", "stay as"),
        (with_column(2, 0.5 * path[:, 1]), "shear_x always goes with", "stay as"),
        (with_column(1, (path[:, 1] > 1e3) * 1e4), "shear_x takes too few values", "three"),
        (crossed + noise, "shear_x and shear_y are never applied together", "together"),
    ):
        with refused(CalibrationError, "bench.csv: ", *named):
            check_excitation(stress, "bench.csv")
    check_excitation(with_column(1, np.sign(path[:, 1]) * 1e4), "bench.csv")
    path[40] = [2e6, -9e5, 9e5]  # a spike
    check_excitation(path, "bench.csv")


def test_every_wiring_is_found():
    channels = sensor_bench(play=0.05).capacitance[:, WIRING]
    channels[7, 2] += 30.0
    for wiring in itertools.permutations(range(4)):
        assert tuple(find_wiring(channels[:, np.argsort(wiring)], load_path())) == wiring
