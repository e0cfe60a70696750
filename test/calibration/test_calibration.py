"""Capacitance to stress, and the file of its coefficients."""

import numpy as np
import pytest
import yaml
from support.damage import changed
from support.wording import refused

from socket_testbed.calibration.model import (
    Calibration,
    ClusterCalibration,
    channel_features,
    read_calibration,
    write_calibration,
)
from socket_testbed.errors import CalibrationError, ConfigurationError
from socket_testbed.samples import Status

ALL_OK = np.zeros(4, dtype=np.uint8)
# Where the four channels lie in the cluster's frame.
PLACES = np.array([[-1.0, 1.0], [1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


def make_cluster(**changes) -> ClusterCalibration:
    values = {
        "normal": np.array([-20_000.0, 4_000.0]),
        "shear": np.array(
            [[100.0, 3_000.0, 50.0, 7.0, 11.0, -3.0], [-200.0, -40.0, 2_500.0, 2.0, -5.0, 13.0]]
        ),
        "mean_range": np.array([4.0, 12.0]),
        "difference_range": np.array([-3.0, 3.0]),
        "wiring": np.arange(4),
    }
    return ClusterCalibration(**(values | changes))


def make_capacitance(mean: float, along_x: float, along_y: float) -> np.ndarray:
    """Four channels whose plane has a mean and pair differences [pF]."""
    return mean + 0.5 * PLACES @ np.array([along_x, along_y])


@pytest.mark.parametrize("seed", range(3))
def test_normal_stress_is_the_line_over_the_mean(seed):
    rng = np.random.default_rng(seed)
    cluster = make_cluster()
    capacitance = rng.uniform(7.0, 9.0, (10, 4))
    stress, status = cluster.apply(capacitance, np.zeros((10, 4), dtype=np.uint8))
    line = np.polynomial.Polynomial(cluster.normal)
    np.testing.assert_allclose(stress[:, 0], line(capacitance.mean(axis=1)), rtol=1e-12)
    assert (status == Status.OK).all()


@pytest.mark.parametrize(("along_x", "along_y"), [(0.0, 0.0), (2.0, 0.0), (0.0, -1.5), (1.2, 2.4)])
def test_shear_stress_is_the_surface_over_the_pair_differences(along_x, along_y):
    cluster = make_cluster()
    stress, _ = cluster.apply(make_capacitance(8.0, along_x, along_y), ALL_OK)
    for axis in range(2):
        one, x, y, xx, xy, yy = cluster.shear[axis]
        table = [[one, y, yy], [x, xy, 0.0], [xx, 0.0, 0.0]]  # [power of dx][power of dy]
        surface = np.polynomial.polynomial.polyval2d(along_x, along_y, table)
        assert stress[1 + axis] == pytest.approx(surface, rel=1e-12)


@pytest.mark.parametrize("channel", range(4))
def test_a_channel_pulls_the_differences_to_its_own_side(channel):
    capacitance = np.full(4, 8.0)
    capacitance[channel] += 1.0
    mean, along_x, along_y = channel_features(capacitance)
    assert mean == pytest.approx(8.25)
    assert (np.sign(along_x), np.sign(along_y)) == tuple(PLACES[channel])
    assert abs(along_x) == pytest.approx(abs(along_y))


def test_a_common_change_makes_no_difference():
    _, along_x, along_y = channel_features(np.full((3, 4), 8.0) + np.arange(3.0)[:, None])
    np.testing.assert_array_equal([along_x, along_y], 0.0)


@pytest.mark.parametrize("wiring", [[0, 1, 2, 3], [3, 1, 0, 2], [1, 2, 3, 0]])
def test_wiring_names_the_input_of_each_channel(wiring):
    channels = make_capacitance(8.0, 1.3, -0.7)
    inputs = np.empty(4)
    inputs[wiring] = channels  # channel c is wired to input wiring[c]
    expected, _ = make_cluster().apply(channels, ALL_OK)
    found, _ = make_cluster(wiring=np.array(wiring)).apply(inputs, ALL_OK)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_any_batch_gives_what_its_single_readings_give(shape):
    rng = np.random.default_rng(4)
    cluster = make_cluster(wiring=np.array([2, 0, 3, 1]))
    capacitance = rng.uniform(3.0, 13.0, (*shape, 4))
    status = rng.choice(np.array([0, 0, 0, 0, 1, 2], dtype=np.uint8), (*shape, 4))
    stress, result = cluster.apply(capacitance, status)
    assert stress.shape == (*shape, 3)
    assert result.shape == shape
    for index in np.ndindex(shape):
        alone, alone_status = cluster.apply(capacitance[index], status[index])
        np.testing.assert_allclose(stress[index], alone, rtol=1e-12)
        assert result[index] == alone_status


def test_stacked_clusters_give_what_each_gives_alone():
    rng = np.random.default_rng(5)
    clusters = {
        name: make_cluster(
            normal=np.array([rng.normal(), rng.uniform(1e3, 5e3)]),
            shear=rng.normal(size=(2, 6)),
            mean_range=np.array([rng.uniform(4.0, 6.0), 11.0]),
            difference_range=np.array([-4.0, rng.uniform(1.0, 4.0)]),
            wiring=rng.permutation(4),
        )
        for name in "abc"
    }
    calibration = Calibration(clusters, "2026-01-01", "made up")
    capacitance = rng.uniform(3.0, 13.0, (90, 3, 4))
    capacitance[::5, 1, 2] = np.inf
    status = rng.choice(np.array([0, 0, 0, 0, 1, 2], dtype=np.uint8), capacitance.shape)
    stress, result = calibration.stacked("cab").apply(capacitance, status)
    assert set(result.ravel().tolist()) == {0, 1, 2, 3}
    for column, name in enumerate("cab"):
        alone, own = clusters[name].apply(capacitance[:, column], status[:, column])
        np.testing.assert_allclose(stress[:, column], alone, rtol=1e-12)
        np.testing.assert_array_equal(result[:, column], own)


@pytest.mark.parametrize(
    ("statuses", "values", "expected"),
    [
        ((0, 0, 0, 0), (8.0, 8.0, 8.0, 8.0), Status.OK),
        ((0, 0, 0, 0), (20.0, 20.0, 20.0, 20.0), Status.OUT_OF_RANGE),
        ((1, 0, 0, 0), (20.0, 20.0, 20.0, 20.0), Status.SATURATED),
        ((1, 0, 0, 0), (np.nan, 8.0, 8.0, 8.0), Status.SATURATED),
        ((0, 2, 0, 0), (8.0, np.nan, 8.0, 8.0), Status.MISSING),
        ((0, 2, 0, 0), (8.0, 8.0, 8.0, 8.0), Status.MISSING),
        ((1, 2, 0, 0), (8.0, np.nan, 8.0, 8.0), Status.MISSING),
        ((0, 2, 0, 0), (20.0, np.nan, 20.0, 20.0), Status.MISSING),
        ((0, 0, 0, 0), (8.0, 8.0, np.nan, 8.0), Status.MISSING),
        ((0, 0, 0, 0), (np.nan,) * 4, Status.MISSING),
    ],
)
def test_the_worst_status_wins_and_only_a_full_reading_gives_a_stress(statuses, values, expected):
    stress, status = make_cluster().apply(np.array(values), np.array(statuses, dtype=np.uint8))
    assert status == expected
    usable = expected in (Status.OK, Status.OUT_OF_RANGE)
    assert np.isfinite(stress).all() == usable
    assert np.isnan(stress).all() != usable


@pytest.mark.parametrize("value", [np.inf, -np.inf])
@pytest.mark.parametrize("channels", [[0], [0, 1], [0, 1, 2, 3]])
def test_an_infinite_capacitance_is_missing(value, channels):
    capacitance = np.full(4, 8.0)
    capacitance[channels] = value
    stress, status = make_cluster().apply(capacitance, ALL_OK)
    assert status == Status.MISSING
    assert np.isnan(stress).all()


def test_one_missing_input_is_missing_whatever_the_wiring():
    cluster = make_cluster(wiring=np.array([3, 2, 1, 0]))
    for channel in range(4):
        status = ALL_OK.copy()
        status[channel] = Status.MISSING
        assert cluster.apply(np.full(4, 8.0), status)[1] == Status.MISSING


@pytest.mark.parametrize(
    ("mean", "along_x", "along_y", "inside"),
    [
        (4.0, 0.0, 0.0, True),
        (12.0, 0.0, 0.0, True),
        (3.99, 0.0, 0.0, False),
        (12.01, 0.0, 0.0, False),
        (8.0, 3.0, -3.0, True),
        (8.0, 3.01, 0.0, False),
        (8.0, -3.01, 0.0, False),
        (8.0, 0.0, 3.01, False),
        (8.0, 0.0, -3.01, False),
    ],
)
def test_ranges_include_their_ends(mean, along_x, along_y, inside):
    stress, status = make_cluster().apply(make_capacitance(mean, along_x, along_y), ALL_OK)
    assert status == (Status.OK if inside else Status.OUT_OF_RANGE)
    assert np.isfinite(stress).all()  # an extrapolation is marked, not hidden


def test_apply_does_not_change_its_arguments():
    capacitance, status = np.array([8.0, np.nan, 8.0, 8.0]), ALL_OK.copy()
    before = capacitance.copy()
    make_cluster().apply(capacitance, status)
    np.testing.assert_array_equal(capacitance, before)
    np.testing.assert_array_equal(status, ALL_OK)


@pytest.fixture
def calibration():
    clusters = {"distal": make_cluster(), "brim": make_cluster(wiring=np.array([2, 0, 3, 1]))}
    return Calibration(clusters, "2026-05-04", "bench run 7")


def test_a_file_gives_back_what_was_written(calibration, tmp_path):
    path = tmp_path / "calibration.yaml"
    write_calibration(calibration, path)
    found = read_calibration(path)
    assert (found.date, found.source) == (calibration.date, calibration.source)
    assert list(found.clusters) == list(calibration.clusters)
    for name, cluster in calibration.clusters.items():
        for field in ("normal", "shear", "mean_range", "difference_range", "wiring"):
            np.testing.assert_array_equal(
                getattr(found.clusters[name], field), getattr(cluster, field)
            )


def test_an_unquoted_date_is_a_date(calibration, tmp_path):
    path = tmp_path / "calibration.yaml"
    write_calibration(calibration, path)
    path.write_text(path.read_text().replace("'2026-05-04'", "2026-05-04"))
    assert read_calibration(path).date == "2026-05-04"


@pytest.mark.parametrize(
    ("key", "value", "error"),
    [
        ("normall", [0.0, 1.0], "brim: unknown key 'normall': did you mean 'normal'"),
        ("normal", [0.0, 1.0], "the gain of normal is 1 Pa/pF: give [offset in Pa, gain"),
        ("normal", [0.0, -2e4], "the gain of normal is -20000 Pa/pF"),
        ("mean_range", [4.0, 4.0], "mean_range is [4, 4]: give [low, high] in pF"),
        ("difference_range", [3.0, -3.0], "difference_range is [3, -3]: give [low, high]"),
        ("wiring", [0, 1, 1, 3], "wiring is [0.0, 1.0, 1.0, 3.0]: give each of 0, 1, 2, 3 once"),
    ],
)
def test_coefficients_that_cannot_be_are_refused(calibration, tmp_path, key, value, error):
    document = changed(calibration.to_document(), ("clusters", "brim", key), value)
    path = tmp_path / "calibration.yaml"
    path.write_text(yaml.safe_dump(document))
    with refused(ConfigurationError, f"{path}: clusters: brim", error):
        read_calibration(path)


def test_a_lacking_cluster_is_named(calibration):
    calibration.require(("brim", "distal"), "the trial")
    with pytest.raises(
        CalibrationError, match=r"no cluster mid of the trial \(it has distal, brim"
    ):
        calibration.require(("brim", "mid"), "the trial")
