"""Exported files of the scene at 12.0 s, read by the programs they are for, against hand values.

At 12.0 s all swings are at zero and the factor is 1.5. The force is (14, 3, -90) N. About the
centre of the tiles, 150 mm above the load cell, the moment is (1, -2, 0.5) N m; at the load cell it
is this plus (0, 0, 0.15) m x F = (-0.45, 2.1, 0) N m.
"""

from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore
from scipy.io import loadmat
from support import scene

import socket_testbed as st

KNEE = (0.02, -0.01, 0.4)  # [m]
# By the title of its column.
ROW = {
    "time [s]": 12.0,
    "Mx [N m]": 0.55,
    "My [N m]": 0.1,
    "Mz [N m]": 0.5,
    "Fx [N]": 14.0,
    "Fy [N]": 3.0,
    "Fz [N]": -90.0,
    # 14 N / 40 N/mm, 3 N / 30 N/mm, 150 mm - 90 N / 20 N/mm
    "q_x [m]": 0.35e-3,
    "q_y [m]": 0.1e-3,
    "q_z [m]": 145.5e-3,
    # 1 / 2, -2 / 3 and 0.5 degrees, small enough to be independent
    "phi_x [rad]": 0.0087266,
    "phi_y [rad]": -0.0116355,
    "phi_z [rad]": 0.0087266,
    # 45 kPa, and shear (-12, 9) kPa: 5 pF + 2.25 pF, -+0.2 pF along x, +-0.15 pF along y
    "brim_lateral.C0 [pF]": 7.6,
    "brim_lateral.C1 [pF]": 7.2,
    "brim_lateral.C2 [pF]": 7.3,
    "brim_lateral.C3 [pF]": 6.9,
    "brim_lateral.status [-]": 0,
    "brim_lateral.normal [Pa]": 45e3,
    "brim_lateral.shear_x [Pa]": -12e3,
    "brim_lateral.shear_y [Pa]": 9e3,
    "brim_lateral.Fx [N]": -10.8,
    "brim_lateral.Fy [N]": 8.1,
    "brim_lateral.Fz [N]": -40.5,
    # Turned by 90 degrees: along the tile (-4.5, 6) kPa, along its own axes (6, 4.5) kPa. Its
    # channels are at the inputs 1, 0, 3, 2: 5 + 3 pF, +-0.1 pF along x, +-0.075 pF along y.
    "mid_anterior.C0 [pF]": 8.175,
    "mid_anterior.C1 [pF]": 7.975,
    "mid_anterior.C2 [pF]": 8.025,
    "mid_anterior.C3 [pF]": 7.825,
    "mid_anterior.normal [Pa]": 60e3,
    "mid_anterior.shear_x [Pa]": 6e3,
    "mid_anterior.shear_y [Pa]": 4.5e3,
    "mid_anterior.Fx [N]": -4.05,
    "mid_anterior.Fy [N]": 5.4,
    "mid_anterior.Fz [N]": -54.0,
    "distal.normal [Pa]": 21e3,
    "distal.Fx [N]": 2.7,
    "distal.Fy [N]": 1.35,
    "distal.Fz [N]": -18.9,
}


def exported(folder: Path, target: Path, **options: Any) -> Path:
    """The samples from 12.0 s to 12.5 s, three of them, in the format of the file's suffix."""
    st.export(folder, target, "12:12.5", **options)
    return target


# --- tables


def table_of(path: Path) -> dict[str, Any]:
    """The first row of a file by its titles, whatever the format."""
    if path.suffix == ".mat":
        content = loadmat(path, simplify_cells=True)
        named = {name: (content[name][0], unit) for name, unit in content["units"].items()}
        return {f"{name} [{unit}]": value for name, (value, unit) in named.items()}
    table = pd.read_csv(path) if path.suffix == ".csv" else pd.read_parquet(path)
    return table.iloc[0].to_dict()


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".mat"])
def test_a_table_holds_the_known_sample(suffix: str, scene_folder: Path, tmp_path: Path) -> None:
    row = table_of(exported(scene_folder, tmp_path / f"a{suffix}"))
    for title, answer in ROW.items():
        key = title.replace(".", "_") if suffix == ".mat" else title
        assert row[key] == pytest.approx(answer, rel=1e-4, abs=1e-7), title
    assert row["stamp [ns]"] == scene.START + 12 * 10**9


