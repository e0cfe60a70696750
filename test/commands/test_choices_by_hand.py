"""What verbs decide besides their numbers: which note, trial, option and order, by hand."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from socket_testbed import api
from socket_testbed.commands import live, pages, results, running, terminal, trials
from socket_testbed.commands.arguments import Parser, _help, add_options, release_paths
from socket_testbed.commands.calls import CALLS, ConfigurationOptions, Fit
from socket_testbed.commands.terminal import StatusLine
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.files import packaged
from socket_testbed.identification.data_finding import GOOD
from socket_testbed.live.bringup import Testbed
from socket_testbed.settings.options import TrialFiles
from socket_testbed.settings.testbed import TestbedSettings
from socket_testbed.simulation.testbed import Simulation
from socket_testbed.trials.trial import Trial

# --- reports and notes


class Reported:
    """A trial with these findings, and what was noted of it."""

    def __init__(self, *found: str) -> None:
        self.found, self.notes, self.left = found, list[str](), list[Any]()
        self.note = self.notes.append

    def problems(self, left: Any) -> tuple[str, ...]:
        self.left.append(left)
        return self.found


def reported(trial: Any, good: bool = True, leave_out: Any = None) -> str:
    return running.report_data(trial, good, leave_out)


def test_the_first_finding_stands_for_all() -> None:
    trial = Reported("data: repair: a dead channel", "data: look at: a spike")
    assert reported(trial, good=False, leave_out=["Mz"]) == "repair: a dead channel"
    assert trial.notes == [*trial.found] and trial.left == [("Mz",)]


@pytest.mark.parametrize(("good", "noted"), [(True, [GOOD]), (False, [])], ids=["alone", "batch"])
def test_good_data_is_reported_of_one_trial(good: bool, noted: list[str]) -> None:
    trial = Reported()
    assert reported(trial, good) == GOOD.removeprefix("data: ")
    assert trial.notes == noted and trial.left == [None]


def test_an_unreadable_trial_s_error_is_the_verb_s() -> None:
    def fail(left: Any) -> None:
        raise TrialError("no bag", "record it")

    trial: Any = SimpleNamespace(problems=fail)
    assert reported(trial) == ""


def test_notes_of_several_trials_name_them_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    below = {"s01/a": tmp_path / "a", "s01/b": tmp_path / "b"}
    monkeypatch.setattr(
        running, "find_trials", lambda path, note: below if path.name == "s01" else {}
    )
    found = running.open_all([tmp_path / "c", tmp_path / "s01"], TrialFiles(tare="none"))
    assert [trial.name for trial in found] == ["c", "a", "b"]
    assert {trial.tare for trial in found} == {"none"}
    for note in ("late", "a: wet", "late"):
        found[1].note(note)
    assert capsys.readouterr().err == "note: a: late\nnote: a: wet\n"


def test_a_page_has_the_typed_command(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["/opt/bin/socket-testbed", "report", "my trial", "-o", "a.html"]
    monkeypatch.setattr(sys, "argv", words)
    assert running.typed_command() == "socket-testbed report 'my trial' -o a.html"


# --- compare


def test_a_condition_s_words_add_up() -> None:
    found = pages._conditions(["gel=a,b", "sock=c", "gel=d,"])
    assert found == {"gel": [Path("a"), Path("b"), Path("d")], "sock": [Path("c")]}


def test_equal_texts_are_printed_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [
        ("trials", "socket", "a", "PTB"), ("trials", "socket", "b", "PTB"),
        ("metadata", "side", "a", "left"), ("metadata", "side", "b", "right"),
    ]  # fmt: skip
    table = pd.DataFrame(rows, columns=["part", "name", "item", "text"])
    cells = pd.DataFrame(
        {"a": ["1"]}, pd.MultiIndex.from_tuples([("socket", "q")], names=["name", "quantity"])
    )
    found: Any = SimpleNamespace(
        kind="trials", items=("a", "b"), title="all of it", notes=("late",), table=table,
        cells=lambda part, quantity=None: cells.droplevel("quantity") if quantity else cells,
        differing=lambda: ["2 of 9", "first", "second"],
    )  # fmt: skip
    pages._show_comparison(found)
    lines = capsys.readouterr().out.splitlines()
    assert lines[:4] == ["trials a, b: all of it", "note: late", "", "whole socket"]
    place = lines.index("2 of 9")
    assert lines[place - 3 : place - 1] == ["socket: PTB", "side: a: left; b: right"]
    assert lines[place - 1 : place + 3] == ["", "2 of 9", "  first", "  second"]
    titles = ("whole socket", "mean pressure by region", "peak pressure by region")
    order = [lines.index(title) for title in (*titles, "share of load by region", "wrench")]
    assert order == sorted(order) and "limb in the socket" not in lines


# --- run, replay


def held(tmp_path: Path, name: str) -> Path:
    folder = tmp_path / name
    folder.mkdir()
    (folder / f"{name}.mcap").touch()
    return folder


def test_trials_that_are_written_do_not_count(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    names = ("s[1]", "s[1]_2", "s2", "s1")
    folders = {name: held(tmp_path, name) for name in names}
    monkeypatch.setattr(live, "is_held", lambda folder: folder.name == "s[1]_2")
    assert live._trials(tmp_path, "s[1]") == {folders["s[1]"]}
    assert live._trials(tmp_path, "") == {folders[name] for name in ("s[1]", "s2", "s1")}


CHOICES = {"theta": 0.25}, {"leave_out": ["Mz"]}, {"variant": "rigid"}, {"model": Path("m.json")}


@pytest.mark.parametrize("given", CHOICES, ids=lambda given: next(iter(given)))
def test_a_replay_without_estimator_has_no_settings(
    given: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(live, "report_data", lambda trial, **given: "")
    name = next(iter(given)).replace("_", "-")
    with pytest.raises(ConfigurationError) as found:
        live.replay(tmp_path, **given)
    assert str(found.value) == f"--{name} is for the estimator: add --estimate"


@pytest.mark.parametrize(
    ("simulation", "registration", "noted"),
    [(None, "", True), (None, "take.csv", False), (Simulation(), "", False)],
    ids=["nominal", "registered", "simulated"],
)
def test_nominal_bodies_of_hardware_are_noted(
    simulation: Any,
    registration: str,
    noted: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    files = (packaged("config", "socket.yaml"), packaged("config", "calibration.yaml"))
    settings = TestbedSettings()
    monkeypatch.setattr(live.bringup, "testbed_settings", lambda params, simulation: settings)
    monkeypatch.setattr(live.bringup, "testbed_files", lambda *given: files)
    socket = SimpleNamespace(registration=registration, bodies="they are nominal")
    monkeypatch.setattr(live, "read_socket", lambda path: socket)
    found = live.configured(simulation, ConfigurationOptions())
    assert isinstance(found, Testbed) and (found.geometry, found.calibration) == files
    told = f"note: {files[0]}: they are nominal\n" if noted else ""
    assert capsys.readouterr().err == told


def test_an_automatic_scale_is_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    speed = SimpleNamespace(time_scale=lambda: 0.25)
    monkeypatch.setattr(live, "measure_speed", lambda: speed)
    monkeypatch.setattr(live, "busy_note", lambda scale: f"busy: {scale:g}")
    assert live._time_scale("auto") == 0.25
    assert capsys.readouterr().err == "busy: 0.25\n"


@pytest.mark.parametrize(
    ("keys", "pressed"),
    [(b" ", True), (b"  ", False), (b" x ", False), (b"x", False), (b"   ", True)],
    ids=["once", "twice", "twice apart", "another", "thrice"],
)
def test_two_presses_undo_each_other(
    keys: bytes, pressed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    status = StatusLine()
    status._has_keys = True
    monkeypatch.setattr(terminal, "_in_foreground", lambda: True)
    monkeypatch.setattr(terminal.select, "select", lambda *given: ([0], [], []))
    monkeypatch.setattr(terminal.os, "read", lambda *given: keys)
    assert status._is_pressed() is pressed


# --- info


def test_topics_are_sorted_with_their_rates() -> None:
    """Nine messages in 2 s are eight periods, 4 Hz; a single one has no rate."""
    bag: Any = SimpleNamespace(
        duration=2.0, counts={"/b": 9, "/a": 1, "/c": 0},
        types={"/a": "pkg/msg/A", "/b": "pkg/msg/B", "/c": "pkg/msg/C"},
    )  # fmt: skip
    lines = [" ".join(line.split()) for line in trials._topics(Path("s01"), bag).splitlines()]
    assert lines[:2] == ["s01: 10 messages in 2.00 s", "topic type messages Hz"]
    assert lines[3:] == [
        "/a pkg/msg/A 1 0.00",
        "/b pkg/msg/B 9 4.00",
        "/c pkg/msg/C 0 0.00",
    ]
    bag.duration = 0.0
    assert trials._topics(Path("s01"), bag).splitlines()[-1].split()[-1] == "0.00"


def test_an_export_says_what_it_wrote(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    table = pd.DataFrame(np.zeros((4, 3)))
    table.attrs = {"segment": "hold 1.00 s to 2.00 s", "rows": "4 samples", "notes": ("no mocap",)}
    monkeypatch.setattr(trials, "open_checked", lambda trial, options: Trial(trial))
    asked: list[Any] = []

    def export(trial: Any, output: Path, *, force_map: bool, pressure: bool, **others: Any) -> Any:
        asked.append((force_map, pressure))
        return table

    monkeypatch.setattr(api, "export", export)
    output = tmp_path / "a.csv"
    trials.export(Path("s01"), output=output, map=True, pressure=False)
    assert capsys.readouterr().out.splitlines() == [
        f"s01: hold 1.00 s to 2.00 s, 4 samples, 3 columns in {output}",
        "note: no mocap",
    ]
    assert asked == [(True, False)]


# --- cycles of the pressure


def test_cycles_show_the_last_of_the_regions(monkeypatch: pytest.MonkeyPatch) -> None:
    """The user's own come last; with more than twelve the first are not drawn."""
    names = [f"r{k}" for k in range(14)]
    frame = pd.DataFrame({f"{name}.mean pressure [kPa]": [1.0] for name in names})
    found: Any = SimpleNamespace(
        over_time=lambda: frame, trial="t", segment="all", places="all of them"
    )
    monkeypatch.setattr(
        results, "main_regions", lambda places: [SimpleNamespace(name=name) for name in names]
    )
    shown: list[Any] = []

    def cycles(trial: Any, table: pd.DataFrame, *, by: str, segment: str) -> str:
        shown.append(([*table], by))
        return "cycles"

    monkeypatch.setattr(api, "cycles", cycles)
    monkeypatch.setattr(results, "draw", lambda drawn, **given: None)
    results._bring_to_cycles(found, "step", None, figure=Path("a.png"))
    assert [len(titles) for titles, _ in shown] == [14, 12]
    assert shown[1] == ([f"r{k}.mean pressure [kPa]" for k in range(2, 14)], "step")


