"""The trade-off over theta, and the paper's pipeline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from socket_testbed.api.models import fit, prepare_fit
from socket_testbed.api.result import Result, origin, records
from socket_testbed.api.trials import PathLike, Progress, as_trial, started
from socket_testbed.arrays import FloatArray
from socket_testbed.documents import check_number
from socket_testbed.identification.paper import PUBLISHED_FRAMES, THEIRS, beside_published
from socket_testbed.identification.pareto import Front, front_document, front_table, pareto_front
from socket_testbed.settings.identification import (
    PAPER_VARIANTS,
    IdentificationSettings,
    Variant,
    Weights,
)
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from socket_testbed.report.style import FigureStyle

_MAX_THETAS = 10_001


@dataclass(frozen=True, repr=False)
class Tradeoff(Result):
    """The trade-off between the wrench and the clusters on a segment of a trial."""

    trial: Trial
    segment: Segment
    fronts: dict[Variant, Front]  # the solutions along theta

    def __repr__(self) -> str:
        fronts = "; ".join(map(repr, self.fronts.values()))
        return f"Tradeoff({self.trial.name}, {self.segment}; {fronts})"

    def to_dataframe(self) -> pd.DataFrame:
        """A row per solution of both fronts, see `Front.to_dataframe`."""
        return front_table(self.fronts.values())

    def document(self) -> dict[str, Any]:
        """The fronts for JSON."""
        fronts = [front_document(front) for front in self.fronts.values()]
        return origin(self.trial, self.segment) | {"fronts": fronts}

    def _figure(self, style: FigureStyle) -> Figure:
        from socket_testbed.report.fronts import pareto_figure

        heading = f"{self.trial.name}, {self.segment}: trade-off between wrench and clusters"
        return pareto_figure([*self.fronts.values()], heading, style)


def theta_values(thetas: int) -> FloatArray:
    """Evenly spaced thetas from 0 to 1, rounded to readable digits [-]."""
    check_number(thetas, "--thetas", 2, _MAX_THETAS)
    return np.linspace(0.0, 1.0, thetas).round(10)


def pareto(
    trial: Trial | PathLike,
    segment: str | Segment = "plateau",
    *,
    thetas: int = 101,
    params: PathLike | None = None,
    progress: Progress | None = None,
    **choices: Any,
) -> Tradeoff:
    """Identify the contact model along theta, for the paper's variants, and find the knees.

    Args:
        trial: The trial.
        segment: As `specification` in `st.select_segment`, or a `Segment`.
        thetas: Number of values of theta from 0 to 1.
        params: As in `fit`.
        progress: See `Progress`.
        choices: Settings as in `fit`, except `variant` and `theta`.

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


@dataclass(frozen=True, repr=False)
class PaperTable(Result):
    """The paper's figures recomputed for a trial, next to the published ones."""

    trial: Trial
    segment: Segment
    samples: int  # in the objective
    settings: IdentificationSettings
    table: pd.DataFrame  # a row per figure, see `beside_published`

    def __repr__(self) -> str:
        return f"PaperTable({self.trial.name}, {self.segment}; {len(self.table)} figures)"

    def to_dataframe(self) -> pd.DataFrame:
        """A row per figure, see `beside_published`."""
        return self.table.copy()

    def document(self) -> dict[str, Any]:
        """The figures for JSON, with the settings used."""
        table = self._saved_table()
        return {
            **origin(self.trial, self.segment),
            "samples": self.samples,
            "settings": self.settings.to_flat(),
            "figures": dict(zip(table.index, records(table), strict=True)),
        }

    def _saved_table(self) -> pd.DataFrame:
        titles = [f"paper: {title}" if group == THEIRS else title for group, title in self.table]
        return self.table.set_axis(titles, axis=1)


def paper(
    trial: Trial | PathLike,
    segment: str | Segment = "plateau",
    *,
    thetas: int = 101,
    weights: Weights = "raw",
    frames: int = PUBLISHED_FRAMES,
    params: PathLike | None = None,
    progress: Progress | None = None,
    **choices: Any,
) -> PaperTable:
    """Run the paper's pipeline: both stages, without and with offsets, and the front over theta.

    Other settings are those of `fit`, whose defaults follow the paper where known: docs/paper.md.

    Args:
        trial: The trial.
        segment: As `specification` in `st.select_segment`, or a `Segment`.
        thetas: Number of values of theta from 0 to 1.
        weights: As in `fit`.
        frames: As in `fit`.
        params: As in `fit`.
        progress: See `Progress`.
        choices: Other settings as in `fit`, except `variant`.

    Returns:
        The figures, a row each, see `beside_published`.

    >>> found = st.paper(st.open_trial("trials/hold"), thetas=5)
    >>> found.to_dataframe().loc["RMSE of Mx [N m]", "the paper"].tolist()
    [3.99, 0.95]
    """
    trial = as_trial(trial)
    chosen = {"weights": weights, "frames": frames, "params": params, **choices}
    theta_values(thetas)  # fails before long work
    fits = {variant: fit(trial, segment, variant=variant, **chosen) for variant in PAPER_VARIANTS}
    fronts = pareto(trial, segment, thetas=thetas, progress=progress, **chosen).fronts
    errors = {variant: found.fit.errors for variant, found in fits.items()}
    last = fits[PAPER_VARIANTS[-1]]
    settings = last.fit.settings
    rows = trial.sound(settings.leave_out)[last.segment.rows]
    table = beside_published(errors, fronts, rows, settings)
    return PaperTable(trial, last.segment, last.fit.samples, settings, table)
