"""Force map of a trial, and its pressure outputs: over segments, at single samples, as text."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import Any

import numpy as np
import pandas as pd

from socket_testbed.arrays import FloatArray, evenly
from socket_testbed.geometry.regions import Region, all_regions
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification import pressure
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.identification.suspension import Suspension, find_suspension
from socket_testbed.samples import Samples
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.tables import NOTHING, UNCERTAIN
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial

_BLOCK = 4096  # samples
INLINE = "{} ({})"  # a value and its interval
CENTRE_TITLES = [title for title in pressure.TITLES if title.startswith("centre of pressure")]


@dataclass(frozen=True)
class MappedTrial:
    """The force map of a trial.

    Attributes:
        trial: The trial.
        geometry: The socket with the n tiles of the map, the trial's own or one with other regions.
        places: The R regions that outputs are for; the last one is the whole socket.
        force_map: Maps samples to forces on all tiles.
        samples: The N samples of the trial; outliers and left-out channels are NaN.
    """

    trial: Trial
    geometry: SocketGeometry
    places: tuple[Region, ...]
    force_map: ForceMap
    samples: Samples

    def outputs(self, rows: Any, threshold: float = pressure.THRESHOLD) -> pressure.PressureOutputs:
        """Outputs over some of the samples.

        Args:
            rows: Rows of `samples`: a slice, indices, or a mask.
            threshold: Normal pressure above which a tile is in contact [Pa].

        Raises:
            TrialError: If none of these samples has a wrench or a trusted cluster.
        """
        samples, places = self.samples[rows], self.places
        return pressure.pressure_outputs(self.force_map, samples, self.geometry, places, threshold)

    def over(self, segment: Segment, threshold: float = pressure.THRESHOLD) -> SegmentPressure:
        """Outputs over a segment of the trial.

        Args:
            segment: The segment.
            threshold: Normal pressure above which a tile is in contact [Pa].

        Raises:
            TrialError: If no sample of the segment has a wrench or a trusted cluster.
        """
        outputs = self.outputs(segment.rows, threshold)
        return SegmentPressure(self.trial, segment, self.places, outputs)

    def course(self, most: int, also: Sequence[int] = ()) -> pressure.PressureOutputs:
        """Outputs of the socket at evenly spread samples, at the highest pressure, and at others.

        Without its regions, they take a fifth of the time.

        Args:
            most: Largest number of evenly spread samples, from the first to the last.
            also: Rows of further samples.

        Returns:
            The outputs with the chosen samples in the order of time and one region, the socket.
        """
        count = len(self.samples)
        blocks = np.array_split(np.arange(count), count // _BLOCK + 1)  # to bound the memory
        pressures = (self.force_map.estimate(self.samples[rows]).normal_pressure for rows in blocks)
        highest = np.concatenate([found.max(axis=1) for found in pressures]).argmax()
        rows = np.union1d(evenly(count, most), [highest, *also])
        return replace(self, places=self.places[-1:]).outputs(rows)


def mapped_trial(
    trial: Trial, settings: EstimatorSettings, geometry: SocketGeometry | None = None
) -> MappedTrial:
    """The force map of a trial, on its own socket or on one with other regions.

    Args:
        trial: The trial, of which outliers are not used.
        settings: The force map's prior, and the channels to leave out.
        geometry: A socket with the same tiles and other regions; None for the trial's own.

    Raises:
        IdentificationError: If the samples are in another unit or frame.
    """
    geometry = geometry or trial.geometry
    left_out = settings.identification.leave_out
    checked = trial.checked(left_out)
    force_map, samples = checked.force_map(settings.force_map), checked.counted
    seen = np.asarray(np.isfinite(samples.trusted_forces[:, :, 2]).any(axis=0))
    clusters = {name: geometry.clusters[name] for name in compress(samples.clusters, seen)}
    places = all_regions(replace(geometry, clusters=clusters), trial.metadata.side)
    return MappedTrial(trial, geometry, places, force_map, samples)


@dataclass(frozen=True, repr=False)
class SegmentPressure:
    """Pressure outputs over a segment of a trial, by region and tile, with 95 % intervals.

    Attributes:
        trial: The trial.
        segment: The segment.
        places: The R regions of the outputs; the last one is the whole socket.
        outputs: The outputs in SI units, by region, by tile, and at every sample of the segment.
    """

    trial: Trial
    segment: Segment
    places: tuple[Region, ...]
    outputs: pressure.PressureOutputs

    @property
    def time(self) -> FloatArray:
        """Times of the N samples since the first sample of the trial, shape (N,) [s]."""
        return np.asarray(self.trial.samples().time[self.segment.rows])

    @property
    def peak_time(self) -> float:
        """Time of the highest pressure on any tile, since the first sample of the trial [s]."""
        return float(self.time[self.outputs.peak_row])

    @property
    def regions(self) -> pd.DataFrame:
        """Outputs over the segment, a row per region, then `socket`.

        Columns: each of `pressure.TITLES`, the best estimate under the posterior, with the ends of
        its 95 % interval, such as `peak pressure low [kPa]`; and the `nearest tile` to the centre
        of pressure.
        """
        names = pd.Index([place.name for place in self.places], name="region")
        table = pd.DataFrame(
            pressure.columns_of(self.outputs.regions, pressure.TITLES), index=names
        )
        geometry, nearest = self.trial.geometry, []
        for centre in self.outputs.regions.centre.value:
            apart = np.linalg.norm(geometry.anchors - centre, axis=1)
            nearest.append("" if np.isnan(apart).any() else geometry.names[apart.argmin()])
        table["nearest tile"] = nearest
        return table

    @property
    def contact(self) -> str:
        """What counts as contact and the time of the integrals, in words."""
        limit, time = 1e-3 * self.outputs.threshold, self.outputs.integrated
        return f"in contact: above {limit:g} kPa; the integrals cover {time:.1f} s"

    @cached_property
    def suspension(self) -> Suspension | None:
        """Motion and stiffness of the limb in the socket; None without poses and a wrench."""
        return find_suspension(self.outputs.samples, self.trial.geometry)


def by_place(names: Iterable[str], found: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Columns such as `anterior.mean pressure [kPa]` of a table with one row per sample.

    Args:
        names: Names of the R places.
        found: Arrays of shape (N, R) by title with unit, a row per sample, a column per place.

    Returns:
        Arrays of shape (N,) by title, place after place.
    """
    return {
        f"{name}.{title}": values[:, column]
        for column, name in enumerate(names)
        for title, values in found.items()
    }


