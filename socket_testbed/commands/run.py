"""`run`: the whole testbed in one command, on hardware or simulated, until Ctrl-C."""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from pathlib import Path

from socket_testbed.commands.hardware_options import (
    add_simulation,
    add_testbed,
    simulation_of,
    testbed_of,
)
from socket_testbed.commands.options import add_model_choice, choose_model
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import check_number, refuse_existing
from socket_testbed.identification.fit import check_names
from socket_testbed.identification.model_file import read_model
from socket_testbed.live.bringup import Simulation, Testbed, end, start, summary
from socket_testbed.live.processes import Graph


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_testbed(parser)
    add_model_choice(parser)
    parser.add_argument("--record", type=Path, metavar="DIR", help="record a trial into DIR")
    parser.add_argument("--model", type=Path, metavar="MODEL", help="predict with it, fit none")
    parser.add_argument("--rate", type=float, metavar="HZ", help="rate of the trigger [Hz]")
    parser.add_argument(
        "--duration", type=float, metavar="S", help="end by itself after S, start included [s]"
    )
    parser.add_argument(
        "--one-process", action="store_true", help="all nodes but trigger and recorder in one"
    )
    add_simulation(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Run until interrupted."""
    if options.duration is not None:
        check_number(options.duration, "--duration", 0.1, 1e6)
    if options.record is not None:
        _check_writable(options.record)
    simulation, faults = simulation_of(options)
    testbed = _testbed(options, simulation)
    with Graph() as graph:
        world = start(graph, testbed)
        for name, value in faults.items():
            assert world is not None
            world.faults.switch(name, value)
        _say("the testbed starts; Ctrl-C ends it")
        ends = time.monotonic() + (options.duration or float("inf"))
        try:
            graph.watch(lambda: time.monotonic() >= ends, _say)
        except KeyboardInterrupt:
            _say("ending")
        end(graph, testbed)
    if testbed.record is not None:
        print(summary(testbed.record))


def _check_writable(path: Path) -> None:
    """Refuse a folder that cannot be made, before anything is started."""
    refuse_existing(path)
    try:
        path.mkdir(parents=True)
        path.rmdir()
    except OSError as error:
        raise ConfigurationError(
            f"{path}: cannot be written ({error.strerror})", "name another folder with --record"
        ) from None


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _testbed(options: argparse.Namespace, simulation: Simulation | None) -> Testbed:
    """What the options mean."""
    testbed = testbed_of(options, simulation)
    trigger = testbed.settings.trigger_node
    if options.rate is not None:
        trigger = dataclasses.replace(trigger, rate=options.rate)
    estimator = choose_model(options, testbed.settings.estimator_node)
    check_names(estimator.identification, testbed.settings.cluster_node.names)
    if options.model is not None:
        read_model(options.model)
        model = str(options.model.resolve())
        estimator = dataclasses.replace(estimator, model=model, auto_fit=False)
    return dataclasses.replace(
        testbed,
        settings=dataclasses.replace(
            testbed.settings, trigger_node=trigger, estimator_node=estimator
        ),
        record=options.record,
        one_process=options.one_process,
    )
