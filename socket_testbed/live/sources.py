"""Sources of other drivers, brought to the trigger while they are read; without ROS.

The values are those that `import` finds in a recording of the same messages: the readers and the
alignment are the same.
"""

from __future__ import annotations

import json
import math
import re
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Annotated, cast

import numpy as np
from msgspec import Meta

from socket_testbed.alignment.align import Aligned, Series, SourceBuffer
from socket_testbed.alignment.series import ClusterSeries, PoseSeries, WrenchSeries
from socket_testbed.alignment.source_clock import RunningClock
from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.calibration.model import Calibration, invert_calibration
from socket_testbed.documents import Document, convert, read_document
from socket_testbed.drivers import ERROR, OK, RECENT, WARN
from socket_testbed.drivers.load_cell.load_cell import iso_time, refuse_tare
from socket_testbed.errors import ConfigurationError, DeviceError, TestbedError
from socket_testbed.files import make_folder, write_text
from socket_testbed.geometry.pose import PoseDocument
from socket_testbed.settings.acquisition import TareSettings
from socket_testbed.settings.alignment import (
    NONE,
    OWN,
    AlignSettings,
    LiveClusterSettings,
    LiveSourceSettings,
    LiveWrenchSettings,
)
from socket_testbed.settings.options import WrenchOf
from socket_testbed.trials import foreign
from socket_testbed.trials.bag import RawMessage
from socket_testbed.trials.imported import WrenchDocument
from socket_testbed.wire import topics

_SECOND = 1_000_000_000  # [ns]
_PERIOD_KNOWN = 1.5  # [s]; after the first trigger, at the latest
_SILENT = 1.0  # [s]; without a message, or
_SILENT_STEPS = 5.0  # so many usual steps of the source
_DISORDER = 10.0  # [s]; for which the largest disorder of stamps counts
_AHEAD = -0.002  # [s]; arrival minus stamp, below which the clock of a source is ahead
_TOPIC = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_MIN_COMPLETE = 0.5  # share of the usual wrenches that a tare needs
_Component = Annotated[float, Meta(ge=-1e6, le=1e6)]
_NEWEST = 20  # triggers whose rate is shown
_CHANNELS = 4  # of a cluster
_NOTHING = np.empty(0, np.int64)


