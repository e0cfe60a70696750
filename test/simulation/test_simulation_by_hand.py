"""Loads, tissue, sensors and live world of the simulation, against hand values.

`Fixed` stands for the random numbers: each is a given multiple of its spread, or a given place in
its range.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import scene
from support.clocks import FakeClock
from support.problems import GEOMETRY

from socket_testbed.calibration.model import invert_calibration
from socket_testbed.errors import TestbedError as SimulationError
from socket_testbed.geometry.pose import Pose
from socket_testbed.simulation import sensors
from socket_testbed.simulation import testbed as live
from socket_testbed.simulation.limb import (
    Donning,
    LoadedLimb,
    draw_donning,
    load_history,
    make_tissue,
)
from socket_testbed.simulation.sensors import ClusterSensor, MarkerBodies, SensorErrors
from socket_testbed.simulation.trial import random_streams
from socket_testbed.simulation.world import World
from socket_testbed.trials.truth import (
    TRUTH_FILE,
    GroundTruth,
    read_true_forces,
    read_truth,
    save_truth,
)

PERFECT = SensorErrors(
    **{field.name: 0.0 for field in dataclasses.fields(SensorErrors) if field.type == "float"}
)


class Fixed:
    """Stands for a generator of random numbers."""

    def __init__(self, normal: float = 0.0, uniform: Any = 0.5, sign: float = 1.0) -> None:
        self._normal, self._uniform, self._sign = normal, uniform, sign

    def normal(self, mean: float = 0.0, spread: float = 1.0, size: Any = None) -> Any:
        value = mean + self._normal * spread
        return value if size is None else np.full(size, value)

    def uniform(self, low: float = 0.0, high: float = 1.0, size: Any = None) -> Any:
        return np.broadcast_to(low + np.asarray(self._uniform) * (high - low), size or ())

    def choice(self, values: Any, size: int, replace: bool = True) -> np.ndarray:
        return np.full(size, self._sign) if replace else np.arange(size)


def fixed(**given: Any) -> Any:
    return Fixed(**given)


# --- loads

# The pylon, 9.3 kg at (4, -3, 450) mm, weighs 91.233 N; 19 kg at (10, 7, 500) mm weigh 186.39 N.
PYLON = ((0.273699, 0.364932, 0.0), (0.0, 0.0, -91.233))
HALF = ((-0.378666, 1.296882, 0.0), (0.0, 0.0, -184.428))
BOTH = ((-1.031031, 2.228832, 0.0), (0.0, 0.0, -277.623))
LOADS: dict[str, tuple[str, float, float, Any]] = {
    # scenario, duration, time; moment and force
    "hold before": ("static_hold", 100.0, 15.0, PYLON),
    "hold halfway": ("static_hold", 100.0, 16.0, HALF),
    "hold": ("static_hold", 100.0, 50.0, BOTH),
    "hold leaving": ("static_hold", 100.0, 84.0, HALF),
    "hold after": ("static_hold", 100.0, 85.0, PYLON),
    "ramp start": ("ramp", 60.0, 0.0, PYLON),
    "ramp quarter": ("ramp", 60.0, 7.5, HALF),
    "ramp top": ("ramp", 60.0, 15.0, BOTH),
    "ramp again": ("ramp", 60.0, 30.0, PYLON),
    "short ramp": ("ramp", 20.0, 10.0, BOTH),
    "protocol between": ("protocol", 100.0, 51.0, PYLON),
    "protocol placing": ("protocol", 100.0, 53.0, HALF),
    "protocol hold": ("protocol", 100.0, 70.0, BOTH),
    "protocol end": ("protocol", 100.0, 90.0, PYLON),
    "pushes before": ("multi_direction", 100.0, 5.0, PYLON),
    # After two turns of 11 s pushed towards +x by 35 (0.6 + 0.4 sin(2 pi 22 / 23)) = 17.22285 N,
    # lifted by 60 sin(2 pi 22 / 17) = 57.70954 N; the moment is (10, 7, 500) mm x force.
    "pushed": (
        *("multi_direction", 100.0, 22.0),
        ((-0.627064, 10.263162, -0.12056), (17.222845, 0.0, -219.913461)),
    ),
    # After 2.25 turns towards +y by 27.44091 N, lifted by 16.41978 N.
    "pushed left": (
        *("multi_direction", 100.0, 24.75),
        ((-14.636548, 2.064635, 0.274409), (0.0, 27.440911, -261.203221)),
    ),
}


@pytest.mark.parametrize("case", LOADS)
def test_a_scenario_loads_the_limb(case: str) -> None:
    """Without sway."""
    scenario, duration, moment, (torque, force) = LOADS[case]
    time = np.arange(0.0, duration + 0.1, 0.25)
    found = load_history(scenario, time, fixed())[int(4 * moment)]  # type: ignore[arg-type]
    if scenario == "protocol":  # hands have left after half of it
        assert moment > 50.0
    np.testing.assert_allclose(found, [*torque, *force], atol=1e-5)


def test_hands_push_lean_and_twist() -> None:
    """At 20 s with phases that give 35 N towards +x at 0.5 m, 186.39 N down at x = 30 mm, 1.5 N m.

    Moments about y: 0.364932 of the pylon, 17.5 of the push, 5.5917 of leaning [N m].
    """
    time = np.arange(0.0, 100.1, 0.25)
    turned = 20.0 / np.array([11.0, 23.0, 7.3, 17.0, 9.1, 13.0])
    phases = np.array([0.0, 0.25, 0.25, 0.25, 0.0, 0.25]) - turned
    found = load_history("protocol", time, fixed(uniform=phases))
    np.testing.assert_allclose(
        found[80], [0.273699, 23.456632, 1.5, 35.0, 0.0, -277.623], atol=1e-6
    )
    np.testing.assert_allclose(found[16], [*PYLON[0], *PYLON[1]], atol=1e-9)  # at 4 s, still off


def test_the_load_sways_with_a_lag() -> None:
    """Kicks of 0.4 N; 0.25 s keep exp(-0.25 / 0.6) = 0.659241; 30 % without the added mass.

    The second force is 0.3 * 0.4 * 0.751932 = 0.0902318 N, the third (1 + 0.659241) times it. They
    act at (10, 7, 500) mm.
    """
    found = load_history("static_hold", np.arange(0.0, 100.1, 0.25), fixed(normal=1.0))
    np.testing.assert_allclose(found[:3, 3], [0.0, 0.0902318, 0.1497163], atol=1e-6)
    np.testing.assert_allclose(found[:3, 4], found[:3, 3])
    moment = np.array([-0.5, 0.5, 0.003]) * 0.0902318 + PYLON[0]
    np.testing.assert_allclose(found[1, :3], moment, atol=1e-6)
    # Equal kicks settle at 0.4 * 0.751932 / (1 - 0.659241) N, 1.3 times it at 50 s with the mass.
    assert found[200, 3] == pytest.approx(1.147451, abs=1e-5)


# --- tissue


def test_tissue_has_nine_points_on_a_tile() -> None:
    """A tile of 30 mm: 10 mm apart, 1 cm^2 each; between tiles 0.25 * 115 cm^2 / 20 pairs."""
    tissue = make_tissue(scene.geometry(), fixed(uniform=0.25))  # properties do not vary
    assert len(tissue.points) == 9 * 12 + 20
    own = 1e3 * tissue.points[:9]  # of ant_prox, at x = 50 mm, z = 210 mm
    np.testing.assert_allclose(np.unique(own[:, 1].round(6)), [-10.0, 0.0, 10.0], atol=1e-6)
    np.testing.assert_allclose(np.unique(own[:, 2].round(6)), [200.0, 210.0, 220.0], atol=1e-6)
    np.testing.assert_allclose(own[:, 0], 50.0)
    np.testing.assert_allclose(tissue.areas[:9], 1e-4)
    np.testing.assert_allclose(tissue.areas[9:18], 16e-4 / 9.0)
    np.testing.assert_allclose(tissue.areas[108:], 1.4375e-4)
    np.testing.assert_allclose(tissue.normals[0], [-1.0, 0.0, 0.0], atol=1e-12)


def test_points_between_tiles_are_halfway() -> None:
    """`ant_prox` and `left_prox`, the first pair of neighbours."""
    tissue = make_tissue(scene.geometry(), fixed(uniform=0.25))
    np.testing.assert_allclose(1e3 * tissue.points[108], [25.0, 25.0, 210.0], atol=1e-9)
    np.testing.assert_allclose(tissue.normals[108], [-np.sqrt(0.5), -np.sqrt(0.5), 0.0], atol=1e-9)


KINDS = {
    # modulus, shear modulus [MPa/m], growth by e, fit [mm]; at the field's highest value, sqrt(24):
    # exp(0.25 sqrt(24)) = 3.4033 times the moduli, 1 mm sqrt(24) more fit
    ("soft", 0.25): (1.5, 0.27, 15.0, 2.0),
    ("soft", 0.0): (5.10495, 0.918890, 15.0, 6.898979),
    ("stiff", 0.25): (6.0, 2.7, 4.0, 0.8),
    ("stiff", 0.0): (54.3965, 24.47843, 4.0, 3.739388),  # exp(0.45 sqrt(24)) = 9.06609
}


@pytest.mark.parametrize(("kind", "phase"), KINDS)
def test_a_kind_of_tissue_has_its_stiffness(kind: Any, phase: float) -> None:
    modulus, shear, growth, fit = KINDS[kind, phase]
    tissue = make_tissue(scene.geometry(), fixed(uniform=phase), kind)
    np.testing.assert_allclose(1e-6 * tissue.modulus, modulus, rtol=1e-5)
    np.testing.assert_allclose(1e-6 * tissue.shear_modulus, shear, rtol=1e-5)
    np.testing.assert_allclose(1e3 * tissue.fit, fit, rtol=1e-6)
    assert 1e3 * tissue.stiffening == pytest.approx(growth)
    assert (tissue.friction, tissue.creep, tissue.creep_time) == (0.5, 0.18, 35.0)


def test_a_donning_changes_compression_and_place() -> None:
    """Ten percent more of 2 mm; a point sees the tissue that was 5 mm below it."""
    geometry, seed = scene.geometry(), 3
    donned = Donning(np.array([0.0, 0.0, 5e-3]), np.zeros(3), 0.1, np.zeros(6))
    moved = dataclasses.replace(geometry, anchors=geometry.anchors - [0.0, 0.0, 5e-3])
    found = make_tissue(geometry, np.random.default_rng(seed), "soft", donned)
    below = make_tissue(moved, np.random.default_rng(seed), "soft")
    np.testing.assert_allclose(found.modulus, below.modulus)
    np.testing.assert_allclose(found.fit, below.fit + 2e-4)
    np.testing.assert_allclose(found.points[:, 2], below.points[:, 2] + 5e-3)


def test_a_turned_donning_turns_the_tissue() -> None:
    """By a quarter turn to the left: what was at the front is at the left."""
    geometry, seed = scene.geometry(), 3
    turn = np.array([0.0, 0.0, 0.5 * np.pi])
    donned = Donning(np.zeros(3), turn, 0.0, np.zeros(6))
    found = make_tissue(geometry, np.random.default_rng(seed), "soft", donned)
    before = make_tissue(geometry, np.random.default_rng(seed), "soft")
    centre = geometry.anchors.mean(axis=0)
    compared = 0
    for point, modulus in zip(before.points, before.modulus, strict=True):
        x, y, z = point - centre
        apart = np.linalg.norm(found.points - centre - [-y, x, z], axis=1)
        if apart.min() < 1e-9:
            assert found.modulus[apart.argmin()] == pytest.approx(modulus)
            compared += 1
    assert compared > 20


def test_a_donning_varies_with_its_share() -> None:
    """At a tenth: 2.5 mm, 0.04 rad, 10 %, a tenth of what friction holds; at 54 mm for a twist."""
    found = draw_donning(0.1, fixed(normal=1.0))
    np.testing.assert_allclose(found.shift, 2.5e-3)
    np.testing.assert_allclose(found.turn, 0.04)
    assert found.preload == pytest.approx(0.1)
    np.testing.assert_allclose(found.seating, [0.1, 0.1, 0.1, *[0.1 / 0.054] * 3])


@pytest.mark.parametrize(("along", "left"), [(0.5, 750.0), (0.0, 0.0)])
def test_seating_leaves_shear(along: float, left: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """On upright tile `ant_prox`: 0.5 along z of 0.5 * 1.5 MPa/m * 2 mm, which friction holds."""
    monkeypatch.setattr(LoadedLimb, "step", lambda self, load, duration: None)
    seating = np.array([0.0, 0.0, along, 0.0, 0.0, 0.0])
    donned = Donning(np.zeros(3), np.zeros(3), 0.0, seating)
    limb = LoadedLimb(scene.geometry(), np.zeros(6), fixed(uniform=0.25), "soft", donned)
    np.testing.assert_allclose(np.hypot(*limb._traction)[:9], left)


def test_a_donning_keeps_the_limb_of_its_seed() -> None:
    """Tissue of the seed alone; everything else differs between donnings."""
    plain, first, second = (
        [stream.normal() for stream in random_streams(4, donning)] for donning in (None, 1, 2)
    )
    assert plain[0] == first[0] == second[0]
    assert len({*plain[1:], *first[1:], *second[1:]}) == 18


@pytest.fixture(scope="module")
def limb() -> LoadedLimb:
    """A limb in even soft tissue, of the package's socket."""
    return LoadedLimb(GEOMETRY, np.array([0, 0, 0, 0, 0, -50.0]), fixed(uniform=0.25))


