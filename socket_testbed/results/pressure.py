"""Forces on all tiles of a trial, and its pressure by region and tile."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pandas as pd

from socket_testbed.arrays import FloatArray, IntArray, evenly, sample_at
from socket_testbed.documents import check_number, check_whole, finite_or_null, path_of
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.figures.pressure import force_map_figure, pressure_figure
from socket_testbed.figures.style import FigureStyle, Limits
from socket_testbed.figures.tiles import draw_wall, pressure_limits
from socket_testbed.geometry.regions import Region, all_regions
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import ForceMap, MapEstimate
from socket_testbed.identification.pressure import (
    SHARE,
    TILE_TITLES,
    TITLES,
    PressureOutputs,
    columns_of,
    highest_row,
    normal_quantity,
    pressure_outputs,
    read_column,
    with_interval,
)
from socket_testbed.identification.suspension import Suspension, find_suspension
from socket_testbed.results.result import PathLike, Result, origin, records
from socket_testbed.results.stresses import Stresses, mean_stresses, stresses_of
from socket_testbed.samples import Samples
from socket_testbed.settings.options import PressureOptions
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.tables import split_unit, stacked, write_table
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from socket_testbed.identification.survey_prior import SurveyPrior

Rows: TypeAlias = dict[tuple[str, str, str], dict[str, Any]]
"""Outputs, keyed by part (`regions`, `tiles`, `limb`), name of the place, and title with the unit.

