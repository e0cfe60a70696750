"""Pressure in the report: pictures, outputs of the regions, maps, and regions over time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from socket_testbed.figures.pressure import pressure_figure, tile_pressures
from socket_testbed.identification.pressure import (
    SHARE,
    with_interval,
)
from socket_testbed.pages import document
from socket_testbed.report.models import model_values
from socket_testbed.report.page import Heading, Pictures, ReportFigure, Section
from socket_testbed.results.pressure import TrialPressure, by_place
from socket_testbed.results.pressure_text import number, page_tables
from socket_testbed.results.report import Results
from socket_testbed.results.stresses import TrialCourse

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
    found, course, geometry = results.pressure, results.course, results.trial.geometry
    outputs, side = found.outputs, results.metadata.side
    (mean,) = document.moments(found.mean, geometry)
    moments = document.moments(course.stresses, geometry)
    at_peak = moments[int(np.abs(course.stresses.time - found.peak_time).argmin())]
    at_peak["words"] = f"at {found.peak_time:.2f} s, the peak {_span(found)}"
    return document.trial_document(geometry, side, results.events, course) | {
        "start": found.peak_time,
        "moments": moments,
        "mean": mean | {"time": None, "words": f"mean over {found.segment}", "highest": "highest"},
        "cards": [
            *document.cards(
                geometry,
                found.places,
                outputs.regions,
                outputs.tiles.peak.value,
                found.peak.measured[0],
                span=_span(found) + _highest(found, course),
            ),
            document.check_card(results.checked.findings, results.bag_notes),
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
    segment = found.segment
    return _SPANS.get(segment.kind, f"in the {segment.noun}")


def _highest(found: TrialPressure, course: TrialCourse) -> str:
    """The highest pressure of the trial [kPa] and its time, if it is not that of the segment."""
    own, highest = (
        number("peak pressure [kPa]", 1e-3 * pressure)
        for pressure in (float(found.outputs.regions.peak.value[-1]), course.highest)
    )
    when = course.highest_time
    return "" if own == highest else f"; highest of the trial {highest} at {when:.0f} s"


def section(results: Results) -> Section:
    """The section with the numerical outputs."""
    found = results.pressure
    names = [place.name for place in found.places]
    pressure = with_interval("mean pressure [kPa]", found.outputs.mean_pressure.part(..., 1e-3))
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
    maps = tile_pressures(found.outputs, found.segment, found.peak_time)
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
