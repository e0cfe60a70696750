"""Force map over all tiles, and pressure outputs by region; neither needs a fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from socket_testbed.api.result import Result, origin, records
from socket_testbed.api.trials import PathLike, as_path, as_trial, select
from socket_testbed.arrays import FloatArray, sample_at
from socket_testbed.documents import check_number, finite_or_null
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.geometry.socket import SocketGeometry, find_regions
from socket_testbed.identification.force_map import ForceMap, MapEstimate
from socket_testbed.identification.pressure import (
    SHARE,
    THRESHOLD,
    TITLES,
    columns_of,
    normal_quantity,
    read_column,
    with_interval,
)
from socket_testbed.identification.problem import check_channels
from socket_testbed.samples import Samples
from socket_testbed.settings.testbed import EstimatorSettings, estimator_settings
from socket_testbed.tables import write_table
from socket_testbed.trials.pressure import (
    CENTRE_TITLES,
    MappedTrial,
    SegmentPressure,
    by_place,
    mapped_trial,
)
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from socket_testbed.report.style import FigureStyle

Rows: TypeAlias = dict[tuple[str, str, str], dict[str, Any]]
"""Values of outputs, by part, name and title."""

TILE_TITLES = tuple(t for t in TITLES if t not in (*CENTRE_TITLES, "contact area [cm^2]"))
_ROW_KEYS = ("value", "low", "high", "uncertain")
_SERIES_TITLES = tuple(title for title in TITLES if not title.startswith("pressure-time"))


@dataclass(frozen=True, repr=False)
class TrialMap(Result):
    """Forces on all tiles over a segment of a trial, with their standard deviations."""

    trial: Trial
    segment: Segment
    time: FloatArray  # (N,) [s], of its samples since the first sample of the trial
    samples: Samples  # with the channels in use
    force_map: ForceMap

    @cached_property
    def estimate(self) -> MapEstimate:
        """The map at every sample."""
        return self.force_map.estimate(self.samples)

    @cached_property
    def mean(self) -> MapEstimate:
        """The mean map, with N = 1."""
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

        Columns per tile: force in {S} with standard deviations, such as `tile_012.Fz [N]` and
        `tile_012.Fz.sd [N]`, then `pressure [Pa]` (positive in compression) and `shear [Pa]`.
        """
        columns = self.estimate.columns(self.trial.geometry.names)
        return pd.DataFrame(columns, index=pd.Index(self.time, name="time [s]"))

    def summary(self) -> pd.DataFrame:
        """Means over the segment, a row per tile, the highest pressure first.

        Standard deviations are those of the mean's error. They do not shrink with the number of
        samples, because the sensors leave the same uncertainty in each.
        """
        table = self.mean.by_tile(self.trial.geometry)
        return table.sort_values("pressure [kPa]", ascending=False, kind="stable")

    def at(self, time: float) -> TrialMap:
        """The map of the latest sample at a time since the first sample [s]."""
        row = sample_at(self.time, time)
        if row is None:
            raise TrialError(
                f"the map has no sample at {time:g} s",
                f"give a time between {self.time[0]:.2f} s and {self.time[-1]:.2f} s",
            )
        when, samples = self.time[row : row + 1], self.samples[row : row + 1]
        first = self.segment.rows.start + row  # of the trial
        instant = Segment("instant", float(when[0]), float(when[0]), slice(first, first + 1))
        return TrialMap(self.trial, instant, when, samples, self.force_map)

    def draws(self, count: int = 200) -> FloatArray:
        """Joint draws of the stresses on all tiles, for intervals of any function of them.

        Each draw is a map consistent with all measurements. All samples use the same seeded random
        numbers.

        Args:
            count: Number D of draws, even.

        Returns:
            Shear along x (proximal) and along y of each tile's frame, and normal pressure, positive
            in compression, shape (N, D, n, 3) [Pa]. For many samples this is large: see `at`.
        """
        geometry = self.trial.geometry
        check_number(count, "count", 2)
        if count % 2:
            raise ConfigurationError(f"{count} draws: an odd number", "give an even number")
        found = np.empty((len(self.time), count, len(geometry), 3))
        for draws in self.force_map.sample(self.samples, count):
            values = draws.values().reshape(len(draws.rows), count, -1, 3)
            found[draws.rows] = values / geometry.areas[:, None] * [1.0, 1.0, -1.0]
        return found

    def document(self) -> dict[str, Any]:
        """The map for JSON, with means over the segment by tile."""
        means = records(self.summary().reset_index())
        return origin(self.trial, self.segment) | {"tiles": means} | super().document()

    def _figure(self, style: FigureStyle) -> Figure:
        """Mean pressure on the tiles, and its standard deviation."""
        from socket_testbed.report.pressure import force_map_figure

        heading = f"{self.trial.name}, {self.segment}: force map"
        side = self.trial.metadata.side
        return force_map_figure(self.trial.geometry, self.mean, heading, style, side)

    def _draw_into(self, ax: Axes) -> None:
        from socket_testbed.report.tiles import draw_wall

        mean, side = self.mean, self.trial.metadata.side
        pressure, reach = 1e-3 * mean.normal_pressure[0], 1e-3 * mean.pressure_reach[0]
        draw_wall(ax, self.trial.geometry, pressure, "pressure [kPa]", reach, side)


