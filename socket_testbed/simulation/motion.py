"""How the limb and the marker bodies move under a load."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.simulation.sensors import SensorErrors, misregister
from socket_testbed.simulation.tissue import LimbInSocket, make_tissue

_SOCKET_IN_WORLD = Pose(
    Rotation.from_euler("zyx", [35.0, 4.0, -3.0], degrees=True).as_matrix(),
    np.array([0.42, -0.31, 0.74]),
)
_STAND_COMPLIANCE = 1e-6  # [m/N]; the stand gives a little under the load
_STAND_TREMOR = 2e-5  # [m]


class LoadedLimb:
    """A limb that is donned and then follows its load from equilibrium to equilibrium.

    Args:
        geometry: Geometry of the socket.
        load: The first load [M; F], shape (6,) [N m, N].
        rng: Source of the tissue's variation.

    Attributes:
        position: Limb position q in {S}, shape (3,) [m].
        rotation: Rotation vector of the limb since donning, shape (3,) [rad].
    """

    def __init__(
        self, geometry: SocketGeometry, load: FloatArray, rng: np.random.Generator
    ) -> None:
        tissue = make_tissue(geometry, rng)
        self._centre = geometry.anchors.mean(axis=0)
        self._limb = LimbInSocket(tissue, self._centre)
        self._covered = tissue.tile >= 0
        self._tile = tissue.tile[self._covered]
        self._tiles = len(geometry)
        for share in (0.25, 0.5, 0.75):  # donning: the first load comes in steps
            self.step(share * load, 1.0)

    def step(self, load: FloatArray, duration: float) -> FloatArray:
        """Follow a load for a while.

        Args:
            load: Load [M; F], shape (6,) [N m, N].
            duration: Time since the step before [s].

        Returns:
            Force of the limb on the socket at every tile, shape (n, 3) [N].
        """
        response = self._limb.step(load, duration)
        self.position = self._centre + self._limb.displacement[:3]
        self.rotation = self._limb.displacement[3:].copy()
        forces = np.zeros((self._tiles, 3))
        np.add.at(forces, self._tile, response[self._covered])
        return forces


class MarkerBodies:
    """The marker bodies of socket and pylon as they really are.

    Args:
        geometry: What the lab believes of them.
        errors: Sizes of the errors of their registration.
        rng: Source of these errors and of the stand's tremor.
    """

    def __init__(
        self, geometry: SocketGeometry, errors: SensorErrors, rng: np.random.Generator
    ) -> None:
        self._rng = rng
        self._socket_body = misregister(geometry.socket_body, errors, rng)
        self._limb_in_body = misregister(geometry.limb, errors, rng)

    def poses(
        self,
        position: FloatArray,
        rotation: FloatArray,
        load: FloatArray,
        swayed: FloatArray | None = None,
    ) -> tuple[Pose, Pose]:
        """True poses of the bodies of socket and pylon in the world, N of each.

        Args:
            position: Limb positions in {S}, shape (N, 3) [m].
            rotation: Rotation vectors of the limb, shape (N, 3) [rad].
            load: Loads [M; F], shape (N, 6) [N m, N].
            swayed: Displacement of the whole stand in the world, shape (3,) [m].
        """
        count = len(position)
        shift = self._rng.normal(0.0, _STAND_TREMOR, (count, 3)) - _STAND_COMPLIANCE * load[:, 3:]
        if swayed is not None:
            shift += swayed
        world = Pose(
            np.tile(_SOCKET_IN_WORLD.rotation, (count, 1, 1)),
            _SOCKET_IN_WORLD.translation + shift,
        )
        limb = Pose(Rotation.from_rotvec(rotation).as_matrix(), position)
        # socket_body maps the body to {S}; world maps {S} to the world.
        return world @ self._socket_body, world @ limb @ self._limb_in_body.inverse()
