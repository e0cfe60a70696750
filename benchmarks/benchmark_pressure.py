"""Pressure outputs against the simulated truth: coverage of their intervals, errors, a rival.

Usage:
    python benchmarks/benchmark_pressure.py [--seeds 71 72 73 74 75] [--duration 120]

An error is the root mean square over places and trials, relative to that of the true values; of
positions and directions it is absolute. The rival is the inverse-distance interpolation of the
clusters with the wrench met, put through the same equations.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from collections import defaultdict
from pathlib import Path

import numpy as np

import socket_testbed as st
from socket_testbed.geometry.regions import Region
from socket_testbed.identification.pressure import outputs_of
from socket_testbed.identification.validation import close_wrench, inverse_distance
from socket_testbed.simulation.limb import TISSUES
from socket_testbed.simulation.trial import read_truth

_SEGMENTS = {"static_hold": "plateau", "ramp": "all", "multi_direction": "all"}
_ABSOLUTE = {"centre": (1e3, "mm"), "direction": (180.0 / np.pi, "deg")}
_SHARE = 0.5  # [-]; beyond which a value is masked
_INSTANTS = 40  # of a trial
_PARTS, _REGIONS = slice(0, 7), slice(7, -1)  # sectors and heights; the sectors by the heights
_PLACES = {
    "socket": ("mean", "peak", "area", "integral", "centre", "shear", "direction"),
    "parts": ("mean", "peak", "area", "integral", "centre", "shear", "direction", "share"),
    "regions": ("mean", "peak", "area", "integral", "centre", "shear", "direction", "share"),
    "instants": ("mean", "peak", "area", "centre", "shear", "direction", "share"),
    "tiles": ("mean", "peak", "integral", "shear", "direction"),
}


def main() -> None:
    """Simulate, judge and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[71, 72, 73, 74, 75])
    parser.add_argument("--duration", type=float, default=120.0, help="of a trial [s]")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")  # no side is stated
    found = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        for tissue in TISSUES:
            for scenario, segment in _SEGMENTS.items():
                for seed in arguments.seeds:
                    path = Path(folder) / f"{tissue}_{scenario}_{seed}"
                    trial = st.simulate(
                        path, scenario, tissue=tissue, seed=seed, duration=arguments.duration
                    )
                    for key, judged in judge(trial, segment).items():
                        found[*key, tissue].append(judged)
    print(f"{'':19} {'within 95 %':>14}  {'error, rival':>32}  {'masked':>12}")
    print(f"{'':19} {'soft':>7}{'stiff':>7}  {'soft':>16}{'stiff':>16}  {'soft':>6}{'stiff':>6}")
    for places, outputs in _PLACES.items():
        for output in outputs:
            print(row(places, output, [found[places, output, tissue] for tissue in TISSUES]))


def judge(trial, segment: str) -> dict[tuple[str, str], tuple[np.ndarray, ...]]:
    """Truth, value, rival, low, high and scale of every output of a trial, flat."""
    pressure = st.pressure(trial, segment)
    geometry, rows = trial.geometry, pressure.segment.rows
    samples = trial.samples()[rows]
    threshold = 1e3 * pressure.threshold
    tiles = [Region(name, np.array([tile])) for tile, name in enumerate(geometry.names)]
    nearest = inverse_distance(geometry, samples.clusters, samples.trusted_forces)
    rival = close_wrench(geometry, nearest, samples.wrench, [*geometry.clusters.values()])
    truth = read_truth(trial.path, samples.stamps).forces
    instants = np.linspace(0, len(samples) - 1, _INSTANTS).astype(int)

    def known(forces: np.ndarray, places) -> dict[str, np.ndarray]:
        return outputs_of(forces, samples.time, geometry, places, threshold)

    def at_instants(forces: np.ndarray) -> dict[str, np.ndarray]:
        each = [
            outputs_of(
                forces[k : k + 1], np.zeros(1), geometry, pressure.places[_REGIONS], threshold
            )
            for k in instants
        ]
        return {name: np.array([values[name] for values in each]) for name in each[0]}

    found = {}
    for places, quantities, true, other, part in (
        ("socket", pressure.outputs.regions, known(truth, pressure.places),
         known(rival, pressure.places), slice(-1, None)),
        ("parts", pressure.outputs.regions, known(truth, pressure.places),
         known(rival, pressure.places), _PARTS),
        ("regions", pressure.outputs.regions, known(truth, pressure.places),
         known(rival, pressure.places), _REGIONS),
        ("instants", pressure.outputs.series, at_instants(truth), at_instants(rival),
         (instants, _REGIONS)),
        ("tiles", pressure.outputs.tiles, known(truth, tiles), known(rival, tiles), slice(None)),
    ):  # fmt: skip
        for output in _PLACES[places]:
            quantity = getattr(quantities, output)
            own = slice(None) if places == "instants" else part
            value = quantity.value[part]
            parts = [true[output][own], value, other[output][own]]
            if output == "direction":
                parts = [value + (angle - value + np.pi) % (2.0 * np.pi) - np.pi for angle in parts]
            parts += [end[part] for end in (quantity.low, quantity.high, quantity.scale)]
            found[places, output] = tuple(part.ravel() for part in parts)
    return found


def row(places: str, output: str, by_tissue: list) -> str:
    """Coverage, error and rival's error, and share masked, by tissue."""
    factor, unit = _ABSOLUTE.get(output, (1.0, ""))
    within, errors, masked = [], [], []
    for trials in by_tissue:
        truth, value, rival, low, high, scale = (
            np.concatenate(part) for part in zip(*trials, strict=True)
        )
        exists = np.isfinite(truth)  # where nothing is pressed there is no centre
        size = 1.0 if unit else np.sqrt(np.mean(truth[exists] ** 2))
        within.append(np.mean((truth >= low - 1e-9) & (truth <= high + 1e-9), where=exists))
        error, other = (
            factor * np.sqrt(np.nanmean((estimate - truth) ** 2)) / size
            for estimate in (value, rival)
        )
        digits = 0 if output == "direction" else 1 if unit else 2
        errors.append(f"{error:.{digits}f}, {other:.{digits}f} {unit}".strip())
        reach = np.maximum(high - value, value - low)
        masked.append(np.mean(~(reach <= _SHARE * scale)))
    return (
        f"{places:9}{output:10} {within[0]:7.3f}{within[1]:7.3f}  {errors[0]:>16}{errors[1]:>16}"
        f"  {masked[0]:6.2f}{masked[1]:6.2f}"
    )


if __name__ == "__main__":
    main()
