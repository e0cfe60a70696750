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
from socket_testbed.live.fit_worker import FitWorker, Refit, Steady
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import IdentificationSettings, PlateauSettings
from socket_testbed.trials.segment import find_plateaus
from socket_testbed.trials.trial import Trial

pytestmark = pytest.mark.graph

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


@pytest.fixture
def slipped(samples: Samples) -> tuple[Samples, int]:
    """The hold with a cluster that slips by 20 N, and the row of the first sample after it."""
    row = len(samples) // 2
    local = samples.local_forces.copy()
    local[row:, 1, 2] -= 20.0
    return dataclasses.replace(samples, local_forces=local), row


def test_a_fit_is_the_same_in_a_process_of_its_own_but_does_not_average_poses(
    worker: FitWorker, trial: Trial, samples: Samples
) -> None:
    averaging = dataclasses.replace(SETTINGS, pose_smoothing=2.0)
    refit = worker.submit(samples, trial.geometry, averaging, STEADY).result(HANGS)
    steady = samples[find_plateaus(samples, PLATEAU)[0].rows]
    here = fit_contact_model(steady, trial.geometry, SETTINGS).model
    assert refit is not None and refit.comparison is None and worker.ready
    assert refit.fit.settings.pose_smoothing == 0.0
    found = refit.fit.model.stiffness
    np.testing.assert_allclose(found, here.stiffness, rtol=1e-6, atol=1e-3)


# --- what is fitted


def test_the_newest_stretch_is_fitted_and_none_across_a_slip_of_a_cluster(worker, trial, slipped):
    samples, row = slipped
    refit = worker.submit(samples, trial.geometry, SETTINGS, STEADY).result(HANGS)
    assert refit is not None
    assert row - 8 <= len(samples) - refit.fit.samples <= row + 8
    assert refit.fit.last_stamp == samples.stamps[-1]
    slip = samples.clusters[1]
    assert f"{slip}.Fz changed by -" in refit.cause
    (error,) = (e for e in refit.fit.errors if e.name == f"{slip}.Fz")
    assert error.rmse < 1.0


def test_a_refit_is_judged_by_the_newest_samples_which_it_left_out(worker, trial, slipped) -> None:
    samples, row = slipped
    before, after = (
        fit_contact_model(part, trial.geometry, SETTINGS).model
        for part in (samples[:row], samples[row:])
    )

    def refit(window: Samples, rival: ContactModel) -> Refit:
        steady = dataclasses.replace(STEADY, rival=rival)
        found = worker.submit(window, trial.geometry, SETTINGS, steady).result(HANGS)
        assert found is not None and found.comparison is not None
        newest = window.complete.sum() - found.comparison.samples
        assert found.fit.last_stamp < window.stamps[window.complete][newest]
        return found

    # It replaces a model of the time before the slip; a model of the time after it stays while
    # steady data from before it is all that can be fitted.
    assert not refit(samples, before).is_worse
    assert refit(samples[: row + 16], after).is_worse


def test_without_enough_steady_data_that_is_newer_than_the_model_s_there_is_no_fit(
    worker: FitWorker, trial: Trial, samples: Samples
) -> None:
    older = dataclasses.replace(STEADY, after=int(samples.stamps[-1]))
    for some, steady in (
        (samples, older),
        (samples, Steady(PLATEAU, 10_000)),
        (samples[:20], Steady(PLATEAU, 5)),
    ):
        assert worker.submit(some, trial.geometry, SETTINGS, steady).result(HANGS) is None


def test_what_cannot_be_fitted_is_refused_with_its_error(worker, trial, samples) -> None:
    negated = dataclasses.replace(samples, wrench=-samples.wrench)
    for wrong, steady, text in ((negated, STEADY, "negated"), (samples[:0], None, "only 0 of 0")):
        submitted = worker.submit(wrong, trial.geometry, SETTINGS, steady)
        with refused(IdentificationError, text):
            submitted.result(HANGS)


def test_outliers_are_named_by_channel_and_do_not_end_a_stretch(worker, trial, samples) -> None:
    wrench, position = samples.wrench.copy(), samples.position.copy()
    wrench[[20, 30], 3] = 1e9
    position[40] = 5.0
    wrong = dataclasses.replace(samples, wrench=wrench, position=position)
    for left_out in ((), ("Fx",)):
        found = "; ".join(worker.check(wrong, trial.geometry, left_out).result(HANGS))
        assert "limb position" in found and ("Fx" in found) is not bool(left_out)
    assert worker.check(samples, trial.geometry, ()).result(HANGS) == ()
    clean, found = (
        worker.submit(some, trial.geometry, SETTINGS, STEADY).result(HANGS)
        for some in (samples, wrong)
    )
    assert found.fit.samples == clean.fit.samples - 3


def test_a_killed_worker_is_replaced(worker: FitWorker, trial: Trial, samples: Samples) -> None:
    worker.submit(samples, trial.geometry, SETTINGS, None).result(HANGS)
    (process,) = worker._pool._processes
    os.kill(process, signal.SIGKILL)
    with pytest.raises(BrokenProcessPool):
        while True:  # until the pool has noticed
            worker._pool.submit(os.getpid).result(HANGS)
    submitted = worker.submit(samples, trial.geometry, SETTINGS, None)
    assert submitted.result(HANGS) is not None
