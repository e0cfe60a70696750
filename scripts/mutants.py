"""Which small changes to the package would no test notice?

    make mutants                                               what a branch changes
    make mutants MUTANTS="socket_testbed/geometry --count 10"  files or folders

Changes one value at a time (`mutations.py`) in a copy of the checkout, and runs the tests that
execute it there, the fastest first, until one fails. A change that passes them all has survived:
a test is missing, or the change does not matter. `line_tests.py` records once which test executes
which line; that takes as long as `make test`, and again after each change of package or tests.

Without files, those that differ from the merge base with `main`, or on `main` itself from the last
commit but one. A line that runs once for all tests, at import or behind a cache, counts as
executed by each test that runs a function of its file.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
from collections import Counter, defaultdict
from contextlib import suppress
from itertools import accumulate
from pathlib import Path

from line_tests import (
    CHECKOUT,
    ORDER,
    PACKAGE,
    copied_checkout,
    environment,
    read_line_tests,
    test_command,
)
from mutations import Mutant, find_sites

_LEAST_WAIT = 60.0  # [s]; of a timeout, for the start of pytest and shared fixtures
_SLOWER = 5.0  # [-]; times that the tests of a mutant may take longer than without it
_NO_TESTS = 5  # pytest's exit code if it finds none

KILLED, SURVIVED, NOT_COVERED = "killed", "survived", "not covered"


def changed_files() -> list[str]:
    """Files of the package that a branch changes, or on `main` its last commit."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(CHECKOUT), *words]
        return subprocess.run(command, check=False, capture_output=True, text=True).stdout.strip()

    base, head = git("merge-base", "HEAD", "main"), git("rev-parse", "HEAD")
    base = base if base not in {"", head} else "HEAD~1"
    return git("diff", "--name-only", "--diff-filter=d", base, "--", f"{PACKAGE}/*.py").split()


def chosen_files(places: list[Path]) -> list[str]:
    """Python files in files or folders of the package, relative to the checkout."""
    files = {file for place in places for file in (place, *place.rglob("*.py"))}
    return sorted(
        file.resolve().relative_to(CHECKOUT).as_posix() for file in files if file.suffix == ".py"
    )


def passes(copy: Path, tests: list[str], seconds: float) -> bool | None:
    """Whether a changed copy of the checkout passes tests; None if pytest finds none of them.

    Args:
        copy: The folder of the copy.
        tests: The tests, in the order in which they run until one fails.
        seconds: Their duration without the change [s]; a change that hangs does not pass.
    """
    order = copy.parent / "order.json"
    order.write_text(json.dumps(tests))
    child = subprocess.Popen(
        test_command("-x", *tests),
        cwd=copy,
        env=environment(copy, **{ORDER: str(order)}),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        code = child.wait(_LEAST_WAIT + _SLOWER * seconds)
    except subprocess.TimeoutExpired:
        return False
    finally:
        with suppress(ProcessLookupError):  # usually all have ended
            os.killpg(child.pid, signal.SIGKILL)
        child.wait()
    return None if code == _NO_TESTS else code == 0


def judge(copy: Path, mutant: Mutant, tests: list[str], seconds: float) -> str:
    """Run the tests of a mutant; prints a survivor. Returns how it ends.

    Args:
        copy: The folder of the copied checkout.
        mutant: The mutant.
        tests: The tests to run.
        seconds: Their duration without the change [s].
    """
    if not tests:
        return NOT_COVERED
    file = copy / mutant.path
    source = file.read_bytes()
    file.write_bytes(mutant.apply(source))
    try:
        passed = passes(copy, tests, seconds)
    finally:
        file.write_bytes(source)
    if passed:
        print(f"{mutant.describe(source)}  ({len(tests)} tests)", flush=True)
    return NOT_COVERED if passed is None else SURVIVED if passed else KILLED


def print_rates(ends: dict[str, Counter[str]]) -> None:
    """Print how many mutants of each folder ended how, and the share that was killed."""
    columns = (KILLED, SURVIVED, NOT_COVERED)
    print("\n" + f"{'folder':40}" + "".join(f"{name:>13}" for name in columns) + "   kill rate")
    for folder, counts in sorted(ends.items()):
        numbers = "".join(f"{counts[name]:13}" for name in columns)
        print(f"{folder:40}{numbers} {100.0 * counts[KILLED] / counts.total():9.0f} %")


def main() -> None:
    """Make mutants, run their tests, print the survivors and the kill rates."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    add = parser.add_argument
    add("places", nargs="*", type=Path, help="files or folders of the package")
    add("--count", type=int, default=40, help="number of mutants (default: 40)")
    add("--seed", type=int, default=0, help="of the choice of mutants (default: 0)")
    add("--graph", action="store_true", help="also run the tests that start node graphs")
    within = "run the first tests of a mutant that take so many seconds together (default: 120)"
    add("--within", type=float, default=120.0, metavar="S", help=within)
    add("--tests", nargs="+", default=[], metavar="PATH", help="tests to run (default: all)")
    add("--workers", type=int, default=3, help="processes that record lines (default: 3)")
    given = parser.parse_args()

    files = chosen_files(given.places) if given.places else changed_files()
    sites = [site for file in files for site in find_sites(CHECKOUT, file)]
    in_functions: dict[str, list[int]] = defaultdict(list)  # lines by file
    for mutant in (mutant for site in sites for mutant in site):
        in_functions[mutant.path] += [] if mutant.once else mutant.lines
    draw = random.Random(given.seed)
    mutants = [draw.choice(site) for site in draw.sample(sites, min(given.count, len(sites)))]
    print(f"{len(mutants)} mutants, of {len(sites)} places in {len(files)} files", flush=True)
    recorded = read_line_tests(given.graph, given.tests, given.workers)
    ends: dict[str, Counter[str]] = defaultdict(Counter)
    with copied_checkout() as copy:
        for mutant in mutants:
            lines = in_functions[mutant.path] if mutant.once else mutant.lines
            tests = recorded.of(mutant.path, lines)
            sums = [*accumulate(recorded.seconds[test] for test in tests)]
            fitting = max(1, sum(total <= given.within for total in sums))
            seconds = sums[fitting - 1] if tests else 0.0
            end = judge(copy, mutant, tests[:fitting], seconds)
            ends[Path(mutant.path).parent.as_posix()][end] += 1
    print_rates(ends)


if __name__ == "__main__":
    main()
