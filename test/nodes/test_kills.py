"""kill -9 of every node while the testbed records: it comes back, and nothing is wrong."""

import signal
from pathlib import Path

import numpy as np
import pytest
from std_srvs.srv import Trigger as TriggerService
from support.testbeds import MEASURED, LiveTestbed, Recorded

from socket_testbed.live.bringup import Simulation
from socket_testbed.trials.topics import CAPACITANCE, MARKERS, PYLON_POSE, SOCKET_POSE, WRENCH

pytestmark = pytest.mark.graph

OF_NODE = {
    "trigger_node": (),
    "cluster_node": (CAPACITANCE,),
    "load_cell_node": (WRENCH,),
    "mocap_node": (SOCKET_POSE, PYLON_POSE, MARKERS),
    "calibration_node": (),
    "estimator_node": (),
}


def kill(live: LiveTestbed, node: str) -> None:
    restarts = len(live.restarts)
    live.process(node).send_signal(signal.SIGKILL)
    live.probe.wait(lambda: len(live.restarts) > restarts, f"{node} started again")
    assert live.restarts[-1] == f"{node} was ended by SIGKILL: started again"


def test_any_node_may_be_killed_and_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "trial"
    with LiveTestbed(path) as live:
        for node in OF_NODE:
            live.wait_for_triggers(10)
            if node == "cluster_node":
                live.switch("clusters.shifted", 2)  # what a restart of the host does to a chip
            kill(live, node)
            kill_seen = len(live.diagnostics)
            live.probe.wait(
                lambda node=node, seen=kill_seen: any(
                    s.name == node for m in live.diagnostics[seen:] for s in m.status
                ),
                f"{node} in the graph",
            )
            if node.endswith(("trigger_node", "cluster_node", "load_cell_node", "mocap_node")):
                live.wait_for(node, "OK")
            live.switch("clusters.shifted", 0)
        live.wait_for_triggers(20)
    recorded = Recorded(path)
    recorded.check_values()
    newest = sorted(recorded.stamps("trigger"))[-5:]
    # Every one is back; on a busy machine one of the last values may be late all the same.
    assert all(set(newest) & recorded.stamps(t.name) for t in MEASURED)


def test_the_others_lose_nothing_when_one_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "trial"
    with LiveTestbed(path) as live:
        live.wait_for_triggers(10)
        kill(live, "load_cell_node")
        live.wait_for_triggers(40)
        live.wait_for("load_cell_node", "OK")
        live.wait_for_triggers(10)
    recorded = Recorded(path)
    lacking = recorded.lacking()
    assert lacking.pop(WRENCH.name) > 0
    assert lacking == dict.fromkeys(lacking, 0)
    recorded.check_values()


def test_a_tare_outlives_its_node() -> None:
    with LiveTestbed(simulation=Simulation("static_hold", period=600.0)) as live:
        live.probe.wait(lambda: tare(live).success, "a tare")
        live.probe.wait(lambda: abs(live.wrenches[-1].wrench.force.z) < 5.0, "the tare")
        kill(live, "load_cell_node")
        seen = len(live.wrenches)
        live.probe.wait(
            lambda: any(np.isfinite(m.wrench.force.z) for m in live.wrenches[seen + 5 :]),
            "wrenches again",
        )
        forces = [m.wrench.force.z for m in live.wrenches[seen:]]
    # 91 N of pylon were taken off, and stay off.
    assert np.nanmax(np.abs(forces)) < 5.0


def tare(live: LiveTestbed) -> TriggerService.Response:
    return live.probe.call(TriggerService, "load_cell/tare", TriggerService.Request())


def test_a_killed_recorder_goes_on_in_a_second_trial(tmp_path: Path) -> None:
    path = tmp_path / "trial"
    with LiveTestbed(path) as live:
        live.wait_for_triggers(60)
        newest = live.newest()
        kill(live, "recorder_node")
        live.probe.wait((tmp_path / "trial_2").exists, "the second trial")
        # A new recorder is found by the others some seconds after it began its trial.
        live.probe.wait(
            lambda: sum(f.stat().st_size for f in (tmp_path / "trial_2").glob("*.mcap")) > 100_000,
            "data in the second trial",
        )
        live.wait_for_triggers(60)
    first, second = Recorded(path), Recorded(tmp_path / "trial_2", path)
    assert any("cut short" in note for note in first.notes)
    # All but the last second or two are there.
    assert max(first.stamps("trigger")) > newest - 2.5e9
    assert len(second.stamps("trigger")) > 20
    first.check_values()
    second.check_values()


@pytest.mark.parametrize("one_process", [False, True])
def test_a_healthy_testbed_loses_nothing(tmp_path: Path, one_process: bool) -> None:
    path = tmp_path / "trial"
    with LiveTestbed(path, rate=50.0, one_process=one_process) as live:
        live.wait_for_triggers(150)
    recorded = Recorded(path)
    assert recorded.lacking() == dict.fromkeys((t.name for t in MEASURED), 0)
    counts = recorded.check_values()
    # A machine that is busy with other things costs values, never messages.
    triggers = len(recorded.stamps("trigger"))
    assert all(count > 0.3 * triggers for count in counts.values()), counts
