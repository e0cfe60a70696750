r"""Accuracy of estimates on unseen data, compared with simple baselines.

Three questions, each answered for an estimate and for its baselines on the same samples:

- `cluster`: the force on a left-out cluster, from the other clusters and the wrench;
- `wrench`: the wrench from the limb's pose alone, on samples not used in the fit;
- `tiles`: the force on tiles without a sensor, if known from a simulation.

The baselines need no model: inverse-distance interpolation of the clusters, without and with the
smallest change that matches the wrench, the best constant, and linear regression on the pose.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.special import ndtri

from socket_testbed.arrays import FloatArray, IntArray, evenly, finite_mean, rms
from socket_testbed.errors import IdentificationError
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification import fit
from socket_testbed.identification.channel_errors import (
    ChannelErrors,
    deviation,
    evaluate,
    skill_of,
)
from socket_testbed.identification.contact import ContactModel, wrench_map
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.identification.noise import (
    channel_noise,
    measurement_errors,
    smooth_poses,
)
from socket_testbed.identification.problem import MIN_SAMPLES, check_parts
from socket_testbed.identification.wrench import REGRESSION, regress_wrench
from socket_testbed.samples import FORCES, MOMENTS, Samples, local_channels, relative_pose
from socket_testbed.settings.identification import (
    VARIANTS,
    ForceMapSettings,
    IdentificationSettings,
)
from socket_testbed.settings.testbed import EstimatorSettings

if TYPE_CHECKING:
    import pandas as pd

LEVELS = (0.5, 0.8, 0.95)  # [-]; of the intervals tested for coverage
INVERSE_DISTANCE = "inverse distance"
CLOSED = "inverse distance, wrench met"
FORCE_MAP = "force map"
CONSTANT = "best constant"
MAX_SAMPLES = 1000  # of a trial, to judge forces on tiles
_MAX_WRENCHES = 4000  # of half a trial

_EXPONENT = 2.0  # [-]; Shepard's
_MIN_DISTANCE = 1e-6  # [m]; of a cluster's own tile
_UNKNOWN = (float("nan"),) * len(LEVELS)

Question = Literal["cluster", "wrench", "tiles"]
Test = Literal["left out", "in-sample", "second half", "other trial"]
"""Relation of the test samples to those of the fit: the left-out cluster, the second half and the
other trial are unseen; in-sample data is not."""
_HALVES: tuple[Test, Test] = ("in-sample", "second half")


@dataclass(frozen=True)
class Judgement:
    """Errors of one predictor on one question; NaN for figures that do not apply.

    Attributes:
        question: `cluster`, `wrench` or `tiles`: see the module.
        predictor: Name of an estimate or a baseline.
        test: Relation of the samples to those of the fit.
        fitted_on: Name of the trial of the fit; empty without a fit.
        tested_on: Name of the test trial.
        cluster: The left-out cluster; empty for all of them, and for the other questions.
        samples: Number of samples judged.
        error: RMSE of the forces on clusters or tiles over the RMS of the measured or true ones
            [-], for a single cluster over that of all clusters. Predicting zero everywhere gives 1.
        moment_rmse: Mean RMSE of the wrench's moments [N m].
        force_rmse: Mean RMSE of the wrench's forces [N].
        moment_skill: 1 - `moment_rmse` over that of the best constants [-].
        force_skill: 1 - `force_rmse` over that of the best constants [-].
        coverage: Share of the true forces within the intervals of each of `LEVELS`, shape (3,) [-].
    """

    question: Question
    predictor: str
    test: Test
    fitted_on: str
    tested_on: str
    cluster: str = ""
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
    r"""Interpolate the clusters' forces over the socket by inverse squared distance.

    .. math:: F_i = R_i \frac{\sum_c w_{ic} f_c}{\sum_c w_{ic}}, \qquad
              w_{ic} = \lVert a_i - a_c \rVert^{-2}

    with f_c in the frame of the cluster's tile, so that pressure stays pressure around the socket
    (Shepard, Proc. 23rd ACM National Conference, 1968). A cluster's own tile has its force.

    Args:
        geometry: The socket with its n tiles.
        clusters: Names of the c clusters.
        local_forces: Forces on the clusters in the clusters' frames, shape (N, c, 3) [N]; a cluster
            with a NaN counts as missing in that sample.

    Returns:
        Forces on the tiles in {S}, shape (N, n, 3) [N]; NaN in samples without any cluster.
    """
    tiles = [geometry.clusters[name] for name in clusters]
    apart = np.linalg.norm(geometry.anchors[:, None] - geometry.anchors[tiles], axis=2)
    weights = np.maximum(apart, _MIN_DISTANCE) ** -_EXPONENT
    known = np.asarray(np.isfinite(local_forces).all(axis=2))
    total = known @ weights.T
    summed = np.einsum("ic,kcj->kij", weights, np.where(known[:, :, None], local_forces, 0.0))
    with np.errstate(invalid="ignore"):
        local = summed / total[:, :, None]
    return np.einsum("iab,kib->kia", geometry.rotations, local)


def close_wrench(
    geometry: SocketGeometry, forces: FloatArray, wrench: FloatArray, held: Sequence[int] = ()
) -> FloatArray:
    r"""Change the forces on the tiles as little as possible so that they match the wrench.

    .. math:: \min \sum_i \lVert \Delta F_i \rVert^2 / A_i \quad \text{with} \quad
              C (F + \Delta F) = w

    so that large tiles change more than small ones, as under an added stress:
    :math:`\Delta F = A C^T (C A C^T)^{-1} (w - C F)`.

    Args:
        geometry: The socket with its n tiles.
        forces: Forces on the tiles in {S}, shape (N, n, 3) [N].
        wrench: Measured wrenches [M; F] in {S}, shape (N, 6) [N m, N]. A channel that never has
            a value is not matched; in samples with another missing value the result is NaN.
        held: Indices of the tiles whose force is fixed, such as those with a sensor. With too few
            other tiles to match the wrench, the misfit is least.

    Returns:
        The changed forces in {S}, shape (N, n, 3) [N].
    """
    known = np.isfinite(wrench).any(axis=0)
    mapping, wrench = wrench_map(geometry.anchors)[known], wrench[:, known]
    areas = geometry.areas.copy()
    areas[list(held)] = 0.0
    gain = np.repeat(areas, 3)[:, None] * mapping.T
    misfit = wrench - forces.reshape(len(forces), -1) @ mapping.T
    change = misfit @ np.linalg.pinv(mapping @ gain, hermitian=True) @ gain.T
    return forces + change.reshape(forces.shape)


WrenchPredictor = Callable[[Samples, IntArray], FloatArray]
"""From the stamps and poses of N samples to the wrenches [M; F] in {S} at k rows of them, shape
(k, 6) [N m, N]; the other samples are the past that a predictor with memory knows."""


def wrench_predictors(
    samples: Samples, models: Mapping[str, ContactModel]
) -> dict[str, WrenchPredictor]:
    """The best constant and linear regression on the pose, fitted on the samples, then models.

    Args:
        samples: Samples with every pose and wrench, such as those `under_load`, on which the
            baselines are fitted; poses averaged as in the fits of the models.
        models: Models by the names that their predictors get.
    """
    mean, middle = samples.wrench.mean(axis=0), np.append(np.zeros(3), samples.attitude)
    slope, constant = regress_wrench(samples, relative_pose(samples.pose, middle))

    def regression(others: Samples, rows: IntArray) -> FloatArray:
        return np.asarray(constant + relative_pose(others.pose[rows], middle) @ slope.T)

    return {
        CONSTANT: lambda others, rows: np.tile(mean, (len(rows), 1)),
        REGRESSION: regression,
        **{name: partial(_wrench_of, model) for name, model in models.items()},
    }


def _wrench_of(model: ContactModel, samples: Samples, rows: IntArray) -> FloatArray:
    """Wrenches of a model at rows of the samples, as a `WrenchPredictor`."""
    if model.trail() is None:  # the past does not matter
        return model.wrench(samples.pose[rows])
    return model.wrench(samples.pose, samples.stamps)[rows]


def judge_wrench(
    measured: FloatArray,
    predicted: Mapping[str, FloatArray],
    test: Test,
    fitted_on: str = "",
    tested_on: str = "",
) -> Iterator[Judgement]:
    """Judge predictions of the wrench from the pose alone; a judgement for each predictor.

    Means leave out wrench channels without a value.

    Args:
        measured: Measured wrenches [M; F] in {S} of the test, shape (k, 6) [N m, N].
        predicted: Predictions of these, by the name of the predictor, shape (k, 6) each [N m, N].
        test: Relation of the samples to those of the fit.
        fitted_on: Name of the trial of the fit.
        tested_on: Name of the trial of the samples.
    """
    constant = np.array([deviation(channel) for channel in measured.T])
    for name, wrench in predicted.items():
        rmse = np.sqrt(np.mean((wrench - measured) ** 2, axis=0))
        figures: dict[str, Any] = {"samples": len(measured)}
        for kind, part in (("moment", MOMENTS), ("force", FORCES)):
            error = finite_mean(rmse[part])
            skill = skill_of(error, finite_mean(constant[part]))
            figures |= {f"{kind}_rmse": error, f"{kind}_skill": skill}
        yield Judgement("wrench", name, test, fitted_on, tested_on, **figures)


FieldEstimator = Callable[[Samples], tuple[FloatArray, FloatArray]]
"""From samples to the forces on the tiles in {S}, shape (N, n, 3) [N], and their standard
deviations by axis of {S}, NaN if unknown."""


def field_estimators(
    geometry: SocketGeometry,
    settings: ForceMapSettings,
    prior_map: ForceMap | None = None,
) -> dict[str, FieldEstimator]:
    """Estimators of the forces on the tiles that need no fit, by name.

    They are inverse-distance interpolation of the clusters, without and with the wrench matched,
    and the force map.

    Args:
        geometry: The socket with its n tiles.
        settings: Prior of the force map.
        prior_map: The force map of the samples' clusters with this prior; None to make it.
    """
    made = cache(partial(ForceMap, geometry, settings=settings))  # by the clusters
    map_of = made if prior_map is None else lambda clusters: prior_map

    def interpolate(samples: Samples) -> tuple[FloatArray, FloatArray]:
        forces = inverse_distance(geometry, samples.clusters, samples.trusted_forces)
        return forces, np.full_like(forces, np.nan)

    def closed(samples: Samples) -> tuple[FloatArray, FloatArray]:
        read = np.isfinite(samples.trusted_forces).any(axis=(0, 2))
        held = [geometry.clusters[name] for name in np.array(samples.clusters)[read]]
        forces, none = interpolate(samples)
        return close_wrench(geometry, forces, samples.wrench, held), none

    def force_map(samples: Samples) -> tuple[FloatArray, FloatArray]:
        found = map_of(samples.clusters).estimate(samples)
        return found.forces, found.standard_deviations

    return {INVERSE_DISTANCE: interpolate, CLOSED: closed, FORCE_MAP: force_map}


def judge_clusters(
    samples: Samples,
    geometry: SocketGeometry,
    estimators: Mapping[str, FieldEstimator],
    noise: FloatArray,
    tested_on: str = "",
) -> Iterator[Judgement]:
    """Judge the forces on each cluster, estimated from the others and the wrench; then on all.

    The intervals are those of a measurement: they include the errors of the cluster's own channels.

    Args:
        samples: N samples of the test with c clusters; clusters without a trusted force are left
            out.
        geometry: The socket, which has these clusters.
        estimators: Estimators of the forces on the tiles, by name.
        noise: Standard deviations of the errors of the clusters' channels in the clusters' frames,
            shape (c, 3) [N]; NaN counts as 0. See `measurement_errors`.
        tested_on: Name of the trial of the samples.
    """
    size = rms(samples.trusted_forces)
    together: dict[str, list[_Compared]] = {}
    for column, cluster in enumerate(samples.clusters):
        tile = geometry.clusters[cluster]
        rotation = geometry.rotations[tile]
        truth = samples.trusted_forces[:, column] @ rotation.T
        if not np.isfinite(truth).all(axis=1).any():
            continue
        hidden = samples.without(local_channels(cluster))
        # Noise along the axes of {S}: the diagonal of R diag(noise^2) R'.
        variance = rotation**2 @ np.nan_to_num(noise[column]) ** 2
        for name, estimate in estimators.items():
            forces, deviations = (values[:, tile] for values in estimate(hidden))
            compared = truth, forces, np.sqrt(deviations**2 + variance)
            together.setdefault(name, []).append(compared)
            figures = _figures([compared], size)
            yield Judgement("cluster", name, "left out", "", tested_on, cluster, **figures)
    for name, all_compared in together.items():
        figures = _figures(all_compared, size)
        yield Judgement("cluster", name, "left out", "", tested_on, **figures)


def judge_tiles(
    samples: Samples,
    geometry: SocketGeometry,
    truth: FloatArray,
    estimators: Mapping[str, FieldEstimator],
    tested_on: str = "",
) -> Iterator[Judgement]:
    """Judge the forces on tiles without a sensor against the truth; nothing if all have one.

    Args:
        samples: N samples of the second half of a trial.
        geometry: The socket with its n tiles.
        truth: True forces on all tiles in {S}, shape (N, n, 3) [N].
        estimators: Estimators of the forces on the tiles, by name.
        tested_on: Name of the trial of the samples.
    """
    bare = np.flatnonzero(~geometry.covered)
    if not len(bare):
        return
    truth = truth[:, bare]
    for name, estimate in estimators.items():
        forces, deviations = (values[:, bare] for values in estimate(samples))
        figures = _figures([(truth, forces, deviations)], rms(truth))
        yield Judgement("tiles", name, "second half", "", tested_on, **figures)


_Compared = tuple[FloatArray, FloatArray, FloatArray]
"""True and estimated forces of N samples in {S}, and the estimates' standard deviations [N]."""


