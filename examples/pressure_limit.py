"""How does my own controller hear that a region is pressed too hard?

A ROS 2 node with a parameter `limit` [kPa] (`--ros-args -p limit:=30.0`) hears the live estimates
of a simulated testbed, which it starts. Printed: the first ten samples in which the peak pressure
of the socket exceeds the limit, with the region that is pressed most.
"""

import subprocess
import sys

import rclpy
from socket_testbed_msgs.msg import RegionPressures

heard: list[float] = []  # pressures above the limit [kPa]


def control(message: RegionPressures) -> None:
    """The last region is the whole socket; the first four are its sides."""
    limit = 1e3 * node.get_parameter("limit").value  # [Pa]
    if message.peak[-1] > limit:
        side = max(range(4), key=lambda region: message.peak[region])
        peak, low, high = (
            1e-3 * v[side] for v in (message.peak, message.peak_low, message.peak_high)
        )
        heard.append(peak)
        print(f"limit exceeded: {message.names[side]}, {peak:.1f} kPa ({low:.1f} to {high:.1f})")


rclpy.init()
node = rclpy.create_node("pressure_limit")
node.declare_parameter("limit", 15.0)
node.create_subscription(RegionPressures, "estimate/regions", control, 10)
words = [sys.executable, "-m", "socket_testbed", "run", "--simulated", "--duration", "40"]
with subprocess.Popen(words, stdout=subprocess.DEVNULL) as testbed:
    while len(heard) < 10 and testbed.poll() is None:
        rclpy.spin_once(node, timeout_sec=0.5)
    testbed.terminate()
node.destroy_node()
rclpy.try_shutdown()
