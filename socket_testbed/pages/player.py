"""A trial for the page: its state at any time, and its course."""

from __future__ import annotations

from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray, evenly, sample_at
from socket_testbed.errors import ConfigurationError
from socket_testbed.identification.pressure import measured_rows
from socket_testbed.identification.survey_prior import SurveyPrior
from socket_testbed.pages import document
from socket_testbed.results.pressure import map_trial
from socket_testbed.results.stresses import course_of, stresses_of
from socket_testbed.trials.trial import Trial

_COURSE_SAMPLES = 400
_INTEGRAL_SAMPLES = 150  # evenly spread over the trial
_INTEGRAL = "pressure-time integral, whole trial [kPa s]"


class Player:
    """A trial as a `Source` of the page: map and outputs are computed on demand."""

    def __init__(
        self,
        trial: Trial,
        predicted: FloatArray | None = None,
        prior: SurveyPrior | None = None,
    ) -> None:
        """Compute the force map's prior and the course of a trial.

        Args:
            trial: The trial of N samples.
            predicted: A model's predictions of all its channels, shape (N, 6 + 3c) [N m, N], of
                which the page shows the wrench; None without a model.
            prior: A survey of the limb as a prior of the force map; None for none.
        """
        self._samples = samples = trial.samples()
        self._mapped = mapped = map_trial(trial, trial.estimator, prior=prior)
        self._data = document.check_card(trial.problems(), trial.notes)
        nothing = np.full((len(samples), 6), np.nan)
        self._predicted = nothing if predicted is None else predicted[:, :6]
        course = course_of(mapped.course(_COURSE_SAMPLES), trial.geometry, int(samples.stamps[0]))
        rows = evenly(len(samples), _INTEGRAL_SAMPLES)
        self._integral = self._mapped.outputs(rows).regions.integral
        metadata = trial.metadata
        facts = metadata.described()
        if prior is not None:
            facts = facts | {"map from": mapped.force_map.source(mapped.samples)}
        socket = trial.geometry, metadata.side
        self._start = document.trial_document(*socket, trial.events(), course) | {
            "title": trial.name,
            "facts": facts,
            "start": course.highest_time,
            "end": float(samples.time[-1]),
        }

    def start(self) -> document.Document:
        """The socket, the course, and the time of the peak, where the page opens.

        Returns:
            `socket` and `course` as in `document.trial_document`, `title`, `facts` (the stated
            metadata), and `start` and `end`, times of the peak and of the last sample [s].
        """
        return self._start

    def now(self, time: float | None) -> document.Document:
        """The latest sample at a time since the first one [s]; None stands for 0.

        Returns:
            `moment` and `cards`, and with a measured sample at this time `bars` and `wrench`, see
            `document`.
        """
        at, samples, mapped = time or 0.0, self._samples, self._mapped
        geometry = mapped.trial.geometry
        row = sample_at(samples.time, at)
        if row is None or not measured_rows(mapped.samples[row : row + 1])[0]:
            nothing = {"title": "Peak", "value": "none", "words": "no sample at this time"}
            return {"moment": {"time": at}, "cards": [nothing, self._data]}
        found = mapped.outputs(slice(row, row + 1))
        start = int(samples.stamps[0])
        stresses = stresses_of(found.estimate, found.samples, geometry, start)
        pressure, measured = stresses.pressure[0], stresses.measured[0]
        shown = document.cards(
            geometry, mapped.places, found.regions, pressure, measured, " at this moment"
        )
        return {
            "moment": document.moments(stresses, geometry)[0],
            "cards": [*shown, self._data],
            "bars": document.bars(mapped.places, found.regions, {_INTEGRAL: self._integral}),
            "wrench": document.wrench_rows(samples.wrench[row], self._predicted[row]),
        }

    def act(self, what: str, given: dict[str, Any]) -> str:
        """A recorded trial has no services.

        Args:
            what: Name of the button.
            given: Its values.

        Raises:
            ConfigurationError: Always.
        """
        raise ConfigurationError(f"a recorded trial cannot {what}", "watch the running testbed")
