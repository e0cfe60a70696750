"""A calibration as a figure: calibrated against known stress, residuals, and hysteresis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.calibration.bench_data import STRESSES
from socket_testbed.calibration.calibrate import BenchCalibration
from socket_testbed.calibration.drift import FALLING, RISING
from socket_testbed.calibration.outliers import Outlier
from socket_testbed.report.figures.style import (
    DEFAULT_STYLE,
    FigureStyle,
    in_style,
    lay_out,
    style_axes,
)

# Okabe & Ito's colours; the marks tell the branches apart in grey, too.
_BRANCHES = (
    (RISING, "rising", "#0072B2", "^"),
    (FALLING, "falling", "#D55E00", "v"),
)
_MOST_POINTS = 4000
_LEVELS = 12


@in_style
def bench_figure(
    calibrated: BenchCalibration, cluster: str, style: FigureStyle = DEFAULT_STYLE
) -> Figure:
    """Draw a column of panels a stress, in kPa.

    Above, calibrated over known stress; in the middle, the residuals of the fit and of the
    cross-validation; below, the mean residual of the rising and falling branches.

    Args:
        calibrated: The calibration.
        cluster: Name of the cluster.
        style: How it is set.
    """
    narrow = style.is_narrow
    figure = style.figure(150.0)
    axes = figure.subplots(3, 3, sharex="col")
    style.add_title(
        figure,
        f"{cluster}: {', '.join(calibrated.bench.files)};"
        f" {calibrated.cross_validation.groups} held out in turn",
    )
    known = calibrated.bench.stress / 1e3
    fitted = calibrated.fitted / 1e3
    held_out = calibrated.cross_validation.predicted / 1e3
    for k, name in enumerate(STRESSES):
        some = slice(None, None, 1 + len(known) // _MOST_POINTS)
        _draw_fit(axes[0, k], known[some, k], fitted[some, k])
        _draw_residuals(
            axes[1, k], known[some, k], (fitted - known)[some, k], (held_out - known)[some, k]
        )
        outliers = [o for o in calibrated.outliers if o.axis == k]
        _draw_outliers(axes[0, k], outliers)
        branches = calibrated.branches[:, k]
        _draw_loop(axes[2, k], known[:, k], (fitted - known)[:, k], branches)
        error = f"\nheld-out:\n{calibrated.held_out[k].percent:.1f} % of\nfull scale"
        axes[0, k].set_title(name + error * style.titles)
        axes[2, k].set_xlabel("known [kPa]")
    for axis, label in zip(axes[:, 0], ("calibrated", "residual", "mean residual"), strict=True):
        axis.set_ylabel(f"{label} [kPa]")
    keys: dict[str, Artist] = {}
    for axis in axes.flat:
        style_axes(axis)
        axis.locator_params(nbins=4 if narrow else 6)
        handles, labels = axis.get_legend_handles_labels()
        keys |= dict(zip(labels, handles, strict=True))
    figure.legend(keys.values(), keys.keys(), loc="outside lower center", ncols=5 - 2 * narrow)
    return lay_out(figure)


def _draw_fit(axis: Axes, known: FloatArray, fitted: FloatArray) -> None:
    ends = [known.min(), known.max()]
    axis.plot(ends, ends, color="0.72", linewidth=2.4)
    axis.plot(known, fitted, ".", color="0.2", markersize=2.0)


def _draw_outliers(axis: Axes, outliers: Sequence[Outlier]) -> None:
    if outliers:
        known = [outlier.known / 1e3 for outlier in outliers]
        fitted = [outlier.fitted / 1e3 for outlier in outliers]
        axis.plot(known, fitted, "o", color="#D55E00", fillstyle="none", label="outlier")


def _draw_residuals(
    axis: Axes, known: FloatArray, training: FloatArray, held_out: FloatArray
) -> None:
    axis.plot(known, held_out, "x", color="#D55E00", markersize=3.0, label="held out")
    axis.plot(known, training, ".", color="0.2", markersize=2.0, label="in the fit")
    axis.axhline(0.0, color="0.72", linewidth=1.0)


def _draw_loop(axis: Axes, known: FloatArray, residual: FloatArray, branches: IntArray) -> None:
    edges = np.linspace(known.min(), known.max(), _LEVELS + 1)
    centres = 0.5 * (edges[1:] + edges[:-1])
    level = np.clip(np.searchsorted(edges, known, side="right") - 1, 0, _LEVELS - 1)
    for branch, label, color, marker in _BRANCHES:
        rows = branches == branch
        count = np.bincount(level[rows], minlength=_LEVELS)
        total = np.bincount(level[rows], residual[rows], minlength=_LEVELS)
        seen = count > 0
        mean = total[seen] / count[seen]
        axis.plot(centres[seen], mean, label=label, color=color, marker=marker, markersize=4.0)
    axis.axhline(0.0, color="0.72", linewidth=1.0)
