"""Pictures and pages of a socket: what is drawn is what the geometry says; nothing is loaded."""

from __future__ import annotations

import base64
import dataclasses
import gzip
import html
import json

import matplotlib as mpl
import numpy as np
import pytest
import trimesh
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread
from scipy.spatial.transform import Rotation
from support import SHARED_DATA
from support.pages import Page
from support.problems import random_socket
from support.ring_socket import ring_socket

from socket_testbed.errors import ConfigurationError, ScanError, TestbedError
from socket_testbed.geometry.axis import SocketAxis, axis_through
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.report.figures.scene import (
    TileValues,
    neighbour_trace,
    socket_page,
    tile_traces,
    value_traces,
)
from socket_testbed.report.figures.socket_picture import (
    DISTAL,
    SIDES,
    draw_surface,
    draw_view,
    frame_view,
    socket_picture,
)
from socket_testbed.report.figures.style import CLUSTER, TILE
from socket_testbed.report.figures.tiles import (
    drawable_surface,
    paint_tiles,
    place_axes,
    tile_squares,
    value_range,
)
from socket_testbed.report.figures.unrolled import draw_unrolled, wall_tiles

SCAN = SHARED_DATA / "ampscan" / "stl_file.stl"
DISTAL_RADIUS, TAPER, WALL = 0.046, np.radians(6.0), 0.215  # [m], [rad], [m]
NASTY = "</script><b>a & \"b\" 'c' $\\frac$"


def cone(around: int = 60, along: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """The interior of the package's own socket, with a wavy brim and a flat distal end."""
    angle = np.arange(around) * 2.0 * np.pi / around
    height, angle = np.meshgrid(np.linspace(0.0, 1.0, along + 1), angle, indexing="ij")
    radius = DISTAL_RADIUS + WALL * np.sin(TAPER) * height
    z = 0.08 + WALL * np.cos(TAPER) * height + 0.01 * height**3 * np.cos(2.0 * angle)
    wall = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1).reshape(-1, 3)
    ring, place = np.meshgrid(np.arange(along), np.arange(around), indexing="ij")
    a, b = ring * around + place, ring * around + (place + 1) % around
    quads = np.stack([a, b, b + around, a + around], axis=-1).reshape(-1, 4)
    end = np.column_stack([b[0], a[0], np.full(around, len(wall))])
    faces = np.vstack([quads[:, [0, 2, 1]], quads[:, [0, 3, 2]], end])
    return np.vstack([wall, [0.0, 0.0, 0.08]]), faces


@pytest.fixture
def rng():
    return np.random.default_rng(5)


@pytest.fixture(scope="module")
def geometry() -> SocketGeometry:
    return ring_socket()


@pytest.fixture(scope="module")
def surface() -> trimesh.Trimesh:
    return drawable_surface(*cone(), 10_000)


@pytest.fixture(scope="module")
def middle(surface) -> SocketAxis:
    """The vertical axis through the surface's middle, heights being z of {S}."""
    return axis_through(
        np.array([*surface.bounds.mean(axis=0)[:2], 0.0]), np.array([0.0, 0.0, 1.0])
    )


@pytest.fixture
def tilted(rng) -> SocketGeometry:
    """Tiles of all sizes in all directions."""
    geometry = random_socket(rng, rings=3, columns=5)
    turns = Rotation.random(len(geometry), random_state=7).as_matrix()
    return dataclasses.replace(
        geometry, rotations=turns, areas=rng.uniform(1e-5, 1e-3, len(geometry))
    )


