"""Measurements of other laboratories' topics, read from a bag as series with their own times."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from socket_testbed.alignment.align import Series
from socket_testbed.alignment.series import ClusterSeries, PoseSeries, WrenchSeries
from socket_testbed.alignment.source_clock import source_clock
from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.errors import TrialError, closest, listed, option_of
from socket_testbed.samples import Status
from socket_testbed.settings.alignment import NONE
from socket_testbed.trials.bag import BagReader, RawMessage
from socket_testbed.trials.rigid_bodies import (
    BODIES,
    bodies_in,
    body_names,
    each_decoded,
    lacking_body,
    require_definition,
)
from socket_testbed.wire import cdr, topics

Source: TypeAlias = Literal["wrench", "socket_pose", "pylon_pose", "clusters"]
SOURCES: tuple[Source, ...] = get_args(Source)
TRANSFORM = "tf:"  # begins a source that is a transform, such as tf:world/socket
BODY = ":"  # ends the topic of a source that is one of its bodies, such as /rigid_bodies:socket

_WRENCHES = ("geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/Wrench")
TRANSFORMS = "tf2_msgs/msg/TFMessage"
_POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
_NUMBERS, _NAMED = "std_msgs/msg/Float64MultiArray", "sensor_msgs/msg/JointState"
_CLUSTERS = (topics.CAPACITANCE.type, topics.STRESS.type, _NUMBERS, _NAMED)
KINDS: dict[Source, tuple[str, ...]] = {
    "wrench": _WRENCHES,
    "socket_pose": (*_POSES, *BODIES),
    "pylon_pose": (*_POSES, *BODIES),
    "clusters": _CLUSTERS,
}
TRIGGERS = (topics.TRIGGER.type, *_WRENCHES, *_POSES, *BODIES, *_CLUSTERS)
TYPES = (*TRIGGERS, TRANSFORMS)  # all that can be read
WORDS: dict[Source, tuple[str, ...]] = {  # in the names of topics and bodies
    "socket_pose": ("socket",),
    "pylon_pose": ("pylon", "limb", "stump", "residu", "shank", "bone"),
    "clusters": ("cluster", "capacit"),
}
LACKING: dict[Source, str] = {  # what a trial cannot do without the source
    "wrench": "no wrench: no load or plateau is known, so give --segment all; a fit needs the load"
    " cell's Wrench or WrenchStamped",
    "socket_pose": "no pose of the socket: a fit and the report need the poses of socket and pylon",
    "pylon_pose": "no pose of the pylon: a fit and the report need the poses of socket and pylon",
    "clusters": "no clusters: the map of pressure comes from the wrench alone, unvalidated; it"
    " needs their capacitances or stresses",
}
_CHANNEL = re.compile(r"(?P<cluster>.+?)[._/: -]?(?P<channel>[0-3])")
_MAX_LAYOUTS = 200
_MAX_BODY_LAYOUTS = 8  # of bodies, most of which have either few layouts or a new one each time
_REMEMBERED = 20  # layouts, of a topic that is being read
_MAX_LISTED = 4
_MAX_SEARCHED = 1000  # messages, for the names of bodies


@dataclass(frozen=True)
class ForeignSource:
    """What a topic measured, on the clock of the recording.

    Attributes:
        topic: Its name, or `TOPIC:BODY` or `tf:PARENT/CHILD`.
        type: Its message type, as `package/msg/Type`.
        series: The measurements.
        notes: What was assumed or left out, one line each.
    """

    topic: str
    type: str
    series: Series
    notes: tuple[str, ...]


def topic_and_body(name: str) -> tuple[str, str]:
    """The topic and the body of a source; without a body it is empty.

    Args:
        name: A topic, `TOPIC:BODY` or `tf:PARENT/CHILD`, whose topic is `/tf`.
    """
    if name.startswith(TRANSFORM):
        return "/tf", ""
    topic, _, body = name.partition(BODY)  # no topic's name has a colon
    return topic, body


def propose(bag: BagReader, chosen: Mapping[Source, str]) -> dict[Source, str]:
    """The topic of each source: those chosen, and for others what the types and names suggest.

    Args:
        bag: The open bag.
        chosen: Topics by source; `none` for a source that is left out.

    Returns:
        Topics by source; sources that the bag lacks are left out.

    Raises:
        TrialError: If a chosen topic is not there or has another type, several topics suit, or
            none is there for any source.
    """
    held = {name: kind for name, kind in bag.types.items() if bag.counts.get(name)}
    if any(source not in chosen for source in ("socket_pose", "pylon_pose")):
        held = _with_bodies(bag, held)
    found: dict[Source, str] = {}
    for source, name in chosen.items():
        if name != NONE:
            _check_topic(bag, source, name)
            found[source] = name
    taken = {*found.values()}
    for source in SOURCES:
        if source in chosen:
            continue
        suited = [
            name
            for name, kind in held.items()
            if kind in KINDS[source] and name not in taken and not _is_computed(name)
        ]
        if source != "wrench":
            suited = _named(source, suited, held)
        if len(suited) > 1:
            raise TrialError(
                f"{bag.path}: {listed(sorted(suited), _MAX_LISTED)} may each be the"
                f" {in_words(source)}",
                f"choose with {option_of(source)} TOPIC, or leave it out with"
                f" {option_of(source)} none",
            )
        if suited:
            found[source] = suited[0]
    _refuse_unclear_poses(bag, held, found, chosen)
    if not found:
        kinds = listed(sorted({*held.values()}), _MAX_LISTED)
        raise TrialError(
            f"{bag.path}: no topic is a wrench, a pose or clusters (there are: {kinds or 'none'})",
            "name topics with --wrench, --socket-pose, --pylon-pose, --clusters",
        )
    return found


def refuse_lacking(bag: BagReader, named: Mapping[str, str]) -> None:
    """Refuse a bag that lacks several topics that are named, in one line.

    Args:
        bag: The open bag.
        named: By option, such as `wrench` or `trigger`, a topic, `TOPIC:BODY` or
            `tf:PARENT/CHILD`; `none` is left out.

    Raises:
        TrialError: If it lacks more than one; where it lacks one, `propose` says more.
    """
    lacking = [
        f"{topic_and_body(name)[0]} of {option_of(option)}"
        for option, name in named.items()
        if name != NONE and not bag.counts.get(topic_and_body(name)[0])
    ]
    if len(lacking) > 1:
        raise TrialError(
            f"{bag.path}: holds no message of {' and '.join(lacking)}",
            "name other topics, or leave each out with none",
        )


def _with_bodies(bag: BagReader, held: Mapping[str, str]) -> dict[str, str]:
    """Types by topic, with each topic of bodies replaced by its bodies.

    Raises:
        TrialError: If such a topic cannot be read.
    """
    parts: dict[str, str] = {}
    for name, kind in held.items():
        if kind in BODIES:
            first = [*islice(bag.messages([name]), _MAX_SEARCHED)]
            parts |= {f"{name}{BODY}{body}": kind for body in body_names(first)}
        else:
            parts[name] = kind
    return parts


def in_words(source: str) -> str:
    """A source's name in a text, such as `pylon pose`."""
    return source.replace("_", " ")


