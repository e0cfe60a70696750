"""Contact models on a trial: a fit on one of its segments, and the judgement of any model."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pandas as pd
from threadpoolctl import threadpool_limits

from socket_testbed.arrays import FloatArray
from socket_testbed.documents import path_of
from socket_testbed.errors import IdentificationError
from socket_testbed.figures.channels import wrench_figure
from socket_testbed.figures.style import FigureStyle
from socket_testbed.figures.tiles import tile_map_figure
from socket_testbed.files import TABLES, write_text
from socket_testbed.identification import information
from socket_testbed.identification.channel_errors import (
    ChannelErrors,
    errors_to_dataframe,
    evaluate,
    summarise_errors,
)
from socket_testbed.identification.fit import Fit, FittedModel, fit_contact_model
from socket_testbed.identification.model_file import quoted_figures, record, write_model
from socket_testbed.identification.noise import smooth_poses
from socket_testbed.identification.problem import check_parts
from socket_testbed.identification.validation import judge_unseen_half
from socket_testbed.results.pressure import TrialPressure
from socket_testbed.results.result import PathLike, Result, origin
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import IdentificationSettings
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.segment import Segment, Span, first_frames
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MIN_HELD_OUT = 10  # samples


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
            segment, and the certificates of both stages; it is a `FittedModel` as `st.read_model`
            reads it from the saved file.
    """

    trial: Trial
    segment: Segment
    fit: Fit

    def __repr__(self) -> str:
        fit = self.fit
        return (
            f"TrialFit({self.variant} on {self.trial.name}, {self.segment}, theta"
            f" {fit.settings.theta:g}; {summarise_errors(fit.errors).in_words()})"
        )

    def save(self, path: PathLike) -> None:
        """Write the model with its geometry, settings, certificates and the trial's identity.

        Args:
            path: The JSON file, with any suffix; an existing one is replaced.
        """
        samples = self.trial.samples()
        identity = {
            "first_stamp": int(samples.stamps[0]),
            "last_stamp": int(samples.stamps[-1]),
            "samples": len(samples),
            **self.trial.replaced,
        }
        write_model(self.fit, path_of(path, "the file"), identity)

    @property
    def variant(self) -> str:
        """The variant of the contact law that was fitted."""
        return self.fit.model.variant

    def load_shares(self) -> tuple[information.LoadShare, ...]:
        """Shares of the measured wrench that springs and offsets carry, over the segment.

        Returns:
            For `Fz`, the whole `force` and the `moment`, in this order: the share of the `springs`,
            of the `offsets` and the `residual` that neither explains [-], which add up to 1. NaN
            without a sample that has a pose and this part of the wrench.
        """
        return _load_shares(self._samples(), self.fit)

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
        return self.trial.checked(self.fit.settings.leave_out).samples[self.segment.rows]

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
        return _errors_document(self, self.fit, self.fit.samples, self.fit.errors)

    def _figure(self, style: FigureStyle) -> Figure:
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
            cluster forces whose status is not OK, count as not measured. Poses are averaged within
            the segment, as in the fit; those of `predicted` also across its ends.
        in_sample: Whether the model was fitted on some samples of the segment.
        predicted: Predictions of the model at all N samples of the trial: the wrench [M; F] in {S}
            [N m, N], then the force on each of the c clusters in the frame {L} of its tile [N],
            shape (N, 6 + 3c); NaN where the limb pose is missing or an outlier.
        held_out: Errors of every channel on the rest of the trial, as in `errors`: on the samples
            that are neither in the segment nor used by the model's fit; empty if every channel has
            fewer than 10 of them.
        pressure: Pressure outputs of the segment; None unless requested.
    """

    trial: Trial
    model: FittedModel
    segment: Segment
    samples: int
    errors: tuple[ChannelErrors, ...]
    in_sample: bool
    predicted: FloatArray
    held_out: tuple[ChannelErrors, ...]
    _load_shares: tuple[information.LoadShare, ...]
    _engagement: information.Engagement
    pressure: TrialPressure | None = None

    def __repr__(self) -> str:
        return (
            f"Evaluation({self.model.model.variant} of {self.model.trial} on {self.trial.name},"
            f" {self.segment}; {summarise_errors(self.errors).in_words()})"
        )

    def load_shares(self) -> tuple[information.LoadShare, ...]:
        """Shares of the measured wrench that springs and offsets carry, over the segment.

        Returns:
            As `TrialFit.load_shares`.
        """
        return self._load_shares

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
        return self._engagement

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
        shown = [(self.model.model.variant, self.predicted, self.errors)]
        heading = f"{self.trial.name}, {self.segment}: measured and predicted wrench"
        return wrench_figure(self.trial.samples(), self.segment, shown, heading, style)


def _errors_document(
    found: TrialFit | Evaluation, model: FittedModel, samples: int, errors: Sequence[ChannelErrors]
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


def part_to_fit(
    trial: Trial, segment: str | Span | Segment, settings: EstimatorSettings
) -> tuple[Segment, Samples]:
    """The part of a trial that is fitted, and its samples; problems in the data become notes.

    Args:
        trial: The trial.
        segment: The part as in `Trial.select`.
        settings: The settings, whose `frames` limits the number of samples.

    Returns:
        The segment, with `frames` only its first samples; and its samples, NaN where a value is an
        outlier.
    """
    identification = settings.identification
    whole = trial.select(segment, settings)
    chosen = first_frames(whole, trial.samples(), identification.frames)
    trial.note_problems(identification.leave_out)
    return chosen, trial.checked(identification.leave_out).part(chosen.rows)


def fit_segment(
    trial: Trial, segment: Segment, samples: Samples, settings: IdentificationSettings
) -> TrialFit:
    """Identify the contact model on a segment of a trial.

    Args:
        trial: The trial.
        segment: The part to fit.
        samples: Its samples, outliers as NaN: see `part_to_fit`.
        settings: Settings of the fit.

    Raises:
        IdentificationError: As `fit_contact_model`.
    """
    # More threads change the rounding of sums; a trial must give the same model on every machine.
    # The programs are small, so that a single thread is no slower.
    with threadpool_limits(1):
        found = fit_contact_model(samples, trial.geometry, settings)
    named = dataclasses.replace(
        found,
        trial=trial.name,
        fingerprint=trial.fingerprint,
        unloaded=trial.unloaded,
        segment=str(segment),
    )
    return TrialFit(trial, segment, named)


def predictions(trial: Trial, stored: FittedModel) -> FloatArray:
    """Predictions of all channels at all samples of a trial.

    Args:
        trial: The trial, whose limb poses the model is given.
        stored: The model.

    Returns:
        The wrench [M; F] in {S} [N m, N], then the force on each of the c clusters in the frame {L}
        of its tile [N], shape (N, 6 + 3c); NaN where the limb pose is missing or an outlier.
    """
    samples = trial.checked(stored.settings.leave_out).posed()
    with threadpool_limits(1):
        return stored.predictions(samples)


def judge(trial: Trial, model: FittedModel, segment: Segment) -> Evaluation:
    """Errors of a model on a segment of a trial.

    Args:
        trial: The trial, whose tiles are those of the model.
        model: The model, with the settings of its fit.
        segment: The part that is judged.

    Raises:
        IdentificationError: If the limb positions of the segment are in another unit or frame, or
            there are none, or nothing was measured that predictions could be compared with.
    """
    leave_out, window = model.settings.leave_out, model.settings.pose_smoothing
    checked = trial.checked(leave_out)
    every, rows = checked.samples, segment.rows
    samples = checked.posed(rows)
    check_parts(samples, "a prediction")
    with threadpool_limits(1):
        over_trial = model.predictions(every)
        predicted = over_trial[rows]
        if window:  # as in the fit, poses are averaged within the segment
            predicted = model.predictions(samples, every[: rows.start])
    errors = evaluate(samples, predicted, leave_out)
    if not any(error.samples for error in errors):
        raise IdentificationError(
            f"none of the {len(samples)} samples has a limb position with a wrench or a trusted"
            " cluster, which predictions are compared with",
            "choose another segment, or record the load cell or the clusters",
        )
    used = model.used(trial.name, trial.fingerprint, checked.measured)
    rest = ~used
    rest[rows] = False
    held_out = evaluate(every[rest], over_trial[rest], leave_out)
    counted = max(error.samples for error in held_out) >= _MIN_HELD_OUT
    return Evaluation(
        trial=trial,
        model=model,
        segment=segment,
        samples=int(samples.has_pose_and_wrench.sum()),
        errors=errors,
        in_sample=bool(used[rows].any()),
        predicted=over_trial,
        held_out=held_out if counted else (),
        _load_shares=_load_shares(samples, model),
        _engagement=information.engagement(every, model.model, window, rows),
    )


def _load_shares(samples: Samples, model: FittedModel) -> tuple[information.LoadShare, ...]:
    smooth = smooth_poses(samples, model.settings.pose_smoothing)
    return information.load_shares(smooth, model.model)
