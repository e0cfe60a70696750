"""`demo`: the simulated testbed live, its trial replayed, and the estimates beside the truth."""

from __future__ import annotations

import shlex
import shutil
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from socket_testbed import api
from socket_testbed.arrays import FloatArray
from socket_testbed.commands.terminal import Progress, number, table
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.files import check_new_folder, make_folder
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.identification.validation import judge_tiles, without_cluster
from socket_testbed.live.bringup import (
    end,
    replay_with_estimator,
    simulated_testbed,
    start,
    summary,
)
from socket_testbed.live.graph_status import GraphStatus
from socket_testbed.live.machine import SLOWEST, busy_note, measure_speed, pace
from socket_testbed.live.processes import Graph, require_ros
from socket_testbed.live.simulated_world import Simulation
from socket_testbed.report.figures.style import save_figure
from socket_testbed.report.figures.tiles import certainty_of, tile_map_figure
from socket_testbed.samples import Samples
from socket_testbed.settings.testbed import EstimatorSettings, ReplaySettings
from socket_testbed.simulation.trial import TRUTH_FILE, GroundTruth, read_truth
from socket_testbed.trials.segment import select_segment
from socket_testbed.trials.topics import FORCE_MAP
from socket_testbed.trials.trial import Trial

_DURATION = 60.0  # [s] of the testbed; of the trial
_PACE = 2.0  # [-]; the protocol within that time
_TRIGGER_RATE = 10.0  # [Hz]
_SPEED = 5.0  # of the replay, relative to the testbed
_START_UP = 6.0  # [s] of the testbed; until the first trigger, at most
_COMPLETE = 0.9  # [-]; fraction of the samples below which the trial is recorded again, slower
_USABLE = 0.3  # [-]; below it there is nothing to show
_ATTEMPTS = 4  # after the first
_HOPELESS = 0.7  # [-]; below it a recording is broken off
_LEAST_JUDGED = 60  # triggers
_IN_HAND = 10  # triggers; whose measurements may be on their way


def demo(*, output: Path = Path("demo"), seed: int = 0) -> None:
    """Run the simulated testbed live, replay its trial, and show the errors.

    Args:
        output: Folder of the trial and of the figure.
        seed: Seed of the simulated testbed.
    """
    started = time.monotonic()
    _make_room(output)
    print(
        f"1. the testbed live for {_DURATION:g} s: simulated chips, their real drivers, the graph,"
        "\n   a recorder. The limb is pushed from all sides, bears 19 kg, and is unloaded"
        f" ({_TRIGGER_RATE:g} Hz)"
    )
    trial = Trial(output / "trial")
    samples, scale = _record(trial, seed, output / "live.log")

    speed = _SPEED * min(scale, measure_speed().time_scale())
    print(f"2. the trial replayed through calibration and estimator at {speed:g} times speed")
    live = _estimate(trial, samples, speed, output / "replay.log")

    print("3. every estimate on what it has not seen, against the simulated truth\n")
    truth = read_truth(trial.path, samples.stamps)
    print(_judged(api.validate(trial), samples, trial.geometry, truth, live))
    figure = output / "force_map.png"
    save_figure(_draw(trial, samples, truth, live), figure)
    print(f"\ntrial {trial.path}, figure {figure} ({time.monotonic() - started:.0f} s)")
    print(f"look at the trial: {_program()} view {shlex.quote(str(trial.path))}")


def _program() -> str:
    """How this program is called here."""
    called = sys.argv[0]
    if Path(called).name != "socket-testbed" or shutil.which("socket-testbed") == called:
        return "socket-testbed"
    return called