def force_map(
    trial: Trial | PathLike, segment: str | Segment = "plateau", *, params: PathLike | None = None
) -> TrialMap:
    """Estimate the force on every tile from the clusters and the wrench, sample by sample.

    The estimate is a Gaussian process over the socket's surface and needs no fitted model. Missing,
    saturated, out-of-range and left-out channels are ignored.

    Args:
        trial: The trial.
        segment: As `specification` in `st.select_segment`, or a `Segment`.
        params: A `testbed.yaml` to use instead of the trial's own; its group `force_map` sets the
            prior.

    >>> found = st.force_map(st.open_trial("trials/hold"), segment="10:20")
    >>> found
    TrialMap(hold, span 10.00 s to 20.00 s; 41 samples, highest mean pressure ... kPa on ...)
    >>> found.estimate.forces.shape, list(found.to_dataframe())[:2]
    ((41, 79, 3), ['distal.Fx [N]', 'distal.Fx.sd [N]'])
    >>> found.save("map.csv")
    >>> found.at(12.0).draws().shape  # for intervals of any function of the map
    (1, 200, 79, 3)
    """
    trial = as_trial(trial)
    settings = estimator_settings(trial.estimator, as_path(params))
    chosen, mapped = _mapped(trial, segment, settings)
    time, rows = np.asarray(trial.samples().time[chosen.rows]), mapped.samples[chosen.rows]
    return TrialMap(trial, chosen, time, rows, mapped.force_map)


def _mapped(
    trial: Trial,
    segment: str | Segment,
    settings: EstimatorSettings,
    geometry: SocketGeometry | None = None,
) -> tuple[Segment, MappedTrial]:
    check_channels(settings.identification.leave_out, trial.samples().channels)
    chosen = select(trial, segment, settings)
    with threadpool_limits(1):
        return chosen, mapped_trial(trial, settings, geometry)


