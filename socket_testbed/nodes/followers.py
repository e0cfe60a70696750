"""Nodes that a trigger or a replay waits for."""

from __future__ import annotations

import re
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray

from socket_testbed.nodes.base import (
    HEARS,
    LINKS,
    NEWEST_STAMP,
    WAITING_FOR,
    TestbedNode,
    reported_values,
)
from socket_testbed.wire.topics import DIAGNOSTICS, full_name

_POLL_INTERVAL = 0.02  # [s]
_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")  # ROS raises an error for any other
_MAX_DIGITS = 19  # of a stamp [ns]
_SILENT = {WAITING_FOR: "", LINKS: "", HEARS: ""}  # another program's diagnostics lack these


class Followers:
    """Nodes that a trigger or a replay waits for: linked at the start, never left far behind.

    Their state comes from their diagnostics. Subscribes: /diagnostics.

    Args:
        node: The node that waits.
        names: Names of the nodes, relative to the waiting node's namespace or absolute.
        stopped: Called repeatedly; waiting ends once it returns true.
    """

    def __init__(
        self, node: TestbedNode[Any], names: tuple[str, ...], stopped: Callable[[], bool]
    ) -> None:
        namespace = node.get_namespace()
        unseen = _SILENT | {WAITING_FOR: "not seen"}
        # values of their newest diagnostics, by key
        self._reports = {full_name(name, namespace): unseen for name in names}
        self._newest: dict[str, int] = {}
        self._sent: deque[int] = deque()
        self._stopped = stopped
        self._news = threading.Condition()
        self._node = node
        node.listen(DIAGNOSTICS, self._on_diagnostics, needed=False)

    def __len__(self) -> int:
        return len(self._reports)

    def await_links(self, patience: float) -> str:
        """Wait for some time [s] until all publishers and subscribers have discovered each other.

        A publisher may not have discovered a subscriber that other nodes, or the subscriber itself,
        know of; its messages would be lost.

        Returns:
            What is not linked in time, in words; empty if all is linked or the wait was stopped.
        """

        def linked() -> bool:
            reports = self._reports.values()
            heard = Counter(name for report in reports for name in report[HEARS].split())
            own = [(name, known, count) for name, (known, count) in self._node.links().items()]
            links = [link for report in reports for link in _links(report)]
            theirs = [(name, known, self._node.count_subscribers(name)) for name, known in links]
            found = all(known >= max(heard[name], count) for name, known, count in own + theirs)
            return found and not any(report[WAITING_FOR] for report in reports)

        if self.wait(linked, patience) or self._stopped():
            return ""
        lacking = {name: report[WAITING_FOR] for name, report in self._reports.items()}
        waiting = [f"{name} ({what})" for name, what in lacking.items() if what]
        return ", ".join(waiting) or "subscribers"

    def sent(self, stamp: int) -> None:
        """Note that a sample with this stamp since the epoch [ns] was sent to them."""
        self._sent.append(stamp)

    def start_over(self) -> None:
        """Forget their progress, because time jumps back."""
        with self._news:
            self._newest = dict.fromkeys(self._newest, 0)
            self._sent.clear()

    def wait(self, condition: Callable[[], bool], duration: float) -> bool:
        """Wait until a condition holds; returns whether it does.

        Args:
            condition: Called repeatedly, and on every news of a follower.
            duration: Longest wait, in real time [s].
        """
        deadline = time.monotonic() + duration
        with self._news:
            while not condition():
                left = deadline - time.monotonic()
                if left <= 0.0 or self._stopped():
                    return False
                self._news.wait(min(left, _POLL_INTERVAL))
        return True

    def catch_up(self, behind: int, patience: float) -> int:
        """Wait until the slowest follower has nearly caught up.

        Args:
            behind: Number of samples that it may be behind.
            patience: Longest standstill, in real time [s].

        Returns:
            The number of samples that it is still behind after a standstill; 0 if it caught up or
            the wait was stopped.
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
        """Note the links and the newest stamp [ns] that the followers report."""
        for status in message.status:
            if status.name not in self._reports:
                continue
            values = _SILENT | reported_values(status)
            with self._news:
                self._reports[status.name] = values
                if (newest := _whole(values.get(NEWEST_STAMP, ""))) is not None:
                    self._newest[status.name] = newest
                self._news.notify_all()


def _links(report: Mapping[str, str]) -> Iterator[tuple[str, int]]:
    """Topic and number of matched subscribers of each link that a node reports."""
    for link in report[LINKS].split():
        name, _, number = link.partition("=")
        if _NAME.fullmatch(name) and (known := _whole(number)) is not None:
            yield name, known


def _whole(text: str) -> int | None:
    """A whole number [1, ns] up to 2^63; None for any other text."""
    return int(text) if text.isascii() and text.isdigit() and len(text) <= _MAX_DIGITS else None