def _record(trial: Trial, seed: int, log: Path) -> tuple[Samples, float]:
    """Record a trial of the simulated testbed, as fast as this machine manages.

    Returns:
        Its samples, and the time scale at which they were recorded [-].
    """
    scale = measure_speed().time_scale()
    if note := busy_note(scale):
        print(f"   {note}")
    for again in range(_ATTEMPTS, -1, -1):
        _run_live(trial.path, seed, scale, log)
        complete = _complete(trial)
        if complete >= _COMPLETE:
            break
        if not again:
            if complete < _USABLE:
                raise TrialError(
                    f"only {complete:.0%} of the samples are complete, even at {pace(scale)}",
                    "this machine is too busy: end other programs, or try again later",
                )
            break
        scale = max(0.5 * scale, SLOWEST)
        print(f"   only {complete:.0%} of the samples are complete: again at {pace(scale)}")
        shutil.rmtree(trial.path, ignore_errors=True)
    print("   " + summary(trial.path))
    return trial.samples(), scale


def _complete(trial: Trial) -> float:
    """Fraction of the samples that a trial should have which hold all measurements [-]."""
    try:
        samples = Trial(trial.path).samples()  # the trial itself would keep them
    except TrialError:  # the nodes were not up before the time was over
        return 0.0
    forces = np.isfinite(samples.local_forces).all(axis=(1, 2))
    expected = _TRIGGER_RATE * (_DURATION - _START_UP)
    return float((samples.complete & forces).sum() / max(expected, len(samples)))


def _run_live(path: Path, seed: int, scale: float, log: Path) -> None:
    """Record a trial of the simulated testbed at a time scale [-], unless it falls behind."""
    # ROS is imported only where a graph runs: the rest works without it.
    require_ros()
    from socket_testbed.nodes.listeners import StatusListener

    protocol = Simulation("protocol", _DURATION, seed, pace=_PACE, time_scale=scale)
    testbed = simulated_testbed(record=path, rate=_TRIGGER_RATE, simulation=protocol)
    progress = Progress("   running")
    status = GraphStatus()
    with ExitStack() as stack:
        output = stack.enter_context(log.open("w", encoding="utf-8"))
        graph = stack.enter_context(Graph(output))
        start(graph, testbed)
        began = time.monotonic()
        listener = StatusListener(status)
        stack.callback(listener.close)

        def done() -> bool:
            listener.take()
            elapsed = (time.monotonic() - began) * scale
            progress(min(int(elapsed), int(_DURATION)), int(_DURATION))
            if falls_behind(status):
                progress.stop()
                return True
            return elapsed >= _DURATION

        graph.watch(done, lambda line: print(line, file=output))
        end(graph, testbed)


def falls_behind(status: GraphStatus) -> bool:
    """Whether so many samples lack a measurement that going on is of no use."""
    judged = status.triggers - _IN_HAND
    return judged >= _LEAST_JUDGED and status.complete < _HOPELESS * judged


def _make_room(folder: Path) -> None:
    """Remove what an earlier demo left, and nothing else."""
    trial = folder / "trial"
    if trial.exists():
        if not (trial / TRUTH_FILE).is_file():
            raise ConfigurationError(
                f"{trial} is not a trial of the demo", "name another folder with -o"
            )
        shutil.rmtree(trial)
    if not folder.exists():
        check_new_folder(folder)
    make_folder(folder)


def _estimate(trial: Trial, samples: Samples, speed: float, log: Path) -> FloatArray:
    """The force maps that a subscriber receives while the trial is replayed at a speed [-].

    Returns:
        Values and standard deviations, shape (2, N, n, 4): the force on each tile in {S} [N], and
        its normal pressure [Pa]; NaN at samples without a map.
    """
    # ROS is imported only where a graph runs: the rest works without it.
    from socket_testbed.nodes.listeners import EstimateListener

    replay = ReplaySettings(
        trial=str(trial.path.resolve()), rate=speed, wait_for=(EstimateListener.NAME,)
    )
    with log.open("w", encoding="utf-8") as output, EstimateListener() as listener:
        replay_with_estimator(trial, replay, EstimatorSettings(), output)
        received = len(listener.estimates[FORCE_MAP])
        print(
            f"   {received} force maps of {len(samples)} samples received,"
            f" {listener.models} models fitted on the way"
        )
        if not received:
            raise TrialError("the graph published no force map", f"read {log}")
        return np.moveaxis(listener.series(FORCE_MAP, samples.stamps.tolist()), 1, 0)


