"""The trade-off over theta, and the paper's figures beside those of a trial."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import pandas as pd
from threadpoolctl import threadpool_limits

from socket_testbed.arrays import FloatArray
from socket_testbed.figures.fronts import pareto_figure
from socket_testbed.figures.style import FigureStyle
from socket_testbed.identification.fit import FittedModel
from socket_testbed.identification.paper import THEIRS, beside_published
from socket_testbed.identification.pareto import (
    Front,
    front_document,
    front_table,
    pareto_front,
)
from socket_testbed.results.models import fit_segment
from socket_testbed.results.result import Result, origin, records
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import (
    PAPER_VARIANTS,
    IdentificationSettings,
    Variant,
)
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class Tradeoff(Result):
    """The trade-off between the wrench and the clusters on a segment of a trial.

    Attributes:
        trial: The trial.
        segment: The part that was fitted; with `frames` only its first samples. Its `start` and
            `end` [s] count from the first sample of the trial, `rows` is a slice of its samples.
        fronts: The solutions along theta of the paper's variants, `stiffness` and
            `stiffness_bias`. Each has `theta`, the weight of the wrench against the clusters
            (0: clusters only, 1: wrench only), and the normalised errors of both, shape (T,) [-],
            1 if zero is predicted; and `knee`.
    """

    trial: Trial
    segment: Segment
    fronts: dict[Variant, Front]

    def __repr__(self) -> str:
        fronts = "; ".join(map(repr, self.fronts.values()))
        return f"Tradeoff({self.trial.name}, {self.segment}; {fronts})"

    def to_dataframe(self) -> pd.DataFrame:
        """A row per solution, the thetas of one variant after those of the other; no named index.

        Columns:

        - `variant`, `theta [-]`: contact law, and weight of the wrench against the clusters;
        - `wrench error [-]`, `local error [-]`: errors of both groups on the objective's scale, 1
          if zero is predicted with weights by size;
        - `non-dominated`: 1 on the front, 0 off it;
        - `mark`: `sensor-only`, `knee` or `wrench-only` for the notable solutions, or empty;
        - `mean moment RMSE [N m]`, `mean force RMSE [N]`, `median local RMSE [N]`: the paper's
          figures over the channels in the objective;
        - `KKT residual or gap [-]`: largest of both stages, scaled;
        - `flaw`: why the solution must not be used, or empty;
        - `RMSE Mx [N m]`, `RMSE distal.Fz [N]`, ...: of each channel in the objective.

        Errors are NaN where a stage has no certified solution.
        """
        return front_table(self.fronts.values())

    def document(self) -> dict[str, Any]:
        """The fronts for JSON.

        Returns:
            `trial`, `segment` (`kind`, `start` and `end` [s]), and `fronts`, each with its
            `variant`, `knee`, `marks` and `solutions`.
        """
        fronts = [front_document(front) for front in self.fronts.values()]
        return origin(self.trial, self.segment) | {"fronts": fronts}

    def _figure(self, style: FigureStyle) -> Figure:
        heading = f"{self.trial.name}, {self.segment}: trade-off between wrench and clusters"
        return pareto_figure([*self.fronts.values()], heading, style)


@dataclass(frozen=True, repr=False)
class PaperTable(Result):
    """The paper's figures recomputed for a trial, next to the published ones.

    Attributes:
        trial: The trial.
        segment: The part that was fitted: the first `frames` samples of the chosen one. Its `start`
            and `end` [s] count from the first sample of the trial, `rows` is a slice of its
            samples.
        samples: Number of samples in the objective: those with a limb pose and every wrench channel
            that is not left out, outliers not counted.
        settings: The settings of the fit with offsets; the other fit differs in the variant.
        table: The figures, see `to_dataframe`.
    """

    trial: Trial
    segment: Segment
    samples: int
    settings: IdentificationSettings
    table: pd.DataFrame

    def __repr__(self) -> str:
        return f"PaperTable({self.trial.name}, {self.segment}; {len(self.table)} figures)"

    def to_dataframe(self) -> pd.DataFrame:
        """A row per figure, indexed by `figure`: its name and unit, such as `RMSE of Mx [N m]`.

        The figures are the paper's mean and median RMSE, the RMSE of every channel, the standard
        deviation `sigma` of the residual of every wrench channel, and the thetas of the marks of
        the fronts, such as `theta, knee [-]`; then the conditions and settings that the paper
        prints, such as `load [N]`.

        Columns, in two levels: `this trial` and `the paper`, each `without offsets` and
        `with offsets` (the variants `stiffness` and `stiffness_bias`), in the unit of the row; and
        a `remark` (below an empty first level): why the two are not comparable, or that the paper
        does not print the number. NaN for a number that is not known. `save` writes one level, with
        titles such as `with offsets` and `paper: with offsets`.
        """
        return self.table.copy()

    def document(self) -> dict[str, Any]:
        """The figures for JSON, with the settings used.

        Returns:
            `trial`, `segment` (`kind`, `start` and `end` [s]), the number of `samples`, `settings`,
            and `figures` by name and unit, with columns as `save` writes them.
        """
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


def trace_fronts(
    trial: Trial,
    segment: Segment,
    samples: Samples,
    settings: IdentificationSettings,
    thetas: FloatArray,
    progress: Callable[[int, int], None],
) -> Tradeoff:
    """Identify the contact model along theta, for the paper's variants, and find the knees.

    Args:
        trial: The trial.
        segment: The part to fit.
        samples: Its samples, outliers as NaN: see `models.part_to_fit`.
        settings: Settings of the fits, except the variant and theta.
        thetas: Ascending thetas, 0 to 1, shape (T,) [-].
        progress: Called with the number of fits done and their total.

    Raises:
        IdentificationError: As `pareto_front`.
    """
    with threadpool_limits(1):
        fronts = pareto_front(samples, trial.geometry, settings, thetas, progress)
    return Tradeoff(trial, segment, fronts)


def fit_paper(
    trial: Trial,
    segment: Segment,
    samples: Samples,
    settings: IdentificationSettings,
    thetas: FloatArray,
    progress: Callable[[int, int], None],
) -> PaperTable:
    """Fit the paper's variants and trace their fronts, and set the figures next to the published.

    Args:
        trial: The trial.
        segment: The part to fit.
        samples: Its samples, outliers as NaN: see `models.part_to_fit`.
        settings: Settings of the fits, except the variant.
        thetas: Ascending thetas of the fronts, 0 to 1, shape (T,) [-].
        progress: Called with the number of fits of the fronts done and their total.

    Raises:
        IdentificationError: As `fit_segment` and `pareto_front`.
    """
    fits: dict[str, FittedModel] = {
        variant: fit_segment(trial, segment, samples, replace(settings, variant=variant)).fit
        for variant in PAPER_VARIANTS
    }
    fronts = trace_fronts(trial, segment, samples, settings, thetas, progress).fronts
    return paper_table(trial, segment, samples, fits, fronts)


def paper_table(
    trial: Trial,
    segment: Segment,
    samples: Samples,
    fits: Mapping[str, FittedModel],
    fronts: Mapping[Variant, Front],
) -> PaperTable:
    """The paper's figures of models that are already fitted, next to the published ones.

    Args:
        trial: The trial.
        segment: The part that was fitted.
        samples: Its samples, outliers as NaN.
        fits: The models of the paper's variants, fitted on these samples, by variant.
        fronts: The fronts of these variants; empty for no figures of the marks.
    """
    errors = {variant: fits[variant].errors for variant in PAPER_VARIANTS}
    last = fits[PAPER_VARIANTS[-1]]
    table = beside_published(errors, fronts, samples, last.settings, trial.geometry)
    return PaperTable(trial, segment, last.samples, last.settings, table)