class StreamedSource:
    """One source of another driver: messages in, values at triggers out.

    All times are on the clock of the triggers' stamps.

    Args:
        source: Which source.
        settings: Its topic, and how its readings are brought to triggers.
        clusters: Names of the C clusters, whose order the values have; empty for other sources.
        keep: Span of readings to keep at least [s].

    Attributes:
        settings: They may be reassigned: all but the topic and the names take effect.
        name: Its name in texts, such as `socket pose`.
        frame: Frame of its newest message; empty if it has none.
        missing: Number of triggers without a value, of any cluster.
        unstamped: Whether its messages have no stamps, so that the times of arrival count.
        clock: Its clock, see `RunningClock`.
        last: The newest value at a trigger; None before any.
    """

    def __init__(
        self,
        source: foreign.Source,
        settings: LiveSourceSettings,
        clusters: Sequence[str] = (),
        keep: float = 0.0,
    ) -> None:
        self.settings = settings
        self.name = foreign.in_words(source)
        self.frame = ""
        self.missing = 0
        self.unstamped = False
        self.clock = RunningClock()
        self.last: Aligned | None = None
        self._source = source
        self._clusters = tuple(clusters)
        named = settings.names if isinstance(settings, LiveClusterSettings) else ()
        self._reader = foreign.SourceReader(source, settings.topic, named or self._clusters)
        self._keep = keep
        self._lock = threading.Lock()  # for the buffer: a tare reads it in another thread
        self._buffer: SourceBuffer | None = None
        self._pending: deque[int] = deque()  # triggers [ns]
        self._disorder: deque[tuple[int, int]] = deque()  # of messages: arrival, stamps late [ns]
        self._heard = 0  # newest arrival [ns]
        self._fault = ("", 0)  # text, and when [ns]
        self._lacked = 0  # newest trigger without a value [ns]

    @property
    def rate(self) -> float:
        """Rate of its readings [Hz]; NaN for fewer than two."""
        return self._buffer.rate if self._buffer else math.nan

    def receive(self, messages: Sequence[RawMessage]) -> None:
        """Read some messages, in the order of their arrival.

        Those that are not such a source are left out, and reported by `health`.

        Args:
            messages: The messages, of one type; `time` is that of their arrival [ns].
        """
        if not messages:
            return
        notes: list[str] = []
        try:
            for stamps, arrivals, values, names in self._reader.parts(messages, notes):
                with self._lock:
                    self._add(stamps, arrivals, self._in_order(arrivals, values, names))
        except TestbedError as error:
            notes.append(str(error))
        if notes:
            self._fault = notes[-1], messages[-1].time

    def _in_order(
        self, arrivals: IntArray, values: FloatArray, names: tuple[str, ...]
    ) -> FloatArray:
        """The values, of clusters by the order of ours; unknown ones are left out."""
        if self._source != "clusters":
            self.frame = names[0]
            return values
        ordered = np.full((len(values), len(self._clusters), values.shape[2]), np.nan)
        known = [name for name in names if name in self._clusters]
        for name in known:
            ordered[:, self._clusters.index(name)] = values[:, names.index(name)]
        if len(known) < len(names):
            other = next(name for name in names if name not in self._clusters)
            ours = ", ".join(self._clusters)
            text = f"{self.settings.topic}: names the cluster {other}, which is none of {ours}"
            hint = "name the clusters in cluster_node"
            self._fault = f"{text}: {hint}", int(arrivals[-1])
        return ordered

    def _add(self, stamps: IntArray, arrivals: IntArray, values: FloatArray) -> None:
        self._heard = int(arrivals[-1])
        stamped = stamps != 0
        if stamped.any():
            self.unstamped = False
            stamps, arrivals, values = stamps[stamped], arrivals[stamped], values[stamped]
            self.clock.add(stamps, arrivals)
            times = self.clock.to_recording(stamps)
        else:
            self.unstamped = True
            times = arrivals
        if self._buffer is None or self._kind_changed(values):
            self._buffer = SourceBuffer(self.settings, self._empty(values), self._keep)
        columns = [values] if self._source != self._pose else [values[:, :3], values[:, 3:]]
        for row, (time, arrival) in enumerate(zip(times.tolist(), arrivals.tolist(), strict=True)):
            late = self._buffer.add(time, *(column[row] for column in columns))
            if late:
                while self._disorder and self._disorder[-1][1] <= late:
                    self._disorder.pop()
                self._disorder.append((arrival, late))
        oldest = int(arrivals[-1]) - round(_DISORDER * _SECOND)
        while self._disorder and self._disorder[0][0] < oldest:
            self._disorder.popleft()

    @property
    def _pose(self) -> str:
        return self._source if self._source.endswith("pose") else ""

    def _kind_changed(self, values: FloatArray) -> bool:
        """Whether the clusters' values are stresses now, and were capacitances, or vice versa."""
        assert self._buffer is not None
        series = self._buffer.series
        return isinstance(series, ClusterSeries) and series.values.shape[2] != values.shape[2]

    def _empty(self, values: FloatArray) -> Series:
        if self._source == "wrench":
            return WrenchSeries(_NOTHING, np.empty((0, 6)), self.frame)
        if self._source == "clusters":
            nothing = np.empty((0, *values.shape[1:]))
            return ClusterSeries(_NOTHING, self._clusters, nothing)
        return PoseSeries(_NOTHING, np.empty((0, 3)), np.empty((0, 4)), self.frame)

    def trigger(self, stamp: int) -> None:
        """Ask for the value at a trigger, given its time [ns]."""
        self._pending.append(stamp)

    def due(self, now: int, period: float, wait: float) -> list[tuple[int, Aligned | None]]:
        """The values at triggers that later readings cannot change, or that waited long enough.

        Args:
            now: The present time [ns].
            period: Period of the triggers [s]; 0 while it is unknown, for which the first ones
                wait.
            wait: Longest wait for a reading, after the trigger, the delay and half the window [s].

        Returns:
            Stamps of triggers [ns], in order, and the values there; None if nothing arrived yet.
        """
        if self._buffer is not None:
            self._buffer.settings = self.settings
        over: list[int] = []
        while self._pending and self._is_over(self._pending[0], now, period, wait):
            over.append(self._pending.popleft())
        if not over:
            return []
        if self._buffer is None:
            values: list[Aligned | None] = [None] * len(over)
        else:
            aligned = self._buffer.at(np.array(over), period)  # at once, which costs less
            values = [aligned.part(row) for row in range(len(over))]
        for value in values:
            if value is None or value.status.any():
                self.missing += 1
                self._lacked = now
        self.last = values[-1]
        return [*zip(over, values, strict=True)]

    def _is_over(self, stamp: int, now: int, period: float, wait: float) -> bool:
        """Whether no later reading counts for a trigger."""
        if period == 0.0 and now < stamp + round(_PERIOD_KNOWN * _SECOND):
            return False
        if self._buffer is None:
            reach = self.settings.delay + 0.5 * self.settings.span(period)
            return now > stamp + round((reach + wait) * _SECOND)
        disorder = self._disorder[0][1] if self._disorder else 0
        if self._buffer.ready(stamp + disorder, period):
            return True
        return now > self._buffer.latest(stamp, period) + round(wait * _SECOND)

    def health(self, now: int) -> tuple[int, str]:
        """State of the source: OK, WARN or ERROR, with fact and hint in one line.

        Args:
            now: The present time [ns].
        """
        for level, text in self._findings(now):
            return level, text
        if math.isnan(self.rate):
            return OK, f"{self.name} heard"
        stamps = ", no stamps" if self.unstamped else ""
        return OK, f"{self.name} at {self.rate:.3g} Hz{stamps}"

    def _findings(self, now: int) -> Iterator[tuple[int, str]]:
        """What is wrong, the worst first: level, and fact and hint in one line."""
        topic, (fault, noted) = self.settings.topic, self._fault
        if fault and now - noted < RECENT * _SECOND:
            yield ERROR, fault
        silence = _silence(self._heard, now, self.rate)
        if silence and self._reader.lacking:
            yield ERROR, f"{self.name}: {self._reader.lacking}"
        if not self._heard:
            hint = "start its driver, or check the topic's name and the ROS_DOMAIN_ID"
            yield ERROR, f"{self.name}: nothing arrives on {topic}: {hint}"
        if silence:
            yield ERROR, f"{self.name}: {topic} is {silence}: check its driver"
        if self._lacked and now - self._lacked < RECENT * _SECOND:
            yield WARN, self._lack()
        if self.clock.is_another:
            fact = f"{self.name}: the clock of {topic} is {self.late:+.3f} s behind this machine's"
            hint = "its stamps are corrected by their arrival; synchronise the clocks"
            yield WARN, f"{fact}: {hint}"
        if self.late < _AHEAD:
            fact = f"{self.name}: the stamps of {topic} are {-1e3 * self.late:.0f} ms ahead"
            yield WARN, f"{fact} of their arrival: synchronise the clocks"

    @property
    def late(self) -> float:
        """By how much its quickest messages arrive after their stamps [s]; NaN if unknown."""
        return _offset(self.clock)

    def between(self, start: int, end: int) -> FloatArray:
        """Values of the readings in a span, as they were read, shape (n, ...).

        Args:
            start: Its start [ns].
            end: Its end [ns].
        """
        if self._buffer is None:
            return np.empty((0, 6))
        with self._lock:
            series = self._buffer.series
            rows = slice(*np.searchsorted(series.times, [start, end]))
            values = series.positions if isinstance(series, PoseSeries) else series.values
            return values[rows].copy()

    def age(self, now: int) -> float:
        """Time since its newest reading [s], at the present time [ns]; NaN without any."""
        return (now - self._buffer.newest) / _SECOND if self._buffer else math.nan

    def _lack(self) -> str:
        topic, rate = self.settings.topic, self.rate
        if self.last is None or not self.last.status.all():
            return f"{self.name}: {topic} lacks readings around some triggers: check its driver"
        late = f" ({1e3 * self.late:.0f} ms after their stamps)" if self.late > 0.1 else ""
        return (
            f"{self.name}: {topic} has no readings around the triggers, at {rate:.3g} Hz{late}:"
            " check its clock and delay, or set a longer stale or wait"
        )

    def figures(self) -> dict[str, object]:
        """Figures by name, of the readings and of the newest value at a trigger.

        `rate` [Hz]; `late`, from stamp to arrival [s]; `age` and `spread` of the readings that went
        into the newest value [s], their number `readings`, and the number of triggers `missing`.
        """
        figures: dict[str, object] = {"rate": _rounded(self.rate, 1), "late": _rounded(self.late)}
        if self.last is not None:
            figures["age"] = _rounded(float(np.ravel(self.last.age)[0]))
            figures["spread"] = _rounded(float(np.ravel(self.last.spread)[0]))
            figures["readings"] = int(np.max(self.last.count))
        key = self._source
        return {f"{key}_{name}": value for name, value in figures.items()} | {
            f"{key}_missing": self.missing
        }