_COLUMNS = ("tiles without sensor", "95 % hold", "left-out clusters", "M [N m]", "F [N]")


def _judged(
    found: api.Validation,
    samples: Samples,
    geometry: SocketGeometry,
    truth: GroundTruth,
    live: FloatArray,
) -> str:
    """The table of all estimates: on tiles, on clusters left out, of the wrench."""
    summary = found.summary()
    cells: dict[str, dict[str, str]] = {}
    for (question, test, name), row in summary.iterrows():
        line = cells.setdefault(name, {})
        if question == "tiles":
            line[_COLUMNS[0]] = number(row["error [-]"], 2)
            line[_COLUMNS[1]] = number(100.0 * row["within 95 % [-]"], 0)
        elif question == "cluster":
            line[_COLUMNS[2]] = number(row["error [-]"], 2)
        elif test == "second half":
            line[_COLUMNS[3]] = number(row["moment RMSE [N m]"], 2)
            line[_COLUMNS[4]] = number(row["force RMSE [N]"], 1)
    (received,) = judge_tiles(
        samples,
        geometry,
        truth.forces,
        {"force map": lambda _: (live[0, ..., :3], live[1, ..., :3])},
        "second half",
    )
    cells["force map, live (all samples)"] = {
        _COLUMNS[0]: number(received.error, 2),
        _COLUMNS[1]: number(100.0 * received.coverage[-1], 0),
    }
    lines = [[name, *(row.get(title, "-") for title in _COLUMNS)] for name, row in cells.items()]
    legend = (
        "tiles, clusters: rms error over the rms of the force, 1 is predicting zero; how many % of"
        "\nthe values the 95 % intervals hold. M, F: RMSE of the wrench from the pose alone, fitted"
        "\non the first half (pushed around), judged on the second (held, unloaded)"
    )
    return f"{table(['estimate', *_COLUMNS], lines)}\n\n{legend}"


def _draw(trial: Trial, samples: Samples, truth: GroundTruth, live: FloatArray) -> Figure:
    """The map over the hold, its uncertainty and the truth, as mean normal pressures."""
    geometry = trial.geometry
    rows = select_segment(samples, "plateau", EstimatorSettings().plateau).rows
    truth_pressure = (
        -np.einsum("kni,ni->kn", truth.forces[rows], geometry.rotations[:, :, 2]) / geometry.areas
    )
    estimate, deviation, actual = (
        1e-3 * np.nanmean(values, axis=0) for values in (*live[..., 3][:, rows], truth_pressure)
    )
    name = "estimated live, mean over the hold; pale where it is uncertain"
    return tile_map_figure(
        geometry,
        {
            name: estimate,
            "its standard deviation": deviation,
            "simulated truth": actual,
        },
        "normal pressure [kPa]",
        "Normal pressure on the socket",
        notes=_held_out(trial, samples[rows]),
        certainty={name: certainty_of(estimate, deviation)},
    )


def _held_out(trial: Trial, hold: Samples) -> dict[str, str]:
    """What each cluster measured over a hold, and what the map says without it, in words."""
    notes = {}
    force_map = ForceMap(trial.geometry, hold.clusters)
    for column, cluster in enumerate(hold.clusters):
        tile = trial.geometry.clusters[cluster]
        hidden = force_map.estimate(without_cluster(hold, cluster))
        measured = -np.nanmean(hold.trusted_forces[:, column, 2]) / trial.geometry.areas[tile]
        predicted = np.nanmean(hidden.normal_pressure[:, tile])
        deviation = np.nanmean(hidden.normal_pressure_standard_deviation[:, tile])
        notes[cluster] = (
            f"{1e-3 * measured:.0f} kPa measured, {1e-3 * predicted:.0f} ± {1e-3 * deviation:.0f}"
            " without it"
        )
    return notes