def _figures(compared: Sequence[_Compared], size: float) -> dict[str, Any]:
    """Figures of a `Judgement` of forces; `size` is the RMS of the true forces [N]."""
    errors = np.concatenate([(forces - truth).ravel() for truth, forces, _ in compared])
    scaled = np.abs(errors / np.concatenate([spread.ravel() for *_, spread in compared]))
    scaled = scaled[np.isfinite(scaled)]
    known = (np.isfinite(forces - truth) for truth, forces, _ in compared)
    samples = max(int(each.reshape(len(each), -1).any(axis=1).sum()) for each in known)
    coverage = _UNKNOWN
    if len(scaled):
        limits = ndtri(0.5 + 0.5 * np.array(LEVELS))
        coverage = tuple(float(np.mean(scaled <= limit)) for limit in limits)
    share = rms(errors) / size if size > 0.0 else float("nan")
    return {"samples": samples, "error": share, "coverage": coverage}


def fit_variants(
    samples: Samples,
    geometry: SocketGeometry,
    settings: IdentificationSettings,
    notify: Callable[[str], None],
) -> dict[str, ContactModel]:
    """Fit every variant of the contact model, by name.

    If none can be fitted, it raises the error of the first.

    Args:
        samples: Samples of a loaded segment.
        geometry: The socket, which has the clusters of the samples.
        settings: Settings of the fits; their variant is ignored.
        notify: Called with a line for each variant that cannot be fitted.
    """
    models: dict[str, ContactModel] = {}
    errors: dict[str, IdentificationError] = {}
    for variant in VARIANTS:
        chosen = dataclasses.replace(settings, variant=variant)
        try:
            models[variant] = fit.fit_contact_model(samples, geometry, chosen).model
        except IdentificationError as error:
            errors[variant] = error
    if not models:
        raise next(iter(errors.values()))
    for name, reason in errors.items():
        notify(f"{name} is not judged: {reason}")
    return models