# Traction of before along the first tangent [Pa], and what 2.9025 kPa of pressure let of it
TRACTION = {"sticks": (100.0, 370.0), "slips": (5e4, 1451.263), "back": (-5e4, -1451.263)}


@pytest.mark.parametrize("case", TRACTION)
def test_tissue_presses_creeps_and_slips(case: str, limb: LoadedLimb) -> None:
    """At the place of donning for 35 s, after 1 mm along the first tangent from -1 mm.

    Of 2 mm 18 % would creep, half of it does: 1.82 mm press with 22.5 kPa (exp(1.82 / 15) - 1) =
    2902.527 Pa. Shear grows by 0.27 MPa/m * 1 mm = 270 Pa, to half the pressure at most.
    """
    before, after = TRACTION[case]
    count = len(limb.tissue.points)
    limb._crept = np.zeros(count)
    limb._traction = np.array([np.full(count, before), np.zeros(count)])
    limb._tangential = np.array([np.full(count, -1e-3), np.zeros(count)])
    forces, crept, traction, tangential = limb._respond(np.zeros(6), 35.0)
    np.testing.assert_allclose(1e3 * crept, 0.18)
    np.testing.assert_allclose(-forces[0] / limb.tissue.areas, 2902.527, rtol=1e-6)
    np.testing.assert_allclose(forces[1] / limb.tissue.areas, after, rtol=1e-6)
    np.testing.assert_allclose(traction[0], after, rtol=1e-6)
    assert not traction[1].any() and not tangential.any()


