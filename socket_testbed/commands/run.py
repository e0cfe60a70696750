"""`run`: the whole testbed in one command, on hardware or simulated, until Ctrl-C."""

from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path

from socket_testbed.commands.hardware_options import (
    add_simulation,
    add_testbed,
    simulation_of,
    testbed_of,
)
from socket_testbed.commands.options import (
    add_metadata,
    add_model_choice,
    choose_model,
    metadata_of,
)
from socket_testbed.commands.status_line import StatusLine
from socket_testbed.commands.text import say
from socket_testbed.documents import check_number
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import check_new_folder, make_folder
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.fit import check_names
from socket_testbed.live.bringup import Testbed, end, predict_with, start, summary
from socket_testbed.live.machine import busy_note, measure_speed, pace
from socket_testbed.live.processes import Graph, GraphNode
from socket_testbed.live.simulated_world import Simulation
from socket_testbed.settings.testbed import check_take_name
from socket_testbed.trials.metadata import TrialMetadata
from socket_testbed.trials.topics import full_namespace


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_testbed(parser)
    add_model_choice(parser)
    parser.add_argument("--record", type=Path, metavar="DIR", help="record a trial into DIR")
    add_metadata(parser)
    parser.add_argument("--model", type=Path, metavar="MODEL", help="predict with it, fit none")
    parser.add_argument("--rate", type=float, metavar="HZ", help="rate of the trigger [Hz]")
    parser.add_argument(
        "--duration", type=float, metavar="S",
        help="end by itself after S of testbed time, start included [s]",
    )  # fmt: skip
    parser.add_argument(
        "--one-process", action="store_true", help="all nodes but trigger and recorder in one"
    )
    view = parser.add_argument_group("the page in a browser")
    view.add_argument("--view", action="store_true", help="serve it, see 'socket-testbed view'")
    view.add_argument("--view-host", metavar="ADDRESS", help="on this address of the machine")
    view.add_argument("--view-port", type=int, metavar="N", help="on this port")
    group = add_simulation(parser)
    group.add_argument(
        "--time-scale", metavar="X", default="1",
        help="run X times as fast as real time, 1 at most; auto: as fast as the machine manages",
    )  # fmt: skip
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Run until interrupted."""
    if options.duration is not None:
        check_number(options.duration, "--duration", 0.1, 1e6)
    if options.record is not None:
        _check_writable(options.record)
    simulation, faults = simulation_of(options)
    if simulation is not None:
        scale = _time_scale(options.time_scale)
        simulation = dataclasses.replace(simulation, time_scale=scale)
    elif options.time_scale != "1":
        raise ConfigurationError("--time-scale is for simulated hardware", "add --simulated")
    testbed = _testbed(options, simulation)
    page = _page(options, testbed)
    disk = testbed.record.parent if testbed.record else None
    with StatusLine(disk) as status, Graph(status.output, status.renew) as graph:
        world = start(graph, testbed)
        if page is not None:
            graph.start_nodes([page])
        for name, value in faults.items():
            assert world is not None
            world.faults.switch(name, value)
        status.say("the testbed starts; Ctrl-C ends it")
        ends = time.monotonic() + (options.duration or float("inf")) / testbed.time_scale
        try:
            status.follow(testbed.namespace)
            graph.watch(lambda: time.monotonic() >= ends, status.say)
        except KeyboardInterrupt:
            status.say("ending")
        end(graph, testbed)
    if testbed.record is not None:
        print(summary(testbed.record))


def _page(options: argparse.Namespace, testbed: Testbed) -> GraphNode | None:
    """The node that serves the page, without which the testbed goes on; None if none is wanted."""
    given = {"host": options.view_host, "port": options.view_port}
    given = {name: value for name, value in given.items() if value is not None}
    if not options.view:
        if given:
            raise ConfigurationError(f"--view-{next(iter(given))} is for a page", "add --view")
        return None
    from socket_testbed.commands.view import check_page

    settings = dataclasses.replace(
        testbed.settings.view_node, geometry=str(testbed.geometry), **given
    )
    check_page(settings)
    return GraphNode("view_node", settings, full_namespace(testbed.namespace), optional=True)


def _check_writable(path: Path) -> None:
    """Refuse a folder that cannot be made, before anything is started."""
    check_new_folder(path)
    check_take_name(path.resolve().name)
    make_folder(path.parent)
    try:
        path.mkdir()
        path.rmdir()
    except OSError as error:
        raise ConfigurationError(
            f"{path}: cannot be written ({error.strerror})", "name another folder with --record"
        ) from None


def _time_scale(text: str) -> float:
    """The time scale that is given or, for 'auto', measured; it says so unless it is 1."""
    if text == "auto":
        scale = measure_speed().time_scale()
        if note := busy_note(scale):
            say(note)
        return scale
    try:
        scale = check_number(float(text), "--time-scale", 0.01, 1.0)
    except ValueError:
        raise ConfigurationError(
            f"--time-scale: '{text}' is not a number", "give a number up to 1, or auto"
        ) from None
    if scale != 1.0:
        say(f"the simulated testbed runs at {pace(scale)}")
    return scale


def _testbed(options: argparse.Namespace, simulation: Simulation | None) -> Testbed:
    """What the options mean."""
    testbed = testbed_of(options, simulation)
    trigger = testbed.settings.trigger_node
    if options.rate is not None:
        trigger = dataclasses.replace(trigger, rate=options.rate)
    estimator = choose_model(options, testbed.settings.estimator_node)
    check_names(estimator.identification, testbed.settings.cluster_node.names)
    if options.model is not None:
        estimator = predict_with(options.model, estimator, read_socket(testbed.geometry))
    return dataclasses.replace(
        testbed,
        settings=dataclasses.replace(
            testbed.settings, trigger_node=trigger, estimator_node=estimator
        ),
        record=options.record,
        metadata=_metadata(options),
        one_process=options.one_process,
    )


def _metadata(options: argparse.Namespace) -> TrialMetadata:
    """Metadata of the new trial."""
    metadata = metadata_of(options)
    if options.record is None and (stated := metadata.stated()):
        raise ConfigurationError(
            f"--{next(iter(stated))} is for a trial that is recorded", "add --record DIR"
        )
    return metadata
