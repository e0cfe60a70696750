"""A scene with known answers: a socket of a dozen tiles, and forces that paper and pencil can sum.

The socket stands on z of {S}, x is anterior, y is left; the leg is a right one, so left is medial.
Its tiles are in four columns (anterior, left, posterior, right) and three levels: `prox` and `mid`
on the wall, 50 mm from the axis, 210 and 150 mm above the load cell, and `end` on the distal end,
20 mm from the axis, 90 mm above it. Every tile has 9 cm^2 but `left_prox`, which has 16 cm^2.

    pressure (normal) [kPa]   anterior   left   posterior   right     (unrolled, from outside)
    prox                         16        8        20        30
    mid                          40        2        25        -1
    end                          15        4.5      14         6

All forces follow one factor, 1 - cos(2 pi t / 24 s) / 2, over 24 s at 4 Hz: half at the start, 1.5
times at 12.0 s, and 1 in the mean, so that means over the trial are the values above. A second
trial, an hour later, has `HEAVIER` times the forces and the load of the first.

`HandMap` stands for the force map: it knows these forces, whatever the channels say, with errors
that all tiles share: 95 % of the draws lie within 1.96 standard deviations, `PRESSURE_SD`. What it
leaves to the product is everything between a tile's force in SI and a number that somebody reads.
"""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from socket_testbed.calibration.model import Calibration, ClusterCalibration, write_calibration
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry, write_socket
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.map_posterior import JointDraws
from socket_testbed.samples import Samples
from socket_testbed.simulation.trial import SimulatedTrial, write_simulated_trial
from socket_testbed.trials.metadata import TrialMetadata, write_metadata
from socket_testbed.trials.truth import GroundTruth

COLUMNS = ("ant", "left", "post", "right")  # at 0, 90, 180 and 270 degrees from anterior to left
# Pressure, shear towards proximal (on the end: anterior), shear along y of the tile [kPa].
STRESS = {
    "ant_prox": (16.0, -1.0, 0.0),
    "left_prox": (8.0, 0.0, 2.0),
    "post_prox": (20.0, 0.0, 0.0),
    "right_prox": (30.0, -8.0, 6.0),
    "ant_mid": (40.0, -3.0, 4.0),
    "left_mid": (2.0, 0.0, 0.0),
    "post_mid": (25.0, -5.0, -12.0),
    "right_mid": (-1.0, 0.0, 0.0),
    "ant_end": (15.0, 0.0, 0.0),
    "left_end": (4.5, 0.0, 0.0),
    "post_end": (14.0, 2.0, 1.0),
    "right_end": (6.0, 0.0, 0.0),
}
TILES = tuple(STRESS)
PRESSURE_SD = {**dict.fromkeys(TILES, 1.0), "right_end": 0.6, "left_mid": 0.5}  # [kPa]
SHEAR_SD = 0.5  # [kPa]; along x of every tile
CLUSTERS = {  # and the tile under each
    "brim_lateral": "right_prox",
    "mid_anterior": "ant_mid",
    "posterior_distal": "post_mid",
    "distal": "post_end",
}
TURNED = {"mid_anterior": 0.5 * np.pi}  # [rad]; its x is the tile's y

PERIOD = 0.25  # [s]
TIME = PERIOD * np.arange(96)  # [s]
FACTOR = 1.0 - 0.5 * np.cos(2.0 * np.pi * TIME / 24.0)
PEAK_ROW = 48
START = 1_800_000_000 * 10**9  # [ns]
STAMPS = START + np.round(1e9 * TIME).astype(np.int64)
HOUR = 3600 * 10**9  # [ns]; from the first trial to the second
HEAVIER = 1.25  # [-]; forces of the second trial over those of the first

CENTRE = np.array([0.0, 0.0, 0.15])  # of the tiles [m]
STIFFNESS = np.array([40e3, 30e3, 20e3])  # along x, y, z [N/m]
ROTATIONAL = np.array([2.0, 3.0, 1.0])  # about x, y, z [N m/deg]
MEAN_LOAD = np.array([14.0, 3.0, -60.0, 1.0, -2.0, 0.5])  # [F; M] about the centre [N, N m]
SWINGS = np.array([10.0, 10.0, 0.0, 0.5, 0.5, 0.3])  # [N, N m]; whole cycles in the trial
CYCLES = np.array([2, 3, 0, 4, 5, 7])


