"""`demo`: run the simulated testbed, replay its trial, compare the estimates with the truth."""

from __future__ import annotations

import shlex
import shutil
import sys
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure, SubFigure

from socket_testbed import api
from socket_testbed.arrays import NORMAL_QUANTILE, FloatArray
from socket_testbed.commands import calls
from socket_testbed.commands.calls import takes
from socket_testbed.commands.terminal import Progress, decimals, table
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.figures import style
from socket_testbed.figures.scale import fixed_end
from socket_testbed.figures.tiles import tile_map_figure
from socket_testbed.files import TemporaryFolder, check_new_folder, make_folder
from socket_testbed.geometry.regions import all_regions, place_of
from socket_testbed.identification import validation
from socket_testbed.identification.force_map import left_out_pressures
from socket_testbed.identification.wrench import REGRESSION
from socket_testbed.live import bringup
from socket_testbed.live.processes import Graph
from socket_testbed.live.scheduling import SLOWEST, busy_note, measure_speed, speed_text
from socket_testbed.samples import Samples, mean_and_sigma
from socket_testbed.settings.testbed import EstimatorSettings, ReplaySettings
from socket_testbed.simulation.testbed import Simulation
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.description import summary
from socket_testbed.trials.trial import Trial
from socket_testbed.trials.truth import GroundTruth, read_truth
from socket_testbed.wire import topics
from socket_testbed.wire.messages import Reader

_LOG = "live.log"  # only a demo writes it
_DURATION = 60.0  # [s] of testbed time; of the trial
_PACE = 2.0  # [-]; speed-up of the protocol
_TRIGGER_RATE = 10.0  # [Hz]
_REPLAY_SPEED = 5.0  # [-]; relative to the testbed
_MAX_START_UP = 6.0  # [s] of testbed time; until the first trigger
_MIN_COMPLETE = 0.9  # [-]; with fewer complete samples the trial is recorded again, slower
_MIN_USABLE = 0.3  # [-]; with fewer complete samples in the last attempt the demo fails
_MAX_RETRIES = 4


@takes(calls.Demo)
def demo(call: calls.Demo) -> None:
    """Run the simulated testbed live, replay its trial, and show the errors."""
    output = call.output
    started = time.monotonic()
    _prepare_folder(output)
    print(
        f"1. the testbed live for {_DURATION:g} s: simulated chips, their real drivers, the graph,"
        "\n   a recorder. The limb is pushed from all sides, bears 19 kg, and is unloaded"
        f" ({_TRIGGER_RATE:g} Hz)"
    )
    trial = Trial(output / "trial")
    samples, scale = _record(trial, call.seed, output / _LOG)

    speed = _REPLAY_SPEED * min(scale, measure_speed().time_scale())
    print(f"2. the trial replayed through calibration and estimator at {speed:g} times speed")
    live = _estimate(trial, samples, speed, output / "replay.log")

    print("3. every estimate on held-out data, against the simulated truth\n")
    truth = read_truth(trial.path, samples.stamps)
    conclusion = _Conclusion(trial, samples, truth, live)
    print(_error_table(api.validate(trial)), "\n")
    for line in conclusion.sentences():
        print(f"- {line}")
    figure = output / "force_map.png"
    style.save_figure(conclusion.draw(), figure)
    print(f"\ntrial {trial.path}, figure {figure} ({time.monotonic() - started:.0f} s)")
    print(f"look at the trial: {_program()} view {shlex.quote(str(trial.path))}")


def _program() -> str:
    called = sys.argv[0]
    if Path(called).name != "socket-testbed" or shutil.which("socket-testbed") == called:
        return "socket-testbed"
    return called


def _record(trial: Trial, seed: int, log: Path) -> tuple[Samples, float]:
    """Record a trial of the simulated testbed, as fast as this machine can.

    Returns:
        Its samples and the time scale of the recording [-].
    """
    scale = measure_speed().time_scale()
    if note := busy_note(scale):
        print(f"   {note}")
    for retries in range(_MAX_RETRIES, -1, -1):
        _run_live(trial.path, seed, scale, log)
        complete = _complete(trial)
        if complete >= (_MIN_COMPLETE if retries else _MIN_USABLE):
            break
        only = f"only {100.0 * complete:.0f} % of the samples are complete"
        if not retries:
            raise TrialError(
                f"{only}, even at {speed_text(scale)}",
                "this machine is too busy: end other programs, or try again later",
            )
        scale = max(0.5 * scale, SLOWEST)
        print(f"   {only}: again at {speed_text(scale)}")
        shutil.rmtree(trial.path, ignore_errors=True)
    print("   " + summary(trial.path))
    return trial.samples(), scale


