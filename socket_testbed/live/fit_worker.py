"""Fits models in a separate process, so that they never delay predictions."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from typing import TypeVar, TypeVarTuple

import numpy as np

from socket_testbed.arrays import IntArray, rms
from socket_testbed.errors import IdentificationError
from socket_testbed.files import end_with_parent
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification import plausibility
from socket_testbed.identification.checked import CheckedSamples
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.data_finding import LEAST_CHECKED
from socket_testbed.identification.fit import Fit, fit_contact_model
from socket_testbed.identification.problem import MIN_SAMPLES, group_sizes
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import IdentificationSettings, PlateauSettings
from socket_testbed.trials.segment import find_newest_plateaus

HELD_OUT = 0.2  # [-]; newest share of the window, held out to judge a refit
LEAST_HELD_OUT = 10  # [samples]
_NICENESS = 10

T = TypeVar("T")
Ts = TypeVarTuple("Ts")


@dataclass(frozen=True)
class Steady:
    """Conditions of an automatic fit, on steady data.

    Attributes:
        plateau: How steady the data must be.
        least_samples: Smallest number of samples to fit on, without those held out.
        after: The newest sample to fit on must have a later stamp since the epoch [ns].
        rival: Model to be replaced, if the two are to be compared; None otherwise.
    """

    plateau: PlateauSettings
    least_samples: int
    after: int = 0
    rival: ContactModel | None = None


@dataclass(frozen=True)
class Contest:
    """Comparison of two models on the newest samples, held out from the fit of the new one.

    The error of a model is the RMS over the channels of the objective, relative to the size of
    their group (moments, forces, clusters), with wrench and clusters weighted by theta.

    Attributes:
        samples: Number of these samples.
        old: Error of the model to be replaced [-].
        new: Error of the new model [-].
    """

    samples: int
    old: float
    new: float

    def __str__(self) -> str:
        return (
            f"on the newest {self.samples} samples a refit has an error of {self.new:.2g},"
            f" the model before it {self.old:.2g}"
        )


@dataclass(frozen=True)
class Refit:
    """A fit on a plateau or on all samples.

    Attributes:
        fit: The fit.
        contest: Comparison with the model to be replaced; None without one.
        cause: Why earlier samples were excluded, in words, if a channel slipped or drifted;
            otherwise empty.
    """

    fit: Fit
    contest: Contest | None = None
    cause: str = ""

    @property
    def is_worse(self) -> bool:
        """Whether it predicts the newest samples worse than the model to be replaced."""
        return self.contest is not None and self.contest.new > self.contest.old


class FitWorker:
    """A process that fits one model at a time."""

    def __init__(self) -> None:
        self._open()

    def _open(self) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(1, spawn, initializer=_begin, initargs=(os.getpid(),))
        # The process inherits the mask: Ctrl-C would end it with a traceback before `close` does.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            # Load the libraries now rather than during the first fit.
            self._loaded = self._pool.submit(os.getpid)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    @property
    def ready(self) -> bool:
        """Whether the process runs, with its libraries loaded."""
        return self._loaded.done()

    def run(self, work: Callable[[*Ts], T], *arguments: *Ts) -> Future[T]:
        """Call a function in the process, after those called before.

        Args:
            work: A module-level function.
            arguments: Its arguments, which are pickled.

        Returns:
            The future result, or the error that the function raised.
        """
        try:
            return self._pool.submit(work, *arguments)
        except BrokenProcessPool:  # it was killed: start a new one
            self._open()
            return self._pool.submit(work, *arguments)

    def close(self) -> None:
        """End the process at once, even during a fit."""
        for process in list((self._pool._processes or {}).values()):
            process.terminate()
        # Join the pool's thread before the interpreter ends.
        self._pool.shutdown(wait=True, cancel_futures=True)


def _begin(node: int) -> None:
    """Yield the processor to the predictions, and end with the node even if that is killed.

    Args:
        node: Process of the node.
    """
    # The node may share a process with a sensor node, and so have its real-time priority.
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.nice(_NICENESS)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent(signal.SIGKILL)
    if os.getppid() != node:  # it was killed while this process loaded its libraries
        os._exit(1)


def fit_samples(
    samples: Samples,
    geometry: SocketGeometry,
    settings: IdentificationSettings,
    steady: Steady | None,
) -> Refit | None:
    """Fit on the newest plateau of some samples, or on all of them.

    Args:
        samples: The samples, in the order of their stamps.
        geometry: The socket that they were measured in.
        settings: Settings of the fit; the smoothing of the poses is switched off.
        steady: Conditions of a fit on a plateau; None to fit on all samples.

    Returns:
        The fit; None if there is no plateau that is long and new enough.

    Raises:
        IdentificationError: If the samples cannot be fitted, or the wrench is negated.
    """
    # In live use, a centred window would lag.
    settings = replace(settings, pose_smoothing=0.0)
    checked = CheckedSamples(samples, geometry, settings.leave_out, whole=False)
    if steady is None:
        return Refit(_plausible_fit(checked.part(), geometry, settings))
    if len(samples) and not samples.wrench.any():
        plausibility.require_load(samples, np.ones(6, dtype=bool))
    cleaned = checked.samples
    complete = cleaned.has_pose_and_wrench
    for stretch in find_newest_plateaus(cleaned, steady.plateau, settings.leave_out):
        used = np.zeros(len(samples), dtype=bool)
        used[stretch.rows] = complete[stretch.rows]
        held_out = max(LEAST_HELD_OUT, round(HELD_OUT * used.sum()))
        newest = np.flatnonzero(complete)[-held_out:]
        if steady.rival is not None and len(newest):
            used[newest[0] :] = False
        if used.sum() < max(steady.least_samples, MIN_SAMPLES):
            continue
        if samples.stamps[used][-1] <= steady.after:
            return None  # the other plateaus are older
        fit = _plausible_fit(checked.part(used), geometry, settings)
        contest = None
        if steady.rival is not None:
            contest = _judge(steady.rival, fit.model, cleaned, newest, settings)
        return Refit(fit, contest, stretch.cause)
    return None


def _plausible_fit(
    samples: Samples, geometry: SocketGeometry, settings: IdentificationSettings
) -> Fit:
    """A fit that refuses a negated wrench: nobody would read a note before the model is used."""
    fit = fit_contact_model(samples, geometry, settings)
    note = plausibility.sign_note(samples, geometry)
    if note is not None:
        raise IdentificationError(note, "check the sign of the load cell; nothing is fitted before")
    return fit


def _judge(
    old: ContactModel,
    new: ContactModel,
    samples: Samples,
    rows: IntArray,
    settings: IdentificationSettings,
) -> Contest:
    """Compare the errors of two models, relative to the size of each group for any weights.

    Args:
        old: The model to be replaced.
        new: The model that would replace it.
        samples: N samples, which precede and include those of the comparison.
        rows: Indices of the samples of the comparison, shape (k,).
        settings: Settings of the fit.
    """
    measured = samples[rows].without(settings.leave_out).trusted_values
    size = np.repeat(group_sizes(measured), [3, 3, measured.shape[1] - 6])

    def error(model: ContactModel) -> float:
        predicted = model.predict(samples.pose, samples.clusters, samples.stamps)[rows]
        relative = (predicted - measured) / size
        wrench, clusters = rms(relative[:, :6], 0.0), rms(relative[:, 6:], 0.0)
        return float(np.sqrt(settings.theta * wrench**2 + (1.0 - settings.theta) * clusters**2))

    return Contest(len(rows), error(old), error(new))


def check_samples(
    samples: Samples, geometry: SocketGeometry, leave_out: tuple[str, ...]
) -> tuple[str, ...]:
    """Problems in some samples, in words, worst first; empty if they are good or too few.

    Args:
        samples: The samples, in the order of their stamps.
        geometry: The socket that they were measured in.
        leave_out: Channels that are not checked, such as `distal.Fz`.
    """
    if len(samples) < LEAST_CHECKED:
        return ()
    checked = CheckedSamples(samples, geometry, leave_out, whole=False)
    return tuple(map(str, checked.findings))
