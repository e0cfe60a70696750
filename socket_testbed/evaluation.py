"""Errors of a model on samples, channel by channel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.contact import ContactModel
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples


@dataclass(frozen=True)
class ChannelErrors:
    """Errors of one channel, in the channel's unit.

    Attributes:
        name: Name of the channel, such as Mx or distal.Fz.
        unit: N m or N.
        in_objective: Whether the fit saw the channel.
        samples: Number of samples with a value.
        rmse: Root-mean-square error.
        mae: Mean absolute error.
        sigma: Standard deviation of the residual.
        skill: ``1 - RMSE / RMSE of the best constant`` [-]: a constant explains a static
            hold, so an RMSE without its skill flatters. NaN where the channel is constant.
    """

    name: str
    unit: str
    in_objective: bool
    samples: int
    rmse: float
    mae: float
    sigma: float
    skill: float


def channel_unit(name: str) -> str:
    """Unit of a channel by its name."""
    return "N m" if name.startswith("M") else "N"


def channel_errors(
    name: str, measured: FloatArray, predicted: FloatArray, in_objective: bool = True
) -> ChannelErrors:
    """Errors of one channel over the samples in which it was measured and predicted.

    Args:
        name: Name of the channel.
        measured: Measured values, shape (N,).
        predicted: Predicted values, shape (N,).
        in_objective: Whether the fit saw the channel.
    """
    rows = np.isfinite(measured) & np.isfinite(predicted)
    residual = predicted[rows] - measured[rows]
    unit = channel_unit(name)
    if not rows.any():
        return ChannelErrors(name, unit, in_objective, 0, *([float("nan")] * 4))
    rmse = float(np.sqrt(np.mean(residual**2)))
    constant = float(np.std(measured[rows]))
    return ChannelErrors(
        name=name,
        unit=unit,
        in_objective=in_objective,
        samples=int(rows.sum()),
        rmse=rmse,
        mae=float(np.mean(np.abs(residual))),
        sigma=float(np.std(residual)),
        skill=1.0 - rmse / constant if constant > 0.0 else float("nan"),
    )


def evaluate(
    samples: Samples, model: ContactModel, leave_out: tuple[str, ...] = ()
) -> tuple[ChannelErrors, ...]:
    """Errors of a model on every channel of the samples.

    Args:
        samples: Samples to predict.
        model: The contact model.
        leave_out: Channels that were not in the objective of its fit.

    Returns:
        Errors of the wrench's six channels, then three a cluster in its frame.
    """
    wrench = model.wrench(samples.position)
    local = model.cluster_forces(samples.position)
    errors = [
        channel_errors(name, samples.wrench[:, i], wrench[:, i], name not in leave_out)
        for i, name in enumerate(WRENCH_CHANNELS)
    ]
    for column, cluster in enumerate(samples.clusters):
        for axis, channel in enumerate(LOCAL_CHANNELS):
            name = f"{cluster}.{channel}"
            measured = samples.local_forces[:, column, axis]
            predicted = local[cluster][:, axis]
            errors.append(channel_errors(name, measured, predicted, name not in leave_out))
    return tuple(errors)
