"""Settings of the acquisition nodes: the only home of their defaults."""

from __future__ import annotations

from dataclasses import dataclass

from socket_testbed.settings.fields import Settings, setting


@dataclass(frozen=True)
class SchedulingSettings(Settings):
    """How a node that measures is scheduled; the rights that it needs: docs/hardware.md."""

    priority: int = setting(
        0, "real-time priority (SCHED_FIFO), above that of all ordinary programs; 0: none [1]",
        0, 98, fixed=True,
    )  # fmt: skip
    cores: tuple[int, ...] = setting(
        (), "cores that it runs on; empty: all [1]", 0, 1023, fixed=True
    )
    lock_memory: bool = setting(False, "keep its memory from being swapped out [-]", fixed=True)


@dataclass(frozen=True)
class TriggerSettings(Settings):
    """Parameters of the trigger node."""

    source: str = setting(
        "gpio", "gpio: a pulse whose edge the kernel stamps; timer: the steady clock alone [-]",
        choices=("gpio", "timer"), fixed=True,
    )  # fmt: skip
    rate: float = setting(4.0, "rate of the trigger [Hz]", 0.1, 500.0)
    enabled: bool = setting(True, "trigger from the start; see trigger/enable [-]", fixed=True)
    wait_for: tuple[str, ...] = setting(
        (), "nodes that must be ready before the first trigger [-]", fixed=True
    )
    chip: str = setting("pinctrl-rp1", "label of the GPIO chip; its number moves [-]", fixed=True)
    output_line: int = setting(17, "line that makes the pulse [1]", 0, 1023, fixed=True)
    input_line: int = setting(
        27, "line wired to it, whose edge is stamped [1]", 0, 1023, fixed=True
    )
    pulse: float = setting(5e-4, "length of the pulse [s]", 1e-5, 0.1, fixed=True)
    simulation: str = setting(
        "", "folder of a simulated world; empty: the hardware [-]", fixed=True
    )
    edge_within: float = setting(
        1e-3, "latest time of the edge after the pulse was asked for [s]", 1e-5, 0.1, fixed=True
    )
    scheduling: SchedulingSettings = SchedulingSettings()


@dataclass(frozen=True)
class ClusterSettings(Settings):
    """Parameters of the cluster node."""

    names: tuple[str, ...] = setting(
        ("brim_lateral", "mid_anterior", "posterior_distal", "distal"),
        "names of the clusters [-]", fixed=True,
    )  # fmt: skip
    chip: str = setting(
        "fdc1004", "chip of the clusters, one of CAPACITIVE_CHIPS in live/hardware.py [-]",
        fixed=True,
    )  # fmt: skip
    buses: tuple[int, ...] = setting(
        (1, 1, 1, 1), "number N of the bus /dev/i2c-N that each cluster is on [1]", 0, 255,
        fixed=True,
    )  # fmt: skip
    multiplexer: int = setting(
        0x70, "address of the multiplexer on these buses; 0: there is none [1]", 0, 0x77, fixed=True
    )
    channels: tuple[int, ...] = setting(
        (0, 1, 2, 3), "channel of the multiplexer that each cluster is on [1]", 0, 7, fixed=True
    )
    sample_rate: int = setting(
        400, "conversions of a chip, shared by its four inputs; FDC1004: 100, 200, 400 [1/s]", 1,
        100_000, fixed=True,
    )  # fmt: skip
    simulation: str = setting(
        "", "folder of a simulated world; empty: the hardware [-]", fixed=True
    )
    bus_timeout: float = setting(
        0.05, "time after which a bus that hangs is given up [s]", 0.01, 1.0, fixed=True
    )
    latest: float = setting(
        0.05, "latest reading after its trigger; a later one is missing [s]", 1e-3, 1.0
    )
    scheduling: SchedulingSettings = SchedulingSettings()


