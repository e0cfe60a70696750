"""Picture and page of a socket: they show what the geometry says; nothing is loaded."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import trimesh
from support.pages import Page
from support.problems import ring_socket

from socket_testbed.pages.wall import unrolled_tiles
from socket_testbed.report.page import simplify, write_socket_page
from socket_testbed.report.tiles import socket_figure

NASTY = "</script><b>a & \"b\" 'c' $\\frac$"
GEOMETRY = ring_socket()


def sphere(subdivisions: int) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions, radius=0.05)


def test_a_simplified_surface_keeps_its_size_and_its_area() -> None:
    mesh = sphere(5)
    corners = np.arange(mesh.faces.size).reshape(-1, 3)
    soup = trimesh.Trimesh(mesh.vertices[mesh.faces].reshape(-1, 3), corners, process=False)
    for surface in (mesh, soup):
        simplified = simplify(surface, 4_000)
        assert 1_000 < len(simplified.faces) <= 4_000
        assert simplified.area == pytest.approx(mesh.area, rel=0.03)
        np.testing.assert_allclose(simplified.bounds, mesh.bounds, atol=0.02 * mesh.extents.max())
    assert simplify(mesh, len(mesh.faces)) is mesh


def test_the_picture_names_every_tile_in_its_place() -> None:
    named = dataclasses.replace(GEOMETRY, clusters={"knee": GEOMETRY.clusters["mid_anterior"]})
    figure, tiles = socket_figure(named, NASTY), unrolled_tiles(named)
    figure.draw_without_rendering()  # its title is no markup
    names = [name + " (knee)" * (name == "mid_anterior") for name in named.names]
    places = {}
    for axis, on_wall in zip(figure.axes, (True, False), strict=True):
        for text in axis.texts:
            name = text.get_text().replace("\n", "").replace("(", " (")
            places[name] = text.get_position()
            assert tiles.on_wall[names.index(name)] == on_wall
    np.testing.assert_allclose([places[name] for name in names], tiles.corners.mean(axis=1))


def test_a_page_shows_tiles_and_surface_loads_nothing_and_its_names_are_no_markup(tmp_path) -> None:
    path, facts = tmp_path / "socket.html", [(NASTY, "1 < 2"), ("tiles", NASTY)]
    alone = dataclasses.replace(
        GEOMETRY,
        names=(NASTY, *GEOMETRY.names[1:]),
        clusters={NASTY: 0},
        neighbours=np.zeros((0, 2), dtype=np.int64),
    )
    mesh = sphere(3)
    write_socket_page(mesh, alone, path, NASTY, facts)
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert not page.attributes("src", "href", "srcset", "data") and NASTY not in text
    assert page.said["title"] == page.said["h1"] == [NASTY]
    assert page.tables["facts"][1:] == [[NASTY, "1 < 2"], ["tiles", NASTY]]
    shown = json.loads(page.script("page-data"))
    assert NASTY in shown["socket"]["clusters"]
    squares = np.array(shown["socket"]["squares"])[:, :4]
    np.testing.assert_allclose(squares, 1e3 * unrolled_tiles(alone).squares, atol=0.051)
    points = np.array(shown["socket"]["surface"]["points"])
    np.testing.assert_allclose(points, 1e3 * mesh.vertices, atol=0.051)
    np.testing.assert_allclose(shown["extras"]["area [mm^2]"]["values"], 1e6 * GEOMETRY.areas)
