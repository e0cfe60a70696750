"""Calibration of the clusters: four capacitances to normal and shear stress.

The normal stress is a first-degree polynomial of the mean of the four channels; each shear stress
is a polynomial of total degree 2 in the differences of the channel pairs along x and along y.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from socket_testbed.arrays import FloatArray, IntArray, StatusArray
from socket_testbed.documents import Document, FieldError, Text, dump_yaml, read_document
from socket_testbed.errors import CalibrationError
from socket_testbed.files import write_text
from socket_testbed.samples import Status

MIN_GAIN = 100.0  # [Pa/pF]; a smaller gain has another unit

_ROUNDING = 1e-9  # [pF]; of a feature at the end of the range; a converter resolves 1e-6
_MAX_NEWTON_STEPS, _TOLERANCE = 20, 1e-11  # [1], [pF]; of the inverse
_OK, _SATURATED, _MISSING, _OUT_OF_RANGE = (np.uint8(status) for status in Status)

SHEAR_TERMS = ("1", "dx", "dy", "dx^2", "dx dy", "dy^2")


def channel_features(capacitance: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean and pair differences of the channels (-x,+y), (+x,+y), (-x,-y), (+x,-y), (..., 4) [pF].

    The differences are along x (mean of +x minus mean of -x) and along y (mean of +y minus mean of
    -y). Mean and differences have shape (...) each [pF].
    """
    c0, c1, c2, c3 = np.moveaxis(capacitance, -1, 0)
    mean = 0.25 * (c0 + c1 + c2 + c3)
    return mean, 0.5 * (c1 + c3 - c0 - c2), 0.5 * (c0 + c1 - c2 - c3)


SHEAR_SIGNS = np.sign(np.stack(channel_features(np.eye(4))[1:]))  # (2, 4); of the channels


def shear_terms(along_x: FloatArray, along_y: FloatArray) -> FloatArray:
    """Monomials `SHEAR_TERMS` of the pair differences, shape (..., 6) [pF^0..pF^2].

    Args:
        along_x: Difference dx of the channels at +x and -x, shape (...) [pF].
        along_y: Difference dy of the channels at +y and -y, shape (...) [pF].
    """
    second = (along_x**2, along_x * along_y, along_y**2)
    return np.stack([np.ones_like(along_x), along_x, along_y, *second], axis=-1)


