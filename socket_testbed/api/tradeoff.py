"""The trade-off over theta, and the paper's pipeline."""

from __future__ import annotations

from typing import Any, Unpack

import numpy as np
from threadpoolctl import threadpool_limits

from socket_testbed.api.models import fit, prepare_fit
from socket_testbed.api.trials import Progress, as_trial, started
from socket_testbed.arrays import FloatArray
from socket_testbed.documents import check_whole
from socket_testbed.errors import ConfigurationError
from socket_testbed.identification.paper import beside_published
from socket_testbed.identification.pareto import pareto_front
from socket_testbed.results.result import PathLike
from socket_testbed.results.tradeoff import PaperTable, Tradeoff
from socket_testbed.settings.identification import (
    PAPER_VARIANTS,
    FrontChoices,
    PaperChoices,
    Weights,
)
from socket_testbed.settings.options import FrontOptions, PaperOptions
from socket_testbed.trials.segment import Segment, Span
from socket_testbed.trials.trial import Trial

_MAX_THETAS = 10_001


def theta_values(thetas: int) -> FloatArray:
    """As many evenly spaced thetas from 0 to 1, rounded to readable digits, (thetas,) [-]."""
    count = check_whole(thetas, "--thetas", 2, _MAX_THETAS)
    return np.linspace(0.0, 1.0, count).round(10)


def pareto(
    trial: Trial | PathLike,
    segment: str | Span | Segment = "plateau",
    *,
    thetas: int = FrontOptions.thetas,
    params: PathLike | None = None,
    progress: Progress | None = None,
    **choices: Unpack[FrontChoices],
) -> Tradeoff:
    """Identify the contact model along theta, for the paper's variants, and find the knees.

    Args:
        trial: The trial.
        segment: As in `fit`.
        thetas: Number of values of theta from 0 to 1.
        params: As in `fit`.
        progress: See `Progress`.
        choices: Settings as in `fit`, except `variant` and `theta`.

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
    trial, chosen, rows, settings = prepare_fit(trial, segment, params, choices)
    report = started(progress, "solving for every theta")
    with threadpool_limits(1):
        fronts = pareto_front(rows, trial.geometry, settings, values, report)
    return Tradeoff(trial, chosen, fronts)


def paper(
    trial: Trial | PathLike,
    segment: str | Span | Segment = "plateau",
    *,
    thetas: int = PaperOptions.thetas,
    weights: Weights = PaperOptions.weights,
    frames: int = PaperOptions.frames,
    params: PathLike | None = None,
    progress: Progress | None = None,
    **choices: Unpack[PaperChoices],
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
        progress: See `Progress`.
        choices: Other settings as in `fit`, except `variant`.

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
    trial = as_trial(trial)
    chosen: dict[str, Any] = {"weights": weights, "frames": frames, "params": params, **choices}
    theta_values(thetas)  # fails before long work
    if "variant" in choices:
        raise ConfigurationError("variant is given", "leave it: the paper's two are fitted")
    fits = {variant: fit(trial, segment, variant=variant, **chosen) for variant in PAPER_VARIANTS}
    fronts = pareto(trial, segment, thetas=thetas, progress=progress, **chosen).fronts
    errors = {variant: found.fit.errors for variant, found in fits.items()}
    last = fits[PAPER_VARIANTS[-1]]
    settings = last.fit.settings
    rows = trial.checked(settings.leave_out).samples[last.segment.rows]
    table = beside_published(errors, fronts, rows, settings, trial.geometry)
    return PaperTable(trial, last.segment, last.fit.samples, settings, table)
