"""Contact models: fitting, evaluation and prediction."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import Literal, TypeAlias

import pandas as pd

from socket_testbed.api.pressure import pressure as pressure_of
from socket_testbed.api.trials import as_path, as_trial
from socket_testbed.documents import check_kind, path_of
from socket_testbed.identification.fit import FittedModel
from socket_testbed.identification.model_file import read_model as _read_model
from socket_testbed.results.models import (
    Evaluation,
    TrialFit,
    fit_segment,
    judge,
    part_to_fit,
    predictions,
)
from socket_testbed.results.result import PathLike
from socket_testbed.settings.identification import Variant, Weights
from socket_testbed.settings.options import EvaluationOptions, FitOptions, SettingsOptions
from socket_testbed.trials.segment import Segment, Span
from socket_testbed.trials.trial import Trial

Model: TypeAlias = TrialFit | FittedModel | PathLike
"""A fit, a model that `st.read_model` read, or the path of its file."""


def fit(
    trial: Trial | PathLike,
    segment: str | Span | Segment = FitOptions.segment,
    *,
    params: PathLike | None = None,
    variant: Variant | str | None = None,
    theta: float | None = None,
    weights: Weights | None = None,
    smoothness: float | None = None,
    leave_out: Sequence[str] | None = None,
    pose_smoothing: float | None = None,
    frames: int | None = None,
    initial_stiffness: float | Literal["auto"] | None = None,
    solver: str | None = None,
) -> TrialFit:
    """Identify the contact model on a segment of a trial.

    Settings default to those in `params`, or to those the trial was recorded with. `variant` takes
    the name of a law of your own, too: see `st.register_law`.

    Args:
        trial: The trial.
        segment: As in `Trial.select`, such as `hold`, `10:20` or `(10, 20)` [s], or a `Segment`.
        params: A `testbed.yaml` to use instead of the trial's own.
        variant: The law: `stiffness` as published, `rigid` by the limb's pose; `_bias` with offsets
            [-].
        theta: Weight of the wrench against the clusters, on normalised errors [-].
        weights: Weights of the channels within a group: by `size`, by `noise`, or equal (`raw`)
            [-].
        smoothness: Weight of the smoothness over neighbouring tiles against the errors [-].
        leave_out: Channels to leave out, such as `distal.Fx` or `Mz`; `distal` leaves out all of a
            cluster [-].
        pose_smoothing: Centred window of the mean pose in offline fits; 0: none [s].
        frames: Samples from the segment's start that offline fits use; 0: all [1].
        initial_stiffness: Stiffness k0 of every spring in Stage 1; `auto` or 0: from the trial's
            slope [N/m].
        solver: Solver of the quadratic programs: any that qpsolvers finds [-].

    Returns:
        The fit: `fit.model` is the contact model; `save` writes it.

    Raises:
        ConfigurationError: A setting or a file is wrong.
        TrialError: The trial cannot be read or has no such segment.
        IdentificationError: The samples cannot be fitted: too few have a wrench and a pose, or a
            solution is not certified.

    >>> trial = st.open_trial("trials/hold")
    >>> fitted = st.fit(trial, variant="rigid_bias", theta=0.5)
    >>> fitted
    TrialFit(rigid_bias on hold, plateau ... s, theta 0.5; mean moment RMSE ... N)
    >>> fitted.to_dataframe().loc["Fz", "unit"]
    'N'
    >>> fitted.save("hold.json")
    """
    options = SettingsOptions(
        params=as_path(params),
        variant=variant,
        theta=theta,
        weights=weights,
        smoothness=smoothness,
        leave_out=leave_out,
        pose_smoothing=pose_smoothing,
        frames=frames,
        initial_stiffness=initial_stiffness,
        solver=solver,
    )
    trial = as_trial(trial)
    settings = trial.settings_for(options)
    chosen, samples = part_to_fit(trial, segment, settings)
    return fit_segment(trial, chosen, samples, settings.identification)


def read_model(path: PathLike) -> FittedModel:
    """Read a model saved by `fit`.

    Returns:
        The model: `model.model` is the contact model with the stiffness of its n tiles along x, y
        and z of `model.model.frame`, shape (n, 3) [N/m]; `geometry` is its socket; `settings` and
        `errors` are those of its fit.

    Raises:
        ConfigurationError: The file cannot be read, or is no model.

    >>> st.fit(st.open_trial("trials/hold")).save("hold.json")
    >>> model = st.read_model("hold.json")
    >>> model
    FittedModel(rigid_bias of hold, ... samples, ... tiles)
    >>> model.model.stiffness.shape == (len(model.geometry), 3)  # [N/m]
    True
    """
    return _read_model(path_of(path, "the file"))


def model_for(trial: Trial, model: Model) -> FittedModel:
    """A fit, a stored model or one at a path, for a trial; refuses one of another socket.

    Args:
        trial: The trial, whose tiles must be those of the model.
        model: See `Model`.
    """
    if isinstance(model, TrialFit):
        model = model.fit
    elif not isinstance(model, FittedModel):
        hint = "give a fit, a model, or the path of its file"
        check_kind(model, (str, os.PathLike), "the model", hint)
        model = read_model(model)
    model.require_socket(trial.geometry)
    return model


def predict(
    trial: Trial | PathLike, model: Model, segment: str | Span | Segment = "all"
) -> pd.DataFrame:
    """Predict every channel of a trial from its limb poses.

    Poses are averaged over the same window as in the model's fit, if any. The whole trial is
    predicted, whatever part of it is returned, so that a model with memory knows the past.

    Args:
        trial: The trial.
        model: A fit, a model that `read_model` read, or the path of its file.
        segment: As in `fit`; the part of the trial whose predictions are returned.

    Returns:
        A row per sample of the segment, indexed by `time [s]` since the trial's first sample.
        Columns: the wrench in {S}, such as `Mx [N m]` and `Fz [N]`, and the force on each cluster
        in the frame {L} of its tile, such as `distal.Fx [N]`; titles and index are those of
        `trial.samples().to_dataframe()`. NaN where the limb pose is missing or an outlier.

    Raises:
        ConfigurationError: The model's file is wrong, or the model is of another socket.
        TrialError: The trial cannot be read or has no such segment.
        IdentificationError: The limb poses are in another unit or frame.

    >>> trial = st.open_trial("trials/hold")
    >>> predicted = st.predict(trial, st.fit(trial))
    >>> measured = trial.samples().to_dataframe()
    >>> bool((predicted - measured)["Fz [N]"].abs().median() < 20)
    True
    """
    trial = as_trial(trial)
    stored = model_for(trial, model)
    chosen = _select(trial, stored, segment)
    trial.note_problems(stored.settings.leave_out)
    samples, values = trial.samples(), predictions(trial, stored)
    table = pd.DataFrame(values, pd.Index(samples.time, name="time [s]"), samples.titles)
    return table.iloc[chosen.rows]


def _select(trial: Trial, stored: FittedModel, segment: str | Span | Segment) -> Segment:
    """A segment of a trial that ignores the channels which the model's fit left out."""
    settings = dataclasses.replace(trial.estimator, identification=stored.settings)
    return trial.select(segment, settings)


