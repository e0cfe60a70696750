"""What `doctor` says at the ends of its limits, and the whole of its hints."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import scene
from support.clocks import FakeClock
from support.natnet import capture_by_hand

from socket_testbed import clocks
from socket_testbed.drivers import OK, WARN
from socket_testbed.errors import DeviceError
from socket_testbed.geometry.socket import write_socket
from socket_testbed.live import doctor
from socket_testbed.live.doctor import Outcome
from socket_testbed.settings.acquisition import (
    ClusterSettings,
    LoadCellSettings,
    MocapSettings,
    TriggerSettings,
)
from socket_testbed.settings.testbed import TestbedSettings
from socket_testbed.simulation.testbed import Simulation

NAMES = ("brim_lateral", "mid_anterior", "posterior_distal", "distal")


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> FakeClock:
    return FakeClock(100.0).install(monkeypatch)


def made_testbed(folder: Path | None = None, simulated: bool = False, **settings: Any) -> Any:
    """A testbed with some nodes' settings, on the socket of the scene in a folder."""
    nodes = {
        "trigger_node": TriggerSettings(source="timer", rate=10.0),
        "load_cell_node": LoadCellSettings(),
        "cluster_node": ClusterSettings(names=NAMES),
        "mocap_node": MocapSettings(server="10.0.0.5"),
    }
    geometry = None
    if folder is not None:
        geometry = folder / "socket.yaml"
        write_socket(scene.geometry(), geometry)
    return SimpleNamespace(
        settings=replace(TestbedSettings(), **{**nodes, **settings}),
        simulation=Simulation() if simulated else None,
        geometry=geometry,
    )


