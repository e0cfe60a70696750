"""The moments of Stage 2 at one set of rest positions after another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.identification.gate_series import GateSeries, series_is_cheaper
from socket_testbed.identification.moments import Moments
from socket_testbed.identification.objective import Objective
from socket_testbed.identification.stages import StageTwoMoments, stage_two_moments
from socket_testbed.settings import IdentificationSettings


@dataclass(frozen=True)
class _Group:
    """Channels of the clusters that were measured in the same samples."""

    series: GateSeries
    channels: list[int]
    points: list[int]


class SharedMoments:
    """Moments of one objective for any rest positions: by series where that is cheaper.

    Args:
        objective: The samples.
        settings: Settings of the identification.
        points: Number n of points of interest.
    """

    def __init__(self, objective: Objective, settings: IdentificationSettings, points: int) -> None:
        self._objective = objective
        self._settings = settings
        self._wrench: GateSeries | None = None
        position, sharpness = objective.position, settings.gate_sharpness
        if series_is_cheaper(position, sharpness, points):
            self._wrench = GateSeries(position, sharpness, objective.wrench)
            self._groups = _group_channels(objective, sharpness)

    def at(self, rest_positions: FloatArray) -> StageTwoMoments:
        """Moments at rest positions q_r, shape (n, 3) [m]."""
        if self._wrench is None:
            return stage_two_moments(self._objective, self._settings, rest_positions)
        channels: dict[int, Moments] = {}
        for group in self._groups:
            moments = group.series.moments(rest_positions[group.points])
            for column, number in enumerate(group.channels):
                point = group.points.index(self._objective.channels[number].point)
                channels[number] = _one_channel(moments, point, column)
        in_order = tuple(channels[number] for number in sorted(channels))
        return StageTwoMoments(self._wrench.moments(rest_positions), in_order)


def _group_channels(objective: Objective, sharpness: float) -> list[_Group]:
    by_rows: dict[bytes, list[int]] = {}
    for number, channel in enumerate(objective.channels):
        by_rows.setdefault(channel.rows.tobytes(), []).append(number)
    groups = []
    for numbers in by_rows.values():
        channels = [objective.channels[number] for number in numbers]
        forces = np.stack([channel.force for channel in channels], axis=1)
        series = GateSeries(objective.position[channels[0].rows], sharpness, forces)
        groups.append(_Group(series, numbers, sorted({channel.point for channel in channels})))
    return groups


def _one_channel(moments: Moments, point: int, column: int) -> Moments:
    """The moments of one point and one target among several."""
    block, target = slice(3 * point, 3 * point + 3), slice(column, column + 1)
    return Moments(
        count=moments.count,
        mean=moments.mean[block],
        gram=moments.gram[block, block],
        target_mean=moments.target_mean[target],
        cross=moments.cross[block, target],
        target_power=moments.target_power[target],
    )
