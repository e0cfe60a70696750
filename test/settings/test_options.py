"""Options stand once: the signatures, docstrings and keywords of the API agree with them."""

import inspect
import re
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest

import socket_testbed as st
from socket_testbed.commands import calls
from socket_testbed.errors import ConfigurationError
from socket_testbed.settings import options
from socket_testbed.socket_design.tiling import TilingSettings

TAKEN: dict[Callable[..., Any], type[options.Options]] = {
    st.annotate: options.MetadataOptions,
    st.calibrate: options.CalibrationOptions,
    st.compare: options.ComparisonOptions,
    st.evaluate: options.EvaluationOptions,
    st.export: options.ExportOptions,
    st.fit: options.FitOptions,
    st.force_map: options.MapOptions,
    st.import_trial: options.ImportOptions,
    st.open_trial: options.OpenOptions,
    st.pareto: options.FrontOptions,
    st.paper: options.PaperOptions,
    st.pressure: options.PressureOptions,
    st.register: options.RegistrationOptions,
    st.simulate: options.SimulationOptions,
    st.tile: options.TileOptions,
    st.validate: options.ValidationOptions,
    st.view: options.PageOptions,
    st.write_report: options.ReportOptions,
}
OWN = {(st.view, "port")}  # any free port, where a verb has one that is known
FREE = {"columns", "units"}  # mappings, which are words on the command line


def explained(function: Callable[..., Any]) -> dict[str, str]:
    """The entries of `Args:`, in the form of the help."""
    section = (inspect.getdoc(function) or "").partition("\nArgs:\n")[2]
    section = re.split(r"^\S", section, maxsplit=1, flags=re.MULTILINE)[0]
    found = re.findall(r"^    (\w+): (.*?)(?=^    \w|\Z)", section, re.DOTALL | re.MULTILINE)
    return {name: as_help(" ".join(text.split())) for name, text in found}


def as_help(text: str) -> str:
    text = re.sub(r"^Whether (to )?|, see `[^`]*`|`|\.$", "", text)
    return text[0].lower() + text[1:] if text[1:2].islower() or text[1:2] == " " else text


PAIRS = [
    pytest.param(function, item, id=f"{function.__name__}-{item.name}")
    for function, kind in TAKEN.items()
    for item in fields(kind)
    if item.name in inspect.signature(function).parameters
]


@pytest.mark.parametrize(("function", "item"), PAIRS)
def test_an_option_has_one_text(function: Callable[..., Any], item: Any) -> None:
    """A docstring says what the help says, or where it is said."""
    found = explained(function)[item.name]
    assert found == as_help(item.metadata["text"]) or found.startswith("as ")


@pytest.mark.parametrize(("function", "item"), PAIRS)
def test_an_option_has_one_default(function: Callable[..., Any], item: Any) -> None:
    default = inspect.signature(function).parameters[item.name].default
    if (function, item.name) not in OWN and item.name not in FREE:
        assert default == (inspect.Parameter.empty if item.default is MISSING else item.default)


@pytest.mark.parametrize("function", TAKEN, ids=lambda function: function.__name__)
def test_an_option_has_its_parameter(function: Callable[..., Any]) -> None:
    known = {*inspect.signature(function).parameters}
    assert {item.name for item in fields(TAKEN[function])} <= known


def test_an_override_is_a_setting_that_is_given() -> None:
    """Not the prior of a report, which is a survey, though a setting has this name."""
    given = {"theta": 0.25, "leave_out": ["Mz"], "smoothness": 0.0}
    assert options.SettingsOptions(params=Path("a"), **given).overrides() == given
    assert options.ReportOptions(prior=Path("a"), thetas=3, frames=0).overrides() == {"frames": 0}
    assert options.PaperOptions().overrides() == {"weights": "raw", "frames": 1000}


METAVARS = {
    **{"jobs": {"N"}, "dask": {"ADDRESS"}, "record": {"DIR"}, "model": {"MODEL"}},
    **{"tare": {"T0:T1", "T0:T1|none|recorded"}, "unloaded": {"T0:T1"}, "tap": {"T0:T1"}},
    **{"segment": {"plateau|hold|auto|all|T0:T1|event:A:B"}, "cycles": {"LABEL"}},
    **{"columns": {"QUANTITY=HEADER", "WHAT=TITLE"}, "units": {"QUANTITY=UNIT", "WHAT=UNIT"}},
    **{"wrench": {"TOPIC"}, "socket_pose": {"TOPIC"}, "pylon_pose": {"TOPIC"}},
    **{"trigger": {"TOPIC"}, "clusters": {"N", "TOPIC"}},  # of 'tile', of 'import'
    **{"offset": {"SOURCE=S"}, "delay": {"SOURCE=S"}, "row_rate": {"SOURCE=HZ"}},
    **{"fault": {"NAME=VALUE"}, "condition": {"NAME=TRIAL,..."}, "points": {"'X Y Z'"}},
    **{"donning": {"SEED"}, "wiring": {"C"}, "leave_out": {"CHANNEL"}, "like": {"TRIAL"}},
    **{"prior": {"SURVEY"}, "initial_stiffness": {"K0|auto"}},
}
CALLS = [
    kind
    for kind in vars(calls).values()
    if isinstance(kind, type) and is_dataclass(kind) and kind.__module__ == calls.__name__
]


