"""The verbs' calls: each verb's arguments and options, as a class whose fields are typed.

A class takes the options of functions of the API from `settings.options`. Importing this module
imports no array library, so that `--help` and wrong calls stay quick.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, ParamSpec, TypeVar

from socket_testbed.settings.options import (
    DONNING,
    DONNING_SHARE,
    DURATIONS,
    OWN_PARAMS,
    PACKAGED_SOCKET,
    SCENARIO,
    SEED,
    SEEDS,
    TISSUE,
    CalibrationOptions,
    ComparisonOptions,
    EvaluationOptions,
    ExportOptions,
    FitOptions,
    FrontOptions,
    ImportOptions,
    LiveFitOptions,
    MapOptions,
    MetadataOptions,
    OpenOptions,
    Options,
    PageOptions,
    PaperOptions,
    PressureOptions,
    PriorOptions,
    RegistrationOptions,
    ReportOptions,
    Scenario,
    SensorFiles,
    SimulationOptions,
    SurveyOptions,
    TileOptions,
    TissueKind,
    TrialFiles,
    ValidationOptions,
    argument,
    internal,
    option,
    required,
    several,
)

P = ParamSpec("P")
C = TypeVar("C")

_TRIALS = "folder of the trial, or a folder of trials"
_FITTED = "a model written by 'fit'"
_PREDICTING = "predict with this model instead of fitting one"
_REPLACE = "replace existing outputs"
_LANDMARK_FILE = """LANDMARKS.yaml names the markers and gives the landmarks' coordinates.

    bodies:                # permanent markers of the bodies (3 to 8), named as in the take
      socket: [Socket:Marker1, Socket:Marker2, Socket:Marker3]
      pylon:               # or a rigid body of Motive, 3 to 8 markers; its frame is kept
        rigid_body: Pylon
    load_cell:             # landmarks on the load cell or the socket: coordinates in {S} [m]
      Cell:Marker1: [0.030, 0.0, 0.012]
      Cell:Marker2: [-0.030, 0.0, 0.012]
      Cell:Marker3: [0.0, 0.055, 0.040]
    limb:                  # landmarks on the limb: coordinates in its frame [m], whose origin
      Limb:Marker1: [0.0, 0.070, 0.10]    # is the lumped mass
      Limb:Marker2: [0.05, -0.030, 0.12]
      Limb:Marker3: [-0.06, -0.020, 0.09]

All keys are required; load_cell and limb name three landmarks or more, as in the take.
With three, or with more in one plane, a wrong sign has no residual: add another off the plane.
"""


@dataclass(frozen=True, kw_only=True)
class Call(Options):
    """Base class of verbs' calls, with what the command line says of a verb."""

    module: ClassVar[str]
    summary: ClassVar[str]
    example: ClassVar[str]
    epilog: ClassVar[str]

    def __init_subclass__(
        cls, module: str, summary: str, example: str = "", epilog: str = ""
    ) -> None:
        """Keep what the command line says of a verb.

        Args:
            module: The module of `commands` with the verb's function, which has the verb's name;
                that of `import` is `import_`.
            summary: What the verb does.
            example: Words of a call after the verb.
            epilog: Text of the help below the options.
        """
        super().__init_subclass__()
        cls.module, cls.summary, cls.example, cls.epilog = module, summary, example, epilog


def takes(call: Callable[P, C]) -> Callable[[Callable[[C], None]], Callable[P, None]]:
    """Let a verb be called with the arguments of its call's class, and receive the call.

    Args:
        call: The class, such as `Fit`.
    """

    def decorate(verb: Callable[[C], None]) -> Callable[P, None]:
        @functools.wraps(verb)
        def called(*args: P.args, **kwargs: P.kwargs) -> None:
            verb(call(*args, **kwargs))

        return called

    return decorate


# Options of several verbs.


@dataclass(frozen=True, kw_only=True)
class ReplaceOptions(Options):
    """Whether outputs may be replaced."""

    replace: bool = option(False, _REPLACE)


@dataclass(frozen=True, kw_only=True)
class DrawOptions(Options):
    """How results are drawn."""

    figure: Path | None = option(None, "draw the results as .png, .pdf or .svg")
    width: Literal[88, 180] = option(
        180, "printed width of figures [mm]: one column of a paper, or the full page"
    )
    title: bool = option(True, "titles of figures and errors in their keys")


