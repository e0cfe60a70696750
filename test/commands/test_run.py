"""`run` and `doctor` as a user calls them, on simulated hardware and on a machine without any."""

import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support import CHECKOUT, HANGS
from support.clocks import careful_time_scale
from support.graph import Probe
from support.testbeds import Recorded, simulated_parameters
from support.verbs import COMMAND, Running, call, program, refused

from socket_testbed import clocks
from socket_testbed.commands import live
from socket_testbed.live import doctor
from socket_testbed.live.scheduling import MachineSpeed
from socket_testbed.nodes import controls
from socket_testbed.settings.testbed import read_testbed
from socket_testbed.trials.metadata import TrialMetadata
from socket_testbed.trials.trial import Trial
from socket_testbed.wire import topics
from socket_testbed.wire.cdr import stamp_of

pytestmark = pytest.mark.graph

SIMULATED = ("--simulated", "--time-scale", "0.25")  # slow enough for a busy machine


def start(*words: object, folder: Path) -> Running:
    call = [*COMMAND, "run", *SIMULATED, "--rate", "20", *map(str, words)]
    return Running(call, cwd=folder, stdout=subprocess.PIPE, text=True)


def interrupt(process: Running) -> str:
    """What a run prints that Ctrl-C ends."""
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=HANGS)
    assert process.returncode == 0
    return out


def test_run_records_until_ctrl_c(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "trial"
    words = ["--record", path, "--variant", "stiffness", "--subject", "S01", "--side", "left"]
    with Probe() as probe, start(*words, folder=tmp_path) as process:
        measured = [probe.listen(topic) for topic in topics.REQUIRED]
        triggers = probe.listen(topics.TRIGGER)
        probe.wait(lambda: all(len(messages) > 2 for messages in measured), "measurements")
        before = stamp_of(triggers[-1])
        code, marked, _ = call(capfd, "mark", "step 2")
        assert code == 0 and marked.startswith("marked 'step 2' in the trial trial, ack")
        goal = len(triggers) + 1  # the newest may be older than the event: time is slow
        probe.wait(lambda: len(triggers) > goal, "triggers after it")
        after = stamp_of(triggers[-1])
        out = interrupt(process)
    trial = Trial(path)
    samples = trial.samples()
    assert out.startswith(f"{path}: {len(samples)} triggers, ") and out.count("\n") == 1
    recorded = Recorded(path)
    assert not recorded.notes and not any(recorded.lacking().values())
    (step,) = (event for event in trial.events() if event.source == "recorded")
    begin = int(samples.stamps[0])
    # A message that a busy machine held up is late, never early.
    assert 1e-9 * (before - begin) - 0.3 < step.time < 1e-9 * (after - begin)
    assert trial.metadata == TrialMetadata("S01", "left")
    assert trial.estimator.identification.variant == "stiffness"
    assert read_testbed(path / "testbed.yaml").trigger_node.rate == 20.0


@pytest.mark.parametrize("verb", [pytest.param("run", marks=pytest.mark.slow), "record"])
def test_a_trial_that_went_away_is_named(verb: str, tmp_path: Path) -> None:
    """As after a disk was unplugged and unmounted: its folder is not there any more."""
    path = tmp_path / "disk" / "trial"
    path.parent.mkdir()
    words = ["run", *SIMULATED, "--record"] if verb == "run" else ["record"]
    call = [*COMMAND, *words, str(path)]
    with Probe() as probe, Running(call, stderr=subprocess.PIPE, text=True) as process:
        said = probe.listen(topics.RECORDED_TRIAL)
        measured = probe.listen(topics.WRENCH)
        probe.wait(lambda: bool(said) and said[-1].data == "trial", "the recording")
        if verb == "run":
            probe.wait(lambda: len(measured) > 2, "measurements")
        shutil.rmtree(path.parent)
        gone = "is gone (No such file or directory): check that its disk is connected"
        probe.wait(lambda: bool(probe.said("recorder_node", gone)), "the recorder's word")
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=HANGS)
    assert process.returncode == 1 and "Traceback" not in err
    assert err.splitlines()[-1] == (
        f"socket-testbed {verb}: error: {path}: is not there: read the recorder's messages; if it"
        " recorded, connect the trial's disk again, or look where the trial was moved to"
    )


SLOWER = "this machine is busy: the simulated testbed runs at {}\n"