def test_the_help_shows_what_an_option_takes() -> None:
    """Without an own word it shows the unit, or the name."""
    found: dict[str, set[str]] = {}
    for item in (item for kind in CALLS for item in fields(kind)):
        if word := item.metadata.get("metavar"):
            found.setdefault(item.name, set()).add(word)
    assert found == METAVARS


TRIAL, FOLDER = "folder of the trial", "folder of the trial, or a folder of trials"
ARGUMENTS = {
    **dict.fromkeys(("Info", "Replay", "Export", "Map", "Pareto", "Paper"), TRIAL),
    **dict.fromkeys(("Report", "Pressure", "Fit", "Evaluate"), FOLDER),
    "Annotate": "folders of one or more trials",
    "Compare": "two or more trials; a folder of trials stands for all of them",
    "Survey": (
        "two or more trials of one limb in one socket; a folder of trials stands for all of them"
    ),
    "Validate": "trials, or folders of trials, of one socket",
    "View": "folder of a trial to play; without one the running testbed is shown",
    "Record": "folder of the new trial",
    "Mark": "label of the event, such as push",
    "Import": "folder or storage file of a bag, or tables",
    "Register": "the take, exported from Motive as CSV",
    "Calibrate": "CSV files of bench data, see docs/calibration.md",
    "Tile": "STL, PLY or OBJ file",
}


def test_the_help_says_what_a_verb_is_called_with() -> None:
    found = {
        kind.__name__: item.metadata["text"]
        for kind in CALLS
        for item in fields(kind)
        if item.metadata.get("positional") and not kind.__name__.endswith("Options")
    }
    assert found == ARGUMENTS


def test_a_tiling_has_the_defaults_of_its_verb() -> None:
    """30 mm and 8 mm, in m."""
    usual = {item.name: item.default for item in fields(calls.Tile)}
    assert (usual["size"], usual["flatness"]) == (30.0, 8.0)
    assert TilingSettings() == TilingSettings(0.030, 0.008, usual["rounds"], usual["seed"])


def test_a_verb_is_called_with_its_own_arguments() -> None:
    asked: list[Any] = []
    verb = calls.takes(calls.Mark)(asked.append)
    verb("push", namespace="/left")
    assert asked == [calls.Mark("push", namespace="/left")]
    with pytest.raises(TypeError, match="nmespace"):
        verb("push", nmespace="/left")  # type: ignore[call-arg]


SEEDS = (0, None)
RANGES: dict[str, tuple[float, float | None]] = {
    "calibrate limit": (0.0, 100.0),
    "compare threshold": (0.0, 500.0),
    "demo seed": SEEDS,
    "doctor period": (5.0, 3600.0),
    "doctor seed": SEEDS,
    "evaluate jobs": (1, None),
    "fit jobs": (1, None),
    "import rate": (0.1, 1000.0),
    "paper thetas": (2, 10_001),
    "pareto thetas": (2, 10_001),
    "pressure threshold": (0.0, 500.0),
    "pressure share": (0.0, 5.0),
    "pressure jobs": (1, None),
    "report thetas": (2, 10_001),
    "report jobs": (1, None),
    "run period": (5.0, 3600.0),
    "run seed": SEEDS,
    "run duration": (0.1, 1e6),
    "simulate duration": (1.0, 36_000.0),
    "simulate rate": (0.1, 1000.0),
    "simulate seed": SEEDS,
    "survey clusters": (0, 64),
    "tile place": (0, 1000),
    "tile height": (0.0, 1000.0),
    "tile size": (5.0, 100.0),
    "tile rounds": (0, 100_000),
    "tile seed": SEEDS,
    "view duration": (0.1, 1e6),
}


def called(verb: str, **given: Any) -> Any:
    """A call of a verb, with a path for all that must be given."""
    kind: Any = calls.CALLS[verb]
    missing = {f.name: Path("a") for f in fields(kind) if f.default is MISSING}
    return kind(**missing | given)


@pytest.mark.parametrize("option", RANGES)
def test_an_option_is_refused_beyond_its_range(option: str) -> None:
    verb, name = option.split()
    low, high = RANGES[option]
    for value in (low, low if high is None else high):
        assert getattr(called(verb, **{name: value}), name) == value
    step = 1 if isinstance(low, int) else 0.01
    for value in (low - step, low - step if high is None else high + step):
        with pytest.raises(ConfigurationError, match=f"--{name} is "):
            called(verb, **{name: value})


def test_no_other_option_has_a_range() -> None:
    ranged = {
        f"{verb} {item.name}"
        for verb, call in calls.CALLS.items()
        for item in fields(call)
        if item.metadata.get("limits", options.UNLIMITED) != options.UNLIMITED
    }
    assert ranged == {*RANGES}


def test_a_whole_number_stays_one() -> None:
    assert isinstance(called("simulate", seed=3.0).seed, int)
    with pytest.raises(ConfigurationError, match="a whole number"):
        called("simulate", seed=0.5)
