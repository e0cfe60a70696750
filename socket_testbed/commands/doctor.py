"""`doctor`: what is wired and what is not, as a table, with the hint of what is not."""

from __future__ import annotations

import argparse
import dataclasses
from contextlib import ExitStack

from socket_testbed import clocks
from socket_testbed.commands.hardware_options import (
    add_simulation,
    add_testbed,
    simulation_of,
    testbed_of,
)
from socket_testbed.commands.text import table
from socket_testbed.errors import DeviceError
from socket_testbed.live.bringup import simulate_hardware
from socket_testbed.live.doctor import examine
from socket_testbed.live.processes import Graph


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_testbed(parser)
    add_simulation(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Look at everything that is configured."""
    simulation, faults = simulation_of(options)
    testbed = testbed_of(options, simulation)
    with ExitStack() as stack:
        if simulation is not None:
            # The drivers run in this process: the simulation keeps to its clock.
            simulation = dataclasses.replace(simulation, time_scale=clocks.time_scale())
            graph = stack.enter_context(Graph())
            testbed, world = simulate_hardware(graph, testbed, simulation)
            for name, value in faults.items():
                world.faults.switch(name, value)
        findings = examine(testbed)
    rows = [[f.what, "failed" if f.hint else "ok", f.found, f.hint] for f in findings]
    print(table(["what", "", "found", "hint"], rows))
    failing = sum(bool(finding.hint) for finding in findings)
    if failing:
        raise DeviceError(f"{failing} of {len(findings)} checks failed", "see the table's hints")
