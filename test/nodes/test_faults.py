"""Every fault of docs/faults.md, switched on in the running testbed while it records.

It and its end are named, the others go on, and no value is wrong or missing without a status.
"""

import re
import time
from collections.abc import Iterator

import pytest
from support import CHECKOUT
from support.testbeds import MEASURED, LiveTestbed, Recorded

from socket_testbed.simulation.world import FAULTS

pytestmark = pytest.mark.graph


# By fault: its value, the node that reports it, and the level and the words of that.
CASES = {
    "trigger.missing": (1, "trigger_node", "ERROR", "no edge on line 27 .*check the wire"),
    "trigger.late": (0.004, "trigger_node", "ERROR", "no edge on line 27"),
    "trigger.unplugged": (1, "trigger_node", "ERROR", "pinctrl-rp1 are gone .*opened again"),
    "clusters.unplugged": (1, "cluster_node", "ERROR", "i2c-1"),
    "clusters.nack": (3, "cluster_node", "ERROR", "0x50 behind channel 2 of 0x70 on i2c-1: "),
    "clusters.timeout": (0.05, "cluster_node", "ERROR", "i2c-1"),
    "clusters.stuck_done": (2, "cluster_node", "ERROR", "channel 1 of 0x70 on i2c-1"),
    "clusters.rail": (4, "cluster_node", "ERROR|WARN", "distal|channel 3"),
    "clusters.brown_out": (1, "cluster_node", "ERROR|WARN", "channel 0 of 0x70 on i2c-1"),
    "load_cell.unplugged": (1, "load_cell_node", "ERROR", "spidev0.0"),
    "load_cell.flipped_bits": (0.2, "load_cell_node", "WARN|ERROR", "checksum"),
    "load_cell.rail": (3, "load_cell_node", "ERROR", "bridge 3 .*rail"),
    "load_cell.brown_out": (0.4, "load_cell_node", "WARN|ERROR", "reset"),
    "load_cell.frozen": (1, "load_cell_node", "ERROR", "convert"),
    "mocap.unplugged": (1, "mocap_node", "ERROR", "127.0.0.1"),
    "mocap.drop": (0.3, "mocap_node", "WARN|ERROR", "lost|missing|datagram"),
    "mocap.truncate": (0.3, "mocap_node", "WARN|ERROR", "datagram|lost"),
    "mocap.duplicate": (0.3, "mocap_node", "WARN|ERROR", "duplicate|twice|order|datagram"),
    "mocap.reorder": (0.3, "mocap_node", "WARN|ERROR", "order|lost|datagram"),
    "mocap.corrupt": (0.3, "mocap_node", "WARN|ERROR", "datagram|lost"),
    "mocap.occlude": (2, "mocap_node", "WARN", "occluded|socket"),
    "mocap.scale": (1000, "mocap_node", "WARN", "millimetres"),
    "clock.step": (3600.0, "trigger_node", "WARN", r"system clock was set by \+3600"),
}
# Nothing to see while they are on: the values are right all the same.
SILENT = {"mocap.swap": 0.2}
# They strike once, at a moment.
MOMENTARY = {"mocap.restart", "mocap.exchange", "clusters.shifted"}
PRESSED = {"limb.out", "clusters.exchanged"}  # test_run presses


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveTestbed]:
    """One testbed that records all the while; what it recorded is judged when it has ended."""
    path = tmp_path_factory.mktemp("faults") / "trial"
    with LiveTestbed(path, one_process=True) as live:
        yield live
    recorded = Recorded(path)
    assert not recorded.notes
    assert recorded.lacking() == dict.fromkeys((t.name for t in MEASURED), 0)
    assert all(recorded.check_values().values())  # there are right values of each topic
    assert not live.restarts


def test_every_fault_is_tested() -> None:
    assert set(CASES) | set(SILENT) | MOMENTARY | PRESSED == set(FAULTS)


def test_every_fault_is_documented() -> None:
    page = (CHECKOUT / "docs" / "faults.md").read_text()
    groups = "|".join({name.partition(".")[0] for name in FAULTS})
    documented = set(re.findall(rf"`((?:{groups})\.\w+)[=`]", page))
    assert documented == set(FAULTS)


@pytest.mark.parametrize("fault", CASES)
def test_a_fault_is_named_until_its_end(live: LiveTestbed, fault: str) -> None:
    value, node, level, words = CASES[fault]
    live.switch(fault, value)
    try:
        live.wait_for(node, level, words)
    finally:
        live.switch(fault, 0.0)
    live.wait_for(node, "OK")
    live.wait_for_triggers(3)


@pytest.mark.parametrize("fault", SILENT)
def test_a_silent_fault_costs_nothing(live: LiveTestbed, fault: str) -> None:
    live.switch(fault, SILENT[fault])
    live.wait_for_triggers(20)
    live.switch(fault, 0.0)
    live.wait_for("mocap_node", "OK")


def test_a_server_that_restarts_is_named(live: LiveTestbed) -> None:
    seen = len(live.probe.said("mocap_node"))
    live.switch("mocap.restart", time.monotonic())
    live.wait_for("mocap_node", "ERROR|WARN", since=seen)  # however briefly
    live.wait_for("mocap_node", "OK")
    live.wait_for_triggers(5)


@pytest.mark.slow
def test_exchanged_ids_cost_a_moment(live: LiveTestbed) -> None:
    for value in (1.0, 0.0):
        seen = len(live.probe.said("mocap_node"))
        live.switch("mocap.exchange", value)
        live.wait_for("mocap_node", "WARN", "changed the ids of its rigid bodies", since=seen)
        live.wait_for("mocap_node", "OK")
    live.wait_for_triggers(5)
