"""The verb `tile`, through the command line."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support import SHARED_DATA, meshes
from support.verbs import call

from socket_testbed.__main__ import run
from socket_testbed.geometry.socket import SocketGeometry, read_socket, write_socket

pytestmark = pytest.mark.slow

CUP = meshes.open_cone(0.05, 0.058, 0.12, 0.004)
LIMB, SOCKET = (
    SHARED_DATA / "ampscan" / "stl_file.stl",
    SHARED_DATA / "homebrew_socket" / "socket.STL",
)


@pytest.fixture(scope="module")
def cup(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of a cup that lies: its opening is towards +x, anterior towards -y."""
    folder = tmp_path_factory.mktemp("scan")
    lying = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    mesh = trimesh.Trimesh(lying.apply(CUP.vertices) + 0.4, CUP.faces, process=False)
    return meshes.write_stl(mesh, folder / "cup.stl")


@pytest.fixture(scope="module")
def tiled(cup: Path) -> Path:
    output = cup.with_name("socket.yaml")
    words = ["tile", str(cup), "-o", str(output), "--anterior=-y", "--rounds", "2"]
    assert run(words) == 0
    return output


def overlap_free(geometry: SocketGeometry, mesh: trimesh.Trimesh, flatness: float) -> None:
    """No point of a surface in {S} is under two tiles; every tile is full."""
    points, face = trimesh.sample.sample_surface(mesh, 80_000, seed=3)
    local = (points[None] - geometry.anchors[:, None]) @ geometry.rotations
    half = 0.5 * np.sqrt(geometry.areas)[:, None, None]
    under = (np.abs(local[:, :, :2]) < half).all(axis=2)
    under &= np.abs(local[:, :, 2]) < 2.0 * flatness
    facing = (mesh.face_normals[face] @ geometry.rotations[:, :, 2].T).T
    under &= facing > 0.0
    assert under.sum(axis=0).max() <= 1
    projected = np.where(under, facing, 0.0).sum(axis=1) * mesh.area / len(points)
    assert np.abs(projected / geometry.areas - 1.0).max() < 0.25  # as well as points can tell


def test_a_scan_becomes_a_socket_on_the_load_cell(tiled: Path) -> None:
    geometry = read_socket(tiled)
    assert len(geometry) > 25
    assert list(geometry.clusters) == ["brim_lateral", "mid_anterior", "posterior_distal", "distal"]
    assert geometry.anchors[:, 2].min() == pytest.approx(0.08, abs=1e-5)
    assert geometry.anchors[:, 2].max() < 0.2
    middle = geometry.anchors[geometry.clusters["mid_anterior"]]
    assert middle[0] > 0.03 and abs(middle[1]) < 0.04
    z = geometry.rotations[:, :, 2]
    outward = geometry.anchors * [1.0, 1.0, 0.0]
    assert np.einsum("ti,ti->t", z, outward).max() < 1e-3
    surface = trimesh.Trimesh(CUP.vertices + np.array([0, 0, 0.08]), CUP.faces, process=False)
    overlap_free(geometry, surface, 0.008)
    assert "cup.stl [mm]" in geometry.source and geometry.registration == ""


def test_the_result_is_drawn(tiled: Path) -> None:
    assert tiled.with_suffix(".png").read_bytes()[:4] == b"\x89PNG"
    page = tiled.with_suffix(".html").read_text(encoding="utf-8")
    for name in read_socket(tiled).names:
        assert name in page


