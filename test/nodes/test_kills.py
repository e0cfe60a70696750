"""kill -9 of every node while the testbed records: it comes back, and nothing is wrong."""

from dataclasses import dataclass
from pathlib import Path

import pytest
from support.testbeds import MEASURED, LiveTestbed, Recorded

from socket_testbed.trials.topics import WRENCH

pytestmark = [pytest.mark.graph, pytest.mark.slow]

COMPUTING = ("calibration_node", "estimator_node")


@dataclass
class Killed:
    """A testbed of which every node was killed in turn, the recorder last.

    Attributes:
        first: The trial until the recorder was killed.
        second: The trial that the next recorder began.
        alone: Stamp until which the load-cell node alone had been killed [ns].
        restarts: What was said about each node that was started again.
    """

    first: Recorded
    second: Recorded
    alone: int
    restarts: list[str]


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Killed:
    path = tmp_path_factory.mktemp("kills") / "trial"
    with LiveTestbed(path) as live:
        live.wait_for_triggers(10)
        live.kill("load_cell_node")
        live.wait_for_triggers(40)
        live.wait_for("load_cell_node", "OK")
        live.wait_for_triggers(10)
        alone = live.newest()
        for node in ("trigger_node", "cluster_node", "mocap_node", *COMPUTING):
            live.wait_for_triggers(10)
            if node == "cluster_node":
                live.switch("clusters.shifted", 2)  # what a restart of the host does to a chip
            live.kill(node)
            kill_seen = len(live.diagnostics)
            live.probe.wait(
                lambda node=node, seen=kill_seen: any(
                    s.name == f"/{node}" for m in live.diagnostics[seen:] for s in m.status
                ),
                f"{node} in the graph",
            )
            if node not in COMPUTING:
                live.wait_for(node, "OK")
            live.switch("clusters.shifted", 0)
        live.wait_for_triggers(20)
        live.kill("recorder_node")
        second = path.with_name("trial_2")
        live.probe.wait(second.exists, "the second trial")
        # A new recorder is found by the others some seconds after it began its trial.
        live.probe.wait(
            lambda: sum(f.stat().st_size for f in second.glob("*.mcap")) > 100_000,
            "data in the second trial",
        )
        live.wait_for_triggers(60)
    return Killed(Recorded(path), Recorded(second, path), alone, live.restarts)


def test_any_node_may_be_killed_and_comes_back(killed: Killed) -> None:
    newest = sorted(killed.second.stamps("trigger"))[-5:]
    # Every one is back; on a busy machine one of the last values may be late all the same.
    assert all(set(newest) & killed.second.stamps(t.name) for t in MEASURED)


def test_no_value_is_wrong_whichever_node_was_killed(killed: Killed) -> None:
    killed.first.check_values()
    killed.second.check_values()


def test_the_others_lose_nothing_when_one_is_killed(killed: Killed) -> None:
    assert killed.restarts[0].startswith("load_cell_node")
    lacking = killed.first.lacking(until=killed.alone)
    # In a slow testbed it may be back before the next trigger.
    lacking.pop(WRENCH.name)
    assert lacking == dict.fromkeys(lacking, 0)


def test_a_killed_recorder_goes_on_in_a_second_trial(killed: Killed) -> None:
    assert any("cut short" in note for note in killed.first.notes)
    assert killed.first.stamps("trigger") and killed.second.stamps("trigger")


def test_a_healthy_testbed_in_one_process_loses_nothing(tmp_path: Path) -> None:
    path = tmp_path / "trial"
    with LiveTestbed(path, rate=50.0, one_process=True) as live:
        live.wait_for_triggers(150)  # many more may come on a busy machine
    recorded = Recorded(path)
    assert recorded.lacking() == dict.fromkeys((t.name for t in MEASURED), 0)
    # A machine that is busy with other things costs values, never messages.
    assert all(recorded.check_values().values())
