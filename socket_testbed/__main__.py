"""The command line: `socket-testbed VERB`, also `python -m socket_testbed VERB`."""

from __future__ import annotations

import argparse
import gc
import keyword
import os
import signal
import sys
from collections.abc import Callable
from pkgutil import resolve_name

if __name__ == "__main__" or sys.argv[0].endswith("socket-testbed"):
    # Ctrl-C during the other imports ends the program without a traceback, as it does later.
    signal.signal(signal.SIGINT, lambda number, frame: os._exit(130))

from socket_testbed.commands.arguments import Parser, add_options, release_paths
from socket_testbed.commands.calls import CALLS, GROUPS
from socket_testbed.errors import TestbedError, likely
from socket_testbed.version import __version__


def main() -> None:
    """Run a verb and exit: 0 on success, 1 on an error, 2 on a wrong call."""
    code = run()
    for number in (signal.SIGINT, signal.SIGTERM):  # a second one while the interpreter ends
        signal.signal(number, signal.SIG_IGN)
    sys.exit(code)


def _parse(words: list[str]) -> argparse.Namespace:
    """The verb and its options; a wrong call exits here with one line and code 2."""
    completed = os.environ.get("COMP_LINE") if "_ARGCOMPLETE" in os.environ else None
    if completed is not None:
        words = completed.split()[1:]
    parser = Parser(
        prog="socket-testbed",
        description="Software of an instrumented prosthetic-socket testbed.",
        allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    version = f"socket_testbed {__version__}"
    parser.add_argument("-V", "--version", action="version", version=version)
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    verb = next(iter(words), "-")
    called, arguments = parser, words
    if verb not in CALLS:
        parser.epilog = "\n\n".join(map(_described, GROUPS))
    for name in [verb] if verb in CALLS else CALLS:
        call = CALLS[name]
        example = f"example:\n  socket-testbed {name} {call.example}"
        subparser = verbs.add_parser(
            name,
            description=call.summary,
            epilog="\n\n".join(filter(None, [example, call.epilog])),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        if name == verb:
            add_options(subparser, call)
            called, arguments = subparser, [verb, *release_paths(words[1:], call)]
    if completed is not None:
        _complete(parser)
    called.words = words
    if not verb.startswith("-") and verb not in CALLS:
        hint = likely(verb, CALLS) or f"use one of {', '.join(CALLS)}"
        parser.exit(2, f"socket-testbed: error: unknown verb '{verb}': {hint}\n")
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        called.error(f"not understood: {' '.join(unknown)}")
    return options


def _described(title: str) -> str:
    """A group of verbs in the help, one per line."""
    summaries = (f"  {call.__name__.lower():<10} {call.summary}" for call in GROUPS[title])
    return "\n".join([f"{title}:", *summaries])


def _complete(parser: argparse.ArgumentParser) -> None:
    """Answer the shell's request for completions, and exit."""
    try:
        from argcomplete import autocomplete
    except ImportError:
        sys.exit(1)
    autocomplete(parser)


def _function_of(verb: str) -> Callable[..., None]:
    """Import the function of a verb."""
    function = verb + "_" * keyword.iskeyword(verb)
    # The imports make hundreds of thousands of objects, all of which stay.
    gc.disable()
    try:
        return resolve_name(f"socket_testbed.commands.{CALLS[verb].module}:{function}")
    finally:
        gc.freeze()
        gc.enable()


def run(arguments: list[str] | None = None) -> int:
    """Run a verb, and print an error as one line.

    The arguments are the words after `socket-testbed`; None for those of this process.

    Returns:
        The exit code: 0 on success, 1 on an error, 130 if the verb was interrupted.
    """
    words = sys.argv[1:] if arguments is None else arguments
    options = vars(_parse(words))
    verb = options.pop("verb")
    # A verb must stop its nodes even when it is terminated by another process, or runs in the
    # background of a script, where the shell ignores Ctrl-C.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    try:
        from socket_testbed.live.processes import graph_environment  # not for --help

        os.environ |= graph_environment()
        _function_of(verb)(**options)
        sys.stdout.flush()
    except TestbedError as error:
        print(f"socket-testbed {verb}: error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"socket-testbed {verb}: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of a pipe, such as head, has closed it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        print(f"socket-testbed {verb}: error: {error}: check the output", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


if __name__ == "__main__":
    main()
