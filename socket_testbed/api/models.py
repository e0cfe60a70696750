"""Contact models: fitting, evaluation and prediction."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import pandas as pd
from threadpoolctl import threadpool_limits

from socket_testbed.api.pressure import pressure as pressure_of
from socket_testbed.api.trials import as_trial, note_problems, settings_of
from socket_testbed.arrays import FloatArray
from socket_testbed.documents import check_kind, path_of
from socket_testbed.files import TABLES, write_text
from socket_testbed.identification import information
from socket_testbed.identification.fit import (
    ChannelErrors,
    Fit,
    errors_to_dataframe,
    fit_contact_model,
    summarise_errors,
)
from socket_testbed.identification.fit import evaluate as _evaluate
from socket_testbed.identification.model_file import (
    StoredModel,
    quoted_figures,
    record,
    write_model,
)
from socket_testbed.identification.model_file import read_model as _read_model
from socket_testbed.identification.noise import smooth_poses
from socket_testbed.identification.validation import judge_unseen_half
from socket_testbed.results.pressure import TrialPressure
from socket_testbed.results.result import PathLike, Result, origin
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import (
    FitChoices,
    IdentificationSettings,
    Variant,
    Weights,
)
from socket_testbed.trials.segment import Segment, Span, first_frames
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from socket_testbed.figures.style import FigureStyle


@dataclass(frozen=True, repr=False)
class TrialFit(Result):
    """A contact model fitted on a segment of a trial, with its certificates.

    The table holds the in-sample errors, the figure shows the stiffness of every tile, and `save`
    writes a model for `st.read_model`.

    Attributes:
        trial: The trial.
        segment: The part that was fitted; with `frames` only its first samples. Its `start` and
            `end` [s] count from the first sample of the trial, `rows` is a slice of its samples.
        fit: The contact model (`fit.model`), the settings used, the errors of every channel on the
            segment, and the certificates of both stages.
    """

    trial: Trial
    segment: Segment
    fit: Fit

    def __repr__(self) -> str:
        fit = self.fit
        return (
            f"TrialFit({fit.model.variant} on {self.trial.name}, {self.segment}, theta"
            f" {fit.settings.theta:g}; {summarise_errors(fit.errors).in_words()})"
        )

    def save(self, path: PathLike) -> None:
        """Write the model with its geometry, settings, certificates and the trial's identity.

        Args:
            path: The JSON file, with any suffix; an existing one is replaced.
        """
        samples = self.trial.samples()
        identity = {
            "name": self.trial.name,
            "fingerprint": self.trial.fingerprint,
            "first_stamp": int(samples.stamps[0]),
            "last_stamp": int(samples.stamps[-1]),
            "samples": len(samples),
            **self.trial.replaced,
        }
        write_model(
            self.fit, self.trial.geometry, identity, str(self.segment), path_of(path, "the file")
        )

    def stored(self) -> StoredModel:
        """The model as `st.read_model` returns it after `save`."""
        fit = self.fit
        return StoredModel(
            model=fit.model,
            geometry=self.trial.geometry,
            settings=fit.settings,
            samples=fit.samples,
            first_stamp=fit.first_stamp,
            last_stamp=fit.last_stamp,
            wrench_rmse=fit.wrench_rmse,
            errors=fit.errors,
            status=fit.status,
            trial=self.trial.name,
            fingerprint=self.trial.fingerprint,
            unloaded=self.trial.unloaded,
            segment=str(self.segment),
        )

    def load_shares(self) -> tuple[information.LoadShare, ...]:
        """Shares of the measured wrench that springs and offsets carry, over the segment.

        Returns:
            For `Fz`, the whole `force` and the `moment`, in this order: the share of the `springs`,
            of the `offsets` and the `residual` that neither explains [-], which add up to 1. NaN
            without a sample that has a pose and this part of the wrench.
        """
        smooth = smooth_poses(self._samples(), self.fit.settings.pose_smoothing)
        return information.load_shares(smooth, self.fit.model)

    def motion(self) -> information.Motion:
        """Motion of the pose over the segment, relative to its noise.

        Returns:
            `excitations`: for position x, y, z and rotation about x, y, z of {S} the standard
            deviations of the `motion`, noise removed, and of the `noise` [m, rad], NaN if unknown;
            and `directions`, the number (0 to 6) of independent directions that move at least three
            times their noise.
        """
        window = self.fit.settings.pose_smoothing
        return information.measure_motion(self._samples(), self.trial.geometry, window)

    def unseen_half(self) -> tuple[ChannelErrors, ...]:
        """Errors on the second half of the segment for a model fitted on its first half.

        In-sample errors are optimistic; rank trials and settings by these instead. They require
        another fit, with the same settings.

        Returns:
            Errors of every channel as in `fit.errors`: the wrench's six, then three per cluster.
        """
        with threadpool_limits(1):
            return judge_unseen_half(self._samples(), self.trial.geometry, self.fit.settings)

    def _samples(self) -> Samples:
        """Samples of the segment without outliers."""
        return self.trial.sound(self.fit.settings.leave_out)[self.segment.rows]

    def to_dataframe(self) -> pd.DataFrame:
        """In-sample errors, a row per channel, indexed by `channel`: such as `Mx`, `distal.Fz`.

        Columns:

        - `unit`: unit of the channel, `N m` or `N`;
        - `RMSE`, `MAE`, `sigma`: root-mean-square and mean absolute error, and standard deviation
          of the residual (predicted - measured), each in this unit;
        - `skill`: 1 - RMSE / RMSE of the best constant [-]: 1 is perfect, 0 no better than a
          constant;
        - `samples`: number of samples in which the channel was measured and predicted;
        - `in objective`: whether the channel was fitted, that is not left out.

        Errors and skill are NaN for a channel without such a sample, the skill also for a channel
        that does not change.
        """
        return errors_to_dataframe(self.fit.errors)

    def document(self) -> dict[str, Any]:
        """The in-sample errors for JSON; `save` writes the model itself.

        Returns:
            `trial`, `model` (its `trial` and `variant`), `segment` (`kind`, `start` and `end` [s]),
            the number of `samples`, `channels` with the errors of each in its `unit`, and
            `in_objective`, the paper's mean and median errors [N m, N] over the fitted channels.
        """
        return _errors_document(self, self.stored(), self.fit.samples, self.fit.errors)

    def _figure(self, style: FigureStyle) -> Figure:
        from socket_testbed.figures.tiles import tile_map_figure

        model = self.fit.model
        maps = {
            f"k along {x} of {model.frame}": k
            for x, k in zip("xyz", model.stiffness.T, strict=True)
        }
        heading = f"{self.trial.name}, {self.segment}: stiffness, {model.variant}"
        side = self.trial.metadata.side
        return tile_map_figure(
            self.trial.geometry, maps, "stiffness [N/m]", heading, style, side=side
        )


Model: TypeAlias = TrialFit | StoredModel | PathLike
"""A fit, a model that `st.read_model` read, or the path of its file."""


@dataclass(frozen=True, repr=False)
class Evaluation(Result):
    """A model evaluated on a segment of a trial, with the errors of every channel.

    The table holds the errors; the figure shows the measured and the predicted wrench over the
    whole trial.

    Attributes:
        trial: The trial that the model is judged on.
        model: The model, with its socket and settings; `model.settings.pose_smoothing` is the
            window over which poses were averaged [s].
        segment: The part of the trial that is judged. Its `start` and `end` [s] count from the
            first sample of the trial, `rows` is a slice of its samples.
        samples: Number of samples of the segment with both a wrench and a limb pose, outliers not
            counted.
        errors: Errors of every channel over the segment, in the channel's unit [N m, N]: the
            wrench's six in {S}, then three per cluster in the frame {L} of its tile. Outliers, and
            cluster forces whose status is not OK, count as not measured.
        pressure: Pressure outputs of the segment; None unless requested.
    """

    trial: Trial
    model: StoredModel
    segment: Segment
    samples: int
    errors: tuple[ChannelErrors, ...]
    pressure: TrialPressure | None = None

    def __repr__(self) -> str:
        return (
            f"Evaluation({self.model.model.variant} of {self.model.trial} on {self.trial.name},"
            f" {self.segment}; {summarise_errors(self.errors).in_words()})"
        )

    @property
    def in_sample(self) -> bool:
        """Whether the model was fitted on some samples of the segment."""
        used = self.model.used(self.trial.name, self.trial.fingerprint, self.trial.samples())
        return bool(used[self.segment.rows].any())

    def to_dataframe(self) -> pd.DataFrame:
        """Errors, a row per channel, indexed by `channel`: such as `Mx`, `distal.Fz`.

        Columns:

        - `unit`: unit of the channel, `N m` or `N`;
        - `RMSE`, `MAE`, `sigma`: root-mean-square and mean absolute error, and standard deviation
          of the residual (predicted - measured), each in this unit;
        - `skill`: 1 - RMSE / RMSE of the best constant [-]: 1 is perfect, 0 no better than a
          constant, which knows the mean of this segment;
        - `samples`: number of samples in which the channel was measured and predicted;
        - `in objective`: whether the channel was in the objective of the model's fit.

        Errors and skill are NaN for a channel without such a sample, the skill also for a channel
        that does not change.
        """
        return errors_to_dataframe(self.errors)

    def engagement(self) -> information.Engagement:
        """Engaged springs at every sample of the trial, and their share of the segment's time.

        Returns:
            `springs`, their number in the model; `engaged` and `uncertain`, numbers of engaged and
            of uncertain springs at each of the trial's N samples, shape (N,) [1], NaN without a
            pose, `uncertain` also if the pose's noise is unknown; and `time_share`, the share of
            the segment's samples with a pose in which a spring is engaged [-], shape (n, 3) by tile
            and axis of {S}, (n, 1) in the rigid variants.
        """
        model, window = self.model.model, self.model.settings.pose_smoothing
        samples = self.trial.sound(self.model.settings.leave_out)
        return information.engagement(samples, model, window, self.segment.rows)

    def document(self) -> dict[str, Any]:
        """The evaluation for JSON.

        Returns:
            The keys of `TrialFit.document` for this trial, segment and model; `in_sample`; and, if
            requested, `pressure` as in `TrialPressure.document`.
        """
        found = _errors_document(self, self.model, self.samples, self.errors)
        found["in_sample"] = self.in_sample
        return found | ({"pressure": self.pressure.document()} if self.pressure else {})

    def save(self, path: PathLike) -> None:
        """Write the errors as JSON, or as a table by suffix; an existing file is replaced.

        Args:
            path: The file; JSON unless it ends in `.csv`, `.parquet` or `.mat`.
        """
        path = path_of(path, "the file")
        if path.suffix.lower() in TABLES:
            super().save(path)
        else:
            write_text(path, self.to_json())

    def _figure(self, style: FigureStyle) -> Figure:
        from socket_testbed.report.models import wrench_figure

        predicted = predictions(self.trial, self.model)
        shown = [(self.model.model.variant, predicted, self.errors)]
        heading = f"{self.trial.name}, {self.segment}: measured and predicted wrench"
        return wrench_figure(self.trial.samples(), self.segment, shown, heading, style)


def _errors_document(
    found: TrialFit | Evaluation, model: StoredModel, samples: int, errors: Sequence[ChannelErrors]
) -> dict[str, Any]:
    identity = origin(found.trial, found.segment)
    return {
        "trial": identity["trial"],
        "model": {"trial": model.trial, "variant": model.model.variant},
        "segment": identity["segment"],
        "samples": samples,
        "channels": [record(error) for error in errors],
        "in_objective": quoted_figures(errors),
    }


def fit(
    trial: Trial | PathLike,
    segment: str | Span | Segment = "plateau",
    *,
    params: PathLike | None = None,
    variant: Variant | None = None,
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

    Settings default to those in `params`, or to those the trial was recorded with.

    Args:
        trial: The trial.
        segment: As `specification` in `trials.segment.select_segment`; also a span as a tuple, such
            as `(10, 20)` [s], or a `Segment`: see `trial.select`.
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
    choices: FitChoices = {
        "variant": variant,
        "theta": theta,
        "weights": weights,
        "smoothness": smoothness,
        "leave_out": leave_out,
        "pose_smoothing": pose_smoothing,
        "frames": frames,
        "initial_stiffness": initial_stiffness,
        "solver": solver,
    }
    trial, chosen, rows, settings = prepare_fit(trial, segment, params, choices)
    # More threads change the rounding of sums; a trial must give the same model on every machine.
    # The programs are small, so that a single thread is no slower.
    with threadpool_limits(1):
        found = fit_contact_model(rows, trial.geometry, settings)
    return TrialFit(trial, chosen, found)


def prepare_fit(
    trial: Trial | PathLike,
    segment: str | Span | Segment,
    params: PathLike | None,
    choices: Mapping[str, Any],
) -> tuple[Trial, Segment, Samples, IdentificationSettings]:
    """The trial, the part to be fitted, its sound samples, and the settings; reports the notes.

    Args:
        trial: The trial.
        segment: As in `fit`.
        params: A `testbed.yaml` to use instead of the trial's own; None for the trial's.
        choices: Settings of the identification that override those, by name; None keeps one.

    Returns:
        The opened trial; the segment, with `frames` only its first samples; the samples of the
        segment, NaN where a value is an outlier; the settings of the identification.
    """
    trial = as_trial(trial)
    settings = settings_of(trial, params, **choices)
    samples, frames = trial.samples(), settings.identification.frames
    chosen = first_frames(trial.select(segment, settings), samples, frames)
    leave_out = settings.identification.leave_out
    note_problems(trial, leave_out)
    return trial, chosen, trial.checked(leave_out).part(chosen.rows), settings.identification


def read_model(path: PathLike) -> StoredModel:
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
    StoredModel(rigid_bias of hold, ... samples, ... tiles)
    >>> model.model.stiffness.shape == (len(model.geometry), 3)  # [N/m]
    True
    """
    return _read_model(path_of(path, "the file"))


