"""What the page takes from a graph, and what it does not show."""

import dataclasses

import numpy as np
import pytest
import rclpy
from support.graph import Probe
from support.problems import ring_socket

from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.nodes.base import TestbedNode
from socket_testbed.nodes.view_node import LiveSource
from socket_testbed.settings.fields import Settings
from socket_testbed.trials.messages import force_map_packer
from socket_testbed.trials.topics import FORCE_MAP

pytestmark = pytest.mark.graph

GEOMETRY = ring_socket()


def test_a_map_of_another_socket_is_named_and_not_drawn() -> None:
    """Even if it has as many tiles."""
    other = dataclasses.replace(GEOMETRY, names=tuple(reversed(GEOMETRY.names)))
    vectors, numbers = np.ones((1, len(GEOMETRY), 3)), np.full((1, len(GEOMETRY)), 5e3)
    estimate = MapEstimate(vectors, vectors, *[numbers] * 4, "measured: wrench")
    rclpy.init()
    with Probe() as probe:
        node = TestbedNode("page", Settings)
        source = LiveSource(node, GEOMETRY, None)
        source.now(None)  # it listens while a browser asks
        publisher = probe.publisher(FORCE_MAP)

        def shows(geometry, drawn: bool) -> bool:
            publisher.publish(force_map_packer(geometry.names)(1, estimate))
            found = source.now(None)
            words = found["cards"][-1]["words"]
            return ("pressure" in found["moment"]) is drawn and (
                ("another socket" in words) is not drawn
            )

        probe.wait(lambda: shows(GEOMETRY, True), "the map")
        probe.wait(lambda: shows(other, False), "that it is of another socket")
        source._asked_at -= 60.0  # no browser has asked for a while
        source.rest()
        assert source._inbox is None
        node.destroy_node()
    rclpy.shutdown()
