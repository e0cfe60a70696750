"""A survey of simulated limbs: the judged error beside the true one, and the completed map.

Usage:
    python benchmarks/benchmark_survey.py [--seeds 400 ... 405] [--shares 0.1 ...] [--tissues ...]

Every limb is put on five times, by default: with its clusters on the package's places, again on the
same ones, and three times on the tiles farthest from all those taken. Donning, load, gain and
offsets are drawn anew each time. Errors are over the RMS of the true forces on the same tiles.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from socket_testbed.arrays import NORMAL_QUANTILE, FloatArray, IntArray
from socket_testbed.calibration.model import Calibration, read_calibration
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.identification.survey import Donned, Field, JointMap, judge, match_loads, score
from socket_testbed.samples import Status
from socket_testbed.settings.identification import ForceMapSettings
from socket_testbed.settings.options import TissueKind
from socket_testbed.simulation.trial import SimulatedTrial, simulate

_DURATION, _RATE = 60.0, 1.0  # [s], [Hz]; of the hold
LOADED = slice(15, 48)
"""Samples of the hold under load."""
Found = TypeVar("Found")
"""What a benchmark finds of one limb."""


def places(geometry: SocketGeometry, count: int) -> list[list[int]]:
    """Tiles of the clusters in each of `count` trials: the socket's own, then the farthest ones."""
    taken = [*geometry.clusters.values()]
    found = [[*taken]]
    apart = np.linalg.norm(geometry.anchors[:, None] - geometry.anchors, axis=2)
    for _ in range(count - 1):
        new: list[int] = []
        for _ in geometry.clusters:
            new.append(int(apart[:, taken].min(axis=1).argmax()))
            taken.append(new[-1])
        found.append(new)
    return found


def measured_values(
    trial: SimulatedTrial, geometry: SocketGeometry, calibration: Calibration
) -> FloatArray:
    """Wrench and forces on the clusters, shape (N, 6 + 3c) [N m, N]."""
    columns = [trial.wrench]
    for name, capacitance in trial.capacitance.items():
        status = np.where(np.isfinite(capacitance), Status.OK, Status.MISSING).astype(np.uint8)
        stress, judged = calibration.clusters[name].apply(capacitance, status)
        forces = geometry.cluster_force(name, stress)
        forces[judged != Status.OK] = np.nan
        columns.append(forces)
    return np.hstack(columns)


def hold_of(
    geometry: SocketGeometry,
    calibration: Calibration,
    tissue: TissueKind,
    share: float,
    seed: int,
    donning: int,
) -> SimulatedTrial:
    """A hold of a limb that is put on.

    Args:
        geometry: The socket with the clusters in their places.
        calibration: The clusters' calibration.
        tissue: The limb's tissue.
        share: How much a donning differs [-].
        seed: Seed of the limb.
        donning: Seed of the donning.
    """
    return simulate(
        geometry, calibration, "static_hold", _DURATION, _RATE, seed,
        tissue=tissue, donning=donning, donning_share=share,
    )  # fmt: skip


def relative(field: Field, truth: FloatArray, tiles: IntArray) -> float:
    """RMS error of a map on some tiles over the RMS of the true forces there [-]."""
    squares = ((field.forces - truth)[:, tiles] ** 2).sum(), (truth[:, tiles] ** 2).sum()
    return float(np.sqrt(squares[0] / squares[1]))


@dataclass(frozen=True)
class Surveyed:
    """Figures of one limb, all relative to the RMS of the forces [-]."""

    true: float
    judged: float
    raw: float
    holds: bool
    coverage: float
    repeated: float
    change: float
    completed: tuple[float, ...]
    limb: float
    stated: float
    within: float


