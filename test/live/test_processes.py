"""The graph as processes: what it needs and starts again, scheduling, and what `doctor` finds."""

import json
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.verbs import program
from support.wording import refused

from socket_testbed import clocks
from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.live import doctor, hardware
from socket_testbed.live.bringup import Testbed
from socket_testbed.live.processes import Graph
from socket_testbed.settings import acquisition
from socket_testbed.settings.testbed import TestbedSettings

NODE = """
import os, signal, rclpy
from socket_testbed.live.processes import RESTARTED
from socket_testbed.nodes.base import OK, TestbedNode
from socket_testbed.settings.fields import Settings

rclpy.init()
node = TestbedNode("worker", Settings)
node.report(OK, "works")
if RESTARTED not in os.environ:
    os.kill(os.getpid(), signal.SIGKILL)
signal.pause()
"""


@pytest.mark.graph
def test_a_graph_ends_with_what_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first OK of a node that was killed is a recovery."""
    (tmp_path / "worker.py").write_text(NODE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    restarts: list[str] = []
    with tempfile.TemporaryFile("w+") as log, Graph(log) as graph:

        def said() -> list[str]:
            log.seek(0)
            return [line.rpartition("]: ")[2] for line in log if "works" in line]

        graph.start_program("page", "socket_testbed.nodes", ["no_such_node"], optional=True)
        graph.start_program("worker", "worker", [])
        graph.watch(lambda: len(said()) >= 2 and len(restarts) >= 2, restarts.append)
        assert [line.strip() for line in said()] == ["works", "recovered: works"]
        assert {"page ended with exit code 1: started again"} < set(restarts)
        assert "worker was ended by SIGKILL: started again" in restarts
        graph.start_program("needed", "socket_testbed.nodes", ["no_such_node"])
        with pytest.raises(TestbedError, match="needed ended with exit code 1"):
            graph.watch(lambda: False, restarts.append)


# --- scheduling, and what `doctor` makes of lateness and kernels

EVERY_THREAD = """
import json, os, threading
from pathlib import Path
from socket_testbed.live.scheduling import schedule
from socket_testbed.settings.acquisition import SchedulingSettings
core = min(os.sched_getaffinity(0))
done = threading.Event()
threading.Thread(target=done.wait, daemon=True).start()
refused = schedule(SchedulingSettings(priority=7, cores=(core,)))
threading.Thread(target=done.wait, daemon=True).start()
threads = [int(path.name) for path in Path("/proc/self/task").iterdir()]
policies = [os.sched_getscheduler(thread) for thread in threads]
print(json.dumps([refused, policies, [list(os.sched_getaffinity(t)) == [core] for t in threads]]))
"""


def test_all_threads_get_what_is_set() -> None:
    _, out, _ = program(sys.executable, "-c", EVERY_THREAD)
    refused, policies, cores = json.loads(out)
    assert len(policies) == 3 and all(cores)
    assert set(policies) == {os.SCHED_OTHER if refused else os.SCHED_FIFO}
    assert not refused or "scheduling.priority 7 is refused" in refused[0]


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda: hardware.make_trigger(acquisition.TriggerSettings()), id="trigger"),
        pytest.param(lambda: hardware.i2c_opener(acquisition.ClusterSettings()), id="clusters"),
        pytest.param(lambda: hardware.spi_opener(acquisition.LoadCellSettings()), id="load-cell"),
    ],
)
def test_hardware_keeps_to_real_time(
    make: Callable[[], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clocks, "_scale", 0.5)
    with refused(ConfigurationError, "TIME_SCALE=0.5 is for a simulated testbed"):
        make()


PI = "Raspberry Pi 5 Model B Rev 1.0"


@pytest.mark.parametrize("release", ["6.6.20+rpt-rpi-2712", "6.6.27"])
def test_doctor_names_kernels_whose_bus_locks_up(release: str) -> None:
    found = doctor.kernel_finding(PI, release)
    assert "5784" in found.found and found.hint == "update it to 6.6.28 or newer"


@pytest.mark.parametrize(
    ("model", "release"),
    [
        pytest.param(PI, "6.8.0-1013-raspi", id="6.8"),
        pytest.param(PI, "6.6.28", id="6.6.28"),
        pytest.param("a laptop", "5.15.0", id="laptop"),
    ],
)
def test_doctor_accepts_other_kernels(model: str, release: str) -> None:
    assert not doctor.kernel_finding(model, release).hint


@pytest.mark.parametrize(
    ("oversampling", "verdict"),
    [
        pytest.param(8192, "soon enough", id="slow-conversions"),
        pytest.param(1024, "too late", id="fast-conversions"),
    ],
)
def test_doctor_judges_lateness_by_kept_conversions(
    oversampling: int, verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "measure_lateness", lambda *_: np.full(10, 2e-3))
    cell = acquisition.LoadCellSettings(oversampling=oversampling)
    (found,) = doctor.check_scheduling(Testbed(TestbedSettings(load_cell_node=cell)))
    assert f": {verdict} for 4 Hz" in found.found


@pytest.mark.parametrize(
    ("module", "arguments", "expected"),
    [
        ("socket_testbed.nodes", ["trigger_node"], 0),
        ("socket_testbed", ["run", "--simulated"], 130),
    ],
    ids=["node", "verb"],
)
def test_ctrl_c_during_the_imports_leaves_nothing(
    module: str, arguments: list[str], expected: int, tmp_path: Path
) -> None:
    """It strikes when a library is imported: no traceback, no line."""
    strike = "import os, signal; os.kill(os.getpid(), signal.SIGINT); import no_such_module"
    for name in ("rclpy", "argcomplete", "msgspec"):
        (tmp_path / f"{name}.py").write_text(strike)
    path = f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"
    code, out, err = program(sys.executable, "-m", module, *arguments, PYTHONPATH=path)
    assert code == expected and not out
    assert not err or err == "socket-testbed run: interrupted\n"