def split(samples: Samples, least_force: float) -> tuple[IntArray, IntArray]:
    """Indices of the first and the second half of the samples under load, in ascending order.

    Args:
        samples: The samples of a trial.
        least_force: Smallest force that counts as load [N].

    Raises:
        IdentificationError: If too few samples are under load to fit and test two halves.
    """
    check_parts(samples, "a validation", wrench=True)
    loaded = np.flatnonzero(samples.under_load(least_force))
    if len(loaded) < 2 * MIN_SAMPLES:
        raise IdentificationError(
            f"only {len(loaded)} of {len(samples)} samples have a pose and a wrench under load"
            f" ({least_force:g} N or more), and two halves to fit and to test need"
            f" {2 * MIN_SAMPLES}",
            "give a longer trial, or see with 'info' what is missing",
        )
    middle = len(loaded) // 2
    return loaded[:middle], loaded[middle:]


def judge_unseen_half(
    samples: Samples, geometry: SocketGeometry, settings: IdentificationSettings
) -> tuple[ChannelErrors, ...]:
    """Errors of each channel on the second half of the samples, of a model fitted on the first.

    Args:
        samples: Samples of a segment, poses not averaged.
        geometry: The socket, which has the clusters of the samples.
        settings: Settings of the fit, by which poses are averaged in both halves.
    """
    first, second = split(samples, 0.0)
    model = fit.fit_contact_model(samples[first], geometry, settings).model
    predicted = fit.predictions(samples, model, settings.pose_smoothing)
    return evaluate(samples[second], predicted[second], settings.leave_out)


