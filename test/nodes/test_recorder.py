"""The recorder in the real graph: what it records, and what is left when it is ended or killed."""

import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool
from support import HANGS
from support.graph import Probe
from support.verbs import COMMAND, Running

from socket_testbed.files import CONFIGURATION_FILES, packaged
from socket_testbed.live.processes import Graph, GraphNode
from socket_testbed.nodes.base import stamp_to_ros
from socket_testbed.settings.testbed import RecorderSettings, ReplaySettings
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.metadata import TrialMetadata
from socket_testbed.trials.trial import Trial
from socket_testbed.wire.cdr import decode, nanoseconds, stamp_of
from socket_testbed.wire.topics import RECORDED_TRIAL, TF, WRENCH, match_topics

pytestmark = pytest.mark.graph


NODE = "recorder_node"


def recorder(*parameters: str, limit: str = "unlimited") -> Running:
    """A recorder of its own, with a limit on the size of a file [KiB]; killed at the end."""
    words = [word for parameter in parameters for word in ("-p", parameter)]
    command = [sys.executable, "-m", "socket_testbed.nodes", "recorder_node", "--ros-args", *words]
    limited = ["bash", "-c", f'ulimit -f {limit}; exec "$@"', "recorder", *command]
    return Running(limited, stderr=subprocess.DEVNULL)


class Sender:
    """Publishes wrenches whose stamp is their number [ns]."""

    def __init__(self, probe: Probe) -> None:
        self._publisher = probe.publisher(WRENCH)
        self.sent = 0

    def __call__(self, number: int = 1) -> None:
        for _ in range(number):
            message = WrenchStamped()
            message.header.stamp = stamp_to_ros(self.sent)
            self._publisher.publish(message)
            self.sent += 1


def recorded(trial: Path) -> tuple[list[int], list[int]]:
    """Numbers of the wrenches in a trial and the times of their recording [ns]."""
    with BagReader(trial) as bag:
        raws = list(bag.messages(["/load_cell/wrench"]))
    return [stamp_of(decode(r.data, r.type)) for r in raws], [r.time for r in raws]


def record(probe: Probe, wanted: bool) -> str:
    answer = probe.call(SetBool, "recorder/record", SetBool.Request(data=wanted))
    assert answer.success, answer.message
    return answer.message


def test_a_recorded_replay_is_the_recording(hold: Path, tmp_path: Path) -> None:
    """In its order and time: that of /clock, where that is asked for."""
    recorded, ticks = tmp_path / "again", []
    with Graph() as graph, Probe() as probe:
        probe.node.create_subscription(Clock, "/clock", ticks.append, 1000)
        frames = probe.listen(TF)
        settings = RecorderSettings(directory=str(recorded), record=False)
        graph.start_nodes([GraphNode(NODE, settings, use_sim_time=True)])
        probe.wait(lambda: bool(probe.said(NODE)), "the recorder's diagnostics")
        replay = ReplaySettings(trial=str(hold), rate=30.0, paused=True, wait_for=(NODE,))
        graph.start("replay_node", replay)
        probe.wait(lambda: bool(probe.said("replay_node")), "the replay")
        assert not probe.figure("replay_node", "published")
        path = Path(record(probe, True).removeprefix("recording "))
        assert probe.call(SetBool, "replay/pause", SetBool.Request(data=False)).success
        graph.wait("replay_node")
        with BagReader(hold) as bag:
            names = list(match_topics(bag.types, "hold").values())
        probe.wait(lambda: all(probe.figure(NODE, name) == 240 for name in names), "all of it")
    with BagReader(hold) as before, BagReader(path) as after:
        for name in names:
            raws, again = list(before.messages([name])), list(after.messages([name]))
            sent = [raw.data + bytes(-len(raw.data) % 4) for raw in raws]  # DDS pads to words
            assert [raw.data for raw in again] == sent, name
            late = [1e-9 * (b.time - a.time) for a, b in zip(raws, again, strict=True)]
            assert abs(np.median(late)) < 10.0, name
        assert after.counts["/diagnostics"] > 0
    assert {t.child_frame_id for m in frames for t in m.transforms} == {"socket", "limb"}
    times = [nanoseconds(tick.clock) for tick in ticks]
    assert times and times == sorted(times)  # the first may precede its discovery
    assert (path / "metadata.yaml").is_file() and (path / "socket.yaml").is_file()
    assert not any(file.stat().st_mode & 0o007 for file in (path, *path.iterdir()))
    np.testing.assert_array_equal(Trial(path).samples().values, Trial(hold).samples().values)


