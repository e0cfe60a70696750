"""Force map over all tiles, and pressure outputs by region; neither needs a fit."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence

from threadpoolctl import threadpool_limits

from socket_testbed.api.trials import as_path, as_trial
from socket_testbed.documents import check_kind, mapping_of, path_of
from socket_testbed.geometry.socket import SocketGeometry, find_regions
from socket_testbed.identification.pressure import check_measured
from socket_testbed.identification.survey_prior import SurveyPrior, read_survey
from socket_testbed.results.pressure import TrialMap, TrialPressure, map_trial
from socket_testbed.results.result import PathLike
from socket_testbed.results.survey import Survey
from socket_testbed.samples import refuse_unknown_channels
from socket_testbed.settings.options import MapOptions, PressureOptions, SettingsOptions
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.segment import Segment, Span
from socket_testbed.trials.trial import Trial


def force_map(
    trial: Trial | PathLike,
    segment: str | Span | Segment = MapOptions.segment,
    *,
    params: PathLike | None = None,
    prior: Survey | PathLike | None = None,
) -> TrialMap:
    """Estimate the force on every tile from the clusters and the wrench, sample by sample.

    The estimate is a Gaussian process over the socket's surface and needs no fitted model. Missing,
    saturated, out-of-range and left-out channels are ignored.

    Args:
        trial: The trial.
        segment: As in `fit`.
        params: A `testbed.yaml` to use instead of the trial's own; its group `force_map` sets the
            prior.
        prior: A survey of this limb in this socket, such as the file of `survey -o FILE.json`, as a
            prior of the force map; the trial must not be in it.

    Returns:
        The map: `estimate` holds its arrays, `to_dataframe()` a row per sample, `summary()` the
        mean of each tile.

    Raises:
        ConfigurationError: A setting or a file is wrong, or the survey is of another socket or
            holds the trial.
        TrialError: The trial cannot be read or has no such segment, or no sample of it has a wrench
            or a cluster.
        IdentificationError: The measured values have another unit.

    >>> found = st.force_map(st.open_trial("trials/hold"), segment="10:20")
    >>> found
    TrialMap(hold, span 10.00 s to 20.00 s; 41 samples, highest mean pressure ... kPa on ...)
    >>> found.estimate.forces.shape, list(found.to_dataframe())[:2]
    ((41, 79, 3), ['distal.Fx [N]', 'distal.Fx.sd [N]'])
    >>> found.save("map.csv")
    >>> found.at(12.0).draws().shape  # for intervals of any function of the map
    (1, 200, 79, 3)
    """
    trial = as_trial(trial)
    settings = trial.settings_for(SettingsOptions(params=as_path(params)))
    return _mapped(trial, segment, settings, prior=prior)


def _mapped(
    trial: Trial,
    segment: str | Span | Segment,
    settings: EstimatorSettings,
    geometry: SocketGeometry | None = None,
    prior: Survey | PathLike | None = None,
) -> TrialMap:
    learnt = prior_for(trial, prior)
    refuse_unknown_channels(settings.identification.leave_out, trial.samples().channels)
    chosen = trial.select(segment, settings)
    trial.note_problems(settings.identification.leave_out)
    with threadpool_limits(1):
        found = map_trial(trial, settings, geometry, learnt).part(chosen)
    check_measured(found.samples)
    return found


def prior_for(trial: Trial, prior: Survey | PathLike | None) -> SurveyPrior | None:
    """What a survey taught, for a trial of its limb that is not in it.

    Args:
        trial: The trial.
        prior: A result of `st.survey`, or the path of its file; None for no survey.

    Raises:
        ConfigurationError: The file is no survey, is of another socket, or holds the trial.
    """
    if prior is None:
        return None
    if isinstance(prior, Survey):
        found = prior.learnt
    else:
        hint = "give a result of st.survey, or the path of its file"
        check_kind(prior, (str, os.PathLike), "the prior", hint)
        found = read_survey(path_of(prior, "the prior"))
    found.require(str(trial.path), trial.geometry, trial.fingerprint)
    return found


def pressure(
    trial: Trial | PathLike,
    segment: str | Span | Segment = PressureOptions.segment,
    *,
    threshold: float = PressureOptions.threshold,
    share: float = PressureOptions.share,
    regions: Mapping[str, Sequence[str]] | None = None,
    params: PathLike | None = None,
    leave_out: Sequence[str] | None = None,
    prior: Survey | PathLike | None = None,
) -> TrialPressure:
    """Pressure and shear of a socket by region and tile, with 95 % intervals.

    The outputs are peak and mean pressure, contact area, pressure-time integral, centre of
    pressure, shear and share of the load, computed from the force map, see `st.force_map` and
    `socket_testbed.identification.pressure`.

    Args:
        trial: The trial.
        segment: As in `fit`.
        threshold: Pressure above which a tile is in contact [kPa].
        share: A value is uncertain if its interval reaches farther than this share of it [-].
        regions: Tile names by region, instead of the regions of `socket.yaml`.
        params: A `testbed.yaml` to use instead of the trial's own; its group `force_map` sets the
            prior.
        leave_out: Channels to ignore, such as `distal.Fx` or `Mz`; `distal` ignores all of a
            cluster.
        prior: A survey of this limb in this socket, such as the file of `survey -o FILE.json`, as a
            prior of the force map; the trial must not be in it.

    Returns:
        The outputs: `regions` and `tiles` are tables over the segment, `over_time()` one of every
        sample, `limb()` one of the limb's motion and stiffness.

    Raises:
        ConfigurationError: A setting, a file or a region is wrong, or the survey is of another
            socket or holds the trial.
        TrialError: The trial cannot be read, has no such segment, or nothing was measured in it.
        IdentificationError: The measured values have another unit.

    >>> found = st.pressure(st.open_trial("trials/hold"))
    >>> found
    TrialPressure(hold, plateau ... s; 21 regions, peak pressure ... to ... kPa)
    >>> list(found.regions)[:3]
    ['peak pressure [kPa]', 'peak pressure low [kPa]', 'peak pressure high [kPa]']
    >>> found.save("pressure.csv")
    """
    trial = as_trial(trial)
    limits = PressureOptions(threshold=threshold, share=share)
    options = SettingsOptions(params=as_path(params), leave_out=leave_out)
    settings = trial.settings_for(options)
    geometry = trial.geometry
    if regions is not None:
        hint = "give tiles by name, such as {'heel': ['distal']}"
        own = find_regions(mapping_of(regions, "regions", hint), geometry.names, "regions")
        geometry = dataclasses.replace(geometry, regions=own)
    mapped = _mapped(trial, segment, settings, geometry, prior)
    with threadpool_limits(1):
        return mapped.pressure(limits.threshold, limits.share)
