"""A simulated testbed as users run it, watched over, and an oracle for what it recorded."""

import dataclasses
import math
import os
import re
import signal
import threading
from pathlib import Path
from typing import Any, Self

import numpy as np
import yaml
from scipy.interpolate import make_interp_spline

from socket_testbed.files import packaged
from socket_testbed.geometry.marker_bodies import fit_body
from socket_testbed.live.bringup import Testbed, end, simulated_testbed, start
from socket_testbed.live.processes import Graph
from socket_testbed.live.scheduling import busy_note
from socket_testbed.simulation.testbed import Simulation
from socket_testbed.trials.trial import Trial
from socket_testbed.trials.truth import TRUTH_FILE
from socket_testbed.wire import topics
from socket_testbed.wire.messages import Reader
from support.clocks import careful_time_scale
from support.graph import Probe

LEVELS = ("OK", "WARN", "ERROR")
MEASURED = (*(topic for topic in topics.REQUIRED if topic is not topics.TRIGGER), topics.MARKERS)

# Everything changes fast, all the time: an old value is a wrong one, and no noise hides it.
MOVING = Simulation("multi_direction", period=40.0, seed=2, pace=6.0, sway=0.05, noise=0.1)


_RATE = 20.0  # [Hz]; of the trigger


def manageable(simulation: Simulation) -> Simulation:
    """A simulation, as slow as this machine and the tests side by side need at present."""
    scale = careful_time_scale()
    if "PYTEST_XDIST_WORKER" in os.environ:
        scale = min(scale, 0.5)
    print(busy_note(scale) or "the simulated testbed runs in real time")
    return dataclasses.replace(simulation, time_scale=scale)


def simulated_parameters(folder: Path, **nodes: dict[str, object]) -> Path:
    """A testbed.yaml of simulated hardware, with parameters of some nodes changed."""
    parameters = yaml.safe_load(packaged("config", "simulated.yaml").read_text())
    for node, changed in nodes.items():
        parameters.setdefault(node, {}).setdefault("ros__parameters", {}).update(changed)
    (folder / "testbed.yaml").write_text(yaml.safe_dump(parameters))
    return folder / "testbed.yaml"


class LiveTestbed:
    """The graph in processes of its own, kept running, with a probe beside it.

    It runs as fast as the machine manages; rates, periods and stamps are in testbed time.
    """

    def __init__(self, record: Path, simulation=MOVING, one_process=False) -> None:
        testbed = simulated_testbed(record, _RATE, manageable(simulation))
        self.testbed: Testbed = dataclasses.replace(testbed, one_process=one_process)
        self.restarts: list[str] = []
        self._ended = threading.Event()

    def __enter__(self) -> Self:
        self.probe = Probe().__enter__()
        self.triggers, self.wrenches = map(self.probe.listen, (topics.TRIGGER, topics.WRENCH))
        self.graph = Graph().__enter__()
        world = start(self.graph, self.testbed)
        assert world is not None
        self.switch = world.faults.switch
        self._thread = threading.Thread(
            target=self.graph.watch, args=(self._ended.is_set, self.restarts.append)
        )
        self._thread.start()
        self.probe.wait(lambda: len(self.wrenches) > 5, "the first samples")
        for node in ("trigger_node", "cluster_node", "load_cell_node", "mocap_node"):
            self.wait_for(node, "OK")
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        end(self.graph, self.testbed)
        self.graph.__exit__()
        self.probe.__exit__()

    def wait_for(self, node: str, level: str, text: str = "", since: int = -1) -> None:
        """Wait until a node's newest diagnostics, or one since so many, have a level and a text."""

        def matches() -> bool:
            return any(
                re.fullmatch(level, LEVELS[said.level[0]]) and re.search(text, said.message)
                for said in self.probe.said(node)[since:]
            )

        self.probe.wait(matches, f"{node} {level} '{text}'")

    def wait_for_triggers(self, count: int) -> None:
        goal = len(self.triggers) + count
        self.probe.wait(lambda: len(self.triggers) >= goal, f"{count} triggers")

    def kill(self, node: str) -> None:
        """Kill a node's process, and wait until it was started again."""
        restarts = len(self.restarts)
        self.graph._members[node].process.send_signal(signal.SIGKILL)
        self.probe.wait(lambda: len(self.restarts) > restarts, f"{node} started again")
        assert self.restarts[-1] == f"{node} was ended by SIGKILL: started again"


