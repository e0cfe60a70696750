"""Takes as Motive would export them, from benches whose truth is known."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.socket_design.motive import read_motive_csv
from socket_testbed.socket_design.registration import Registration, read_landmarks, register_take
from support.problems import PYLON_TRIAD, SOCKET_TRIAD, random_pose, random_socket

RATE = 120.0  # [Hz]
UNITS = {"Meters": 1.0, "Centimeters": 1e-2, "Millimeters": 1e-3}
SOCKET_NAMES = tuple(f"Socket:Marker{i}" for i in (1, 2, 3))
PYLON_NAMES = tuple(f"Pylon:Marker{i}" for i in (1, 2, 3))
CELL = 1e-3 * np.array([[60, 0, 10], [-50, 30, 0], [10, -70, 20], [0, 30, 80], [40, 50, 100]])
IN_SOCKET = np.array([0.0, 0.0, 0.13])  # [m]; the middle of `random_socket`
LIMB = np.array([[0, 70, 100], [50, -30, 120], [-60, -20, 90], [20, 20, 200], [-30, 60, 170]]) / 1e3


@dataclass
class Written:
    """The content of a CSV: columns of N frames by name, in metres and in `world`."""

    markers: dict[str, np.ndarray]
    solved: dict[str, np.ndarray] = field(default_factory=dict)
    bodies: dict[str, Pose] = field(default_factory=dict)
    version: str = "1.21"
    unit: str = "Meters"

    def __len__(self) -> int:
        return len(next(iter(self.markers.values())))


def motive_lines(take: Written, rate: float = RATE) -> list[str]:
    """The lines of an export: the header and blank line, the rows of names, the frames."""
    # Titles (type, name, property, axis) and numbers of the columns behind the time.
    titles, columns, scale = [], [], UNITS[take.unit]
    for name, pose in take.bodies.items():
        titles += [("Rigid Body", name, "Rotation", axis) for axis in "XYZW"]
        titles += [("Rigid Body", name, "Position", axis) for axis in "XYZ"]
        titles.append(("Rigid Body", name, "Mean Marker Error", ""))
        columns += [*pose.quaternion().T, *(pose.translation / scale).T, np.zeros(len(take))]
    for kind, markers in (("Rigid Body Marker", take.solved), ("Marker", take.markers)):
        for name, positions in markers.items():
            titles += [(kind, name, "Position", axis) for axis in "XYZ"]
            columns += [*(positions / scale).T]
    header = (
        f"Format Version,{take.version},Take Name,Take 2024-05-05 03.49.50 PM"
        f",Capture Frame Rate,{2.0 * rate:.6f},Export Frame Rate,{rate:.6f}"
        f",Total Exported Frames,{len(take)},Rotation Type,Quaternion"
        f",Length Units,{take.unit},Coordinate Space,Global"
    )
    kinds, names, meanings, axes = (list(row) for row in zip(*titles, strict=True))
    ids = [f'"{sum(map(ord, name)):08X}"' for name in names]
    named = float(take.version) > 1.22
    labels = ("Type", "Name", "ID") if named else ("", "", "")
    rows = [["", label, *row] for label, row in zip(labels, (kinds, names, ids), strict=True)]
    if float(take.version) >= 1.25:
        rows.append(["", "Parent", *["" for _ in names]])
    rows += [["", "", *meanings], ["Frame", "Time (Seconds)", *axes]]
    for frame, numbers in enumerate(np.array(columns).T):
        cells = [f"{value:.6f}" if np.isfinite(value) else "" for value in numbers]
        rows.append([str(frame), f"{frame / rate:.6f}", *cells])
    return [header, "", *(",".join(row) for row in rows)]


def write_take(take: Written, path: Path, rate: float = RATE) -> Path:
    return write_lines(motive_lines(take, rate), path)


def write_lines(lines: list[str], path: Path, newline: str = "\r\n", code: str = "utf-8") -> Path:
    path.write_bytes("".join(line + newline for line in lines).encode(code))
    return path


@dataclass
class Bench:
    """A socket and its limb on the bench with landmarks, and the take of them."""

    geometry: SocketGeometry  # A socket whose triads, `socket_body` and `limb` are out of date
    socket_body: Pose  # true pose of the socket's own triad frame in {S}
    limb: Pose  # true pose of the limb in the pylon's own triad frame
    q: np.ndarray  # true limb position in {S} [m]
    places: dict[str, np.ndarray]  # true places of the markers in `world`, by name [m]
    take: Written
    document: dict  # content of LANDMARKS.yaml


def make_bench(
    rng: np.random.Generator,
    frames: int = 60,
    noise: float = 1e-4,
    placement: float = 0.0,
    landmarks: int = 5,
    scene: np.random.Generator | None = None,
    **changes: object,
) -> Bench:
    scene = scene or rng
    cell_in_world = random_pose(scene, 1.0)
    limb_in_cell = Pose(np.eye(3), IN_SOCKET) @ random_pose(scene, 0.01)
    socket_in_cell, pylon_in_limb = random_pose(scene, 0.15), random_pose(scene, 0.2)
    limb_in_world = cell_in_world @ limb_in_cell
    socket = (cell_in_world @ socket_in_cell).apply(SOCKET_TRIAD)
    pylon = (limb_in_world @ pylon_in_limb).apply(PYLON_TRIAD)
    places = dict(zip(SOCKET_NAMES + PYLON_NAMES, [*socket, *pylon], strict=True))
    known = {}
    for group, frame, points in (("Cell", cell_in_world, CELL), ("Limb", limb_in_world, LIMB)):
        known[group] = {f"{group}:{i}": p for i, p in enumerate(points[:landmarks].tolist())}
        for name, point in known[group].items():
            places[name] = frame.apply(point + rng.normal(0.0, placement, 3))
    markers = {name: place + rng.normal(0.0, noise, (frames, 3)) for name, place in places.items()}
    # The triads' own frames: origin at the first marker, x to the second, z normal to them.
    socket_frame, pylon_frame = own_frame_of(SOCKET_TRIAD), own_frame_of(PYLON_TRIAD)
    return Bench(
        geometry=random_socket(scene),
        socket_body=socket_in_cell @ socket_frame,
        limb=(pylon_in_limb @ pylon_frame).inverse(),
        q=limb_in_cell.translation,
        places=places,
        take=Written(markers, **changes),
        document={
            "bodies": {"socket": list(SOCKET_NAMES), "pylon": list(PYLON_NAMES)},
            "load_cell": known["Cell"],
            "limb": known["Limb"],
        },
    )


def own_frame_of(triad: np.ndarray) -> Pose:
    """Frame of a triad by Gram and Schmidt: the QR decomposition of its two edges."""
    edges = (triad[1:] - triad[0]).T
    axes, scales = np.linalg.qr(edges)
    x, y = (axes * np.sign(np.diag(scales))).T
    return Pose(np.column_stack([x, y, np.cross(x, y)]), triad[0])


def track(bench: Bench, name: str, triad: tuple[str, ...], frame: Pose) -> Bench:
    """The bench with a rigid body of Motive, whose frame lies at `frame` of the triad's own."""
    pose = own_frame_of(np.array([bench.places[marker] for marker in triad])) @ frame
    count = len(bench.take)
    tracked = Pose(np.tile(pose.rotation, (count, 1, 1)), np.tile(pose.translation, (count, 1)))
    take = replace(bench.take, bodies={**bench.take.bodies, name: tracked})
    return replace(bench, take=take)


def write_landmarks(document: dict, path: Path) -> Path:
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return path


def register(bench: Bench, folder: Path, force: bool = False) -> Registration:
    take = read_motive_csv(write_take(bench.take, folder / "take.csv"))
    landmarks = read_landmarks(write_landmarks(bench.document, folder / "landmarks.yaml"))
    return register_take(take, landmarks, bench.geometry, force)


def between(a: Pose, b: Pose) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses."""
    angle = Rotation.from_matrix(a.rotation.T @ b.rotation).magnitude()
    return float(np.linalg.norm(a.translation - b.translation)), float(angle)
