"""The nodes that a trigger or a replay waits for: linked at its start, never left far behind."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from functools import partial
from itertools import chain
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.publisher import Publisher

from socket_testbed.nodes.base import HEARS, LINKS, NEWEST_STAMP, WAITING_FOR, TestbedNode
from socket_testbed.trials.topics import DIAGNOSTICS

_POLL = 0.02  # [s]


class Followers:
    """Nodes that another waits for, by what their diagnostics report.

    Their names are in the waiting node's namespace or absolute; `stopped` says whether waiting has
    become pointless.
    """

    def __init__(
        self, node: TestbedNode[Any], names: tuple[str, ...], stopped: Callable[[], bool]
    ) -> None:
        namespace = node.get_namespace().rstrip("/")
        full = (name if name.startswith("/") else f"{namespace}/{name}" for name in names)
        self._waiting = dict.fromkeys(full, "not seen")
        self._links: dict[str, dict[str, int]] = {}
        self._hears: dict[str, list[str]] = {}
        self._newest: dict[str, int] = {}
        self._sent: deque[int] = deque()
        self._stopped = stopped
        self._news = threading.Condition()
        self._node = node
        node.listen(DIAGNOSTICS, self._on_diagnostics, needed=False)

    def __len__(self) -> int:
        return len(self._waiting)

    def await_links(
        self, publishers: Mapping[str, Publisher], needed: frozenset[str], patience: float
    ) -> str:
        """Wait until all that publish and subscribe have found each other.

        A node may not know yet of a subscriber that another knows of, or of one that says so
        itself, and would publish past it. Of the waiting node's own publishers, by topic, those
        needed are linked only with a subscriber. Returns what is not linked in time, if anything.
        """

        def linked() -> bool:
            heard = Counter(chain.from_iterable(self._hears.values()))

            def count(topic: str) -> int:
                return max(heard[topic], self._node.count_subscribers(topic))

            return (
                all(
                    publisher.get_subscription_count() >= max(count(name), name in needed)
                    for name, publisher in publishers.items()
                )
                and not any(self._waiting.values())
                and all(
                    known >= count(topic)
                    for links in self._links.values()
                    for topic, known in links.items()
                )
            )

        if self.wait(linked, patience) or self._stopped():
            return ""
        waiting = [f"{name} ({what})" for name, what in self._waiting.items() if what]
        return ", ".join(waiting) or "subscribers"

    def sent(self, stamp: int) -> None:
        """A sample with this stamp [ns] was sent to them."""
        self._sent.append(stamp)

    def start_over(self) -> None:
        """Time jumps back: what they had worked off says nothing any more."""
        with self._news:
            self._newest = dict.fromkeys(self._newest, 0)
            self._sent.clear()

    def wait(self, condition: Callable[[], bool], duration: float) -> bool:
        """Wait until a condition holds; returns whether it does after a duration [s]."""
        deadline = time.monotonic() + duration
        with self._news:
            while not condition():
                left = deadline - time.monotonic()
                if left <= 0.0 or self._stopped():
                    return False
                self._news.wait(min(left, _POLL))
        return True

    def catch_up(self, behind: int, patience: float) -> int:
        """Wait until they are at most so many samples behind, while there is progress in time.

        Returns how many samples they are still behind, 0 if they caught up.
        """
        while self._newest and len(self._sent) > behind:
            before = len(self._sent)
            if not self.wait(partial(self._fewer_left_than, before), patience):
                self._sent.clear()
                return 0 if self._stopped() else before
        return 0

    def _fewer_left_than(self, count: int) -> bool:
        slowest = min(self._newest.values())
        while self._sent and self._sent[0] <= slowest:
            self._sent.popleft()
        return len(self._sent) < count

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name in self._waiting:
                values = {entry.key: entry.value for entry in status.values}
                with self._news:
                    self._waiting[status.name] = values.get(WAITING_FOR, "")
                    self._hears[status.name] = values.get(HEARS, "").split()
                    links = (link.split("=") for link in values.get(LINKS, "").split())
                    self._links[status.name] = {topic: int(count) for topic, count in links}
                    if NEWEST_STAMP in values:
                        self._newest[status.name] = int(values[NEWEST_STAMP])
                    self._news.notify_all()
