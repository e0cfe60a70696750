"""A testbed's graph from another host: a network namespace with a cable to this one."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from socket_testbed.files import RANGE

HERE, THERE = "10.213.77.1", "10.213.77.2"
LOOK = """
import sys, time, rclpy
rclpy.init()
node = rclpy.create_node("stranger")
end = time.monotonic() + 8.0
while time.monotonic() < end and not [n for n in node.get_node_names() if n != "stranger"]:
    rclpy.spin_once(node, timeout_sec=0.1)
print(sorted(n for n in node.get_node_names() if n != "stranger"))
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


@pytest.mark.slow
@pytest.mark.graph
def test_another_host_finds_a_graph_only_where_it_is_opened(cable: str, tmp_path: Path) -> None:
    program = tmp_path / "look.py"
    program.write_text(LOOK)
    for reach, found in (("LOCALHOST", False), ("SUBNET", True)):
        own = {name: of for name, of in os.environ.items() if "PROFILES_FILE" not in name}
        run = [sys.executable, "-m", "socket_testbed", "run", "--simulated", "--duration", "30"]
        outside = own | {RANGE: "SUBNET", "ROS_STATIC_PEERS": HERE}
        with subprocess.Popen(run, env=own | {RANGE: reach}) as testbed:
            try:
                look = [*cable.split(), sys.executable, str(program)]
                said = [subprocess.check_output(look, env=outside, text=True) for _ in range(2)]
                assert any("_node" in text for text in said) is found, (reach, said)
            finally:
                testbed.terminate()
