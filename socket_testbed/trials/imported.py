"""Writes a trial from sources that know no trigger, and the record of how it was made.

The trial holds the testbed's topics, one message per trigger, and beside them the messages or
tables from which they were made, unchanged. `import.yaml` in its folder states the mapping, with
which other recordings can be imported alike, and what came of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, field, to_builtins

from socket_testbed.alignment.align import Aligned
from socket_testbed.alignment.common_clock import MAX_OFFSET
from socket_testbed.arrays import FloatArray, IntArray, StatusArray, finite_mean
from socket_testbed.documents import Document, convert, dump_yaml, load_yaml
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import atomic_output, check_new_folder, make_folder
from socket_testbed.geometry.pose import PoseDocument
from socket_testbed.settings.alignment import MAX_DELAY, SourceSettings
from socket_testbed.settings.options import WrenchOf
from socket_testbed.trials.bag import BagWriter, RawMessage
from socket_testbed.trials.trial import store_configuration
from socket_testbed.wire import messages, topics

RECORD_FILE = "import.yaml"
MAPPING = "mapping"  # the part of it that `read_mapping` reads
_HEADER = "# How this trial was made by 'socket-testbed import': times in s, lengths in m.\n"
ORIGINALS = "originals"  # folder of a trial that holds the tables it was made from
ORIGINAL = "/original"  # ends the name of an original topic that is called like the testbed's
_DEPTH = 100  # [messages]
AUTO, TAP = "auto", "tap"  # a delay that the load tells, an offset that a tap tells
_Delay = Annotated[float, Meta(ge=-MAX_DELAY, le=MAX_DELAY)] | Literal["auto"]


class SourceDocument(Document):
    """A source in a mapping file.

    Attributes:
        topic: Its topic, `TOPIC:BODY` or `tf:PARENT/CHILD` for a pose, the file of its table,
            `FILE:BODY` for a body of a take, or `none`; None to find it.
        delay: Delay of its stamps behind the measurement [s]; `auto` to find it against the load.
        offset: What is added to the times of its table, see `Offset` [s], or `tap` to find it from
            a tap; None for a topic, and for a table whose offset follows from others.
        row_rate: Rate of the rows of its table without times [Hz]; None for any other.
        method: `line`, `mean` or `last`, see `SourceSettings`.
        window: Span centred on a trigger whose readings are used; negative: as `SourceSettings`
            [s].
        stale: Longest distance of readings around a trigger; negative: as `SourceSettings` [s].
    """

    topic: str | None = None
    delay: _Delay = SourceSettings.delay
    offset: Annotated[float, Meta(ge=-MAX_OFFSET, le=MAX_OFFSET)] | Literal["tap"] | None = None
    row_rate: Annotated[float, Meta(ge=0.1, le=20000.0)] | None = None
    method: str = SourceSettings.method
    window: float = SourceSettings.window
    stale: float = SourceSettings.stale

    def settings(self, delay: float) -> SourceSettings:
        """How its readings are brought to triggers; checked.

        Args:
            delay: The delay, as stated or found [s].
        """
        return SourceSettings(delay=delay, method=self.method, window=self.window, stale=self.stale)


class WrenchDocument(SourceDocument):
    """The wrench in a mapping file.

    Attributes:
        of: Whose force it is: of the `limb` on the socket, or of the `socket` on the limb.
        pose: Pose of the frame of the messages in {S}; None if they are in {S}.
        tare: Span T0:T1 without load, since the first trigger [s], whose mean is subtracted; None
            for a wrench that its driver tares.
    """

    of: WrenchOf = "limb"
    pose: PoseDocument | None = None
    tare: str | None = None


class ClustersDocument(SourceDocument):
    """The clusters in a mapping file.

    Attributes:
        names: Clusters of an array without names, in its order, four capacitances each.
    """

    names: tuple[str, ...] = ()


class SourceMapping(Document):
    """A mapping file: which topic is what, and how it is brought to triggers.

    Attributes:
        wrench: The wrench of the load cell.
        socket_pose: The pose of the socket's marker body.
        pylon_pose: The pose of the pylon's marker body.
        clusters: Capacitances or stresses of the clusters.
        rate: Rate of triggers over the time that all sources share [Hz]; None with a trigger, or
            for the usual one.
        trigger: Topic whose stamps are the triggers; None for a rate.
        columns: Titles of columns of tables, by what they hold, see `TableFormat`.
        units: Units of tables by quantity, see `TableFormat`.
    """

    wrench: WrenchDocument = field(default_factory=WrenchDocument)
    socket_pose: SourceDocument = field(default_factory=SourceDocument)
    pylon_pose: SourceDocument = field(default_factory=SourceDocument)
    clusters: ClustersDocument = field(default_factory=ClustersDocument)
    rate: Annotated[float, Meta(ge=0.1, le=1000.0)] | None = None
    trigger: str | None = None
    columns: dict[str, str] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)


def stated(mapping: SourceMapping) -> dict[str, Any]:
    """A mapping as a file states it, without what is usual anyway."""
    usual, found = to_builtins(SourceMapping()), {}
    for name, value in to_builtins(mapping).items():
        given = value
        if isinstance(value, dict):
            given = {key: own for key, own in value.items() if own != usual[name].get(key)}
        if given not in ({}, usual[name]):
            found[name] = given
    return found


def read_mapping(trial: Path) -> SourceMapping:
    """The mapping with which a trial was imported.

    Args:
        trial: Its folder.

    Raises:
        ConfigurationError: If it is no imported trial, or its record is wrong.
    """
    file = trial / RECORD_FILE
    if not file.is_file():
        fact = f"{trial}: holds no {RECORD_FILE}"
        raise ConfigurationError(fact, "give a trial that 'import' made")
    record = load_yaml(file)
    if not isinstance(record, dict) or MAPPING not in record:
        raise ConfigurationError(f"{file}: states no {MAPPING}", "import that trial again")
    return convert(record[MAPPING], SourceMapping, f"{file}: {MAPPING}")


def in_load_cell(values: FloatArray, mapping: WrenchDocument) -> FloatArray:
    """Wrenches [M; F] of the limb on the socket in {S}, shape (N, 6) [N m, N].

    F_S = R F and M_S = R M + p x R F, with the pose (R, p) of the messages' frame in {S}.

    Args:
        values: Wrenches [M; F] in the frame of the messages, shape (N, 6) [N m, N].
        mapping: Whose force they are, and the pose of their frame.
    """
    if mapping.of == "socket":
        values = -values
    if mapping.pose is None:
        return values
    pose = mapping.pose.pose()
    moment, force = values[:, :3] @ pose.rotation.T, values[:, 3:] @ pose.rotation.T
    return np.hstack([moment + np.cross(pose.translation, force), force])


def original_name(name: str) -> str:
    """Name of a topic of the bag in the trial: its own, unless it is called like a testbed's."""
    called = any(name == t.name or name.endswith(f"/{t.name}") for t in topics.TOPICS)
    return name + ORIGINAL if called else name


