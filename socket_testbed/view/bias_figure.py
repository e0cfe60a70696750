"""The constant offsets of the sensors as bars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from socket_testbed.arrays import FloatArray
from socket_testbed.samples import WRENCH_CHANNELS
from socket_testbed.view.paper import MODEL_STYLES, dress, lay_out

_WIDTH, _ROW, _REST = 5.6, 0.24, 0.8  # [inch]
_TITLES = ("moment [N m]", "force [N]", "force on a cluster, in its frame [N]")


def bias_figure(channels: Sequence[str], offsets: Mapping[str, FloatArray]) -> Figure:
    """Offsets of every channel, a bar a model: moments, forces, the clusters' forces.

    Args:
        channels: Names of the m channels.
        offsets: Offsets by model, shape (m,) each [N m, N]; three models at most.
    """
    count = len(WRENCH_CHANNELS)
    groups = [[0, 1, 2], [3, 4, 5], [*range(count, len(channels))]]
    heights = [_ROW * len(indices) + _REST for indices in groups]
    figure = Figure(figsize=(_WIDTH, sum(heights)), layout="constrained")
    axes = figure.subplots(3, 1, height_ratios=heights)
    thickness = 0.8 / len(offsets)
    for axis, title, indices in zip(axes, _TITLES, groups, strict=True):
        places = np.arange(len(indices))
        for number, (label, values) in enumerate(offsets.items()):
            shift = (number - 0.5 * (len(offsets) - 1)) * thickness
            colour = MODEL_STYLES[-1 - number]["color"]
            axis.barh(places + shift, values[indices], thickness, color=colour, label=label)
        axis.axvline(0.0, color="0.3", linewidth=0.8)
        axis.set_yticks(places, [channels[i] for i in indices], fontsize=9, parse_math=False)
        axis.invert_yaxis()
        axis.set_xlabel(f"offset of the {title}", fontsize=9)
        axis.tick_params(axis="x", labelsize=9)
        dress(axis)
    if len(offsets) > 1:
        for text in axes[0].legend(frameon=False, fontsize=8).get_texts():
            text.set_parse_math(False)
    return lay_out(figure)
