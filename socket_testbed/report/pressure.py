"""Pressure of a trial as the report shows it: computed, as tables, and in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.geometry.regions import Region, Side, all_regions
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import ForceMap, MapEstimate, without_untrusted
from socket_testbed.identification.pressure import (
    SHARE,
    THRESHOLD,
    PressureOutputs,
    Quantity,
    RegionOutputs,
    pressure_outputs,
    read_column,
    with_interval,
)
from socket_testbed.report.page import MASKED, NOTHING, Table
from socket_testbed.samples import Samples
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.segment import Segment

_INSTANTS = 60  # of the trial in the scene

_DECIMALS = {
    "peak pressure [kPa]": 1,
    "mean pressure [kPa]": 1,
    "contact area [cm^2]": 0,
    "pressure-time integral [kPa s]": 0,
    "share of load [%]": 0,
    "shear [kPa]": 1,
    "shear direction [deg]": 0,
    "centre of pressure x [mm]": 0,
    "centre of pressure y [mm]": 0,
    "centre of pressure z [mm]": 0,
}
_PRESSURES = 5  # columns of the first table by region


@dataclass(frozen=True)
class PressureResults:
    """Pressure over the segment, and at instants of the trial.

    Attributes:
        side: The leg that wears the socket; None where that is not stated.
        places: The regions; the last one is the socket.
        time: Times of the segment's samples since the first one of the trial, shape (N,) [s].
        outputs: The outputs of the places and the tiles over the segment.
        instants: Times spread over the trial, that of the peak among them, shape (k,) [s].
        over_trial: The force map at the instants.
    """

    side: Side | None
    places: tuple[Region, ...]
    time: FloatArray
    outputs: PressureOutputs
    instants: FloatArray
    over_trial: MapEstimate

    @property
    def peak_time(self) -> float:
        """When a tile has the highest pressure, since the first sample of the trial [s]."""
        return float(self.time[self.outputs.peak_row])

    @property
    def peak_tile(self) -> int:
        """The tile with the highest pressure."""
        return int(self.outputs.peak_map.normal_pressure[0].argmax())


def read_pressure(
    samples: Samples,
    segment: Segment,
    geometry: SocketGeometry,
    settings: EstimatorSettings,
    side: Side | None,
) -> PressureResults:
    """Pressure over a segment, from the force map.

    Args:
        samples: Samples of the trial.
        segment: The segment.
        geometry: Geometry of the socket.
        settings: Settings of the estimator.
        side: The leg that wears the socket; None where that is not stated.

    Raises:
        TrialError: If no sample of the segment has a channel to estimate from.
    """
    leave_out = settings.identification.leave_out
    chosen = without_untrusted(samples[segment.rows], geometry, leave_out)
    force_map = ForceMap(geometry, samples.clusters, settings.force_map)
    places = all_regions(geometry, side)
    outputs = pressure_outputs(force_map, chosen, geometry, places, THRESHOLD)
    rows = _spread(len(samples), segment.rows.start + outputs.peak_row)
    every = without_untrusted(samples, geometry, leave_out)
    return PressureResults(
        side=side,
        places=places,
        time=samples.time[segment.rows],
        outputs=outputs,
        instants=samples.time[rows],
        over_trial=force_map.estimate(every[rows]),
    )


def _spread(count: int, peak: int) -> IntArray:
    """Rows spread over all of them, and the one of the peak."""
    spread = np.linspace(0, count - 1, min(count, _INSTANTS)).round().astype(np.int64)
    return np.union1d(spread, [peak])


def regions_frame(pressure: PressureResults) -> pd.DataFrame:
    """Outputs over the segment with the ends of their intervals, a row per region.

    Values are NaN where they are not determined.
    """
    names = pd.Index([place.name for place in pressure.places], name="region")
    columns: dict[str, FloatArray] = {}
    for title in _DECIMALS:
        columns |= with_interval(title, read_column(pressure.outputs.regions, title), SHARE)
    return pd.DataFrame(columns, index=names)


def pressure_tables(pressure: PressureResults, geometry: SocketGeometry) -> list[Table]:
    """The outputs of the socket, then those of the regions, with their intervals."""
    found = [
        (title.replace("^2", "\N{SUPERSCRIPT TWO}"), quantity, decimals)
        for title, quantity, decimals in _quantities(pressure.outputs.regions)
    ]
    remarks = _remarks(pressure, geometry)
    socket = pd.DataFrame(
        {
            "value": [_value(quantity, decimals, -1) for _, quantity, decimals in found],
            "95 % interval": [_interval(quantity, decimals, -1) for _, quantity, decimals in found],
            "": [remarks.get(title, "") for title, _, _ in found],
        },
        index=pd.Index([title for title, _, _ in found], name="socket"),
    ).drop(index="share of load [%]")
    regions = pd.DataFrame(
        {
            title: [
                f"{_value(quantity, decimals, row)}\n{_interval(quantity, decimals, row)}"
                for row in range(len(pressure.places))
            ]
            for title, quantity, decimals in found
        },
        index=pd.Index([place.name for place in pressure.places], name="region"),
    )
    below = "the 95 % interval below each value"
    return [
        Table("pressure-socket", "The socket over the segment", socket),
        Table(
            "pressure-regions",
            f"Pressure and load by region, {below}",
            regions.iloc[:, :_PRESSURES],
        ),
        Table(
            "pressure-shear",
            f"Shear and centre of pressure by region, {below}",
            regions.iloc[:, _PRESSURES:],
        ),
    ]


def describe_pressure(pressure: PressureResults, geometry: SocketGeometry) -> str:
    """The pressure on the socket in a sentence."""
    parts = []
    for title, quantity, decimals in _quantities(pressure.outputs.regions)[:3]:
        name, unit = title.removesuffix("]").replace("^2", "\N{SUPERSCRIPT TWO}").split(" [")
        value, interval = (words(quantity, decimals, -1) for words in (_value, _interval))
        parts.append(f"{name} {value} ({interval}) {unit}")
    where = geometry.names[pressure.peak_tile]
    return (
        f"Pressure over the segment, with 95 % intervals: {'; '.join(parts)}. The peak is on"
        f" {where} at {pressure.peak_time:.2f} s."
    )


def _quantities(found: RegionOutputs) -> list[tuple[str, Quantity, int]]:
    """The outputs in the units of their titles, and how many decimals they are printed with."""
    return [(title, read_column(found, title), decimals) for title, decimals in _DECIMALS.items()]


def _value(quantity: Quantity, decimals: int, row: int) -> str:
    known = quantity.determined(SHARE)[row]
    return f"{quantity.value[row]:z.{decimals}f}" if known else MASKED


def _interval(quantity: Quantity, decimals: int, row: int) -> str:
    low, high = quantity.low[row], quantity.high[row]
    return (
        f"{low:z.{decimals}f} to {high:z.{decimals}f}"
        if np.isfinite([low, high]).all()
        else NOTHING
    )


def _remarks(pressure: PressureResults, geometry: SocketGeometry) -> dict[str, str]:
    """What is to be said of the outputs of the socket."""
    outputs = pressure.outputs
    centre = outputs.regions.centre.value[-1]
    nearest = geometry.names[int(np.linalg.norm(geometry.anchors - centre, axis=1).argmin())]
    return {
        "peak pressure [kPa]": (
            f"on {geometry.names[pressure.peak_tile]} at {pressure.peak_time:.2f} s"
        ),
        "mean pressure [kPa]": "over all tiles and the segment",
        "contact area [cm\N{SUPERSCRIPT TWO}]": (
            f"above {1e-3 * THRESHOLD:g} kPa; all tiles have {1e4 * geometry.areas.sum():.0f}"
        ),
        "pressure-time integral [kPa s]": f"over {outputs.integrated:.1f} s, while in contact",
        "shear [kPa]": "of the mean tangential stress",
        "shear direction [deg]": "from proximal, about the inward normal",
        "centre of pressure x [mm]": f"near {nearest}",
    }
