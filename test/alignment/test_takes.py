"""Exports of motion capture by hand: bodies, markers, units, gaps."""

from pathlib import Path

import numpy as np
import pytest
from support.wording import refused

from socket_testbed.alignment.table_file import TableFormat, read_table
from socket_testbed.alignment.takes import Take, is_take, read_take, table_take, take_poses
from socket_testbed.errors import ConfigurationError

# Two frames; the second moved by 10 mm along x, a marker lost.
NEXUS = """Trajectories
100
,,Socket:A,,,Socket:B,,,Socket:C,,
Frame,Sub Frame,X,Y,Z,X,Y,Z,X,Y,Z
,,mm,mm,mm,mm,mm,mm,mm,mm,mm
101,0,0,0,0,60,0,0,0,90,0
102,0,10,0,0,70,0,0,10,90,0
103,0,10,0,0,70,0,0,,,
"""
DEVICES = """Devices
1000
,,Force Plate - Force,,
Frame,Sub Frame,Fx,Fy,Fz
,,N,N,N
1,0,1,2,3

"""
BODY = np.array([[0.0, 0.0, 0.0], [0.06, 0.0, 0.0], [0.0, 0.09, 0.0]])
# Yaw by 90 deg: x to y, y to -x. By columns: (0, 1, 0), (-1, 0, 0), (0, 0, 1).
TURNED = "0\t1\t0\t-1\t0\t0\t0\t0\t1"
BY_ROW = "0\t-1\t0\t1\t0\t0\t0\t0\t1"
LOST = "\t".join(["0.000"] * 16)
TITLES = "X\tY\tZ\tRoll\tPitch\tYaw\tResidual\t" + "\t".join(f"Rot[{k}]" for k in range(9))


def qualisys(matrix: str = TURNED, titles: str = f"Socket {TITLES}\tLimb {TITLES}") -> str:
    row = f"100.0\t200.0\t300.0\t0.0\t0.0\t90.0\t0.1\t{matrix}"
    return (
        "NO_OF_FRAMES\t2\nNO_OF_CAMERAS\t8\nNO_OF_BODIES\t2\nFREQUENCY\t50\nDATA_INCLUDED\t6D\n"
        f"BODY_NAMES\tSocket\tLimb\n{titles}\n{row}\t{row}\n{LOST}\t{row}\n"
    )


def written(path: Path, text: str) -> Path:
    path.write_text(text, newline="\r\n")
    return path


@pytest.mark.parametrize("text", [NEXUS, DEVICES + NEXUS, f"\n\n{NEXUS}\n"],
                         ids=["alone", "devices", "blank lines"])  # fmt: skip
def test_trajectories_of_nexus(tmp_path: Path, text: str) -> None:
    path = written(tmp_path / "take.csv", text)
    assert is_take(text)
    take = read_take(path)
    assert take.names == ["Socket"]
    np.testing.assert_allclose(take.times, [1.0, 1.01, 1.02])
    np.testing.assert_allclose(take.markers["Socket:B"][1], [0.07, 0.0, 0.0])
    assert np.isnan(take.markers["Socket:C"][2]).all()
    series, _ = take_poses(take, "Socket", BODY)
    np.testing.assert_allclose(series.positions, [[0, 0, 0], [0.01, 0, 0]], atol=1e-9)
    assert series.times.tolist() == [1_000_000_000, 1_010_000_000]


