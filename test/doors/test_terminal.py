"""What `doctor`, `pareto`, `paper` and `validate` print, of findings and results made by hand."""

import functools
import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from support import scene
from support.clocks import FakeClock
from support.natnet import capture_by_hand

from socket_testbed import api, clocks
from socket_testbed.__main__ import run
from socket_testbed.drivers import ERROR, OK, WARN, DeviceBusyError
from socket_testbed.errors import DeviceError
from socket_testbed.geometry.socket import write_socket
from socket_testbed.identification.channel_errors import ChannelErrors
from socket_testbed.identification.paper import beside_published
from socket_testbed.identification.pareto import Front, FrontPoint
from socket_testbed.identification.validation import Judgement
from socket_testbed.live import doctor
from socket_testbed.live.doctor import Outcome
from socket_testbed.settings.acquisition import (
    ClusterSettings,
    LoadCellSettings,
    MocapSettings,
    SchedulingSettings,
    TriggerSettings,
)
from socket_testbed.settings.identification import IdentificationSettings
from socket_testbed.settings.testbed import TestbedSettings
from socket_testbed.trials.metadata import TrialMetadata


class Printed:
    """What a call printed, with runs of blanks as one, and its exit code."""

    def __init__(self, *words: object) -> None:
        out, err = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(err):
            self.code = run([str(word) for word in words])
        self.lines = [" ".join(line.split()) for line in out.getvalue().splitlines()]
        self.error = err.getvalue()


def wrapped(found: Any, name: str) -> Callable[..., Any]:
    """Stands for a function of the API with its options, and returns a result made by hand."""

    @functools.wraps(getattr(api, name))
    def made(*arguments: Any, **options: Any) -> Any:
        return found

    return made


# --- doctor

FINDINGS = [
    Outcome("trigger", "pinctrl-rp1, line 17 to 27, edge within 250 us"),
    Outcome("cluster distal", "no answer at 0x50", "check the cluster's plug"),
    Outcome("load cell", "ADS131M06 on spidev0.0, ID 0x2602"),
]


