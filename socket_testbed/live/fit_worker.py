"""Fits in a process of their own, so that none of them delays a prediction."""

from __future__ import annotations

import multiprocessing
import os
import signal
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from functools import partial

from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.fit import Fit, fit_contact_model
from socket_testbed.identification.problem import LEAST_SAMPLES
from socket_testbed.live.processes import end_with_parent
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import IdentificationSettings, PlateauSettings
from socket_testbed.trials.segment import find_plateaus

_NICENESS = 10


class FitWorker:
    """One process that fits one model at a time."""

    def __init__(self) -> None:
        self._open()

    def _open(self) -> None:
        self._pool = ProcessPoolExecutor(
            max_workers=1, mp_context=multiprocessing.get_context("spawn"), initializer=_step_back
        )
        # The libraries load now rather than within the first fit.
        self._loaded = self._pool.submit(os.getpid)

    @property
    def ready(self) -> bool:
        """Whether the process runs, with its libraries loaded."""
        return self._loaded.done()

    def submit(
        self,
        samples: Samples,
        geometry: SocketGeometry,
        settings: IdentificationSettings,
        plateau: PlateauSettings | None,
        least_samples: int,
    ) -> Future[Fit | None]:
        """Fit on the plateau of some samples, or on all of them.

        Args:
            samples: The samples.
            geometry: Geometry of the socket.
            settings: Settings of the identification.
            plateau: What counts as a plateau; None to fit on all samples.
            least_samples: Smallest plateau to fit on.

        Returns:
            The fit to come; None where there is no plateau large enough.
        """
        work = partial(_fit, samples, geometry, settings, plateau, least_samples)
        try:
            return self._pool.submit(work)
        except BrokenProcessPool:  # it was killed: the next one takes its place
            self._open()
            return self._pool.submit(work)

    def close(self) -> None:
        """End the process, whatever it is doing."""
        for process in list((self._pool._processes or {}).values()):
            process.terminate()
        # Joined here, the pool's thread is gone before the interpreter ends.
        self._pool.shutdown(wait=True, cancel_futures=True)


def _step_back() -> None:
    """Give way to the predictions, and end with the node even if that is killed."""
    os.nice(_NICENESS)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent(signal.SIGKILL)


def _fit(
    samples: Samples,
    geometry: SocketGeometry,
    settings: IdentificationSettings,
    plateau: PlateauSettings | None,
    least_samples: int,
) -> Fit | None:
    settings = replace(settings, pose_smoothing=0.0)  # live, every pose is predicted by itself
    if plateau is None:
        return fit_contact_model(samples, geometry, settings)
    plateaus = find_plateaus(samples, plateau)
    if not plateaus:
        return None
    steady = samples[plateaus[0].rows]
    if int(steady.complete.sum()) < max(least_samples, LEAST_SAMPLES):
        return None
    return fit_contact_model(steady, geometry, settings)
