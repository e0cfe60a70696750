"""`demo`: the simulated testbed live, its trial replayed, and the errors beside the truth."""

from __future__ import annotations

import argparse
import dataclasses
import shutil
import time
from pathlib import Path

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.commands.text import Progress, number, table
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.evaluation import channel_errors
from socket_testbed.live.bringup import (
    Simulation,
    end,
    replay_with_estimator,
    simulated_testbed,
    start,
    summary,
)
from socket_testbed.live.processes import Graph
from socket_testbed.live.time_scale import SLOWEST, busy_note, measure_speed, pace
from socket_testbed.report.figures.channels import wrench_figure
from socket_testbed.report.figures.style import save_figure
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples, channel_unit
from socket_testbed.settings.identification import PAPER_VARIANTS
from socket_testbed.settings.testbed import EstimatorSettings, ReplaySettings
from socket_testbed.simulation.trial import TRUTH_FILE, GroundTruth, read_truth
from socket_testbed.trials.segment import select_segment
from socket_testbed.trials.synchronise import read_samples
from socket_testbed.trials.trial import Trial

_DURATION = 36.0  # [s] of the testbed; of the trial
_TRIGGER_RATE = 10.0  # [Hz]
_SPEED = 5.0  # of the replay, relative to the testbed
_COMPLETE = 0.9  # [-]; fraction of the samples below which the trial is recorded again, slower

Estimate = tuple[FloatArray, FloatArray]  # wrench (N, 6), forces (N, n, 3)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("demo"), metavar="DIR", help="default: demo"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the simulated testbed")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Run the simulated testbed, replay its trial with each variant, compare."""
    started = time.monotonic()
    folder: Path = options.output
    _make_room(folder)
    print(
        f"1. the testbed live for {_DURATION:g} s: simulated chips, their real drivers, the graph,"
        f"\n   a recorder. A static hold: 9.3 kg pylon, 19 kg placed, held ({_TRIGGER_RATE:g} Hz)"
    )
    trial = Trial(folder / "trial")
    samples, scale = _record(trial, options.seed, folder / "live.log")

    speed = _SPEED * min(scale, measure_speed().time_scale())
    print(f"2. the trial replayed through calibration and estimator at {speed:g} times speed")
    estimates: dict[str, Estimate] = {}
    for variant in PAPER_VARIANTS:
        log = folder / f"{variant}.log"
        estimates[variant] = _estimate(trial, samples, variant, speed, log)

    plateau = select_segment(samples, "plateau", EstimatorSettings().plateau)
    rows = np.zeros(len(samples), dtype=bool)
    rows[plateau.rows] = True
    for wrench, _ in estimates.values():
        rows &= np.isfinite(wrench).all(axis=1)
    if not rows.any():
        raise TrialError("the graph predicted nothing on the plateau", f"read {folder}/*.log")
    truth = read_truth(trial.path, samples.stamps)
    print(
        f"3. errors on the {int(rows.sum())} samples of the hold that both variants predicted"
        " live,\n   against the measurement and against the simulated truth\n"
    )
    print(_errors(samples, trial.geometry, truth, estimates, rows))
    print("\n" + _everywhere(trial.geometry, truth, estimates, rows))
    figure = folder / "wrench.png"
    drawn = wrench_figure(
        samples.time,
        samples.wrench,
        {variant: wrench for variant, (wrench, _) in estimates.items()},
        rows,
        "Simulated static hold: wrench measured live, predicted while replayed",
    )
    save_figure(drawn, figure)
    print(f"\ntrial {trial.path}, figure {figure} ({time.monotonic() - started:.0f} s)")


def _record(trial: Trial, seed: int, log: Path) -> tuple[Samples, float]:
    """Record a trial of the simulated testbed, as fast as this machine manages.

    Returns:
        Its samples, and the time scale at which they were recorded [-].
    """
    scale = measure_speed().time_scale()
    if note := busy_note(scale):
        print(f"   {note}")
    while True:
        _run_live(trial.path, seed, scale, log)
        complete = _complete(trial)
        if complete >= _COMPLETE or scale <= SLOWEST:
            break
        scale *= 0.5
        print(f"   only {complete:.0%} of the samples are complete: again at {pace(scale)}")
        shutil.rmtree(trial.path)
    print("   " + summary(trial.path))
    return read_samples(trial), scale


def _complete(trial: Trial) -> float:
    """Fraction of a trial's samples that hold all measurements [-]."""
    try:
        samples = read_samples(trial)
    except TrialError:  # the nodes were not up before the hold was over
        return 0.0
    forces = np.isfinite(samples.local_forces).all(axis=(1, 2))
    return float((samples.complete & forces).mean())


