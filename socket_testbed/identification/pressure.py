r"""Clinical outputs of a socket's pressure, by region, with 95 % intervals.

Every output is computed from many joint draws of the forces on all tiles
(`force_map.ForceMap.sample`), so its interval covers all uncertainty left by the channels, even for
outputs that are nonlinear in the forces. In the tile's frame the stress of tile i with the area
A_i is :math:`(\tau_x, \tau_y, -p) = F_i / A_i`; x is proximal and p is positive in compression.
Over a region:

- mean pressure: :math:`\sum_i A_i p_i / \sum_i A_i`, averaged over the samples. Negative estimates
  are kept, so that the means agree with the measured wrench;
- peak pressure: :math:`\max_i p_i`, the highest of all samples over a span;
- contact area: the area of the tiles in contact, that is whose p_i exceeds the threshold, averaged
  over the samples;
- pressure-time integral: the mean over the region's area of the integral of p_i while tile i is in
  contact, by the trapezoidal rule; breaks of the recording are left out;
- centre of pressure: the mean of the tiles' centres weighted by their compressive normal forces
  :math:`A_i \max(p_i, 0)`;
- shear: the magnitude of the mean tangential stress over area and span, and its direction from x
  (proximal) towards y;
- share of load: the axial force (along the socket) of the region over that of all tiles.

All values come from the force map: a tile is in contact if that is likelier than not, and the
contact area and the integral count the same tiles. The draws of peak, contact area, integral and
shear exceed the value on average: an uncertain pressure near zero lies above the threshold in many
of them. The interval covers both that of the draws and the same interval shifted to the value. For
peak, contact area and integral the errors of the draws are widened.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from socket_testbed.arrays import BREAK, NORMAL_QUANTILE, BoolArray, FloatArray, IntArray, gaps
from socket_testbed.errors import TrialError
from socket_testbed.geometry.regions import Region, proximal_direction
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import ForceMap, MapEstimate
from socket_testbed.samples import Samples
from socket_testbed.settings.options import PressureOptions
from socket_testbed.tables import split_unit

THRESHOLD = 1e3 * PressureOptions.threshold  # [Pa]; default for a tile in contact
# A value is uncertain if its interval reaches farther than this share of it [-].
SHARE = PressureOptions.share
# In pictures, full colour up to a ratio of interval reach to value, the greyest from another on.
# Lower values are treated as `_MIN_GREYED`.
_FULL_COLOUR, _GREYEST = 1.0, 2.5  # [-]
_MIN_GREYED = 5e3  # [Pa]
_DRAWS = 200
_PEAK_WIDENING = 1.25  # [-]; of pressures' errors, as true fields have longer tails than the draws
_QUANTILES = (0.025, 0.5, 0.975)  # [-]
_RAISED = ("peak", "area", "integral", "shear")  # their draws exceed the value on average
_NEVER_NEGATIVE = ("area", "integral", "shear")
MAX_DRAWN = 2000  # samples of a span with expanded draws, evenly spread
# Samples whose draws are expanded at a time: on all tiles, and on regions in order. A few megabytes
# of them stay in the processor's own memory.
_TILES_BATCH, _ORDERED_BATCH = 4, 8
_RIGHT_ANGLE = 0.5 * np.pi  # [rad]
_MIN_EXTENT = 1e-9  # [m]; of a region of a single tile, whose centre of pressure is certain
# Output, axis of a vector, factor from SI, and displayed decimals, by the title of a column; in the
# order of tables.
_COLUMNS: dict[str, tuple[str, int | None, float, int]] = {
    "peak pressure [kPa]": ("peak", None, 1e-3, 1),
    "mean pressure [kPa]": ("mean", None, 1e-3, 1),
    "contact area [cm^2]": ("area", None, 1e4, 0),
    "pressure-time integral [kPa s]": ("integral", None, 1e-3, 0),
    "share of load [%]": ("share", None, 100.0, 0),
    "shear [kPa]": ("shear", None, 1e-3, 1),
    "shear direction [deg]": ("direction", None, 180.0 / np.pi, 0),
    "centre of pressure x [mm]": ("centre", 0, 1e3, 0),
    "centre of pressure y [mm]": ("centre", 1, 1e3, 0),
    "centre of pressure z [mm]": ("centre", 2, 1e3, 0),
}
TITLES = tuple(_COLUMNS)
"""Columns of the outputs of a region, with their units."""
_NOT_OF_TILES = ("contact area", "centre of pressure")  # which a single tile does not have
TILE_TITLES = tuple(title for title in TITLES if not title.startswith(_NOT_OF_TILES))
"""Columns of the outputs of a tile, with their units."""
_DECIMALS = {title: column[3] for title, column in _COLUMNS.items()}


@dataclass(frozen=True)
class Quantity:
    """Values with their 95 % intervals, as arrays of one shape and unit.

    Shape and unit are those of the output, such as in `RegionOutputs`.

    Attributes:
        value: The estimates; NaN if unknown.
        low: Lower ends of the intervals.
        high: Upper ends of the intervals.
        scale: Reference for the reach of an interval, 0 or more: the magnitude of the value, the
            extent of the region for a coordinate, a right angle for a direction, the geometric
            mean of both axes' own stiffnesses for a stiffness.
    """

    value: FloatArray
    low: FloatArray
    high: FloatArray
    scale: FloatArray

    @property
    def reach(self) -> FloatArray:
        """Distance of the farther end of the interval from the value, in its shape and unit."""
        return np.maximum(self.high - self.value, self.value - self.low)

    def certain(self, share: float = SHARE) -> BoolArray:
        """Where the interval reaches no farther from the value than a share of the scale [-].

        The result has the shape of the values, and is false where they are NaN.
        """
        return np.asarray(self.reach <= share * self.scale)  # false for NaN

    def part(self, place: Any, factor: float = 1.0) -> Quantity:
        """Elements of the arrays, in another unit.

        Args:
            place: Index of the arrays, such as `(..., 2)`; `...` for all elements.
            factor: From the unit of the values to the other one, such as 1e-3 for Pa to kPa.
        """
        return Quantity(*(np.asarray(factor * values[place]) for values in vars(self).values()))


def normal_quantity(value: FloatArray, deviation: FloatArray) -> Quantity:
    """Normally distributed values with 95 % intervals from their standard deviations.

    Args:
        value: The values, of any shape and unit.
        deviation: Their standard deviations, in the shape and unit of the values.
    """
    reach = NORMAL_QUANTILE * deviation
    return Quantity(value, value - reach, value + reach, np.abs(value))


@dataclass(frozen=True)
class RegionOutputs:
    """Outputs of R regions, over a span, shape (R,), or at N instants, shape (N, R).

    The module docstring defines them.

    Attributes:
        mean: Mean pressure, positive in compression [Pa].
        peak: Peak pressure, positive in compression [Pa].
        area: Contact area [m^2].
        integral: Pressure-time integral [Pa s]; NaN at instants and over a single sample.
        centre: Centre of pressure in {S}, shape (R, 3) or (N, R, 3) [m]; NaN without compression.
        shear: Magnitude of the mean shear [Pa].
        direction: Direction of the shear from x (proximal) towards y of the tiles' frames, within
            half a turn of 0 [rad]; the ends of its interval may lie beyond.
        share: Share of the load, that is of the force along the socket [-]; it may be negative.
    """

    mean: Quantity
    peak: Quantity
    area: Quantity
    integral: Quantity
    centre: Quantity
    shear: Quantity
    direction: Quantity
    share: Quantity


def decimals_of(title: str) -> int:
    """Displayed decimals of an output by its title, such as `stiffness Fz [N/mm]`."""
    return _DECIMALS.get(title, 1 if title.endswith("[N]") else 2)


def greyness(value: FloatArray, reach: FloatArray) -> FloatArray:
    """Greyness of pressures by the reach of their 95 % intervals [-]: 0 full colour, 1 greyest.

    Args:
        value: Pressures, of any shape [Pa].
        reach: Distances of the ends of their intervals, in the shape of the pressures [Pa].
    """
    share = reach / np.maximum(np.abs(value), _MIN_GREYED)
    return np.asarray(np.clip((share - _FULL_COLOUR) / (_GREYEST - _FULL_COLOUR), 0.0, 1.0))


def read_column(found: RegionOutputs, title: str) -> Quantity:
    """The output of a column of `TITLES`, shape (R,) or (N, R), in the unit of the title.

    Args:
        found: The outputs.
        title: The title of the column, such as `peak pressure [kPa]`.
    """
    name, axis, factor, _ = _COLUMNS[title]
    quantity: Quantity = getattr(found, name)
    return quantity.part(... if axis is None else (..., axis), factor)


def columns_of(found: RegionOutputs, titles: Sequence[str]) -> dict[str, FloatArray]:
    """Columns with the ends of their intervals by title, shape (R,) or (N, R), in its unit.

    Args:
        found: The outputs.
        titles: Titles of the columns, of `TITLES`.
    """
    columns = (with_interval(title, read_column(found, title)) for title in titles)
    return {title: values for column in columns for title, values in column.items()}


def with_interval(title: str, quantity: Quantity) -> dict[str, FloatArray]:
    """A column and the ends of its interval, by title.

    Args:
        title: Title with a unit, such as `peak pressure [kPa]`.
        quantity: Its values, in that unit.
    """
    return {
        title: quantity.value,
        interval_end(title, "low"): quantity.low,
        interval_end(title, "high"): quantity.high,
    }


def interval_end(title: str, end: str) -> str:
    """Title of the end of a column's interval, such as `peak pressure low [kPa]`.

    Args:
        title: Title of the column, such as `peak pressure [kPa]`.
        end: `low` or `high`.
    """
    name, unit = split_unit(title)
    return f"{name} {end} [{unit}]"


@dataclass(frozen=True)
class PressureOutputs:
    """Outputs of a socket over a span of time.

    Attributes:
        regions: Outputs of the R regions over the span, shape (R,).
        tiles: Outputs of each of the n tiles over the span, shape (n,).
        integrated: Time that the integrals cover, without breaks [s].
        peak_row: Index of the sample with the highest pressure of a tile.
        force_map: The force map that the outputs are drawn from.
        samples: The N samples of the span.
        by_region: Computes the outputs of the R regions from forces.
        threshold: Pressure above which a tile is in contact [Pa].
    """

    regions: RegionOutputs
    tiles: RegionOutputs
    integrated: float
    peak_row: int
    force_map: ForceMap
    samples: Samples
    by_region: _Regions
    threshold: float

    @property
    def source(self) -> str:
        """The channels that the outputs are computed from, in words."""
        return self.force_map.source(self.samples)

    @cached_property
    def estimate(self) -> MapEstimate:
        """The force map of the N samples."""
        return self.force_map.estimate(self.samples)

    @cached_property
    def mean_map(self) -> MapEstimate:
        """The mean of the force map over the span, with N = 1: see `ForceMap.mean`."""
        return self.force_map.mean(self.samples)

    @cached_property
    def peak_map(self) -> MapEstimate:
        """The force map of the sample `peak_row`, with N = 1."""
        return self.force_map.estimate(self.samples[self.peak_row : self.peak_row + 1])

    @cached_property
    def series(self) -> RegionOutputs:
        """Outputs of the regions at every sample, shape (N, R); NaN where nothing was measured."""
        kept = np.flatnonzero(measured_rows(self.samples))
        series: dict[str, Quantity] = {}
        drawn = _expanded(self.force_map, self.samples[kept], self.by_region.areas, self.threshold)
        for some, alone, instants in drawn:
            for name, quantity in vars(self.by_region.outputs(alone, instants)).items():
                shape = (len(self.samples), *quantity.value.shape[1:])
                _store(series.setdefault(name, _unknown(shape)), quantity, kept[some])
        return RegionOutputs(**series)

    @cached_property
    def mean_pressure(self) -> Quantity:
        """Mean pressure of the regions at every sample, shape (N, R) [Pa].

        It equals `series.mean` at a fraction of the cost; NaN where nothing was measured.
        """
        mapping = self.by_region.mean_pressure
        found = _unknown((len(self.samples), mapping.shape[1]))
        kept = np.flatnonzero(measured_rows(self.samples))
        for draws in self.force_map.sample(self.samples[kept], _DRAWS):
            regional = draws.mapped(mapping)
            value, last = regional.mean(), np.full((1, 1, 1), _DRAWS - 1)
            low, high = np.empty((2, *value.shape))
            for some, ordered in regional.ordered(_ORDERED_BATCH):
                low[some], _, high[some] = _read_quantiles(ordered, last)
            low, high = np.minimum(low, value), np.maximum(high, value)
            _store(found, Quantity(value, low, high, np.abs(value)), kept[regional.rows])
        return found


@dataclass(frozen=True)
class _Fields:
    """Inputs of the outputs, on n tiles, with any leading axes.

    Attributes:
        force: Mean force on the socket in the tiles' frames, shape (..., n, 3) [N].
        peak: Highest pressure, shape (..., n) [Pa].
        contact: Share of the time in contact, shape (..., n) [-].
        compression: Mean compressive force, 0 or more, shape (..., n) [N].
        integral: Integral of the pressure in contact, shape (..., n) [Pa s]; None at an instant.
    """

    force: FloatArray
    peak: FloatArray
    contact: FloatArray
    compression: FloatArray
    integral: FloatArray | None = None


class _Regions:
    """Computes the outputs of regions from fields."""

    def __init__(self, geometry: SocketGeometry, regions: Sequence[Region]) -> None:
        count, anchors, areas = len(geometry), geometry.anchors, geometry.areas
        self._tiles = np.concatenate([region.tiles for region in regions])
        self._starts = np.cumsum([0, *(len(region.tiles) for region in regions[:-1])])
        member = np.array([np.isin(np.arange(count), region.tiles) for region in regions]).T * 1.0
        self._area_of_tiles = areas[:, None] * member
        self._areas = self._area_of_tiles.sum(axis=0)
        self.areas = areas  # of the tiles
        # From compressive forces to their sums and first moments, by region.
        arms = np.column_stack([np.ones(count), anchors])
        self._moments = (arms[:, :, None] * member[:, None]).reshape(count, -1)
        # From forces to mean shear along x and y, mean pressure, and axial force, by region.
        mean = np.array([1.0, 1.0, -1.0])[:, None, None] * member / self._areas
        linear = np.zeros((count, 3, 4, len(regions)))
        for axis in range(3):
            linear[:, axis, axis] = mean[axis]
        along = proximal_direction(geometry) @ geometry.rotations  # (n, 3)
        linear[:, :, 3] = along[:, :, None] * member[:, None]
        self._linear = linear.reshape(3 * count, -1)
        self.mean_pressure = linear[:, :, 2].reshape(3 * count, -1)  # from forces, (3n, R) [1/m^2]
        self._axial = along.reshape(-1)
        centres = (member.T @ anchors) / member.sum(axis=0)[:, None]
        apart = ((anchors[:, None] - centres) ** 2).sum(axis=2)
        extents = np.sqrt((apart * member).sum(axis=0) / member.sum(axis=0))
        self._extents = np.maximum(extents, _MIN_EXTENT)

    def read(self, fields: _Fields) -> dict[str, FloatArray]:
        """The outputs by their names, shape (..., R), and the centre (..., R, 3), in SI units."""
        leading = fields.peak.shape[:-1]
        force = fields.force.reshape(*leading, -1)
        x, y, mean, axial = np.moveaxis((force @ self._linear).reshape(*leading, 4, -1), -2, 0)
        moments = (fields.compression @ self._moments).reshape(*leading, 4, -1)
        found = {
            "mean": mean,
            "peak": np.maximum.reduceat(fields.peak[..., self._tiles], self._starts, axis=-1),
            "area": fields.contact @ self._area_of_tiles,
            "shear": np.hypot(x, y),
            "direction": np.arctan2(y, x),
        }
        with np.errstate(invalid="ignore", divide="ignore"):
            centre = moments[..., 1:, :] / moments[..., :1, :]
            found["centre"] = np.swapaxes(centre, -2, -1)
            found["share"] = axial / (force @ self._axial)[..., None]
        if fields.integral is not None:
            found["integral"] = fields.integral @ self._area_of_tiles / self._areas
        return found

    def outputs(self, estimate: _Fields, draws: _Fields) -> RegionOutputs:
        """The outputs with intervals.

        Args:
            estimate: Fields of the estimate, with the leading axes (..., 1).
            draws: Fields of the D draws, with the leading axes (..., D).
        """
        axis = estimate.peak.ndim - 2
        values = {name: np.take(found, 0, axis) for name, found in self.read(estimate).items()}
        drawn = self.read(draws)
        found = {name: self.interval(name, values[name], drawn[name]) for name in values}
        found.setdefault("integral", _unknown(values["mean"].shape))
        return RegionOutputs(**found)

    def interval(self, name: str, value: FloatArray, drawn: FloatArray) -> Quantity:
        """A quantity with its interval, in SI units.

        Args:
            name: Its name, a field of `RegionOutputs`.
            value: The estimate, shape (..., R), of the `centre` (..., R, 3).
            drawn: The draws, shape (..., D, R), of the `centre` (..., D, R, 3).
        """
        axis = value.ndim - (2 if name == "centre" else 1)
        difference = drawn - np.expand_dims(value, axis)
        if name == "direction":
            difference = (difference + np.pi) % (2.0 * np.pi) - np.pi
        low, middle, high = _quantiles(np.moveaxis(difference, axis, -1))
        if name in _RAISED:
            low, high = np.minimum(low, low - middle), np.maximum(high, high - middle)
        low, high = value + np.minimum(low, 0.0), value + np.maximum(high, 0.0)
        if name in _NEVER_NEGATIVE:
            low = np.maximum(low, 0.0)
        if name == "area":
            high = np.minimum(high, self._areas)
        scales = {"centre": self._extents[:, None], "direction": np.array(_RIGHT_ANGLE)}
        scale = np.broadcast_to(scales.get(name, np.abs(value)), value.shape)
        return Quantity(value, low, high, scale)


class _Span:
    """Fields of D draws, accumulated over the samples of a span."""

    def __init__(self, draws: int, tiles: int) -> None:
        self._samples, self._time = 0, 0.0
        self._force = np.zeros((draws, tiles, 3))
        self.peak = np.full((draws, tiles), -np.inf)
        self._contact, self._compression, self._integral = np.zeros((3, draws, tiles))

    def add(self, instants: _Fields, weights: FloatArray) -> None:
        """Add the fields of k samples.

        Args:
            instants: Their fields, with the leading axes (k, D).
            weights: Their weights in time integrals, shape (k,) [s].
        """
        self._samples += len(weights)
        self._time += float(weights.sum())
        self._force += instants.force.sum(axis=0)
        self.raise_peaks(instants)
        self._contact += instants.contact.sum(axis=0)
        self._compression += instants.compression.sum(axis=0)
        self._integral += np.einsum("k,kdn,kdn->dn", weights, instants.peak, instants.contact)

    def raise_peaks(self, instants: _Fields) -> None:
        """Add k samples to the peaks only."""
        self.peak = np.maximum(self.peak, instants.peak.max(axis=0))

    def fields(self) -> _Fields:
        """The fields over the span, with the leading axis D."""
        return _Fields(
            force=self._force / self._samples,
            peak=self.peak,
            contact=self._contact / self._samples,
            compression=self._compression / self._samples,
            integral=self._integral if self._time > 0.0 else None,
        )


def _expanded(
    force_map: ForceMap, samples: Samples, areas: FloatArray, threshold: float
) -> Iterator[tuple[IntArray, _Fields, _Fields]]:
    """Batches of k samples: their indices, fields of the estimate and of the D draws.

    The fields have the shapes (k, 1, n) and (k, D, n). The errors of the draws' pressures are
    widened, those of their forces are not.
    """
    for draws in force_map.sample(samples, _DRAWS):
        for start in range(0, len(draws.rows), _TILES_BATCH):
            some = draws[start : start + _TILES_BATCH]
            alone = _instants(some.mean()[:, None], areas, threshold)
            instants = _instants(some.values(), areas, threshold)
            pressure = alone.peak + _PEAK_WIDENING * (instants.peak - alone.peak)
            contact = _in_contact(pressure, threshold)
            yield some.rows, alone, replace(instants, peak=pressure, contact=contact)


def pressure_outputs(
    force_map: ForceMap,
    samples: Samples,
    geometry: SocketGeometry,
    regions: Sequence[Region],
    threshold: float,
) -> PressureOutputs:
    """Outputs of regions and tiles over a span.

    Args:
        force_map: The force map of the socket and its clusters.
        samples: The N samples of the span; those without any measured channel are left out.
        geometry: The socket with its n tiles.
        regions: R regions, each with at least one tile.
        threshold: Pressure above which a tile is in contact [Pa].

    Raises:
        TrialError: If no sample has a wrench or a trusted cluster.
    """
    kept = np.flatnonzero(check_measured(samples))
    measured, areas = samples[kept], geometry.areas
    weights = integration_weights(measured.time)
    alone, drawn = _Span(1, len(areas)), _Span(_DRAWS, len(areas))
    peaks = np.zeros(len(areas), dtype=np.int64)
    for draws in force_map.sample(measured, _DRAWS):
        instants = _instants(draws.mean()[:, None], areas, threshold)
        top = instants.peak[:, 0].argmax(axis=0)
        peaks = np.where(instants.peak.max(axis=0)[0] > alone.peak[0], draws.rows[top], peaks)
        alone.add(instants, weights[draws.rows])
    # Neighbouring samples share their uncertainty: draws at some of them suffice for the means.
    # Each tile may have its peak at any sample, so the draws there are added.
    groups = np.arange(0, len(kept), -(-len(kept) // MAX_DRAWN))
    thinned = (groups + np.append(groups[1:], len(kept)) - 1) // 2
    group_weights = np.add.reduceat(weights, groups)
    for rows, _, instants in _expanded(force_map, measured[thinned], areas, threshold):
        drawn.add(instants, group_weights[rows])
    if len(thinned) < len(kept):
        for _, _, instants in _expanded(force_map, measured[np.unique(peaks)], areas, threshold):
            drawn.raise_peaks(instants)
    each = [Region(name, np.array([tile])) for tile, name in enumerate(geometry.names)]
    over_span = alone.fields(), drawn.fields()
    by_region = _Regions(geometry, regions)
    return PressureOutputs(
        regions=by_region.outputs(*over_span),
        tiles=_Regions(geometry, each).outputs(*over_span),
        integrated=float(weights.sum()),
        peak_row=int(kept[peaks[alone.peak[0].argmax()]]),
        force_map=force_map,
        samples=samples,
        by_region=by_region,
        threshold=threshold,
    )


def highest_row(force_map: ForceMap, samples: Samples, geometry: SocketGeometry) -> int:
    """Index of the sample with the highest pressure on a tile, by the mean of the map.

    Args:
        force_map: The force map of the socket and its clusters.
        samples: N samples, at least one.
        geometry: The socket.
    """
    highest = np.empty(len(samples))
    for draws in force_map.sample(samples, _DRAWS):
        compression = -draws.mean()[:, 2::3]
        highest[draws.rows] = (compression / geometry.areas).max(axis=1)
    return int(highest.argmax())


def _instants(forces: FloatArray, areas: FloatArray, threshold: float) -> _Fields:
    """Fields of forces in the tiles' frames, which may be flattened, shape (k, D, 3n) [N]."""
    forces = forces.reshape(*forces.shape[:2], -1, 3)
    compression = -forces[..., 2]
    pressure = compression / areas
    return _Fields(
        force=forces,
        peak=pressure,
        contact=_in_contact(pressure, threshold),
        compression=np.maximum(compression, 0.0),
    )


