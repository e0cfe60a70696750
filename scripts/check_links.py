"""Check that every link between the documents leads to a file, and to a heading in it.

    python scripts/check_links.py

Prints each broken link with its page; ends with exit code 1 if there is one. Links to other hosts
are not followed. Needs the standard library alone.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TOP = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_ELSEWHERE = re.compile(r"[a-z]+:", re.IGNORECASE)
_CODE = re.compile(r"```.*?```|`[^`\n]+`", re.DOTALL)


def documents() -> list[Path]:
    """The pages whose links are checked."""
    return [*(ROOT / name for name in TOP), *sorted((ROOT / "docs").glob("*.md"))]


def anchors(page: Path) -> set[str]:
    """Anchors of the headings of a page."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL).lower()
    headings = re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading).replace(" ", "-") for heading in headings}


def broken_links(page: Path) -> list[str]:
    """Targets in a page that lead nowhere: no such file, or no such heading in a document."""
    broken = []
    for target in _LINK.findall(_CODE.sub("", page.read_text())):
        if _ELSEWHERE.match(target):
            continue
        path, _, anchor = target.partition("#")
        found = page.parent / path if path else page
        is_page = found.suffix == ".md"
        if not found.exists() or (anchor and is_page and anchor not in anchors(found)):
            broken.append(target)
    return broken


def main() -> int:
    """Print the broken links; returns the exit code."""
    pages = documents()
    broken = [f"{page.relative_to(ROOT)}: {link}" for page in pages for link in broken_links(page)]
    print("\n".join(broken) if broken else f"{len(pages)} documents, no broken link")
    return bool(broken)


if __name__ == "__main__":
    sys.exit(main())