def test_parquet_fields_carry_their_units(scene_folder: Path, tmp_path: Path) -> None:
    schema = pq.read_schema(exported(scene_folder, tmp_path / "a.parquet"))
    units = {field.name: field.metadata[b"unit"].decode() for field in schema}
    assert units["Mx [N m]"] == "N m" and units["distal.C0 [pF]"] == "pF"
    assert units["q_z [m]"] == "m" and units["distal.normal [Pa]"] == "Pa"


def test_moments_are_about_the_given_point(scene_folder: Path, tmp_path: Path) -> None:
    """KNEE x F = (-0.3, 7.4, 0.2) N m is taken off."""
    row = table_of(exported(scene_folder, tmp_path / "a.csv", about=KNEE))
    moment = [row[f"{name} [N m]"] for name in ("Mx", "My", "Mz")]
    assert moment == pytest.approx([0.85, -7.3, 0.3])
    assert row["Fz [N]"] == pytest.approx(-90.0)


# --- OpenSim's loads and markers

LOADS = {
    **{"socket_force_vx": 14.0, "socket_force_vy": 3.0, "socket_force_vz": -90.0},
    **{"socket_force_px": 0.0, "socket_force_py": 0.0, "socket_force_pz": 0.0},
    **{"socket_torque_x": 0.55, "socket_torque_y": 0.1, "socket_torque_z": 0.5},
}
ABOUT_KNEE = {
    **{"socket_force_px": 0.02, "socket_force_py": -0.01, "socket_force_pz": 0.4},
    **{"socket_torque_x": 0.85, "socket_torque_y": -7.3, "socket_torque_z": 0.3},
}


@pytest.mark.parametrize("suffix", [".mot", ".sto"])
@pytest.mark.parametrize(
    ("about", "answers"), [(None, LOADS), (KNEE, LOADS | ABOUT_KNEE)], ids=["cell", "knee"]
)
def test_opensim_reads_the_known_loads(
    suffix: str, about: Any, answers: dict[str, float], scene_folder: Path, tmp_path: Path
) -> None:
    path = exported(scene_folder, tmp_path / f"a{suffix}", about=about)
    lines = path.read_text().splitlines()
    assert lines[1:6] == ["version=1", "nRows=3", "nColumns=10", "inDegrees=no", "endheader"]
    row = pd.read_csv(path, sep="\t", skiprows=6).iloc[0]
    assert row["time"] == 12.0 and [*row.index] == ["time", *LOADS]
    for title, answer in answers.items():
        assert row[title] == pytest.approx(answer, abs=1e-6), title


# The socket's triad (0, 0, 0), (90, 0, 10) and (-10, 45, 0) mm, turned by 1.2 rad about z, at
# (1000, 2000, 500) mm in the world: cos 1.2 = 0.36236, sin 1.2 = 0.93204.
SOCKET_MARKERS = [
    [1000.0, 2000.0, 500.0],
    [1032.6122, 2083.8835, 510.0],
    [954.4347, 2006.9857, 500.0],
]


def test_opensim_reads_the_known_markers(scene_folder: Path, tmp_path: Path) -> None:
    path = exported(scene_folder, tmp_path / "a.trc")
    lines = [line.split("\t") for line in path.read_text().splitlines()]
    head = dict(zip(lines[1], lines[2], strict=True))
    assert head["Units"] == "mm" and head["NumFrames"] == "3" and head["NumMarkers"] == "6"
    assert head["DataRate"] == head["CameraRate"] == "4"
    assert lines[3][:2] == ["Frame#", "Time"]
    assert [name for name in lines[3][2:] if name] == [
        *("socket_1", "socket_2", "socket_3"),
        *("pylon_1", "pylon_2", "pylon_3"),
    ]
    assert lines[4][2:8] == ["X1", "Y1", "Z1", "X2", "Y2", "Z2"]
    row = np.array(lines[6], dtype=float)
    assert row[:2].tolist() == [1.0, 12.0]
    np.testing.assert_allclose(row[2:11].reshape(3, 3), SOCKET_MARKERS, atol=1e-3)


# --- C3D