@dataclass(frozen=True)
class ClusterCalibration:
    """Coefficients of one cluster, or of several stacked along a leading axis.

    Attributes:
        normal: Offset and gain of the normal stress (positive in compression) over the mean of the
            channels, shape (2,) [Pa, Pa/pF].
        shear: Coefficients of `SHEAR_TERMS`, a row for shear x and one for shear y, shape (2, 6)
            [Pa, Pa/pF, Pa/pF^2].
        mean_range: Lower and upper end of the calibrated range of the mean, shape (2,) [pF].
        difference_range: Lower and upper end of the calibrated range of both pair differences,
            shape (2,) [pF].
        wiring: Converter input, 0 to 3, of each channel (-x,+y), (+x,+y), (-x,-y), (+x,-y), shape
            (4,).
        baseline: Capacitances by input of the converter of the unloaded cluster on the bench, shape
            (4,) [pF]; None if not recorded.
        bench: Bench record of these coefficients (date, source, errors) as in `calibration.yaml`,
            for information only; may be empty.
    """

    normal: FloatArray
    shear: FloatArray
    mean_range: FloatArray
    difference_range: FloatArray
    wiring: IntArray
    baseline: FloatArray | None = None
    bench: Mapping[str, Any] = field(default_factory=dict)

    def apply(self, capacitance: FloatArray, status: StatusArray) -> tuple[FloatArray, StatusArray]:
        """Stress on the cluster from the converter's four inputs and their status.

        Outside the calibrated range the stress is extrapolated.

        Args:
            capacitance: Capacitances by input of the converter, shape (..., 4) [pF]; NaN if not
                read. Stacked coefficients of c clusters take shape (..., c, 4).
            status: `Status` of each input, shape (..., 4): ok, saturated or missing.

        Returns:
            The stress, normal (positive in compression), shear x and shear y along the cluster's
            axes, shape (..., 3) [Pa], NaN unless all four channels were read; and its `Status`,
            shape (...).
        """
        capacitance = np.where(np.isfinite(capacitance), capacitance, np.nan)
        features = np.einsum("...ij,...j->...i", self._features, capacitance)
        mean, along_x, along_y = (features[..., i] for i in range(3))
        stress = np.empty_like(features)
        stress[..., 0] = self.normal[..., 0] + self.normal[..., 1] * mean
        terms = shear_terms(along_x, along_y)
        stress[..., 1:] = np.einsum("...ij,...j->...i", self.shear, terms)

        limits = np.stack([self.mean_range, self.difference_range, self.difference_range], axis=-2)
        low, high = limits[..., 0] - _ROUNDING, limits[..., 1] + _ROUNDING
        outside = ((features < low) | (features > high)).any(axis=-1)
        worst = status.max(axis=-1)
        # A saturated input is also NaN, but must be reported as saturated.
        causes = [worst >= _MISSING, worst == _SATURATED, np.isnan(mean), outside]
        result = np.select(causes, [_MISSING, _SATURATED, _MISSING, _OUT_OF_RANGE], _OK)
        stress[causes[0] | causes[1] | causes[2]] = np.nan
        return stress, result

    @cached_property
    def _features(self) -> FloatArray:
        """Matrix of `channel_features` from the inputs, shape (3, 4) [-]; stacked, (c, 3, 4)."""
        by_channel = np.array(channel_features(np.eye(4)))
        return np.moveaxis(by_channel[:, np.argsort(self.wiring)], 0, -2)

    def to_document(self) -> dict[str, Any]:
        """The cluster's section of `calibration.yaml`, in the units of the attributes."""
        document = {
            "normal": self.normal.tolist(),
            "shear_x": self.shear[0].tolist(),
            "shear_y": self.shear[1].tolist(),
            "mean_range": self.mean_range.tolist(),
            "difference_range": self.difference_range.tolist(),
            "wiring": self.wiring.tolist(),
        }
        if self.baseline is not None:
            document["baseline"] = self.baseline.tolist()
        if self.bench:
            document["bench"] = dict(self.bench)
        return document


@dataclass(frozen=True)
class Calibration:
    """Calibration of all clusters.

    Attributes:
        clusters: Coefficients keyed by the cluster's name.
        date: Date of the coefficients as text; the `bench` record of a cluster has its own.
        source: Where the coefficients come from, in words; the `bench` record of a cluster has its
            own.
    """

    clusters: dict[str, ClusterCalibration]
    date: str
    source: str

    @property
    def origin(self) -> str:
        """Its source and date."""
        return f"{self.source} ({self.date})"

    def require(self, clusters: Collection[str], of: str) -> None:
        """Refuse a calibration that lacks one of the clusters.

        Args:
            clusters: Names of the clusters.
            of: What these clusters belong to, for the error, such as `the socket`.

        Raises:
            CalibrationError: If a cluster is not in the calibration.
        """
        lacking = [name for name in clusters if name not in self.clusters]
        if lacking:
            raise CalibrationError(
                f"the calibration has no cluster {', '.join(lacking)} of {of}"
                f" (it has {', '.join(self.clusters) or 'none'})",
                "give the calibration.yaml of these clusters",
            )

    def stacked(self, clusters: Collection[str]) -> ClusterCalibration:
        """Coefficients of c >= 1 known clusters by name, to `apply` to shape (..., c, 4) [pF].

        Each attribute has a leading axis of length c in the order of the names; baselines and bench
        records are left out.
        """
        chosen = [self.clusters[name] for name in clusters]
        names = ("normal", "shear", "mean_range", "difference_range", "wiring")
        arrays: dict[str, Any] = {n: np.stack([getattr(c, n) for c in chosen]) for n in names}
        return ClusterCalibration(**arrays)

    def to_document(self) -> dict[str, Any]:
        """The content of `calibration.yaml`."""
        return {
            "date": self.date,
            "source": self.source,
            "clusters": {name: cluster.to_document() for name, cluster in self.clusters.items()},
        }


_HEADER = """\
# Calibration of the clusters, four capacitances to stress.
# normal: offset [Pa] and gain [Pa/pF] over the mean of the four channels.
# shear_x, shear_y: coefficients of 1, dx, dy, dx^2, dx dy, dy^2 [Pa, Pa/pF, Pa/pF^2] with dx, dy
#   the differences of the channel pairs along x and y [pF].
# mean_range, difference_range: the calibrated ranges [pF].
# wiring: the converter's input of each channel (-x,+y), (+x,+y), (-x,-y), (+x,-y).
# baseline: the inputs of the unloaded cluster on the bench [pF].
# bench: origin and quality of a cluster's coefficients.
"""


