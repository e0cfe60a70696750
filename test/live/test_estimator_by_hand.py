"""Online estimation of the scene: its window, its words, and contests of models, by hand."""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import scene
from support.wording import refused

from socket_testbed.errors import IdentificationError
from socket_testbed.live import estimator, fit_worker
from socket_testbed.live.estimator import OnlineEstimator, SampleWindow
from socket_testbed.live.fit_worker import Contest, Refit
from socket_testbed.live.graph_status import GraphStatus
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import IdentificationSettings
from socket_testbed.settings.testbed import EstimatorSettings, WindowSettings
from socket_testbed.wire import topics

OK, WARN, ERROR = 0, 1, 2
SECOND = 10**9  # [ns]


def sample(stamp: int) -> Samples:
    """A sample without any force."""
    rest = np.zeros((1, 3))
    clusters = tuple(scene.CLUSTERS)
    forces, status = np.zeros((1, 4, 3)), np.zeros((1, 4), np.uint8)
    return Samples(np.array([stamp]), rest, rest, np.zeros((1, 6)), clusters, forces, status)


# --- the window


@pytest.mark.parametrize(
    ("newest", "kept"), [(10.0, [0.0, 4.0, 10.0]), (10.001, [4.0, 10.001])], ids=["at", "over"]
)
def test_a_window_keeps_its_duration(newest: float, kept: list[float]) -> None:
    window = SampleWindow(10.0)
    for second in (0.0, 4.0, newest):
        window.add(sample(round(second * 1e9)))
    assert len(window) == len(kept)
    assert (window.samples().stamps * 1e-9).tolist() == pytest.approx(kept)


