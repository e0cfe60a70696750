"""The command line: `socket-testbed VERB`, also `python -m socket_testbed VERB`."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from importlib import import_module

from socket_testbed import __version__
from socket_testbed.commands.arguments import Parser, release_paths
from socket_testbed.errors import TestbedError, likely

VERBS = {
    "demo": "run the simulated testbed live, replay its trial, and show the errors",
    "run": "bring up the testbed, on hardware or simulated, and record it",
    "doctor": "list what is wired, what is not, and how to fix it",
    "tile": "turn a scan into tiles, frames and neighbours",
    "register": "locate the marker bodies' frames from a static take and landmarks",
    "calibrate": "fit a cluster's coefficients to bench data and show their quality",
    "simulate": "write a simulated trial with its ground truth",
    "record": "record the graph as a trial",
    "annotate": "state and show a trial's metadata: subject code, side, socket, liner, ...",
    "mark": "mark an event in the running graph, for the trial that is being recorded",
    "replay": "publish a trial with /clock; --estimate runs the estimator on it",
    "view": "see the running testbed, or play a trial, in a browser: pressure map, wrench, sensors",
    "info": "show what a trial holds: topics, rates, gaps, plateau",
    "fit": "identify the contact model on a trial, or on every trial of a folder",
    "evaluate": "compute a model's errors on a trial, or on every trial of a folder",
    "validate": "judge estimates on data they have not seen, beside simple rivals",
    "paper": "run the published pipeline and lay its figures beside the printed ones",
    "pareto": "trace the trade-off of wrench against clusters over theta",
    "pressure": "pressure by region: mean, peak, contact area, time integral, shear, load",
    "compare": "lay trials side by side, with their differences",
    "map": "estimate the force on every tile with its uncertainty, without a fit",
    "report": "write a page with a trial's results: figures, errors, data quality",
    "export": "write a trial's synchronised samples as CSV, Parquet or MAT",
}


def main(arguments: list[str] | None = None) -> None:
    """Run a verb and exit: 0 when it succeeded, 1 on an error, 2 on a wrong call."""
    sys.exit(run(arguments))


def _parse(words: list[str]) -> argparse.Namespace:
    """The options of a verb; a wrong call ends here, with one line and the exit code 2."""
    completed = os.environ.get("COMP_LINE") if "_ARGCOMPLETE" in os.environ else None
    if completed is not None:
        words = completed.split()[1:]
    parser = Parser(
        prog="socket-testbed",
        description="Software of an instrumented prosthetic-socket testbed.",
        allow_abbrev=False,
    )
    version = f"socket_testbed {__version__}"
    parser.add_argument("-V", "--version", action="version", version=version)
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    called = parser
    for verb, summary in VERBS.items():
        subparser = verbs.add_parser(verb, help=summary, description=summary, allow_abbrev=False)
        # Only the verb that is called is imported: the others' libraries take their time.
        if words[:1] == [verb]:
            import_module(f"socket_testbed.commands.{verb}").configure(subparser)
            called = subparser
    if completed is not None:
        _complete(parser)
    called.words = words
    verb = next(iter(words), "-")
    if not verb.startswith("-") and verb not in VERBS:
        parser.exit(2, f"socket-testbed: error: unknown verb '{verb}': {_verb_hint(verb)}\n")
    options, unknown = parser.parse_known_args(release_paths(words))
    if unknown:
        called.error(f"not understood: {' '.join(unknown)}")
    return options


def _verb_hint(verb: str) -> str:
    return likely(verb, VERBS) or f"use one of {', '.join(VERBS)}"


def _complete(parser: argparse.ArgumentParser) -> None:
    """Answer the shell's request for completions, and exit."""
    try:
        from argcomplete import autocomplete
    except ImportError:
        sys.exit(1)
    autocomplete(parser)


def run(arguments: list[str] | None = None) -> int:
    """Run a verb; returns the exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    # The programs are small: a second thread of linear algebra waits for the other cores' work
    # much longer than it helps. It is read when numpy is first imported, by the verb below.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Whoever reaches a graph can read and stop it: it stays on this machine unless told otherwise.
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    options = _parse(words)
    # Ended by another process, or started in the background of a script where the shell has it
    # ignore Ctrl-C, a verb ends its nodes all the same.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    try:
        options.run(options)
        sys.stdout.flush()
    except TestbedError as error:
        print(f"socket-testbed {options.verb}: error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"socket-testbed {options.verb}: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of a pipe, such as head, has what it wanted.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        print(f"socket-testbed {options.verb}: error: {error}: check the output", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


if __name__ == "__main__":
    main()
