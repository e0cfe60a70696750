"""The pages in a real browser: what is drawn, and what buttons and keys do."""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, sync_playwright
from support import HANGS

import socket_testbed as st
from socket_testbed.errors import TestbedError
from socket_testbed.pages.player import Player
from socket_testbed.pages.server import PageServer

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
_FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no browser: chromium is not installed"),
]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=[*_FLAGS])
        yield found
        found.close()


class Tab:
    """A page in a window of its own, with its errors and what it asked for."""

    def __init__(self, browser: Browser, url: str, width: int = 900) -> None:
        self.errors: list[str] = []
        self.asked: list[str] = []
        window = browser.new_context(viewport={"width": width, "height": 700})
        window.set_default_timeout(1e3 * HANGS)
        self.page: Page = window.new_page()
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("dialog", lambda dialog: dialog.accept())
        self.page.goto(url)

    def reads(self, pattern: str) -> None:
        """Wait until a regular expression is to be read."""
        self.page.wait_for_function(
            "pattern => new RegExp(pattern).test(document.body.innerText)", arg=pattern, polling=100
        )

    def pressure(self) -> float:
        """The highest value that the map draws [kPa]."""
        found: float = self.page.evaluate(
            "() => Math.max(...document.getElementById('map').data"
            ".filter(trace => trace.type === 'heatmap' && trace.zmax > 1)"
            ".flatMap(trace => [...trace.z].flat()).filter(Number.isFinite))"
        )
        return found

    def close(self) -> None:
        assert not self.errors
        self.page.context.close()


@pytest.fixture(scope="module")
def report(hold: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, float]:
    """Address of a report and the peak that its map shows [kPa]."""
    page = tmp_path_factory.mktemp("report") / "hold.html"
    results = st.write_report(st.open_trial(hold), page, thetas=3)
    return page.as_uri(), 1e-3 * results.pressure.outputs.peak_map.normal_pressure.max()


@pytest.mark.parametrize("width", [900, 390], ids=["window", "phone"])
def test_a_report_moves_in_time(width: int, browser: Browser, report: tuple[str, float]) -> None:
    url, peak = report
    tab = Tab(browser, url, width)
    tab.reads(rf"Peak\s+{peak:.1f} kPa\s*95 %: ")
    assert tab.pressure() == pytest.approx(peak, rel=0.15)
    at_peak = tab.pressure()
    tab.page.get_by_role("button", name="Mean over").click()
    tab.reads("mean over plateau")
    assert tab.pressure() < at_peak
    tab.page.locator("#cursor").fill("0")
    tab.reads(r"at 0\.00 s")
    tab.page.locator("#model > summary").click()
    tab.page.locator("#chart-wrench .main-svg").first.wait_for()
    assert all(url.startswith(("file:", "blob:", "data:")) for url in tab.asked)
    tab.close()


def test_a_trial_is_played_from_its_peak(browser: Browser, hold: Path) -> None:
    trial = st.open_trial(hold)
    peak = Player(trial).start()["start"]
    with st.view(trial) as served:
        tab = Tab(browser, served.url)
        tab.reads(r"Peak[\s\S]+Data\s+good")
        place = "() => Number(document.getElementById('cursor').value)"
        assert tab.page.evaluate(place) == pytest.approx(peak, abs=0.3)
        tab.page.keyboard.press("ArrowLeft")
        tab.page.wait_for_function(f"({place})() < {peak - 3}")
        tab.page.get_by_role("button", name="Play").click()
        tab.page.wait_for_function(f"({place})() > {peak - 4}")
        tab.page.get_by_role("button", name="Pause").click()
        tab.close()


class Bench(Player):
    """A trial that the page takes for a running testbed."""

    pressed: tuple[tuple[str, dict[str, Any]], ...] = ()

    def start(self) -> dict[str, Any]:
        return super().start() | {"live": True, "buttons": True, "metadata": {"side": ["", "left"]}}

    def now(self, time: float | None) -> dict[str, Any]:
        recording = {"on": bool(self.pressed), "words": "recording s01" if self.pressed else ""}
        return super().now(20.0) | {"recording": recording, "sensors": [["!", "clock", "late", ""]]}

    def act(self, what: str, given: dict[str, Any]) -> str:
        if what == "tare":
            raise TestbedError("the load cell is loaded", "take the limb out")
        self.pressed += ((what, given),)
        return "done"


def test_buttons_call_their_services(browser: Browser, hold: Path) -> None:
    """And state what came of it."""
    bench = Bench(st.open_trial(hold))
    with PageServer(bench, "127.0.0.1", 0) as server:
        tab = Tab(browser, server.url)
        tab.page.get_by_role("button", name="Tare").click()
        tab.reads(re.escape("tare: the load cell is loaded: take the limb out"))
        tab.page.get_by_role("button", name="Record").click()
        tab.reads("record: done")
        tab.page.get_by_role("button", name="Stop recording").wait_for()
        tab.page.locator("#label").fill("step")
        tab.page.get_by_role("button", name="Mark").click()
        tab.reads("mark: done")
    assert bench.pressed == (("record", {"trial": "", "side": ""}), ("mark", {"label": "step"}))
    tab.reads("is the program still running")
    tab.close()
