"""Pressure in the report: pictures, outputs of the regions, maps, and regions over time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from socket_testbed.arrays import FloatArray
from socket_testbed.figures.pressure import NAMED_SEGMENTS, pressure_figure, tile_pressures
from socket_testbed.identification.pressure import (
    SHARE,
    PressureOutputs,
    read_column,
    with_interval,
)
from socket_testbed.pages import document
from socket_testbed.report.models import model_values
from socket_testbed.report.page import Heading, Pictures, ReportFigure, Section
from socket_testbed.results.pressure import TrialPressure, by_place
from socket_testbed.results.pressure_text import number, page_tables
from socket_testbed.results.report import Results

_SPANS = {"loaded": "while loaded", "all": "in the trial"}  # by the kind of a segment


def head_section(results: Results) -> Section:
    """The pictures of the socket."""
    described = "Pressure on the unrolled wall of the socket, estimated between the clusters"
    return Section("socket", "", [Pictures(described)])


def page_data(results: Results) -> dict[str, Any]:
    """Data of the cards and the pictures of the socket, as plain data for JSON.

    The keys are those of `pages.document.trial_document`; `start`, the time of the peak [s];
    `moments` and `mean` (over the segment, without a time), `cards`, `bars`; and `extras`, the
    models' parameters on the tiles, each with `values` and `unit`.
    """
    found, over_trial = results.pressure, results.over_trial
    outputs, tiles, geometry = found.outputs, found.outputs.tiles, results.trial.geometry
    time = 1e-9 * (over_trial.samples.stamps - results.samples.stamps[0])
    measured = pd.DataFrame(document.measured_pressure(outputs.samples, geometry))
    means = tiles.mean.value, tiles.mean.reach, tiles.shear.value, measured.mean().to_numpy()
    arrows = document.shear_arrows(geometry, outputs.mean_map.forces[0])
    mean = document.moment(found.peak_time, *means, arrows=arrows)
    moments = document.moments(time, over_trial, geometry)
    at_peak = moments[int(np.abs(time - found.peak_time).argmin())]
    at_peak["words"] = f"at {found.peak_time:.2f} s, the peak {_span(found)}"
    side, events = results.metadata.side, results.events
    return document.trial_document(geometry, side, events, over_trial, time) | {
        "start": found.peak_time,
        "moments": moments,
        "mean": mean | {"time": None, "words": f"mean over {found.segment}", "highest": "highest"},
        "cards": [
            *document.cards(
                geometry,
                found.places,
                outputs.regions,
                tiles.peak.value,
                measured.loc[outputs.peak_row],
                span=_span(found) + _highest(found, over_trial, time),
            ),
            document.check_card(results.data, results.bag_notes),
        ],
        "bars": document.bars(found.places, outputs.regions),
        "extras": {
            f"{label}: {name}": values
            for label, candidate in results.candidates.items()
            for name, values in model_values(results, candidate.model.model).items()
        },
    }


def _span(found: TrialPressure) -> str:
    """The segment in words, such as `in the hold`."""
    kind = found.segment.kind
    return _SPANS.get(kind, f"in the {kind if kind in NAMED_SEGMENTS else 'segment'}")


def _highest(found: TrialPressure, over_trial: PressureOutputs, time: FloatArray) -> str:
    """The highest pressure of the trial [kPa] and its time, if it is not that of the segment.

    The times since the first sample of the trial are those of the samples of `over_trial` [s].
    """
    title = "peak pressure [kPa]"
    own, highest = (
        number(title, float(read_column(outputs.regions, title).value[-1]))
        for outputs in (found.outputs, over_trial)
    )
    when = time[over_trial.peak_row]
    return "" if own == highest else f"; highest of the trial {highest} at {when:.0f} s"


def section(results: Results) -> Section:
    """The section with the numerical outputs."""
    found = results.pressure
    names = [place.name for place in found.places]
    pressure = with_interval("mean pressure [kPa]", found.outputs.mean_pressure().part(..., 1e-3))
    over_time = pd.DataFrame({"time [s]": found.time} | by_place(names, pressure))
    return Section(
        "pressure",
        "Pressure",
        [
            f"Over {found.segment}. A value is marked uncertain if its 95 % interval reaches"
            f" farther than {100.0 * SHARE:g} % of it; {found.contact}. Shear direction is"
            " measured from proximal about the inward normal. 'socket-testbed pressure' gives the"
            " same numbers, also for other segments and thresholds.",
            *page_tables(found),
            Heading("Estimation"),
            "From the measurements of clusters and load cell, without a fitted model: a Gaussian"
            f" process over the socket's surface ({found.outputs.source}). How many"
            " true values of simulated limbs lie within the intervals is in docs/pressure.md; over"
            " a whole hold they are fewer for areas and time integrals. The mean over the segment"
            " is as uncertain as a single sample: the sensors leave the same uncertainty in each.",
            _overview(results),
        ],
        {
            "pressure.csv": found.regions,
            "pressure_of_regions.csv": over_time,
            "force_map.csv": found.outputs.mean_map.by_tile(results.trial.geometry),
        },
    )


def _overview(results: Results) -> ReportFigure:
    """Unrolled pressure over the segment and at its peak, and regional pressure over time."""
    found = results.pressure
    maps = tile_pressures(found.outputs, found.segment.kind, found.peak_time)
    values = {f"{name} [kPa]": quantity.value for name, quantity in maps.items()}
    return ReportFigure(
        "pressure_map",
        f"Pressure on the unrolled socket, {found.segment}, and at its peak. The greyer, the"
        " less certain. Tiles with a cluster are outlined. Below, the mean pressure of sectors,"
        " heights and user-defined regions, thinned without losing a peak;"
        " pressure_of_regions.csv holds all samples.",
        lambda style: pressure_figure(
            found.trial, found.segment, found.places, found.outputs, "", style
        ),
        pd.DataFrame({"tile": results.trial.geometry.names, **values}),
    )
