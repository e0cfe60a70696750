"""The samples of a trial as a table, with what the clusters' forces were computed from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from socket_testbed import tables
from socket_testbed.calibration.bench_data import STRESSES
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.evaluation import predict_channels
from socket_testbed.samples import LOCAL_CHANNELS, Samples, channel_unit
from socket_testbed.tables import check_format, split_unit
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.synchronise import Measurements
from socket_testbed.trials.trial import Trial

_SHARED = 1 + 6 + 3  # columns besides the clusters': time, wrench, limb position

__all__ = ["Column", "check_format", "sample_columns", "sample_table", "write_table"]


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


@dataclass(frozen=True)
class Column:
    """A column of a table, for callers that have no data frame yet."""

    name: str
    unit: str
    values: Any

    @property
    def title(self) -> str:
        """The name with the unit, such as `distal.Fz [N]`."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def sample_columns(*arguments: Any) -> list[Column]:
    """The columns of `sample_table`."""
    return [
        Column(*split_unit(title), column) for title, column in sample_table(*arguments).items()
    ]


def write_table(columns: Sequence[Column], path: Path) -> None:
    """Write columns: see `tables.write_table`."""
    frame = pd.DataFrame({c.title: pd.Series(c.values, dtype=_kind(c.values)) for c in columns})
    tables.write_table(frame, path)


def _kind(values: Any) -> Any:
    return object if isinstance(values, list) else None
