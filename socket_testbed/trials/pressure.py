"""A trial's force map, and the pressure outputs over its segments and at its instants."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.axis import Region, all_regions
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import ForceMap, map_trial
from socket_testbed.identification.information import Suspension, find_suspension
from socket_testbed.identification.pressure import THRESHOLD, PressureOutputs, pressure_outputs
from socket_testbed.samples import Samples
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial


@dataclass(frozen=True)
class MappedTrial:
    """The force map of a trial."""

    geometry: SocketGeometry
    places: tuple[Region, ...]  # the last one is the socket
    force_map: ForceMap
    samples: Samples  # of the trial, with the channels that count

    def outputs(self, rows: Any, threshold: float = THRESHOLD) -> PressureOutputs:
        """Outputs over some rows of the samples; in contact above a threshold [Pa]."""
        samples, places = self.samples[rows], self.places
        return pressure_outputs(self.force_map, samples, self.geometry, places, threshold)

    def course(self, rows: Any) -> PressureOutputs:
        """The same of the whole socket alone: a series of its regions takes five times as long."""
        samples, places = self.samples[rows], self.places[-1:]
        return pressure_outputs(self.force_map, samples, self.geometry, places, THRESHOLD)


def mapped_trial(
    trial: Trial, settings: EstimatorSettings, geometry: SocketGeometry | None = None
) -> MappedTrial:
    """The force map of a trial, on its socket unless one with other regions is given."""
    geometry = geometry or trial.geometry
    places = all_regions(geometry, trial.metadata.side)
    left_out = settings.identification.leave_out
    found = map_trial(trial.samples(), geometry, settings.force_map, left_out)
    return MappedTrial(geometry, places, *found)


@dataclass(frozen=True, repr=False)
class SegmentPressure:
    """Pressure outputs over a segment of a trial, by region and tile, with 95 % intervals."""

    trial: Trial
    segment: Segment
    places: tuple[Region, ...]  # the last one is the socket
    outputs: PressureOutputs

    @property
    def time(self) -> FloatArray:
        """Times of the N samples since the first sample of the trial, shape (N,) [s]."""
        return np.asarray(self.trial.samples().time[self.segment.rows])

    @property
    def peak_time(self) -> float:
        """When a tile has the highest pressure, since the first sample of the trial [s]."""
        return float(self.time[self.outputs.peak_row])

    @cached_property
    def suspension(self) -> Suspension | None:
        """How the limb sits in the socket; None without poses and a wrench."""
        return find_suspension(self.trial.samples()[self.segment.rows], self.trial.geometry)


def by_place(names: Iterable[str], found: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Columns of R places, from arrays (N, R) by their titles: `anterior.mean pressure [kPa]`."""
    return {
        f"{name}.{title}": values[:, column]
        for column, name in enumerate(names)
        for title, values in found.items()
    }