def _complete(trial: Trial) -> float:
    """Fraction of the expected samples that are complete [-]."""
    try:
        samples = Trial(trial.path).samples()  # `trial` itself would cache them
    except TrialError:  # the nodes did not start in time
        return 0.0
    expected = _TRIGGER_RATE * (_DURATION - _MAX_START_UP)
    return float(samples.complete.sum() / max(expected, len(samples)))


def _run_live(path: Path, seed: int, scale: float, log: Path) -> None:
    protocol = Simulation("protocol", _DURATION, seed, pace=_PACE, time_scale=scale)
    testbed = bringup.simulated_testbed(record=path, rate=_TRIGGER_RATE, simulation=protocol)
    progress = Progress("   running")
    with log.open("w", encoding="utf-8") as output, Graph(output) as graph:
        bringup.start(graph, testbed)
        began = time.monotonic()

        def done() -> bool:
            elapsed = (time.monotonic() - began) * scale
            progress(min(int(elapsed), int(_DURATION)), int(_DURATION))
            return elapsed >= _DURATION

        graph.watch(done, lambda line: print(line, file=output))
        bringup.end(graph, testbed)


def _prepare_folder(folder: Path) -> None:
    """Remove the trial of an earlier demo and nothing else, then make the folder."""
    trial = folder / "trial"
    if trial.exists():
        if not (folder / _LOG).is_file():
            raise ConfigurationError(
                f"{trial} is not a trial of the demo", "name another folder with -o"
            )
        shutil.rmtree(trial)
    if not folder.exists():
        check_new_folder(folder)
    make_folder(folder)


def _estimate(trial: Trial, samples: Samples, speed: float, log: Path) -> FloatArray:
    """Replay the trial at a speed [-] and collect the published pressures.

    Returns:
        Normal pressure on each tile and its standard deviation, shape (2, N, n) [Pa]; NaN for
        samples without a map.
    """
    replay = ReplaySettings(trial=str(trial.path.resolve()), rate=speed)
    topic, pressures = topics.FORCE_MAP, {}
    with log.open("w", encoding="utf-8") as output, TemporaryFolder() as folder:
        path = Path(folder) / "replay"
        bringup.record_estimates(trial, replay, EstimatorSettings(), path, output)
        with BagReader(path) as bag:
            models = bag.counts[f"/{topics.PARAMETERS.name}"]
            reader = Reader(topic, path)
            for raw in bag.messages([f"/{topic.name}"]):
                stamp, (_, fields) = reader.read(raw.data)
                names = ("normal_pressure", "normal_pressure_standard_deviation")
                pressures[stamp] = np.array([fields[name][0] for name in names])
    print(
        f"   {len(pressures)} force maps of {len(samples)} samples received,"
        f" {models} models fitted on the way"
    )
    if not pressures:
        raise TrialError("the graph published no force map", f"read {log}")
    none = np.full((2, len(trial.geometry)), np.nan)
    return np.stack([pressures.get(stamp, none) for stamp in samples.stamps.tolist()], axis=1)


_ESTIMATES = (validation.FORCE_MAP, validation.CLOSED, "rigid_bias", REGRESSION)
# For each column: query of the judgements, column of the judgements, decimals.
_COLUMNS = {
    "tiles without sensor": ("question == 'tiles'", "error [-]", 2),
    "left-out clusters": ("question == 'cluster'", "error [-]", 2),
    "M [N m]": ("question == 'wrench' and test == 'second half'", "moment RMSE [N m]", 2),
    "F [N]": ("question == 'wrench' and test == 'second half'", "force RMSE [N]", 1),
}
_LEGEND = """
*: best. Tiles, clusters: rms error over the rms of the force; predicting zero gives 1.
M, F: RMSE of the wrench from the pose alone, fitted on the first half (pushed around),
judged on the second (held, unloaded)"""


def _error_table(found: api.Validation) -> str:
    """Errors on tiles, left-out clusters and the wrench, the best marked."""
    columns = []
    for which, column, digits in _COLUMNS.values():
        judged = found.summary().query(which).groupby("predictor")[column].last()
        errors = judged.reindex([*_ESTIMATES])
        columns.append(
            [decimals(error, digits) + "*" * bool(error == errors.min()) for error in errors]
        )
    rows = [*map(list, zip(_ESTIMATES, *columns, strict=True))]
    return f"{table(['estimate', *_COLUMNS], rows)}\n{_LEGEND}"