def test_a_pulled_out_limb_is_an_error() -> None:
    """Nothing holds it against 10 kN upwards; the sideways forces are balanced nevertheless."""
    loaded = LoadedLimb(GEOMETRY, np.array([0, 0, 0, 0, 0, -50.0]), fixed(uniform=0.25))
    with pytest.raises(SimulationError, match="no equilibrium under the load") as error:
        loaded.step(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1e4]), 1.0)
    assert "10000.0] [N m, N]" in error.value.fact


# --- sensors


@pytest.mark.parametrize(("span", "factor"), [(0.25, 1.0), (1.0, 0.5), (0.0625, 2.0)])
def test_a_longer_mean_is_less_noisy(span: float, factor: float) -> None:
    noise = SensorErrors().wrench_noise(span)
    np.testing.assert_allclose(noise, factor * np.array([*[0.01] * 3, *[0.15] * 3]))


def test_a_stress_gives_its_capacitances() -> None:
    """40 kPa: 5 + 2 pF; dx = -0.1, dy = 4 / 30 pF; inputs 1, 0, 3, 2 are the channels."""
    own = scene.calibration().clusters["mid_anterior"]
    found = invert_calibration(own, np.array([[40e3, -3e3, 4e3]]))
    np.testing.assert_allclose(found, [[7.0166667, 7.1166667, 6.8833333, 6.9833333]], atol=1e-6)


