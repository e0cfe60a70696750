"""Proposed places of clusters, against the force map that they are for."""

from dataclasses import replace

import numpy as np
import pytest

from socket_testbed.errors import ConfigurationError
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import ForceMapSettings
from socket_testbed.socket_design.clusters import place_clusters

GEOMETRY = read_socket(packaged("config", "socket.yaml"))


def test_clusters_that_are_there_stay_and_each_further_one_lowers_the_error() -> None:
    stay = [GEOMETRY.clusters["distal"], 40]
    allowed = np.arange(len(GEOMETRY)) < 60
    found = place_clusters(GEOMETRY, 6, stay, allowed)
    tiles = found.tiles.tolist()
    assert tiles[:2] == stay and len(set(tiles)) == 6 and max(tiles[2:]) < 60
    errors = [found.errors[count] for count in range(2, 7)]
    assert errors == sorted(errors, reverse=True) and 0.0 < errors[-1] < errors[0] < 1.0
    low, high = found.at_random
    assert errors[-1] < high and low < high
    with pytest.raises(ConfigurationError, match="do not fit"):
        place_clusters(GEOMETRY, 80)


def test_the_first_proposal_is_the_best_single_cluster_of_the_force_map() -> None:
    """Under one hypothesis: tried on every tile, by the map's own standard deviations."""
    settings = ForceMapSettings(draws=1)
    nothing = np.full((1, 3), np.nan)
    left = []
    for tile in range(len(GEOMETRY)):
        geometry = replace(GEOMETRY, clusters={"c": tile})
        samples = Samples(
            np.zeros(1, np.int64), nothing, nothing, np.zeros((1, 6)), ("c",),
            np.zeros((1, 1, 3)), np.zeros((1, 1), np.uint8),
        )  # fmt: skip
        estimate = ForceMap(geometry, ("c",), settings).estimate(samples)
        left.append((estimate.standard_deviations**2).sum())
    place = place_clusters(GEOMETRY, 1, settings=replace(settings, spread=0.0)).tiles[0]
    assert left[place] < 1.02 * min(left)
