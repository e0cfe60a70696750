"""Synchronised samples as a table for other programs."""

from __future__ import annotations

from collections.abc import Iterator

from socket_testbed.arrays import FloatArray, StatusArray
from socket_testbed.contact import ContactModel
from socket_testbed.evaluation import channel_unit, predict_channels
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples
from socket_testbed.trials.measurements import Measurements
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.table_file import Column
from socket_testbed.trials.trial import Trial

_STRESSES = ("normal", "shear_x", "shear_y")


def sample_columns(
    trial: Trial,
    measured: Measurements,
    samples: Samples,
    segment: Segment,
    model: ContactModel | None = None,
) -> list[Column]:
    """The samples of a trial as columns, with what the clusters' forces were computed from.

    Args:
        trial: The trial.
        measured: All that was measured.
        samples: All samples made of it.
        segment: Which of them are wanted.
        model: A model whose predictions are added as `predicted.*`.

    Returns:
        Stamp [ns], time since the trial's first sample [s], wrench and limb position in {S};
        for each cluster its capacitances by the converter's input [pF], its status (0 ok,
        1 saturated, 2 missing, 3 out of the calibrated range), and its stress [Pa] and force [N]
        in its own frame. NaN where there is none.

    Raises:
        ConfigurationError: If the model lacks a cluster of the samples.
    """
    time = samples.time[segment.rows]
    samples = samples[segment.rows]
    columns = [Column("stamp", "ns", samples.stamps), Column("time", "s", time)]
    columns += _channels("", WRENCH_CHANNELS, samples.wrench)
    columns += [Column(f"q_{axis}", "m", samples.position[:, i]) for i, axis in enumerate("xyz")]
    capacitance, status = measured.capacitance[segment.rows], measured.status[segment.rows]
    for number in range(len(samples.clusters)):
        columns += _cluster_columns(
            trial, samples, number, capacitance[:, number], status[:, number]
        )
    if model is not None:
        columns += _prediction_columns(samples, model)
    return columns


def _channels(prefix: str, names: tuple[str, ...], values: FloatArray) -> list[Column]:
    return [
        Column(f"{prefix}{name}", channel_unit(name), values[:, i]) for i, name in enumerate(names)
    ]


def _cluster_columns(
    trial: Trial,
    samples: Samples,
    number: int,
    capacitance: FloatArray,
    status: StatusArray,
) -> Iterator[Column]:
    name = samples.clusters[number]
    stress, _ = trial.calibration.clusters[name].apply(capacitance, status)
    for channel in range(4):
        yield Column(f"{name}.C{channel}", "pF", capacitance[:, channel])
    yield Column(f"{name}.status", "-", samples.status[:, number])
    for i, component in enumerate(_STRESSES):
        yield Column(f"{name}.{component}", "Pa", stress[:, i])
    yield from _channels(f"{name}.", LOCAL_CHANNELS, samples.local_forces[:, number])


def _prediction_columns(samples: Samples, model: ContactModel) -> list[Column]:
    values = predict_channels(model, samples.position, samples.clusters)
    return _channels("predicted.", samples.channels, values)