def test_a_trial_is_simulated_and_fitted_on_a_tiled_scan(
    tiled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trial, model = tmp_path / "hold", tmp_path / "hold.json"
    words = ("--geometry", tiled, "--duration", 40)
    assert call(capsys, "simulate", "-o", trial, *words)[0] == 0
    code, out, _ = call(capsys, "info", trial)
    assert code == 0 and "cup.stl" in out and "nominal, not registered" in out
    assert call(capsys, "fit", trial, "-o", model)[0] == 0


def test_clusters_and_bodies_are_taken_over(
    cup: Path, tiled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = read_socket(tiled)
    registered = dataclasses.replace(first, registration="take.csv")
    write_socket(registered, tmp_path / "registered.yaml")
    assert first.scan is not None
    one, other = (first.clusters[name] for name in ("mid_anterior", "posterior_distal"))
    here = first.anchors[one] + 0.002
    between = first.anchors[other] + 0.013 * first.rotations[other, :, 0]
    in_scan = 1e3 * first.scan.in_load_cell.inverse().apply(here)
    turned = first.rotations[other] @ Rotation.from_rotvec([0.0, 0.0, 0.5 * np.pi]).as_matrix()
    (tmp_path / "clusters.yaml").write_text(
        f"clusters:\n  here: {{scan: {in_scan.tolist()}}}\n"
        f"  between: {{anchor: {between.tolist()}, frame: {turned.tolist()}}}\n"
    )
    words = ("--clusters", tmp_path / "clusters.yaml", "--bodies", tmp_path / "registered.yaml")
    output = tmp_path / "socket.yaml"
    anterior = ("--anterior=-y", "--rounds", 2)
    code, out, err = call(capsys, "tile", cup, "-o", output, *anterior, *words)
    assert code == 0, err
    geometry = read_socket(output)
    assert set(geometry.clusters) == {"here", "between"}
    surface = trimesh.Trimesh(CUP.vertices + np.array([0, 0, 0.08]), CUP.faces, process=False)
    overlap_free(geometry, surface, 0.008)
    nearest = trimesh.proximity.closest_point(surface, [here, between])[0]
    found = geometry.anchors[[geometry.clusters["here"], geometry.clusters["between"]]]
    assert np.linalg.norm(found - nearest, axis=1).max() < 1e-4
    assert np.degrees(geometry.turned["between"]) == pytest.approx(90.0, abs=5.0)
    x, y, z = 1e3 * here
    for text in (out, output.with_suffix(".html").read_text(encoding="utf-8")):
        assert f"asked at ({x:.1f}, {y:.1f}, {z:.1f}), laid at (" in text
        assert "mm away, turned by " in text
    assert geometry.registration == "take.csv"
    # Without --bodies the registration is not overwritten.
    code, _, err = call(capsys, "tile", cup, "-o", output, "--replace", *anterior)
    assert code == 1 and "registered marker bodies" in err and "--bodies" in err
    assert "nominal" not in err


def test_a_moved_turned_or_rescaled_scan_gives_the_same_socket(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cup = meshes.wavy(meshes.open_cone(0.05, 0.055, 0.05, 0.008, dome=True), 0.005)
    glued = np.array([[0.05, 0.02, 0.02], [-0.05, 0.0, 0.0]])
    found = []
    for seed, unit in enumerate(("mm", "in")):
        rng = np.random.default_rng(seed)
        turned, away = Rotation.random(rng=rng), rng.normal(0.0, 0.3, 3)
        if not seed:
            turned, away = Rotation.identity(), np.zeros(3)
        scan = meshes.moved(cup, lambda points: turned.apply(points) + away)  # noqa: B023
        meshes.write_stl(scan, tmp_path / "scan.stl", unit)
        picked = (turned.apply(glued) + away) / meshes.UNITS[unit]
        lines = [f"  c{i}: {{scan: {point.tolist()}}}" for i, point in enumerate(picked)]
        (tmp_path / "clusters.yaml").write_text("clusters:\n" + "\n".join(lines) + "\n")
        anterior = " ".join(map(str, turned.apply([1.0, 0.0, 0.0])))
        words = ("--unit", unit, f"--anterior={anterior}", "--clusters", tmp_path / "clusters.yaml")
        output = tmp_path / f"{unit}_socket.yaml"
        code, _, err = call(
            capsys, "tile", tmp_path / "scan.stl", "-o", output, "--rounds", 0, *words
        )
        assert code == 0, err
        found.append(read_socket(output))
        assert found[seed].scan is not None
        asked = found[seed].scan.points(picked)
        assert asked == pytest.approx(found[0].scan.points(1e3 * glued), abs=1e-6)
    for name in ("c0", "c1"):
        anchors = [socket.anchors[socket.clusters[name]] for socket in found]
        frames = [socket.rotations[socket.clusters[name]] for socket in found]
        assert np.ptp(anchors, axis=0).max() < 1e-6 and np.ptp(frames, axis=0).max() < 1e-5
    # The search may find another of the tilings that are as good.
    assert np.ptp([len(socket) for socket in found]) <= 1


def test_points_and_landmarks_place_the_same_frame(
    cup: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # In the scan: the origin of {S} 80 mm below the end, x towards -y, so y towards -z.
    scan = {"o": [320.0, 400.0, 400.0], "x": [320.0, 300.0, 400.0], "y": [320.0, 390.0, 350.0]}
    load_cell = {"o": [0.0, 0.0, 0.0], "x": [0.1, 0.0, 0.0], "y": [0.01, 0.05, 0.0]}
    lines = [f"  {k}: {{scan: {scan[k]}, load_cell: {load_cell[k]}}}" for k in scan]
    (tmp_path / "l.yaml").write_text("landmarks:\n" + "\n".join(lines) + "\n")
    points = [" ".join(map(str, scan[k])) for k in "oxy"]
    common = ("--rounds", 0, "--size", 60, "--flatness", 15)
    for name, words in (("p", ("--points", *points)), ("l", ("--landmarks", tmp_path / "l.yaml"))):
        code, _, err = call(
            capsys, "tile", cup, "-o", tmp_path / f"{name}_socket.yaml", *common, *words
        )
        assert code == 0, err
    first, second = read_socket(tmp_path / "p_socket.yaml"), read_socket(tmp_path / "l_socket.yaml")
    assert first.anchors[:, 2].min() > 0.079
    assert first.same_tiles(second)


def in_unit_cube(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    centred = mesh.vertices - mesh.bounds.mean(axis=0)
    return trimesh.Trimesh(2.0 * centred / mesh.extents.max(), mesh.faces, process=False)


def sphere() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=3, radius=0.08)


TENTH = meshes.scaled(meshes.open_cone(0.06, 0.07, 0.4, 0.02), 0.1)
BAD: dict[str, tuple[bytes | trimesh.Trimesh | None, tuple[str, ...], str]] = {
    "missing": (None, (), "No such file"),
    "empty": (b"", (), "not a valid STL"),
    "text": (b"this is no scan, but a note\n" * 20, (), "cup.stl"),
    "truncated": (b"", (), "cup.stl"),
    "too curved": (CUP, ("--size", "70"), "no 70 mm tile"),
    "too small": (meshes.open_cone(0.02, 0.02, 0.025, 0.003), ("--unit", "mm"), "0.025 m long"),
    "a tenth": (TENTH, (), "neither in m nor in mm"),
    "a tenth, in mm": (TENTH, ("--unit", "mm"), "its unit is likely cm: give --unit cm"),
    "wide": (meshes.scaled(CUP, 2.7), (), "0.905 m around, which no socket is"),
    "closed solid": (sphere(), (), "cavity"),
    "normalised": (in_unit_cube(CUP), (), "neither in m nor in mm"),
    "no body": (CUP, ("--body", "7"), "7"),
    "tile size": (CUP, ("--size", "0.03"), "--size"),
    "flatness": (CUP, ("--flatness", "0"), "--flatness"),
    "proximal": (CUP, ("--proximal", "up"), "--proximal is 'up'"),
    "anterior": (CUP, ("--anterior", "+z"), "--anterior is along"),
    "line": (CUP, ("--points", "0 0 0", "1 0 0", "2 0 0"), "on one line"),
    "output": (CUP, (), "not a .yaml file"),
}


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ({"closed": False}, r"\bdistal 1\d mm above the distal end"),
        ({"hole": 0.008}, "distal beside a hole of 7 mm around the axis"),
    ],
    ids=["open", "hole"],
)
def test_usual_places_that_a_socket_lacks_are_listed(
    shape: dict[str, float], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = meshes.write_stl(meshes.open_cone(0.05, 0.06, 0.13, 0.008, **shape), tmp_path / "s.stl")
    words = ("-o", tmp_path / "socket.yaml", "--rounds", 0, "--proximal=+z", "--anterior=+x")
    code, _, err = call(capsys, "tile", scan, *words)
    assert code == 1 and re.search(message, err) and "--clusters" in err, err
    assert not (tmp_path / "socket.yaml").exists()


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content, words, message = BAD[case]
    scan = tmp_path / "cup.stl"
    if isinstance(content, bytes):
        scan.write_bytes(content)
    elif content is not None:
        unit = "m" if case == "normalised" else "mm"
        meshes.write_stl(content, scan, unit)
    if case == "truncated":
        meshes.write_stl(CUP, scan)
        scan.write_bytes(scan.read_bytes()[:-700])
    output = tmp_path / ("socket.txt" if case == "output" else "socket.yaml")
    code, _, err = call(capsys, "tile", scan, "-o", output, "--rounds", 0, *words)
    line = err.splitlines()[-1]
    assert code == 1 and line.startswith("socket-testbed tile: error: ") and message in line
    assert not output.exists()


@pytest.mark.skipif(not LIMB.exists(), reason="the real scans are not here")
def test_a_real_limb_is_tiled_inside(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "socket.yaml"
    code, _, err = call(capsys, "tile", LIMB, "-o", output, "--rounds", 0)
    assert code == 0, err
    geometry = read_socket(output)
    assert 58 <= len(geometry) <= 84  # 764 cm^2 hold 84 at most
    # The scan's normals point out; the tiles' point to the axis all the same.
    z, middle = geometry.rotations[:, :, 2], geometry.anchors.mean(axis=0)
    inward = np.einsum("ti,ti->t", z, (middle - geometry.anchors) * [1.0, 1.0, 0.3])
    assert (inward > 0.0).mean() > 0.95


@pytest.mark.skipif(not SOCKET.exists(), reason="the real scans are not here")
def test_a_real_socket_is_tiled_on_its_inner_wall(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "socket.yaml"
    code, _, err = call(capsys, "tile", SOCKET, "-o", output)
    assert code == 1 and "has 2 bodies" in err and "--body" in err
    words = ("tile", SOCKET, "-o", output, "--rounds", 0, "--body", 1)
    code, _, err = call(capsys, *words)  # it has no distal end and nothing posterior
    assert code == 1 and "posterior_distal " in err and "; distal " in err
    (tmp_path / "clusters.yaml").write_text("clusters: {}\n")
    code, _, err = call(capsys, *words, "--clusters", tmp_path / "clusters.yaml")
    assert code == 0, err
    geometry = read_socket(output)
    assert 38 <= len(geometry) <= 56
