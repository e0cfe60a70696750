"""The page in a real browser: what it shows, and that it comes back."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser
from support.browser import CHROMIUM, Tab, open_browser
from support.ring_socket import ring_socket

import socket_testbed as st
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.viewer.page import Page
from socket_testbed.viewer.server import PageServer
from socket_testbed.viewer.source import Instant, SensorState

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no browser: chromium is not installed"),
]

GEOMETRY = ring_socket()
PUSHED = int(np.argmax(GEOMETRY.anchors[:, 0]))  # the foremost tile


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return int(listening.getsockname()[1])


class Pushed:
    """A source that shows how hard the foremost tile is pushed, and how a sensor is."""

    geometry = GEOMETRY
    controls = playback = None

    def __init__(self) -> None:
        self.sensor = SensorState("load cell", 0, "measures", 100.0, 0.0)
        self.push(10e3)

    def push(self, pressure: float) -> None:
        n = len(GEOMETRY)
        pressures = np.full((1, n), 2e3)
        pressures[0, PUSHED] = pressure
        forces = np.zeros((1, n, 3))
        words = "prior: mean zero; measured: wrench, " + ", ".join(GEOMETRY.clusters)
        estimate = MapEstimate(
            forces, forces, pressures, 0.02 * pressures, 0 * pressures, 0 * pressures, words
        )
        wrench = np.full(6, np.nan)
        self._shown = Instant(round(pressure), 1e-3, estimate, wrench, wrench, None, None)

    def instant(self) -> Instant:
        return self._shown

    def wrenches(self) -> tuple[Any, Any, Any]:
        return np.zeros(0), np.zeros((0, 6)), np.zeros((0, 6))

    def sensors(self) -> list[SensorState]:
        return [self.sensor]

    def recording(self) -> None:
        return None

    def regions(self) -> None:
        return None

    def watched(self, on: bool) -> None:
        pass


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with open_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def source() -> Pushed:
    return Pushed()


@pytest.fixture(scope="module")
def port() -> int:
    return free_port()


@pytest.fixture(scope="module")
def served(source: Pushed, port: int) -> Iterator[list[Page]]:
    """The page of the pushed source, as the last one of a list: a test may serve it anew."""
    pages = [Page(source, PageServer("127.0.0.1", port))]
    yield pages
    pages[-1].close()


@pytest.fixture(scope="module")
def tab(browser: Browser, served: list[Page], port: int) -> Iterator[Tab]:
    tab = Tab(browser, f"http://localhost:{port}")
    tab.reads("peak 10 ± ")
    yield tab
    tab.close()


def test_the_page_shows_a_push(tab: Tab, source: Pushed) -> None:
    """In words and in colours, and asks nobody but its own server."""
    source.push(40e3)
    tab.reads("peak 40 ± .*, anterior")
    tab.shows(lambda colours: colours.std() > 10.0)
    pushed = tab.colours()
    source.push(3e3)
    tab.reads("peak 3 ± ")
    tab.shows(lambda colours: np.abs(colours - pushed).max() > 60.0)
    source.push(10e3)
    tab.reads("peak 10 ± ")
    assert not tab.errors
    for url in tab.asked:
        assert url.startswith(("http://localhost:", "ws://localhost:", "blob:http://localhost:"))


def test_a_sensor_that_fails_is_seen_in_words(tab: Tab, source: Pushed) -> None:
    tab.reads("all 1 are well")
    source.sensor = SensorState("load cell", 2, "the chip is gone: check its wires", 0.0, 1.0)
    tab.reads("1 of 1 need attention[^]*the chip is gone: check its wires")
    source.sensor = SensorState("load cell", 0, "recovered", 100.0, 0.0)
    tab.reads("all 1 are well[^]*recovered")


def test_five_browsers_see_the_same(tab: Tab, browser: Browser, source: Pushed, port: int) -> None:
    tabs = [tab, *(Tab(browser, f"http://127.0.0.1:{port}") for _ in range(4))]
    for pressure in (20e3, 10e3):
        source.push(pressure)
        for each in tabs:
            each.reads(f"peak {1e-3 * pressure:.0f} ± ")
    for other in tabs[1:]:
        assert not other.errors
        other.close()


def test_the_page_of_a_server_that_comes_back_comes_back(
    tab: Tab, served: list[Page], source: Pushed, port: int
) -> None:
    served[-1].close()
    source.push(30e3)
    served.append(Page(source, PageServer("127.0.0.1", port)))
    tab.reads("peak 30 ± ")
    source.push(10e3)
    tab.reads("peak 10 ± ")


class _Foreign(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b"<p>another site</p>")

    def log_message(self, *_: object) -> None:
        pass


def test_another_site_s_page_is_refused(browser: Browser, served: list[Page], port: int) -> None:
    """It reaches neither the page nor its websocket, as this machine's own browser calls them."""
    foreign = HTTPServer(("127.0.0.1", 0), _Foreign)
    thread = Thread(target=foreign.serve_forever)
    thread.start()
    page = browser.new_page()
    page.goto(f"http://127.0.0.1:{foreign.server_port}")
    outcome = page.evaluate(
        """port => new Promise(done => {
            const socket = new WebSocket(`ws://127.0.0.1:${port}`, "viser-v1.1.1")
            socket.onopen = () => done("open")
            socket.onerror = () => done("refused")
        })""",
        port,
    )
    assert outcome == "refused"
    page.close()
    foreign.shutdown()
    thread.join()
    foreign.server_close()


def test_a_trial_is_played_paused_and_sought(browser: Browser, hold: Path) -> None:
    trial = st.open_trial(hold, notify=lambda note: None)
    placed = next(event.time for event in trial.events() if event.label == "placed")
    with st.view(trial) as page:
        tab = Tab(browser, page.url)
        tab.reads("peak \\d+ ± ")
        tab.page.get_by_label("event").click()
        tab.page.get_by_role("option", name="placed").click()
        tab.reads(f"Regions at {np.floor(4 * placed) / 4:.1f} s")
        tab.press("Play")
        tab.page.get_by_role("button", name="Pause", exact=True).wait_for()
        tab.page.keyboard.press("Space")
        tab.page.get_by_role("button", name="Play", exact=True).wait_for()
        assert not tab.errors
        tab.close()
