"""Settings of the acquisition nodes: the only home of their defaults."""

from __future__ import annotations

from dataclasses import dataclass

from socket_testbed.settings.fields import Settings, fixed, setting


@dataclass(frozen=True)
class SchedulingSettings(Settings):
    """How a node that measures is scheduled; the rights that it needs: docs/hardware.md."""

    priority: int = fixed(0, "real-time priority, above ordinary programs; 0: none [1]", 0, 98)
    cores: tuple[int, ...] = fixed((), "cores that it runs on; empty: all [1]", 0, 1023)
    lock_memory: bool = fixed(False, "keep its memory from being swapped out [-]")


@dataclass(frozen=True)
class TriggerSettings(Settings):
    """Parameters of the trigger node."""

    source: str = fixed(
        "gpio", "gpio: a pulse whose edge the kernel stamps; timer: the steady clock alone [-]",
        choices=("gpio", "timer"),
    )  # fmt: skip
    rate: float = setting(4.0, "rate of the trigger [Hz]", 0.1, 500.0)
    enabled: bool = fixed(True, "trigger from the start; see trigger/enable [-]")
    wait_for: tuple[str, ...] = fixed((), "nodes that must be ready before the first trigger [-]")
    chip: str = fixed("pinctrl-rp1", "label of the GPIO chip; its number moves [-]")
    output_line: int = fixed(17, "line that makes the pulse [1]", 0, 1023)
    input_line: int = fixed(27, "line wired to it, whose edge is stamped [1]", 0, 1023)
    pulse: float = fixed(5e-4, "length of the pulse [s]", 1e-5, 0.1)
    simulation: str = fixed("", "folder of a simulated world; empty: the hardware [-]")
    edge_within: float = fixed(1e-3, "latest edge after the pulse was asked for [s]", 1e-5, 0.1)
    scheduling: SchedulingSettings = SchedulingSettings()


@dataclass(frozen=True)
class ClusterSettings(Settings):
    """Parameters of the cluster node."""

    names: tuple[str, ...] = fixed(
        ("brim_lateral", "mid_anterior", "posterior_distal", "distal"), "names of the clusters [-]"
    )
    chip: str = fixed("fdc1004", "their chip, of CAPACITIVE_CHIPS in live/hardware.py [-]")
    buses: tuple[int, ...] = fixed((1, 1, 1, 1), "N of each cluster's bus /dev/i2c-N [1]", 0, 255)
    multiplexer: int = fixed(0x70, "address of their multiplexer; 0: there is none [1]", 0, 0x77)
    multiplexers: tuple[int, ...] = fixed(
        (), "the same by cluster, where they differ; empty: one address for all [1]", 0, 0x77
    )
    channels: tuple[int, ...] = fixed(
        (0, 1, 2, 3), "channel of the multiplexer that each cluster is on [1]", 0, 7
    )
    sample_rate: int = fixed(
        400, "conversions of a chip for its four inputs; FDC1004: 100, 200, 400 [1/s]", 1, 100_000
    )
    simulation: str = fixed("", "folder of a simulated world; empty: the hardware [-]")
    bus_timeout: float = fixed(0.05, "time after which a bus that hangs is given up [s]", 0.01, 1.0)
    latest: float = fixed(0.05, "reading later than this is missing [s]", 1e-3, 1.0)
    scheduling: SchedulingSettings = SchedulingSettings()

    @property
    def each_multiplexer(self) -> tuple[int, ...]:
        """Address of every cluster's multiplexer; 0: it has none."""
        return self.multiplexers or (self.multiplexer,) * len(self.names)


