"""Wiring checks: each device is opened with its own driver and queried, or pressed by the user."""

from __future__ import annotations

import platform
import re
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray
from socket_testbed.calibration.model import read_calibration
from socket_testbed.drivers import ERROR, DeviceBusyError
from socket_testbed.drivers.load_cell.ads131m0x import CHECK_WIRING, conversion_period
from socket_testbed.drivers.natnet.client import NatNetClient
from socket_testbed.drivers.natnet.tracker import BodyTracker, SeenBody
from socket_testbed.errors import ConfigurationError, DeviceError, TestbedError, fact_and_hint
from socket_testbed.geometry.socket import read_socket
from socket_testbed.live.bringup import Testbed
from socket_testbed.live.hardware import make_clusters, make_load_cell, make_trigger
from socket_testbed.live.scheduling import LATEST, measure_lateness
from socket_testbed.live.sources import StreamedSource, TriggerStream
from socket_testbed.settings.alignment import LiveSourceSettings, LiveWrenchSettings

_FRAMES = 1000
_PULSES = 5
_SERVER_TIMEOUT = 3.0  # [s]
_TRACKING_TIMEOUT = 1.0  # [s]; until both bodies are seen
_MIN_READINGS, _MAX_READINGS = 6, 18
_WATCH_DURATION = 1.0  # [s]; of the load cell's conversions
_POLL_INTERVAL = 0.05  # [s]
_DEFAULT_PRIORITY = 10  # tried if none is set
_MODEL_FILE = Path("/proc/device-tree/model")  # of the computer
_SOUND_I2C = [6, 6, 28]  # the first packaged kernel with raspberrypi/linux#6071 (March 2024)
_MAX_PAUSE = 1.5  # conversions of the load cell, whose converter keeps two
_MAX_LATENESS = 0.25  # [-]; of a reading, as a share of the trigger period

# Press test:
_PRESS_TIMEOUT = 20.0  # [s]; also for the release
_UNLOADED_READINGS = 20  # before the first press
_RELEASE_TIME = 1.0  # [s]; before the first unloaded reading
_READING_PERIOD = 0.1  # [s]; also the averaging period of the load cell
_MIN_PRESSURE = 4e3  # [Pa]; of a press,
_SIGMAS = 8.0  # which also exceeds this many standard deviations of the unloaded readings
_PRESS_READINGS = 3  # readings in a press
_PATIENCE_FACTOR = 10  # times as many if a busy computer misses those of the load cell
_MIN_FORCE = 1.0  # [N]
_MIN_COSINE = 0.5  # [-]; between the load cell's force and the outward normal
_RELEASE_RATIO = 0.5  # [-]; of the threshold of a press
_UNFELT = "press in its middle with the thumb; if it stays silent: its cable, its calibration"


@dataclass(frozen=True)
class Outcome:
    """The outcome of a check.

    Attributes:
        what: The device or sensor.
        found: What was found, in words with units.
        hint: What to do about it; empty if all is well.
    """

    what: str
    found: str
    hint: str = ""


@dataclass
class HeardSource:
    """A source of another driver or of triggers, and what was heard of it.

    Attributes:
        source: The source, with the readings; or the triggers.
        type: Type of its messages, as `package/msg/Type`; empty if nobody publishes it.
        wrong: What is wrong with its topic, fact and hint in one line; empty if nothing is.
        ended: The time at which listening ended, since the epoch [ns].
    """

    source: StreamedSource | TriggerStream
    type: str = ""
    wrong: str = ""
    ended: int = 0


def examine(testbed: Testbed) -> list[Outcome]:
    """Check all configured devices, one after the other; a failed check is an outcome too.

    Those whose measurements another driver makes are left out.
    """
    outcomes: list[Outcome] = []
    for check in CHECKS:
        if _DRIVERS.get(check.__name__, "trigger_node") not in running_drivers(testbed):
            continue
        try:
            outcomes.extend(check(testbed))
        except TestbedError as error:
            what = check.__name__.removeprefix("check_").replace("_", " ")
            outcomes.append(Outcome(what, error.fact, error.hint))
    return outcomes


def examine_running(
    testbed: Testbed, user: DeviceBusyError, states: Mapping[str, tuple[int, str]]
) -> list[Outcome]:
    """Report the devices as the running testbed that uses them does, and check the computer.

    Args:
        testbed: The testbed as configured here.
        user: Who uses its buses.
        states: Level and message of each of its nodes, by name; those without are not running.
    """
    outcomes: list[Outcome] = []
    for check in (check_kernel, check_scheduling):
        outcomes.extend(check(testbed))
    if not states:
        return [*outcomes, Outcome("devices", user.fact, user.hint)]
    outcomes.append(Outcome("devices", f"{user.fact}: its own reports follow"))
    for node in running_drivers(testbed):
        what = REPORTING[node]
        if node not in states:
            hint = "end the other program, then call 'doctor' again"
            outcomes.append(Outcome(what, f"no report from {node} of the running testbed", hint))
            continue
        level, message = states[node]
        outcomes.append(_failure(what, message) if level else Outcome(what, message))
    return outcomes