@pytest.mark.parametrize(
    ("lateness", "speed", "scale", "said"),
    [
        (0.0, 5.0, 1.0, ""),
        (1e-4, 0.1, 0.5, SLOWER.format("half of real time")),
        (0.1, 0.001, 0.0625, SLOWER.format("a sixteenth of real time")),
    ],
    ids=["idle", "busy", "very busy"],
)
def test_a_busy_machine_gets_a_slower_testbed(
    lateness: float, speed: float, scale: float, said: str, monkeypatch, capsys
) -> None:
    monkeypatch.setattr(live, "measure_speed", lambda: MachineSpeed(lateness, speed))
    assert (live._time_scale("auto"), capsys.readouterr().err) == (scale, said)


@pytest.mark.slow
def test_the_readme_s_subscriber_hears_the_map(tmp_path: Path) -> None:
    """At once: there is no model yet."""
    code = (CHECKOUT / "README.md").read_text().partition("```python\nimport rclpy")[2]
    program = "import rclpy" + code.partition("```")[0]
    call = [sys.executable, "-u", "-c", program]
    with (
        start(folder=tmp_path),
        Running(call, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as subscriber,
    ):
        assert subscriber.stdout is not None
        line = subscriber.stdout.readline()
    assert re.fullmatch(r"\w+: \d+\.\d kPa( -?\d+\.\d){3} N\n", line.replace(",", "")), line


@pytest.mark.slow
def test_the_page_s_button_records(tmp_path: Path) -> None:
    """Without `--record`, and at whatever speed."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        page = f"http://127.0.0.1:{free.getsockname()[1]}"
    body, headers = b'{"do": "record", "trial": "s07"}', {"Origin": page}
    words = ("--view", "--view-port", page.rpartition(":")[2], "--time-scale", "auto")
    with Probe() as probe, start(*words, folder=tmp_path) as process:
        wrenches = probe.listen(topics.WRENCH)
        probe.wait(lambda: wrenches and probe.said("view_node"), "measurements and the page")
        request = urllib.request.Request(f"{page}/do", body, headers)
        with urllib.request.urlopen(request, timeout=HANGS) as answer:
            assert "recording" in json.load(answer)["said"]
        goal = len(wrenches) + 10
        probe.wait(lambda: len(wrenches) > goal, "a trial")
        assert interrupt(process).startswith("trials/s07: ")
    assert len(Trial(tmp_path / "trials" / "s07").samples()) > 5
    assert [path.name for path in (tmp_path / "trials").iterdir()] == ["s07"]


def test_an_event_that_nobody_hears_is_an_error(capfd, monkeypatch) -> None:
    monkeypatch.setattr(controls, "_TRIGGER_TIMEOUT", 0.0)
    with Probe() as probe:
        received = probe.listen(topics.EVENT, "/lab/event")
        with monkeypatch.context() as patch:
            patch.setattr(controls, "_LINK_TIMEOUT", 2.0)
            refused(capfd, "mark", "push", named=["no subscriber", "give --namespace /lab"])
        code, out, err = call(capfd, "mark", "push", "--namespace", "/lab")
        assert code == 0 and out.startswith("marked 'push' for this graph, acknowledged by 1 sub")
        assert "no trial is being recorded" in err and "no trigger received" in err
        probe.wait(lambda: len(received) == 1, "the event")
    assert received[0].label == "push"


@pytest.fixture
def manageable_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Testbed time as slow as this machine needs; `doctor` gives it to what it simulates."""
    monkeypatch.setattr(clocks, "_scale", careful_time_scale())


@pytest.mark.usefixtures("manageable_time")
def test_doctor_finds_all_simulated(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, subtests: pytest.Subtests
) -> None:
    file = simulated_parameters(tmp_path, mocap_node={"socket_body": "Socket"})  # as in a lab
    code, table, _ = call(capsys, "doctor", "--simulated", "--params", file)
    assert code == 0 and "failed" not in table, table
    for found in (
        *("line 17 to 27", "FDC1004 at 0x50 behind channel 3 of 0x70 on i2c-1", "NatNet 4.5"),
        *("ADS131M06 on spidev0.0, ID 0x26", "0 of 1000 frames corrupted", "markers are seen"),
    ):
        with subtests.test(found):
            assert found in table


HINTS = {
    "trigger": "check the wire between the two lines",
    "cluster mid_anterior": "check the cluster's plug",
    "load cell": "check MISO",
    "motion capture": "check that Motive streams",
}


@pytest.mark.usefixtures("manageable_time")
def test_doctor_names_what_fails(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, subtests: pytest.Subtests
) -> None:
    monkeypatch.setattr(doctor, "_SERVER_TIMEOUT", 0.1)
    faults = ["trigger.missing=1", "clusters.nack=2", "load_cell.unplugged=1", "mocap.unplugged=1"]
    words = [word for fault in faults for word in ("--fault", fault)]
    code, out, err = call(capsys, "doctor", "--simulated", *words)
    rows = {line.split("  ")[0]: line for line in out.splitlines()}
    for what, hint in HINTS.items():
        with subtests.test(what):
            assert "failed" in rows[what] and hint in rows[what]
    assert "failed" not in rows["cluster distal"]
    assert code == 1 and "checks failed" in err


def test_doctor_without_hardware_names_each_device(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    subtests: pytest.Subtests,
) -> None:  # fmt: skip
    monkeypatch.setattr(doctor, "_SERVER_TIMEOUT", 0.1)
    file = simulated_parameters(
        tmp_path,
        mocap_node={"server": "127.0.0.1", "command_port": 9},
        load_cell_node={"device": "250.7"},
        cluster_node={"buses": [250, 250, 250, 250]},
        trigger_node={"chip": "no such chip"},
    )
    code, table, err = call(capsys, "doctor", "--params", file)
    assert code == 1 and "Traceback" not in table + err
    chip = ("GPIO chip 'no such chip'", "set trigger_node's chip")
    for named in ("/dev/i2c-250", "dtparam=i2c_arm=on", "spidev250.7", *chip):
        with subtests.test(named):
            assert named in table


@pytest.fixture
def pressed(
    capsys: pytest.CaptureFixture[str], manageable_time: None
) -> Callable[..., dict[str, list[str]]]:
    """Press every simulated cluster; gives the rows of the table by cluster."""

    def rows(*words: object) -> dict[str, list[str]]:
        _, out, _ = call(capsys, "doctor", "--press", "--simulated", *words)
        parts = [re.split(r"  +", line) for line in out.splitlines()]
        return {row[0].removeprefix("press on "): row[1:] for row in parts if len(row) > 2}

    return rows


@pytest.mark.slow
def test_a_press_is_felt_by_its_cluster(pressed, subtests: pytest.Subtests) -> None:
    rows = pressed()
    for name in ("brim_lateral", "mid_anterior", "posterior_distal", "distal"):
        with subtests.test(name):
            assert rows[name][0] == "ok" and rows[name][1].startswith(f"{name} felt +1")


@pytest.mark.slow
def test_presses_find_exchanged_cables(pressed, tmp_path: Path) -> None:
    """The wires follow the names; then two cables are exchanged."""
    names = ["mid_anterior", "brim_lateral", "distal"]
    wired = ("--params", simulated_parameters(tmp_path, cluster_node={
        "names": names, "buses": [1] * 3, "channels": [0, 1, 2],
    }))  # fmt: skip
    rows = pressed(*wired)
    assert all(rows[name][1].startswith(f"{name} felt +1") for name in names)
    rows = pressed(*wired, "--fault", "clusters.exchanged=1")
    assert rows["mid_anterior"][1].startswith("brim_lateral felt +")
    assert "exchange the places of mid_anterior and brim_lateral" in rows["mid_anterior"][2]


OUTWARD = np.array([0.6, 0.0, -0.8])


@pytest.mark.parametrize(
    ("sign", "force", "hint"),
    [
        (1.0, 14.0 * OUTWARD, ""),
        (-1.0, 14.0 * OUTWARD, "its normal is the wrong way round"),
        (1.0, -14.0 * OUTWARD, "check the load cell's signs"),
        (1.0, 14.0 * np.array([0.0, 1.0, 0.0]), "how the load cell is turned"),
    ],
    ids=["right", "reversed normal", "reversed force", "turned force"],
)
def test_a_press_finds_reversed_signs(sign: float, force: np.ndarray, hint: str) -> None:
    change = np.concatenate([[sign * 15e3, 0.0], force])
    found = doctor._judge(("distal", "other"), 0, 0, change, OUTWARD)
    assert hint in found.hint and bool(found.hint) == bool(hint)


@pytest.mark.slow
def test_a_full_disk_is_an_error(tmp_path: Path) -> None:
    """A limit on the size of files stands for a full disk; what was recorded before is kept."""
    words = ["run", "--simulated", "--record", tmp_path / "full", "--rate", 100, "--duration", 20]
    limited = ["bash", "-c", 'ulimit -f 1200; exec "$@"', "_", *COMMAND]
    code, out, err = program(*limited, *words)
    assert code == 1 and "recording stopped" in err, err
    assert err.splitlines()[-1].endswith("cause, such as a full or unplugged disk")
    assert "triggers" in out and len(Trial(tmp_path / "full").samples()) > 100
