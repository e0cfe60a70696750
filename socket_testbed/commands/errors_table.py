"""The errors of a model as a table: the paper's six wrench channels, then the clusters'."""

from __future__ import annotations

from collections.abc import Sequence

from socket_testbed.commands.text import number, table
from socket_testbed.evaluation import ChannelErrors, summarise_errors


def errors_table(errors: Sequence[ChannelErrors]) -> str:
    """RMSE, MAE, sigma and skill a channel, with the means and the median the paper quotes."""
    rows = [
        [
            error.name,
            error.unit,
            number(error.rmse),
            number(error.mae),
            number(error.sigma),
            number(error.skill, 2),
            "" if error.in_objective else "not in objective",
        ]
        for error in errors
    ]
    lines = [table(["channel", "unit", "RMSE", "MAE", "sigma", "skill", ""], rows), ""]
    summary = summarise_errors(errors)
    lines.append(
        f"mean moment RMSE {number(summary.moment_rmse)} N m, mean force RMSE"
        f" {number(summary.force_rmse)} N, median local RMSE {number(summary.local_rmse)} N"
    )
    if summary.without_value:
        lines.append(f"without a value, in none of these: {', '.join(summary.without_value)}")
    return "\n".join(lines)