def test_a_future_stamp_does_not_stop_a_window() -> None:
    """Nothing older than a sample that claims to be of tomorrow was ever dropped."""
    window = SampleWindow(10.0)
    for second in (0, 86_400, *range(1, 30)):
        window.add(sample(second * SECOND))
    assert (window.samples().stamps // SECOND).tolist() == list(range(19, 30))


def test_samples_with_one_stamp_fill_a_bounded_window() -> None:
    """No trigger is faster than 500 Hz: 0.1 s hold 50 samples."""
    window = SampleWindow(0.1)
    for _ in range(200):
        window.add(sample(SECOND))
    assert len(window) == len(window.samples()) == 50


def test_an_empty_window_says_where_to_look() -> None:
    window = SampleWindow(10.0)
    window.add(sample(0))
    window.clear()
    assert len(window) == 0
    with refused(IdentificationError, "there is no complete sample to fit: see in the diagnostics"):
        window.samples()


# --- the estimator


class Fitter:
    """Stands for the worker process: what it was asked for, as futures."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, Future[Any]]] = []

    def run(self, work: Callable[..., Any], *given: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.asked.append((work.__name__, future))
        return future


@pytest.fixture
def fitter() -> Fitter:
    return Fitter()


@pytest.fixture
def settings() -> dict[str, EstimatorSettings]:
    window = WindowSettings(least_samples=12, refit_after=3, pending=2)
    return {"now": EstimatorSettings(window=window)}


@pytest.fixture
def online(
    monkeypatch: pytest.MonkeyPatch, fitter: Fitter, settings: dict[str, EstimatorSettings]
) -> OnlineEstimator:
    scene.stand_in(monkeypatch)
    return OnlineEstimator(scene.geometry(), lambda: settings["now"], fitter, lambda model: None)


def send(online: OnlineEstimator, second: float) -> estimator.Estimates:
    """A complete sample."""
    stamp = scene.START + round(second * 1e9)
    online.trigger(stamp)
    online.add(topics.STRESS, stamp, {n: (np.array([1e4, 0, 0]), 0) for n in scene.CLUSTERS})
    online.add(topics.WRENCH, stamp, np.arange(6.0))
    online.add(topics.SOCKET_POSE, stamp, np.eye(7)[6])
    return online.add(topics.PYLON_POSE, stamp, np.eye(7)[6])


def fit(**changes: Any) -> Any:
    """Stands for a fit of 80 samples that determines 30 of 36 directions."""
    model = SimpleNamespace(
        variant="rigid_bias",
        stiffness=np.zeros((12, 3)),
        trail=lambda: None,
        wrench_and_forces=lambda pose, stamps, trail: (
            np.ones((len(pose), 6)),
            np.full((len(pose), 12, 3), 2.0),
        ),
    )
    own = {"model": model, "samples": 80, "determined": 29.7, "last_stamp": scene.START}
    return SimpleNamespace(**own | changes)


def test_it_begins_by_waiting(online: OnlineEstimator) -> None:
    words = "no model yet: waiting for steady data or estimator/fit"
    assert online.state == (OK, words) and online.newest == 0
    counts = ("triggers", "samples", "predictions", "fits", "refused", "incomplete")
    assert online.figures() == dict.fromkeys((*counts, "window", "maps"), 0)


def test_without_automatic_fits_it_waits_for_a_request(
    monkeypatch: pytest.MonkeyPatch, fitter: Fitter
) -> None:
    scene.stand_in(monkeypatch)
    chosen = EstimatorSettings(auto_fit=False)
    online = OnlineEstimator(scene.geometry(), lambda: chosen, fitter, lambda model: None)
    assert online.state == (OK, "no model yet: estimator/fit")


def test_the_first_fit_waits_for_enough(online: OnlineEstimator, fitter: Fitter) -> None:
    """Twelve samples are enough, ten new ones are due; then the model is refitted after three."""
    for k in range(11):
        send(online, 0.1 * k)
    fits = [own for own in fitter.asked if own[0] == "fit_samples"]
    assert fits == []
    send(online, 1.1)
    fits = [own for own in fitter.asked if own[0] == "fit_samples"]
    assert len(fits) == 1
    fits[0][1].set_result(Refit(fit()))
    assert online.state == (
        OK,
        "model rigid_bias from 80 samples, 30 of 36 directions determined",
    )
    found = send(online, 1.2)
    assert found.wrench.tolist() == [1.0] * 6 and found.forces.tolist() == [[2.0] * 3] * 12
    send(online, 1.3)
    assert len([own for own in fitter.asked if own[0] == "fit_samples"]) == 1
    send(online, 1.4)
    assert len([own for own in fitter.asked if own[0] == "fit_samples"]) == 2
    figures = online.figures()
    assert (figures["fits"], figures["predictions"], figures["samples"]) == (1, 3, 15)


@pytest.fixture
def fitted(online: OnlineEstimator, fitter: Fitter) -> OnlineEstimator:
    """With a model, and a refit under way."""
    for k in range(12):
        send(online, 0.1 * k)
    fitter.asked[-1][1].set_result(Refit(fit()))
    for k in range(3):
        send(online, 1.2 + 0.1 * k)
    return online


MODEL = "model rigid_bias from 80 samples, 30 of 36 directions determined"
CONTEST = Contest(24, 0.0512, 0.0478)
WORDS = "on the newest 24 samples a refit has an error of 0.048, the model before it 0.051"


def test_a_better_model_replaces_the_previous_one(fitted: OnlineEstimator, fitter: Fitter) -> None:
    fitter.asked[-1][1].set_result(Refit(fit(samples=90), CONTEST, "a.Fz changed by -8.0 N"))
    model = MODEL.replace("80", "90")
    assert fitted.state == (
        OK,
        f"{model}; older samples left out: a.Fz changed by -8.0 N; it replaced the previous model:"
        f" {WORDS}",
    )
    assert (fitted.figures()["fits"], fitted.figures()["refused"]) == (2, 0)


def test_a_worse_model_is_refused(fitted: OnlineEstimator, fitter: Fitter) -> None:
    contest = Contest(24, 0.0478, 0.0512)
    fitter.asked[-1][1].set_result(Refit(fit(samples=90), contest))
    words = "on the newest 24 samples a refit has an error of 0.051, the model before it 0.048"
    assert fitted.state == (OK, f"{MODEL}; kept: {words}")
    assert (fitted.figures()["fits"], fitted.figures()["refused"]) == (1, 1)


def test_a_failed_fit_is_an_error(fitted: OnlineEstimator, fitter: Fitter) -> None:
    fitter.asked[-1][1].set_exception(IdentificationError("only 9 samples", "record more"))
    assert fitted.state == (ERROR, "no fit: only 9 samples: record more")


@pytest.mark.parametrize(("second", "checks"), [(1.9, 1), (2.0, 2)], ids=["earlier", "due"])
def test_data_is_checked_every_two_seconds(
    second: float, checks: int, online: OnlineEstimator, fitter: Fitter
) -> None:
    send(online, 0.0)
    fitter.asked[0][1].set_result(())
    send(online, second)
    assert [name for name, _ in fitter.asked] == ["check_samples"] * checks


def test_findings_are_a_warning(online: OnlineEstimator, fitter: Fitter) -> None:
    send(online, 0.0)
    fitter.asked[0][1].set_result(("data: check Fx", "data: check Fy"))
    words = "no model yet: waiting for steady data or estimator/fit"
    assert online.state == (WARN, f"data: check Fx (and 1 more); {words}")
    online.trigger(0)  # time jumps back
    assert online.state == (OK, words)


def test_a_failed_check_is_told(online: OnlineEstimator, fitter: Fitter) -> None:
    send(online, 0.0)
    fitter.asked[0][1].set_exception(ValueError("no"))
    assert online.state[0] == WARN and online.state[1].startswith("data not checked: no; no model")


def test_incomplete_samples_are_dropped_oldest_first(online: OnlineEstimator) -> None:
    """Two stamps may wait."""
    for second in (1, 2, 3):
        online.add(topics.SOCKET_POSE, scene.START + second * SECOND, np.eye(7)[6])
    assert online.figures()["incomplete"] == 1
    stress = {n: (np.array([1e4, 0, 0]), 0) for n in scene.CLUSTERS}
    for second, count in ((1, 0), (3, 1)):
        stamp = scene.START + second * SECOND
        online.add(topics.STRESS, stamp, stress)
        online.add(topics.WRENCH, stamp, np.arange(6.0))
        online.add(topics.PYLON_POSE, stamp, np.eye(7)[6])
        assert online.figures()["samples"] == count


def test_a_negated_trigger_clears_the_window(online: OnlineEstimator) -> None:
    send(online, 1.0)
    assert online.newest == scene.START + SECOND and online.figures()["window"] == 1
    online.trigger(scene.START + SECOND)  # the same stamp is no jump
    assert online.figures()["window"] == 1
    online.trigger(scene.START)
    assert online.newest == 0 and online.figures()["window"] == 0


# --- contests


@pytest.mark.parametrize(("old", "new", "worse"), [(0.5, 0.6, True), (0.5, 0.5, False)])
def test_a_refit_must_not_be_worse(old: float, new: float, worse: bool) -> None:
    assert Refit(fit(), Contest(10, old, new)).is_worse is worse
    assert not Refit(fit()).is_worse


@pytest.mark.parametrize(
    ("theta", "old"), [(1.0, 0.3), (0.0, 0.4), (0.5, 0.353553), (0.2, 0.382099)]
)
def test_errors_are_relative_and_weighed_by_theta(theta: float, old: float) -> None:
    """Moments of 2 N m are off by 0.6, forces of 10 N by 3, a cluster's 20 N by 8.

    So 0.3 of the wrench and 0.4 of the cluster: sqrt(theta 0.3^2 + (1 - theta) 0.4^2).
    """
    wrench = np.tile([2.0, 2.0, 2.0, 10.0, 10.0, 10.0], (5, 1))
    forces = np.full((5, 1, 3), 20.0)
    status = np.zeros((5, 1), np.uint8)
    rest = np.zeros((5, 3))
    own = Samples(np.arange(5), rest, rest, wrench, ("a",), forces, status)
    newest = np.array([1, 2, 3, 4])
    off = np.array([0.6] * 3 + [3.0] * 3 + [8.0] * 3)

    def model(factor: float) -> Any:
        predicted = np.hstack([wrench, forces[:, 0]]) + factor * off
        return SimpleNamespace(predict=lambda pose, clusters, stamps: predicted)

    chosen = IdentificationSettings(theta=theta)
    found = fit_worker._judge(model(1.0), model(0.5), own, newest, chosen)
    assert found.samples == 4
    assert (found.old, found.new) == pytest.approx((old, 0.5 * old), rel=1e-5)


def test_a_wrench_that_is_always_zero_is_refused() -> None:
    """A load cell that is not connected may send zeros."""
    rows = np.zeros(60, dtype=int)
    still = replace(sample(0)[rows], stamps=250_000_000 * np.arange(60))
    steady = fit_worker.Steady(EstimatorSettings().plateau, least_samples=10)
    with refused(IdentificationError, "the wrench never exceeds 0 N and 0 N m in 60 samples"):
        fit_worker.fit_samples(still, scene.geometry(), IdentificationSettings(), steady)


def test_too_few_samples_are_not_checked() -> None:
    few = replace(sample(0))
    assert fit_worker.check_samples(few, scene.geometry(), ()) == ()


# --- the status line


def test_errors_are_of_the_last_ten_seconds() -> None:
    """Forces off by 3 N in one of three directions: 3 / sqrt(3); moments by 0.2 N m."""
    status = GraphStatus()
    for second, force in ((0, 300.0), (1, 3.0), (10, 3.0)):
        stamp = scene.START + second * SECOND
        status.add(topics.TRIGGER, stamp, np.array(1))
        status.add(topics.WRENCH, stamp, np.arange(6.0))
        off = np.array([0.0, 0.2, 0.0, 0.0, force, 0.0])
        status.add(topics.ESTIMATED_WRENCH, stamp, np.arange(6.0) + off)
        if second == 10:
            mean = np.sqrt((300.0**2 + 9.0 + 9.0) / 9.0)
            assert status.errors() == pytest.approx((mean, 0.2 / np.sqrt(3.0)))
    stamp = scene.START + 10 * SECOND + 1
    status.add(topics.WRENCH, stamp, np.arange(6.0))
    status.add(topics.ESTIMATED_WRENCH, stamp, np.arange(6.0))
    force, moment = status.errors()
    assert force == pytest.approx(np.sqrt(18.0 / 9.0))
    assert moment == pytest.approx(0.2 * np.sqrt(2.0 / 9.0))


def test_the_status_begins_empty() -> None:
    status = GraphStatus()
    assert (status.triggers, status.complete, status.elapsed) == (0, 0, 0.0)
    assert status.errors() is status.wrench is status.heard is None
    assert status.variant == status.trial == ""


def test_elapsed_time_is_that_of_the_triggers() -> None:
    status = GraphStatus()
    for second in (5, 6, 9):
        status.add(topics.TRIGGER, second * SECOND, np.array(1))
    assert status.elapsed == pytest.approx(4.0) and status.triggers == 3
    status.add(topics.TRIGGER, SECOND, np.array(1))  # a replay restarts
    assert status.elapsed == 0.0 and status.heard is not None


def test_a_model_is_loaded_from_its_file(online: OnlineEstimator, tmp_path: Path) -> None:
    online.load(scene.model(tmp_path / "model.json", "walk"))
    assert online.state == (OK, "predicting with the model of walk")
    found = send(online, 0.0)
    assert found.wrench == pytest.approx([0.55, 1.1, 0.5, 14.0, 3.0, -100.0])
    assert online.figures()["predictions"] == 1