def _failure(what: str, message: str) -> Outcome:
    """A failed outcome from a one-line message of fact and hint."""
    fact, hint = fact_and_hint(message)
    return Outcome(what, fact, hint or "see docs/faults.md")


def check_kernel(testbed: Testbed) -> Iterator[Outcome]:
    """Report the kernel of a Raspberry Pi."""
    if testbed.simulation is None and _MODEL_FILE.is_file():
        yield kernel_finding(_MODEL_FILE.read_text().rstrip("\0"), platform.release())


def kernel_finding(model: str, release: str) -> Outcome:
    """Check a kernel against known bus faults on its Raspberry Pi.

    Args:
        model: The computer, as its device tree names it, such as `Raspberry Pi 5 Model B Rev 1.0`.
        release: The kernel's release, such as `6.6.20-v8`.
    """
    found, version = f"{release} on {model}", re.findall(r"\d+", release)[:3]
    if "Raspberry Pi 5" in model and [*map(int, version)] < _SOUND_I2C:
        return Outcome(
            "kernel",
            f"{found}: its I2C bus can lock up (raspberrypi/linux#5784)",
            f"update it to {'.'.join(map(str, _SOUND_I2C))} or newer",
        )
    return Outcome("kernel", found)


def check_trigger(testbed: Testbed) -> Iterator[Outcome]:
    """Fire pulses and detect their edges; `judge_sources` judges those of another program."""
    settings, delays = testbed.settings.trigger_node, []
    if settings.source == "topic":
        return
    with closing(make_trigger(settings)) as trigger:
        for _ in range(_PULSES):
            before = clocks.monotonic()
            delays.append(trigger.fire() - before)
            trigger.end_pulse()
    found = "the steady clock; no wire"
    if settings.source == "gpio":
        found = (
            f"{settings.chip}, line {settings.output_line} to {settings.input_line},"
            f" edge within {max(delays) * 1e6:.0f} us"
        )
    yield Outcome("trigger", found)


def check_scheduling(testbed: Testbed) -> Iterator[Outcome]:
    """Measure how late threads wake up, also with a real-time priority if permitted."""
    settings = testbed.settings.trigger_node
    rate, wanted = settings.rate, settings.scheduling.priority
    ordinary, urgent = measure_lateness(), measure_lateness(wanted or _DEFAULT_PRIORITY)
    found = f"threads wake up {_late(ordinary)}"
    if len(urgent):
        found += f", with real-time priority {wanted or _DEFAULT_PRIORITY} {_late(urgent)}"
    else:
        found += "; no permission for a real-time priority"
    used = urgent if wanted and len(urgent) else ordinary
    cell = testbed.settings.load_cell_node
    pause = _MAX_PAUSE * conversion_period(cell.clock_in, cell.oversampling)
    enough = np.percentile(used, 99) <= min(LATEST, pause, _MAX_LATENESS / rate)
    found += f": {'soon enough' if enough else 'too late'} for {rate:g} Hz"
    hint = ""
    if not enough and testbed.simulation is None:
        hint = "end other programs, or set scheduling.priority of the nodes that measure"
        hint += " (docs/hardware.md)"
    elif not enough:
        found += " in real time; a simulated testbed may run slower"
    yield Outcome("scheduling", found, hint)


def _late(late: FloatArray) -> str:
    return f"{1e3 * np.percentile(late, 99):.2g} ms late (p99; {1e3 * late.max():.2g} ms at most)"


def check_clusters(testbed: Testbed) -> Iterator[Outcome]:
    """Check which chip answers at each cluster's address."""
    with closing(make_clusters(testbed.settings.cluster_node)) as reader:
        chips = reader.identify()
        for count in range(_MAX_READINGS):
            faults = reader.read(clocks.monotonic()).faults
            # The first readings may set an input's range, and a busy machine may read some late.
            if count + 1 >= _MIN_READINGS and not faults:
                break
        for name, found in chips.items():
            if isinstance(found, DeviceError):
                yield Outcome(f"cluster {name}", found.fact, found.hint)
            elif name in faults:
                yield _failure(f"cluster {name}", faults[name][0])
            else:
                yield Outcome(f"cluster {name}", found)


