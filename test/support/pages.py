"""Pages and tables as their readers open them."""

from datetime import UTC, datetime
from html.parser import HTMLParser

import numpy as np

MADE = datetime(2026, 2, 3, 4, 5, 6, tzinfo=UTC)
THETAS = np.linspace(0.0, 1.0, 5)
LABELS = ["stiffness", "stiffness_bias", "rigid_bias", "given"]  # of the models in a report
NASTY = "<b>a & \"b\" 'c' $\\frac$"


class Page(HTMLParser):
    """What a page holds; its elements must be closed in their order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""  # all that is read, without scripts and styles
        self.said: dict[str, list[str]] = {}  # texts by tag, scripts and styles too
        self.tables: dict[str, list[list[str]]] = {}  # cells by the table's id, row by row
        self.open: list[str] = []  # elements that were never closed
        self._rows: list[list[str]] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attributes)))
        if tag == "table":
            self._rows = self.tables[dict(attributes).get("id") or ""] = []
        elif tag == "tr":
            self._rows.append([])
        elif tag in ("td", "th"):
            self._rows[-1].append("")
        if tag not in ("meta", "img", "input"):
            self.open.append(tag)
            self.said.setdefault(tag, []).append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open:
            return
        tag = self.open[-1]
        self.said[tag][-1] += data
        if tag not in ("script", "style"):
            self.text += data
        if tag in ("td", "th"):
            self._rows[-1][-1] += data

    def attributes(self, *names: str) -> list[str]:
        return [a[name] or "" for _, a in self.tags for name in names if name in a]

    @property
    def policy(self) -> str:
        return next(a["content"] or "" for _, a in self.tags if a.get("http-equiv"))

    def script(self, name: str) -> str:
        scripts = [attributes.get("id") for tag, attributes in self.tags if tag == "script"]
        return self.said["script"][scripts.index(name)]

    def rows(self, table: str) -> dict[str, list[str]]:
        """Rows of a table by their first cell."""
        return {row[0]: row[1:] for row in self.tables[table]}