def area_of(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Area of a surface."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


def renamed(geometry: SocketGeometry, name: str) -> SocketGeometry:
    """The same socket; a tile and the cluster on it have another name."""
    tile = next(iter(geometry.clusters.values()))
    names = list(geometry.names)
    names[tile] = name
    clusters = {
        name if covered == tile else cluster: covered
        for cluster, covered in geometry.clusters.items()
    }
    return dataclasses.replace(geometry, names=tuple(names), clusters=clusters)


# --- the squares


def test_a_square_has_the_tiles_area_and_lies_in_its_plane_along_its_axes(tilted):
    for corners, anchor, R, area in zip(
        tile_squares(tilted), tilted.anchors, tilted.rotations, tilted.areas, strict=True
    ):
        edges = np.roll(corners, -1, axis=0) - corners
        np.testing.assert_allclose(np.linalg.norm(edges, axis=1), np.sqrt(area), rtol=1e-12)
        np.testing.assert_allclose((corners - anchor) @ R[:, 2], 0.0, atol=1e-15)
        np.testing.assert_allclose(corners.mean(axis=0), anchor, atol=1e-15)
        np.testing.assert_allclose(edges[0] / np.sqrt(area), R[:, 0], atol=1e-12)
        np.testing.assert_allclose(edges[1] / np.sqrt(area), R[:, 1], atol=1e-12)


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.05, 0.0, 0.1), (3.0, -4.0, 0.5)])
def test_the_axes_have_a_round_length_and_stay_near_the_socket(offset):
    low, high = np.array([-0.06, -0.05, 0.0]) + offset, np.array([0.06, 0.05, 0.2]) + offset
    axes = place_axes(low, high)
    diagonal = np.linalg.norm(high - low)
    assert 0.08 * diagonal < axes.length < 0.3 * diagonal
    assert float(f"{axes.length:.0e}") == pytest.approx(axes.length)
    assert np.linalg.norm(np.clip(axes.start, low, high) - axes.start) < diagonal
    assert axes.moved == (np.linalg.norm(axes.start) > 0.0)
    assert ("moved" in axes.describe()) == axes.moved


# --- the surface


def test_a_small_surface_is_drawn_as_it_is():
    vertices, faces = cone()
    surface = drawable_surface(vertices, faces, len(faces))
    np.testing.assert_array_equal(surface.vertices, vertices)
    np.testing.assert_array_equal(surface.faces, faces)


@pytest.mark.parametrize("most_faces", [2_000, 8_000, 30_000])
def test_a_simplified_surface_keeps_its_size_its_area_and_its_brim(most_faces):
    mesh = trimesh.Trimesh(*cone(240, 160), process=False)
    simplified = drawable_surface(mesh.vertices, mesh.faces, most_faces)
    assert most_faces / 2 < len(simplified.faces) <= most_faces
    result = trimesh.Trimesh(simplified.vertices, simplified.faces, process=False)
    assert result.area == pytest.approx(mesh.area, rel=0.03)
    assert simplified.area == pytest.approx(area_of(simplified.vertices, simplified.faces))
    np.testing.assert_allclose(simplified.bounds, mesh.bounds, atol=0.02 * mesh.extents.max())
    outwards = (result.face_normals[:, :2] * result.triangles_center[:, :2]).sum(axis=1) > 0.01
    assert result.area_faces[outwards].sum() < 0.005 * result.area  # where the merging folds it

    angle = np.arctan2(result.vertices[:, 1], result.vertices[:, 0])
    height = result.vertices[:, 2]
    sector = np.minimum(np.floor(angle / np.radians(15.0)), 11.0)
    tops = [np.flatnonzero(sector == s)[height[sector == s].argmax()] for s in np.unique(sector)]
    assert len(tops) == 24
    brim = 0.08 + WALL * np.cos(TAPER) + 0.01 * np.cos(2.0 * angle[tops])
    np.testing.assert_allclose(height[tops], brim, atol=4e-4)


def test_faces_that_share_no_vertex_are_simplified_too():
    vertices, faces = cone(100, 80)
    soup = drawable_surface(
        vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3), 5000
    )
    assert 1000 < len(soup.faces) <= 5000
    assert soup.area == pytest.approx(area_of(vertices, faces), rel=0.04)


