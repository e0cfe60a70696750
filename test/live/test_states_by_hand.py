"""What the online estimator says of itself when its data and its fit both have something to say."""

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest
from support import scene

from socket_testbed.drivers import ERROR, OK, WARN
from socket_testbed.errors import IdentificationError
from socket_testbed.live.estimator import OnlineEstimator
from socket_testbed.settings.testbed import EstimatorSettings, WindowSettings
from socket_testbed.trials import topics


class Worker:
    """Stands for the worker process: the last request of each function, as a future."""

    def __init__(self) -> None:
        self.asked: dict[str, Future[Any]] = {}

    def run(self, work: Callable[..., Any], *given: Any) -> Future[Any]:
        self.asked[work.__name__] = Future()
        return self.asked[work.__name__]


@pytest.fixture
def worker() -> Worker:
    return Worker()


@pytest.fixture
def online(monkeypatch: pytest.MonkeyPatch, worker: Worker) -> OnlineEstimator:
    """An estimator with twelve samples in 1.1 s, whose data is checked and which fits."""
    scene.stand_in(monkeypatch)
    settings = EstimatorSettings(window=WindowSettings(least_samples=12))
    made = OnlineEstimator(scene.geometry(), lambda: settings, worker, lambda model: None)
    stresses = {name: (np.array([1e4, 0.0, 0.0]), 0) for name in scene.CLUSTERS}
    for number in range(12):
        stamp = scene.START + number * 100_000_000
        made.trigger(stamp)
        made.add(topics.STRESS, stamp, stresses)
        made.add(topics.WRENCH, stamp, np.arange(6.0))
        made.add(topics.SOCKET_POSE, stamp, np.eye(7)[6])
        made.add(topics.PYLON_POSE, stamp, np.eye(7)[6])
    assert set(worker.asked) == {"check_samples", "fit_samples"}
    return made


FINDING = "data: look at Fx"
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
    online: OnlineEstimator,
    worker: Worker,
) -> None:
    worker.asked["check_samples"].set_result(findings)
    if fails:
        error = IdentificationError("only 9 samples", "record more")
        worker.asked["fit_samples"].set_exception(error)
    assert online.state == state
