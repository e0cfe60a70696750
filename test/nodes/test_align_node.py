"""Topics of other drivers in the real graph: best effort and reliable, with clocks of their own."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from std_srvs.srv import Trigger as TriggerService
from support.foreign import CAPACITANCES, LIMB, SOCKET, WRENCH, simulate_foreign
from support.graph import Probe
from support.player import Player
from support.verbs import COMMAND, program

import socket_testbed as st
from socket_testbed.live import bringup
from socket_testbed.live.doctor import judge_sources
from socket_testbed.live.processes import Graph
from socket_testbed.nodes.foreign_topics import hear_sources
from socket_testbed.settings.acquisition import TriggerSettings
from socket_testbed.settings.alignment import (
    AlignSettings,
    LiveClusterSettings,
    LiveSourceSettings,
    LiveWrenchSettings,
)
from socket_testbed.settings.testbed import EstimatorSettings, TestbedSettings
from socket_testbed.trials.trial import Trial
from socket_testbed.wire import topics
from socket_testbed.wire.cdr import stamp_of

pytestmark = pytest.mark.graph

ALIGN = AlignSettings(
    wrench=LiveWrenchSettings(topic=WRENCH, delay=0.02),
    socket_pose=LiveSourceSettings(topic=SOCKET),
    pylon_pose=LiveSourceSettings(topic=LIMB),
    clusters=LiveClusterSettings(topic=CAPACITANCES),
)
RATE = 20.0  # [Hz]; of the trigger
ENOUGH = 100  # triggers with all sources


@dataclass
class Lab:
    """What a testbed without any driver of its own measured, and said.

    Attributes:
        trial: The recorded trial.
        nodes: The nodes that ran.
        said: What the align node said of its sources, in order.
        figures: The figures of its diagnostics while all sources were there.
        refused: Its answer to a tare while the trial was recorded.
        after: Stamps of the poses after the wrench had stopped, with a value [ns].
    """

    trial: Path
    nodes: list[str] = field(default_factory=list)
    said: list[str] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)
    refused: str = ""
    after: list[int] = field(default_factory=list)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("foreign") / "bag"
    simulate_foreign(path, "multi_direction", duration=15.0)
    return path


@pytest.fixture(scope="module")
def lab(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    settings = replace(
        TestbedSettings(),
        trigger_node=TriggerSettings(source="timer", rate=RATE),
        align_node=ALIGN,
        estimator_node=EstimatorSettings(auto_fit=False),
    )
    testbed = bringup.Testbed(settings, record=tmp_path_factory.mktemp("live") / "trial")
    assert testbed.record is not None
    lab = Lab(testbed.record)
    with Probe() as probe, Player(probe, bag) as player, Graph() as graph:
        wrenches, poses = probe.listen(topics.WRENCH), probe.listen(topics.PYLON_POSE)
        probe.said("align_node")
        bringup.start(graph, testbed)
        lab.nodes = [node.name for node in testbed.nodes(graph.folder)]

        def full() -> bool:
            return sum(np.isfinite(m.wrench.force.z) for m in wrenches) > ENOUGH

        probe.wait(full, "wrenches")
        lab.figures = {key: probe.figure("align_node", key) for key in ("wrench_rate",)}
        answer = probe.call(TriggerService, "load_cell/tare", TriggerService.Request())
        lab.refused = answer.message
        player.stopped.add(WRENCH)
        probe.wait(lambda: bool(probe.said("align_node", "is silent")), "a silent wrench")
        begin = len(poses)
        probe.wait(lambda: len(poses) > begin + 20, "poses after it")
        lab.after = [stamp_of(m) for m in poses[begin:] if np.isfinite(m.pose.position.x)]
        assert np.isnan(wrenches[-1].wrench.force.z)
        lab.said = [status.message for status in probe.said("align_node")]
        bringup.end(graph, testbed)
    yield lab


def test_only_the_nodes_that_are_needed_run(lab: Lab) -> None:
    assert lab.nodes == [
        *("recorder_node", "trigger_node", "align_node", "calibration_node", "estimator_node")
    ]


def test_a_source_that_stops_is_named_and_others_go_on(lab: Lab) -> None:
    # On a busy machine another source may be silent for a moment as well.
    assert any(said.startswith(f"wrench: {WRENCH} is silent for ") for said in lab.said)
    assert len(lab.after) > 15


def test_the_diagnostics_give_the_rate(lab: Lab) -> None:
    assert lab.figures["wrench_rate"] == pytest.approx(500.0, rel=0.1)


def test_a_recorded_trial_refuses_the_tare(lab: Lab) -> None:
    assert lab.refused.startswith("cannot tare: the trial trial is being recorded: ")


def test_the_trial_holds_what_came_in(lab: Lab) -> None:
    with Trial(lab.trial).open() as bag:
        for name in (WRENCH, SOCKET, LIMB):
            assert bag.counts[name] > 4 * ENOUGH
        assert bag.counts[CAPACITANCES] > 0.8 * ENOUGH


def test_live_values_are_those_of_an_import(lab: Lab, tmp_path: Path) -> None:
    """But for the messages that one of them did not get: best effort, on a busy machine."""
    imported = st.import_trial(
        lab.trial, tmp_path / "imported", wrench=WRENCH, socket_pose=SOCKET, pylon_pose=LIMB,
        clusters=CAPACITANCES, names=TestbedSettings().cluster_node.names, trigger="/trigger",
        delay={"wrench": 0.02}, notify=lambda note: None,
    ).measurements()  # fmt: skip
    live = Trial(lab.trial, notify=lambda note: None).measurements()
    np.testing.assert_array_equal(live.stamps, imported.stamps)
    for name in ("wrench", "socket", "pylon"):
        ours, theirs = getattr(live, name), getattr(imported, name)
        known = np.isfinite(ours).all(axis=1) & np.isfinite(theirs).all(axis=1)
        assert known.sum() > 0.9 * ENOUGH
        same = np.isclose(ours[known], theirs[known], rtol=1e-9, atol=1e-12).all(axis=1)
        assert same.mean() > 0.5, name  # with another delay hardly any is


def test_a_fit_reads_the_trial(lab: Lab, tmp_path: Path) -> None:
    model = tmp_path / "model.json"
    code, _, error = program(*COMMAND, "fit", lab.trial, "--segment", "all", "-o", model)
    assert code == 0, error
    assert json.loads(model.read_text())


def test_doctor_hears_each_source(bag: Path) -> None:
    """Capacitances trigger, by their arrival, and a microcontroller is silent."""
    settings = replace(
        TestbedSettings(),
        trigger_node=TriggerSettings(source="topic", topic=CAPACITANCES),
        align_node=replace(ALIGN, clusters=LiveClusterSettings(topic="/nobody")),
    )
    with Probe() as probe, Player(probe, bag):
        heard = hear_sources(settings.align_node, CAPACITANCES, settings.cluster_names)
    trigger, wrench, socket, _, clusters = judge_sources(bringup.Testbed(settings), heard)
    assert trigger.what == "trigger" and not trigger.hint
    assert trigger.found.startswith(f"{CAPACITANCES}: std_msgs/msg/Float64MultiArray, ")
    assert trigger.found.endswith(" Hz, without stamps: the times of arrival count")
    assert wrench.found.startswith(f"{WRENCH}: geometry_msgs/msg/WrenchStamped, ")
    assert "frame ft_sensor, taken as {S}" in wrench.found and not wrench.hint
    assert " ms from stamp to arrival, newest " in socket.found and not socket.hint
    assert clusters.found == "nothing arrives on /nobody"
    assert clusters.hint.startswith("start its driver")
