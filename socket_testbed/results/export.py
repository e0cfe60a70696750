"""The table that `st.export` writes: the samples of a trial with what was computed of them."""

from __future__ import annotations

import dataclasses

import pandas as pd

from socket_testbed.identification import information
from socket_testbed.identification.fit import FittedModel
from socket_testbed.results.models import predictions
from socket_testbed.results.pressure import TrialMap, TrialPressure
from socket_testbed.samples import moments_about
from socket_testbed.trials.export import sample_table
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial


def export_table(
    trial: Trial,
    segment: Segment,
    model: FittedModel | None,
    mapped: TrialMap | None,
    pressures: TrialPressure | None,
    about: tuple[float, float, float] | None,
) -> pd.DataFrame:
    """The synchronised samples of a segment, a row each, with computed columns beside them.

    Args:
        trial: The trial.
        segment: The part of it that becomes the table.
        model: A model whose predictions become `predicted.*` and engaged springs `springs.*`; None
            for none.
        mapped: The force map of the segment, which becomes `map.*`; None for none.
        pressures: The pressure outputs of the segment, which become `pressure.*`; None for none.
        about: Reference point of the moments in {S} [m]; None for the load cell's origin.

    Returns:
        Columns as in `st.export`.
    """
    measured, samples = trial.measurements_and_samples()
    predicted = None
    added: list[pd.DataFrame] = []
    if model is not None:
        predicted = predictions(trial, model)
        predicted[:, :6] = moments_about(predicted[:, :6], about)
        engaged = information.engagement(
            trial.checked(model.settings.leave_out).samples,
            model.model,
            model.settings.pose_smoothing,
        )
        added.append(pd.DataFrame(engaged.columns("springs."))[segment.rows])
    if mapped is not None:
        added.append(pd.DataFrame(mapped.estimate.columns(trial.geometry.names, "map.")))
    if pressures is not None:
        added.append(pressures.over_time().add_prefix("pressure."))
    moved = dataclasses.replace(samples, wrench=moments_about(samples.wrench, about))
    table = sample_table(measured, moved, trial.calibration, segment, predicted)
    return pd.concat([table, *(each.set_axis(table.index) for each in added)], axis=1)


def sources(mapped: TrialMap | None, pressures: TrialPressure | None) -> tuple[str, ...]:
    """The prior and channels of a force map and of pressure outputs, in words, without repetition.

    Args:
        mapped: The force map; None for none.
        pressures: The pressure outputs; None for none.
    """
    found = [] if mapped is None else [mapped.estimate.source]
    found += [] if pressures is None else [pressures.outputs.source]
    return tuple(dict.fromkeys(found))