def _is_computed(name: str) -> bool:
    return any(topic.computed and name.endswith(f"/{topic.name}") for topic in topics.TOPICS)


def _named(source: Source, suited: Sequence[str], held: Mapping[str, str]) -> list[str]:
    """Those of some topics whose names say the source; clusters of our own types in any case."""
    own = [name for name in suited if held[name] in _CLUSTERS[:2]]
    if own:
        capacitances = [name for name in own if held[name] == topics.CAPACITANCE.type]
        return capacitances or own
    return [name for name in suited if any(word in _label(name) for word in WORDS[source])]


def _label(name: str) -> str:
    """The part of a name that tells what a topic or body is, in lower case."""
    topic, body = topic_and_body(name)
    return (body or topic).lower()


def _refuse_unclear_poses(
    bag: BagReader,
    held: Mapping[str, str],
    found: Mapping[Source, str],
    chosen: Mapping[Source, str],
) -> None:
    """Ask which pose is which where names do not tell it."""
    left = sorted(
        name
        for name, kind in held.items()
        if kind in KINDS["socket_pose"] and name not in found.values()
    )
    open_ones = [s for s in ("socket_pose", "pylon_pose") if s not in found and s not in chosen]
    if left and open_ones:
        options = " and ".join(f"{option_of(source)} TOPIC" for source in open_ones)
        raise TrialError(
            f"{bag.path}: cannot tell whose pose {listed(left, _MAX_LISTED)} is",
            f"state it with {options}, or none instead of a topic",
        )