def cells(
    names: Iterable[str],
    found: pressure.RegionOutputs,
    form: str = INLINE,
    share: float = pressure.SHARE,
) -> pd.DataFrame:
    """Formatted outputs: values with their 95 % intervals as text.

    Args:
        names: Names of the R places, which give the rows.
        found: Their outputs over a span, shape (R,), in SI units.
        form: Text with two fields, for the value and for its interval.
        share: An interval that reaches farther from its value than this share of it is marked
            uncertain [-]; of a coordinate it is a share of the region's extent, of a direction one
            of a right angle.

    Returns:
        A row per place, a column per title of `pressure.TITLES`, in the unit of the title.
    """
    columns = {
        title: _formatted(title, pressure.read_column(found, title), form, share)
        for title in pressure.TITLES
    }
    return pd.DataFrame(columns, index=[*names])


def limb_cells(found: Suspension, share: float = pressure.SHARE) -> dict[str, str]:
    """Formatted outputs of the limb in the socket, by title with unit.

    Args:
        found: Motion and stiffness of the limb in the socket.
        share: An interval that reaches farther from its value than this share of it is marked
            uncertain [-].
    """
    outputs = found.outputs().items()
    unknown = f"{NOTHING} (the load does not change in every direction)"
    return {
        title: unknown if np.isnan(value.value) else _formatted(title, value, INLINE, share)[0]
        for title, value in outputs
    }


def _formatted(title: str, quantity: pressure.Quantity, form: str, share: float) -> list[str]:
    """Values with their intervals; a dash for unknown ones."""
    columns = (quantity.value, quantity.low, quantity.high, quantity.certain(share))
    number = f"{{:z.{pressure.decimals_of(title)}f}}"
    return [
        form.format(
            number.format(value),
            f"{number} to {number}".format(low, high) + UNCERTAIN * (not certain),
        )
        if np.isfinite([low, high]).all()
        else NOTHING
        for value, low, high, certain in zip(*map(np.atleast_1d, columns), strict=True)
    ]
