"""Sources of other drivers while they are read: values, health in words, clocks, tare."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.foreign import header, pose_fields, vector, wrench_fields
from support.rigid_bodies import Body
from support.rigid_bodies import message as bodies_message
from support.wording import refused

from socket_testbed.alignment.align import Aligned, align
from socket_testbed.alignment.source_clock import RunningClock
from socket_testbed.calibration.model import read_calibration
from socket_testbed.errors import ConfigurationError, DeviceError
from socket_testbed.files import packaged
from socket_testbed.live.bringup import Testbed
from socket_testbed.live.doctor import HeardSource, Outcome, judge_sources
from socket_testbed.live.sources import (
    StreamedSource,
    TriggerStream,
    WrenchTare,
    absent_topics,
    as_capacitances,
    check_sources,
    foreign_topics,
    wrench_mapping,
)
from socket_testbed.settings.acquisition import TareSettings, TriggerSettings
from socket_testbed.settings.alignment import (
    AlignSettings,
    LiveClusterSettings,
    LiveSourceSettings,
    LiveWrenchSettings,
    SourceSettings,
)
from socket_testbed.settings.testbed import TestbedSettings
from socket_testbed.trials import foreign
from socket_testbed.trials.bag import RawMessage
from socket_testbed.trials.imported import in_load_cell
from socket_testbed.wire import cdr, topics

OK, WARN, ERROR = 0, 1, 2
START, SECOND = 1_700_000_000_000_000_000, 1_000_000_000  # [ns]
NAMES = ("brim_lateral", "distal")
PERIOD = 0.25  # [s]; of the trigger
LOST = [0.0] * 7  # pose of a body that is not tracked

Fields = dict[str, Any]


def wrench(stamp: int, row: int) -> Fields:
    values = np.array([0.1, 0.2, 0.3, 1.0, 2.0, -100.0 - row])
    return {"header": header(stamp, "ft"), "wrench": wrench_fields(values)}


def pose(stamp: int, row: int) -> Fields:
    turn = np.deg2rad(0.1 * row)
    values = np.array([1e-4 * row, 0.2, 0.3, 0.0, 0.0, np.sin(turn), np.cos(turn)])
    return {"header": header(stamp, "world"), "pose": pose_fields(values)}


def numbers(stamp: int, row: int) -> Fields:
    return {"data": (np.arange(5.0, 5.8, 0.1) + 1e-3 * row).tolist()}


def named(stamp: int, row: int) -> Fields:
    """In another order than ours, with a cluster that we do not have."""
    names = [f"{cluster}.{n}" for cluster in ("distal", "heel", "brim_lateral") for n in range(4)]
    values = {"name": names, "position": (np.arange(12.0) + 1e-3 * row).tolist()}
    return {"header": header(stamp, ""), **values}


def halved(stamp: int, row: int) -> Fields:
    """One of our two clusters."""
    values = {"name": [f"distal.{n}" for n in range(4)], "position": [5.0, 5.1, 5.2, 5.3]}
    return {"header": header(stamp, ""), **values}


SOURCES: dict[str, tuple[foreign.Source, str, Callable[[int, int], Fields]]] = {
    "wrench": ("wrench", "geometry_msgs/msg/WrenchStamped", wrench),
    "pose": ("pylon_pose", "geometry_msgs/msg/PoseStamped", pose),
    "numbers": ("clusters", "std_msgs/msg/Float64MultiArray", numbers),
    "named": ("clusters", "sensor_msgs/msg/JointState", named),
    "halved": ("clusters", "sensor_msgs/msg/JointState", halved),
}


def messages(
    kind: str, stamps: Sequence[int], arrivals: Sequence[int], sent: Sequence[int] | None = None
) -> list[RawMessage]:
    """Messages with stamps and arrivals [ns]; `sent` replaces the stamps in the headers."""
    _, type_name, fields = SOURCES[kind]
    rows = enumerate(zip(sent or stamps, arrivals, strict=True))
    return [
        RawMessage("/x", type_name, arrival, cdr.encode(
            cdr.make_message(type_name, **fields(stamp, row)), type_name
        ))
        for row, (stamp, arrival) in rows
    ]  # fmt: skip


def every(hertz: float, duration: float, start: int = START) -> list[int]:
    """Times at a rate [ns]."""
    return [start + round(SECOND * row / hertz) for row in range(int(hertz * duration))]


def source_of(kind: str, **settings: Any) -> StreamedSource:
    name, _, _ = SOURCES[kind]
    classes: dict[str, Any] = {"wrench": LiveWrenchSettings, "clusters": LiveClusterSettings}
    own = classes.get(name, LiveSourceSettings)(topic="/x", **settings)
    return StreamedSource(name, own, NAMES if name == "clusters" else ())


def played(
    source: StreamedSource, sent: Sequence[RawMessage], triggers: Sequence[int], wait: float = 0.3
) -> dict[int, Aligned | None]:
    """The values at triggers, as messages arrive in hundredths of a second."""
    found: dict[int, Aligned | None] = {}
    left, asked = [*sent], [*triggers]
    now = START
    while now < triggers[-1] + 3 * SECOND:
        now += SECOND // 100
        arrived = [message for message in left if message.time <= now]
        left = left[len(arrived) :]
        source.receive(arrived)
        while asked and asked[0] <= now:
            source.trigger(asked.pop(0))
        found |= dict(source.due(now, PERIOD, wait))
    return found


@pytest.mark.parametrize("method", ["line", "mean", "last"])
@pytest.mark.parametrize("kind", [kind for kind in SOURCES if kind != "halved"])
def test_values_are_those_of_an_import(kind: str, method: str) -> None:
    """Stamps are out of order by up to 20 ms, and each message takes its own time."""
    random = np.random.default_rng(1)
    times = np.array(every(200.0, 6.0))
    stamps = times + random.integers(0, 20_000_000, len(times))
    arrivals = np.sort(times + random.integers(21_000_000, 27_000_000, len(times)))
    sent = messages(kind, stamps.tolist(), arrivals.tolist())
    triggers = every(1.0 / PERIOD, 4.0, START + SECOND)
    source = source_of(kind, delay=0.013, method=method)
    live = played(source, sent, triggers)
    read = foreign.read_source(SOURCES[kind][0], "/x", {"/x": sent}, NAMES)
    offline = align(read.series, np.array(triggers), source.settings, PERIOD)
    assert [*live] == triggers and np.isfinite(offline.values).all()
    values = offline.values
    if kind == "named":
        values = values[:, [read.series.clusters.index(name) for name in NAMES]]
    found = np.concatenate([value.values for value in live.values() if value is not None])
    np.testing.assert_allclose(found, values, rtol=1e-9, atol=1e-12)


def test_the_value_at_a_trigger_is_that_moment_s() -> None:
    """Fz falls by 1 N in 10 ms from -100 N; with a delay of 20 ms it is 2 N further."""
    times = every(100.0, 3.0)
    live = played(source_of("wrench", delay=0.02), messages("wrench", times, times), [times[150]])
    (value,) = live.values()
    assert value is not None and value.values[0, 5] == pytest.approx(-100.0 - 150 - 2)


def test_a_late_reading_is_waited_for() -> None:
    """10 ms of the window, 50 ms of the longest gap and the wait of 300 ms after the trigger."""
    times = every(100.0, 1.0)
    source, trigger = source_of("wrench", window=0.02, stale=0.05), times[-1] + SECOND // 20
    source.receive(messages("wrench", times, times))
    source.trigger(trigger)
    assert source.due(trigger + round(0.355e9), PERIOD, 0.3) == []
    ((stamp, _),) = source.due(trigger + round(0.365e9), PERIOD, 0.3)
    assert stamp == trigger


def test_a_source_that_stops_is_missing_after_the_wait() -> None:
    times = every(100.0, 2.0)
    triggers = every(4.0, 3.0, START + SECOND // 2)
    source = source_of("wrench")
    live = played(source, messages("wrench", times, times), triggers)
    given = [value is not None and not value.status.any() for value in live.values()]
    assert given == [True] * 6 + [False] * 6 and source.missing == 6
    after = triggers[-1] + 3 * SECOND
    level, text = source.health(after)
    silent = f"{(after - times[-1]) / SECOND:.1f}"
    assert (level, text) == (ERROR, f"wrench: /x is silent for {silent} s: check its driver")


def test_triggers_wait_for_nothing_only_so_long() -> None:
    source = source_of("wrench")
    source.trigger(START)
    assert source.due(START + round(0.4e9), PERIOD, 0.3) == []
    assert source.due(START + round(0.43e9), PERIOD, 0.3) == [(START, None)]
    assert source.health(START) == (
        ERROR,
        "wrench: nothing arrives on /x: start its driver, or check the topic's name and the"
        " ROS_DOMAIN_ID",
    )


def test_the_first_triggers_wait_for_their_period() -> None:
    source = source_of("wrench")
    times = every(100.0, 1.0)
    source.receive(messages("wrench", times, times))
    source.trigger(times[50])
    assert source.due(times[90], 0.0, 0.3) == []
    ((stamp, value),) = source.due(times[90], PERIOD, 0.3)
    assert stamp == times[50] and value is not None and value.count[0] == 25


TREE = "tf2_msgs/msg/TFMessage"


def transforms(stamp: int, *names: str) -> RawMessage:
    """Transforms from the world, each a millimetre further than the one before."""
    own = [
        {"header": header(stamp, "world"), "child_frame_id": name,
         "transform": {"translation": vector([1e-3 * row, 0.0, 0.0]),
                       "rotation": vector([0.0, 0.0, 0.0, 1.0], "xyzw")}}
        for row, name in enumerate(names)
    ]  # fmt: skip
    content = cdr.encode(cdr.make_message(TREE, transforms=own), TREE)
    return RawMessage("/tf", TREE, stamp, content)


def on_tf() -> StreamedSource:
    return StreamedSource("socket_pose", LiveSourceSettings(topic="tf:world/rig"))


def test_a_transform_is_found_among_others() -> None:
    source, times = on_tf(), every(100.0, 2.0)
    for time in times:
        source.receive([transforms(time, "camera"), transforms(time, "table", "camera", "/rig")])
    source.trigger(times[100])
    ((_, value),) = source.due(times[-1], PERIOD, 0.3)
    assert value is not None and value.values[0].tolist() == pytest.approx([2e-3, *[0.0] * 5, 1.0])
    assert source.health(times[-1]) == (OK, "socket pose at 100 Hz")


def test_other_transforms_are_no_sign_of_life() -> None:
    source = on_tf()
    source.receive([transforms(START, "camera")])
    level, text = source.health(START)
    assert level == ERROR and text.startswith("socket pose: nothing arrives on tf:world/rig: ")


def of_a_body() -> StreamedSource:
    return StreamedSource("socket_pose", LiveSourceSettings(topic="/rigid_bodies:rig"))


def test_a_body_is_found_while_its_markers_change() -> None:
    source, times = of_a_body(), every(100.0, 2.0)
    for row, time in enumerate(times):
        body = Body("rig", [1e-4 * row, 0.2, 0.3, 0.0, 0.0, 0.6, 0.8], row % 4)
        source.receive([bodies_message("present", time, [Body("table", LOST), body])])
    source.trigger(times[100])
    ((_, value),) = source.due(times[-1], PERIOD, 0.3)
    assert value is not None and value.values[0, :3].tolist() == pytest.approx([0.01, 0.2, 0.3])
    assert source.health(times[-1]) == (OK, "socket pose at 100 Hz") and source.frame == "map"


LACKING = {
    "another": (
        [Body("table", LOST)],
        "socket pose: /rigid_bodies: no body is called rig (there are: table): name one of them",
    ),
    "lost": (
        [Body("rig", LOST)],
        "socket pose: /rigid_bodies: the body rig is not tracked: bring its markers into view",
    ),
}


@pytest.mark.parametrize("case", LACKING)
def test_a_body_that_is_not_there_is_named(case: str) -> None:
    """At once without any reading of it, and after a second of silence."""
    sent, words = LACKING[case]
    source = of_a_body()
    source.receive([bodies_message("first", START, sent)])
    level, text = source.health(START)
    assert level == ERROR and text.startswith(words)
    source.receive([bodies_message("first", START, [Body("rig", [1.0, *LOST[1:6], 1.0])])])
    assert source.health(START) == (OK, "socket pose heard")
    source.receive([bodies_message("first", START + SECOND, sent)])
    assert source.health(START + SECOND)[0] == OK
    level, text = source.health(START + SECOND + 1)
    assert level == ERROR and text.startswith(words)


@pytest.mark.parametrize(
    ("settings", "period", "span"),
    [
        ({}, 0.0500312, 0.05),
        ({}, 0.7, 0.25),
        ({"window": 0.0312}, 0.05, 0.0312),
        ({"method": "last", "window": 0.2}, 0.05, 0.0),
    ],
    ids=["jitter", "long", "stated", "last"],
)
def test_the_span_follows_the_period(settings: Fields, period: float, span: float) -> None:
    assert SourceSettings(**settings).span(period) == span


# --- health in words


def late(seconds: float) -> Callable[[list[int]], list[int]]:
    return lambda times: [time + round(1e9 * seconds) for time in times]


HEALTH = {
    "sound": ("wrench", late(0.0), (OK, "wrench at 100 Hz")),
    "no stamps": ("numbers", late(0.0), (OK, "clusters at 100 Hz, no stamps")),
    "another clock": (
        "wrench",
        late(-3.0),
        (WARN, "wrench: the clock of /x is +3.000 s behind this machine's: its stamps are corrected"
         " by their arrival; synchronise the clocks"),
    ),
    "ahead": (
        "wrench",
        late(0.25),
        (WARN, "wrench: the stamps of /x are 250 ms ahead of their arrival: synchronise the"
         " clocks"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", HEALTH)
def test_a_source_says_how_it_is(case: str) -> None:
    kind, shift, expected = HEALTH[case]
    times = every(100.0, 2.0)
    source = source_of(kind)
    source.receive(messages(kind, times, times, shift(times)))
    assert source.health(times[-1]) == expected


def test_an_unknown_cluster_is_named() -> None:
    times = every(10.0, 1.0)
    source = source_of("named")
    source.receive(messages("named", times, times))
    level, text = source.health(times[-1])
    assert level == ERROR
    assert text == (
        "/x: names the cluster heel, which is none of brim_lateral, distal: name the clusters in"
        " cluster_node"
    )


def test_unreadable_messages_are_named_and_left_out() -> None:
    times = every(100.0, 1.0)
    sent = messages("wrench", times, times)
    source = source_of("wrench")
    source.receive([*sent[:-1], sent[-1]._replace(data=b"\0\1\0\0nothing")])
    assert source.health(times[-1]) == (
        ERROR,
        "/x: 1 messages cannot be decoded, and are left out",
    )
    assert source.between(START, times[-1]).shape == (99, 6)


def test_an_array_of_another_length_is_refused() -> None:
    source = StreamedSource("clusters", LiveClusterSettings(topic="/x"), ("distal",))
    source.receive(messages("numbers", [START], [START]))
    level, text = source.health(START)
    assert level == ERROR and text.startswith("/x: has 8 values, and 1 clusters are named: ")


def test_a_value_lacks_if_one_cluster_does() -> None:
    times = every(100.0, 3.0)
    source = source_of("halved")
    played(source, messages("halved", times, times), [times[100], times[150]])
    assert source.figures()["clusters_missing"] == 2
    soon = times[150] + SECOND // 2
    assert source.health(soon) == (
        WARN,
        "clusters: /x lacks readings around some triggers: check its driver",
    )


def test_figures_are_in_seconds_and_hertz() -> None:
    times = every(100.0, 3.0)
    source = source_of("wrench", window=0.1)
    played(source, messages("wrench", times, [t + 2_000_000 for t in times]), [times[150]])
    assert source.figures() == {
        "wrench_rate": 100.0,
        "wrench_late": 0.002,
        "wrench_age": 0.0,
        "wrench_spread": 0.1,
        "wrench_readings": 11,
        "wrench_missing": 0,
    }


# --- clocks


@pytest.mark.parametrize("drift", [1e-4, 3e-5], ids=["quickly", "slowly"])
def test_a_clock_that_drifts_is_followed(drift: float) -> None:
    """For five minutes, by 30 ms or 9 ms in all."""
    clock = RunningClock()
    arrivals = np.array(every(10.0, 300.0))
    stamps = arrivals - np.round((arrivals - START) * drift).astype(np.int64)
    for row in range(0, len(arrivals), 10):
        clock.add(stamps[row : row + 10], arrivals[row : row + 10])
    assert clock.is_another
    assert clock.clock is not None and clock.clock.duration == pytest.approx(60.0, abs=1.0)
    assert np.abs(clock.to_recording(stamps[-10:]) - arrivals[-10:]).max() < 200_000


def test_a_clock_that_is_set_is_followed_at_once() -> None:
    clock = RunningClock()
    arrivals = np.array(every(10.0, 60.0))
    stamps = np.where(arrivals < START + 50 * SECOND, arrivals, arrivals - 7 * SECOND)
    for row in range(0, len(arrivals), 10):
        clock.add(stamps[row : row + 10], arrivals[row : row + 10])
        assert clock.is_another == (row >= 500)
    np.testing.assert_array_equal(clock.to_recording(stamps[-10:]), arrivals[-10:])


def test_the_same_clock_stays_uncorrected() -> None:
    """Its messages take 20 ms, of which up to 5 ms vary."""
    clock = RunningClock()
    stamps = np.array(every(100.0, 90.0))
    vary = np.random.default_rng(0).integers(15_000_000, 20_000_000, len(stamps))
    for row in range(0, len(stamps), 100):
        part = slice(row, row + 100)
        clock.add(stamps[part], (stamps + vary)[part])
        assert clock.to_recording(stamps[part]) is not None and not clock.is_another


# --- triggers of another program


def test_messages_of_another_program_are_triggers() -> None:
    """One that is not later than the last one is none."""
    stream = TriggerStream("/x")
    assert stream.health(START) == (
        ERROR,
        "no message on /x, each of which is a trigger: start its program, or check the topic's name"
        " and the ROS_DOMAIN_ID",
    )
    times = every(4.0, 2.0)
    sent = messages("wrench", times, [time + 1_000_000 for time in times])
    assert stream.receive(sent) == times
    assert stream.receive(sent[-1:]) == []
    assert stream.health(times[-1]) == (OK, "a trigger with each message on /x, 4 Hz")
    assert stream.health(times[-1] + 3 * SECOND) == (
        ERROR,
        "/x is silent for 3.0 s: check its program",
    )


def test_triggers_without_stamps_count_as_they_arrive() -> None:
    times = every(4.0, 1.0)
    arrivals = [time + 1_000_000 for time in times]
    assert TriggerStream("/x").receive(messages("numbers", times, arrivals)) == arrivals


def triggers_of(kind: str, hertz: float, late: int = 1_000_000) -> HeardSource:
    """Two seconds of triggers that arrive late [ns], heard until 4 ms after the last one."""
    stream, times = TriggerStream("/sync"), every(hertz, 2.0)
    stream.receive(messages(kind, times, [time + late for time in times]))
    return HeardSource(stream, SOURCES[kind][1], ended=times[-1] + 4_000_000)


def judged(*heard: HeardSource) -> list[Outcome]:
    """What doctor says of sources whose trigger is set to 20 Hz, in vain if others trigger."""
    trigger = TriggerSettings(source="topic", topic="/sync", rate=20.0)
    return judge_sources(Testbed(replace(TestbedSettings(), trigger_node=trigger)), heard)


TRIGGERING = {
    "stamped": (
        triggers_of("wrench", 4.0),
        ("/sync: geometry_msgs/msg/WrenchStamped, 4 Hz, 1.0 ms from stamp to arrival, newest 4 ms"
         " old", ""),
    ),
    "unstamped": (
        triggers_of("numbers", 4.0),
        ("/sync: std_msgs/msg/Float64MultiArray, 4 Hz, without stamps: the times of arrival count",
         ""),
    ),
    "another clock": (
        triggers_of("wrench", 4.0, 3 * SECOND),
        ("the clock of /sync is not this machine's",
         "its stamps are corrected by their arrival; synchronise the clocks"),
    ),
    "silent": (
        HeardSource(TriggerStream("/sync"), ended=START),
        ("no message on /sync, each of which is a trigger",
         "start its program, or check the topic's name and the ROS_DOMAIN_ID"),
    ),
    "of another type": (
        HeardSource(TriggerStream("/sync"), wrong="/sync is a std_msgs/msg/String: name a topic"),
        ("/sync is a std_msgs/msg/String", "name a topic"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", TRIGGERING)
def test_doctor_judges_the_triggers_of_another_program(case: str) -> None:
    heard, (found, hint) = TRIGGERING[case]
    assert judged(heard) == [Outcome("trigger", found, hint)]


@pytest.mark.parametrize(("hertz", "hint"), [(4.0, ""), (200.0, "raise its rate above the trigg")])
def test_sources_are_judged_by_the_triggers_heard(hertz: float, hint: str) -> None:
    """A wrench at 10 Hz suits triggers at 4 Hz, not at 200 Hz."""
    source, times = source_of("wrench"), every(10.0, 2.0)
    source.receive(messages("wrench", times, times))
    _, outcome = judged(
        triggers_of("wrench", hertz), HeardSource(source, SOURCES["wrench"][1], ended=times[-1])
    )
    assert outcome.hint.startswith(hint) and bool(outcome.hint) == bool(hint)


FRAMES: dict[str, tuple[str, dict[str, Any], str]] = {
    "as it is": ("wrench", {}, ", frame ft, taken as {S}"),
    "moved": ("wrench", {"translation": (0.0, 0.0, 0.1)}, ", frame ft, brought into {S}"),
    "turned": (
        "wrench",
        {"rotation": (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)},
        ", frame ft, brought into {S}",
    ),
    "pose": ("pose", {}, ", frame world"),
    "clusters": ("numbers", {}, ""),
}


@pytest.mark.parametrize("case", FRAMES)
def test_doctor_states_the_frame_of_a_source(case: str) -> None:
    kind, settings, frame = FRAMES[case]
    source, times = source_of(kind, **settings), every(10.0, 2.0)
    source.receive(messages(kind, times, times))
    heard = HeardSource(source, SOURCES[kind][1], ended=times[-1])
    _, outcome = judged(triggers_of("wrench", 4.0), heard)
    assert outcome.found.startswith(f"/x: {SOURCES[kind][1]}, 10 Hz{frame}, ")
    rest = outcome.found.partition(f"10 Hz{frame}, ")[2]
    assert rest.startswith(("0.0 ms from stamp", "without stamps"))


# --- settings


SOCKET, PYLON = LiveSourceSettings(topic="/a"), LiveSourceSettings(topic="/b")
WRONG: dict[str, tuple[Fields, str]] = {
    "one pose": (
        {"socket_pose": SOCKET},
        "align_node: pylon_pose.topic is empty, and the other pose is another driver's: name its"
        " topic as well, or none",
    ),
    "one topic": (
        {"socket_pose": SOCKET, "pylon_pose": SOCKET},
        "align_node: socket_pose.topic and pylon_pose.topic are both /a: give each source",
    ),
    "no child": (
        {"socket_pose": LiveSourceSettings(topic="tf:world"), "pylon_pose": PYLON},
        "align_node: socket_pose.topic is 'tf:world': give a topic, or for a pose tf:PARENT/CHILD",
    ),
    "a transform": (
        {"wrench": LiveWrenchSettings(topic="tf:a/b")},
        "align_node: wrench.topic is 'tf:a/b': give a topic",
    ),
    "no name": (
        {"wrench": LiveWrenchSettings(topic="/ft sensor")},
        "align_node: wrench.topic is '/ft sensor', which is no name of a topic: give one such",
    ),
    "a body": (
        {"wrench": LiveWrenchSettings(topic="/ft:rig")},
        "align_node: wrench.topic is '/ft:rig', which is no name of a topic: give one such",
    ),
    "our own": (
        {"wrench": LiveWrenchSettings(topic="load_cell/wrench")},
        "align_node: wrench.topic is load_cell/wrench, which the testbed publishes itself: give",
    ),
    "no rotation": (
        {"wrench": LiveWrenchSettings(topic="/ft", rotation=(1.0,) * 9)},
        "align_node: wrench: rotation is not a right-handed orthonormal frame",
    ),
    "few numbers": (
        {"wrench": LiveWrenchSettings(topic="/ft", translation=(1.0,))},
        "align_node: wrench.rotation and wrench.translation have 9 and 1 numbers: give nine",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_sources_that_do_not_fit_are_refused(case: str) -> None:
    given, words = WRONG[case]
    with refused(ConfigurationError, words):
        check_sources(AlignSettings(**given))


def test_a_topic_of_another_namespace_is_a_source() -> None:
    settings = AlignSettings(wrench=LiveWrenchSettings(topic="/right/load_cell/wrench"))
    check_sources(settings, "/left")
    with refused(ConfigurationError, "which the testbed publishes itself"):
        check_sources(settings, "/right")


def test_topics_to_record_are_those_of_other_drivers() -> None:
    settings = AlignSettings(
        wrench=LiveWrenchSettings(topic="/ft"),
        socket_pose=LiveSourceSettings(topic="tf:world/socket"),
        pylon_pose=LiveSourceSettings(topic="none"),
    )
    check_sources(settings)
    assert foreign_topics(settings) == ("/ft", "/tf")
    assert absent_topics(settings) == (topics.PYLON_POSE,)


def test_two_bodies_share_a_recorded_topic() -> None:
    settings = AlignSettings(
        socket_pose=LiveSourceSettings(topic="rigid_bodies:socket"),
        pylon_pose=LiveSourceSettings(topic="rigid_bodies:limb"),
    )
    check_sources(settings)
    assert foreign_topics(settings, "/sync") == ("rigid_bodies", "/sync")


def test_a_wrench_is_turned_into_the_load_cell_s_frame() -> None:
    """Turned by 90 deg about z, 0.1 m above {S}, and of the socket on the limb: negated."""
    rows = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    mapping = wrench_mapping(
        LiveWrenchSettings(topic="/ft", of="socket", rotation=rows, translation=(0.0, 0.0, 0.1))
    )
    found = in_load_cell(np.array([[-1.0, -2.0, -3.0, -10.0, -20.0, 150.0]]), mapping)
    np.testing.assert_allclose(found, [[-3.0, -1.0, 3.0, -20.0, 10.0, -150.0]])


def test_stresses_become_capacitances_that_give_them_back() -> None:
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    stress = np.array([[[45e3, -12e3, 9e3], [np.nan, 0.0, 0.0]], [[6e3, 1e3, -2e3], [3e3, 0, 0]]])
    found = as_capacitances(stress, NAMES, calibration)
    assert np.isnan(found[0, 1]).all() and np.isfinite(found[1]).all()
    back, _ = calibration.stacked(NAMES).apply(found, np.isnan(found).astype(np.uint8) * 2)
    np.testing.assert_allclose(back[[0, 1, 1], [0, 0, 1]], stress[[0, 1, 1], [0, 0, 1]], atol=1e-3)
    assert as_capacitances(found, NAMES, calibration) is found


# --- tare

LIMITS = TareSettings(tare_duration=1.0)


def test_a_tare_survives_a_restart(tmp_path: Path) -> None:
    path = str(tmp_path / "tare.json")
    tare = WrenchTare(path)
    assert not tare.wrench.any() and tare.time == 0
    load = np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])
    removed = tare.take(np.tile(load, (100, 1)), 100.0, LIMITS, START + 999, forced=False)
    np.testing.assert_allclose(removed, load)
    again = tare.take(np.tile(2.0 * load, (100, 1)), 100.0, LIMITS, START + 1999, forced=False)
    np.testing.assert_allclose(again, load)
    stored = WrenchTare(path)
    np.testing.assert_allclose(stored.wrench, 2.0 * load)
    assert stored.time == tare.time == START + 1000


REFUSED = {
    "few": (np.zeros((40, 6)), False, "cannot tare: 40 wrenches in the last 1 s: wait that long"),
    "heavy": (np.full((100, 6), 50.0), False, "cannot tare: the cell bears 87 N, more than 40 N"),
    "moving": (
        np.outer(np.arange(100.0), np.ones(6)),
        True,
        "cannot tare: Mx moves by 28.9 N m (standard deviation), more than 0.2 N m",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_tare_is_refused(case: str) -> None:
    wrenches, forced, words = REFUSED[case]
    tare = WrenchTare()
    with refused(DeviceError, words):
        tare.take(wrenches, 100.0, LIMITS, START, forced)
    assert tare.time == 0


def test_a_heavy_load_can_be_tared_by_force() -> None:
    tare = WrenchTare()
    tare.take(np.full((100, 6), 50.0), 100.0, LIMITS, START, forced=True)
    assert tare.wrench.tolist() == [50.0] * 6


def test_a_damaged_tare_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "tare.json"
    path.write_text("{}")
    with refused(ConfigurationError, "remove the file and tare again"):
        WrenchTare(str(path))


def test_changed_settings_take_effect() -> None:
    times = every(100.0, 3.0)
    source = source_of("wrench")
    source.settings = replace(source.settings, delay=0.1)
    live = played(source, messages("wrench", times, times), [times[150]])
    (value,) = live.values()
    assert value is not None and value.values[0, 5] == pytest.approx(-260.0)