def judge_samples(
    samples: Samples,
    geometry: SocketGeometry,
    settings: EstimatorSettings,
    truth: FloatArray | None,
    name: str,
    notify: Callable[[str], None],
    prior_map: ForceMap | None = None,
) -> list[Judgement]:
    """Answer all three questions on the loaded part of one trial.

    The variants and their baselines are fitted on its first half and judged on both halves. Tiles
    without a sensor are judged on the second half for every estimate, if their forces are known.

    Args:
        samples: The N samples of a trial, poses not averaged.
        geometry: The socket with its n tiles.
        settings: Settings of the fits, whose variant is ignored, of the force map and of the least
            load.
        truth: True forces on all tiles in {S}, shape (N, n, 3) [N]; None if unknown.
        name: Name of the trial.
        notify: Called with a line for each variant that cannot be fitted.
        prior_map: The force map of the samples' clusters with the prior of the settings; None to
            make it.
    """
    first, second = split(samples, settings.plateau.least_force)
    found = judge_map(samples, geometry, settings, name, prior_map)
    models = fit_variants(samples[first], geometry, settings.identification, notify)
    samples = smooth_poses(samples, settings.identification.pose_smoothing)
    seen, unseen = (half[evenly(len(half), _MAX_WRENCHES)] for half in (first, second))
    rows = np.concatenate([seen, unseen])
    predictors = wrench_predictors(samples[first], models)
    predicted = {who: predict(samples, rows) for who, predict in predictors.items()}
    measured, parts = samples.wrench[rows], (slice(len(seen)), slice(len(seen), None))
    for part, test in zip(parts, _HALVES, strict=True):
        of_part = {who: wrench[part] for who, wrench in predicted.items()}
        found += judge_wrench(measured[part], of_part, test, name, name)
    if truth is not None:
        rows = second[evenly(len(second), MAX_SAMPLES)]
        estimators = field_estimators(geometry, settings.force_map, prior_map) | {
            variant: partial(_forces_of, model) for variant, model in models.items()
        }
        found += judge_tiles(samples[rows], geometry, truth[rows], estimators, name)
    return found


