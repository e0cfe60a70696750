"""Motion of the limb in the socket under a load: load histories, tissue, equilibrium.

The physics is independent of the estimator's law. Normal pressure grows exponentially with the
compression along the surface normal, shear follows Coulomb stick-slip, compliance varies over the
surface, and part of the compression relaxes with time. The surface grid is finer than the tiles
and includes points between them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from socket_testbed.arrays import FloatArray
from socket_testbed.documents import check_number, check_whole
from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.samples import GRAVITY
from socket_testbed.settings.options import Scenario, SimulationOptions, TissueKind

SCENARIOS: tuple[Scenario, ...] = get_args(Scenario)
TISSUES: tuple[TissueKind, ...] = get_args(TissueKind)

_PYLON_MASS = 9.3  # [kg]; as published
_ADDED_MASS = 19.0  # [kg]; as published
_PYLON_POINT = np.array([0.004, -0.003, 0.45])  # [m]; centre of mass of the pylon in {S}
_ADDED_POINT = np.array([0.010, 0.007, 0.50])  # [m]; position of the added mass in {S}
_PLACING_TIME = 2.0  # [s]; to place or remove the mass
_SWAY_FORCE = 0.4  # [N]
_SWAY_TIME = 0.6  # [s]
_MAX_PUSH = 35.0  # [N]; of the hands
_PUSH_HEIGHT, _PUSH_TRAVEL = 0.35, 0.15  # [m]; above the load cell, and amplitude
_MAX_LEAN = _ADDED_MASS * GRAVITY  # [N]; of the hands on the pylon
_LEAN_ARM = 0.03  # [m]; about the axis
_MAX_TWIST = 1.5  # [N m]; of the hands about the axis
_HAND_PERIODS = np.array([11.0, 23.0, 7.3, 17.0, 9.1, 13.0])  # [s]
_GRID = 3  # points along the edge of a tile
_GAP_AREA = 0.25  # [-]; area between the tiles, relative to that of the tiles
# Standard deviations of a donning's differences at a share of 1, see `draw_donning`.
_SHIFT = 0.025  # [m]
_TURN = 0.4  # [rad]
_SEATING_ARM = 0.054  # [m]; the mean radius of the package's socket
_LENGTH = 0.1  # [m]; scales rotations to lengths for the solver
_FORCE_TOLERANCE = 1e-4  # [N]; imbalance accepted without a retry
_MAX_IMBALANCE = 0.05  # [N]; above it the socket does not hold the limb


def load_history(scenario: Scenario, time: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Wrench of the load on the limb about the origin of {S}, in {S}, [M; F], (N, 6) [N m, N].

    - `static_hold`: the pylon alone, then the mass placed, held and removed, as published;
    - `ramp`: the mass is put on and taken off slowly and repeatedly;
    - `multi_direction`: the mass is on and pushed from all sides;
    - `protocol`: pushes, leaning and twists for the first half, then the hold, then the pylon
      alone, as `docs/protocol.md` recommends.

    The sway of pylon and mass and the motion of the hands are random. In equilibrium it is the
    wrench of the limb on the socket. Gravity acts along -z of {S}.

    Args:
        scenario: One of those named here.
        time: Times since the start, ascending, shape (N,) [s]; the last one is the duration.
        rng: Random numbers of the sway and the hands.
    """
    duration = float(time[-1]) if len(time) else 0.0
    added = np.zeros((len(time), 3))
    hands = np.zeros((len(time), 6))
    if scenario == "static_hold":
        share = _trapezoid(time, 0.15 * duration, 0.85 * duration)
    elif scenario == "ramp":
        share = 0.5 - 0.5 * np.cos(2.0 * np.pi * time / min(30.0, max(duration, 1e-9)))
    elif scenario == "protocol":
        share = _trapezoid(time, 0.52 * duration, 0.9 * duration)
        hands += _trapezoid(time, 0.04 * duration, 0.5 * duration)[:, None] * _hands(time, rng)
    elif scenario == "multi_direction":
        share = _trapezoid(time, 0.05 * duration, 0.95 * duration)
        around, up, slow = 2.0 * np.pi * time / _HAND_PERIODS[[0, 3, 1], None]
        push = _MAX_PUSH * share * (0.6 + 0.4 * np.sin(slow))
        lift = 60.0 * share * np.sin(up)
        added = np.column_stack([push * np.cos(around), push * np.sin(around), lift])
    added[:, 2] -= share * _ADDED_MASS * GRAVITY
    added[:, :2] += _sway(time, rng) * (0.3 + share[:, None])

    pylon = np.tile([0.0, 0.0, -_PYLON_MASS * GRAVITY], (len(time), 1))
    moment = np.cross(_PYLON_POINT, pylon) + np.cross(_ADDED_POINT, added)
    return np.hstack([moment, pylon + added]) + hands


