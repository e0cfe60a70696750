"""Damaged documents and files: values replaced, bytes cut, overwritten, doubled or replaced."""

import copy
import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from hypothesis import strategies as draw

DELETE = object()  # instead of a value

# Words that stand for no number where one belongs in a CSV or a text mesh.
NO_NUMBERS = (
    *("nan", "-nan", "inf", "1e999", "-1e999", "9" * 400, "0x10", "1_000", "1.5.2", "--1", "1e"),
    *("true", "None", '"', '"1', "'1.5'", "x" * 100_000, "\0", "\u0661\u0662", "1d5"),
)
_NASTY = (
    *(word.encode() for word in NO_NUMBERS),
    *(b"", b"\0" * 16, b"\xff" * 8, b"\xef\xbb\xbf", b"\n", b",,,", b";;;", b"\t", b"\r"),
    *(b"\x1b[2J", b"-1", b"0", b"1e308", b"1e-320", b"&a [*a]", b"- - - 1", b"{a: ", b"---"),
    b"x" * 140_000,
    *(n.to_bytes(8, "little") for n in (0x7F, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1)),
)
_NUMBER = re.compile(rb"(?<![\w.:-])[-+]?\d+\.\d+(?:[eE][-+]?\d+)?(?![\w.:-])")


def damaged(data: draw.DataObject, content: bytes) -> bytes:
    """A file of which one to three spans are cut out or replaced, by others of its own or not."""
    for _ in range(data.draw(draw.integers(1, 3))):
        size = len(content)
        at = data.draw(draw.integers(0, size) | draw.integers(0, min(200, size)))
        end = at + data.draw(draw.sampled_from([0, 1, 1, 4, 8, 60, 2000, size]))
        start = data.draw(draw.integers(0, size))
        own = content[start : start + data.draw(draw.sampled_from([1, 8, 60, 2000, size]))]
        new = data.draw(draw.sampled_from([*_NASTY, own, own]) | draw.binary(max_size=8))
        content = content[:at] + new + content[end:]
    return content


def without_a_number(data: draw.DataObject, content: bytes) -> bytes:
    """A text with one number replaced by what is none."""
    place = data.draw(draw.sampled_from(list(_NUMBER.finditer(content))))
    new = data.draw(draw.sampled_from(NO_NUMBERS)).encode()
    return content[: place.start()] + new + content[place.end() :]


def changed(document: Any, place: Sequence[str | int], value: Any) -> Any:
    """A copy of a document with another value at a place, or without it for `DELETE`."""
    document = copy.deepcopy(document)
    parent = document
    for key in place[:-1]:
        parent = parent[key]
    parent[place[-1]] = value
    if value is DELETE:
        del parent[place[-1]]
    return document


def numbers_of(value: Any) -> np.ndarray:
    """All floating-point numbers of a record in its order, NaN for None, shape (N,)."""
    return np.concatenate([np.empty(0), *map(np.ravel, _parts(value))])


def _parts(value: Any) -> Iterator[Any]:
    if value is None:
        yield np.nan
    elif isinstance(value, float | np.floating):
        yield float(value)
    elif isinstance(value, np.ndarray):
        if value.dtype.kind == "f":
            yield value
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for item in dataclasses.fields(value):
            yield from _parts(getattr(value, item.name))
    elif isinstance(value, Mapping | list | tuple):
        for each in value.values() if isinstance(value, Mapping) else value:
            yield from _parts(each)
