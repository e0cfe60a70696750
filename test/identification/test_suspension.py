"""The stiffness of a limb in a socket that is known: a linear one."""

import numpy as np

from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.information import find_suspension
from socket_testbed.samples import Samples

GEOMETRY = read_socket(packaged("config", "socket.yaml"))
SIZES = np.array([4e4, 4e4, 9e4, 150.0, 150.0, 60.0])  # [N/m, N m/rad]


def suspended(seed: int, moments: float = 1.0, count: int = 400) -> tuple[np.ndarray, Samples]:
    """A random stiffness about the tiles' centre, and noisy samples of a limb that it holds."""
    rng, centre = np.random.default_rng(seed), GEOMETRY.anchors.mean(axis=0)
    mixed = np.eye(6) + 0.12 * rng.normal(size=(6, 6))
    stiffness = np.sqrt(SIZES)[:, None] * (mixed @ mixed.T) * np.sqrt(SIZES)
    time = np.linspace(0.0, 40.0, count)
    phases = 2.0 * np.pi * time[:, None, None] / 40.0 * np.arange(1.0, 7.0)
    waves = np.sin(phases + rng.uniform(0.0, 6.28, (6, 6))) * rng.normal(size=(6, 6))
    load = waves.sum(axis=2) * [20.0, 20.0, 60.0, 2.0 * moments, 2.0 * moments, 0.5 * moments]
    moved = load @ np.linalg.inv(stiffness).T
    origin = np.array([0.0, 0.0, 0.15])
    position = origin + moved[:, :3] - np.cross(moved[:, 3:], centre - origin)
    force = load[:, :3] + [0.0, 0.0, -200.0]
    wrench = np.hstack([load[:, 3:] + np.cross(centre, force), force])
    wrench += rng.normal(0.0, [0.02] * 3 + [0.2] * 3, (count, 6))
    position += rng.normal(0.0, 2e-5, position.shape)
    rotation = moved[:, 3:] + rng.normal(0.0, 1e-4, (count, 3))
    local, status = np.zeros((count, 1, 3)), np.zeros((count, 1), np.uint8)
    stamps = (1e9 * time).astype(np.int64)
    return stiffness, Samples(stamps, position, rotation, wrench, ("a",), local, status)


def test_a_linear_suspension_is_found_within_its_intervals() -> None:
    held = []
    for seed in range(6):
        known, samples = suspended(seed)
        found = find_suspension(samples, GEOMETRY)
        assert found is not None
        stiffness = found.stiffness
        np.testing.assert_allclose(np.diag(stiffness.value), np.diag(known), rtol=0.1)
        held.append((stiffness.low <= known) & (known <= stiffness.high))
        assert found.pistoning.low <= found.pistoning.value <= found.pistoning.high
    assert np.mean(held) > 0.88


def test_without_a_load_in_every_direction_or_a_pose_there_is_no_stiffness() -> None:
    _, samples = suspended(0, moments=0.0)
    found = find_suspension(samples, GEOMETRY)
    assert found is not None and not found.stiffness.certain().any()
    assert np.isfinite(found.pistoning.value)
    samples.position[:] = np.nan
    assert find_suspension(samples, GEOMETRY) is None
