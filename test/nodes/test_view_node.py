"""What the page takes from a graph, and what it does not show."""

import dataclasses

import numpy as np
import pytest
import rclpy
from support.graph import Probe
from support.ring_socket import ring_socket
from support.sources import estimate_of

from socket_testbed.nodes.listeners import ListenerNode
from socket_testbed.nodes.view_node import LiveSource
from socket_testbed.trials.messages import force_map_packer
from socket_testbed.trials.topics import FORCE_MAP

pytestmark = pytest.mark.graph

GEOMETRY = ring_socket()


def test_a_map_of_another_socket_is_named_and_not_drawn() -> None:
    """Even if it has as many tiles."""
    other = dataclasses.replace(GEOMETRY, names=tuple(reversed(GEOMETRY.names)))
    drawn_map = estimate_of(np.full(len(GEOMETRY), 5e3), "measured: wrench")
    rclpy.init()
    with Probe() as probe:
        node = ListenerNode("page", lambda: None)
        source = LiveSource(node, GEOMETRY, None)
        source.watched(True)
        publisher = probe.publisher(FORCE_MAP)

        def shows(geometry, drawn: bool) -> bool:
            publisher.publish(force_map_packer(geometry.names)(1, drawn_map))
            instant = source.instant()
            words = " ".join(sensor.words for sensor in source.sensors())
            return (
                instant is not None
                and (instant.map is not None) is drawn
                and ("another socket" in words) is not drawn
            )

        probe.wait(lambda: shows(GEOMETRY, True), "the map")
        probe.wait(lambda: shows(other, False), "that it is of another socket")
        source.watched(False)
        node.destroy_node()
    rclpy.shutdown()
