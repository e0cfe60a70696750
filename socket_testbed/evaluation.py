"""Errors of a model on samples, channel by channel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.contact import ContactModel
from socket_testbed.errors import ConfigurationError
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples

_ROUNDING = 1e-12  # [-]; spread of a channel that is constant, against its size


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
    return "N m" if name.rpartition(".")[2].startswith("M") else "N"


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
    rounding = _ROUNDING * float(np.abs(measured[rows]).max())
    return ChannelErrors(
        name=name,
        unit=unit,
        in_objective=in_objective,
        samples=int(rows.sum()),
        rmse=rmse,
        mae=float(np.mean(np.abs(residual))),
        sigma=float(np.std(residual)),
        skill=1.0 - rmse / constant if constant > rounding else float("nan"),
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

    Raises:
        ConfigurationError: If the model lacks a cluster of the samples.
    """
    lacking = [name for name in samples.clusters if name not in model.cluster_points]
    if lacking:
        raise ConfigurationError(
            f"the model knows no cluster {', '.join(lacking)}", "fit one on a trial with it"
        )
    wrench = model.wrench(samples.position)
    trusted = samples.trusted_forces
    local = model.cluster_forces(samples.position)
    errors = [
        channel_errors(name, samples.wrench[:, i], wrench[:, i], name not in leave_out)
        for i, name in enumerate(WRENCH_CHANNELS)
    ]
    for column, cluster in enumerate(samples.clusters):
        for axis, channel in enumerate(LOCAL_CHANNELS):
            name = f"{cluster}.{channel}"
            measured = trusted[:, column, axis]
            predicted = local[cluster][:, axis]
            errors.append(channel_errors(name, measured, predicted, name not in leave_out))
    return tuple(errors)
