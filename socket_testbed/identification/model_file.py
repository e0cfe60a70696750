"""Models on the disk: parameters, geometry, settings, certificates and the trial's identity."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import Section, atomic_output, closest, decimal, load_json
from socket_testbed.geometry.socket import SocketGeometry, socket_from_section
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.evaluation import ChannelErrors
from socket_testbed.identification.fit import Fit
from socket_testbed.settings.identification import VARIANTS, IdentificationSettings

_FORMAT = "socket_testbed model 1"
_KEYS = ("format", "trial", "segment", "settings", "geometry", "parameters", "quality")
_LARGEST = 1e9  # [N/m, N, N m, 1/m]; no parameter comes near it
_FARTHEST = 10.0  # [m, rad]
_LEAST_STIFFNESS = -1.0  # [N/m]; solvers stay above it
_PARAMETERS = (
    "variant",
    "sharpness",
    "stiffness",
    "rest_positions",
    "wrench_bias",
    "force_bias",
    "clusters",
    "reference_pose",
    "wrench_slope",
    "parameter_factor",
)


@dataclass(frozen=True)
class StoredModel:
    """A model read from its file.

    Attributes:
        model: The contact model.
        geometry: Geometry of the socket it was fitted on.
        settings: Settings of its identification.
        samples: Number of samples of its fit.
        last_stamp: Stamp of the newest of them [ns].
        wrench_rmse: Errors of its fit, shape (6,) [N m, N].
        errors: Errors of its fit on every channel; none in a model of an older version.
        status: The solver and the certificate of both stages, in words.
        trial: Name of the trial it was fitted on.
        unloaded: Spans of it by which the clusters' drift was corrected [s].
    """

    model: ContactModel
    geometry: SocketGeometry
    settings: IdentificationSettings
    samples: int
    last_stamp: int
    wrench_rmse: FloatArray
    errors: tuple[ChannelErrors, ...]
    status: str
    trial: str
    unloaded: tuple[tuple[float, float], ...]

    def __repr__(self) -> str:
        return (
            f"StoredModel({self.model.variant} of {self.trial}, {self.samples} samples,"
            f" {len(self.geometry)} tiles)"
        )

    def require_socket(self, geometry: SocketGeometry) -> None:
        """Check that the model was fitted on the socket that it is used on.

        Args:
            geometry: Geometry of that socket.

        Raises:
            ConfigurationError: Unless it has the same tiles at the same places.
        """
        if not self.geometry.same_tiles(geometry):
            raise ConfigurationError(
                f"the model of {self.trial} was fitted on another socket ({len(self.geometry)}"
                f" tiles) than the one that it is used on ({len(geometry)} tiles)",
                "fit a model on this socket, or give the socket.yaml of the model's trial",
            )


def write_model(
    fit: Fit, geometry: SocketGeometry, trial: dict[str, Any], segment: str, path: Path
) -> None:
    """Write a fitted model as JSON.

    Args:
        fit: The fit.
        geometry: Geometry of the socket.
        trial: Identity of the trial; at least its `name`.
        segment: The segment of the trial.
        path: The file; an older one is replaced.

    Raises:
        ConfigurationError: If the file cannot be written.
    """
    model = fit.model
    document = {
        "format": _FORMAT,
        "trial": trial,
        "segment": segment,
        "settings": fit.settings.to_flat(),
        "geometry": geometry.to_document(),
        "parameters": {
            "variant": model.variant,
            "sharpness": model.sharpness,
            "stiffness": model.stiffness.tolist(),
            "rest_positions": model.rest_positions.tolist(),
            "wrench_bias": model.wrench_bias.tolist(),
            "force_bias": {name: bias.tolist() for name, bias in model.force_bias.items()},
            "clusters": list(model.cluster_points),
            "reference_pose": model.reference_pose.tolist(),
            "wrench_slope": model.wrench_slope.tolist(),
            "parameter_factor": _packed(model.parameter_factor),
        },
        "quality": {
            "samples": fit.samples,
            "last_stamp": fit.last_stamp,
            "determined_directions": fit.determined,
            "status": fit.status,
            "wrench_rmse": [finite_or_null(error.rmse) for error in fit.errors[:6]],
            "stage_1": dataclasses.asdict(fit.stage_one.certificate),
            "stage_2": dataclasses.asdict(fit.stage_two.certificate),
            "joint": None if fit.joint is None else dataclasses.asdict(fit.joint.certificate),
            "errors": [errors_document(error) for error in fit.errors],
        },
    }
    with atomic_output(path) as staging:
        staging.write_text(json.dumps(document, indent=1, allow_nan=False), encoding="utf-8")


def errors_document(errors: ChannelErrors) -> dict[str, Any]:
    """The errors of one channel for JSON."""
    return {key: finite_or_null(value) for key, value in dataclasses.asdict(errors).items()}


def finite_or_null(value: Any) -> Any:
    """A value for JSON, which has no NaN: None stands for it."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_model(path: Path, geometry: SocketGeometry | None = None) -> StoredModel:
    """Read a model.

    Args:
        path: The file.
        geometry: Geometry of the socket that the model is used on, to check that it fits.

    Raises:
        ConfigurationError: If the file is missing, is not a model, or is of another socket.
    """
    try:
        data = load_json(path, "a model")
    except ConfigurationError as error:
        raise ConfigurationError(error.fact, "give a file that 'fit' wrote") from None
    if not isinstance(data, dict) or "format" not in data:
        raise ConfigurationError(f"{path}: is not a model", "give a file that 'fit' wrote")
    document = Section(data, str(path)).expect(_KEYS)
    if document.text("format") != _FORMAT:
        raise ConfigurationError(
            f"{path}: is of the format '{document.text('format')}'", "fit the trial again"
        )
    fitted_on = socket_from_section(document.section("geometry"))
    settings_section = document.section("settings")
    values = {name: settings_section.take(name) for name in settings_section.names()}
    parameters = document.section("parameters").expect(_PARAMETERS)
    quality = document.section("quality")
    stored = StoredModel(
        model=_model(parameters, fitted_on),
        geometry=fitted_on,
        settings=IdentificationSettings.from_flat(values, f"{path}: settings"),
        samples=quality.integer("samples"),
        last_stamp=quality.integer("last_stamp"),
        wrench_rmse=quality.array("wrench_rmse", (6,), finite=False),
        errors=_errors(quality),
        status=quality.text("status"),
        trial=document.section("trial").text("name"),
        unloaded=_unloaded(document.section("trial")),
    )
    if geometry is not None:
        stored.require_socket(geometry)
    return stored