def _in_contact(pressure: FloatArray, threshold: float) -> FloatArray:
    """1 where a pressure exceeds the threshold, else 0, of the shape of the pressures [Pa]."""
    return (pressure > threshold).astype(float)


@dataclass(frozen=True)
class Contact:
    """Contact of R regions at an instant.

    Attributes:
        area: Contact area, shape (R,) [m^2].
        pressure: Mean over the region's area of the pressure in contact, shape (R,) [Pa]: the rate
            of the pressure-time integral.
    """

    area: Quantity
    pressure: Quantity


def contact_of(
    geometry: SocketGeometry, regions: Sequence[Region], found: MapEstimate, threshold: float
) -> Contact:
    """Contact of R regions from a map of N = 1 alone, without draws.

    Each end of an interval takes that end of the interval of every tile, as if all tiles had the
    same errors: the intervals are wider than those of `RegionOutputs`.

    Args:
        geometry: The socket of n tiles.
        regions: The R regions.
        found: The force map.
        threshold: Pressure above which a tile is in contact [Pa].
    """
    reach = found.pressure_reach[0]
    pressures = found.normal_pressure[0] + np.outer([0.0, -1.0, 1.0], reach)  # value, low, high
    contact = _in_contact(pressures, threshold)
    held = np.stack([contact, contact * pressures], axis=1) * geometry.areas  # (3, 2, n)
    sums = np.stack([held[..., region.tiles].sum(axis=-1) for region in regions], axis=-1)
    areas = np.array([geometry.areas[region.tiles].sum() for region in regions])
    value, low, high = sums[:, 0]
    mean, least, most = sums[:, 1] / areas
    return Contact(Quantity(value, low, high, value), Quantity(mean, least, most, mean))


