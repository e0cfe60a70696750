"""How a survey is computed: like loads of its trials, the maps and what judges them, free tiles."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from socket_testbed.arrays import BoolArray, FloatArray, rms
from socket_testbed.errors import ConfigurationError, IdentificationError
from socket_testbed.geometry.regions import all_regions, tiles_named
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification import survey as numerics
from socket_testbed.identification.survey import Donned
from socket_testbed.identification.survey_prior import learnt
from socket_testbed.results.survey import Survey
from socket_testbed.settings.identification import ForceMapSettings
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial

_LOAD_TOLERANCE = 0.05  # [-]; mismatch of like loads that is noted


@dataclass(frozen=True, eq=False)
class SurveyedPart:
    """The usable samples of a trial's segment.

    Attributes:
        name: Name of the trial among the others.
        trial: The trial.
        segment: The segment.
        places: The tile under each of its c clusters, by name.
        tiles: Indices of these tiles, shape (c,).
        values: Its samples by channel, shape (N, 6 + 3c) [N m, N].
    """

    name: str
    trial: Trial
    segment: Segment
    places: Mapping[str, str]
    tiles: tuple[int, ...]
    values: FloatArray

    @classmethod
    def of(
        cls, name: str, trial: Trial, settings: EstimatorSettings, segment: Segment
    ) -> SurveyedPart:
        """The usable samples of a segment, and a note on each problem of the trial's data.

        Args:
            name: Name of the trial among the others.
            trial: The trial.
            settings: Its settings, which name the channels to leave out.
            segment: The part of the trial.

        Raises:
            IdentificationError: If no sample has a wrench and all clusters, or if the samples are
                in another unit or frame.
        """
        leave_out = settings.identification.leave_out
        trial.note_problems(leave_out)
        checked = trial.checked(leave_out)
        checked.part(segment.rows)  # refuses another unit
        samples = checked.counted[segment.rows]
        values = samples.trusted_values
        known = np.isfinite(values)
        usable = (known | ~known.any(axis=0)).all(axis=1)
        if not usable.any() or not known[:, :6].any():
            raise IdentificationError(
                "no sample has a wrench and all clusters", "choose another part with --segment"
            )
        tiles = tuple(trial.geometry.clusters[cluster] for cluster in samples.clusters)
        names = trial.geometry.names
        places = {each: names[tile] for each, tile in zip(samples.clusters, tiles, strict=True)}
        return cls(name, trial, segment, places, tiles, values[usable])


def survey_parts(
    parts: Sequence[SurveyedPart],
    settings: ForceMapSettings,
    clusters: int | None,
    keep_out: Sequence[str],
    report: Callable[[int, int], None],
) -> Survey:
    """Judge and complete the force map of a limb by trials with moved clusters.

    Args:
        parts: The parts of J trials of one limb in one socket.
        settings: The ordinary prior of all maps.
        clusters: Number of clusters of the next trial; None for as many as in the last one.
        keep_out: Regions and tiles excluded from proposals.
        report: Called after each of two steps, with the steps done and their number; reading each
            trial was one, too.

    Raises:
        ConfigurationError: If the number of clusters or a name to keep out is wrong.
        IdentificationError: If the trials share no like load, or all clusters are in one place.
    """
    trials, names = [part.trial for part in parts], tuple(part.name for part in parts)
    geometry, steps = trials[0].geometry, len(parts) + 2
    donned, mismatch = _matched(parts, settings)
    free = _free_tiles(geometry, parts, keep_out)
    wanted = len(donned[-1].tiles) if clusters is None else clusters
    if wanted > free.sum():
        raise ConfigurationError(
            f"{wanted} clusters do not fit on {free.sum()} tiles that no trial measured",
            "give a lower number for --clusters, or keep out of fewer regions",
        )
    with threadpool_limits(1):
        joint = numerics.JointMap(geometry, donned, settings)
        report(steps - 1, steps)
        own = [numerics.JointMap(geometry, [each], settings) for each in donned]
        judged = numerics.judge(geometry, donned, joint, own)
        tiles, gain = joint.place_next(wanted, free)
        report(steps, steps)
    sides = {trial.metadata.side for trial in trials}
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
            [(part.name, part.trial.fingerprint, [*part.places]) for part in parts],
            donned,
        ),
        next_tiles=tuple(geometry.names[tile] for tile in tiles.tolist()),
        next_error=gain if wanted else float("nan"),
        side=sides.pop() if len(sides) == 1 else None,
        notes=tuple(_notes(names, trials, rms(mismatch))),
    )


def _matched(
    parts: Sequence[SurveyedPart], settings: ForceMapSettings
) -> tuple[list[Donned], FloatArray]:
    """The trials at like loads, and the mismatch of each load over the force [-]."""
    wrenches = [part.values[:, :6] for part in parts]
    known = np.all([np.isfinite(each).all(axis=0) for each in wrenches], axis=0)
    shown = [np.where(known, each, 0.0) for each in wrenches]
    rows, mismatch = numerics.match_loads(shown, settings.arm)
    found = [Donned(part.tiles, part.values[some]) for part, some in zip(parts, rows, strict=True)]
    return found, mismatch


def _free_tiles(
    geometry: SocketGeometry, parts: Sequence[SurveyedPart], keep_out: Sequence[str]
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
