"""`mark`: publish an event into the running graph."""

from __future__ import annotations

import sys
import time

from socket_testbed.commands import calls
from socket_testbed.commands.calls import takes


@takes(calls.Mark)
def mark(call: calls.Mark) -> None:
    """Mark an event in the running graph, for the trial being recorded."""
    called = time.monotonic()  # before the slow imports
    from socket_testbed.live.processes import require_ros
    from socket_testbed.trials.events import check_label

    check_label(call.label)
    require_ros()
    from socket_testbed.nodes.controls import publish_event

    marked = publish_event(call.label, called, call.namespace)
    where = f"in the trial {marked.trial}" if marked.trial else "for this graph"
    count = "1 subscriber" if marked.subscribers == 1 else f"{marked.subscribers} subscribers"
    print(f"marked '{call.label}' {where}, acknowledged by {count}")
    for note in marked.notes():
        print(f"note: {note}", file=sys.stderr)