def _quantiles(drawn: FloatArray) -> FloatArray:
    """`_QUANTILES` of the draws along the last axis, without NaN, shape (3, ...)."""
    ordered = np.sort(drawn, axis=-1)  # NaN comes last
    return _read_quantiles(
        ordered, np.maximum(np.isfinite(drawn).sum(axis=-1, keepdims=True) - 1, 0)
    )


def _read_quantiles(ordered: FloatArray, last: IntArray) -> FloatArray:
    """`_QUANTILES` of ascending values up to the index `last`, (..., 1), of the last axis."""
    place = last * np.array(_QUANTILES)
    below = place.astype(np.int64)
    low = np.take_along_axis(ordered, below, axis=-1)
    high = np.take_along_axis(ordered, np.minimum(below + 1, last), axis=-1)
    return np.moveaxis(low + (place - below) * (high - low), -1, 0)


def _unknown(shape: tuple[int, ...]) -> Quantity:
    """A quantity of NaN."""
    return Quantity(*(np.full(shape, np.nan) for _ in fields(Quantity)))


def _store(stored: Quantity, found: Quantity, rows: IntArray) -> None:
    """Write a quantity at some samples into that of all samples."""
    for name, values in vars(found).items():
        getattr(stored, name)[rows] = values


def measured_rows(samples: Samples) -> BoolArray:
    """Samples with a channel of the wrench or of a trusted cluster, shape (N,)."""
    return np.asarray(np.isfinite(samples.trusted_values).any(axis=1))


def check_measured(samples: Samples) -> BoolArray:
    """As `measured_rows`, for what needs one.

    Raises:
        TrialError: If no sample has a wrench or a trusted cluster.
    """
    rows = measured_rows(samples)
    if not rows.any():
        raise TrialError(
            "no sample of the segment has a wrench or a trusted cluster", "choose another segment"
        )
    return rows


def integration_weights(time: FloatArray) -> FloatArray:
    """Weights of the trapezoidal rule, without breaks, for ascending times, shape (N,) each [s].

    A step longer than three times the usual one is a break, in which the data is unknown.
    """
    steps = np.pad(np.where(gaps(time, BREAK), 0.0, np.diff(time)), 1)
    return 0.5 * (steps[:-1] + steps[1:])
