"""The estimates of the scene at 12.0 s as ROS messages, read by ROS, against hand values.

The measurements of one trigger pass through the online estimator, whose force map knows the scene,
and through the packers of the estimator node. Forces and pressures are 1.5 times the means.
"""

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation
from socket_testbed_msgs import msg
from support import scene
from visualization_msgs.msg import MarkerArray

from socket_testbed.live.estimator import Estimates, OnlineEstimator
from socket_testbed.nodes.estimator_node import PressureMap
from socket_testbed.samples import Status
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.wire import messages, topics

STAMP = scene.START + 12 * 10**9


class NoFits:
    """Stands for the worker process: nothing is fitted here."""

    def run(self, work: Callable[..., Any], *given: Any) -> Future[Any]:
        return Future()


@pytest.fixture(scope="module")
def estimator(by_hand: None) -> OnlineEstimator:
    return OnlineEstimator(scene.geometry(), EstimatorSettings, NoFits(), lambda model: None)


@pytest.fixture(scope="module")
def estimates(estimator: OnlineEstimator) -> Estimates:
    """What the clusters' stresses and the wrench of the trigger at 12.0 s complete."""
    calibration, row = scene.calibration(), scene.PEAK_ROW
    stresses = {}
    for name in scene.CLUSTERS:
        inputs = scene.capacitances(name)[row]
        stress, status = calibration.clusters[name].apply(inputs, np.zeros(4, dtype=np.uint8))
        stresses[name] = stress, int(status)
    estimator.add(topics.STRESS, STAMP, stresses)
    return estimator.add(topics.WRENCH, STAMP, scene.wrench()[row])


# --- estimate/force_map


@pytest.fixture(scope="module")
def force_map(estimates: Estimates) -> Any:
    pack = messages.force_map_packer(scene.TILES)
    return deserialize_message(pack(STAMP, estimates.force_map), msg.ForceMap)


FORCES = {  # on the socket in {S} [N]
    "ant_mid": (54.0, 5.4, -4.05),
    "right_prox": (8.1, -40.5, -10.8),
    "left_prox": (-4.8, 19.2, 0.0),
    "post_end": (2.7, 1.35, -18.9),
    "right_mid": (0.0, 1.35, 0.0),
}
STRESSES = {  # pressure and shear [Pa]
    "ant_mid": (60e3, 7.5e3),
    "right_prox": (45e3, 15e3),
    "left_prox": (12e3, 3e3),
    "right_mid": (-1.5e3, 0.0),
}


def test_the_force_map_is_headed(force_map: Any) -> None:
    assert force_map.header.frame_id == "load_cell"
    assert (force_map.header.stamp.sec, force_map.header.stamp.nanosec) == (1_800_000_012, 0)
    assert tuple(force_map.names) == scene.TILES
    assert force_map.source == "made by hand"


@pytest.mark.parametrize("tile", FORCES)
def test_the_force_map_holds_the_known_forces(tile: str, force_map: Any) -> None:
    force = force_map.forces[scene.TILES.index(tile)]
    assert (force.x, force.y, force.z) == pytest.approx(FORCES[tile], abs=1e-9)


@pytest.mark.parametrize("tile", STRESSES)
def test_the_force_map_holds_the_known_stresses(tile: str, force_map: Any) -> None:
    place, (pressure, shear) = scene.TILES.index(tile), STRESSES[tile]
    assert force_map.normal_pressure[place] == pytest.approx(pressure)
    assert force_map.shear[place] == pytest.approx(shear, abs=1e-9)
    assert force_map.normal_pressure_standard_deviation[place] == pytest.approx(1e3)
    assert force_map.shear_standard_deviation[place] == pytest.approx(500.0)


def test_the_force_map_has_errors_by_axis(force_map: Any) -> None:
    """1 kPa of pressure at the front is 0.9 N along x; 0.5 kPa of shear 0.45 N along z."""
    error = force_map.standard_deviations[scene.TILES.index("ant_mid")]
    assert (error.x, error.y, error.z) == pytest.approx((0.9, 0.0, 0.45), abs=1e-9)