def model_for(trial: Trial, model: Model) -> StoredModel:
    """A fit, a stored model or one at a path, for a trial; refuses one of another socket.

    Args:
        trial: The trial, whose tiles must be those of the model.
        model: See `Model`.
    """
    if isinstance(model, TrialFit):
        model = model.stored()
    elif not isinstance(model, StoredModel):
        hint = "give a fit, a model, or the path of its file"
        check_kind(model, (str, os.PathLike), "the model", hint)
        model = read_model(model)
    model.require_socket(trial.geometry)
    return model


def _predictions(samples: Samples, stored: StoredModel, past: Samples | None = None) -> FloatArray:
    """Predictions of a model, shape (N, 6 + 3c) [N m, N], with poses averaged as in its fit."""
    with threadpool_limits(1):
        return stored.predictions(samples, past)


def predictions(trial: Trial, stored: StoredModel) -> FloatArray:
    """Predictions of all channels at all samples of a trial.

    Args:
        trial: The trial, whose limb poses the model is given.
        stored: The model.

    Returns:
        The wrench [M; F] in {S} [N m, N], then the force on each of the c clusters in the frame {L}
        of its tile [N], shape (N, 6 + 3c); NaN where the limb pose is missing or an outlier.
    """
    return _predictions(trial.checked(stored.settings.leave_out).posed(), stored)