def frame(angle: float) -> np.ndarray:
    """The frame of a tile on the wall at an angle from anterior towards left [rad]."""
    inward, upwards = np.array([-np.cos(angle), -np.sin(angle), 0.0]), np.array([0.0, 0.0, 1.0])
    return np.column_stack([upwards, np.cross(inward, upwards), inward])


def geometry() -> SocketGeometry:
    """The socket of the scene."""
    places = {"prox": (0.05, 0.21), "mid": (0.05, 0.15), "end": (0.02, 0.09)}
    anchors, rotations = [], []
    for tile in TILES:
        column, level = tile.split("_")
        angle = 0.5 * np.pi * COLUMNS.index(column)
        radius, height = places[level]
        anchors.append([radius * np.cos(angle), radius * np.sin(angle), height])
        rotations.append(np.eye(3) if level == "end" else frame(angle))
    ring = [(4 * level + k, 4 * level + (k + 1) % 4) for level in range(3) for k in range(4)]
    upright = [(k, k + 4) for k in range(8)]
    triad = np.array([[0.0, 0.0, 0.0], [0.09, 0.0, 0.01], [-0.01, 0.045, 0.0]])
    return SocketGeometry(
        names=TILES,
        anchors=np.round(anchors, 12),
        rotations=np.round(rotations, 12),
        areas=np.where(np.array(TILES) == "left_prox", 16e-4, 9e-4),
        neighbours=np.array(sorted(tuple(sorted(pair)) for pair in [*ring, *upright])),
        clusters={name: TILES.index(tile) for name, tile in CLUSTERS.items()},
        socket_markers=triad,
        pylon_markers=triad + 0.01,
        socket_body=Pose(Rotation.from_rotvec([0.0, 0.0, 0.4]).as_matrix(), np.array([0.1, 0, 0])),
        limb=Pose(np.eye(3), np.array([0.0, 0.0, -0.2])),
        source="a scene made by hand",
        registration="made by hand",
        regions={"tibia": (0, 4), "fibula": (3, 7)},  # ant_prox, ant_mid; right_prox, right_mid
        turned=dict(TURNED),
    )


def calibration() -> Calibration:
    """Round coefficients: 20 kPa/pF from 5 pF on, and 30 kPa/pF of shear along either axis."""
    wirings = ([0, 1, 2, 3], [1, 0, 3, 2], [3, 2, 1, 0], [2, 3, 0, 1])
    clusters = {
        name: ClusterCalibration(
            normal=np.array([-100e3, 20e3]),
            shear=np.array([[0.0, 30e3, 0.0, 0, 0, 0], [0.0, 0.0, 30e3, 0, 0, 0]]),
            mean_range=np.array([4.0, 12.0]),
            difference_range=np.array([-1.8, 1.8]),
            wiring=np.array(wiring),
        )
        for name, wiring in zip(CLUSTERS, wirings, strict=True)
    }
    return Calibration(clusters, "2026-01-01", "made by hand")


def capacitances(cluster: str, scale: float = 1.0) -> np.ndarray:
    """What the inputs of a cluster's converter read, (N, 4) [pF]: the calibration inverted."""
    normal, along_x, along_y = scale * np.array(STRESS[CLUSTERS[cluster]])
    if cluster in TURNED:  # turned by +90 degrees, its x is the tile's y, its y is the tile's -x
        along_x, along_y = along_y, -along_x
    mean, dx, dy = 5.0 + FACTOR * normal / 20.0, FACTOR * along_x / 30.0, FACTOR * along_y / 30.0
    channels = [mean + 0.5 * (x * dx + y * dy) for x, y in ((-1, 1), (1, 1), (-1, -1), (1, -1))]
    wiring = calibration().clusters[cluster].wiring
    found = np.empty((len(FACTOR), 4))
    for channel, own in enumerate(channels):
        found[:, wiring[channel]] = own
    return found


def load(scale: float = 1.0) -> np.ndarray:
    """Load [F; M] on the socket about the centre of the tiles, (N, 6) [N, N m]."""
    found = MEAN_LOAD + SWINGS * np.sin(2.0 * np.pi * np.outer(TIME / 24.0, CYCLES))
    found[:, 2] = MEAN_LOAD[2] * FACTOR
    return scale * found


