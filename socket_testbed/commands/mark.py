"""`mark`: publish an event into the running graph."""

from __future__ import annotations

import argparse
import sys
import time


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("label", metavar="LABEL", help="what happens, such as push")
    parser.add_argument(
        "--namespace", default="/", metavar="NAME", help="namespace of the testbed (default: /)"
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Publish, and wait until it is acknowledged."""
    called = time.monotonic()  # before the imports: they take their time
    from socket_testbed.live.processes import require_ros
    from socket_testbed.trials.events import check_label

    label = check_label(options.label)
    require_ros()
    from socket_testbed.nodes.controls import publish_event

    marked = publish_event(label, called, f"/{options.namespace.strip('/')}")
    where = f"in the trial {marked.trial}" if marked.trial else "for this graph"
    heard = "1 subscriber" if marked.subscribers == 1 else f"{marked.subscribers} subscribers"
    print(f"marked '{label}' {where}, acknowledged by {heard}")
    for note in marked.notes():
        print(f"note: {note}", file=sys.stderr)
