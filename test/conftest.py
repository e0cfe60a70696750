import gc
import os
from collections.abc import Iterator
from pathlib import Path

# numpy reads it when it is first imported; child processes inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pytest
from support import SHARED_DATA
from support.domains import claim_domain

# No graph leaves this machine, nor meets another's. This must stand before rclpy is imported
# anywhere; child processes inherit it.
os.environ["ROS_DOMAIN_ID"] = claim_domain()
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

from socket_testbed.__main__ import run
from socket_testbed.identification.contact import LAWS
from socket_testbed.live.processes import graph_environment
from socket_testbed.settings import identification
from socket_testbed.settings.fields import renew_choices

os.environ |= graph_environment()  # the tests' own nodes hear as those of a graph do

_SLOW_WITHIN = 400.0  # [s]; with a module's fixtures, on a machine that others use

# What runs whole verbs, or spoils whole files and scans: `make quick` leaves them out.
LONG = {
    *("commands", "test_api.py", "test_damaged_files.py"),
    *("test_trials.py", "test_export.py", "test_mcap_file.py"),
    *("socket_design/test_registration.py", "socket_design/test_tiling.py"),
    *("doors/test_tiling.py", "doors/test_figures.py", "doors/test_result_figures.py"),
    *("doors/test_report_page.py", "doors/test_comparison.py", "doors/test_donnings.py"),
    *("doors/test_comparison_notes.py", "identification/test_data_check.py"),
    *("test_report.py", "test_server.py", "test_player.py", "test_natnet_client.py"),
    *("calibration/test_bench.py", "calibration/test_bench_by_hand.py", "test_bench_file.py"),
    *("identification/test_limb_motion.py", "identification/test_force_map.py"),
    *("trials/test_raw_check.py", "trials/test_reprocess.py", "socket_design/test_scan_file.py"),
    *("doors/test_fewer_parts.py", "doors/test_imports.py", "doors/test_imported_tables.py"),
    *("doors/test_options_of_live_verbs.py", "simulation/test_simulation.py", "test_notebook.py"),
    *("live/test_estimator.py", "nodes/test_replay_alone.py", "nodes/test_trial_lines_by_hand.py"),
    *("identification/test_survey.py", "doors/test_survey.py", "doors/test_priors.py"),
    *("trials/test_segment.py", "test_natnet_tracker.py", "alignment/test_accuracy.py"),
}


@pytest.fixture(scope="module", autouse=True)
def domain(request: pytest.FixtureRequest) -> None:
    """Another ROS domain for a module with graphs: nodes killed in the last one linger for 20 s."""
    own = (item for item in request.session.items if item.path == request.path)
    if any(item.get_closest_marker(kind) for item in own for kind in ("graph", "slow")):
        os.environ["ROS_DOMAIN_ID"] = claim_domain()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(1)


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


@pytest.fixture
def few_variants(monkeypatch: pytest.MonkeyPatch) -> None:
    """Validates only variants that are fitted at once: the others repeat what these show."""
    place = "socket_testbed.identification.validation.VARIANTS"
    monkeypatch.setattr(place, ("stiffness", "stiffness_bias"))


@pytest.fixture
def own_laws() -> Iterator[None]:
    """Contact laws that a test registers are forgotten after it."""
    lists = identification.VARIANTS, identification.BIAS_VARIANTS
    kept, laws = [[*names] for names in lists], dict(LAWS)
    yield
    for names, before in zip(lists, kept, strict=True):
        names[:] = before
    LAWS.clear()
    LAWS.update(laws)
    renew_choices()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    if not SHARED_DATA.is_dir():
        pytest.skip("no shared data beside the checkout")
    return SHARED_DATA


class _Shifted(pytest.Dir):
    """A folder of tests, which each worker collects from another place on.

    In a fresh checkout each compiles a part of the modules, and reads what the others compiled.
    """

    def collect(self) -> list[pytest.Item | pytest.Collector]:
        found = [*super().collect()]
        worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
        begin = len(found) * worker // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
        return found[begin:] + found[:begin]


def pytest_collect_directory(path: Path, parent: pytest.Collector) -> pytest.Collector:
    return _Shifted.from_parent(parent, path=path)


def pytest_collection_finish() -> None:
    """Keep the thousands of collected cases out of every later search for garbage."""
    gc.collect()
    gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the modules with graphs and the slow ones first, so that none is left for the end."""
    here = Path(__file__).parent
    first: set[Path] = set()
    for item in items:
        place = item.path.relative_to(here)
        if not LONG.isdisjoint([place.as_posix(), *place.parts]):
            item.add_marker("long")
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(_SLOW_WITHIN))
        if item.get_closest_marker("graph") or item.get_closest_marker("slow"):
            first.add(item.path)
    items.sort(key=lambda item: (item.path not in first, item.path))
