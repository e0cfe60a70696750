"""`pareto`: the wrench against the clusters over theta, for the variants of the paper."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from socket_testbed import api
from socket_testbed.commands.options import (
    add_figure,
    add_identification,
    add_pose_smoothing,
    add_replace,
    add_segment,
    add_stage_one,
    add_thetas,
    add_trial,
    add_unloaded,
    check_figure,
    choices,
    figure_choices,
    trial_of,
)
from socket_testbed.commands.text import Progress, number, table
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import check_outputs
from socket_testbed.identification.pareto import KNEE, SENSOR_ONLY, WRENCH_ONLY, Front

_HEADER = (
    *("variant", "solution", "theta", "wrench error", "local error"),
    *("moment [N m]", "force [N]", "local [N]", ""),
)
_LEGEND = (
    "wrench error, local error: roots of the weighted squares of the objective, J_w and J_f;"
    "\nmoment, force, local: mean, mean and median RMSE of the channels in the objective;"
    "\ndominated: another theta is better in both, which two stages one after the other allow"
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_trial(parser)
    add_segment(parser)
    add_unloaded(parser)
    add_identification(parser, variant=False, theta=False)  # both of the paper's
    add_pose_smoothing(parser)
    add_stage_one(parser)
    add_thetas(parser)
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FRONT.csv", help="table of every solution"
    )
    add_figure(parser, "FRONT", "both fronts drawn")
    parser.add_argument("--json", action="store_true", help="print JSON on standard output")
    add_replace(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Identify along theta, write and print."""
    check_figure(options)
    if options.output is not None and options.output.suffix.lower() != ".csv":
        raise ConfigurationError(f"{options.output}: is not a .csv file", "name a .csv file")
    check_outputs(options.output, options.figure, replace=options.replace)
    trial = trial_of(options)
    found = api.pareto(
        trial, options.segment, thetas=options.thetas, progress=Progress, **choices(options)
    )
    if options.output is not None:
        found.save(options.output)
    if options.figure is not None:
        found.draw(options.figure, **figure_choices(options))
    if options.json:
        print(found.to_json())
        return
    print(f"{trial.name}: {found.segment}, theta from 0 to 1 in {options.thetas} values\n")
    fronts = [*found.fronts.values()]
    print(_solutions_table(fronts))
    print(f"\n{_LEGEND}\n")
    for front in fronts:
        print(_describe(front))
    for path in filter(None, (options.output, options.figure)):
        print(f"written: {path}")


def _solutions_table(fronts: Sequence[Front]) -> str:
    rows = []
    for front in fronts:
        for name in (SENSOR_ONLY, KNEE, WRENCH_ONLY):
            index = front.marks.get(name)
            if index is None:
                rows.append([front.variant, name, *["-"] * 6, _absence(front, name)])
                continue
            errors = (front.wrench_error, front.local_error)
            sizes = (front.moment_rmse, front.force_rmse, front.local_rmse)
            cells = [f"{front.theta[index]:.3g}", *(number(e[index], 4) for e in errors)]
            cells += [number(size[index]) for size in sizes]
            remark = "" if front.non_dominated[index] else "dominated"
            rows.append([front.variant, name, *cells, remark])
    return table(_HEADER, rows)


def _absence(front: Front, name: str) -> str:
    if name == KNEE:
        return "none: see below"
    return front.flaws[0 if name == SENSOR_ONLY else -1]


def _describe(front: Front) -> str:
    """Counts, certificate and flaws of a front, a line each."""
    count = len(front.theta)
    lines = [
        f"{front.variant}: {front.knee.verdict}",
        f"  {int(front.non_dominated.sum())} of {count} solutions not dominated, largest KKT"
        f" residual or gap {front.worst_residual:.1e}",
    ]
    for flaw in dict.fromkeys(filter(None, front.flaws)):
        thetas = front.theta[[text == flaw for text in front.flaws]]
        span = f"{thetas[0]:.3g}" + (f" to {thetas[-1]:.3g}" if len(thetas) > 1 else "")
        lines.append(f"  left out: {len(thetas)} at theta {span}: {flaw}")
    return "\n".join(lines)
