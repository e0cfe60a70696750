"""Settings of the acquisition nodes; their defaults are defined only here."""

from __future__ import annotations

from dataclasses import dataclass

from socket_testbed.errors import ConfigurationError
from socket_testbed.settings.fields import Settings, fixed, setting

MAX_TARE = 60.0  # [s]; longest averaging time of a tare
MAX_STALE = 1.0  # [s]; longest gap between frames of the motion capture
READY_TIMEOUT = 60.0  # [s] of real time; for all nodes before the first trigger
MAX_PULSE = 0.5  # [-]; of the trigger's period
MAX_SPAN = 0.25  # [s]; of the default averaging around a trigger


def averaging_span(wanted: float, period: float) -> float:
    """Span centred on a trigger to average over [s].

    Args:
        wanted: The setting [s]; a negative one stands for the trigger period, at most `MAX_SPAN`.
        period: The trigger period [s]; 0 if it is not known yet.
    """
    return wanted if wanted >= 0.0 else min(period, MAX_SPAN)


@dataclass(frozen=True)
class SchedulingSettings(Settings):
    """Scheduling of a node that measures; see docs/hardware.md for the required rights."""

    priority: int = fixed(0, "real-time priority; 0: none [1]", 0, 98)
    cores: tuple[int, ...] = fixed((), "cores to run on; empty: all [1]", 0, 1023)
    lock_memory: bool = fixed(False, "lock the node's memory, so that it is never swapped out [-]")


@dataclass(frozen=True)
class TriggerSettings(Settings):
    """Parameters of the trigger node."""

    source: str = fixed(
        "gpio",
        "gpio: a pulse with a kernel timestamp; timer: the steady clock alone; topic: the messages"
        " of another program [-]",
        choices=("gpio", "timer", "topic"),
    )
    topic: str = fixed(
        "", "topic of another program, each message of which is a trigger, for source topic [-]"
    )
    rate: float = setting(4.0, "rate of the trigger [Hz]", 0.1, 500.0)
    enabled: bool = fixed(True, "start triggering at once; see trigger/enable [-]")
    wait_for: tuple[str, ...] = fixed((), "nodes that must be ready before the first trigger [-]")
    chip: str = fixed("pinctrl-rp1", "label of the GPIO chip; its number may change [-]")
    output_line: int = fixed(17, "line that outputs the pulse [1]", 0, 1023)
    input_line: int = fixed(27, "line wired to output_line, whose edge is timestamped [1]", 0, 1023)
    pulse: float = fixed(5e-4, "length of the pulse [s]", 1e-5, 0.1)
    simulation: str = fixed("", "folder of a simulated world; empty: the hardware [-]")
    edge_within: float = fixed(1e-3, "longest delay of the edge after the pulse [s]", 1e-5, 0.1)
    scheduling: SchedulingSettings = SchedulingSettings()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.source == "gpio" and self.output_line == self.input_line:
            fact = f"output_line and input_line are both {self.output_line}"
            raise ConfigurationError(fact, "give two lines, and wire one to the other")
        if (self.source == "topic") != bool(self.topic):
            fact = f"source is {self.source} and topic is '{self.topic}'"
            raise ConfigurationError(fact, "give a topic with source topic, and with no other")
        if self.pulse * self.rate > MAX_PULSE:
            fact = f"a pulse of {self.pulse:g} s is too long for {self.rate:g} Hz"
            hint = f"set pulse to {1e-6 * int(1e6 * MAX_PULSE / self.rate):g} s or less"
            raise ConfigurationError(fact, hint)


@dataclass(frozen=True)
class ClusterSettings(Settings):
    """Parameters of the cluster node."""

    names: tuple[str, ...] = fixed(
        ("brim_lateral", "mid_anterior", "posterior_distal", "distal"), "names of the clusters [-]"
    )
    chip: str = fixed(
        "fdc1004", "chip of the clusters, one of CAPACITIVE_CHIPS in live/hardware.py [-]"
    )
    buses: tuple[int, ...] = fixed((1, 1, 1, 1), "N of each cluster's bus /dev/i2c-N [1]", 0, 255)
    multiplexer: int = fixed(0x70, "I2C address of the clusters' multiplexer; 0: none [1]", 0, 0x77)
    multiplexers: tuple[int, ...] = fixed(
        (),
        "address of each cluster's multiplexer, if they differ; empty: multiplexer for all [1]",
        0,
        0x77,
    )
    channels: tuple[int, ...] = fixed((0, 1, 2, 3), "multiplexer channel of each cluster [1]", 0, 7)
    sample_rate: int = fixed(
        400, "conversions per chip, shared by its inputs; FDC1004: 100, 200, 400 [1/s]", 1, 100_000
    )
    simulation: str = fixed("", "folder of a simulated world; empty: the hardware [-]")
    bus_timeout: float = fixed(0.02, "timeout of a transfer on a hanging bus [s]", 0.01, 1.0)
    latest: float = fixed(0.05, "later readings after the trigger count as missing [s]", 1e-3, 1.0)
    scheduling: SchedulingSettings = SchedulingSettings()

    @property
    def each_multiplexer(self) -> tuple[int, ...]:
        """I2C address of each cluster's multiplexer, one entry per cluster; 0: none."""
        return self.multiplexers or (self.multiplexer,) * len(self.names)

    @property
    def places(self) -> list[tuple[int, int, int]]:
        """Bus number N of /dev/i2c-N, multiplexer address (0: none) and channel, per cluster."""
        return [*zip(self.buses, self.each_multiplexer, self.channels, strict=True)]