def _check_topic(bag: BagReader, source: Source, name: str) -> None:
    option = option_of(source)
    if name.startswith(TRANSFORM):
        if source not in ("socket_pose", "pylon_pose") or "/" not in name:
            fact = f"{option} is '{name}'"
            raise TrialError(fact, "give a topic, or for a pose tf:PARENT/CHILD")
        if not _transform_topics(bag):
            fact = f"{bag.path}: holds no {TRANSFORMS}, for {option} {name}"
            raise TrialError(fact, "record /tf, or name a topic with poses")
        return
    topic, body = topic_and_body(name)
    if body and source not in ("socket_pose", "pylon_pose"):
        raise TrialError(f"{option} is '{name}'", "give a topic; bodies have poses alone")
    if not bag.counts.get(topic):
        known = [n for n, kind in bag.types.items() if kind in KINDS[source] and bag.counts.get(n)]
        state = "holds no message" if topic in bag.types else "is not in the bag"
        raise TrialError(
            f"{bag.path}: the topic {topic} of {option} {state}", closest(topic, known)
        )
    kind, kinds = bag.types[topic], kinds_of(source, name)
    if kind not in kinds:
        hint = another_topic(topic, kind, kinds)
        raise TrialError(f"{bag.path}: {topic} of {option} is a {kind}", hint)


def kinds_of(source: Source, name: str) -> tuple[str, ...]:
    """The types that a source may have.

    Args:
        source: Which one.
        name: Its topic, `TOPIC:BODY`, or `tf:PARENT/CHILD`.
    """
    if name.startswith(TRANSFORM):
        return (TRANSFORMS,)
    _, body = topic_and_body(name)
    return BODIES if body else tuple(kind for kind in KINDS[source] if kind not in BODIES)


def another_topic(topic: str, kind: str, kinds: Sequence[str]) -> str:
    """A hint for a topic that has none of the types that its use allows.

    Args:
        topic: The topic.
        kind: Its type, as `package/msg/Type`.
        kinds: The types that would do.
    """
    if kind in BODIES and kinds == kinds_of("socket_pose", topic):
        return f"name one of its bodies, such as {topic}{BODY}socket"
    return f"name a topic of type {' or '.join(kinds)}"


def _transform_topics(bag: BagReader) -> list[str]:
    return [n for n, kind in bag.types.items() if kind == TRANSFORMS and bag.counts.get(n)]


def read_messages(
    bag: BagReader, names: Mapping[Source, str], trigger: str | None = None
) -> dict[str, list[RawMessage]]:
    """The messages of the sources' topics, and of a trigger, by full name of the topic.

    Args:
        bag: The open bag.
        names: The topic of each source.
        trigger: The topic of the triggers; None for none.
    """
    wanted: set[str] = set()
    for name in names.values():
        is_transform = name.startswith(TRANSFORM)
        wanted |= {*_transform_topics(bag)} if is_transform else {topic_and_body(name)[0]}
    if trigger is not None:
        wanted.add(trigger)
    messages: dict[str, list[RawMessage]] = defaultdict(list)
    for message in bag.messages(wanted):
        messages[message.topic].append(message)
    return dict(messages)


def read_stamps(messages: Sequence[RawMessage], known: Layouts | None = None) -> IntArray:
    """Times of messages, from their headers or, without one, of their arrival, (N,) [ns].

    Args:
        messages: The messages, of one type.
        known: Layouts of earlier messages, to which new ones are added; None for none.
    """
    if messages and messages[0].type in BODIES:
        times = [cdr.stamp_of(own) or message.time for message, own in each_decoded(messages, [])]
        return np.unique(np.array(times, dtype=np.int64))
    parts = [
        np.where(stamps == 0, arrivals, stamps)
        for arrivals, stamps, _, _ in _decoded(messages, known=known)
    ]
    return np.unique(np.concatenate(parts)) if parts else np.empty(0, np.int64)