@dataclass(frozen=True)
class LoadCellSettings(Settings):
    """Parameters of the load-cell node."""

    device: str = setting("0.0", "bus and chip select N.M of /dev/spidevN.M [-]", fixed=True)
    spi_clock: float = setting(8e6, "clock of the bus [Hz]", 1e5, 25e6, fixed=True)
    channels: int = setting(
        6, "channels of the converter: 6 (M06) or 8 (M08) [1]", 6, 8, fixed=True
    )
    crc: str = setting(
        "ccitt", "polynomial of the converter's checksum: ccitt (0x1021) or ansi (0x8005) [-]",
        choices=("ccitt", "ansi"), fixed=True,
    )  # fmt: skip
    inputs: tuple[int, ...] = setting(
        (0, 1, 2, 3, 4, 5), "input of the converter that each bridge is on [1]", 0, 7, fixed=True
    )
    data_ready_line: int = setting(
        -1, "GPIO line that DRDY is wired to, whose edges stamp the conversions; -1: none [1]",
        -1, 1023, fixed=True,
    )  # fmt: skip
    data_ready_chip: str = setting(
        "pinctrl-rp1", "label of the GPIO chip of that line [-]", fixed=True
    )
    clock_in: float = setting(8.192e6, "clock of the converter [Hz]", 3e5, 8.4e6, fixed=True)
    oversampling: int = setting(
        8192, "oversampling ratio; rate = clock_in / 2 / oversampling [1]", 128, 16384, fixed=True
    )
    gain: int = setting(1, "gain of the converter's own amplifier [1]", 1, 128, fixed=True)
    amplifier_gain: tuple[float, ...] = setting(
        (34.0, 34.0, 34.0, 151.0, 151.0, 151.0), "gain of each bridge's amplifier [-]", 1.0, 1e4,
        fixed=True,
    )  # fmt: skip
    excitation: float = setting(5.0, "voltage across the bridges [V]", 0.5, 20.0, fixed=True)
    sign: tuple[float, ...] = setting(
        (1.0, 1.0, 1.0, 1.0, 1.0, 1.0), "sign of each bridge, 1 or -1 [-]", -1.0, 1.0, fixed=True
    )
    matrix: tuple[float, ...] = setting(
        (), "the maker's matrix, row by row, Fx Fy Fz Mx My Mz over the bridges [N, N m per mV/V]",
        -1e6, 1e6, fixed=True,
    )  # fmt: skip
    full_scale: tuple[float, ...] = setting(
        (), "full scale of Fx Fy Fz Mx My Mz [N, N m]", 1e-3, 1e5, fixed=True
    )
    simulation: str = setting(
        "", "folder of a simulated world; empty: the hardware [-]", fixed=True
    )
    window: float = setting(
        0.02,
        "shortest span of conversions for a wrench, a quarter after its trigger [s]",
        1e-3,
        1.0,
    )
    average_over: float = setting(
        -1.0, "span centred on a trigger that its wrench averages, where the window is shorter;"
        " negative: the trigger's period, at most 0.25; 0: the window alone [s]", -1.0, 0.5,
    )  # fmt: skip
    tare_duration: float = setting(1.0, "span that a tare averages [s]", 0.1, 60.0)
    tare_force: float = setting(
        2.0, "largest standard deviation of a force while taring [N]", 1e-3, 1e3
    )
    tare_moment: float = setting(
        0.2, "largest standard deviation of a moment while taring [N m]", 1e-4, 1e2
    )
    tare_file: str = setting(
        "", "file that keeps the tare over a restart; empty: none [-]", fixed=True
    )
    scheduling: SchedulingSettings = SchedulingSettings()


@dataclass(frozen=True)
class MocapSettings(Settings):
    """Parameters of the motion-capture node."""

    server: str = setting("", "address of the computer that runs Motive [-]", fixed=True)
    command_port: int = setting(1510, "its command port [1]", 1, 65535, fixed=True)
    data_port: int = setting(1511, "its data port, for multicast [1]", 1, 65535, fixed=True)
    multicast: str = setting(
        "", "multicast group, such as 239.255.42.99; empty: unicast [-]", fixed=True
    )
    interface: str = setting("", "own address towards the server; empty: any [-]", fixed=True)
    bitstream: str = setting(
        "4.1", "version of the stream that a unicast server is asked for [-]", fixed=True
    )
    socket_body: str = setting(
        "socket", "name of the socket's rigid body in Motive [-]", fixed=True
    )
    pylon_body: str = setting("pylon", "name of the pylon's rigid body in Motive [-]", fixed=True)
    geometry: str = setting(
        "", "path of socket.yaml, for the marker triads; empty: the package's own [-]", fixed=True
    )
    stale: float = setting(
        0.05, "largest gap between the frames around a trigger, and wait for them [s]", 1e-3, 1.0
    )
    window: float = setting(
        -1.0, "span of frames centred on a trigger whose mean is its pose; negative: the trigger's"
        " period, at most 0.25; 0: between the two frames around it [s]", -1.0, 0.5,
    )  # fmt: skip
    clock_uncertainty: float = setting(
        2e-3, "largest error of Motive's clock; where it is known worse, poses are missing [s]",
        1e-5, 0.1, fixed=True,
    )  # fmt: skip
    record_takes: bool = setting(True, "have Motive record when the recorder records [-]")
    scheduling: SchedulingSettings = SchedulingSettings()
