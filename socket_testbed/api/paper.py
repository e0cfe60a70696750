"""The paper's pipeline on a trial, and its figures beside the printed ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from socket_testbed.api.models import check_thetas, fit, pareto
from socket_testbed.api.result import Result, records
from socket_testbed.api.trials import PathLike, Progress
from socket_testbed.identification.published import PUBLISHED_FRAMES, THEIRS, beside_published
from socket_testbed.settings.identification import PAPER_VARIANTS, IdentificationSettings
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, repr=False)
class PaperTable(Result):
    """The figures of the paper for a trial, beside the printed ones."""

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
        """The figures for JSON, with the settings that they were found with."""
        table = self._saved_table()
        return {
            "trial": self.trial.name,
            "segment": str(self.segment),
            "samples": self.samples,
            "settings": self.settings.to_flat(),
            "figures": dict(zip(table.index, records(table), strict=True)),
        }

    def _saved_table(self) -> pd.DataFrame:
        titles = [f"paper: {title}" if of == THEIRS else title for of, title in self.table]
        return self.table.set_axis(titles, axis=1)


def paper(
    trial: Trial,
    segment: str | Segment = "plateau",
    *,
    thetas: int = 101,
    params: PathLike | None = None,
    progress: Progress | None = None,
    **choices: Any,
) -> PaperTable:
    """Run the paper's pipeline: both stages, without and with offsets, and the front over theta.

    Unless they are given, the first 1000 samples of the segment and raw weights are taken; other
    settings are those of `fit`, whose defaults are the paper's where known. See docs/paper.md.

    Args:
        trial: The trial.
        segment: The segment, or its specification.
        thetas: Number of values of theta from 0 to 1.
        params: As in `fit`.
        progress: See `Progress`.
        choices: Settings as in `fit`, but for `variant`.

    Returns:
        The figures; their table has a row each, see `beside_published`.

    Raises:
        TestbedError: As `fit` and `pareto`.

    >>> found = st.paper(st.open_trial("trials/hold"), thetas=5)
    >>> found.to_dataframe().loc["RMSE of Mx [N m]", "the paper"].tolist()
    [3.99, 0.95]
    """
    given = {name: value for name, value in choices.items() if value is not None}
    chosen = {"weights": "raw", "frames": PUBLISHED_FRAMES, **given}
    check_thetas(thetas)
    fits = {v: fit(trial, segment, params=params, variant=v, **chosen) for v in PAPER_VARIANTS}
    fronts = pareto(
        trial, segment, thetas=thetas, params=params, progress=progress, **chosen
    ).fronts
    errors = {variant: found.fit.errors for variant, found in fits.items()}
    last = fits[PAPER_VARIANTS[-1]]
    rows, settings = trial.samples()[last.segment.rows], last.fit.settings
    table = beside_published(errors, fronts, rows, settings)
    return PaperTable(trial, last.segment, last.fit.samples, settings, table)
