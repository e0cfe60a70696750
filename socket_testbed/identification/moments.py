"""Moments of samples: all that Stage 2 needs of the data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from socket_testbed.arrays import FloatArray


@dataclass(frozen=True)
class Moments:
    """Moments of N rows of gated displacements S (N, p) and targets Y (N, m).

    Attributes:
        count: Number of rows N.
        mean: Means of S, shape (p,) [m].
        gram: Centred products of S with itself, shape (p, p) [m^2].
        target_mean: Means of Y, shape (m,).
        cross: Centred products of S with Y, shape (p, m).
        target_power: Centred sums of squares of Y, shape (m,).
    """

    count: int
    mean: FloatArray
    gram: FloatArray
    target_mean: FloatArray
    cross: FloatArray
    target_power: FloatArray

    def about_zero(self) -> Moments:
        """The same moments without centring, as a model without offsets needs them."""
        return Moments(
            self.count,
            np.zeros_like(self.mean),
            self.gram + self.count * np.outer(self.mean, self.mean),
            np.zeros_like(self.target_mean),
            self.cross + self.count * np.outer(self.mean, self.target_mean),
            self.target_power + self.count * self.target_mean**2,
        )
