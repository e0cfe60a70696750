"""The testbed on hardware, on a ROS installation: the nodes that `socket-testbed run` starts.

ros2 launch socket_testbed testbed.launch.py params:=/path/of/testbed.yaml record:=/path/of/trial
"""

import tempfile
from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription
from socket_testbed.clocks import shared_environment
from socket_testbed.files import packaged
from socket_testbed.live.bringup import Testbed
from socket_testbed.live.processes import REMAPPINGS, write_parameters
from socket_testbed.settings.testbed import read_testbed

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
# Parameters and the tare, until this program ends: a node that is started again finds them.
TEMPORARY = tempfile.TemporaryDirectory(prefix="socket_testbed_")


def bring_up(context: LaunchContext) -> list[Node]:
    def given(name: str) -> str:
        return LaunchConfiguration(name).perform(context)

    testbed = Testbed(
        read_testbed(Path(given("params"))),
        geometry=Path(given("geometry")).resolve(),
        calibration=Path(given("calibration")).resolve(),
        record=Path(given("record")) if given("record") else None,
        namespace=given("namespace"),
    )
    testbed.check_devices()
    folder = Path(TEMPORARY.name)
    return [
        Node(
            package="socket_testbed",
            executable=node.name,
            name=node.name,
            namespace=node.namespace,
            remappings=REMAPPINGS,
            parameters=[str(write_parameters([node], folder / f"{node.name}.yaml"))],
            respawn=True,  # what is killed comes back; the others go on meanwhile
            respawn_delay=0.5,
            output="screen",
        )
        for node in testbed.nodes(folder)
    ]


def generate_launch_description() -> LaunchDescription:
    config = {name: str(packaged("config", f"{name}.yaml")) for name in ("socket", "calibration")}
    return LaunchDescription(
        [
            # It stays on this machine unless the user's own environment says otherwise.
            SetEnvironmentVariable(RANGE, EnvironmentVariable(RANGE, default_value="LOCALHOST")),
            # A node that is started again has the same clock as the others.
            *(SetEnvironmentVariable(*item) for item in shared_environment().items()),
            DeclareLaunchArgument("params", description="node parameters, a testbed.yaml"),
            DeclareLaunchArgument("geometry", default_value=config["socket"]),
            DeclareLaunchArgument("calibration", default_value=config["calibration"]),
            DeclareLaunchArgument("record", default_value="", description="folder of a new trial"),
            DeclareLaunchArgument("namespace", default_value="", description="of the nodes"),
            OpaqueFunction(function=bring_up),
        ]
    )