def write_imported_trial(
    path: Path,
    triggers: IntArray,
    aligned: Mapping[str, Aligned],
    clusters: tuple[Sequence[str], FloatArray, StatusArray],
    originals: Sequence[RawMessage],
    configuration: Mapping[str, bytes],
    record: Mapping[str, Any],
) -> None:
    """Write the trial.

    Args:
        path: The folder, which must not exist.
        triggers: Times of the triggers, shape (N,) [ns].
        aligned: The wrench in {S} (`wrench`) and the poses (`socket_pose`, `pylon_pose`) at the
            triggers; a wrench that is left out is missing at every trigger, a pose has no topic.
        clusters: Names of the clusters, capacitances, shape (N, C, 4) [pF], and the `Status` of
            each.
        originals: The messages from which the trial was made.
        configuration: The files to store with it, by name, see `read_configuration`.
        record: What `import.yaml` states.

    Raises:
        ConfigurationError: If the folder exists or cannot be written.
    """
    check_new_folder(path)
    make_folder(path.parent)
    types = {message.topic: (message.type, message.definition) for message in originals}
    kept = {name: original_name(name) for name in types}
    entries = [(message.time, kept[message.topic], message.data) for message in originals]
    own = [topics.TRIGGER, topics.WRENCH, topics.CAPACITANCE]
    poses = {
        topics.POSES[name]: aligned[f"{name}_pose"].values
        for name in topics.POSES
        if f"{name}_pose" in aligned
    }
    names, capacitance, status = clusters
    missing = np.full((len(triggers), 6), np.nan)
    wrench = aligned["wrench"].values if "wrench" in aligned else missing
    pack_trigger, pack_wrench = messages.trigger_packer(), messages.wrench_packer()
    pack_pose, pack_capacitance = messages.pose_packer(), messages.capacitance_packer(names)
    for row, stamp in enumerate(triggers.tolist()):
        packed = [pack_trigger(stamp, row), pack_wrench(stamp, wrench[row])]
        packed.append(pack_capacitance(stamp, capacitance[row], status[row]))
        entries += [(stamp, f"/{t.name}", data) for t, data in zip(own, packed, strict=True)]
        entries += [(stamp, f"/{t.name}", pack_pose(stamp, v[row])) for t, v in poses.items()]
    entries.sort(key=lambda entry: entry[0])
    with atomic_output(path) as staging:
        with BagWriter(staging) as bag:
            for topic in [*own, *poses]:
                bag.add_topic(f"/{topic.name}", topic)
            for name, (kind, definition) in types.items():
                bag.add_topic(kept[name], topics.Topic(kept[name], kind), definition)
            for time, name, data in entries:
                bag.write(name, time, data)
        record_text = _HEADER + dump_yaml(dict(record))
        if any(name.startswith(f"{ORIGINALS}/") for name in configuration):
            (staging / ORIGINALS).mkdir()
        store_configuration(staging, {**configuration, RECORD_FILE: record_text.encode()})


def described(aligned: Aligned, settings: SourceSettings, window: float) -> dict[str, Any]:
    """What `import.yaml` states of a source beside its topic: window, delay, and what went in.

    Args:
        aligned: Its values at the triggers.
        settings: How they were brought there.
        window: Span centred on a trigger whose readings were used [s].
    """
    age = finite_mean(np.abs(aligned.age).ravel(), np.median)
    return {
        "delay": round(settings.delay, 6),
        "method": settings.method,
        "window": round(window, 6),
        "readings_per_trigger": finite_mean(aligned.count.ravel().astype(float), np.median),
        "age": None if np.isnan(age) else round(age, 6),
        "missing": round(float((aligned.status != 0).mean()), 6),
    }