class Recorded:
    """What a trial of the simulated testbed holds, by topic and stamp."""

    def __init__(self, path: Path, truth: Path | None = None) -> None:
        self._values: dict[str, dict[int, Any]] = {t.name: {} for t in (topics.TRIGGER, *MEASURED)}
        readers = {topic.name: Reader(topic) for topic in (topics.TRIGGER, *MEASURED)}
        with Trial(path).open() as bag:
            self.notes = bag.notes
            for raw in bag.messages([f"/{name}" for name in readers]):
                name = raw.topic.lstrip("/")
                stamp, values = readers[name].read(raw.data)
                assert stamp not in self._values[name], f"{name}: a stamp came twice"
                self._values[name][stamp] = values
        with np.load((truth or path) / TRUTH_FILE) as data:
            self._truth = dict(data)
        self._geometry = Trial(path).geometry
        intervals = np.diff(sorted(self.stamps(topics.TRIGGER.name)))
        # What poses and wrenches are averaged over: the trigger's period, at most 0.25 s [ns].
        self._around = min(float(np.median(intervals)), 0.25e9) * np.linspace(-0.5, 0.5, 11)

    def stamps(self, topic: str) -> set[int]:
        return set(self._values[topic])

    def lacking(self, until: float = math.inf) -> dict[str, int]:
        """How many triggers each measured topic lacks, up to a stamp [ns]."""
        triggers = {stamp for stamp in self.stamps(topics.TRIGGER.name) if stamp <= until}
        return {t.name: len(triggers - self.stamps(t.name)) for t in MEASURED}

    def felt(self, name: str, stamp: int, around: Any = 0.0) -> np.ndarray:
        """What the sensors felt around a stamp [ns], linear between the simulation's steps."""
        times = 1e-9 * (self._truth["stamps"] - stamp)
        near = slice(*np.searchsorted(times, [-3.0, 3.0]))
        felt = self._truth[f"felt_{name}"][near]
        return make_interp_spline(times[near], felt, k=1, check_finite=False)(1e-9 * around)

    def known(self, topic: topics.Topic) -> list[tuple[int, Any]]:
        """Values of a topic, but for those around which a busy machine held the world up."""
        # A state must be there before its forerunner's time is over: 40 ms ahead of its own.
        late = self._truth["lateness"] > -0.045
        at, lateness = self._truth["stamps"][late], self._truth["lateness"][late]
        begin, end = at - 0.06e9, at + 1e9 * np.maximum(lateness, 0.0) + 0.03e9
        return [
            (stamp, values)
            for stamp, values in self._values[topic.name].items()
            if not ((begin < stamp) & (stamp < end)).any()
        ]

    def check_values(self) -> dict[str, int]:
        """Assert that no value is wrong; returns how many there are of each topic.

        A value is wrong if it is not what the sensor felt at its trigger: the clusters from
        two cycles of their converters before to 50 ms after, markers at the very time, wrenches
        and poses on average around it, or at the very time where much around it is missing.
        """
        counts = dict.fromkeys((t.name for t in MEASURED), 0)
        for stamp, wrench in self.known(topics.WRENCH):
            around = self.felt("wrench", stamp, self._around)
            ends = around.mean(axis=0), self.felt("wrench", stamp)
            off = np.abs(wrench - np.clip(wrench, np.minimum(*ends), np.maximum(*ends)))
            assert np.isnan(off).all() or (off < np.repeat([0.1, 0.9], 3)).all(), (stamp, off)
            counts[topics.WRENCH.name] += bool(np.isfinite(off).all())
        for stamp, (_, values, status) in self.known(topics.CAPACITANCE):
            felt = self.felt("capacitance", stamp, np.linspace(-0.03e9, 0.055e9, 12))
            fine = status == 0
            assert (np.isfinite(values) == fine).all()
            within = (values > felt.min(axis=0) - 0.012) & (values < felt.max(axis=0) + 0.012)
            assert within[fine].all(), (stamp, values, felt)
            counts[topics.CAPACITANCE.name] += int(fine.sum())
        for k, (body, topic) in enumerate(topics.POSES.items()):
            triad = self._geometry.markers[body]
            for stamp, pose in self.known(topic):
                if not np.isfinite(pose).all():
                    assert np.isnan(pose).all()
                    continue
                markers = self.felt("markers", stamp, self._around).mean(axis=0)[k]
                true = fit_body(triad, markers[None]).pose
                turn = abs(pose[3:] @ true.quaternion()[0])
                assert np.linalg.norm(pose[:3] - true.translation[0]) < 6e-4, stamp
                assert 2.0 * np.arccos(min(turn, 1.0)) < 0.01, stamp
                counts[topic.name] += 1
        for stamp, bodies in self.known(topics.MARKERS):
            for (name, seen), true in zip(bodies, self.felt("markers", stamp), strict=True):
                off = np.linalg.norm(seen - true, axis=1)
                assert (np.isnan(off) | (off < 6e-4)).all(), (stamp, name, off)
                counts[topics.MARKERS.name] += int(np.isfinite(off).sum())
        return counts