@pytest.mark.skipif(not SCAN.exists(), reason="the scan is not here")
def test_a_real_scan_keeps_its_size_and_area():
    mesh = trimesh.load(SCAN)
    simplified = drawable_surface(1e-3 * mesh.vertices, mesh.faces, 4_000)
    assert len(simplified.faces) <= 4_000
    assert simplified.area == pytest.approx(1e-6 * mesh.area, rel=0.03)
    np.testing.assert_allclose(simplified.bounds, 1e-3 * mesh.bounds, atol=2e-3)


TRIANGLE = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])


@pytest.mark.parametrize(
    ("vertices", "faces", "fact"),
    [
        (TRIANGLE[:, :2], [[0, 1, 2]], "vertices have the shape (3, 2)"),
        (TRIANGLE, np.zeros((0, 3), dtype=int), "faces have the shape (0, 3)"),
        (TRIANGLE, [[0, 1, 3]], "none of the 3"),
        (TRIANGLE, [[0, 1, -1]], "none of the 3"),
        (TRIANGLE, [[0.0, 1.0, 2.0]], "no whole numbers"),
        (TRIANGLE * np.nan, [[0, 1, 2]], "not finite"),
        (TRIANGLE * 1e3, [[0, 1, 2]], "is 100 m long"),
        (TRIANGLE * 0.0, [[0, 1, 2]], "is 0 m long"),
    ],
)
def test_what_is_no_surface_is_refused(vertices, faces, fact):
    with pytest.raises(ScanError) as error:
        drawable_surface(np.asarray(vertices), np.asarray(faces), 100)
    assert fact in error.value.fact


def test_loose_crumbs_are_refused():
    corners = np.random.default_rng(1).uniform(0.0, 0.2, (20, 1, 3)) + 1e-6 * TRIANGLE
    with pytest.raises(ScanError, match="hang together"):
        drawable_surface(corners.reshape(-1, 3), np.arange(60).reshape(-1, 3), 5)


# --- the traces of a page


def polylines(trace) -> list[np.ndarray]:
    """The lines of a trace between its gaps, each (k, 3)."""
    points = np.column_stack([trace.x, trace.y, trace.z]).astype(float)
    gaps = np.flatnonzero(np.isnan(points[:, 0]))
    return [part[~np.isnan(part[:, 0])] for part in np.split(points, gaps + 1) if len(part) > 1]


def test_the_outlines_of_a_page_are_the_squares_in_mm(tilted):
    outlines = [line for t in tile_traces(tilted) if t.type == "scatter3d" for line in polylines(t)]
    assert len(outlines) == len(tilted)
    expected = {tuple(np.round(1e3 * c.mean(axis=0), 2)): c for c in tile_squares(tilted)}
    for line in outlines:
        np.testing.assert_array_equal(line[0], line[-1])
        square = expected.pop(tuple(np.round(line[:4].mean(axis=0), 2)))
        np.testing.assert_allclose(line[:4], 1e3 * square, atol=1e-4)


def test_the_filled_squares_of_a_page_cover_the_tiles_areas(tilted):
    for trace, tiles in (
        (tile_traces(tilted)[0], np.setdiff1d(range(15), list(tilted.clusters.values()))),
        (tile_traces(tilted)[1], np.sort(list(tilted.clusters.values()))),
    ):
        faces = np.column_stack([trace.i, trace.j, trace.k])
        mesh = trimesh.Trimesh(np.column_stack([trace.x, trace.y, trace.z]), faces, process=False)
        areas = mesh.area_faces.reshape(-1, 4).sum(axis=1)
        np.testing.assert_allclose(areas, 1e6 * tilted.areas[tiles], rtol=1e-4)
        normals = mesh.face_normals.reshape(-1, 4, 3)
        normals_of_tiles = tilted.rotations[tiles, :, 2]
        np.testing.assert_allclose(
            np.einsum("tfi,ti->tf", normals, normals_of_tiles), 1.0, atol=1e-4
        )


