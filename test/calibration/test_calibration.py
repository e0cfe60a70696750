"""Capacitance to stress, and the file of its coefficients."""

import dataclasses

import numpy as np
import pytest
import yaml
from support.damage import changed
from support.wording import refused

from socket_testbed.calibration import model
from socket_testbed.errors import CalibrationError, ConfigurationError
from socket_testbed.samples import Status

ALL_OK = np.zeros(4, dtype=np.uint8)
# Where the four channels lie in the cluster's frame.
PLACES = np.array([[-1.0, 1.0], [1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


def make_cluster(**changes) -> model.ClusterCalibration:
    values = {
        "normal": np.array([-20_000.0, 4_000.0]),
        "shear": np.array(
            [[100.0, 3_000.0, 50.0, 7.0, 11.0, -3.0], [-200.0, -40.0, 2_500.0, 2.0, -5.0, 13.0]]
        ),
        "mean_range": np.array([4.0, 12.0]),
        "difference_range": np.array([-3.0, 3.0]),
        "wiring": np.arange(4),
    }
    return model.ClusterCalibration(**(values | changes))


def make_capacitance(mean: float, along_x: float, along_y: float) -> np.ndarray:
    """Four channels whose plane has a mean and pair differences [pF]."""
    return mean + 0.5 * PLACES @ np.array([along_x, along_y])


DIFFERENCES = pytest.mark.parametrize(
    ("along_x", "along_y"),
    [
        pytest.param(0.0, 0.0, id="balanced"),
        pytest.param(2.0, 0.0, id="along-x"),
        pytest.param(0.0, -1.5, id="along-y"),
        pytest.param(1.2, 2.4, id="along-both"),
    ],
)


@DIFFERENCES
def test_normal_stress_is_the_line_over_the_mean(along_x: float, along_y: float):
    line = np.polynomial.Polynomial(make_cluster().normal)
    stress, status = make_cluster().apply(make_capacitance(8.3, along_x, along_y), ALL_OK)
    assert status == Status.OK and stress[0] == pytest.approx(line(8.3), rel=1e-12)


@DIFFERENCES
def test_shear_is_the_surface_over_the_differences(along_x: float, along_y: float):
    cluster = make_cluster()
    stress, _ = cluster.apply(make_capacitance(8.3, along_x, along_y), ALL_OK)
    for found, (one, x, y, xx, xy, yy) in zip(stress[1:], cluster.shear, strict=True):
        table = [[one, y, yy], [x, xy, 0.0], [xx, 0.0, 0.0]]  # [power of dx][power of dy]
        surface = np.polynomial.polynomial.polyval2d(along_x, along_y, table)
        assert found == pytest.approx(surface, rel=1e-12)


def test_stacked_clusters_agree_with_single_readings(rng):
    clusters = {
        name: make_cluster(
            normal=np.array([rng.normal(), rng.uniform(1e3, 5e3)]),
            shear=rng.normal(size=(2, 6)),
            mean_range=np.array([rng.uniform(4.0, 6.0), 11.0]),
            wiring=rng.permutation(4),
        )
        for name in "abc"
    }
    capacitance = rng.uniform(3.0, 13.0, (90, 3, 4))
    capacitance[::5, 1, 2] = np.inf
    status = rng.choice(np.array([0, 0, 0, 0, 1, 2], dtype=np.uint8), capacitance.shape)
    stacked = model.Calibration(clusters, "2026-01-01", "made up").stacked("cab")
    stress, result = stacked.apply(capacitance, status)
    assert set(result.ravel().tolist()) == {0, 1, 2, 3}
    for row, column in np.ndindex(90, 3):
        cluster = clusters["cab"[column]]  # whose channel c is wired to input wiring[c]
        plain = dataclasses.replace(cluster, wiring=np.arange(4))
        of_channels = (values[row, column, cluster.wiring] for values in (capacitance, status))
        alone, worst = plain.apply(*of_channels)
        np.testing.assert_allclose(stress[row, column], alone, rtol=1e-12)
        assert result[row, column] == worst


@pytest.mark.parametrize(
    ("capacitance", "expected"),
    [
        pytest.param(make_capacitance(12.0, 3.0, -3.0), Status.OK, id="highest"),
        pytest.param(make_capacitance(4.0, -3.0, 3.0), Status.OK, id="lowest"),
        pytest.param(make_capacitance(3.99, 0.0, 0.0), Status.OUT_OF_RANGE, id="mean-below"),
        pytest.param(make_capacitance(12.01, 0.0, 0.0), Status.OUT_OF_RANGE, id="mean-above"),
        pytest.param(make_capacitance(8.0, 0.0, -3.01), Status.OUT_OF_RANGE, id="y-below"),
        pytest.param(make_capacitance(8.0, 0.0, 3.01), Status.OUT_OF_RANGE, id="y-above"),
        pytest.param(make_capacitance(8.0, -3.01, 0.0), Status.OUT_OF_RANGE, id="x-below"),
        pytest.param(make_capacitance(8.0, 3.01, 0.0), Status.OUT_OF_RANGE, id="x-above"),
    ],
)
def test_a_full_reading_gives_a_stress(capacitance: np.ndarray, expected: Status):
    """Also outside of the calibrated range, with another status."""
    stress, status = make_cluster().apply(capacitance, ALL_OK)
    assert status == expected
    assert np.isfinite(stress).all()


@pytest.mark.parametrize(
    ("read", "ends"),
    [
        pytest.param([8.5, 8.6, 5.6, 10.1], {"mean_range": np.array([4.0, 8.2])}, id="mean"),
        pytest.param([8.3, 8.7, 8.2, 7.5], {"difference_range": np.array([-0.15, 3.0])}, id="x"),
    ],
)
def test_a_reading_at_the_end_is_in_range(read: list[float], ends: dict[str, np.ndarray]):
    """Rounding puts its mean, 32.8 / 4 pF, or its difference, -0.15 pF, 1e-15 pF outside."""
    _, status = make_cluster(**ends).apply(np.array(read), ALL_OK)
    assert status == Status.OK


@pytest.mark.parametrize(
    ("statuses", "capacitance", "expected"),
    [
        pytest.param((1, 0, 0, 0), (np.nan, 8.0, 8.0, 8.0), Status.SATURATED, id="saturated"),
        pytest.param((0, 0, 0, 2), (8.0, 8.0, 8.0, 8.0), Status.MISSING, id="missing"),
        pytest.param((1, 2, 0, 0), (8.0, np.nan, 8.0, 8.0), Status.MISSING, id="worst-wins"),
        pytest.param((0, 0, 0, 0), (np.inf, -np.inf, 8.0, 8.0), Status.MISSING, id="infinite"),
    ],
)
def test_an_incomplete_reading_gives_no_stress(statuses, capacitance, expected: Status):
    of_channels = np.array(capacitance), np.array(statuses, dtype=np.uint8)
    stress, status = make_cluster().apply(*of_channels)
    assert status == expected
    assert not np.isfinite(stress).any()


CLUSTERS = {"distal": make_cluster(), "brim": make_cluster(wiring=np.array([2, 0, 3, 1]))}
MADE_UP = model.Calibration(CLUSTERS, "2026-05-04", "bench run 7")


def test_a_calibration_survives_its_file(tmp_path):
    path = tmp_path / "calibration.yaml"
    model.write_calibration(MADE_UP, path)
    path.write_text(path.read_text().replace("'2026-05-04'", "2026-05-04"))  # a date of YAML
    assert model.read_calibration(path).to_document() == MADE_UP.to_document()


@pytest.mark.parametrize(
    ("key", "value", "error"),
    [
        pytest.param(
            *("normal", [0.0, 1.0], "the gain of normal is 1 Pa/pF: give [offset in Pa, gain"),
            id="gain-of-another-unit",
        ),
        pytest.param(
            *("mean_range", [4.0, 4.0], "mean_range is [4, 4]: give [low, high] in pF"),
            id="empty-range",
        ),
        pytest.param(
            *(
                "wiring",
                [0, 1, 1, 3],
                "wiring is [0, 1, 1, 3]: give each of 0, 1, 2, 3 once",
            ),
            id="input-twice",
        ),
    ],
)
def test_coefficients_that_cannot_be_are_refused(tmp_path, key, value, error):
    path = tmp_path / "calibration.yaml"
    document = changed(MADE_UP.to_document(), ("clusters", "brim", key), value)
    path.write_text(yaml.safe_dump(document))
    with refused(ConfigurationError, f"{path}: clusters: brim", error):
        model.read_calibration(path)


def test_a_cluster_without_a_calibration_is_named():
    MADE_UP.require(("brim", "distal"), "the trial")
    with refused(CalibrationError, "no cluster mid of the trial (it has distal, brim"):
        MADE_UP.require(("brim", "mid"), "the trial")