def _errors(quality: Section) -> tuple[ChannelErrors, ...]:
    listed = quality.take("errors") if "errors" in quality.names() else []
    if not isinstance(listed, list):
        raise ConfigurationError(f"{quality.where}: errors is not a list", "fit the trial again")
    return tuple(_channel_errors(Section(each, f"{quality.where}: errors")) for each in listed)


def _channel_errors(errors: Section) -> ChannelErrors:
    """Errors of a channel; JSON has no NaN, null stands for it."""
    figures = [
        math.nan if errors.take(name) is None else errors.number(name)
        for name in ("rmse", "mae", "sigma", "skill")
    ]
    return ChannelErrors(
        errors.text("name"),
        errors.text("unit"),
        errors.flag("in_objective"),
        errors.integer("samples"),
        *figures,
    )


def _model(parameters: Section, geometry: SocketGeometry) -> ContactModel:
    variant = parameters.text("variant")
    if variant not in VARIANTS:
        raise ConfigurationError(
            f"{parameters.where}: variant is '{variant}'", closest(variant, VARIANTS)
        )
    clusters = parameters.texts("clusters")
    for name in clusters:
        if name not in geometry.clusters:
            raise ConfigurationError(
                f"{parameters.where}: no cluster '{name}'", closest(name, geometry.clusters)
            )
    bias = parameters.section("force_bias").expect(clusters)
    points = len(geometry)
    return ContactModel(
        variant=variant,
        names=geometry.names,
        anchors=geometry.anchors,
        rotations=geometry.rotations,
        stiffness=_stiffness(parameters, points),
        rest_positions=parameters.array("rest_positions", (points, 3), limit=_FARTHEST),
        sharpness=parameters.number("sharpness", 1.0, _LARGEST),
        wrench_bias=parameters.array("wrench_bias", (6,), limit=_LARGEST),
        force_bias={name: bias.array(name, (3,), limit=_LARGEST) for name in bias.names()},
        cluster_points={name: geometry.clusters[name] for name in clusters},
        **_rigid_parameters(parameters, points),
    )


def _stiffness(parameters: Section, points: int) -> FloatArray:
    stiffness = parameters.array("stiffness", (points, 3), limit=_LARGEST)
    if stiffness.min() < _LEAST_STIFFNESS:
        raise ConfigurationError(
            f"{parameters.where}: stiffness holds {stiffness.min():g} N/m", "fit the trial again"
        )
    return stiffness


def _packed(factor: FloatArray) -> list[str]:
    """A line per direction of the parameters' uncertainty, with six digits."""
    return [" ".join(f"{v:.6g}" for v in way.ravel()) for way in np.moveaxis(factor, 2, 0)]


def _unpacked(parameters: Section, points: int) -> FloatArray:
    lines = parameters.take("parameter_factor")
    try:
        ways = [np.array([*map(decimal, line.split())]).reshape(6, points) for line in lines]
    except (AttributeError, TypeError, ValueError):
        raise ConfigurationError(
            f"{parameters.where}: parameter_factor does not hold 6 numbers per tile and line",
            "fit the trial again",
        ) from None
    return np.stack(ways, axis=2) if ways else np.zeros((6, 0, 0))


def _rigid_parameters(parameters: Section, points: int) -> dict[str, FloatArray]:
    """What older files lack, whose variants need none of it."""
    shapes = {"reference_pose": ((6,), _FARTHEST), "wrench_slope": ((6, 6), _LARGEST)}
    known = set(parameters.names())
    found = {
        name: parameters.array(name, shape, limit=limit)
        for name, (shape, limit) in shapes.items()
        if name in known
    }
    if "parameter_factor" in known:
        found["parameter_factor"] = _unpacked(parameters, points)
    return found


def _unloaded(trial: Section) -> tuple[tuple[float, float], ...]:
    spans = trial.take("unloaded") if "unloaded" in trial.names() else []
    if spans == []:
        return ()
    count = len(spans) if isinstance(spans, list) else 1
    return tuple((start, end) for start, end in trial.array("unloaded", (count, 2)).tolist())