def survey_limb(
    geometry: SocketGeometry, calibration: Calibration, tissue: TissueKind, share: float, seed: int
) -> Surveyed:
    """Survey one simulated limb.

    Args:
        geometry: The socket.
        calibration: The clusters' calibration.
        tissue: The limb's tissue.
        share: How much a donning differs [-].
        seed: Seed of the limb.
    """
    sets = places(geometry, 4)
    sets = [sets[0], sets[0], *sets[1:]]
    measured, truths = [], []
    for number, tiles in enumerate(sets):
        placed = replace(geometry, clusters=dict(zip(geometry.clusters, tiles, strict=True)))
        trial = hold_of(placed, calibration, tissue, share, seed, number + 1)
        measured.append(measured_values(trial, placed, calibration)[LOADED])
        forces = trial.truth.forces[LOADED]
        truths.append(np.einsum("nij,kni->knj", geometry.rotations, forces))
    settings = ForceMapSettings()
    rows, _ = match_loads([values[:, :6] for values in measured], settings.arm)
    donned = [
        Donned(tuple(tiles), values[some])
        for tiles, values, some in zip(sets, measured, rows, strict=True)
    ]
    truth = [each[some] for each, some in zip(truths, rows, strict=True)]
    every = np.arange(len(geometry))
    bare = np.setdiff1d(every, np.concatenate(sets))

    singles = [JointMap(geometry, [each], settings) for each in donned]
    joint = JointMap(geometry, donned, settings)
    judged = judge(geometry, donned, joint, singles)
    squares = np.zeros(2)
    for single, tiles, forces in zip(singles, sets, truth, strict=True):
        free = np.setdiff1d(every, tiles)
        error = (single.field(0).forces - forces)[:, free]
        squares += (error**2).sum(), (forces[:, free] ** 2).sum()
    true = float(np.sqrt(squares[0] / squares[1]))

    moved = [donned[0], *donned[2:]]
    two, four = (JointMap(geometry, moved[:count], settings) for count in (2, 4))
    completed = [each.field(0) for each in (singles[0], two, four, joint)]
    off = np.abs(completed[-1].forces - truth[0])[:, bare]
    found = score(judged.points)
    return Surveyed(
        true=true,
        judged=judged.error.value,
        raw=found.error,
        holds=bool(judged.error.low <= true <= judged.error.high),
        coverage=found.coverage[-1],
        repeated=judged.repeated,
        change=joint.change,
        completed=tuple(relative(each, truth[0], bare) for each in completed),
        limb=relative(joint.field(), truth[0], bare),
        stated=judged.completed.value,
        within=float(np.mean(off <= NORMAL_QUANTILE * completed[-1].deviations[:, bare])),
    )


def print_rows(
    description: str,
    header: str,
    seeds: Sequence[int],
    shares: Sequence[float],
    judge_limb: Callable[[SocketGeometry, Calibration, TissueKind, float, int], Found],
    row_of: Callable[[Sequence[Found]], str],
) -> None:
    """Judge limbs as the command line says, and print a row for each tissue and donning.

    Args:
        description: What the benchmark does, for its help and its first lines.
        header: Titles of the columns.
        seeds: The limbs, if no others are asked for.
        shares: How much donnings differ, if nothing else is asked for [-].
        judge_limb: Judges one limb: of a socket, calibration, tissue, share and seed.
        row_of: The row of several limbs.
    """
    parser = argparse.ArgumentParser(description=description.partition("\n")[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[*seeds], help="limbs")
    parser.add_argument("--shares", type=float, nargs="+", default=[*shares], help="of donning [-]")
    parser.add_argument("--tissues", nargs="+", default=["soft", "stiff"], help="soft, stiff")
    options = parser.parse_args()
    geometry = read_socket(packaged("config", "socket.yaml"))
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    print(description)
    print(header)
    for tissue in options.tissues:
        for share in options.shares:
            with threadpool_limits(1):
                found = [
                    judge_limb(geometry, calibration, tissue, share, seed) for seed in options.seeds
                ]
            print(f"{tissue:<6} {100 * share:3.0f} %   | {row_of(found)}", flush=True)


def main() -> None:
    """Survey the limbs and print a row for each tissue and donning."""
    header = (
        "tissue donning | true, judged: mean, judged/true by limb; interval holds; before"
        " correction; 95 % hold | repeats, change | own, completed by 2, 4, 4 + a repeat; limb;"
        " stated; 95 % hold"
    )
    shares = (0.0, 0.1, 0.2, 0.4)
    print_rows(__doc__ or "", header, range(400, 406), shares, survey_limb, _row)


def _row(found: Sequence[Surveyed]) -> str:
    def mean(name: str) -> float:
        return float(np.mean([getattr(each, name) for each in found]))

    ratios = [each.judged / each.true for each in found]
    completed = ", ".join(
        f"{value:.3f}" for value in np.mean([each.completed for each in found], axis=0)
    )
    return (
        f"{mean('true'):.3f}, {mean('judged'):.3f}: {mean('judged') / mean('true'):.2f},"
        f" {min(ratios):.2f} to {max(ratios):.2f}; {100 * mean('holds'):.0f} %;"
        f" {mean('raw'):.3f}; {100 * mean('coverage'):.0f} % |"
        f" {mean('repeated'):.2f}, {mean('change'):.2f} | {completed}; {mean('limb'):.3f};"
        f" {mean('stated'):.3f}; {100 * mean('within'):.0f} %"
    )


if __name__ == "__main__":
    main()