def check_load_cell(testbed: Testbed) -> Iterator[Outcome]:
    """Check which converter answers, and whether its frames are intact."""
    settings = testbed.settings.load_cell_node
    cell = make_load_cell(settings)
    with closing(cell.converter) as converter:
        chip = converter.connect()
        yield Outcome("load cell", chip.description)
        corrupted = chip.check_frames(_FRAMES)
        hint = CHECK_WIRING if corrupted else ""
        yield Outcome("load cell CRC", f"{corrupted} of {_FRAMES} frames corrupted", hint)
        ends = clocks.monotonic() + _WATCH_DURATION
        converter.poll_until(lambda: clocks.monotonic() >= ends)
        level, message = cell.health(clocks.monotonic())
        if (line := settings.data_ready_line) >= 0:
            counts = converter.counts()
            found = f"{counts['conversions']} edges on line {line}"
            found += f", STATUS disagrees with {counts['status_disagrees']}"
            yield Outcome("load cell DRDY", found)
        yield (_failure if level else Outcome)("load cell bridges", message)


def check_motion_capture(testbed: Testbed) -> Iterator[Outcome]:
    """Check which server answers, how well its clock is known, and whether it tracks the bodies."""
    settings = testbed.settings.mocap_node
    geometry = read_socket(testbed.geometry)
    tracker = BodyTracker(settings, *geometry.markers.values())
    with closing(NatNetClient(settings, tracker.add)) as client:
        client.start()
        deadline = clocks.monotonic() + _SERVER_TIMEOUT
        while (health := client.health(clocks.monotonic()))[0] and clocks.monotonic() < deadline:
            clocks.sleep(_POLL_INTERVAL)
        level, message = health
        if level >= ERROR:
            yield _failure("motion capture", message)
            return
        seen = _look_at_bodies(tracker, settings.stale)
        server, link = client.server, client.figures()
    address = f"{settings.server}:{settings.command_port}"
    yield Outcome("motion capture", f"{server}, {link['rate']:.0f} Hz, at {address}")
    if level:
        yield _failure("motion capture stream", message)
    known = 1e3 * link["clock_uncertainty"]
    yield Outcome("motion capture clock", f"known within {known:.2f} ms")
    names = (settings.socket_body, settings.pylon_body)
    for name, markers, body in zip(names, geometry.markers.values(), seen, strict=True):
        what, found = f"rigid body {name}", f"its {len(markers)} markers are seen"
        yield _failure(what, body.fault) if body.fault else Outcome(what, found)


def _look_at_bodies(tracker: BodyTracker, stale: float) -> tuple[SeenBody, SeenBody]:
    """Socket and pylon at the first trigger that has both, or at the last that was tried.

    One late frame, as on a busy network or computer, is not a body that is not tracked.

    Args:
        tracker: What receives the frames.
        stale: Largest gap between two frames that are used [s].
    """
    end = clocks.monotonic() + _TRACKING_TIMEOUT
    while True:
        trigger = clocks.monotonic()
        tracker.wait(trigger, deadline=trigger + stale)
        seen = tracker.sample(trigger)
        if clocks.monotonic() > end or not any(body.fault for body in seen):
            return seen


def running_drivers(testbed: Testbed) -> list[str]:
    """The nodes that measure in a testbed, by its settings."""
    settings = testbed.settings
    align = ["align_node"] if settings.align_node.is_used else []
    return ["trigger_node", *settings.own_nodes, *align]


def judge_sources(testbed: Testbed, heard: Sequence[HeardSource]) -> list[Outcome]:
    """Judge the sources of other drivers: rate, age, clock and frame; and the triggers.

    Args:
        testbed: The testbed, whose trigger and waiting time they serve.
        heard: What was heard of each; of the triggers, if another program makes them.
    """
    settings = testbed.settings
    rate, wait = settings.trigger_node.rate, settings.align_node.wait
    outcomes, frames = [], {}
    for own in heard:
        if isinstance(own.source, TriggerStream):
            rate = own.source.rate  # NaN, which nothing is below, if it is not known
            outcomes.append(_judge_trigger(own, own.source))
    for own in heard:
        if isinstance(own.source, StreamedSource):
            outcomes.append(_judge_source(own, own.source, rate, wait))
            if own.source.name.endswith("pose"):
                frames[own.source.name] = own.source.frame
    if len({*frames.values()}) > 1 and all(frames.values()):
        found = " and ".join(f"{name} in {frame}" for name, frame in frames.items())
        outcomes.append(Outcome("frame of the poses", found, "give both in one frame at rest"))
    return outcomes