def _offset(clock: RunningClock) -> float:
    """By how much the quickest messages arrive after their stamps [s]; NaN if unknown."""
    return clock.clock.offset if clock.clock is not None else math.nan


def _silence(heard: int, now: int, rate: float) -> str:
    """That a topic is silent, and for how long, in words; empty while it is not.

    Args:
        heard: Arrival of its newest message [ns].
        now: The present time [ns].
        rate: Rate of its messages [Hz]; NaN if unknown.
    """
    seconds = (now - heard) / _SECOND
    usual = _SILENT_STEPS / rate if rate > 0.0 else 0.0
    return f"silent for {seconds:.1f} s" if seconds > max(_SILENT, usual) else ""


class TriggerStream:
    """Triggers from the messages of another program.

    Args:
        topic: Its topic, for texts.

    Attributes:
        topic: Its topic, as given.
        clock: Its clock, see `RunningClock`.
        unstamped: Whether its newest message has no stamp, so that the time of arrival counts.
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.clock = RunningClock()
        self.unstamped = False
        self._known: foreign.Layouts = []
        self._newest: deque[int] = deque(maxlen=_NEWEST)
        self._heard = 0  # newest arrival [ns]

    @property
    def rate(self) -> float:
        """Mean rate of the newest triggers [Hz]; NaN for fewer than two."""
        if len(self._newest) < 2:
            return math.nan
        return (len(self._newest) - 1) / ((self._newest[-1] - self._newest[0]) * 1e-9)

    def receive(self, messages: Sequence[RawMessage]) -> list[int]:
        """Stamps of the new triggers [ns], ascending.

        Args:
            messages: The messages, of one type; `time` is that of their arrival [ns].
        """
        found: list[int] = []
        for message in messages:
            self._heard = message.time
            stamps = foreign.read_stamps([message], self._known)
            if not len(stamps):
                continue
            self.clock.add(stamps, np.array([message.time]))
            self.unstamped = int(stamps[0]) == message.time
            stamp = int(self.clock.to_recording(stamps)[0])
            if not self._newest or stamp > self._newest[-1]:
                self._newest.append(stamp)
                found.append(stamp)
        return found

    def health(self, now: int) -> tuple[int, str]:
        """State of the topic at the present time [ns]: OK, WARN or ERROR, fact and hint."""
        if not self._heard:
            hint = "start its program, or check the topic's name and the ROS_DOMAIN_ID"
            return ERROR, f"no message on {self.topic}, each of which is a trigger: {hint}"
        rate = self.rate
        if silence := _silence(self._heard, now, rate):
            return ERROR, f"{self.topic} is {silence}: check its program"
        if self.clock.is_another:
            fact = f"the clock of {self.topic} is not this machine's"
            hint = "its stamps are corrected by their arrival; synchronise the clocks"
            return WARN, f"{fact}: {hint}"
        shown = "" if math.isnan(rate) else f", {rate:.3g} Hz"
        return OK, f"a trigger with each message on {self.topic}{shown}"

    @property
    def late(self) -> float:
        """By how much its quickest messages arrive after their stamps [s]; NaN if unknown."""
        return _offset(self.clock)

    def age(self, now: int) -> float:
        """Time since its newest trigger [s], at the present time [ns]; NaN without any."""
        return (now - self._newest[-1]) / _SECOND if self._newest else math.nan


class _TareDocument(Document):
    moment: tuple[_Component, _Component, _Component]
    force: tuple[_Component, _Component, _Component]
    time: Annotated[datetime, Meta(tz=True)]


class WrenchTare:
    """The wrench of another driver at no load, stored in a file if a path is given.

    Args:
        path: The file; empty for none.

    Attributes:
        wrench: What is subtracted, [M; F] in {S}, shape (6,) [N m, N]; zeros if never tared.
        time: When it was taken, since the epoch [ns], to a microsecond; 0 if never.

    Raises:
        ConfigurationError: The file is damaged.
    """

    def __init__(self, path: str = "") -> None:
        self._path = Path(path).expanduser() if path else None
        self.wrench: FloatArray = np.zeros(6)
        self.time = 0
        if self._path is not None and self._path.exists():
            try:
                stored = read_document(self._path, _TareDocument)
            except ConfigurationError as error:
                raise ConfigurationError(error.fact, "remove the file and tare again") from None
            self.wrench = np.array([*stored.moment, *stored.force])
            self.time = 1000 * round(1e6 * stored.time.timestamp())

    def take(
        self, wrenches: FloatArray, rate: float, settings: TareSettings, time: int, forced: bool
    ) -> FloatArray:
        """Take the mean of some wrenches as no load.

        Args:
            wrenches: Wrenches [M; F] of the last `tare_duration`, in {S} and not tared, shape
                (n, 6) [N m, N].
            rate: Usual rate of the source [Hz].
            settings: Duration and limits.
            time: The present time since the epoch [ns].
            forced: Whether to remove even a force above `tare_load`.

        Returns:
            The removed load, what the tared wrench was before, shape (6,) [N m, N].

        Raises:
            DeviceError: Too few wrenches are there, the load moves, or its force is above
                `tare_load` and not forced.
        """
        known = wrenches[np.isfinite(wrenches).all(axis=1)]
        expected = rate * settings.tare_duration
        if len(known) < max(2.0, _MIN_COMPLETE * expected) or not expected > 0.0:
            raise DeviceError(
                f"cannot tare: {len(known)} wrenches in the last {settings.tare_duration:g} s",
                "wait that long, check the load cell's driver, or set a longer tare_duration",
            )
        mean = known.mean(axis=0)
        removed = mean - self.wrench
        refuse_tare(known, removed, settings, forced)
        if self._path is not None:
            content = {
                "moment": mean[:3].tolist(),
                "force": mean[3:].tolist(),
                "time": iso_time(time),
            }
            make_folder(self._path.parent)
            write_text(self._path, json.dumps(content, indent=2) + "\n")
        self.wrench, self.time = mean, 1000 * (time // 1000)
        return np.asarray(removed)


def as_capacitances(
    values: FloatArray, names: Sequence[str], calibration: Calibration
) -> FloatArray:
    """Capacitances of clusters, from their stresses by the calibration turned round.

    Args:
        values: Stresses normal (positive in compression), shear x and y in the cluster's own frame,
            shape (N, C, 3) [Pa]; capacitances, shape (N, C, 4) [pF], are returned as they are.
        names: Names of the C clusters, which the calibration knows.
        calibration: Calibration of the clusters.

    Returns:
        Capacitances by converter input, shape (N, C, 4) [pF]; NaN where a stress is missing.
    """
    if values.shape[2] == _CHANNELS:
        return values
    found = np.full((*values.shape[:2], _CHANNELS), np.nan)
    for column, name in enumerate(names):
        known = np.isfinite(values[:, column]).all(axis=1)
        own = calibration.clusters[name]
        found[known, column] = invert_calibration(own, values[known, column])
    return found


def refuse_own_topic(topic: str, where: str, namespace: str) -> None:
    """Refuse a topic of another program that is called like one of the testbed's.

    Args:
        topic: Its name, absolute or relative to the namespace.
        where: The setting that names it, such as `trigger_node: topic`.
        namespace: Absolute namespace of the testbed.

    Raises:
        ConfigurationError: If the testbed publishes a topic of that name.
    """
    if topics.full_name(topic, namespace) in {
        topics.full_name(own.name, namespace) for own in topics.TOPICS
    }:
        fact = f"{where} is {topic}, which the testbed publishes itself"
        raise ConfigurationError(fact, "give the other program's topic another name")


def check_sources(settings: AlignSettings, namespace: str = "/") -> None:
    """Check that the sources of other drivers fit together, before anything starts.

    Args:
        settings: The sources.
        namespace: Absolute namespace of the testbed.

    Raises:
        ConfigurationError: One pose alone is that of another driver, a transform is no
            `tf:PARENT/CHILD` or is no pose, two sources have one topic, a topic is one that the
            testbed publishes, or the pose of the wrench's frame is wrong.
    """
    wrench_mapping(settings.wrench)
    poses = settings.socket_pose.topic, settings.pylon_pose.topic
    if (poses[0] == OWN) != (poses[1] == OWN):
        lacking = "socket_pose" if poses[0] == OWN else "pylon_pose"
        raise ConfigurationError(
            f"align_node: {lacking}.topic is empty, and the other pose is another driver's",
            "name its topic as well, or none",
        )
    named: dict[str, str] = {}
    for name, own in settings.sources.items():
        if not own.is_foreign:
            continue
        topic, body = foreign.topic_and_body(own.topic)
        if own.topic.startswith(foreign.TRANSFORM):
            parent, _, child = own.topic.removeprefix(foreign.TRANSFORM).strip("/").partition("/")
            if not name.endswith("pose") or not parent or not child:
                fact = f"align_node: {name}.topic is '{own.topic}'"
                raise ConfigurationError(fact, "give a topic, or for a pose tf:PARENT/CHILD")
        elif not _TOPIC.fullmatch(topic) or (body and not name.endswith("pose")):
            fact = f"align_node: {name}.topic is '{own.topic}', which is no name of a topic"
            raise ConfigurationError(fact, "give one such as /ft_sensor/wrench")
        else:
            refuse_own_topic(topic, f"align_node: {name}.topic", namespace)
        if (other := named.setdefault(own.topic.strip("/"), name)) != name:
            fact = f"align_node: {other}.topic and {name}.topic are both {own.topic}"
            raise ConfigurationError(fact, "give each source a topic of its own")


def foreign_topics(settings: AlignSettings, trigger: str = "") -> tuple[str, ...]:
    """Topics of other drivers, as the settings name them; `/tf` for transforms.

    Args:
        settings: The sources.
        trigger: Topic whose messages are the triggers; empty for none.
    """
    own = [own.topic for own in settings.sources.values() if own.is_foreign]
    named = [foreign.topic_and_body(name)[0] for name in own]
    return tuple(dict.fromkeys([*named, trigger] if trigger else named))


def absent_topics(settings: AlignSettings) -> tuple[topics.Topic, ...]:
    """The testbed's topics whose values there are not: of sources that are `none`."""
    sources = {
        "wrench": topics.WRENCH,
        "socket_pose": topics.SOCKET_POSE,
        "pylon_pose": topics.PYLON_POSE,
        "clusters": topics.CAPACITANCE,
    }
    return tuple(topic for name, topic in sources.items() if settings.sources[name].topic == NONE)


def wrench_mapping(settings: LiveWrenchSettings) -> WrenchDocument:
    """How a wrench of another driver becomes that of the limb on the socket in {S}.

    Raises:
        ConfigurationError: If the pose of its frame is not nine and three numbers, or no rotation.
    """
    if len(settings.rotation) != 9 or len(settings.translation) != 3:
        counts = f"{len(settings.rotation)} and {len(settings.translation)}"
        fact = f"align_node: wrench.rotation and wrench.translation have {counts} numbers"
        raise ConfigurationError(fact, "give nine, row by row, and three")
    rows = np.array(settings.rotation).reshape(3, 3).tolist()
    given = {"rotation": rows, "translation": [*settings.translation]}
    pose = convert(given, PoseDocument, "align_node: wrench")
    return WrenchDocument(of=cast(WrenchOf, settings.of), pose=pose)


def _rounded(value: float, digits: int = 5) -> float:
    return round(value, digits) if math.isfinite(value) else math.nan
