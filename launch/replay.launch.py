"""Replay a trial through calibration and estimator, on a ROS installation.

ros2 launch socket_testbed replay.launch.py trial:=/path/of/trial rate:=2.0
"""

from pathlib import Path

import yaml
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription
from socket_testbed.files import TemporaryFolder
from socket_testbed.live.bringup import replay_nodes
from socket_testbed.live.processes import launch_environment, launch_namespace, launched
from socket_testbed.settings.options import SettingsOptions
from socket_testbed.settings.testbed import ReplaySettings
from socket_testbed.trials.trial import Trial

TEMPORARY = TemporaryFolder()  # until this program ends

ARGUMENTS = {
    "rate": ("1.0", "speed relative to the recording"),
    "loop": ("false", "restart at the end"),
    "namespace": ("", "of nodes and topics, such as left; empty: that of a group, or as recorded"),
    "geometry": ("", "the socket, a socket.yaml; empty: the trial's own"),
    "calibration": ("", "a calibration.yaml; empty: the trial's own"),
    "params": ("", "node parameters, a testbed.yaml; empty: the trial's own"),
}


def bring_up(context: LaunchContext) -> list[Node | RegisterEventHandler]:
    given = {n: LaunchConfiguration(n).perform(context) for n in ("trial", *ARGUMENTS)}
    geometry, calibration, params = (
        Path(given[name]).resolve() if given[name] else None
        for name in ("geometry", "calibration", "params")
    )
    trial = Trial(Path(given["trial"]).resolve(), geometry, calibration)
    namespace, pushed = given["namespace"], context.launch_configurations.get("ros_namespace", "")
    if namespace or pushed:
        namespace = launch_namespace(namespace, pushed)
    replay = ReplaySettings(
        trial=str(trial.path),
        namespace=namespace,
        rate=yaml.safe_load(given["rate"]),
        loop=yaml.safe_load(given["loop"]),
    )
    estimator = trial.settings_for(SettingsOptions(params=params))
    nodes = [
        Node(**launched(node, Path(TEMPORARY.name)))
        for node in replay_nodes(trial, replay, estimator)
    ]
    end = OnProcessExit(target_action=nodes[-1], on_exit=[EmitEvent(event=Shutdown())])
    return [*nodes, RegisterEventHandler(end)]


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            # The graph stays on this machine unless the user's environment says otherwise.
            *(SetEnvironmentVariable(*item) for item in launch_environment().items()),
            DeclareLaunchArgument("trial", description="folder of the trial"),
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=bring_up),
        ]
    )
