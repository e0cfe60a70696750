"""What the online estimator asks its worker for, when, and what becomes of the answers."""

from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import scene

from socket_testbed.drivers import OK, WARN
from socket_testbed.errors import IdentificationError
from socket_testbed.identification.checked import CheckedSamples
from socket_testbed.live import fit_worker
from socket_testbed.live.estimator import OnlineEstimator, cluster_forces
from socket_testbed.live.fit_worker import Refit, Steady
from socket_testbed.samples import Samples, Status
from socket_testbed.settings.identification import IdentificationSettings
from socket_testbed.settings.testbed import EstimatorSettings, WindowSettings
from socket_testbed.wire import topics

TENTH = 100_000_000  # [ns]


class Worker:
    """Stands for the worker process: what it was asked for, with the arguments and futures."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, tuple[Any, ...], Future[Any]]] = []

    def run(self, work: Callable[..., Any], *given: Any) -> Future[Any]:
        self.asked.append((work.__name__, given, Future()))
        return self.asked[-1][2]

    def of(self, name: str) -> list[tuple[tuple[Any, ...], Future[Any]]]:
        return [(given, future) for own, given, future in self.asked if own == name]


class Bench:
    """An estimator of the scene with twelve samples at least and a refit after three."""

    def __init__(self) -> None:
        window = WindowSettings(least_samples=12, refit_after=3)
        self.settings = EstimatorSettings(window=window)
        self.worker = Worker()
        self.told: list[Any] = []
        self.online = OnlineEstimator(
            scene.geometry(), lambda: self.settings, self.worker, self.told.append
        )

    def send(self, first: int, last: int) -> None:
        """Samples of these numbers, ten a second."""
        stresses = {name: (np.array([1e4, 0.0, 0.0]), 0) for name in scene.CLUSTERS}
        for number in range(first, last + 1):
            stamp = scene.START + number * TENTH
            self.online.trigger(stamp)
            self.online.add(topics.STRESS, stamp, stresses)
            self.online.add(topics.WRENCH, stamp, np.arange(6.0))
            self.online.add(topics.SOCKET_POSE, stamp, np.eye(7)[6])
            self.online.add(topics.PYLON_POSE, stamp, np.eye(7)[6])

    def conditions(self) -> list[Steady | None]:
        return [given[3] for given, _ in self.worker.of("fit_samples")]


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    scene.stand_in(monkeypatch)
    return Bench()


def fit(number: int) -> Any:
    """Stands for a fit whose newest sample has this number."""
    model = SimpleNamespace(
        variant="rigid_bias",
        stiffness=np.zeros((12, 3)),
        trail=lambda: None,
        wrench_and_forces=lambda pose, stamps, trail: (
            np.ones((len(pose), 6)),
            np.full((len(pose), 12, 3), 2.0),
        ),
    )
    stamp = scene.START + number * TENTH
    return SimpleNamespace(model=model, samples=12, determined=30.0, last_stamp=stamp)


def test_a_refit_is_newer_and_better_than_its_rival(bench: Bench) -> None:
    bench.send(1, 12)
    bench.worker.of("fit_samples")[0][1].set_result(Refit(first := fit(11)))
    assert bench.told == [first]
    bench.send(13, 15)
    before, after = bench.conditions()
    settings = bench.settings
    assert before == Steady(settings.plateau, 12, 0, None)
    assert after == Steady(settings.plateau, 12, scene.START + 11 * TENTH, first.model)
    samples, geometry, chosen, _ = bench.worker.of("fit_samples")[1][0]
    assert len(samples) == 15 and chosen == settings.identification
    assert tuple(geometry.clusters) == samples.clusters


def test_models_of_other_settings_are_no_rivals(bench: Bench) -> None:
    bench.send(1, 12)
    bench.worker.of("fit_samples")[0][1].set_result(Refit(fit(11)))
    changed = replace(bench.settings.identification, theta=0.2)
    bench.settings = replace(bench.settings, identification=changed)
    bench.send(13, 15)
    condition = bench.conditions()[1]
    assert condition is not None and (condition.after, condition.rival) == (0, None)
    second = fit(14)
    bench.worker.of("fit_samples")[1][1].set_result(Refit(second))
    bench.send(16, 18)
    condition = bench.conditions()[2]
    assert condition is not None and condition.rival is second.model


def test_a_fit_from_before_a_jump_back_is_never_newer(bench: Bench) -> None:
    """Its model predicts; samples of after the jump, with earlier stamps, are fitted again."""
    bench.send(20, 31)
    bench.online.trigger(scene.START)
    bench.worker.of("fit_samples")[0][1].set_result(Refit(fit(31)))
    bench.send(1, 12)
    condition = bench.conditions()[1]
    assert condition is not None and condition.after == 0 and condition.rival is not None


def test_findings_from_before_a_jump_back_do_not_count(bench: Bench) -> None:
    bench.send(20, 20)
    bench.online.trigger(scene.START)
    bench.worker.of("check_samples")[0][1].set_result(("data: look at Fx",))
    assert bench.online.state[0] == OK
    bench.send(1, 1)  # checked at once
    bench.worker.of("check_samples")[1][1].set_result(("data: look at Fx",))
    assert bench.online.state[0] == WARN


def test_a_check_waits_for_the_one_before(bench: Bench) -> None:
    """Its channels are those of the objective."""
    identification = IdentificationSettings(leave_out=("distal.Fz",))
    bench.settings = replace(bench.settings, identification=identification)
    bench.send(1, 50)
    ((samples, _, leave_out), future), *others = bench.worker.of("check_samples")
    assert not others and len(samples) == 1 and leave_out == ("distal.Fz",)
    future.set_result(())
    bench.send(51, 51)
    assert len(bench.worker.of("check_samples")) == 2


def test_a_fit_without_steady_data_changes_nothing(bench: Bench) -> None:
    bench.send(1, 12)
    before = bench.online.state
    bench.worker.of("fit_samples")[0][1].set_result(None)
    assert bench.online.state == before and bench.told == []
    bench.send(13, 21)
    assert len(bench.worker.of("fit_samples")) == 1  # tried again after ten samples
    bench.send(22, 22)
    assert len(bench.worker.of("fit_samples")) == 2


def test_one_fit_runs_at_a_time(bench: Bench) -> None:
    bench.send(1, 12)
    with pytest.raises(IdentificationError) as found:
        bench.online.fit()
    assert str(found.value) == "a fit is running already: ask again when it is done"
    bench.send(13, 40)
    assert len(bench.worker.of("fit_samples")) == 1


@pytest.mark.parametrize("error", [CancelledError(), BrokenProcessPool()], ids=["ended", "killed"])
def test_an_aborted_fit_is_to_be_asked_again(
    error: BaseException, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def aborted(steady: bool) -> Any:
        assert not steady
        return SimpleNamespace(result=lambda: (_ for _ in ()).throw(error))

    monkeypatch.setattr(bench.online, "_start_fit", aborted)
    with pytest.raises(IdentificationError) as found:
        bench.online.fit()
    assert str(found.value) == "the fit was aborted: ask again"


def test_a_requested_fit_takes_all_samples(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.send(1, 3)
    wanted = fit(3)

    def run(work: Callable[..., Any], *given: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(Refit(wanted))
        assert len(given[0]) == 3 and given[3] is None
        return future

    monkeypatch.setattr(bench.worker, "run", run)
    assert bench.online.fit() is wanted
    assert bench.told == [wanted]


def test_forces_are_of_the_socket_s_clusters() -> None:
    """10 kPa on 9 cm^2 push the socket with 9 N outwards, along -z.

    1 and -2 kPa along the cluster's x and y, which are y and -x of its tile, are 0.9 and -1.8 N.
    """
    stresses = {
        "mid_anterior": (np.array([10e3, 1e3, -2e3]), Status.OK),
        "another": (np.array([1.0, 1.0, 1.0]), Status.OK),
        "distal": (np.array([np.nan, np.nan, np.nan]), Status.SATURATED),
    }
    forces, status = cluster_forces(scene.geometry(), stresses)
    order = list(scene.geometry().clusters)
    assert forces[order.index("mid_anterior")] == pytest.approx([1.8, 0.9, -9.0])
    assert np.isnan(np.delete(forces, order.index("mid_anterior"), axis=0)).all()
    by_name = dict(zip(order, status.tolist(), strict=True))
    assert by_name == {
        "brim_lateral": Status.MISSING,
        "mid_anterior": Status.OK,
        "posterior_distal": Status.MISSING,
        "distal": Status.SATURATED,
    }


# --- in the worker


def samples(count: int) -> Samples:
    """Samples at 4 Hz whose Fz is their number."""
    rest = np.zeros((count, 3))
    wrench = np.ones((count, 6))
    wrench[:, 5] = np.arange(count)
    clusters = tuple(scene.CLUSTERS)
    forces, status = np.ones((count, 4, 3)), np.zeros((count, 4), np.uint8)
    stamps = scene.START + 250_000_000 * np.arange(count)
    return Samples(stamps, rest, rest, wrench, clusters, forces, status)


def measured(checked: CheckedSamples) -> Samples:
    """Stands for the samples without outliers."""
    return checked.measured


def part(checked: CheckedSamples, rows: Any = slice(None)) -> Samples:
    """Stands for samples that nothing refuses."""
    return checked.measured[rows]


class Fitted:
    """Stands for the fit in the worker: what it was given."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *stretches: tuple[int, int, str]) -> None:
        self.given: list[Samples] = []
        self.judged: list[Samples] = []
        self.settings: list[IdentificationSettings] = []
        monkeypatch.setattr(fit_worker, "fit_contact_model", self.fit)
        monkeypatch.setattr(fit_worker, "_judge", self.judge)
        monkeypatch.setattr(fit_worker.plausibility, "sign_note", lambda *given: None)
        monkeypatch.setattr(fit_worker.CheckedSamples, "samples", property(measured))
        monkeypatch.setattr(fit_worker.CheckedSamples, "part", part)
        found = [SimpleNamespace(rows=slice(a, b), cause=cause) for a, b, cause in stretches]
        monkeypatch.setattr(fit_worker, "find_newest_plateaus", lambda *given: iter(found))

    def fit(self, own: Samples, geometry: Any, settings: IdentificationSettings) -> Any:
        self.given.append(own)
        self.settings.append(settings)
        return SimpleNamespace(model="new")

    def judge(self, old: Any, new: Any, own: Samples, rows: Any, settings: Any) -> Any:
        assert (old, new) == ("old", "new")
        assert len(own) == 100  # the past of the newest samples
        self.judged.append(own[rows])
        return "contest"

    def numbers(self, own: Samples) -> tuple[int, int]:
        fz = own.wrench[:, 5]
        assert len(fz) == fz[-1] - fz[0] + 1
        return int(fz[0]), int(fz[-1])


