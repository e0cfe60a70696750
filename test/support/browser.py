"""A real browser on the page, without a screen and without a graphics card."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from playwright.sync_api import Browser, sync_playwright

from support import HANGS

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


@contextmanager
def open_browser() -> Iterator[Browser]:
    """The browser, started."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=_FLAGS)
        try:
            yield browser
        finally:
            browser.close()


class Tab:
    """A page in a window of its own.

    Attributes:
        errors: What the console says is wrong.
        asked: Addresses that the page asked for.
    """

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

    @property
    def text(self) -> str:
        """What is to be read."""
        return self.page.inner_text("body")

    def reads(self, pattern: str) -> None:
        """Wait until a regular expression is to be read."""
        self.page.wait_for_function(
            "pattern => new RegExp(pattern).test(document.body.innerText)", arg=pattern, polling=200
        )

    def press(self, button: str) -> None:
        self.page.get_by_role("button", name=button, exact=True).click()

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
