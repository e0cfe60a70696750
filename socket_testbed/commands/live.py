"""`run`, `doctor`, `record` and `replay`: the graph on real or simulated hardware or a trial."""

from __future__ import annotations

import dataclasses
import glob
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Literal

from socket_testbed import clocks
from socket_testbed.commands import calls
from socket_testbed.commands.calls import ConfigurationOptions, SimulatedOptions, takes
from socket_testbed.commands.running import (
    check_metadata,
    left_out,
    name_and_value,
    open_given,
    print_note,
    refuse_given,
    report_data,
)
from socket_testbed.commands.terminal import StatusLine, say, table
from socket_testbed.documents import check_number
from socket_testbed.errors import ConfigurationError, DeviceError, TrialError, closest
from socket_testbed.files import check_new_folder, disk_hint, is_held
from socket_testbed.geometry.socket import read_socket
from socket_testbed.live import bringup
from socket_testbed.live.doctor import (
    Outcome,
    examine,
    examine_running,
    judge_sources,
    press_test,
    running_drivers,
)
from socket_testbed.live.hardware import find_user
from socket_testbed.live.processes import Graph, GraphNode, require_ros
from socket_testbed.live.scheduling import busy_note, measure_speed, speed_text
from socket_testbed.live.sources import absent_topics, check_sources, foreign_topics
from socket_testbed.settings.acquisition import READY_TIMEOUT
from socket_testbed.settings.options import (
    SettingsOptions,
    TrialFiles,
    given,
)
from socket_testbed.settings.testbed import (
    RecorderSettings,
    ReplaySettings,
    TestbedSettings,
    estimator_settings,
    read_testbed,
)
from socket_testbed.simulation.limb import check_donning
from socket_testbed.simulation.testbed import Simulation
from socket_testbed.simulation.world import FAULTS, World
from socket_testbed.trials.bag_parts import BAG_METADATA
from socket_testbed.trials.metadata import METADATA_FILE, write_metadata
from socket_testbed.trials.trial import read_configuration, recorded_namespace
from socket_testbed.wire.topics import Service, full_name, full_namespace

# Beginnings of the descriptions of faults that take the number of a thing, from 1.
_COUNTED = ("number of the cluster", "1 + the", "-1: the limb")

# --duration counts from the first trigger, at the latest from this time after the start [s].
_START_TIMEOUT = READY_TIMEOUT + 30.0


def simulated(options: SimulatedOptions) -> tuple[Simulation | None, dict[str, float]]:
    """The simulation, None for real hardware, and the active faults.

    Raises:
        ConfigurationError: An option is out of its range, or belongs to simulated hardware that is
            not asked for.
    """
    faults = dict(map(_fault, options.fault))
    names = ("scenario", "period", "tissue", "seed", "donning", "donning_share")
    chosen = {name: getattr(options, name) for name in names}
    if not options.simulated:
        usual = SimulatedOptions()
        other = {name: value for name, value in chosen.items() if value != getattr(usual, name)}
        refuse_given(other | {"fault": faults or None}, "simulated hardware", "add --simulated")
        return None, {}
    check_donning(options.donning, options.donning_share)
    return Simulation(**chosen), faults


def _fault(text: str) -> tuple[str, float]:
    name, value = name_and_value(text, "--fault", "load_cell.flipped_bits=0.01")
    if name not in FAULTS:
        raise ConfigurationError(f"--fault {text}: unknown fault '{name}'", closest(name, FAULTS))
    try:
        least = {"limb.out": -1.0, "clock.step": -1e6}.get(name, 0.0)
        most = 1.0 if FAULTS[name].startswith("probability") else 1e6
        number = check_number(float(value), f"--fault {name}", least, most)
        if FAULTS[name].startswith(_COUNTED) and (number == 0.0 or number != round(number)):
            raise ConfigurationError(
                f"--fault {text}: nothing has this number", f"{name} takes {FAULTS[name]}"
            )
        return name, number
    except ValueError:
        raise ConfigurationError(
            f"--fault {text}: '{value}' is not a number", f"{name} takes {FAULTS[name]}"
        ) from None


