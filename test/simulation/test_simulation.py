import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
import trimesh

from socket_testbed.calibration.model import read_calibration
from socket_testbed.errors import TestbedError
from socket_testbed.files import packaged
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import read_socket
from socket_testbed.simulation.limb import (
    SCENARIOS,
    TISSUES,
    LimbInSocket,
    LoadedLimb,
    load_history,
    make_tissue,
)
from socket_testbed.simulation.sensors import CAMERA_RATE, observe_markers
from socket_testbed.simulation.socket_scan import make_socket_scan
from socket_testbed.simulation.trial import simulate
from socket_testbed.simulation.world import SensorErrors
from socket_testbed.socket_design.design import place_by_directions
from socket_testbed.socket_design.interior import find_interior
from socket_testbed.socket_design.motive import read_motive_csv

PERFECT = SensorErrors(**{field.name: 0.0 for field in dataclasses.fields(SensorErrors)})


@pytest.fixture(scope="module")
def geometry():
    return read_socket(packaged("config", "socket.yaml"))


@pytest.fixture(scope="module")
def calibration():
    return read_calibration(packaged("config", "calibration.yaml"))


def press(geometry, force: float, seed: int = 0) -> tuple[np.ndarray, LimbInSocket]:
    """Forces at the surface points under a vertical load [N]."""
    tissue = make_tissue(geometry, np.random.default_rng(seed))
    limb = LimbInSocket(tissue, geometry.anchors.mean(axis=0))
    forces = np.zeros_like(tissue.points)
    for share in np.linspace(0.2, 1.0, 8):
        forces = limb.step(np.array([0, 0, 0, 0, 0, -share * force]), 0.25)
    return forces, limb


def test_the_packaged_tiles_lie_on_the_package_s_scan(geometry) -> None:
    scan = make_socket_scan()
    scan.apply_scale(1e-3)
    placed = place_by_directions(
        np.asarray(scan.vertices), find_interior(scan).proximal, np.array([0.0, 0.0, 1.0]), 0.08
    )
    surface = trimesh.Trimesh(
        placed.scan_in_load_cell.apply(scan.vertices), scan.faces, process=False
    )
    _, distance, face = trimesh.proximity.closest_point(surface, geometry.anchors)
    assert distance.max() < 1e-4
    along = np.einsum("ti,ti->t", geometry.rotations[:, :, 2], surface.face_normals[face])
    assert np.abs(along).min() > 0.9


def test_the_socket_carries_the_load_by_pressure_within_the_cone_of_friction(geometry) -> None:
    for force in (50.0, 280.0):
        forces, limb = press(geometry, force)
        assert np.allclose(forces.sum(axis=0), [0, 0, -force], atol=0.05)
        tissue = limb._tissue
        normal = -np.einsum("pi,pi->p", forces, tissue.normals)
        tangential = np.linalg.norm(forces + normal[:, None] * tissue.normals, axis=1)
        assert normal.min() >= 0.0
        assert (tangential <= tissue.friction * normal + 1e-9).all()


def test_the_tissue_stiffens_creeps_under_a_held_load_and_does_not_retrace(geometry) -> None:
    tissue = make_tissue(geometry, np.random.default_rng(0))
    stuck = dataclasses.replace(tissue, friction=0.0, creep=0.0, fit=0.0 * tissue.fit)
    limb = LimbInSocket(stuck, geometry.anchors.mean(axis=0))
    sunk = []
    for force in (100.0, 300.0, 500.0):
        limb.step(np.array([0, 0, 0, 0, 0, -force]), 0.25)
        sunk.append(-limb.displacement[2])
    first, second = np.diff(sunk)
    assert 0.0 < second < first

    load = np.array([0, 0, 0, 0, 0, -250.0])
    _, limb = press(geometry, 250.0)
    at_once = limb.displacement[2]
    for _ in range(200):
        limb.step(load, 0.5)
    assert limb.displacement[2] < at_once - 1e-5
    before = limb.displacement.copy()
    for share in (1.2, 1.4, 1.2, 1.0):
        limb.step(share * load, 1e-6)
    assert np.linalg.norm(limb.displacement[:3] - before[:3]) > 1e-6


