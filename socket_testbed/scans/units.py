"""The unit of a scan's lengths: given, stated by the file, or inferred from the size."""

from __future__ import annotations

import re
from typing import Literal

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.documents import closest
from socket_testbed.errors import ScanError

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}

Source = Literal["given", "stated", "inferred"]

_SOCKET = (0.1, 0.6)  # [m]; length of what is taken for a socket unasked
_POSSIBLE = (0.03, 2.0)  # [m]; length of what is believed when the unit is known
_WORDS = {
    prefix + word: short + "m"
    for prefix, short in (("", ""), ("centi", "c"), ("milli", "m"))
    for word in ("meter", "metre", "meters", "metres")
} | {"inch": "in", "inches": "in", "mm": "mm", "cm": "cm"}
# 'units in progress' names no inches: the shortest words count behind a colon only.
_STATED = re.compile(
    rf"\bunits?\s*[:=]\s*({'|'.join(_WORDS)}|m|in)\b"
    rf"|\bunits?\s+(?:are\s+|in\s+)?({'|'.join(_WORDS)})\b"
)


def stated_unit(comment: str) -> str | None:
    """The unit that a file's own words name, as in 'units: mm', if they do.

    Args:
        comment: Header or comments of the file.
    """
    found = _STATED.search(comment.lower())
    if not found:
        return None
    word = found[1] or found[2]
    return _WORDS.get(word, word)


def check_unit(unit: str) -> None:
    """Refuse a unit that is none.

    Raises:
        ScanError: If the unit is not one of `METRES`.
    """
    if unit not in METRES:
        raise ScanError(f"the unit '{unit}' is unknown", closest(unit, METRES))


def find_unit(name: str, size: float, given: str | None, stated: str | None) -> tuple[str, Source]:
    """The unit of a body's lengths.

    Args:
        name: What names the body in an error.
        size: Its largest extent, in the unknown unit.
        given: The unit that the user gave, if any.
        stated: The unit that the file states, if any.

    Raises:
        ScanError: If the unit makes the body no possible size, or if none was
            given or stated and not exactly one makes it the size of a socket.
    """
    known = given or stated
    if known is None:
        return _infer(name, size), "inferred"
    length = size * METRES[known]
    if not _POSSIBLE[0] <= length <= _POSSIBLE[1]:
        raise ScanError(
            f"{name}: is {length:.3g} m long in {known}, which no socket is",
            f"give its unit with --unit ({', '.join(METRES)})",
        )
    return known, "given" if given else "stated"


def refuse_normalised(name: str, vertices: FloatArray) -> None:
    """Refuse a model that was scaled to the size 1 or 2: its real size is lost.

    Args:
        name: What names the model in an error.
        vertices: Shape (V, 3), in the file's unit.

    Raises:
        ScanError: If the vertices just fill [0, 1] or [-1, 1] in their largest extent.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    for start, size in (0.0, 1.0), (-0.5, 1.0), (-1.0, 2.0):
        inside = low.min() > start - 0.01 and high.max() < start + size + 0.01
        if inside and abs(float(np.max(high - low)) - size) < 0.01 * size:
            raise ScanError(
                f"{name}: is a model in normalised units ({size:g} long), its real size is lost",
                "export it in its real size",
            )


def _infer(name: str, size: float) -> str:
    lengths = {unit: size * metres for unit, metres in METRES.items()}
    fits = [unit for unit, length in lengths.items() if _SOCKET[0] <= length <= _SOCKET[1]]
    if len(fits) == 1:
        return fits[0]
    shown = ", ".join(f"{length:.3g} m in {unit}" for unit, length in lengths.items())
    why = "more than one unit makes" if fits else "no unit makes"
    raise ScanError(
        f"{name}: {why} its length {size:.4g} that of a socket, {_SOCKET[0]:g} to {_SOCKET[1]:g} m"
        f" ({shown})",
        "give its unit with --unit",
    )
