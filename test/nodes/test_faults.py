"""Every fault of docs/faults.md, switched on in the running testbed while it records.

What counts: the fault is named, the others go on, the recovery is named, no value of the trial is
wrong, and no sample is missing without a status.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from support import CHECKOUT
from support.testbeds import MEASURED, LiveTestbed, Recorded

from socket_testbed.simulation.world import FAULTS

pytestmark = pytest.mark.graph


@dataclass(frozen=True)
class Case:
    """A fault and what is said of it."""

    value: float
    node: str
    level: str
    text: str


CASES = {
    "trigger.missing": Case(1, "trigger_node", "ERROR", "no edge on line 27 .*check the wire"),
    "trigger.late": Case(0.004, "trigger_node", "ERROR", "no edge on line 27"),
    "clusters.unplugged": Case(1, "cluster_node", "ERROR", "i2c-1"),
    "clusters.nack": Case(3, "cluster_node", "ERROR", "0x50 behind channel 2 of 0x70 on i2c-1: "),
    "clusters.timeout": Case(0.05, "cluster_node", "ERROR", "i2c-1"),
    "clusters.stuck_done": Case(2, "cluster_node", "ERROR", "channel 1 of 0x70 on i2c-1"),
    "clusters.rail": Case(4, "cluster_node", "ERROR|WARN", "distal|channel 3"),
    "clusters.brown_out": Case(1, "cluster_node", "ERROR|WARN", "channel 0 of 0x70 on i2c-1"),
    "load_cell.unplugged": Case(1, "load_cell_node", "ERROR", "spidev0.0"),
    "load_cell.flipped_bits": Case(0.2, "load_cell_node", "WARN|ERROR", "checksum"),
    "load_cell.rail": Case(3, "load_cell_node", "ERROR", "bridge 3 .*rail"),
    "load_cell.brown_out": Case(0.4, "load_cell_node", "WARN|ERROR", "reset"),
    "load_cell.frozen": Case(1, "load_cell_node", "ERROR", "convert"),
    "mocap.unplugged": Case(1, "mocap_node", "ERROR", "127.0.0.1"),
    "mocap.drop": Case(0.3, "mocap_node", "WARN|ERROR", "lost|missing|datagram"),
    "mocap.truncate": Case(0.3, "mocap_node", "WARN|ERROR", "datagram|lost"),
    "mocap.duplicate": Case(0.3, "mocap_node", "WARN|ERROR", "duplicate|twice|order|datagram"),
    "mocap.reorder": Case(0.3, "mocap_node", "WARN|ERROR", "order|lost|datagram"),
    "mocap.corrupt": Case(0.3, "mocap_node", "WARN|ERROR", "datagram|lost"),
    "mocap.occlude": Case(2, "mocap_node", "WARN", "occluded|socket"),
    "clock.step": Case(3600.0, "trigger_node", "WARN", r"system clock was set by \+3600"),
}
# Nothing to see while they are on: the values are right all the same.
SILENT = {"mocap.swap": 0.2}
# They strike once, at a moment.
MOMENTARY = {"mocap.restart", "clusters.shifted"}


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveTestbed]:
    """One testbed that records all the while; what it recorded is judged when it has ended."""
    path = tmp_path_factory.mktemp("faults") / "trial"
    with LiveTestbed(path) as live:
        yield live
    recorded = Recorded(path)
    assert not recorded.notes
    assert recorded.lacking() == dict.fromkeys((t.name for t in MEASURED), 0)
    assert all(recorded.check_values().values())  # there are right values of each topic
    assert not live.restarts


def test_every_fault_is_tested_and_documented() -> None:
    assert set(CASES) | set(SILENT) | MOMENTARY == set(FAULTS)
    page = (CHECKOUT / "docs" / "faults.md").read_text()
    documented = set(re.findall(r"`((?:trigger|clusters|load_cell|mocap|clock)\.\w+)[=`]", page))
    assert documented == set(FAULTS)


def well(live: LiveTestbed, *nodes: str) -> None:
    for node in nodes:
        live.wait_for(node, "OK")


@pytest.mark.parametrize("fault", CASES)
def test_a_fault_is_named_and_so_is_its_end(live: LiveTestbed, fault: str) -> None:
    case = CASES[fault]
    live.switch(fault, case.value)
    try:
        live.wait_for(case.node, case.level, case.text)
    finally:
        live.switch(fault, 0.0)
    well(live, case.node)
    live.wait_for_triggers(3)


def test_a_fault_that_costs_nothing(live: LiveTestbed) -> None:
    for fault, value in SILENT.items():
        live.switch(fault, value)
        live.wait_for_triggers(20)
        live.switch(fault, 0.0)
        well(live, "mocap_node")


def test_a_restarted_server_is_found_again(live: LiveTestbed) -> None:
    seen = len(live.probe.said("mocap_node"))
    live.switch("mocap.restart", live.elapsed())
    live.wait_for_moment("mocap_node", "ERROR|WARN", seen)
    well(live, "mocap_node")
    live.wait_for_triggers(5)
