"""Settings of sources that know no trigger; their defaults are defined only here."""

from __future__ import annotations

from dataclasses import dataclass

from socket_testbed.settings.acquisition import MAX_SPAN, TareSettings, averaging_span
from socket_testbed.settings.fields import Settings, fixed, setting

MAX_DELAY = 10.0  # [s]; of a source
USUAL_STALE = 0.05, 2.5  # [s], [-]; longest distance of readings: that, or so many usual steps


@dataclass(frozen=True)
class SourceSettings(Settings):
    """How the readings of one source that knows no trigger are brought to triggers."""

    delay: float = setting(
        0.0, "delay of the stamps behind the measurement; subtracted from each [s]",
        -MAX_DELAY, MAX_DELAY,
    )  # fmt: skip
    method: str = setting(
        "line",
        "line: of a least-squares line through the window, at the trigger; mean: of the window;"
        " last: the last reading before the trigger [-]",
        choices=("line", "mean", "last"),
    )
    window: float = setting(
        -1.0, "span centred on a trigger whose readings are used; negative: the trigger's period,"
        f" at most {MAX_SPAN}; 0: between the two readings around the trigger [s]", -1.0, 5.0,
    )  # fmt: skip
    stale: float = setting(
        -1.0, "longest distance between the two readings around a trigger, or age of the last one;"
        f" negative: {USUAL_STALE[1]} usual steps of the source, at least {USUAL_STALE[0]} [s]",
        -1.0, 10.0,
    )  # fmt: skip

    def span(self, period: float) -> float:
        """Span centred on a trigger whose readings are used [s]; 0 for the method `last`.

        Of the period three digits count: the jitter of a trigger does not move the span, which is
        the same live and in a recording.

        Args:
            period: Period of the trigger [s]; 0 while it is not known.
        """
        if self.method == "last":
            return 0.0
        return averaging_span(self.window, float(f"{period:.3g}"))


OWN = ""  # topic of a source that the testbed's own driver measures
NONE = "none"  # topic of a source that there is not


@dataclass(frozen=True)
class LiveSourceSettings(SourceSettings):
    """A pose that the testbed's own driver measures, or that arrives on another topic."""

    topic: str = fixed(
        OWN,
        "topic of the measurements of another driver, TOPIC:BODY for one of its rigid bodies, or"
        " tf:PARENT/CHILD for a transform on /tf; none: there are none; empty: the testbed's own"
        " driver measures [-]",
    )

    @property
    def is_foreign(self) -> bool:
        """Whether its measurements arrive on a topic of another driver."""
        return self.topic not in (OWN, NONE)


@dataclass(frozen=True)
class LiveWrenchSettings(LiveSourceSettings):
    """A wrench that the testbed's own load cell measures, or that arrives on another topic."""

    of: str = setting(
        "limb", "whose force it is: of the limb on the socket, or of the socket on the limb [-]",
        choices=("limb", "socket"),
    )  # fmt: skip
    rotation: tuple[float, ...] = fixed(
        (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        "rows of the rotation that maps vectors of its frame to {S}, nine numbers [-]", -1.0, 1.0,
    )  # fmt: skip
    translation: tuple[float, ...] = fixed(
        (0.0, 0.0, 0.0), "origin of its frame in {S}, three numbers [m]", -2.0, 2.0
    )


@dataclass(frozen=True)
class LiveClusterSettings(LiveSourceSettings):
    """Capacitances that the testbed's own chips measure, or values that arrive on another topic."""

    names: tuple[str, ...] = fixed(
        (),
        "clusters, in the order of an array without names, four capacitances each; empty: those of"
        " cluster_node [-]",
    )


@dataclass(frozen=True)
class AlignSettings(TareSettings):
    """Parameters of the align node: sources of other drivers, brought to the trigger."""

    wrench: LiveWrenchSettings = LiveWrenchSettings()
    socket_pose: LiveSourceSettings = LiveSourceSettings()
    pylon_pose: LiveSourceSettings = LiveSourceSettings()
    clusters: LiveClusterSettings = LiveClusterSettings()
    wait: float = setting(
        0.3, "longest wait for a reading, after the trigger, the delay and half the window [s]",
        0.01, 10.0,
    )  # fmt: skip
    geometry: str = fixed("", "path of socket.yaml, for frames; empty: the package's own [-]")
    calibration: str = fixed(
        "", "path of calibration.yaml, for stresses; empty: the package's own [-]"
    )

    @property
    def sources(self) -> dict[str, LiveSourceSettings]:
        """The settings of each source by its name, such as `socket_pose`."""
        return {
            "wrench": self.wrench,
            "socket_pose": self.socket_pose,
            "pylon_pose": self.pylon_pose,
            "clusters": self.clusters,
        }

    @property
    def is_used(self) -> bool:
        """Whether any source is not measured by the testbed's own driver."""
        return any(own.topic != OWN for own in self.sources.values())
