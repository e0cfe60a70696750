"""The physics of the limb against mechanics and the published experiment; the sensors' errors."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from support.clocks import FakeClock
from support.problems import GEOMETRY
from support.wording import refused

import socket_testbed as st
from socket_testbed.calibration.model import read_calibration
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import packaged
from socket_testbed.identification.channel_errors import summarise_errors
from socket_testbed.live.bringup import Testbed
from socket_testbed.live.hardware import make_clusters, make_load_cell
from socket_testbed.settings.acquisition import ClusterSettings
from socket_testbed.settings.testbed import TestbedSettings, read_testbed
from socket_testbed.simulation.limb import LoadedLimb, load_history
from socket_testbed.simulation.sensors import CAMERA_RATE, SensorErrors
from socket_testbed.simulation.testbed import LiveTestbed, Simulation
from socket_testbed.simulation.trial import simulate
from socket_testbed.simulation.world import World
from socket_testbed.socket_design.motive import read_motive_csv

PERFECT = SensorErrors(
    **{field.name: 0.0 for field in dataclasses.fields(SensorErrors) if field.type == "float"}
)
CALIBRATION = read_calibration(packaged("config", "calibration.yaml"))
DOWN = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -1.0])


@pytest.mark.parametrize("force", [50.0, 280.0], ids=["50-N", "280-N"])
def test_friction_and_pressure_carry_the_load(force: float) -> None:
    """Within the cone of friction."""
    loaded = LoadedLimb(GEOMETRY, force * DOWN, np.random.default_rng(0))
    loaded.step(force * DOWN, 0.25)
    tissue = loaded.tissue
    assert np.allclose(loaded.forces.sum(axis=0), [0, 0, -force], atol=0.05)
    normal = -np.einsum("pi,pi->p", loaded.forces, tissue.normals)
    tangential = np.linalg.norm(loaded.forces + normal[:, None] * tissue.normals, axis=1)
    assert normal.min() >= 0.0
    assert (tangential <= tissue.friction * normal + 1e-9).all()


@pytest.mark.parametrize(
    ("tissue", "least", "most"),
    [pytest.param("soft", 6.0, 9.0, id="soft"), pytest.param("stiff", 0.6, 1.4, id="stiff")],
)
def test_the_limb_settles_under_the_paper_s_load(tissue, least, most) -> None:
    time, settled = np.arange(0.0, 120.0, 2.0), []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        load, moved = load_history("static_hold", time, rng), []
        loaded = LoadedLimb(GEOMETRY, load[0], rng, tissue)
        for wrench in load:
            loaded.step(wrench, 2.0)
            moved.append(1e3 * loaded.position)  # [mm]
        before, held = (time > 5) & (time < 15), (time > 60) & (time < 95)
        settled.append(np.array(moved)[before].mean(axis=0) - np.array(moved)[held].mean(axis=0))
    down = np.array(settled)[:, 2]
    assert least < np.median(down) < most
    assert 0.6 * least < down.min() and down.max() < 1.4 * most


def measure(window: float, rate: float = 4.0, **errors: float):
    """A trial of 100 samples, and the errors of the limb's measured position [m]."""
    sizes = dataclasses.replace(PERFECT, **errors)
    measured = {"errors": sizes, "mocap_window": window}
    trial = simulate(GEOMETRY, CALIBRATION, "ramp", 100.0 / rate, rate, 2, **measured)
    limb_pose = GEOMETRY.limb_pose(trial.poses["socket"], trial.poses["pylon"])
    return trial, limb_pose.translation - trial.truth.position


def test_perfect_sensors_see_the_truth() -> None:
    trial, off = measure(0.0)
    np.testing.assert_allclose(trial.wrench, trial.truth.wrench)
    # The stand moves the whole testbed, not the limb in the socket.
    assert np.abs(off).max() < 1e-9
    turned = GEOMETRY.limb_pose(trial.poses["socket"], trial.poses["pylon"]).rotation_vector()
    np.testing.assert_allclose(turned, trial.truth.rotation, atol=1e-9)
    for cluster, tile in GEOMETRY.clusters.items():
        read = trial.capacitance[cluster]
        stress, status = CALIBRATION.clusters[cluster].apply(read, np.zeros(read.shape, np.uint8))
        assert (status == 0).all()
        actual = trial.truth.forces[:, tile] @ GEOMETRY.rotations[tile]
        np.testing.assert_allclose(GEOMETRY.cluster_force(cluster, stress), actual, atol=2e-3)


def test_more_than_16_clusters_are_not_simulated() -> None:
    clusters = ClusterSettings(names=tuple(f"c{number}" for number in range(17)))
    nodes = dataclasses.replace(TestbedSettings(), cluster_node=clusters)
    with refused(ConfigurationError, "names 17 clusters, and 16 can be simulated"):
        Testbed(nodes, simulation=Simulation())


