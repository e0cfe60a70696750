"""The online estimates: measurements in, force maps and predictions out, models fitted meanwhile.

It knows no ROS: the estimator node converts messages for it and publishes what it returns.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import CancelledError, Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray, StatusArray
from socket_testbed.errors import IdentificationError, TestbedError
from socket_testbed.geometry.axis import all_regions
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.fit import Fit
from socket_testbed.identification.force_map import ForceMap, MapEstimate
from socket_testbed.identification.model_file import StoredModel, read_model
from socket_testbed.identification.plausibility import channel_limits
from socket_testbed.identification.pressure import (
    THRESHOLD,
    PressureOutputs,
    measured_rows,
    pressure_outputs,
)
from socket_testbed.live.fit_worker import FitWorker, Refit, Steady
from socket_testbed.samples import Samples, Status, channel_names
from socket_testbed.settings.identification import IdentificationSettings
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.topics import PYLON_POSE, SOCKET_POSE, STRESS, WRENCH, Topic

MEASURED = (STRESS, WRENCH, SOCKET_POSE, PYLON_POSE)  # each is part of a sample

_FIRST_ATTEMPT = 10  # samples between attempts at the first model
_CHECK_PERIOD = 2_000_000_000  # [ns]; between checks of the data


class StampSynchroniser:
    """Puts measurements with equal stamps together; nothing is matched by nearest.

    So many pending stamps are kept while their measurements come in; `incomplete` counts those that
    were given up.
    """

    def __init__(self, topics: Iterable[Topic], pending: int) -> None:
        self._topics = frozenset(topics)
        self._pending = pending
        self._open: OrderedDict[int, dict[Topic, Any]] = OrderedDict()
        self.incomplete = 0

    def add(self, topic: Topic, stamp: int, value: Any) -> dict[Topic, Any] | None:
        """Add a measurement by the stamp of its trigger [ns].

        Returns:
            All measurements of the stamp if this was the last, else None.
        """
        entry = self._open.setdefault(stamp, {})
        entry[topic] = value
        if entry.keys() == self._topics:
            del self._open[stamp]
            return entry
        while len(self._open) > self._pending:
            self._open.popitem(last=False)
            self.incomplete += 1
        return None

    def clear(self) -> None:
        """Forget pending measurements, as after a jump back in time."""
        self._open.clear()


class SampleWindow:
    """The newest samples, up to a duration [s], as bytes: handing them out takes no time."""

    def __init__(self, clusters: tuple[str, ...], duration: float) -> None:
        self._clusters = clusters
        self._duration = round(duration * 1e9)
        width = len(clusters)
        self._layout = np.dtype(
            [
                ("stamps", np.int64),
                ("position", np.float64, 3),
                ("rotation", np.float64, 3),
                ("wrench", np.float64, 6),
                ("local_forces", np.float64, (width, 3)),
                ("status", np.uint8, (width,)),
            ]
        )
        self._rows: deque[tuple[int, bytes]] = deque()  # stamp [ns] and sample

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, sample: Samples) -> None:
        """Add the newest sample; those older than the window go."""
        values = tuple(getattr(sample, name)[0] for name in self._layout.names or ())
        stamp = int(sample.stamps[0])
        self._rows.append((stamp, np.array(values, self._layout).tobytes()))
        while self._rows[0][0] < stamp - self._duration:
            self._rows.popleft()

    def clear(self) -> None:
        """Forget all samples."""
        self._rows.clear()

    def samples(self) -> Samples:
        """The samples of the window in the order of their stamps."""
        rows = np.frombuffer(b"".join(row for _, row in self._rows), self._layout)
        rows = rows[np.argsort(rows["stamps"], kind="stable")]
        names = self._layout.names or ()
        return Samples(clusters=self._clusters, **{name: rows[name] for name in names})


def cluster_forces(
    geometry: SocketGeometry, stresses: Mapping[str, tuple[FloatArray, int]]
) -> tuple[FloatArray, StatusArray]:
    """The forces on a socket's c clusters, in their tiles' frames {L}, shape (c, 3) [N]; statuses.

    By cluster there are normal stress, shear x and y, shape (3,) [Pa], and status. A cluster that
    is not there is missing; what is missing is NaN.
    """
    missing = (np.full(3, np.nan), Status.MISSING)
    found = [stresses.get(name, missing) for name in geometry.clusters]
    forces = [
        geometry.cluster_force(name, stress)
        for name, (stress, _) in zip(geometry.clusters, found, strict=True)
    ]
    return np.array(forces), np.array([status for _, status in found], dtype=np.uint8)


class OnlineMap:
    """Maps the forces on all tiles from the clusters and the wrench of a trigger.

    It needs neither a fitted model nor the motion capture: the first sample has a map.
    Channels that are left out of the objective do not count, and neither do values that no limb in
    a socket gives. Stresses are normal stress, shear x and y, shape (3,) [Pa], and status by
    cluster; wrenches [M; F] in {S}, shape (6,) [N m, N]. The settings may change meanwhile.

    Attributes:
        count: Number of maps.
        places: The regions of the outputs; the last one is the socket.
    """

    def __init__(self, geometry: SocketGeometry, settings: Callable[[], EstimatorSettings]) -> None:
        self._geometry = geometry
        self._settings = settings
        self._clusters = tuple(geometry.clusters)
        self._limits = channel_limits(geometry, self._clusters)
        self._names = channel_names(self._clusters)
        self._synchroniser = StampSynchroniser((STRESS, WRENCH), settings().window.pending)
        self._prior = settings().force_map
        self._map = ForceMap(geometry, self._clusters, self._prior)
        self._newest: tuple[FloatArray, Mapping[str, tuple[FloatArray, int]]]
        self.count = 0
        self.places = all_regions(geometry)

    def clear(self) -> None:
        """Forget pending measurements, as after a jump back in time."""
        self._synchroniser.clear()

    def add(self, topic: Topic, stamp: int, value: Any) -> MapEstimate | None:
        """Add a measurement, as to `OnlineEstimator.add`; topics that the map ignores may come too.

        Returns:
            The map, with N = 1, if this completes the clusters and the wrench of the stamp.
        """
        if topic not in (STRESS, WRENCH):
            return None
        measured = self._synchroniser.add(topic, stamp, value)
        if measured is None:
            return None
        self._newest = measured[WRENCH], measured[STRESS]
        sample = self._sample(*self._newest)
        self.count += 1
        return self._map.update(sample)

    def newest_outputs(self) -> PressureOutputs | None:
        """The outputs of the sample that was mapped last, from joint draws; None if it is empty."""
        sample = self._sample(*self._newest)
        if not measured_rows(sample)[0]:
            return None
        return pressure_outputs(self._map, sample, self._geometry, self.places, THRESHOLD)

    def _sample(
        self, wrench: FloatArray, stresses: Mapping[str, tuple[FloatArray, int]]
    ) -> Samples:
        """The channels of one sample that count; from now on the map has the present prior."""
        settings = self._settings()
        if settings.force_map != self._prior:
            self._prior = settings.force_map
            self._map = ForceMap(self._geometry, self._clusters, self._prior)
        forces, status = cluster_forces(self._geometry, stresses)
        values = np.concatenate([wrench, forces.reshape(-1)])
        values[~(np.abs(values) <= self._limits)] = np.nan
        unknown = np.full((1, 3), np.nan)
        values[np.isin(self._names, settings.identification.leave_out)] = np.nan
        return Samples(
            np.zeros(1, dtype=np.int64),
            unknown,
            unknown,
            values[None, :6],
            self._clusters,
            values[None, 6:].reshape(1, -1, 3),
            status[None],
        )


@dataclass(frozen=True)
class Estimate:
    """A prediction of one sample, from the pose alone."""

    stamp: int  # stamp of the sample's trigger since the epoch [ns]
    model: ContactModel
    wrench: FloatArray  # predicted wrench [M; F] in {S}, shape (6,) [N m, N]
    forces: FloatArray  # predicted force at each of the n points in {S}, shape (n, 3) [N]


class OnlineEstimator:
    """Predicts every synchronised sample with the newest model, and has models fitted.

    The settings are asked for as they are now. `notify` is called with each new model: a `Fit`, in
    a thread of the fitter's, or the `StoredModel` that was loaded.

    Attributes:
        newest: Newest stamp of which the sample was predicted [ns]; 0 at first and after a jump
            back in time.
    """

    def __init__(
        self,
        geometry: SocketGeometry,
        settings: Callable[[], EstimatorSettings],
        fitter: FitWorker,
        notify: Callable[[Fit | StoredModel], None],
    ) -> None:
        self._geometry = geometry
        self._settings = settings
        self._fitter = fitter
        self._notify = notify
        self._clusters = tuple(geometry.clusters)
        window = settings().window
        self._synchroniser = StampSynchroniser(MEASURED, window.pending)
        self._window = SampleWindow(self._clusters, window.duration)
        self._lock = threading.Lock()  # of the window, and of the fit that runs
        self._fitting = False
        self._since_attempt = 0  # samples
        self._last_trigger = 0
        self._model: ContactModel | None = None
        self._last_stamp = 0  # of the samples that the model was fitted on [ns]
        self._fitted_with = settings().identification
        self._origin = ""  # of the model, in words
        self._checking = False
        self._last_check = 0  # [ns]
        self._findings: tuple[str, ...] = ()  # on the data of the window
        self._counts = {"triggers": 0, "samples": 0, "predictions": 0, "fits": 0, "refused": 0}
        self._state = (0, "no model yet: waiting for steady data or estimator/fit")
        self.newest = 0

    @property
    def state(self) -> tuple[int, str]:
        """0 OK, 1 warning or 2 error, and why, in one line."""
        level, text = self._state
        if not self._findings:
            return level, text
        more = f" (and {len(self._findings) - 1} more)" * (len(self._findings) > 1)
        return max(level, 1), f"{self._findings[0]}{more}; {text}"

    def figures(self) -> dict[str, object]:
        """Counts for the diagnostics, by name."""
        incomplete = self._synchroniser.incomplete
        return {**self._counts, "incomplete": incomplete, "window": len(self._window)}

    def load(self, path: Path) -> None:
        """Predict with a stored model."""
        stored = read_model(path, self._geometry)
        self._model, self._last_stamp = stored.model, 0
        self._origin = f"predicting with the model of {stored.trial}"
        self._state = (0, self._origin)
        self._notify(stored)

    def trigger(self, stamp: int) -> bool:
        """Count a trigger; after a jump back in time [ns] forget all measurements.

        Returns:
            Whether time jumped back.
        """
        jumped = stamp < self._last_trigger
        if jumped:
            self._synchroniser.clear()
            with self._lock:
                self._window.clear()
            self.newest = self._last_check = self._last_stamp = 0
            self._findings = ()
        self._last_trigger = stamp
        self._counts["triggers"] += 1
        return jumped

    def add(self, topic: Topic, stamp: int, value: Any) -> Estimate | None:
        """Add a measurement.

        Args:
            topic: One of `MEASURED`.
            stamp: Stamp of its trigger since the epoch [ns].
            value: Of STRESS the normal stress, shear x, shear y, shape (3,) [Pa], and the status
                by cluster; of WRENCH [M; F], shape (6,) [N m, N]; of a pose the position [m] and
                quaternion (x, y, z, w), shape (7,).

        Returns:
            The estimate if this completes a sample and there is a model.
        """
        measured = self._synchroniser.add(topic, stamp, value)
        if measured is None:
            return None
        sample = self._sample(stamp, measured)
        self._counts["samples"] += 1
        estimate = None
        if (model := self._model) is not None:
            wrench, forces = model.wrench(sample.pose)[0], model.forces(sample.pose)[0]
            estimate = Estimate(stamp, model, wrench, forces)
            self._counts["predictions"] += 1
        self.newest = max(self.newest, stamp)
        with self._lock:
            self._window.add(sample)
        self._since_attempt += 1
        if self._fit_is_due():
            self._start_fit(steady=True)
        if stamp - self._last_check >= _CHECK_PERIOD and not self._checking:
            self._check(stamp)
        return estimate

    def fit(self) -> Fit:
        """Fit on all samples of the window, and wait for the model."""
        started = self._start_fit(steady=False)
        if started is None:
            raise IdentificationError("a fit is running already", "ask again when it is done")
        try:
            refit = started.result()
        except (CancelledError, BrokenProcessPool):
            raise IdentificationError("the fit was ended", "ask again") from None
        if refit is None:
            raise IdentificationError("no samples to fit on", "ask again when there are some")
        return refit.fit

    def _sample(self, stamp: int, measured: dict[Topic, Any]) -> Samples:
        both = np.array([measured[SOCKET_POSE], measured[PYLON_POSE]])
        bodies = Pose.from_quaternion(both[:, :3], both[:, 3:])
        socket, pylon = map(Pose, bodies.rotation, bodies.translation)
        forces, status = cluster_forces(self._geometry, measured[STRESS])
        limb = self._geometry.limb_pose(socket, pylon)
        return Samples(
            np.array([stamp]),
            limb.translation[None],
            limb.rotation_vector()[None],
            measured[WRENCH][None],
            self._clusters,
            forces[None],
            status[None],
        )

    def _fit_is_due(self) -> bool:
        """Auto fit is on, with enough samples, and enough new ones since the last attempt."""
        settings = self._settings()
        due = settings.window.refit_after if self._model is not None else _FIRST_ATTEMPT
        return (
            settings.auto_fit
            and not self._fitting
            and 0 < due <= self._since_attempt
            and len(self._window) >= settings.window.least_samples
        )

    def _start_fit(self, steady: bool) -> Future[Refit | None] | None:
        """Start a fit on the window's newest steady stretch, or on all of it."""
        settings = self._settings()
        with self._lock:
            if self._fitting:
                return None
            self._fitting = True
            self._since_attempt = 0
            samples = self._window.samples()
        condition = self._condition(settings) if steady else None
        future = self._fitter.submit(samples, self._geometry, settings.identification, condition)
        future.add_done_callback(partial(self._take_over, settings.identification))
        return future

    def _condition(self, settings: EstimatorSettings) -> Steady:
        """Conditions of an automatic fit; with changed settings it is compared with no model."""
        changed = settings.identification != self._fitted_with
        return Steady(
            plateau=settings.plateau,
            least_samples=settings.window.least_samples,
            after=0 if changed else self._last_stamp,
            rival=None if changed else self._model,
        )

    def _take_over(self, settings: IdentificationSettings, future: Future[Refit | None]) -> None:
        """Predict with a fitted model from now on, unless the present one predicts better."""
        self._fitting = False
        if future.cancelled():
            return
        try:
            refit = future.result()
        except (TestbedError, BrokenProcessPool) as error:
            self._state = (2, f"no fit: {error}")
            return
        if refit is None:
            return
        if refit.is_worse:
            self._counts["refused"] += 1
            self._state = (0, f"{self._origin}; it stays: {refit.comparison}")
            return
        fit = refit.fit
        self._model, self._last_stamp = fit.model, fit.last_stamp
        self._fitted_with = settings
        self._counts["fits"] += 1
        self._origin = (
            f"model {fit.model.variant} from {fit.samples} samples, "
            f"{fit.determined:.0f} of {fit.model.stiffness.size} directions determined"
        )
        if refit.cause:
            self._origin += f"; older samples left out: {refit.cause}"
        compared = f"; it replaced another: {refit.comparison}" if refit.comparison else ""
        self._state = (0, self._origin + compared)
        self._notify(fit)

    def _check(self, stamp: int) -> None:
        self._checking, self._last_check = True, stamp
        with self._lock:
            samples = self._window.samples()
        leave_out = self._settings().identification.leave_out
        future = self._fitter.check(samples, self._geometry, leave_out)
        future.add_done_callback(self._take_findings)

    def _take_findings(self, future: Future[tuple[str, ...]]) -> None:
        self._checking = False
        if not future.cancelled() and future.exception() is None:
            self._findings = future.result()