def _judge_trigger(heard: HeardSource, source: TriggerStream) -> Outcome:
    """Judge the triggers of another program."""
    if heard.wrong:
        return _failure("trigger", heard.wrong)
    level, message = source.health(heard.ended)
    if level:
        return _failure("trigger", message)
    parts = [f"{source.topic}: {heard.type}", f"{source.rate:.3g} Hz", _timing(heard)]
    return Outcome("trigger", ", ".join(parts))


def _timing(heard: HeardSource) -> str:
    """How a source's messages are stamped, in words."""
    source = heard.source
    if source.unstamped:
        return "without stamps: the times of arrival count"
    age = 1e3 * source.age(heard.ended)
    return f"{1e3 * source.late:.1f} ms from stamp to arrival, newest {age:.0f} ms old"


def _judge_source(
    heard: HeardSource, source: StreamedSource, trigger_rate: float, wait: float
) -> Outcome:
    """Judge a source for triggers at a rate [Hz], for which the align node waits [s]."""
    what, topic = source.name, source.settings.topic
    if heard.wrong:
        return _failure(what, heard.wrong)
    level, message = source.health(heard.ended)
    if level:
        return _failure(what, message.removeprefix(f"{what}: "))
    parts = [f"{topic}: {heard.type}", f"{source.rate:.3g} Hz"]
    if source.name != "clusters":
        parts += [f"frame {source.frame or 'not stated'}{_in_load_cell(source.settings)}"]
    found, hint = ", ".join([*parts, _timing(heard)]), ""
    if source.rate < trigger_rate:
        hint = f"raise its rate above the trigger's {trigger_rate:.3g} Hz, or lower the trigger's"
    elif source.late > wait:
        hint = f"set align_node's wait, {wait:g} s, above its delay of arrival"
    return Outcome(what, found, hint)


def _in_load_cell(settings: LiveSourceSettings) -> str:
    """How the frame of a wrench becomes {S}, in words; empty for other sources."""
    if not isinstance(settings, LiveWrenchSettings):
        return ""
    usual = LiveWrenchSettings()
    stated = (settings.rotation, settings.translation) != (usual.rotation, usual.translation)
    return ", brought into {S}" if stated else ", taken as {S}"


CHECKS: tuple[Callable[[Testbed], Iterator[Outcome]], ...] = (
    check_kernel,
    check_trigger,
    check_scheduling,
    check_clusters,
    check_load_cell,
    check_motion_capture,
)

# The node that uses the device of each check:
_DRIVERS = {
    "check_clusters": "cluster_node",
    "check_load_cell": "load_cell_node",
    "check_motion_capture": "mocap_node",
}

# The nodes whose reports stand for the checks of their devices while a testbed runs:
REPORTING = {
    "trigger_node": "trigger",
    "cluster_node": "clusters",
    "load_cell_node": "load cell",
    "mocap_node": "motion capture",
    "align_node": "sources of other drivers",
}


# --- press test: the user presses each cluster, which verifies its sign, place and order. The limb
# is out of the socket. The test cannot verify gains, nor detect that the user swapped two clusters.
# A reading holds the normal stress of the c clusters [Pa] and the force on the load cell [N], shape
# (c + 3,); missing values are NaN.


def press_test(testbed: Testbed, ask: Callable[[str], None]) -> Iterator[Outcome]:
    """Ask for a press on each cluster in turn and report the response; no node may run meanwhile.

    Args:
        testbed: The testbed; its limb is out of the socket.
        ask: Called with an instruction to the user: `press on NAME` or `let go`.

    Yields:
        The outcome of each press, as soon as it is known.

    Raises:
        ConfigurationError: If another driver measures the clusters or the wrench.
        DeviceError: If a cluster gives no reading without load.
    """
    geometry = read_socket(testbed.geometry)
    names = testbed.settings.cluster_node.names
    if lacking := {"cluster_node", "load_cell_node"} - {*testbed.settings.own_nodes}:
        raise ConfigurationError(
            f"--press reads the testbed's own chips, and {sorted(lacking)[0]} is not used",
            "press on each cluster, and look at clusters/stress",
        )
    outward = [-geometry.rotations[geometry.clusters[name], :, 2] for name in names]
    with _readings(testbed) as read:
        ask("let go")
        clocks.sleep(_RELEASE_TIME)
        unloaded = [read() for _ in range(_UNLOADED_READINGS)]
        zero = _mean(unloaded)
        dead = [name for name, value in zip(names, zero, strict=False) if np.isnan(value)]
        if dead:
            hint = "see what 'doctor' says of it without --press"
            raise DeviceError(f"cluster {dead[0]} gives no reading", hint)
        noise = np.nanstd(np.array(unloaded)[:, :-3], axis=0)
        threshold = np.maximum(_MIN_PRESSURE, _SIGMAS * noise)

        def pressure(reading: FloatArray) -> FloatArray:  # of either sign, relative to a press
            return np.abs(reading - zero)[:-3] / threshold

        for number, name in enumerate(names):
            ask(f"press on {name}")
            pressed = _wait(read, lambda reading: bool((pressure(reading) > 1.0).any()))
            if pressed is None:
                found = f"no cluster answered within {_PRESS_TIMEOUT:g} s"
                yield Outcome(f"press on {name}", found, _UNFELT)
                continue
            answered = int(np.nanargmax(pressure(pressed)))
            yield _judge(names, number, answered, pressed - zero, outward[number])
            ask("let go")
            # NaN fails the test: all clusters must be read, and none pressed.
            _wait(read, lambda reading: bool((pressure(reading) <= _RELEASE_RATIO).all()))


