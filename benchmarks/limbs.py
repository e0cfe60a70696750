"""Limbs of other physics than the package's simulator: what the force map is judged on.

Each family is a law of contact that neither the estimator nor `socket_testbed.simulation` has. A
limb is moved by a rigid motion that swings about a load along the socket; its forces on the tiles
then have the wrench that the load cell measures, with a share that the surface between the tiles
bears. Sensors have errors of gain and offset, and noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import ConvexHull, Delaunay, cKDTree

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.regions import proximal_direction
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact import wrench_map
from socket_testbed.samples import Samples

_STEPS = 24  # load states of a trial
_SHARE_SPREAD = 0.05  # [-]; wider than the map assumes
_ARM = 0.06  # [m]; where a rotation moves a tile as far as a translation
_GAIN, _OFFSET, _NOISE = 0.03, 0.3, 0.1  # of a cluster's channels: [-], [N], [N]
_WRENCH_OFFSET = np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0])  # [N m], [N]
_CELL = 0.010  # [m]; edge of a finite element
_NODES = 9  # of the skin that bear a tile's force


@dataclass(frozen=True)
class Trial:
    """Samples of a limb in a socket, and the true forces on the tiles in {S}, (N, n, 3) [N]."""

    samples: Samples
    forces: FloatArray


class Limb:
    """What all families share: the socket, random fields on it, and motions of the limb."""

    def __init__(self, geometry: SocketGeometry, rng: np.random.Generator) -> None:
        self.geometry, self.rng = geometry, rng
        self.normals = geometry.rotations[:, :, 2]  # inward
        self.apart = np.linalg.norm(geometry.anchors[:, None] - geometry.anchors, axis=2)

    def field(self, length: float) -> FloatArray:
        """A random field of the variance 1 that varies over a length [m], shape (n,) [-]."""
        covariance = np.exp(-0.5 * (self.apart / length) ** 2) + 1e-6 * np.eye(len(self.apart))
        return np.linalg.cholesky(covariance) @ self.rng.standard_normal(len(self.apart))

    def motions(self) -> FloatArray:
        """Displacements of the limb's skin at the tiles, the load's being 1, shape (N, n, 3)."""
        anchors, proximal = self.geometry.anchors, proximal_direction(self.geometry)
        swing = 1.0 if self.rng.random() < 0.5 else 0.3  # pushed around, or held
        down = np.clip(1.0 + 0.35 * swing * self._walk(), 0.25, 2.0)
        across = np.linalg.svd(proximal[None])[2][1:]
        shift = 0.12 * swing * np.column_stack([self._walk(), self._walk()])
        turn = 0.09 * swing * np.column_stack([self._walk() for _ in range(3)])
        moved = -down[:, None] * proximal + shift @ across
        return moved[:, None] + np.cross(turn[:, None], (anchors - anchors.mean(axis=0)) / _ARM)

    def share(self) -> float:
        """A share of the load on the tiles [-], about the share of the wall that they cover."""
        covered = self.geometry.tile_share
        assert covered is not None
        return min(self.rng.normal(covered, _SHARE_SPREAD), 1.0)

    def _walk(self) -> FloatArray:
        """A smooth random course of the size 1, shape (N,)."""
        time, rng = np.linspace(0.0, 2.0 * np.pi, _STEPS), self.rng
        waves = [rng.normal() / k * np.sin(k * time + rng.uniform(0.0, 6.28)) for k in (1, 2, 3)]
        return np.asarray(np.sum(waves, axis=0))

    def split(self, vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Parts of vectors (..., n, 3): outward along the normal (..., n), and tangential."""
        outward = -(vectors * self.normals).sum(axis=-1)
        return outward, vectors + outward[..., None] * self.normals

    def trial(self, forces: FloatArray, share: float, load: float | None) -> Trial:
        """What the testbed measures of forces, which are scaled to a mean load [N].

        Args:
            forces: Forces on the tiles in {S}, shape (N, n, 3).
            share: Share of the wrench that the tiles bear [-].
            load: Mean load [N]; None for the forces as they are.
        """
        geometry, rng = self.geometry, self.rng
        wrench = forces.reshape(len(forces), -1) @ wrench_map(geometry.anchors).T / share
        scale = 1.0 if load is None else load / np.abs(wrench[:, 5]).mean()
        forces, wrench = scale * forces, scale * wrench
        tiles = list(geometry.clusters.values())
        local = np.einsum("cji,kcj->kci", geometry.rotations[tiles], forces[:, tiles])
        local *= 1.0 + _GAIN * rng.standard_normal(local.shape[1:])
        local += _OFFSET * rng.standard_normal(local.shape[1:])
        local += _NOISE * rng.standard_normal(local.shape)
        wrench += _WRENCH_OFFSET * rng.standard_normal(6)
        nothing = np.full((len(wrench), 3), np.nan)
        stamps = np.arange(len(wrench), dtype=np.int64) * 500_000_000
        status = np.zeros(local.shape[:2], dtype=np.uint8)
        names = tuple(geometry.clusters)
        return Trial(Samples(stamps, nothing, nothing, wrench, names, local, status), forces)


