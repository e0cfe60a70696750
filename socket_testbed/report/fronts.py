"""Trade-off between wrench and clusters: Pareto fronts of the paper's variants."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd

from socket_testbed.figures.fronts import (
    LOCAL_LABEL,
    WRENCH_LABEL,
    describe_front,
    kept_solutions,
    pareto_figure,
)
from socket_testbed.figures.style import PAGE_LINES
from socket_testbed.identification.pareto import (
    FIGURES,
    KNEE,
    SENSOR_ONLY,
    WRENCH_ONLY,
    Front,
    front_table,
)
from socket_testbed.pages.document import numbers
from socket_testbed.report.page import ReportFigure, Section
from socket_testbed.results.report import Results
from socket_testbed.tables import Table


def section(results: Results) -> Section:
    """The section on the fronts, or the reason for their absence."""
    if not results.fronts:
        return Section("fronts", "Pareto fronts", [f"None: {results.no_fronts}."])
    fronts, lines = [*results.fronts.values()], {}
    for front, style in zip(fronts, PAGE_LINES[1:], strict=False):
        kept, errors = kept_solutions(front)
        x, y = numbers(errors[:, kept], 6)
        lines[describe_front(front)] = {"x": x, "y": y, "style": style}
    figure = ReportFigure(
        "pareto",
        "Normalised error of the clusters against that of the wrench, for theta from 0 to 1. Errors"
        " are the square roots of the terms of the objective; predicting zero gives 1. Dominated"
        " solutions are faint.",
        lambda style: pareto_figure(fronts, results.title("Trade-off"), style),
        front_table(fronts),
        {
            "dots": True,
            "log": True,
            "over": WRENCH_LABEL,
            "panels": [{"title": LOCAL_LABEL, "lines": lines}],
        },
    )
    verdicts = [f"{front.variant}: {front.knee.verdict}." for front in fronts]
    return Section("fronts", "Pareto fronts", [verdicts, figure, marks_table(fronts)])


def marks_table(fronts: Iterable[Front]) -> Table:
    """The marked solutions of each front, three rows each: sensor-only, knee and wrench-only.

    The table is indexed by `variant`. Its columns are `solution`, `theta [-]`, both normalised
    errors [-], the paper's mean and median RMSE [N m, N], and a `remark`. Numbers are NaN where a
    front has no such solution; the remark then says why, otherwise whether it is dominated.
    """
    columns = [*FIGURES.values()][:-1]  # without the residual
    rows = []
    for front in fronts:
        table = front.to_dataframe()
        for name in (SENSOR_ONLY, KNEE, WRENCH_ONLY):
            row: dict[str, Any] = {"variant": front.variant, "solution": name}
            index = front.marks.get(name)
            if index is None:
                flaw = front.flaws[0 if name == SENSOR_ONLY else -1]
                row |= dict.fromkeys(columns, np.nan) | {"remark": "none" if name == KNEE else flaw}
            else:
                remark = "" if front.non_dominated[index] else "dominated"
                row |= table.loc[index, columns].to_dict() | {"remark": remark}
            rows.append(row)
    formats = {"theta [-]": ".3g", "wrench error [-]": ".4f", "local error [-]": ".4f"}
    caption = "The marked solutions of each front, with RMSE of the channels in the objective"
    return Table("marks", caption, pd.DataFrame(rows).set_index("variant"), formats)
