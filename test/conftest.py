import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.domains import claim_domain

# Every run, and every worker of pytest-xdist, has a ROS domain of its own, and no graph leaves
# this machine. This must stand before rclpy is imported anywhere; child processes inherit it.
os.environ["ROS_DOMAIN_ID"] = claim_domain()
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from support import SHARED_DATA

from socket_testbed.__main__ import run


@pytest.fixture(scope="session")
def hold(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated static hold of 60 s at 4 Hz; tests that change it work on a copy."""
    path = tmp_path_factory.mktemp("trials") / "hold"
    assert run(["simulate", "-o", str(path), "--duration", "60", "--seed", "3"]) == 0
    return path


@pytest.fixture(scope="session")
def hold_model(hold: Path) -> Path:
    """A model with offsets, fitted on the plateau of the hold."""
    path = hold.parent / "model.json"
    assert run(["fit", str(hold), "-o", str(path)]) == 0
    return path


@pytest.fixture(scope="session")
def shared_data() -> Iterator[Path]:
    """Real data that nobody here wrote, where it lies beside the checkout."""
    if not SHARED_DATA.is_dir():
        pytest.skip("no shared data beside the checkout")
    yield SHARED_DATA


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the long modules first, those that wait for graphs beside those that compute."""
    turn: dict[Path, int] = {}
    counts = {"graph": 0, "slow": 0}
    for item in items:
        kind = next((kind for kind in counts if item.get_closest_marker(kind)), None)
        if kind is not None and item.path not in turn:
            turn[item.path] = counts[kind]
            counts[kind] += 1
    items.sort(key=lambda item: (turn.get(item.path, len(turn)), item.path))