def follow(geometry, scenario, seed: int, tissue, rate: float = 1.0) -> tuple[np.ndarray, ...]:
    """Times [s], positions [mm] and rotations [mrad] of a limb in 120 s of a scenario."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 120.0, 1.0 / rate)
    load = load_history(scenario, time, rng)
    limb = LoadedLimb(geometry, load[0], rng, tissue)
    moved = []
    for wrench in load:
        limb.step(wrench, 1.0 / rate)
        moved.append(np.concatenate([limb.position, limb.rotation]))
    return time, *np.hsplit(1e3 * np.array(moved), 2)


def silicone_around_a_bone() -> tuple[float, float]:
    """Moduli of a bed of springs [Pa/m] that an incompressible cylinder around a bone acts like.

    Across: plane strain, the bone moved by 1, the silicone slides on the wall. Along: pure shear.
    """
    shear, bone, wall = 75e3 / 3.0, 0.010, 0.054

    def radial(r: float) -> np.ndarray:
        return np.array([r**2, 1.0, r**-2, np.log(r)])

    def around(r: float) -> np.ndarray:
        return np.array([3.0 * r**2, 1.0, -(r**-2), np.log(r) + 1.0])

    slope = np.array([6.0 * wall, 0.0, 2.0 * wall**-3, 1.0 / wall])
    shear_strain = slope - (around(wall) - radial(wall)) / wall
    conditions = [radial(bone), around(bone), radial(wall), shear_strain]
    stiffness = 4.0 * np.pi * shear * abs(np.linalg.solve(conditions, [1.0, 1.0, 0.0, 0.0])[3])
    return stiffness / (np.pi * wall), shear / (wall * np.log(wall / bone))


def test_the_soft_tissue_is_the_published_silicone(geometry) -> None:
    across, along = silicone_around_a_bone()
    tissues = [make_tissue(geometry, np.random.default_rng(seed), "soft") for seed in range(20)]
    assert np.median([t.modulus for t in tissues]) == pytest.approx(across, rel=0.05)
    assert np.median([t.shear_modulus for t in tissues]) == pytest.approx(along, rel=0.05)
    centre = geometry.anchors.mean(axis=0)
    sides = np.abs(geometry.rotations[:, 2, 2]) < 0.3
    radius = np.linalg.norm((geometry.anchors - centre)[sides, :2], axis=1).mean()
    assert radius == pytest.approx(0.054, rel=0.02)


@pytest.mark.parametrize(("tissue", "least", "most"), [("soft", 6.0, 9.0), ("stiff", 0.6, 1.4)])
def test_the_limb_settles_under_the_paper_s_load(geometry, tissue, least, most) -> None:
    settled = []
    for seed in range(5):
        time, position, _ = follow(geometry, "static_hold", seed, tissue, rate=0.5)
        before, held = (time > 5) & (time < 15), (time > 60) & (time < 95)
        settled.append(position[before].mean(axis=0) - position[held].mean(axis=0))
    down = np.array(settled)[:, 2]
    assert least < np.median(down) < most
    assert 0.6 * least < down.min() and down.max() < 1.4 * most
    assert np.abs(np.array(settled)[:, :2]).max() < 0.15 * most


def test_the_limb_is_held_however_long_the_steps(geometry) -> None:
    for scenario, tissue, rate in itertools.product(SCENARIOS, TISSUES, (0.5, 5.0)):
        rng = np.random.default_rng(7)
        load = load_history(scenario, np.arange(0.0, 10.0, 1.0 / rate), rng)
        limb = LoadedLimb(geometry, load[0], rng, tissue)
        for wrench in load:
            carried = limb.step(wrench, 1.0 / rate).sum(axis=0)
        assert carried[2] < 0.6 * load[-1, 5]  # by the tiles, without what is between them


def test_a_load_that_pulls_the_limb_out_is_refused(geometry) -> None:
    tissue = make_tissue(geometry, np.random.default_rng(0))
    limb = LimbInSocket(tissue, geometry.anchors.mean(axis=0))
    with pytest.raises(TestbedError, match="no equilibrium"):
        limb.step(np.array([0, 0, 0, 0, 0, 5000.0]), 0.25)


def test_a_seed_gives_one_trial(geometry, calibration) -> None:
    first, second, other = (
        simulate(geometry, calibration, "protocol", 6.0, 4.0, seed) for seed in (5, 5, 6)
    )
    np.testing.assert_array_equal(first.wrench, second.wrench)
    np.testing.assert_array_equal(first.markers["pylon"], second.markers["pylon"])
    np.testing.assert_array_equal(first.truth.forces, second.truth.forces)
    assert not np.array_equal(first.truth.forces, other.truth.forces)


def test_the_static_hold_is_the_paper_s_and_the_protocol_pushes_before_it() -> None:
    time, pylon, mass = np.arange(0, 120, 0.25), 9.3 * 9.81, 19.0 * 9.81
    for scenario, begin, held, end in (
        ("static_hold", 15, (25, 95), 110), ("protocol", 4, (66, 105), 109),
    ):  # fmt: skip
        load = load_history(scenario, time, np.random.default_rng(0))
        for when, force in (
            (time < begin, pylon),
            ((time > held[0]) & (time < held[1]), pylon + mass),
            (time > end, pylon),
        ):
            np.testing.assert_allclose(load[when, 5], -force, atol=1e-9)
    pushed = load[(time > 7) & (time < 57)]
    for axis in (0, 1):  # from all sides
        assert pushed[:, 3 + axis].min() < -20.0 and pushed[:, 3 + axis].max() > 20.0
    assert np.ptp(pushed[:, 5]) > 0.9 * mass
    assert np.ptp(pushed[:, 2]) > 2.0


def alone(values: np.ndarray) -> np.ndarray:
    """What of each column's changes the other columns do not explain linearly, rms."""
    centred = values - values.mean(axis=0)
    left = []
    for k in range(centred.shape[1]):
        others = np.delete(centred, k, axis=1)
        fitted = others @ np.linalg.lstsq(others, centred[:, k], rcond=None)[0]
        left.append(np.sqrt(np.mean((centred[:, k] - fitted) ** 2)))
    return np.array(left)


