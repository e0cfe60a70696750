"""The samples of a trial as a table, with what the clusters' forces were computed from."""

from __future__ import annotations

from typing import Any

import pandas as pd

from socket_testbed.calibration.bench_data import STRESSES
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.evaluation import predict_channels
from socket_testbed.samples import LOCAL_CHANNELS, Samples, channel_unit
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.synchronise import Measurements
from socket_testbed.trials.trial import Trial

_SHARED = 1 + 6 + 3  # columns besides the clusters': time, wrench, limb position


def sample_table(
    trial: Trial,
    measured: Measurements,
    samples: Samples,
    segment: Segment,
    model: ContactModel | None = None,
) -> pd.DataFrame:
    """The samples of a trial as a table, with what the clusters' forces were computed from.

    Args:
        trial: The trial.
        measured: All that was measured.
        samples: All samples made of it.
        segment: Which of them are wanted.
        model: A model whose predictions are added as `predicted.*`.

    Returns:
        A row per sample, with the units in the titles: stamp [ns], time since the trial's first
        sample [s], wrench and limb position in {S}; for each cluster its capacitances by the
        converter's input [pF], its status (0 ok, 1 saturated, 2 missing, 3 out of the calibrated
        range), and its stress [Pa] and force [N] in its own frame. NaN where there is none.

    Raises:
        ConfigurationError: If the model lacks a cluster of the samples.
    """
    table = samples.to_dataframe().iloc[segment.rows].reset_index()
    stamps = samples.stamps[segment.rows]
    capacitance, status = measured.capacitance[segment.rows], measured.status[segment.rows]
    columns: dict[str, Any] = {"stamp [ns]": stamps, **table.iloc[:, :_SHARED]}
    for number, name in enumerate(samples.clusters):
        readings = capacitance[:, number]
        stress, _ = trial.calibration.clusters[name].apply(readings, status[:, number])
        columns |= {f"{name}.C{i} [pF]": readings[:, i] for i in range(4)}
        columns[f"{name}.status [-]"] = table[f"{name}.status [-]"]
        columns |= {f"{name}.{axis} [Pa]": stress[:, i] for i, axis in enumerate(STRESSES)}
        columns |= {title: table[title] for title in (f"{name}.{f} [N]" for f in LOCAL_CHANNELS)}
    if model is not None:
        position = samples.position[segment.rows]
        predicted = predict_channels(model, position, samples.clusters)
        for channel, values in zip(samples.channels, predicted.T, strict=True):
            columns[f"predicted.{channel} [{channel_unit(channel)}]"] = values
    return pd.DataFrame(columns)
