"""Damaged files: seeded mutations of good ones, by bytes, by lines and by values."""

from __future__ import annotations

import copy
import dataclasses
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

Rng = np.random.Generator
T = TypeVar("T")

DELETE = object()  # instead of a value
DEEP = 3000  # levels; Python's own limit is 1000
_LAUGHS = "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}' if i else 'lol'] * 9)}]\n" for i in range(9)
)
# What stands for no number where one belongs: each is refused, or is a value that is missing.
NO_NUMBERS = {
    "yaml": (
        *(
            "null",
            "~",
            "''",
            "true",
            "no",
            "'1.5 '",
            "1:30",
            "010",
            "1_000",
            "0b11",
            "1.5.2",
            "--1",
        ),
        *("[1.5]", "[[1, 2], [3]]", "{a: 1}", ".nan", ".inf", "-.INF", "1e999", "-1e999"),
        *("9" * 400, "9" * 5000, "0x" + "f" * 5000, "1:" + "30:" * 3000 + "1", "1e", "2026-01-01"),
        *("2026-13-45", "2001-12-14t21:59:43.10-99:99", "!!int x", "!!float x", "!!timestamp x"),
        *("!!bool x", "!!binary x", "!!set [1]", "!!omap [1]", "!!map [1]", "!!int ''", "!other 1"),
        *("!!python/object:os.system x", "!!python/tuple [1]", "*nobody", "&a [*a]", "&a {b: *a}"),
        *("[" * DEEP, "[" * DEEP + "]" * DEEP, "{a: " * DEEP, "x" * 100_000, '"\\0"', '"\\uD800"'),
        *("|\n  text", "? [a, b]", "? {a: 1}\n: 2", "{[a, b]: 1}", "=", "<<", "1\n---\n2"),
    ),
    "json": (
        *("null", '""', "true", '"1.5"', "NaN", "Infinity", "-Infinity", "1e999", "[1.5]", "{}"),
        *("9" * 400, "9" * 5000, "[" * DEEP, "[" * DEEP + "]" * DEEP, '{"a":' * DEEP),
        *('"' + "x" * 100_000 + '"', '"\\u0000"', '"\\ud800"', "[[1, 2], [3]]", "0x10", "1_000"),
    ),
    "text": (
        *("nan", "-nan", "inf", "1e999", "-1e999", "9" * 400, "0x10", "1_000", "1.5.2", "--1"),
        *("true", "None", '"', '"1', "'1.5'", "x" * 100_000, "\0", "\u0661\u0662", "1d5", "1e"),
    ),
}
# What changes the structure: whatever a reader makes of it, it is a named error or finite.
_SNIPPETS = {
    "yaml": (
        *("&a [*a]", "<<: *nobody", "<<: 3", "<<: [{a: 1}, 2]", "? [a, b]\n: 1", "? {a: 1}", "..."),
        *(
            "a: 2026-13-45",
            "- - - - 1",
            "\t",
            "%TAG ! x",
            "%YAML 9.9",
            "---",
            "!!set {a}",
            "@",
            "`",
        ),
        *(_LAUGHS, "a: " + "{a: " * DEEP, "- " * DEEP, "9" * 5000 + ": 1", "1: 1\n1.0: 1\ntrue: 1"),
        *("\ufeff", "\u2028", "\x85", "\x1b[2J: 1", "null: 1", "a: &b\n  <<: *b"),
    ),
    "json": (
        "[" * DEEP,
        "{",
        "]",
        ",",
        '"a": 1,',
        "\ufeff",
        "NaN",
        "//",
        "01",
        "1.",
        '{"a": {"a": ' * DEEP,
    ),
    "text": (
        "\0",
        "\ufeff",
        '"',
        ",,,",
        ";;;",
        "\t",
        "\r",
        "\x1b[2J",
        "\u2028",
        "\x85",
        "x" * 140_000,
    ),
}
_NUMBER = re.compile(r"(?<![\w.:-])[-+]?\d+\.\d+(?:[eE][-+]?\d+)?(?![\w.:-])")
_WORD = re.compile(r"[-+.\w]+")
_LENGTHS = (0, 1, 0x7F, 0x7FFF, 0x7FFFFFFF, 0xFFFFFFF0, 0xFFFFFFFF, 2**40, 2**63 - 1, 2**64 - 1)
_ENCODINGS = ("utf-16", "utf-16-be", "utf-32", "latin-1", "utf-7", "cp037")


def no_number(rng: Rng, content: bytes, kind: str) -> bytes:
    """A text with one number replaced by what is none; the same if it holds no number."""
    return _replaced(rng, content, _NUMBER, lambda found: _one_of(rng, NO_NUMBERS[kind]))


def _replaced(
    rng: Rng, content: bytes, pattern: re.Pattern[str], new: Callable[[list[re.Match[str]]], str]
) -> bytes:
    """A text with one match of a pattern replaced; the same if there is none."""
    text = content.decode("utf-8", "surrogateescape")
    found = list(pattern.finditer(text))
    if not found:
        return content
    place = _one_of(rng, found)
    text = text[: place.start()] + new(found) + text[place.end() :]
    return text.encode("utf-8", "surrogateescape")


def _one_of(rng: Rng, choices: Sequence[T]) -> T:
    return choices[int(rng.integers(len(choices)))]


