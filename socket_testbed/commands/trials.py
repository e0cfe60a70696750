"""`simulate`, `info`, `annotate` and `export`: simulate, inspect, describe and export trials."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any

from socket_testbed import api
from socket_testbed.commands.arguments import takes
from socket_testbed.commands.options import (
    check_metadata,
    given,
    open_checked,
    open_given,
    print_note,
    report_data,
)
from socket_testbed.commands.terminal import Progress, decimals, table, text_of
from socket_testbed.files import CONFIGURATION_FILES, check_outputs
from socket_testbed.trials.description import describe_samples, drop_outs, loads_table, noise_table
from socket_testbed.trials.metadata import NO_SIDE, TrialMetadata
from socket_testbed.trials.tares import read_tares, tares_in_words
from socket_testbed.trials.trial import Trial
from socket_testbed.trials.truth import TRUTH_FILE, read_truth

_MAX_TIMES = 8  # printed per event label


@takes("simulate")
def simulate(*, output: Path, **options: Any) -> None:
    """Write a simulated trial with its ground truth.

    Args:
        output: As `path` in `simulate`.
    """
    trial = api.simulate(output, **options, progress=Progress)
    geometry = trial.geometry
    print(
        f"{output}: {options['scenario']}, {options['tissue']} tissue,"
        f" {len(read_truth(trial.path).wrench)} triggers at {options['rate']:g} Hz,"
        f" {len(geometry)} tiles, {len(geometry.clusters)} clusters,"
        f" seed {options['seed']}; truth in {output / TRUTH_FILE}"
    )


@takes("annotate")
def annotate(trial: list[Path], **options: Any) -> None:
    """Set and show a trial's metadata: subject code, side, socket, liner and more.

    Args:
        trial: Folders of one or more trials.
    """
    check_metadata(options)
    for path in trial:
        metadata = api.annotate(api.open_trial(path, notify=print_note), **options)
        if len(trial) > 1:
            print(f"{path}:")
        print(_metadata(metadata))


def _metadata(metadata: TrialMetadata) -> str:
    """The stated metadata of a trial."""
    rows = [[name, text] for name, text in metadata.described().items()]
    found = table(["metadata", "value"], rows) if rows else "no metadata: 'annotate' states them"
    if metadata.side is None:
        found += f"\n{NO_SIDE}"
    return found


@takes("commands.options.open_given", "export", "files.check_outputs", without="path force_map")
def export(
    trial: Path, *, output: Path, map: bool = False, replace: bool = False, **options: Any
) -> None:
    """Write a trial's samples as CSV, Parquet or MAT, or for OpenSim and C3D.

    Args:
        output: As `path` in `export`.
        map: As `force_map` in `export`.
    """
    check_outputs(output, replace=replace)
    opened = open_checked(trial, **options)
    written = api.export(opened, output, force_map=map, **given(options, api.export))
    segment, rows = written.attrs["segment"], written.attrs["rows"]
    print(f"{opened.name}: {segment}, {rows}, {len(written.columns)} columns in {output}")
    for note in written.attrs["notes"]:
        print(f"note: {note}")


@takes("commands.options.open_given", without="unloaded")
def info(trial: Path, **options: Any) -> None:
    """Show the contents of a trial: topics, rates, gaps, plateau."""
    notify = cache(lambda note: print(f"note: {note}"))  # part of the output
    opened = dataclasses.replace(open_given(trial, **options), notify=notify)
    print(f"{_topics(opened)}\n")
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
    stored = [name for name in CONFIGURATION_FILES if (trial / name).is_file()]
    print(f"recorded with: {', '.join(stored) or 'nothing stored'}")
    geometry = opened.geometry
    print(f"socket: {geometry.source or 'not stated'}; {len(geometry)} tiles")
    print(f"registration: {geometry.bodies}")
    print(f"calibration: {opened.calibration.origin}")
    with opened.open() as bag:
        tares = read_tares(bag)
    print("\n".join(tares_in_words(tares, int(samples.stamps[0]))))


def _topics(trial: Trial) -> str:
    with trial.open() as bag:
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
        heading = f"{trial.path}: {sum(bag.counts.values())} messages in {duration:.2f} s"
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
