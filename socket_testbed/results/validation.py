"""Estimates judged on held-out data, beside simple rivals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pandas as pd

from socket_testbed.figures.style import FigureStyle
from socket_testbed.figures.validation import validation_figure
from socket_testbed.identification import validation
from socket_testbed.identification.model_file import record
from socket_testbed.results.result import Result
from socket_testbed.trials.metadata import TrialMetadata

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class Validation(Result):
    """Estimates judged on held-out data; `save` writes the table of `by_trial`.

    Attributes:
        trials: Names of the trials that were read.
        fitted: Names of those that models were fitted on, at most 12.
        judgements: The errors of each predictor on each question, test and trial, by cluster where
            clusters are left out.
        metadata: Stated metadata of each of `trials`, in their order.
        priors: With a survey as a prior, what the force map of each trial used, in words.
    """

    trials: tuple[str, ...]
    fitted: tuple[str, ...]
    judgements: tuple[validation.Judgement, ...]
    metadata: tuple[TrialMetadata, ...]
    priors: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return (
            f"Validation({len(self.trials)} trial{'s'[: len(self.trials) > 1]}, models fitted on"
            f" {len(self.fitted)}; {len(self.judgements)} judgements)"
        )

    def to_dataframe(self) -> pd.DataFrame:
        """A row per judgement; no named index.

        Columns:

        - `question`: `cluster` (force on a left-out cluster), `wrench` (from the pose alone) or
          `tiles` (forces on tiles without a sensor, known from a simulation);
        - `predictor`: a model variant, `force map`, or a simple rival;
        - `test`: relation of the samples to those of the fit: `left out`, `in-sample`,
          `second half` or `other trial`;
        - `fitted on`, `tested on`: names of the trials; the former is empty without a fit;
        - `cluster`: the left-out one; empty for all of them together, and for other questions;
        - `samples [1]`: number of samples;
        - `error [-]`: of `cluster` and `tiles`, RMSE of the forces over their RMS, 1 if zero is
          predicted;
        - `moment RMSE [N m]`, `force RMSE [N]`, `moment skill [-]`, `force skill [-]`: of `wrench`,
          means over the axes, and their skill against the best constant;
        - `within 50 % [-]`, `within 80 % [-]`, `within 95 % [-]`: share of the true values inside
          these intervals of the prediction.

        Figures that a question or a predictor does not have are NaN.
        """
        return validation.judgements_table(self.judgements)

    def summary(self) -> pd.DataFrame:
        """Means over the trials, indexed by `question`, `test` and `predictor`.

        The columns are the numeric ones of `to_dataframe`, with their means over all judgements
        that take the clusters together; `judged [1]`, the number of these; `worst error [-]`; and
        `median moment skill [-]` and `median force skill [-]`, which a single bad trial does not
        affect. NaN as in `to_dataframe`.
        """
        return validation.summarise_judgements(self.judgements)

    def by_trial(self) -> pd.DataFrame:
        """A row per trial with its metadata and judgements, indexed by `trial`, its name.

        Columns: the metadata `subject`, `side`, `socket`, `liner`, `mass [kg]`, `operator`,
        `protocol` and `trial_notes`, None where not stated; then the figures of `to_dataframe` by
        question, test and predictor, such as `wrench, second half: rigid_bias force skill [-]`.
        Figures of the test `other trial` are medians over the models of other trials.

        NaN for a figure that a trial does not have, all of them if it could not be judged.
        """
        stated = [metadata.columns() for metadata in self.metadata]
        table = pd.DataFrame(stated, index=pd.Index(self.trials, name="trial"), dtype=object)
        return table.join(validation.judgements_by_trial(self.judgements))

    def _saved_table(self) -> pd.DataFrame:
        return self.by_trial()

    def _figure(self, style: FigureStyle) -> Figure:
        """Errors by cluster and coverage of the intervals."""
        several = len(self.trials) > 1
        name = f"{len(self.trials)} trials, means" if several else self.trials[0]
        return validation_figure(self.judgements, f"{name}: validation", style)

    def document(self) -> dict[str, Any]:
        """The validation for JSON.

        Returns:
            The names `trials` and `fitted`; `levels`, the probabilities of the tested intervals
            [-]; `judgements`, with the share of the values within each level as `coverage`; and
            `priors` in words, empty without a survey.
        """
        return {
            "trials": list(self.trials),
            "fitted": list(self.fitted),
            "levels": list(validation.LEVELS),
            "judgements": [record(judgement) for judgement in self.judgements],
            "priors": list(self.priors),
        }