Each is a dictionary with a `value`, the ends `low` and `high` of its 95 % interval, and whether it
is `uncertain`.
"""

_PASCALS = 1e3  # in a kilopascal, the unit of a threshold outside; the outputs hold SI units
_ROW_KEYS = ("value", "low", "high", "uncertain")
_STRESSES = ("pressure [kPa]", "shear [kPa]")  # of a tile over time
_SERIES_TITLES = tuple(title for title in TITLES if not title.startswith("pressure-time"))


@dataclass(frozen=True, repr=False)
class TrialMap(Result):
    """Forces on all n tiles at the N samples of a segment of a trial, with standard deviations.

    Attributes:
        trial: The trial; tile i is `trial.geometry.names[i]`.
        segment: The part of the trial. Its `start` and `end` [s] count from the first sample of the
            trial, `rows` is a slice of the trial's samples.
        time: Times of the samples since the first sample of the trial, shape (N,) [s].
        samples: The N samples that the map was conditioned on; outliers and left-out channels are
            NaN. Clusters are used only where their status is OK.
        force_map: The estimator, its prior weighed by the evidence of the whole trial; `estimate`
            takes any samples of its clusters.
        places: The R regions of pressure outputs, with their `name` and the indices of their
            `tiles`; the last one is `socket`, all tiles.
    """

    _SCALED = True

    trial: Trial
    segment: Segment
    time: FloatArray
    samples: Samples
    force_map: ForceMap
    places: tuple[Region, ...]

    @cached_property
    def estimate(self) -> MapEstimate:
        """The map at every sample.

        Its forces on the socket are in {S}, shape (N, n, 3) [N], its pressures (positive in
        compression) and shears have the shape (N, n) [Pa]. At a sample without any channel it is
        the prior: no force, with large standard deviations.
        """
        return self.force_map.estimate(self.samples)

    @cached_property
    def mean(self) -> MapEstimate:
        """The mean map over the segment, in the units and frames of `estimate`, with N = 1.

        Standard deviations are root mean squares over the samples: a mean over time is as uncertain
        as a typical sample, because the sensors leave the same directions open in each.
        """
        return self.force_map.mean(self.samples)

    def __repr__(self) -> str:
        highest = self.summary().iloc[0]
        return (
            f"TrialMap({self.trial.name}, {self.segment}; {len(self.time)} samples, highest mean"
            f" pressure {highest['pressure [kPa]']:.1f} +- {highest['pressure sd [kPa]']:.1f} kPa"
            f" on {highest.name})"
        )

    def to_dataframe(self) -> pd.DataFrame:
        """The map as a pandas table, a row per sample, indexed by `time [s]`.

        The index counts from the first sample of the trial. Columns of each tile, here `distal`:

        - `distal.Fx [N]`, `distal.Fx.sd [N]`, and those of Fy and Fz: force of the limb on the
          socket in {S}, with its standard deviation;
        - `distal.pressure [Pa]`, `distal.pressure.sd [Pa]`: normal pressure, positive in
          compression;
        - `distal.shear [Pa]`, `distal.shear.sd [Pa]`: magnitude of the shear, never negative.

        No value is NaN: a sample without any channel has the prior's force, zero, and its standard
        deviations.
        """
        columns = self.estimate.columns(self.trial.geometry.names)
        return pd.DataFrame(columns, index=pd.Index(self.time, name="time [s]"))

    def to_long(self) -> pd.DataFrame:
        """The map in long form, a row per value; no named index.

        Columns: `trial`, its name; `time [s]` since its first sample; `tile`; `quantity` and
        `unit`, such as `pressure` and `Pa`; the `value`, and its standard deviation `sd` in the
        same unit. Quantities and frames are those of `to_dataframe`.
        """
        table = self.to_dataframe()
        titles = [title for title in table if not split_unit(title)[0].endswith(".sd")]
        parts = [split_unit(title) for title in titles]
        places = [name.rpartition(".") for name, _ in parts]
        deviations = [f"{name}.sd [{unit}]" for name, unit in parts]
        columns = {
            "trial": [self.trial.name] * len(parts),
            "time [s]": self.time,
            "tile": [tile for tile, _, _ in places],
            "quantity": [name for _, _, name in places],
            "unit": [unit for _, unit in parts],
            "value": table[titles].to_numpy(),
            "sd": table[deviations].to_numpy(),
        }
        return stacked(columns, len(table))

    def summary(self) -> pd.DataFrame:
        """Means over the segment, a row per tile, indexed by `tile`, the highest pressure first.

        Columns: `cluster`, the one on the tile, or empty; `pressure [kPa]` (normal, positive in
        compression) and `shear [kPa]` (magnitude), with their standard deviations
        `pressure sd [kPa]` and `shear sd [kPa]`. No value is NaN.

        Standard deviations are those of the mean's error. They do not shrink with the number of
        samples, because the sensors leave the same uncertainty in each.
        """
        table = self.mean.by_tile(self.trial.geometry)
        return table.sort_values("pressure [kPa]", ascending=False, kind="stable")

    def at(self, time: float) -> TrialMap:
        """The map of the latest sample at a time since the first sample of the trial [s].

        Returns:
            A map with N = 1, whose segment is this instant.

        Raises:
            TrialError: The map has no sample there: the time is before its first sample, or more
                than three usual steps after the last one before it.
        """
        time = check_number(time, "the time")
        row = sample_at(self.time, time)
        if row is None:
            raise TrialError(
                f"the map has no sample at {time:g} s",
                f"give a time between {self.time[0]:.2f} s and {self.time[-1]:.2f} s",
            )
        when = float(self.time[row])
        first = self.segment.rows.start + row  # of the trial
        return self.part(Segment("instant", when, when, slice(first, first + 1)))

    def part(self, segment: Segment) -> TrialMap:
        """The map of a shorter segment.

        Args:
            segment: A segment of the same trial, inside the map's own.

        Raises:
            TrialError: The segment reaches beyond that of the map.
        """
        own, rows = self.segment.rows, segment.rows
        if rows.start < own.start or rows.stop > own.stop:
            raise TrialError(
                f"the segment {segment} reaches beyond that of the map, {self.segment}",
                "give a segment inside it, or map the whole trial",
            )
        chosen = slice(rows.start - own.start, rows.stop - own.start)
        time, samples = self.time[chosen], self.samples[chosen]
        return replace(self, segment=segment, time=time, samples=samples)

    def outputs(
        self, rows: slice | IntArray = slice(None), threshold: float = PressureOptions.threshold
    ) -> PressureOutputs:
        """Pressure outputs over some of the samples, as arrays in SI units.

        Args:
            rows: Rows of `samples`.
            threshold: Pressure above which a tile is in contact [kPa].

        Raises:
            TrialError: None of these samples has a wrench or a trusted cluster.
        """
        samples, geometry = self.samples[rows], self.trial.geometry
        limit = _PASCALS * threshold
        return pressure_outputs(self.force_map, samples, geometry, self.places, limit)

    def pressure(
        self, threshold: float = PressureOptions.threshold, share: float = SHARE
    ) -> TrialPressure:
        """Pressure outputs over the segment of the map, see `TrialPressure`.

        Args:
            threshold: Pressure above which a tile is in contact [kPa].
            share: A value is uncertain if its interval reaches farther than this share of it [-].

        Raises:
            TrialError: No sample has a wrench or a trusted cluster.
        """
        outputs = self.outputs(threshold=threshold)
        return TrialPressure(self.trial, self.segment, self.places, outputs, share)

    def course(self, most: int, also: Sequence[int] = ()) -> PressureOutputs:
        """Outputs of the socket at evenly spread samples, at the highest pressure, and at others.

        Without its regions, they take a fifth of the time.

        Args:
            most: Largest number of evenly spread samples, from the first to the last.
            also: Rows of further samples.

        Returns:
            The outputs with the chosen samples in the order of time and one region, the socket.
        """
        highest = highest_row(self.force_map, self.samples, self.trial.geometry)
        rows = np.union1d(evenly(len(self.samples), most), [highest, *also])
        return replace(self, places=self.places[-1:]).outputs(rows)

    def draws(self, count: int = 200) -> FloatArray:
        """Joint draws of the stresses on all tiles, for intervals of any function of them.

        Each draw is a map consistent with all measurements. All samples use the same seeded random
        numbers.

        Args:
            count: Number D of draws, even.

        Returns:
            Shape (N, D, n, 3) [Pa]; the last axis holds the shear along x (proximal) and along y of
            each tile's frame {L}, and the normal pressure, positive in compression. The second half
            of the draws has the errors of the first half with opposite signs. For many samples the
            array is large: see `at`.

        Raises:
            ConfigurationError: The count is odd or below 2.
        """
        geometry = self.trial.geometry
        count = check_whole(count, "count", 2)
        if count % 2:
            raise ConfigurationError(f"{count} draws: an odd number", "give an even number")
        found = np.empty((len(self.time), count, len(geometry), 3))
        for draws in self.force_map.sample(self.samples, count):
            values = draws.values().reshape(len(draws.rows), count, -1, 3)
            found[draws.rows] = values / geometry.areas[:, None] * [1.0, 1.0, -1.0]
        return found

    def document(self) -> dict[str, Any]:
        """The map for JSON.

        Returns:
            `trial`, `segment` (`kind`, `start` and `end` [s]), `tiles` with the rows of `summary`
            (means over the segment [kPa]), and `rows` with those of `to_dataframe` [s, N, Pa].
        """
        means = records(self.summary().reset_index())
        return origin(self.trial, self.segment) | {"tiles": means} | super().document()

    def _figure(self, style: FigureStyle) -> Figure:
        """Mean pressure on the tiles, and its standard deviation."""
        heading = f"{self.trial.name}, {self.segment}: force map"
        side = self.trial.metadata.side
        return force_map_figure(self.trial.geometry, self.mean, heading, style, side)

    def _draw_into(self, ax: Axes, limits: Limits) -> None:
        mean, side = self.mean, self.trial.metadata.side
        pressure, reach = 1e-3 * mean.normal_pressure[0], 1e-3 * mean.pressure_reach[0]
        ends = pressure_limits(pressure, limits)
        draw_wall(ax, self.trial.geometry, pressure, "pressure [kPa]", reach, side, ends)


@dataclass(frozen=True, repr=False)
class TrialPressure(Result):
    """Pressure outputs over a segment of a trial, by region and tile, with 95 % intervals.

    Pressure is positive in compression. The tables are `regions` (the one that is saved), `tiles`,
    `limb` and `over_time`.

    Attributes:
        trial: The trial; tile i is `trial.geometry.names[i]`.
        segment: The part of the trial. Its `start` and `end` [s] count from the first sample of the
            trial, `rows` is a slice of the trial's samples.
        places: The R regions, with their `name` and the indices of their `tiles`, in the order of
            the rows of `regions`; the last one is `socket`, all tiles.
        outputs: The outputs as arrays in SI units (Pa, m^2, Pa s, m, rad): over the segment by
            region, shape (R,), and by tile, shape (n,), and of the regions at its N samples, shape
            (N, R), each with the ends of its interval; and the samples and force map behind them.
        share: A value is uncertain if its interval reaches farther than this share of it [-].
    """

    _SCALED = True

    trial: Trial
    segment: Segment
    places: tuple[Region, ...]
    outputs: PressureOutputs
    share: float = SHARE

    def __repr__(self) -> str:
        socket = self.regions.iloc[-1]
        low, high = socket["peak pressure low [kPa]"], socket["peak pressure high [kPa]"]
        return (
            f"TrialPressure({self.trial.name}, {self.segment}; {len(self.places)} regions, peak"
            f" pressure {low:.1f} to {high:.1f} kPa)"
        )

    @property
    def time(self) -> FloatArray:
        """Times of the N samples since the first sample of the trial, shape (N,) [s]."""
        return np.asarray(self.trial.samples().time[self.segment.rows])

    @property
    def peak_time(self) -> float:
        """Time of the highest pressure on any tile, since the first sample of the trial [s]."""
        return float(self.time[self.outputs.peak_row])

    @property
    def threshold(self) -> float:
        """Pressure above which a tile is in contact [kPa]."""
        return round(self.outputs.threshold / _PASCALS, 9)  # as given, to its last digit

    @property
    def regions(self) -> pd.DataFrame:
        """Outputs over the segment, a row per region, then `socket`.

        Columns: each of `pressure.TITLES`, the best estimate under the posterior, with the ends of
        its 95 % interval, such as `peak pressure low [kPa]`; and the `nearest tile` to the centre
        of pressure.
        """
        names = pd.Index([place.name for place in self.places], name="region")
        table = pd.DataFrame(columns_of(self.outputs.regions, TITLES), index=names)
        geometry, nearest = self.trial.geometry, []
        for centre in self.outputs.regions.centre.value:
            apart = np.linalg.norm(geometry.anchors - centre, axis=1)
            nearest.append("" if np.isnan(apart).any() else geometry.names[apart.argmin()])
        table["nearest tile"] = nearest
        return table

    @property
    def contact(self) -> str:
        """What counts as contact and the time of the integrals, in words."""
        time = self.outputs.integrated
        return f"in contact: above {self.threshold:g} kPa; the integrals cover {time:.1f} s"

    @cached_property
    def mean(self) -> Stresses:
        """The mean stresses on the tiles over the segment, K = 1."""
        return mean_stresses(self.outputs, self.trial.geometry)

    @cached_property
    def peak(self) -> Stresses:
        """The stresses on the tiles at the highest pressure on any of them, K = 1."""
        found, row = self.outputs, self.outputs.peak_row
        samples, start = found.samples[row : row + 1], int(self.trial.samples().stamps[0])
        return stresses_of(found.peak_map, samples, self.trial.geometry, start)

    def complete(self) -> TrialPressure:
        """Compute now what is otherwise computed when it is first read; returns the same result.

        A report calls this before it draws.
        """
        kept = (self, "mean"), (self, "peak"), (self, "suspension"), (self.outputs, "mean_pressure")
        for owner, name in kept:
            getattr(owner, name)
        return self

    @cached_property
    def suspension(self) -> Suspension | None:
        """Motion and stiffness of the limb in the socket; None without poses and a wrench."""
        return find_suspension(self.outputs.samples, self.trial.geometry)

    @cached_property
    def map(self) -> TrialMap:
        """The force map behind the outputs, of the same segment: 6 kB a sample."""
        found = self.outputs
        samples, force_map = found.samples, found.force_map
        return TrialMap(self.trial, self.segment, self.time, samples, force_map, self.places)

    def rows(self) -> Rows:
        """Every output by part, place and title, such as `("tiles", "distal", "shear [kPa]")`.

        Returns:
            For each key a dictionary: the `value`, the ends `low` and `high` of its 95 % interval,
            all in the unit of the title, and the flag `uncertain`. The part is `regions`, `tiles`
            or `limb`, whose place is empty. Unknown values are NaN and uncertain; an unknown end of
            an interval of the limb is infinite.
        """
        regions = tuple(place.name for place in self.places)
        parts = (
            ("regions", regions, self.outputs.regions, TITLES),
            ("tiles", self.trial.geometry.names, self.outputs.tiles, TILE_TITLES),
        )
        quantities = [
            (part, names, title, read_column(found, title))
            for part, names, found, titles in parts
            for title in titles
        ]
        if self.suspension is not None:
            limb = self.suspension.outputs()
            quantities += [("limb", ("",), title, found) for title, found in limb.items()]
        rows: Rows = {}
        for part, names, title, found in quantities:
            columns = found.value, found.low, found.high, ~found.certain(self.share)
            values = zip(*(np.atleast_1d(column).tolist() for column in columns), strict=True)
            for name, row in zip(names, values, strict=True):
                rows[part, name, title] = dict(zip(_ROW_KEYS, row, strict=True))
        return rows

    def limb(self) -> pd.DataFrame:
        """How the limb is held by the socket: its pistoning, range of rotation and stiffness.

        The index holds each output with its unit:

        - `pistoning [mm]`: range of the limb's motion along the socket, from its 2.5 % to its
          97.5 % percentile over the samples;
        - `range of rotation about x [deg]`, and y and z of {S}: range between the same percentiles;
        - `stiffness Fx [N/mm]`, `stiffness Mx [N m/deg]`, and y and z of {S}: change of the load on
          the socket with the limb's displacement along, or rotation about, this axis through the
          mean of the tiles' centres; `suspension` holds the full 6 x 6 matrix.

        Columns, in the unit of the row: `value`, the ends `low` and `high` of its 95 % interval,
        and `uncertain`, a flag. The stiffnesses are NaN if the load did not change in every
        direction; an end is infinite if parts of the segment leave it open. The table is empty if
        fewer than 64 samples have a pose and a complete wrench.
        """
        found = {title: row for (part, _, title), row in self.rows().items() if part == "limb"}
        return pd.DataFrame.from_dict(found, orient="index", columns=[*_ROW_KEYS])

    @property
    def tiles(self) -> pd.DataFrame:
        """Outputs over the segment, a row per tile, indexed by `tile`, in the socket's order.

        Columns: `cluster`, the one on the tile, or empty; then, each with the ends of its 95 %
        interval, such as `peak pressure low [kPa]` and `peak pressure high [kPa]`:

        - `peak pressure [kPa]`, `mean pressure [kPa]`: highest of all samples, and mean over them;
        - `pressure-time integral [kPa s]`: of the pressure while the tile is in contact;
        - `share of load [%]`: of the axial force of all tiles;
        - `shear [kPa]`, `shear direction [deg]`: magnitude of the mean shear, and its direction in
          the tile's frame {L} from x (proximal) towards y; ends may lie beyond +-180.

        No value is NaN, except the integral over a single sample.
        """
        geometry = self.trial.geometry
        names = pd.Index(geometry.names, name="tile")
        table = pd.DataFrame(columns_of(self.outputs.tiles, TILE_TITLES), index=names)
        table.insert(0, "cluster", geometry.cluster_names)
        return table

    def to_dataframe(self) -> pd.DataFrame:
        """The table of `regions`: a row per region, then `socket`, indexed by `region`.

        Columns, each with the ends of its 95 % interval, such as `peak pressure low [kPa]` and
        `peak pressure high [kPa]`:

        - `peak pressure [kPa]`: highest on any tile of the region, of all samples;
        - `mean pressure [kPa]`: over the region's area and the samples;
        - `contact area [cm^2]`: of the tiles above the threshold, mean over the samples;
        - `pressure-time integral [kPa s]`: of the pressure on tiles in contact, mean over the area;
        - `share of load [%]`: of the axial force of all tiles;
        - `shear [kPa]`, `shear direction [deg]`: magnitude of the mean shear over area and samples,
          and its direction from x (proximal) towards y of the tiles' frames {L}; ends may lie
          beyond +-180;
        - `centre of pressure x [mm]`, and y and z: in {S}.

        The last column is `nearest tile`, the one nearest to the centre of pressure, or empty. The
        centre is NaN for a region without compression at any sample, the integral over a single
        sample.
        """
        return self.regions

    def over_time(self) -> pd.DataFrame:
        """Outputs of the regions and stresses on the tiles, a row per sample, by `time [s]`.

        The index counts from the first sample of the trial. Columns, each with the ends of its 95 %
        interval, such as `distal.mean pressure low [kPa]`:

        - of each region the columns of `regions` at this instant except the pressure-time integral
          and the nearest tile, such as `anterior proximal.mean pressure [kPa]`;
        - of each tile `pressure [kPa]` (normal, positive in compression) and `shear [kPa]`
          (magnitude), such as `h007_a054.shear [kPa]`; a tile named like a region has the prefix
          `tile `, as in `tile distal.pressure [kPa]`. Ends lie 1.96 standard deviations of the
          force map from the value, that of a shear not below 0.

        Regions are NaN at a sample in which nothing was measured, and a centre of pressure where
        nothing is compressed; tiles are never NaN and have the prior's values there.
        """
        estimate = self.map.estimate
        pressure = normal_quantity(
            1e-3 * estimate.normal_pressure, 1e-3 * estimate.normal_pressure_standard_deviation
        )
        shear = normal_quantity(1e-3 * estimate.shear, 1e-3 * estimate.shear_standard_deviation)
        shear = dataclasses.replace(shear, low=np.maximum(shear.low, 0.0))
        stresses = with_interval("pressure [kPa]", pressure)
        stresses |= with_interval("shear [kPa]", shear)
        regions = [place.name for place in self.places]
        columns = by_place(regions, columns_of(self.outputs.series, _SERIES_TITLES))
        # A cluster and its tile may have the name of a region, such as distal.
        tiles = [f"tile {n}" if n in regions else n for n in self.trial.geometry.names]
        columns |= by_place(tiles, stresses)
        return pd.DataFrame(columns, index=pd.Index(self.time, name="time [s]"))

    def to_long(self, over_time: bool = False) -> pd.DataFrame:
        """The outputs in long form, a row per value; no named index.

        Columns: `trial`, its name; `part`, which is `regions`, `tiles` or `limb`; `name` of the
        region or tile, empty for the limb; `quantity` and `unit`, such as `peak pressure` and
        `kPa`; the `value` with the ends `low` and `high` of its 95 % interval; and the flag
        `uncertain`. NaN is unknown, an unknown end of an interval of the limb is infinite.

        Args:
            over_time: Whether to return the values of `over_time` instead, with a column `time [s]`
                and without `uncertain` and the limb.
        """
        if over_time:
            return self._long_over_time()
        rows = [
            {
                "trial": self.trial.name,
                "part": part,
                "name": name,
                **dict(zip(("quantity", "unit"), split_unit(title), strict=True)),
                **row,
            }
            for (part, name, title), row in self.rows().items()
        ]
        return pd.DataFrame(rows)

    def _long_over_time(self) -> pd.DataFrame:
        table = self.over_time()
        regions = [place.name for place in self.places]
        series = [title for title in _SERIES_TITLES if f"{regions[-1]}.{title}" in table]
        kinds = [("regions", name, name, title) for name in regions for title in series]
        for name in self.trial.geometry.names:
            column = f"tile {name}" if name in regions else name
            kinds += [("tiles", name, column, title) for title in _STRESSES]
        parts = [split_unit(title) for *_, title in kinds]
        ends = {
            end: [
                f"{column}.{quantity}{suffix} [{unit}]"
                for (_, _, column, _), (quantity, unit) in zip(kinds, parts, strict=True)
            ]
            for end, suffix in (("value", ""), ("low", " low"), ("high", " high"))
        }
        columns = {
            "trial": [self.trial.name] * len(kinds),
            "time [s]": self.time,
            "part": [part for part, *_ in kinds],
            "name": [name for _, name, *_ in kinds],
            "quantity": [quantity for quantity, _ in parts],
            "unit": [unit for _, unit in parts],
            **{end: table[titles].to_numpy() for end, titles in ends.items()},
        }
        return stacked(columns, len(table))

    def document(self) -> dict[str, Any]:
        """The outputs for JSON, each with its interval and the flag `uncertain`.

        Returns:
            `trial`, `segment` (`kind`, `start` and `end` [s]), the number of `samples`, the limits
            and the integrated time with their units in the keys, `source` (what was measured, in
            words), and `regions`, `tiles` and `limb` with the outputs of `rows` by name and title;
            None for unknown values.
        """
        names, nearest = self.trial.geometry.names, self.regions["nearest tile"]
        found: dict[str, dict[str, dict[str, Any]]] = {"regions": {}, "tiles": {}, "limb": {"": {}}}
        for place in self.places:
            tiles = [names[tile] for tile in place.tiles]
            near = nearest[place.name] or None
            found["regions"][place.name] = {"tiles": tiles, "nearest tile": near}
        for (part, name, title), row in self.rows().items():
            values = {key: finite_or_null(value) for key, value in row.items()}
            found[part].setdefault(name, {})[title] = values
        return {
            **origin(self.trial, self.segment),
            "samples": len(self.time),
            "threshold [kPa]": self.threshold,
            "largest reach of an interval [-]": self.share,
            "integrated time [s]": self.outputs.integrated,
            "source": self.outputs.source,
            **found,
            "limb": found["limb"][""],
        }

    def save(self, path: PathLike, over_time: bool = False) -> None:
        """Write the table of `regions` or `over_time`; an existing file is replaced.

        Args:
            path: `.csv`, `.parquet` or `.mat`; or `.json` for the document.
            over_time: Whether to write the table of `over_time` instead of `regions`.
        """
        if over_time:
            write_table(self.over_time(), path_of(path, "the file"))
        else:
            super().save(path)

    def _figure(self, style: FigureStyle) -> Figure:
        """Unrolled maps, mean and at the peak; sectors, heights and user regions over time."""
        heading = f"{self.trial.name}: pressure, {self.segment}"
        return pressure_figure(self.trial, self.segment, self.places, self.outputs, heading, style)

    def _draw_into(self, ax: Axes, limits: Limits) -> None:
        self.map._draw_into(ax, limits)


def map_trial(
    trial: Trial,
    settings: EstimatorSettings,
    geometry: SocketGeometry | None = None,
    prior: SurveyPrior | None = None,
) -> TrialMap:
    """The force map of a whole trial, with the regions of its own socket or of another.

    Args:
        trial: The trial, of which outliers are not used.
        settings: The force map's ordinary prior, and the channels to leave out.
        geometry: A socket with the same tiles and other regions; None for the trial's own.
        prior: A survey of the limb; None for the ordinary prior alone.

    Raises:
        IdentificationError: If the samples are in another unit or frame.
        TrialError: If the trial holds no sample.
    """
    geometry = geometry or trial.geometry
    checked = trial.checked(settings.identification.leave_out)
    force_map, samples = checked.force_map(settings.force_map, prior), checked.counted
    seen = np.asarray(np.isfinite(samples.trusted_forces[:, :, 2]).any(axis=0))
    clusters = {name: geometry.clusters[name] for name in compress(samples.clusters, seen)}
    places = all_regions(replace(geometry, clusters=clusters), trial.metadata.side)
    whole = trial.select("all", settings)
    return TrialMap(trial, whole, np.asarray(samples.time), samples, force_map, places)


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