@dataclass(frozen=True, kw_only=True)
class TableOptions(ReplaceOptions):
    """How a result is written and printed."""

    output: Path | None = option(None, "table of the result")
    json: bool = option(False, "print JSON on standard output")


@dataclass(frozen=True, kw_only=True)
class FolderOptions(Options, heading="for a folder of trials"):
    """How a verb works on a folder of trials."""

    trial: Path = argument(_TRIALS)
    output: Path | None = option(None, "the output file, or the folder of output files")
    jobs: int | None = option(
        None,
        "number of parallel trials (default: one per core)",
        metavar="N",
        either="workers",
        limits=(1, sys.maxsize),
    )
    dask: str | None = option(
        None,
        "use the workers of a Dask cluster instead, by the address of its scheduler",
        metavar="ADDRESS",
        either="workers",
    )
    again: bool = option(False, "repeat finished trials")
    replace: bool = option(False, _REPLACE)
    alone: bool = internal(True, "whether the trial is the only one")


@dataclass(frozen=True, kw_only=True)
class BatchOptions(FolderOptions, OpenOptions):
    """How a verb opens a trial, or each trial of a folder."""


@dataclass(frozen=True, kw_only=True)
class ConfigurationOptions(Options):
    """Files of a live testbed."""

    geometry: Path | None = option(None, PACKAGED_SOCKET)
    calibration: Path | None = option(None, "a calibration.yaml (default: the package's own)")
    params: Path | None = option(None, "a testbed.yaml with the parameters of the nodes")


@dataclass(frozen=True, kw_only=True)
class SimulatedOptions(Options, heading="for simulated hardware"):
    """The simulated hardware of a live testbed."""

    simulated: bool = option(False, "simulate the hardware at its buses")
    scenario: Scenario = option(SimulationOptions.scenario, SCENARIO)
    period: float = option(120.0, "period of the scenario [s]", limits=(5.0, 3600.0))
    tissue: TissueKind = option(SimulationOptions.tissue, TISSUE)
    seed: int = option(SimulationOptions.seed, SEED, limits=SEEDS)
    donning: int | None = option(SimulationOptions.donning, DONNING, metavar="SEED")
    donning_share: float = option(SimulationOptions.donning_share, DONNING_SHARE)
    fault: Iterable[str] = several(
        "switch on a fault, such as load_cell.flipped_bits=0.01; see docs/faults.md",
        metavar="NAME=VALUE",
    )


# Try.


@dataclass(frozen=True, kw_only=True)
class Demo(
    Call,
    module="demo",
    summary="run the simulated testbed live, replay its trial, and show the errors",
):
    """Options of `demo`."""

    output: Path = option(Path("demo"), "folder of the trial and of the figure")
    seed: int = option(0, "seed of the simulated testbed", limits=SEEDS)


# Set up.


@dataclass(frozen=True, kw_only=True)
class Tile(
    Call,
    TileOptions,
    ReplaceOptions,
    module="design",
    summary="turn a scan into tiles, frames and neighbours",
    example="scan.stl -o socket.yaml",
):
    """Options of `tile`."""

    scan: Path = argument("STL, PLY or OBJ file")
    output: Path = required(
        "the socket.yaml to write, if any, with a picture (.png) and a page (.html) next to it"
    )
    height: float = option(
        80.0, "height of the distal end above the load cell [mm]", limits=(0.0, 1000.0)
    )
    size: float = option(30.0, "edge length of a tile [mm]", limits=(5.0, 100.0))
    flatness: float = option(8.0, "largest distance of the surface from a tile's plane [mm]")
    rounds: int = option(
        300, "rounds of the search; more may find further tiles", limits=(0, 100_000)
    )
    seed: int = option(0, "seed of the search", limits=SEEDS)
    points: tuple[str, str, str] | None = option(
        None,
        "origin of {S}, a point on its +x, one towards its +y, picked in the scan in its unit",
        metavar="'X Y Z'",
        either="points",
    )


@dataclass(frozen=True, kw_only=True)
class Calibrate(
    Call,
    CalibrationOptions,
    DrawOptions,
    ReplaceOptions,
    module="design",
    summary="fit a cluster's coefficients to bench data and show their quality",
    example="bench.csv --cluster distal -o calibration.yaml",
):
    """Options of `calibrate`."""

    bench: list[Path] = argument("CSV files of bench data, see docs/calibration.md")
    output: Path = required("the calibration file; an existing one keeps its other clusters")
    limit: float = option(
        10.0, "largest held-out RMSE in percent of full scale", limits=(0.0, 100.0)
    )
    force: bool = option(False, "write even above the limit")
    figure: Path | None = option(None, "draw the fit")


