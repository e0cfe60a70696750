r"""What a lab reads from a socket's pressure, by region, with 95 % intervals.

Every output is computed from each of many joint draws of the forces on all tiles
(`force_map.ForceMap.sample`), so that its interval follows from what the channels leave open, also
where it is no linear function of the forces. In the tile's frame the stress of tile i with the area
A_i is :math:`(\tau_x, \tau_y, -p) = F_i / A_i`; x is proximal and p is positive in compression.
Over a region, with T for the span of time:

- mean pressure: :math:`\sum_i A_i p_i / \sum_i A_i`, the mean over the samples. A negative pressure
  of the estimate counts as it is, so that the means meet the measured wrench;
- peak pressure: :math:`\max_i p_i`, the highest of all samples over a span;
- contact area: the area of the tiles whose p_i exceeds the threshold, the mean over the samples;
- pressure-time integral: the mean over the region's area of the integral of p_i while tile i is in
  contact, by the trapezoidal rule; gaps between the samples are left out;
- centre of pressure: the mean of the tiles' centres weighted by their compressive normal forces
  :math:`A_i \max(p_i, 0)`;
- shear: the magnitude of the mean tangential stress over area and span, and its direction from x
  (proximal) towards y;
- share of load: the axial force (along z of {S}) of the region over that of all tiles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.errors import TrialError
from socket_testbed.geometry.regions import Region
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import ForceMap, MapEstimate
from socket_testbed.samples import Samples

_DRAWS = 200
_TAILS = (0.025, 0.975)  # [-]
_LONGEST_STEP = 3.0  # usual steps between samples; what is longer is a gap
_QUARTER_TURN = 0.5 * np.pi  # [rad]


@dataclass(frozen=True)
class Quantity:
    """Values with their 95 % intervals, arrays of one shape.

    Attributes:
        value: The estimates.
        low: Lower ends of the intervals.
        high: Upper ends of the intervals.
        scale: What the reach of an interval is compared with: the size of the value, the extent of
            the region for a coordinate, a right angle for a direction.
    """

    value: FloatArray
    low: FloatArray
    high: FloatArray
    scale: FloatArray

    def determined(self, share: float) -> BoolArray:
        """Where the interval reaches no farther from the value than a share of the scale.

        Args:
            share: Of the scale [-].
        """
        reach = np.maximum(self.high - self.value, self.value - self.low)
        return np.asarray(reach <= share * self.scale)  # never where one is NaN


@dataclass(frozen=True)
class RegionOutputs:
    """Outputs of R regions, over a span, shape (R,), or at N instants, shape (N, R).

    Attributes:
        mean: Mean pressure [Pa].
        peak: Peak pressure [Pa].
        area: Contact area [m^2].
        integral: Pressure-time integral [Pa s]; NaN at instants.
        centre: Centre of pressure in {S}, with a last axis of 3 [m].
        shear: Magnitude of the shear [Pa].
        direction: Direction of the shear from the tiles' x (proximal) towards y [rad]; the ends of
            its interval may lie beyond half a turn.
        share: Share of the load [-].
    """

    mean: Quantity
    peak: Quantity
    area: Quantity
    integral: Quantity
    centre: Quantity
    shear: Quantity
    direction: Quantity
    share: Quantity


@dataclass(frozen=True)
class PressureOutputs:
    """Outputs of a socket over a span of time.

    Attributes:
        regions: Over the span, shape (R,).
        tiles: Of every tile over the span, shape (n,).
        series: Of the regions at every sample, shape (N, R); NaN where nothing was measured.
        integrated: Time that the integrals cover, without gaps [s].
    """

    regions: RegionOutputs
    tiles: RegionOutputs
    series: RegionOutputs
    integrated: float


@dataclass(frozen=True)
class _Fields:
    """What the outputs are computed from, on n tiles, with any leading axes.

    Attributes:
        force: Mean force in the tiles' frames, shape (..., n, 3) [N].
        peak: Highest pressure, shape (..., n) [Pa].
        contact: Share of the time in contact, shape (..., n) [-].
        integral: Integral of the pressure in contact, shape (..., n) [Pa s].
        compression: Mean compressive force, shape (..., n) [N].
    """

    force: FloatArray
    peak: FloatArray
    contact: FloatArray
    integral: FloatArray
    compression: FloatArray


class _Reader:
    """Reads the outputs of regions from fields.

    Args:
        geometry: Geometry of the socket.
        regions: The R regions.
    """

    def __init__(self, geometry: SocketGeometry, regions: Sequence[Region]) -> None:
        self._geometry = geometry
        self._tiles = np.concatenate([region.tiles for region in regions])
        self._starts = np.cumsum([0, *(len(region.tiles) for region in regions[:-1])])
        self._member = np.zeros((len(geometry), len(regions)))
        for number, region in enumerate(regions):
            self._member[region.tiles, number] = 1.0
        self._areas = geometry.areas @ self._member
        counts = self._member.sum(axis=0)
        centres = (self._member.T @ geometry.anchors) / counts[:, None]
        apart = ((geometry.anchors[:, None] - centres) ** 2).sum(axis=2)
        self._extents = np.sqrt((apart * self._member).sum(axis=0) / counts)

    def read(self, fields: _Fields) -> dict[str, FloatArray]:
        """The outputs by their names, shape (..., R), and the centre (..., R, 3)."""
        areas, anchors, member = self._geometry.areas, self._geometry.anchors, self._member
        axial = (fields.force * self._geometry.rotations[:, 2]).sum(axis=-1)
        compression = fields.compression @ member
        weighted = np.stack(
            [(fields.compression * anchors[:, axis]) @ member for axis in range(3)], axis=-1
        )
        shear = np.stack([fields.force[..., axis] @ member for axis in (0, 1)], axis=-1)
        shear /= self._areas[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            return {
                "mean": -(fields.force[..., 2] @ member) / self._areas,
                "peak": np.maximum.reduceat(fields.peak[..., self._tiles], self._starts, axis=-1),
                "area": (fields.contact * areas) @ member,
                "integral": (fields.integral * areas) @ member / self._areas,
                "centre": weighted / compression[..., None],
                "shear": np.hypot(shear[..., 0], shear[..., 1]),
                "direction": np.arctan2(shear[..., 1], shear[..., 0]),
                "share": (axial @ member) / axial.sum(axis=-1, keepdims=True),
            }

    def outputs(self, estimate: _Fields, draws: _Fields, axis: int) -> RegionOutputs:
        """The outputs with intervals.

        Args:
            estimate: The fields of the estimate.
            draws: Those of the draws, with one more axis.
            axis: That axis.
        """
        values, drawn = self.read(estimate), self.read(draws)
        found = {}
        for name, value in values.items():
            difference = drawn[name] - np.expand_dims(value, axis)
            if name == "direction":
                difference = (difference + np.pi) % (2.0 * np.pi) - np.pi
            low, high = value + np.quantile(difference, _TAILS, axis=axis)
            found[name] = Quantity(value, low, high, self._scale(name, value))
        return RegionOutputs(**found)

    def _scale(self, name: str, value: FloatArray) -> FloatArray:
        if name == "centre":
            return np.broadcast_to(self._extents[:, None], value.shape)
        if name == "direction":
            return np.full(value.shape, _QUARTER_TURN)
        return np.abs(value)


class _Span:
    """Fields of D draws, gathered over the samples of a span."""

    def __init__(self, geometry: SocketGeometry, draws: int) -> None:
        tiles = len(geometry)
        self._samples = 0
        self._force = np.zeros((draws, tiles, 3))
        self._peak = np.full((draws, tiles), -np.inf)
        self._contact, self._integral, self._compression = np.zeros((3, draws, tiles))

    def add(self, instants: _Fields) -> None:
        """Add the fields at some samples, with the leading axes (k, D)."""
        self._samples += len(instants.force)
        self._force += instants.force.sum(axis=0)
        np.maximum(self._peak, instants.peak.max(axis=0), out=self._peak)
        self._contact += instants.contact.sum(axis=0)
        self._integral += instants.integral.sum(axis=0)
        self._compression += instants.compression.sum(axis=0)

    def fields(self) -> _Fields:
        """The fields over the span, with the leading axis D."""
        return _Fields(
            force=self._force / self._samples,
            peak=self._peak,
            contact=self._contact / self._samples,
            integral=self._integral,
            compression=self._compression / self._samples,
        )


def pressure_outputs(
    force_map: ForceMap,
    estimate: MapEstimate,
    samples: Samples,
    geometry: SocketGeometry,
    regions: Sequence[Region],
    threshold: float,
) -> PressureOutputs:
    """The outputs of regions and tiles with 95 % intervals.

    Args:
        force_map: The force map.
        estimate: Its estimate of the samples.
        samples: N samples.
        geometry: Geometry of the socket.
        regions: The regions.
        threshold: Pressure above which a tile is in contact [Pa].

    Raises:
        TrialError: If no sample has a channel to estimate from.
    """
    measured = np.isfinite(estimate.normal_pressure).all(axis=1) & measured_rows(samples)
    if not measured.any():
        raise TrialError(
            "no sample of the segment has a wrench or a trusted cluster", "choose another segment"
        )
    kept = np.flatnonzero(measured)
    weights = integration_weights(samples.time[kept])
    forces = np.einsum("nij,kni->knj", geometry.rotations, estimate.forces[kept])
    of_regions = _Reader(geometry, regions)
    of_tiles = _Reader(
        geometry, [Region(name, np.array([i])) for i, name in enumerate(geometry.names)]
    )

    drawn, alone = _Span(geometry, _DRAWS), _Span(geometry, 1)
    series: dict[str, Quantity] = {}
    for rows, draws in force_map.sample(samples[kept], _DRAWS):
        instants = _instants(draws, weights[rows], geometry.areas, threshold)
        own = _instants(forces[rows, None], weights[rows], geometry.areas, threshold)
        drawn.add(instants)
        alone.add(own)
        _store(series, of_regions.outputs(_first(own), instants, 1), kept[rows], len(samples))
    whole, single = drawn.fields(), _first(alone.fields(), 0)
    return PressureOutputs(
        regions=of_regions.outputs(single, whole, 0),
        tiles=of_tiles.outputs(single, whole, 0),
        series=RegionOutputs(**series),
        integrated=float(weights.sum()),
    )


def _instants(
    forces: FloatArray, weights: FloatArray, areas: FloatArray, threshold: float
) -> _Fields:
    """The fields at k samples of forces of shape (k, D, n, 3) [N]."""
    pressure = -forces[..., 2] / areas
    contact = pressure > threshold
    return _Fields(
        force=forces,
        peak=pressure,
        contact=contact.astype(float),
        integral=np.where(contact, pressure, 0.0) * weights[:, None, None],
        compression=np.maximum(-forces[..., 2], 0.0),
    )


def _first(of_one: _Fields, axis: int = 1) -> _Fields:
    """Fields without the axis of the draws, which has the length 1."""
    return _Fields(
        **{field.name: getattr(of_one, field.name).squeeze(axis) for field in fields(of_one)}
    )


def _store(series: dict[str, Quantity], found: RegionOutputs, rows: IntArray, count: int) -> None:
    """Put outputs at some samples among those of all N samples."""
    for output in fields(found):
        quantity: Quantity = getattr(found, output.name)
        if output.name not in series:
            shape = (count, *quantity.value.shape[1:])
            series[output.name] = Quantity(*(np.full(shape, np.nan) for _ in fields(Quantity)))
        for part in fields(Quantity):
            values = getattr(quantity, part.name)
            getattr(series[output.name], part.name)[rows] = (
                np.nan if output.name == "integral" else values
            )


def measured_rows(samples: Samples) -> BoolArray:
    """Samples with a channel that counts: of the wrench, or of a trusted cluster, shape (N,)."""
    forces = samples.trusted_forces.reshape(len(samples), -1)
    return np.asarray(np.isfinite(np.hstack([samples.wrench, forces])).any(axis=1))


def integration_weights(time: FloatArray) -> FloatArray:
    """Weights of the trapezoidal rule, without gaps, shape (N,) [s].

    A step longer than three times the usual one is a gap: what happened in it is not known.

    Args:
        time: Times of the samples, ascending, shape (N,) [s].
    """
    steps = np.diff(time)
    if not len(steps):
        return np.zeros(len(time))
    steps = np.where(steps > _LONGEST_STEP * np.median(steps), 0.0, steps)
    return np.asarray(0.5 * (np.append(steps, 0.0) + np.append(0.0, steps)))
