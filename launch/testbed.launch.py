# Copyright 2026 socket_testbed maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The testbed on a ROS installation, as `socket-testbed run` starts it: on hardware or simulated.

ros2 launch socket_testbed testbed.launch.py params:=/path/of/testbed.yaml record:=/path/of/trial
ros2 launch socket_testbed testbed.launch.py simulated:=true namespace:=left
"""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
)
from launch.event_handlers import OnShutdown
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node
from socket_testbed.clocks import shared_environment
from socket_testbed.files import packaged
from socket_testbed.live.bringup import (
    simulate_hardware,
    Simulation,
    Testbed,
    testbed_settings,
)
from socket_testbed.live.processes import Graph, REMAPPINGS, write_parameters

RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
# The simulated world, and a folder for parameters and the tare, until this program ends: a node
# that is started again finds them.
GRAPH = Graph()


def bring_up(context: LaunchContext) -> list[Node | RegisterEventHandler]:
    def given(name: str) -> str:
        return LaunchConfiguration(name).perform(context)

    simulation = Simulation() if given('simulated') == 'true' else None
    params = Path(given('params')) if given('params') else None
    testbed = Testbed(
        testbed_settings(params, simulation),
        geometry=Path(given('geometry')).resolve(),
        calibration=Path(given('calibration')).resolve(),
        simulation=simulation,
        record=Path(given('record')) if given('record') else None,
        namespace=given('namespace'),
    )
    testbed.check_devices()
    if simulation is not None:
        testbed, _ = simulate_hardware(GRAPH, testbed, simulation)
    end = OnShutdown(on_shutdown=lambda event, context: GRAPH.stop())
    nodes = [
        Node(
            package='socket_testbed',
            executable=node.name,
            name=node.name,
            namespace=node.namespace,
            remappings=REMAPPINGS,
            parameters=[str(write_parameters([node], GRAPH.folder / f'{node.name}.yaml'))],
            respawn=True,  # what is killed comes back; the others go on meanwhile
            respawn_delay=0.5,
            output='screen',
        )
        for node in testbed.nodes(GRAPH.folder)
    ]
    return [*nodes, RegisterEventHandler(end)]


def generate_launch_description() -> LaunchDescription:
    config = {name: str(packaged('config', f'{name}.yaml')) for name in ('socket', 'calibration')}
    return LaunchDescription(
        [
            # It stays on this machine unless the user's own environment says otherwise.
            SetEnvironmentVariable(RANGE, EnvironmentVariable(RANGE, default_value='LOCALHOST')),
            # A node that is started again has the same clock as the others.
            *(SetEnvironmentVariable(*item) for item in shared_environment().items()),
            DeclareLaunchArgument(
                'params', default_value='', description='node parameters, a testbed.yaml'
            ),
            DeclareLaunchArgument(
                'geometry', default_value=config['socket'], description='the socket, a socket.yaml'
            ),
            DeclareLaunchArgument(
                'calibration',
                default_value=config['calibration'],
                description='of the clusters, a calibration.yaml',
            ),
            DeclareLaunchArgument(
                'simulated',
                default_value='false',
                choices=['true', 'false'],
                description='simulate the hardware at its buses',
            ),
            DeclareLaunchArgument(
                'record',
                default_value='',
                description='folder of a new trial; empty: no recording',
            ),
            DeclareLaunchArgument(
                'namespace',
                default_value='',
                description='of nodes and topics, such as left; empty: none',
            ),
            OpaqueFunction(function=bring_up),
        ]
    )