def read_source(
    source: Source,
    name: str,
    messages: Mapping[str, Sequence[RawMessage]],
    clusters: Sequence[str] = (),
) -> ForeignSource:
    """What a source measured, ascending in time, on the clock of the recording.

    Args:
        source: Which one.
        name: Its topic, `TOPIC:BODY`, or `tf:PARENT/CHILD`.
        messages: The messages of the bag by topic, see `read_messages`.
        clusters: Names of clusters for an array that has none, in its order, four values each.

    Raises:
        TrialError: If its messages cannot be read as such a source.
    """
    if name.startswith(TRANSFORM):
        own = [
            message
            for received in messages.values()
            for message in received
            if message.type == TRANSFORMS
        ]
    else:
        own = [*messages.get(topic_and_body(name)[0], ())]
    kind = own[0].type if own else ""
    notes: list[str] = []
    parts = list(_values(source, name, own, clusters, notes))
    if not parts:
        if kind in BODIES:
            raise TrialError(*lacking_body(topic_and_body(name)[1], own))
        raise TrialError(f"{name}: holds no reading of the {in_words(source)}", "check the topic")
    columns = {column for _, _, _, column in parts}
    if len(columns) > 1:
        shown = "; ".join(", ".join(part) for part in sorted(columns))
        raise TrialError(f"{name}: its messages name different things ({shown})", "choose another")
    frames_or_names = columns.pop()
    stamps = np.concatenate([stamps for stamps, _, _, _ in parts])
    arrivals = np.concatenate([arrivals for _, arrivals, _, _ in parts])
    values = np.concatenate([values for _, _, values, _ in parts])
    zero = stamps == 0
    if zero.any() and not zero.all():
        stamps, arrivals, values = stamps[~zero], arrivals[~zero], values[~zero]
        notes.append(f"{name}: {int(zero.sum())} messages without a stamp are left out")
    elif zero.all():
        stamps = arrivals
        notes.append(f"{name}: has no stamps, so the times of its arrival count")
    elif (clock := source_clock(stamps, arrivals)).is_another:
        stamps = clock.to_recording(stamps)
        notes.append(f"{name}: its clock is not that of the recording ({clock}): corrected")
    order = np.argsort(stamps, kind="stable")
    stamps, values = stamps[order], values[order]
    again = np.flatnonzero(np.diff(stamps) == 0)
    if len(again):
        stamps, values = np.delete(stamps, again), np.delete(values, again, axis=0)
        notes.append(f"{name}: of {len(again)} readings with the stamp of the next the last counts")
    series = _series(source, stamps, values, frames_or_names)
    return ForeignSource(name, kind, series, tuple(notes))


def _series(source: Source, times: IntArray, values: FloatArray, names: tuple[str, ...]) -> Series:
    if source == "wrench":
        return WrenchSeries(times, values, names[0])
    if source == "clusters":
        return ClusterSeries(times, names, values)
    return PoseSeries(times, values[:, :3], values[:, 3:], names[0])


_Part: TypeAlias = tuple[IntArray, IntArray, FloatArray, tuple[str, ...]]
"""Stamps and arrivals [ns], values, and the frame or the names of the clusters."""

Layouts: TypeAlias = list[tuple[cdr.Layout, Any]]
"""Layouts of messages of one type, each with a decoded sample."""


class SourceReader:
    """Reads a source's messages as they arrive, with the layouts of the earlier ones.

    Args:
        source: Which source.
        name: Its topic, `TOPIC:BODY`, or `tf:PARENT/CHILD`.
        clusters: Names of clusters for an array that has none, in its order, four values each.

    Attributes:
        lacking: That the newest messages lack the body, fact and hint in one line; empty if not.
    """

    def __init__(self, source: Source, name: str, clusters: Sequence[str] = ()) -> None:
        self.lacking = ""
        self._source = source
        self._name = name
        self._clusters = clusters
        self._known: Layouts = []

    def parts(self, messages: Sequence[RawMessage], notes: list[str]) -> Iterator[_Part]:
        """The values of messages of one type, in parts.

        Args:
            messages: The messages, in the order of their arrival.
            notes: Gets a line about messages that cannot be decoded.

        Yields:
            Stamps, 0 without a header, and arrivals [ns], shape (k,); values, shape (k, ...) in the
            units of the series; the frame, or the names of the clusters.

        Raises:
            TrialError: If the messages are not such a source.
        """
        found = False
        for part in _values(self._source, self._name, messages, self._clusters, notes, self._known):
            found = True
            yield part
        del self._known[:-_REMEMBERED]
        self.lacking = ""
        if not found and messages[0].type in BODIES:
            _, body = topic_and_body(self._name)
            self.lacking = ": ".join(lacking_body(body, messages))


