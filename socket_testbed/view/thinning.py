"""Lines of very many samples thinned to what a page can hold, with every peak kept."""

from __future__ import annotations

import numpy as np

from socket_testbed.arrays import FloatArray


def thin(x: FloatArray, y: FloatArray, most: int) -> tuple[FloatArray, FloatArray]:
    """Keep the lowest and the highest value of each of equally many samples.

    Args:
        x: Positions, shape (N,).
        y: Values, shape (N,); NaN where there is none.
        most: Largest number of points to keep.

    Returns:
        The kept points in their order, shape (M,) each, M <= `most`; all of them if they
        are no more. A gap is kept where all values of its samples are missing.
    """
    if len(x) <= most:
        return x, y
    size = -(-2 * len(x) // most)
    whole = len(x) // size * size
    kept = [_extremes(y[:whole].reshape(-1, size), 0)]
    if whole < len(x):
        kept.append(_extremes(y[None, whole:], whole))
    index = np.concatenate(kept)
    return x[index], y[index]


def _extremes(rows: FloatArray, first: int) -> FloatArray:
    """Indices of the lowest and the highest value of each row, in their order."""
    start = first + rows.shape[1] * np.arange(len(rows))
    lowest = start + np.where(np.isnan(rows), np.inf, rows).argmin(axis=1)
    highest = start + np.where(np.isnan(rows), -np.inf, rows).argmax(axis=1)
    return np.sort(np.stack([lowest, highest], axis=1), axis=1).ravel()