@dataclass(frozen=True)
class LoadCellSettings(Settings):
    """Parameters of the load-cell node."""

    device: str = fixed("0.0", "bus and chip select N.M of /dev/spidevN.M [-]")
    spi_clock: float = fixed(8e6, "clock of the bus [Hz]", 1e5, 25e6)
    channels: int = fixed(6, "channels of the converter: 6 (M06) or 8 (M08) [1]", 6, 8)
    crc: str = fixed(
        "ccitt", "polynomial of the converter's checksum: ccitt (0x1021) or ansi (0x8005) [-]",
        choices=("ccitt", "ansi"),
    )  # fmt: skip
    inputs: tuple[int, ...] = fixed(
        (0, 1, 2, 3, 4, 5), "input of the converter that each bridge is on [1]", 0, 7
    )
    data_ready_line: int = fixed(
        -1, "GPIO line of DRDY, whose edges stamp the conversions; -1: none [1]", -1, 1023
    )
    data_ready_chip: str = fixed("pinctrl-rp1", "label of the GPIO chip of that line [-]")
    clock_in: float = fixed(8.192e6, "clock of the converter [Hz]", 3e5, 8.4e6)
    oversampling: int = fixed(8192, "ratio; rate = clock_in / 2 / oversampling [1]", 128, 16384)
    gain: int = fixed(1, "gain of the converter's own amplifier [1]", 1, 128)
    amplifier_gain: tuple[float, ...] = fixed(
        (34.0, 34.0, 34.0, 151.0, 151.0, 151.0), "gain of each bridge's amplifier [-]", 1.0, 1e4
    )
    excitation: float = fixed(5.0, "voltage across the bridges [V]", 0.5, 20.0)
    sign: tuple[float, ...] = fixed(
        (1.0, 1.0, 1.0, 1.0, 1.0, 1.0), "sign of each bridge, 1 or -1 [-]", -1.0, 1.0
    )
    matrix: tuple[float, ...] = fixed(
        (), "the maker's, row by row, Fx to Mz over the bridges [N, N m per mV/V]", -1e6, 1e6
    )
    full_scale: tuple[float, ...] = fixed((), "full scale of Fx Fy Fz Mx My Mz [N, N m]", 1e-3, 1e5)
    simulation: str = fixed("", "folder of a simulated world; empty: the hardware [-]")
    window: float = setting(
        0.02, "shortest span of a wrench's conversions, a quarter after its trigger [s]", 1e-3, 1.0
    )
    average_over: float = setting(
        -1.0, "span centred on a trigger that its wrench averages, where the window is shorter;"
        " negative: the trigger's period, at most 0.25; 0: the window alone [s]", -1.0, 0.5,
    )  # fmt: skip
    tare_duration: float = setting(1.0, "span that a tare averages [s]", 0.1, 60.0)
    tare_force: float = setting(2.0, "largest deviation of a force while taring [N]", 1e-3, 1e3)
    tare_moment: float = setting(0.2, "the same of a moment while taring [N m]", 1e-4, 1e2)
    tare_load: float = setting(100.0, "largest force that a tare removes unforced [N]", 1.0, 1e5)
    tare_file: str = fixed("", "file that keeps the tare over a restart; empty: none [-]")
    scheduling: SchedulingSettings = SchedulingSettings()


@dataclass(frozen=True)
class MocapSettings(Settings):
    """Parameters of the motion-capture node."""

    server: str = fixed("", "address of the computer that runs Motive [-]")
    command_port: int = fixed(1510, "its command port [1]", 1, 65535)
    data_port: int = fixed(1511, "its data port, for multicast [1]", 1, 65535)
    multicast: str = fixed("", "multicast group, such as 239.255.42.99; empty: unicast [-]")
    interface: str = fixed("", "own address towards the server; empty: any [-]")
    bitstream: str = fixed("4.1", "version of the stream that a unicast server is asked for [-]")
    socket_body: str = fixed("socket", "name of the socket's rigid body in Motive [-]")
    pylon_body: str = fixed("pylon", "name of the pylon's rigid body in Motive [-]")
    geometry: str = fixed("", "path of socket.yaml, for markers; empty: the package's own [-]")
    stale: float = fixed(
        0.05, "largest gap between the frames around a trigger, and wait for them [s]", 1e-3, 1.0
    )
    window: float = setting(
        -1.0, "span of frames centred on a trigger whose mean is its pose; negative: the trigger's"
        " period, at most 0.25; 0: between the two frames around it [s]", -1.0, 0.5,
    )  # fmt: skip
    clock_uncertainty: float = fixed(
        2e-3, "error of Motive's clock beyond which poses are missing [s]", 1e-5, 0.1
    )
    record_takes: bool = setting(True, "have Motive record when the recorder records [-]")
    scheduling: SchedulingSettings = SchedulingSettings()