def test_the_kernel_is_that_of_hardware(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    model = tmp_path / "model"
    monkeypatch.setattr(doctor, "_MODEL_FILE", model)
    monkeypatch.setattr(doctor.platform, "release", lambda: "6.6.20-v8")
    assert [*doctor.check_kernel(made_testbed())] == []
    model.write_text("Raspberry Pi 5 Model B Rev 1.0\0")
    assert [*doctor.check_kernel(made_testbed(simulated=True))] == []
    assert [*doctor.check_kernel(made_testbed())] == [
        Outcome(
            "kernel",
            "6.6.20-v8 on Raspberry Pi 5 Model B Rev 1.0: its I2C bus can lock up"
            " (raspberrypi/linux#5784)",
            "update it to 6.6.28 or newer",
        )
    ]
    model.write_text("Raspberry Pi 4 Model B\0")
    found = [*doctor.check_kernel(made_testbed())]
    assert found == [Outcome("kernel", "6.6.20-v8 on Raspberry Pi 4 Model B")]


def test_a_timer_has_no_wire(monkeypatch: pytest.MonkeyPatch) -> None:
    fired: list[str] = []
    trigger = SimpleNamespace(
        fire=lambda: fired.append("fire") or 100.0,
        end_pulse=lambda: fired.append("end"),
        close=lambda: fired.append("close"),
    )
    monkeypatch.setattr(doctor, "make_trigger", lambda settings: trigger)
    assert [*doctor.check_trigger(made_testbed())] == [
        Outcome("trigger", "the steady clock; no wire")
    ]
    assert fired == ["fire", "end"] * 5 + ["close"]


# Lateness [ms], rate [Hz], oversampling at 8.192 MHz, whether it is soon enough. A conversion of
# 4096 takes 1 ms, and two wait: 1.5 ms; a quarter of the trigger's period at 200 Hz is 1.25 ms.
LATENESS = {
    "drivers": (2.99, 10.0, 16384, True),
    "drivers' limit": (3.01, 10.0, 16384, False),
    "conversions": (1.49, 10.0, 4096, True),
    "conversions' limit": (1.51, 10.0, 4096, False),
    "period": (1.24, 200.0, 16384, True),
    "period's limit": (1.26, 200.0, 16384, False),
}


@pytest.mark.parametrize("case", LATENESS)
@pytest.mark.parametrize("simulated", [False, True], ids=["hardware", "simulated"])
def test_lateness_is_held_to_three_limits(
    simulated: bool, case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    late, rate, oversampling, enough = LATENESS[case]
    monkeypatch.setattr(
        doctor,
        "measure_lateness",
        lambda priority=0: np.full(0 if priority else 100, 1e-3 * late),
    )
    own = made_testbed(
        simulated=simulated,
        trigger_node=TriggerSettings(rate=rate),
        load_cell_node=LoadCellSettings(oversampling=oversampling, clock_in=8.192e6),
    )
    (found,) = doctor.check_scheduling(own)
    words = f"threads wake up {late:.2g} ms late (p99; {late:.2g} ms at most); no permission for a"
    words += f" real-time priority: {'soon enough' if enough else 'too late'} for {rate:g} Hz"
    hint = ""
    if simulated and not enough:
        words += " in real time; a simulated testbed may run slower"
    elif not enough:
        hint = (
            "end other programs, or set scheduling.priority of the nodes that measure"
            " (docs/hardware.md)"
        )
    assert found == Outcome("scheduling", words, hint)


@pytest.mark.parametrize(
    ("good", "readings", "found"),
    [(0, 6, ""), (5, 6, ""), (6, 7, ""), (17, 18, ""), (18, 18, "late"), (99, 18, "late")],
    ids=str,
)
def test_clusters_are_read_until_they_are_well(
    good: int, readings: int, found: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Six times at least, eighteen times at most; `good` is the first reading without a fault."""
    count = iter(range(100))
    asked: list[int] = []

    def read(trigger: float) -> Any:
        asked.append(next(count))
        return SimpleNamespace(faults={} if asked[-1] >= good else {"a": ("late",)})

    reader = SimpleNamespace(identify=lambda: {"a": "chip"}, read=read, close=lambda: None)
    monkeypatch.setattr(doctor, "make_clusters", lambda settings: reader)
    expected = (
        Outcome("cluster a", "late", "see docs/faults.md")
        if found
        else Outcome("cluster a", "chip")
    )
    assert [*doctor.check_clusters(made_testbed())] == [expected]
    assert len(asked) == readings


@pytest.mark.parametrize("line", [-1, 0], ids=["without DRDY", "line 0"])
def test_drdy_has_a_row_where_it_is_wired(line: int, monkeypatch: pytest.MonkeyPatch) -> None:
    converter = SimpleNamespace(
        connect=lambda: SimpleNamespace(description="chip", check_frames=lambda count: 2),
        poll_until=lambda stopped: None,
        counts=lambda: {"conversions": 500, "status_disagrees": 0},
        close=lambda: None,
    )
    cell = SimpleNamespace(converter=converter, health=lambda now: (OK, "converts"))
    monkeypatch.setattr(doctor, "make_load_cell", lambda settings: cell)
    own = made_testbed(load_cell_node=LoadCellSettings(data_ready_line=line))
    wired = [Outcome("load cell DRDY", "500 edges on line 0, STATUS disagrees with 0")]
    assert [*doctor.check_load_cell(own)] == [
        Outcome("load cell", "chip"),
        Outcome(
            "load cell CRC",
            "2 of 1000 frames corrupted",
            "check the wiring and the chip select (docs/faults.md), or lower load_cell_node's"
            " spi_clock",
        ),
        *(wired if line >= 0 else []),
        Outcome("load cell bridges", "converts"),
    ]


def test_a_warning_of_the_stream_is_a_row(
    clock: FakeClock, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The server has three seconds to be well; then the bodies are looked at."""
    moments: list[float] = []

    def sample(moment: float) -> Any:
        moments.append(moment)
        return [SimpleNamespace(fault="")] * 2

    client = capture_by_hand(monkeypatch, clock, sample, rate=240.4, uncertainty=1.234e-5)
    client.health = lambda now: (WARN, "12 datagrams damaged: check the network")
    settings = MocapSettings(server="10.0.0.5", command_port=1511, stale=0.4, pylon_body="leg")
    assert [*doctor.check_motion_capture(made_testbed(tmp_path, mocap_node=settings))] == [
        Outcome("motion capture", "Motive 3.1, 240 Hz, at 10.0.0.5:1511"),
        Outcome("motion capture stream", "12 datagrams damaged", "check the network"),
        Outcome("motion capture clock", "known within 0.01 ms"),
        Outcome("rigid body socket", "its 3 markers are seen"),
        Outcome("rigid body leg", "its 3 markers are seen"),
    ]
    assert clock.now == pytest.approx(103.4, abs=0.06)
    assert moments == [pytest.approx(clock.now - 0.4)]


LATE = SimpleNamespace(fault="no two frames within 0.05 s around the trigger")
SEEN = SimpleNamespace(fault="")


@pytest.mark.parametrize("bad_looks, is_found", [(1, True), (3, True), (1000, False)])
def test_late_frames_do_not_fail_the_bodies(
    bad_looks: int,
    is_found: bool,
    clock: FakeClock,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """A busy network's late frame is no untracked body: the bodies have a second to be seen."""
    looks = 0

    def sample(moment: float) -> Any:
        nonlocal looks
        looks += 1
        return [SEEN, LATE if looks <= bad_looks else SEEN]

    capture_by_hand(monkeypatch, clock, sample, rate=240.0, uncertainty=1e-5)
    settings = MocapSettings(server="10.0.0.5", stale=0.05)
    *_, pylon = doctor.check_motion_capture(made_testbed(tmp_path, mocap_node=settings))
    assert pylon.found == ("its 3 markers are seen" if is_found else LATE.fault)
    assert clock.now == pytest.approx(100.05 + 0.05 * bad_looks if is_found else 101.0, abs=0.06)


# --- the press test

NORMAL = "its normal is the wrong way round: check its channels' order and its calibration"
HINTS: dict[str, tuple[Sequence[float], Sequence[float], str]] = {
    "exchanged": (
        (1, 10, 0, 0),
        (0, -20, 0),
        "exchange the places of brim_lateral and mid_anterior in cluster_node's channels, or their"
        " cables; or press on brim_lateral itself",
    ),
    "reversed": ((-10, 0, 0, 0), (0, -20, 0), NORMAL),
    "sideways": (
        (10, 0, 0, 0),
        (20, 0, 0),
        "check how the load cell is turned, its matrix, and the cluster's place",
    ),
    "too light": (
        (3.9, 0, 0, 0),
        (0, -20, 0),
        "press in its middle with the thumb; if it stays silent: its cable, its calibration",
    ),
    # The cosine of the angle to the normal -y must exceed a half
    "59 degrees": ((10, 0, 0, 0), (8.572, -5.150, 0), ""),
    "61 degrees": (
        (10, 0, 0, 0),
        (8.746, -4.848, 0),
        "check how the load cell is turned, its matrix, and the cluster's place",
    ),
    "119 degrees": (
        (10, 0, 0, 0),
        (8.746, 4.848, 0),
        "check how the load cell is turned, its matrix, and the cluster's place",
    ),
    "121 degrees": (
        (10, 0, 0, 0),
        (8.572, 5.150, 0),
        "check the load cell's signs and matrix",
    ),
    "1 N": ((10, 0, 0, 0), (0, -1.01, 0), ""),
}


def pressed(
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    felt: Sequence[float],
    force: Sequence[float] = (0.0, -20.0, 0.0),
    noise: float = 0.0,
) -> Outcome:
    """Outcome of a press on `brim_lateral` that all clusters feel so [kPa], with its force [N].

    Unloaded readings alternate by `noise` [Pa], their standard deviation.
    """
    asked: list[str] = []
    count = iter(range(10**6))

    @contextmanager
    def readings(own: Any) -> Iterator[Callable[[], np.ndarray]]:
        def read() -> np.ndarray:
            clocks.sleep(0.1)
            if asked[-1] == "let go":
                return np.array([noise * (-1) ** next(count)] * 4 + [0.0] * 3)
            return np.array([*(1e3 * np.array(felt)), *force])

        yield read

    monkeypatch.setattr(doctor, "_readings", readings)
    return next(doctor.press_test(made_testbed(folder), asked.append))


@pytest.mark.parametrize("case", HINTS)
def test_a_press_has_its_whole_hint(
    case: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    felt, force, hint = HINTS[case]
    assert pressed(monkeypatch, tmp_path, felt, force).hint == hint


@pytest.mark.parametrize(
    ("noise", "felt", "answered"),
    [(0.0, 4.1, True), (600.0, 4.7, False), (600.0, 4.9, True), (600.0, -4.9, True)],
    ids=["quiet", "within noise", "above noise", "below noise"],
)
def test_a_press_exceeds_eight_sigmas(
    noise: float, felt: float, answered: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """4 kPa at least; 8 times 600 Pa are 4.8 kPa."""
    found = pressed(monkeypatch, tmp_path, (felt, 0, 0, 0), noise=noise).found
    words = f"brim_lateral felt {felt:+.1f} kPa"
    assert found.startswith(words if answered else "no cluster answered within 20 s")


def test_a_dead_cluster_ends_the_press_test(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    @contextmanager
    def readings(own: Any) -> Iterator[Callable[[], np.ndarray]]:
        yield lambda: np.array([0.0, 0.0, np.nan, np.nan, 0.0, 0.0, 0.0])

    monkeypatch.setattr(doctor, "_readings", readings)
    with pytest.raises(DeviceError) as found:
        next(doctor.press_test(made_testbed(tmp_path), lambda words: None))
    assert str(found.value) == (
        "cluster posterior_distal gives no reading: see what 'doctor' says of it without --press"
    )


@pytest.mark.parametrize(("left", "waited"), [(1.9, 0.4), (2.1, 1.4)], ids=["free", "held"])
def test_the_next_press_waits_for_the_release(
    left: float, waited: float, clock: FakeClock, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """To half of 4 kPa in four readings; the cluster keeps so many kPa for a second."""
    asked: list[tuple[float, str]] = []

    @contextmanager
    def readings(own: Any) -> Iterator[Callable[[], np.ndarray]]:
        def read() -> np.ndarray:
            clocks.sleep(0.1)
            since, words = asked[-1]
            kept = 1e3 * left * (len(asked) > 1 and clock.now - since < 1.05)
            felt = 1e4 if words != "let go" else kept
            return np.array([felt, 0.0, 0.0, 0.0, 0.0, -20.0 * (words != "let go"), 0.0])

        yield read

    monkeypatch.setattr(doctor, "_readings", readings)
    presses = doctor.press_test(
        made_testbed(tmp_path), lambda words: asked.append((clock.now, words))
    )
    next(presses)
    next(presses)
    words = [entry[1] for entry in asked]
    assert words == ["let go", "press on brim_lateral", "let go", "press on mid_anterior"]
    assert asked[1][0] - asked[0][0] == pytest.approx(3.0)  # 1 s, and 20 readings
    assert asked[3][0] - asked[2][0] == pytest.approx(waited)


# Readings of a cluster and a force, `n` for a missing one; the mean of what is kept, or None.
WAITS: dict[str, tuple[str, float | None]] = {
    "the first is in motion": ("9 1 2 3", 2.0),
    "a gap begins again": ("9 1 0 9 4 5 6", 5.0),
    "a late reading is no gap": ("9 1 n 2 3", 2.0),
    "too few": ("9 1 2", None),
}


@pytest.mark.parametrize("case", WAITS)
def test_a_press_is_the_mean_of_three_readings(case: str) -> None:
    """At ten readings a second, for 20 s."""
    words, mean = WAITS[case]
    given = iter([float("nan") if word == "n" else float(word) for word in words.split()])

    def read() -> np.ndarray:
        clocks.sleep(0.1)
        value = next(given, 0.0)
        return np.array([value, value, value, value])

    found = doctor._wait(read, lambda reading: bool(reading[0] > 0.0))
    assert found is None if mean is None else found.tolist() == [mean] * 4


def test_a_press_without_forces_ends(clock: FakeClock) -> None:
    """After 31 readings of the cluster, of which the first does not count."""
    count = iter(range(100))

    def read() -> np.ndarray:
        clocks.sleep(0.1)
        return np.array([1.0 + next(count), np.nan, np.nan, np.nan])

    found = doctor._wait(read, lambda reading: True)
    assert found is not None and found[0] == 16.5 and np.isnan(found[1:]).all()
    assert clock.now == pytest.approx(103.1)
