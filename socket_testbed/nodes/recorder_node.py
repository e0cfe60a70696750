"""Recorder node: records the topics of the testbed as raw bytes into a trial (MCAP).

Subscribes: the topics of the testbed; the maps with `everything`; topics of other programs, whose
names the setting `beside` has. Service: recorder/record.
Publishes: /diagnostics, and recorder/trial (std_msgs/String, latched): the name (last path
component) of the trial being recorded, empty if none.

Recording times start from the system clock and advance steadily, so that a step of the system clock
does not reorder messages. With use_sim_time, they follow /clock.

If its folder already holds a trial, for example after a restart, the recorder keeps it and records
into DIRECTORY_2, DIRECTORY_3, ... instead. It refuses while another recorder writes that trial.

The other files of a trial are read at the start and cannot be changed afterwards; the parameters
`next.*` set the name and metadata of the next requested trial.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

from rclpy.parameter import Parameter
from std_msgs.msg import String
from std_srvs.srv import SetBool

from socket_testbed import clocks
from socket_testbed.clocks import SteadyClock
from socket_testbed.errors import ConfigurationError, TestbedError, fact_and_hint
from socket_testbed.files import disk_hint, is_held, is_reachable, refuse_existing
from socket_testbed.nodes.base import ELAPSED, ERROR, FREE, OK, WARN, Inbox, TestbedNode
from socket_testbed.nodes.foreign_topics import ForeignTopic
from socket_testbed.settings.testbed import NextTrialSettings, RecorderSettings, check_take_name
from socket_testbed.trials import foreign, metadata
from socket_testbed.trials.bag import BagWriter
from socket_testbed.trials.bag_parts import is_bag
from socket_testbed.trials.imported import original_name
from socket_testbed.trials.trial import read_configuration, store_configuration
from socket_testbed.wire.topics import RECORDED_TRIAL, TOPICS, Service, Topic, full_name

# Topics of other programs:
_TAKE_PERIOD = 0.1  # [s]
_LOOK_PERIOD = 0.5  # [s]; of looks for publishers
_WARN = 10.0  # [s]; between two warnings

_SILENCE_TIMEOUT = 10.0  # [s]; for a graph to start


class RecorderNode(TestbedNode[RecorderSettings]):
    """Records on request, one trial per recording.

    Messages are stored as they arrive, with the time of their arrival since the epoch [ns]; their
    headers keep the stamps of the triggers. Service: recorder/record starts and ends a trial.
    """

    def __init__(self) -> None:
        super().__init__("recorder_node", RecorderSettings)
        os.umask(os.umask(0) | 0o007)  # personal data: for owner and group only
        settings = self.settings
        self._directory = Path(settings.directory).absolute()
        files = (settings.geometry, settings.calibration, settings.parameters)
        self._configuration = read_configuration(*(Path(f) if f else None for f in files))
        self._stated = metadata.TrialMetadata()
        if settings.metadata:
            self._stated = metadata.read_metadata(Path(settings.metadata))
        self._bag: BagWriter | None = None
        self._path: Path | None = None
        self._counts: dict[str, int] = {}
        self._began = 0.0  # [s]
        self._warned = False
        self._now: Callable[[], int] = SteadyClock().now
        self._announcer = self.advertise(RECORDED_TRIAL)
        chosen = [topic for topic in TOPICS if settings.everything or not topic.unrecorded]
        self._topics = {self.resolve_topic_name(topic.name): topic for topic in chosen}
        self._required = [
            name
            for name, topic in self._topics.items()
            if topic.required and topic.name not in settings.absent
        ]
        for name, topic in self._topics.items():
            callback = partial(self._on_message, name)
            self.listen(topic, callback, name, needed=name in self._required, raw=True)
        self._inbox: Inbox | None = None
        self._beside: list[ForeignTopic] = []
        if settings.beside:
            self._inbox = Inbox(self.get_name(), self.get_namespace(), {})
            names = [full_name(name, self.get_namespace()) for name in settings.beside]
            self._beside = [ForeignTopic(self._inbox.node, name, foreign.TYPES) for name in names]
            self.repeat(_TAKE_PERIOD, self._take)
            self.repeat(_LOOK_PERIOD, self._look)
        self.serve(SetBool, Service.RECORD, self._on_record)
        self.repeat(settings.flush_period, self._flush)
        self._announce()
        if settings.record:
            self._record()

    def _read_settings(self, changes: dict[str, Any]) -> RecorderSettings:
        settings = super()._read_settings(changes)
        _metadata_of(settings.next)  # refuses invalid metadata
        return settings

    def check(self) -> None:
        """Report topics without messages."""
        if self._bag is None:
            return
        silent = self._silent_topics()
        if silent and clocks.monotonic() - self._began > _SILENCE_TIMEOUT:
            what = "" if silent == self._required else f" on {', '.join(silent)}"
            self.report(
                WARN,
                f"recording {self._path}, but nothing arrives{what}: check that the testbed runs,"
                " with the same ROS_DOMAIN_ID (on another computer: docs/hardware.md, Network)",
            )
            self._warned = True
        elif self._warned and not silent:
            self._warned = False
            self.report(OK, f"recording {self._path}")

    def _silent_topics(self) -> list[str]:
        """The required topics of which the recording has no message."""
        return [name for name in self._required if not self._counts[name]]

    def figures(self) -> dict[str, object]:
        """The trial, its recorded duration [s], free space [bytes], and message counts by topic."""
        elapsed = clocks.monotonic() - self._began if self._bag is not None else 0.0
        place = self._path or self._directory
        free = math.nan
        with suppress(OSError):  # the disk was unplugged
            made = next(path for path in (place, *place.parents) if path.exists())
            free = shutil.disk_usage(made).free
        return {"trial": self._path or "", ELAPSED: round(elapsed, 1), FREE: free, **self._counts}

    def _on_record(self, wanted: bool) -> str:
        """Start a trial with the name and metadata of the parameters `next.*`, or end it."""
        given = self.settings.next
        if wanted and self._bag is None:
            stated = metadata.change_metadata(self._stated, _metadata_of(given).stated())
            self._start(self._next_path(given.name), stated)
            self._forget_next()
        elif wanted and self._path is not None and given != NextTrialSettings():
            self._forget_next()  # meant for this request only
            raise ConfigurationError(f"{self._path.name} is being recorded", "stop it first")
        elif not wanted:
            if self._bag is None:
                return "nothing was being recorded"
            self._end()
            if self._level == ERROR:  # the disk failed
                raise TestbedError(*fact_and_hint(self._message))
        return f"{'recording' if self._bag else 'recorded'} {self._path}"

    def _forget_next(self) -> None:
        """Reset the name and metadata of the next trial, which apply to one trial only."""
        blank = NextTrialSettings().to_flat("next.")
        self.set_parameters([Parameter(name, value=value) for name, value in blank.items()])

    def _next_path(self, name: str) -> Path:
        """Path of a requested recording: in the folder, or next to it if it holds a trial."""
        directory = self._directory
        if is_bag(directory):
            path = directory.with_name(f"{directory.name}_{name}") if name else directory
        else:
            path = directory / (name or datetime.now().strftime("trial_%Y%m%d_%H%M%S"))
        return _beside(path) if path.exists() else path

    def _record(self) -> None:
        """Record into the folder, or next to it if it holds a trial."""
        directory = self._directory
        holds_trial = is_bag(directory)
        if holds_trial and is_held(directory):
            raise ConfigurationError(
                f"{directory} is being written by another recorder", "end it, or name a new folder"
            )
        path = _beside(directory) if holds_trial else directory
        self._start(path, self._stated)
        if holds_trial:
            self.report(WARN, f"recording {path}: {directory} holds a trial and stays as it is")

    def _start(self, path: Path, stated: metadata.TrialMetadata) -> None:
        """Start recording into a new folder, with the configuration and the stated metadata."""
        check_take_name(path.name)
        refuse_existing(path)
        contents = dict(self._configuration)
        if stated.stated():
            contents[metadata.METADATA_FILE] = metadata.metadata_text(stated).encode()
        bag = BagWriter(path)
        try:
            bag.__enter__()
            for name, topic in self._topics.items():
                bag.add_topic(name, topic)
            store_configuration(path, contents)
        except OSError as error:
            bag.abandon()
            shutil.rmtree(path, ignore_errors=True)  # created above and still empty
            raise ConfigurationError(
                f"{path}: cannot be written ({error.strerror or error})", disk_hint(error)
            ) from None
        clock = self.get_clock()
        self._now = SteadyClock().now
        # A slowed simulation's steady clock has the time of its /clock, and does not tick.
        if clock.ros_time_is_active and clocks.time_scale() == 1.0:
            self._now = lambda: clock.now().nanoseconds
        self._bag, self._path = bag, path
        self._began, self._warned = clocks.monotonic(), False
        self._counts = dict.fromkeys(self._topics, 0)
        self._announce()
        self.report(OK, f"recording {path}")

    def close(self) -> None:
        """Close the trial, if one is being recorded, and stop listening to other programs."""
        self._take()
        self._end()
        if self._inbox is not None:
            self._beside = []
            self._inbox.close()
            self._inbox = None

    def _end(self) -> None:
        """Close the trial, if one is being recorded."""
        if self._bag is None:
            return
        with self._until_disk_fails(self._bag):
            self._bag.__exit__(None, None, None)
            self._bag = None
            self._announce()
            text = f"recorded {sum(self._counts.values())} messages in {self._path}"
            silent = self._silent_topics()
            if silent:
                text += f", none on {', '.join(silent)}: a fit needs these"
            self.report(WARN if silent else OK, text)

    def _on_message(self, name: str, data: bytes) -> None:
        """Record a serialised message of a topic, given by its full name, as arrived now."""
        if self._bag is None:
            return
        with self._until_disk_fails(self._bag):
            self._bag.write(name, self._now(), data)
            self._counts[name] += 1

    def _look(self) -> None:
        """Subscribe to the topics of other programs that are there now."""
        for topic in self._beside:
            if wrong := topic.look():
                self.get_logger().warning(f"not recorded: {wrong}", throttle_duration_sec=_WARN)

    def _take(self) -> None:
        """Record what has arrived on the topics of other programs."""
        for topic in self._beside:
            for raw in topic.take(self._now):
                if self._bag is None:
                    continue
                name = original_name(topic.name)
                if name not in self._counts:
                    self._bag.add_topic(name, Topic(name, raw.type), raw.definition)
                    self._counts[name] = 0
                with self._until_disk_fails(self._bag):
                    self._bag.write(name, raw.time, raw.data)
                    self._counts[name] += 1

    def _flush(self) -> None:
        if self._bag is not None:
            with self._until_disk_fails(self._bag):
                self._bag.flush()

    @contextmanager
    def _until_disk_fails(self, bag: BagWriter) -> Iterator[None]:
        """End the recording if the disk is full or gone, and report the fault."""
        try:
            yield
        except OSError as error:
            self._bag = None
            bag.abandon()
            self._announce()
            state = "keeps its data" if is_reachable(bag.path) else "is gone"
            self.report(
                ERROR,
                f"recording stopped, {bag.path} {state} ({error.strerror}): {disk_hint(error)}",
            )

    def _announce(self) -> None:
        """Publish the name of the trial being recorded."""
        if self.context.ok():
            name = self._path.name if self._bag and self._path else ""
            self._announcer.publish(String(data=name))


def _beside(path: Path) -> Path:
    """The first free name among `path`_2, `path`_3, ..."""
    names = (path.parent / f"{path.name}_{number}" for number in count(2))
    return next(name for name in names if not name.exists())


def _metadata_of(given: NextTrialSettings) -> metadata.TrialMetadata:
    """The metadata of the next trial; a ConfigurationError if they are invalid."""
    stated = {name: value for name, value in vars(given).items() if name != "name" and value}
    return metadata.TrialMetadata(**stated)