def invert_calibration(calibration: ClusterCalibration, stress: FloatArray) -> FloatArray:
    """Capacitances by the converter's input, (N, 4) [pF], for which a calibration gives stresses.

    Args:
        calibration: Calibration of the cluster.
        stress: Normal stress (positive in compression), shear x and shear y in the cluster's frame
            {L}, shape (N, 3) [Pa].
    """
    mean = (stress[:, 0] - calibration.normal[0]) / calibration.normal[1]
    x, y = np.zeros((2, len(stress)))
    _, cx, cy, cxx, cxy, cyy = calibration.shear.T[:, :, None]
    for _ in range(_MAX_NEWTON_STEPS):
        missing_x, missing_y = (stress[:, 1:] - shear_terms(x, y) @ calibration.shear.T).T
        (a, c), (b, d) = cx + 2.0 * cxx * x + cxy * y, cy + cxy * x + 2.0 * cyy * y  # derivatives
        determinant = a * d - b * c
        step_x = (d * missing_x - b * missing_y) / determinant
        step_y = (a * missing_y - c * missing_x) / determinant
        x, y = x + step_x, y + step_y
        if max(np.abs(step_x).max(initial=0.0), np.abs(step_y).max(initial=0.0)) < _TOLERANCE:
            break
    # Channels from mean and differences; the fourth combination, a twist, is zero.
    channels = mean[:, None] + 0.5 * np.column_stack([x, y]) @ SHEAR_SIGNS
    inputs = np.empty_like(channels)
    inputs[:, calibration.wiring] = channels
    return inputs


def write_calibration(calibration: Calibration, path: Path) -> None:
    """Write `calibration.yaml`, complete or not at all.

    Args:
        calibration: The calibration.
        path: The file, which is replaced if it exists.
    """
    text = dump_yaml(calibration.to_document(), default_flow_style=None)
    write_text(path, _HEADER + text)


_Number = Annotated[float, Meta(ge=-1e9, le=1e9)]  # [Pa, Pa/pF, Pa/pF^2, pF]
_Pair = tuple[_Number, _Number]
_Four = tuple[_Number, _Number, _Number, _Number]
_Six = tuple[_Number, _Number, _Number, _Number, _Number, _Number]


class _Cluster(Document):
    normal: _Pair
    shear_x: _Six
    shear_y: _Six
    mean_range: _Pair
    difference_range: _Pair
    wiring: _Four
    baseline: _Four | None = None
    bench: dict[str, Any] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        if sorted(self.wiring) != [0, 1, 2, 3]:
            given = ", ".join(f"{number:g}" for number in self.wiring)
            raise FieldError(f"wiring is [{given}]", "give each of 0, 1, 2, 3 once")
        for key in ("mean_range", "difference_range"):
            low, high = getattr(self, key)
            if low >= high:
                raise FieldError(f"{key} is [{low:g}, {high:g}]", "give [low, high] in pF")
        if self.normal[1] < MIN_GAIN:
            raise FieldError(
                f"the gain of normal is {self.normal[1]:g} Pa/pF",
                "give [offset in Pa, gain in Pa/pF], compression positive",
            )


class _Calibration(Document):
    date: Text
    source: Text
    clusters: dict[str, _Cluster]


def read_calibration(path: Path) -> Calibration:
    """Read `calibration.yaml`: coefficients [Pa, Pa/pF, Pa/pF^2] and ranges [pF] by cluster."""
    document = read_document(path, _Calibration)
    clusters = {
        name: ClusterCalibration(
            normal=np.array(cluster.normal),
            shear=np.array([cluster.shear_x, cluster.shear_y]),
            mean_range=np.array(cluster.mean_range),
            difference_range=np.array(cluster.difference_range),
            wiring=np.array(cluster.wiring, dtype=np.int64),
            baseline=None if cluster.baseline is None else np.array(cluster.baseline),
            bench=cluster.bench,
        )
        for name, cluster in document.clusters.items()
    }
    return Calibration(clusters, str(document.date), str(document.source))
