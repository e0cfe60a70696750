"""Validation: estimates judged on held-out data, against simple rivals."""

from __future__ import annotations

from collections.abc import Sequence

from threadpoolctl import threadpool_limits

from socket_testbed.api.pressure import prior_for
from socket_testbed.api.trials import (
    Progress,
    as_path,
    open_different,
    require_one_socket,
    started,
    trials_of,
    unique_names,
)
from socket_testbed.errors import ConfigurationError
from socket_testbed.results.result import PathLike
from socket_testbed.results.survey import Survey
from socket_testbed.results.validating import Recording, judge_recordings, pass_over_failed
from socket_testbed.results.validation import Validation
from socket_testbed.settings.identification import Weights
from socket_testbed.settings.options import SettingsOptions, ValidationOptions
from socket_testbed.trials.segment import Segment, Span
from socket_testbed.trials.trial import Trial


def validate(
    *trials: Trial | PathLike,
    segment: str | Span | Segment = ValidationOptions.segment,
    params: PathLike | None = None,
    theta: float | None = None,
    weights: Weights | None = None,
    smoothness: float | None = None,
    leave_out: Sequence[str] | None = None,
    pose_smoothing: float | None = None,
    solver: str | None = None,
    prior: Survey | PathLike | None = None,
    progress: Progress | None = None,
) -> Validation:
    """Judge estimates of tile forces and wrench on held-out data.

    - Each cluster is left out and its force is predicted from the other clusters and the wrench.
    - Every model variant is fitted on the first half of the loaded part of a trial and predicts the
      wrench of the second half from the pose alone; with several trials, it is also fitted on all
      of that part and predicts the others. With more than 12 trials, models are fitted on 12
      evenly spread ones, and each predicts 12 others.
    - If a trial has a simulated ground truth, forces on tiles without a sensor are compared with
      it.

    Simple rivals answer the same questions; see `socket_testbed.identification.validation`.
    Among several trials, those that cannot be judged are skipped with a note.

    Args:
        trials: Trials of one socket; notes on a trial given as a folder begin with its name.
        segment: As in `fit`.
        params: A `testbed.yaml` to use instead of each trial's own.
        theta: As in `fit`.
        weights: As in `fit`.
        smoothness: As in `fit`.
        leave_out: As in `fit`.
        pose_smoothing: As in `fit`.
        solver: As in `fit`.
        prior: A survey of this limb in this socket, such as the file of `survey -o FILE.json`, as a
            prior of the force map; the trial must not be in it.
        progress: See `Progress`.

    Returns:
        The validation: `summary()` has the means over the trials, `to_dataframe()` every judgement,
        `by_trial()` a row per trial.

    Raises:
        ConfigurationError: No trial is given, one is given twice, they are of different sockets, or
            a setting is wrong, or the survey is of another socket or holds a trial.
        TrialError: A single trial cannot be read or has no such segment; none of several can be
            judged.
        IdentificationError: A single trial has too few samples under load to fit and to test.

    >>> found = st.validate(st.open_trial("trials/hold"), st.open_trial("trials/walk"))
    >>> found
    Validation(2 trials, models fitted on 2; ... judgements)
    >>> left_out = found.summary().query("question == 'cluster'")
    >>> bool((left_out["error [-]"] > 0.0).all())
    True
    """
    options = SettingsOptions(
        params=as_path(params),
        theta=theta,
        weights=weights,
        smoothness=smoothness,
        leave_out=leave_out,
        pose_smoothing=pose_smoothing,
        solver=solver,
    )
    opened = open_different(trials_of(trials))
    recordings = _recordings(opened, segment, options, prior)
    report = started(progress, "validating")
    with threadpool_limits(1):
        return judge_recordings(recordings, len(opened), report)


def _recordings(
    trials: Sequence[Trial],
    segment: str | Span | Segment,
    options: SettingsOptions,
    prior: Survey | PathLike | None,
) -> list[Recording]:
    """Read the trials, which must be of one socket."""
    if not trials:
        raise ConfigurationError("no trial to validate on", "give one or more trials")
    found = []
    for name, trial in zip(unique_names(trials), trials, strict=True):
        with pass_over_failed(name, trial, len(trials) > 1):
            settings = trial.settings_for(options)
            recording = Recording.of(name, trial, settings, trial.select(segment, settings))
            found.append(recording.with_prior(prior_for(trial, prior)))
    read = [recording.trial for recording in found]
    require_one_socket(read, "validate the trials of one socket at a time")
    return found
