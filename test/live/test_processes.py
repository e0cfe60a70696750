"""The graph as processes: what it needs, and what it does without."""

import os
import signal

import pytest
from support.graph import Probe

from socket_testbed.errors import TestbedError
from socket_testbed.live.processes import SPARE, Graph
from socket_testbed.settings.testbed import CalibrationNodeSettings
from socket_testbed.trials.topics import DIAGNOSTICS


@pytest.mark.graph
def test_a_graph_ends_with_what_it_needs_and_goes_on_without_what_is_optional() -> None:
    said: list[str] = []
    with open(os.devnull, "w") as nowhere, Graph(nowhere) as graph:  # noqa: PTH123
        graph.start_program("page", "socket_testbed.nodes", ["no_such_node"], optional=True)
        graph.watch(lambda: bool(said), said.append)
        assert said == ["page ended with exit code 1: started again"]
        graph.start_program("needed", "socket_testbed.nodes", ["no_such_node"])
        with pytest.raises(TestbedError, match="needed ended with exit code 1"):
            graph.watch(lambda: False, said.append)


@pytest.mark.graph
def test_a_spare_process_takes_the_place_of_a_killed_node() -> None:
    said: list[str] = []
    with open(os.devnull, "w") as nowhere, Graph(nowhere) as graph, Probe() as probe:  # noqa: PTH123
        probe.listen(DIAGNOSTICS)

        def heard_of(node: str) -> list[str]:
            statuses = (s for m in probe.received[DIAGNOSTICS.name] for s in m.status)
            return [status.message for status in statuses if status.name == f"/{node}"]

        graph.start("calibration_node", CalibrationNodeSettings())
        graph.keep_spare()
        graph.watch(lambda: SPARE in graph._members, said.append)
        spare = graph._members[SPARE].process
        graph._members["calibration_node"].process.send_signal(signal.SIGKILL)
        graph.watch(lambda: bool(said), said.append)
        assert said == ["calibration_node was ended by SIGKILL: started again"]
        assert graph._members["calibration_node"].process is spare
        graph.watch(lambda: "started again" in heard_of("calibration_node"), said.append)
        # There is another spare one; a dead one leaves the restart to a new process.
        graph.watch(lambda: SPARE in graph._members, said.append)
        for name in (SPARE, "calibration_node"):
            graph._members[name].process.send_signal(signal.SIGKILL)
            graph._members[name].process.wait()
        dead = graph._members[SPARE].process
        graph.watch(lambda: len(said) == 3, said.append)
        assert graph._members["calibration_node"].process not in {spare, dead}
        assert graph._members["calibration_node"].exit_code() is None
