"""The quality of a trial's data in numbers: its load, drop-outs and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.identification.checked import CheckedSamples
from socket_testbed.samples import Status, force_magnitude
from socket_testbed.tables import Table
from socket_testbed.trials.description import (
    describe_samples,
    drop_outs,
    loads_table,
    noise_table,
    states_by_channel,
)
from socket_testbed.trials.segment import Segment


@dataclass(frozen=True, eq=False)
class DataQuality:
    """The N samples of a trial in numbers.

    Attributes:
        words: Their number, rate and gaps.
        load: Magnitudes of the measured force [N] and moment [N m], by title with the unit, shape
            (N,); outliers are NaN.
        lacking: Where a measurement is not usable, by its name, shape (N,).
        drop_outs: Measurements without a value, see `description.drop_outs`.
        loads: Loads of the segment in the first row, then of the plateaus, see
            `description.loads_table`.
        noise: Noise of the channels, see `description.noise_table`.
    """

    words: str
    load: dict[str, FloatArray]
    lacking: dict[str, BoolArray]
    drop_outs: Table
    loads: Table
    noise: Table


def data_quality(
    checked: CheckedSamples, segment: Segment, plateaus: Sequence[Segment]
) -> DataQuality:
    """The quality of the data of a trial.

    Args:
        checked: The samples of the trial.
        segment: The part in use.
        plateaus: The plateaus of the trial.
    """
    measured, samples = checked.measured, checked.samples
    states = states_by_channel(measured)
    return DataQuality(
        words=describe_samples(measured),
        load={
            "force magnitude [N]": force_magnitude(samples.wrench),
            "moment magnitude [N m]": np.linalg.norm(samples.wrench[:, :3], axis=1),
        },
        lacking={name: state != Status.OK for name, state in states.items()},
        drop_outs=drop_outs(measured, segment.rows),
        loads=loads_table(samples, (segment, *plateaus)),
        noise=noise_table(samples.clusters, checked.noise),
    )
