"""A testbed that was registered and tared wrong, recorded by its nodes and repaired later."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from std_srvs.srv import Trigger as TriggerService
from support.bags import pose_vector, wrench_vector
from support.graph import Probe
from support.testbeds import Recorded, manageable

from socket_testbed.files import packaged
from socket_testbed.geometry.marker_bodies import fit_body
from socket_testbed.geometry.socket import read_socket, write_socket
from socket_testbed.live.bringup import Simulation, end, simulate_hardware, simulated_testbed
from socket_testbed.live.processes import Graph
from socket_testbed.settings.testbed import ReplaySettings
from socket_testbed.trials.layout import stamp_of
from socket_testbed.trials.topics import LOAD_CELL_RAW, SOCKET_POSE, WRENCH
from socket_testbed.trials.trial import Trial

pytestmark = pytest.mark.graph
RIGHT = packaged("config", "socket.yaml")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """With a marker of the socket 5 mm off in socket.yaml, and tared with the pylon on the cell."""
    folder = tmp_path_factory.mktemp("wrong")
    geometry = read_socket(RIGHT)
    markers = geometry.socket_markers.copy()
    markers[1, 0] += 0.005
    write_socket(dataclasses.replace(geometry, socket_markers=markers), folder / "wrong.yaml")
    simulation = manageable(Simulation("static_hold", 1800.0), 20.0)
    right = simulated_testbed(folder / "trial", 20.0, simulation)
    with Probe() as probe, Graph() as graph:
        raws = probe.listen(LOAD_CELL_RAW)
        testbed, _ = simulate_hardware(graph, right, simulation)
        testbed = dataclasses.replace(testbed, geometry=folder / "wrong.yaml")
        graph.start_nodes(testbed.nodes(graph.folder))
        probe.wait(lambda: len(raws) > 20, "the first samples")
        request = TriggerService.Request()
        refusal = probe.call(TriggerService, "load_cell/tare", request)
        assert not refusal.success and "trial is being recorded" in refusal.message
        forced = "load_cell/force_tare"
        probe.wait(lambda: probe.call(TriggerService, forced, request).success, "a tare")
        probe.wait(lambda: raws[-1].tared.sec > 0, "wrenches with the tare")
        tared = len(raws)
        probe.wait(lambda: len(raws) > tared + 40, "more of them")
        end(graph, testbed)
    yield folder / "trial"


def test_wrenches_and_poses_are_repaired_and_replayed_so(recorded: Path) -> None:
    wrong = Trial(recorded).measurements()
    assert np.isnan(wrong.socket).all()  # no pose fits the markers of the wrong file
    assert np.nanmax(np.abs(wrong.wrench[-20:, 5])) < 5.0  # the pylon's 91 N are gone
    (tare,) = [event.label for event in Trial(recorded).events() if event.source == "recorded"]
    assert tare.startswith("tare removed Mx ") and "Fz" in tare
    found = Trial(recorded, RIGHT, tare="none").measurements()
    oracle = Recorded(recorded)
    markers = read_socket(RIGHT).socket_markers
    felt = {stamp for stamp, _ in oracle.known(WRENCH.name)}
    for stamp, wrench, socket in zip(found.stamps, found.wrench, found.socket, strict=True):
        if stamp not in felt:
            continue
        if np.isfinite(wrench).all():
            off = np.abs(wrench - oracle.averaged("wrench", stamp))
            assert (off < np.repeat([0.1, 0.9], 3)).all()
        if np.isfinite(socket).all():
            seen = fit_body(markers, oracle.felt("markers", stamp)[0][None]).pose
            assert np.linalg.norm(socket[:3] - seen.translation[0]) < 6e-4
            assert abs(socket[3:] @ seen.quaternion()[0]) > 1.0 - 1e-5
    # A busy machine may be late for some frames: whoever has all its markers has a pose.
    whole = np.isfinite(found.markers["socket"][:, : len(markers)]).all(axis=(1, 2))
    assert whole.sum() > 10 and np.isfinite(found.socket[whole]).all()

    rows = {stamp: row for row, stamp in enumerate(found.stamps.tolist())}
    replay = ReplaySettings(trial=str(recorded), rate=2.0, geometry=str(RIGHT), tare="none")
    with Probe() as probe, Graph() as graph:
        # Discovery may outlast the first messages; a recording may end within a sample.
        heard = {topic: probe.listen(topic) for topic in (WRENCH, SOCKET_POSE)}
        graph.start("replay_node", replay)
        for topic, messages in heard.items():
            last = max(oracle.stamps(topic.name))
            probe.wait(
                lambda m=messages, last=last: bool(m) and stamp_of(m[-1]) == last, "the last sample"
            )
    for topic, vector, numbers in (
        (WRENCH, lambda message: wrench_vector(message.wrench), found.wrench),
        (SOCKET_POSE, lambda message: pose_vector(message.pose), found.socket),
    ):
        order = [rows[stamp_of(message)] for message in heard[topic]]
        np.testing.assert_array_equal([vector(m) for m in heard[topic]], numbers[order])