def friction_bed(limb: Limb) -> Trial:
    """Independent linear springs with Coulomb friction, which remembers how it was loaded."""
    rng, geometry = limb.rng, limb.geometry
    stiffness = np.exp(0.4 * limb.field(rng.uniform(0.03, 0.12)))
    if rng.random() < 0.4:  # a bony end
        height = geometry.anchors @ proximal_direction(geometry)
        stiffness *= 1.0 + 2.0 * np.exp(-(((height - height.min()) / 0.03) ** 2))
    preload = 0.3 * rng.random() * np.exp(0.5 * limb.field(0.06))
    friction, tangential = rng.uniform(0.2, 0.6), stiffness * rng.uniform(0.2, 0.8)
    motions = limb.motions()
    donning = np.linspace(0.2, 1.0, 5)[:, None, None] * motions[0]
    held, last, found = np.zeros((2, *motions.shape[1:])), 0.0, []
    held = held[0]
    for moved in (*donning, *motions):
        outward, _ = limb.split(moved)
        normal = stiffness * np.maximum(outward + preload, 0.0)
        held += tangential[:, None] * limb.split(moved - last)[1]
        held *= _within(held, friction * normal)
        last = moved
        found.append(held - normal[:, None] * limb.normals)
    return limb.trial(np.array(found[5:]), limb.share(), rng.uniform(250.0, 700.0))


def finite_elements(limb: Limb) -> Trial:
    """Soft tissue on a rigid bone, linear elastic, in contact with a rigid wall with friction."""
    rng = limb.rng
    along, tangential = _compliances(limb, rng.uniform(0.25, 0.5))
    mismatch = 0.2 * rng.random() + 0.3 * rng.random() * limb.field(rng.uniform(0.04, 0.08))
    friction = rng.uniform(0.0, 0.5)
    root = np.linalg.cholesky(along)
    found = []
    for moved in limb.motions():
        outward, sideways = limb.split(moved)
        # The contact forces that deform the tissue by the overlap: least energy, none pulls.
        normal = nnls(root.T, np.linalg.solve(root, outward + mismatch))[0]
        shear = np.linalg.solve(tangential, sideways)
        shear *= _within(shear, friction * normal)
        found.append(limb.split(shear)[1] - normal[:, None] * limb.normals)
    return limb.trial(np.array(found), limb.share(), rng.uniform(250.0, 700.0))


def published_law(limb: Limb) -> Trial:
    """The published bed: tri-axial springs with rest positions of their own, by translation."""
    rng, rotations = limb.rng, limb.geometry.rotations
    stiffness = 2500.0 * np.exp(0.5 * limb.field(0.04))  # [N/m]
    rest = np.column_stack([limb.field(0.03) for _ in range(3)])
    if rng.random() < 0.5:
        rest = rng.uniform(-1.5, 1.5, rest.shape)
    position = 4e-3 * limb.motions().mean(axis=1)  # [m]
    local = np.einsum("nji,knj->kni", rotations, position[:, None] - 4e-3 * rest)
    local *= stiffness[:, None]
    local[..., 2] = np.minimum(local[..., 2], 0.0)
    return limb.trial(np.einsum("nij,knj->kni", rotations, local), 1.0, None)


FAMILIES: dict[str, Callable[[Limb], Trial]] = {
    "finite elements": finite_elements,
    "friction bed": friction_bed,
    "published law": published_law,
}


def _within(forces: FloatArray, limit: FloatArray) -> FloatArray:
    """Factors that keep forces (n, 3) within a limit (n,), shape (n, 1) [-]."""
    sizes = np.linalg.norm(forces, axis=1)
    return np.asarray(np.minimum(1.0, limit / np.maximum(sizes, 1e-12))[:, None])


def _compliances(limb: Limb, bone: float) -> tuple[FloatArray, FloatArray]:
    """Displacements of the skin by forces on the tiles, shape (n, n) each: normal, tangential.

    Finite elements in cubes that fill the hull of the tiles; the bone is a core of a share of the
    radius that ends above the distal end. Only ratios count: the stiffness is 1.
    """
    from scipy.sparse.linalg import splu
    from skfem import Basis, ElementHex1, ElementVector, MeshHex
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    anchors, axis = limb.geometry.anchors, proximal_direction(limb.geometry)
    low, high = anchors.min(axis=0) - _CELL, anchors.max(axis=0) + _CELL
    grid = MeshHex.init_tensor(*(np.arange(a, b, _CELL) for a, b in zip(low, high, strict=True)))
    centres = grid.p[:, grid.t].mean(axis=1).T
    hull = Delaunay(anchors[ConvexHull(anchors).vertices])
    mesh = grid.restrict(np.flatnonzero(hull.find_simplex(centres) >= 0)).remove_unused_nodes()
    basis = Basis(mesh, ElementVector(ElementHex1()))
    stiffness = linear_elasticity(*lame_parameters(1.0, 0.45)).assemble(basis)
    middle = anchors.mean(axis=0)
    points, height = mesh.p.T - middle, (mesh.p.T - middle) @ axis
    radius = np.linalg.norm(points - height[:, None] * axis, axis=1)
    outer = np.linalg.norm((anchors - middle) - ((anchors - middle) @ axis)[:, None] * axis, axis=1)
    lowest = ((anchors - middle) @ axis).min()
    core = (radius < bone * outer.max()) & (height > lowest + 3 * _CELL)
    degrees = basis.nodal_dofs  # (3, nodes)
    free = np.setdiff1d(np.arange(basis.N), degrees[:, core].ravel())
    factor = splu(stiffness[free][:, free].tocsc(), permc_spec="MMD_AT_PLUS_A")
    surface = np.setdiff1d(mesh.boundary_nodes(), np.flatnonzero(core))
    nearest = surface[cKDTree(mesh.p[:, surface].T).query(anchors, k=_NODES)[1]]
    tiles = len(anchors)
    tangents = limb.geometry.rotations[:, :, 0]
    found = []
    for directions in (limb.normals, tangents):
        loads = np.zeros((basis.N, tiles))
        for tile, nodes in enumerate(nearest):
            for component in range(3):
                loads[degrees[component, nodes], tile] = directions[tile, component] / len(nodes)
        moved = loads[free].T @ factor.solve(loads[free])
        found.append(0.5 * (moved + moved.T) + 1e-3 * np.trace(moved) / tiles * np.eye(tiles))
    return found[0], found[1]
