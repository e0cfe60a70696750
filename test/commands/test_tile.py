"""The verb `tile`, through the command line."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import meshes
from support.verbs import call, refused

from socket_testbed.__main__ import run
from socket_testbed.geometry.regions import all_regions
from socket_testbed.geometry.socket import read_socket, write_socket

pytestmark = pytest.mark.slow

CUP = meshes.open_cone(0.05, 0.058, 0.12, 0.004)
# The cup lies: its opening is towards +x, anterior towards -y.
LYING = meshes.moved(CUP, lambda p: p @ np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]) + 0.4)


@pytest.fixture(scope="module")
def cup(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of the cup that lies, in millimetres."""
    return meshes.write_stl(LYING, tmp_path_factory.mktemp("scan") / "cup.stl")


@pytest.fixture(scope="module")
def tiled(cup: Path) -> Path:
    output = cup.with_name("socket.yaml")
    words = ["tile", str(cup), "-o", str(output), "--anterior=-y", "--rounds", "2"]
    assert run(words) == 0
    return output


def test_a_scan_becomes_a_socket(tiled: Path) -> None:
    geometry = read_socket(tiled)
    assert len(geometry) > 25
    assert geometry.anchors[:, 2].min() == pytest.approx(0.08, abs=1e-5)
    middle = geometry.anchors[geometry.clusters["mid_anterior"]]
    assert middle[0] > 0.03 and abs(middle[1]) < 0.04
    assert "cup.stl [mm]" in geometry.source and geometry.registration == ""
    assert tiled.with_suffix(".png").read_bytes()[:4] == b"\x89PNG"
    assert geometry.names[0] in tiled.with_suffix(".html").read_text(encoding="utf-8")


INCHES = ("--anterior=0 -2 0", "--unit", "in", "--rounds", 2)


@pytest.fixture(scope="module")
def registered(tiled: Path) -> Path:
    """The socket, as `register` leaves it."""
    path = tiled.with_name("registered.yaml")
    write_socket(dataclasses.replace(read_socket(tiled), registration="take.csv"), path)
    return path


@pytest.fixture(scope="module")
def in_inches(tiled: Path) -> Path:
    return meshes.write_stl(LYING, tiled.with_name("inches.stl"), "in")


def test_picked_places_of_clusters_are_taken_over(
    tiled: Path, registered: Path, in_inches: Path, tmp_path: Path, capsys
) -> None:
    """The scan and the places picked in it are in inches now; the bodies stay."""
    first = read_socket(tiled)
    assert first.scan is not None
    one, other = (first.clusters[name] for name in ("mid_anterior", "posterior_distal"))
    here = first.anchors[one] + 0.002
    between = first.anchors[other] + 0.013 * first.rotations[other, :, 0]
    turned = first.rotations[other] @ Rotation.from_rotvec([0.0, 0.0, 0.5 * np.pi]).as_matrix()
    in_scan = first.scan.in_load_cell.inverse().apply(here) / meshes.UNITS["in"]
    (tmp_path / "clusters.yaml").write_text(
        f"clusters:\n  here: {{scan: {in_scan.tolist()}}}\n"
        f"  between: {{anchor: {between.tolist()}, frame: {turned.tolist()}}}\n"
    )
    words = ("--clusters", tmp_path / "clusters.yaml", "--bodies", registered)
    output = tmp_path / "socket.yaml"
    code, out, err = call(capsys, "tile", in_inches, "-o", output, *INCHES, *words)
    assert code == 0, err
    geometry = read_socket(output)
    assert set(geometry.clusters) == {"here", "between"}
    found = geometry.anchors[[geometry.clusters["here"], geometry.clusters["between"]]]
    assert np.linalg.norm(found - [here, between], axis=1).max() < 0.003
    assert np.degrees(geometry.turned["between"]) == pytest.approx(90.0, abs=5.0)
    assert "laid at (" in out
    assert geometry.registration == "take.csv"


def test_a_registration_is_not_replaced_unasked(
    registered: Path, in_inches: Path, tmp_path: Path, capsys
) -> None:
    output = shutil.copyfile(registered, tmp_path / "socket.yaml")
    code, _, err = call(capsys, "tile", in_inches, "-o", output, "--replace", *INCHES)
    assert code == 1 and "registered marker bodies" in err and "--bodies" in err


def test_clusters_are_proposed_where_they_tell_most(cup: Path, tmp_path: Path, capsys) -> None:
    output = tmp_path / "six.yaml"
    words = ["tile", cup, "-o", output, "--anterior=-y", "--rounds", "2", "--place", "6"]
    code, _, error = call(capsys, *words, "--keep-out", "posterior")
    geometry = read_socket(output)
    assert code == 0 and "the number matters more than the places" in error
    assert list(geometry.clusters) == [f"cluster_{number}" for number in range(1, 7)]
    tiles = {region.name: set(region.tiles) for region in all_regions(geometry)}
    assert not tiles["posterior"] & set(geometry.clusters.values())


def test_an_unknown_tile_is_refused_unread(tmp_path: Path, capsys) -> None:
    """Before the scan is read: there is none."""
    words = ("--anterior=-y", "--place", "6", "--keep-out", "nowhere")
    output = tmp_path / "six.yaml"
    refused(capsys, "tile", "no scan", "-o", output, *words, named=["tile 'nowhere'"])


TENTH = meshes.scaled(meshes.open_cone(0.06, 0.07, 0.4, 0.02), 0.1)


@pytest.mark.parametrize(
    ("mesh", "words", "message"),
    [
        (TENTH, ("--unit", "mm"), "its unit is likely cm: give --unit cm"),
        (CUP, ("--anterior", "+z"), "--anterior is along"),
    ],
    ids=["unit", "direction"],
)
def test_a_wrong_scale_or_direction_is_refused(
    mesh, words: tuple[str, str], message: str, tmp_path: Path, capsys
) -> None:
    scan, output = meshes.write_stl(mesh, tmp_path / "cup.stl"), tmp_path / "socket.yaml"
    refused(capsys, "tile", scan, "-o", output, "--rounds", 0, *words, named=[message])
    assert not output.exists()


def test_a_real_limb_is_tiled_on_the_inside(shared_data: Path, tmp_path: Path, capsys) -> None:
    output = tmp_path / "socket.yaml"
    words = ("tile", shared_data / "ampscan/stl_file.stl", "-o", output, "--rounds", 0)
    code, _, err = call(capsys, *words)
    assert code == 0, err
    geometry = read_socket(output)
    assert 58 <= len(geometry) <= 84  # 764 cm^2 hold 84 at most


def test_a_real_socket_is_tiled_on_the_inside(shared_data: Path, tmp_path: Path, capsys) -> None:
    """It has no distal end and nothing posterior."""
    output, none = tmp_path / "socket.yaml", tmp_path / "clusters.yaml"
    scan = shared_data / "homebrew_socket/socket.STL"
    words = ("tile", scan, "-o", output, "--rounds", 0, "--body", 1)
    refused(capsys, *words, named=["posterior_distal ", "; distal "])
    none.write_text("clusters: {}\n")
    code, _, err = call(capsys, *words, "--clusters", none)
    assert code == 0, err
    assert 38 <= len(read_socket(output)) <= 56