BUILT: dict[str, tuple[dict[str, float], tuple[float, float, float], list[float]]] = {
    # errors (each one spread), stress [kPa], inputs at 100 s [pF]; the cluster is unturned and its
    # channels (-x,+y), (+x,+y), (-x,-y), (+x,-y) are the inputs 0, 1, 2, 3
    "perfect": ({}, (40.0, 3.0, 0.0), [6.95, 7.05, 6.95, 7.05]),
    "gain": ({"gain_mismatch": 0.02}, (40.0, 0.0, 0.0), [7.04] * 4),
    "offset": ({"offset": 0.03}, (0.0, 0.0, 0.0), [5.03] * 4),
    "drift": ({"capacitance_drift": 1e-4}, (0.0, 0.0, 0.0), [5.01] * 4),
    "cross-talk": ({"cross_talk": 0.1}, (40.0, 3.0, 0.0), [6.955, 7.045, 6.955, 7.045]),
    # turned by 0.05 rad: dx = 0.099875, dy = -0.004998 pF
    "placement": (
        {"placement": 0.05},
        (0.0, 3.0, 0.0),
        [4.9475635, 5.0474385, 4.9525615, 5.0524365],
    ),
    # 0.6 of 20 kPa in each stress: 0.6 pF, dx = dy = 0.4 pF
    "stress": ({"stress_offset": 20e3}, (0.0, 0.0, 0.0), [5.6, 6.0, 5.2, 5.6]),
}


