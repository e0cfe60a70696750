"""Arguments that describe the testbed to the verbs that work with its hardware."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TypeVar

from socket_testbed.acquisition_settings import (
    ClusterSettings,
    LoadCellSettings,
    MocapSettings,
    TriggerSettings,
)
from socket_testbed.bringup import Simulation, Testbed
from socket_testbed.checked import Settings
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.settings import EstimatorSettings, read_parameters

S = TypeVar("S", bound=Settings)


def add_testbed(parser: argparse.ArgumentParser) -> None:
    """The configuration of a testbed."""
    parser.add_argument("--geometry", type=Path, metavar="SOCKET.yaml", help="the socket")
    parser.add_argument(
        "--calibration", type=Path, metavar="CALIBRATION.yaml", help="of the clusters"
    )
    parser.add_argument("--params", type=Path, metavar="TESTBED.yaml", help="node parameters")


def testbed_of(options: argparse.Namespace, simulation: Simulation | None) -> Testbed:
    """The testbed that is meant; whatever is wrong with it is named before any node starts.

    Raises:
        TestbedError: For a wrong file, or files that do not belong together.
    """
    # A simulated load cell is described by the package; a real one only by its owner.
    given = read_parameters(packaged("config", "simulated.yaml")) if simulation else {}
    if options.params is not None:
        given |= read_parameters(options.params)

    def of(node: str, kind: type[S]) -> S:
        settings = given.get(node, kind())
        assert isinstance(settings, kind)
        return settings

    geometry = (options.geometry or packaged("config", "socket.yaml")).resolve()
    if simulation is None and not read_socket(geometry).registration:
        print(
            f"note: {geometry}: the marker bodies are nominal: register them before the limb's"
            " position is trusted",
            file=sys.stderr,
        )
    return Testbed(
        trigger=of("trigger_node", TriggerSettings),
        clusters=of("cluster_node", ClusterSettings),
        load_cell=of("load_cell_node", LoadCellSettings),
        mocap=of("mocap_node", MocapSettings),
        estimator=of("estimator_node", EstimatorSettings),
        geometry=geometry,
        calibration=(options.calibration or packaged("config", "calibration.yaml")).resolve(),
        simulation=simulation,
    )