def test_the_pointer_tells_name_anchor_area_and_normal(geometry):
    text = tile_traces(geometry)[0].text[0]
    assert text.split("<br>") == [
        "<b>ring1_01</b>",
        "anchor (48.6, 0.0, 104.6) mm",
        "area 900.0 mm²",
        "inward normal (-0.995, 0.000, 0.105)",
    ]


def test_neighbours_are_joined_and_wait_in_the_legend(geometry):
    trace = neighbour_trace(geometry)
    assert trace.visible == "legendonly"
    expected = 1e3 * geometry.anchors[geometry.neighbours]
    np.testing.assert_allclose(polylines(trace), expected, atol=1e-4)


def test_values_colour_the_tiles_of_a_page(geometry, rng):
    values = rng.uniform(2.0, 70.0, len(geometry))
    values[[3, 11]] = np.nan
    found = TileValues("pressure [kPa]", values).document(geometry)
    (row,) = found["values"]
    np.testing.assert_allclose([np.nan if v is None else v for v in row], values)
    assert [row[3], row[11], found["times"]] == [None] * 3
    assert (found["low"], found["high"]) == (np.nanmin(values), np.nanmax(values))
    assert found["unit"] == "pressure [kPa]"
    coloured, white = (t for t in value_traces(geometry) if t.type == "mesh3d")
    # Light and shade would make other colours of those of the bar.
    assert (coloured.lighting.ambient, coloured.lighting.diffuse) == (1.0, 0.0)
    for trace in (coloured, white):
        points = np.column_stack([trace.x, trace.y, trace.z]).reshape(-1, 5, 3)
        np.testing.assert_allclose(points[:, :4], 1e3 * tile_squares(geometry), atol=1e-4)


def test_instants_share_one_scale_and_have_their_times(geometry, rng):
    values, times = rng.uniform(0.0, 70.0, (3, len(geometry))), np.array([0.0, 1.25, 7.0])
    found = TileValues("pressure [kPa]", values, times).document(geometry)
    assert (found["low"], found["high"]) == (values.min(), values.max())
    assert found["times"] == [0.0, 1.25, 7.0]
    np.testing.assert_allclose(found["values"], values, rtol=5e-4)


@pytest.mark.parametrize(
    ("change", "fact"), [(lambda v: v[:-1], "shape (66,)"), (lambda v: v / 0, "'ring1_01'")]
)
@pytest.mark.parametrize(
    "draw", [lambda geometry, v: TileValues("", v).document(geometry), paint_tiles]
)
def test_values_that_are_not_the_tiles_are_refused(geometry, draw, change, fact):
    with np.errstate(divide="ignore"):
        values = change(np.ones(len(geometry)))
    with pytest.raises(ConfigurationError) as error:
        draw(geometry, values)
    assert fact in error.value.fact


@pytest.mark.parametrize("values", [[5.0, 5.0], [0.0, 0.0], [np.nan, -3.0], [np.nan, np.nan]])
def test_a_scale_has_two_ends_around_the_values(geometry, values):
    low, high = value_range(geometry, np.resize(values, len(geometry)))
    assert low < high
    assert not np.any((np.array(values) < low) | (np.array(values) > high))


# --- the panels of a picture


def panel():
    figure = Figure(figsize=(12.0, 5.0), layout="constrained")
    return figure, figure.add_subplot()


def texts(axis) -> list[str]:
    return [text.get_text().replace("\n", "") for text in axis.texts]


def polygons(collection) -> np.ndarray:
    return np.array([path.vertices[:4] for path in collection.get_paths()])