def test_a_killed_recorder_keeps_what_had_come(tmp_path: Path) -> None:
    """And goes on in a trial beside."""
    trial, beside = tmp_path / "trial", tmp_path / "trial_2"
    settings = ("record:=true", f"directory:={trial}")
    with Probe() as probe:
        announced = probe.listen(RECORDED_TRIAL)
        with recorder(*settings) as process:
            probe.wait(lambda: [m.data for m in announced][-1:] == ["trial"], "the trial's name")
            with recorder(*settings) as second:
                assert second.wait(timeout=HANGS) == 1, "the folder is being written"
            assert not beside.exists()
            send = Sender(probe)

            def send_until_recorded() -> bool:
                send(10)
                return probe.figure(NODE, "/load_cell/wrench") > 100

            probe.wait(send_until_recorded, "100 messages")
            # Nobody sends any more: what has come reaches the disk within a flush period.
            had_come = probe.figure(NODE, "/load_cell/wrench")
            probe.wait(lambda: len(recorded(trial)[0]) >= had_come, "them on the disk")
            process.kill()
            process.wait()
        before = {file: file.read_bytes() for file in trial.iterdir()}
        assert trial / "metadata.yaml" not in before
        with recorder(*settings):
            probe.wait(lambda: [m.data for m in announced][-1:] == ["trial_2"], "the other name")
            words = f"recording {beside}: {trial} holds a trial"
            probe.wait(lambda: bool(probe.said(NODE, words)), "the recorder's word about it")
            assert probe.said(NODE, words)[0].level == DiagnosticStatus.WARN
    with BagReader(trial) as bag:
        assert "cut short" in bag.notes[-1]
    numbers, times = recorded(trial)
    assert numbers == list(range(len(numbers))) and times == sorted(times)
    assert len(numbers) >= had_come
    assert {file: file.read_bytes() for file in trial.iterdir()} == before
    assert (beside / "trial_2.mcap").is_file() and (beside / "socket.yaml").is_file()


def test_a_full_disk_keeps_the_recording(tmp_path: Path) -> None:
    trial = tmp_path / "trial"
    settings = ("record:=true", f"directory:={trial}", "flush_period:=0.1")
    with Probe() as probe, recorder(*settings, limit="200"):
        announced = probe.listen(RECORDED_TRIAL)
        send = Sender(probe)

        def send_until_full() -> bool:
            send(10)
            return bool(probe.said(NODE, "takes no larger file"))

        probe.wait(send_until_full, "the recorder's word about the disk")
        assert probe.said(NODE, "takes no larger file")[0].level == DiagnosticStatus.ERROR
        probe.wait(lambda: [m.data for m in announced][-1:] == [""], "no trial's name")
        assert record(probe, False) == "nothing was being recorded"
    numbers, _ = recorded(trial)
    assert numbers == list(range(len(numbers))) and len(numbers) > 200


@pytest.mark.slow
def test_a_silent_recording_is_reported(tmp_path: Path) -> None:
    """Ten seconds without a testbed, then a load cell alone; it ends whole."""
    trial = tmp_path / "trial"
    command = [*COMMAND, "record", str(trial)]
    with Probe() as probe, Running(command, stderr=subprocess.PIPE, text=True) as process:
        send = Sender(probe)
        probe.wait(lambda: bool(probe.said(NODE, "but nothing arrives: check")), "the silence")
        send()
        words = "but nothing arrives on /trigger, "
        probe.wait(lambda: bool(probe.said(NODE, words)), "a word on the others")
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=HANGS)
    assert "nothing arrives: check that the testbed runs" in error
    assert "none on /trigger, " in error and "Traceback" not in error
    assert process.returncode == 0 and (trial / "metadata.yaml").is_file()
    assert recorded(trial)[0] == [0]


def test_the_next_trial_is_stored_as_stated(tmp_path: Path) -> None:
    """No other program chooses what is stored or where."""
    stated, trials = tmp_path / "stated.yaml", tmp_path / "trials"
    stated.write_text("subject: S01\nliner: gel\n")

    def recorded_as(**values: Any) -> str:
        assert not probe.refusals(NODE, **values)
        answer = record(probe, True)
        record(probe, False)
        return Path(answer.removeprefix("recording ")).name

    with Probe() as probe, recorder(f"directory:={trials}", f"metadata:={stated}"):
        fixed = ("geometry", "calibration", "parameters", "metadata", "directory")
        assert len(probe.refusals(NODE, **dict.fromkeys(fixed, "/secret"))) == len(fixed)
        (reason,) = probe.refusals(NODE, next__name="../up")
        assert "next.name: the trial's name '../up' cannot be" in reason
        assert recorded_as(next__name="stairs", next__subject="S02", next__mass=70) == "stairs"
        stated.unlink()  # it was read at the start
        unnamed = {recorded_as() for _ in range(3)}  # several within a second
        assert len(unnamed) == 3
        assert recorded_as(next__name="stairs", next__side="left") == "stairs_2"
    both = TrialMetadata("S02", liner="gel", mass=70.0)
    assert Trial(trials / "stairs").metadata == both
    assert Trial(trials / "stairs_2").metadata == TrialMetadata("S01", "left", liner="gel")
    for name in CONFIGURATION_FILES:
        stored = trials / "stairs" / name
        assert stored.read_bytes() == packaged("config", name).read_bytes()
