"""Faces of a few triangles wound alike, by hand."""

import numpy as np
import pytest

from socket_testbed.socket_design.scan_file import wind_alike

STRIP = [[0, 1, 2], [2, 1, 3], [2, 3, 4]]  # wound alike: shared edges run both ways


@pytest.mark.parametrize(
    ("faces", "turned"),
    [
        (STRIP, 0),
        ([STRIP[0], [3, 1, 2], STRIP[2]], 1),  # the middle one against two
        ([[2, 1, 0], [3, 1, 2], STRIP[2]], 1),  # two against the last
        ([STRIP[0], [3, 1, 2]], 1),  # one against one
        ([[2, 1, 0], [3, 1, 2]], 0),
        ([[0, 1, 2], [3, 4, 5]], 0),  # apart
    ],
    ids=["alike", "middle", "majority", "tie", "both turned", "apart"],
)
def test_the_fewest_faces_are_turned(faces: list[list[int]], turned: int) -> None:
    found, count = wind_alike(np.array(faces))
    assert count == turned
    assert (found != np.array(faces)).any(axis=1).sum() == turned
    edges = [(face[k], face[(k + 1) % 3]) for face in found.tolist() for k in range(3)]
    assert len({*edges}) == len(edges)  # no edge runs the same way twice
