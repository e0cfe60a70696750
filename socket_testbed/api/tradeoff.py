"""The trade-off over theta, and the paper's pipeline."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from socket_testbed.api.trials import Progress, as_path, as_trial, started
from socket_testbed.arrays import FloatArray
from socket_testbed.results.models import part_to_fit
from socket_testbed.results.result import PathLike
from socket_testbed.results.tradeoff import PaperTable, Tradeoff, fit_paper, trace_fronts
from socket_testbed.settings.identification import Weights
from socket_testbed.settings.options import (
    FrontOptions,
    PaperOptions,
    SettingsOptions,
    ThetasOptions,
)
from socket_testbed.trials.segment import Segment, Span
from socket_testbed.trials.trial import Trial


def theta_values(thetas: int) -> FloatArray:
    """As many evenly spaced thetas from 0 to 1, rounded to readable digits, (thetas,) [-]."""
    chosen = ThetasOptions(thetas=thetas)
    return np.linspace(0.0, 1.0, chosen.thetas).round(10)


def pareto(
    trial: Trial | PathLike,
    segment: str | Span | Segment = FrontOptions.segment,
    *,
    thetas: int = FrontOptions.thetas,
    params: PathLike | None = None,
    weights: Weights | None = None,
    smoothness: float | None = None,
    leave_out: Sequence[str] | None = None,
    pose_smoothing: float | None = None,
    frames: int | None = None,
    initial_stiffness: float | Literal["auto"] | None = None,
    solver: str | None = None,
    progress: Progress | None = None,
) -> Tradeoff:
    """Identify the contact model along theta, for the paper's variants, and find the knees.

    Args:
        trial: The trial.
        segment: As in `fit`.
        thetas: Number of values of theta from 0 to 1.
        params: As in `fit`.
        weights: As in `fit`.
        smoothness: As in `fit`.
        leave_out: As in `fit`.
        pose_smoothing: As in `fit`.
        frames: As in `fit`.
        initial_stiffness: As in `fit`.
        solver: As in `fit`.
        progress: See `Progress`.

    Returns:
        The trade-off: `fronts` by variant, `to_dataframe()` with a row per solution.

    Raises:
        ConfigurationError: A setting or a file is wrong.
        TrialError: The trial cannot be read or has no such segment.
        IdentificationError: The samples cannot be fitted, a group of channels is left out, or no
            theta gives a usable solution.

    >>> tradeoff = st.pareto(st.open_trial("trials/hold"), thetas=11)
    >>> tradeoff.fronts["stiffness"]
    Front(stiffness, 11 solutions, ... not dominated; knee of depth ...)
    >>> tradeoff.draw("front.png")
    """
    values = theta_values(thetas)
    options = SettingsOptions(
        params=as_path(params),
        weights=weights,
        smoothness=smoothness,
        leave_out=leave_out,
        pose_smoothing=pose_smoothing,
        frames=frames,
        initial_stiffness=initial_stiffness,
        solver=solver,
    )
    trial = as_trial(trial)
    settings = trial.settings_for(options)
    chosen, samples = part_to_fit(trial, segment, settings)
    report = started(progress, "solving for every theta")
    return trace_fronts(trial, chosen, samples, settings.identification, values, report)


def paper(
    trial: Trial | PathLike,
    segment: str | Span | Segment = PaperOptions.segment,
    *,
    thetas: int = PaperOptions.thetas,
    weights: Weights = PaperOptions.weights,
    frames: int = PaperOptions.frames,
    params: PathLike | None = None,
    theta: float | None = None,
    smoothness: float | None = None,
    leave_out: Sequence[str] | None = None,
    pose_smoothing: float | None = None,
    initial_stiffness: float | Literal["auto"] | None = None,
    solver: str | None = None,
    progress: Progress | None = None,
) -> PaperTable:
    """Run the paper's pipeline: both stages, without and with offsets, and the front over theta.

    Other settings are those of `fit`, whose defaults follow the paper where known: docs/paper.md.

    Args:
        trial: The trial.
        segment: As in `fit`.
        thetas: Number of values of theta from 0 to 1.
        weights: As in `fit`.
        frames: As in `fit`.
        params: As in `fit`.
        theta: As in `fit`.
        smoothness: As in `fit`.
        leave_out: As in `fit`.
        pose_smoothing: As in `fit`.
        initial_stiffness: As in `fit`.
        solver: As in `fit`.
        progress: See `Progress`.

    Returns:
        The figures: `to_dataframe()` has a row each.

    Raises:
        ConfigurationError: A setting or a file is wrong.
        TrialError: The trial cannot be read or has no such segment.
        IdentificationError: The samples cannot be fitted, or no theta gives a usable solution.

    >>> found = st.paper(st.open_trial("trials/hold"), thetas=5)
    >>> found.to_dataframe().loc["RMSE of Mx [N m]", "the paper"].tolist()
    [3.99, 0.95]
    """
    values = theta_values(thetas)
    options = SettingsOptions(
        params=as_path(params),
        weights=weights,
        frames=frames,
        theta=theta,
        smoothness=smoothness,
        leave_out=leave_out,
        pose_smoothing=pose_smoothing,
        initial_stiffness=initial_stiffness,
        solver=solver,
    )
    trial = as_trial(trial)
    settings = trial.settings_for(options)
    chosen, samples = part_to_fit(trial, segment, settings)
    report = started(progress, "solving for every theta")
    return fit_paper(trial, chosen, samples, settings.identification, values, report)
