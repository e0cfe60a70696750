"""Two testbeds in two namespaces of one graph, each with its own nodes, topics and devices."""

import dataclasses
import platform

import pytest
from rcl_interfaces.srv import ListParameters
from std_srvs.srv import SetBool
from support.graph import Probe
from support.testbeds import manageable

from socket_testbed.live.bringup import end, simulated_testbed, start
from socket_testbed.live.processes import Graph
from socket_testbed.live.simulated_world import Simulation
from socket_testbed.trials.layout import stamp_of
from socket_testbed.trials.topics import TF, TF_STATIC, TRIGGER, WRENCH

NAMESPACES = ("/left", "/right")
NODES = ("trigger_node", "cluster_node", "load_cell_node", "mocap_node", "calibration_node")


@pytest.mark.graph
@pytest.mark.slow
def test_testbeds_in_namespaces_leave_each_other_alone() -> None:
    simulation = manageable(Simulation("static_hold", 1800.0))
    both = simulated_testbed(rate=10.0, simulation=simulation)
    both = dataclasses.replace(both, one_process=True)
    testbeds = [dataclasses.replace(both, namespace=name) for name in NAMESPACES]
    with Probe() as probe, Graph() as left, Graph() as right:
        left_heard, right_heard = (
            {t: probe.listen(t, f"{name}/{t.name.strip('/')}") for t in (TRIGGER, WRENCH, TF)}
            for name in NAMESPACES
        )
        static = [probe.listen(TF_STATIC, f"{name}/tf_static") for name in NAMESPACES]
        for graph, testbed in zip((left, right), testbeds, strict=True):
            start(graph, testbed)
        heard = (left_heard, right_heard)
        probe.wait(lambda: all(len(of[WRENCH]) > 5 for of in heard), "both testbeds")

        # What is measured in one namespace was asked for in it.
        asked = [{stamp_of(message) for message in list(of[TRIGGER])} for of in heard]
        for own, of in zip(asked, heard, strict=True):
            measured = {stamp_of(message) for message in list(of[WRENCH])}
            own |= {stamp_of(message) for message in list(of[TRIGGER])}
            assert {stamp for stamp in measured if stamp >= min(own)} <= own
        assert not asked[0] & asked[1]
        for enabled in (False, True):
            request = SetBool.Request(data=enabled)
            assert probe.call(SetBool, "/left/trigger/enable", request).success
            count = len(right_heard[TRIGGER])
            probe.wait(lambda count=count: len(right_heard[TRIGGER]) > count + 5, "triggers")

        # Frames are called the same in both: on one topic nobody could tell them apart.
        probe.wait(lambda: all(static) and all(of[TF] for of in heard), "the transforms of both")
        for of, fixed in zip(heard, static, strict=True):
            assert {t.child_frame_id for t in of[TF][-1].transforms} == {"socket", "limb"}
            assert fixed[0].transforms[0].child_frame_id == "load_cell"
        assert probe.node.count_publishers("/tf") == 0

        # Every node reports under its full name, with its hardware, and has parameter services:
        # `ros2 param list` asks every node that is listed.
        expected = {f"{name[1:]}/{node}" for name in NAMESPACES for node in NODES}
        probe.wait(lambda: all(map(probe.said, expected)), "the diagnostics of all nodes")
        found = probe.said("left/cluster_node")[-1].hardware_id
        assert found.startswith(platform.node()) and "i2c-1" in found
        said = [s for name in NAMESPACES for s in probe.said(f"{name[1:]}/trigger_node")]
        assert said and not any("another trigger" in status.message for status in said)
        listed = probe.node.get_node_names_and_namespaces()
        own = {f"{of[1:]}/{name}" for name, of in listed if of in NAMESPACES}
        assert own == expected | {f"{name[1:]}/estimator_node" for name in NAMESPACES}
        for name in sorted(own):
            answer = probe.call(
                ListParameters, f"/{name}/list_parameters", ListParameters.Request()
            )
            assert "use_sim_time" in answer.result.names
        for graph, testbed in zip((left, right), testbeds, strict=True):
            end(graph, testbed)
