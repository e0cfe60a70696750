import dataclasses
import os
import signal
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pytest

from socket_testbed.errors import IdentificationError
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.live.fit_worker import FitWorker
from socket_testbed.settings.identification import IdentificationSettings, PlateauSettings
from socket_testbed.trials.segment import find_plateaus
from socket_testbed.trials.synchronise import read_samples
from socket_testbed.trials.trial import Trial

pytestmark = pytest.mark.graph

TIMEOUT = 60.0  # [s]
SETTINGS = IdentificationSettings()


@pytest.fixture(scope="module")
def worker() -> Iterator[FitWorker]:
    worker = FitWorker()
    yield worker
    worker.close()


def test_a_fit_is_the_same_in_a_process_of_its_own(worker: FitWorker, hold: Path) -> None:
    trial = Trial(hold)
    samples = read_samples(trial)
    submitted = worker.submit(samples, trial.geometry, SETTINGS, PlateauSettings(), 50)
    fit = submitted.result(TIMEOUT)
    steady = samples[find_plateaus(samples, PlateauSettings())[0].rows]
    here = fit_contact_model(steady, trial.geometry, SETTINGS)
    assert fit is not None and worker.ready
    np.testing.assert_allclose(fit.model.stiffness, here.model.stiffness, rtol=1e-6, atol=1e-3)


def test_live_fits_do_not_average_the_poses(worker: FitWorker, hold: Path) -> None:
    trial = Trial(hold)
    samples = read_samples(trial)
    settings = dataclasses.replace(SETTINGS, pose_smoothing=2.0)
    fit = worker.submit(samples, trial.geometry, settings, None, 50).result(TIMEOUT)
    here = fit_contact_model(samples, trial.geometry, SETTINGS)
    assert fit is not None and fit.settings.pose_smoothing == 0.0
    np.testing.assert_allclose(fit.model.stiffness, here.model.stiffness, rtol=1e-6, atol=1e-3)


def test_without_enough_steady_data_there_is_no_fit(worker: FitWorker, hold: Path) -> None:
    trial = Trial(hold)
    samples = read_samples(trial)
    for some, least in ((samples, 10_000), (samples[:20], 5)):
        submitted = worker.submit(some, trial.geometry, SETTINGS, PlateauSettings(), least)
        assert submitted.result(TIMEOUT) is None


def test_an_error_comes_back_as_it_was_raised(worker: FitWorker, hold: Path) -> None:
    trial = Trial(hold)
    none = read_samples(trial)[:0]
    with pytest.raises(IdentificationError, match="only 0 of 0 samples") as raised:
        worker.submit(none, trial.geometry, SETTINGS, None, 1).result(TIMEOUT)
    assert raised.value.hint


def test_a_killed_worker_is_replaced(hold: Path) -> None:
    trial = Trial(hold)
    samples = read_samples(trial)
    worker = FitWorker()
    try:
        worker.submit(samples, trial.geometry, SETTINGS, None, 1).result(TIMEOUT)
        (process,) = worker._pool._processes
        os.kill(process, signal.SIGKILL)
        with pytest.raises(BrokenProcessPool):
            while True:  # until the pool has noticed
                worker._pool.submit(os.getpid).result(TIMEOUT)
        submitted = worker.submit(samples, trial.geometry, SETTINGS, None, 1)
        assert submitted.result(TIMEOUT) is not None
    finally:
        worker.close()