def damaged(rng: Rng, content: bytes, kind: str) -> bytes:
    """A file with one to three of its bytes, words or lines damaged.

    Args:
        rng: Draws the damage.
        content: The good file.
        kind: What it is: `yaml`, `json`, `text` or `binary`.
    """
    ways = _BINARY if kind == "binary" else (*_BINARY, *_TEXTUAL, *_TEXTUAL)
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        content = _one_of(rng, ways)(rng, content, kind)
    return content


def _place(rng: Rng, content: bytes, size: int = 0) -> int:
    return int(rng.integers(max(len(content) - size, 0) + 1))


def _flip(rng: Rng, content: bytes, kind: str) -> bytes:
    changed = bytearray(content)
    for _ in range(int(rng.integers(1, 4)) if content else 0):
        changed[int(rng.integers(len(changed)))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _overwrite(rng: Rng, content: bytes, kind: str) -> bytes:
    at = _place(rng, content, 4)
    noise = [rng.bytes(4), b"\0" * 16, b"\xff" * 4, b"\xff" * 8][int(rng.integers(4))]
    return content[:at] + noise + content[at + len(noise) :]


def _length(rng: Rng, content: bytes, kind: str) -> bytes:
    """A number such as a length or an offset, written over somewhere, most often near an end."""
    size = int(rng.choice([4, 8]))
    near = int(rng.integers(0, 200))
    at = [near, max(len(content) - near, 0), _place(rng, content, size)][int(rng.integers(3))]
    value = _one_of(rng, _LENGTHS) % 256**size
    return content[:at] + value.to_bytes(size, "little") + content[at + size :]


def _cut(rng: Rng, content: bytes, kind: str) -> bytes:
    return content[: _place(rng, content)]


def _drop(rng: Rng, content: bytes, kind: str) -> bytes:
    at = _place(rng, content)
    return content[:at] + content[at + int(rng.integers(1, 60)) :]


def _double(rng: Rng, content: bytes, kind: str) -> bytes:
    at = _place(rng, content)
    end = at + int(rng.integers(1, 2000))
    return content[:end] + content[at:]


def _splice(rng: Rng, content: bytes, kind: str) -> bytes:
    a, b = _place(rng, content), _place(rng, content)
    return content[:a] + content[b:]


_BINARY = (_flip, _flip, _overwrite, _length, _cut, _drop, _double, _splice)


def _lines(rng: Rng, content: bytes, kind: str) -> bytes:
    lines = content.splitlines(keepends=True)
    if len(lines) < 2:
        return content
    a, b = (int(i) for i in rng.integers(0, len(lines), 2))
    way = int(rng.integers(4))
    if way == 0:
        lines[a], lines[b] = lines[b], lines[a]
    elif way == 1:
        lines.insert(a, lines[b])
    elif way == 2:
        del lines[a]
    else:
        lines[a] = lines[a].rstrip()[: _place(rng, lines[a])] + lines[b]
    return b"".join(lines)


def _word(rng: Rng, content: bytes, kind: str) -> bytes:
    """A word replaced by one of the nasty ones, or by another word of the file."""
    nasty = (*NO_NUMBERS[kind], *_SNIPPETS[kind], "1e308", "-1e308", "1e-320", "-1", "0", "")

    def new(words: list[re.Match[str]]) -> str:
        chosen = _one_of(rng, nasty)
        return _one_of(rng, words)[0] if rng.random() < 0.2 else chosen

    return _replaced(rng, content, _WORD, new)


def _insert(rng: Rng, content: bytes, kind: str) -> bytes:
    snippets = _SNIPPETS[kind]
    snippet = _one_of(rng, snippets).encode()
    lines = content.splitlines(keepends=True)
    lines.insert(int(rng.integers(len(lines) + 1)), snippet + b"\n" * int(rng.integers(2)))
    return b"".join(lines)


def _encode(rng: Rng, content: bytes, kind: str) -> bytes:
    text = content.decode("utf-8", "replace")
    if rng.random() < 0.3:
        return text.encode("utf-8-sig")
    return text.encode(_one_of(rng, _ENCODINGS), "replace")


_TEXTUAL = (_word, _word, _word, _lines, _insert, _encode)


def changed(document: Any, place: Sequence[str | int], value: Any) -> Any:
    """A copy of a document with another value at a place, or without it for `DELETE`."""
    document = copy.deepcopy(document)
    parent = document
    for key in place[:-1]:
        parent = parent[key]
    if value is DELETE:
        del parent[place[-1]]
    else:
        parent[place[-1]] = value
    return document


def numbers_of(value: Any) -> np.ndarray:
    """All floating-point numbers of a record in its order, NaN for None, shape (N,)."""
    parts = [np.ravel(part) for part in _parts(value)]
    return np.concatenate([np.empty(0), *parts])


def _parts(value: Any) -> Iterator[np.ndarray]:
    if value is None:
        yield np.array([np.nan])
    elif isinstance(value, float | np.floating):
        yield np.array([value], dtype=float)
    elif isinstance(value, np.ndarray):
        if value.dtype.kind == "f":
            yield value
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for item in dataclasses.fields(value):
            yield from _parts(getattr(value, item.name))
    elif isinstance(value, Mapping):
        for each in value.values():
            yield from _parts(each)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from _parts(each)


Check = Callable[[Any], None]
