"""Online estimation: measurements in, force maps and predictions out, models fitted meanwhile.

It does not depend on ROS: the estimator node converts its messages and publishes its results.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from socket_testbed.arrays import FloatArray, StatusArray
from socket_testbed.drivers import ERROR, OK, WARN
from socket_testbed.errors import IdentificationError, first_of
from socket_testbed.geometry.regions import all_regions
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification import pressure
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.fit import Fit, FittedModel
from socket_testbed.identification.force_map import ForceMap, MapEstimate
from socket_testbed.identification.model_file import read_model
from socket_testbed.identification.plausibility import beyond_a_person, channel_limits
from socket_testbed.identification.wrench import PoseTrail
from socket_testbed.live.fit_worker import FitWorker, Refit, Steady, check_samples, fit_samples
from socket_testbed.samples import Samples
from socket_testbed.settings.identification import IdentificationSettings
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.wire.messages import in_order
from socket_testbed.wire.topics import PYLON_POSE, SOCKET_POSE, STRESS, WRENCH, Topic

MEASURED = (STRESS, WRENCH, SOCKET_POSE, PYLON_POSE)  # the parts of a sample

_FIRST_FIT_INTERVAL = 10  # samples between attempts at the first model
_MAX_RATE = 500.0  # [Hz]; of the trigger
_MAX_PARTS = 500  # single samples in a window before they are joined, which takes less memory
_CHECK_PERIOD = 2_000_000_000  # [ns]; between checks of the data


class SampleWindow:
    """The newest samples, in bounded memory.

    Args:
        duration: Samples whose stamps are further than this from the last one are dropped [s]: the
            older ones, and any with a stamp in the future.
    """

    def __init__(self, duration: float) -> None:
        self._duration = round(duration * 1e9)
        self._most = math.ceil(_MAX_RATE * duration)
        self._parts: deque[Samples] = deque()  # what was joined last, and the samples since
        self._count = 0  # of their samples
        self._last = 0  # stamp of the last sample [ns]

    def __len__(self) -> int:
        return self._count

    def add(self, sample: Samples) -> None:
        """Add one sample, usually the newest; it may be a little older than those before."""
        self._parts.append(sample)
        self._count += 1
        self._last = int(sample.stamps[0])
        while abs(int(self._parts[0].stamps[-1]) - self._last) > self._duration:
            self._count -= len(self._parts.popleft())
        if len(self._parts) > _MAX_PARTS or self._count > self._most:
            self.samples()

    def clear(self) -> None:
        """Drop all samples."""
        self._parts, self._count = deque(), 0

    def samples(self) -> Samples:
        """The samples of the window in the order of their stamps.

        Raises:
            IdentificationError: If there is none yet.
        """
        if not self._parts:
            hint = "see in the diagnostics which node sends no measurements"
            raise IdentificationError("there is no complete sample to fit", hint)
        names = [field.name for field in fields(Samples) if field.name != "clusters"]
        joined = {n: np.concatenate([getattr(s, n) for s in self._parts]) for n in names}
        found = Samples(clusters=self._parts[0].clusters, **joined)
        found = found[-self._most :]
        found = found[np.abs(found.stamps - self._last) <= self._duration]
        found = found[np.argsort(found.stamps, kind="stable")]
        self._parts, self._count = deque([found]), len(found)
        return found


class OnlineMap:
    """Maps the forces on all tiles, sample by sample, from the clusters and the wrench.

    Channels left out of the objective and physically impossible values are ignored.

    Args:
        geometry: The socket, with n tiles.
        settings: Returns the current settings, which may change at any time.

    Attributes:
        count: Number of maps so far.
        places: The R regions of the outputs; the last one is the whole socket.
    """

    def __init__(self, geometry: SocketGeometry, settings: Callable[[], EstimatorSettings]) -> None:
        self._geometry = geometry
        self._settings = settings
        self._limits = channel_limits(geometry, tuple(geometry.clusters))
        self._prior = settings().force_map
        self._map = ForceMap(geometry, tuple(geometry.clusters), self._prior)
        self._newest: Samples
        self.count = 0
        self.places = all_regions(geometry)

    def update(self, sample: Samples, wanted: bool = True) -> MapEstimate | None:
        """The map of one sample, with N = 1; needs no pose.

        Of the rules for outliers, one sample shows the limits of a person alone.

        Args:
            sample: The sample, with N = 1.
            wanted: Whether its map is wanted; otherwise it only counts for the maps after it, and
                None is returned.
        """
        settings = self._settings()
        if settings.force_map != self._prior:
            self._prior = settings.force_map
            self._map = ForceMap(self._geometry, sample.clusters, self._prior)
        left_out = ~sample.counted(settings.identification.leave_out)
        implausible = beyond_a_person(sample.values, self._limits)
        self._newest = sample.blanked(implausible | left_out)
        if not wanted:
            self._map.learn(self._newest)
            return None
        self.count += 1
        return self._map.update(self._newest)

    def outputs(self) -> pressure.PressureOutputs | None:
        """The outputs of `places` at the last mapped sample, from joint draws.

        None if no channel of the sample has a value.
        """
        if not pressure.measured_rows(self._newest)[0]:
            return None
        return pressure.pressure_outputs(
            self._map, self._newest, self._geometry, self.places, pressure.THRESHOLD
        )


class Estimates(NamedTuple):
    """The estimates that a measurement completes, if any.

    Attributes:
        force_map: Forces on all tiles, with N = 1; None unless clusters and wrench are complete and
            the map is wanted.
        wrench: Predicted wrench of the limb on the socket, [M; F] in {S}, shape (6,) [N m, N]; None
            unless the sample is complete and a model exists.
        forces: Predicted force of the limb on each of the n tiles in {S}, shape (n, 3) [N]; None
            unless the sample is complete and a model exists.
    """

    force_map: MapEstimate | None = None
    wrench: FloatArray | None = None
    forces: FloatArray | None = None


class OnlineEstimator:
    """Maps and predicts every sample, and starts fits.

    Measurements are matched by equal stamps, never by nearest ones. The clusters and the wrench
    give a map; both poses are needed to predict with the newest model.

    Args:
        geometry: The socket, with n tiles and c clusters.
        settings: Returns the current settings, which may change at any time.
        fitter: The process that fits.
        notify: Called with each new model: a fit, in a thread of the fitter, or a loaded one.
        map_wanted: Whether anybody wants the map of the present sample.

    Attributes:
        map: Maps the forces on all tiles.
        newest: Newest stamp of a complete sample since the epoch [ns]; 0 before the first one, and
            after a jump back in time.
    """

    def __init__(
        self,
        geometry: SocketGeometry,
        settings: Callable[[], EstimatorSettings],
        fitter: FitWorker,
        notify: Callable[[FittedModel], None],
        map_wanted: Callable[[], bool] = lambda: True,
    ) -> None:
        self._geometry = geometry
        self._settings = settings
        self._fitter = fitter
        self._notify = notify
        self._map_wanted = map_wanted
        self._clusters = tuple(geometry.clusters)
        self._window = SampleWindow(settings().window.duration)
        self._open: OrderedDict[int, dict[Topic, Any]] = OrderedDict()  # incomplete, by stamp
        self._lock = threading.Lock()  # for the window and the start of a fit
        self._fitting = False
        self._since_attempt = 0  # samples
        self._last_trigger = 0
        self._jumps = 0  # back in time
        self._model: ContactModel | None = None
        self._trail: PoseTrail | None = None  # of the limb, for a model with memory
        self._last_stamp = 0  # of the samples behind the model [ns]
        self._fitted_with = settings().identification
        self._origin = ""  # description of the model
        self._checking = False
        self._last_check = 0  # [ns]
        self._findings: tuple[str, ...] = ()  # on the data of the window
        names = ("triggers", "samples", "predictions", "fits", "refused", "incomplete")
        self._counts = dict.fromkeys(names, 0)
        waiting = "waiting for steady data or " * settings().auto_fit
        self._state = (OK, f"no model yet: {waiting}estimator/fit")
        self.map = OnlineMap(geometry, settings)
        self.newest = 0

    @property
    def state(self) -> tuple[int, str]:
        """Level (OK, WARN or ERROR) and its reason in one line."""
        level, text = self._state
        if not self._findings:
            return level, text
        return max(level, WARN), f"{first_of(self._findings)}; {text}"

    def figures(self) -> dict[str, object]:
        """Counts for the diagnostics, by name."""
        return {**self._counts, "window": len(self._window), "maps": self.map.count}

    def load(self, path: Path) -> None:
        """Predict with a stored model, read from its file.

        Raises:
            ConfigurationError: If the file is wrong, or its model was fitted on another socket.
        """
        stored = read_model(path, self._geometry)
        self._model, self._trail, self._last_stamp = stored.model, stored.model.trail(), 0
        self._origin = f"predicting with the model of {stored.trial}"
        self._state = (OK, self._origin)
        self._notify(stored)

    def trigger(self, stamp: int) -> None:
        """Count a trigger, given its stamp since the epoch [ns].

        After a jump back in time, all measurements are dropped.
        """
        if stamp < self._last_trigger:
            self._open.clear()
            with self._lock:
                self._window.clear()
            self.newest = self._last_check = self._last_stamp = 0
            self._jumps += 1
            self._findings = ()
        self._last_trigger = stamp
        self._counts["triggers"] += 1

    def add(self, topic: Topic, stamp: int, value: Any) -> Estimates:
        """Add a measurement.

        Args:
            topic: One of `MEASURED`.
            stamp: Stamp of its trigger since the epoch [ns].
            value: Of STRESS the normal stress (positive in compression) and shears along x and y
                of the cluster's own frame, shape (3,) [Pa], and the status, by cluster; of WRENCH
                [M; F] in {S}, shape (6,) [N m, N]; of a pose the position [m] and quaternion
                (x, y, z, w) of the marker body in the world, shape (7,).

        Returns:
            The map if this completes the clusters and the wrench and it is wanted; the prediction
            if it completes the sample and a model exists.
        """
        measured = self._open.setdefault(stamp, {})
        measured[topic] = cluster_forces(self._geometry, value) if topic is STRESS else value
        mapped = topic in (STRESS, WRENCH) and STRESS in measured and WRENCH in measured
        complete = len(measured) == len(MEASURED)
        if mapped or complete:
            sample = self._sample(stamp, measured)
        force_map = self.map.update(sample, self._map_wanted()) if mapped else None
        if complete:
            del self._open[stamp]
            estimates = Estimates(force_map, *self._predict(sample))
            self._keep(sample)
            return estimates
        while len(self._open) > self._settings().window.pending:
            self._open.popitem(last=False)
            self._counts["incomplete"] += 1
        return Estimates(force_map)

    def fit(self) -> Fit:
        """Fit on all samples of the window, and wait for the model.

        Raises:
            IdentificationError: If a fit is running already or was aborted, there is no sample, or
                the samples cannot be fitted.
        """
        started = self._start_fit(steady=False)
        if started is None:
            raise IdentificationError("a fit is running already", "ask again when it is done")
        try:
            refit = started.result()
        except (CancelledError, BrokenProcessPool):
            raise IdentificationError("the fit was aborted", "ask again") from None
        assert refit is not None  # None only for automatic fits
        return refit.fit

    def _sample(self, stamp: int, measured: dict[Topic, Any]) -> Samples:
        """The sample at a stamp; the limb pose is NaN without both body poses."""
        forces, status = measured[STRESS]
        position = rotation = np.full(3, np.nan)
        if len(measured) == len(MEASURED):
            limb = self._geometry.limb_of(measured[SOCKET_POSE], measured[PYLON_POSE])
            position, rotation = limb.translation, limb.rotation_vector()
        return Samples(
            np.array([stamp]),
            position[None],
            rotation[None],
            measured[WRENCH][None],
            self._clusters,
            forces[None],
            status[None],
        )

    def _predict(self, sample: Samples) -> tuple[FloatArray | None, FloatArray | None]:
        model = self._model
        if model is None:
            return None, None
        self._counts["predictions"] += 1
        wrench, forces = model.wrench_and_forces(sample.pose, sample.stamps, self._trail)
        return wrench[0], forces[0]

    def _keep(self, sample: Samples) -> None:
        """Keep a complete sample; start a fit and a data check when due."""
        stamp = int(sample.stamps[0])
        self._counts["samples"] += 1
        self.newest = max(self.newest, stamp)
        with self._lock:
            self._window.add(sample)
        self._since_attempt += 1
        if self._fit_is_due():
            self._start_fit(steady=True)
        if abs(stamp - self._last_check) >= _CHECK_PERIOD and not self._checking:
            self._check(stamp)

    def _fit_is_due(self) -> bool:
        """Whether auto fit is on, with enough samples, enough new ones since the last attempt."""
        settings = self._settings()
        due = settings.window.refit_after if self._model is not None else _FIRST_FIT_INTERVAL
        return (
            settings.auto_fit
            and not self._fitting
            and 0 < due <= self._since_attempt
            and len(self._window) >= settings.window.least_samples
        )

    def _start_fit(self, steady: bool) -> Future[Refit | None] | None:
        """Start a fit on the window's newest plateau, or on all of it."""
        settings = self._settings()
        with self._lock:
            if self._fitting:
                return None
            samples = self._window.samples()
            self._fitting = True
            self._since_attempt = 0
        chosen, condition = settings.identification, None
        if steady:
            # After a change of settings, models are not comparable.
            changed = chosen != self._fitted_with
            condition = Steady(
                plateau=settings.plateau,
                least_samples=settings.window.least_samples,
                after=0 if changed else self._last_stamp,
                rival=None if changed else self._model,
            )
        future = self._fitter.run(fit_samples, samples, self._geometry, chosen, condition)
        future.add_done_callback(partial(self._take_over, chosen, self._jumps))
        return future

    def _take_over(
        self, settings: IdentificationSettings, since: int, future: Future[Refit | None]
    ) -> None:
        """Switch to a fitted model, unless the current one predicts better.

        The fit began after `since` jumps back in time.
        """
        self._fitting = False
        if future.cancelled():
            return
        try:
            refit = future.result()
        except Exception as error:  # also one that nobody foresaw
            self._state = (ERROR, f"no fit: {error}")
            return
        if refit is None:
            return
        if refit.is_worse:
            self._counts["refused"] += 1
            self._state = (OK, f"{self._origin}; kept: {refit.contest}")
            return
        fit = refit.fit
        self._model, self._trail = fit.model, self._trail_of(fit.model)
        self._last_stamp = fit.last_stamp if since == self._jumps else 0
        self._fitted_with = settings
        self._counts["fits"] += 1
        self._origin = (
            f"model {fit.model.variant} from {fit.samples} samples, "
            f"{fit.determined:.0f} of {fit.model.stiffness.size} directions determined"
        )
        if refit.cause:
            self._origin += f"; older samples left out: {refit.cause}"
        judged = f"; it replaced the previous model: {refit.contest}" if refit.contest else ""
        self._state = (OK, self._origin + judged)
        self._notify(fit)

    def _trail_of(self, model: ContactModel) -> PoseTrail | None:
        """Where the limb has been so far, for a model with memory; None for one without."""
        trail = model.trail()
        with self._lock:
            past = self._window.samples() if trail is not None and len(self._window) else None
        if past is not None:
            model.wrench(past.pose, past.stamps, trail)
        return trail

    def _check(self, stamp: int) -> None:
        """Start a check of the window's data."""
        self._checking, self._last_check = True, stamp
        with self._lock:
            samples = self._window.samples()
        leave_out = self._settings().identification.leave_out
        future = self._fitter.run(check_samples, samples, self._geometry, leave_out)
        future.add_done_callback(partial(self._take_findings, self._jumps))

    def _take_findings(self, since: int, future: Future[tuple[str, ...]]) -> None:
        self._checking = False
        if future.cancelled() or since != self._jumps:
            return
        error = future.exception()
        self._findings = (f"data not checked: {error}",) if error else future.result()


def cluster_forces(
    geometry: SocketGeometry, stresses: Mapping[str, tuple[FloatArray, int]]
) -> tuple[FloatArray, StatusArray]:
    """Forces on the clusters of a socket, in its order; an absent cluster is missing.

    Args:
        geometry: The socket, with c clusters.
        stresses: By cluster the normal stress (positive in compression) and shears along x and y of
            its own frame, shape (3,) [Pa], and the `Status`.

    Returns:
        Forces of the limb on the clusters in their tiles' frames {L}, shape (c, 3) [N], NaN where
        missing, and the statuses, shape (c,).
    """
    found, status = in_order(stresses, geometry.clusters)
    pairs = zip(geometry.clusters, found, strict=True)
    return np.array([geometry.cluster_force(*pair) for pair in pairs]), status