@dataclass(frozen=True)
class TareSettings(Settings):
    """How a wrench is tared."""

    tare_duration: float = setting(1.0, "averaging time of a tare [s]", 0.1, MAX_TARE)
    tare_force: float = setting(2.0, "largest deviation of a force while taring [N]", 1e-3, 1e3)
    tare_moment: float = setting(0.2, "largest deviation of a moment while taring [N m]", 1e-4, 1e2)
    tare_load: float = setting(
        40.0, "largest force that an unforced tare removes; a tenth of the lightest person's weight"
        " [N]", 1.0, 1e5,
    )  # fmt: skip
    tare_pressure: float = setting(
        5e3, "largest normal stress of a cluster at an unforced tare [Pa]", 100.0, 1e7
    )
    tare_file: str = fixed("", "file that keeps the tare across restarts; empty: none [-]")


@dataclass(frozen=True)
class LoadCellSettings(TareSettings):
    """Parameters of the load-cell node."""

    device: str = fixed("0.0", "bus and chip select N.M of /dev/spidevN.M [-]")
    spi_clock: float = fixed(8e6, "clock of the bus [Hz]", 1e5, 25e6)
    channels: int = fixed(6, "channels of the converter: 6 (M06) or 8 (M08) [1]", 6, 8)
    crc: str = fixed(
        "ccitt", "polynomial of the converter's checksum: ccitt (0x1021) or ansi (0x8005) [-]",
        choices=("ccitt", "ansi"),
    )  # fmt: skip
    inputs: tuple[int, ...] = fixed((0, 1, 2, 3, 4, 5), "converter input of each bridge [1]", 0, 7)
    data_ready_line: int = fixed(
        -1, "GPIO line of DRDY, whose edges timestamp the conversions; -1: none [1]", -1, 1023
    )
    data_ready_chip: str = fixed("pinctrl-rp1", "label of the GPIO chip of data_ready_line [-]")
    clock_in: float = fixed(8.192e6, "clock of the converter [Hz]", 3e5, 8.4e6)
    oversampling: int = fixed(
        8192, "oversampling ratio; rate = clock_in / 2 / oversampling [1]", 128, 16384
    )
    gain: int = fixed(1, "gain of the converter's internal amplifier [1]", 1, 128)
    amplifier_gain: tuple[float, ...] = fixed(
        (34.0, 34.0, 34.0, 151.0, 151.0, 151.0), "gain of each bridge's amplifier [-]", 1.0, 1e4
    )
    excitation: float = fixed(5.0, "voltage across the bridges [V]", 0.5, 20.0)
    sign: tuple[float, ...] = fixed(
        (1.0, 1.0, 1.0, 1.0, 1.0, 1.0), "sign of each bridge, 1 or -1 [-]", -1.0, 1.0
    )
    matrix: tuple[float, ...] = fixed(
        (),
        "calibration matrix of the maker, row by row, Fx to Mz over the bridges [N, N m per mV/V]",
        -1e6,
        1e6,
    )
    full_scale: tuple[float, ...] = fixed((), "full scale of Fx Fy Fz Mx My Mz [N, N m]", 1e-3, 1e5)
    simulation: str = fixed("", "folder of a simulated world; empty: the hardware [-]")
    window: float = setting(
        0.02, "minimum span of a wrench's conversions, a quarter after the trigger [s]", 1e-3, 1.0
    )
    average_over: float = setting(
        -1.0, "span centred on a trigger to average its wrench, if the window is shorter;"
        f" negative: the trigger's period, at most {MAX_SPAN}; 0: the window alone [s]", -1.0, 0.5,
    )  # fmt: skip
    scheduling: SchedulingSettings = SchedulingSettings()


@dataclass(frozen=True)
class MocapSettings(Settings):
    """Parameters of the motion-capture node."""

    server: str = fixed("", "address of the computer that runs Motive [-]")
    command_port: int = fixed(1510, "command port of Motive [1]", 1, 65535)
    data_port: int = fixed(1511, "data port of Motive, for multicast [1]", 1, 65535)
    multicast: str = fixed("", "multicast group, such as 239.255.42.99; empty: unicast [-]")
    interface: str = fixed("", "own address towards the server; empty: any [-]")
    bitstream: str = fixed("4.1", "stream version to request from a unicast server [-]")
    socket_body: str = fixed("socket", "name of the socket's rigid body in Motive [-]")
    pylon_body: str = fixed("pylon", "name of the pylon's rigid body in Motive [-]")
    geometry: str = fixed("", "path of socket.yaml, for markers; empty: the package's own [-]")
    stale: float = fixed(
        0.05, "largest gap between frames around a trigger, and timeout for them [s]",
        1e-3, MAX_STALE,
    )  # fmt: skip
    window: float = setting(
        -1.0, "span of frames centred on a trigger to average for its pose; negative: the trigger's"
        f" period, at most {MAX_SPAN}; 0: between the two frames around it [s]", -1.0, 0.5,
    )  # fmt: skip
    clock_uncertainty: float = fixed(
        2e-3, "uncertainty of Motive's clock above which poses are missing [s]", 1e-5, 0.1
    )
    record_takes: bool = setting(True, "have Motive record when the recorder records [-]")
    scheduling: SchedulingSettings = SchedulingSettings()
