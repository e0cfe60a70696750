"""Arguments of the verbs that can simulate the hardware."""

from __future__ import annotations

import argparse

from socket_testbed.bringup import Simulation
from socket_testbed.documents import check_number, closest
from socket_testbed.errors import ConfigurationError
from socket_testbed.simulation.devices.faults import FAULTS
from socket_testbed.simulation.loading import SCENARIOS


def add_simulation(parser: argparse.ArgumentParser) -> None:
    """Hardware that is simulated at its buses."""
    group = parser.add_argument_group("simulated hardware")
    group.add_argument("--simulated", action="store_true", help="simulate it at its buses")
    group.add_argument(
        "--scenario", choices=SCENARIOS, default="static_hold", help="load (default: static_hold)"
    )
    group.add_argument(
        "--period", type=float, default=120.0, metavar="S", help="of the scenario (default: 120 s)"
    )
    group.add_argument("--seed", type=int, default=0, help="seed of all that is random")
    group.add_argument(
        "--fault", action="append", default=[], metavar="NAME=VALUE",
        help="switch a fault on, such as load_cell.flipped_bits=0.01; see docs/faults.md",
    )  # fmt: skip


def simulation_of(options: argparse.Namespace) -> tuple[Simulation | None, dict[str, float]]:
    """What is simulated, None on hardware, and the faults that are on."""
    faults = dict(_fault(text) for text in options.fault)
    if not options.simulated:
        if faults:
            raise ConfigurationError("--fault is for simulated hardware", "add --simulated")
        return None, {}
    check_number(options.period, "--period", 5.0, 3600.0)
    check_number(options.seed, "--seed", 0)
    return Simulation(options.scenario, options.period, options.seed), faults


def _fault(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    if name not in FAULTS:
        raise ConfigurationError(f"--fault {text}: unknown fault '{name}'", closest(name, FAULTS))
    try:
        return name, check_number(float(value), f"--fault {name}", -1e6, 1e6)
    except ValueError:
        raise ConfigurationError(
            f"--fault {text}: '{value}' is no number", f"{name} takes {FAULTS[name]}"
        ) from None
