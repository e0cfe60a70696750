"""Arguments of the verbs that work with the testbed's hardware, real or simulated."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from socket_testbed.documents import check_number
from socket_testbed.errors import ConfigurationError, closest
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.live.bringup import Testbed, testbed_settings
from socket_testbed.live.simulated_world import Simulation
from socket_testbed.simulation.limb import SCENARIOS, TISSUES
from socket_testbed.simulation.world import FAULTS


def add_simulation(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Hardware that is simulated at its buses; returns the group of these arguments."""
    group = parser.add_argument_group("simulated hardware")
    group.add_argument("--simulated", action="store_true", help="simulate it at its buses")
    group.add_argument(
        "--scenario", choices=SCENARIOS, default="static_hold", help="load (default: static_hold)"
    )
    group.add_argument(
        "--period", type=float, default=120.0, metavar="S", help="of the scenario (default: 120 s)"
    )
    group.add_argument(
        "--tissue", choices=TISSUES, default="soft", help="of the limb (default: soft)"
    )
    group.add_argument("--seed", type=int, default=0, help="seed of all that is random")
    group.add_argument(
        "--fault", action="append", default=[], metavar="NAME=VALUE",
        help="switch a fault on, such as load_cell.flipped_bits=0.01; see docs/faults.md",
    )  # fmt: skip
    return group


def simulation_of(options: argparse.Namespace) -> tuple[Simulation | None, dict[str, float]]:
    """What is simulated, None on hardware, and the faults that are on."""
    faults = dict(_fault(text) for text in options.fault)
    if not options.simulated:
        if faults:
            raise ConfigurationError("--fault is for simulated hardware", "add --simulated")
        return None, {}
    check_number(options.period, "--period", 5.0, 3600.0)
    check_number(options.seed, "--seed", 0)
    return Simulation(options.scenario, options.period, options.seed, tissue=options.tissue), faults


def _fault(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    if name not in FAULTS:
        raise ConfigurationError(f"--fault {text}: unknown fault '{name}'", closest(name, FAULTS))
    try:
        return name, check_number(float(value), f"--fault {name}", -1e6, 1e6)
    except ValueError:
        raise ConfigurationError(
            f"--fault {text}: '{value}' is not a number", f"{name} takes {FAULTS[name]}"
        ) from None


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
    geometry = (options.geometry or packaged("config", "socket.yaml")).resolve()
    if simulation is None and not read_socket(geometry).registration:
        print(
            f"note: {geometry}: the marker bodies are nominal: register them before the limb's"
            " position is trusted",
            file=sys.stderr,
        )
    return Testbed(
        settings=testbed_settings(options.params, simulation),
        geometry=geometry,
        calibration=(options.calibration or packaged("config", "calibration.yaml")).resolve(),
        simulation=simulation,
    )
