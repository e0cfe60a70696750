"""Model files: parameters, geometry, settings, certificates and the trial's identity."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from socket_testbed import documents
from socket_testbed.errors import ConfigurationError, closest, naming
from socket_testbed.files import write_text
from socket_testbed.geometry.socket import SocketGeometry, socket_from_document
from socket_testbed.identification.channel_errors import QUOTED, ChannelErrors, summarise_errors
from socket_testbed.identification.contact import ContactModel, law_of
from socket_testbed.identification.fit import Fit, FittedModel
from socket_testbed.identification.wrench import (
    FEATURES,
    MAX_SUPPORT,
    MotionMemory,
    WrenchModel,
)
from socket_testbed.settings.identification import IdentificationSettings
from socket_testbed.tables import split_unit

_FORMAT = "socket_testbed model 2"
_FORMATS = ("socket_testbed model 1", _FORMAT)  # readable ones; the first knew no memory
_AGAIN = "fit the trial again"


def write_model(fit: Fit, path: Path, trial: Mapping[str, Any] | None = None) -> None:
    """Write a fitted model as JSON, replacing an older file.

    Args:
        fit: The fit, which knows its trial, socket and segment.
        path: The file to write.
        trial: What else identifies the trial, by name, such as its number of `samples`; None for
            nothing.
    """
    identity = {
        "name": fit.trial,
        "fingerprint": fit.fingerprint,
        "unloaded": fit.unloaded,
        **(trial or {}),
    }
    document = {
        "format": _FORMAT,
        "trial": identity,
        "segment": fit.segment,
        "settings": fit.settings.to_flat(),
        "geometry": fit.geometry.to_document(),
        "parameters": _parameters(fit.model),
        "quality": {
            "samples": fit.samples,
            "first_stamp": fit.first_stamp,
            "last_stamp": fit.last_stamp,
            "determined_directions": fit.determined,
            "status": fit.status,
            "wrench_rmse": [*map(documents.finite_or_null, fit.wrench_rmse.tolist())],
            "stage_1": record(fit.stage_one.certificate),
            "stage_2": record(fit.stage_two.certificate),
            "joint": None if fit.joint is None else record(fit.joint.certificate),
            "errors": [record(error) for error in fit.errors],
        },
    }
    write_text(path, json.dumps(document, indent=1, allow_nan=False))


_ARRAYS = ("stiffness", "rest_positions", "wrench_bias", "reference_pose", "wrench_slope")
_REGRESSION = ("reference_pose", "slope", "constant", "deviation")
_SCALES = ("scale", "spread")  # infinite for what did not move


def _parameters(model: ContactModel) -> dict[str, Any]:
    names = ("variant", "sharpness", *_ARRAYS)
    found = {name: documents.plain(getattr(model, name)) for name in names}
    found["force_bias"] = {name: documents.plain(bias) for name, bias in model.force_bias.items()}
    found["clusters"] = list(model.cluster_points)
    if model.of_wrench is not None:
        found["of_wrench"] = _wrench_parameters(model.of_wrench)
    return found


def _wrench_parameters(of_wrench: WrenchModel) -> dict[str, Any]:
    """A predictor of the wrench for JSON; null stands for the scale of what did not move."""
    found = {name: documents.plain(getattr(of_wrench, name)) for name in _REGRESSION}
    found["memory"] = None
    if of_wrench.memory is not None:
        memory = {n: documents.plain(value) for n, value in vars(of_wrench.memory).items()}
        fields = [field.name for field in dataclasses.fields(MotionMemory)]
        found["memory"] = {name: memory[name] for name in fields}
        for name in _SCALES:
            found["memory"][name] = [*map(documents.finite_or_null, memory[name])]
    return found


def record(of: Any) -> dict[str, Any]:
    """A dataclass of numbers and texts for JSON, such as the errors of a channel.

    Values that are not finite become null.
    """
    return {key: documents.finite_or_null(value) for key, value in dataclasses.asdict(of).items()}


def quoted_figures(errors: Sequence[ChannelErrors]) -> dict[str, Any]:
    """The paper's summary figures over the channels in the objective, by name and unit.

    Names are such as `mean moment RMSE [N m]`; figures that are not finite become None.
    """
    figures = summarise_errors(errors).quoted.items()
    return {
        f"{name} [{split_unit(QUOTED[name])[1]}]": documents.finite_or_null(value)
        for name, value in figures
    }


_Parameter = Annotated[float, Meta(ge=-1e9, le=1e9)]  # [N/m, N, N m]; far beyond any real one
_Stiffness = Annotated[float, Meta(ge=-1.0, le=1e9)]  # [N/m]; solvers may undershoot zero slightly
_Place = Annotated[float, Meta(ge=-10.0, le=10.0)]  # [m, rad]
_Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
_Second = Annotated[float, Meta(ge=-documents.FINITE, le=documents.FINITE)]
_Figure = _Second | None  # JSON has no NaN
_Three = tuple[_Parameter, _Parameter, _Parameter]
_Positive = Annotated[float, Meta(gt=0.0, le=1e9)]
_Six = tuple[_Parameter, _Parameter, _Parameter, _Parameter, _Parameter, _Parameter]
_SixPositive = Annotated[list[_Positive], Meta(min_length=6, max_length=6)]
_Scales = Annotated[list[_Positive | None], Meta(min_length=6, max_length=6)]
_Features = Annotated[list[_Parameter], Meta(min_length=FEATURES, max_length=FEATURES)]
_Spreads = Annotated[list[_Positive | None], Meta(min_length=FEATURES, max_length=FEATURES)]


class _Memory(documents.Document):
    scale: _Scales
    centre: _Features
    spread: _Spreads
    support: Annotated[list[_Features], Meta(min_length=1, max_length=MAX_SUPPORT)]
    left: list[_Six]
    length: _Positive
    noise: Annotated[float, Meta(gt=0.0, le=1.0)]
    deviation: _SixPositive
    widening: _SixPositive

    def memory(self, where: str) -> MotionMemory:
        """The memory of a predictor of the wrench."""
        if len(self.left) != len(self.support):
            fact = f"{where}: left has {len(self.left)} rows for {len(self.support)} support points"
            raise ConfigurationError(fact, _AGAIN)
        arrays: dict[str, Any] = {
            name: np.array(getattr(self, name), float) for name in self.__struct_fields__
        }
        for name in _SCALES:
            arrays[name][np.isnan(arrays[name])] = np.inf
        return MotionMemory(**arrays | {"length": self.length, "noise": self.noise})


class _OfWrench(documents.Document):
    reference_pose: tuple[_Place, _Place, _Place, _Place, _Place, _Place]
    slope: tuple[_Six, _Six, _Six, _Six, _Six, _Six]
    constant: _Six
    deviation: _Six
    memory: _Memory | None = None

    def predictor(self, where: str) -> WrenchModel:
        """The predictor of the wrench."""
        regression = {name: np.array(getattr(self, name)) for name in _REGRESSION}
        memory = None if self.memory is None else self.memory.memory(f"{where}: memory")
        return WrenchModel(**regression, memory=memory)


class _Parameters(documents.Document):
    variant: str
    sharpness: Annotated[float, Meta(ge=1.0, le=1e9)]
    stiffness: list[tuple[_Stiffness, _Stiffness, _Stiffness]]
    rest_positions: list[tuple[_Place, _Place, _Place]]
    wrench_bias: _Six
    force_bias: dict[str, _Three]
    clusters: list[documents.Text]
    # Missing in older files, whose variants need neither:
    reference_pose: tuple[_Place, _Place, _Place, _Place, _Place, _Place] | None = None
    wrench_slope: tuple[_Six, _Six, _Six, _Six, _Six, _Six] | None = None
    parameter_factor: Any = None  # in older files, unused
    of_wrench: dict[str, Any] | None = None

    def model(self, geometry: SocketGeometry, where: str) -> ContactModel:
        """The contact model on a socket's tiles."""
        with naming(f"{where}: variant", ConfigurationError):
            law_of(self.variant)
        points, clusters = len(geometry), [str(name) for name in self.clusters]
        for name in clusters:
            if name not in geometry.clusters:
                hint = closest(name, geometry.clusters)
                raise ConfigurationError(f"{where}: clusters: no cluster '{name}'", hint)
        documents.refuse_unknown(self.force_bias, clusters, f"{where}: force_bias")
        for key, rows in (("stiffness", self.stiffness), ("rest_positions", self.rest_positions)):
            if len(rows) != points:
                fact = f"{where}: {key} has {len(rows)} rows for {points} tiles"
                raise ConfigurationError(fact, _AGAIN)
        of_wrench = None
        if self.of_wrench is not None:
            of_wrench = _predictor(self.of_wrench, geometry, f"{where}: of_wrench")
        arrays: dict[str, Any] = {name: getattr(self, name) for name in _ARRAYS}
        return ContactModel(
            variant=self.variant,
            names=geometry.names,
            anchors=geometry.anchors,
            rotations=geometry.rotations,
            sharpness=self.sharpness,
            force_bias={name: np.array(bias) for name, bias in self.force_bias.items()},
            cluster_points={name: geometry.clusters[name] for name in clusters},
            of_wrench=of_wrench,
            **{name: np.array(value) for name, value in arrays.items() if value is not None},
        )