@dataclass(frozen=True, kw_only=True)
class Register(
    Call,
    RegistrationOptions,
    ReplaceOptions,
    module="design",
    summary="locate the marker bodies' frames from a static take and landmarks",
    epilog=_LANDMARK_FILE,
    example="static.csv --landmarks landmarks.yaml --socket socket.yaml",
):
    """Options of `register`."""

    take: Path = argument("the take, exported from Motive as CSV")
    output: Path | None = option(
        None, "file of the registered socket (default: replace the socket itself)"
    )


@dataclass(frozen=True, kw_only=True)
class Doctor(
    Call,
    ConfigurationOptions,
    SimulatedOptions,
    module="live",
    summary="check every connection, and say how to fix what fails",
    example="--press",
):
    """Options of `doctor`."""

    press: bool = option(
        False,
        "ask for a press on each cluster instead, with the limb out of the socket, to check its"
        " position, its sign, and the load cell's direction",
    )


# In the lab.


@dataclass(frozen=True, kw_only=True)
class Run(
    Call,
    ConfigurationOptions,
    LiveFitOptions,
    MetadataOptions,
    SimulatedOptions,
    module="live",
    summary="start the testbed, real or simulated, and record it",
    example="--record trials/s01 --view",
):
    """Options of `run`."""

    record: Path | None = option(
        None,
        "record a trial into this folder; without it, the page's button records into trials/",
        metavar="DIR",
    )
    model: Path | None = option(None, _PREDICTING, metavar="MODEL")
    rate: float | None = option(None, "trigger rate [Hz]")
    duration: float | None = option(
        None,
        "stop after this testbed time, counted from the first trigger [s]",
        limits=DURATIONS,
    )
    one_process: bool = option(False, "run all nodes except trigger and recorder in one process")
    view: bool = option(False, "serve the page for a browser, see 'socket-testbed view'")
    view_host: str | None = option(None, "serve the page on this address of the machine")
    view_port: int | None = option(None, "serve the page on this port")
    time_scale: float | Literal["auto"] = option(
        1.0,
        "speed of the simulated testbed relative to real time, at most 1; auto: as fast as the"
        " machine allows",
    )


@dataclass(frozen=True, kw_only=True)
class Record(
    Call,
    MetadataOptions,
    module="live",
    summary="record the graph as a trial",
    example="trials/s01",
):
    """Options of `record`."""

    directory: Path = argument("folder of the new trial")
    geometry: Path | None = option(None, "the socket.yaml to store in the trial")
    calibration: Path | None = option(None, "the calibration.yaml to store in the trial")
    params: Path | None = option(None, "the testbed.yaml to store in the trial")


@dataclass(frozen=True, kw_only=True)
class Mark(
    Call,
    module="mark",
    summary="mark an event in the running graph, for the trial being recorded",
    example="push",
):
    """Options of `mark`."""

    label: str = argument("label of the event, such as push")
    namespace: str = option("/", "namespace of the testbed")


@dataclass(frozen=True, kw_only=True)
class View(
    Call,
    PageOptions,
    TrialFiles,
    PriorOptions,
    module="pages",
    summary="view the running testbed, or play a trial, in a browser: pressure map, wrench,"
    " sensors",
    example="trials/s01",
):
    """Options of `view`."""

    trial: Path | None = argument(
        "folder of a trial to play; without one the running testbed is shown", None
    )
    namespace: str | None = option(None, "namespace of the running testbed (default: /)")
    duration: float | None = option(None, "stop after this time [s]", limits=DURATIONS)
    allow_host: Iterable[str] = several(
        "further host names of this machine under which browsers may open the page"
    )
    buttons: bool = option(
        False, "allow the buttons (tare, record, ...) even where other machines see the page"
    )
    model: Path | None = option(None, f"{_FITTED}, to show its predicted wrench", metavar="MODEL")


@dataclass(frozen=True, kw_only=True)
class Simulate(
    Call,
    SimulationOptions,
    module="trials",
    summary="write a simulated trial with its ground truth",
    example="-o trials/protocol --scenario protocol --duration 60",
):
    """Options of `simulate`."""

    output: Path = required("folder of the new trial")


