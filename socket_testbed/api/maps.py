"""The force map of a trial: the force on every tile with its uncertainty, without a fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from socket_testbed.api.result import Result, origin, records
from socket_testbed.api.trials import PathLike, as_path, select
from socket_testbed.arrays import FloatArray
from socket_testbed.identification.force_map import MapEstimate, map_samples
from socket_testbed.settings.testbed import estimator_settings
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from socket_testbed.report.figures.style import FigureStyle


@dataclass(frozen=True, repr=False)
class TrialMap(Result):
    """Forces on all tiles over a segment of a trial, with their standard deviations."""

    trial: Trial
    segment: Segment
    time: FloatArray  # (N,) [s], of its samples since the first sample of the trial
    estimate: MapEstimate

    def __repr__(self) -> str:
        mean = self.estimate.mean()
        peak = int(mean.normal_pressure[0].argmax())
        return (
            f"TrialMap({self.trial.name}, {self.segment}; {len(self.time)} samples, highest mean"
            f" pressure {1e-3 * mean.normal_pressure[0, peak]:.1f} +-"
            f" {1e-3 * mean.normal_pressure_standard_deviation[0, peak]:.1f} kPa on"
            f" {self.trial.geometry.names[peak]})"
        )

    def to_dataframe(self) -> pd.DataFrame:
        """The map as a pandas table, a row per sample, indexed by `time [s]`.

        Columns per tile: force in {S} with its standard deviations, such as `tile_012.Fz [N]` and
        `tile_012.Fz.sd [N]`, then `pressure [Pa]` (positive in compression) and `shear [Pa]`.
        """
        import pandas as pd

        columns = self.estimate.columns(self.trial.geometry.names)
        return pd.DataFrame(columns, index=pd.Index(self.time, name="time [s]"))

    def summary(self) -> pd.DataFrame:
        """Means over the segment, a row per tile, the highest pressure first.

        A standard deviation is that of the mean's error: it does not shrink with the number of
        samples, since what the sensors leave open stays the same.
        """
        import pandas as pd

        geometry, mean = self.trial.geometry, self.estimate.mean()
        clusters = {tile: cluster for cluster, tile in geometry.clusters.items()}
        table = pd.DataFrame(
            {
                "cluster": [clusters.get(tile, "") for tile in range(len(geometry))],
                "pressure [kPa]": 1e-3 * mean.normal_pressure[0],
                "pressure sd [kPa]": 1e-3 * mean.normal_pressure_standard_deviation[0],
                "shear [kPa]": 1e-3 * mean.shear[0],
                "shear sd [kPa]": 1e-3 * mean.shear_standard_deviation[0],
            },
            index=pd.Index(geometry.names, name="tile"),
        )
        return table.sort_values("pressure [kPa]", ascending=False, kind="stable")

    def document(self) -> dict[str, Any]:
        """The map for JSON, with its means over the segment by tile."""
        means = records(self.summary().reset_index())
        return origin(self.trial, self.segment) | {"tiles": means} | super().document()

    def _figure(self, style: FigureStyle) -> Figure:
        """The mean pressure on the tiles, and its standard deviation."""
        from socket_testbed.report.sections.pressure import force_map_figure

        heading = f"{self.trial.name}, {self.segment}: force map"
        return force_map_figure(self.trial.geometry, self.estimate.mean(), heading, style)


def force_map(
    trial: Trial,
    segment: str | Segment = "plateau",
    *,
    params: PathLike | None = None,
) -> TrialMap:
    """Estimate the force on every tile from the clusters and the wrench, sample by sample.

    A Gaussian process over the socket's surface; it needs no fitted model. Channels that are
    missing, saturated, out of range or left out do not count.

    Args:
        trial: The trial.
        segment: The segment, or its specification, see `st.select_segment`.
        params: A `testbed.yaml` to use instead of the trial's own; its group `force_map` is the
            prior.

    Raises:
        ConfigurationError: For a wrong setting.
        TrialError: If the trial cannot be read or holds no such segment.

    >>> found = st.force_map(st.open_trial("trials/hold"), segment="10:20")
    >>> found
    TrialMap(hold, span 10.00 s to 20.00 s; 41 samples, highest mean pressure ... kPa on ...)
    >>> found.estimate.forces.shape, list(found.to_dataframe())[:2]
    ((41, 79, 3), ['distal.Fx [N]', 'distal.Fx.sd [N]'])
    >>> found.save("map.csv")
    """
    settings = estimator_settings(trial.estimator, as_path(params))
    samples = trial.samples()
    chosen = select(trial, segment, settings)
    with threadpool_limits(1):
        estimate = map_samples(
            samples[chosen.rows],
            trial.geometry,
            settings.force_map,
            settings.identification.leave_out,
        )
    return TrialMap(trial, chosen, np.asarray(samples.time[chosen.rows]), estimate)
