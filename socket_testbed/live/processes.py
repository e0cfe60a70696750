"""The graph as processes: each is started with its settings, monitored, and ended cleanly.

They end with the command that started them, even if it is killed.
"""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import IO, Any, Self

from socket_testbed.clocks import Backoff, shared_environment
from socket_testbed.documents import dump_yaml
from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.files import PARENT, TemporaryFolder, packaged
from socket_testbed.settings.fields import Settings, parameter_values
from socket_testbed.wire.topics import full_namespace

# Environment variables of the processes:
RESTARTED = "SOCKET_TESTBED_RESTARTED"  # set if this process replaces another
RANGE, _LOCAL = "ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"
_THREADS = "OPENBLAS_NUM_THREADS"  # numpy reads it when it is first imported
# Fast DDS; newer versions read the second name.
_PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
# Without shared memory, as in config/loopback.xml, where the graph may leave this machine.
_TRANSPORTS, _NO_SHARED_MEMORY = "FASTDDS_BUILTIN_TRANSPORTS", "UDPv4"

SPARE = "spare"  # name of the process that stands by to replace a killed node

_NODES = "socket_testbed.nodes"
STOP_TIMEOUT = 60.0  # [s]; for a clean end of a node
_POLL_INTERVAL = 0.05  # [s]
_EARLY_FAILURE = 10.0  # [s]; an earlier failure means wrong input
MAX_BACKOFF = 10.0  # [s]; before restarting a process that ends repeatedly
_CALM_AFTER = 3.0  # [s]; all processes have run this long before a spare one is started


@dataclass(frozen=True)
class GraphNode:
    """A node and its start options.

    Attributes:
        name: Name of the node and of its module, such as `estimator_node`.
        settings: Its settings, which become its parameters.
        namespace: Its absolute namespace.
        use_sim_time: Whether it takes the time from /clock.
        process: Name of a process shared with other nodes; empty for a process of its own.
        optional: Whether the graph can start without it.
    """

    name: str
    settings: Settings
    namespace: str = "/"
    use_sim_time: bool = False
    process: str = ""
    optional: bool = False


def write_parameters(nodes: Iterable[GraphNode], path: Path) -> Path:
    """Write the ROS parameter file of some nodes, for any namespace; returns its path.

    Args:
        nodes: The nodes, whose settings become parameters.
        path: The file, which is replaced if it exists.
    """
    document = {}
    for node in nodes:
        values = {"use_sim_time": node.use_sim_time, **parameter_values(node.settings)}
        document[f"/**/{node.name}"] = {"ros__parameters": values}
    path.write_text(dump_yaml(document), encoding="utf-8")
    return path


def launched(node: GraphNode, folder: Path, again: bool = False) -> dict[str, Any]:
    """Keywords of the launch action of a node.

    Args:
        node: The node.
        folder: Existing folder into which its parameter file is written, as long as it runs.
        again: Whether it replaces a node that has ended.
    """
    return {
        "package": "socket_testbed",
        "executable": node.name,
        "name": node.name,
        "namespace": node.namespace,
        "parameters": [str(write_parameters([node], folder / f"{node.name}.yaml"))],
        "output": "screen",
        "additional_env": {RESTARTED: "1"} if again else {},
        "sigterm_timeout": f"{STOP_TIMEOUT:g}",  # a recorder may need longer than the default
    }


def launch_namespace(given: str, pushed: str) -> str:
    """Absolute namespace of the nodes of a launch file.

    Nodes that are started again later, outside the group, keep it.

    Args:
        given: The namespace given to the launch file; relative or empty: inside `pushed`.
        pushed: The namespace of the group that includes the launch file (PushRosNamespace); empty
            for none.
    """
    return full_namespace(given if given.startswith("/") else f"{pushed}/{given}")


def require_ros() -> None:
    """Refuse to continue without ROS 2 and the messages.

    Raises:
        ConfigurationError: If rclpy or the testbed's messages cannot be imported.
    """
    for package in ("rclpy", "socket_testbed_msgs"):
        if importlib.util.find_spec(package) is None:
            raise ConfigurationError(
                f"{package} cannot be imported",
                "run 'make setup', or source the ROS 2 workspace that holds this package",
            )


def graph_environment() -> dict[str, str]:
    """Variables of a graph's processes; the user's environment may replace each.

    Any machine that reaches a graph can read and stop it, so it stays on this one. The problems are
    small: a second thread of linear algebra waits for busy cores much longer than it helps.
    """
    found = {_THREADS: os.environ.get(_THREADS, "1")}
    own_transports = any(name in os.environ for name in (*_PROFILE_VARIABLES, _TRANSPORTS))
    if os.environ.get(RANGE, _LOCAL) == _LOCAL:
        found[RANGE] = _LOCAL
        if not own_transports:
            found |= dict.fromkeys(_PROFILE_VARIABLES, str(packaged("config", "loopback.xml")))
    elif not own_transports:
        found[_TRANSPORTS] = _NO_SHARED_MEMORY
    return found