@pytest.mark.parametrize("tissue", TISSUES)
def test_the_protocol_excites_all_six_numbers_of_the_pose(geometry, tissue) -> None:
    motion = {}
    for scenario in ("protocol", "static_hold"):
        time, position, rotation = follow(geometry, scenario, 1, tissue, rate=0.5)
        motion[scenario] = np.hstack([position, rotation])[(time > 6) & (time < 60)]
    found, held = alone(motion["protocol"]), alone(motion["static_hold"])
    least = {"soft": [0.08, 0.08, 1.0, 3.0, 3.0, 3.0], "stiff": [0.02, 0.02, 0.1, 0.4, 0.4, 0.2]}
    assert (found > least[tissue]).all()  # [mm, mrad]
    assert (found > 10.0 * held).all()


def test_perfect_sensors_see_the_truth(geometry, calibration) -> None:
    trial = simulate(geometry, calibration, "ramp", 5.0, 4.0, 0, errors=PERFECT, mocap_window=0.0)
    np.testing.assert_allclose(trial.wrench, trial.truth.wrench)
    limb = geometry.limb_pose(trial.poses["socket"], trial.poses["pylon"])
    # The stand moves the whole testbed, not the limb in the socket.
    np.testing.assert_allclose(limb.translation, trial.truth.position, atol=1e-9)
    np.testing.assert_allclose(limb.rotation_vector(), trial.truth.rotation, atol=1e-9)
    for cluster, tile in geometry.clusters.items():
        stress, status = calibration.clusters[cluster].apply(
            trial.capacitance[cluster], np.zeros((len(trial.stamps), 4), dtype=np.uint8)
        )
        assert (status == 0).all()
        actual = trial.truth.forces[:, tile] @ geometry.rotations[tile]
        np.testing.assert_allclose(geometry.cluster_force(cluster, stress), actual, atol=2e-3)


