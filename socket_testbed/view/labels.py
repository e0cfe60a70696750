"""Names in tiles."""

from __future__ import annotations

import textwrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from socket_testbed.arrays import FloatArray

_LARGEST, _SMALLEST = 7.0, 3.0  # [pt]
_LONGEST_LINE = 9  # characters
_CHARACTER = 0.62  # [-]; width of a character by the size of the font
_LINE = 1.25  # [-]; height of a line, likewise


def write_label(axis: Axes, label: str, corners: FloatArray, colour: str) -> None:
    """Write a label inside a tile, as large as fits; leave it out where that is too small.

    The panel must have its limits and its aspect.

    Args:
        axis: The panel.
        label: What to write; it may hold anything, and none of it is markup.
        corners: The tile's corners in the panel's coordinates, shape (4, 2).
        colour: Of the ink.
    """
    if not label.strip():
        return
    lines = _break(label)
    width, height = np.ptp(corners, axis=0) * _points_per_unit(axis)
    size = min(
        _LARGEST,
        width / (_CHARACTER * max(len(line) for line in lines)),
        height / (_LINE * len(lines)),
    )
    if size < _SMALLEST:
        return
    x, y = corners.mean(axis=0)
    axis.text(
        x,
        y,
        "\n".join(lines),
        color=colour,
        fontsize=size,
        ha="center",
        va="center",
        parse_math=False,
        linespacing=1.0,
        zorder=3,
    )


def write_cluster(axis: Axes, cluster: str, corners: FloatArray) -> None:
    """Write the name of a cluster over its tile, at one size whatever the tile's.

    Args:
        axis: The panel.
        cluster: What to write, no markup either.
        corners: The tile's corners in the panel's coordinates, shape (4, 2).
    """
    x, y = corners.mean(axis=0)
    axis.text(
        x,
        y,
        "\n".join(_break(cluster)),
        fontsize=_LARGEST,
        ha="center",
        va="center",
        parse_math=False,
        linespacing=1.2,
        path_effects=[withStroke(linewidth=2.0, foreground="white")],
        zorder=3,
    )


def _break(label: str) -> list[str]:
    """Break a long label behind its underscores and at its spaces."""
    if len(label) <= _LONGEST_LINE:
        return [label]
    words = label.replace("_", "_ ").split()
    lines = textwrap.wrap(" ".join(words), _LONGEST_LINE, break_long_words=False)
    return [line.replace("_ ", "_") for line in lines]


def _points_per_unit(axis: Axes) -> FloatArray:
    """Size of a unit of the panel's two axes on paper, shape (2,) [pt]."""
    paper = np.array(axis.figure.bbox.size) * 72.0 / axis.figure.dpi
    room = axis.get_position(original=True).size * paper
    span = np.abs([np.subtract(*axis.get_xlim()), np.subtract(*axis.get_ylim())])
    aspect = axis.get_aspect()
    per_x = min(room[0] / span[0], room[1] / (span[1] * aspect))
    return np.array([per_x, per_x * aspect])
