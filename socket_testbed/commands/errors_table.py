"""The errors of a model as a table: the paper's six wrench channels, then the clusters'."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from socket_testbed.commands.text import number, table
from socket_testbed.evaluation import ChannelErrors


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
    wrench, local = errors[:6], errors[6:]
    lines = [table(["channel", "unit", "RMSE", "MAE", "sigma", "skill", ""], rows), ""]
    lines.append(
        f"mean moment RMSE {_mean(wrench[:3]):.3f} N m, mean force RMSE {_mean(wrench[3:]):.3f} N,"
        f" median local RMSE {_median(local):.3f} N"
    )
    return "\n".join(lines)


def _mean(errors: Sequence[ChannelErrors]) -> float:
    return float(np.mean([error.rmse for error in errors]))


def _median(errors: Sequence[ChannelErrors]) -> float:
    return float(np.median([error.rmse for error in errors])) if errors else float("nan")
