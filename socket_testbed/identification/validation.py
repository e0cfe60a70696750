r"""How far estimates hold on data that they have not seen, beside simple rivals.

Three questions, each answered for an estimate and for its rivals on the same samples:

- `cluster`: the force on a cluster that was left out, from the other clusters and the wrench;
- `wrench`: the wrench from the limb's pose alone, on samples that no fit has seen;
- `tiles`: the force on the tiles without a sensor, where a simulation knows it.

The rivals are what needs no model: inverse-distance interpolation of the clusters, the same with
the smallest change that meets the wrench, the best constant, and linear regression on the pose.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact import ContactModel, wrench_map
from socket_testbed.identification.evaluation import predict_channels
from socket_testbed.samples import Samples, Status

LEVELS = (0.5, 0.8, 0.95)  # [-]; of the intervals whose coverage is judged
INVERSE_DISTANCE = "inverse distance"
CLOSED = "inverse distance, wrench met"
CONSTANT = "best constant"
REGRESSION = "linear regression on the pose"
FIRST_HALF, SECOND_HALF = "first half", "second half"

_EXPONENT = 2.0  # [-]; Shepard's
_NEAR = 1e-6  # [m]; a tile nearer than this to a cluster's is that tile
_RANK = 1e-10  # [-]; smallest singular value of the standardised poses, relative to the largest
_ROUNDING = 1e-12  # [-]; spread of a pose's component that is constant, against its size
_UNKNOWN = (float("nan"),) * len(LEVELS)

Question = Literal["cluster", "wrench", "tiles"]


@dataclass(frozen=True)
class Judgement:
    """Errors of one predictor on one question; NaN where the question has no such figure.

    Attributes:
        question: `cluster`, `wrench` or `tiles`: see this module.
        predictor: An estimate or a rival.
        fitted_on: The samples that it was fitted on; empty for what needs no fit.
        tested_on: The samples that it was judged on.
        cluster: The cluster that was left out; empty for all of them.
        in_sample: Whether it was fitted on the samples that it is judged on.
        samples: Number of samples.
        error: Root mean square error of the forces over their root mean square [-]; 1 is what
            predicting zero has.
        moment_rmse: Mean RMSE of the moments [N m].
        force_rmse: Mean RMSE of the forces [N].
        moment_skill: 1 - `moment_rmse` over that of the constants which fit these samples
            best [-].
        force_skill: The same of `force_rmse` [-].
        coverage: Share of the values that the intervals of `LEVELS` hold [-].
    """

    question: Question
    predictor: str
    fitted_on: str
    tested_on: str
    cluster: str = ""
    in_sample: bool = False
    samples: int = 0
    error: float = float("nan")
    moment_rmse: float = float("nan")
    force_rmse: float = float("nan")
    moment_skill: float = float("nan")
    force_skill: float = float("nan")
    coverage: tuple[float, ...] = _UNKNOWN


def inverse_distance(
    geometry: SocketGeometry, clusters: Sequence[str], local_forces: FloatArray
) -> FloatArray:
    r"""Interpolate the clusters' forces over the socket by the inverse square of the distance.

    .. math:: F_i = R_i \frac{\sum_c w_{ic} f_c}{\sum_c w_{ic}}, \qquad
              w_{ic} = \lVert a_i - a_c \rVert^{-2}

    with f_c in the cluster's frame, so that a pressure stays a pressure around the socket
    (Shepard, Proc. 23rd ACM National Conference, 1968). A cluster's own tile has its force.

    Args:
        geometry: Geometry of the socket.
        clusters: Names of the c clusters.
        local_forces: Force on each in its frame, shape (N, c, 3) [N]; NaN where there is none.

    Returns:
        Forces in {S}, shape (N, n, 3) [N]; NaN in samples without any cluster.
    """
    tiles = [geometry.clusters[name] for name in clusters]
    apart = np.linalg.norm(geometry.anchors[:, None] - geometry.anchors[tiles], axis=2)
    weights = np.maximum(apart, _NEAR) ** -_EXPONENT
    known = np.asarray(np.isfinite(local_forces).all(axis=2))
    total = known @ weights.T
    summed = np.einsum("ic,kcj->kij", weights, np.where(known[:, :, None], local_forces, 0.0))
    with np.errstate(invalid="ignore"):
        local = summed / total[:, :, None]
    return np.einsum("iab,kib->kia", geometry.rotations, local)


def close_wrench(
    geometry: SocketGeometry, forces: FloatArray, wrench: FloatArray, held: Sequence[int] = ()
) -> FloatArray:
    r"""The smallest change of the forces on the tiles with which they add up to the wrench.

    .. math:: \min \sum_i \lVert \Delta F_i \rVert^2 / A_i \quad \text{with} \quad
              C (F + \Delta F) = w

    so that a large tile changes more than a small one, as under an added stress:
    :math:`\Delta F = A C^T (C A C^T)^{-1} (w - C F)`.

    Args:
        geometry: Geometry of the socket.
        forces: Forces in {S}, shape (N, n, 3) [N].
        wrench: Wrenches [M; F], shape (N, 6) [N m, N].
        held: Tiles whose force stays, such as those with a sensor.

    Returns:
        Forces in {S}, shape (N, n, 3) [N]; if the other tiles are too few to meet every wrench,
        those that come nearest.
    """
    mapping = wrench_map(geometry.anchors)
    areas = geometry.areas.copy()
    areas[list(held)] = 0.0
    gain = np.repeat(areas, 3)[:, None] * mapping.T
    lacking = wrench - forces.reshape(len(forces), -1) @ mapping.T
    change = lacking @ np.linalg.pinv(mapping @ gain, hermitian=True) @ gain.T
    return forces + change.reshape(forces.shape)


@dataclass(frozen=True)
class PoseRegression:
    """Linear regression of the wrench on the limb's pose, ``w = c + B (p - p_mean)``.

    Attributes:
        mean_pose: Mean pose of the samples of the fit, shape (6,) [m, rad].
        constant: Mean wrench, shape (6,) [N m, N].
        slope: B transposed: the wrench per pose, shape (6, 6) [N m, N per m, rad].
    """

    mean_pose: FloatArray
    constant: FloatArray
    slope: FloatArray

    def predict(self, pose: FloatArray) -> FloatArray:
        """Wrenches at poses of shape (N, 6), shape (N, 6) [N m, N]."""
        return self.constant + (pose - self.mean_pose) @ self.slope


def fit_regression(pose: FloatArray, wrench: FloatArray) -> PoseRegression:
    """Fit the wrench by least squares to position and rotation of the limb, with a constant.

    Where the poses lack rank, the solution is the one of least norm in standardised poses.

    Args:
        pose: Position and rotation vector of the limb in {S}, shape (N, 6) [m, rad].
        wrench: Measured wrenches, shape (N, 6) [N m, N].
    """
    mean = pose.mean(axis=0)
    spread = pose.std(axis=0)
    spread = np.where(spread > _ROUNDING * np.abs(pose).max(axis=0), spread, np.inf)
    constant = wrench.mean(axis=0)
    slope = np.linalg.lstsq((pose - mean) / spread, wrench - constant, rcond=_RANK)[0]
    return PoseRegression(mean, constant, slope / spread[:, None])


WrenchPredictor = Callable[[FloatArray], FloatArray]
"""From poses, shape (N, 6) [m, rad], to wrenches, shape (N, 6) [N m, N]."""


def wrench_rivals(samples: Samples) -> dict[str, WrenchPredictor]:
    """The best constant and linear regression on the pose, fitted on samples; by name."""
    complete = samples[samples.complete]
    regression = fit_regression(complete.pose, complete.wrench)
    return {
        CONSTANT: lambda pose: np.tile(regression.constant, (len(pose), 1)),
        REGRESSION: regression.predict,
    }


def model_predictor(model: ContactModel) -> WrenchPredictor:
    """The wrench that a contact model predicts."""
    return lambda pose: predict_channels(model, pose, ())


def judge_wrench(
    samples: Samples,
    predictors: Mapping[str, WrenchPredictor],
    fitted_on: str,
    tested_on: str,
    in_sample: bool = False,
) -> list[Judgement]:
    """Judge predictions of the wrench from the pose alone.

    Args:
        samples: The samples to predict; those without a wrench or a pose are passed over.
        predictors: What predicts the wrench, by name.
        fitted_on: What the predictors were fitted on.
        tested_on: What the samples are.
        in_sample: Whether that is the same.
    """
    samples = samples[samples.complete]
    sizes = samples.wrench.std(axis=0)
    found = []
    for name, predict in predictors.items():
        residual = predict(samples.pose) - samples.wrench
        rmse = np.sqrt(np.mean(residual**2, axis=0))
        moment, force = float(rmse[:3].mean()), float(rmse[3:].mean())
        found.append(
            Judgement(
                question="wrench",
                predictor=name,
                fitted_on=fitted_on,
                tested_on=tested_on,
                in_sample=in_sample,
                samples=len(samples),
                moment_rmse=moment,
                force_rmse=force,
                moment_skill=_skill(moment, float(sizes[:3].mean())),
                force_skill=_skill(force, float(sizes[3:].mean())),
            )
        )
    return found


def _skill(error: float, constant: float) -> float:
    return 1.0 - error / constant if constant > 0.0 else float("nan")


def loaded_rows(samples: Samples, least_force: float) -> BoolArray:
    """Complete samples under load, shape (N,): a force of at least `least_force` [N]."""
    force = np.linalg.norm(samples.wrench[:, 3:], axis=1)
    return np.asarray(samples.complete & (force >= least_force))


def without_cluster(samples: Samples, cluster: str) -> Samples:
    """The samples as they would be had a cluster not been read."""
    column = samples.clusters.index(cluster)
    forces, status = samples.local_forces.copy(), samples.status.copy()
    forces[:, column] = np.nan
    status[:, column] = Status.MISSING
    return dataclasses.replace(samples, local_forces=forces, status=status)
