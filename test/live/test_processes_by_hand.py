"""Processes of a graph without a graph: their commands, environment, ends and restarts."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from socket_testbed.clocks import Backoff
from socket_testbed.documents import load_yaml
from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.files import packaged
from socket_testbed.live import processes
from socket_testbed.live.processes import Graph, GraphNode
from socket_testbed.settings.acquisition import TriggerSettings

TIMER = TriggerSettings(source="timer", rate=8.0)


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Graph:
    """A graph whose programs are noted in `started`, not started."""
    found: Any = Graph()
    found.started = []
    monkeypatch.setattr(found, "_spawn", lambda command, again=False: command)
    monkeypatch.setattr(
        found, "start_program", lambda *given, **more: found.started.append((*given, more))
    )
    return found


def test_nodes_of_a_process_start_together(graph: Any) -> None:
    graph.start_nodes(
        [
            GraphNode("trigger_node", TIMER, "/left"),
            GraphNode("cluster_node", TIMER, "/left", process="testbed", optional=True),
            GraphNode("mocap_node", TIMER, "/left", use_sim_time=True, process="testbed"),
            GraphNode("view_node", TIMER, "/left", optional=True),
        ]
    )
    ros = ["--ros-args", "-r", "__ns:=/left"]
    files = [graph.folder / f"{name}.yaml" for name in ("trigger_node", "testbed", "view_node")]
    nodes = ["trigger_node"], ["cluster_node", "mocap_node"], ["view_node"]
    assert [given[2] for given in graph.started] == [
        [*own, *ros, "--params-file", str(file)] for own, file in zip(nodes, files, strict=True)
    ]
    assert [given[0] for given in graph.started] == ["trigger_node", "testbed", "view_node"]
    assert {given[1] for given in graph.started} == {"socket_testbed.nodes"}
    assert [given[3] for given in graph.started] == [False, False, True]
    written: Any = load_yaml(files[1])
    assert [*written] == ["/**/cluster_node", "/**/mocap_node"]
    by_node = {name: own["ros__parameters"] for name, own in written.items()}
    assert [own["use_sim_time"] for own in by_node.values()] == [False, True]
    assert by_node["/**/mocap_node"]["rate"] == 8.0


def test_a_launched_node_has_its_options(tmp_path: Path) -> None:
    node = GraphNode("trigger_node", TIMER, "/left")
    found = processes.launched(node, tmp_path)
    assert found == {
        "package": "socket_testbed",
        "executable": "trigger_node",
        "name": "trigger_node",
        "namespace": "/left",
        "parameters": [str(tmp_path / "trigger_node.yaml")],
        "output": "screen",
        "additional_env": {},
        "sigterm_timeout": "60",
    }
    again = processes.launched(node, tmp_path, again=True)
    assert again["additional_env"] == {"SOCKET_TESTBED_RESTARTED": "1"}


VARIABLES = (
    "OPENBLAS_NUM_THREADS",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTDDS_BUILTIN_TRANSPORTS",
)
LOOPBACK = str(packaged("config", "loopback.xml"))
ENVIRONMENTS: dict[str, tuple[dict[str, str], tuple[str | None, ...]]] = {
    "none": ({}, ("1", "LOCALHOST", LOOPBACK, LOOPBACK, None)),
    "threads": ({VARIABLES[0]: "4"}, ("4", "LOCALHOST", LOOPBACK, LOOPBACK, None)),
    "this machine": ({VARIABLES[1]: "LOCALHOST"}, ("1", "LOCALHOST", LOOPBACK, LOOPBACK, None)),
    "network": ({VARIABLES[1]: "SUBNET"}, ("1", None, None, None, "UDPv4")),
    "network, own transports": (
        {VARIABLES[1]: "SUBNET", VARIABLES[4]: "DEFAULT"},
        ("1", None, None, None, None),
    ),
    "own profile": ({VARIABLES[3]: "own.xml"}, ("1", "LOCALHOST", None, None, None)),
    "own older profile": ({VARIABLES[2]: "own.xml"}, ("1", "LOCALHOST", None, None, None)),
    "own transports": ({VARIABLES[4]: "SHM"}, ("1", "LOCALHOST", None, None, None)),
}


@pytest.mark.parametrize("case", ENVIRONMENTS)
def test_the_user_s_environment_counts(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    own, expected = ENVIRONMENTS[case]
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    for name, value in own.items():
        monkeypatch.setenv(name, value)
    found = processes.graph_environment()
    assert tuple(found.get(name) for name in VARIABLES) == expected
    launch = processes.launch_environment()
    assert launch == {**found, "SOCKET_TESTBED_PARENT": str(os.getpid())}


@pytest.mark.parametrize("lacking", ["rclpy", "socket_testbed_msgs"])
def test_a_graph_needs_ros_and_messages(lacking: str, monkeypatch: pytest.MonkeyPatch) -> None:
    found = SimpleNamespace(util=SimpleNamespace(find_spec=lambda name: name != lacking or None))
    monkeypatch.setattr(processes, "importlib", found)
    with pytest.raises(ConfigurationError) as error, Graph():
        pass
    hint = "run 'make setup', or source the ROS 2 workspace that holds this package"
    assert str(error.value) == f"{lacking} cannot be imported: {hint}"


# --- ends

ENDS = {
    "code": ("import sys; sys.exit(3)", 3, "ended with exit code 3"),
    "done": ("", 0, "ended with exit code 0"),
    "killed": (
        "import os, signal; os.kill(os.getpid(), signal.SIGKILL)",
        -signal.SIGKILL,
        "was ended by SIGKILL",
    ),
    "no name": (
        "import os; os.kill(os.getpid(), 40)",
        -40,
        "was ended by signal 40",
    ),
}


@pytest.mark.parametrize("case", ENDS)
def test_a_process_s_end_has_words(case: str) -> None:
    program, code, words = ENDS[case]
    graph = Graph()
    process = graph._spawn([sys.executable, "-c", program])
    member = processes._Member([], process, 0.0, False)
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    assert member.exit_code() == code
    assert process.poll() == member.exit_code() == code
    assert str(processes._failure("x", code)) == f"x {words}: see what it printed"


class Process:
    """Stands for a process that has ended with a code, or runs (None)."""

    def __init__(self, code: int | None) -> None:
        self.returncode = code


def members(graph: Any, **codes: int) -> None:
    for name, code in codes.items():
        process: Any = Process(code)
        graph._members[name] = processes._Member([name], process, 0.0, name == "page")


def test_another_process_s_end_is_a_failure() -> None:
    graph = Graph()
    members(graph, replay_node=0, estimator_node=1)
    with pytest.raises(TestbedError, match=r"^replay_node ended with exit code 0: see what it"):
        graph.check()
    with pytest.raises(TestbedError, match=r"^estimator_node ended with exit code 1: see what it"):
        graph.check(but="replay_node")
    graph.wait("replay_node")
    with pytest.raises(TestbedError, match=r"^estimator_node ended with exit code 1"):
        graph.wait("estimator_node")


@pytest.mark.parametrize(
    ("code", "after", "wrong"),
    [(1, 9.9, True), (1, 10.1, False), (0, 1.0, False), (-9, 1.0, False)],
    ids=["early", "later", "no failure", "killed"],
)
def test_an_early_failure_is_wrong_input(
    code: int, after: float, wrong: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "time", SimpleNamespace(monotonic=lambda: 100.0 + after))
    assert processes.is_wrong_input(code, 100.0) is wrong


@pytest.mark.parametrize(
    ("ran", "waits"),
    [(9.0, [0.05, 0.1, 0.2]), (11.0, [0.05, 0.05, 0.05])],
    ids=["early ends", "late ends"],
)
def test_early_ends_are_restarted_later(
    ran: float, waits: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "time", SimpleNamespace(monotonic=lambda: 100.0))
    backoff = Backoff(processes.MAX_BACKOFF)
    found = [processes.wait_again(backoff, 100.0 - ran) for _ in waits]
    assert found == pytest.approx(waits)


def test_restarts_are_ten_seconds_apart_at_most() -> None:
    found = processes._Member([], Any, 0.0, False).backoff  # type: ignore[arg-type]
    assert max(found.failed(0.0) for _ in range(20)) == 10.0


def test_a_spare_process_starts_once_all_is_calm(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three seconds after the last start."""
    graph: Any = Graph()
    clock = SimpleNamespace(monotonic=lambda: clock.now, sleep=lambda seconds: None, now=0.0)
    monkeypatch.setattr(processes, "time", clock)
    started: list[tuple[float, str, str, list[str], bool]] = []

    def start(name: str, module: str, arguments: list[str], optional: bool) -> None:
        started.append((clock.now, name, module, arguments, optional))
        running: Any = SimpleNamespace(exit_code=lambda: None, started=clock.now)
        graph._members[name] = running

    monkeypatch.setattr(graph, "start_program", start)
    running = SimpleNamespace(exit_code=lambda: None, started=2.0)
    graph._members["trigger_node"] = running
    moments = iter([1.0, 4.9, 5.1, 9.0])

    def done() -> bool:
        clock.now = next(moments, 0.0)
        return clock.now == 0.0

    graph.keep_spare("/left")
    graph.watch(done, lambda line: None)
    ros = ["--ros-args", "-r", "__ns:=/left"]
    assert started == [(5.1, "spare", "socket_testbed.nodes", ["spare", *ros], True)]


