"""The gate: what is believable in some samples, judged once for everything that uses them.

Outliers are judged over all samples, whatever part of them is used: a value is an outlier of its
trial, or of none. Units and the number of outliers are judged over the part that is used, because
a limb that is not yet in the socket says nothing about the units of a later hold.

Fits, maps, validation and reports take samples from here and judge no value again. The rules are
functions of `plausibility` (single values, units), `data_check` (whole sources) and `noise`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

from socket_testbed.arrays import BoolArray
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification import plausibility
from socket_testbed.identification.data_check import check_data
from socket_testbed.identification.data_finding import DataFinding
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.identification.noise import ChannelNoise, channel_noise
from socket_testbed.identification.plausibility import Outliers
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import ForceMapSettings

if TYPE_CHECKING:
    from socket_testbed.identification.survey_prior import SurveyPrior


@dataclass(frozen=True)
class Evidence:
    """What is known of a trial beside its samples, for the check of its data.

    Attributes:
        mass: Mass of the person [kg]; None if it is unknown.
        raw: What the measurements show from which the samples were made, and what nodes reported.
    """

    mass: float | None = None
    raw: tuple[DataFinding, ...] = ()


@dataclass(frozen=True, eq=False)
class CheckedSamples:
    """Samples of a trial or of a window, judged once; every property is computed once and kept.

    Attributes:
        measured: The N samples as measured.
        geometry: The socket, which has the clusters of the samples.
        leave_out: Names of channels that are not judged and keep their values, such as `Mz`.
        whole: Whether the samples are a whole trial, see `data_check.check_data`.
        evidence: Returns what else the findings take into account.
    """

    measured: Samples
    geometry: SocketGeometry
    leave_out: tuple[str, ...] = ()
    whole: bool = True
    evidence: Callable[[], Evidence] = Evidence
    _maps: dict[tuple[ForceMapSettings, bool, SurveyPrior | None], ForceMap] = field(
        default_factory=dict, init=False, repr=False
    )

    def __getstate__(self) -> dict[str, Any]:
        # A map is large and quickly made again.
        return vars(self) | {"_maps": {}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)

    @cached_property
    def outliers(self) -> Outliers:
        """Single implausible values, judged over all N samples."""
        return plausibility.find_outliers(self.measured, self.geometry, self.leave_out)

    @cached_property
    def samples(self) -> Samples:
        """The N samples with outliers as NaN."""
        return self.outliers.taken_from(self.measured)

    @cached_property
    def counted(self) -> Samples:
        """The N samples with outliers and left-out channels as NaN."""
        return self.samples.without(self.leave_out)

    @cached_property
    def noise(self) -> ChannelNoise:
        """Noise of every channel over all N samples, without outliers."""
        return channel_noise(self.samples)

    @cached_property
    def findings(self) -> tuple[DataFinding, ...]:
        """Defects of the data, the worst first; empty for good data, see `data_check`."""
        known = self.evidence()
        return check_data(
            self.measured,
            self.geometry,
            mass=known.mass,
            leave_out=self.leave_out,
            whole=self.whole,
            raw=known.raw,
            outliers=self.outliers,
            prior_map=self.prior_map,
            noise=self.noise,
        )

    def part(self, rows: slice | BoolArray = slice(None)) -> Samples:
        """The samples of some rows with outliers as NaN, for a fit.

        Args:
            rows: Rows of the samples: a slice, or a mask of shape (N,).

        Raises:
            IdentificationError: If these samples are in another unit or frame, or if more than
                `plausibility.MAX_OUTLIERS` of them hold an outlier.
        """
        part = self.samples[rows]
        plausibility.require_units(part, self.geometry, self.leave_out)
        plausibility.require_few_outliers(self.measured, self.outliers, rows)
        return part

    def posed(self, rows: slice | BoolArray = slice(None)) -> Samples:
        """The samples of some rows with outliers as NaN, for predictions from the limb's pose.

        Args:
            rows: Rows of the samples: a slice, or a mask of shape (N,).

        Raises:
            IdentificationError: If the limb positions of these samples, as measured, are in another
                unit or frame.
        """
        plausibility.require_position(self.measured[rows], self.geometry)
        return self.samples[rows]

    def force_map(self, settings: ForceMapSettings, prior: SurveyPrior | None = None) -> ForceMap:
        """The force map whose prior is weighed by the evidence of all N samples.

        Args:
            settings: Sizes and spreads of the ordinary prior.
            prior: A survey of the limb; None for the ordinary prior alone.

        Raises:
            IdentificationError: If the samples are in another unit or frame.
        """
        return self._map(settings, True, prior)

    def prior_map(self, settings: ForceMapSettings, prior: SurveyPrior | None = None) -> ForceMap:
        """The force map whose prior is weighed by the samples that it is given, see `ForceMap`.

        Args:
            settings: Sizes and spreads of the ordinary prior.
            prior: A survey of the limb; None for the ordinary prior alone.
        """
        return self._map(settings, False, prior)

    def _map(
        self, settings: ForceMapSettings, weighed: bool, prior: SurveyPrior | None
    ) -> ForceMap:
        key = settings, weighed, prior
        if key not in self._maps:
            for other in [*self._maps]:
                if other[2] not in (None, prior):  # a map with a survey is large
                    del self._maps[other]
            if weighed:
                plausibility.require_units(self.measured, self.geometry, self.leave_out)
            trial = self.counted if weighed else None
            clusters = self.measured.clusters
            surveyed = None if prior is None else prior.expected(self.geometry, clusters)
            self._maps[key] = ForceMap(self.geometry, clusters, settings, trial, surveyed)
        return self._maps[key]