def test_values_colour_the_tiles_of_a_picture(geometry, surface, middle, rng):
    values = rng.uniform(-3.0, 9.0, len(geometry))
    values[4] = np.nan
    paint = paint_tiles(geometry, values)
    share = (values - np.nanmin(values)) / np.ptp(values[np.isfinite(values)])
    known = np.isfinite(values)
    np.testing.assert_allclose(
        paint.fills[known], mpl.colormaps["cividis"](share[known]), atol=0.01
    )
    np.testing.assert_array_equal(paint.fills[4], 1.0)
    greys = paint.fills[known] @ [0.2126, 0.7152, 0.0722, 0.0]
    assert (np.diff(greys[np.argsort(values[known])]) > -0.01).all()

    _, axis = panel()
    draw_unrolled(axis, geometry, paint, middle, surface)
    tiles = np.flatnonzero(wall_tiles(geometry, middle))
    np.testing.assert_array_equal(axis.collections[1].get_facecolors(), paint.fills[tiles])
    assert paint.scale.get_clim() == pytest.approx((np.nanmin(values), np.nanmax(values)))


def test_without_values_there_is_no_colour_scale(geometry):
    assert paint_tiles(geometry).scale is None


def test_the_unrolled_wall_shows_each_tile_at_its_angle_and_height(geometry, surface, middle):
    _, axis = panel()
    draw_unrolled(axis, geometry, paint_tiles(geometry), middle, surface)
    tiles = np.flatnonzero(wall_tiles(geometry, middle))
    assert [geometry.names[t] for t in tiles] == texts(axis)
    squares = polygons(axis.collections[1])
    x, y, z = geometry.anchors[tiles].T
    off = squares[..., 0].mean(axis=1) - np.degrees(np.arctan2(y, x))
    np.testing.assert_allclose((off + 180.0) % 360.0, 180.0, atol=0.1)
    np.testing.assert_allclose(squares[..., 1].mean(axis=1), 1e3 * z, atol=1e-6)
    # No tile is torn at the end of the turn: each is as wide as its edge at its radius.
    width = np.radians(np.ptp(squares[..., 0], axis=1)) * np.hypot(x, y)
    np.testing.assert_allclose(width, 0.030, rtol=0.12)
    assert axis.get_xlim()[0] < squares[..., 0].min()
    assert axis.get_xlim()[1] > squares[..., 0].max()


def test_every_tile_has_its_name_in_the_unrolled_wall_or_on_the_distal_end(
    geometry, surface, middle
):
    _, unrolled = panel()
    _, end = panel()
    paint = paint_tiles(geometry)
    draw_unrolled(unrolled, geometry, paint, middle, surface)
    frame_view(end, DISTAL, *surface.bounds)
    rest = np.flatnonzero(~wall_tiles(geometry, middle))
    draw_view(end, DISTAL, geometry, paint, rest)
    assert sorted(texts(unrolled) + texts(end)) == sorted(geometry.names)


def test_a_cluster_with_a_name_of_its_own_stands_beside_the_tiles(geometry, surface, middle):
    named = dataclasses.replace(geometry, clusters={"knee": geometry.clusters["mid_anterior"]})
    _, axis = panel()
    draw_unrolled(axis, named, paint_tiles(named), middle, surface)
    assert "mid_anterior(knee)" in texts(axis)


@pytest.mark.parametrize(
    ("view", "towards", "right"),
    [
        (SIDES[0], [1, 0, 0], [0, 1, 0]),
        (SIDES[1], [0, 1, 0], [-1, 0, 0]),
        (SIDES[2], [-1, 0, 0], [0, -1, 0]),
        (SIDES[3], [0, -1, 0], [1, 0, 0]),
    ],
)
def test_a_side_shows_its_tiles_where_an_eye_there_sees_them(
    geometry, surface, middle, view, towards, right
):
    figure, axis = panel()
    low, high = surface.bounds
    frame_view(axis, view, low, high)
    draw_surface(axis, view, surface)
    draw_view(axis, view, geometry, paint_tiles(geometry), np.arange(len(geometry)))
    figure.draw_without_rendering()
    centres = axis.transData.transform(polygons(axis.collections[1]).mean(axis=1))

    ours = np.flatnonzero(wall_tiles(geometry, middle))
    facing = geometry.anchors[ours] @ towards / np.hypot(*geometry.anchors[ours, :2].T)
    seen = ours[facing > 0.2]
    assert len(seen) <= len(centres) <= (facing > 0.1).sum()
    # An orthographic eye: pixels are a scale and a shift away from (right, up).
    plane = geometry.anchors[seen] @ np.column_stack([right, [0, 0, 1]])
    scale = np.ptp(centres[:, 1]) / np.ptp(plane[:, 1])
    assert scale > 0.0
    middle = (low + high) / 2.0 @ np.column_stack([right, [0, 0, 1]])
    pixels = scale * (plane - middle) + axis.bbox.get_points().mean(axis=0)
    apart = np.linalg.norm(pixels[:, None] - centres[None], axis=2).min(axis=1)
    assert apart.max() < 0.5, apart
    names = {
        c for c, t in geometry.clusters.items() if geometry.rotations[t, :, 2] @ towards < -0.6
    }
    assert set(texts(axis)) == names


