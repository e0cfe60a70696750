"""The pages without a browser: their own scripts in a small JavaScript engine, on a DOM of ours.

`Tab` opens a page as a browser does: it parses the HTML, runs the scripts in their order, and then
clicks, chooses, types and lets time pass. What the scripts draw is kept as `Picture`s.
"""

from __future__ import annotations

import base64
import gzip
import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import quickjs
from markupsafe import Markup

from socket_testbed.pages.server import Source
from support import CHECKOUT

STATIC = CHECKOUT / "socket_testbed" / "pages" / "static"
LIVE_PAGE = (STATIC / "live.html").read_text(encoding="utf-8")
INK = "rgb(17, 34, 51)"  # colour of the page's text
DARK, NARROW = "(prefers-color-scheme: dark)", "(max-width: 700px)"

_DOM = Path(__file__).with_name("dom.js")
_VIEWER = "plotly.js"  # the script of the viewer, which the fake one replaces
_EMPTY = ("meta", "link", "input", "img", "br")  # elements that have no end
_DATA = ("application/json", "text/plain")  # types of scripts that are not run


class LostError(Exception):
    """Raised by an answer: the server cannot be reached."""


class StatusError(Exception):
    """Raised by an answer: the server answers with this status and text."""

    def __init__(self, status: int, text: str) -> None:
        self.status, self.text = status, text


# Answers a path, and the body of a POST, with what is sent as JSON.
Answer = Callable[[str, Any], Any]


def served(source: Source) -> Answer:
    """The answers of a server with a source, see `pages.server`."""

    def answer(path: str, body: Any) -> Any:
        if path == "start":
            return source.start()
        if path == "do":
            return {"said": source.act(body.pop("do"), body)}
        name, _, time = path.partition("?t=")
        assert name == "now"
        return source.now(float(time) if time else None)

    return answer


@contextmanager
def small_viewer() -> Iterator[Path]:
    """A folder in which pages are written with the fake viewer, packed as the real one is."""
    packed = base64.b64encode(gzip.compress(b"globalThis.Plotly = browser.Plotly;")).decode()
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr("socket_testbed.report.page._viewer", lambda: Markup(packed))
        yield Path(folder)