def configured(simulation: Simulation | None, options: ConfigurationOptions) -> bringup.Testbed:
    """The configured testbed; errors in its files are reported before any node starts.

    Args:
        simulation: The simulation; None for real hardware.
        options: Files of the testbed.
    """
    settings = bringup.testbed_settings(options.params, simulation)
    files = bringup.testbed_files(settings, options.geometry, options.calibration)
    if simulation is None and not (socket := read_socket(files[0])).registration:
        print_note(f"{files[0]}: {socket.bodies}")
    return bringup.Testbed(settings, *files, simulation=simulation)


@takes(calls.Doctor)
def doctor(call: calls.Doctor) -> None:
    """Check every connection, and say how to fix what fails.

    While a testbed runs on these buses, it reports what the testbed says of them instead.

    Raises:
        DeviceError: A check failed, or another program uses the buses that --press needs.
    """
    simulation, faults = simulated(call)
    testbed = configured(simulation, call)
    _check_faults(faults, testbed)
    world = None
    user = find_user(testbed.settings) if simulation is None else None
    with ExitStack() as stack:
        if simulation is not None:
            # The drivers run in this process, so the simulation follows its clock.
            simulation = dataclasses.replace(simulation, time_scale=clocks.time_scale())
            graph = stack.enter_context(Graph())
            testbed, world = bringup.simulate_hardware(graph, testbed, simulation)
            for name, value in faults.items():
                world.faults.switch(name, value)
        if call.press:
            clusters = testbed.settings.cluster_names
            if user is not None:
                raise user
            findings = list(press_test(testbed, partial(_ask, world, clusters)))
        elif user is not None:
            from socket_testbed.nodes.controls import reported_states  # needs ROS

            states = reported_states(running_drivers(testbed), testbed.namespace)
            findings = examine_running(testbed, user, states)
        else:
            findings = examine(testbed)
        settings = testbed.settings
        if not call.press and (settings.align_node.is_used or settings.trigger_node.topic):
            findings += _foreign_findings(testbed)
    rows = [[f.what, "failed" if f.hint else "ok", f.found, f.hint] for f in findings]
    print(table(["what", "", "found", "hint"], rows))
    failing = sum(bool(finding.hint) for finding in findings)
    if failing:
        raise DeviceError(f"{failing} of {len(findings)} checks failed", "see the table's hints")


def _foreign_findings(testbed: bringup.Testbed) -> list[Outcome]:
    """Judge the sources of other drivers and their triggers, by listening for some seconds."""
    check_sources(testbed.settings.align_node, full_namespace(testbed.namespace))
    require_ros()
    from socket_testbed.nodes.foreign_topics import hear_sources  # needs ROS

    namespace = full_namespace(testbed.namespace)
    settings = testbed.settings
    heard = hear_sources(
        settings.align_node, settings.trigger_node.topic, settings.cluster_names, namespace
    )
    return judge_sources(testbed, heard)


def _check_faults(faults: Mapping[str, float], testbed: bringup.Testbed) -> None:
    """Refuse a fault of a cluster that there is not."""
    count = len(testbed.settings.cluster_names)
    for name, value in faults.items():
        if value > count and (name == "limb.out" or "number of the cluster" in FAULTS[name]):
            hint = f"give 1 to {count}: {name} takes {FAULTS[name]}"
            raise ConfigurationError(f"--fault {name}={value:g}: there is no such cluster", hint)


def _ask(world: World | None, clusters: Sequence[str], request: str) -> None:
    """Print a request to the user; in a simulated world, carry it out."""
    say(request)
    if world is not None:
        name = request.removeprefix("press on ")
        number = clusters.index(name) + 1 if name in clusters else -1
        world.faults.switch("limb.out", number)


