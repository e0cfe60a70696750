"""Which tests execute which line of the package: recorded under coverage, for `mutants.py`.

This module is also the plugin of pytest that tells coverage which test or fixture runs. Processes
that a test starts record for that test.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]
PACKAGE = "socket_testbed"

# Environment variables for the plugin: a folder for records, a file with the order of the tests,
# and what runs just now.
_RECORDS, ORDER, _CONTEXT = "LINE_TESTS_RECORDS", "LINE_TESTS_ORDER", "LINE_TESTS_CONTEXT"
_NOT_COPIED = {".git", ".venv", "build", "install", "log", "demo", "trials"}
_SETTINGS = """
[run]
source = {source}
data_file = {folder}/coverage
parallel = true
sigterm = true
patch = _exit
context = ${{{context}-}}
disable_warnings = no-data-collected, module-not-imported, module-not-measured
"""


@dataclass(frozen=True)
class LineTests:
    """Which tests execute which lines.

    Attributes:
        seconds: Duration of each test that passes [s]; parameters of a test count as one.
        lines: For each file, relative to the checkout, and each line the tests that execute it.
    """

    seconds: dict[str, float]
    lines: dict[str, dict[int, set[str]]]

    def of(self, path: str, numbers: Sequence[int]) -> list[str]:
        """The tests that execute one of some lines, those of the module with the fastest first.

        Args:
            path: The file, relative to the checkout.
            numbers: Numbers of the lines, from 1.
        """
        lines = self.lines.get(path, {})
        found = {test for number in numbers for test in lines.get(number, ())}
        fastest: dict[str, float] = {}
        for test in sorted(found, key=self.seconds.__getitem__):
            fastest.setdefault(_module(test), self.seconds[test])
        return sorted(found, key=lambda t: (fastest[_module(t)], _module(t), self.seconds[t]))


def read_line_tests(graph: bool, chosen: Sequence[str], workers: int) -> LineTests:
    """The record in build/mutants, made anew if a file of the package or of the tests has changed.

    Args:
        graph: Whether to include the tests of node graphs.
        chosen: Files or folders of tests, relative to the checkout; empty for all.
        workers: Number of processes that run the tests.
    """
    state = hashlib.sha256(repr((graph, sorted(chosen))).encode())
    for file in sorted([*(CHECKOUT / PACKAGE).rglob("*.py"), *(CHECKOUT / "test").rglob("*.py")]):
        state.update(file.relative_to(CHECKOUT).as_posix().encode() + file.read_bytes())
    path = CHECKOUT / "build" / "mutants" / f"{state.hexdigest()[:16]}.json"
    if not path.exists():
        print("recording which test executes which line, once for this state", flush=True)
        with copied_checkout() as copy:
            record = _record(
                copy, "not slow" if graph else "not graph and not slow", chosen, workers
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(record))
    record = json.loads(path.read_text())
    names = record["names"]
    lines = {
        file: {int(line): {names[n] for n in tests} for line, tests in lines.items()}
        for file, lines in record["lines"].items()
    }
    return LineTests(record["seconds"], lines)


@contextmanager
def copied_checkout() -> Iterator[Path]:
    """A copy of the checkout that may be changed; it is removed at the end."""

    def ignored(folder: str, names: list[str]) -> set[str]:
        caches = {name for name in names if name == "__pycache__" or name.endswith("_cache")}
        return caches | (_NOT_COPIED if Path(folder) == CHECKOUT else set())

    with tempfile.TemporaryDirectory(prefix="mutants_") as folder:
        copy = Path(folder).resolve() / "checkout"
        shutil.copytree(CHECKOUT, copy, ignore=ignored)
        yield copy


def test_command(*words: str) -> list[str]:
    """The command that runs tests with this plugin, in the folder of a copied checkout."""
    return [sys.executable, "-m", "pytest", "-q", "--tb=no", "-p", "no:cacheprovider", *words]


def environment(copy: Path, **more: str) -> dict[str, str]:
    """Environment in which Python finds the package in a copied checkout, and pytest this plugin.

    Args:
        copy: The folder of the copied checkout.
        more: Further variables.
    """
    places = os.pathsep.join([str(copy), str(Path(__file__).parent)])
    return os.environ | {"PYTHONPATH": places, "PYTEST_PLUGINS": Path(__file__).stem} | more


def _record(copy: Path, marks: str, chosen: Sequence[str], workers: int) -> dict[str, Any]:
    """Run the tests under coverage; returns the content of the record's file."""
    import coverage

    folder = copy.parent / "records"
    folder.mkdir()
    settings = folder / "coveragerc"
    settings.write_text(_SETTINGS.format(source=copy / PACKAGE, folder=folder, context=_CONTEXT))
    command = test_command("-n", str(workers), "--dist", "loadfile", "-m", marks, *chosen)
    variables = {"COVERAGE_PROCESS_START": str(settings), _RECORDS: str(folder)}
    subprocess.run(command, check=False, cwd=copy, env=environment(copy, **variables))
    tests: dict[str, dict[str, Any]] = {}
    for part in folder.glob("tests-*.json"):
        tests |= json.loads(part.read_text())
    if failed := [name for name, test in tests.items() if not test["passed"]]:
        print("tests that fail without any change do not count:", *failed, sep="\n  ")
    passed = {name: test for name, test in tests.items() if test["passed"]}
    if not passed:
        raise SystemExit("error: no test passes: run them, or name others with --tests")
    tests_in = defaultdict(set)  # by context
    for name, test in passed.items():
        tests_in[name].add(name)
        for context in test["fixtures"]:
            tests_in[context].add(name)
    combined = coverage.Coverage(data_file=str(folder / "coverage"), config_file=str(settings))
    combined.combine([str(folder)])
    data, numbers = combined.get_data(), {name: n for n, name in enumerate(passed)}
    lines: dict[str, dict[int, list[int]]] = {}
    for file in data.measured_files():
        by_line = {
            line: sorted({numbers[test] for context in contexts for test in tests_in[context]})
            for line, contexts in data.contexts_by_lineno(file).items()
        }
        lines[Path(file).relative_to(copy).as_posix()] = {n: t for n, t in by_line.items() if t}
    seconds = {name: test["seconds"] for name, test in passed.items()}
    return {"names": [*passed], "seconds": seconds, "lines": lines}


