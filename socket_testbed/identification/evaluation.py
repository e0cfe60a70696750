"""Errors of a model on samples, per channel, and the figures that the paper quotes of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.identification.contact import ContactModel
from socket_testbed.samples import WRENCH_CHANNELS, Samples, channel_unit

if TYPE_CHECKING:
    import pandas as pd

_ROUNDING = 1e-12  # [-]; spread of a channel that is constant, against its size
_CHUNK = 4096  # samples; predicting takes memory by the samples times the tiles


@dataclass(frozen=True)
class ChannelErrors:
    """Errors of one channel, in the channel's unit."""

    name: str  # name of the channel, such as Mx or distal.Fz
    unit: str  # N m or N
    rmse: float  # root-mean-square error
    mae: float  # mean absolute error
    sigma: float  # standard deviation of the residual
    # ``1 - RMSE / RMSE of the best constant`` [-]: a constant explains a static hold, so an RMSE
    # without its skill flatters. NaN where the channel is constant.
    skill: float
    samples: int  # number of samples with a value
    in_objective: bool  # whether the fit saw the channel


def channel_errors(
    name: str, measured: FloatArray, predicted: FloatArray, in_objective: bool = True
) -> ChannelErrors:
    """Errors of one channel over the samples in which it was measured and predicted."""
    rows = np.isfinite(measured) & np.isfinite(predicted)
    residual, count = predicted[rows] - measured[rows], int(rows.sum())
    rmse = mae = sigma = skill = float("nan")
    if count:
        rmse = float(np.sqrt(np.mean(residual**2)))
        mae, sigma = float(np.mean(np.abs(residual))), float(np.std(residual))
        constant = float(np.std(measured[rows]))
        if constant > _ROUNDING * float(np.abs(measured[rows]).max()):
            skill = 1.0 - rmse / constant
    return ChannelErrors(name, channel_unit(name), rmse, mae, sigma, skill, count, in_objective)


def errors_to_dataframe(errors: Iterable[ChannelErrors]) -> pd.DataFrame:
    """Errors as a pandas table, a row per channel, indexed by its name: see `ChannelErrors`."""
    import pandas as pd

    titles = {"name": "channel", "rmse": "RMSE", "mae": "MAE", "in_objective": "in objective"}
    table = pd.DataFrame([vars(error) for error in errors])
    return table.rename(columns=titles).set_index("channel")


@dataclass(frozen=True)
class ErrorSummary:
    """What the paper quotes of the errors of the channels in the objective; NaN without any."""

    moment_rmse: float  # mean RMSE of the moments [N m]
    force_rmse: float  # mean RMSE of the forces [N]
    local_rmse: float  # median RMSE of the clusters' channels [N]
    skill: float  # median skill of these channels [-]
    wrench_skill: float  # median skill of the wrench's channels [-]
    local_skill: float  # median skill of the clusters' channels [-]
    # channels that no sample has both measured and predicted; no figure includes them
    without_value: tuple[str, ...]


def summarise_errors(errors: Sequence[ChannelErrors]) -> ErrorSummary:
    """Means and medians over the channels in the objective, as the paper quotes them."""
    known = [error for error in errors if error.samples > 0 and error.in_objective]
    wrench = [error for error in known if error.name in WRENCH_CHANNELS]
    local = [error for error in known if error.name not in WRENCH_CHANNELS]
    return ErrorSummary(
        moment_rmse=finite_mean(error.rmse for error in wrench if error.name[0] == "M"),
        force_rmse=finite_mean(error.rmse for error in wrench if error.name[0] == "F"),
        local_rmse=finite_mean((error.rmse for error in local), np.median),
        skill=finite_mean((error.skill for error in known), np.median),
        wrench_skill=finite_mean((error.skill for error in wrench), np.median),
        local_skill=finite_mean((error.skill for error in local), np.median),
        without_value=tuple(error.name for error in errors if error.samples == 0),
    )


def predict_channels(model: ContactModel, pose: FloatArray, clusters: Sequence[str]) -> FloatArray:
    """Predict every channel in the order of `channel_names`, shape (N, 6 + 3c) [N m, N].

    The wrench comes first, then the force on each of the c clusters in its frame. A pose holds
    position and rotation vector, shape (N, 6) [m, rad]; NaN where it is NaN.
    """
    lacking = [name for name in clusters if name not in model.cluster_points]
    if lacking:
        raise ConfigurationError(
            f"the model has no cluster {', '.join(lacking)}", "fit a model on a trial that has it"
        )
    predicted = np.empty((len(pose), 6 + 3 * len(clusters)))
    for start in range(0, len(pose), _CHUNK):
        rows = slice(start, start + _CHUNK)
        local = model.cluster_forces(pose[rows])
        forces = [local[name] for name in clusters]
        predicted[rows] = np.hstack([model.wrench(pose[rows]), *forces])
    return predicted


def evaluate(
    samples: Samples, model: ContactModel, leave_out: tuple[str, ...] = ()
) -> tuple[ChannelErrors, ...]:
    """Errors of a model on every channel of the samples; those left out were not in its fit."""
    predicted = predict_channels(model, samples.pose, samples.clusters)
    return evaluate_predictions(samples, predicted, leave_out)


def evaluate_predictions(
    samples: Samples, predicted: FloatArray, leave_out: tuple[str, ...] = ()
) -> tuple[ChannelErrors, ...]:
    """Errors of predictions, as `predict_channels` gives them for these samples: see `evaluate`."""
    measured = samples.trusted_values
    return tuple(
        channel_errors(name, measured[:, i], predicted[:, i], name not in leave_out)
        for i, name in enumerate(samples.channels)
    )


def finite_mean(values: Iterable[float], mean: Callable[[list[float]], Any] = np.mean) -> float:
    """Mean, or another `mean`, of the finite values; NaN without any."""
    finite = [value for value in values if np.isfinite(value)]
    return float(mean(finite)) if finite else float("nan")