def launch_environment() -> dict[str, str]:
    """Variables of a launch file's processes, which end with the launch."""
    return {**graph_environment(), PARENT: str(os.getpid())}


def is_wrong_input(code: int, began: float) -> bool:
    """Whether a process failed so soon after the start of the graph that its input must be wrong.

    Args:
        code: Its exit code; negative: the signal that ended it.
        began: Start of the graph on the monotonic clock [s].
    """
    return code > 0 and time.monotonic() - began < _EARLY_FAILURE


def wait_again(backoff: Backoff, started: float) -> float:
    """Wait before the next restart of a process that has ended [s].

    Args:
        backoff: The waits of this process, which grow with each early end.
        started: Its last start on the monotonic clock [s].
    """
    now = time.monotonic()
    if now - started > _EARLY_FAILURE:
        backoff.succeeded()
    return backoff.failed(now)


@dataclass
class _Member:
    """A process of the graph.

    Attributes:
        command: Its command line.
        process: The process.
        started: Its last start on the monotonic clock [s].
        optional: Whether the graph can start without it.
        backoff: The waits between its restarts.
    """

    command: list[str]
    process: subprocess.Popen[bytes]
    started: float
    optional: bool
    backoff: Backoff = field(default_factory=partial(Backoff, MAX_BACKOFF))

    def exit_code(self) -> int | None:
        """Its exit code (negative: the signal that ended it), or None while it runs.

        Popen.poll can hold its lock forever if Ctrl-C interrupts it; this takes no lock.
        """
        if self.process.returncode is not None:
            return self.process.returncode
        found = os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        if found is None:
            return None
        killed = found.si_code in {os.CLD_KILLED, os.CLD_DUMPED}
        return -found.si_status if killed else found.si_status


