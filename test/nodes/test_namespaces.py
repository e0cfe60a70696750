"""Two testbeds in two namespaces of one graph, each with its own nodes, topics and devices."""

from __future__ import annotations

import dataclasses
import platform
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from rcl_interfaces.srv import ListParameters
from std_srvs.srv import SetBool
from support.graph import Probe
from support.testbeds import manageable

from socket_testbed.live.bringup import end, simulated_testbed, start
from socket_testbed.live.processes import Graph
from socket_testbed.live.simulated_world import Simulation
from socket_testbed.trials.topics import TF, TF_STATIC, TRIGGER, WRENCH

pytestmark = [pytest.mark.graph, pytest.mark.slow]

NAMESPACES = ("/left", "/right")
NODES = ("trigger_node", "cluster_node", "load_cell_node", "mocap_node", "calibration_node")


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimpleNamespace]:
    """Two testbeds that run at once, and what another program hears of them."""
    simulation = manageable(Simulation("static_hold", 1800.0), 20.0)
    with Probe() as probe, Graph() as left, Graph() as right:
        triggers = {name: probe.listen(TRIGGER, f"{name}/trigger") for name in NAMESPACES}
        wrenches = {name: probe.listen(WRENCH, f"{name}/load_cell/wrench") for name in NAMESPACES}
        both = dataclasses.replace(
            simulated_testbed(rate=10.0, simulation=simulation), one_process=True
        )
        testbeds = [dataclasses.replace(both, namespace=name) for name in NAMESPACES]
        for graph, testbed in zip((left, right), testbeds, strict=True):
            start(graph, testbed)
        probe.wait(lambda: all(len(found) > 5 for found in wrenches.values()), "both testbeds")
        yield SimpleNamespace(probe=probe, triggers=triggers, wrenches=wrenches)
        for graph, testbed in zip((left, right), testbeds, strict=True):
            end(graph, testbed)


def test_every_node_has_its_full_name_its_hardware_and_parameter_services(
    two: SimpleNamespace,
) -> None:
    expected = {f"{namespace}/{node}" for namespace in NAMESPACES for node in NODES}

    nodes = sorted(name.removeprefix("/") for name in expected)
    two.probe.wait(lambda: all(map(two.probe.said, nodes)), "the diagnostics of all nodes")
    found = two.probe.said("left/cluster_node")[-1].hardware_id
    assert found.startswith(platform.node()) and "i2c-1" in found
    # `ros2 param list` asks every node that is listed.
    listed = two.probe.node.get_node_names_and_namespaces()
    own = {f"{namespace}/{name}" for name, namespace in listed if namespace in NAMESPACES}
    assert own == {*expected, *(f"{namespace}/estimator_node" for namespace in NAMESPACES)}
    for name in sorted(own):
        answer = two.probe.call(ListParameters, f"{name}/list_parameters", ListParameters.Request())
        assert "use_sim_time" in answer.result.names


def test_each_testbed_follows_its_own_trigger(two: SimpleNamespace) -> None:
    """What is measured in one namespace was asked for in it, and no testbed sees another's."""

    def stamps(messages: list) -> set[tuple[int, int]]:
        return {(m.header.stamp.sec, m.header.stamp.nanosec) for m in list(messages)}

    measured = {name: stamps(two.wrenches[name]) for name in NAMESPACES}
    asked = {name: stamps(two.triggers[name]) for name in NAMESPACES}
    first = {name: min(asked[name]) for name in NAMESPACES}
    for name in NAMESPACES:
        assert {stamp for stamp in measured[name] if stamp >= first[name]} <= asked[name]
    assert not asked["/left"] & asked["/right"]
    said = [s for name in NAMESPACES for s in two.probe.said(f"{name[1:]}/trigger_node")]
    assert said and not any("another trigger" in status.message for status in said)


def test_services_of_one_testbed_leave_the_other_alone(two: SimpleNamespace) -> None:
    for enabled in (False, True):
        request = SetBool.Request(data=enabled)
        assert two.probe.call(SetBool, "/left/trigger/enable", request).success
        count = len(two.triggers["/right"])
        two.probe.wait(lambda count=count: len(two.triggers["/right"]) > count + 5, "triggers")


def test_each_testbed_has_transforms_of_its_own(two: SimpleNamespace) -> None:
    """Frames are called the same in both: on one topic nobody could tell them apart."""
    moving = [two.probe.listen(TF, f"{name}/tf") for name in NAMESPACES]
    static = [two.probe.listen(TF_STATIC, f"{name}/tf_static") for name in NAMESPACES]
    two.probe.wait(lambda: all(moving) and all(static), "the transforms of both")
    for own, fixed in zip(moving, static, strict=True):
        assert {t.child_frame_id for t in own[-1].transforms} == {"socket", "limb"}
        assert fixed[0].transforms[0].child_frame_id == "load_cell"
    assert two.probe.node.count_publishers("/tf") == 0