@takes(calls.Run)
def run(call: calls.Run) -> None:
    """Start the testbed, real or simulated, and record it.

    Raises:
        ConfigurationError: An option is wrong, or belongs to simulated hardware, a recorded trial
            or a page that is not asked for.
        TrialError: A recorded trial is empty, or its recording stopped early.
    """
    duration = call.duration
    simulation, faults = simulated(call)
    if simulation is not None:
        simulation = dataclasses.replace(simulation, time_scale=_time_scale(call.time_scale))
    elif call.time_scale != 1.0:
        raise ConfigurationError("--time-scale is for simulated hardware", "add --simulated")
    testbed = _testbed(simulation, call)
    _check_faults(faults, testbed)
    testbed = dataclasses.replace(testbed, one_process=call.one_process)
    record, trials = testbed.record, Path(testbed.settings.recorder_node.directory)
    if record is not None:
        bringup.check_new_trial(record)
    place = (trials, "") if record is None else (record.parent, record.resolve().name)
    older = _trials(*place)
    if record is None and call.view:  # the page's button records
        testbed = dataclasses.replace(testbed, record=trials, at_once=False)
    page = _page(testbed, call.view, call.view_host, call.view_port)
    with (
        StatusLine(record.parent if record else None) as status,
        Graph(status.output, status.renew) as graph,
    ):
        world = bringup.start(graph, testbed)
        if page is not None:
            graph.start_nodes([page])
        for name, value in faults.items():
            assert world is not None
            world.faults.switch(name, value)
        status.say("the testbed starts; Ctrl-C ends it")
        begin = time.monotonic() + _START_TIMEOUT

        def over() -> bool:
            nonlocal begin
            now = time.monotonic()
            if status.triggered:
                begin = min(begin, now)
            return now >= begin + (duration or math.inf) / testbed.time_scale

        try:
            status.follow(testbed.namespace, absent_topics(testbed.settings.align_node))
            graph.watch(over, status.say)
        except KeyboardInterrupt:
            status.say("ending")
        bringup.end(graph, testbed)
    announced = status.trials if testbed.record is not None else set()
    expected = {place[0] / name for name in announced if name.startswith(place[1])}
    if record is not None and status.triggered:  # the first trigger waits for the recorder
        expected.add(place[0] / place[1])
    # A recorder that was restarted or asked for another trial has recorded several.
    _summarise(sorted(_trials(*place) - older | expected))


def _summarise(trials: Iterable[Path]) -> None:
    """Print a summary of each recorded trial; raise the error of the first that is incomplete."""
    from socket_testbed.trials.description import summary  # pandas would delay the start

    failed = []
    for trial in trials:
        try:
            _require_disk(trial)
            print(summary(trial))
            _require_end(trial)
        except TrialError as error:  # such as one without a trigger
            failed.append(error)
    for other in failed[1:]:
        say(f"error: {other}")
    if failed:
        raise failed[0]


def _trials(folder: Path, name: str) -> set[Path]:
    """Trials in a folder with this name prefix that are not being written."""
    try:
        found = {file.parent for file in folder.glob(f"{glob.escape(name)}*/*.mcap")}
        return {trial for trial in found if not is_held(trial)}
    except OSError:  # the disk was unplugged
        return set()


def _require_disk(trial: Path) -> None:
    """Raise an error if a recording is not there, or cannot be read."""
    try:
        next(trial.iterdir(), None)
    except FileNotFoundError:
        raise TrialError(
            f"{trial}: is not there",
            "read the recorder's messages; if it recorded, connect the trial's disk again, or look"
            " where the trial was moved to",
        ) from None
    except OSError as error:
        raise TrialError(f"{trial}: cannot be read ({error.strerror})", disk_hint(error)) from None


def _require_end(trial: Path) -> None:
    """Raise an error if a recording is incomplete."""
    if not (trial / BAG_METADATA).exists():
        raise TrialError(
            f"{trial}: the recording stopped early; the trial keeps the data so far",
            "read the recorder's messages on the cause, such as a full or unplugged disk",
        )


def _time_scale(wanted: float | Literal["auto"]) -> float:
    """The given time scale or, for 'auto', a measured one; reports it unless it is 1."""
    if wanted == "auto":
        scale = measure_speed().time_scale()
        note = busy_note(scale)
    else:
        scale = wanted
        note = f"the simulated testbed runs at {speed_text(scale)}" if 0.0 < scale < 1.0 else ""
    if note:
        say(note)
    return scale


