"""The graph as processes: what it needs, and what it does without."""

import os

import pytest

from socket_testbed.live.processes import Graph, NodeFailedError


@pytest.mark.graph
def test_a_graph_ends_with_what_it_needs_and_goes_on_without_what_is_optional() -> None:
    said: list[str] = []
    with open(os.devnull, "w") as nowhere, Graph(nowhere) as graph:  # noqa: PTH123
        graph.start_program("page", "socket_testbed.nodes", ["no_such_node"], optional=True)
        graph.watch(lambda: bool(said), said.append)
        assert said == ["page ended with exit code 1: started again"]
        graph.start_program("needed", "socket_testbed.nodes", ["no_such_node"])
        with pytest.raises(NodeFailedError, match="needed ended with exit code 1"):
            graph.watch(lambda: False, said.append)
