"""Replay a trial through calibration and estimator, on a ROS installation.

ros2 launch socket_testbed replay.launch.py trial:=/path/of/trial rate:=2.0
"""

import tempfile
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
from socket_testbed.files import local_graph
from socket_testbed.live.bringup import replay_nodes
from socket_testbed.live.processes import launched
from socket_testbed.settings.testbed import ReplaySettings, read_testbed
from socket_testbed.trials.trial import Trial

TEMPORARY = tempfile.TemporaryDirectory(prefix="socket_testbed_")  # until this program ends

ARGUMENTS = {
    "rate": ("1.0", "speed against the recording"),
    "loop": ("false", "start again at the end"),
    "namespace": ("", "of nodes and topics, such as left; empty: as recorded"),
    "params": ("", "node parameters; empty: the trial's own"),
}


def bring_up(context: LaunchContext) -> list[Node | RegisterEventHandler]:
    given = {n: LaunchConfiguration(n).perform(context) for n in ("trial", *ARGUMENTS)}
    trial = Trial(Path(given["trial"]).resolve())
    replay = ReplaySettings(
        trial=str(trial.path),
        namespace=given["namespace"],
        rate=yaml.safe_load(given["rate"]),
        loop=yaml.safe_load(given["loop"]),
    )
    estimator = trial.estimator
    if given["params"]:
        estimator = read_testbed(Path(given["params"])).estimator_node
    nodes = [
        Node(**launched(node, Path(TEMPORARY.name)))
        for node in replay_nodes(trial, replay, estimator)
    ]
    end = OnProcessExit(target_action=nodes[-1], on_exit=[EmitEvent(event=Shutdown())])
    return [*nodes, RegisterEventHandler(end)]


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            # It stays on this machine unless the user's own environment says otherwise.
            *(SetEnvironmentVariable(*item) for item in local_graph().items()),
            DeclareLaunchArgument("trial", description="folder of the trial"),
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=bring_up),
        ]
    )
