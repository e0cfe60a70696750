"""The ground truth in a simulated trial's folder."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.documents import GET_LFS, IS_LFS_POINTER, LFS_POINTER
from socket_testbed.errors import TrialError

TRUTH_FILE = "ground_truth.npz"


@dataclass(frozen=True)
class GroundTruth:
    """True motion and forces in {S}, one row per time.

    Attributes:
        tiles: Names of the n tiles.
        forces: Force of the limb on the socket at each tile, in {S}, shape (N, n, 3) [N]; the
            surface between the tiles bears a part of the load, too.
        wrench: Wrench of the limb on the socket [M; F] about the origin of {S}, in {S}, shape
            (N, 6) [N m, N].
        position: Limb position q in {S}, shape (N, 3) [m].
        rotation: Rotation vector of the limb since donning, in {S}, shape (N, 3) [rad].
    """

    tiles: tuple[str, ...]
    forces: FloatArray
    wrench: FloatArray
    position: FloatArray
    rotation: FloatArray


def save_truth(path: Path, stamps: IntArray, truth: GroundTruth, **more: FloatArray) -> None:
    """Write a ground truth as a .npz file.

    Args:
        path: The file to write.
        stamps: Times of its rows since the epoch, shape (N,) [ns].
        truth: The ground truth.
        **more: Further arrays to store, by name.
    """
    arrays: dict[str, Any] = {**vars(truth), **more}
    np.savez_compressed(path, names=np.array(arrays.pop("tiles")), stamps=stamps, **arrays)


def read_truth(path: Path, stamps: IntArray | None = None) -> GroundTruth:
    """Read the ground truth in a simulated trial's folder.

    Args:
        path: Folder of the trial.
        stamps: Times since the epoch, shape (N,) [ns], to which it is interpolated linearly; held
            before the first and after the last simulated time. None: the times of the simulation.

    Raises:
        TrialError: The file is missing or damaged.
    """
    if not (path / TRUTH_FILE).is_file():
        raise TrialError(
            f"{path}: holds no ground truth ({TRUTH_FILE})",
            "only trials of 'simulate' and 'run --simulated --record' have one",
        )
    from scipy.interpolate import make_interp_spline  # 0.1 s, for simulated trials alone

    try:
        with np.load(path / TRUTH_FILE) as data:
            times, tiles = data["stamps"], tuple(data["names"].tolist())
            since = times - times[0]
            if len(since) < 2:
                raise ValueError("it has fewer than two times")
            names = [field.name for field in fields(GroundTruth)[1:]]
            splines = [make_interp_spline(since, data[name], k=1) for name in names]
    except Exception as error:  # parsing may raise any error
        fact, hint = f"is damaged ({error})", "simulate the trial again, or remove the file"
        with suppress(OSError), (path / TRUTH_FILE).open("rb") as file:
            if file.read(len(LFS_POINTER)) == LFS_POINTER:
                fact, hint = IS_LFS_POINTER, GET_LFS
        raise TrialError(f"{path / TRUTH_FILE}: {fact}", hint) from None
    at = since if stamps is None else np.clip(stamps - times[0], 0, since[-1])
    return GroundTruth(tiles, *(spline(at) for spline in splines))


def read_true_forces(path: Path, stamps: IntArray, tiles: Sequence[str]) -> FloatArray | None:
    """True force of the limb on the socket at n tiles, in {S}, shape (N, n, 3) [N].

    None if the trial in the folder was not simulated, or simulated with other tiles.

    Args:
        path: Folder of the trial.
        stamps: Times since the epoch, shape (N,) [ns].
        tiles: Names of the n tiles, in the order of the result.
    """
    if not (path / TRUTH_FILE).is_file():
        return None
    truth = read_truth(path, stamps)
    return truth.forces if truth.tiles == tuple(tiles) else None