@pytest.fixture
def examined(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Callable[[Sequence[Outcome]], Printed]:
    def called(findings: Sequence[Outcome]) -> Printed:
        monkeypatch.setattr("socket_testbed.commands.live.examine", lambda testbed: findings)
        monkeypatch.setattr(
            "socket_testbed.commands.live.configured", lambda *_, **__: make_testbed()
        )
        return Printed("doctor")

    return called


def test_a_finding_with_a_hint_has_failed(examined: Callable[..., Printed]) -> None:
    printed = examined(FINDINGS)
    assert printed.lines[0] == "what found hint"
    assert printed.lines[2:] == [
        "trigger ok pinctrl-rp1, line 17 to 27, edge within 250 us",
        "cluster distal failed no answer at 0x50 check the cluster's plug",
        "load cell ok ADS131M06 on spidev0.0, ID 0x2602",
    ]
    assert printed.code == 1 and "1 of 3 checks failed: see the table's hints" in printed.error


def test_without_a_hint_all_is_well(examined: Callable[..., Printed]) -> None:
    printed = examined([FINDINGS[0], FINDINGS[2]])
    assert printed.code == 0 and printed.error == ""


USER = DeviceBusyError("i2c-1", "process 4711, socket-testbed run")
STATES = {
    "trigger_node": (0, "triggering at 4 Hz"),
    "cluster_node": (2, "no answer at 0x50 on i2c-1: check the cluster's plug"),
    "load_cell_node": (0, "spidev0.0 converts"),
}


@pytest.fixture
def next_to(monkeypatch: pytest.MonkeyPatch) -> Callable[[dict[str, Any]], Printed]:
    """`doctor` beside a testbed whose nodes report some states."""
    kernel = Outcome("kernel", "6.12.1 on a computer")
    for check in ("check_kernel", "check_scheduling"):
        found = [kernel] if check == "check_kernel" else []
        monkeypatch.setattr(doctor, check, lambda testbed, found=found: found)

    def called(states: dict[str, Any], *arguments: str) -> Printed:
        commands = "socket_testbed.commands.live"
        monkeypatch.setattr(f"{commands}.find_user", lambda settings: USER)
        monkeypatch.setattr(f"{commands}.configured", lambda *_, **__: make_testbed())
        monkeypatch.setattr(
            "socket_testbed.nodes.controls.reported_states", lambda nodes, namespace: states
        )
        return Printed("doctor", *arguments)

    return called


def test_doctor_beside_a_testbed_asks_it(next_to: Callable[..., Printed]) -> None:
    printed = next_to(STATES)
    assert printed.lines[2:] == [
        "kernel ok 6.12.1 on a computer",
        "devices ok another program uses i2c-1 (process 4711, socket-testbed run):"
        " its own reports follow",
        "trigger ok triggering at 4 Hz",
        "clusters failed no answer at 0x50 on i2c-1 check the cluster's plug",
        "load cell ok spidev0.0 converts",
        "motion capture failed no report from mocap_node of the running testbed"
        " end the other program, then call 'doctor' again",
    ]
    assert printed.code == 1


def test_doctor_beside_a_silent_program_names_it(next_to: Callable[..., Printed]) -> None:
    printed = next_to({})
    assert printed.lines[3:] == [
        "devices failed another program uses i2c-1 (process 4711, socket-testbed run)"
        " end it first (Ctrl-C, or systemctl stop if it is a service)"
    ]
    assert printed.code == 1


def test_presses_beside_a_testbed_are_refused(next_to: Callable[..., Printed]) -> None:
    printed = next_to(STATES, "--press")
    assert printed.code == 1 and "another program uses i2c-1 (process 4711" in printed.error


def test_an_error_ends_its_check_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def check_load_cell(testbed: Any) -> Iterator[Outcome]:
        yield FINDINGS[2]
        raise DeviceError("no answer", "plug it in")

    def check_trigger(testbed: Any) -> Iterator[Outcome]:
        yield FINDINGS[0]

    monkeypatch.setattr(doctor, "CHECKS", (check_load_cell, check_trigger))
    testbed: Any = SimpleNamespace(settings=TestbedSettings())
    assert doctor.examine(testbed) == [
        FINDINGS[2],
        Outcome("load cell", "no answer", "plug it in"),
        FINDINGS[0],
    ]


@pytest.mark.parametrize(
    ("release", "sound"),
    [("6.6.20-v8", False), ("6.6.28-v8", True), ("6.12.1", True), ("5.15.84", False)],
    ids=str,
)
def test_a_pi_5_s_old_kernel_is_named(release: str, sound: bool) -> None:
    found = doctor.kernel_finding("Raspberry Pi 5 Model B Rev 1.0", release)
    assert found.what == "kernel" and bool(found.hint) is not sound
    assert found.hint in ("", "update it to 6.6.28 or newer")
    assert not doctor.kernel_finding("Raspberry Pi 4 Model B", release).hint


def make_testbed(**settings: Any) -> Any:
    """A testbed with some nodes' settings, on hardware."""
    nodes = {
        "trigger_node": TriggerSettings(source="gpio", rate=50.0),
        "load_cell_node": LoadCellSettings(data_ready_line=22),
        "cluster_node": ClusterSettings(),
        "mocap_node": MocapSettings(server="10.0.0.5"),
    }
    settings = replace(TestbedSettings(), **{**nodes, **settings})
    return SimpleNamespace(settings=settings, simulation=None, namespace="/")


def only(found: Iterator[Outcome]) -> Outcome:
    (outcome,) = found
    return outcome


def test_the_trigger_s_longest_delay_is_in_microseconds(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = FakeClock(100.0).install(monkeypatch)
    delays = iter([1e-4, 2.5e-4, 2e-4, 1e-4, 5e-5])
    trigger = SimpleNamespace(
        fire=lambda: clock.now + next(delays), end_pulse=lambda: None, close=lambda: None
    )
    monkeypatch.setattr(doctor, "make_trigger", lambda settings: trigger)
    found = only(doctor.check_trigger(make_testbed()))
    assert found == Outcome("trigger", "pinctrl-rp1, line 17 to 27, edge within 250 us")


# Lateness in ms, of an ordinary and an urgent thread: the most of 200, and one of them
LATE = {
    "soon": (1.0, 5.0, 0.1, "soon enough", "1 ms late (p99; 5 ms at most)"),
    "late": (4.0, 9.0, 0.1, "too late", "4 ms late (p99; 9 ms at most)"),
}


@pytest.mark.parametrize("case", LATE)
def test_lateness_is_in_milliseconds(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """3 ms are tolerated; no real-time priority is set, so that of an ordinary thread counts."""
    usual, worst, urgent, verdict, words = LATE[case]

    def lateness(priority: int = 0) -> np.ndarray:
        late = np.full(200, urgent if priority else usual)
        late[7] = urgent if priority else worst
        return 1e-3 * late

    monkeypatch.setattr(doctor, "measure_lateness", lateness)
    found = only(doctor.check_scheduling(make_testbed()))
    assert found.found == (
        f"threads wake up {words}, with real-time priority 10 0.1 ms late (p99; 0.1 ms at most):"
        f" {verdict} for 50 Hz"
    )
    assert bool(found.hint) is (verdict == "too late")


# Steps in ms between 101 threads that wake up ever later; the 99th of 100 counts, and 3 ms suffice
SPREAD = {
    "soon": (0.03, "soon enough", "3 ms late (p99; 3 ms at most)"),
    "sooner": (0.01, "soon enough", "0.99 ms late (p99; 1 ms at most)"),
    "late in a hundredth": (0.031, "too late", "3.1 ms late (p99; 3.1 ms at most)"),
    "late in a half": (0.08, "too late", "7.9 ms late (p99; 8 ms at most)"),
}


@pytest.mark.parametrize("case", SPREAD)
def test_the_latest_hundredth_judges_lateness(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    step, verdict, words = SPREAD[case]

    def lateness(priority: int = 0) -> np.ndarray:
        return 1e-3 * (0.02 if priority else step) * np.arange(101)

    monkeypatch.setattr(doctor, "measure_lateness", lateness)
    found = only(doctor.check_scheduling(make_testbed()))
    assert found.found == (
        f"threads wake up {words}, with real-time priority 10 2 ms late (p99; 2 ms at most):"
        f" {verdict} for 50 Hz"
    )


@pytest.mark.parametrize("permitted", [True, False], ids=["permitted", "refused"])
def test_a_priority_that_is_set_counts(permitted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """An ordinary thread is 4 ms late, too late."""

    def lateness(priority: int = 0) -> np.ndarray:
        assert priority in (0, 20)
        return np.full(100, 1e-4 if priority else 4e-3)[: 100 if permitted or not priority else 0]

    monkeypatch.setattr(doctor, "measure_lateness", lateness)
    settings = TriggerSettings(rate=50.0, scheduling=SchedulingSettings(priority=20))
    found = only(doctor.check_scheduling(make_testbed(trigger_node=settings)))
    end = "0.1 ms at most): soon enough" if permitted else "priority: too late"
    assert found.found.endswith(f"{end} for 50 Hz") and bool(found.hint) is not permitted
    assert ("no permission for a real-time priority" in found.found) is not permitted


def test_chips_and_faults_of_clusters_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    FakeClock(100.0).install(monkeypatch)
    chips: dict[str, Any] = {
        "a": "FDC1004 at 0x50 on i2c-1",
        "b": DeviceError("no answer", "its plug"),
        "c": "FDC1004 at 0x50 on i2c-3",
    }
    faults = {"c": ("input 3 is out of range: check its sensor",)}
    reader = SimpleNamespace(
        identify=lambda: chips,
        read=lambda trigger: SimpleNamespace(faults=faults),
        close=lambda: None,
    )
    monkeypatch.setattr(doctor, "make_clusters", lambda settings: reader)
    assert [*doctor.check_clusters(make_testbed())] == [
        Outcome("cluster a", "FDC1004 at 0x50 on i2c-1"),
        Outcome("cluster b", "no answer", "its plug"),
        Outcome("cluster c", "input 3 is out of range", "check its sensor"),
    ]


@pytest.mark.parametrize("corrupted", [0, 3], ids=["intact", "corrupted"])
@pytest.mark.parametrize("level", [OK, WARN], ids=["fine", "near"])
def test_the_load_cell_s_frames_are_counted(
    corrupted: int, level: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    FakeClock(100.0).install(monkeypatch)
    chip = SimpleNamespace(description="ADS131M06", check_frames=lambda count: corrupted)
    converter = SimpleNamespace(
        connect=lambda: chip,
        poll_until=lambda stopped: None,
        counts=lambda: {"conversions": 500, "status_disagrees": 2},
        close=lambda: None,
    )
    words = "Fx is above 80 %: do not load it further" if level else "spidev0.0 converts"
    cell = SimpleNamespace(converter=converter, health=lambda now: (level, words))
    monkeypatch.setattr(doctor, "make_load_cell", lambda settings: cell)
    chip_row, crc, line, bridges = doctor.check_load_cell(make_testbed())
    assert chip_row == Outcome("load cell", "ADS131M06")
    assert crc.found == f"{corrupted} of 1000 frames corrupted" and bool(crc.hint) == bool(
        corrupted
    )
    assert line == Outcome("load cell DRDY", "500 edges on line 22, STATUS disagrees with 2")
    expected = ("Fx is above 80 %", "do not load it further") if level else (words, "")
    assert bridges == Outcome("load cell bridges", *expected)


def test_motion_capture_is_in_hertz_and_milliseconds(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    clock = FakeClock(100.0)
    clock.install(monkeypatch)
    bodies = [SimpleNamespace(fault=""), SimpleNamespace(fault="marker 2 is hidden: look for it")]
    client = capture_by_hand(
        monkeypatch, clock, lambda moment: bodies, rate=119.9, uncertainty=4.5e-4
    )
    write_socket(scene.geometry(), tmp_path / "socket.yaml")
    testbed = make_testbed()
    testbed.geometry = tmp_path / "socket.yaml"
    assert [*doctor.check_motion_capture(testbed)] == [
        Outcome("motion capture", "Motive 3.1, 120 Hz, at 10.0.0.5:1510"),
        Outcome("motion capture clock", "known within 0.45 ms"),
        Outcome("rigid body socket", "its 3 markers are seen"),
        Outcome("rigid body pylon", "marker 2 is hidden", "look for it"),
    ]
    client.health = lambda now: (ERROR, "no server answers: check the network")
    assert [*doctor.check_motion_capture(testbed)] == [
        Outcome("motion capture", "no server answers", "check the network")
    ]


# A press on `brim_lateral`, on the right wall, whose outward normal is -y: what every cluster feels
# [kPa], the force on the load cell [N], and what is found with the start of its hint
NAMES = ("brim_lateral", "mid_anterior", "posterior_distal", "distal")
PRESSES: dict[str, tuple[Sequence[float], Sequence[float], str, str]] = {
    "as it should": (
        *((12.34, 1, 0, 0), (0, -20, 0)),
        *("brim_lateral felt +12.3 kPa, the load cell 20.0 N", ""),
    ),
    "exchanged": (
        *((1, 10, 0, 0), (0, -20, 0), "mid_anterior felt +10.0 kPa"),
        "exchange the places of brim_lateral and mid_anterior",
    ),
    "reversed": (
        *((-10, 0, 0, 0), (0, -20, 0), "brim_lateral felt -10.0 kPa"),
        "its normal is the wrong way round",
    ),
    "no force": (
        *((10, 0, 0, 0), (0, -0.9, 0), "brim_lateral felt +10.0 kPa, the load cell felt nothing"),
        "check the load cell's wiring",
    ),
    "reversed force": (
        *((10, 0, 0, 0), (0, 20, 0)),
        "brim_lateral felt +10.0 kPa, the load cell 20.0 N the other way",
        "check the load cell's signs and matrix",
    ),
    "sideways": (
        *((10, 0, 0, 0), (20, 0, 0)),
        "brim_lateral felt +10.0 kPa, the load cell 20.0 N in another direction",
        "check how the load cell is turned",
    ),
    "too light": (
        *((3.9, 0, 0, 0), (0, -20, 0), "no cluster answered within 20 s"),
        "press in its middle",
    ),
}


def pressed(
    monkeypatch: pytest.MonkeyPatch, folder: Path, felt: Sequence[float], force: Sequence[float]
) -> tuple[list[Outcome], list[str]]:
    """Outcomes of presses that all feel like this, and what was asked for."""
    FakeClock(100.0).install(monkeypatch)
    asked: list[str] = []

    @contextmanager
    def readings(testbed: Any) -> Iterator[Callable[[], np.ndarray]]:
        unloaded = np.array([500.0, -300.0, 100.0, 0.0, 1.0, 2.0, -3.0])

        def read() -> np.ndarray:
            clocks.sleep(0.1)
            load = np.array([*(1e3 * np.array(felt)), *force])
            return unloaded + load * (asked[-1] != "let go")

        yield read

    monkeypatch.setattr(doctor, "_readings", readings)
    write_socket(scene.geometry(), folder / "socket.yaml")
    testbed = make_testbed(cluster_node=ClusterSettings(names=NAMES))
    testbed.geometry = folder / "socket.yaml"
    return [*doctor.press_test(testbed, asked.append)], asked


@pytest.mark.parametrize("case", PRESSES)
def test_a_press_is_judged(case: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    felt, force, found, hint = PRESSES[case]
    outcomes, asked = pressed(monkeypatch, tmp_path, felt, force)
    assert outcomes[0].what == "press on brim_lateral"
    assert outcomes[0].found == found
    assert outcomes[0].hint.startswith(hint) and bool(outcomes[0].hint) == bool(hint)
    assert asked[:2] == ["let go", "press on brim_lateral"]
    assert [each.what for each in outcomes] == [f"press on {name}" for name in NAMES]


@pytest.mark.parametrize(
    ("number", "outward"),
    [(0, (0, -1, 0)), (1, (1, 0, 0)), (2, (-1, 0, 0)), (3, (0, 0, -1))],
    ids=NAMES,
)
@pytest.mark.parametrize(("sign", "right"), [(1, True), (-1, False)], ids=["outwards", "inwards"])
def test_every_cluster_is_pressed_outwards(
    number: int,
    outward: Sequence[int],
    sign: int,
    right: bool,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """On the distal end outwards is down."""
    felt = 10.0 * np.eye(4)[number]
    force = 20.0 * sign * np.array(outward)
    outcomes, _ = pressed(monkeypatch, tmp_path, felt, force)
    assert (outcomes[number].hint == "") is right


# --- pareto

FRONT_LINES = (
    "scene: all 0.00 s to 23.75 s, theta from 0 to 1 in 7 values",
    "variant solution theta [-] wrench error [-] local error [-] mean moment RMSE [N m]"
    " mean force RMSE [N] median local RMSE [N] remark",
    "stiffness sensor-only 0 0.8000 0.1000 0.900 9.000 1.000",
    "stiffness knee 0.5 0.2000 0.1500 0.500 5.000 4.000",
    "stiffness wrench-only 1 0.1000 0.9000 0.200 2.000 7.000",
    "stiffness_bias sensor-only 0 0.5000 0.5000 0.400 4.000 2.000 dominated",
    "stiffness_bias knee - - - - - - none",
    "stiffness_bias wrench-only - - - - - - not certified",
    # 1 - (0.1 / 0.7 + 0.05 / 0.8) = 0.795
    "stiffness: knee of depth 0.79: the front spans 0.7 by 0.8",
    "3 of 7 solutions not dominated, largest KKT residual or gap 2.0e-08",
    "left out: 2 at theta 0.8 to 0.9: open",
    "left out: 1 at theta 0.95: stuck",
    "stiffness_bias: no knee: the front spans 0.1 by 0.1 and is straight",
    "2 of 4 solutions not dominated, largest KKT residual or gap 3.0e-09",
    "left out: 1 at theta 1: not certified",
)


def point(
    theta: float, wrench: float, local: float, moment: float, median: float, **others: Any
) -> FrontPoint:
    """A solution whose forces are off by ten times as much as its moments."""
    return FrontPoint(
        theta=theta,
        residual=others.get("residual", 1e-9),
        rmse=np.array([moment, median]),
        flaw=others.get("flaw", ""),
        wrench_error=wrench,
        local_error=local,
        mean_moment_rmse=moment,
        mean_force_rmse=10.0 * moment,
        median_local_rmse=median,
    )


def fronts() -> dict[Any, Front]:
    """One with a knee and a dominated solution at 0.25; one that is straight, its start worse."""
    channels = ("Mx", "distal.Fz")
    first = [
        point(0.0, 0.8, 0.1, 0.9, 1.0),
        point(0.25, 0.9, 0.5, 0.8, 2.0),
        point(0.5, 0.2, 0.15, 0.5, 4.0, residual=2e-8),
        point(0.8, 0.15, 0.6, 0.4, 5.0, flaw="open", residual=1.0),
        point(0.9, 0.12, 0.7, 0.3, 6.0, flaw="open"),
        point(0.95, 0.11, 0.8, 0.3, 6.0, flaw="stuck"),
        point(1.0, 0.1, 0.9, 0.2, 7.0),
    ]
    second = [
        point(0.0, 0.5, 0.5, 0.4, 2.0, residual=3e-9),
        point(0.4, 0.5, 0.4, 0.3, 2.0),
        point(0.5, 0.4, 0.5, 0.3, 2.0),
        point(1.0, 0.3, 0.7, 0.1, 2.0, flaw="not certified"),
    ]
    return {
        "stiffness": Front("stiffness", channels, first),
        "stiffness_bias": Front("stiffness_bias", channels, second),
    }


@pytest.fixture(scope="module")
def traded(trial) -> api.Tradeoff:
    return api.Tradeoff(trial, trial.select("all"), fronts())


@pytest.fixture(scope="module")
def front_lines(traded: api.Tradeoff, scene_folder: Path) -> list[str]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(api, "pareto", wrapped(traded, "pareto"))
        printed = Printed("pareto", scene_folder, "--segment", "all")
    assert printed.code == 0, printed.error
    return printed.lines


@pytest.mark.parametrize("line", FRONT_LINES, ids=range(len(FRONT_LINES)))
def test_pareto_prints_the_known_fronts(line: str, front_lines: list[str]) -> None:
    assert line in front_lines


def test_the_front_s_table_marks_its_solutions(traded: api.Tradeoff) -> None:
    table = traded.to_dataframe()
    own = table[table["variant"] == "stiffness"]
    assert own["mark"].tolist() == ["sensor-only", "", "knee", "", "", "", "wrench-only"]
    assert own["non-dominated"].tolist() == [1, 0, 1, 0, 0, 0, 1]
    row = own.iloc[2]
    assert (row["theta [-]"], row["wrench error [-]"], row["local error [-]"]) == (0.5, 0.2, 0.15)
    assert (row["RMSE Mx [N m]"], row["RMSE distal.Fz [N]"]) == (0.5, 4.0)
    assert row["KKT residual or gap [-]"] == 2e-8
    assert own["flaw"].iloc[5] == "stuck"


def test_the_front_s_document_has_its_knee(traded: api.Tradeoff) -> None:
    first, second = traded.document()["fronts"]
    assert first["knee"]["theta"] == 0.5
    assert first["knee"]["depth"] == pytest.approx(0.794643, abs=1e-6)
    assert first["knee"]["span"] == pytest.approx([0.7, 0.8])
    assert (first["non_dominated"], first["worst_residual"]) == (3, 2e-8)
    assert second["knee"]["theta"] is None
    assert second["solutions"][3]["flaw"] == "not certified"
    assert first["marks"]["wrench-only"]["local_error"] == 0.9


# --- paper

CHANNELS = ("Mx", "My", "Mz", "Fx", "Fy", "Fz", "distal.Fx", "distal.Fy", "distal.Fz")


def errors(factor: float) -> list[ChannelErrors]:
    """RMSE of 1 to 9 times a factor, sigma of a quarter of it; distal.Fx is left out."""
    return [
        ChannelErrors(
            name=name,
            unit="N m" if name[0] == "M" else "N",
            rmse=factor * number,
            mae=0.5 * factor * number,
            sigma=0.25 * factor * number,
            skill=0.1,
            samples=96,
            in_objective=name != "distal.Fx",
        )
        for number, name in enumerate(CHANNELS, start=1)
    ]


ALONE = "not printed in the paper"
WEIGHTS = "weights size, raw in the paper"
PAPER_LINES = (
    "scene: all 0.00 s to 23.75 s, 96 samples",
    "theta 0.7, weights size; rest positions within 8 mm of the mean limb position; k0 3000 N/m,"
    " alpha 2000 1/m",
    "figure without offsets with offsets paper: without offsets paper: with offsets remark",
    # moments 1, 2, 3; forces 4, 5, 6; 8 and 9 of the clusters' channels in the objective
    "mean moment RMSE [N m] 2.000 0.200 1.690 0.440 not comparable: load of 200 N, about 300 N;"
    f" 96 samples, 1000; {WEIGHTS}",
    "mean force RMSE [N] 5.000 0.500 5.940 5.250 not comparable: load of 200 N, about 300 N; 96"
    f" samples, 1000; {WEIGHTS}",
    "median local RMSE [N] 8.500 0.850 90.070 3.760 not comparable: load of 200 N, about 300 N; 96"
    " samples, 1000; weights size, raw; 2 of 3 channels counted, 9 in the paper",
    "RMSE of Mx [N m] 1.000 0.100 3.990 0.950 not comparable: load of 200 N, about 300 N; 96"
    f" samples, 1000; {WEIGHTS}",
    "RMSE of Fz [N] 6.000 0.600 7.850 8.030 not comparable: load of 200 N, about 300 N; 96"
    f" samples, 1000; {WEIGHTS}",
    "RMSE of Mz [N m] 3.000 0.300 - 0.250 not comparable: load of 200 N, about 300 N; 96"
    f" samples, 1000; {WEIGHTS}; {ALONE} without offsets",
    f"RMSE of Fx [N] 4.000 0.400 - - {ALONE}",
    f"RMSE of distal.Fy [N] 8.000 0.800 - - {ALONE}: left out of its objective",
    "RMSE of distal.Fx [N] 7.000 0.700 - - not comparable: left out of the objective",
    f"sigma of My [N m] 0.500 0.050 - - {ALONE}",
    f"sigma of Fz [N] 1.500 0.150 - - {ALONE}",
    f"theta, sensor-only [-] 0.000 0.000 - - {ALONE}",
    f"theta, knee [-] 0.500 - - - {ALONE}",
    f"theta, wrench-only [-] 1.000 - - - {ALONE}",
    "load [N] 200.000 200.000 300.000 300.000 about, in the paper",
    "mass of the pylon [kg] - - 9.300 9.300 not known from a trial",
    "duration of the hold [min] - - 10.000 10.000 not known from a trial",
    "samples [1] 96.000 96.000 1000.000 1000.000",
    "cluster channels left out [1] 1.000 1.000 3.000 3.000",
)
FITTED = IdentificationSettings(theta=0.7, leave_out=("distal.Fx",))


def beside(trial: Any, load: float, settings: IdentificationSettings, swing: float = 0.0) -> Any:
    """The paper's table for the scene under a load along -z that swings."""
    samples = trial.samples()
    wrench = np.zeros_like(samples.wrench)
    wrench[:, 5] = -load + swing * np.where(np.arange(96) % 2, 1.0, -1.0)
    made = {"stiffness": errors(1.0), "stiffness_bias": errors(0.1)}
    return beside_published(
        made, fronts(), replace(samples, wrench=wrench), settings, trial.geometry
    )


@pytest.fixture(scope="module")
def paper_lines(trial, scene_folder: Path) -> list[str]:
    segment = trial.select("all")
    found = api.PaperTable(trial, segment, 96, FITTED, beside(trial, 200.0, FITTED))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(api, "paper", wrapped(found, "paper"))
        printed = Printed("paper", scene_folder, "--segment", "all")
    assert printed.code == 0, printed.error
    return printed.lines


@pytest.mark.parametrize("line", PAPER_LINES, ids=range(len(PAPER_LINES)))
def test_paper_prints_the_known_figures(line: str, paper_lines: list[str]) -> None:
    assert line in paper_lines


@pytest.mark.parametrize(
    ("load", "swing", "remark"),
    [
        (300.0, 0.0, f"not comparable: 96 samples, 1000; {WEIGHTS}"),
        (241.0, 0.0, f"not comparable: 96 samples, 1000; {WEIGHTS}"),
        (365.0, 0.0, f"not comparable: load of 365 N, about 300 N; 96 samples, 1000; {WEIGHTS}"),
        (
            *(300.0, 11.0),
            f"not comparable: load that varies by 11 N, a hold; 96 samples, 1000; {WEIGHTS}",
        ),
    ],
    ids=["same", "a fifth less", "more", "swinging"],
)
def test_other_conditions_are_named(load: float, swing: float, remark: str, trial) -> None:
    table = beside(trial, load, FITTED, swing)
    assert table.loc["RMSE of Mx [N m]", ("", "remark")] == remark


def test_the_paper_s_own_weights_are_no_difference(trial) -> None:
    table = beside(trial, 300.0, IdentificationSettings(weights="raw"))
    remark = "not comparable: 96 samples, 1000 in the paper"
    assert table.loc["mean force RMSE [N]", ("", "remark")] == remark


# --- validate


def judged(question: Any, predictor: str, test: Any, trial: str, **figures: Any) -> Judgement:
    return Judgement(question, predictor, test, "hold", trial, samples=90, **figures)


JUDGEMENTS = (
    judged("cluster", "force map", "left out", "a", error=0.3, coverage=(0.42, 0.78, 0.95)),
    judged("cluster", "force map", "left out", "b", error=0.6, coverage=(0.50, 0.80, 0.91)),
    judged("cluster", "inverse distance", "left out", "a", error=0.5),
    judged("cluster", "inverse distance", "left out", "b", error=0.8),
    # a single cluster's is no row of its own
    judged("cluster", "force map", "left out", "b", cluster="distal", error=9.0),
    judged(
        *("wrench", "rigid_bias", "second half", "a"),
        **{"moment_rmse": 1.0, "force_rmse": 20.0, "moment_skill": 0.75, "force_skill": 0.5},
    ),
    judged(
        *("wrench", "rigid_bias", "second half", "b"),
        **{"moment_rmse": 2.0, "force_rmse": 50.0, "moment_skill": 0.25, "force_skill": -0.3},
    ),
    judged(
        *("wrench", "best constant", "second half", "a"),
        **{"moment_rmse": 4.0, "force_rmse": 40.0, "moment_skill": 0.0, "force_skill": 0.0},
    ),
)
VALIDATED = (
    "2 trials, means over them; models fitted on 1: a",
    "Force on a left-out cluster, from the others and the wrench",
    "predictor error [-] worst error [-] in 50 % [%] in 80 % [%] in 95 % [%] judged [1]",
    "force map 0.45 0.60 46 79 93 2",
    "inverse distance 0.65 0.80 - - - 2",
    "Wrench from the pose alone, fitted on the other half of the trial",
    "predictor moment RMSE [N m] force RMSE [N] median moment skill [-] median force skill [-]"
    " judged [1]",
    "rigid_bias 1.500 35.00 0.50 0.10 2",
    "best constant 4.000 40.00 0.00 0.00 1",
)


def validated(*names: str) -> api.Validation:
    chosen = tuple(each for each in JUDGEMENTS if each.tested_on in names)
    metadata = tuple(TrialMetadata(subject=f"S-{name}") for name in names)
    return api.Validation(names, ("a",), chosen, metadata)


@pytest.fixture(scope="module")
def validation_lines(scene_folder: Path) -> dict[int, list[str]]:
    """Lines by the number of trials."""
    found = {}
    for names in (("a",), ("a", "b")):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(api, "validate", wrapped(validated(*names), "validate"))
            printed = Printed("validate", scene_folder)
        assert printed.code == 0, printed.error
        found[len(names)] = printed.lines
    return found


@pytest.mark.parametrize("line", VALIDATED, ids=range(len(VALIDATED)))
def test_validate_prints_the_known_means(line: str, validation_lines: dict[int, list[str]]) -> None:
    assert line in validation_lines[2]


def test_one_trial_has_its_own_figures(validation_lines: dict[int, list[str]]) -> None:
    lines = validation_lines[1]
    assert lines[0] == "a: the part under load, in two halves"
    assert "force map 0.30 42 78 95" in lines
    assert "predictor moment RMSE [N m] force RMSE [N] moment skill [-] force skill [-]" in lines
    assert "rigid_bias 1.000 20.00 0.75 0.50" in lines


def test_a_single_bad_trial_spoils_no_median_skill(
    monkeypatch: pytest.MonkeyPatch, scene_folder: Path
) -> None:
    """Skills of 0.75, 0.25 and -8, and of 0.5, -0.3 and -4; of RMSE the means."""
    bad = judged(
        *("wrench", "rigid_bias", "second half", "c"),
        **{"moment_rmse": 6.0, "force_rmse": 20.0, "moment_skill": -8.0, "force_skill": -4.0},
    )
    own = [each for each in JUDGEMENTS if each.predictor == "rigid_bias"]
    metadata = tuple(TrialMetadata(subject=f"S-{name}") for name in "abc")
    found = api.Validation(("a", "b", "c"), ("a",), (*own, bad), metadata)
    monkeypatch.setattr(api, "validate", wrapped(found, "validate"))
    assert "rigid_bias 3.000 30.00 0.25 -0.30" in Printed("validate", scene_folder).lines


def test_a_study_has_a_row_per_trial() -> None:
    table = validated("a", "b").by_trial()
    assert [*table.index] == ["a", "b"] and table["subject"].tolist() == ["S-a", "S-b"]
    row = table.loc["b"]
    assert row["cluster, left out: force map error [-]"] == 0.6
    assert row["cluster, left out: force map within 95 % [-]"] == 0.91
    assert row["wrench, second half: rigid_bias force skill [-]"] == -0.3
    assert row["wrench, second half: rigid_bias moment RMSE [N m]"] == 2.0
    assert pd.isna(table.loc["b", "wrench, second half: best constant force RMSE [N]"])
