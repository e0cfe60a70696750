"""Coverage of a left-out cluster's force: its noise, given in its own frame, along the axes of {S}.

`right_prox` is at 270 degrees: x of its frame is z of {S}, its y is x and its z is y. Noise of 1,
2 and 8 N along its x, y and z is of 2, 8 and 1 N along x, y and z of {S}.
"""

import numpy as np
import pytest
from support import scene
from support.problems import make_samples

from socket_testbed.identification.validation import judge_clusters

NOISE = np.array([[1.0, 2.0, 8.0]])  # [N] in the frame of the tile
IN_SOCKET = np.array([2.0, 8.0, 1.0])  # [N] along the axes of {S}
COUNT = 5


@pytest.mark.parametrize(
    ("sigmas", "coverage"),
    [
        (0.6, (1.0, 1.0, 1.0)),  # half of a normal distribution is within 0.674 sigma
        (0.75, (0.0, 1.0, 1.0)),
        (1.35, (0.0, 0.0, 1.0)),  # four fifths within 1.282
        (2.05, (0.0, 0.0, 0.0)),  # 95 % within 1.960
        (-1.35, (0.0, 0.0, 1.0)),
        (-2.05, (0.0, 0.0, 0.0)),
    ],
    ids=["half", "80 %", "95 %", "outside", "95 % below", "outside below"],
)
def test_noise_is_turned_into_the_socket(sigmas: float, coverage: tuple[float, ...]) -> None:
    geometry = scene.geometry()
    tile = geometry.clusters["brim_lateral"]
    local = np.tile([3.0, -2.0, -40.0], (COUNT, 1))
    samples = make_samples(np.zeros((COUNT, 3)), np.zeros((COUNT, 6)), {"brim_lateral": local})

    def off(_):
        forces = np.zeros((COUNT, len(geometry), 3))
        forces[:, tile] = [-2.0, -40.0, 3.0] + sigmas * IN_SOCKET
        return forces, np.zeros_like(forces)

    of_cluster, of_all = judge_clusters(samples, geometry, {"off": off}, NOISE)
    assert of_cluster.coverage == of_all.coverage == coverage


def test_noise_adds_to_the_map_s_own() -> None:
    """sqrt(2^2 + 8^2) = 8.246 N along x: 1.9 of them are within 95 %, 7.8 of the noise alone."""
    geometry = scene.geometry()
    tile = geometry.clusters["brim_lateral"]
    local = np.zeros((COUNT, 3))
    samples = make_samples(np.zeros((COUNT, 3)), np.zeros((COUNT, 6)), {"brim_lateral": local + 1})

    def off(_):
        forces = np.zeros((COUNT, len(geometry), 3))
        forces[:, tile] = [1.0 + 1.9 * 8.246, 1.0, 1.0]
        deviations = np.zeros_like(forces)
        deviations[..., 0] = 8.0
        return forces, deviations

    of_cluster, _ = judge_clusters(samples, geometry, {"off": off}, NOISE)
    assert of_cluster.coverage == pytest.approx((2 / 3, 2 / 3, 1.0))
