"""Survey: the force map of one limb, judged and completed by trials with moved clusters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from socket_testbed.api.trials import (
    Progress,
    as_path,
    as_trial,
    require_different,
    require_one_socket,
    started,
    trials_of,
    unique_names,
)
from socket_testbed.arrays import BoolArray, FloatArray, rms
from socket_testbed.documents import check_whole
from socket_testbed.errors import ConfigurationError, IdentificationError, naming
from socket_testbed.geometry.regions import all_regions, tiles_named
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification import survey as numerics
from socket_testbed.identification.survey import Donned
from socket_testbed.identification.survey_prior import learnt
from socket_testbed.results.result import PathLike
from socket_testbed.results.survey import Survey
from socket_testbed.settings.options import EstimationOptions, SurveyOptions
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.segment import Segment, Span, specification_of
from socket_testbed.trials.trial import Trial

_MAX_TRIALS = 12
_MAX_CLUSTERS = 64
_LOAD_TOLERANCE = 0.05  # [-]; mismatch of like loads that is noted


def open_surveyed(trials: Sequence[Trial | PathLike]) -> list[Trial]:
    """The trials of a survey, all different and of one socket; their data is not read.

    Args:
        trials: The trials or their folders.

    Raises:
        ConfigurationError: There are too few or too many, one is given twice, or they are of
            different sockets.
    """
    if not 2 <= len(trials) <= _MAX_TRIALS:
        raise ConfigurationError(
            f"trials of a survey: {len(trials)}",
            f"give 2 to {_MAX_TRIALS} of one limb, with clusters on other tiles",
        )
    opened = [as_trial(each) for each in trials]
    require_different(opened)
    require_one_socket(opened, "survey one limb in one socket at a time")
    return opened


def survey(
    *trials: Trial | PathLike,
    segment: str | Span | Segment = SurveyOptions.segment,
    clusters: int | None = SurveyOptions.clusters,
    keep_out: Sequence[str] = (),
    params: PathLike | None = None,
    progress: Progress | None = None,
) -> Survey:
    """Judge and complete the force map of one limb by trials with moved clusters.

    The limb is put on and loaded alike in every trial, and its clusters are on other tiles, which
    each trial's `socket.yaml` states. Each trial's own map is judged by what the other trials
    measured elsewhere, and all of them complete one map: see
    `socket_testbed.identification.survey`. A trial repeated without moving the clusters tells what
    donning and sensors change. docs/survey.md is the protocol for an afternoon.

    Args:
        trials: Two to 12 trials of one limb in one socket.
        segment: As in `fit`, for every trial; its loads are matched by their wrench.
        clusters: Number of clusters of the next trial, for which places are proposed; 0 for none,
            by default as many as in the last trial.
        keep_out: Regions and tiles excluded from proposals, such as `anterior proximal`.
        params: A `testbed.yaml` to use instead of the first trial's own; its group `force_map` sets
            the prior of all maps.
        progress: See `Progress`.

    Returns:
        The survey: `verdict` in a sentence, `scores()` by region and distance, `to_dataframe()`
        every judged place, `pressures()` every tile.

    Raises:
        ConfigurationError: There are too few or too many trials, one is given twice, they are of
            different sockets, or a setting is wrong.
        TrialError: A trial cannot be read or has no such segment.
        IdentificationError: The trials share no like load, all clusters are in the same places, or
            the measured values of a trial have another unit.

    >>> options = dict(duration=40, seed=3, donning=1, geometry="moved.yaml")
    >>> moved = st.simulate("trials/moved", **options)
    >>> found = st.survey("trials/hold", moved)
    >>> found
    Survey(2 trials hold, moved; 6 judged values, error ...)
    >>> found.verdict
    'on this limb a map of 4 clusters is within ... of the force between them; ...'
    >>> st.write_survey(found, "survey.html")
    """
    specification = specification_of(segment)
    options = EstimationOptions(params=as_path(params))
    opened = open_surveyed(trials_of(trials))
    names = unique_names(opened)
    settings = opened[0].settings_for(options)
    geometry = opened[0].geometry
    report = started(progress, "surveying")
    parts: list[_Part] = []
    for done, (name, trial) in enumerate(zip(names, opened, strict=True), start=1):
        with naming(name, IdentificationError):
            parts.append(_part_of(trial, specification, trial.settings_for(options)))
        report(done, len(opened) + 2)
    donned, mismatch = _matched(parts, settings)
    free = _free_tiles(geometry, parts, keep_out)
    wanted = (
        len(donned[-1].tiles)
        if clusters is None
        else check_whole(clusters, "--clusters", 0, _MAX_CLUSTERS)
    )
    if wanted > free.sum():
        raise ConfigurationError(
            f"{wanted} clusters do not fit on {free.sum()} tiles that no trial measured",
            "give a lower number for --clusters, or keep out of fewer regions",
        )
    with threadpool_limits(1):
        joint = numerics.JointMap(geometry, donned, settings.force_map)
        report(len(opened) + 1, len(opened) + 2)
        own = [numerics.JointMap(geometry, [each], settings.force_map) for each in donned]
        judged = numerics.judge(geometry, donned, joint, own)
        tiles, gain = joint.place_next(wanted, free)
        report(len(opened) + 2, len(opened) + 2)
    sides = {trial.metadata.side for trial in opened}
    return Survey(
        trials=names,
        segments=tuple(str(part.segment) for part in parts),
        geometry=geometry,
        clusters=tuple(part.places for part in parts),
        states=len(donned[0].values),
        mismatch=rms(mismatch),
        change=joint.change,
        judgements=judged,
        single=tuple(each.field(0) for each in own),
        completed=tuple(joint.field(number) for number in range(len(donned))),
        limb=joint.field(),
        learnt=learnt(
            joint,
            geometry,
            [(n, t.fingerprint, [*p.places]) for n, t, p in zip(names, opened, parts, strict=True)],
            donned,
        ),
        next_tiles=tuple(geometry.names[tile] for tile in tiles.tolist()),
        next_error=gain if wanted else float("nan"),
        side=sides.pop() if len(sides) == 1 else None,
        notes=tuple(_notes(names, opened, rms(mismatch))),
    )


@dataclass(frozen=True, eq=False)
class _Part:
    """The usable samples of a trial's segment.

    Attributes:
        segment: The segment.
        places: The tile under each of its c clusters, by name.
        tiles: Indices of these tiles, shape (c,).
        values: Its samples by channel, shape (N, 6 + 3c) [N m, N].
    """

    segment: Segment
    places: Mapping[str, str]
    tiles: tuple[int, ...]
    values: FloatArray


def _part_of(trial: Trial, specification: str, settings: EstimatorSettings) -> _Part:
    chosen = trial.select(specification, settings)
    trial.note_problems(settings.identification.leave_out)
    checked = trial.checked(settings.identification.leave_out)
    checked.part(chosen.rows)  # refuses another unit
    samples = checked.counted[chosen.rows]
    values = samples.trusted_values
    known = np.isfinite(values)
    usable = (known | ~known.any(axis=0)).all(axis=1)
    if not usable.any() or not known[:, :6].any():
        raise IdentificationError(
            "no sample has a wrench and all clusters", "choose another part with --segment"
        )
    tiles = tuple(trial.geometry.clusters[name] for name in samples.clusters)
    names = trial.geometry.names
    places = {name: names[tile] for name, tile in zip(samples.clusters, tiles, strict=True)}
    return _Part(chosen, places, tiles, values[usable])


def _matched(
    parts: Sequence[_Part], settings: EstimatorSettings
) -> tuple[list[Donned], FloatArray]:
    """The trials at like loads, and the mismatch of each load over the force [-]."""
    wrenches = [part.values[:, :6] for part in parts]
    known = np.all([np.isfinite(each).all(axis=0) for each in wrenches], axis=0)
    shown = [np.where(known, each, 0.0) for each in wrenches]
    rows, mismatch = numerics.match_loads(shown, settings.force_map.arm)
    found = [Donned(part.tiles, part.values[some]) for part, some in zip(parts, rows, strict=True)]
    return found, mismatch


def _free_tiles(
    geometry: SocketGeometry, parts: Sequence[_Part], keep_out: Sequence[str]
) -> BoolArray:
    """Tiles that no trial measured and that may take a cluster, shape (n,)."""
    named = {name: np.array([tile]) for tile, name in enumerate(geometry.names)}
    named |= {region.name: region.tiles for region in all_regions(geometry)}
    free = np.ones(len(geometry), dtype=bool)
    for part in parts:
        free[list(part.tiles)] = False
    for name in keep_out:
        free[tiles_named(name, named)] = False
    return free


def _notes(names: Sequence[str], trials: Sequence[Trial], mismatch: float) -> Iterator[str]:
    subjects = {trial.metadata.subject for trial in trials}
    if len(subjects) > 1:
        yield (
            "the trials state different subjects"
            f" ({', '.join(sorted(str(each or 'none') for each in subjects))}): a survey is of one"
            " limb"
        )
    if mismatch > _LOAD_TOLERANCE:
        yield (
            f"the loads differ by {100.0 * mismatch:.0f} % of the force between trials: this counts"
            " as an error of the maps"
        )
    for name, trial in zip(names, trials, strict=True):
        if trial.geometry.registration != trials[0].geometry.registration:
            yield f"{name}: its marker bodies are registered otherwise than those of {names[0]}"