def judge_map(
    samples: Samples,
    geometry: SocketGeometry,
    settings: EstimatorSettings,
    name: str,
    prior_map: ForceMap | None = None,
) -> list[Judgement]:
    """Judge the estimators that need no fit on left-out clusters.

    Args:
        samples: The samples of a trial; those under load are judged, at most `MAX_SAMPLES`.
        geometry: The socket, which has the clusters of the samples.
        settings: Settings of the force map and of the least load.
        name: Name of the trial.
        prior_map: The force map of the samples' clusters with the prior of the settings; None to
            make it.
    """
    loaded = samples[samples.under_load(settings.plateau.least_force)]
    samples = loaded[evenly(len(loaded), MAX_SAMPLES)]
    noise = measurement_errors(samples, channel_noise(samples).local_forces, settings.force_map)
    estimators = field_estimators(geometry, settings.force_map, prior_map)
    return [*judge_clusters(samples, geometry, estimators, noise, name)]


def _forces_of(model: ContactModel, samples: Samples) -> tuple[FloatArray, FloatArray]:
    """Forces of a model on the tiles, as a `FieldEstimator`: without standard deviations."""
    forces = model.forces(samples.pose)
    return forces, np.full_like(forces, np.nan)


_TITLES = {
    "fitted_on": "fitted on",
    "tested_on": "tested on",
    "samples": "samples [1]",
    "error": "error [-]",
    "moment_rmse": "moment RMSE [N m]",
    "force_rmse": "force RMSE [N]",
    "moment_skill": "moment skill [-]",
    "force_skill": "force skill [-]",
}