def _predictor(data: dict[str, Any], geometry: SocketGeometry, where: str) -> WrenchModel:
    """The predictor of the wrench; a regression of format 1 was written as a bed of no stiffness.

    Args:
        data: Its part of the document.
        geometry: The socket of the model.
        where: Start of every error.
    """
    if "stiffness" not in data:
        return documents.convert(data, _OfWrench, where).predictor(where)
    old = documents.convert(data, _Parameters, where).model(geometry, where)
    if old.stiffness.any():
        fact = f"{where}: the wrench is predicted by a second bed, as in an older version"
        raise ConfigurationError(fact, _AGAIN)
    unknown = np.full(6, np.nan)
    return WrenchModel(old.reference_pose, old.wrench_slope, old.wrench_bias, unknown)


class _Quality(Struct):  # the certificates are for human readers
    samples: _Count
    last_stamp: _Count
    wrench_rmse: tuple[_Figure, _Figure, _Figure, _Figure, _Figure, _Figure]
    status: str
    errors: list[dict[str, Any]] = []
    first_stamp: _Count = 0


class _Trial(Struct):  # ignores any further identity
    name: documents.Text
    fingerprint: str = ""
    unloaded: list[tuple[_Second, _Second]] = []


class _Model(documents.Document):
    format: str
    trial: _Trial
    settings: dict[str, Any]
    geometry: dict[str, Any]
    parameters: _Parameters
    quality: _Quality
    segment: str = ""


