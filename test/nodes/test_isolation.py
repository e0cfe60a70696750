"""Testbeds that leave each other and other hosts alone: in namespaces, and across a network."""

import dataclasses
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from std_srvs.srv import SetBool
from support import HANGS
from support.graph import Probe
from support.testbeds import manageable

from socket_testbed.live.bringup import end, simulated_testbed, start
from socket_testbed.live.processes import RANGE, Graph
from socket_testbed.simulation.testbed import Simulation
from socket_testbed.wire.cdr import stamp_of
from socket_testbed.wire.topics import TF, TF_STATIC, TRIGGER, WRENCH

pytestmark = [pytest.mark.graph, pytest.mark.slow]

NAMESPACES = ("/left", "/right")
NODES = ("trigger_node", "cluster_node", "load_cell_node", "mocap_node", "calibration_node")


def test_testbeds_in_namespaces_leave_each_other_alone() -> None:
    simulation = manageable(Simulation("static_hold", 1800.0))
    both = simulated_testbed(rate=10.0, simulation=simulation)
    both = dataclasses.replace(both, one_process=True)
    testbeds = [dataclasses.replace(both, namespace=name) for name in NAMESPACES]
    with Probe() as probe, Graph() as left, Graph() as right:
        left_heard, right_heard = (
            {t: probe.listen(t, f"{name}/{t.name.strip('/')}") for t in (TRIGGER, WRENCH, TF)}
            for name in NAMESPACES
        )
        static = [probe.listen(TF_STATIC, f"{name}/tf_static") for name in NAMESPACES]
        for graph, testbed in zip((left, right), testbeds, strict=True):
            start(graph, testbed)
        heard = (left_heard, right_heard)
        probe.wait(lambda: all(len(of[WRENCH]) > 5 for of in heard), "both testbeds")

        # What is measured in one namespace was asked for in it.
        asked = [{stamp_of(message) for message in list(of[TRIGGER])} for of in heard]
        for own, of in zip(asked, heard, strict=True):
            measured = {stamp_of(message) for message in list(of[WRENCH])}
            own |= {stamp_of(message) for message in list(of[TRIGGER])}
            assert {stamp for stamp in measured if stamp >= min(own)} <= own
        assert not asked[0] & asked[1]

        def assert_unmoved(enabled: bool) -> None:
            """The right one's triggers go on when the left one's are switched."""
            request = SetBool.Request(data=enabled)
            assert probe.call(SetBool, "/left/trigger/enable", request).success
            count = len(right_heard[TRIGGER])
            probe.wait(lambda: len(right_heard[TRIGGER]) > count + 5, "triggers")

        assert_unmoved(enabled=False)
        assert_unmoved(enabled=True)

        # Frames are called the same in both: on one topic nobody could tell them apart.
        probe.wait(lambda: all(static) and all(of[TF] for of in heard), "the transforms of both")
        for of, fixed in zip(heard, static, strict=True):
            assert {t.child_frame_id for t in of[TF][-1].transforms} == {"socket", "limb"}
            assert fixed[0].transforms[0].child_frame_id == "load_cell"
        assert probe.node.count_publishers("/tf") == 0

        expected = {f"{name[1:]}/{node}" for name in NAMESPACES for node in NODES}
        probe.wait(lambda: all(map(probe.said, expected)), "the diagnostics of all nodes")
        said = [s for name in NAMESPACES for s in probe.said(f"{name[1:]}/trigger_node")]
        assert said and not any("another trigger" in status.message for status in said)
        for graph, testbed in zip((left, right), testbeds, strict=True):
            end(graph, testbed)


# --- a network namespace with a cable to this host

HERE, THERE = "10.213.77.1", "10.213.77.2"
LOOK = """
import sys, time, rclpy
rclpy.init()
node = rclpy.create_node("stranger")
end, found = time.monotonic() + float(sys.argv[1]), []
while time.monotonic() < end and not found:
    rclpy.spin_once(node, timeout_sec=0.1)
    found = [name for name in node.get_node_names() if name.endswith("_node")]
print(found)
"""


@pytest.fixture
def cable() -> Iterator[str]:
    """A network namespace that this machine reaches over a cable."""
    name, end = f"there{os.getpid()}", f"veth{os.getpid() % 10**6}"
    inside = f"ip netns exec {name}"
    steps = (
        f"ip netns add {name}",
        f"ip link add {end} type veth peer name peer netns {name}",
        f"ip addr add {HERE}/24 dev {end}",
        f"ip link set {end} up",
        f"{inside} ip addr add {THERE}/24 dev peer",
        f"{inside} ip link set peer up",
        f"{inside} ip link set lo up",
    )
    try:
        if not shutil.which("ip") or not all(map(done, steps)):
            pytest.skip("network namespaces are not allowed here")
        yield inside
    finally:
        if shutil.which("ip"):
            done(f"ip link del {end}")
            done(f"ip netns del {name}")


def done(words: str) -> bool:
    return subprocess.run(words.split(), check=False, capture_output=True).returncode == 0


@pytest.mark.parametrize(
    ("reach", "found"), [("LOCALHOST", False), ("SUBNET", True)], ids=["closed", "open"]
)
def test_another_host_finds_only_an_open_graph(
    reach: str, found: bool, cable: str, tmp_path: Path
) -> None:
    program = tmp_path / "look.py"
    program.write_text(LOOK)
    own = {name: of for name, of in os.environ.items() if "PROFILES_FILE" not in name}
    run = [sys.executable, "-m", "socket_testbed", "run", "--simulated", "--duration", "30"]
    outside = own | {RANGE: "SUBNET", "ROS_STATIC_PEERS": HERE}
    with subprocess.Popen(run, env=own | {RANGE: reach}) as testbed:
        try:
            patience = str(HANGS if found else 16.0)  # it ends when it finds a node
            look = [*cable.split(), sys.executable, str(program), patience]
            said = subprocess.check_output(look, env=outside, text=True)
            assert ("_node" in said) is found
        finally:
            testbed.terminate()