@pytest.mark.parametrize("matrix", [TURNED, BY_ROW], ids=["by columns", "by rows"])
def test_bodies_of_qualisys(tmp_path: Path, matrix: str) -> None:
    take = read_take(written(tmp_path / "take.tsv", qualisys(matrix)))
    assert [*take.bodies] == ["Socket", "Limb"]
    series, _ = take_poses(take, "Limb", BODY)
    assert series.times.tolist() == [0, 20_000_000]
    np.testing.assert_allclose(series.positions[0], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(np.abs(series.quaternions[0]), [0, 0, 0.5**0.5, 0.5**0.5])
    assert series.quaternions[0, 2] * series.quaternions[0, 3] > 0.0
    socket, _ = take_poses(take, "Socket", BODY)
    assert socket.times.tolist() == [0]


WRONG = {
    "no rows": (NEXUS.split("101", maxsplit=1)[0], "no part 'Trajectories' with rows"),
    "devices only": (DEVICES, "no part 'Trajectories'"),
    "metres": (NEXUS.replace("mm", "m"), "the columns of 'Socket:A'"),
    "no rate": (NEXUS.replace("100\n", "fast\n", 1), "its rate is 'fast'"),
    "no bodies": (qualisys().replace("BODY_NAMES", "NAMES"), "names no body"),
    "no matrix": (qualisys(titles=f"Socket {TITLES}\tLimb {TITLES.replace('Rot', 'R')}"),
                  "the columns of 'Limb X'"),
    "other angles": (qualisys(TURNED.replace("-1", "1")), "do not agree with its rotation"),
}  # fmt: skip


@pytest.mark.parametrize("kind", WRONG)
def test_a_take_that_cannot_be_read(tmp_path: Path, kind: str) -> None:
    text, fact = WRONG[kind]
    with refused(ConfigurationError, "take.csv", fact):
        read_take(written(tmp_path / "take.csv", text))


def test_a_real_take_has_one_body(shared_data: Path) -> None:
    take = read_take(shared_data / "motive_csv" / "sample_optitrack_take.csv")
    assert take.names == ["Rigid Body 1"]
    series, _ = take_poses(take, "Rigid Body 1", BODY)
    assert len(series.times) == 250
    np.testing.assert_allclose(series.positions[0], [0.0600, 0.0192, 0.0766], atol=1e-4)


POSES = {
    "dots": ("t [s],socket.x [mm],socket.y [mm],socket.z [mm],socket.qx,socket.qy,socket.qz,"
             "socket.qw", "socket", "100,200,300"),
    "words": ("t [s],Socket Position X (m),Socket Position Y (m),Socket Position Z (m),"
              "Socket Rotation X,Socket Rotation Y,Socket Rotation Z,Socket Rotation W",
              "Socket", "0.1,0.2,0.3"),
    "topics": ("t [s],/socket/pose.position.x [m],/socket/pose.position.y [m],"
               "/socket/pose.position.z [m],/socket/pose.orientation.x,/socket/pose.orientation.y,"
               "/socket/pose.orientation.z,/socket/pose.orientation.w", "socket", "0.1,0.2,0.3"),
    "one body": ("t [s],x [cm],y [cm],z [cm],qx,qy,qz,qw", "body", "10,20,30"),
}  # fmt: skip


def posed(path: Path, titles: str, place: str, turn: str = "0,0,0.6,0.8") -> Take:
    text = f"{titles}\n0,{place},{turn}\n0.01,{place},{turn}\n"
    table = read_table(written(path / "poses.csv", text))
    return table_take(path / "poses.csv", table, TableFormat())


@pytest.mark.parametrize("kind", POSES)
def test_poses_from_a_table(tmp_path: Path, kind: str) -> None:
    titles, body, place = POSES[kind]
    take = posed(tmp_path, titles, place)
    assert take.names == [body]
    series, _ = take_poses(take, body, BODY)
    np.testing.assert_allclose(series.positions, [[0.1, 0.2, 0.3]] * 2)
    np.testing.assert_allclose(series.quaternions, [[0, 0, 0.6, 0.8]] * 2)
    assert series.times.tolist() == [0, 10_000_000]


def test_an_untracked_row_is_no_wrong_quaternion(tmp_path: Path) -> None:
    """Lines 2 and 3 are not tracked, line 5 has a length of 0.5; of equal times the last counts."""
    titles, _, place = POSES["dots"]
    turns = ("0,0,0,0", "0,0,0,0", "0,0,0.6,0.8", "0,0,0.3,0.4")
    rows = [f"{0.01 * row},{place},{turn}\n" for row, turn in enumerate(turns)]
    path = tmp_path / "poses.csv"

    def read(*kept: str) -> Take:
        table = read_table(written(path, "".join((f"{titles}\n", *kept))))
        return table_take(path, table, TableFormat())

    with pytest.raises(ConfigurationError) as caught:
        read(*rows)
    assert str(caught.value) == (
        "line 5: the quaternion of 'socket' is not of length 1: give qx, qy, qz, qw of unit"
        " quaternions"
    )
    with refused(ConfigurationError, "line 6: the quaternion"):
        read(rows[0], *rows)
    series, _ = take_poses(read(*rows[:3]), "socket", BODY)
    assert np.isnan(series.quaternions[:, 3]).tolist() == [True, True, False]


def test_poses_that_cannot_be_read(tmp_path: Path) -> None:
    titles, _, place = POSES["dots"]
    with refused(ConfigurationError, "'socket.x' has no unit", "--units length='m'"):
        posed(tmp_path, titles.replace(" [mm]", ""), place)
    with refused(ConfigurationError, "line 2: the quaternion of 'socket' is not of length 1"):
        posed(tmp_path, titles, place, "0,0,60,80")
    with refused(ConfigurationError, "are both x of 'socket'"):
        posed(tmp_path, titles.replace("socket.y", "socket x"), place)