def judgements_table(judgements: Sequence[Judgement]) -> pd.DataFrame:
    """Judgements as a pandas table, one per row, with units in the names: see `Judgement`."""
    import pandas as pd

    table = pd.DataFrame([vars(j) for j in judgements]).rename(columns=_TITLES)
    shares = np.array(table.pop("coverage").tolist())
    for level, share in zip(LEVELS, shares.T, strict=True):
        table[f"within {100 * level:g} % [-]"] = share
    return table


def summarise_judgements(judgements: Sequence[Judgement]) -> pd.DataFrame:
    """Means over the trials, one row per `question`, `test` and `predictor`, in this order.

    The columns are the numeric ones of `judgements_table`, `judged [1]`, the number of judgements,
    `worst error [-]`, and medians of the skills, such as `median force skill [-]`, which a single
    bad trial does not affect.
    """
    table = judgements_table([j for j in judgements if not j.cluster])
    grouped = table.groupby(["question", "test", "predictor"], sort=False)
    means = grouped.mean(numeric_only=True)
    means.insert(0, "judged [1]", grouped.size())
    means.insert(3, "worst error [-]", grouped["error [-]"].max())
    for skill in ("moment skill [-]", "force skill [-]"):
        means[f"median {skill}"] = grouped[skill].median()
    return means


def judgements_by_trial(judgements: Sequence[Judgement]) -> pd.DataFrame:
    """Judgements of each `trial` in one row: its own, and medians over models of other trials.

    The columns are the figures of `judgements_table` by question, test and predictor, such as
    `wrench, second half: rigid_bias force skill [-]`.
    """
    import pandas as pd

    table = judgements_table([j for j in judgements if not j.cluster])
    keys = ["question", "test", "predictor"]
    figures = [name for name in table.columns[6:] if name != "samples [1]"]
    medians = table.groupby(["tested on", *keys], sort=False)[figures].median()
    rows: dict[str, dict[str, float]] = {}
    for (trial, question, test, predictor), found in medians.iterrows():
        row = rows.setdefault(trial, {})
        for figure, value in found.dropna().items():
            row[f"{question}, {test}: {predictor} {figure}"] = value
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("trial")