@pytest.mark.parametrize("case", BUILT)
def test_a_built_cluster_has_its_errors(case: str) -> None:
    errors, stress, inputs = BUILT[case]
    built = dataclasses.replace(PERFECT, **errors)
    sensor = ClusterSensor(scene.calibration().clusters["brim_lateral"], built, fixed(normal=1.0))
    found = sensor.respond(1e3 * np.array([stress]), np.array([100.0]))
    np.testing.assert_allclose(found, [inputs], atol=1e-6)


def test_a_cluster_has_its_own_offset() -> None:
    """20 kPa in each stress: 1 pF, dx = dy = 2 / 3 pF; nothing is drawn within `stress_offset`."""
    own = sensors.ClusterErrors((20e3, 20e3, 20e3), (0.0, 0.0, 0.0))
    built = dataclasses.replace(PERFECT, stress_offset=90e3)
    nominal = scene.calibration().clusters["brim_lateral"]
    found = ClusterSensor(nominal, built, fixed(normal=1.0), own).respond(
        np.zeros((1, 3)), np.zeros(1)
    )
    np.testing.assert_allclose(found, [[6.0, 6.6666667, 5.3333333, 6.0]], atol=1e-6)


def test_published_offsets_are_forces_in_a_tile() -> None:
    """Normal 63 N of pull, 48 N along x and 38 N along y on 9 cm^2; a deviation of 2.4 N."""
    own = sensors.LIKE_PAPER.clusters["brim_lateral"]
    np.testing.assert_allclose(own.offset, [-70e3, 53333.33, 42222.22], rtol=1e-6)
    assert own.vibration[0] == pytest.approx(2.4 * 2**0.5 / 9e-4)


def test_a_converter_has_noise_and_steps() -> None:
    """2 fF of noise; steps of 2^-19 pF."""
    errors = dataclasses.replace(PERFECT, capacitance_noise=0.002)
    sensor = ClusterSensor(scene.calibration().clusters["distal"], errors, fixed())
    found = sensor.read(np.zeros((1, 3)), np.zeros(1), fixed(normal=1.0))
    np.testing.assert_allclose(found, 5.002, atol=1e-6)
    assert (found * 2**19 == np.round(found * 2**19)).all() and (found != 5.002).all()


def test_a_stand_vibrates_at_13_5_hertz() -> None:
    """From the top of a wave, at a quarter and half of 1 / 13.5 s."""
    time = np.array([0.0, 1.0 / 54.0, 1.0 / 27.0])
    found = sensors.vibration(np.array([2.0, 0.5]), time, fixed(uniform=0.25))
    np.testing.assert_allclose(found, [[2.0, 0.5], [0.0, 0.0], [-2.0, -0.5]], atol=1e-9)


def test_a_tare_leaves_an_offset() -> None:
    found = sensors.wrench_offset(SensorErrors(), fixed(normal=1.0))
    assert found.tolist() == [0.05, 0.05, 0.05, 0.8, 0.8, 0.8]
    found = sensors.wrench_offset(sensors.LIKE_PAPER, fixed(normal=1.0))
    assert found.tolist() == [-7.45, 0.05, 0.05, 0.8, 0.8, 0.8]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_load_cell_creeps_with_the_load(sign: float) -> None:
    """Full load after 40 s, one time constant: half, then three quarters, of which all is 1."""
    load = np.zeros((3, 6))
    load[:, 5] = [-10.0, -110.0, -110.0]
    time = np.array([0.0, 40.0, 80.0])
    found = sensors.wrench_creep(sensors.LIKE_PAPER, load, time, fixed(sign=sign))
    moment, force = sign * 0.9, sign * 4.0
    np.testing.assert_allclose(found[:, 2], [0.0, moment / 1.5, moment])
    np.testing.assert_allclose(
        found[:, 2:4], [[0, 0], [moment / 1.5, force / 1.5], [moment, force]]
    )