def _decoded(
    messages: Sequence[RawMessage],
    notes: list[str] | None = None,
    known: Layouts | None = None,
    most: int = _MAX_LAYOUTS,
    others: list[RawMessage] | None = None,
) -> Iterator[tuple[IntArray, IntArray, cdr.Record, Any]]:
    """Arrivals and stamps [ns], numbers and one sample of messages, each part of one layout.

    Without a header the stamps are the arrivals. The known layouts are tried first, and new ones
    are added to them. Messages beyond the most layouts go to `others`, or are left out.
    """
    known = [] if known is None else known
    if not messages:
        return
    kind, name, definition = messages[0].type, messages[0].topic, messages[0].definition
    arrivals = np.array([message.time for message in messages], dtype=np.int64)
    left, refused = np.arange(len(messages)), 0
    for tried in range(most):
        if not len(left):
            break
        if tried - refused < len(known):
            layout, sample = known[tried - refused]
        else:
            first = messages[left[0]].data
            try:
                layout = cdr.Layout(first, kind, definition)
                sample = cdr.decode(first, kind, definition)
            except Exception:  # the library may raise any exception
                left, refused = left[1:], refused + 1
                continue
            known.append((layout, sample))
        records, fits = layout.records([messages[row].data for row in left.tolist()])
        if not len(records):
            continue
        own = arrivals[left[fits]]
        stamps = cdr.stamps_of(records) if "header" in (records.dtype.names or ()) else own
        yield own, stamps, records, sample
        left = left[~fits]
    if others is None:
        refused += len(left)
    else:
        others += [messages[row] for row in left.tolist()]
    if refused and notes is not None:
        notes.append(f"{name}: {refused} messages cannot be decoded, and are left out")


def _values(
    source: Source,
    name: str,
    messages: Sequence[RawMessage],
    clusters: Sequence[str],
    notes: list[str],
    known: Layouts | None = None,
) -> Iterator[_Part]:
    """The values of messages of one kind, in parts."""
    kind = messages[0].type if messages else ""
    if kind in BODIES:
        yield from _body(name, messages, notes, known)
        return
    for arrivals, stamps, records, sample in _decoded(messages, notes, known):
        if kind == TRANSFORMS:
            yield from _transforms(name, arrivals, records, sample)
            continue
        values, names = _READERS[kind](name, records, sample, clusters)
        stamped = stamps if hasattr(sample, "header") else np.zeros_like(arrivals)
        yield stamped, arrivals, values, names


def _transforms(name: str, arrivals: IntArray, records: cdr.Record, sample: Any) -> Iterator[_Part]:
    """The transforms of one parent and child."""
    parent, _, child = name.removeprefix(TRANSFORM).strip("/").partition("/")
    for number, own in enumerate(sample.transforms):
        frames = own.header.frame_id.strip("/"), own.child_frame_id.strip("/")
        if frames == (parent, child):
            record = records["transforms"][str(number)]
            values = _joined(record["transform"], "translation", "rotation")
            yield cdr.stamps_of(record), arrivals, values, (parent,)


def _body(
    name: str, messages: Sequence[RawMessage], notes: list[str], known: Layouts | None
) -> Iterator[_Part]:
    """The poses of a body where it is tracked, in the order of arrival, in parts of one frame."""
    _, wanted = topic_and_body(name)
    others: list[RawMessage] = []
    parts: dict[str, list[tuple[IntArray, IntArray, FloatArray]]] = defaultdict(list)
    require_definition(messages[0])
    for arrivals, stamps, records, sample in _decoded(
        messages, notes, known, _MAX_BODY_LAYOUTS, others
    ):
        for number, own in enumerate(sample.rigidbodies):
            if own.rigid_body_name == wanted:
                record, frame, stamped = records["rigidbodies"][str(number)], "", stamps
                if hasattr(own, "header"):  # which most drivers leave empty
                    frame, stamped = own.header.frame_id, cdr.stamps_of(record)
                    stamped = np.where(stamped == 0, stamps, stamped)
                values = _joined(record["pose"], "position", "orientation")
                seen = values[:, :3].any(axis=1) & values[:, 3:].any(axis=1)
                part = stamped[seen], arrivals[seen], values[seen]
                parts[frame or sample.header.frame_id].append(part)
    for message, body in bodies_in(others, notes) if others else ():
        if body.name == wanted and body.pose:
            row = [body.stamp], [message.time], [body.pose]
            parts[body.frame].append((np.array(row[0]), np.array(row[1]), np.array(row[2])))
    for frame, found in parts.items():
        stamps, arrivals, values = (np.concatenate(column) for column in zip(*found, strict=True))
        order = np.argsort(arrivals, kind="stable")
        if len(order):
            yield stamps[order], arrivals[order], values[order], (frame,)