def _run_live(path: Path, seed: int, scale: float, log: Path) -> None:
    """Record a trial of the simulated testbed at a time scale [-]."""
    hold = Simulation("static_hold", _DURATION, seed, time_scale=scale)
    testbed = simulated_testbed(record=path, rate=_TRIGGER_RATE, simulation=hold)
    progress = Progress("   running")
    with log.open("w", encoding="utf-8") as output, Graph(output) as graph:
        start(graph, testbed)
        began = time.monotonic()

        def done() -> bool:
            elapsed = (time.monotonic() - began) * scale
            progress(min(int(elapsed), int(_DURATION)), int(_DURATION))
            return elapsed >= _DURATION

        graph.watch(done, lambda line: print(line, file=output))
        end(graph, testbed)


def _make_room(folder: Path) -> None:
    """Remove what an earlier demo left, and nothing else."""
    trial = folder / "trial"
    if trial.exists():
        if not (trial / TRUTH_FILE).is_file():
            raise ConfigurationError(
                f"{trial} is not a trial of the demo", "name another folder with -o"
            )
        shutil.rmtree(trial)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"{folder}: cannot be made ({error.strerror})", "name another folder with -o"
        ) from None


def _estimate(trial: Trial, samples: Samples, variant: str, speed: float, log: Path) -> Estimate:
    """What a subscriber receives while the trial is replayed with a variant, at a speed [-]."""
    # ROS is imported only where a graph runs: the rest works without it.
    from socket_testbed.nodes.estimate_listener import EstimateListener

    settings = EstimatorSettings()
    settings = dataclasses.replace(
        settings, identification=dataclasses.replace(settings.identification, variant=variant)
    )
    replay = ReplaySettings(
        trial=str(trial.path.resolve()), rate=speed, wait_for=(EstimateListener.NAME,)
    )
    with log.open("w", encoding="utf-8") as output, EstimateListener() as listener:
        replay_with_estimator(trial, replay, settings, output)
        print(
            f"   {variant}: {len(listener.wrench)} of {len(samples)} samples predicted,"
            f" {listener.models} models fitted on the way"
        )
        return listener.series(samples.stamps.tolist(), len(trial.geometry))


def _errors(
    samples: Samples,
    geometry: SocketGeometry,
    truth: GroundTruth,
    estimates: dict[str, Estimate],
    rows: BoolArray,
) -> str:
    header = ["RMSE", "unit"]
    for variant in estimates:
        header += [f"{variant}", "to truth", "skill"]
    lines = []
    for i, name in enumerate(WRENCH_CHANNELS):
        cells = [name, channel_unit(name)]
        for wrench, _ in estimates.values():
            cells += _cells(name, samples.wrench[rows, i], truth.wrench[rows, i], wrench[rows, i])
        lines.append(cells)
    for column, cluster in enumerate(samples.clusters):
        tile = geometry.clusters[cluster]
        in_cluster = truth.forces[:, tile] @ geometry.rotations[tile]
        for axis, channel in enumerate(LOCAL_CHANNELS):
            name = f"{cluster}.{channel}"
            cells = [name, "N"]
            for _, forces in estimates.values():
                predicted = (forces[:, tile] @ geometry.rotations[tile])[rows, axis]
                measured = samples.local_forces[rows, column, axis]
                cells += _cells(name, measured, in_cluster[rows, axis], predicted)
            lines.append(cells)
    return table(header, lines)


def _cells(name: str, measured: FloatArray, truth: FloatArray, predicted: FloatArray) -> list[str]:
    to_measured = channel_errors(name, measured, predicted)
    to_truth = channel_errors(name, truth, predicted)
    return [number(to_measured.rmse), number(to_truth.rmse), number(to_measured.skill, 2)]


def _everywhere(
    geometry: SocketGeometry,
    truth: GroundTruth,
    estimates: dict[str, Estimate],
    rows: BoolArray,
) -> str:
    """How far the forces are off on the tiles without a sensor, against predicting zero."""
    bare = np.setdiff1d(np.arange(len(geometry)), list(geometry.clusters.values()))
    actual = truth.forces[rows][:, bare]
    size = np.sqrt((actual**2).sum(axis=2).mean())
    parts = []
    for variant, (_, forces) in estimates.items():
        error = np.sqrt(((forces[rows][:, bare] - actual) ** 2).sum(axis=2).mean())
        parts.append(f"{variant} {error:.2f} N ({error / size:.2f} of predicting zero)")
    return f"force on the {len(bare)} tiles without a sensor, RMSE to truth: " + ", ".join(parts)
