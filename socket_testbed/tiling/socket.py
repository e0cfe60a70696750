"""A socket's geometry from its tiling."""

from __future__ import annotations

import dataclasses

import numpy as np

from socket_testbed.arrays import FloatArray, IntArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.tiling.clusters import ClusterPlace, assign_clusters, nominal_places
from socket_testbed.tiling.names import tile_names
from socket_testbed.tiling.tiling import Tiling


def tiled_socket(
    tiling: Tiling,
    end: FloatArray,
    proximal: FloatArray,
    anterior: FloatArray,
    places: list[ClusterPlace] | None,
    bodies: SocketGeometry,
    source: str,
) -> tuple[SocketGeometry, list[str]]:
    """The geometry of a tiled socket in {S}, its tiles in the order of their names.

    A tile that a cluster is on bears the cluster's name.

    Args:
        tiling: The tiles in {S}.
        end: Centre of the distal end in {S}, shape (3,) [m].
        proximal: Direction towards the proximal end in {S}, shape (3,) [-].
        anterior: Direction from which the names' angles count, shape (3,) [-].
        places: Where the clusters are; None for where they usually are.
        bodies: A geometry with the marker bodies to take over.
        source: What the tiles were made from.

    Returns:
        The geometry, and notes on the clusters.

    Raises:
        ConfigurationError: If a cluster is on no tile, or two are on the same.
    """
    names = tile_names(tiling.squares.anchors, end, proximal, anterior)
    if places is None:
        places = nominal_places(tiling.squares, end, proximal, anterior)
    clusters, notes = assign_clusters(places, tiling.squares, names)
    order = np.array(sorted(range(len(names)), key=names.__getitem__))
    place_of = np.argsort(order)
    name_of_cluster_tile = {tile: cluster for cluster, tile in clusters.items()}
    geometry = dataclasses.replace(
        bodies,
        names=tuple(name_of_cluster_tile.get(int(tile), names[tile]) for tile in order),
        anchors=tiling.squares.anchors[order],
        rotations=tiling.squares.rotations[order],
        areas=np.full(len(names), tiling.squares.edge**2),
        neighbours=_renumbered(tiling.neighbours, place_of),
        clusters={cluster: int(place_of[tile]) for cluster, tile in clusters.items()},
        source=source,
    )
    return geometry, notes


def _renumbered(pairs: IntArray, place_of: IntArray) -> IntArray:
    """Pairs of tiles by their new indices, each and all sorted."""
    pairs = np.sort(place_of[pairs], axis=1)
    return pairs[np.lexsort(pairs.T[::-1])]