def test_the_distal_end_is_seen_from_above_with_anterior_up_and_left_on_the_left(
    geometry, surface, middle
):
    figure, axis = panel()
    frame_view(axis, DISTAL, *surface.bounds)
    rest = np.flatnonzero(~wall_tiles(geometry, middle))
    draw_view(axis, DISTAL, geometry, paint_tiles(geometry), rest)
    figure.draw_without_rendering()
    pixels = axis.transData.transform([text.get_position() for text in axis.texts])
    x, y = (pixels - axis.bbox.get_points().mean(axis=0)).T
    for name, right, up in zip(texts(axis), x, y, strict=True):
        anchor = geometry.anchors[geometry.names.index(name)]
        assert np.sign(np.round([up, -right])) == pytest.approx(np.sign(np.round(anchor[:2], 6)))


@pytest.mark.parametrize("name", ["", "            "])
def test_a_name_of_nothing_is_left_out(geometry, surface, middle, name):
    _, axis = panel()
    odd = renamed(geometry, name)
    draw_unrolled(axis, odd, paint_tiles(odd), middle, surface)
    assert len(texts(axis)) == wall_tiles(geometry, middle).sum() - 1


# --- the picture


@pytest.mark.slow
def test_a_picture_has_its_size_and_shows_tiles_and_clusters(geometry, tmp_path):
    (tmp_path / "new").mkdir()
    path = tmp_path / "new" / "socket.png"
    socket_picture(*cone(30, 15), renamed(geometry, NASTY), path, NASTY)
    pixels = imread(path)[..., :3]
    assert pixels.shape == (2200, 2400, 3)
    for colour, share in ((TILE, 0.1), (CLUSTER, 0.003), ("white", 0.2)):
        alike = np.abs(pixels - to_rgb(colour)).max(axis=2) < 0.02
        assert share < alike.mean() < 0.9
    assert [p.name for p in path.parent.iterdir()] == ["socket.png"]


def test_a_picture_can_be_a_pdf(geometry, tmp_path):
    socket_picture(*cone(20, 10), geometry, tmp_path / "socket.PDF", "")
    assert (tmp_path / "socket.PDF").read_bytes().startswith(b"%PDF")


def test_a_picture_of_another_kind_is_refused(geometry, tmp_path):
    with pytest.raises(ConfigurationError, match=r"socket\.bmp.*\.png or \.pdf"):
        socket_picture(*cone(20, 10), geometry, tmp_path / "socket.bmp", "")
    assert not list(tmp_path.iterdir())


# --- the page


def scene(page: Page) -> tuple[list[dict], dict]:
    """The traces and the layout that the page's script draws."""
    figure = json.loads(page.script("scene-figure"))
    return figure["data"], figure["layout"]


def written(tmp_path, geometry, mesh=None, title="A socket", facts=()) -> tuple[str, Page]:
    path = tmp_path / "socket.html"
    socket_page(*(mesh or cone()), geometry, path, title, facts)
    assert [p.name for p in tmp_path.iterdir()] == ["socket.html"]
    text = path.read_text(encoding="utf-8")
    return text, Page(text)


