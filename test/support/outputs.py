"""Pressure outputs of known forces, by their definitions in plain numpy."""

import numpy as np

from socket_testbed.arrays import BREAK, gaps
from socket_testbed.geometry.regions import proximal_direction


def outputs_of(forces, time, geometry, regions, threshold) -> dict[str, np.ndarray]:
    """Outputs over a span by region, as in `RegionOutputs`, of forces (N, n, 3) in {S} [N]."""
    local = np.einsum("nij,kni->knj", geometry.rotations, forces)
    pressed = -local[..., 2] / geometry.areas
    held = np.where(pressed > threshold, pressed, 0.0)
    axial = forces @ proximal_direction(geometry)
    parts = np.split(np.arange(len(time)), np.flatnonzero(gaps(time, BREAK)) + 1)
    found: dict[str, list] = {}
    for region in regions:
        tiles, area = region.tiles, geometry.areas[region.tiles]
        push = np.maximum(-local[:, tiles, 2], 0.0).mean(axis=0)
        shear = local[:, tiles, :2].mean(axis=0).sum(axis=0) / area.sum()
        integrals = [np.trapezoid(held[part][:, tiles], time[part], axis=0) for part in parts]
        with np.errstate(invalid="ignore", divide="ignore"):  # nothing is pressed
            centre = (push[:, None] * geometry.anchors[tiles]).sum(axis=0) / push.sum()
        outputs = {
            "mean": np.average(pressed[:, tiles].mean(axis=0), weights=area),
            "peak": pressed[:, tiles].max(),
            "area": ((pressed[:, tiles] > threshold) * area).sum(axis=1).mean(),
            "integral": np.average(np.sum(integrals, axis=0), weights=area),
            "centre": centre,
            "shear": np.linalg.norm(shear),
            "direction": np.arctan2(shear[1], shear[0]),
            "share": axial[:, tiles].sum() / axial.sum(),
        }
        for name, value in outputs.items():
            found.setdefault(name, []).append(value)
    return {name: np.array(values) for name, values in found.items()}
