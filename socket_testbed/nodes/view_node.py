"""View node: serves a page that shows the running testbed in a browser.

Subscribes, while a browser asks: estimate/force_map, estimate/regions, load_cell/wrench,
estimate/wrench, clusters/stress. Always: /diagnostics, recorder/trial. Publishes: /diagnostics.
With buttons, see `ServiceControls`, also: event, trigger, and calls of services.

The page's subscriptions have no executor: each request takes the newest messages. At 100 Hz most
messages are never decoded.
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from contextlib import suppress
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from socket_testbed import clocks
from socket_testbed.arrays import FloatArray
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.files import SOCKET_FILE, file_or_packaged
from socket_testbed.geometry.regions import all_regions, axial_force
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.identification.data_finding import CHECK
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.pressure import (
    THRESHOLD,
    Quantity,
    RegionOutputs,
    contact_of,
    integration_weights,
)
from socket_testbed.nodes import base
from socket_testbed.nodes.controls import ServiceControls
from socket_testbed.pages import document
from socket_testbed.pages.server import PageServer, is_local
from socket_testbed.samples import Status
from socket_testbed.settings.testbed import ViewSettings
from socket_testbed.tables import duration_text
from socket_testbed.trials.metadata import FIELDS, SIDES
from socket_testbed.wire import topics
from socket_testbed.wire.messages import Reader, in_order

_STALE_AFTER = 2.0  # [s]; older data is not shown as current
_SILENT_AFTER = 3.0 * base.REPORT_PERIOD  # [s]; a node without a report for longer is silent
_IDLE_AFTER = 3.0  # [s]; without a request for longer, no browser is open
_LONGEST = 1e9  # [s]; of a recording
_DEPTHS = {
    topics.FORCE_MAP: 50,
    topics.WRENCH: 50,
    topics.ESTIMATED_WRENCH: 50,
    topics.STRESS: 50,
    topics.REGIONS: 5,
}
_MAX_KEPT = 200  # messages of a topic, to match those of the regions
_COURSE_DURATION = 30.0  # [s]
_INTEGRAL = f"pressure-time integral, last {_COURSE_DURATION:.0f} s [kPa s]"
_NO_WRENCH = np.full(6, np.nan)
_T = TypeVar("_T")
_SIGNS = ("\N{BLACK CIRCLE}", "\N{BLACK UP-POINTING TRIANGLE}", "\N{BLACK SQUARE}")


def _keep(kept: OrderedDict[int, _T], stamp: int, value: _T) -> None:
    """Keep the newest values by stamp [ns], up to `_MAX_KEPT`."""
    kept[stamp] = value
    while len(kept) > _MAX_KEPT:
        kept.popitem(last=False)


class ViewNode(base.TestbedNode[ViewSettings]):
    """Shows the running testbed in browsers.

    While a browser asks, the page shows the newest estimate/regions [Pa] with estimate/force_map
    (pressure and shear [Pa] on the tiles) and clusters/stress [Pa] of the same stamp; the newest
    wrenches of load_cell/wrench and estimate/wrench in {S} [N, N m]; and from /diagnostics the
    state of every node. Without regions it shows the newest map.
    """

    def __init__(self) -> None:
        super().__init__("view_node", ViewSettings)
        settings = self.settings
        geometry = read_socket(file_or_packaged(settings.geometry, SOCKET_FILE))
        allowed = settings.buttons or is_local(settings.host)
        self._live = LiveSource(self, geometry, ServiceControls(self) if allowed else None)
        self._server = PageServer(self._live, settings.host, settings.port, settings.names)
        self.report(base.OK, f"the testbed is shown at {self._server.url}")

    def check(self) -> None:
        """Unsubscribe once no browser is open."""
        with self._server.asking:
            self._live.unsubscribe_if_idle()

    def close(self) -> None:
        """Stop the page server."""
        self._server.close()
        super().close()


class LiveSource:
    """The running testbed, a `Source` of the page.

    Args:
        node: The node in whose namespace the testbed is, and which is spun elsewhere.
        geometry: The socket that is shown; maps of another one are not.
        controls: Performs the actions of the buttons; None: the buttons are off.
    """

    def __init__(
        self,
        node: base.TestbedNode[Any],
        geometry: SocketGeometry,
        controls: ServiceControls | None,
    ) -> None:
        self._geometry, self._controls, self._node = geometry, controls, node
        self._own = node.get_fully_qualified_name()
        self._prefix = self._own.removesuffix(node.get_name())
        self._inbox: base.Inbox | None = None
        self._readers = {topic: Reader(topic) for topic in _DEPTHS}
        self._asked_at = 0.0  # [s]; when a browser last asked
        # stamp [ns], values and arrival [s] of the newest message by topic
        self._newest: dict[topics.Topic, tuple[int, Any, float]] = {}
        self._wrenches: deque[tuple[int, FloatArray]] = deque(maxlen=_MAX_KEPT)  # by stamp
        # Recent maps and stresses [Pa] of the clusters by stamp [ns], and regions without their map
        self._maps: OrderedDict[int, MapEstimate] = OrderedDict()
        self._stresses: OrderedDict[int, FloatArray] = OrderedDict()
        self._waiting: OrderedDict[int, RegionOutputs] = OrderedDict()
        self._pair = 0  # stamp of the regions on the page and of their map [ns]; 0 for none
        self._first = 0  # [ns]
        self._foreign = False  # whether the newest map belongs to another socket
        self._sensors: dict[str, tuple[DiagnosticArray, float]] = {}
        self._rates: dict[str, tuple[float, float, float]] = {}  # count, time [s], rate [Hz]
        self._trial = ("", 0.0)
        self._places = all_regions(geometry)
        self._arrows = document.arrow_map(geometry)
        self._shown: document.Document = {}  # cards (except the data's), bars, course
        self._shown_at = -math.inf  # [s]
        self._course: deque[tuple[float, ...]] = deque()  # time [s], force [N], peak and ends [Pa]
        # Pressure in contact of the regions with its ends, (3, R) [Pa], at the times of the course
        self._held: deque[FloatArray] = deque()
        node.listen(topics.DIAGNOSTICS, self._on_diagnostics, needed=False)
        node.listen(topics.RECORDED_TRIAL, self._on_trial, needed=False)

    def start(self) -> document.Document:
        """The socket, and whether buttons are enabled."""
        return {
            "title": "socket_testbed, live",
            "facts": {},
            "socket": document.socket_document(self._geometry),
            "live": True,
            "buttons": self._controls is not None,
            "metadata": {name: ("", *SIDES) if name == "side" else () for name in FIELDS},
        }

    def now(self, time: float | None) -> document.Document:
        """The newest sample, whatever the time; map, cards, bars and course are of one stamp."""
        del time
        self._asked_at = clocks.monotonic()
        if self._inbox is None:
            self._inbox = self._subscribe()
        self._take(self._inbox)
        self._update(self._inbox)
        data, sensors = self._state_of_sensors()
        found = {"moment": self._moment(), "sensors": sensors, "recording": self._recording()}
        found |= self._shown | {"cards": [*self._shown.get("cards", []), data]}
        wrenches = map(self._recent, (topics.WRENCH, topics.ESTIMATED_WRENCH))
        pair = (_NO_WRENCH if wrench is None else wrench for wrench in wrenches)
        return found | {"wrench": document.wrench_rows(*pair)}

    def act(self, what: str, given: dict[str, Any]) -> str:
        """Perform a button's action; returns the outcome in one line.

        Args:
            what: The action, see `ServiceControls.act`.
            given: Its arguments by name; empty ones are left out.

        Raises:
            ConfigurationError: If the buttons are off, there is no such action, or an argument is
                invalid.
            TestbedError: If a service refuses, does not answer, or is not offered.
        """
        if self._controls is None:
            raise ConfigurationError("the buttons are off", "start 'view' with --buttons")
        return self._controls.act(
            what, {name: str(value) for name, value in given.items() if value}
        )

    def unsubscribe_if_idle(self) -> None:
        """Unsubscribe if no browser has asked for a while."""
        if self._inbox is not None and clocks.monotonic() - self._asked_at > _IDLE_AFTER:
            self._inbox.close()
            self._inbox, self._foreign = None, False
            self._newest.clear()
            self._maps.clear()

    def _subscribe(self) -> base.Inbox:
        # Publishers never wait for this page: lost messages are not retransmitted.
        lost = ReliabilityPolicy.BEST_EFFORT
        qos = {topic: QoSProfile(depth=n, reliability=lost) for topic, n in _DEPTHS.items()}
        return base.Inbox(f"{self._node.get_name()}_inbox", self._node.get_namespace(), qos)

    def _read(self, inbox: base.Inbox, topic: topics.Topic) -> list[tuple[int, Any]]:
        """Stamps [ns] and values (see `Reader`) of the queued messages of a topic, in order."""
        found = []
        for data in inbox.take(topic):
            with suppress(TrialError):  # another program's layout
                found.append(self._readers[topic].read(data))
        return found

    def _take(self, inbox: base.Inbox) -> None:
        """Take maps [N, Pa] and wrenches [M; F] in {S} [N m, N]."""
        now = clocks.monotonic()
        for topic in (topics.WRENCH, topics.ESTIMATED_WRENCH):
            for stamp, values in self._read(inbox, topic):
                if topic is topics.WRENCH:
                    if self._wrenches and stamp < self._wrenches[-1][0]:
                        self._restart()
                    self._first = self._first or stamp
                    self._wrenches.append((stamp, values))
                self._newest[topic] = stamp, values, now
        for stamp, (names, fields) in self._read(inbox, topics.FORCE_MAP):
            self._foreign = names != self._geometry.names
            if not self._foreign:
                estimate = MapEstimate(**fields)
                self._newest[topics.FORCE_MAP] = stamp, estimate, now
                _keep(self._maps, stamp, estimate)
        for stamp, stresses in self._read(inbox, topics.STRESS):
            stress, status = in_order(stresses, self._geometry.clusters)
            _keep(self._stresses, stamp, np.where(status == Status.OK, stress[:, 0], np.nan))

    def _restart(self) -> None:
        """Forget what was measured before the graph was restarted."""
        for kept in (self._wrenches, self._course, self._held):
            kept.clear()
        for by_stamp in (self._maps, self._stresses, self._waiting):
            by_stamp.clear()
        self._first = self._pair = 0

    def _update(self, inbox: base.Inbox) -> None:
        """Update the page with the newest outputs by region and the map of the same stamp."""
        now, geometry, places = clocks.monotonic(), self._geometry, self._places
        if now - self._shown_at > _STALE_AFTER:
            self._shown, self._pair = {}, 0
        own = tuple(place.name for place in places)
        for stamp, (names, outputs) in self._read(inbox, topics.REGIONS):
            if names == own:
                _keep(self._waiting, stamp, outputs)
        for stamp in [*self._waiting]:
            if stamp not in self._maps:
                continue
            mapped, outputs = self._maps[stamp], self._waiting.pop(stamp)
            contact = contact_of(geometry, places, mapped, THRESHOLD)
            wrench = dict(self._wrenches).get(stamp, _NO_WRENCH)
            peak = outputs.peak
            row = (axial_force(geometry, wrench), peak.value[-1], peak.low[-1], peak.high[-1])
            self._first = self._first or stamp
            self._course.append((1e-9 * (stamp - self._first), *map(float, row)))
            held = contact.pressure
            self._held.append(np.stack([held.value, held.low, held.high]))
            while self._course[-1][0] - self._course[0][0] > _COURSE_DURATION:
                self._course.popleft()
                self._held.popleft()
            time, load, value, low, high = np.array(self._course).T
            self._shown_at, self._pair = now, stamp
            self._shown = {
                "cards": document.cards(
                    geometry,
                    places,
                    outputs,
                    mapped.normal_pressure[0],
                    self._measured(stamp),
                    " now",
                ),
                "bars": document.bars(
                    places, replace(outputs, area=contact.area), {_INTEGRAL: self._integral(time)}
                ),
                "course": document.course(time, load, Quantity(value, low, high, value), []),
            }

    def _integral(self, time: FloatArray) -> Quantity:
        """Pressure-time integral of the regions over the course, whose times are given [s]."""
        value, low, high = integration_weights(time) @ np.stack(self._held, axis=1)
        return Quantity(value, low, high, value)

    def _moment(self) -> document.Document:
        """The map of the cards, else the newest one: stresses on the tiles with its time [s]."""
        found = self._maps.get(self._pair, self._recent(topics.FORCE_MAP))
        if found is None:
            return {"time": 0.0, "words": "no force map"}
        stamp = self._pair if self._pair in self._maps else self._newest[topics.FORCE_MAP][0]
        stresses = found.normal_pressure[0], found.pressure_reach[0], found.shear[0]
        arrows = np.einsum("nai,ni->na", self._arrows, found.forces[0])
        time, measured = 1e-9 * (stamp - self._first), self._measured(stamp)
        return document.moment(time, *stresses, measured, arrows=arrows)

    def _measured(self, stamp: int) -> FloatArray:
        """Measured normal pressures of the clusters at a stamp, shape (c,) [Pa]; NaN if missing."""
        return self._stresses.get(stamp, np.full(len(self._geometry.clusters), np.nan))

    def _recent(self, topic: topics.Topic) -> Any:
        """The newest values of a topic; None if stale."""
        _, values, arrival = self._newest.get(topic, (0, None, -math.inf))
        return values if clocks.monotonic() - arrival < _STALE_AFTER else None

    def _state_of_sensors(self) -> tuple[document.Document, list[list[str]]]:
        """The data card, and a row per node: sign, name, message and rate."""
        now, rows, bad = clocks.monotonic(), [], []
        for name, (status, arrival) in sorted(self._sensors.items()):
            level, words = int.from_bytes(status.level, "little"), status.message
            if now - arrival > _SILENT_AFTER:
                level, words = 2, f"silent for {now - arrival:.0f} s; it said: {words}"
            title = name.removeprefix(self._prefix).removesuffix("_node").replace("_", " ")
            rate = self._rates.get(name, (0.0, 0.0, math.nan))[2]
            shown = f"{rate:.3g} Hz" if math.isfinite(rate) else ""
            rows.append([_SIGNS[min(level, 2)], title, words, shown])
            if level > 0:
                names = words.partition(":")[0].split(", ")
                of_clusters = {*names} <= {*self._geometry.clusters}  # they say more than the node
                bad.append((level, words if of_clusters else f"{title}: {words}"))
        if self._foreign:
            bad.append((3, "the force map is of another socket: give 'view' its --geometry"))
        if not rows and not bad:
            return document.data_card(["no data from the testbed"], "", "none"), rows
        problems = [words.removeprefix(f"estimator: {CHECK}") for _, words in sorted(bad)[::-1]]
        return document.data_card(problems, f"all {len(rows)} nodes report OK"), rows

    def _recording(self) -> document.Document:
        """The trial being recorded, and the free space."""
        announced, since = self._trial
        trial = base.recorded_trial(self._node, announced)
        now = clocks.monotonic()
        recorder, arrival = self._sensors.get(f"{self._prefix}recorder_node", (None, now))
        words = f"recording {trial}" if trial else "nothing is being recorded"
        if recorder is not None:
            figures = base.reported_values(recorder)
            elapsed = base.reported_number(figures, base.ELAPSED) + now - max(arrival, since)
            if trial and 0.0 <= elapsed < _LONGEST:
                words += f" for {duration_text(elapsed)}"
            free = base.reported_number(figures, base.FREE)
            if math.isfinite(free):
                words += f", {1e-9 * free:.1f} GB free"
        return {"on": bool(trial), "words": words}

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        """Note the state of each node of this testbed, and the rate of its count [Hz]."""
        now = clocks.monotonic()
        for status in message.status:
            # Another testbed may run in another namespace.
            if status.name.rpartition("/")[0] + "/" != self._prefix or status.name == self._own:
                continue
            self._sensors[status.name] = status, now
            values = base.reported_values(status)
            counts = (base.reported_number(values, key) for key in base.COUNTS)
            count = next(filter(math.isfinite, counts), math.nan)
            before, since, _ = self._rates.setdefault(status.name, (count, now, math.nan))
            if count < before:  # it was restarted
                self._rates[status.name] = count, now, math.nan
            elif now - since > 0.5:
                self._rates[status.name] = count, now, (count - before) / (now - since)

    def _on_trial(self, message: String) -> None:
        """Note the name of the trial being recorded (empty if none) and when it came [s]."""
        self._trial = message.data, clocks.monotonic()
