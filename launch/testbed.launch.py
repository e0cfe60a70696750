"""The testbed on a ROS installation, as `socket-testbed run` starts it: on hardware or simulated.

ros2 launch socket_testbed testbed.launch.py params:=/path/of/testbed.yaml record:=/path/of/trial
ros2 launch socket_testbed testbed.launch.py simulated:=true namespace:=left
"""

from pathlib import Path

from launch.actions import (
    DeclareLaunchArgument,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
)
from launch.event_handlers import OnShutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription
from socket_testbed.clocks import shared_environment
from socket_testbed.files import local_graph, packaged
from socket_testbed.live.bringup import (
    Simulation,
    Testbed,
    simulate_hardware,
    testbed_settings,
)
from socket_testbed.live.processes import Graph, launched

# The simulated world, and a folder for parameters and the tare, until this program ends: a node
# that is started again finds them.
GRAPH = Graph()

ARGUMENTS = {
    "params": ("", "node parameters, a testbed.yaml"),
    "geometry": (str(packaged("config", "socket.yaml")), "the socket, a socket.yaml"),
    "calibration": (str(packaged("config", "calibration.yaml")), "a calibration.yaml"),
    "record": ("", "folder of a new trial; empty: no recording"),
    "namespace": ("", "of nodes and topics, such as left; empty: none"),
}


def bring_up(context: LaunchContext) -> list[Node | RegisterEventHandler]:
    given = {n: LaunchConfiguration(n).perform(context) for n in ("simulated", *ARGUMENTS)}
    simulation = Simulation() if given["simulated"] == "true" else None
    params = Path(given["params"]) if given["params"] else None
    testbed = Testbed(
        testbed_settings(params, simulation),
        geometry=Path(given["geometry"]).resolve(),
        calibration=Path(given["calibration"]).resolve(),
        simulation=simulation,
        record=Path(given["record"]) if given["record"] else None,
        namespace=given["namespace"],
    )
    testbed.check_devices()
    if simulation is not None:
        testbed, _ = simulate_hardware(GRAPH, testbed, simulation)
    end = OnShutdown(on_shutdown=lambda event, context: GRAPH.stop())
    # What is killed comes back; the others go on meanwhile.
    nodes = [
        Node(**launched(node, GRAPH.folder), respawn=True, respawn_delay=0.5)
        for node in testbed.nodes(GRAPH.folder)
    ]
    return [*nodes, RegisterEventHandler(end)]


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            # It stays on this machine unless the user's own environment says otherwise.
            *(SetEnvironmentVariable(*item) for item in local_graph().items()),
            # A node that is started again has the same clock as the others.
            *(SetEnvironmentVariable(*item) for item in shared_environment().items()),
            DeclareLaunchArgument(
                "simulated",
                default_value="false",
                choices=["true", "false"],
                description="simulate the hardware at its buses",
            ),
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=bring_up),
        ]
    )
