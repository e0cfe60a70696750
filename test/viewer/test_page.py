"""The page draws while a browser is open, for slow ones less often."""

import threading
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
from support import HANGS
from support.ring_socket import ring_socket
from viser import __version__ as viser_version
from websockets.sync.client import ClientConnection, connect

from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.viewer.page import Page
from socket_testbed.viewer.server import PageServer
from socket_testbed.viewer.source import Instant

GEOMETRY = ring_socket()
CAMERA = {
    "type": "ViewerCameraMessage",
    **{"wxyz": (1, 0, 0, 0), "position": (1, 0, 0), "fov": 1.0, "near": 0.1, "far": 10.0},
    **{"image_height": 100, "image_width": 100, "look_at": (0, 0, 0), "up_direction": (0, 0, 1)},
}


class Moving:
    """A source whose every instant is another."""

    geometry = GEOMETRY
    controls = playback = None

    def __init__(self) -> None:
        self.random = np.random.default_rng(1)
        self.drawn = 0
        self.is_watched = threading.Event()
        self.is_alone = threading.Event()
        self.silent = False

    def instant(self) -> Instant:
        self.drawn += 1
        n = len(GEOMETRY)
        pressure = self.random.uniform(0.0, 20e3, (1, n))
        forces = self.random.normal(0.0, 1.0, (1, n, 3))
        estimate = MapEstimate(
            forces, abs(forces), pressure, pressure / 5, pressure / 3, pressure / 6, "measured: all"
        )
        nothing = np.full(6, np.nan)
        shown = None if self.silent else estimate
        return Instant(self.drawn, 0.05 * self.drawn, shown, nothing, nothing, None, None)

    def wrenches(self) -> tuple[Any, Any, Any]:
        return np.zeros(0), np.zeros((0, 6)), np.zeros((0, 6))

    def sensors(self) -> list[Any]:
        return []

    def recording(self) -> None:
        return None

    def regions(self) -> None:
        return None

    def watched(self, on: bool) -> None:
        (self.is_watched if on else self.is_alone).set()


@pytest.fixture
def source() -> Moving:
    return Moving()


@pytest.fixture
def page(source: Moving) -> Iterator[tuple[Page, PageServer]]:
    server = PageServer("127.0.0.1", 0)
    page = Page(source, server)
    yield page, server
    page.close()


def browse(server: PageServer, **options: Any) -> ClientConnection:
    """Connect as the page in a browser does."""
    protocol: Any = [f"viser-v{viser_version}"]
    browser = connect(server.url.replace("http", "ws"), subprotocols=protocol, **options)
    browser.send(msgspec.msgpack.encode(CAMERA))
    return browser


def buffered(server: PageServer) -> int:
    return len(server.viser._websock_server._broadcast_buffer.message_from_id)


def test_nothing_is_drawn_while_no_browser_is_open(
    source: Moving, page: tuple[Page, PageServer]
) -> None:
    _, server = page
    assert not source.is_watched.is_set() and source.drawn == 0
    with browse(server):
        assert source.is_watched.wait(HANGS)
        assert not source.is_alone.is_set()
    assert source.is_alone.wait(HANGS)
    drawn = source.drawn
    source.is_watched.clear()
    with browse(server):  # it comes back
        assert source.is_watched.wait(HANGS)
        while source.drawn == drawn:
            pass


def test_a_browser_that_reads_nothing_makes_no_queue(
    source: Moving, page: tuple[Page, PageServer]
) -> None:
    drawing, server = page
    for _ in range(5):
        drawing.draw()
    before = buffered(server)
    # It takes no more than the network's own buffers hold, until it reads.
    with browse(server, max_queue=1) as browser:
        assert source.is_watched.wait(HANGS)
        for _ in range(500):
            drawing.draw()
        assert buffered(server) <= before + 5
        assert len(browser.recv(HANGS)) > 0


def test_an_estimator_that_is_silent_leaves_no_map(
    source: Moving, page: tuple[Page, PageServer]
) -> None:
    drawing, _ = page
    drawing.draw()
    assert drawing._scene._pictures[0]._values.batched_scales.max() > 0.0
    source.silent = True
    drawing.draw()
    assert drawing._scene._pictures[0]._values.batched_scales.max() == 0.0
    assert "no force map" in drawing._legend._words.content
