"""What the online estimator says of itself when its data and its fit both have something to say."""

from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import scene

from socket_testbed.drivers import ERROR, OK, WARN
from socket_testbed.errors import IdentificationError
from socket_testbed.live.estimator import OnlineEstimator
from socket_testbed.live.fit_worker import Refit
from socket_testbed.settings.testbed import EstimatorSettings, WindowSettings
from socket_testbed.wire import topics


class Worker:
    """Stands for the worker process: the last request of each function, as a future."""

    def __init__(self) -> None:
        self.asked: dict[str, Future[Any]] = {}
        self.counts: Counter[str] = Counter()

    def run(self, work: Callable[..., Any], *given: Any) -> Future[Any]:
        self.asked[work.__name__] = Future()
        self.counts[work.__name__] += 1
        return self.asked[work.__name__]


@pytest.fixture
def worker() -> Worker:
    return Worker()


def send(made: OnlineEstimator, first: int, last: int) -> None:
    """Send samples of these numbers, ten a second."""
    stresses = {name: (np.array([1e4, 0.0, 0.0]), 0) for name in scene.CLUSTERS}
    for number in range(first, last + 1):
        stamp = scene.START + number * 100_000_000
        made.trigger(stamp)
        made.add(topics.STRESS, stamp, stresses)
        made.add(topics.WRENCH, stamp, np.arange(6.0))
        made.add(topics.SOCKET_POSE, stamp, np.eye(7)[6])
        made.add(topics.PYLON_POSE, stamp, np.eye(7)[6])


def estimator(worker: Worker, **window: int) -> OnlineEstimator:
    """An estimator with twelve samples in 1.1 s, whose data is checked and which fits."""
    settings = EstimatorSettings(window=WindowSettings(least_samples=12, **window))
    made = OnlineEstimator(scene.geometry(), lambda: settings, worker, lambda model: None)
    send(made, 1, 12)
    assert set(worker.asked) == {"check_samples", "fit_samples"}
    return made


@pytest.fixture(autouse=True)
def by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    scene.stand_in(monkeypatch)


FINDING = "data: check Fx"
FAILED = "no fit: only 9 samples: record more"
WAITING = "no model yet: waiting for steady data or estimator/fit"


@pytest.mark.parametrize(
    ("fails", "findings", "state"),
    [
        (False, (), (OK, WAITING)),
        (False, (FINDING,), (WARN, f"{FINDING}; {WAITING}")),
        (True, (), (ERROR, FAILED)),
        (True, (FINDING,), (ERROR, f"{FINDING}; {FAILED}")),
    ],
    ids=["neither", "data alone", "fit alone", "both"],
)
def test_the_worse_of_data_and_fit_counts(
    fails: bool,
    findings: tuple[str, ...],
    state: tuple[int, str],
    worker: Worker,
) -> None:
    online = estimator(worker)
    worker.asked["check_samples"].set_result(findings)
    if fails:
        error = IdentificationError("only 9 samples", "record more")
        worker.asked["fit_samples"].set_exception(error)
    assert online.state == state


@pytest.mark.parametrize(
    ("every", "samples", "fits"),
    [(0, 40, 1), (5, 4, 1), (5, 5, 2)],
    ids=["never", "not yet", "due"],
)
def test_a_refit_waits_for_new_samples(every: int, samples: int, fits: int, worker: Worker) -> None:
    online = estimator(worker, refit_after=every)
    model = SimpleNamespace(
        variant="rigid_bias",
        stiffness=np.zeros((12, 3)),
        trail=lambda: None,
        wrench_and_forces=lambda pose, stamps, trail: (
            np.ones((len(pose), 6)),
            np.full((len(pose), 12, 3), 2.0),
        ),
    )
    fit = SimpleNamespace(model=model, samples=12, determined=30.0, last_stamp=scene.START)
    worker.asked["fit_samples"].set_result(Refit(fit))  # type: ignore[arg-type]
    assert online.figures()["fits"] == 1
    send(online, 13, 12 + samples)
    assert worker.counts["fit_samples"] == fits