def test_bodies_are_where_stand_and_limb_are() -> None:
    """The stand is at (420, -310, 740) mm, turned by R = Rx(-3) Ry(4) Rz(35) degrees.

    R (100, 0, 0) mm = (81.7157, 56.9799, -8.7081) mm is the socket's body. The stand yields
    by 1 mm where 1000 N along -z of {S} push it, R (0, 0, -1) mm = (-0.0698, -0.0522, -0.9962) mm,
    trembles by 0.02 mm, and is swayed by 3 mm along x.
    """
    bodies = MarkerBodies(scene.geometry(), PERFECT, fixed(normal=1.0))
    load = np.zeros((1, 6))
    load[0, 5] = -1000.0
    position = np.array([[0.0, 0.0, -0.1]])
    swayed = np.array([0.003, 0.0, 0.0])
    socket, pylon = bodies.poses(position, np.zeros((1, 3)), load, swayed)
    np.testing.assert_allclose(
        1e3 * socket.translation, [[504.6659, -253.0523, 730.3157]], atol=2e-3
    )
    # The limb is 200 mm below the pylon's body: R (0, 0, 100) mm from the stand.
    third = np.array([6.9756, 5.2208, 99.6195])
    found = 1e3 * pylon.translation - [422.9502, -310.0322, 739.0238]
    np.testing.assert_allclose(found, [third], atol=2e-3)


def test_labels_are_swapped_and_markers_occluded() -> None:
    pose = Pose(np.eye(3)[None], np.array([[1.0, 0.0, 0.0]]))
    markers = np.array([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.2]])
    noisy = dataclasses.replace(PERFECT, marker_noise=1e-3)
    seen = sensors.observe_markers(pose, markers, noisy, fixed(normal=1.0))
    np.testing.assert_allclose(seen[0], markers + np.array([1.001, 0.001, 0.001]))
    swapped = dataclasses.replace(PERFECT, label_swap=0.6)
    seen = sensors.observe_markers(pose, markers, swapped, fixed())
    np.testing.assert_allclose(seen[0], markers[[1, 0, 2]] + [1.0, 0.0, 0.0])
    occluded = dataclasses.replace(PERFECT, drop_out=0.6)
    assert np.isnan(sensors.observe_markers(pose, markers, occluded, fixed())).all()


# --- the truth


def test_the_truth_is_linear_between_its_times(tmp_path: Path) -> None:
    stamps = 10**18 + np.array([0, 10, 20])
    steps = np.array([0.0, 1.0, 3.0])
    rows = steps[:, None] * np.ones(3)
    truth = GroundTruth(
        ("a", "b"), rows[:, None] * [[1.0], [2.0]], np.hstack([rows, 5 * rows]), rows, 7 * rows
    )
    save_truth(tmp_path / TRUTH_FILE, stamps, truth)
    found = read_truth(tmp_path, 10**18 + np.array([-5, 5, 15, 99]))
    assert found.tiles == ("a", "b")
    np.testing.assert_allclose(found.position[:, 0], [0.0, 0.5, 2.0, 3.0])
    np.testing.assert_allclose(found.rotation[:, 2], [0.0, 3.5, 14.0, 21.0])
    np.testing.assert_allclose(found.wrench[1], [0.5, 0.5, 0.5, 2.5, 2.5, 2.5])
    np.testing.assert_allclose(found.forces[2, :, 0], [2.0, 4.0])
    np.testing.assert_allclose(read_truth(tmp_path).position[:, 0], steps)


@pytest.mark.parametrize(
    ("tiles", "known"),
    [(("a", "b"), True), (("b", "a"), False), (("a",), False)],
    ids=["same", "other order", "fewer"],
)
def test_true_forces_are_of_the_same_tiles(
    tiles: tuple[str, ...], known: bool, tmp_path: Path
) -> None:
    stamps, rows = np.array([0, 10]), np.zeros((2, 3))
    assert read_true_forces(tmp_path, stamps, tiles) is None
    truth = GroundTruth(("a", "b"), np.ones((2, 2, 3)), np.zeros((2, 6)), rows, rows)
    save_truth(tmp_path / TRUTH_FILE, stamps, truth)
    found = read_true_forces(tmp_path, stamps, tiles)
    assert (found is not None) is known
    assert found is None or found.tolist() == np.ones((2, 2, 3)).tolist()


