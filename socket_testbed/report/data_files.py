"""The data of the figures as CSV: units in the header, empty where there is no value."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.contact import ContactModel
from socket_testbed.evaluation import ChannelErrors, channel_unit, trusted_values
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.report.results import Candidate, Results

_CHUNK = 10_000  # rows; a trial of an hour is not held as text


def write_channels(results: Results, channels: Sequence[int], path: Path) -> None:
    """Write channels over time: measured, and predicted by every model.

    Args:
        results: The results.
        channels: Which of the samples' channels, by index.
        path: File to write.
    """
    measured = trusted_values(results.samples)
    columns: dict[str, FloatArray] = {}
    for i in channels:
        name = results.samples.channels[i]
        unit = channel_unit(name)
        columns[f"{name} measured [{unit}]"] = measured[:, i]
        for candidate in results.candidates:
            columns[f"{name} predicted {candidate.label} [{unit}]"] = candidate.predicted[:, i]
    _write_series(results, columns, path)


def write_overview(results: Results, unusable: Mapping[str, BoolArray], path: Path) -> None:
    """Write the magnitudes of the measured force and moment, and what cannot be used when."""
    wrench = results.samples.wrench
    columns = {
        "force magnitude [N]": np.linalg.norm(wrench[:, 3:], axis=1),
        "moment magnitude [N m]": np.linalg.norm(wrench[:, :3], axis=1),
    }
    columns |= {f"{name} not usable [-]": 1.0 * flags for name, flags in unusable.items()}
    _write_series(results, columns, path)


def write_tiles(geometry: SocketGeometry, columns: Mapping[str, FloatArray], path: Path) -> None:
    """Write values of the tiles, a row a tile.

    Args:
        geometry: The socket.
        columns: Values, shape (n,) each, by their header.
        path: File to write.
    """
    clusters = {tile: name for name, tile in geometry.clusters.items()}
    table = np.column_stack([geometry.anchors, *columns.values()])
    header = ["tile", "cluster", *(f"anchor {axis} in S [m]" for axis in "xyz"), *columns]
    rows = (
        [geometry.names[i], clusters.get(i, ""), *map(_cell, row)]
        for i, row in enumerate(table.tolist())
    )
    _write(path, header, rows)


def write_offsets(channels: Sequence[str], offsets: Mapping[str, FloatArray], path: Path) -> None:
    """Write the constant offsets of the sensors, a row a channel."""
    header = ["channel", "unit", *(f"offset {label} [unit of the row]" for label in offsets)]
    rows = (
        [name, channel_unit(name), *(_cell(float(values[i])) for values in offsets.values())]
        for i, name in enumerate(channels)
    )
    _write(path, header, rows)


def write_errors(candidates: Sequence[Candidate], path: Path) -> None:
    """Write the errors of every model, over the segment and the rest, a row a channel."""
    header = ["model", "samples of", "channel", "unit of RMSE, MAE, sigma", "in objective"]
    header += ["samples [1]", "RMSE", "MAE", "sigma", "skill [-]"]
    rows = (
        [candidate.label, part, *_errors(error)]
        for candidate in candidates
        for part, errors in (("segment", candidate.errors), ("rest", candidate.held_out))
        for error in errors
    )
    _write(path, header, rows)


def write_residuals(candidates: Sequence[Candidate], path: Path) -> None:
    """Write what the residuals have in common, a row a model and channel."""
    header = ["model", "channel", "samples [1]", "lag-1 autocorrelation [-]"]
    header += ["decorrelation time [s]", "effective samples [1]"]
    rows = (
        [
            candidate.label,
            error.name,
            str(common.samples),
            *map(_cell, (common.lag_one, common.decorrelation, common.effective)),
        ]
        for candidate in candidates
        for error, common in zip(candidate.errors, candidate.residuals, strict=True)
    )
    _write(path, header, rows)


def offsets_of(model: ContactModel, clusters: Sequence[str]) -> FloatArray:
    """Constant offsets of the wrench, then of each cluster in its frame, shape (6 + 3c,)."""
    zero = np.zeros(3)
    return np.concatenate([model.wrench_bias, *(model.force_bias.get(c, zero) for c in clusters)])


def _write_series(results: Results, columns: Mapping[str, FloatArray], path: Path) -> None:
    header = ["stamp [ns]", "time [s]", "in segment", *columns]
    _write(path, header, _series(results, [*columns.values()]))


def _series(results: Results, columns: Sequence[FloatArray]) -> Iterator[list[str]]:
    samples, inside = results.samples, results.in_segment
    time = samples.time
    for start in range(0, len(samples), _CHUNK):
        rows = slice(start, start + _CHUNK)
        stamps, flags = samples.stamps[rows].tolist(), inside[rows].tolist()
        values = np.column_stack([time[rows], *(column[rows] for column in columns)]).tolist()
        for stamp, flag, (when, *cells) in zip(stamps, flags, values, strict=True):
            yield [str(stamp), _cell(when), str(int(flag)), *map(_cell, cells)]


def _errors(error: ChannelErrors) -> list[str]:
    figures = (error.rmse, error.mae, error.sigma, error.skill)
    place = [error.name, error.unit, str(int(error.in_objective)), str(error.samples)]
    return [*place, *map(_cell, figures)]


def _write(path: Path, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(header)
        writer.writerows(rows)


def _cell(value: float) -> str:
    return f"{value:.10g}" if math.isfinite(value) else ""