# --- the help

TEXTS: dict[str, tuple[str, Any, str]] = {
    "switch": ("draw it", False, "draw it"),
    "per cent": ("a file of 50 % or more", None, "a file of 50 %% or more"),
    "number": ("weight [-]", 0.25, "weight (default: 0.25)"),
    "count": ("samples; 0: all [1]", 0, "samples; 0: all (default: 0)"),
    "unit": ("length [s]", 2.0, "length [s] (default: 2)"),
    "small": ("weight", 1e-3, "weight (default: 0.001)"),
    "own": ("weight (default: the usual one)", 0.5, "weight (default: the usual one)"),
    "empty": ("names", (), "names"),
    "text": ("segment", "plateau", "segment (default: plateau)"),
}


@pytest.mark.parametrize("case", TEXTS)
def test_a_description_becomes_a_help(case: str) -> None:
    text, default, shown = TEXTS[case]
    assert _help(text, default) == shown


@pytest.mark.parametrize(
    ("verb", "words", "moved"),
    [
        ("fit", ["--leave-out", "Mz", "a/hold"], ["a/hold", "--leave-out", "Mz"]),
        ("fit", ["--leave-out", "a/b", "c/d"], ["c/d", "--leave-out", "a/b"]),
        (
            "fit",
            ["--leave-out", "Mz", "--theta", "0.5"],
            ["--leave-out", "Mz", "--theta", "0.5"],
        ),
        ("calibrate", ["--columns", "c0=a", "c1=b/c"], ["--columns", "c0=a", "c1=b/c"]),
        ("fit", ["a/hold", "--leave-out", "Mz"], ["a/hold", "--leave-out", "Mz"]),
    ],
    ids=["after", "first value", "option", "assignment", "before"],
)
def test_a_path_behind_a_list_is_the_trial(verb: str, words: list[str], moved: list[str]) -> None:
    assert release_paths(words, CALLS[verb]) == moved


def test_options_of_several_trials_have_their_heading() -> None:
    parser = Parser()
    add_options(parser, Fit)
    groups = {group.title: group for group in parser._action_groups}
    several = {action.dest for action in groups["for a folder of trials"]._group_actions}
    assert {"jobs", "dask", "again"} <= several and "theta" not in several