@dataclass(frozen=True, repr=False)
class TrialPressure(SegmentPressure, Result):
    """Pressure outputs over a segment of a trial, by region and tile, with 95 % intervals."""

    threshold: float  # [kPa]; a tile above this pressure is in contact
    share: float  # [-]; of a value; with an interval that reaches farther it is uncertain

    def __repr__(self) -> str:
        socket = self.regions.iloc[-1]
        low, high = socket["peak pressure low [kPa]"], socket["peak pressure high [kPa]"]
        return (
            f"TrialPressure({self.trial.name}, {self.segment}; {len(self.places)} regions, peak"
            f" pressure {low:.1f} to {high:.1f} kPa)"
        )

    @cached_property
    def map(self) -> TrialMap:
        """The underlying force map at every sample: 6 kB each."""
        found = self.outputs
        return TrialMap(self.trial, self.segment, self.time, found.samples, found.force_map)

    def rows(self) -> Rows:
        """Every output by part (`regions`, `tiles` or `limb`), place and title.

        Each has a `value`, the ends `low` and `high` of its 95 % interval, and a flag `uncertain`.
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
        """Pistoning, range of rotation and stiffness along and about x, y, z of {S}.

        Rows such as `pistoning [mm]` and `stiffness Fz [N/mm]`, columns `value`, `low`, `high`
        (95 %) and `uncertain`; NaN where the load did not change in every direction. Empty without
        poses. `suspension` holds the full 6 x 6 stiffness.
        """
        found = {title: row for (part, _, title), row in self.rows().items() if part == "limb"}
        return pd.DataFrame.from_dict(found, orient="index", columns=[*_ROW_KEYS])

    @property
    def tiles(self) -> pd.DataFrame:
        """Outputs over the segment, a row per tile, with 95 % intervals as in `regions`."""
        geometry = self.trial.geometry
        names = pd.Index(geometry.names, name="tile")
        table = pd.DataFrame(columns_of(self.outputs.tiles, TILE_TITLES), index=names)
        table.insert(0, "cluster", geometry.cluster_names)
        return table

    def to_dataframe(self) -> pd.DataFrame:
        """Same as `regions`."""
        return self.regions

    def over_time(self) -> pd.DataFrame:
        """Outputs of the regions and stresses on the tiles at every sample, by `time [s]`.

        Columns such as `anterior proximal.mean pressure [kPa]`, and `distal.pressure [kPa]` and
        `distal.shear [kPa]` for tiles (`tile distal` if a region has the same name), with the ends
        of their 95 % intervals. Intervals of tiles are 1.96 standard deviations of the force map.
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

    def document(self) -> dict[str, Any]:
        """The outputs for JSON, each with its interval and the flag `uncertain`."""
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
            write_table(self.over_time(), Path(path))
        else:
            super().save(path)

    def _figure(self, style: FigureStyle) -> Figure:
        """Unrolled maps, mean and at the peak; sectors, heights and user regions over time."""
        from socket_testbed.report.pressure import pressure_figure

        return pressure_figure(self, f"{self.trial.name}: pressure, {self.segment}", style)

    def _draw_into(self, ax: Axes) -> None:
        self.map._draw_into(ax)


def pressure(
    trial: Trial | PathLike,
    segment: str | Segment = "plateau",
    *,
    threshold: float = 1e-3 * THRESHOLD,
    share: float = SHARE,
    regions: Mapping[str, Sequence[str]] | None = None,
    params: PathLike | None = None,
    leave_out: Sequence[str] | None = None,
) -> TrialPressure:
    """Pressure and shear of a socket by region and tile, with 95 % intervals.

    The outputs are peak and mean pressure, contact area, pressure-time integral, centre of
    pressure, shear and share of the load, computed from the force map, see `st.force_map` and
    `socket_testbed.identification.pressure`.

    Args:
        trial: The trial.
        segment: As `specification` in `st.select_segment`, or a `Segment`.
        threshold: Pressure above which a tile is in contact [kPa].
        share: A value is uncertain if its interval reaches farther than this share of it [-].
        regions: Tile names by region, instead of the regions of `socket.yaml`.
        params: A `testbed.yaml` to use instead of the trial's own; its group `force_map` sets the
            prior.
        leave_out: Channels to ignore, such as `distal.Fx` or `Mz`.

    >>> found = st.pressure(st.open_trial("trials/hold"))
    >>> found
    TrialPressure(hold, plateau ... s; 21 regions, peak pressure ... to ... kPa)
    >>> list(found.regions)[:3]
    ['peak pressure [kPa]', 'peak pressure low [kPa]', 'peak pressure high [kPa]']
    >>> found.save("pressure.csv")
    """
    trial = as_trial(trial)
    check_number(threshold, "--threshold", 0.0, 500.0)
    check_number(share, "--share", 0.0, 5.0)
    settings = estimator_settings(trial.estimator, as_path(params), leave_out=leave_out)
    geometry = trial.geometry
    if regions is not None:
        own = find_regions(regions, geometry.names, "regions")
        geometry = dataclasses.replace(geometry, regions=own)
    chosen, mapped = _mapped(trial, segment, settings, geometry)
    with threadpool_limits(1):
        found = mapped.over(chosen, 1e3 * threshold)
    return TrialPressure(**vars(found), threshold=threshold, share=share)
