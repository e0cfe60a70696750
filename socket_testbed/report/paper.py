"""What the paper reports of its static hold, to be read beside a trial's own figures."""

from __future__ import annotations

from dataclasses import dataclass

from socket_testbed.evaluation import ChannelErrors, summarise_errors


@dataclass(frozen=True)
class PaperFigure:
    """A figure that the paper quotes for both variants.

    Attributes:
        name: What it is.
        unit: Its unit.
        without_bias: The paper's value for the variant `stiffness`.
        with_bias: The paper's value for the variant `stiffness_bias`.
    """

    name: str
    unit: str
    without_bias: float
    with_bias: float


PAPER_FIGURES = (
    PaperFigure("mean moment RMSE", "N m", 1.69, 0.44),
    PaperFigure("median local RMSE", "N", 90.07, 3.76),
    PaperFigure("RMSE of Mx", "N m", 3.99, 0.95),
)


def same_figures(errors: tuple[ChannelErrors, ...]) -> tuple[float, ...]:
    """A trial's own values of `PAPER_FIGURES`, in their order and units.

    Args:
        errors: Errors of every channel.
    """
    summary = summarise_errors(errors)
    return summary.moment_rmse, summary.local_rmse, errors[0].rmse