def _joined(record: cdr.Record, *fields: str) -> FloatArray:
    return np.concatenate([record[field] for field in fields], axis=-1).astype(np.float64)


_Read: TypeAlias = Callable[
    [str, cdr.Record, Any, Sequence[str]], tuple[FloatArray, tuple[str, ...]]
]


def _frame(sample: Any) -> tuple[str, ...]:
    return (sample.header.frame_id,)


def _capacitances(
    name: str, records: cdr.Record, sample: Any, clusters: Sequence[str]
) -> tuple[FloatArray, tuple[str, ...]]:
    """Capacitances (n, C, 4) [pF]; NaN where the status is not ok."""
    own = cdr.elements(records, "clusters")
    values = [np.where(part["status"] == 0, part["capacitance"], np.nan) for part in own]
    return _stacked(name, values, sample)


def _stresses(
    name: str, records: cdr.Record, sample: Any, clusters: Sequence[str]
) -> tuple[FloatArray, tuple[str, ...]]:
    """Stresses (n, C, 3) [Pa]; NaN where the status says that nothing was measured."""
    values = []
    for part in cdr.elements(records, "clusters"):
        stress = np.stack([part[field] for field in ("normal", "shear_x", "shear_y")], axis=-1)
        is_lacking = np.isin(part["status"], (Status.SATURATED, Status.MISSING))
        values.append(np.where(is_lacking[..., None], np.nan, stress))
    return _stacked(name, values, sample)


def _stacked(
    name: str, values: list[FloatArray], sample: Any
) -> tuple[FloatArray, tuple[str, ...]]:
    if not values:
        raise TrialError(f"{name}: names no cluster", "choose another topic")
    return np.stack(values, axis=1).astype(np.float64), tuple(c.name for c in sample.clusters)


def _numbers(
    name: str, records: cdr.Record, sample: Any, clusters: Sequence[str]
) -> tuple[FloatArray, tuple[str, ...]]:
    """Capacitances (n, C, 4) [pF] of an array without names."""
    data = records["data"] if "data" in (records.dtype.names or ()) else np.empty((0, 0))
    if not clusters or data.shape[-1] != 4 * len(clusters):
        raise TrialError(
            f"{name}: has {data.shape[-1]} values, and {len(clusters)} clusters are named",
            "name the clusters in its order with --names, four values each",
        )
    return data.reshape(len(data), len(clusters), 4).astype(np.float64), tuple(clusters)


def _named_values(
    name: str, records: cdr.Record, sample: Any, clusters: Sequence[str]
) -> tuple[FloatArray, tuple[str, ...]]:
    """Capacitances (n, C, 4) [pF] of values with names such as `distal.0`."""
    places: dict[str, dict[int, int]] = {}
    for column, own in enumerate(sample.name):
        found = _CHANNEL.fullmatch(own)
        if found is not None:
            places.setdefault(found["cluster"], {})[int(found["channel"])] = column
    if not places:
        shown = listed(list(sample.name), _MAX_LISTED) or "none"
        raise TrialError(f"{name}: no name is a channel ({shown})", "name them such as distal.0")
    values = np.full((len(records), len(places), 4), np.nan)
    for number, own in enumerate(places.values()):
        for channel, column in own.items():
            values[:, number, channel] = records["position"][:, column]
    return values, tuple(places)


_READERS: dict[str, _Read] = {
    "geometry_msgs/msg/WrenchStamped": lambda name, records, sample, clusters: (
        _joined(records["wrench"], "torque", "force"),
        _frame(sample),
    ),
    "geometry_msgs/msg/Wrench": lambda name, records, sample, clusters: (
        _joined(records, "torque", "force"),
        ("",),
    ),
    "geometry_msgs/msg/PoseStamped": lambda name, records, sample, clusters: (
        _joined(records["pose"], "position", "orientation"),
        _frame(sample),
    ),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda name, records, sample, clusters: (
        _joined(records["pose"]["pose"], "position", "orientation"),
        _frame(sample),
    ),
    "geometry_msgs/msg/TransformStamped": lambda name, records, sample, clusters: (
        _joined(records["transform"], "translation", "rotation"),
        _frame(sample),
    ),
    topics.CAPACITANCE.type: _capacitances,
    topics.STRESS.type: _stresses,
    _NUMBERS: _numbers,
    _NAMED: _named_values,
}
