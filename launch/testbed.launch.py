"""The whole testbed on hardware, on a ROS installation.

ros2 launch socket_testbed testbed.launch.py params:=/path/of/testbed.yaml record:=/path/of/trial
"""

from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription
from socket_testbed.clocks import BEGINNING, SteadyClock

SENSING = ["cluster_node", "load_cell_node", "mocap_node", "calibration_node", "estimator_node"]


def generate_launch_description() -> LaunchDescription:
    geometry = LaunchConfiguration("geometry")
    calibration = LaunchConfiguration("calibration")
    params = LaunchConfiguration("params")
    record = LaunchConfiguration("record")
    recording = IfCondition(PythonExpression(["'", record, "' != ''"]))

    def packaged(name: str) -> PathJoinSubstitution:
        return PathJoinSubstitution([FindPackageShare("socket_testbed"), "config", name])

    def node(executable: str, parameters: dict, condition: IfCondition | None = None) -> Node:
        return Node(
            package="socket_testbed",
            executable=executable,
            name=executable,
            namespace=LaunchConfiguration("namespace"),
            parameters=[params, parameters],
            condition=condition,
            respawn=True,  # what is killed comes back; the others go on meanwhile
            respawn_delay=0.5,
            output="screen",
        )

    # A node that is started again tells the same time as the others.
    beginning = SetEnvironmentVariable(BEGINNING, str(SteadyClock().beginning))
    return LaunchDescription(
        [
            beginning,
            DeclareLaunchArgument("params", description="node parameters, a testbed.yaml"),
            DeclareLaunchArgument("geometry", default_value=packaged("socket.yaml")),
            DeclareLaunchArgument("calibration", default_value=packaged("calibration.yaml")),
            DeclareLaunchArgument("record", default_value="", description="folder of a new trial"),
            DeclareLaunchArgument("namespace", default_value="", description="of the nodes"),
            node(
                "recorder_node",
                {
                    "record": True,
                    "directory": record,
                    "geometry": geometry,
                    "calibration": calibration,
                    "parameters": params,
                },
                recording,
            ),
            node("trigger_node", {"wait_for": SENSING}),
            node("cluster_node", {}),
            node("load_cell_node", {}),
            node("mocap_node", {"geometry": geometry}),
            node("calibration_node", {"calibration": calibration}),
            node("estimator_node", {"geometry": geometry}),
        ]
    )
