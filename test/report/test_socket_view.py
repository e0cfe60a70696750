"""Pictures and pages of a socket: what is drawn is what the geometry says; nothing is loaded."""

from __future__ import annotations

import base64
import dataclasses
import gzip
import json

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.pages import Page
from support.problems import random_socket
from support.ring_socket import ring_socket

from socket_testbed.geometry.axis import socket_axis, wall_tiles
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.report.figures.tiles import (
    socket_figure,
    tile_squares,
    value_range,
)
from socket_testbed.report.socket_page import simplify, write_socket_page

NASTY = "</script><b>a & \"b\" 'c' $\\frac$"


def cone(around: int = 60, along: int = 40) -> trimesh.Trimesh:
    """The interior of the ring socket, open at both ends."""
    angle = np.arange(around) * 2.0 * np.pi / around
    height, angle = np.meshgrid(np.linspace(0.0, 1.0, along + 1), angle, indexing="ij")
    radius = 0.046 + 0.0225 * height
    wall = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.08 + 0.214 * height], -1)
    ring, place = np.meshgrid(np.arange(along), np.arange(around), indexing="ij")
    a, b = ring * around + place, ring * around + (place + 1) % around
    quads = np.stack([a, b, b + around, a + around], axis=-1).reshape(-1, 4)
    faces = np.vstack([quads[:, [0, 2, 1]], quads[:, [0, 3, 2]]])
    return trimesh.Trimesh(wall.reshape(-1, 3), faces, process=False)


@pytest.fixture(scope="module")
def geometry() -> SocketGeometry:
    return ring_socket()


def names_on(axis) -> list[str]:
    return [text.get_text().replace("\n", "") for text in axis.texts]


def test_a_square_has_the_tiles_area_and_lies_in_its_plane_along_its_axes():
    rng = np.random.default_rng(5)
    tilted = random_socket(rng, rings=3, columns=5)
    turns = Rotation.random(len(tilted), random_state=7).as_matrix()
    tilted = dataclasses.replace(tilted, rotations=turns, areas=rng.uniform(1e-5, 1e-3, 15))
    squares = tile_squares(tilted)
    edges = (np.roll(squares, -1, axis=1) - squares) / np.sqrt(tilted.areas)[:, None, None]
    np.testing.assert_allclose(squares.mean(axis=1), tilted.anchors, atol=1e-15)
    for edge, axis, sign in ((0, 0, 1.0), (1, 1, 1.0), (2, 0, -1.0), (3, 1, -1.0)):
        np.testing.assert_allclose(edges[:, edge], sign * turns[:, :, axis], atol=1e-12)


def test_a_simplified_surface_keeps_its_size_and_its_area():
    mesh = cone(120, 80)
    corners = np.arange(mesh.faces.size).reshape(-1, 3)
    soup = trimesh.Trimesh(mesh.vertices[mesh.faces].reshape(-1, 3), corners, process=False)
    for surface in (mesh, soup):
        simplified = simplify(surface, 4_000)
        assert 1_000 < len(simplified.faces) <= 4_000
        assert simplified.area == pytest.approx(mesh.area, rel=0.03)
        np.testing.assert_allclose(simplified.bounds, mesh.bounds, atol=0.02 * mesh.extents.max())
    assert simplify(mesh, len(mesh.faces)) is mesh


def test_a_scale_has_two_ends(geometry):
    for values in ([5.0, 5.0], [0.0, 0.0], [np.nan, -3.0], [np.nan, np.nan]):
        low, high = value_range(geometry, np.resize(values, len(geometry)))
        assert low < high
        assert not np.any((np.array(values) < low) | (np.array(values) > high))


