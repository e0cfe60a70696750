"""The acquisition nodes one by one: services, parameters, and what Motive gets from them."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from std_msgs.msg import String
from std_srvs.srv import SetBool
from std_srvs.srv import Trigger as TriggerService
from support.graph import Probe
from support.testbeds import LiveTestbed

from socket_testbed.live.processes import Graph
from socket_testbed.live.simulated_world import Simulation
from socket_testbed.settings.acquisition import MocapSettings
from socket_testbed.settings.testbed import RecorderSettings
from socket_testbed.simulation.devices.natnet_server import NatNetServer
from socket_testbed.trials.topics import DIAGNOSTICS, RECORDED_TRIAL

pytestmark = pytest.mark.graph


def test_motive_records_while_the_recorder_does(tmp_path: Path) -> None:
    server = NatNetServer(lambda _: [])
    settings = MocapSettings(server=server.address[0], command_port=server.address[1])
    try:
        with Probe() as probe, Graph() as graph:
            graph.start("mocap_node", settings)
            graph.start("recorder_node", RecorderSettings(directory=str(tmp_path)))
            request = SetBool.Request(data=True)
            answer = probe.call(SetBool, "recorder/record", request)
            name = answer.message.rpartition("/")[2]
            probe.wait(lambda: server.recording, "a take")
            assert server.takes == [name]
            probe.call(SetBool, "recorder/record", SetBool.Request(data=False))
            probe.wait(lambda: not server.recording, "the end of the take")
            # Any program of the network may name the trial that is recorded.
            status = probe.listen(DIAGNOSTICS)
            probe.publisher(RECORDED_TRIAL).publish(String(data="x,StopRecording\n../y"))
            probe.wait(
                lambda: any(
                    "cannot be that of a take" in s.message for m in status for s in m.status
                ),
                "the refusal",
            )
            assert server.takes == [name] and not server.recording
    finally:
        server.close()


@pytest.fixture(scope="module")
def live() -> Iterator[LiveTestbed]:
    """A testbed with the pylon alone for minutes."""
    with LiveTestbed(simulation=Simulation("static_hold", 1800.0)) as live:
        yield live


def test_the_trigger_is_enabled_and_disabled(live: LiveTestbed) -> None:
    answer = live.probe.call(SetBool, "trigger/enable", SetBool.Request(data=False))
    assert answer.success
    live.wait_for("trigger_node", "WARN", "not enabled: call trigger/enable")
    # While it rests, faults are seen all the same.
    live.switch("clusters.nack", 1)
    live.wait_for("cluster_node", "ERROR", "channel 0")
    count = len(live.triggers)
    live.switch("clusters.nack", 0)
    live.wait_for("cluster_node", "OK")
    assert len(live.triggers) == count
    live.probe.call(SetBool, "trigger/enable", SetBool.Request(data=True))
    live.wait_for_triggers(5)
    sequences = [m.sequence for m in live.triggers]
    assert set(np.diff(sequences)) == {1}


def test_a_take_s_stamps_are_even_and_match_the_wrenches(live: LiveTestbed) -> None:
    live.wait_for_triggers(40)
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in live.triggers]
    wrenches = {(m.header.stamp.sec, m.header.stamp.nanosec) for m in live.wrenches}
    live.wait_for_triggers(2)  # one of them may come after its wrench
    triggers = {(m.header.stamp.sec, m.header.stamp.nanosec) for m in live.triggers}
    assert {stamp for stamp in wrenches if stamp >= min(triggers)} <= triggers
    assert np.median(np.diff(stamps)) == pytest.approx(0.05, abs=2e-3)


def test_poses_and_wrenches_are_averages_over_the_trigger_s_period(live: LiveTestbed) -> None:
    """50 ms at 240 frames and 500 conversions a second, half of it after the trigger."""

    def figure(node: str, name: str) -> float:
        found = [s.values for m in live.diagnostics for s in m.status if s.name == f"/{node}"]
        return float({v.key: v.value for v in found[-1]}[name])

    live.probe.wait(lambda: figure("mocap_node", "averaged_frames") >= 10, "the mean poses")
    live.probe.wait(
        lambda: figure("load_cell_node", "averaged_conversions") >= 22, "the mean wrenches"
    )
    assert figure("mocap_node", "averaged_frames") <= 14
    assert figure("load_cell_node", "averaged_conversions") <= 28
    assert figure("mocap_node", "delay") > 0.02


def tare(live: LiveTestbed) -> TriggerService.Response:
    return live.probe.call(TriggerService, "load_cell/tare", TriggerService.Request())


def test_a_tare_outlives_its_node(live: LiveTestbed) -> None:
    live.probe.wait(lambda: tare(live).success, "a tare")
    live.probe.wait(lambda: abs(live.wrenches[-1].wrench.force.z) < 5.0, "the tare")
    live.kill("load_cell_node")
    seen = len(live.wrenches)
    live.probe.wait(
        lambda: any(np.isfinite(m.wrench.force.z) for m in live.wrenches[seen + 5 :]),
        "wrenches again",
    )
    forces = [m.wrench.force.z for m in live.wrenches[seen:]]
    # 91 N of pylon were taken off, and stay off.
    assert np.nanmax(np.abs(forces)) < 5.0