@pytest.fixture
def running(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeClock:
    """The clock of a simulated testbed in this folder, with the usual errors of sensors."""
    clock, world = FakeClock(1000.0).install(monkeypatch), World(tmp_path, create=True)
    LiveTestbed(world, GEOMETRY, CALIBRATION, Simulation(), SensorErrors()).advance(clock.now)
    return clock


NODES = read_testbed(packaged("config", "simulated.yaml"))


@pytest.mark.parametrize("rate", [4.0, 20.0], ids=["4-Hz", "20-Hz"])
def test_a_live_load_cell_has_simulated_noise(
    tmp_path: Path, running: FakeClock, rate: float
) -> None:
    """By the unmodified driver, which averages conversions."""
    cell = make_load_cell(dataclasses.replace(NODES.load_cell_node, simulation=str(tmp_path)))
    triggers = running.now + 1.0 + np.arange(60) / rate
    while running.now < triggers[-1] + 0.5:
        running.sleep(1.1e-3)
        cell.converter.poll()
    wrench = np.array([cell.wrench_at(trigger, 1.0 / rate).wrench for trigger in triggers])
    trial = simulate(GEOMETRY, CALIBRATION, "static_hold", 120.0 / rate, rate, 0)
    live, offline = wrench.std(axis=0), (trial.wrench - trial.truth.wrench).std(axis=0)
    for group in (slice(3), slice(3, 6)):
        assert np.mean(live[group]) == pytest.approx(np.mean(offline[group]), rel=0.25)


def test_running_clusters_have_the_stated_noise(tmp_path: Path, running: FakeClock) -> None:
    """By the unmodified driver, which averages none of their conversions."""
    clusters = make_clusters(dataclasses.replace(NODES.cluster_node, simulation=str(tmp_path)))
    read = np.array([clusters.read(running.now).capacitance for _ in range(200)])
    stated = SensorErrors().capacitance_noise
    assert np.mean(read.std(axis=0)) == pytest.approx(stated, rel=0.1)


def test_marker_noise_is_that_of_a_real_take(shared_data: Path) -> None:
    """`sample_optitrack_take.csv` of cmuphyscomp/hmv-s16: a triad of 0.2 m, 250 frames at 120 Hz.

    It drifts by 0.4 mm: third differences leave the noise alone.
    """
    take = read_motive_csv(shared_data / "motive_csv" / "sample_optitrack_take.csv")
    markers = take.stack(take.markers_of("Rigid Body 1"))
    found = []
    for frames in (1, 2, 4):
        means = np.array([markers[k : k + frames].mean(axis=0) for k in range(0, 248, frames)])
        found.append(np.sqrt(np.mean(np.diff(means, 3, axis=0) ** 2 / 20.0)))
    assert found[0] == pytest.approx(SensorErrors.marker_noise, rel=0.15)
    # White: a mean of n frames has the noise divided by the root of n.
    np.testing.assert_allclose(found[1:], found[0] / np.sqrt([2, 4]), rtol=0.2)


@pytest.mark.parametrize(
    ("rate", "window"),
    [pytest.param(4.0, 0.25, id="4-Hz"), pytest.param(20.0, 0.05, id="20-Hz")],
)
def test_the_window_s_mean_averages_camera_noise(rate: float, window: float) -> None:
    """It does not lag."""
    _, single = measure(0.0, marker_noise=5e-5)
    _, perfect = measure(window, rate)
    _, averaged = measure(-1.0, rate, marker_noise=5e-5)
    frames = 2 * int(0.5 * window * CAMERA_RATE) + 1
    expected = single.std(axis=0) / np.sqrt(frames)
    np.testing.assert_allclose((averaged - perfect).std(axis=0), expected, rtol=0.35)
    assert np.abs(perfect.mean(axis=0)).max() < 1e-6  # it settles by 1 mm/s


def test_one_frame_with_the_body_is_enough() -> None:
    trial, off = measure(0.25, drop_out=0.3, label_swap=0.2)
    assert np.abs(off).max() < 1e-4
    assert np.isnan(trial.markers["pylon"][:, :, 0]).mean() == pytest.approx(0.3, abs=0.1)


def test_without_any_marker_there_is_no_position() -> None:
    assert np.isnan(measure(0.25, drop_out=1.0)[1]).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:data. check")
def test_the_paper_s_variants_come_near_its_figures(tmp_path) -> None:
    """Published, RMSE without -> with offsets: moments 1.69 -> 0.44 N m, Mx 3.99 -> 0.95 N m,
    forces 5.94 -> 5.25 N, clusters 90 -> 3.8 N."""
    found: dict[str, list[list[float]]] = {"stiffness": [], "stiffness_bias": []}
    for seed in (0, 1, 2):
        trial = st.simulate(tmp_path / str(seed), duration=480, seed=seed, like_paper=True)
        for variant, rows in found.items():
            fitted = st.fit(trial, variant=variant, weights="raw", theta=0.98, frames=1000)
            errors = fitted.fit.errors
            summary = summarise_errors(errors)
            (about_x,) = (error.rmse for error in errors if error.name == "Mx")
            rows.append(
                [
                    summary.mean_moment_rmse,
                    about_x,
                    summary.mean_force_rmse,
                    summary.median_local_rmse,
                ]
            )
    without, with_offsets = (np.median(found[variant], axis=0) for variant in found)
    # moments, Mx, forces, clusters
    assert (without > [1.35, 3.2, 5.0, 80.0]).all() and (without < [2.2, 4.8, 7.2, 100.0]).all()
    assert (with_offsets > [0.35, 0.8, 4.5, 3.3]).all()
    assert (with_offsets < [0.53, 1.1, 6.0, 4.3]).all()
