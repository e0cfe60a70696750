"""The first line of Motive's CSV exports: keys and values."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from socket_testbed.errors import RegistrationError

_OLDEST, _NEWEST = 1.2, 1.25
_METRES = {"meters": 1.0, "centimeters": 1e-2, "millimeters": 1e-3}
_AGAIN = "export the take from Motive again"


@dataclass(frozen=True)
class MotiveHeader:
    """What the header says of a take.

    Attributes:
        version: Version of the format.
        frame_rate: Frame rate of the export [Hz].
        units: Unit of length, as written.
        scale: Unit of length [m].
        exported: Number of frames that were exported; None where it is not said.
        notes: What a person should know of it.
    """

    version: str
    frame_rate: float
    units: str
    scale: float
    exported: int | None
    notes: tuple[str, ...]


def read_header(cells: list[str], path: Path) -> MotiveHeader:
    """Read the header.

    Raises:
        RegistrationError: If this is no header of Motive, or one of a file that is not read here.
    """
    cells = [cell.strip() for cell in cells]
    if cells[0] != "Format Version":
        raise RegistrationError(
            f"{path}: is no export of Motive, which begins with 'Format Version'",
            "export the take to CSV from Motive, with the header information",
        )
    # A comma in the name of the take shifts the pairs: what follows a key is its value.
    values = dict(pairwise(cells))
    for key in ("Format Version", "Length Units", "Rotation Type"):
        if not values.get(key):
            raise RegistrationError(f"{path}: the header has no '{key}'", _AGAIN)
    _require_conventions(values, path)
    units = values["Length Units"]
    exported = values.get("Total Exported Frames", "")
    return MotiveHeader(
        version=values["Format Version"],
        frame_rate=_frame_rate(values, path),
        units=units,
        scale=_METRES[units.lower()],
        exported=int(exported) if exported.isdecimal() else None,
        notes=_version_notes(values["Format Version"], path),
    )


def _require_conventions(values: dict[str, str], path: Path) -> None:
    if values["Rotation Type"] != "Quaternion":
        raise RegistrationError(
            f"{path}: has rotations of the type {values['Rotation Type']}", "export quaternions"
        )
    if values["Length Units"].lower() not in _METRES:
        raise RegistrationError(
            f"{path}: has lengths in '{values['Length Units']}'",
            "export metres, centimetres or millimetres",
        )
    space = values.get("Coordinate Space", "Global")
    if space != "Global":
        raise RegistrationError(
            f"{path}: has coordinates in the space '{space}'", "export global (world) coordinates"
        )


def _version_notes(version: str, path: Path) -> tuple[str, ...]:
    number = _number(version)
    if not number >= _OLDEST:
        raise RegistrationError(
            f"{path}: has the format version {version}",
            "export the take from a newer Motive (format 1.20 to 1.25)",
        )
    if number > _NEWEST:
        return (f"{path}: the format version {version} is not known; read as {_NEWEST}",)
    return ()


def _frame_rate(values: dict[str, str], path: Path) -> float:
    for key in ("Export Frame Rate", "Capture Frame Rate"):
        rate = _number(values.get(key, ""))
        if 0.0 < rate < math.inf:
            return rate
    raise RegistrationError(f"{path}: the header has no frame rate", _AGAIN)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