PLATEAU = EstimatorSettings().plateau
CONTESTS = {
    # samples of the plateau, first and last of the fit and of the contest
    "a fifth": ((0, 100, ""), (0, 79), (80, 99)),
    "ten at least": ((60, 100, ""), (60, 89), (90, 99)),
}


@pytest.mark.parametrize("case", CONTESTS)
def test_the_newest_samples_judge_a_refit(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    stretch, fitted, judged = CONTESTS[case]
    stand = Fitted(monkeypatch, stretch)
    settings = IdentificationSettings(pose_smoothing=0.5)
    steady: Any = Steady(PLATEAU, 10, 0, "old")  # type: ignore[arg-type]
    found: Any = fit_worker.fit_samples(samples(100), scene.geometry(), settings, steady)
    assert stand.numbers(stand.given[0]) == fitted and stand.numbers(stand.judged[0]) == judged
    assert found.contest == "contest"
    assert stand.settings[0].pose_smoothing == 0.0


def test_without_a_rival_nothing_is_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    stand = Fitted(monkeypatch, (20, 100, "a.Fz changed"))
    steady = Steady(PLATEAU, 10)
    found: Any = fit_worker.fit_samples(samples(100), scene.geometry(), SETTINGS, steady)
    assert stand.numbers(stand.given[0]) == (20, 99) and not stand.judged
    assert (found.contest, found.cause) == (None, "a.Fz changed")


SETTINGS = IdentificationSettings()
CHOICES = {
    # plateaus, newest first; least samples, after which sample; first and last fitted
    "too short": (((90, 100, ""), (0, 80, "")), 40, -1, (0, 79)),
    "as long as needed": (((60, 100, ""),), 40, -1, (60, 99)),
    "one too short": (((61, 100, ""),), 40, -1, None),
    "newer": (((0, 80, ""),), 40, 78, (0, 79)),
    "known": (((0, 80, ""),), 40, 79, None),
    "none": ((), 40, -1, None),
}


@pytest.mark.parametrize("case", CHOICES)
def test_the_newest_long_plateau_is_fitted(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    stretches, least, after, fitted = CHOICES[case]
    stand = Fitted(monkeypatch, *stretches)
    steady = Steady(PLATEAU, least, scene.START + 250_000_000 * after)
    found = fit_worker.fit_samples(samples(100), scene.geometry(), SETTINGS, steady)
    if fitted is None:
        assert found is None and not stand.given
    else:
        assert stand.numbers(stand.given[0]) == fitted


def test_a_negated_wrench_is_not_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    Fitted(monkeypatch)
    monkeypatch.setattr(fit_worker.plausibility, "sign_note", lambda *given: "Fz is negated")
    with pytest.raises(IdentificationError) as found:
        fit_worker.fit_samples(samples(20), scene.geometry(), SETTINGS, None)
    assert (
        str(found.value)
        == "Fz is negated: check the sign of the load cell; nothing is fitted before"
    )