def test_c3d_holds_the_known_frame(scene_folder: Path, tmp_path: Path) -> None:
    file = ezc3d.c3d(str(exported(scene_folder, tmp_path / "a.c3d")))
    point, analog = file["parameters"]["POINT"], file["parameters"]["ANALOG"]
    assert point["RATE"]["value"][0] == analog["RATE"]["value"][0] == 4.0
    assert point["UNITS"]["value"] == ["mm"]
    assert point["LABELS"]["value"][:4] == ["socket_1", "socket_2", "socket_3", "pylon_1"]
    assert analog["LABELS"]["value"] == ["Mx", "My", "Mz", "Fx", "Fy", "Fz"]
    assert analog["UNITS"]["value"] == ["Nm", "Nm", "Nm", "N", "N", "N"]
    np.testing.assert_allclose(file["data"]["points"][:3, :3, 0].T, SOCKET_MARKERS, atol=1e-3)
    wrench = file["data"]["analogs"][0][:, 0]
    np.testing.assert_allclose(wrench, [0.55, 0.1, 0.5, 14.0, 3.0, -90.0], atol=1e-5)


# --- standard messages


@pytest.fixture(scope="module")
def standard(
    scene_folder: Path, by_hand: None, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Any]:
    """The first message on each topic of an exported bag, as the bag library reads it."""
    path = tmp_path_factory.mktemp("standard") / "a.mcap"
    st.export(scene_folder, path, "12:12.5", pressure=True, force_map=True)
    types = get_typestore(Stores.ROS2_JAZZY)
    found: dict[str, Any] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            assert message.log_time >= scene.START + 12 * 10**9
            found.setdefault(channel.topic, types.deserialize_cdr(message.data, schema.name))
    return found


def test_a_standard_bag_holds_the_known_wrench(standard: dict[str, Any]) -> None:
    message = standard["/load_cell/wrench"]
    assert message.header.frame_id == "load_cell"
    assert message.header.stamp.sec == 1_800_000_012 and message.header.stamp.nanosec == 0
    force, torque = message.wrench.force, message.wrench.torque
    assert (force.x, force.y, force.z) == pytest.approx((14.0, 3.0, -90.0))
    assert (torque.x, torque.y, torque.z) == pytest.approx((0.55, 0.1, 0.5))


def test_a_standard_bag_holds_the_known_pose(standard: dict[str, Any]) -> None:
    """Half of 1.2 rad about z is in the quaternion."""
    message = standard["/mocap/socket/pose"]
    assert message.header.frame_id == "world"
    position, turn = message.pose.position, message.pose.orientation
    assert (position.x, position.y, position.z) == pytest.approx((1.0, 2.0, 0.5))
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    expected = [0.0, 0.0, np.sin(0.6), np.cos(0.6)]
    np.testing.assert_allclose(quaternion * np.sign(quaternion[3]), expected, atol=1e-9)


NUMBERS = {
    "/brim_lateral/normal_Pa": 45e3,
    "/brim_lateral/shear_x_Pa": -12e3,
    "/mid_anterior/C0_pF": 8.175,
    "/distal/Fz_N": -18.9,
    "/q_z_m": 145.5e-3,
    "/pressure/socket/peak_pressure_kPa": 60.0,
    "/pressure/socket/peak_pressure_low_kPa": 57.55,
    "/pressure/lateral/mean_pressure_kPa": 17.5,
    "/pressure/ant_mid/pressure_kPa": 60.0,
    "/map/ant_mid/Fx_N": 54.0,
    "/map/ant_mid/pressure_Pa": 60e3,
    "/map/ant_mid/shear_Pa": 7.5e3,
}


@pytest.mark.parametrize("topic", NUMBERS)
def test_a_standard_bag_holds_the_known_numbers(topic: str, standard: dict[str, Any]) -> None:
    assert standard[topic].data == pytest.approx(NUMBERS[topic], rel=1e-4)


# --- computed columns

ADDED = {
    "pressure.anterior.mean pressure [kPa]": 35.5,
    "pressure.anterior.mean pressure low [kPa]": 33.54,
    "pressure.anterior.mean pressure high [kPa]": 37.46,
    "pressure.lateral.centre of pressure y [mm]": -45.0,
    "map.ant_mid.Fx [N]": 54.0,
    "map.ant_mid.Fy [N]": 5.4,
    "map.ant_mid.Fz [N]": -4.05,
    "map.ant_mid.pressure [Pa]": 60e3,
    "map.ant_mid.pressure.sd [Pa]": 1e3,
}


@pytest.mark.parametrize("title", ADDED)
def test_computed_columns_hold_the_known_outputs(
    title: str, scene_folder: Path, by_hand: None, tmp_path: Path
) -> None:
    path = exported(scene_folder, tmp_path / "a.csv", pressure=True, force_map=True)
    assert table_of(path)[title] == pytest.approx(ADDED[title], rel=1e-4)