@dataclass(frozen=True, kw_only=True)
class Import(
    Call,
    ImportOptions,
    module="imports",
    summary="make a trial from other sensors' topics or tables",
    example="lab_bag -o trials/s01 --rate 25",
):
    """Options of `import`."""

    source: list[Path] = argument("folder or storage file of a bag, or tables")
    output: Path = required("folder of the new trial")


# Afterwards.


@dataclass(frozen=True, kw_only=True)
class Info(
    Call,
    TrialFiles,
    module="trials",
    summary="show the contents of a trial: topics, rates, gaps, plateau",
    example="trials/s01",
):
    """Options of `info`."""

    trial: Path = argument("folder of the trial")


@dataclass(frozen=True, kw_only=True)
class Annotate(
    Call,
    MetadataOptions,
    module="trials",
    summary="set and show a trial's metadata: subject code, side, socket, liner and more",
    example="trials/s01 --subject S01 --side left --mass 82.5",
):
    """Options of `annotate`."""

    trial: list[Path] = argument("folders of one or more trials")
    remove: Iterable[str] = several("a field, or several, to remove")


@dataclass(frozen=True, kw_only=True)
class Report(
    Call,
    BatchOptions,
    DrawOptions,
    ReportOptions,
    module="pages",
    summary="write a page with a trial's results: figures, errors, data quality",
    example="trials/s01 -o s01.html",
):
    """Options of `report`."""

    output: Path = required("the page, or the folder of the pages of a folder of trials")
    figure: Path | None = internal(None, "not used: the page holds all figures")
    command: str = internal("", "the command as typed, for the record")


@dataclass(frozen=True, kw_only=True)
class Pressure(
    Call,
    BatchOptions,
    PressureOptions,
    DrawOptions,
    TableOptions,
    module="results",
    summary="pressure by region: mean, peak, contact area, time integral, shear, load",
    example="trials/s01 --segment hold -o s01.csv --figure s01.pdf",
):
    """Options of `pressure`."""

    output: Path | None = option(
        None, "table of the regions; for a folder of trials, the folder of these tables"
    )
    over_time: bool = option(
        False,
        "write a table over time instead: regions and tiles at every sample",
        either="course",
    )
    cycles: str | None = option(
        None,
        "write and draw means and standard deviations over 0 to 100 % of a cycle instead; cycles"
        " run from each event of a label to the next, such as 'stance', or between two labels, such"
        " as 'stance:swing'. Usually with --segment all",
        metavar="LABEL",
        either="course",
    )
    figure: Path | None = option(
        None, "draw unrolled maps, mean and at the peak, and regions over time"
    )


@dataclass(frozen=True, kw_only=True)
class Compare(
    Call,
    OpenOptions,
    ComparisonOptions,
    TableOptions,
    module="pages",
    summary="compare trials side by side, with their differences",
    example="trials/gel trials/sock --segment hold",
):
    """Options of `compare`."""

    trial: list[Path] | None = argument(
        "two or more trials; a folder of trials stands for all of them", None
    )
    condition: Iterable[str] = several(
        "instead, the repeated trials of a condition, such as gel=trials/gel1,trials/gel2",
        metavar="NAME=TRIAL,...",
    )
    output: Path | None = option(
        None, "a page (.html), or a table (.csv, .parquet) of all values and differences"
    )


@dataclass(frozen=True, kw_only=True)
class Survey(
    Call,
    SensorFiles,
    SurveyOptions,
    DrawOptions,
    TableOptions,
    module="pages",
    summary="judge and complete the map of one limb by trials with moved clusters",
    example="trials/a trials/b trials/c -o survey.html",
):
    """Options of `survey`."""

    trial: list[Path] = argument(
        "two or more trials of one limb in one socket; a folder of trials stands for all of them"
    )
    geometry: Sequence[Path] = several(
        "a socket.yaml for each trial, in their order, instead of their own: where its clusters are"
    )
    output: Path | None = option(
        None,
        "a page (.html), a table (.csv, .parquet) of the judged values, or the survey (.json) as"
        " the --prior of the next trial",
    )
    figure: Path | None = option(None, "draw each trial's own map and the completed one")


@dataclass(frozen=True, kw_only=True)
class Fit(
    Call,
    BatchOptions,
    FitOptions,
    module="results",
    summary="identify the contact model on a trial, or on every trial of a folder",
    example="trials/s01 -o s01.json",
):
    """Options of `fit`."""

    output: Path = required("file of the model, or the folder of the models of a folder of trials")


