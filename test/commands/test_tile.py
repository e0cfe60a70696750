"""The verb `tile`, through the command line."""

import dataclasses
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


def test_a_scan_becomes_a_socket_on_the_load_cell(tiled: Path) -> None:
    geometry = read_socket(tiled)
    assert len(geometry) > 25
    assert geometry.anchors[:, 2].min() == pytest.approx(0.08, abs=1e-5)
    middle = geometry.anchors[geometry.clusters["mid_anterior"]]
    assert middle[0] > 0.03 and abs(middle[1]) < 0.04
    assert "cup.stl [mm]" in geometry.source and geometry.registration == ""
    assert tiled.with_suffix(".png").read_bytes()[:4] == b"\x89PNG"
    assert geometry.names[0] in tiled.with_suffix(".html").read_text(encoding="utf-8")


def test_clusters_and_bodies_are_taken_over(tiled: Path, tmp_path: Path, capsys) -> None:
    """The scan and the places picked in it are in inches now."""
    first = read_socket(tiled)
    registered = dataclasses.replace(first, registration="take.csv")
    write_socket(registered, tmp_path / "registered.yaml")
    assert first.scan is not None
    one, other = (first.clusters[name] for name in ("mid_anterior", "posterior_distal"))
    here = first.anchors[one] + 0.002
    between = first.anchors[other] + 0.013 * first.rotations[other, :, 0]
    turned = first.rotations[other] @ Rotation.from_rotvec([0.0, 0.0, 0.5 * np.pi]).as_matrix()
    cup = meshes.write_stl(LYING, tmp_path / "inches.stl", "in")
    in_scan = first.scan.in_load_cell.inverse().apply(here) / meshes.UNITS["in"]
    (tmp_path / "clusters.yaml").write_text(
        f"clusters:\n  here: {{scan: {in_scan.tolist()}}}\n"
        f"  between: {{anchor: {between.tolist()}, frame: {turned.tolist()}}}\n"
    )
    words = ("--clusters", tmp_path / "clusters.yaml", "--bodies", tmp_path / "registered.yaml")
    output = tmp_path / "socket.yaml"
    anterior = ("--anterior=0 -2 0", "--unit", "in", "--rounds", 2)
    code, out, err = call(capsys, "tile", cup, "-o", output, *anterior, *words)
    assert code == 0, err
    geometry = read_socket(output)
    assert set(geometry.clusters) == {"here", "between"}
    found = geometry.anchors[[geometry.clusters["here"], geometry.clusters["between"]]]
    assert np.linalg.norm(found - [here, between], axis=1).max() < 0.003
    assert np.degrees(geometry.turned["between"]) == pytest.approx(90.0, abs=5.0)
    assert "laid at (" in out
    assert geometry.registration == "take.csv"
    # Without --bodies the registration is not overwritten.
    code, _, err = call(capsys, "tile", cup, "-o", output, "--replace", *anterior)
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
    words[1] = "no scan"  # refused before it is read
    refused(capsys, *words, "--replace", "--keep-out", "nowhere", named=["tile 'nowhere'"])


def test_a_wrong_unit_or_direction_is_one_line(tmp_path: Path, capsys) -> None:
    scan, output = tmp_path / "cup.stl", tmp_path / "socket.yaml"
    tenth = meshes.scaled(meshes.open_cone(0.06, 0.07, 0.4, 0.02), 0.1)
    for mesh, words, message in (
        (tenth, ("--unit", "mm"), "its unit is likely cm: give --unit cm"),
        (CUP, ("--anterior", "+z"), "--anterior is along"),
    ):
        meshes.write_stl(mesh, scan)
        refused(capsys, "tile", scan, "-o", output, "--rounds", 0, *words, named=[message])
        assert not output.exists()


def test_real_scans_are_tiled_on_the_inside(shared_data: Path, tmp_path: Path, capsys) -> None:
    limb, socket = shared_data / "ampscan/stl_file.stl", shared_data / "homebrew_socket/socket.STL"
    output, none = tmp_path / "socket.yaml", tmp_path / "clusters.yaml"
    words = ("-o", output, "--rounds", 0)
    code, _, err = call(capsys, "tile", limb, *words)
    assert code == 0, err
    geometry = read_socket(output)
    assert 58 <= len(geometry) <= 84  # 764 cm^2 hold 84 at most

    words += ("--replace",)
    words += ("--body", 1)  # it has no distal end and nothing posterior
    refused(capsys, "tile", socket, *words, named=["posterior_distal ", "; distal "])
    none.write_text("clusters: {}\n")
    code, _, err = call(capsys, "tile", socket, *words, "--clusters", none)
    assert code == 0, err
    assert 38 <= len(read_socket(output)) <= 56