class _Conclusion:
    """Results of the demo over the hold, in words and as a picture; pressures in kPa."""

    def __init__(
        self, trial: Trial, samples: Samples, truth: GroundTruth, live: FloatArray
    ) -> None:
        self._geometry = trial.geometry
        rows = trial.select("plateau", EstimatorSettings()).rows
        self._hold, normal = samples[rows], self._geometry.rotations[:, :, 2]
        pressed = -np.einsum("kni,ni->kn", truth.forces[rows], normal) / self._geometry.areas
        self._estimate, deviation, self._truth = (
            1e-3 * np.nanmean(values, axis=0) for values in (*live[:, rows], pressed)
        )
        self._error, self._reach = self._estimate - self._truth, NORMAL_QUANTILE * deviation
        left_out = [*left_out_pressures(self._hold, self._geometry)]
        self._names = [name for name, *_ in left_out]
        # By cluster: measured pressure, the map's without it, and half-width of its interval.
        self._left_out = 1e-3 * np.nanmean([values for _, *values in left_out], axis=-1)
        self._left_out[:, 2] *= NORMAL_QUANTILE

    def sentences(self) -> list[str]:
        """Measured and estimated pressures, their errors, and what to try next."""
        places = all_regions(self._geometry)
        bare = np.flatnonzero(~self._geometry.covered)
        held = 100.0 * np.mean(np.abs(self._error[bare]) <= self._reach[bare])
        load, _ = mean_and_sigma(self._hold.wrench[:, 3:])
        measured, without, reach = self._left_out.T
        highest, worst = measured.argmax(), np.abs(measured - without).argmax()

        def described(tile: int) -> str:
            estimate = _interval(self._estimate[tile], self._reach[tile])
            place = place_of(self._geometry, places, tile)
            return f"{place}, {estimate}, {self._truth[tile]:.1f} in truth"

        return [
            f"Highest pressure measured over the hold, under {load:.0f} N: cluster"
            f" {self._names[highest]}, {measured[highest]:.1f} kPa.",
            f"Highest between the clusters: {described(bare[self._estimate[bare].argmax()])};"
            f" {held:.0f} % of the 95 % intervals contain the truth.",
            f"Largest error: {described(bare[np.abs(self._error[bare]).argmax()])}.",
            f"Largest error without its cluster: {self._names[worst]},"
            f" {_interval(without[worst], reach[worst])}, {measured[worst]:.1f} measured.",
            "Next: 'view' shows the map over time, 'report' everything on one page.",
        ]

    def draw(self) -> Figure:
        """Map and truth on one scale, the error, and every cluster left out."""
        high = fixed_end(max(self._estimate.max(), self._truth.max()))
        error = float(np.abs(self._error).max()) or 1.0
        maps = {
            "estimated live, mean over the hold": (self._estimate, self._reach, 0.0, high),
            "simulated truth": (self._truth, 0.0 * self._truth, 0.0, high),
            "error: estimate - truth": (self._error, 0.0 * self._error, -error, error),
        }
        return tile_map_figure(
            self._geometry,
            {title: values for title, (values, *_) in maps.items()},
            "normal pressure [kPa]",
            "Normal pressure on the socket",
            limits={title: (row[2], row[3]) for title, row in maps.items()},
            reach={title: reach for title, (_, reach, *_) in maps.items()},
            below=(48.0, self._draw_left_out),
        )

    def _draw_left_out(self, part: SubFigure) -> None:
        axis, places = part.subplots(), np.arange(len(self._names))
        measured, predicted, reach = self._left_out.T
        predicted_style = {"fmt": "s", "capsize": 3, "color": style.LINE_STYLES[1]["color"]}
        label = "estimated without the cluster, 95 % interval"
        axis.errorbar(predicted, places, xerr=reach, label=label, **predicted_style)
        axis.plot(measured, places, "o", color=style.LINE_STYLES[0]["color"], label="measured")
        axis.set_yticks(places, [f" {name}" for name in self._names], parse_math=False)
        axis.set_ylim(len(places) - 0.5, -0.5)
        axis.set_xlabel("normal pressure [kPa]")
        style.style_axes(axis)
        style.add_legend(axis, ncols=2)


def _interval(value: float, reach: float) -> str:
    return f"{value:.1f} kPa (95 %: {value - reach:.1f} to {value + reach:.1f})"
