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

"""Replay a trial through calibration and estimator, on a ROS installation.

ros2 launch socket_testbed replay.launch.py trial:=/path/of/trial rate:=2.0
"""

from pathlib import Path
import tempfile

from launch import LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node
from socket_testbed.live.bringup import replay_nodes
from socket_testbed.live.processes import REMAPPINGS, write_parameters
from socket_testbed.settings.testbed import read_testbed, ReplaySettings
from socket_testbed.trials.trial import Trial
import yaml

RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
TEMPORARY = tempfile.TemporaryDirectory(prefix='socket_testbed_')  # until this program ends


def bring_up(context: LaunchContext) -> list[Node | RegisterEventHandler]:
    def given(name: str) -> str:
        return LaunchConfiguration(name).perform(context)

    trial = Trial(Path(given('trial')).resolve())
    replay = ReplaySettings(
        trial=str(trial.path),
        namespace=given('namespace'),
        rate=yaml.safe_load(given('rate')),
        loop=yaml.safe_load(given('loop')),
    )
    estimator = trial.estimator
    if given('params'):
        estimator = read_testbed(Path(given('params'))).estimator_node
    folder = Path(TEMPORARY.name)
    nodes = [
        Node(
            package='socket_testbed',
            executable=node.name,
            name=node.name,
            namespace=node.namespace,
            remappings=REMAPPINGS,
            parameters=[str(write_parameters([node], folder / f'{node.name}.yaml'))],
            output='screen',
        )
        for node in replay_nodes(trial, replay, estimator)
    ]
    end = OnProcessExit(target_action=nodes[-1], on_exit=[EmitEvent(event=Shutdown())])
    return [*nodes, RegisterEventHandler(end)]


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            # It stays on this machine unless the user's own environment says otherwise.
            SetEnvironmentVariable(RANGE, EnvironmentVariable(RANGE, default_value='LOCALHOST')),
            DeclareLaunchArgument('trial', description='folder of the trial'),
            DeclareLaunchArgument(
                'rate', default_value='1.0', description='speed against the recording'
            ),
            DeclareLaunchArgument(
                'loop', default_value='false', description='start again at the end'
            ),
            DeclareLaunchArgument(
                'namespace',
                default_value='',
                description='of nodes and topics, such as left; empty: as recorded',
            ),
            DeclareLaunchArgument(
                'params', default_value='', description="node parameters; empty: the trial's own"
            ),
            OpaqueFunction(function=bring_up),
        ]
    )