def read_model(path: Path, geometry: SocketGeometry | None = None) -> FittedModel:
    """Read a model that `write_model` wrote.

    Args:
        path: The file.
        geometry: The socket that the model must have been fitted on; None to accept any.

    Raises:
        ConfigurationError: If the file is not a model of this format, or of another socket.
    """
    data = documents.load_json(path, "a model", "give a file that 'fit' wrote")
    if not isinstance(data, dict) or "format" not in data:
        raise ConfigurationError(f"{path}: is not a model", "give a file that 'fit' wrote")
    if data["format"] not in _FORMATS:
        fact = f"{path}: is of the format {documents.shown(data['format'])}"
        raise ConfigurationError(fact, _AGAIN)
    document = documents.convert(data, _Model, str(path))
    quality = document.quality
    fitted_on = socket_from_document(document.geometry, f"{path}: geometry")
    # JSON has null in place of NaN.
    errors = [{k: math.nan if v is None else v for k, v in e.items()} for e in quality.errors]
    found = FittedModel(
        model=document.parameters.model(fitted_on, f"{path}: parameters"),
        geometry=fitted_on,
        settings=IdentificationSettings.from_flat(document.settings, f"{path}: settings"),
        samples=quality.samples,
        first_stamp=quality.first_stamp,
        last_stamp=quality.last_stamp,
        wrench_rmse=np.array(quality.wrench_rmse, dtype=float),
        errors=documents.convert(errors, tuple[ChannelErrors, ...], f"{path}: quality: errors"),
        status=quality.status,
        trial=str(document.trial.name),
        fingerprint=document.trial.fingerprint,
        unloaded=tuple(document.trial.unloaded),
        segment=document.segment,
    )
    if geometry is not None:
        found.require_socket(geometry)
    return found
