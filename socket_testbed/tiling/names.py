"""Names of tiles by their places, so that another tiling gives the same place the same name."""

from __future__ import annotations

import numpy as np

from socket_testbed.arrays import FloatArray


def tile_names(
    anchors: FloatArray, end: FloatArray, proximal: FloatArray, anterior: FloatArray
) -> tuple[str, ...]:
    """Names such as `h092_a045`: 92 mm above the distal end, 45 degrees from anterior.

    The angle is about the axis through the end, counterclockwise seen from above. Tiles at one
    place to the millimetre and the degree are told apart by a letter.

    Args:
        anchors: Centres of the tiles, shape (n, 3) [m].
        end: Centre of the distal end, shape (3,) [m].
        proximal: Direction towards the proximal end, shape (3,) [-].
        anterior: Direction from which angles count, shape (3,) [-].
    """
    left = np.cross(proximal, anterior)
    offset = anchors - end
    heights = np.maximum(np.round(1e3 * offset @ proximal), 0).astype(int)
    angles = np.degrees(np.arctan2(offset @ left, offset @ anterior))
    names: list[str] = []
    for height, angle in zip(heights, np.round(angles).astype(int) % 360, strict=True):
        name = f"h{height:03d}_a{angle:03d}"
        twins = sum(other.startswith(name) for other in names)
        names.append(name + (chr(ord("a") + twins) if twins else ""))
    return tuple(names)
