"""Survey: the force map of one limb, judged and completed by trials with moved clusters."""

from __future__ import annotations

from collections.abc import Sequence

from socket_testbed.api.trials import (
    Progress,
    as_path,
    open_different,
    require_one_socket,
    started,
    trials_of,
    unique_names,
)
from socket_testbed.errors import ConfigurationError, IdentificationError, naming
from socket_testbed.results.result import PathLike
from socket_testbed.results.survey import Survey
from socket_testbed.results.surveying import SurveyedPart, survey_parts
from socket_testbed.settings.options import SettingsOptions, SurveyOptions
from socket_testbed.trials.segment import Segment, Span, specification_of
from socket_testbed.trials.trial import Trial

_MAX_TRIALS = 12


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
    opened = open_different(trials)
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
        trials: Two to 12 trials of one limb in one socket; notes on a trial given as a folder begin
            with its name.
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
    options = SettingsOptions(params=as_path(params))
    proposed = SurveyOptions(clusters=clusters).clusters
    opened = open_surveyed(trials_of(trials))
    names = unique_names(opened)
    settings = opened[0].settings_for(options)
    report, steps = started(progress, "surveying"), len(opened) + 2
    parts = []
    for done, (name, trial) in enumerate(zip(names, opened, strict=True), start=1):
        with naming(name, IdentificationError):
            own = trial.settings_for(options)
            chosen = trial.select(specification, own)
            parts.append(SurveyedPart.of(name, trial, own, chosen))
        report(done, steps)
    return survey_parts(parts, settings.force_map, proposed, keep_out, report)