def _hands(time: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Wrench of hands that push, lean and twist, [M; F], shape (N, 6) [N m, N].

    They push from all sides at varying height, lean on the pylon's top off its axis, and twist.
    Each motion has its own period, so that no two stay in step; the phases are random.
    """
    phases = 2.0 * np.pi * (time[:, None] / _HAND_PERIODS + rng.uniform(0.0, 1.0, 6))
    around, strength, height, lean, side, twist = phases.T
    zero = np.zeros(len(time))
    sides = np.column_stack([np.cos(around), np.sin(around), zero])
    push = _MAX_PUSH * (0.6 + 0.4 * np.sin(strength))[:, None] * sides
    push_point = np.column_stack([zero, zero, _PUSH_HEIGHT + _PUSH_TRAVEL * np.sin(height)])
    down = np.column_stack([zero, zero, -_MAX_LEAN * (0.5 + 0.5 * np.sin(lean))])
    down_point = _LEAN_ARM * np.column_stack([np.cos(side), np.sin(side), zero])
    moment = np.cross(push_point, push) + np.cross(down_point, down)
    moment[:, 2] += _MAX_TWIST * np.sin(twist)
    return np.hstack([moment, push + down])


def _trapezoid(time: FloatArray, on: float, off: float) -> FloatArray:
    """Smooth rise from 0 to 1 at `on`, and fall back at `off`, shape (N,)."""
    rising = np.clip((time - on) / _PLACING_TIME, 0.0, 1.0)
    falling = np.clip((off - time) / _PLACING_TIME, 0.0, 1.0)
    share = np.minimum(rising, falling)
    return share * share * (3.0 - 2.0 * share)


def _sway(time: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Random horizontal forces of a standing person and a pylon, (N, 2) [N]."""
    sway = np.zeros((len(time), 2))
    steps = np.diff(time, prepend=time[:1])
    kicks = rng.normal(0.0, _SWAY_FORCE, (len(time), 2))
    for k in range(1, len(time)):
        keep = np.exp(-steps[k] / _SWAY_TIME)
        sway[k] = keep * sway[k - 1] + np.sqrt(1.0 - keep**2) * kicks[k]
    return sway


@dataclass(frozen=True)
class Tissue:
    """Mechanical properties of the p surface points.

    Attributes:
        points: Positions in {S}: nine of each tile, tile after tile, then one between each pair of
            neighbours, shape (p, 3) [m].
        normals: Inward normals in {S}, shape (p, 3) [-].
        areas: Area that each point stands for, shape (p,) [m^2].
        modulus: Normal pressure per compression at first contact, shape (p,) [Pa/m].
        stiffening: Compression over which the modulus grows by a factor e [m].
        shear_modulus: Shear stress per tangential displacement while sticking, shape (p,) [Pa/m].
        friction: Coefficient of friction: shear slips at this fraction of the normal pressure [-].
        fit: Compression by donning, negative for a gap, shape (p,) [m].
        creep: Fraction of the compression that relaxes [-].
        creep_time: Time constant of the relaxation [s].
    """

    points: FloatArray
    normals: FloatArray
    areas: FloatArray
    modulus: FloatArray
    stiffening: float
    shear_modulus: FloatArray
    friction: float
    fit: FloatArray
    creep: float
    creep_time: float


@dataclass(frozen=True)
class Donning:
    """How a donning of a limb differs from the nominal one.

    Attributes:
        shift: Displacement of the limb's tissue in the socket, in {S}, shape (3,) [m].
        turn: Rotation vector of the tissue about the mean of the tiles' centres, in {S}, shape (3,)
            [rad].
        preload: Change of the mean compression by donning, relative to it [-].
        seating: Shear that is left at each point of the surface as the limb slid into place,
            relative to what friction can hold there: a rigid motion in {S}, translation and
            rotation vector, whose tangential part it is, shape (6,) [-, 1/m].
    """

    shift: FloatArray
    turn: FloatArray
    preload: float
    seating: FloatArray


def check_donning(donning: object, share: object) -> int | None:
    """Seed of a donning, or None for the nominal one.

    Args:
        donning: The seed as a user gave it; None for the nominal donning.
        share: How much the donning differs, as a user gave it [-].

    Raises:
        ConfigurationError: The seed is no whole number from 0, the share is not within 0 to 1, or a
            share is given without a seed.
    """
    check_number(share, "--donning-share", 0.0, 1.0)
    if donning is not None:
        return check_whole(donning, "--donning")
    if share != SimulationOptions.donning_share:
        raise ConfigurationError(
            f"--donning-share is {share}, but no donning is given",
            "add --donning SEED: the nominal donning does not vary",
        )
    return None


def draw_donning(share: float, rng: np.random.Generator) -> Donning:
    """A random donning, whose differences have the standard deviations below.

    At a share of 10 %, the default, the tissue is shifted by 2.5 mm and turned by 2.3 degrees about
    each axis, the mean compression changes by 10 % (0.2 mm in soft tissue, 0.08 mm in stiff), and
    seating leaves a tenth of the shear that friction can hold, along each axis and by a twist about
    each. All are proportional to the share.

    Args:
        share: About the standard deviation of a tile's force between donnings, relative to the
            root mean square over the tiles [-]; docs/survey.md reports the measured one.
        rng: Random numbers of the donning.
    """
    shift, turn, push, twist = rng.normal(0.0, 1.0, (4, 3))
    seating = np.concatenate([push, twist / _SEATING_ARM])
    return Donning(
        shift=share * _SHIFT * shift,
        turn=share * _TURN * turn,
        preload=share * float(rng.normal()),
        seating=share * seating,
    )


# By kind: modulus and shear modulus [Pa/m], their variation over the surface [-], stiffening, and
# mean and spread of the fit [m] (see `Tissue`).
_KINDS: dict[TissueKind, tuple[float, ...]] = {
    "soft": (1.5e6, 2.7e5, 0.25, 0.015, 0.002, 0.001),
    "stiff": (6.0e6, 2.7e6, 0.45, 0.004, 0.0008, 0.0006),
}


def make_tissue(
    geometry: SocketGeometry,
    rng: np.random.Generator,
    kind: TissueKind = "soft",
    donning: Donning | None = None,
) -> Tissue:
    """Tissue whose properties vary smoothly over a socket's surface.

    The `soft` tissue models the published experiment: silicone cast around a rigid bone.

    - Silicone of Shore 00-30 bears 69 kPa at 100 % elongation (data sheet of Ecoflex 00-30,
      Smooth-On: 10 psi). A neo-Hookean solid bears G (l - 1 / l^2) at stretch l, or 1.75 G at 2, so
      the secant G is 39 kPa. At small strains it is lower: E = 3 G = 70 to 80 kPa. Here E = 75 kPa,
      G = 25 kPa, incompressible.
    - The limb is a cylinder of radius b = 54 mm, the mean of the package's socket, around a bone
      of radius a = 10 mm.
    - Axial load shears the silicone between bone and socket; per area, G / (b ln(b / a))
      = 0.27 MPa/m (Adkins and Gent, Br. J. Appl. Phys. 5 (1954) 354).
    - Across the axis the silicone flows around the bone. In plane strain with a sliding wall (a
      sock), the creeping-flow stream function (A r^3 + B r + C / r + D r ln r) sin(theta) gives a
      stiffness K = 4 pi G D per unit length. A bed of springs of modulus m has pi b m, so
      m = 1.5 MPa/m. Bonded to both, the total would be 2.4 (long) or 1.1 MPa/m (short)
      (Horton, Gover and Tupholme, Rubber Chem. Technol. 73 (2000) 253).
    - The tangent of the true stress in a neo-Hookean layer of 44 mm grows by (1 + 2 / l^3) / 3, to
      1.9 times at 25 % compression, or by e over 15 mm of compression.
    - The layer's thickness varies, so the moduli vary by a quarter over the surface. Donning
      compresses it by 2 mm, plus or minus 1 mm.

    Under the published load the limb settles 7 mm (5 to 10 mm, by seed); about 8 mm was measured.

    The `stiff` tissue is thin and firm, with 4 times the normal and 10 times the shear modulus.

    Args:
        geometry: The socket, with n tiles and e pairs of neighbours: 9 n + e surface points.
        rng: Random numbers of the variation over the surface.
        kind: `soft` or `stiff`.
        donning: How the limb was put on; None for the nominal donning.
    """
    modulus, shear_modulus, spread, stiffening, fit, fit_spread = _KINDS[kind]
    edges = np.sqrt(geometry.areas)
    offsets = (np.arange(_GRID) + 0.5) / _GRID - 0.5
    grid = np.array([[x, y, 0.0] for x in offsets for y in offsets])
    on_tiles = geometry.anchors[:, None] + np.einsum(
        "nij,gj->ngi", geometry.square_frames(), grid
    ) * edges.reshape(-1, 1, 1)
    normals = geometry.rotations[:, :, 2]
    a, b = geometry.neighbours.T
    between = 0.5 * (geometry.anchors[a] + geometry.anchors[b])
    between_normals = normals[a] + normals[b]
    between_normals /= np.linalg.norm(between_normals, axis=1, keepdims=True)
    gap_area = _GAP_AREA * geometry.areas.sum() / max(len(a), 1)

    points = np.vstack([on_tiles.reshape(-1, 3), between])
    of_limb, preload = points, 1.0
    if donning is not None:
        centre = geometry.anchors.mean(axis=0)
        turned = (points - centre) @ Rotation.from_rotvec(donning.turn).as_matrix()
        of_limb = centre + turned - donning.shift
        preload = 1.0 + donning.preload
    variation = np.exp(spread * _smooth_field(of_limb, rng))
    return Tissue(
        points=points,
        normals=np.vstack([np.repeat(normals, _GRID**2, axis=0), between_normals]),
        areas=np.concatenate(
            [np.repeat(geometry.areas / _GRID**2, _GRID**2), np.full(len(a), gap_area)]
        ),
        modulus=modulus * variation,
        stiffening=stiffening,
        shear_modulus=shear_modulus * variation,
        friction=0.5,
        fit=fit * preload + fit_spread * _smooth_field(of_limb, rng),
        creep=0.18,
        creep_time=35.0,
    )


def _smooth_field(points: FloatArray, rng: np.random.Generator) -> FloatArray:
    """A random field of about unit variance that varies over about 0.1 m, shape (p,)."""
    waves = rng.normal(0.0, 1.0 / 0.06, (12, 3))
    phases = rng.uniform(0.0, 2.0 * np.pi, 12)
    return np.sqrt(2.0 / 12.0) * np.cos(points @ waves.T + phases).sum(axis=1)


class LoadedLimb:
    """A limb, a rigid bone in tissue, donned under a first load.

    It moves quasi-statically between equilibria.

    Args:
        geometry: The socket.
        load: The first load [M; F] about the origin of {S}, in {S}, shape (6,) [N m, N]; three
            quarters of it are applied in steps.
        rng: Random numbers of the tissue.
        kind: Kind of the tissue, see `make_tissue`.
        donning: How the limb was put on; None for the nominal donning.

    Attributes:
        tissue: The tissue.
        position: Limb position q in {S}, shape (3,) [m].
        rotation: Rotation vector of the limb since donning, in {S}, shape (3,) [rad].
        forces: Force of the limb on the socket at every surface point, in {S}, shape (p, 3) [N].
    """

    def __init__(
        self,
        geometry: SocketGeometry,
        load: FloatArray,
        rng: np.random.Generator,
        kind: TissueKind = "soft",
        donning: Donning | None = None,
    ) -> None:
        self.tissue = tissue = make_tissue(geometry, rng, kind, donning)
        self._tiles = len(geometry)
        self._centre = geometry.anchors.mean(axis=0)  # centre of rotation of the bone
        self._axes = _axes(tissue.normals)
        arms = np.cross(tissue.points - self._centre, self._axes)
        # Linear map from the bone's displacement to those of the points along their axes.
        self._jacobian = np.concatenate([self._axes, arms], axis=2).reshape(-1, 6)
        self._tangent: FloatArray | None = None  # Jacobian of the imbalance at the last equilibrium
        self._displacement = np.zeros(6)  # of the centre [m], and rotation vector [rad]
        self._crept = tissue.creep * np.maximum(tissue.fit, 0.0)
        self._traction = np.zeros((2, len(tissue.points)))
        if donning is not None:
            held = tissue.friction * tissue.modulus * np.maximum(tissue.fit, 0.0)
            self._traction = held * (self._jacobian @ donning.seating).reshape(3, -1)[1:]
        self._tangential = np.zeros((2, len(tissue.points)))
        for share in (0.25, 0.5, 0.75):  # donning: apply the first load in steps
            self.step(share * load, 1.0)

    def step(self, load: FloatArray, duration: float) -> FloatArray:
        """Move to the equilibrium under a load.

        Args:
            load: Wrench of the load on the limb [M; F] about the origin of {S}, in {S}, shape (6,)
                [N m, N].
            duration: Time since the step before, in which the tissue creeps [s].

        Returns:
            The force of the limb on the socket at each of the n tiles, in {S}, shape (n, 3) [N];
            that between the tiles is only in `forces`.

        Raises:
            TestbedError: There is no equilibrium: the load is too large, or the socket does not
                hold the limb.
        """
        scale = 1e-3 * np.repeat([1.0, 1.0 / _LENGTH], 3)
        balance = np.concatenate([load[3:], load[:3] - np.cross(self._centre, load[3:])])
        lengths = np.repeat([1.0, _LENGTH], 3)

        def imbalance(x: FloatArray) -> FloatArray:
            # Virtual work; moments about the limb's centre decouple from the forces.
            forces = self._respond(x * scale, duration)[0]
            return np.asarray((forces.ravel() @ self._jacobian - balance) / lengths)

        start = self._displacement / scale
        answer = self._solve(imbalance, start)
        if np.abs(answer.fun).max() > _FORCE_TOLERANCE:
            # Powell's steps may stall where the surface starts to slip: use another method.
            answer = root(imbalance, start, method="lm", options={"xtol": 1e-12, "ftol": 1e-14})
        if np.abs(answer.fun).max() > _MAX_IMBALANCE:
            raise TestbedError(
                f"no equilibrium under the load {np.round(load, 2).tolist()} [N m, N]",
                "give a smaller load or a socket that holds the limb",
            )
        self._displacement = answer.x * scale
        forces, self._crept, self._traction, self._tangential = self._respond(
            self._displacement, duration
        )
        self.position = self._centre + self._displacement[:3]
        self.rotation = self._displacement[3:].copy()
        self.forces = np.einsum("ap,api->pi", forces, self._axes)
        on_tiles = self.forces[: self._tiles * _GRID**2]
        return on_tiles.reshape(self._tiles, -1, 3).sum(axis=1)

    def _solve(self, imbalance: Callable[[FloatArray], FloatArray], start: FloatArray) -> Any:
        """Solve by Powell's hybrid method, starting with the tangent of the previous step."""
        options = {"xtol": 1e-10}
        if (tangent := self._tangent) is not None:
            answer = root(imbalance, start, jac=lambda x: tangent, method="hybr", options=options)
        if tangent is None or np.abs(answer.fun).max() > _FORCE_TOLERANCE:
            answer = root(imbalance, start, method="hybr", options=options)
        triangle = np.zeros((6, 6))
        triangle[np.triu_indices(6)] = answer.r
        self._tangent = answer.fjac.T @ triangle
        return answer

    def _respond(
        self, displacement: FloatArray, duration: float
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Forces on the socket, crept compression, shear traction, tangential displacement.

        Forces are along the axes of the points, shape (3, p), tractions and tangential
        displacements along the last two axes, shape (2, p).
        """
        tissue = self.tissue
        along_normal, *across = (self._jacobian @ displacement).reshape(3, -1)
        compression = tissue.fit - along_normal

        rate = duration / tissue.creep_time
        target = tissue.creep * np.maximum(compression, 0.0)
        crept = (self._crept + rate * target) / (1.0 + rate)
        elastic = np.maximum(compression - crept, 0.0)
        pressure = tissue.modulus * tissue.stiffening * np.expm1(elastic / tissue.stiffening)

        tangential = np.array(across)
        traction = self._traction + tissue.shear_modulus * (tangential - self._tangential)
        size = np.hypot(*traction)
        limit = tissue.friction * pressure
        traction *= np.minimum(1.0, limit / np.maximum(size, 1e-12))

        forces = tissue.areas * np.vstack([-pressure, traction])
        return forces, crept, traction, tangential


def _axes(normals: FloatArray) -> FloatArray:
    """Normal and two tangents of each point, shape (3, p, 3) [-]."""
    least = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([normals, first, np.cross(normals, first)])