# --- the plugin

_tests: dict[str, dict[str, Any]] = {}  # that ran in this process


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests into the order that a file gives."""
    if order := os.environ.get(ORDER):
        places = {name: n for n, name in enumerate(json.loads(Path(order).read_text()))}
        items.sort(key=lambda item: places[_function(item.nodeid)])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, Any, Any]:
    """Record the lines that a test executes."""
    name = _function(item.nodeid)
    _tests.setdefault(name, {"seconds": 0.0, "passed": True, "fixtures": []})
    with _context(name):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(
    fixturedef: pytest.FixtureDef[Any], request: pytest.FixtureRequest
) -> Generator[None, Any, Any]:
    """Record the lines that a shared fixture executes, for all tests that use it."""
    if fixturedef.scope == "function":
        return (yield)
    with _context(_shared(fixturedef)):
        return (yield)


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """Note the shared fixtures that a test uses, whether it set them up or another test did."""
    fixtures = _tests[_function(item.nodeid)]["fixtures"]
    for definitions in item._fixtureinfo.name2fixturedefs.values():  # type: ignore[attr-defined]
        fixtures += {_shared(each) for each in definitions if each.scope != "function"}


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note the time that a test takes, and whether it passes."""
    if test := _tests.get(_function(report.nodeid)):
        test["seconds"] += report.duration
        test["passed"] &= not report.failed


def pytest_sessionfinish() -> None:
    """Write what this process noted."""
    if folder := os.environ.get(_RECORDS):
        Path(folder, f"tests-{os.getpid()}.json").write_text(json.dumps(_tests))


@contextmanager
def _context(name: str) -> Iterator[None]:
    """Lines executed meanwhile, here or by new processes, belong to a test or a shared fixture."""
    if _RECORDS not in os.environ:
        yield
        return
    import coverage

    current, outside = coverage.Coverage.current(), os.environ.get(_CONTEXT, "")
    assert current is not None, "coverage did not start with Python"
    os.environ[_CONTEXT] = name
    current.switch_context(name)
    try:
        yield
    finally:
        os.environ[_CONTEXT] = outside
        current.switch_context(outside)


def _shared(fixture: pytest.FixtureDef[Any]) -> str:
    """The context of a shared fixture."""
    return f"{fixture.argname} of {fixture.baseid}"


def _function(nodeid: str) -> str:
    """The name of a test without its parameters."""
    return nodeid.partition("[")[0]


def _module(test: str) -> str:
    return test.partition("::")[0]