# --- estimate/regions

REGIONS = {  # without a side, sectors are called left and right; value, low, high [Pa, -]
    "anterior": {
        "mean": (35.5e3, 33.54e3, 37.46e3),
        "peak": (60e3, 57.55e3, 62.45e3),
        # |(-2 +- 0.98, 2)| kPa
        "shear": (2.8284e3, 2.2451e3, 3.5889e3),
        # 25.65 of 76.275 N downwards; draws: 25.65 of 74.8834 and of 77.6666 N
        "load_share": (0.33628, 0.33026, 0.34253),
    },
    "right": {
        "mean": (17.5e3, 15.8013e3, 19.1987e3),
        "peak": (45e3, 42.55e3, 47.45e3),
    },
    "socket": {"mean": (21.8022e3, 19.9802e3, 23.6241e3), "load_share": (1.0, 1.0, 1.0)},
}


@pytest.fixture(scope="module")
def regions(estimator: OnlineEstimator, estimates: Estimates) -> Any:
    pack = messages.regions_packer([place.name for place in estimator.map.places])
    outputs = estimator.map.outputs()
    assert outputs is not None
    return deserialize_message(pack(STAMP, outputs.regions), msg.RegionPressures)


@pytest.mark.parametrize("name", REGIONS)
def test_regions_hold_the_known_outputs(name: str, regions: Any) -> None:
    place = list(regions.names).index(name)
    for field, answers in REGIONS[name].items():
        for end, answer in zip(("", "_low", "_high"), answers, strict=True):
            found = getattr(regions, f"{field}{end}")[place]
            assert found == pytest.approx(answer, rel=1e-4), f"{field}{end}"


def test_regions_are_in_the_load_cell_s_frame(regions: Any) -> None:
    assert regions.header.frame_id == "load_cell"
    assert regions.names[-1] == "socket" and "left" in regions.names


# --- estimate/pressure_map, for RViz


@pytest.fixture(scope="module")
def markers(estimates: Estimates) -> dict[tuple[str, int], Any]:
    data = PressureMap(scene.geometry()).serialised(STAMP, estimates.force_map)
    return {(m.ns, m.id): m for m in deserialize_message(data, MarkerArray).markers}


def marker(markers: dict[tuple[str, int], Any], space: str, tile: str) -> Any:
    return markers[space, scene.TILES.index(tile)]


ARROWS = {  # anchor [m] and the tip, 2 mm/N away along the force on the socket
    "ant_mid": ((0.05, 0.0, 0.15), (0.158, 0.0108, 0.1419)),
    "right_prox": ((0.0, -0.05, 0.21), (0.0162, -0.131, 0.1884)),
    "post_end": ((-0.02, 0.0, 0.09), (-0.0146, 0.0027, 0.0522)),
}


@pytest.mark.parametrize("tile", ARROWS)
def test_an_arrow_points_along_the_force(tile: str, markers: Any) -> None:
    """From the anchor outwards and down: the limb pushes the socket."""
    arrow = marker(markers, "forces", tile)
    assert arrow.type == arrow.ARROW and arrow.header.frame_id == "load_cell"
    ends = [(p.x, p.y, p.z) for p in arrow.points]
    assert ends[0] == pytest.approx(ARROWS[tile][0], abs=1e-9)
    assert ends[1] == pytest.approx(ARROWS[tile][1], abs=1e-9)
    assert arrow.scale.x < arrow.scale.y  # the shaft is thinner than the head


COLOURS = {  # red, green, blue, opacity: white to dark red over 0 to 30 kPa
    "ant_mid": (0.6, 0.0, 0.0, 1.0),  # 60 kPa is beyond the end
    "left_prox": (0.84, 0.54, 0.54, 1.0),  # 12 kPa: 0.4 of the scale
    "left_mid": (0.96, 0.81, 0.81, 1.0),  # 3 kPa: 0.1
    "right_mid": (1.0, 0.9, 0.9, 1.0),  # pull is as pale as nothing
}


