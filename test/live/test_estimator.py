"""The online estimator without ROS: what it makes of measurements, when and on what it fits."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import HANGS
from support.problems import make_samples
from support.wording import refused

from socket_testbed.errors import ConfigurationError, IdentificationError
from socket_testbed.geometry.pose import Pose
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.fit import Fit, FittedModel, fit_contact_model
from socket_testbed.identification.force_map import ForceMap, MapEstimate
from socket_testbed.identification.model_file import read_model, write_model
from socket_testbed.identification.wrench import WrenchModel, _fit_memory
from socket_testbed.live import estimator
from socket_testbed.live.fit_worker import Contest, FitWorker, Refit, Steady, fit_samples
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import ForceMapSettings, IdentificationSettings
from socket_testbed.settings.testbed import EstimatorSettings, WindowSettings
from socket_testbed.trials.segment import find_plateaus
from socket_testbed.trials.trial import Trial
from socket_testbed.wire.topics import PYLON_POSE, SOCKET_POSE, STRESS, WRENCH, Topic

PERIOD = 250_000_000  # [ns]
PRIOR = ForceMapSettings(draws=4)


class FakeFitter:
    """A fitter without a process: the test says when and how each fit ends."""

    def __init__(self) -> None:
        self.requests: list[SimpleNamespace] = []
        self.checks: list[tuple[Samples, Future[tuple[str, ...]]]] = []

    def run(self, work: Any, samples: Samples, geometry: Any, *given: Any) -> "Future[Any]":
        future: Future[Any] = Future()
        if work is fit_samples:
            asked = {"samples": samples, "settings": given[0], "steady": given[1]}
            self.requests.append(SimpleNamespace(**asked, future=future))
        else:
            self.checks.append((samples, future))
        return future


@pytest.fixture(scope="module")
def trial(hold: Path) -> Trial:
    return Trial(hold)


@pytest.fixture(scope="module")
def fit(trial: Trial) -> Fit:
    return fit_contact_model(trial.samples(), trial.geometry, IdentificationSettings())


class Bench:
    """An estimator with what it is given, what it returned and which models it reported."""

    def __init__(self, trial: Trial, **window: Any) -> None:
        self.fitter: Any = FakeFitter()
        self.settings = EstimatorSettings(window=WindowSettings(**window), force_map=PRIOR)
        self.models: list[FittedModel] = []
        self.mapped: list[int] = []  # stamps in periods
        self.predicted: dict[int, np.ndarray] = {}  # wrenches by stamp in periods
        self.geometry = trial.geometry
        self.estimator = estimator.OnlineEstimator(
            self.geometry, lambda: self.settings, self.fitter, self.models.append
        )

    def values(self, shift: float = 0.0) -> dict[Topic, Any]:
        """One measurement of each kind; `shift` moves the limb [m]."""
        upright = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
        moved = np.array([0.0, 0.0, shift, 0.0, 0.0, 0.0, 1.0])
        stress = {name: (np.array([1e4, 0.0, 0.0]), 0) for name in self.geometry.clusters}
        return {STRESS: stress, WRENCH: np.arange(6.0), SOCKET_POSE: upright, PYLON_POSE: moved}

    def add(self, topic: Topic, number: int, value: Any) -> Any:
        found = self.estimator.add(topic, number * PERIOD, value)
        self.mapped += [number] * (found.force_map is not None)
        if found.wrench is not None:
            self.predicted[number] = found.wrench
        return found

    def send(self, count: int, start: int = 0, lacking: Topic | None = None) -> None:
        for k in range(start, start + count):
            self.estimator.trigger(k * PERIOD)
            for topic, value in self.values(1e-4 * k).items():
                if topic is not lacking:
                    self.add(topic, k, value)

    def answer(self, request: int, fit: Fit, **refit: Any) -> None:
        self.fitter.requests[request].future.set_result(Refit(fit, **refit))

    def figures(self, *names: str) -> list[Any]:
        return [self.estimator.figures()[name] for name in names]


@pytest.fixture
def bench(trial: Trial) -> Bench:
    return Bench(trial, least_samples=20, refit_after=30)


@pytest.fixture
def fitted(bench: Bench, fit: Fit) -> Bench:
    """A bench whose first fit, on 20 samples, is done."""
    bench.send(20)
    bench.answer(0, fit)
    return bench


# --- measurements by stamp, and the window


@pytest.mark.parametrize("separate", [True, False], ids=["predictor", "springs"])
def test_wrench_and_forces_are_those_of_the_model(fit: Fit, trial: Trial, separate: bool) -> None:
    model, samples = fit.model, trial.samples()[:20]
    assert model.of_wrench is not None and model.force_bias
    model = model if separate else dataclasses.replace(model, of_wrench=None)
    wrench, forces = model.wrench_and_forces(samples.pose, samples.stamps, None)
    np.testing.assert_array_equal(wrench, model.wrench(samples.pose, samples.stamps))
    np.testing.assert_array_equal(forces, model.forces(samples.pose))


def test_a_window_holds_the_newest_samples_by_stamp() -> None:
    window, pose = estimator.SampleWindow(duration=3.0), np.zeros((1, 3))
    stamps = [round(k * 1e7 * (1.0 + (k > 700))) for k in range(2000)]  # 100 Hz, then 50 Hz
    late = stamps[-1] - 1_500_000_001
    for stamp in [*stamps, late]:
        forces, status = np.full((1, 2, 3), 7.0), np.zeros((1, 2), dtype=np.uint8)
        wrench = np.full((1, 6), float(stamp))
        window.add(Samples(np.array([stamp]), pose, pose, wrench, ("p", "q"), forces, status))
    samples = window.samples()
    assert samples.stamps.tolist() == sorted([*(s for s in stamps if s >= stamps[-1] - 3e9), late])
    assert samples.wrench[:, 0].tolist() == samples.stamps.tolist()


def test_a_sample_is_predicted_whatever_the_order(fitted: Bench, fit: Fit) -> None:
    values = fitted.values(2e-3)
    values[PYLON_POSE][3:] = [0.01, -0.02, 0.005, np.sqrt(1.0 - 5.25e-4)]  # turned
    limb = fitted.geometry.limb_pose(
        *(Pose.from_quaternion(v[None, :3], v[None, 3:]) for v in list(values.values())[2:])
    )
    pose = np.hstack([limb.translation, limb.rotation_vector()])
    arrivals = [(k, topic) for k in range(100, 120) for topic in estimator.MEASURED]
    np.random.default_rng(0).shuffle(arrivals)
    found = [fitted.add(topic, number, values[topic]) for number, topic in arrivals]
    last = {number: place for place, (number, _) in enumerate(arrivals)}
    assert list(fitted.predicted) == sorted(last, key=lambda number: last[number])
    for wrench in list(fitted.predicted.values()):
        np.testing.assert_allclose(wrench, fit.model.wrench(pose)[0])
    forces = [estimates.forces for estimates in found if estimates.forces is not None]
    np.testing.assert_allclose(forces, fit.model.forces(pose).repeat(20, axis=0))
    # A map asks for no pose.
    needed = {n: i for i, (n, topic) in enumerate(arrivals) if topic in (STRESS, WRENCH)}
    assert fitted.mapped[20:] == sorted(needed, key=lambda number: needed[number])


@pytest.mark.parametrize(
    ("lacking", "mapped"),
    [
        pytest.param(STRESS, 0, id="stress"),
        pytest.param(WRENCH, 0, id="wrench"),
        pytest.param(SOCKET_POSE, 30, id="socket-pose"),
        pytest.param(PYLON_POSE, 30, id="pylon-pose"),
    ],
)
def test_an_incomplete_sample_is_never_fitted(trial: Trial, lacking: Topic, mapped: int) -> None:
    """Nor predicted, nor matched by nearest."""
    bench = Bench(trial, least_samples=10, pending=5)
    bench.send(30, lacking=lacking)
    for stamp in (0, 29 * PERIOD - 1):  # too late, and of no sample
        found = bench.estimator.add(lacking, stamp, bench.values()[lacking])
        assert found == (None, None, None)
    assert len(bench.mapped) == mapped
    assert bench.figures("samples", "window") == [0, 0] and not bench.fitter.requests
    assert bench.figures("incomplete")[0] >= 25


def test_a_cluster_not_in_the_message_is_missing(bench: Bench) -> None:
    stresses, geometry = bench.values()[STRESS], bench.geometry
    absent, _ = stresses.popitem()
    forces, status = estimator.cluster_forces(geometry, stresses)
    column = tuple(geometry.clusters).index(absent)
    assert status[column] == 2 and np.isnan(forces[column]).all()
    known = [geometry.cluster_force(name, stress) for name, (stress, _) in stresses.items()]
    np.testing.assert_allclose(np.delete(forces, column, axis=0), known)


def test_a_jump_back_in_time_clears_the_window(fitted: Bench, fit: Fit) -> None:
    fitted.send(5, start=1000)
    fitted.add(WRENCH, 2, np.zeros(6))  # pending
    fitted.estimator.trigger(2 * PERIOD)
    assert fitted.figures("window") == [0] and fitted.estimator.newest == 0
    for topic, value in fitted.values().items():
        if topic is not WRENCH:
            assert fitted.add(topic, 2, value) == (None, None, None)
    # The model stays, and older stamps are new to it.
    fitted.send(30, start=3)
    steady = fitted.fitter.requests[1].steady
    assert steady.after == 0 and steady.rival is fit.model
    # So are they to a fit that began before the jump.
    fitted.estimator.trigger(0)
    fitted.answer(1, fit)
    fitted.send(30)
    assert fitted.fitter.requests[2].steady.after == 0


# --- the map of a sample


class LiveMap:
    """The map of a running testbed, and what the map of a trial makes of other values."""

    def __init__(self, trial: Trial) -> None:
        self.sample = trial.samples()[100:101]
        self.settings = EstimatorSettings(force_map=PRIOR)
        self.geometry = trial.geometry
        self.map = estimator.OnlineMap(trial.geometry, lambda: self.settings)

    def update(self, **values: Any) -> MapEstimate:
        found = self.map.update(dataclasses.replace(self.sample, **values))
        assert found is not None
        return found

    def check(self, found: MapEstimate, prior: ForceMapSettings = PRIOR, **values: Any) -> None:
        usual = ForceMap(self.geometry, self.sample.clusters, prior)
        sample = dataclasses.replace(self.sample, **values)
        for name, own in vars(usual.update(sample)).items():
            np.testing.assert_equal(getattr(found, name), own, err_msg=name)


@pytest.fixture
def live(trial: Trial) -> LiveMap:
    return LiveMap(trial)


@pytest.mark.parametrize("force", [1e9, -1e9], ids=["positive", "negative"])
def test_a_force_that_no_limb_gives_is_unmapped(force: float, live: LiveMap) -> None:
    spoilt, lacking = live.sample.wrench.copy(), live.sample.wrench.copy()
    spoilt[0, 3], lacking[0, 3] = force, np.nan
    live.check(live.update(wrench=spoilt), wrench=lacking)


def test_a_channel_that_is_left_out_is_unmapped(live: LiveMap) -> None:
    """And a changed prior counts from the next sample."""
    live.update()
    forces = live.sample.local_forces.copy()
    forces[0, live.sample.clusters.index("distal"), 2] = np.nan
    left_out = IdentificationSettings(leave_out=("distal.Fz", "no such channel"))
    prior = dataclasses.replace(PRIOR, length=0.1)
    live.settings = EstimatorSettings(identification=left_out, force_map=prior)
    live.check(live.update(), prior, local_forces=forces)


def test_a_sample_whose_map_nobody_wants_counts_for_later_maps(live: LiveMap) -> None:
    """The next map and the outputs are those after both samples."""
    usual = ForceMap(live.geometry, live.sample.clusters, PRIOR)
    usual.update(live.sample)
    other = dataclasses.replace(live.sample, wrench=0.5 * live.sample.wrench)
    assert live.map.update(live.sample, wanted=False) is None
    assert live.map.outputs() is not None and live.map.count == 0
    found = live.update(wrench=other.wrench)
    for name, own in vars(usual.update(other)).items():
        np.testing.assert_equal(getattr(found, name), own, err_msg=name)
    alone = ForceMap(live.geometry, live.sample.clusters, PRIOR).update(other)
    assert not np.array_equal(alone.forces, found.forces)


def test_a_sample_of_nothing_has_no_outputs(live: LiveMap) -> None:
    live.update()
    assert live.map.outputs() is not None
    live.update(wrench=live.sample.wrench * np.nan, status=live.sample.status + 2)
    assert live.map.outputs() is None


# --- when to fit


def test_it_fits_once_the_window_holds_enough(bench: Bench) -> None:
    bench.send(19)
    assert not bench.fitter.requests
    bench.send(31, start=19)
    (request,) = bench.fitter.requests  # one at a time
    assert len(request.samples) == 20
    assert request.steady == Steady(bench.settings.plateau, least_samples=20)
    assert request.settings == bench.settings.identification
    assert not bench.predicted and bench.estimator.newest == 49 * PERIOD
    assert bench.figures("samples", "triggers", "window", "maps") == [50, 50, 50, 50]
    request.future.set_result(None)  # without a plateau it tries again
    assert bench.estimator.state[0] == 0 and "no model yet" in bench.estimator.state[1]
    bench.send(1, start=50)
    assert len(bench.fitter.requests) == 2


def test_it_fits_again_after_as_many_samples(fitted: Bench, fit: Fit) -> None:
    fitted.send(29, start=20)
    assert len(fitted.fitter.requests) == 1
    fitted.send(1, start=49)
    _, again = fitted.fitter.requests
    assert again.steady.rival is fit.model and again.steady.after == fit.last_stamp


@pytest.mark.parametrize(
    "error",
    [
        pytest.param(
            IdentificationError("the samples say nothing", "load the socket"), id="refused"
        ),
        pytest.param(BrokenProcessPool(), id="worker-died"),
    ],
)
def test_a_fit_that_fails_leaves_the_model(fitted: Bench, fit: Fit, error: Exception) -> None:
    fitted.send(30, start=20)
    fitted.fitter.requests[1].future.set_exception(error)
    assert fitted.estimator.state == (2, f"no fit: {error}")
    fitted.send(30, start=50)
    assert 79 in fitted.predicted
    assert fitted.fitter.requests[2].steady.rival is fit.model
    fitted.answer(2, fit)
    assert fitted.estimator.state[0] == 0


def test_a_model_of_other_settings_is_replaced(fitted: Bench, fit: Fit) -> None:
    """Models of alike settings are compared."""
    fitted.send(30, start=20)
    fitted.answer(1, fit)
    theta = dataclasses.replace(fitted.settings.identification, theta=0.1)
    fitted.settings = dataclasses.replace(fitted.settings, identification=theta)
    for request in range(2, 6):
        fitted.send(30, start=30 * request - 10)
        assert 30 * request + 19 in fitted.predicted
        if request < 4:
            fitted.fitter.requests[request].future.set_exception(BrokenProcessPool())
        else:
            fitted.answer(request, fit)
            assert fitted.estimator.state[0] == 0
    steady = [request.steady for request in fitted.fitter.requests[1:]]
    assert [each.rival for each in steady] == [fit.model, None, None, None, fit.model]
    assert [each.after for each in steady] == [fit.last_stamp, 0, 0, 0, fit.last_stamp]


@pytest.fixture
def on_request(bench: Bench) -> Bench:
    """A bench of 20 samples that fits on request alone."""
    bench.settings = dataclasses.replace(bench.settings, auto_fit=False)
    bench.send(20)
    return bench


def test_data_is_checked_every_two_seconds(on_request: Bench) -> None:
    ((samples, future),) = on_request.fitter.checks
    assert len(samples) == 9 and not on_request.fitter.requests
    future.set_result(("data: check Fx: it stands still", "data: check the mass"))
    level, text = on_request.estimator.state
    assert level == 1 and text.startswith("data: check Fx: it stands still (and 1 more); no mod")


def test_a_fit_on_request_takes_all_samples(on_request: Bench, fit: Fit) -> None:
    with ThreadPoolExecutor() as pool:
        answer = pool.submit(on_request.estimator.fit)
        while not on_request.fitter.requests:
            pass
        with refused(IdentificationError, "a fit is running already: ask again"):
            on_request.estimator.fit()
        (request,) = on_request.fitter.requests
        assert len(request.samples) == 20 and request.steady is None
        request.future.set_result(Refit(fit))
        assert answer.result(HANGS) is fit and on_request.models == [fit]


@pytest.mark.parametrize("worse", [False, True], ids=["refit-better", "refit-worse"])
def test_the_better_model_of_newest_samples_stays(bench: Bench, fit: Fit, worse: bool) -> None:
    fit = dataclasses.replace(fit, model=dataclasses.replace(fit.model, of_wrench=None))
    bench.send(20)
    bench.answer(0, fit, cause="distal.Fz changed by -20.0 N")
    assert "older samples left out: distal.Fz changed by -20.0 N" in bench.estimator.state[1]
    bench.send(30, start=20)
    model = dataclasses.replace(fit.model, wrench_bias=fit.model.wrench_bias + 1.0)
    other = dataclasses.replace(fit, model=model, samples=7)
    bench.answer(1, other, contest=Contest(24, 0.05, 0.06 if worse else 0.04))
    for topic, value in bench.values(1e-4 * 49).items():
        bench.add(topic, 50, value)
    np.testing.assert_allclose(bench.predicted[50] - bench.predicted[49], 1.0 - worse)
    assert bench.models == [fit, other][: 2 - worse]
    assert bench.figures("fits", "refused", "predictions") == [2 - worse, worse, 31]
    level, text = bench.estimator.state
    assert level == 0 and ("kept: " in text) == worse
    assert "the newest 24 samples a refit has an error of 0.0" in text


def exchange_two_clusters(geometry: dict[str, Any]) -> None:
    clusters = geometry["clusters"]
    first, second, *_ = clusters
    clusters[first], clusters[second] = clusters[second], clusters[first]


def lift_a_tile(geometry: dict[str, Any]) -> None:
    anchor = next(iter(geometry["tiles"].values()))["anchor"]
    anchor[2] += 0.01


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        pytest.param(exchange_two_clusters, "had another tile or area", id="clusters-exchanged"),
        pytest.param(lift_a_tile, "another socket", id="tile-lifted"),
    ],
)
def test_a_model_of_another_socket_is_refused(
    bench: Bench, hold_model: Path, tmp_path: Path, change: Any, wrong: str
) -> None:
    document = json.loads(hold_model.read_text())
    change(document["geometry"])
    (tmp_path / "model.json").write_text(json.dumps(document))
    with refused(ConfigurationError, wrong):
        bench.estimator.load(tmp_path / "model.json")


def test_a_stored_model_predicts_at_once(bench: Bench, hold_model: Path) -> None:
    bench.estimator.load(hold_model)
    (reported,) = bench.models
    assert isinstance(reported, FittedModel) and reported.trial == read_model(hold_model).trial
    assert bench.estimator.state == (0, f"predicting with the model of {reported.trial}")
    bench.send(2)
    for topic, value in bench.values(np.nan).items():  # a marker is occluded
        bench.add(topic, 2, value)
    assert list(bench.predicted) == [0, 1, 2]
    assert np.isnan(bench.predicted[2]).all() and np.isfinite(bench.predicted[1]).all()


# --- fits, in the process of the worker

SETTINGS = IdentificationSettings()
PLATEAU = EstimatorSettings().plateau
STEADY = Steady(PLATEAU, least_samples=30)


@pytest.fixture(scope="module")
def worker() -> Iterator[FitWorker]:
    worker = FitWorker()
    yield worker
    worker.close()


@pytest.fixture(scope="module")
def samples(trial: Trial) -> Samples:
    """A hold under load, without the ramps at its ends."""
    samples = trial.samples()
    return samples[find_plateaus(samples, PLATEAU)[0].rows]


@pytest.mark.parametrize(("of_node", "code"), [(True, 0), (False, 1)], ids=["its node", "killed"])
def test_a_worker_whose_node_was_killed_meanwhile_ends(of_node: bool, code: int) -> None:
    """Its parent is another process then."""
    node = "os.getppid()" if of_node else "os.getppid() + 1"
    program = f"import os; from socket_testbed.live.fit_worker import _begin; _begin({node})"
    ended = subprocess.run([sys.executable, "-c", program], check=False, timeout=60)
    assert ended.returncode == code


@pytest.mark.graph
def test_a_killed_worker_is_replaced(worker: FitWorker, trial: Trial, samples: Samples) -> None:
    averaging = dataclasses.replace(SETTINGS, pose_smoothing=2.0)
    work = (fit_samples, samples, trial.geometry, averaging, STEADY)
    refit = worker.run(*work).result(HANGS)
    steady = samples[find_plateaus(samples, PLATEAU)[0].rows]
    here = fit_contact_model(steady, trial.geometry, SETTINGS).model
    assert refit is not None and refit.contest is None and worker.ready
    assert refit.fit.settings.pose_smoothing == 0.0
    np.testing.assert_allclose(refit.fit.model.stiffness, here.stiffness, rtol=1e-6, atol=1e-3)
    (process,) = worker._pool._processes
    os.kill(process, signal.SIGKILL)
    with pytest.raises(BrokenProcessPool):
        while True:  # until the pool has noticed
            worker._pool.submit(os.getpid).result(HANGS)
    assert worker.run(*work).result(HANGS) is not None


# --- what is fitted


def test_the_newest_stretch_since_a_slip_is_fitted(trial: Trial, samples: Samples) -> None:
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
        assert found is not None and found.contest is not None
        newest = window.has_pose_and_wrench.sum() - found.contest.samples
        assert found.fit.last_stamp < window.stamps[window.has_pose_and_wrench][newest]
        return found

    # It replaces a model of before; one of after stays while all that can be fitted is of before.
    assert not refit(samples, before).is_worse
    assert refit(samples[: row + 16], after).is_worse


def test_outliers_do_not_end_a_stretch(trial: Trial, samples: Samples) -> None:
    wrench, position = samples.wrench.copy(), samples.position.copy()
    wrench[[20, 30], 3], position[40] = 1e9, 5.0
    spoilt = dataclasses.replace(samples, wrench=wrench, position=position)
    clean, found = (fit_samples(s, trial.geometry, SETTINGS, STEADY) for s in (samples, spoilt))
    assert found.fit.samples == clean.fit.samples - 3


@pytest.mark.parametrize(
    ("change", "steady"),
    [
        pytest.param(lambda s: s, lambda s: {"after": int(s.stamps[-1])}, id="no-newer-data"),
        pytest.param(lambda s: s, lambda _: {"least_samples": 10_000}, id="too-few-samples"),
        pytest.param(
            lambda s: dataclasses.replace(s, position=np.full_like(s.position, np.nan)),
            lambda _: {"rival": object()},
            id="occluded",
        ),
        pytest.param(lambda s: s[:20], lambda _: {"least_samples": 5}, id="too-short"),
    ],
)
def test_without_newer_steady_data_nothing_is_fitted(
    trial: Trial, samples: Samples, change: Any, steady: Any
) -> None:
    asked = dataclasses.replace(STEADY, **steady(samples))
    assert fit_samples(change(samples), trial.geometry, SETTINGS, asked) is None


@pytest.mark.parametrize(
    ("change", "steady", "text"),
    [
        pytest.param(
            *(lambda s: dataclasses.replace(s, wrench=-s.wrench), STEADY, "negated"), id="negated"
        ),
        pytest.param(lambda s: s[:0], None, "only 0 of 0", id="empty"),
    ],
)
def test_wrong_samples_are_refused(
    trial: Trial, samples: Samples, change: Any, steady: Steady | None, text: str
) -> None:
    with refused(IdentificationError, text):
        fit_samples(change(samples), trial.geometry, SETTINGS, steady)


@pytest.mark.parametrize("loaded", [True, False], ids=["loaded", "fitted"])
def test_a_live_memory_is_that_of_the_trial(
    bench: Bench, fit: Fit, loaded: bool, tmp_path: Path
) -> None:
    """A model that arrives later knows the poses of the window."""
    rng = np.random.default_rng(2)
    motion = np.column_stack([np.sin(np.arange(160) / n) for n in range(3, 9)])
    own = make_samples(1e-3 * motion, rng.normal(size=(160, 6)), {"a": np.zeros((160, 3))})
    memory = _fit_memory(own, own.pose, own.wrench, np.arange(0, 160, 2))
    measured = bench.values(2.5e-3)
    limb = bench.geometry.limb_of(measured[SOCKET_POSE], measured[PYLON_POSE])
    middle = np.append(limb.translation, limb.rotation_vector())
    of_wrench = WrenchModel(middle, np.zeros((6, 6)), np.zeros(6), np.ones(6), memory)
    fit = dataclasses.replace(fit, model=dataclasses.replace(fit.model, of_wrench=of_wrench))
    if loaded:
        write_model(fit, tmp_path / "model.json", {"name": "made up"})
        bench.estimator.load(tmp_path / "model.json")
        bench.send(50)
    else:
        bench.send(20)
        bench.answer(0, fit)
        bench.send(30, start=20)
    window = bench.estimator._window.samples()
    expected = fit.model.wrench(window.pose, window.stamps)
    assert np.ptp(expected[:, 3]) > 0.01
    np.testing.assert_allclose(bench.predicted[49], expected[49], rtol=1e-6)