def wrench(scale: float = 1.0) -> np.ndarray:
    """Wrench [M; F] at the load cell, (N, 6) [N m, N]."""
    force, moment = np.hsplit(load(scale), 2)
    return np.hstack([moment + np.cross(CENTRE, force), force])


def limb(scale: float = 1.0) -> Pose:
    """Poses of the limb in {S}: its origin is the centre of the tiles, displaced by the load."""
    force, moment = np.hsplit(load(scale), 2)
    turned = Rotation.from_rotvec(np.radians(moment / ROTATIONAL))
    return Pose(turned.as_matrix(), CENTRE + force / STIFFNESS)


def factor_at(stamps: np.ndarray) -> np.ndarray:
    """The factor of all forces at some stamps [ns] of either trial."""
    later, elapsed = np.divmod(stamps - START, HOUR)
    rows = np.searchsorted(STAMPS - START, elapsed)
    return np.where(later, HEAVIER, 1.0) * FACTOR[rows]


def forces_in_tiles(stamps: np.ndarray) -> np.ndarray:
    """Forces on the tiles in their frames at some stamps [ns], (N, n, 3) [N]."""
    pressure, along_x, along_y = np.array([*STRESS.values()]).T
    once = 1e3 * geometry().areas[:, None] * np.column_stack([along_x, along_y, -pressure])
    return factor_at(stamps)[:, None, None] * once


def write(folder: Path, side: str = "right", subject: str = "S01", second: bool = False) -> Path:
    """Write the scene, or its second trial, with its files; returns its folder."""
    scale, stamps = (HEAVIER, STAMPS + HOUR) if second else (1.0, STAMPS)
    folder.parent.mkdir(parents=True, exist_ok=True)
    files = folder.parent / "socket.yaml", folder.parent / "calibration.yaml"
    write_socket(geometry(), files[0])
    write_calibration(calibration(), files[1])
    socket = geometry()
    world = Pose(Rotation.from_rotvec([0.0, 0.0, 1.2]).as_matrix(), np.array([1.0, 2.0, 0.5]))
    count = len(TIME)
    # Cameras see even a body at rest move in its last digits.
    tremor = 1e-9 * (np.arange(count) % 2)[:, None]
    turned = Rotation.from_rotvec(tremor * [0.0, 0.0, 1.0]).as_matrix() @ world.rotation
    still = Pose(turned, world.translation + tremor)
    # From the limb in {S} back to the pylon in the world.
    in_world = still @ socket.socket_body.inverse() @ limb(scale) @ socket.limb.inverse()
    poses = {"socket": still, "pylon": in_world}
    forces = np.einsum("nij,knj->kni", socket.rotations, forces_in_tiles(stamps))
    motion, load_cell = limb(scale), wrench(scale)
    truth = GroundTruth(TILES, forces, load_cell, motion.translation, motion.rotation_vector())
    trial = SimulatedTrial(
        stamps=stamps,
        capacitance={name: capacitances(name, scale) for name in CLUSTERS},
        wrench=load_cell,
        markers={name: poses[name].place(own) for name, own in socket.markers.items()},
        poses=poses,
        truth=truth,
    )
    write_simulated_trial(trial, folder, *files)
    metadata = TrialMetadata(subject=subject, side=side, socket="scene", mass=61.2)
    write_metadata(metadata, folder / "trial.yaml")
    return folder


