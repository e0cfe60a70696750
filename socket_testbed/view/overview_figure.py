"""A trial at a glance: the load over time, the plateaus, and what could not be used when."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.view.channel_panels import MOST_POINTS
from socket_testbed.view.paper import dress, lay_out
from socket_testbed.view.thinning import thin

_WIDTH, _LOAD, _ROW, _REST = 7.0, 1.7, 0.2, 1.2  # [inch]
_BINS = 400  # of the trial's time
_CHOSEN, _OTHER = "0.80", "0.93"  # greys


def overview_figure(
    time: FloatArray,
    wrench: FloatArray,
    plateaus: Sequence[tuple[float, float]],
    chosen: tuple[float, float],
    unusable: Mapping[str, BoolArray],
) -> Figure:
    """The magnitudes of force and moment, and the share of samples that cannot be used.

    Args:
        time: Times of the samples, shape (N,) [s].
        wrench: Measured wrenches [M; F], shape (N, 6) [N m, N].
        plateaus: Starts and ends of the steady stretches [s].
        chosen: Start and end of the segment in use [s].
        unusable: Samples in which a measurement cannot be used, shape (N,), by its name.
    """
    raster = _ROW * len(unusable) + _REST
    figure = Figure(figsize=(_WIDTH, 2.0 * _LOAD + raster), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True, height_ratios=(_LOAD, _LOAD, raster))
    for axis, columns, label, colour in (
        (axes[0], slice(3, 6), "force [N]", "#0072B2"),
        (axes[1], slice(0, 3), "moment [N m]", "#D55E00"),
    ):
        for span in plateaus:
            axis.axvspan(*span, color=_OTHER, linewidth=0.0)
        axis.axvspan(*chosen, color=_CHOSEN, linewidth=0.0)
        magnitude = np.linalg.norm(wrench[:, columns], axis=1)
        axis.plot(*thin(time, magnitude, MOST_POINTS), color=colour, linewidth=1.0)
        axis.set_ylabel(f"magnitude of the\n{label}", fontsize=9)
        dress(axis)
    _draw_raster(figure, axes[2], time, unusable)
    for axis in axes:
        axis.tick_params(labelsize=9)
    return lay_out(figure)


def _draw_raster(
    figure: Figure, axis: Axes, time: FloatArray, unusable: Mapping[str, BoolArray]
) -> None:
    count = max(1, min(_BINS, len(time) // 2))
    edges = np.linspace(time[0], max(time[-1], time[0] + 1e-3), count + 1)
    bins = np.clip(np.searchsorted(edges, time, side="right") - 1, 0, count - 1)
    triggers = np.bincount(bins, minlength=count)
    lost = [np.bincount(bins, flags, minlength=count) for flags in unusable.values()]
    # Without a trigger nothing was measured at all.
    share = np.where(triggers > 0, np.array(lost) / np.maximum(triggers, 1), 1.0)
    rows = np.arange(len(unusable) + 1) - 0.5
    mesh = axis.pcolormesh(edges, rows, share, cmap="Greys", vmin=0.0, vmax=1.0, rasterized=True)
    axis.set_yticks(range(len(unusable)), list(unusable), fontsize=8.5, parse_math=False)
    axis.invert_yaxis()
    axis.set_xlabel("time [s]", fontsize=9)
    bar = figure.colorbar(mesh, ax=axis, pad=0.01, aspect=12)
    bar.set_label("not usable [-]", fontsize=9)