def evaluate(
    trial: Trial | PathLike,
    model: Model,
    segment: str | Span | Segment = EvaluationOptions.segment,
    *,
    pose_smoothing: float | None = None,
    pressure: bool = False,
) -> Evaluation:
    """Errors of a model on a segment of a trial, channel by channel.

    Args:
        trial: The trial, preferably not the one of the fit.
        model: A fit, a model from `read_model`, or the path of its file.
        segment: As in `fit`.
        pose_smoothing: Centred window of the mean pose [s] (default: that of the model's fit).
        pressure: Whether to add the pressure outputs of the segment, see `st.pressure`. They come
            from the force map, not from the model.

    Returns:
        The evaluation: `errors` and `to_dataframe()` give the errors of every channel.

    Raises:
        ConfigurationError: The model's file is wrong, or the model is of another socket.
        TrialError: The trial cannot be read or has no such segment.
        IdentificationError: The limb poses are in another unit or frame.

    >>> fitted = st.fit(st.open_trial("trials/hold"))
    >>> found = st.evaluate(st.open_trial("trials/walk"), fitted, segment="all")
    >>> found
    Evaluation(rigid_bias of hold on walk, all 0.00 s to 39.75 s; mean moment RMSE ... N)
    >>> list(found.to_dataframe())
    ['unit', 'RMSE', 'MAE', 'sigma', 'skill', 'samples', 'in objective']
    """
    trial = as_trial(trial)
    stored = model_for(trial, model)
    if pose_smoothing is not None:
        changed = dataclasses.replace(stored.settings, pose_smoothing=pose_smoothing)
        stored = dataclasses.replace(stored, settings=changed)
    chosen = _select(trial, stored, segment)
    found = judge(trial, stored, chosen)
    trial.note_problems(stored.settings.leave_out)
    if bool(trial.unloaded) != bool(stored.unloaded):
        fitted = "with" if stored.unloaded else "without"
        trial.note(f"the model was fitted {fitted} --unloaded: its offsets differ")
    if not pressure:
        return found
    return dataclasses.replace(found, pressure=pressure_of(trial, chosen))
