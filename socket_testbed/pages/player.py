"""A trial as the page shows it: at any time that is asked for, and its course."""

from __future__ import annotations

from typing import Any

import numpy as np

from socket_testbed.arrays import BREAK, evenly, usual_period
from socket_testbed.errors import ConfigurationError
from socket_testbed.geometry.axis import all_regions
from socket_testbed.identification.force_map import map_trial
from socket_testbed.identification.model_file import StoredModel
from socket_testbed.identification.noise import smooth_poses
from socket_testbed.identification.plausibility import require_position
from socket_testbed.identification.pressure import (
    THRESHOLD,
    PressureOutputs,
    measured_rows,
    pressure_outputs,
)
from socket_testbed.pages.document import (
    Document,
    bars,
    cards,
    data_card,
    moments,
    numbers,
    trial_document,
)
from socket_testbed.trials.trial import Trial

_INSTANTS = 400  # of the course


class Player:
    """A trial, a `Source` of the page: its map and outputs are computed when they are shown.

    A model, if one is given, predicts the wrench.
    """

    def __init__(self, trial: Trial, model: StoredModel | None = None) -> None:
        self._geometry = trial.geometry
        self._samples = samples = trial.samples()
        settings = trial.estimator
        self._map, self._trusted = map_trial(
            samples, trial.geometry, settings.force_map, settings.identification.leave_out
        )
        self._places = all_regions(trial.geometry, trial.metadata.side)
        self._data = data_card(trial.findings)
        self._holds = BREAK * usual_period(samples.time)  # [s]; a sample
        self._predicted = np.full((len(samples), 6), np.nan)
        if model is not None:
            model.require_socket(trial.geometry)
            require_position(samples, trial.geometry)
            poses = smooth_poses(samples, model.settings.pose_smoothing).pose
            self._predicted = model.model.wrench(poses)
        rows = evenly(len(samples), _INSTANTS)
        time, found = samples.time[rows], self._outputs(rows)
        self._start = trial_document(trial, found, time) | {
            "title": trial.name,
            "facts": trial.metadata.described(),
            "start": float(time[found.peak_row]),
            "end": float(samples.time[-1]),
        }

    def _outputs(self, rows: Any) -> PressureOutputs:
        return pressure_outputs(
            self._map, self._trusted[rows], self._geometry, self._places, THRESHOLD
        )

    def start(self) -> Document:
        """The socket, the course, and the time of the peak, at which the page opens."""
        return self._start

    def now(self, time: float | None) -> Document:
        """The newest sample at a time since the first one [s]."""
        at, samples = time or 0.0, self._samples
        row = max(int(np.searchsorted(samples.time, at + 1e-6, "right")) - 1, 0)
        one = slice(row, row + 1)
        if at - samples.time[row] > self._holds or not measured_rows(self._trusted[one])[0]:
            nothing = {"title": "Peak", "value": "none", "words": "no sample at this time"}
            return {"moment": {"time": at}, "cards": [nothing, self._data]}
        found = self._outputs(one)
        shown = cards(
            self._geometry, self._places, found.regions, found.estimate.normal_pressure[0]
        )
        return {
            "moment": moments(samples.time[one], found, self._geometry)[0],
            "cards": [*shown, self._data],
            "bars": bars(self._places, found.regions),
            "wrench": [numbers(samples.wrench[row]), numbers(self._predicted[row])],
        }

    def act(self, what: str, given: dict[str, Any]) -> str:
        """A recorded trial has no services."""
        raise ConfigurationError(f"a recorded trial cannot {what}", "watch the running testbed")
