"""`info`: what a trial holds."""

from __future__ import annotations

import argparse
import dataclasses

import numpy as np

from socket_testbed.commands.options import add_trial, trial_of
from socket_testbed.commands.text import metadata_table, number, table
from socket_testbed.identification.noise import channel_noise, noise_groups
from socket_testbed.samples import Samples, Status
from socket_testbed.trials.segment import find_plateaus
from socket_testbed.trials.trial import CONFIGURATION_FILES, Trial

_NAMED = 8  # times of the events of a label that are printed


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trial(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Print topics, rates, gaps, missing data, noise, plateaus, events and configuration."""
    notes: dict[str, None] = {}  # part of the output, each once
    trial = dataclasses.replace(trial_of(options), notify=lambda note: notes.update({note: None}))
    print(_topics(trial))
    shown = len(notes)
    samples, metadata = trial.samples(), trial.metadata
    print()
    for note in list(notes)[shown:]:
        print(f"note: {note}")
    print(_triggers(samples))
    print()
    print(_missing(samples))
    print()
    print(_noise(samples))
    print()
    for segment in find_plateaus(samples, trial.estimator.plateau):
        mean = np.nanmean(samples[segment.rows].wrench[:, 3:], axis=0)
        print(f"{segment}: mean force {np.linalg.norm(mean):.1f} N")
    print(_events(trial))
    print(f"\n{metadata_table(metadata)}\n")
    stored = [name for name in CONFIGURATION_FILES if (trial.path / name).is_file()]
    print(f"recorded with: {', '.join(stored) or 'nothing stored'}")
    geometry = trial.geometry
    print(f"socket: {geometry.source or 'no source'}; {len(geometry)} tiles")
    print(f"marker bodies: {geometry.registration or 'nominal, not registered'}")
    print(f"calibration: {trial.calibration.source} ({trial.calibration.date})")


def _topics(trial: Trial) -> str:
    with trial.open() as bag:
        duration = bag.duration
        rows = [
            [name, bag.types[name], str(count), number(count / duration if duration else 0.0, 2)]
            for name, count in sorted(bag.counts.items())
        ]
        lines = [f"{trial.path}: {sum(bag.counts.values())} messages in {duration:.2f} s"]
        lines += [f"note: {note}" for note in bag.notes]
    return "\n".join([*lines, table(["topic", "type", "messages", "Hz"], rows)])


def _triggers(samples: Samples) -> str:
    periods = np.diff(samples.time)
    if len(periods) == 0:
        return "1 sample"
    usual = float(np.median(periods))
    gaps = periods > 1.5 * usual
    return (
        f"{len(samples)} samples at {1.0 / usual:.2f} Hz, {int(samples.complete.sum())} complete;"
        f" {int(gaps.sum())} gaps, the largest {float(periods.max()):.3f} s"
    )


def _missing(samples: Samples) -> str:
    rows = [
        ["wrench", str(int(np.isnan(samples.wrench).any(axis=1).sum())), "", ""],
        ["limb position", str(int(np.isnan(samples.position).any(axis=1).sum())), "", ""],
    ]
    for column, cluster in enumerate(samples.clusters):
        status = samples.status[:, column]
        rows.append(
            [
                cluster,
                *(
                    str(int((status == state).sum()))
                    for state in (Status.MISSING, Status.SATURATED, Status.OUT_OF_RANGE)
                ),
            ]
        )
    return table(["measurement", "missing", "saturated", "out of range"], rows)


def _events(trial: Trial) -> str:
    """The times of the events by their labels, the first ones where there are many."""
    times: dict[tuple[str, str], list[str]] = {}
    for event in trial.events():
        times.setdefault((event.label, event.source), []).append(f"{event.time:.2f}")
    lines = []
    for (label, source), at in times.items():
        more = f" ... ({len(at)} times)" if len(at) > _NAMED else ""
        lines.append(f"event {label} ({source}): {', '.join(at[:_NAMED])} s{more}")
    return "\n".join(lines) or "no events"


def _noise(samples: Samples) -> str:
    groups = noise_groups(channel_noise(samples), samples.clusters)
    rows = [[name, *(number(value, 4) for value in noise)] for name, noise in groups.items()]
    return table(["noise of one sample", "x", "y", "z"], rows)
