"""`pareto` and `paper`: the published method, its trade-off and its figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from socket_testbed import api
from socket_testbed.commands.arguments import takes
from socket_testbed.commands.options import check_files, draw, given, open_checked
from socket_testbed.commands.text import Progress, number, table
from socket_testbed.errors import ConfigurationError
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


@takes(
    "commands.options.open_given",
    "pareto",
    "fit",
    "commands.options.draw",
    "files.check_outputs",
    without="variant theta",  # both of the paper's, and all
)
def pareto(
    trial: Path,
    *,
    output: Path | None = None,
    figure: Path | None = None,
    json: bool = False,
    replace: bool = False,
    **options: Any,
) -> None:
    """Trace the trade-off of wrench against clusters over theta.

    Args:
        output: Table of every solution (.csv).
        figure: Draw both fronts.
        json: Print JSON on standard output.
    """
    if output is not None and output.suffix.lower() != ".csv":
        raise ConfigurationError(f"{output}: is not a .csv file", "name a .csv file")
    check_files(output, figure, replace=replace)
    opened = open_checked(trial, **options)
    found = api.pareto(opened, **given(options, api.pareto, api.fit), progress=Progress)
    if output is not None:
        found.save(output)
    draw(found, figure, **options)
    if json:
        print(found.to_json())
        return
    print(f"{opened.name}: {found.segment}, theta from 0 to 1 in {options['thetas']} values\n")
    fronts = [*found.fronts.values()]
    print(f"{_solutions(fronts)}\n\n{_LEGEND}\n")
    for front in fronts:
        print(_describe(front))
    for path in filter(None, (output, figure)):
        print(f"written: {path}")


def _solutions(fronts: Sequence[Front]) -> str:
    rows = []
    for front in fronts:
        for name in (SENSOR_ONLY, KNEE, WRENCH_ONLY):
            index = front.marks.get(name)
            if index is None:
                flaw = front.flaws[0 if name == SENSOR_ONLY else -1]
                absence = "none: see below" if name == KNEE else flaw
                rows.append([front.variant, name, *["-"] * 6, absence])
                continue
            errors = (front.wrench_error, front.local_error)
            sizes = (front.moment_rmse, front.force_rmse, front.local_rmse)
            cells = [f"{front.theta[index]:.3g}", *(number(e[index], 4) for e in errors)]
            cells += [number(size[index]) for size in sizes]
            remark = "" if front.non_dominated[index] else "dominated"
            rows.append([front.variant, name, *cells, remark])
    return table(_HEADER, rows)


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


@takes("commands.options.open_given", "paper", "fit", without="variant")
def paper(trial: Path, *, json: bool = False, **options: Any) -> None:
    """Run the published pipeline and lay its figures beside the printed ones.

    Args:
        json: Print JSON on standard output.
    """
    opened = open_checked(trial, **options)
    found = api.paper(opened, **given(options, api.paper, api.fit), progress=Progress)
    if json:
        print(found.to_json())
        return
    settings = found.settings.to_flat()
    print(f"{opened.name}: {found.segment}, {found.samples} samples")
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
