"""Every option of every function of the API arrives where it has its effect, and nowhere else.

A case holds an option's value and what it changes at the next layer, compared with the call without
it. A new option without a case is an error.
"""

import inspect
import shutil
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from support import results_by_hand, scene
from support.arrivals import Stage, changes, plain, write_files

import socket_testbed as st
from socket_testbed.files import packaged
from socket_testbed.identification.checked import CheckedSamples
from socket_testbed.identification.fit import FittedModel
from socket_testbed.results.pressure import TrialMap
from socket_testbed.settings.identification import IdentificationSettings
from socket_testbed.simulation.sensors import LIKE_PAPER
from socket_testbed.socket_design.tiling import TilingSettings
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial

Calls = dict[str, Callable[..., None]]

CALLS: Calls = {}  # by name of the function: calls it on a stage with some options


def calls(function: Callable[..., None]) -> Callable[..., None]:
    """Register a call by the name of the function of the API, without `call_`."""
    CALLS[function.__name__.removeprefix("call_")] = function
    return function


@pytest.fixture(scope="module")
def folder(scene_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the scene, its files, a model, and settings; calls are made in it."""
    path = tmp_path_factory.mktemp("options")
    (path / "scene").symlink_to(scene_folder)
    for name in ("socket.yaml", "calibration.yaml"):
        (path / name).symlink_to(scene_folder / name)
    write_files(path)
    return path


@pytest.fixture
def stage(folder: Path, trial: Trial, monkeypatch: pytest.MonkeyPatch) -> Iterator[Stage]:
    """The stage for calls of one function, in the folder of the files."""
    monkeypatch.chdir(folder)
    return Stage(monkeypatch, trial)


# ------------------------------------------------------------------ trials


@calls
def call_open_trial(stage: Stage, **options: Any) -> None:
    opened = st.open_trial("scene", **options)
    files = (opened.socket_file, opened.calibration_file, opened.load_cell_file)
    names = ("socket", "calibration", "load cell")
    stage.seen |= {name: plain(file) for name, file in zip(names, files, strict=True)}
    stage.seen |= {"unloaded": opened.unloaded, "tare": opened.tare}
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        opened.note("is odd")
    stage.seen["warned of"] = [str(each.message) for each in warned]


@calls
def call_annotate(stage: Stage, **options: Any) -> None:
    own = Path("annotated")
    shutil.copytree("scene", own, dirs_exist_ok=True)
    st.annotate(own, **options)
    stage.seen |= st.open_trial(own).metadata.columns()


@calls
def call_check_data(stage: Stage, **options: Any) -> None:
    st.check_data(stage.trial, **options)


@calls
def call_simulate(stage: Stage, **options: Any) -> None:
    for kind in ("socket", "calibration"):
        stage.replace(f"api.trials.read_{kind}", lambda path, kind=kind: f"{kind} {path.name}")
    places = ("socket", "calibration", "scenario", "duration", "rate", "seed", "errors")

    def simulated(*given: Any, progress: Any, **named: Any) -> str:
        stage.seen |= dict(zip(places, given, strict=True)) | named
        progress(1, 2)
        return "simulated"

    stage.replace("simulation.trial.simulate", simulated)
    stage.keep("simulation.trial.check_trial_folder", "", "checked for replacement")
    stored = ("", "folder", "stored socket", "stored calibration", "left out", "replaced")
    stage.keep("simulation.trial.write_simulated_trial", *stored)
    stage.keep("api.trials.open_trial", "")
    st.simulate("new", **options)


# ------------------------------------------------------------------ models


@calls
def call_fit(stage: Stage, **options: Any) -> None:
    stage.watch_trials()

    def fitted(samples: Any, geometry: Any, settings: Any) -> Any:
        stage.seen |= {"samples": len(samples)} | settings.to_flat()
        return results_by_hand.fit_by_hand(samples, geometry, settings)

    stage.replace("results.models.fit_contact_model", fitted)
    stage.seen["segment"] = str(st.fit(stage.trial, **options).segment)


@calls
def call_read_model(stage: Stage, **options: Any) -> None:
    st.read_model("model.json", **options)


@calls
def call_predict(stage: Stage, **options: Any) -> None:
    def predicted(trial: Trial, stored: Any) -> Any:
        stage.seen["model of"] = stored.trial
        return np.zeros((96, 18))

    stage.replace("api.models.predictions", predicted)
    found = st.predict(stage.trial, **{"model": "model.json"} | options)
    stage.seen["rows"] = [len(found), *found.index[[0, -1]]]


@calls
def call_evaluate(stage: Stage, **options: Any) -> None:
    stage.watch_trials()

    def predicted(stored: Any, samples: Any, past: Any = None) -> Any:
        if past is not None:  # the segment's own, as poses are averaged within it
            stage.seen |= {"predicted": len(samples), "past": len(past)}
        stage.seen["model of"] = stored.trial
        stage.seen["averaged over"] = stored.settings.pose_smoothing
        return np.zeros((len(samples), 18))

    def pressures(trial: Trial, segment: Segment) -> str:
        stage.seen["pressure of"] = str(segment)
        return "pressure"

    stage.patch.setattr(FittedModel, "predictions", predicted)

    def judged(samples: Any, predictions: Any, leave_out: Any) -> Any:
        stage.seen.setdefault("judged", len(samples))  # later the rest of the trial
        return (SimpleNamespace(samples=1),)

    stage.replace("results.models.evaluate", judged)
    stage.replace("api.models.pressure_of", pressures)
    found = st.evaluate(stage.trial, **{"model": "model.json"} | options)
    stage.seen["segment"] = str(found.segment)


@calls
def call_pareto(stage: Stage, **options: Any) -> None:
    stage.watch_trials()

    def traced(samples: Any, geometry: Any, settings: Any, values: Any, report: Any) -> Any:
        stage.seen |= {"samples": len(samples), "values": values.tolist()} | settings.to_flat()
        report(1, 5)
        return {}

    stage.replace("results.tradeoff.pareto_front", traced)
    stage.seen["segment"] = str(st.pareto(stage.trial, **options).segment)


@calls
def call_paper(stage: Stage, **options: Any) -> None:
    stage.watch_trials()

    def arrives(call: str, samples: Any, settings: IdentificationSettings) -> None:
        chosen = {"samples": len(samples)} | settings.to_flat()
        stage.seen |= {f"{call}: {name}": value for name, value in chosen.items()}

    def fitted(trial: Trial, segment: Segment, samples: Any, settings: Any) -> Any:
        arrives(settings.variant, samples, settings)
        stage.seen[f"{settings.variant}: segment"] = str(segment)
        return SimpleNamespace(fit=SimpleNamespace(errors=(), settings=settings, samples=3))

    def traced(samples: Any, geometry: Any, settings: Any, values: Any, report: Any) -> Any:
        arrives("front", samples, settings)
        stage.seen["values"] = values.tolist()
        report(1, 5)
        return {}

    stage.replace("results.tradeoff.fit_segment", fitted)
    stage.replace("results.tradeoff.pareto_front", traced)
    stage.keep("results.tradeoff.beside_published", returned=pd.DataFrame())
    stage.seen["segment"] = str(st.paper(stage.trial, **options).segment)


# ------------------------------------------------------------------ force map and pressure


def _stands_for_map(stage: Stage) -> None:
    stage.watch_trials()

    def mapped(trial: Trial, settings: Any, geometry: Any = None, prior: Any = None) -> Any:
        stage.seen["survey"] = prior and prior.name
        stage.seen |= {"left out": settings.identification.leave_out}
        stage.seen["length of the prior"] = settings.force_map.length
        stage.seen["regions"] = {} if geometry is None else geometry.regions

        def part(segment: Segment) -> TrialMap:
            stage.seen["segment"] = str(segment)
            rows, time = segment.rows, trial.samples().time
            return TrialMap(trial, segment, time[rows], trial.samples()[rows], None, ())  # type: ignore[arg-type]

        return SimpleNamespace(part=part)

    def pressed(found: TrialMap, threshold: float, share: float) -> Any:
        return SimpleNamespace(threshold=threshold, share=share)

    stage.patch.setattr(TrialMap, "pressure", pressed)
    stage.replace("api.pressure.map_trial", mapped)


@calls
def call_force_map(stage: Stage, **options: Any) -> None:
    _stands_for_map(stage)
    found = st.force_map(stage.trial, **options)
    stage.seen |= {"segment": str(found.segment), "samples": len(found.samples)}
    stage.seen["last time"] = found.time[-1]


@calls
def call_pressure(stage: Stage, **options: Any) -> None:
    _stands_for_map(stage)
    found = st.pressure(stage.trial, **options)
    stage.seen |= {"threshold [kPa]": found.threshold, "share": found.share}


@calls
def call_cycles(stage: Stage, **options: Any) -> None:
    stage.watch_trials()
    spans = [(0.0, 8.0), (8.0, 16.0), (16.0, 23.5)]
    stage.keep("api.cycles.cycle_spans", "", "delimited by", returned=spans)
    found = st.cycles(stage.trial, **options)
    stage.seen |= {"titles": found.titles, "cycles": len(found), "by": found.by}


@calls
def call_compare(stage: Stage, **options: Any) -> None:
    given = () if "conditions" in options else ("scene", "second")
    shutil.copytree("scene", "second", dirs_exist_ok=True)

    def judged(trial: Trial, segment: str, **choices: Any) -> Any:
        stage.seen |= {f"{trial.name}: {name}": plain(value) for name, value in choices.items()}
        stage.seen[f"{trial.name}: segment"] = segment
        return SimpleNamespace(trial=trial)

    stage.replace("api.comparison.pressure", judged)
    stage.keep("results.comparing._shared_rows", "", "", "regions alone", returned=[])
    stage.keep("results.comparing.values_table", returned=pd.DataFrame())
    stage.keep("results.comparing._texts", returned=pd.DataFrame())
    stage.keep("results.comparing._notes", returned=())
    found = st.compare(*given, **options)
    stage.seen |= {"trials": dict(found.conditions), "title": found.title}
    stage.seen["tiles"] = found.geometry is not None


@calls
def call_survey(stage: Stage, **options: Any) -> None:
    stage.watch_trials()
    shutil.copytree("scene", "second", dirs_exist_ok=True)

    class Joint:
        change, changes = 0.1, np.zeros(1)
        hypotheses, weights = (), np.zeros((0, 1))

        def __init__(self, geometry: Any, donned: Any, settings: Any) -> None:
            stage.seen |= {"length": settings.length, "loads": len(donned[0].values)}

        def field(self, trial: int | None = None) -> None:
            return None

        def place_next(self, count: int, allowed: np.ndarray) -> tuple[np.ndarray, float]:
            stage.seen |= {"clusters": count, "not for": np.flatnonzero(~allowed).tolist()}
            return np.arange(count), 0.9

    stage.replace("identification.survey.JointMap", Joint)
    stage.keep("identification.survey.judge")
    found = st.survey("scene", "second", **options)
    stage.seen["tiles"] = found.next_tiles


# ------------------------------------------------------------------ validation


@calls
def call_validate(stage: Stage, **options: Any) -> None:
    stage.watch_trials()

    def mapped(checked: Any, settings: Any, prior: Any = None) -> Any:
        return prior and SimpleNamespace(name=prior.name, source=lambda samples: "by hand")

    stage.patch.setattr(CheckedSamples, "prior_map", mapped)

    def judged(samples: Any, geometry: Any, settings: Any, *others: Any) -> list[Any]:
        stage.seen["survey"] = others[-1] and others[-1].name
        stage.seen |= {"samples": len(samples)} | settings.identification.to_flat()
        missing = np.isnan(samples.wrench).all(axis=0)
        stage.seen["missing in the wrench"] = np.flatnonzero(missing).tolist()
        return ["a judgement"]

    stage.replace("identification.validation.judge_samples", judged)
    stage.seen["priors"] = st.validate(stage.trial, **options).priors


# ------------------------------------------------------------------ files and pages


@calls
def call_export(stage: Stage, **options: Any) -> None:
    stage.watch_trials()
    times = stage.trial.samples().time

    def mapped(trial: Trial, segment: Segment, prior: Any) -> Any:
        stage.seen["survey"] = prior
        shape = len(times[segment.rows])
        columns = lambda names, prefix: {f"{prefix}force [N]": np.zeros(shape)}  # noqa: E731
        estimate = SimpleNamespace(columns=columns, source="a map by hand")
        return SimpleNamespace(estimate=estimate)

    def pressures(trial: Trial, segment: Segment, prior: Any) -> Any:
        stage.seen["survey"] = prior
        table = pd.DataFrame({"peak [kPa]": np.zeros(len(times[segment.rows]))})
        outputs = SimpleNamespace(source="pressures by hand")
        return SimpleNamespace(over_time=lambda: table, outputs=outputs)

    def brought(trial: Trial, table: pd.DataFrame, *, by: str, segment: Segment) -> Any:
        stage.seen |= {"cycles by": by, "cycles in": str(segment)}
        return SimpleNamespace(to_dataframe=table.head)

    stage.replace("api.export.force_map_of", mapped)
    stage.replace("api.export.pressure_of", pressures)
    stage.replace("api.export.cycles_of", brought)

    def written(table: pd.DataFrame, path: Path) -> None:
        stage.seen |= {"file": str(path), "rows": len(table)}
        groups = {name.partition(".")[0] for name in table if "." in name} - {*scene.CLUSTERS}
        stage.seen["added"] = sorted(groups)
        own = stage.trial.samples().wrench[np.searchsorted(times, table["time [s]"])]
        lever = (own[:, 1] - table["My [N m]"]) / own[:, 3]
        stage.seen["lever of Fx [m]"] = [round(float(end), 6) for end in (min(lever), max(lever))]

    stage.replace("api.export.write_table", written)
    table = st.export(stage.trial, **{"path": "samples.csv"} | options)
    stage.seen["notes"] = table.attrs["notes"]


@calls
def call_write_report(stage: Stage, **options: Any) -> None:
    def computed(
        trial: Trial, part: str, settings: Any, values: Any, model: Any, report: Any, prior: Any
    ) -> Any:
        stage.seen["survey"] = prior and prior.name
        stage.seen |= {"part": part, "values": values.tolist()} | settings.identification.to_flat()
        stage.seen["least force"] = settings.plateau.least_force
        stage.seen["model of"] = model and model.trial
        report(1, 6)
        return SimpleNamespace(bag_notes=())

    def written(found, page, command, made, drawing, replace, style) -> None:
        stage.seen |= {"page": str(page), "command": command, "replaced": replace}
        stage.seen["printed"] = style and (style.width, style.titles)
        if drawing is not None:
            drawing(2, 3)

    stage.watch_trials()
    stage.replace("results.report.compute_results", computed)
    stage.replace("report.write.write_report", written)
    stage.keep("report.write.check_page_path", "checked page", "checked for replacement")
    st.write_report(stage.trial, **{"page": "scene.html"} | options)


@calls
def call_write_comparison(stage: Stage, **options: Any) -> None:
    cells = pd.DataFrame({"hold": ["1.0"]}, index=["socket"])
    found: Any = SimpleNamespace(
        differing=lambda: ["0 of 0 intervals"], cells=lambda part: cells, items=("hold",),
        table=pd.DataFrame({"part": []}), notes=(), geometry=None, title="by hand",
    )  # fmt: skip
    stage.keep("api.pages.check_kind")
    stage.keep("report.comparison._cards", returned=[])

    def written(path: Path, title: str, subtitle: str, groups: Any, data: Any) -> None:
        (shown,) = groups["Data"][-1].parts
        stage.seen |= {"page": str(path), "command": shown.frame.loc["command"].iloc[0]}

    stage.replace("report.comparison.write_page", written)
    st.write_comparison(found, **{"page": "found.html"} | options)


@calls
def call_write_survey(stage: Stage, **options: Any) -> None:
    found: Any = SimpleNamespace(
        tables=lambda: ("scores", "judged"), pressures=pd.DataFrame, conclusions=list, notes=(),
        verdict="by hand", trials=(), segments=(), clusters=(), states=3,
        judgements=SimpleNamespace(points=()),
    )  # fmt: skip
    stage.keep("api.pages.check_kind")
    stage.keep("report.survey._cards", returned=[])
    stage.keep("report.survey._map_data", returned=({}, {}))

    def written(path: Path, title: str, subtitle: str, groups: Any, data: Any) -> None:
        (shown,) = groups["Data"][-1].parts
        stage.seen |= {"page": str(path), "command": shown.frame.loc["command"].iloc[0]}

    stage.replace("report.survey.write_page", written)
    st.write_survey(found, **{"page": "found.html"} | options)


@calls
def call_view(stage: Stage, **options: Any) -> None:
    def predicted(trial: Trial, stored: Any) -> str:
        return f"predictions of {stored.trial}"

    stage.replace("api.pages.predictions", predicted)

    def played(trial: Trial, predictions: Any, prior: Any) -> None:
        stage.seen |= {"predictions": predictions, "survey": prior and prior.name}

    stage.replace("pages.player.Player", played)
    stage.keep("pages.server.PageServer", "", "host", "port", "names")
    st.view(stage.trial, **options)


# ------------------------------------------------------------------ design


@calls
def call_calibrate(stage: Stage, **options: Any) -> None:
    bench, wiring = SimpleNamespace(time=[3.0, 9.0]), {"wiring": np.array([3, 2, 1, 0])}
    known = SimpleNamespace(clusters={"distal": SimpleNamespace(**wiring)})
    socket = SimpleNamespace(clusters={"distal": 1}, areas=[1e-4, 9e-4])
    stage.replace("api.design.read_calibration", lambda path: known)
    stage.keep("api.design.read_socket", "socket", returned=socket)
    readings = ("bench", "columns", "units", "area")
    stage.keep("calibration.bench_data.read_bench", *readings, returned=bench)
    stage.replace("calibration.bench_data.join_benches", lambda benches: benches[-1])
    unloaded = ("unloaded", "unloaded columns", "unloaded units")
    stage.keep("calibration.bench_data.read_unloaded", *unloaded)

    def averaged(time: float, read: Any, where: str) -> Any:
        stage.seen[f"baseline at {time:g} s"] = where
        return SimpleNamespace(capacitance=f"that of {where}", where=where)

    def corrected(data: Any, before: Any, after: Any) -> Any:
        stage.seen["corrected by"] = (before.where, after.where)
        return data

    stage.replace("calibration.drift.average_baseline", averaged)
    stage.replace("calibration.drift.correct_bench", corrected)
    stage.replace("calibration.drift.measure_drift", lambda cluster, *ends: "a drift")
    fit = ("", "inputs", "wiring is given", "outliers dropped")
    quality = SimpleNamespace(cluster=None)
    stage.keep("calibration.calibrate.calibrate_bench", *fit, returned=quality)
    found = st.calibrate("bench.csv", **{"cluster": "distal"} | options)
    stage.seen |= {"name": found.name, "into": plain(found.existing_file)}
    stage.seen |= {"first baseline": found.baseline, "drift": found.drift}
    stage.seen["others kept"] = found.existing is not None


@calls
def call_register(stage: Stage, **options: Any) -> None:
    for place, name in (("motive.read_motive_csv", "take"), ("registration.read_landmarks", "at")):
        stage.replace(f"socket_design.{place}", lambda path, name=name: f"{name} {path}")
    stage.replace("api.design.read_socket", lambda path: f"socket {path}")
    found = SimpleNamespace(geometry="registered")
    taken = ("take", "landmarks", "socket", "forced")
    stage.keep("socket_design.registration.register_take", *taken, returned=found)
    stage.keep("api.design.write_socket", "written", "output")
    st.register("take.csv", **{"landmarks": "landmarks.yaml", "socket": "socket.yaml"} | options)


@dataclass(frozen=True)
class _Design:
    """Stands for a design: its notes."""

    notes: tuple[str, ...] = ()


@calls
def call_tile(stage: Stage, **options: Any) -> None:
    names = ("directions", "landmarks", "points")
    for name in names:
        given = {"directions": ("", "upwards", "front", "height")}.get(name, (name, "metres"))
        stage.keep(f"socket_design.design.place_by_{name}", *given, returned=name)
    stage.keep("socket_design.clusters.read_cluster_places", "places", returned=[FRONT])
    stage.keep("socket_design.scan_file.read_scan", "scan", "unit", "body", returned="the scan")

    def designed(name, scan, placed, upwards, clusters, kept, settings, progress) -> Any:
        stage.seen |= {"name": name, "towards": plain(upwards), "clusters": clusters}
        stage.seen |= {"bodies": kept.source, "registered": kept.registration}
        stage.seen |= {"edge": settings.edge, "placed by": placed(None, np.ones(3), 0.5)}
        progress(1, 2)
        return _Design()

    stage.replace("socket_design.design.design_socket", designed)

    def proposed(design: Any, number: int, keep_out: Any) -> Any:
        stage.seen |= {"proposed": number, "kept out": [*keep_out]}
        return design

    stage.replace("socket_design.design.with_proposed_clusters", proposed)
    stage.keep("api.design._write_design", "", "output")
    stage.keep("api.design._check_socket_output", "checked output", "kept bodies")
    stage.seen["notes"] = st.tile("scan.stl", **options).notes


# ------------------------------------------------------------------ cases

SPAN = "span 2.00 s to 5.00 s"  # 13 samples
PROGRESS = "progress"  # stands for a function that keeps it

LEFT_OUT: dict[str, Any] = {
    "checked without": ("Mz",),
    "sound without": ("Mz",),
    "selected without": ("Mz",),
}
# For each function: an option's value, what it changes, and options that it needs beside it.
Cases = dict[str, tuple[Any, ...]]
FIT: Cases = {
    "segment": ("2:5", {"part": "2:5", "segment": SPAN, "samples": 13}),
    "params": ("params.yaml", {"theta": 0.2, "least force": 30.0}),
    "variant": ("stiffness", {"variant": "stiffness"}),
    "theta": (0.25, {"theta": 0.25}),
    "weights": ("noise", {"weights": "noise"}),
    "smoothness": (0.5, {"smoothness": 0.5}),
    "leave_out": (("Mz",), {"leave_out": ["Mz"], **LEFT_OUT}),
    "pose_smoothing": (1.5, {"pose_smoothing": 1.5}),
    "frames": (7, {"frames": 7, "samples": 7, "segment": "all 0.00 s to 1.50 s"}),
    "initial_stiffness": (2000.0, {"initial_stiffness": 2000.0}),
    "solver": ("clarabel", {"solver": "clarabel"}),
}


def of_paper(name: str, value: Any) -> dict[str, Any]:
    """What an option changes of both fits and of the front."""
    return {f"{call}: {name}": value for call in ("stiffness", "stiffness_bias", "front")}


def segment_of_paper(segment: str, samples: int) -> dict[str, Any]:
    """What a part of the trial changes of both fits, of the front, and of the result."""
    parts = {"segment": segment, "stiffness: segment": segment, "stiffness_bias: segment": segment}
    return parts | of_paper("samples", samples)


FRONT = SimpleNamespace(name="front")  # the place of a cluster
NO_BODIES = {"kept bodies": None}
NOT_BY_AXES = {**dict.fromkeys(("upwards", "front", "height"), "nothing"), "notes": ()}
REGIONS = {"mine": ["ant_prox", "right_end"]}

PRIOR = {"prior": ("survey.json", {"survey": "survey of a, b"})}
CASES: dict[str, Cases] = {
    "open_trial": {
        "geometry": ("socket.yaml", {"socket": "socket.yaml"}),
        "calibration": ("calibration.yaml", {"calibration": "calibration.yaml"}),
        "unloaded": ([(0, 2), (20, 22)], {"unloaded": ((0.0, 2.0), (20.0, 22.0))}),
        "load_cell": ("params.yaml", {"load cell": "params.yaml"}),
        "tare": ("none", {"tare": "none"}),
        "notify": ("notes", {"notes": ["is odd"], "warned of": []}),
    },
    "annotate": {
        "subject": ("S02", {"subject": "S02"}),
        "side": ("left", {"side": "left"}),
        "socket": ("PTB 3", {"socket": "PTB 3"}),
        "liner": ("gel", {"liner": "gel"}),
        "mass": (82.5, {"mass [kg]": 82.5}),
        "operator": ("JD", {"operator": "JD"}),
        "protocol": ("P1", {"protocol": "P1"}),
        "notes": ("warm", {"trial_notes": "warm"}),
        "remove": (["mass"], {"mass [kg]": None}),
    },
    "check_data": {},
    "simulate": {
        "scenario": ("ramp", {"scenario": "ramp"}),
        "tissue": ("stiff", {"tissue": "stiff"}),
        "duration": (30.0, {"duration": 30.0}),
        "rate": (8.0, {"rate": 8.0}),
        "seed": (5, {"seed": 5}),
        "donning": (3, {"donning": 3}),
        "donning_share": (0.2, {"donning_share": 0.2}, {"donning": 3}),
        "like_paper": (
            True,
            {"calibration": "calibration like_paper.yaml", "errors": LIKE_PAPER}
            | {"stored calibration": str(packaged("config", "like_paper.yaml"))}
            | {"left out": ("distal.Fx", "distal.Fy", "posterior_distal.Fx")},
        ),
        "replace": (True, {"checked for replacement": True, "replaced": True}),
        "geometry": (
            "model.json",
            {"socket": "socket model.json", "stored socket": "model.json"},
        ),
        "calibration": (
            "model.json",
            {"calibration": "calibration model.json", "stored calibration": "model.json"},
        ),
        PROGRESS: (PROGRESS, {"simulating": (1, 2)}),
    },
    "fit": FIT,
    "read_model": {},
    "predict": {
        "model": ("other.json", {"model of": "other"}),
        "segment": ("2:5", {"rows": [13, 2.0, 5.0]}),
    },
    "evaluate": {
        "model": ("other.json", {"model of": "other"}),
        "segment": ("2:5", {"part": "2:5", "segment": SPAN, "judged": 13}),
        "pose_smoothing": (1.5, {"averaged over": 1.5, "predicted": 96, "past": 0}),
        "pressure": (True, {"pressure of": "all 0.00 s to 23.75 s"}),
    },
    "pareto": {
        **{name: case for name, case in FIT.items() if name not in ("variant", "theta")},
        "thetas": (3, {"values": [0.0, 0.5, 1.0]}),
        PROGRESS: (PROGRESS, {"solving for every theta": (1, 5)}),
    },
    "paper": {
        **{
            name: (value, of_paper(name, value))
            for name, (value, *_) in FIT.items()
            if name != "variant"
        },
        "segment": ("2:5", {"part": "2:5", **segment_of_paper(SPAN, 13)}),
        "params": ("params.yaml", of_paper("theta", 0.2) | {"least force": 30.0}),
        "leave_out": (("Mz",), of_paper("leave_out", ["Mz"]) | LEFT_OUT),
        "frames": (7, of_paper("frames", 7) | segment_of_paper("all 0.00 s to 1.50 s", 7)),
        "thetas": (3, {"values": [0.0, 0.5, 1.0]}),
        PROGRESS: (PROGRESS, {"solving for every theta": (1, 5)}),
    },
    "force_map": {
        "segment": (
            "2:5",
            {"part": "2:5", "segment": SPAN, "samples": 13, "last time": 5.0},
        ),
        "params": ("params.yaml", {"length of the prior": 0.05, "least force": 30.0}),
        **PRIOR,
    },
    "pressure": {
        **PRIOR,
        "segment": ("2:5", {"part": "2:5", "segment": SPAN}),
        "threshold": (20.0, {"threshold [kPa]": 20.0}),
        "share": (0.1, {"share": 0.1}),
        "regions": (REGIONS, {"regions": {"mine": (0, 11)}}),
        "params": ("params.yaml", {"length of the prior": 0.05, "least force": 30.0}),
        "leave_out": (
            ("Mz",),
            {"left out": ("Mz",), "checked without": ("Mz",), "selected without": ("Mz",)},
        ),
    },
    "cycles": {
        "quantity": (["Fz", "Mx"], {"titles": ("Fz [N]", "Mx [N m]")}),
        "by": ("push", {"delimited by": "push", "by": "push"}),
        "segment": ("0:20", {"part": "0:20", "cycles": 2}),
    },
    "compare": {
        "conditions": (
            {"gel": ["scene"], "sock": ["second"]},
            {"trials": {"gel": ["scene"], "sock": ["second"]}},
        ),
        "segment": (
            "2:5",
            {
                "scene: segment": "2:5",
                "second: segment": "2:5",
                "title": "segment 2:5, in contact above 5 kPa",
            },
        ),
        "threshold": (
            20.0,
            {
                "scene: threshold": 20.0,
                "second: threshold": 20.0,
                "title": "segment plateau, in contact above 20 kPa",
            },
        ),
        "by_region": (True, {"regions alone": True, "tiles": False}),
        "prior": (
            "survey.json",
            {"scene: prior": "survey.json", "second: prior": "survey.json"},
        ),
        "params": (
            "params.yaml",
            {"scene: params": "params.yaml", "second: params": "params.yaml"},
        ),
        PROGRESS: (PROGRESS, {"comparing": (2, 2)}),
    },
    "survey": {
        "segment": ("2:5", {"part": "2:5"}),
        "clusters": (2, {"clusters": 2, "tiles": ("ant_prox", "left_prox")}),
        "keep_out": (["left_prox"], {"not for": [1, 3, 4, 6, 10]}),
        "params": ("params.yaml", {"length": 0.05, "least force": 30.0}),
        PROGRESS: (PROGRESS, {"surveying": (4, 4)}),
    },
    "validate": {
        "segment": ("2:5", {"part": "2:5", "samples": 13}),
        "params": ("params.yaml", {"theta": 0.2, "least force": 30.0}),
        "theta": (0.25, {"theta": 0.25}),
        "weights": ("noise", {"weights": "noise"}),
        "smoothness": (0.5, {"smoothness": 0.5}),
        "leave_out": (
            ("Mz",),
            {
                "leave_out": ["Mz"],
                "missing in the wrench": [2],
                **LEFT_OUT,
            },
        ),
        "pose_smoothing": (1.5, {"pose_smoothing": 1.5}),
        "solver": ("clarabel", {"solver": "clarabel"}),
        "prior": ("survey.json", {"survey": "survey of a, b", "priors": ("scene: by hand",)}),
        PROGRESS: (PROGRESS, {"validating": (1, 1)}),
    },
    "export": {
        "path": ("other.mat", {"file": "other.mat"}),
        "segment": ("2:5", {"part": "2:5", "rows": 13}),
        "model": (
            "model.json",
            {"added": ["predicted", "springs"], "sound without": ("distal.Fx",)},
        ),
        "force_map": (True, {"added": ["map"], "survey": None}),
        "pressure": (True, {"added": ["pressure"], "survey": None}),
        "prior": (
            "survey.json",
            {"survey": "survey.json", "notes": ("a map by hand", "pressures by hand")},
            {"force_map": True, "pressure": True},
        ),
        "cycles": (
            "push",
            {"cycles by": "push", "cycles in": "all 0.00 s to 23.75 s", "rows": 5},
        ),
        "about": ((0.0, 0.0, 0.1), {"lever of Fx [m]": [0.1, 0.1]}),
    },
    "write_report": {
        **{
            name: (case[0], {name: plain(case[0])})
            for name, case in FIT.items()
            if name != "variant"
        },
        "segment": ("2:5", {"part": "2:5"}),
        "params": ("params.yaml", {"theta": 0.2, "least force": 30.0}),
        "leave_out": (("Mz",), {"leave_out": ["Mz"]}),
        **PRIOR,
        "page": ("new.html", {"page": "new.html", "checked page": "new.html"}),
        "model": ("model.json", {"model of": "another"}),
        "thetas": (3, {"values": [0.0, 0.5, 1.0]}),
        "command": ("by hand", {"command": "by hand"}),
        "replace": (True, {"checked for replacement": True, "replaced": True}),
        "figures": (True, {"printed": (180, True)}),
        "width": (88, {"printed": (88, True)}, {"figures": True}),
        "title": (False, {"printed": (180, False)}, {"figures": True}),
        PROGRESS: (PROGRESS, {"fitting, judging, mapping": (1, 6)}),
    },
    "write_comparison": {
        "page": ("other.html", {"page": "other.html"}),
        "command": ("by hand", {"command": "by hand"}),
    },
    "write_survey": {
        "page": ("other.html", {"page": "other.html"}),
        "command": ("by hand", {"command": "by hand"}),
    },
    "view": {
        **PRIOR,
        "model": ("model.json", {"predictions": "predictions of another"}),
        "port": (8081, {"port": 8081}),
        "host": ("0.0.0.0", {"host": "0.0.0.0"}),
        "names": (("lab",), {"names": ("lab",)}),
    },
    "calibrate": {
        "cluster": ("new", {"name": "new"}),
        "into": ("old.yaml", {"into": "old.yaml", "others kept": True, "inputs": [3, 2, 1, 0]}),
        "baseline": (
            ["before.csv", "after.csv"],
            {
                "baseline at 3 s": "before.csv",
                "baseline at 9 s": "after.csv",
                "corrected by": ("before.csv", "after.csv"),
                "first baseline": "that of before.csv",
                "drift": "a drift",
                "unloaded": "after.csv",
                "unloaded columns": {},
                "unloaded units": {},
            },
        ),
        "columns": (
            {"time": "t"},
            {"columns": {"time": "t"}, "unloaded columns": {"time": "t"}},
            {"baseline": ["before.csv"]},
        ),
        "units": (
            {"time": "ms"},
            {"units": {"time": "ms"}, "unloaded units": {"time": "ms"}},
            {"baseline": ["before.csv"]},
        ),
        "area": (2e-4, {"area": 2e-4}),
        "geometry": ("socket.yaml", {"socket": "socket.yaml", "area": 9e-4}),
        "wiring": ((1, 0, 3, 2), {"inputs": [1, 0, 3, 2], "wiring is given": True}),
        "drop_outliers": (True, {"outliers dropped": True}),
    },
    "register": {
        "landmarks": ("other.yaml", {"landmarks": "at other.yaml"}),
        "socket": ("other.yaml", {"socket": "socket other.yaml"}),
        "output": ("new.yaml", {"written": "registered", "output": "new.yaml"}),
        "force": (True, {"forced": True}),
    },
    "tile": {
        "output": ("new.yaml", {"checked output": "new.yaml", "output": "new.yaml"} | NO_BODIES),
        "unit": ("cm", {"unit": "cm"}),
        "body": ("2", {"body": "2"}),
        "proximal": ("-z", {"towards": [0.0, 0.0, -1.0]}),
        "anterior": ("+y", {"front": [0.0, 1.0, 0.0], "notes": ()}),
        "height": (0.1, {"height": 0.1}),
        "landmarks": (
            "at.yaml",
            {"placed by": "landmarks", "landmarks": "at.yaml", "metres": 0.5, **NOT_BY_AXES},
        ),
        "points": (
            [[0, 0, 0], [2, 0, 0], [0, 4, 0]],
            {
                "placed by": "points",
                "points": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]],
                **NOT_BY_AXES,
            },
        ),
        "clusters": ("at.yaml", {"places": "at.yaml", "clusters": [FRONT]}),
        "place": (3, {"clusters": [], "proposed": 3, "kept out": []}),
        "keep_out": (
            ["anterior proximal"],
            {"kept out": ["anterior proximal"]},
            {"place": 3},
        ),
        "bodies": (
            "socket.yaml",
            {"bodies": "a scene made by hand", "registered": "made by hand"},
        ),
        "settings": (TilingSettings(edge=0.02), {"edge": 0.02}),
        PROGRESS: (PROGRESS, {"tiling": (1, 2)}),
    },
}


# The effects of their options are in test_imports.py, test_imported_tables.py, test_own_law.py.
ELSEWHERE = {"import_trial", "register_law"}
FUNCTIONS = {
    name: getattr(st, name) for name in st.__all__ if name.islower() and name not in ELSEWHERE
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_option_has_a_case(name: str) -> None:
    _trial, *options = inspect.signature(FUNCTIONS[name]).parameters
    assert {*options} == {*CASES[name]}


def arrived(stage: Stage, name: str, options: dict[str, Any]) -> dict[str, Any]:
    """What arrives of a call."""
    stage.seen = {}
    given = dict(options)
    if given.get(PROGRESS) == PROGRESS:
        given[PROGRESS] = stage.watch
    if given.get("notify") == "notes":
        given["notify"] = stage.seen.setdefault("notes", []).append
    CALLS[name](stage, **given)
    return stage.seen


@pytest.mark.parametrize(
    ("name", "option"), [(name, option) for name, cases in CASES.items() for option in cases]
)
def test_an_option_arrives(name: str, option: str, stage: Stage) -> None:
    value, expected, *beside = CASES[name][option]
    others = dict(*beside)
    usual = stage.usually([name, str(others)], lambda call: arrived(stage, name, others))
    found = arrived(stage, name, others | {option: value})
    assert changes(usual, found) == expected


def test_a_given_calibration_replaces_the_paper_s(stage: Stage) -> None:
    found = arrived(stage, "simulate", {"like_paper": True, "calibration": "model.json"})
    assert found["calibration"] == "calibration model.json"
    assert (found["stored calibration"], found["errors"]) == ("model.json", LIKE_PAPER)


def test_clusters_beside_proposals_stay(stage: Stage) -> None:
    found = arrived(stage, "tile", {"clusters": "at.yaml", "place": 3})
    assert (found["clusters"], found["proposed"]) == ([FRONT], 3)


DEFAULTS: dict[str, dict[str, Any]] = {
    "open_trial": {"tare": "recorded"},
    "simulate": {
        "scenario": "static_hold",
        "tissue": "soft",
        "like_paper": False,
        "duration": 120.0,
        "rate": 4.0,
        "seed": 0,
        "donning_share": 0.1,
        "replace": False,
    },
    "fit": {"segment": "plateau"},
    "predict": {"segment": "all"},
    "evaluate": {"segment": "plateau", "pressure": False},
    "pareto": {"segment": "plateau", "thetas": 101},
    "paper": {"segment": "plateau", "thetas": 101, "weights": "raw", "frames": 1000},
    "force_map": {"segment": "plateau"},
    "pressure": {"segment": "plateau", "threshold": 5.0, "share": 0.5},
    "cycles": {"by": "placed", "segment": "all"},
    "compare": {"segment": "plateau", "threshold": 5.0, "by_region": False},
    "survey": {"segment": "plateau"},
    "validate": {"segment": "all"},
    "export": {"segment": "all", "force_map": False, "pressure": False},
    "write_report": {
        "segment": "plateau",
        "thetas": 101,
        "command": "socket_testbed.write_report",
        "replace": False,
        "figures": False,
        "width": 180,
        "title": True,
    },
    "write_comparison": {"command": "socket_testbed.write_comparison"},
    "write_survey": {"command": "socket_testbed.write_survey"},
    "view": {"port": 0, "host": "127.0.0.1"},
    "calibrate": {"drop_outliers": False},
    "tile": {"height": 0.08, "place": 0},
    "register": {"force": False},
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_defaults_are_the_documented_ones(name: str) -> None:
    parameters = inspect.signature(FUNCTIONS[name]).parameters.items()
    nothing = (inspect.Parameter.empty, None, ())
    own = {key: each.default for key, each in parameters if each.default not in nothing}
    assert own == DEFAULTS.get(name, {})
