"""All that a report tells of a trial, computed once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from socket_testbed.arrays import BoolArray, FloatArray
from socket_testbed.contact import VARIANTS, ContactModel, Variant
from socket_testbed.errors import IdentificationError, TrialError
from socket_testbed.evaluation import (
    ChannelErrors,
    evaluate_predictions,
    predict_channels,
    trusted_values,
)
from socket_testbed.identification.fit import Fit, fit_contact_model
from socket_testbed.identification.front import Front
from socket_testbed.identification.implausible import Implausible, find_implausible
from socket_testbed.identification.model_file import StoredModel
from socket_testbed.identification.pareto import pareto_front
from socket_testbed.report.autocorrelation import Autocorrelation, autocorrelation
from socket_testbed.samples import Samples
from socket_testbed.settings import EstimatorSettings
from socket_testbed.trials.segment import Segment, find_plateaus, select_segment
from socket_testbed.trials.synchronise import read_samples
from socket_testbed.trials.trial import Trial

GIVEN = "given"
_LEAST_HELD_OUT = 10  # samples


@dataclass(frozen=True)
class Candidate:
    """A model whose predictions are shown.

    Attributes:
        label: The variant that was fitted here, or `given`.
        model: The model.
        leave_out: Channels that were not in the objective of its fit.
        predicted: What it predicts over the trial, in the order of the samples' channels,
            shape (N, 6 + 3c) [N m, N].
        errors: Its errors over the segment.
        held_out: Its errors over the rest of the trial; empty where there is too little.
        residuals: What its residuals over the segment have in common, a channel each.
        fit: The fit over the segment; None for a model that was given.
        given: The model that was given; None for one that was fitted here.
    """

    label: str
    model: ContactModel
    leave_out: tuple[str, ...]
    predicted: FloatArray
    errors: tuple[ChannelErrors, ...]
    held_out: tuple[ChannelErrors, ...]
    residuals: tuple[Autocorrelation, ...]
    fit: Fit | None = None
    given: StoredModel | None = None


@dataclass(frozen=True)
class Results:
    """The results of a trial.

    Attributes:
        trial: The trial.
        samples: Its samples.
        segment: The segment that was fitted.
        specification: How the segment was asked for.
        settings: Settings of the estimator; the variant does not matter.
        candidates: The models: both variants, then one that was given, if any.
        fronts: The trade-off fronts by variant; empty where there are none.
        no_fronts: Why there are none; empty where there are.
        implausible: Channels that are proposed to be left out.
        plateaus: Steady stretches of the trial, the longest first.
        bag_notes: What is to be known of the trial's bag.
    """

    trial: Trial
    samples: Samples
    segment: Segment
    specification: str
    settings: EstimatorSettings
    candidates: tuple[Candidate, ...]
    fronts: dict[Variant, Front]
    no_fronts: str
    implausible: tuple[Implausible, ...]
    plateaus: tuple[Segment, ...]
    bag_notes: tuple[str, ...]

    @property
    def in_segment(self) -> BoolArray:
        """Samples of the segment, shape (N,)."""
        rows = np.zeros(len(self.samples), dtype=bool)
        rows[self.segment.rows] = True
        return rows

    @property
    def fitted(self) -> dict[str, Candidate]:
        """The models that were fitted here, by variant."""
        return {c.label: c for c in self.candidates if c.fit is not None}

    @property
    def mean_position(self) -> FloatArray:
        """Mean limb position over the segment in {S}, shape (3,) [m]."""
        return np.asarray(np.nanmean(self.samples.position[self.segment.rows], axis=0))


def compute_results(
    trial: Trial,
    specification: str,
    settings: EstimatorSettings,
    thetas: Sequence[float] | FloatArray,
    given: StoredModel | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Results:
    """Fit both variants on a segment of a trial, walk along theta, and judge all of it.

    Args:
        trial: The trial.
        specification: The segment: `plateau`, `all`, or `T0:T1` in seconds.
        settings: Settings of the estimator; the variant does not matter.
        thetas: Weights of the wrench against the clusters, rising [-].
        given: A model to be shown as well.
        progress: Told the number of thetas done and of all.

    Raises:
        TrialError: If the trial cannot be read, holds no such segment, or is of another
            socket than the given model.
        ConfigurationError: For wrong settings or thetas.
        IdentificationError: If the segment does not allow a fit.
    """
    if given is not None:
        _require_same_socket(trial, given)
    notes: list[str] = []
    samples = read_samples(replace(trial, tell=notes.append))
    segment = select_segment(samples, specification, settings.plateau)
    chosen = samples[segment.rows]
    candidates = [_fit(samples, segment, trial, settings, variant) for variant in VARIANTS]
    if given is not None:
        candidates.append(_judge(samples, segment, GIVEN, given))
    fronts: dict[Variant, Front] = {}
    no_fronts = ""
    try:
        fronts = pareto_front(
            chosen, trial.geometry, settings.identification, thetas, progress=progress
        )
    except IdentificationError as error:  # the rest of the report stands without it
        no_fronts = str(error)
    return Results(
        trial=trial,
        samples=samples,
        segment=segment,
        specification=specification,
        settings=settings,
        candidates=tuple(candidates),
        fronts=fronts,
        no_fronts=no_fronts,
        implausible=find_implausible(chosen, trial.geometry),
        plateaus=tuple(find_plateaus(samples, settings.plateau)),
        bag_notes=tuple(dict.fromkeys(notes)),
    )


def _fit(
    samples: Samples, segment: Segment, trial: Trial, settings: EstimatorSettings, variant: Variant
) -> Candidate:
    identification = replace(settings.identification, variant=variant)
    fit = fit_contact_model(samples[segment.rows], trial.geometry, identification)
    return _judge(samples, segment, variant, fit)


def _judge(samples: Samples, segment: Segment, label: str, source: Fit | StoredModel) -> Candidate:
    model, leave_out = source.model, source.settings.leave_out
    predicted = predict_channels(model, samples.position, samples.clusters)
    outside = np.ones(len(samples), dtype=bool)
    outside[segment.rows] = False
    held_out = evaluate_predictions(samples[outside], predicted[outside], leave_out)
    enough = max(error.samples for error in held_out) >= _LEAST_HELD_OUT
    chosen = samples[segment.rows]
    residuals = trusted_values(chosen) - predicted[segment.rows]
    return Candidate(
        label=label,
        model=model,
        leave_out=leave_out,
        predicted=predicted,
        errors=evaluate_predictions(chosen, predicted[segment.rows], leave_out),
        held_out=held_out if enough else (),
        residuals=tuple(autocorrelation(chosen.time, column) for column in residuals.T),
        fit=source if isinstance(source, Fit) else None,
        given=source if isinstance(source, StoredModel) else None,
    )


def effective_samples(candidate: Candidate) -> tuple[float, float]:
    """Least and median number of independent samples, over the channels [1]; NaN for none."""
    known = [r.effective for r in candidate.residuals if np.isfinite(r.effective)]
    return (min(known), float(np.median(known))) if known else (float("nan"), float("nan"))


def _require_same_socket(trial: Trial, given: StoredModel) -> None:
    if not trial.geometry.same_tiles(given.geometry):
        raise TrialError(
            f"the model was fitted on another socket ({len(given.geometry)} tiles) than that of"
            f" {trial.path} ({len(trial.geometry)} tiles)",
            "give a model of this socket, or none",
        )