@pytest.mark.parametrize("tile", COLOURS)
@pytest.mark.parametrize("space", ["tiles", "forces"])
def test_a_marker_s_colour_shows_the_pressure(space: str, tile: str, markers: Any) -> None:
    colour = marker(markers, space, tile).color
    assert (colour.r, colour.g, colour.b, colour.a) == pytest.approx(COLOURS[tile], abs=1e-6)


def test_an_uncertain_marker_fades(estimates: Estimates) -> None:
    """With 12 kPa +- 1.75 * 12 kPa a tile is half as grey as can be: 1 - 0.9 / 2."""
    estimate = estimates.force_map
    place = scene.TILES.index("left_prox")
    estimate.normal_pressure_standard_deviation[0, place] = 1.75 * 12e3 / 1.96
    try:
        data = PressureMap(scene.geometry()).serialised(STAMP, estimate)
    finally:
        estimate.normal_pressure_standard_deviation[0, place] = 1e3
    found = {(m.ns, m.id): m for m in deserialize_message(data, MarkerArray).markers}
    assert found["tiles", place].color.a == pytest.approx(0.55, abs=1e-6)


@pytest.mark.parametrize(("tile", "half"), [("ant_mid", 0.015), ("left_prox", 0.02)])
def test_a_tile_is_a_square_in_its_place(tile: str, half: float, markers: Any) -> None:
    """The square of its area about its anchor, in the wall, seen from outside."""
    own, place = marker(markers, "tiles", tile), scene.TILES.index(tile)
    geometry = scene.geometry()
    turn = own.pose.orientation
    rotation = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])
    position = own.pose.position
    assert (position.x, position.y, position.z) == pytest.approx(geometry.anchors[place])
    np.testing.assert_allclose(
        rotation.apply([0.0, 0.0, 1.0]), geometry.rotations[place][:, 2], atol=1e-9
    )
    corners = np.array([(p.x, p.y, p.z) for p in own.points])
    assert np.abs(corners[:, :2]) == pytest.approx(half) and not corners[:, 2].any()
    assert own.type == own.TRIANGLE_LIST and len(corners) == 6
    for first, second, third in corners.reshape(2, 3, 3):
        normal = np.cross(second - first, third - first)
        assert normal[2] < 0.0  # clockwise about the inward normal: its face looks outwards
    edges = [own.scale.x, own.scale.y, own.scale.z]
    assert edges == [1.0, 1.0, 1.0]


# --- the other messages


def test_a_wrench_is_moment_and_force() -> None:
    """The vector is [M; F]; the message has torque and force."""
    data = messages.wrench_packer()(STAMP, scene.wrench()[scene.PEAK_ROW])
    wrench = deserialize_message(data, WrenchStamped).wrench
    torque, force = wrench.torque, wrench.force
    assert (torque.x, torque.y, torque.z) == pytest.approx((0.55, 0.1, 0.5))
    assert (force.x, force.y, force.z) == pytest.approx((14.0, 3.0, -90.0))


def test_local_forces_are_by_tile() -> None:
    forces = np.arange(36.0).reshape(12, 3)
    data = messages.local_forces_packer(scene.TILES)(STAMP, forces)
    found = deserialize_message(data, msg.LocalForceArray)
    force = found.forces[found.names.index("ant_mid")]
    assert (force.x, force.y, force.z) == (12.0, 13.0, 14.0)


def test_a_stress_is_normal_then_shear() -> None:
    values = np.array([[45e3, -12e3, 9e3], [60e3, 6e3, 4.5e3]])
    status = np.array([Status.OK, Status.OUT_OF_RANGE], dtype=np.uint8)
    pack = messages.stress_packer(["brim_lateral", "mid_anterior"])
    found = deserialize_message(pack(STAMP, values, status), msg.ClusterStressArray)
    first, second = found.clusters
    assert (first.name, first.normal, first.shear_x, first.shear_y) == (
        *("brim_lateral", 45e3),
        *(-12e3, 9e3),
    )
    assert (second.name, second.status) == ("mid_anterior", 3)
