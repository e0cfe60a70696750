"""The transforms of a testbed, composed as RViz does it, against the geometry's own formula."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.bags import move_to_namespace, rewrite
from support.graph import Probe

from socket_testbed.files import packaged
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import read_socket
from socket_testbed.live.bringup import replay_nodes
from socket_testbed.live.processes import Graph
from socket_testbed.nodes.mocap_node import fixed_frames
from socket_testbed.settings.testbed import EstimatorSettings, ReplaySettings
from socket_testbed.trials.layout import stamp_of
from socket_testbed.trials.topics import FORCE_MAP, TF, TF_STATIC
from socket_testbed.trials.trial import Trial

GEOMETRY = read_socket(packaged("config", "socket.yaml"))


def pose_of(transform: Any) -> Pose:
    """A transform's pose, from the message's own fields."""
    t, q = transform.transform.translation, transform.transform.rotation
    turn = Rotation.from_quat([q.x, q.y, q.z, q.w])
    return Pose(turn.as_matrix(), np.array([t.x, t.y, t.z]))


def test_a_cluster_s_frame_is_its_tile_s_turned_as_it_is_glued() -> None:
    geometry = dataclasses.replace(GEOMETRY, turned={"distal": 0.6})
    found = {name: (parent, pose) for parent, name, pose in fixed_frames(geometry)}
    assert set(found) == {"load_cell", *GEOMETRY.clusters}
    for name, tile in GEOMETRY.clusters.items():
        parent, pose = found[name]
        assert parent == "load_cell"
        # {L}: z is the inward normal, the origin the tile's centre.
        np.testing.assert_allclose(pose.apply(np.zeros(3)), GEOMETRY.anchors[tile])
        inward = pose.apply(np.array([0.0, 0.0, 1.0])) - GEOMETRY.anchors[tile]
        np.testing.assert_allclose(inward, GEOMETRY.rotations[tile][:, 2])
        # A stress along the axes of the cluster's frame is the force that the fit reckons with.
        normal, shear_x, shear_y = stress = np.array([2e4, 3e3, -1e3])
        force = geometry.areas[tile] * pose.rotation @ (shear_x, shear_y, -normal)
        expected = geometry.rotations[tile] @ geometry.cluster_force(name, stress)
        np.testing.assert_allclose(force, expected)
    parent, load_cell = found["load_cell"]
    assert parent == "socket"
    both: Pose = GEOMETRY.socket_body @ load_cell
    np.testing.assert_allclose(both.rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(both.translation, 0.0, atol=1e-9)


@pytest.mark.graph
@pytest.mark.slow
def test_the_transforms_of_a_replay_compose_to_the_recorded_poses(
    hold: Path, tmp_path: Path
) -> None:
    """A trial of the namespace /lab, replayed with the estimator."""

    def hide_pylon(topic: str, message: Any) -> Any:
        """In the second half of every second."""
        if topic == "/mocap/pylon/pose" and message.header.stamp.nanosec >= 500_000_000:
            message.pose.position.x = float("nan")
        return message

    hidden = rewrite(hold, tmp_path / "hidden", hide_pylon)
    trial = Trial(move_to_namespace(hidden, tmp_path / "lab", "/lab"))
    replay = ReplaySettings(trial=str(trial.path), rate=20.0)
    samples = trial.samples()
    with Probe() as probe, Graph() as graph:
        tf, static, maps = (
            probe.listen(topic, f"/lab/{topic.name.strip('/')}")
            for topic in (TF, TF_STATIC, FORCE_MAP)
        )
        graph.start_nodes(replay_nodes(trial, replay, EstimatorSettings(auto_fit=False)))
        graph.wait("replay_node")
        last = samples.stamps[-1]
        probe.wait(lambda: bool(maps) and stamp_of(maps[-1]) == last, "the last sample")
    fixed = {t.child_frame_id: t for m in static for t in m.transforms}
    assert {(t.header.frame_id, name) for name, t in fixed.items()} == {
        ("socket", "load_cell"),
        *(("load_cell", name) for name in trial.geometry.clusters),
    }
    moving: dict[str, dict[int, Pose]] = {"socket": {}, "limb": {}}
    for t in (t for message in tf for t in message.transforms):
        assert t.header.frame_id == "world"
        moving[t.child_frame_id][stamp_of(t)] = pose_of(t)
    poses = dict(zip(samples.stamps.tolist(), samples.pose, strict=True))
    # What the motion capture did not see is not published, all the rest is once a subscriber is
    # found.
    seen = {stamp for stamp, pose in poses.items() if np.isfinite(pose).all()}
    for name, expected in (("socket", set(poses)), ("limb", seen)):
        assert set(moving[name]) == {stamp for stamp in expected if stamp >= min(moving[name])}
    both = sorted(set(moving["socket"]) & set(moving["limb"]))
    assert both and len(seen) == 120
    for stamp in both[::20]:
        cell = moving["socket"][stamp] @ pose_of(fixed["load_cell"])
        limb = cell.inverse() @ moving["limb"][stamp]
        np.testing.assert_allclose(limb.translation, poses[stamp][:3], atol=1e-8)
        turn = Rotation.from_rotvec(poses[stamp][3:]).as_matrix()
        np.testing.assert_allclose(limb.rotation, turn, atol=1e-8)
