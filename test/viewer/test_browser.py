"""The page in a real browser: what it shows, and that it comes back."""

from __future__ import annotations

import shutil
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, sync_playwright
from support import HANGS
from support.sources import NOTHING, StillSource, estimate_of

import socket_testbed as st
from socket_testbed.viewer.page import Page, PageServer
from socket_testbed.viewer.source import Instant, SensorState

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")

_FLAGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",  # the processor draws
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
)
# Drawn by the processor, a frame takes long: few of them, without smoothing, leave the page time.
_FRUGAL = """
    const frame = window.requestAnimationFrame.bind(window)
    window.requestAnimationFrame = draw => window.setTimeout(() => frame(draw), 300)
    const context = HTMLCanvasElement.prototype.getContext
    HTMLCanvasElement.prototype.getContext = function (kind, options) {
        return context.call(this, kind, {...options, antialias: false})
    }
"""
_SIZE = {"width": 900, "height": 420}  # the panels leave little to draw
_PICTURE = """() => {
    const scene = [...document.querySelectorAll("canvas")].sort((a, b) => b.height - a.height)[0]
    const copy = document.createElement("canvas")
    copy.width = 66
    copy.height = 40
    const pen = copy.getContext("2d")
    pen.drawImage(scene, 0, 0, copy.width, copy.height)
    return [...pen.getImageData(0, 0, copy.width, copy.height).data]
}"""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no browser: chromium is not installed"),
]


class Tab:
    """A page in a window of its own, with the errors of its console and what it asked for."""

    def __init__(self, browser: Browser, url: str) -> None:
        self.errors: list[str] = []
        self.asked: list[str] = []
        self._window = browser.new_context(viewport=_SIZE)
        self._window.set_default_timeout(1e3 * HANGS)
        self._window.add_init_script(_FRUGAL)
        self.page = self._window.new_page()
        self.page.on("console", self._on_console)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("websocket", lambda socket: self.asked.append(socket.url))
        self.page.goto(url)

    def close(self) -> None:
        self._window.close()

    def _on_console(self, message: Any) -> None:
        if message.type == "error":
            self.errors.append(message.text)

    def reads(self, pattern: str) -> None:
        """Wait until a regular expression is to be read."""
        self.page.wait_for_function(
            "pattern => new RegExp(pattern).test(document.body.innerText)", arg=pattern, polling=200
        )

    def button(self, name: str) -> Any:
        return self.page.get_by_role("button", name=name, exact=True)

    def colours(self) -> np.ndarray:
        """The scene, few of its pixels, RGB, shape (40, 66, 3)."""
        values = np.array(self.page.evaluate(_PICTURE), dtype=float)
        return values.reshape(40, 66, 4)[..., :3]

    def shows(self, condition: Callable[[np.ndarray], bool]) -> None:
        """Wait until the scene's colours meet a condition."""
        deadline = HANGS
        while not condition(self.colours()):
            self.page.wait_for_timeout(500.0)
            deadline -= 0.5
            assert deadline > 0.0, "the scene does not show it"


class Pushed(StillSource):
    """A source that shows how hard the foremost tile is pushed, and how a sensor is."""

    def __init__(self) -> None:
        self.sensor = SensorState("load cell", 0, "measures", 100.0, 0.0)
        self.push(10e3)

    def push(self, pressure: float) -> None:
        pressures = np.full(len(self.geometry), 2e3)
        pressures[np.argmax(self.geometry.anchors[:, 0])] = pressure
        words = "prior: mean zero; measured: wrench, " + ", ".join(self.geometry.clusters)
        estimate = estimate_of(pressures, words)
        self._shown = Instant(round(pressure), 1e-3, estimate, NOTHING, NOTHING, None, None)

    def instant(self) -> Instant:
        return self._shown

    def sensors(self) -> list[SensorState]:
        return [self.sensor]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=_FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def source() -> Pushed:
    return Pushed()


@pytest.fixture(scope="module")
def port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return int(listening.getsockname()[1])


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


def test_the_page_shows_a_push_and_a_sensor_that_fails(tab: Tab, source: Pushed) -> None:
    """In words and in colours, and asks nobody but its own server."""
    source.push(40e3)
    tab.reads("peak 40 ± .*, anterior")
    tab.shows(lambda colours: colours.std() > 10.0)
    pushed = tab.colours()
    source.push(3e3)
    tab.reads("peak 3 ± ")
    tab.shows(lambda colours: np.abs(colours - pushed).max() > 60.0)
    tab.reads("all 1 are well")
    source.sensor = SensorState("load cell", 2, "the chip is gone: check its wires", 0.0, 1.0)
    tab.reads("1 of 1 need attention[^]*the chip is gone: check its wires")
    assert not tab.errors
    for url in tab.asked:
        assert url.startswith(("http://localhost:", "ws://localhost:", "blob:http://localhost:"))


def test_browsers_see_the_same_and_come_back_with_their_server(tab, browser, served, source, port):
    other = Tab(browser, f"http://127.0.0.1:{port}")
    source.push(20e3)
    for each in (tab, other):
        each.reads("peak 20 ± ")
    assert not other.errors
    other.close()
    served[-1].close()
    source.push(30e3)
    served.append(Page(source, PageServer("127.0.0.1", port)))
    tab.reads("peak 30 ± ")


def test_a_page_that_is_not_its_own_is_refused(browser: Browser, served: list[Page], port: int):
    """It does not reach the websocket, although this machine's own browser calls it."""
    page = browser.new_page()
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


def test_a_trial_is_played_paused_and_sought(browser: Browser, hold: Path) -> None:
    trial = st.open_trial(hold, notify=lambda note: None)
    placed = next(event.time for event in trial.events() if event.label == "placed")
    with st.view(trial) as page:
        tab = Tab(browser, page.url)
        tab.reads("peak \\d+ ± ")
        tab.page.get_by_label("event").click()
        tab.page.get_by_role("option", name="placed").click()
        tab.reads(f"Regions at {np.floor(4 * placed) / 4:.1f} s")
        tab.button("Play").click()
        tab.button("Pause").wait_for()
        tab.page.keyboard.press("Space")
        tab.button("Play").wait_for()
        assert not tab.errors
        tab.close()