# --- the live world


@pytest.fixture
def world(tmp_path: Path) -> World:
    """Two clusters; everything doubles from 100 s to 102 s."""
    made = World(tmp_path, create=True)
    quaternions = np.array([[0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0]])
    for moment, factor in ((100.0, 1.0), (102.0, 2.0)):
        made.push(
            moment,
            factor * np.arange(1.0, 9.0).reshape(2, 4),
            factor * np.arange(10.0, 16.0),
            np.hstack([factor * np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), quaternions]),
        )
    return made


@pytest.mark.parametrize(
    ("moment", "factor"),
    [(99.0, 1.0), (99.99, 1.0), (100.5, 1.25), (101.0, 1.5), (102.0, 2.0), (110.0, 2.0)],
)
def test_a_world_is_linear_between_its_states(moment: float, factor: float, world: World) -> None:
    """And constant before and after."""
    assert world.capacitance(1, 2, moment) == pytest.approx(7.0 * factor)
    assert world.wrench(moment) == pytest.approx(factor * np.arange(10.0, 16.0))
    found = world.poses(moment)
    np.testing.assert_allclose(found[:, :3], factor * np.array([[1, 2, 3], [4, 5, 6]]))
    np.testing.assert_allclose(found[:, 3:], [[0, 0, 0, 1], [1, 0, 0, 0]])


def test_a_world_keeps_its_last_states(tmp_path: Path) -> None:
    """32 of 40 from 0 s to 39 s: the oldest is that of 8 s."""
    made = World(tmp_path, create=True)
    for k in range(40):
        made.push(float(k), np.full((1, 4), float(k)), np.zeros(6), np.ones((2, 7)))
    found = [made.capacitance(0, 0, moment) for moment in (0.0, 8.0, 8.5, 38.25, 50.0)]
    assert found == pytest.approx([8.0, 8.0, 8.5, 38.25, 39.0])


def test_the_oldest_states_stay_linear_once_passed(world: World) -> None:
    """A look before them, where the world is constant, holds for no later time."""
    for k in range(40):
        world.push(200.0 + k, np.full((1, 4), float(k)), np.zeros(6), np.ones((2, 7)))
    assert world.capacitance(0, 0, 190.0) == 8.0
    assert world.capacitance(0, 0, 208.5) == pytest.approx(8.5)


@pytest.mark.parametrize(
    "counts",
    [[5, 5, 6, 6], [5, 4, 6, 6, 6], [4, 6, 6, 6]],
    ids=["being changed", "odd, then even", "changed meanwhile"],
)
def test_a_half_written_state_is_not_read(counts: list[int], world: World) -> None:
    """The count of changes is odd while another process writes, and grows with each write."""
    left = [*counts]
    world._changes = type("Counts", (), {"__getitem__": lambda self, _: left.pop(0)})()
    world.wrench(100.5)
    assert not left


def test_another_process_reads_the_world(world: World, tmp_path: Path) -> None:
    world.faults.switch("clock.step", 2.0)
    world.port = 4711
    other = World(tmp_path)
    assert (other.port, other.faults["clock.step"], other.faults["limb.out"]) == (4711, 2.0, 0.0)
    assert other.capacitance(0, 3, 101.0) == pytest.approx(6.0)
    late = other.wall_clock()
    other.faults.switch("clock.step", 0.0)
    assert late - other.wall_clock() == pytest.approx(2_000_000_000, abs=5e8)


class StillLimb:
    """Stands for a limb that does not move: 9 N press outwards on `ant_mid`."""

    def __init__(self, geometry: Any, load: Any, rng: Any, kind: Any, donning: Any) -> None:
        self.position, self.rotation = np.array([0.0, 0.0, 0.1]), np.zeros(3)
        self.steps: list[tuple[float, float]] = []

    def step(self, load: np.ndarray, duration: float) -> np.ndarray:
        self.steps.append((float(load[5]), duration))
        forces = np.zeros((12, 3))
        forces[4, 0] = 9.0
        return forces