class HandMap:
    """Stands for `ForceMap`: the forces of the scene, with errors that all tiles share."""

    def __init__(self, socket, clusters, settings=None, trial=None, surveyed=None) -> None:
        self.surveyed = surveyed
        self._areas = socket.areas
        self._rotations = socket.rotations
        self._errors = (
            1e3
            * self._areas[:, None]
            * np.column_stack(
                [
                    np.full(len(TILES), SHEAR_SD),
                    np.zeros(len(TILES)),
                    [-PRESSURE_SD[tile] for tile in TILES],
                ]
            )
        )  # one standard deviation, in the tiles' frames [N]

    def learn(self, sample: Samples) -> None:
        """Nothing: its errors are given."""

    def estimate(self, samples: Samples) -> MapEstimate:
        """The forces in {S} and what follows from them in a tile's frame."""
        forces = forces_in_tiles(samples.stamps)
        shape = forces.shape[:2]
        along = np.einsum("nij,nj->ni", self._rotations, self._errors)
        return MapEstimate(
            forces=np.einsum("nij,knj->kni", self._rotations, forces),
            standard_deviations=np.broadcast_to(np.abs(along), forces.shape).copy(),
            normal_pressure=-forces[..., 2] / self._areas,
            normal_pressure_standard_deviation=np.broadcast_to(
                1e3 * np.array([*PRESSURE_SD.values()]), shape
            ).copy(),
            shear=np.hypot(forces[..., 0], forces[..., 1]) / self._areas,
            shear_standard_deviation=np.full(shape, 1e3 * SHEAR_SD),
            source=self.source(samples),
        )

    update = estimate

    def mean(self, samples: Samples) -> MapEstimate:
        """The mean of the estimates, with N = 1; here the errors are the same at all samples."""
        found = self.estimate(samples)
        means = {n: v.mean(axis=0, keepdims=True) for n, v in vars(found).items() if n != "source"}
        return replace(found, **means)

    def source(self, samples: Samples) -> str:
        """What the map is conditioned on, in words."""
        return "made by hand"

    def sample(self, samples: Samples, count: int = 200) -> Iterator[JointDraws]:
        """Draws: a tenth of them 1.96 standard deviations above, a tenth below, the others exact.

        So the 2.5 % and 97.5 % quantiles are 1.96 standard deviations from the value.
        """
        half = count // 2
        steps = np.where(np.arange(half) < half // 5, 1.96, 0.0)
        once = (forces_in_tiles(STAMPS[:1]) / FACTOR[0]).reshape(-1, 1)
        yield JointDraws(
            rows=np.arange(len(samples)),
            channels=factor_at(samples.stamps)[:, None],
            gain=once[None],
            weights=np.ones(1),
            sizes=np.ones((len(samples), 1)),
            hypotheses=np.zeros(half, dtype=np.int64),
            errors=steps[:, None] * self._errors.reshape(-1),
        )


def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the product map forces by hand, wherever it makes a map of a trial or of live data."""
    for place in ("identification.checked", "live.estimator"):
        monkeypatch.setattr(f"socket_testbed.{place}.ForceMap", HandMap)


# Outputs over the whole trial with a threshold of 5 kPa: value, lower and upper end of the 95 %
# interval. By hand, for `anterior` (16, 40 and 15 kPa on three tiles of 9 cm^2):
#   peak: 1.5 * 40, +-1.25 * 1.96 * 1 kPa (the errors of peaks, contact areas and integrals are
#   widened by 1.25);
#   mean: (16 + 40 + 15) / 3 = 71 / 3, +-1.96; all three are always above 5 kPa, so 27 cm^2;
#   integral: 71 / 3 times the factor's integral, 0.25 * (96 - (0.5 + 0.50107) / 2) = 23.8749 s;
#   interval: +-1.25 * 1.96 kPa over 23.75 s;
#   share: 0.9 * (1 + 3 + 15) = 17.1 N downwards of 50.85 N on all tiles; draws: 17.1 / 49.4584
#   (shear 0.98 kPa more, pressure 1.96 kPa more) and 17.1 / 52.2416;
#   shear: mean (-1 - 3 + 0) / 3 along x and 4 / 3 along y, 135 degrees;
#   centre: weights 16, 40, 15 of x = 50, 50, 20 mm and z = 210, 150, 90 mm.
# `lateral`: 30, -1 and 6 kPa; pull does not count in the centre; `right_end` exceeds 5 kPa in 59 of
# 96 samples: 9 * (96 + 59) / 96 cm^2; in 43 and 77 of them with errors of 1.25 * 1.96 * 0.6 kPa.
ANSWERS: dict[str, dict[str, tuple[float, float, float]]] = {
    "anterior": {
        "peak pressure [kPa]": (60.0, 57.55, 62.45),
        "mean pressure [kPa]": (23.6667, 21.7067, 25.6267),
        "contact area [cm^2]": (27.0, 27.0, 27.0),
        "pressure-time integral [kPa s]": (565.0385, 506.8510, 623.2260),
        "share of load [%]": (33.6283, 32.7325, 34.5745),
        "shear [kPa]": (1.8856, 1.3794, 2.6701),
        "shear direction [deg]": (135.0, 104.8422, 150.0422),
        "centre of pressure x [mm]": (43.6620, 43.3819, 43.9926),
        "centre of pressure y [mm]": (0.0, 0.0, 0.0),
        "centre of pressure z [mm]": (150.8451, 150.7804, 150.9214),
    },
    "lateral": {
        "peak pressure [kPa]": (45.0, 42.55, 47.45),
        "mean pressure [kPa]": (11.6667, 9.9680, 13.3653),
        "contact area [cm^2]": (14.53125, 13.03125, 16.21875),
        "pressure-time integral [kPa s]": (275.3997, 243.1241, 310.5276),
        "share of load [%]": (24.7788, 24.0493, 25.4694),
        "shear [kPa]": (3.3333, 2.6163, 4.1591),
        "shear direction [deg]": (143.1301, 130.1421, 151.2576),
        "centre of pressure x [mm]": (0.0, 0.0, 0.0),
        "centre of pressure y [mm]": (-45.0, -45.5964, -44.6309),
        "centre of pressure z [mm]": (190.0, 187.0870, 192.3856),
    },
    "socket": {
        "peak pressure [kPa]": (60.0, 57.55, 62.45),
        "mean pressure [kPa]": (14.5348, 12.7128, 16.3567),
        "contact area [cm^2]": (84.5417, 74.8333, 93.8125),
        "pressure-time integral [kPa s]": (335.6998, 286.1639, 389.4480),
        "share of load [%]": (100.0, 100.0, 100.0),
        "shear [kPa]": (1.1908, 0.2786, 2.1632),
        "shear direction [deg]": (170.3313, 134.1147, 174.6951),
        "centre of pressure x [mm]": (3.0527, 2.7272, 3.4462),
        "centre of pressure y [mm]": (-3.8500, -5.1982, -2.9951),
        "centre of pressure z [mm]": (163.0854, 162.3531, 163.9347),
    },
}
# The motion of the limb: 60 N * 0.5 * 2 / 20 N/mm = 3 mm of pistoning; swings of the moments over
# the rotational stiffness, there and back: 2 * 0.5 / 2, 2 * 0.5 / 3 and 2 * 0.3 / 1 degrees. The
# range leaves out 2.5 % at either end, where a sine turns: at most 0.7 % less.
LIMB = {
    "pistoning [mm]": 3.0,
    "range of rotation about x [deg]": 0.5,
    "range of rotation about y [deg]": 1.0 / 3.0,
    "range of rotation about z [deg]": 0.6,
    "stiffness Fx [N/mm]": 40.0,
    "stiffness Fy [N/mm]": 30.0,
    "stiffness Fz [N/mm]": 20.0,
    "stiffness Mx [N m/deg]": 2.0,
    "stiffness My [N m/deg]": 3.0,
    "stiffness Mz [N m/deg]": 1.0,
}


def model(path: Path, name: str = "another") -> Path:
    """Write a model without springs, whose offsets alone predict; of a trial of that name.

    It predicts the mean wrench, but 1 N m too much about y and 40 N too much load along z, the mean
    force on `mid_anterior`, and none on the other clusters.
    """
    document = {
        "format": "socket_testbed model 1",
        "trial": {"name": name},
        "segment": "all 0.00 s to 23.75 s",
        "settings": {"variant": "stiffness_bias", "leave_out": ["distal.Fx"]},
        "geometry": geometry().to_document(),
        "parameters": {
            "variant": "stiffness_bias",
            "sharpness": 2000.0,
            "stiffness": [[0.0] * 3] * len(TILES),
            "rest_positions": [[0.0] * 3] * len(TILES),
            "wrench_bias": [0.55, 1.1, 0.5, 14.0, 3.0, -100.0],
            "force_bias": {"mid_anterior": [-2.7, 3.6, -36.0]},
            "clusters": [*CLUSTERS],
        },
        "quality": {
            "samples": len(TIME),
            "first_stamp": int(STAMPS[0]),
            "last_stamp": int(STAMPS[-1]),
            "wrench_rmse": [0.1, 0.2, 0.3, 1.0, 2.0, 3.0],
            "status": "made by hand",
        },
    }
    path.write_text(json.dumps(document))
    return path
