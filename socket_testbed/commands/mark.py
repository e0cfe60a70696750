"""`mark`: publish an event into the running graph."""

from __future__ import annotations

import sys
import time


def mark(label: str, *, namespace: str = "/") -> None:
    """Mark an event in the running graph, for the trial being recorded.

    Args:
        label: Label of the event, such as push.
        namespace: Namespace of the testbed.
    """
    called = time.monotonic()  # before the slow imports
    from socket_testbed.live.processes import require_ros
    from socket_testbed.trials.events import check_label

    check_label(label)
    require_ros()
    from socket_testbed.nodes.controls import publish_event

    marked = publish_event(label, called, namespace)
    where = f"in the trial {marked.trial}" if marked.trial else "for this graph"
    count = "1 subscriber" if marked.subscribers == 1 else f"{marked.subscribers} subscribers"
    print(f"marked '{label}' {where}, acknowledged by {count}")
    for note in marked.notes():
        print(f"note: {note}", file=sys.stderr)