def predict(trial: Trial | PathLike, model: Model) -> pd.DataFrame:
    """Predict every channel of a trial from its limb poses.

    Poses are averaged over the same window as in the model's fit, if any.

    Args:
        trial: The trial.
        model: A fit, a model that `read_model` read, or the path of its file.

    Returns:
        A row per sample, indexed by `time [s]` since the first sample. Columns: the wrench in {S},
        such as `Mx [N m]` and `Fz [N]`, and the force on each cluster in the frame {L} of its tile,
        such as `distal.Fx [N]`; titles and index are those of `trial.samples().to_dataframe()`. NaN
        where the limb pose is missing or an outlier.

    Raises:
        ConfigurationError: The model's file is wrong, or the model is of another socket.
        TrialError: The trial cannot be read.
        IdentificationError: The limb poses are in another unit or frame.

    >>> trial = st.open_trial("trials/hold")
    >>> predicted = st.predict(trial, st.fit(trial))
    >>> measured = trial.samples().to_dataframe()
    >>> bool((predicted - measured)["Fz [N]"].abs().median() < 20)
    True
    """
    trial = as_trial(trial)
    samples, values = trial.samples(), predictions(trial, model_for(trial, model))
    return pd.DataFrame(values, pd.Index(samples.time, name="time [s]"), samples.titles)


def evaluate(
    trial: Trial | PathLike,
    model: Model,
    segment: str | Span | Segment = "plateau",
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
    leave_out = stored.settings.leave_out
    settings = dataclasses.replace(trial.estimator, identification=stored.settings)
    chosen = trial.select(segment, settings)
    checked = trial.checked(leave_out)
    rows = checked.posed(chosen.rows)
    note_problems(trial, leave_out)
    if bool(trial.unloaded) != bool(stored.unloaded):
        fitted = "with" if stored.unloaded else "without"
        trial.note(f"the model was fitted {fitted} --unloaded: its offsets differ")
    past = checked.samples[: chosen.rows.start]
    errors = _evaluate(rows, _predictions(rows, stored, past), leave_out)
    outputs = pressure_of(trial, chosen) if pressure else None
    return Evaluation(trial, stored, chosen, int(rows.has_pose_and_wrench.sum()), errors, outputs)