def _mean(readings: list[FloatArray]) -> FloatArray:
    return np.asarray(np.ma.masked_invalid(np.array(readings)).mean(axis=0).filled(np.nan))


def _judge(
    names: Sequence[str], number: int, answered: int, change: FloatArray, outward: FloatArray
) -> Outcome:
    """Judge the wiring from a press on a cluster and the number of the cluster that answered.

    `change` is that of the reading, shape (c + 3,) [Pa, N], `outward` the outward normal of the
    wall at the press in {S}, shape (3,) [-].
    """
    name, felt, what = names[number], names[answered], f"press on {names[number]}"
    found = f"{felt} felt {1e-3 * change[answered]:+.1f} kPa"
    if felt != name:
        hint = f"exchange the places of {name} and {felt} in cluster_node's"
        return Outcome(what, found, f"{hint} channels, or their cables; or press on {name} itself")
    if change[answered] < 0.0:
        hint = "its normal is the wrong way round: check its channels' order and its calibration"
        return Outcome(what, found, hint)
    size = float(np.linalg.norm(change[-3:]))
    if not size >= _MIN_FORCE:
        hint = "check the load cell's wiring"
        return Outcome(what, f"{found}, the load cell felt nothing", hint)
    along, found = float(change[-3:] @ outward) / size, f"{found}, the load cell {size:.1f} N"
    if along <= -_MIN_COSINE:
        return Outcome(what, f"{found} the other way", "check the load cell's signs and matrix")
    if along < _MIN_COSINE:
        hint = "check how the load cell is turned, its matrix, and the cluster's place"
        return Outcome(what, f"{found} in another direction", hint)
    return Outcome(what, found)


@contextmanager
def _readings(testbed: Testbed) -> Iterator[Callable[[], FloatArray]]:
    """A function that reads the clusters and the load cell together, with their own drivers."""
    settings = testbed.settings
    stacked = read_calibration(testbed.calibration).stacked(settings.cluster_node.names)
    cell = make_load_cell(settings.load_cell_node)
    with (
        closing(make_clusters(settings.cluster_node)) as clusters,
        closing(cell.converter) as converter,
    ):
        stopping = threading.Event()

        def read() -> FloatArray:
            due = clocks.monotonic() + _READING_PERIOD
            reading = clusters.read(clocks.monotonic())
            stress, _ = stacked.apply(reading.capacitance, reading.status)
            clocks.sleep(max(0.0, due - clocks.monotonic()))
            wrench = cell.wrench_at(due - 0.7 * _READING_PERIOD, 0.5 * _READING_PERIOD).wrench
            return np.concatenate([stress[:, 0], wrench[3:]])

        polling = threading.Thread(
            target=converter.poll_until, args=(stopping.is_set,), daemon=True
        )
        polling.start()
        try:
            yield read
        finally:
            stopping.set()
            polling.join()


def _wait(read: Callable[[], FloatArray], done: Callable[[FloatArray], bool]) -> FloatArray | None:
    """Read until a condition holds in several readings; their mean, or None on timeout."""
    ends = clocks.monotonic() + _PRESS_TIMEOUT
    found: list[FloatArray] = []
    while clocks.monotonic() < ends:
        reading = read()
        if done(reading):
            found.append(reading)
        elif np.isfinite(reading[:-3]).all():  # ignore late readings
            found.clear()
        felt = sum(np.isfinite(reading[-3:]).all() for reading in found[1:])
        if felt >= _PRESS_READINGS or len(found) > _PATIENCE_FACTOR * _PRESS_READINGS:
            return _mean(found[1:])  # the first one caught the press in motion
    return None
