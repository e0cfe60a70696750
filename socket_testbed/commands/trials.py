"""`simulate`, `info`, `annotate` and `export`: simulate, inspect, describe and export trials."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

from socket_testbed import api
from socket_testbed.commands import calls
from socket_testbed.commands.calls import takes
from socket_testbed.commands.running import (
    check_metadata,
    open_checked,
    open_given,
    print_note,
    report_data,
)
from socket_testbed.commands.terminal import Progress, decimals, table, text_of
from socket_testbed.files import CONFIGURATION_FILES, check_outputs, check_suffix
from socket_testbed.settings.options import (
    ExportOptions,
    MetadataOptions,
    SimulationOptions,
    given,
)
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.description import describe_samples, drop_outs, loads_table, noise_table
from socket_testbed.trials.export import EXPORT_FORMATS
from socket_testbed.trials.metadata import NO_SIDE, TrialMetadata
from socket_testbed.trials.tares import tares_in_words
from socket_testbed.trials.trial import Trial
from socket_testbed.trials.truth import TRUTH_FILE, read_truth

_MAX_TIMES = 8  # printed per event label


@takes(calls.Simulate)
def simulate(call: calls.Simulate) -> None:
    """Write a simulated trial with its ground truth."""
    trial = api.simulate(call.output, **given(call, SimulationOptions), progress=Progress)
    geometry = trial.geometry
    donned = ""
    if call.donning is not None:
        donned = f", donning {call.donning} (differs by {100 * call.donning_share:g} %)"
    print(
        f"{call.output}: {call.scenario}, {call.tissue} tissue,"
        f" {len(read_truth(trial.path).wrench)} triggers at {call.rate:g} Hz,"
        f" {len(geometry)} tiles, {len(geometry.clusters)} clusters,"
        f" seed {call.seed}{donned}; truth in {call.output / TRUTH_FILE}"
    )


@takes(calls.Annotate)
def annotate(call: calls.Annotate) -> None:
    """Set and show a trial's metadata: subject code, side, socket, liner and more."""
    check_metadata(call)
    for path in call.trial:
        opened = api.open_trial(path, notify=print_note)
        metadata = api.annotate(opened, **given(call, MetadataOptions), remove=call.remove)
        if len(call.trial) > 1:
            print(f"{path}:")
        print(_metadata(metadata))


def _metadata(metadata: TrialMetadata) -> str:
    """The stated metadata of a trial."""
    rows = [[name, text] for name, text in metadata.described().items()]
    found = table(["metadata", "value"], rows) if rows else "no metadata: 'annotate' states them"
    if metadata.side is None:
        found += f"\n{NO_SIDE}"
    return found


@takes(calls.Export)
def export(call: calls.Export) -> None:
    """Write a trial's samples as CSV, Parquet or MAT, or for OpenSim and C3D."""
    check_suffix(call.output, EXPORT_FORMATS, "trial's export")
    check_outputs(call.output, replace=call.replace)
    opened = open_checked(call.trial, call)
    chosen = given(call, ExportOptions)
    written = api.export(opened, call.output, force_map=call.map, **chosen)
    segment, rows = written.attrs["segment"], written.attrs["rows"]
    print(f"{opened.name}: {segment}, {rows}, {len(written.columns)} columns in {call.output}")
    for note in written.attrs["notes"]:
        print(f"note: {note}")


@takes(calls.Info)
def info(call: calls.Info) -> None:
    """Show the contents of a trial: topics, rates, gaps, plateau."""
    notify = cache(lambda note: print(f"note: {note}"))  # part of the output
    opened = dataclasses.replace(open_given(call.trial, call), notify=notify)
    with opened.kept_open() as bag:
        print(f"{_topics(opened.path, bag)}\n")
        report_data(opened)
        samples, metadata, estimator = opened.samples(), opened.metadata, opened.estimator
        checked = opened.checked()
        tables = [drop_outs(samples), noise_table(samples.clusters, checked.noise)]
        if plateaus := opened.plateaus(estimator):
            tables.append(loads_table(checked.samples, plateaus))
        print(describe_samples(samples))
        for shown in tables:
            print(f"\n{shown.caption}\n\n{text_of(shown)}")
        print(f"\n{_events(opened)}")
        print(f"\n{_metadata(metadata)}\n")
        stored = [name for name in CONFIGURATION_FILES if (call.trial / name).is_file()]
        print(f"recorded with: {', '.join(stored) or 'nothing stored'}")
        geometry = opened.geometry
        print(f"socket: {geometry.source or 'not stated'}; {len(geometry)} tiles")
        print(f"registration: {geometry.bodies}")
        print(f"calibration: {opened.calibration.origin}")
        print("\n".join(tares_in_words(opened.tares, int(samples.stamps[0]))))


def _topics(path: Path, bag: BagReader) -> str:
    duration = bag.duration
    rows = [
        [
            name,
            bag.types[name],
            str(n),
            decimals(max(n - 1, 0) / duration if duration else 0.0, 2),
        ]
        for name, n in sorted(bag.counts.items())
    ]
    heading = f"{path}: {sum(bag.counts.values())} messages in {duration:.2f} s"
    return f"{heading}\n{table(['topic', 'type', 'messages', 'Hz'], rows)}"


def _events(trial: Trial) -> str:
    """Times of the events by label, cut after the first few."""
    times: dict[tuple[str, str], list[str]] = {}
    for event in trial.events():
        times.setdefault((event.label, event.source), []).append(f"{event.time:.2f}")
    lines = []
    for (label, source), at in times.items():
        more = f" ... ({len(at)} times)" if len(at) > _MAX_TIMES else ""
        lines.append(f"event {label} ({source}): {', '.join(at[:_MAX_TIMES])} s{more}")
    return "\n".join(lines) or "no events"