@pytest.fixture
def running(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[World, live.LiveTestbed, FakeClock]:
    """A live testbed of the scene without errors of sensors, begun at 100 s."""
    clock = FakeClock(100.0).install(monkeypatch)
    monkeypatch.setattr(live, "LoadedLimb", StillLimb)
    made = World(tmp_path, create=True)
    simulation = live.Simulation("static_hold", period=20.0, noise=3.0, sway=0.01)
    errors = dataclasses.replace(PERFECT, capacitance_noise=0.5, force_noise=0.2)
    testbed = live.LiveTestbed(made, scene.geometry(), scene.calibration(), simulation, errors)
    return made, testbed, clock


def test_a_live_testbed_states_its_noise(running: Any) -> None:
    """Of a mean over 1 s: half of that over 0.25 s, three times."""
    world, _, _ = running
    assert world.capacitance_noise.tolist() == [0.5]
    assert world.wrench_noise == pytest.approx([0.0, 0.0, 0.0, 0.3, 0.3, 0.3])


def test_a_live_cluster_feels_its_tile(running: Any) -> None:
    """9 N on 9 cm^2 are 10 kPa, 0.5 pF above 5 pF; the other clusters feel nothing."""
    world, testbed, _ = running
    testbed.advance(110.0)
    found = [world.capacitance(cluster, 0, 110.0) for cluster in range(4)]
    assert found == pytest.approx([5.0, 5.5, 5.0, 5.0])
    assert world.wrench(110.0)[5] == pytest.approx(-277.623, abs=0.5)  # halfway through the hold
    # sway of 10 mm with a period of 3 s along x: sin(2 pi 10 / 3) = 0.866
    still = world.poses(110.0)[0, :3].copy()
    testbed.advance(112.0)  # sin(2 pi 12 / 3) = 0
    assert still[0] - world.poses(112.0)[0, 0] == pytest.approx(8.66e-3, abs=3e-4)


def test_a_live_load_repeats(running: Any) -> None:
    """The pylon alone until 3 s of 20 s, and again after 20 s."""
    _, testbed, _ = running
    for moment in (101.0, 110.0, 121.0):
        testbed.advance(moment)
    loads, durations = zip(*testbed._limb.steps, strict=True)
    assert loads == pytest.approx([-91.233, -277.623, -91.233])
    assert durations == pytest.approx([1.0, 9.0, 11.0])


def test_a_thumb_presses_a_cluster(running: Any) -> None:
    """15 kPa on 9 cm^2 of the second cluster, at (50, 0, 150) mm: 13.5 N and 2.025 N m."""
    world, testbed, _ = running
    world.faults.switch("limb.out", 2.0)
    testbed.advance(101.0)
    assert world.wrench(101.0) == pytest.approx([0.0, 2.025, 0.0, 13.5, 0.0, 0.0])
    found = [world.capacitance(cluster, 0, 101.0) for cluster in range(4)]
    assert found == pytest.approx([5.0, 5.75, 5.0, 5.0])
    world.faults.switch("limb.out", -1.0)
    testbed.advance(102.0)
    assert not world.wrench(102.0).any()
    assert world.capacitance(1, 0, 102.0) == pytest.approx(5.0)


def test_a_saved_live_truth_holds_its_states(running: Any, tmp_path: Path) -> None:
    _, testbed, clock = running
    clock.now = 101.5
    testbed.advance(101.0)
    testbed.advance(110.0)
    testbed.save(
        tmp_path / TRUTH_FILE, type("Clock", (), {"to_epoch": lambda _, at: int(10 * at)})()
    )
    with np.load(tmp_path / TRUTH_FILE) as data:
        assert data["stamps"].tolist() == [1010, 1100]
        assert data["lateness"].tolist() == pytest.approx([0.5, -8.5])
        assert data["forces"][0, 4].tolist() == [9.0, 0.0, 0.0]
        assert data["wrench"][:, 5] == pytest.approx([-91.233, -277.623])
        assert data["felt_wrench"][1] == pytest.approx(data["wrench"][1])
        assert data["felt_capacitance"][0, :, 0] == pytest.approx([5.0, 5.5, 5.0, 5.0])
        assert data["felt_markers"].shape == (2, 2, 3, 3)
    assert read_truth(tmp_path).position[0].tolist() == [0.0, 0.0, 0.1]


def test_a_smaller_body_is_padded() -> None:
    found = live._padded([np.ones((2, 3)), np.ones((3, 3))])
    assert np.isnan(found[0, 2]).all() and np.isfinite(found[1]).all() and found.shape == (2, 3, 3)