def _testbed(simulation: Simulation | None, call: calls.Run) -> bringup.Testbed:
    testbed = configured(simulation, call)
    trigger = testbed.settings.trigger_node
    if call.rate is not None:
        if trigger.source == "topic":
            fact = f"--rate is given, and the triggers are the messages on {trigger.topic}"
            raise ConfigurationError(fact, "leave it out, or set trigger_node's source to timer")
        trigger = dataclasses.replace(trigger, rate=call.rate)
    estimator = estimator_settings(testbed.settings.estimator_node, call.overrides())
    estimator = bringup.predict_with(call.model, estimator, testbed.geometry)
    metadata, record = check_metadata(call), bringup.new_trial(testbed.settings, call.record)
    if record is None:
        refuse_given(metadata.stated(), "a recorded trial", "add --record DIR")
    settings = dataclasses.replace(testbed.settings, trigger_node=trigger, estimator_node=estimator)
    return dataclasses.replace(testbed, settings=settings, record=record, metadata=metadata)


def _page(
    testbed: bringup.Testbed, view: bool, host: str | None, port: int | None
) -> GraphNode | None:
    """The node that serves the page, which the testbed survives; None without --view."""
    if not view:
        refuse_given({"view_host": host, "view_port": port}, "a page", "add --view")
        return None
    from socket_testbed.pages.server import listen

    usual = testbed.settings.view_node
    settings = dataclasses.replace(
        usual,
        geometry=str(testbed.geometry),
        host=usual.host if host is None else host,
        port=usual.port if port is None else port,
    )
    listen(settings.host, settings.port).close()  # fails before any node starts
    namespace = full_namespace(testbed.namespace)
    return GraphNode("view_node", settings, namespace, testbed.use_sim_time, optional=True)


@takes(calls.Record)
def record(call: calls.Record) -> None:
    """Record the graph as a trial.

    Raises:
        TrialError: The trial is not there at the end, or its recording stopped early.
    """
    directory, geometry, calibration = call.directory, call.geometry, call.calibration
    check_new_folder(directory)
    # The trial needs readable files later.
    read_configuration(geometry, calibration, call.params)
    stored = {"geometry": geometry, "calibration": calibration, "parameters": call.params}
    files: dict[str, Any] = {name: str(path.resolve()) for name, path in stored.items() if path}
    stated = check_metadata(call)
    used = TestbedSettings() if call.params is None else read_testbed(call.params)
    settings = RecorderSettings(
        directory=str(directory.resolve()),
        record=True,
        beside=foreign_topics(used.align_node, used.trigger_node.topic),
        absent=tuple(topic.name for topic in absent_topics(used.align_node)),
        **files,
    )
    disk = directory.resolve().parent
    with StatusLine(disk) as status, Graph(status.output, status.renew) as graph:
        if stated.stated():
            file = graph.folder / METADATA_FILE
            write_metadata(stated, file)
            settings = dataclasses.replace(settings, metadata=str(file))
        graph.start("recorder_node", settings)
        status.say(f"recording {directory}; Ctrl-C ends it")
        try:
            status.follow()
            graph.wait("recorder_node")
        except KeyboardInterrupt:
            graph.stop()
    print(directory)
    _require_disk(directory)
    _require_end(directory)


@takes(calls.Replay)
def replay(call: calls.Replay) -> None:
    """Publish a trial with /clock; --estimate runs the estimator on it."""
    opened = open_given(call.trial, call)
    report_data(opened, leave_out=left_out(opened, call))
    replayed = ReplaySettings(
        trial=str(call.trial.resolve()), rate=call.rate, loop=call.loop, paused=call.paused
    )
    if call.estimate:
        estimator = opened.settings_for(SettingsOptions(**given(call, SettingsOptions)))
        estimator = bringup.predict_with(call.model, estimator, opened.geometry_path)
        nodes = bringup.replay_nodes(opened, replayed, estimator)
    else:
        files = {"model": call.model, **given(call, TrialFiles), "params": call.params}
        used = files | call.overrides()
        refuse_given(used, "the estimator", "add --estimate")
        nodes = [GraphNode("replay_node", replayed)]
    namespace = recorded_namespace(opened)
    with opened.open() as bag:  # an unreadable trial is reported before any node starts
        length = bag.duration
    pause = full_name(Service.PAUSE_REPLAY, nodes[-1].namespace)
    with (
        StatusLine(duration=length, pause=pause, paused=call.paused) as status,
        Graph(status.output, status.renew) as graph,
    ):
        graph.start_nodes(nodes)
        status.follow(namespace)
        graph.wait("replay_node")