def test_each_tile_is_at_its_angle_and_height_or_on_the_distal_end(geometry):
    named = dataclasses.replace(geometry, clusters={"knee": geometry.clusters["mid_anterior"]})
    tiles = np.flatnonzero(wall_tiles(geometry, socket_axis(geometry)))
    figure = socket_figure(named, NASTY)
    axis, end = figure.axes
    on_the_wall, on_the_end = names_on(axis), names_on(end)
    squares = np.array([path.vertices[:4] for path in axis.collections[0].get_paths()])
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["tile", "tile with a cluster"]
    assert "mid_anterior(knee)" in on_the_wall
    x, y, z = geometry.anchors[tiles].T
    off = squares[..., 0].mean(axis=1) - np.degrees(np.arctan2(y, x))
    np.testing.assert_allclose((off + 180.0) % 360.0, 180.0, atol=1.0)
    heights = squares[..., 1].mean(axis=1)
    np.testing.assert_allclose(heights - heights[0], 1e3 * (z - z[0]), atol=0.5)
    # No tile is torn at the end of the turn: each is as wide as its edge at its radius.
    width = np.radians(np.ptp(squares[..., 0], axis=1)) * np.hypot(x, y)
    np.testing.assert_allclose(width, 0.030, rtol=0.12)
    assert axis.get_xlim()[0] < squares[..., 0].min() < squares[..., 0].max() < axis.get_xlim()[1]
    # The end is seen from above, with anterior up and left on the left.
    expected = set(geometry.names) - {"mid_anterior"} | {"mid_anterior(knee)"}
    assert {*on_the_wall, *on_the_end} == expected
    figure.draw_without_rendering()  # its title is no markup
    pixels = end.transData.transform([text.get_position() for text in end.texts])
    x, y = (pixels - end.bbox.get_points().mean(axis=0)).T
    for name, right, up in zip(on_the_end, x, y, strict=True):
        anchor = np.round(geometry.anchors[geometry.names.index(name)], 6)
        assert (np.sign(np.round([up, -right])) == np.sign(anchor[:2])).all()


def written(tmp_path, geometry, mesh=None, title="A socket", facts=()) -> tuple[str, Page]:
    path = tmp_path / "socket.html"
    write_socket_page(mesh or cone(), geometry, path, title, facts)
    assert [p.name for p in tmp_path.iterdir()] == ["socket.html"]
    text = path.read_text(encoding="utf-8")
    return text, Page(text)


def test_a_page_loads_nothing_and_shows_every_tile_and_the_surface(geometry, tmp_path):
    text, page = written(tmp_path, geometry)
    assert not page.loads and not page.open
    viewer = gzip.decompress(base64.b64decode(page.script("viewer"))).decode()
    assert viewer.count("plotly.js v") == 1
    # The viewer's own buttons hold one that sends the chart to somebody.
    assert "displayModeBar: false" in text
    shown = json.loads(page.script("page-data"))
    squares = np.array(shown["socket"]["squares"])[:, :4]
    np.testing.assert_allclose(squares, 1e3 * tile_squares(geometry), atol=0.051)
    points = np.array(shown["socket"]["surface"]["points"])
    np.testing.assert_allclose(points, 1e3 * cone().vertices, atol=0.051)
    np.testing.assert_allclose(shown["extras"]["area [mm^2]"]["values"], 1e6 * geometry.areas)


def test_names_are_no_markup_and_a_page_stays_small_and_needs_no_other_clusters(geometry, tmp_path):
    facts = [(NASTY, "1 < 2"), ("tiles", NASTY)]
    renamed = (NASTY, *geometry.names[1:])
    alone = dataclasses.replace(
        geometry,
        names=renamed,
        clusters={NASTY: 0},
        neighbours=np.zeros((0, 2), dtype=np.int64),
    )
    text, page = written(tmp_path, alone, cone(200, 200), NASTY, facts)
    assert NASTY not in text and len(text.encode()) < 4e6
    assert page.said["title"] == page.said["h1"] == [NASTY]
    assert page.tables["facts"][1:] == [[NASTY, "1 < 2"], ["tiles", NASTY]]
    assert NASTY in json.loads(page.script("page-data"))["socket"]["clusters"]
