"""A cluster calibrated from bench data."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from socket_testbed.arrays import FloatArray
from socket_testbed.calibration.model import Calibration, write_calibration
from socket_testbed.documents import path_of
from socket_testbed.figures.style import MEASURED_STYLE, VERMILION, FigureStyle, lay_out, style_axes
from socket_testbed.files import refuse_existing
from socket_testbed.results.result import PathLike, Result

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure

    from socket_testbed.calibration.calibrate import BenchCalibration
    from socket_testbed.calibration.drift import Drift
_MAX_POINTS = 4000  # per panel


@dataclass(frozen=True, repr=False)
class CalibratedCluster(Result):
    """A cluster calibrated from bench data, to be saved into a calibration.

    Attributes:
        name: Name of the cluster.
        quality: The coefficients (`quality.cluster`), the bench data, its outliers, and the errors
            on the data of the fit and on held-out data [Pa].
        baseline: Capacitances of the unloaded cluster before the bench run by converter input,
            shape (4,) [pF]; None without unloaded readings.
        drift: Change of the unloaded cluster over the bench run, for which the bench data is
            corrected: `capacitance` by converter input, shape (4,) [pF], and `stress` (normal,
            shear x, shear y), shape (3,) [Pa]; None without unloaded readings before and after.
        existing: The calibration whose other clusters are kept; None without one.
        existing_file: The file of that calibration, which `save` may replace; None without one.
    """

    name: str
    quality: BenchCalibration
    baseline: FloatArray | None
    drift: Drift | None
    existing: Calibration | None = None
    existing_file: Path | None = None

    def __repr__(self) -> str:
        errors = self.to_dataframe()["held-out RMSE [%]"]
        words = ", ".join(f"{name} {percent:.2g} %" for name, percent in errors.items())
        return (
            f"CalibratedCluster({self.name}: {len(self.quality.bench)} readings; held-out RMSE of"
            f" full scale: {words})"
        )

    def to_dataframe(self) -> pd.DataFrame:
        """Range and errors, a row per stress, indexed by `stress`: normal, shear_x, shear_y.

        Full scale is the largest magnitude of the known stress; outliers do not count for it.

        Columns:

        - `from [Pa]`, `to [Pa]`: range of the known stress without outliers; normal is positive in
          compression;
        - `held-out RMSE [Pa]`, `held-out RMSE [%]`, `held-out MAE [Pa]`, `held-out R2 [-]`: errors
          on groups of readings (files, cycles or blocks) that the fit did not see, the percentage
          of full scale; R2 is the explained share of the variance;
        - `training RMSE [Pa]`: error on the readings of the fit;
        - `hysteresis [%]`, `repeatability [%]`, `cross-talk [%]`: of full scale, see
          `socket_testbed.calibration.calibrate.quality_figures`. NaN if the bench run does not show
          them: without a rise and fall through equal loads, without a repeated cycle, or without a
          pure load along another axis.
        """
        held_out = self.quality.held_out
        columns = {
            "from [Pa]": self.quality.stress_range[:, 0],
            "to [Pa]": self.quality.stress_range[:, 1],
            "held-out RMSE [Pa]": held_out["rmse"],
            "held-out RMSE [%]": held_out["percent"],
            "held-out MAE [Pa]": held_out["mae"],
            "held-out R2 [-]": held_out["r2"],
            "training RMSE [Pa]": self.quality.training["rmse"],
            "hysteresis [%]": self.quality.figures["hysteresis"],
            "repeatability [%]": self.quality.figures["repeatability"],
            "cross-talk [%]": self.quality.figures["cross_talk"],
        }
        return pd.DataFrame(columns).rename_axis("stress")

    def notes(self) -> list[str]:
        """A note if other clusters of the existing calibration were fitted to these readings."""
        old, new = self.existing.clusters if self.existing else {}, self.quality.cluster
        same = [
            name
            for name, other in old.items()
            if name != self.name
            and np.allclose(
                [*other.normal, *other.mean_range], [*new.normal, *new.mean_range], 1e-9
            )
        ]
        note = (
            f"{self.name} has the same bench readings as {', '.join(same)}: calibrate every cluster"
            " on a bench run of its own"
        )
        return [note] if same else []

    def calibration(self, limit: float = 10.0, force: bool = False) -> Calibration:
        """The existing calibration with this cluster replaced or added.

        Args:
            limit: Largest held-out RMSE [% of the full scale].
            force: Whether to accept a cluster above the limit, marked as forced.

        Returns:
            The calibration: its coefficients by cluster, with this cluster's errors as its `bench`.

        Raises:
            CalibrationError: The normal stress does not grow with the capacitance, or a held-out
                RMSE exceeds the limit.
        """
        from socket_testbed.calibration.calibrate import bench_record

        self.quality.require_gain()
        if not force:
            self.quality.require_accuracy(limit)
        today, forced = date.today().isoformat(), bool(self.quality.above(limit))
        record = bench_record(self.quality, today, limit, forced, self.drift)
        cluster = dataclasses.replace(self.quality.cluster, baseline=self.baseline, bench=record)
        old = self.existing
        clusters = {**(old.clusters if old else {}), self.name: cluster}
        if old is not None and not all(c.bench for c in clusters.values()):
            # Clusters without a record of their own rely on the old date and source.
            return dataclasses.replace(old, clusters=clusters)
        sources = [f"{name}: {c.bench.get('source')}" for name, c in clusters.items()]
        return Calibration(clusters, today, "; ".join(sources))

    def save(
        self, path: PathLike, limit: float = 10.0, force: bool = False, replace: bool = False
    ) -> None:
        """Write `calibration` to a new file, or over the existing calibration.

        Args:
            path: The YAML file, whatever its suffix.
            limit: Largest held-out RMSE [% of the full scale].
            force: Whether to accept a cluster above the limit.
            replace: Whether to replace another file.

        Raises:
            CalibrationError: As in `calibration`.
            ConfigurationError: Another file exists.
        """
        path = path_of(path, "the file")
        own = self.existing_file is not None and self.existing_file.resolve() == path.resolve()
        if not (own or replace):
            refuse_existing(path)
        calibration = self.calibration(limit, force)
        write_calibration(calibration, path)

    def _figure(self, style: FigureStyle) -> Figure:
        """Calibrated versus known stress, and the residuals; a column per stress."""
        from socket_testbed.calibration.bench_data import STRESSES

        found = self.quality
        groups = found.cross_validation.groups
        known, fitted, held_out = (
            1e-3 * stress
            for stress in (found.bench.stress, found.fitted, found.cross_validation.predicted)
        )
        some = slice(None, None, 1 + len(known) // _MAX_POINTS)
        figure = style.figure(110.0)
        axes = figure.subplots(2, 3, sharex="col")
        files = ", ".join(found.bench.files)
        style.add_title(figure, f"{self.name}: {files}; {groups} held out in turn")
        for k, name in enumerate(STRESSES):
            x = known[:, k]
            above, below = axes[:, k]
            ends = [x[some].min(), x[some].max()]
            above.plot(ends, ends, **MEASURED_STYLE)
            above.plot(x[some], fitted[some, k], ".", color="0.2", markersize=2.0)
            if outliers := [o for o in found.outliers if o.axis == k]:
                places = np.array([(o.known, o.fitted) for o in outliers]).T * 1e-3
                above.plot(*places, "o", color=VERMILION, fillstyle="none", label="outlier")
            unseen = (held_out - known)[some, k]
            below.plot(x[some], unseen, "x", color=VERMILION, markersize=3.0, label="held out")
            fit = (fitted - known)[some, k]
            below.plot(x[some], fit, ".", color="0.2", markersize=2.0, label="in the fit")
            below.axhline(0.0, color=MEASURED_STYLE["color"], linewidth=1.0)
            error = f"\nheld-out:\n{found.held_out['percent'].iloc[k]:.1f} % of\nfull scale"
            above.set_title(name + error * style.titles)
            below.set_xlabel("known [kPa]")
        for row, label in enumerate(("calibrated", "residual")):
            axes[row, 0].set_ylabel(f"{label} [kPa]")
        keys: dict[str, Artist] = {}
        for axis in axes.flat:
            style_axes(axis)
            axis.locator_params(nbins=4 if style.is_narrow else 6)
            handles, labels = axis.get_legend_handles_labels()
            keys |= dict(zip(labels, handles, strict=True))
        figure.legend(keys.values(), keys.keys(), loc="outside lower center", ncols=3)
        return lay_out(figure)