def test_a_page_loads_nothing_and_could_not(geometry, tmp_path):
    text, page = written(tmp_path, geometry)
    assert page.loads and all(what.startswith("data:image/svg+xml,") for what in page.loads)
    assert not page.open
    assert "default-src 'none'" in page.policy
    assert "http" not in page.policy
    assert "@import" not in "".join(page.said["style"])
    assert "url(" not in "".join(page.said["style"])
    viewer = gzip.decompress(base64.b64decode(page.script("scene-viewer"))).decode()
    assert viewer.count("plotly.js v") == 1
    # The viewer's own buttons hold one that sends the chart to somebody.
    assert "displayModeBar: false" in text


def test_a_scene_is_reached_by_keyboard_and_has_a_still_picture_in_its_place(geometry, tmp_path):
    _, page = written(tmp_path, geometry)
    (box,) = [a for _, a in page.tags if a.get("id") == "scene"]
    assert box["tabindex"] == "0" and box["aria-label"] and box["role"]
    assert set(page.said["button"]) >= {"Turn left", "Nearer", "Start view"}
    # Without its script the page shows the picture, and no control that does nothing.
    assert len([tag for tag, _ in page.tags if tag == "img"]) == 1
    assert all("hidden" in a for _, a in page.tags if "needs-scene" in (a.get("class") or ""))


def test_a_page_holds_every_tile_and_equal_axes_in_mm(geometry, tmp_path):
    _, page = written(tmp_path, geometry)
    traces, layout = scene(page)
    shown = {text.split("<br>")[0] for trace in traces for text in trace.get("text", ())}
    assert {f"<b>{name}</b>" for name in geometry.names} <= shown
    assert {" x", " y", " z", " proximal"} <= shown
    assert {a["text"] for a in layout["scene"]["annotations"]} == set(geometry.clusters)
    assert layout["scene"]["aspectmode"] == "data"
    assert layout["scene"]["zaxis"]["title"]["text"] == "z [mm]"
    heights = np.frombuffer(base64.b64decode(traces[0]["z"]["bdata"]), traces[0]["z"]["dtype"])
    np.testing.assert_allclose(heights, 1e3 * cone()[0][:, 2], rtol=1e-6)


def test_names_are_no_markup(geometry, tmp_path):
    facts = [(NASTY, "1 < 2"), ("tiles", NASTY)]
    text, page = written(tmp_path, renamed(geometry, NASTY), title=NASTY, facts=facts)
    assert NASTY not in text
    assert page.said["title"] == page.said["h1"] == [NASTY]
    assert page.tables["facts"][1:] == [[NASTY, "1 < 2"], ["tiles", NASTY]]
    traces, layout = scene(page)
    names = {t.split("<br>")[0][3:-4] for trace in traces for t in trace.get("text", ())}
    names |= {annotation["text"] for annotation in layout["scene"]["annotations"]}
    assert NASTY in {html.unescape(name) for name in names}
    assert not any("<" in name for name in names)


def test_a_page_of_half_a_million_faces_stays_small(geometry, tmp_path):
    text, _ = written(tmp_path, geometry, mesh=cone(500, 500))
    assert len(text.encode()) < 4e6


def test_a_page_needs_neither_clusters_nor_neighbours(geometry, tmp_path):
    bare = dataclasses.replace(geometry, clusters={}, neighbours=np.zeros((0, 2), dtype=np.int64))
    _, page = written(tmp_path, bare)
    assert "tiles with a cluster" not in {trace.get("name") for trace in scene(page)[0]}


def test_a_page_that_fails_leaves_the_older_one(geometry, tmp_path):
    path = tmp_path / "socket.html"
    path.write_text("older")
    with pytest.raises(TestbedError):
        socket_page(*cone(), geometry, path / "below.html", "", ())
    with pytest.raises(TestbedError):
        socket_page(TRIANGLE * 1e3, np.array([[0, 1, 2]]), geometry, path, "", ())
    assert path.read_text() == "older"
    assert [p.name for p in tmp_path.iterdir()] == ["socket.html"]
