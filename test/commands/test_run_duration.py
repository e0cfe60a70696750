"""When `run --duration` ends: after that testbed time from the first trigger, by a fake clock."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from socket_testbed.__main__ import run
from socket_testbed.commands import live

START = 100.0  # [s] on the clock


class Clock:
    """A clock that each look at the graph moves on by a second."""

    def __init__(self) -> None:
        self.now = START

    def monotonic(self) -> float:
        return self.now


class Status:
    """The status of a graph whose first trigger comes after some seconds."""

    output = None
    seconds = 0.0
    clock: Clock

    def __init__(self, disk: Path | None = None) -> None:
        del disk

    def __enter__(self) -> "Status":
        return self

    def __exit__(self, *error: object) -> None: ...

    def renew(self) -> None: ...

    def say(self, line: str) -> None: ...

    def follow(self, namespace: str, absent: object = ()) -> None: ...

    @property
    def triggered(self) -> bool:
        return self.clock.now >= START + self.seconds


class Graph:
    """A graph that is watched once a second until it is over, at most 1000 s."""

    clock: Clock

    def __init__(self, output: Any, renew: Any) -> None: ...

    def __enter__(self) -> "Graph":
        return self

    def __exit__(self, *error: object) -> None: ...

    def watch(self, over: Any, say: Any) -> None:
        while not over() and self.clock.now < START + 1000.0:
            self.clock.now += 1.0


@pytest.mark.parametrize(
    ("words", "first", "ends"),
    [
        (["--time-scale", "1"], 5.0, 15.0),
        (["--time-scale", "0.5"], 5.0, 25.0),
        (["--time-scale", "0.1"], 0.0, 100.0),
        # without a trigger: 60 s until nodes must be ready, 30 s more
        (["--time-scale", "0.5"], 2000.0, 110.0),
    ],
    ids=["real time", "half", "a tenth", "no trigger"],
)
def test_a_duration_is_testbed_time(
    words: list[str], first: float, ends: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    clock = Clock()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Status, "clock", clock, raising=False)
    monkeypatch.setattr(Status, "seconds", first)
    monkeypatch.setattr(Graph, "clock", clock, raising=False)
    fakes = {"time": clock, "StatusLine": Status, "Graph": Graph}
    for name, fake in fakes.items():
        monkeypatch.setattr(live, name, fake)
    monkeypatch.setattr(live.bringup, "start", lambda graph, testbed: SimpleNamespace())
    monkeypatch.setattr(live.bringup, "end", lambda graph, testbed: None)
    assert run(["run", "--simulated", "--duration", "10", *words]) == 0
    assert clock.now - START == ends