class Graph:
    """Node processes that live and end together; a context manager.

    Args:
        output: An open file to which the nodes print; None for that of this process.
        meanwhile: Called repeatedly while the graph waits.

    Attributes:
        folder: A temporary folder that exists as long as the graph.
        clock: Environment variables of all further processes, with the testbed's time scale and
            clock origin.

    Raises:
        ConfigurationError: On entry, if ROS 2 or the messages cannot be imported.
    """

    def __init__(
        self, output: IO[Any] | None = None, meanwhile: Callable[[], None] = lambda: None
    ) -> None:
        self._output = output
        self._meanwhile = meanwhile
        self._members: dict[str, _Member] = {}
        self._spare: list[str] = []  # arguments of the spare process; empty for none
        self._temporary = TemporaryFolder()
        self.folder = Path(self._temporary.name)
        self.clock = shared_environment()

    def __enter__(self) -> Self:
        require_ros()
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()
        self._temporary.cleanup()

    def start(self, node: str, settings: Settings, namespace: str = "/") -> None:
        """Start a node in a process of its own, without which the graph cannot run.

        Args:
            node: Its name, such as `estimator_node`.
            settings: Its settings, which become its parameters.
            namespace: Its absolute namespace.
        """
        self.start_nodes([GraphNode(node, settings, namespace)])

    def start_nodes(self, nodes: Iterable[GraphNode]) -> None:
        """Start nodes in order; those of a shared process together with its first."""
        processes: dict[str, list[GraphNode]] = {}
        for node in nodes:
            processes.setdefault(node.process or node.name, []).append(node)
        for name, members in processes.items():
            file = write_parameters(members, self.folder / f"{name}.yaml")
            names = [node.name for node in members]
            ros = [*_ros_arguments(members[0].namespace), "--params-file", str(file)]
            optional = all(node.optional for node in members)
            self.start_program(name, _NODES, [*names, *ros], optional)

    def keep_spare(self, namespace: str = "/") -> None:
        """Keep a process on standby to replace a killed one.

        It has imported the node libraries and been discovered, so it takes over at once. A fresh
        process first imports its libraries and joins ROS (0.5 to 0.8 s). Then 0.8 to 3 s pass until
        a subscriber has discovered it: Fast DDS announces each process every 3 s. The trigger node
        also waits until it and the other nodes have discovered each other.

        Measured on two cores with a load of 2 to 5, at 20 Hz, from the kill of a node to its next
        message, three or four kills each: trigger 0.8 to 1.2 s with a spare process and 3.8 to
        4.2 s without, clusters 0.3 to 0.4 and 2.0 to 3.9 s, load cell 0.2 to 0.3 and 1.7 to 3.4 s,
        mocap 0.3 to 0.5 and 2.2 to 4.6 s, calibration 0.2 to 0.3 and 2.2 to 3.2 s, estimator 0.6 to
        1.6 and 2.1 to 4.2 s.
        """
        self._spare = [SPARE, *_ros_arguments(namespace)]

    def start_program(
        self, name: str, module: str, arguments: list[str], optional: bool = False
    ) -> None:
        """Start a module as a process.

        Args:
            name: What messages call it; also the name for `stop` and `wait`.
            module: The module, such as `socket_testbed.nodes`.
            arguments: Its command-line arguments.
            optional: Whether `watch` also restarts it after an early failure.
        """
        command = [sys.executable, "-m", module, *arguments]
        self._members[name] = _Member(command, self._spawn(command), time.monotonic(), optional)

    def _spawn(self, command: list[str], again: bool = False) -> subprocess.Popen[bytes]:
        # In its own session, a node gets Ctrl-C only once: from this process.
        return subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=self._output,
            stderr=self._output,
            start_new_session=True,
            env={**os.environ, PARENT: str(os.getpid()), **self.clock}
            | ({RESTARTED: "1"} if again else {}),
        )

    def _replace(self, ended: _Member) -> subprocess.Popen[bytes]:
        """A replacement for an ended process: the spare one, or a new one."""
        spare = self._members.get(SPARE, ended)
        if spare is not ended and spare.exit_code() is None and _NODES in ended.command:
            assert spare.process.stdin is not None
            with suppress(BrokenPipeError):
                with spare.process.stdin as place:
                    place.write(json.dumps(ended.command[3:]).encode())
                del self._members[SPARE]
                return spare.process
        return self._spawn(ended.command, again=True)

    def wait(self, node: str) -> None:
        """Wait until a node, given by the name of its process, has finished.

        Raises:
            TestbedError: If it fails, or another process ends before it.
        """
        while (code := self._members[node].exit_code()) is None:
            self.check(but=node)
            self.pause()
        if code != 0:
            raise _failure(node, code)

    def pause(self, duration: float = 0.0) -> None:
        """Wait for a moment, or for a duration [s], while the processes work."""
        ends = time.monotonic() + duration
        while True:
            self._meanwhile()
            time.sleep(_POLL_INTERVAL)
            if time.monotonic() >= ends:
                return

    def check(self, but: str = "") -> None:
        """Check that all processes run, except the one named by `but`.

        Raises:
            TestbedError: If another one has ended.
        """
        for name, member in self._members.items():
            if name != but and (code := member.exit_code()) is not None:
                raise _failure(name, code)

    def watch(self, done: Callable[[], bool], notify: Callable[[str], None]) -> None:
        """Keep the processes running: ended ones are restarted.

        Args:
            done: Called repeatedly; true ends the watch.
            notify: Called with one line per restart.

        Raises:
            TestbedError: If a process that is not optional fails within 10 s of this call.
        """
        began = time.monotonic()
        while not done():
            now = time.monotonic()
            calm = all(now - member.started > _CALM_AFTER for member in self._members.values())
            if self._spare and SPARE not in self._members and calm:
                self.start_program(SPARE, _NODES, self._spare, optional=True)
            for name, member in list(self._members.items()):
                code = member.exit_code()
                if code is None or name not in self._members:  # the spare has replaced another
                    continue
                if is_wrong_input(code, began) and not member.optional:
                    raise _failure(name, code)
                if member.backoff.due(now):
                    notify(f"{name} {_ending(code)}: started again")
                    wait_again(member.backoff, member.started)
                    member.process = self._replace(member)
                    member.started = now
            self.pause()

    def stop(self, *names: str) -> None:
        """End some processes by name, or all of them: first SIGTERM, after 60 s SIGKILL."""
        members = [self._members[name] for name in names] or self._members.values()
        # SIGTERM ends a node cleanly once ROS handles signals, and at once before that.
        for number in (signal.SIGTERM, signal.SIGKILL):
            running = [member for member in members if member.exit_code() is None]
            for member in running:
                with suppress(ProcessLookupError):
                    os.kill(member.process.pid, number)
            deadline = time.monotonic() + STOP_TIMEOUT
            while time.monotonic() < deadline and any(m.exit_code() is None for m in running):
                self.pause()
        for member in members:
            member.process.poll()  # reap it


def _ros_arguments(namespace: str) -> list[str]:
    """ROS arguments of nodes in a namespace, except their parameters."""
    return ["--ros-args", "-r", f"__ns:={namespace}"]


def _failure(name: str, code: int) -> TestbedError:
    return TestbedError(f"{name} {_ending(code)}", "see what it printed")


def _ending(code: int) -> str:
    if code < 0:
        names = {number.value: number.name for number in signal.Signals}
        return f"was ended by {names.get(-code, f'signal {-code}')}"
    return f"ended with exit code {code}"