# --- starts and stops


@pytest.fixture
def spawned(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What processes would be started with: the options of `subprocess.Popen`."""
    found: list[dict[str, Any]] = []
    monkeypatch.setattr(
        processes.subprocess, "Popen", lambda command, **more: found.append(more) or command
    )
    return found


def test_a_process_knows_its_parent_clock_and_restart(spawned: list[dict[str, Any]]) -> None:
    output: Any = object()
    graph = Graph(output)
    graph.clock = {"SOCKET_TESTBED_TIME_SCALE": "0.5"}
    assert graph._spawn(["a"]) == graph._spawn(["a"], again=True) == ["a"]  # type: ignore[comparison-overlap]
    first, again = (options["env"] for options in spawned)
    assert first["SOCKET_TESTBED_PARENT"] == str(os.getpid())
    assert first["SOCKET_TESTBED_TIME_SCALE"] == "0.5" and first["PATH"] == os.environ["PATH"]
    assert again == {**first, "SOCKET_TESTBED_RESTARTED": "1"}
    for options in spawned:
        assert options["start_new_session"] and options["stdin"] == subprocess.PIPE
        assert options["stdout"] is options["stderr"] is output


SPARES = {
    # exit code of the spare process (None: it runs), module of the ended one; whether it takes over
    "ready": (None, "socket_testbed.nodes", True),
    "ended": (1, "socket_testbed.nodes", False),
    "another program": (None, "socket_testbed.simulation.testbed", False),
}


@pytest.mark.parametrize("case", SPARES)
def test_a_spare_process_takes_over_nodes(case: str, spawned: list[dict[str, Any]]) -> None:
    """It reads from its standard input what it is to run."""
    code, module, takes_over = SPARES[case]
    graph: Any = Graph()
    told: list[bytes] = []

    class Input:
        def __enter__(self) -> "Input":
            return self

        def __exit__(self, *given: object) -> None:
            told.append(b"end")

        def write(self, data: bytes) -> None:
            told.append(data)

    spare = SimpleNamespace(stdin=Input())
    graph._members["spare"] = SimpleNamespace(exit_code=lambda: code, process=spare, command=[])
    ended: Any = SimpleNamespace(command=["python", "-m", module, "mocap_node", "--ros-args"])
    found = graph._replace(ended)
    assert ("spare" in graph._members) is not takes_over
    if takes_over:
        assert found is spare and not spawned
        assert told == [b'["mocap_node", "--ros-args"]', b"end"]
    else:
        assert found == ended.command and not told
        assert spawned[0]["env"]["SOCKET_TESTBED_RESTARTED"] == "1"


class Deaf:
    """Stands for a process that ends at a signal, a while after it; None: at SIGKILL alone."""

    def __init__(self, clock: Any, pid: int, takes: float | None) -> None:
        self.pid, self._clock, self._takes = pid, clock, takes
        self.ends = float("inf")
        self.returncode: int | None = None
        self.reaped = False

    def signalled(self, number: int) -> None:
        if number == signal.SIGKILL or self._takes is not None:
            takes = self._takes or 0.0
            self.ends = min(self.ends, self._clock.now + takes * (number != signal.SIGKILL))

    def poll(self) -> None:
        self.reaped = True


def test_a_graph_ends_gently_then_by_force(monkeypatch: pytest.MonkeyPatch) -> None:
    """A node has 60 s after SIGTERM; another that has ended gets no signal."""
    clock: Any = SimpleNamespace(now=100.0)

    def sleep(seconds: float) -> None:
        clock.now += seconds

    clock.monotonic, clock.sleep = (lambda: clock.now), sleep
    monkeypatch.setattr(processes, "time", clock)
    graph: Any = Graph()
    ways = {"quick": 1.0, "slow": 59.0, "deaf": None, "kept": 1.0}
    made = {name: Deaf(clock, 10 + k, takes) for k, (name, takes) in enumerate(ways.items())}
    sent: list[tuple[int, int, int]] = []

    def kill(pid: int, number: int) -> None:
        sent.append((pid, number, round(clock.now - 100.0)))
        next(own for own in made.values() if own.pid == pid).signalled(number)

    monkeypatch.setattr(processes.os, "kill", kill)
    for name, own in made.items():
        graph._members[name] = SimpleNamespace(
            process=own, exit_code=lambda own=own: 0 if clock.now >= own.ends else None
        )
    graph.stop("quick", "slow", "deaf")
    term, force = int(signal.SIGTERM), int(signal.SIGKILL)
    assert sent == [(10, term, 0), (11, term, 0), (12, term, 0), (12, force, 60)]
    assert [own.reaped for own in made.values()] == [True, True, True, False]
    sent.clear()
    graph.stop()
    assert [(pid, number) for pid, number, _ in sent] == [(13, term)]
    made["kept"].ends = 0.0
