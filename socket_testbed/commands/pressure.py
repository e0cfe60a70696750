"""`pressure` and `map`: pressure and shear as a lab reads them, and the force on every tile."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from socket_testbed import api
from socket_testbed.api import TrialPressure
from socket_testbed.batch import Row
from socket_testbed.commands.arguments import takes
from socket_testbed.commands.options import (
    TrialVerb,
    draw,
    given,
    on_trial,
    on_trials,
    segment_columns,
)
from socket_testbed.commands.terminal import number, table, text_of
from socket_testbed.errors import ConfigurationError
from socket_testbed.geometry.socket import PARTS_OF_SECTORS
from socket_testbed.identification.model_file import finite_or_null
from socket_testbed.identification.pressure import TITLES, interval_end
from socket_testbed.tables import Table
from socket_testbed.trials.trial import Trial

_ABREAST = 3  # outputs in a table
_SHOWN = 8  # tiles of a map


@takes("commands.options.on_trials", "pressure", "commands.options.deliver")
def pressure(
    trial: Path, *, over_time: bool = False, cycles: str | None = None, **options: Any
) -> None:
    """Pressure by region: mean, peak, contact area, time integral, shear, load.

    Args:
        output: Table of the regions; for a folder of trials the folder of such tables.
        over_time: Write a table of every sample instead: regions and tiles over time.
        cycles: Write and draw means and standard deviations over 0 to 100 % of a cycle instead;
            cycles run from each event of a label to the next, such as 'stance', or between two,
            such as 'stance:swing'. Mostly with --segment all.
        figure: Draw unrolled maps, mean and at the peak, and regions over time.
    """
    if over_time and options["output"] is None:
        raise ConfigurationError("--over-time has no output", "name its table with -o FILE.csv")
    verb = TrialVerb("pressure", ".pressure.csv", _compute, _row, _show, ("side",))
    on_trials(verb, trial, over_time=over_time, cycles=cycles, **options)


def _compute(trial: Trial, options: Mapping[str, Any]) -> TrialPressure:
    found = api.pressure(trial, **given(options, api.pressure))
    if options["cycles"] is not None:
        _bring_to_cycles(found, **options)
        return found
    if options["output"] is not None:
        found.save(options["output"], over_time=options["over_time"])
    draw(found, **options)
    return found


def _bring_to_cycles(
    found: TrialPressure, cycles: str, output: Path | None, **options: Any
) -> None:
    """Write all outputs over a cycle, and draw the mean pressure of the regions."""
    table, of = found.over_time(), partial(api.cycles, found.trial, by=cycles)
    every = of(table, segment=found.segment)
    print(f"{every}\n")
    if output is not None:
        every.save(output)
    names = [place.name for place in found.places if place.name not in PARTS_OF_SECTORS]
    shown = [f"{name}.mean pressure [kPa]" for name in names]
    draw(of(table[shown], segment=found.segment), **options)


def _show(found: TrialPressure, options: Mapping[str, Any]) -> None:
    print(f"{found.trial.name}: {found.segment}, {len(found.time)} samples")
    print(f"{found.outputs.source}\n")
    print(pressure_tables(found))
    for path in filter(None, (options["output"], options["figure"])):
        print(f"\nwritten: {path}")


def _row(found: TrialPressure) -> Row:
    return {
        **segment_columns(len(found.time), found.segment),
        "threshold [kPa]": found.threshold,
        **pressure_columns(found),
    }


def pressure_tables(found: TrialPressure) -> str:
    """Outputs of the regions, and of the tiles under a cluster, in tables below each other."""
    document, geometry = found.document(), found.trial.geometry
    measured = {name: geometry.names[tile] for name, tile in geometry.clusters.items()}
    clusters = {f"{tile}, {name}": document["tiles"][tile] for name, tile in measured.items()}
    parts = []
    for label, outputs in (("region", document["regions"]), ("tile under a cluster", clusters)):
        known = [title for title in TITLES if title in next(iter(outputs.values()), ())]
        for start in range(0, len(known), _ABREAST):
            titles = known[start : start + _ABREAST]
            rows = [[name, *(_cell(of[title]) for title in titles)] for name, of in outputs.items()]
            parts.append(table([label, *titles], rows) + "\n")
    limb = [[title, _cell(of)] for title, of in document["limb"].items()]
    return "\n".join(
        [
            *parts,
            table(["limb in the socket", "value"], limb) + "\n",
            "best estimate under the posterior (95 % interval); uncertain: the interval reaches"
            f" farther from the value than {found.share:g} of it\nin contact: above"
            f" {found.threshold:g} kPa; the integrals cover {found.outputs.integrated:.1f} s",
        ]
    )


def _cell(quantity: Mapping[str, Any]) -> str:
    """A value with its interval, and whether it is uncertain; a dash where it is not known."""
    if quantity["value"] is None:
        return "-"
    value, low, high = (number(quantity[part], 1) for part in ("value", "low", "high"))
    return f"{value} ({low} to {high})" + " uncertain" * quantity["uncertain"]


def pressure_columns(found: TrialPressure) -> Row:
    """Outputs of the socket with their intervals, for a summary."""
    socket = found.regions.iloc[-1]
    ends = (interval_end(title, end) for title in TITLES for end in ("low", "high"))
    return {name: finite_or_null(socket[name]) for name in (*TITLES, *ends)}


@takes("force_map", "commands.options.deliver", without="json")
def map(trial: Path, *, output: Path, **options: Any) -> None:
    """Estimate the force on every tile with its uncertainty, without a fit.

    Args:
        output: Table of forces, pressure and shear on every tile with standard deviations.
        figure: Draw the mean pressure and its uncertainty.
    """
    on_trial(trial, {"output": output, **options}, api.force_map, _show_map)


def _show_map(found: api.TrialMap) -> None:
    summary = found.summary()
    highest = summary.head(_SHOWN)
    print(f"{found.trial.name}: {found.segment}, {len(found.time)} samples, {len(summary)} tiles")
    print(f"{found.estimate.source}\n")
    print(text_of(Table("map", "", highest)))
    print(f"\nmeans over the segment, the {len(highest)} highest; sd: standard deviation")
