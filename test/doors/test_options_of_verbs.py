"""Every option of every verb arrives where it has its effect, and changes nothing else.

A case holds the words of an option and what they change at the next layer, compared with the call
without them. A new option without a case is an error.
"""

import functools
import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from support.arrivals import (
    Stage,
    call_verb,
    changes,
    defaults_of_verb,
    joined,
    plain,
    write_files,
)

from socket_testbed import api
from socket_testbed.__main__ import _parse
from socket_testbed.commands.calls import CALLS
from socket_testbed.errors import TestbedError
from socket_testbed.trials.trial import Trial


@pytest.fixture(scope="module")
def folder(scene_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the scene twice, its files, models, and settings; calls are made in it."""
    path = tmp_path_factory.mktemp("verbs")
    for name in ("scene", "second"):
        (path / name).mkdir()
        for file in scene_folder.iterdir():
            (path / name / file.name).symlink_to(file)
    for name in ("socket.yaml", "calibration.yaml"):
        (path / name).symlink_to(scene_folder / name)
    write_files(path)
    return path


@pytest.fixture
def stage(folder: Path, trial: Trial, monkeypatch: pytest.MonkeyPatch) -> Iterator[Stage]:
    """The stage for calls of one verb, in the folder of the files."""
    monkeypatch.chdir(folder)
    return Stage(monkeypatch, trial)


class Result:
    """Stands for a result of the API: keeps how it is written, drawn and shown."""

    notes: Any = ()
    geometry = SimpleNamespace(registration="by hand")
    existing = None
    name = "distal"
    outputs = SimpleNamespace(source="by hand")

    def __init__(self, stage: Stage) -> None:
        self._seen = stage

    def save(self, path: Path, *limits: Any, **choices: Any) -> None:
        self._seen.seen |= {"saved": plain(path), "limits": limits, "choices": choices}

    def draw(self, path: Path, width: int, title: bool) -> None:
        self._seen.seen |= {"drawn": plain(path), "width": width, "title": title}

    def to_json(self) -> str:
        self._seen.seen["as JSON"] = True
        return "{}"

    def facts(self) -> list[tuple[str, str]]:
        return [("a fact", "it is")]


def described(trial: Trial) -> dict[str, Any]:
    """How a trial was opened."""
    files = (trial.path, trial.socket_file, trial.calibration_file, trial.load_cell_file)
    names = ("trial", "socket", "calibration", "load cell")
    found = {name: plain(file) for name, file in zip(names, files, strict=True)}
    return found | {"unloaded": trial.unloaded, "tare": trial.tare}


def stand_in(stage: Stage, name: str, result: Any = None) -> None:
    """Replace a function of the API by one that keeps its arguments."""
    real = getattr(api, name)

    @functools.wraps(real)
    def called(*given: Any, **named: Any) -> Any:
        bound = inspect.signature(real).bind(*given, **named).arguments
        arrived = {key: value for key, value in bound.items() if key not in ("choices", "items")}
        for key, value in (arrived | bound.get("choices", {})).items():
            if isinstance(value, Trial):
                stage.seen |= described(value)
            elif key in ("trials", "conditions"):
                continue
            elif key == "settings":
                stage.seen |= vars(value)
            else:
                stage.seen[key] = plain(value)
        several = bound.get("trials", ()) or bound.get("items", ())
        groups = bound.get("conditions") or ({"": several} if several else {})
        for group, trials in groups.items():
            stage.seen[f"trials {group}".strip()] = [plain(each.path) for each in trials]
            for each in trials:
                opened = described(each)
                del opened["trial"]
                stage.seen |= opened
        return Result(stage) if result is None else result

    stage.patch.setattr(api, name, called)


def show(stage: Stage, place: str) -> None:
    """Keep that a result is shown."""
    stage.replace(place, lambda *given: stage.seen.update({"shown": True}))


def checked(stage: Stage) -> None:
    """Keep the channels that the data check leaves out, and what outputs may be replaced."""
    stage.watch_trials()

    def outputs(*paths: Any, replace: bool) -> None:
        stage.seen["outputs"] = [str(path) for path in paths if path is not None]
        stage.seen["replaced"] = replace

    for module in ("running", "trials", "design"):
        stage.replace(f"commands.{module}.check_outputs", outputs)


PREPARE: dict[str, Callable[[Stage], None]] = {}  # by verb: puts the stand-ins in their places


def prepares(*verbs: str) -> Callable[..., Any]:
    """Register the preparation of some verbs."""

    def register(function: Callable[..., None]) -> Callable[..., None]:
        for verb in verbs:
            PREPARE[verb] = functools.partial(function, verb=verb)
        return function

    return register


# ------------------------------------------------------------------ results of trials

FUNCTION = {"map": "force_map", "report": "write_report"}  # of the verb, where named otherwise
ROWS = {"fit": "results._fit_row", "evaluate": "results._evaluation_row"}
ROWS |= {"pressure": "results._pressure_row", "report": "pages._report_row"}
SHOWN = {"evaluate": "results._show_evaluation", "report": "pages._show_report"}
SHOWN |= {"pareto": "results._show_fronts", "validate": "results._show_validation"}


@prepares("fit", "evaluate", "pressure", "report", "validate", "pareto", "paper", "map")
def prepare_result(stage: Stage, verb: str) -> None:
    checked(stage)
    stand_in(stage, FUNCTION.get(verb, verb))
    show(stage, f"commands.{SHOWN.get(verb, f'results._show_{verb}')}")
    if verb in ROWS:
        stage.replace(f"commands.{ROWS[verb]}", lambda found: {})
    if verb == "report":
        stage.replace("commands.pages.typed_command", lambda: "as typed")
    if verb == "pressure":
        brought = lambda found, cycles, **options: stage.seen.update(  # noqa: E731
            {"cycles": cycles} | {n: plain(options[n]) for n in ("output", "figure", "title")}
        )
        stage.replace("commands.results._bring_to_cycles", brought)


WRITES = {"compare": "write_comparison", "survey": "write_survey"}  # pages


@prepares("compare", "survey")
def prepare_compared(stage: Stage, verb: str) -> None:
    checked(stage)
    stand_in(stage, verb)
    stage.patch.setattr(
        api, WRITES[verb],
        lambda found, page, command: stage.seen.update({"page": str(page), "command": command}),
    )  # fmt: skip
    stage.replace("commands.pages.typed_command", lambda: "as typed")
    show(stage, f"commands.pages._show_{WRITES[verb].removeprefix('write_')}")


# ------------------------------------------------------------------ trials


@prepares("simulate")
def prepare_simulate(stage: Stage, verb: str) -> None:
    simulated = SimpleNamespace(path=Path("new"), geometry=stage.trial.geometry)
    stand_in(stage, "simulate", simulated)
    truth = SimpleNamespace(wrench=np.zeros((3, 6)))
    stage.replace("commands.trials.read_truth", lambda path: truth)


@prepares("import")
def prepare_import(stage: Stage, verb: str) -> None:
    stand_in(stage, "import_trial", stage.trial)


@prepares("annotate")
def prepare_annotate(stage: Stage, verb: str) -> None:
    stand_in(stage, "annotate", stage.trial.metadata)


@prepares("export")
def prepare_export(stage: Stage, verb: str) -> None:
    checked(stage)
    table = pd.DataFrame()
    table.attrs |= {"segment": "all", "rows": "3 samples", "notes": ()}
    stand_in(stage, "export", table)


@prepares("info")
def prepare_info(stage: Stage, verb: str) -> None:
    checked(stage)

    def reported(trial: Trial) -> None:
        stage.seen |= described(trial) | {"code": 1}
        raise TestbedError("that is all", "look at what has arrived")

    stage.replace("commands.trials.report_data", reported)


# ------------------------------------------------------------------ design


@prepares("tile", "register", "calibrate")
def prepare_design(stage: Stage, verb: str) -> None:
    checked(stage)
    result = Result(stage)
    result.notes = (lambda: ()) if verb == "calibrate" else ()
    stand_in(stage, verb, result)
    for printed in ("_registration", "_calibration"):
        stage.replace(f"commands.design.{printed}", lambda found: "")


# ------------------------------------------------------------------ cases

Cases = dict[str, tuple[Any, ...]]

# For each verb its least words, by option; then for each option other words, what they change, and
# words that it needs beside it.
LEAST: dict[str, dict[str, str]] = {
    "fit": {"trial": "scene", "output": "-o new.json"},
    "evaluate": {"trial": "scene", "model": "--model model.json"},
    "pressure": {"trial": "scene"},
    "report": {"trial": "scene", "output": "-o new.html"},
    "validate": {"trial": "scene"},
    "pareto": {"trial": "scene"},
    "paper": {"trial": "scene"},
    "map": {"trial": "scene", "output": "-o new.csv"},
    "compare": {"trial": "scene second"},
    "survey": {"trial": "scene second"},
    "import": {"source": "bag", "output": "-o new"},
    "simulate": {"output": "-o new"},
    "annotate": {"trial": "scene"},
    "export": {"trial": "scene", "output": "-o new.csv"},
    "info": {"trial": "scene"},
    "tile": {"scan": "scan.stl", "output": "-o new.yaml"},
    "register": {
        "take": "take.csv",
        "landmarks": "--landmarks at.yaml",
        "socket": "--socket socket.yaml",
    },
    "calibrate": {
        "bench": "bench.csv",
        "output": "-o new.yaml",
        "cluster": "--cluster distal",
    },
}
TRIAL: Cases = {"trial": ("second", {"trial": "second"})}
SOURCES: Cases = {
    "geometry": ("--geometry socket.yaml", {"socket": "socket.yaml"}),
    "calibration": ("--calibration calibration.yaml", {"calibration": "calibration.yaml"}),
    "load_cell": ("--load-cell params.yaml", {"load cell": "params.yaml"}),
    "tare": ("--tare none", {"tare": "none"}),
}
UNLOADED: Cases = {
    "unloaded": (
        "--unloaded 0:2 --unloaded 20:22",
        {"unloaded": ((0.0, 2.0), (20.0, 22.0))},
    ),
}
SETTINGS: Cases = {
    "segment": ("--segment 2:5", {"segment": "2:5"}),
    "params": ("--params params.yaml", {"params": "params.yaml"}),
    "theta": ("--theta 0.25", {"theta": 0.25}),
    "weights": ("--weights noise", {"weights": "noise"}),
    "smoothness": ("--smoothness 0.5", {"smoothness": 0.5}),
    "leave_out": ("--leave-out Mz", {"leave_out": ["Mz"], "checked without": ("Mz",)}),
    "pose_smoothing": ("--pose-smoothing 1.5", {"pose_smoothing": 1.5}),
    "frames": ("--frames 7", {"frames": 7}),
    "initial_stiffness": ("--initial-stiffness 2e3", {"initial_stiffness": 2000.0}),
    "solver": ("--solver clarabel", {"solver": "clarabel"}),
    "thetas": ("--thetas 3", {"thetas": 3}),
}
VARIANT: Cases = {"variant": ("--variant stiffness", {"variant": "stiffness"})}
JSON: Cases = {"json": ("--json", {"as JSON": True, "shown": "nothing"})}
REPLACE: Cases = {"replace": ("--replace", {"replaced": True})}
WRITTEN = {"saved": "new.csv", "limits": (), "choices": {}}
DRAWN = {"outputs": ["new.pdf"], "drawn": "new.pdf", "width": 180, "title": True}
OUTPUT: Cases = {"output": ("-o new.csv", {"outputs": ["new.csv"], **WRITTEN})}
FIGURE: Cases = {
    "figure": ("--figure new.pdf", DRAWN),
    "width": ("--width 88", {"width": 88}, {"figure": "--figure new.pdf"}),
    "title": ("--no-title", {"title": False}, {"figure": "--figure new.pdf"}),
}
PRIOR: Cases = {"prior": ("--prior survey.json", {"prior": "survey.json"})}
THRESHOLD: Cases = {"threshold": ("--threshold 20", {"threshold": 20.0})}
DESCRIBED: Cases = {
    "subject": ("--subject S02", {"subject": "S02"}),
    "side": ("--side left", {"side": "left"}),
    "socket": ("--socket PTB", {"socket": "PTB"}),
    "liner": ("--liner gel", {"liner": "gel"}),
    "mass": ("--mass 82.5", {"mass": 82.5}),
    "operator": ("--operator JD", {"operator": "JD"}),
    "protocol": ("--protocol P1", {"protocol": "P1"}),
    "notes": ("--notes warm", {"notes": "warm"}),
}


def only(cases: Cases, *names: str) -> Cases:
    """Some cases of a table."""
    return {name: cases[name] for name in names}


def but(cases: Cases, *names: str) -> Cases:
    """A table without some cases."""
    return {name: case for name, case in cases.items() if name not in names}


OPENED = {**SOURCES, **UNLOADED}
CASES: dict[str, Cases] = {
    "fit": {
        **TRIAL,
        **OPENED,
        **but(SETTINGS, "thetas"),
        **VARIANT,
        **REPLACE,
        "output": ("-o b.json", {"outputs": ["b.json"], "saved": "b.json"}),
    },
    "evaluate": {
        **TRIAL,
        **OPENED,
        **JSON,
        **REPLACE,
        **only(SETTINGS, "segment", "pose_smoothing"),
        "model": ("--model other.json", {"model": "other.json"}),
        "output": ("-o b.txt", {"outputs": ["b.txt"], **WRITTEN, "saved": "b.txt"}),
        "pressure": ("--pressure", {"pressure": True}),
    },
    "pressure": {
        **TRIAL,
        **OPENED,
        **JSON,
        **REPLACE,
        **FIGURE,
        **THRESHOLD,
        **only(SETTINGS, "segment", "params", "leave_out"),
        **PRIOR,
        "share": ("--share 0.1", {"share": 0.1}),
        "output": (
            "-o new.csv",
            {"outputs": ["new.csv"], **WRITTEN, "choices": {"over_time": False}},
        ),
        "over_time": (
            "--over-time",
            {"choices": {"over_time": True}},
            {"output": "-o new.csv"},
        ),
        "cycles": (
            "--cycles push",
            {"cycles": "push", "output": None} | {"figure": None, "title": True},
        ),
    },
    "report": {
        **TRIAL,
        **OPENED,
        **SETTINGS,
        **PRIOR,
        "output": ("-o b.html", {"outputs": ["b.html"], "page": "b.html"}),
        "replace": ("--replace", {"replaced": True, "replace": True}),
        "width": ("--width 88", {"width": 88}),
        "title": ("--no-title", {"title": False}),
        "figures": ("--figures", {"figures": True}),
        "model": ("--model model.json", {"model": "model.json"}),
    },
    "validate": {
        "trial": ("second scene", {"trials": ["second", "scene"]}),
        **SOURCES,
        **JSON,
        **REPLACE,
        **OUTPUT,
        **FIGURE,
        **but(SETTINGS, "thetas", "frames", "initial_stiffness"),
        **PRIOR,
    },
    "pareto": {
        **TRIAL,
        **OPENED,
        **JSON,
        **REPLACE,
        **OUTPUT,
        **FIGURE,
        **but(SETTINGS, "theta"),
    },
    "paper": {**TRIAL, **OPENED, **JSON, **REPLACE, **OUTPUT, **SETTINGS},
    "map": {
        **TRIAL,
        **OPENED,
        **REPLACE,
        **only(SETTINGS, "segment", "params"),
        **PRIOR,
        **FIGURE,
        "output": ("-o b.csv", {"outputs": ["b.csv"], "saved": "b.csv"}),
        "figure": ("--figure new.pdf", DRAWN | {"outputs": ["new.csv", "new.pdf"]}),
    },
    "compare": {
        "trial": ("second scene", {"trials": ["second", "scene"]}),
        **OPENED,
        **JSON,
        **REPLACE,
        **OUTPUT,
        **THRESHOLD,
        **only(SETTINGS, "segment", "params"),
        **PRIOR,
        "by_region": ("--by-region", {"by_region": True}),
        "condition": (
            {"trial": "", "condition": "--condition gel=scene --condition sock=second"},
            {"trials": "nothing", "trials gel": ["scene"], "trials sock": ["second"]},
        ),
    },
    "survey": {
        "trial": ("second scene", {"trials": ["second", "scene"]}),
        **but(SOURCES, "geometry"),
        "geometry": ("--geometry socket.yaml socket.yaml", {"socket": "socket.yaml"}),
        **JSON,
        **REPLACE,
        **OUTPUT,
        **FIGURE,
        **only(SETTINGS, "segment", "params"),
        "clusters": ("--clusters 2", {"clusters": 2}),
        "keep_out": ("--keep-out distal middle", {"keep_out": ["distal", "middle"]}),
    },
    "import": {
        "source": ("a.csv b.csv", {"source": ["a.csv", "b.csv"]}),
        "output": ("-o b", {"path": "b"}),
        "wrench": ("--wrench /ft", {"wrench": "/ft"}),
        "socket_pose": ("--socket-pose tf:world/socket", {"socket_pose": "tf:world/socket"}),
        "pylon_pose": ("--pylon-pose none", {"pylon_pose": "none"}),
        "clusters": ("--clusters /uc", {"clusters": "/uc"}),
        "names": ("--names a b", {"names": ["a", "b"]}),
        "rate": ("--rate 25", {"rate": 25.0}),
        "trigger": ("--trigger /sync", {"trigger": "/sync"}),
        "offset": ("--offset wrench=1.5 clusters=tap", {"offset": ["wrench=1.5", "clusters=tap"]}),
        "tap": ("--tap 0:5", {"tap": "0:5"}),
        "columns": ("--columns Fx=f1 Fz=f3", {"columns": ["Fx=f1", "Fz=f3"]}),
        "units": ("--units force=kN", {"units": ["force=kN"]}),
        "row_rate": ("--row-rate wrench=500", {"row_rate": ["wrench=500"]}),
        "delay": ("--delay wrench=0.02", {"delay": ["wrench=0.02"]}),
        "wrench_of": ("--wrench-of socket", {"wrench_of": "socket"}),
        "tare": ("--tare 0:3", {"tare": "0:3"}),
        "mapping": ("--mapping mapping.yaml", {"mapping": "mapping.yaml"}),
        "like": ("--like trials/s01", {"like": "trials/s01"}),
        "geometry": ("--geometry socket.yaml", {"geometry": "socket.yaml"}),
        "calibration": ("--calibration calibration.yaml", {"calibration": "calibration.yaml"}),
    },
    "simulate": {
        "output": ("-o b", {"path": "b"}),
        "scenario": ("--scenario ramp", {"scenario": "ramp"}),
        "tissue": ("--tissue stiff", {"tissue": "stiff"}),
        "like_paper": ("--like-paper", {"like_paper": True}),
        "duration": ("--duration 30", {"duration": 30.0}),
        "rate": ("--rate 8", {"rate": 8.0}),
        "seed": ("--seed 5", {"seed": 5}),
        "donning": ("--donning 3", {"donning": 3}),
        "donning_share": ("--donning-share 0.2", {"donning_share": 0.2}),
        "geometry": ("--geometry socket.yaml", {"geometry": "socket.yaml"}),
        "calibration": ("--calibration calibration.yaml", {"calibration": "calibration.yaml"}),
        "replace": ("--replace", {"replace": True}),
    },
    "annotate": {
        **TRIAL,
        **DESCRIBED,
        "remove": ("--remove mass --remove side", {"remove": ["mass", "side"]}),
    },
    "export": {
        **TRIAL,
        **OPENED,
        **REPLACE,
        **only(SETTINGS, "segment"),
        **PRIOR,
        "output": ("-o b.csv", {"outputs": ["b.csv"], "path": "b.csv"}),
        "map": ("--map", {"force_map": True}),
        "model": ("--model model.json", {"model": "model.json"}),
        "pressure": ("--pressure", {"pressure": True}),
        "cycles": ("--cycles push", {"cycles": "push"}),
        "about": ("--about 0 0.1 -0.2", {"about": [0.0, 0.1, -0.2]}),
    },
    "info": {**TRIAL, **SOURCES},
    "tile": {
        "scan": ("b.stl", {"scan": "b.stl"}),
        "output": (
            "-o b.yaml",
            {"output": "b.yaml", "outputs": ["b.yaml", "b.png", "b.html"]},
        ),
        "height": ("--height 100", {"height": 0.1}),
        "size": ("--size 20", {"edge": 0.02}),
        "flatness": ("--flatness 5", {"flatness": 0.005}),
        "rounds": ("--rounds 12", {"rounds": 12}),
        "seed": ("--seed 5", {"seed": 5}),
        "points": (
            "--points 0,0,0 1,0,0 0,2,0",
            {"points": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]},
        ),
        **REPLACE,
        "unit": ("--unit cm", {"unit": "cm"}),
        "body": ("--body 2", {"body": "2"}),
        "proximal": ("--proximal +z", {"proximal": "+z"}),
        "anterior": ("--anterior +y", {"anterior": "+y"}),
        "landmarks": ("--landmarks at.yaml", {"landmarks": "at.yaml"}),
        "clusters": ("--clusters at.yaml", {"clusters": "at.yaml"}),
        "place": ("--place 3", {"place": 3}),
        "keep_out": ("--keep-out tibia fibula", {"keep_out": ["tibia", "fibula"]}),
        "bodies": ("--bodies socket.yaml", {"bodies": "socket.yaml"}),
    },
    "register": {
        "take": ("b.csv", {"take": "b.csv"}),
        "landmarks": ("--landmarks b.yaml", {"landmarks": "b.yaml"}),
        "socket": ("--socket b.yaml", {"socket": "b.yaml", "output": "b.yaml"}),
        "output": (
            "-o new.yaml",
            {"output": "new.yaml", "outputs": ["new.yaml"], "replaced": False},
        ),
        "force": ("--force", {"force": True}),
        "replace": ("--replace", {"replaced": True}, {"output": "-o new.yaml"}),
    },
    "calibrate": {
        "bench": ("a.csv b.csv", {"bench": ["a.csv", "b.csv"]}),
        "output": ("-o b.yaml", {"saved": "b.yaml"}),
        "cluster": ("--cluster brim", {"cluster": "brim"}),
        "into": ("--into old.yaml", {"into": "old.yaml", "outputs": ["new.yaml"]}),
        "columns": ("--columns time=t c0=a", {"columns": {"time": "t", "c0": "a"}}),
        "units": ("--units time=ms", {"units": {"time": "ms"}}),
        "wiring": ("--wiring 2 3 0 1", {"wiring": [2, 3, 0, 1]}),
        "baseline": ("--baseline a.csv b.csv", {"baseline": ["a.csv", "b.csv"]}),
        "limit": ("--limit 5", {"limits": (5.0, False, False)}),
        "force": ("--force", {"limits": (10.0, True, False)}),
        "replace": ("--replace", {"limits": (10.0, False, True), "replaced": True}),
        "area": ("--area 1e-3", {"area": 1e-3}),
        "geometry": ("--geometry socket.yaml", {"geometry": "socket.yaml"}),
        "drop_outliers": ("--drop-outliers", {"drop_outliers": True}),
        **FIGURE,
    },
}


LIVE = {"demo", "doctor", "run", "record", "mark", "view", "replay"}  # in another module


@pytest.mark.parametrize("verb", sorted({*CALLS} - LIVE))
def test_every_option_has_a_case(verb: str) -> None:
    batch = {*BATCH} if verb in ROWS else set()
    assert {*defaults_of_verb(verb)} == {*CASES[verb]} | batch


@pytest.mark.parametrize(
    ("verb", "option"), [(verb, option) for verb, cases in CASES.items() for option in cases]
)
def test_an_option_arrives(verb: str, option: str, stage: Stage) -> None:
    words, expected, *beside = CASES[verb][option]
    PREPARE[verb](stage)
    usual = stage.usually(joined(verb, LEAST[verb], *beside), lambda w: call_verb(stage, *w))
    given = words if isinstance(words, dict) else {option: words}
    found = call_verb(stage, *joined(verb, LEAST[verb], *beside, given))
    assert changes(usual, found) == expected


# ------------------------------------------------------------------ a folder of trials

BATCH: Cases = {
    "jobs": ("--jobs 3", {"jobs": 3}),
    "dask": ("--dask tcp://lab:8786", {"dask": "tcp://lab:8786"}),
    "again": ("--again", {"again": True}),
}
ALONE = {"trial", "output", "json", "figure", "replace"}  # options without meaning in a folder
NO_SETTINGS = {*SOURCES, "params", "model", "prior"} - {
    "tare"
}  # files, which are known by their contents

# What an option changes in a folder, where it is not the same as alone.
IN_BATCH: dict[tuple[str, str], dict[str, Any]] = {
    ("evaluate", "pressure"): {"pressure": True, "metadata": ("side", "mass")},
    ("pressure", "over_time"): {"choices": {"over_time": True}},
    ("pressure", "width"): {},  # of a figure, which a folder has not
    ("pressure", "title"): {},
    ("pressure", "cycles"): {
        "cycles": "push",
        "output": "new/s02/second.pressure.csv",
        "figure": None,
        "title": True,
        **dict.fromkeys(("saved", "limits", "choices"), "nothing"),
    },
}


def batched(stage: Stage) -> None:
    """Do the jobs of a folder of trials at once, and keep how."""
    trials = {"scene": Path("scene"), "s02/second": Path("second")}
    stage.replace("commands.running.find_trials", lambda path, note: trials)

    def done(task: Any, jobs: Any, report: Any, say: Any, processes: Any, dask: Any) -> None:
        stage.seen |= {"jobs": processes, "dask": dask, "again": task.again}
        stage.seen |= {"may replace": task.replace, "metadata": task.metadata}
        stage.seen |= {f"setting {name}": value for name, value in task.settings.items()}
        stage.seen["written"] = [plain(job.output) for job in jobs]
        task.work(jobs[-1])

    stage.replace("commands.running.run_batch", done)


@pytest.mark.parametrize(
    ("verb", "option"),
    [(verb, option) for verb in ROWS for option in {**CASES[verb], **BATCH} if option not in ALONE],
)
def test_an_option_arrives_in_a_batch(verb: str, option: str, stage: Stage) -> None:
    words, expected, *_ = {**CASES[verb], **BATCH}[option]
    expected = IN_BATCH.get((verb, option), expected)
    PREPARE[verb](stage)
    batched(stage)
    least = LEAST[verb] | {"trial": "study", "output": "-o new"}
    usual = stage.usually(joined(verb, least), lambda w: call_verb(stage, *w))
    found = call_verb(stage, *joined(verb, least, {option: words}))
    if option not in NO_SETTINGS | {*BATCH}:
        value = vars(_parse(joined(verb, least, {option: words})))[option]
        expected = expected | {f"setting {option}": value}
    assert changes(usual, found) == expected


WITH_PARAMS = [verb for verb in CASES if {"params", "trial"} <= {*CASES[verb]}]


@pytest.mark.parametrize("verb", WITH_PARAMS)
def test_a_file_s_channels_are_not_checked(verb: str, stage: Stage) -> None:
    PREPARE[verb](stage)
    words = {"params": "--params without.yaml"}
    found = call_verb(stage, *joined(verb, LEAST[verb], words))
    assert found["checked without"] == ("Mz", "distal.Fx")


@pytest.mark.parametrize("verb", [verb for verb in ROWS if verb in WITH_PARAMS])
def test_a_batch_checks_no_channel_left_out(verb: str, stage: Stage) -> None:
    PREPARE[verb](stage)
    batched(stage)
    least = LEAST[verb] | {"trial": "study", "output": "-o new"}
    found = call_verb(stage, *joined(verb, least, {"params": "--params without.yaml"}))
    assert found["checked without"] == ("Mz", "distal.Fx")


@pytest.mark.parametrize("verb", ROWS)
def test_a_batch_has_its_outputs(verb: str, stage: Stage) -> None:
    PREPARE[verb](stage)
    batched(stage)
    suffix = {"fit": "json", "evaluate": "errors.json", "report": "html"}
    least = LEAST[verb] | {"trial": "study", "output": "-o new"}
    found = call_verb(stage, *joined(verb, least, {"replace": "--replace"}))
    names = [f"new/{name}.{suffix.get(verb, 'pressure.csv')}" for name in ("scene", "s02/second")]
    assert found["written"] == names
    assert found["page" if verb == "report" else "saved"] == names[-1]
    assert (found["may replace"], found["trial"]) == (True, "second")
