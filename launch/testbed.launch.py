"""The testbed on a ROS installation, as started by `socket-testbed run`: on hardware or simulated.

ros2 launch socket_testbed testbed.launch.py params:=/path/of/testbed.yaml record:=/path/of/trial
ros2 launch socket_testbed testbed.launch.py simulated:=true namespace:=left
"""

import time
from functools import partial
from pathlib import Path

import yaml
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
    TimerAction,
)
from launch.event_handlers import OnShutdown
from launch.events import Shutdown
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription
from socket_testbed.clocks import Backoff
from socket_testbed.errors import ConfigurationError
from socket_testbed.live.bringup import (
    Simulation,
    Testbed,
    check_new_trial,
    new_trial,
    simulate_hardware,
    testbed_files,
    testbed_settings,
)
from socket_testbed.live.hardware import require_free
from socket_testbed.live.processes import (
    MAX_BACKOFF,
    Graph,
    GraphNode,
    is_wrong_input,
    launch_environment,
    launch_namespace,
    launched,
    wait_again,
)

# Holds the simulated world and a folder for parameters and the tare until this program ends, so
# that a restarted node finds them.
GRAPH = Graph()
BEGAN = time.monotonic()

ARGUMENTS = {
    "params": ("", "node parameters, a testbed.yaml"),
    "geometry": ("", "a socket.yaml; empty: as in params, or the package's own"),
    "calibration": ("", "a calibration.yaml; empty: as in params, or the package's own"),
    "record": ("", "folder of a new trial; empty: as in params, or no recording"),
    "namespace": ("", "of nodes and topics, such as left; relative to that of a group"),
    "time_scale": ("1.0", "speed of the simulated testbed relative to real time, at most 1"),
}


def bring_up(context: LaunchContext) -> list[Node | RegisterEventHandler | SetEnvironmentVariable]:
    given = {n: LaunchConfiguration(n).perform(context) for n in ("simulated", *ARGUMENTS)}
    simulation, scale = None, yaml.safe_load(given["time_scale"])
    if given["simulated"] == "true":
        simulation = Simulation(time_scale=scale)
    elif scale != 1.0:
        raise ConfigurationError("time_scale is for simulated hardware", "add simulated:=true")
    params = Path(given["params"]) if given["params"] else None
    pushed = context.launch_configurations.get("ros_namespace", "")
    namespace = launch_namespace(given["namespace"], pushed)
    settings = testbed_settings(params, simulation, namespace)
    testbed = Testbed(
        settings,
        *testbed_files(settings, given["geometry"], given["calibration"]),
        simulation=simulation,
        record=new_trial(settings, Path(given["record"]) if given["record"] else None),
        namespace=namespace,
    )
    testbed.check_devices()
    if testbed.record is not None:
        check_new_trial(testbed.record)
    if simulation is None:
        require_free(testbed.settings)
    else:
        testbed, _ = simulate_hardware(GRAPH, testbed, simulation)
    end = OnShutdown(on_shutdown=lambda event, context: GRAPH.stop())
    return [
        # A restarted node and the simulated world have the same clock as the others.
        *(SetEnvironmentVariable(*item) for item in GRAPH.clock.items()),
        *(started(node, Backoff(MAX_BACKOFF)) for node in testbed.nodes(GRAPH.folder)),
        RegisterEventHandler(end),
    ]


def started(node: GraphNode, backoff: Backoff, again: bool = False) -> Node:
    end = partial(on_exit, node, backoff, time.monotonic())
    return Node(**launched(node, GRAPH.folder, again), on_exit=end)


def on_exit(
    node: GraphNode, backoff: Backoff, since: float, event: ProcessExited, context: LaunchContext
) -> list[EmitEvent | TimerAction]:
    """Restart a node that failed, as `run` does, unless wrong input ends the launch.

    A node that ended cleanly, because somebody asked it to, stays ended.
    """
    if context.is_shutdown or event.returncode == 0:
        return []
    if is_wrong_input(event.returncode, BEGAN) and not node.optional:
        reason = f"{node.name} failed: see what it printed"
        return [EmitEvent(event=Shutdown(reason=reason))]
    wait = wait_again(backoff, since)
    return [TimerAction(period=wait, actions=[started(node, backoff, again=True)])]


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            # The graph stays on this machine unless the user's environment says otherwise.
            *(SetEnvironmentVariable(*item) for item in launch_environment().items()),
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
