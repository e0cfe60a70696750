"""Measured against predicted wrench as a figure for a paper."""

from __future__ import annotations

from pathlib import Path

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.evaluation import channel_errors
from socket_testbed.samples import WRENCH_CHANNELS
from socket_testbed.view.channel_panels import Panel, Prediction, panels_figure
from socket_testbed.view.paper import save_figure

_ORDER = (3, 4, 5, 0, 1, 2)  # the forces above, the moments below


def wrench_figure(
    time: FloatArray,
    measured: FloatArray,
    predicted: dict[str, FloatArray],
    rows: BoolArray,
    title: str,
    path: Path,
) -> None:
    """Measured against predicted wrench, a panel a channel, with the errors in the panels.

    Args:
        time: Times, shape (N,) [s].
        measured: Measured wrenches [M; F], shape (N, 6) [N m, N].
        predicted: Predicted wrenches by variant, shape (N, 6) each; NaN before a model.
        rows: Samples that the errors are taken over, shaded, shape (N,).
        title: What is shown.
        path: File to write; its suffix says the format.
    """
    span = (float(time[rows][0]), float(time[rows][-1]))
    panels = [
        Panel(
            time,
            measured[:, i],
            tuple(
                Prediction(
                    variant,
                    wrench[:, i],
                    channel_errors(WRENCH_CHANNELS[i], measured[rows, i], wrench[rows, i]),
                )
                for variant, wrench in predicted.items()
            ),
            span,
        )
        for i in _ORDER
    ]
    save_figure(panels_figure(panels, 3, f"{title}; errors over the shaded span"), path)
