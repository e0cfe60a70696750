"""Random sockets, spring beds and samples, and whole problems of identification."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed.files import packaged
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry, read_socket
from socket_testbed.identification.contact import ContactModel
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import IdentificationSettings, Variant

GEOMETRY = read_socket(packaged("config", "socket.yaml"))  # the package's own
SOCKET_TRIAD = np.array([[0.0, 0.0, 0.0], [0.09, 0.0, 0.01], [-0.01, 0.045, 0.0]])  # [m]
PYLON_TRIAD = np.array([[0.0, 0.01, 0.0], [0.07, 0.0, 0.0], [0.01, 0.05, 0.02]])  # [m]


def random_pose(rng: np.random.Generator, reach: float = 0.3, count: int | None = None) -> Pose:
    """A random pose, or `count` of them, within `reach` [m]."""
    shape = (3,) if count is None else (count, 3)
    quaternion = rng.normal(size=(*shape[:-1], 4))  # normalised, it is uniform over rotations
    return Pose(Rotation.from_quat(quaternion).as_matrix(), rng.uniform(-reach, reach, shape))


def wall_frame(angle: float, cone: float) -> tuple[np.ndarray, np.ndarray]:
    """The direction outwards at an angle about z, and the frame of a tile there on a cone [rad]."""
    outwards, upwards = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([0.0, 0.0, 1.0])
    z = -np.cos(cone) * outwards + np.sin(cone) * upwards
    x = np.sin(cone) * outwards + np.cos(cone) * upwards
    return outwards, np.column_stack([x, np.cross(z, x), z])


def _cone(
    tiles: dict[str, tuple[np.ndarray, np.ndarray]], near: float, clusters: dict[str, str]
) -> SocketGeometry:
    """A socket of tiles by name, anchor and frame, which are neighbours if nearer than that [m]."""
    names, places = tuple(tiles), np.array([anchor for anchor, _ in tiles.values()])
    rotations = np.array([frame for _, frame in tiles.values()])
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    alike = rotations[:, :, 2] @ rotations[:, :, 2].T > -0.2
    return SocketGeometry(
        names=names,
        anchors=places,
        rotations=rotations,
        areas=np.full(len(names), 9e-4),
        neighbours=np.argwhere(np.triu((apart < near) & alike, 1)),
        clusters={name: names.index(tile) for name, tile in clusters.items()},
        socket_markers=SOCKET_TRIAD,
        pylon_markers=PYLON_TRIAD,
        socket_body=Pose(np.eye(3), np.zeros(3)),
        limb=Pose(np.eye(3), np.zeros(3)),
    )


def ring_socket() -> SocketGeometry:
    """A cone about z, 80 mm above the load cell, with tiles in six rings and on its distal end."""
    pitch, cone = 0.033, np.radians(6.0)  # [m], [rad]
    on = {"ring6_4": "brim_lateral", "ring4_1": "mid_anterior", "ring1_5": "posterior_distal"}
    on |= {"end_0_0": "distal"}  # clusters, whose names their tiles have
    tiles = {}
    for ring in range(6):
        along = (ring + 0.75) * pitch
        radius, height = 0.046 + along * np.sin(cone), 0.080 + along * np.cos(cone)
        count = int(2.0 * np.pi * radius / pitch)
        for place in range(count):
            outwards, frame = wall_frame(2.0 * np.pi * place / count, cone)
            tiles[f"ring{ring + 1}_{place + 1}"] = radius * outwards + [0.0, 0.0, height], frame
    for x, y in ((0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)):  # no tangent is proximal: x is anterior
        tiles[f"end_{x}_{y}"] = np.array([x * pitch, y * pitch, 0.080]), np.eye(3)
    named = {on.get(name, name): tile for name, tile in tiles.items()}
    return _cone(named, 0.047, {name: name for name in on.values()})


def small_socket() -> SocketGeometry:
    """A cylinder of 50 mm about z with tiles to all four sides in three rings, and one on its end.

    The rings are 20, 50 and 80 mm above the end; `left2` is to the left in the second one.
    """
    tiles = {}
    for ring, height in enumerate((0.10, 0.13, 0.16), start=1):
        for turn, side in enumerate(("anterior", "left", "posterior", "right")):
            outwards, frame = wall_frame(0.5 * np.pi * turn, 0.0)
            tiles[f"{side}{ring}"] = 0.05 * outwards + [0.0, 0.0, height], frame
    tiles["end"] = np.array([0.0, 0.0, 0.08]), np.eye(3)
    return _cone(tiles, 0.04, {"front": "anterior3", "side": "left2"})


def random_socket(rng: np.random.Generator, rings=2, columns=4, clusters=3) -> SocketGeometry:
    """A cone of rings x columns tiles around z, which is proximal, with clusters on random ones."""
    tiles, pairs = {}, []
    cone = rng.uniform(0.05, 0.2)  # [rad]
    for ring in range(rings):
        for column in range(columns):
            angle = 2.0 * np.pi * (column + rng.uniform(-0.1, 0.1)) / columns
            outwards, frame = wall_frame(angle, cone)
            radius = 0.045 + 0.01 * ring + rng.uniform(-0.002, 0.002)
            anchor = radius * outwards + [0.0, 0.0, 0.1 + 0.06 * ring]
            tile = len(tiles)
            tiles[f"tile_{ring}_{column}"] = anchor, frame
            pairs.append(sorted((tile, ring * columns + (column + 1) % columns)))
            pairs += [[tile, tile + columns]] if ring + 1 < rings else []
    covered = rng.permutation([*tiles])[:clusters]
    geometry = _cone(tiles, 0.0, {f"cluster_{i}": str(tile) for i, tile in enumerate(covered)})
    neighbours = np.unique(np.array(pairs), axis=0)
    socket_body, limb = random_pose(rng), random_pose(rng)
    return replace(geometry, neighbours=neighbours, socket_body=socket_body, limb=limb)


def random_bed(
    rng: np.random.Generator,
    geometry: SocketGeometry,
    variant: Variant = "stiffness",
    untouched: float = 0.0,
) -> ContactModel:
    """A spring bed, a fraction of it `untouched` (stiffness 0); offsets in the bias variant."""
    n = len(geometry)
    with_bias = variant == "stiffness_bias"
    return ContactModel(
        variant=variant,
        names=geometry.names,
        anchors=geometry.anchors,
        rotations=geometry.rotations,
        stiffness=rng.uniform(500.0, 8000.0, (n, 3)) * (rng.random((n, 3)) >= untouched),
        rest_positions=rng.uniform(-0.002, 0.002, (n, 3)),
        sharpness=2000.0,
        wrench_bias=with_bias * rng.normal(0.0, [1.0, 1.0, 1.0, 10.0, 10.0, 10.0]),
        force_bias={name: rng.normal(0.0, 5.0, 3) for name in geometry.clusters if with_bias},
        cluster_points=dict(geometry.clusters),
    )


def moving_limb(rng: np.random.Generator, count: int, amplitude: float = 0.003) -> np.ndarray:
    """Limb positions that cross the gates of all axes on ways of their own, (N, 3) [m]."""
    phase = np.linspace(0.0, 2.0 * np.pi, count)[:, None] * [1.0, 2.0, 3.0]
    way = amplitude * np.sin(phase + rng.uniform(0.0, 2.0 * np.pi, 3))
    return way + rng.normal(0.0, 0.1 * amplitude, (count, 3))


def make_samples(pose: np.ndarray, wrench: np.ndarray, forces: dict[str, np.ndarray]) -> Samples:
    """Complete samples at 4 Hz; of positions alone, or of whole poses [m, rad]."""
    count = len(pose)
    return Samples(
        stamps=np.int64(10**18) + 250_000_000 * np.arange(count, dtype=np.int64),
        position=pose[:, :3],
        rotation=pose[:, 3:] if pose.shape[1] == 6 else np.zeros((count, 3)),
        wrench=wrench,
        clusters=tuple(forces),
        local_forces=np.stack([*forces.values()], axis=1) if forces else np.zeros((count, 0, 3)),
        status=np.zeros((count, len(forces)), dtype=np.uint8),
    )


def samples_of_bed(
    rng: np.random.Generator, bed: ContactModel, position: np.ndarray, noise: float = 0.0
) -> Samples:
    """What perfect sensors would measure on a bed, plus `noise` relative to 1 N and 0.1 N m."""
    wrench, forces = bed.wrench(position), bed.cluster_forces(position)
    wrench = wrench + noise * rng.normal(0.0, [0.1] * 3 + [1.0] * 3, wrench.shape)
    forces = {name: f + noise * rng.normal(0.0, 1.0, f.shape) for name, f in forces.items()}
    return make_samples(position, wrench, forces)


def naive_gated(displacement: np.ndarray, sharpness: float) -> np.ndarray:
    """The paper's form of s: (1/2 - 1/2 tanh(alpha d)) d."""
    return (0.5 - 0.5 * np.tanh(sharpness * displacement)) * displacement


def make_case(
    seed: int, variant: Variant = "stiffness_bias", gaps: bool = False, **changes
) -> tuple[SocketGeometry, ContactModel, Samples, IdentificationSettings]:
    """A random bed and its samples: the socket, the bed, the samples and the settings.

    Little smoothness and many tiles without contact put part of the solution on its bound. Gaps
    are in the clusters: single channels, whole clusters, statuses.
    """
    rng = np.random.default_rng(seed)
    geometry = random_socket(rng)
    bed = random_bed(rng, geometry, variant, untouched=0.4)
    samples = samples_of_bed(rng, bed, moving_limb(rng, 40), 1.0)
    if gaps:
        forces = samples.local_forces
        forces[rng.random(forces.shape) < 0.1] = np.nan
        forces[5:9, 0] = np.nan
        samples.status[12:16, 1] = 3
        forces[12:16, 1] += 1e4  # what no fit may see
    settings = IdentificationSettings(variant=variant, **({"smoothness": 1e-5} | changes))
    return geometry, bed, samples, settings
