"""Landmarks whose names are swapped, or whose coordinates are mirrored.

A residual shows a mix-up only as far as the landmarks' places differ: what it would not show is
said, so that a person looks.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, permutations

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import RegistrationError
from socket_testbed.geometry.rigid import fit_rigid, misfit, root_mean_square

_SUSPECT = 0.001  # [m]; a smaller residual raises no question
_TELLING = 3.0  # [-]; how many times better another explanation must fit
_AS_GOOD = 2.0  # [-]; two explanations that fit alike
_UNSEEN = 0.002  # [m]; a residual that nobody is warned of
_MOST_ORDERED = 6  # landmarks of which every order is tried


def refuse_mix_ups(known: FloatArray, measured: FloatArray, names: Sequence[str]) -> None:
    """Refuse landmarks that fit much better under other names, or mirrored.

    Args:
        known: Landmarks in the frame to register, shape (k, 3) [m].
        measured: The same landmarks in another frame, shape (k, 3) [m].
        names: Names of the k landmarks.

    Raises:
        RegistrationError: Naming the landmarks whose exchange mends it, as far as the residual
            tells.
    """
    orders = _orders(len(names))
    misfits = _misfits(known, measured[orders])
    named = misfits[0]
    best = int(misfits.argmin())
    if named > _SUSPECT and named > _TELLING * misfits[best]:
        moved = (orders != orders[0]).sum(axis=1)
        alike = np.flatnonzero(misfits <= _AS_GOOD * misfits[best])
        plainest = int(alike[moved[alike].argmin()])
        raise _mixed(names, orders[plainest], named, misfits[plainest])
    mirrored = _misfits(known * [1.0, 1.0, -1.0], measured[None])[0]
    if named > _SUSPECT and named > _TELLING * mirrored:
        raise RegistrationError(
            f"landmarks {', '.join(names)} fit with {1e3 * named:.1f} mm, mirrored with"
            f" {1e3 * mirrored:.1f} mm",
            "check the signs of their coordinates, and that the take was exported with"
            " right-handed axes",
        )


def unseen_mix_ups(known: FloatArray, names: Sequence[str]) -> tuple[str, ...]:
    """What mix-ups of the landmarks would leave too small a residual to be seen.

    Args:
        known: Landmarks in the frame to register, shape (k, 3) [m].
        names: Names of the k landmarks.
    """
    misfits = _misfits(known, known[_swaps(len(names))])
    unseen = [
        f"{a} and {b} could be swapped unseen ({1e3 * rms:.1f} mm): check which is which"
        for (a, b), rms in zip(combinations(names, 2), misfits, strict=True)
        if rms < _UNSEEN
    ]
    if _misfits(known * [1.0, 1.0, -1.0], known[None])[0] < _UNSEEN:
        unseen.append(
            f"{', '.join(names)} lie in one plane: a wrong sign of a coordinate would not be seen"
        )
    return tuple(unseen)


def _misfits(known: FloatArray, measured: FloatArray) -> FloatArray:
    """Root-mean-square residuals of M sets of measured points, shape (M,) [m]."""
    return root_mean_square(misfit(known, measured, fit_rigid(known, measured)))


def _swaps(count: int) -> IntArray:
    swaps = np.tile(np.arange(count), (count * (count - 1) // 2, 1))
    for order, (a, b) in zip(swaps, combinations(range(count), 2), strict=True):
        order[[a, b]] = b, a
    return swaps


def _orders(count: int) -> IntArray:
    """Orders of the landmarks, the first being the one that is named."""
    if count <= _MOST_ORDERED:
        return np.array(list(permutations(range(count))))
    return np.concatenate([np.arange(count)[None], _swaps(count)])


def _mixed(names: Sequence[str], order: IntArray, named: float, mended: float) -> RegistrationError:
    taken = [names[i] for i in order]
    moved = [pair for pair in zip(names, taken, strict=True) if pair[0] != pair[1]]
    here, there = (" and ".join(side) for side in zip(*moved, strict=True))
    how = "swapped" if len(moved) == 2 else f"taken for {there}"
    return RegistrationError(
        f"landmarks {here} fit with {1e3 * named:.1f} mm as they are named, with"
        f" {1e3 * mended:.1f} mm if they are {how}",
        "exchange their names or their coordinates",
    )