class _Parser(HTMLParser):
    """The page as nodes within each other, for `browser.build`, and its scripts in order."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.nodes: list[Any] = []
        self.scripts: list[tuple[dict[str, Any], list[Any]]] = []
        self._open = [self.nodes]
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "html":
            return
        inside: list[Any] = []
        attributes = {name: value or "" for name, value in attrs}
        self._open[-1].append([tag, attributes, inside])
        if tag == "script":
            self.scripts.append((attributes, inside))
        if tag not in _EMPTY:
            self._open.append(inside)

    def handle_endtag(self, tag: str) -> None:
        if tag != "html":
            self._open.pop()

    def handle_data(self, data: str) -> None:
        self._open[-1].append(data)


class Tab:
    """An open page.

    `page` is its HTML, `answer` the server's part. Lines of JavaScript in `before` run ahead of
    the page's scripts, to change the browser.
    """

    def __init__(self, page: str, answer: Answer | None = None, before: str = "") -> None:
        self._answer = answer
        self._context = quickjs.Context()
        self._context.add_callable("callPython", self._called)
        self._context.eval(_DOM.read_text(encoding="utf-8"))
        parsed = _Parser(page)
        self.run(f"browser.build({json.dumps(parsed.nodes)})")
        self.run(before)
        for attributes, inside in parsed.scripts:
            source = attributes.get("src")
            if attributes.get("type") in _DATA:
                continue
            if source == _VIEWER:
                self.run("globalThis.Plotly = browser.Plotly")
            elif source is not None:
                self.run((STATIC / source).read_text(encoding="utf-8"))
            else:
                self.run("".join(inside))

    def _called(self, what: str, given: str) -> str:
        """Answer a call of the fake browser."""
        if what == "unpack":
            numbers, form = json.loads(given)
            assert form == "gzip"
            return json.dumps(gzip.decompress(bytes(numbers)).decode())
        method, path, body = json.loads(given)
        assert self._answer is not None, f"the page asks for {path}"
        try:
            found = self._answer(path, json.loads(body) if method == "POST" else None)
        except LostError:
            return json.dumps({"lost": True})
        except StatusError as error:
            return json.dumps({"status": error.status, "text": error.text})
        return json.dumps({"status": 200, "text": json.dumps(found, allow_nan=False)})

    def run(self, source: str) -> None:
        """Run a script in the page, and all that it leaves to be done at once."""
        result = self._context.eval(source)
        if isinstance(result, quickjs.Object):
            self._context.set("_result", result)
            self._context.eval("browser.watch(_result)")
        self._settle()

    def _settle(self) -> None:
        while self._context.execute_pending_job():
            pass
        errors = json.loads(self._context.eval("JSON.stringify(browser.errors)"))
        assert not errors, errors[0]

    def evaluate(self, expression: str) -> Any:
        """The value of an expression in the page."""
        found = self._context.eval(f"JSON.stringify({expression}) ?? 'null'")
        return json.loads(found)

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        until = self.evaluate("browser.now") + 1e3 * seconds
        while self._context.eval(f"browser.step({until})"):
            self._settle()
        self._settle()

    def get(self, selector: str, name: str) -> Any:
        """A property of the first element that matches."""
        return self.evaluate(f"browser.find({json.dumps(selector)}).{name}")

    def text(self, selector: str) -> str:
        """What is read in an element."""
        return str(self.get(selector, "textContent"))

    def texts(self, selector: str) -> list[str]:
        """What is read in all the elements that match."""
        found = f"document.querySelectorAll({json.dumps(selector)})"
        return list(self.evaluate(f"{found}.map((one) => one.textContent)"))

    def rows(self, table: str) -> list[list[str]]:
        """The cells of a table, row by row."""
        cells = "map((row) => row.children.map((cell) => cell.textContent))"
        return list(self.evaluate(f"browser.find({json.dumps(table)}).children.{cells}"))

    def options(self, selector: str) -> list[str]:
        """The texts of the options of a select."""
        return list(self.get(selector, "options.map((option) => option.textContent)"))

    def send(self, selector: str, event: str, details: Mapping[str, Any] | None = None) -> bool:
        """Dispatch an event; whether the page prevents what the browser would do."""
        target = f"browser.find({json.dumps(selector)})"
        given = json.dumps(details or {})
        prevented = self._context.eval(f"browser.dispatch({target}, {event!r}, {given})")
        self._settle()
        return bool(prevented)

    def click(self, selector: str) -> None:
        """Click an element that is shown."""
        one = f"let one = browser.find({json.dumps(selector)})"
        hidden = self._context.eval(
            f"{{ {one}, hidden = false; while (one) {{ hidden ||= one.hidden; one = one.parent; }}"
            " hidden; }"
        )
        assert not hidden, f"{selector} is hidden"
        self.send(selector, "click")

    def choose(self, selector: str, option: str) -> None:
        """Choose an option of a select by its text."""
        place = self.options(selector).index(option)
        self.run(f"browser.find({json.dumps(selector)}).place = {place}; undefined")
        self.send(selector, "change")

    def type(self, selector: str, text: str | float) -> None:
        """Type into a field, or move a slider."""
        self.run(f"browser.find({json.dumps(selector)}).value = {json.dumps(text)}; undefined")
        self.send(selector, "input")

    def press(self, key: str, on: str = "body") -> bool:
        """Press a key on an element; whether the page prevents what the browser would do."""
        return self.send(on, "keydown", {"key": key})

    @property
    def requested(self) -> list[str]:
        """Paths of all GET requests so far."""
        return list(self.evaluate("browser.requested"))

    @property
    def doings(self) -> list[list[Any]]:
        """Questions and POST requests so far, in their order."""
        return list(self.evaluate("browser.doings"))

    def drawn(self, selector: str) -> int:
        """How many pictures were drawn in a box."""
        return int(self.get(selector, "pictures.length"))

    def picture(self, selector: str) -> Picture:
        """The last picture that was drawn in a box."""
        found = self.get(selector, "pictures.at(-1)")
        assert found is not None, f"nothing is drawn in {selector}"
        return Picture(**json.loads(found))


@dataclass(frozen=True)
class Picture:
    """A picture as plotly is given it."""

    how: str  # the function that was called
    traces: list[dict[str, Any]]
    layout: dict[str, Any]
    config: dict[str, Any]

    def of_type(self, kind: str) -> list[dict[str, Any]]:
        """The traces of a type."""
        return [trace for trace in self.traces if trace["type"] == kind]

    def heatmap(self, axis: str = "x") -> Heatmap:
        """The heatmap on an x axis whose values are read."""
        (found,) = (trace for trace in self._heatmaps(axis) if trace.get("hoverinfo") != "skip")
        return Heatmap(found)

    def veil(self, axis: str = "x") -> Heatmap:
        """The heatmap on an x axis that lies over the other one."""
        first, second = self._heatmaps(axis)
        assert second["hoverinfo"] == "skip" and first.get("hoverinfo") != "skip"
        return Heatmap(second)

    def has_veil(self, axis: str = "x") -> bool:
        """Whether something lies over the heatmap."""
        return len(self._heatmaps(axis)) > 1

    def _heatmaps(self, axis: str) -> list[dict[str, Any]]:
        return [trace for trace in self.of_type("heatmap") if trace["xaxis"] == axis]

    @property
    def notes(self) -> dict[str, dict[str, Any]]:
        """The annotations by their text."""
        found = {note["text"]: note for note in self.layout["annotations"]}
        assert len(found) == len(self.layout["annotations"])
        return found


@dataclass(frozen=True)
class Heatmap:
    """Values on a grid: a row for each y, in it a value for each x."""

    trace: dict[str, Any]

    def _at(self, name: str, x: float, y: float) -> Any:
        values = self.trace[name]
        assert len(values) == len(self.trace["y"])
        row = values[self.trace["y"].index(y)]
        assert len(row) == len(self.trace["x"])
        return row[self.trace["x"].index(x)]

    def value(self, x: float, y: float) -> Any:
        """The value that stands at a place."""
        return self._at("z", x, y)

    def highest(self) -> tuple[float, float, float]:
        """The highest value and its place, (z, x, y)."""
        return max(
            (value, x, y)
            for y, row in zip(self.trace["y"], self.trace["z"], strict=True)
            for x, value in zip(self.trace["x"], row, strict=True)
            if value is not None
        )

    def colour(self, value: float) -> tuple[int, ...]:
        """The colour of a value, (red, green, blue) of 255, as plotly blends the scale's."""
        low, high = self.trace["zmin"], self.trace["zmax"]
        share = min(max((value - low) / (high - low), 0.0), 1.0)
        places, colours = zip(*self.trace["colorscale"], strict=True)
        blended = np.transpose([read_colour(colour) for colour in colours])
        return tuple(round(float(np.interp(share, places, part))) for part in blended)

    def hover(self, x: float, y: float) -> str:
        """The text at the pointer, as plotly fills its template."""
        given = {"z": self.value(x, y)}
        if "customdata" in self.trace:
            given["customdata"] = self._at("customdata", x, y)
        return hover_text(self.trace["hovertemplate"], given)


def read_colour(text: str) -> tuple[int, ...]:
    """Red, green and blue of 255 of `#rrggbb` or `rgb(r,g,b)`."""
    if text.startswith("#"):
        return tuple(bytes.fromhex(text[1:]))
    found = re.fullmatch(r"rgb\((\d+), ?(\d+), ?(\d+)\)", text)
    assert found, f"no colour: {text}"
    return tuple(map(int, found.groups()))


def hover_text(template: str, given: Mapping[str, Any]) -> str:
    """A hover template of plotly with its values, `%{name:.1f}` and `%{name[0]:.1f}`."""

    def filled(match: re.Match[str]) -> str:
        name, place, digits, unknown = match.groups()
        assert unknown is None, f"no format that plotly knows: {match[0]}"
        value = given[name] if place is None else given[name][int(place)]
        return f"{value:.{digits}f}"

    text = re.sub(r"%\{(\w+)(?:\[(\d+)\])?(?::\.(\d)f|([^}]*))\}", filled, template)
    assert text.endswith("<extra></extra>"), "the name of the trace stands beside the value"
    return text.removesuffix("<extra></extra>").replace("<br>", ", ")
