"""A survey as the prior of a limb's next trial: the map's error with it and without it.

Usage:
    python benchmarks/benchmark_survey_prior.py [--seeds 600 ... 605] [--shares 0.1 0.4] [--tissues
    ...]

Every limb is put on five times, each time with its clusters on other tiles. The next trial is the
fifth; its prior is a survey of the first two, or of the first four, and, to show that it gives way,
a survey of another limb of the same tissue. Donning, load, gain and offsets are drawn anew each
time. Errors are over the RMS of the true forces, on the tiles that no trial measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from benchmark_survey import LOADED, hold_of, measured_values, places, print_rows

from socket_testbed.arrays import NORMAL_QUANTILE, FloatArray, IntArray
from socket_testbed.calibration.model import Calibration
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.identification.survey import Donned, JointMap, match_loads
from socket_testbed.identification.survey_prior import SurveyPrior, learnt
from socket_testbed.samples import Samples, Status
from socket_testbed.settings.identification import ForceMapSettings
from socket_testbed.settings.options import TissueKind

SETTINGS = ForceMapSettings()
STRANGER = 1000  # added to the seed of a limb gives that of another one
SIZES = (2, 4)  # trials of a survey


@dataclass(frozen=True)
class Trial:
    """What a donning measured under load, and the true forces.

    Attributes:
        geometry: The socket with the clusters in their places.
        tiles: The tile under each of c clusters.
        values: The wrench and the forces on the clusters, shape (N, 6 + 3c) [N m, N].
        forces: True forces on the tiles in {S}, shape (N, n, 3) [N].
    """

    geometry: SocketGeometry
    tiles: tuple[int, ...]
    values: FloatArray
    forces: FloatArray

    @property
    def samples(self) -> Samples:
        """Its samples."""
        count, clusters = len(self.values), tuple(self.geometry.clusters)
        nothing = np.full((count, 3), np.nan)
        local = self.values[:, 6:].reshape(count, len(clusters), 3)
        status = np.where(np.isfinite(local).all(axis=2), Status.OK, Status.MISSING)
        return Samples(
            np.arange(count) * 10**9, nothing, nothing, self.values[:, :6], clusters, local,
            status.astype(np.uint8),
        )  # fmt: skip


def put_on(
    geometry: SocketGeometry,
    calibration: Calibration,
    tissue: TissueKind,
    share: float,
    seed: int,
    sets: Sequence[Sequence[int]],
) -> list[Trial]:
    """Put a limb on once for each set of tiles, with its clusters on them."""
    found = []
    for number, tiles in enumerate(sets):
        placed = replace(geometry, clusters=dict(zip(geometry.clusters, tiles, strict=True)))
        trial = hold_of(placed, calibration, tissue, share, seed, number + 1)
        values = measured_values(trial, placed, calibration)[LOADED]
        found.append(Trial(placed, tuple(tiles), values, trial.truth.forces[LOADED]))
    return found


def learnt_from(geometry: SocketGeometry, trials: Sequence[Trial]) -> SurveyPrior:
    """What a survey of some trials teaches."""
    rows, _ = match_loads([each.values[:, :6] for each in trials], SETTINGS.arm)
    donned = [
        Donned(each.tiles, each.values[some]) for each, some in zip(trials, rows, strict=True)
    ]
    joint = JointMap(geometry, donned, SETTINGS)
    names = [
        (str(number), f"trial {number}", tuple(each.geometry.clusters))
        for number, each in enumerate(trials)
    ]
    return learnt(joint, geometry, names, donned)


@dataclass(frozen=True)
class Judged:
    """A map of the next trial.

    Attributes:
        error: RMS error over the RMS of the true forces, on the judged tiles [-].
        within: Share of the forces within their 95 % intervals [-].
        share: Probability of the survey's prior [-].
    """

    error: float
    within: float
    share: float


def judge(trial: Trial, prior: SurveyPrior | None, tiles: IntArray) -> Judged:
    """Map the next trial with a prior, and judge it on some tiles."""
    samples = trial.samples
    geometry, clusters = trial.geometry, samples.clusters
    surveyed = None if prior is None else prior.expected(geometry, clusters)
    mapped = ForceMap(geometry, clusters, SETTINGS, samples, surveyed)
    found = mapped.estimate(samples)
    off, truth = (found.forces - trial.forces)[:, tiles], trial.forces[:, tiles]
    reach = NORMAL_QUANTILE * found.standard_deviations[:, tiles]
    return Judged(
        error=float(np.sqrt((off**2).sum() / (truth**2).sum())),
        within=float(np.mean(np.abs(off) <= reach)),
        share=mapped.survey_probability(samples),
    )


def judge_limb(
    geometry: SocketGeometry, calibration: Calibration, tissue: TissueKind, share: float, seed: int
) -> list[Judged]:
    """Judge the next trial of a limb: without a prior, with surveys, with another limb's survey."""
    sets = places(geometry, max(SIZES) + 1)
    trials = put_on(geometry, calibration, tissue, share, seed, sets)
    strangers = put_on(geometry, calibration, tissue, share, seed + STRANGER, sets[: max(SIZES)])
    tiles = np.setdiff1d(np.arange(len(geometry)), np.concatenate(sets))
    priors = [learnt_from(geometry, trials[:count]) for count in SIZES]
    priors.append(learnt_from(geometry, strangers))
    return [judge(trials[-1], prior, tiles) for prior in (None, *priors)]


def main() -> None:
    """Judge the limbs and print a row for each tissue and donning."""
    header = (
        "tissue donning | error without, with a survey of 2, of 4, of another limb; by limb, over"
        " that without | 95 % intervals hold | probability of the survey's prior"
    )
    print_rows(__doc__ or "", header, range(600, 606), (0.1, 0.4), judge_limb, _row)


def _row(found: Sequence[Sequence[Judged]]) -> str:
    errors, within, shares = (
        np.array([[getattr(each, name) for each in limb] for limb in found])
        for name in ("error", "within", "share")
    )
    ratios = errors[:, 1:] / errors[:, :1]
    means = ", ".join(f"{value:.3f}" for value in errors.mean(axis=0))
    ranges = ", ".join(
        f"{low:.2f} to {high:.2f}"
        for low, high in zip(ratios.min(axis=0), ratios.max(axis=0), strict=True)
    )
    holds = ", ".join(f"{100 * value:.0f}" for value in within.mean(axis=0))
    probable = ", ".join(
        f"{value:.2f} ({low:.2f} to {high:.2f})"
        for value, low, high in zip(
            shares.mean(axis=0)[1:], shares.min(axis=0)[1:], shares.max(axis=0)[1:], strict=True
        )
    )
    return f"{means}; {ranges} | {holds} % | {probable}"


if __name__ == "__main__":
    main()