def test_the_cameras_drop_and_swap_as_often_as_set(geometry) -> None:
    count = 4000
    pose = Pose(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)))
    rng = np.random.default_rng(0)
    dropping = dataclasses.replace(PERFECT, drop_out=0.1)
    seen = observe_markers(pose, geometry.socket_markers, dropping, rng)
    assert np.isnan(seen[:, :, 0]).mean() == pytest.approx(0.1, abs=0.01)
    swapping = dataclasses.replace(PERFECT, label_swap=0.2)
    seen = observe_markers(pose, geometry.socket_markers, swapping, rng)
    moved = np.abs(seen - geometry.socket_markers).max(axis=(1, 2)) > 0.01
    assert moved.mean() == pytest.approx(0.2, abs=0.03)


FIVE = 0.001 * np.array([[0, 0, 0], [61, 4, 9], [13, 47, 2], [40, 72, 31], [-35, 20, 44]])


def test_a_body_of_five_markers_keeps_its_pose_through_occlusions(geometry, calibration) -> None:
    larger = dataclasses.replace(geometry, socket_markers=FIVE)
    faulty = dataclasses.replace(PERFECT, drop_out=0.1, label_swap=0.2)
    plain, trial = (
        simulate(of, calibration, "ramp", 5.0, 4.0, 0, errors=errors, mocap_window=0.0)
        for of, errors in ((geometry, PERFECT), (larger, faulty))
    )
    assert trial.markers["socket"].shape[1:] == (5, 3) and trial.markers["pylon"].shape[1:] == (
        3,
        3,
    )
    position = trial.poses["socket"].translation
    found = np.isfinite(position).all(axis=1)
    whole = np.isfinite(trial.markers["socket"]).all(axis=(1, 2))
    assert found[whole].all() and found.sum() > whole.sum()
    np.testing.assert_allclose(position[found], plain.poses["socket"].translation[found], atol=1e-9)


def test_the_noise_of_a_marker_is_that_of_a_real_take(shared_data: Path) -> None:
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


def measure(geometry, window: float, rate: float = 4.0, **errors: float) -> tuple[np.ndarray, ...]:
    """Errors of the limb's measured position [m], and the pylon's measured markers."""
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    sizes = dataclasses.replace(PERFECT, **errors)
    trial = simulate(
        geometry, calibration, "ramp", 100.0 / rate, rate, 2, errors=sizes, mocap_window=window
    )
    limb = geometry.limb_pose(trial.poses["socket"], trial.poses["pylon"])
    return limb.translation - trial.truth.position, trial.markers["pylon"]


def test_the_mean_over_the_window_averages_the_cameras_noise_and_does_not_lag(geometry) -> None:
    single, _ = measure(geometry, 0.0, marker_noise=5e-5)
    for rate, window in ((4.0, 0.25), (20.0, 0.05)):
        perfect, _ = measure(geometry, 0.25, rate)
        averaged, _ = measure(geometry, 0.25, rate, marker_noise=5e-5)
        frames = 2 * int(0.5 * window * CAMERA_RATE) + 1
        expected = single.std(axis=0) / np.sqrt(frames)
        np.testing.assert_allclose((averaged - perfect).std(axis=0), expected, rtol=0.35)
        speed = 0.008 * np.pi / 30.0  # [m/s]; of the limb's settling under the ramp
        if rate == 4.0:
            assert np.abs(perfect.mean(axis=0)).max() < 0.01 * 0.125 * speed
    assert np.abs(measure(geometry, 0.0)[0]).max() < 1e-9
    error, markers = measure(geometry, 0.25, drop_out=0.3)  # one frame with the body is enough
    assert np.isfinite(error).all()
    assert np.isnan(markers[:, :, 0]).mean() == pytest.approx(0.3, abs=0.1)
    assert np.isnan(measure(geometry, 0.25, drop_out=1.0)[0]).all()
