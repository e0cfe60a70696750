"""Fits on live data: in the process of the worker, and as the function that it calls."""

import dataclasses
import os
import signal
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pytest
from support import HANGS
from support.wording import refused

from socket_testbed.errors import IdentificationError
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.live.fit_worker import FitWorker, Refit, Steady, fit_samples
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import IdentificationSettings, PlateauSettings
from socket_testbed.trials.segment import find_plateaus
from socket_testbed.trials.trial import Trial

SETTINGS = IdentificationSettings()
PLATEAU = PlateauSettings()
STEADY = Steady(PLATEAU, least_samples=30)


@pytest.fixture(scope="module")
def worker() -> Iterator[FitWorker]:
    worker = FitWorker()
    yield worker
    worker.close()


@pytest.fixture(scope="module")
def trial(hold: Path) -> Trial:
    return Trial(hold)


@pytest.fixture(scope="module")
def samples(trial: Trial) -> Samples:
    """A hold under load, without the ramps at its ends."""
    samples = trial.samples()
    return samples[find_plateaus(samples, PLATEAU)[0].rows]


@pytest.mark.graph
def test_a_process_fits_without_averaging_poses_and_is_replaced_when_killed(
    worker: FitWorker, trial: Trial, samples: Samples
) -> None:
    averaging = dataclasses.replace(SETTINGS, pose_smoothing=2.0)
    work = (fit_samples, samples, trial.geometry, averaging, STEADY)
    refit = worker.run(*work).result(HANGS)
    steady = samples[find_plateaus(samples, PLATEAU)[0].rows]
    here = fit_contact_model(steady, trial.geometry, SETTINGS).model
    assert refit is not None and refit.judgement is None and worker.ready
    assert refit.fit.settings.pose_smoothing == 0.0
    np.testing.assert_allclose(refit.fit.model.stiffness, here.stiffness, rtol=1e-6, atol=1e-3)
    (process,) = worker._pool._processes
    os.kill(process, signal.SIGKILL)
    with pytest.raises(BrokenProcessPool):
        while True:  # until the pool has noticed
            worker._pool.submit(os.getpid).result(HANGS)
    assert worker.run(*work).result(HANGS) is not None


# --- what is fitted


def test_the_newest_stretch_since_a_slip_is_fitted_and_judged_by_the_newest_samples(
    trial: Trial, samples: Samples
) -> None:
    """A cluster slips by 20 N in the middle of a hold."""
    row = len(samples) // 2
    local = samples.local_forces.copy()
    local[row:, 1, 2] -= 20.0
    samples = dataclasses.replace(samples, local_forces=local)
    found = fit_samples(samples, trial.geometry, SETTINGS, STEADY)
    assert found is not None
    assert row - 8 <= len(samples) - found.fit.samples <= row + 8
    assert found.fit.last_stamp == samples.stamps[-1]
    slip = samples.clusters[1]
    assert f"{slip}.Fz changed by -" in found.cause
    (error,) = (e for e in found.fit.errors if e.name == f"{slip}.Fz")
    assert error.rmse < 1.0

    before, after = (
        fit_contact_model(part, trial.geometry, SETTINGS).model
        for part in (samples[:row], samples[row:])
    )

    def refit(window: Samples, rival: ContactModel) -> Refit:
        steady = dataclasses.replace(STEADY, rival=rival)
        found = fit_samples(window, trial.geometry, SETTINGS, steady)
        assert found is not None and found.judgement is not None
        newest = window.complete.sum() - found.judgement.samples
        assert found.fit.last_stamp < window.stamps[window.complete][newest]
        return found

    # It replaces a model of the time before the slip; a model of the time after it stays while
    # steady data from before it is all that can be fitted.
    assert not refit(samples, before).is_worse
    assert refit(samples[: row + 16], after).is_worse


def test_without_enough_steady_data_that_is_newer_than_the_model_s_there_is_no_fit(
    trial: Trial, samples: Samples
) -> None:
    older = dataclasses.replace(STEADY, after=int(samples.stamps[-1]))
    for some, steady in (
        (samples, older),
        (samples, Steady(PLATEAU, 10_000)),
        (samples[:20], Steady(PLATEAU, 5)),
    ):
        assert fit_samples(some, trial.geometry, SETTINGS, steady) is None
    negated = dataclasses.replace(samples, wrench=-samples.wrench)
    for wrong, condition, text in (
        (negated, STEADY, "negated"),
        (samples[:0], None, "only 0 of 0"),
    ):
        with refused(IdentificationError, text):
            fit_samples(wrong, trial.geometry, SETTINGS, condition)
