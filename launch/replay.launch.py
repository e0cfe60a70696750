"""Replay a trial through the calibration and estimator nodes, on a ROS installation.

ros2 launch socket_testbed replay.launch.py trial:=/path/of/trial rate:=2.0
"""

from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    trial = LaunchConfiguration("trial")
    namespace = LaunchConfiguration("namespace")

    def node(executable: str, parameters: dict) -> Node:
        return Node(
            package="socket_testbed",
            executable=executable,
            name=executable,
            namespace=namespace,
            parameters=[LaunchConfiguration("params"), parameters],
            output="screen",
        )

    estimator = node(
        "estimator_node",
        {"geometry": PathJoinSubstitution([trial, "socket.yaml"]), "use_sim_time": True},
    )
    calibration = node(
        "calibration_node",
        {"calibration": PathJoinSubstitution([trial, "calibration.yaml"]), "use_sim_time": True},
    )
    replay = node(
        "replay_node",
        {
            "trial": ParameterValue(trial, value_type=str),
            "rate": ParameterValue(LaunchConfiguration("rate"), value_type=float),
            "loop": ParameterValue(LaunchConfiguration("loop"), value_type=bool),
            "measured_only": True,
            "wait_for": ["calibration_node", "estimator_node"],
        },
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("trial", description="folder of the trial"),
            DeclareLaunchArgument("rate", default_value="1.0", description="speed [-]"),
            DeclareLaunchArgument("loop", default_value="false", description="start again"),
            DeclareLaunchArgument("namespace", default_value="", description="of the nodes"),
            DeclareLaunchArgument(
                "params",
                default_value=PathJoinSubstitution([trial, "testbed.yaml"]),
                description="node parameters; the trial's own by default",
            ),
            calibration,
            estimator,
            replay,
            RegisterEventHandler(
                OnProcessExit(target_action=replay, on_exit=[EmitEvent(event=Shutdown())])
            ),
        ]
    )
