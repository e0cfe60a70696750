"""`paper`: the published pipeline on a trial, and its figures beside the printed ones."""

from __future__ import annotations

import argparse

from socket_testbed import api
from socket_testbed.commands.options import (
    add_identification,
    add_pose_smoothing,
    add_segment,
    add_stage_one,
    add_thetas,
    add_trial,
    add_unloaded,
    choices,
    trial_of,
)
from socket_testbed.commands.text import Progress, number, table
from socket_testbed.identification.published import PUBLISHED_FRAMES


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trial(parser)
    add_segment(parser)
    add_unloaded(parser)
    add_identification(parser, variant=False)  # both of the paper's
    add_pose_smoothing(parser)
    add_stage_one(parser, str(PUBLISHED_FRAMES))
    add_thetas(parser)
    parser.add_argument("--json", action="store_true", help="print JSON on standard output")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Run the pipeline and print its table."""
    trial = trial_of(options)
    found = api.paper(
        trial, options.segment, thetas=options.thetas, progress=Progress, **choices(options)
    )
    if options.json:
        print(found.to_json())
        return
    settings = found.settings.to_flat()
    print(f"{trial.name}: {found.segment}, {found.samples} samples")
    print(
        f"theta {settings['theta']:g}, weights {settings['weights']}; rest positions within"
        f" {1e3 * settings['rest_position_limit']:g} mm of"
        f" {settings['reference_position'] or 'the mean limb position'}; k0"
        f" {settings['initial_stiffness']:.4g} N/m, alpha {settings['gate_sharpness']:g} 1/m\n"
    )
    figures = found.document()["figures"]
    cells = [
        [
            name,
            *("-" if v is None else v if isinstance(v, str) else number(v) for v in row.values()),
        ]
        for name, row in figures.items()
    ]
    titles = next(iter(figures.values()))
    print(table(["figure", *titles], cells))
