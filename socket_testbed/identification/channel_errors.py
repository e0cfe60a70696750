"""Errors of any model per channel, with the summary figures of the paper."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from socket_testbed.arrays import FloatArray, finite_mean, rms
from socket_testbed.identification.contact import ContactModel
from socket_testbed.samples import WRENCH_CHANNELS, Samples, channel_unit
from socket_testbed.tables import number, split_unit

if TYPE_CHECKING:
    import pandas as pd

_CONSTANT = 1e-12  # [-]; spread of a constant channel, relative to its magnitude


@dataclass(frozen=True)
class ChannelErrors:
    """Errors of one channel, in the channel's unit; NaN without a sample.

    Attributes:
        name: The channel: of the wrench in {S}, such as `Mx`, or of a cluster in the cluster's
            frame, such as `distal.Fz`.
        unit: Unit of the errors, `N m` or `N`.
        rmse: Root-mean-square error [N m] or [N].
        mae: Mean absolute error [N m] or [N].
        sigma: Standard deviation of the residual, the error without its mean [N m] or [N].
        skill: ``1 - RMSE / RMSE of the best constant`` [-]: as a constant explains a static hold,
            an RMSE alone is flattering. At most 1; 0 or less if a constant is as good. NaN for
            a constant channel.
        samples: Number of samples in which the channel was measured and predicted.
        in_objective: Whether the channel was fitted.
    """

    name: str
    unit: str
    rmse: float
    mae: float
    sigma: float
    skill: float
    samples: int
    in_objective: bool


def deviation(values: FloatArray) -> float:
    """Standard deviation of values (N,), in their unit: the RMSE of the best constant.

    It is 0 if they differ by rounding only, and NaN if any is NaN.
    """
    found = float(np.std(values))
    return 0.0 if found <= _CONSTANT * float(np.abs(values).max()) else found


def skill_of(error: float, of_constant: float) -> float:
    """Skill of an error relative to that of the best constant, 1 or less [-].

    Args:
        error: RMSE of a prediction, or a mean of several, in any unit.
        of_constant: RMSE of the best constant in that unit; 0 gives a skill of NaN.
    """
    return 1.0 - error / (of_constant or np.nan)


def channel_errors(
    name: str, measured: FloatArray, predicted: FloatArray, in_objective: bool = True
) -> ChannelErrors:
    """Errors of one channel over the samples in which it was measured and predicted.

    Args:
        name: Name of the channel, such as `Mx` or `distal.Fz`.
        measured: Its measured values, shape (N,) [N m] or [N]; NaN where missing.
        predicted: Its predicted values, shape (N,) [N m] or [N]; NaN where missing.
        in_objective: Whether the channel was fitted.
    """
    rows = np.isfinite(measured) & np.isfinite(predicted)
    residual, count = predicted[rows] - measured[rows], int(rows.sum())
    rmse = mae = sigma = skill = float("nan")
    if count:
        rmse = rms(residual)
        mae, sigma = float(np.mean(np.abs(residual))), float(np.std(residual))
        skill = skill_of(rmse, deviation(measured[rows]))
    return ChannelErrors(name, channel_unit(name), rmse, mae, sigma, skill, count, in_objective)


def errors_to_dataframe(errors: Iterable[ChannelErrors]) -> pd.DataFrame:
    """Errors as a pandas table, one row per channel, indexed by its name: see `ChannelErrors`."""
    import pandas as pd

    titles = {"name": "channel", "rmse": "RMSE", "mae": "MAE", "in_objective": "in objective"}
    table = pd.DataFrame([vars(error) for error in errors])
    return table.rename(columns=titles).set_index("channel")


# The paper's summary figures: fields of `ErrorSummary` with their titles
QUOTED = {
    "mean_moment_rmse": "mean moment RMSE [N m]",
    "mean_force_rmse": "mean force RMSE [N]",
    "median_local_rmse": "median local RMSE [N]",
}


@dataclass(frozen=True)
class ErrorSummary:
    """The paper's summary figures over the channels in the objective; NaN without any.

    Attributes:
        mean_moment_rmse: Mean RMSE of the wrench's moments [N m].
        mean_force_rmse: Mean RMSE of the wrench's forces [N].
        median_local_rmse: Median RMSE of the clusters' channels [N].
        skill: Median skill of all channels in the objective [-].
        wrench_skill: Median skill of the wrench's channels [-].
        local_skill: Median skill of the clusters' channels [-].
        without_value: Names of the channels without a sample that is both measured and predicted,
            which are in none of the figures.
    """

    mean_moment_rmse: float
    mean_force_rmse: float
    median_local_rmse: float
    skill: float
    wrench_skill: float
    local_skill: float
    without_value: tuple[str, ...]

    @property
    def quoted(self) -> dict[str, float]:
        """The paper's figures by their fields, the keys of `QUOTED` [N m, N]."""
        return {field: getattr(self, field) for field in QUOTED}

    def in_words(self, form: Callable[[float], str] = number) -> str:
        """The paper's figures with their units, in one line; `form` writes a number."""
        titles = map(split_unit, QUOTED.values())
        pairs = zip(titles, self.quoted.values(), strict=True)
        return ", ".join(f"{name} {form(value)} {unit}" for (name, unit), value in pairs)


def summarise_errors(errors: Sequence[ChannelErrors]) -> ErrorSummary:
    """Means and medians over the channels in the objective, as in the paper."""
    known = [error for error in errors if error.samples > 0 and error.in_objective]
    wrench = [error for error in known if error.name in WRENCH_CHANNELS]
    local = [error for error in known if error.name not in WRENCH_CHANNELS]
    return ErrorSummary(
        mean_moment_rmse=finite_mean(error.rmse for error in wrench if error.name[0] == "M"),
        mean_force_rmse=finite_mean(error.rmse for error in wrench if error.name[0] == "F"),
        median_local_rmse=finite_mean((error.rmse for error in local), np.median),
        skill=finite_mean((error.skill for error in known), np.median),
        wrench_skill=finite_mean((error.skill for error in wrench), np.median),
        local_skill=finite_mean((error.skill for error in local), np.median),
        without_value=tuple(error.name for error in errors if error.samples == 0),
    )


def evaluate(
    samples: Samples, predicted: ContactModel | FloatArray, leave_out: tuple[str, ...] = ()
) -> tuple[ChannelErrors, ...]:
    """Errors of every channel of a model or of its predictions, in the order of the channels.

    Args:
        samples: N measured samples with c clusters; forces whose status is not OK are ignored.
        predicted: A model, or predictions of all channels in the order of `Samples.channels`,
            shape (N, 6 + 3c) [N m, N]. A model predicts from the poses of the samples as they are.
        leave_out: Names of the channels that were not fitted, such as `Mz`.
    """
    if isinstance(predicted, ContactModel):
        predicted = predicted.predict(samples.pose, samples.clusters, samples.stamps)
    measured = samples.trusted_values
    return tuple(
        channel_errors(name, measured[:, i], predicted[:, i], name not in leave_out)
        for i, name in enumerate(samples.channels)
    )
