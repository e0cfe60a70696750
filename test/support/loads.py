"""Samples over a load history, without a trial behind them."""

import numpy as np

from socket_testbed.samples import Samples


def samples_of(load: np.ndarray, rate: float, noise: float = 0.2, seed: int = 0) -> Samples:
    """Samples at a rate [Hz] of a vertical load [N] with noise [N]; all else is steady."""
    rng = np.random.default_rng(seed)
    count = len(load)
    wrench = rng.normal(0.0, [0.02] * 3 + [noise] * 3, (count, 6))
    wrench[:, 5] -= load
    return Samples(
        stamps=np.arange(count) * round(1e9 / rate),
        position=rng.normal(0.0, 1e-4, (count, 3)),
        rotation=np.zeros((count, 3)),
        wrench=wrench,
        clusters=("a",),
        local_forces=np.zeros((count, 1, 3)),
        status=np.zeros((count, 1), dtype=np.uint8),
    )