@dataclass(frozen=True, kw_only=True)
class Evaluate(
    Call,
    BatchOptions,
    EvaluationOptions,
    module="results",
    summary="compute a model's errors on a trial, or on every trial of a folder",
    example="trials/s02 --model s01.json",
):
    """Options of `evaluate`."""

    model: Path = required(
        f"{_FITTED}; for a folder of trials, also the folder of their models", metavar="MODEL"
    )
    output: Path | None = option(
        None, "JSON file of the errors; for a folder of trials, the folder of these files"
    )
    json: bool = option(False, "print JSON on standard output")


@dataclass(frozen=True, kw_only=True)
class Validate(
    Call,
    TrialFiles,
    ValidationOptions,
    DrawOptions,
    TableOptions,
    module="results",
    summary="judge estimates on held-out data, against simple rivals",
    example="trials/s01 trials/s02",
):
    """Options of `validate`."""

    trial: list[Path] = argument("trials, or folders of trials, of one socket")
    output: Path | None = option(None, "table with a row per trial, for a study")
    figure: Path | None = option(
        None, "draw the errors by cluster and the coverage of the intervals"
    )


@dataclass(frozen=True, kw_only=True)
class Replay(
    Call,
    TrialFiles,
    LiveFitOptions,
    module="live",
    summary="publish a trial with /clock; --estimate runs the estimator on it",
    example="trials/s01 --estimate",
):
    """Options of `replay`."""

    trial: Path = argument("folder of the trial")
    rate: float = option(1.0, "speed relative to the recording")
    loop: bool = option(False, "start again at the end")
    paused: bool = option(False, "start paused; the space bar continues")
    estimate: bool = option(False, "also run the calibration and estimator nodes")
    model: Path | None = option(None, _PREDICTING, metavar="MODEL")
    params: Path | None = option(None, OWN_PARAMS)


@dataclass(frozen=True, kw_only=True)
class Export(
    Call,
    OpenOptions,
    ExportOptions,
    ReplaceOptions,
    module="trials",
    summary="write a trial's samples as CSV, Parquet or MAT, or for OpenSim and C3D",
    example="trials/s01 -o s01.csv --pressure",
):
    """Options of `export`."""

    trial: Path = argument("folder of the trial")
    output: Path = required(
        "the file; its suffix, .csv, .parquet or .mat, selects the format. .mot and .sto are"
        " external loads for OpenSim, .trc its markers, .c3d both; .mcap holds standard ROS"
        " messages with named columns: see socket_testbed.trials.export"
    )
    map: bool = option(False, "add the force map as map.*")


@dataclass(frozen=True, kw_only=True)
class Map(
    Call,
    OpenOptions,
    MapOptions,
    DrawOptions,
    ReplaceOptions,
    module="results",
    summary="estimate the force on every tile with its uncertainty, without a fit",
    example="trials/s01 -o map.csv",
):
    """Options of `map`."""

    trial: Path = argument("folder of the trial")
    output: Path = required(
        "table of force, pressure and shear on every tile with standard deviations"
    )
    figure: Path | None = option(None, "draw the mean pressure and its uncertainty")


@dataclass(frozen=True, kw_only=True)
class Pareto(
    Call,
    OpenOptions,
    FrontOptions,
    DrawOptions,
    TableOptions,
    module="results",
    summary="trace the trade-off between wrench and clusters over theta",
    example="trials/s01 --thetas 21 --figure front.pdf",
):
    """Options of `pareto`."""

    trial: Path = argument("folder of the trial")
    output: Path | None = option(None, "table of all solutions")
    figure: Path | None = option(None, "draw both fronts")


@dataclass(frozen=True, kw_only=True)
class Paper(
    Call,
    OpenOptions,
    PaperOptions,
    TableOptions,
    module="results",
    summary="run the published pipeline and compare its figures with the published ones",
    example="trials/s01",
):
    """Options of `paper`."""

    trial: Path = argument("folder of the trial")


# The verbs in the order of the help, by what a user wants to do.
GROUPS: dict[str, tuple[type[Call], ...]] = {
    "try": (Demo,),
    "set up": (Tile, Calibrate, Register, Doctor),
    "in the lab": (Run, Record, Mark, View, Import, Simulate),
    "afterwards": (
        *(Info, Annotate, Report, Pressure, Compare, Survey, Fit, Evaluate, Validate),
        *(Replay, Export, Map, Pareto, Paper),
    ),
}
CALLS = {call.__name__.lower(): call for group in GROUPS.values() for call in group}  # by verb
