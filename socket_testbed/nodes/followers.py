"""Nodes that a trigger or a replay waits for."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from functools import partial
from itertools import chain
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray

from socket_testbed.nodes.base import HEARS, LINKS, NEWEST_STAMP, WAITING_FOR, TestbedNode
from socket_testbed.trials.topics import DIAGNOSTICS, full_name

_POLL_INTERVAL = 0.02  # [s]


class Followers:
    """Nodes that a trigger or a replay waits for: linked at the start, never left far behind.

    Their state comes from their diagnostics. Their names are relative to the waiting node's
    namespace or absolute; waiting ends once `stopped` returns true.
    """

    def __init__(
        self, node: TestbedNode[Any], names: tuple[str, ...], stopped: Callable[[], bool]
    ) -> None:
        namespace = node.get_namespace()
        self._waiting = {full_name(name, namespace): "not seen" for name in names}
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

    def await_links(self, patience: float) -> str:
        """Wait until all publishers and subscribers have discovered each other.

        A publisher may not have discovered a subscriber that other nodes, or the subscriber itself,
        know of; its messages would be lost. Returns what is not linked in time, or "".
        """

        def linked() -> bool:
            heard = Counter(chain.from_iterable(self._hears.values()))
            own = [(name, known, count) for name, (known, count) in self._node.links().items()]
            theirs = [
                (name, known, self._node.count_subscribers(name))
                for links in self._links.values()
                for name, known in links.items()
            ]
            found = all(known >= max(heard[name], count) for name, known, count in own + theirs)
            return found and not any(self._waiting.values())

        if self.wait(linked, patience) or self._stopped():
            return ""
        waiting = [f"{name} ({what})" for name, what in self._waiting.items() if what]
        return ", ".join(waiting) or "subscribers"

    def sent(self, stamp: int) -> None:
        """Note that a sample with this stamp [ns] was sent to them."""
        self._sent.append(stamp)

    def start_over(self) -> None:
        """Forget their progress, because time jumps back."""
        with self._news:
            self._newest = dict.fromkeys(self._newest, 0)
            self._sent.clear()

    def wait(self, condition: Callable[[], bool], duration: float) -> bool:
        """Wait until a condition holds, at most a duration [s]; returns whether it does."""
        deadline = time.monotonic() + duration
        with self._news:
            while not condition():
                left = deadline - time.monotonic()
                if left <= 0.0 or self._stopped():
                    return False
                self._news.wait(min(left, _POLL_INTERVAL))
        return True

    def catch_up(self, behind: int, patience: float) -> int:
        """Wait until they are at most `behind` samples behind; `patience` limits a standstill [s].

        Returns the number of samples they are still behind, 0 if they caught up.
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
            if status.name not in self._waiting:
                continue
            values = {entry.key: entry.value for entry in status.values}
            links = (link.split("=") for link in values.get(LINKS, "").split())
            with self._news:
                self._waiting[status.name] = values.get(WAITING_FOR, "")
                self._hears[status.name] = values.get(HEARS, "").split()
                self._links[status.name] = {topic: int(count) for topic, count in links}
                if NEWEST_STAMP in values:
                    self._newest[status.name] = int(values[NEWEST_STAMP])
                self._news.notify_all()
