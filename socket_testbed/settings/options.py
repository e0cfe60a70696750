"""Options that functions of the API and verbs of the command line share.

Each option stands once, as a field: its type, its default, its range, and its text for a reader of
`--help`. An object of options is right for any trial: a number out of its range is refused.
Signatures of the API take their defaults from here, and the command line is made of these fields.
Nothing here imports an array library, so that `--help` and wrong calls stay quick.
"""

from __future__ import annotations

import dataclasses
import inspect
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from socket_testbed.documents import FINITE, check_number, check_whole
from socket_testbed.errors import option_of
from socket_testbed.settings.acquisition import TriggerSettings
from socket_testbed.settings.identification import IdentificationSettings, Variant, Weights
from socket_testbed.settings.testbed import ViewSettings

Side = Literal["left", "right"]
Scenario = Literal["static_hold", "ramp", "multi_direction", "protocol"]
TissueKind = Literal["soft", "stiff"]

SCENARIO = "the load history: static_hold, ramp, multi_direction or protocol"
TISSUE = "tissue of the limb: soft like the published experiment's silicone, or stiff"
SEED = "seed of the random numbers: of the limb, its load and all errors"
PACKAGED_SOCKET = "a socket.yaml (default: the package's own)"
DONNING = (
    "put the limb of this seed on again: seed of the donning, with other load, sensors and errors"
    " (default: the nominal donning)"
)
DONNING_SHARE = (
    "how much a donning differs: about the standard deviation of a tile's force over its rms;"
    " at 0.1 tissue shifts by 2.5 mm and 2.3 degrees, and the mean compression changes by 10 % [-]"
)
UNLIMITED = (-FINITE, FINITE)  # limits of a number without any
SEEDS = (0, sys.maxsize)
RATES = (0.1, 1000.0)  # [Hz]
DURATIONS = (0.1, 1e6)  # [s]; of live work
RECORDED = "recorded"  # the tare that a trial was recorded with


def option(
    default: Any,
    text: str,
    *,
    metavar: str = "",
    either: str = "",
    shown: Any = MISSING,
    setting: bool = False,
    limits: tuple[float, float] = UNLIMITED,
) -> Any:
    """A field that is an option of the command line.

    Args:
        default: The value if it is not given; `MISSING` for an option that must be given.
        text: What it is, for the help, with the unit in brackets.
        metavar: What stands for the value in the help; empty for the unit or the name.
        either: A word that this option shares with those that it excludes; empty for none.
        shown: The default that the help states, where `default` stands for another.
        setting: Whether it overrides the setting of a fit of this name, see `Options.overrides`.
        limits: The least and the largest value of a number, in its unit.
    """
    metadata = {"text": text, "metavar": metavar, "either": either, "setting": setting}
    metadata |= {"shown": default if shown is MISSING else shown, "limits": limits}
    return field(default=default, metadata=metadata)


def required(text: str, *, metavar: str = "") -> Any:
    """A field that is an option which must be given.

    Args:
        text: What it is, for the help, with the unit in brackets.
        metavar: What stands for the value in the help; empty for the unit or the name.
    """
    return option(MISSING, text, metavar=metavar)


def several(text: str, *, metavar: str = "") -> Any:
    """A field that is an option with any number of values, by default none.

    Args:
        text: What it is, for the help, with the unit in brackets.
        metavar: What stands for a value in the help; empty for the unit or the name.
    """
    return option((), text, metavar=metavar)


def argument(text: str, default: Any = MISSING) -> Any:
    """A field that is a positional argument of the command line.

    Args:
        text: What it is, for the help.
        default: The value if it is not given; `MISSING` for an argument that must be given.
    """
    metadata = {"text": text, "shown": None, "positional": True}
    return field(default=default, metadata=metadata, kw_only=False)


def internal(default: Any, text: str) -> Any:
    """A field that a verb sets itself, and that is no option.

    Args:
        default: Its value at first.
        text: What it is.
    """
    return field(default=default, metadata={"text": text, "internal": True})


def setting_of_fit(name: str, metavar: str = "", default: Any = None) -> Any:
    """An option that overrides a field of `IdentificationSettings`, with the text of the field.

    Args:
        name: The field, which the option is named after.
        metavar: What stands for the value in the help; empty for the unit or the name.
        default: The value if it is not given; None keeps the trial's own, and the help states the
            default of the field.
    """
    declared = IdentificationSettings.flat()[name]
    text = declared.metadata["description"]
    shown = declared.default if default is None else default
    return option(default, text, metavar=metavar, shown=shown, setting=True)


@dataclass(frozen=True, kw_only=True)
class Options:
    """Base class of options; the fields of a subclass document themselves by their texts."""

    heading: ClassVar[str] = ""

    def __init_subclass__(cls, heading: str = "") -> None:
        """Keep the heading of a class, and append `Attributes:` to its docstring.

        Args:
            heading: Heading of its options in the help; empty for the usual one.
        """
        super().__init_subclass__()
        cls.heading = heading
        if cls.__doc__:  # `python -OO` strips it
            entries = (
                f"    {name}: {declared.metadata['text']}."
                for name, declared in vars(cls).items()
                if isinstance(declared, dataclasses.Field)
            )
            cls.__doc__ = "\n".join([inspect.cleandoc(cls.__doc__), "\nAttributes:", *entries])

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            value, limits = getattr(self, item.name), item.metadata.get("limits", UNLIMITED)
            if limits == UNLIMITED or (value is None and item.default is None):
                continue
            whole = str(item.type).startswith("int")
            check = check_whole if whole else check_number
            object.__setattr__(self, item.name, check(value, option_of(item.name), *limits))

    def overrides(self) -> dict[str, Any]:
        """The settings of a fit that these options state, by their names; those not None."""
        names = (item.name for item in dataclasses.fields(self) if item.metadata.get("setting"))
        stated = {name: getattr(self, name) for name in names}
        return {name: value for name, value in stated.items() if value is not None}


def given(options: Options, *takers: Callable[..., Any]) -> dict[str, Any]:
    """The options that some functions or classes of options have, as keywords.

    Args:
        options: Options of a verb.
        takers: Functions that are called with the result, or classes of options.
    """
    names = {name for taker in takers for name in inspect.signature(taker).parameters}
    declared = (item.name for item in dataclasses.fields(options))
    return {name: getattr(options, name) for name in declared if name in names}


# What is read of a trial.

_SEGMENT = (
    "plateau, the longest; hold, the longest while the load is placed; auto, the hold or, failing"
    " that, the part under load; all; T0:T1 in seconds since the first sample; or event:A:B between"
    " events, such as event:placed+5:removed-2, with event labels, push#2 for the second push, or"
    " seconds at either end"
)
OWN_PARAMS = "a testbed.yaml to use instead of the trial's own"
_PARAMS_OF_EACH = "a testbed.yaml to use instead of each trial's own"
_THRESHOLD = "pressure above which a tile is in contact [kPa]"
_THRESHOLDS = (0.0, 500.0)  # [kPa]
_KEEP_OUT = "regions and tiles excluded from proposals, such as anterior proximal"
_PARAMS_OF_MAP = f"{OWN_PARAMS}; its group force_map sets the prior"


def segment_option(default: str) -> Any:
    """The option for the part of a trial.

    Args:
        default: The part by default, such as `plateau`.
    """
    return option(default, _SEGMENT, metavar="plateau|hold|auto|all|T0:T1|event:A:B")


@dataclass(frozen=True, kw_only=True)
class SensorFiles(Options):
    """Files and tare that the sensors of a trial are read with."""

    calibration: Path | None = option(None, "a calibration.yaml to use instead of the trial's own")
    load_cell: Path | None = option(
        None,
        "a testbed.yaml whose load cell (matrix, signs, gains, ...) replaces the trial's own and is"
        " applied to the recorded bridge ratios",
    )
    tare: str = option(
        RECORDED,
        "tare to subtract from the wrenches: the recorded one, none, or the mean of T0:T1, an"
        " unloaded span in seconds since the first sample",
        metavar="T0:T1|none|recorded",
    )


@dataclass(frozen=True, kw_only=True)
class TrialFiles(SensorFiles):
    """Files and tare that a trial is opened with."""

    geometry: Path | None = option(
        None,
        "a socket.yaml to use instead of the trial's own. If a body's markers differ there, its"
        " poses are refitted to the recorded markers",
    )


@dataclass(frozen=True, kw_only=True)
class OpenOptions(TrialFiles):
    """How a trial is opened, see `st.open_trial`."""

    unloaded: Sequence[str] = several(
        "unloaded spans before and after the load, used to correct the drift of the clusters;"
        " seconds since the first sample",
        metavar="T0:T1",
    )


# What a fit uses.


@dataclass(frozen=True, kw_only=True)
class SolutionOptions(Options):
    """Settings of every fit, see `IdentificationSettings`; None keeps those of the trial."""

    weights: Weights | None = setting_of_fit("weights")
    smoothness: float | None = setting_of_fit("smoothness")
    leave_out: Sequence[str] | None = setting_of_fit("leave_out", metavar="CHANNEL")
    solver: str | None = setting_of_fit("solver")


@dataclass(frozen=True, kw_only=True)
class ThetaOptions(SolutionOptions):
    """Settings of a fit with one theta."""

    theta: float | None = setting_of_fit("theta")


@dataclass(frozen=True, kw_only=True)
class LiveFitOptions(ThetaOptions):
    """Settings of a fit that the estimator node has, too."""

    variant: Variant | str | None = setting_of_fit("variant")


@dataclass(frozen=True, kw_only=True)
class PoseOptions(Options):
    """How poses are averaged for a fit."""

    pose_smoothing: float | None = setting_of_fit("pose_smoothing")


@dataclass(frozen=True, kw_only=True)
class OfflineOptions(PoseOptions):
    """Settings that only a fit on a recorded trial has."""

    frames: int | None = setting_of_fit("frames")
    initial_stiffness: float | Literal["auto"] | None = setting_of_fit(
        "initial_stiffness", metavar="K0|auto"
    )


@dataclass(frozen=True, kw_only=True)
class PartOptions(Options):
    """The part of a trial that is used, and its settings."""

    segment: str = segment_option("plateau")
    params: Path | None = option(None, OWN_PARAMS)


@dataclass(frozen=True, kw_only=True)
class SettingsOptions(LiveFitOptions, OfflineOptions):
    """What a call changes in the settings of a trial, see `Trial.settings_for`."""

    params: Path | None = option(None, OWN_PARAMS)


@dataclass(frozen=True, kw_only=True)
class FitOptions(PartOptions, SettingsOptions):
    """Options of `st.fit`."""


@dataclass(frozen=True, kw_only=True)
class ThetasOptions(Options):
    """Values of theta along a front."""

    thetas: int = option(101, "number of values of theta from 0 to 1", limits=(2, 10_001))


@dataclass(frozen=True, kw_only=True)
class FrontOptions(PartOptions, ThetasOptions, SolutionOptions, OfflineOptions):
    """Options of `st.pareto`."""


@dataclass(frozen=True, kw_only=True)
class PaperOptions(PartOptions, ThetasOptions, ThetaOptions, OfflineOptions):
    """Options of `st.paper`."""

    weights: Weights = setting_of_fit("weights", default="raw")
    frames: int = setting_of_fit("frames", default=1000)


@dataclass(frozen=True, kw_only=True)
class PriorOptions(Options):
    """The prior of the force map."""

    prior: Path | None = option(
        None,
        "a survey of this limb in this socket, such as the file of survey -o FILE.json, as a prior"
        " of the force map; the trial must not be in it",
        metavar="SURVEY",
    )


@dataclass(frozen=True, kw_only=True)
class ValidationOptions(ThetaOptions, PoseOptions, PriorOptions):
    """Options of `st.validate`."""

    segment: str = segment_option("all")
    params: Path | None = option(None, _PARAMS_OF_EACH)


# What is computed of a trial, and written.


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions(Options):
    """Options of `st.evaluate`."""

    segment: str = segment_option("plateau")
    pose_smoothing: float | None = option(
        None,
        "centred window of the mean pose [s] (default: that of the model's fit)",
    )
    pressure: bool = option(
        False,
        "add the pressure outputs of the segment. They come from the force map, not from the model",
    )


@dataclass(frozen=True, kw_only=True)
class MapOptions(PriorOptions):
    """Options of `st.force_map`."""

    segment: str = segment_option("plateau")
    params: Path | None = option(None, _PARAMS_OF_MAP)


@dataclass(frozen=True, kw_only=True)
class PressureOptions(MapOptions):
    """Options of `st.pressure`."""

    threshold: float = option(5.0, _THRESHOLD, limits=_THRESHOLDS)
    share: float = option(
        0.5,
        "a value is uncertain if its interval reaches farther than this share of it [-]",
        limits=(0.0, 5.0),
    )
    leave_out: Sequence[str] | None = option(
        None,
        "channels to ignore, such as distal.Fx or Mz; distal ignores all of a cluster",
        metavar="CHANNEL",
    )


@dataclass(frozen=True, kw_only=True)
class ComparisonOptions(PriorOptions):
    """Options of `st.compare`."""

    segment: str = segment_option("plateau")
    threshold: float = option(PressureOptions.threshold, _THRESHOLD, limits=_THRESHOLDS)
    by_region: bool = option(False, "compare trials by region alone; their sockets may then differ")
    params: Path | None = option(None, _PARAMS_OF_EACH)


@dataclass(frozen=True, kw_only=True)
class SurveyOptions(Options):
    """Options of `st.survey`."""

    segment: str = segment_option("plateau")
    clusters: int | None = option(
        None,
        "number of clusters of the next trial, for which places are proposed (default: as many as"
        " in the last one)",
        metavar="N",
        limits=(0, 64),
    )
    keep_out: Sequence[str] = several(_KEEP_OUT)
    params: Path | None = option(None, _PARAMS_OF_EACH)


@dataclass(frozen=True, kw_only=True)
class ReportOptions(PartOptions, ThetasOptions, ThetaOptions, OfflineOptions, PriorOptions):
    """Options of `st.write_report`."""

    model: Path | None = option(None, "a further model to show", metavar="MODEL")
    figures: bool = option(False, "add figures for print to the folder, as .pdf and .png")


@dataclass(frozen=True, kw_only=True)
class ExportOptions(PriorOptions):
    """Options of `st.export`."""

    segment: str = segment_option("all")
    model: Path | None = option(
        None,
        "a model whose predictions are added as predicted.* and engaged springs as springs.*",
        metavar="MODEL",
    )
    pressure: bool = option(False, "add pressure and shear of every region and tile as pressure.*")
    cycles: str | None = option(
        None,
        "events that delimit cycles; the table then holds mean and standard deviation of all"
        " columns over 0 to 100 % of a cycle",
        metavar="LABEL",
    )
    about: tuple[float, float, float] | None = option(
        None,
        "reference point of the moments in {S}, such as the knee's centre [m] (default: the load"
        " cell's origin)",
    )


@dataclass(frozen=True, kw_only=True)
class PageOptions(Options):
    """Where a page is served, see `st.view`."""

    host: str = option(
        ViewSettings.host,
        "address of this machine to serve the page on, 0.0.0.0 for all; at 127.0.0.1 only this"
        " machine can open it",
    )
    port: int = option(ViewSettings.port, "port of the page; 0 for any free port")


@dataclass(frozen=True, kw_only=True)
class MetadataOptions(Options):
    """What is stated about a trial, see `st.annotate`."""

    subject: str | None = option(None, "code of the subject, such as S01; never a name")
    side: Side | None = option(None, "side of the residual limb, left or right")
    socket: str | None = option(None, "the socket, such as PTB 3")
    liner: str | None = option(None, "liner or sock")
    mass: float | None = option(None, "body mass of the subject [kg]")
    operator: str | None = option(None, "initials or code of the operator")
    protocol: str | None = option(None, "the protocol followed")
    notes: str | None = option(None, "any further remarks")


@dataclass(frozen=True, kw_only=True)
class SimulationOptions(Options):
    """Options of `st.simulate`."""

    scenario: Scenario = option("static_hold", SCENARIO)
    tissue: TissueKind = option("soft", TISSUE)
    like_paper: bool = option(
        False,
        "make the errors of load cell and clusters as large as in the published experiment, with a"
        " calibration whose ranges admit them; the settings stored with the trial leave out the"
        " three channels that the paper leaves out",
    )
    duration: float = option(120.0, "duration [s]", limits=(1.0, 36000.0))
    rate: float = option(TriggerSettings.rate, "trigger rate [Hz]", limits=RATES)
    seed: int = option(0, SEED, limits=SEEDS)
    donning: int | None = option(None, DONNING, metavar="SEED")
    donning_share: float = option(0.1, DONNING_SHARE)
    geometry: Path | None = option(None, PACKAGED_SOCKET)
    calibration: Path | None = option(
        None,
        "a calibration.yaml (default: the package's own, config/like_paper.yaml with like_paper)",
    )
    replace: bool = option(
        False, "replace an older simulated trial in that folder, and nothing else"
    )


WrenchOf = Literal["limb", "socket"]


@dataclass(frozen=True, kw_only=True)
class ImportOptions(Options):
    """Options of `st.import_trial`."""

    wrench: str | None = option(
        None,
        "topic or table of the load cell's wrench, or none (default: found by its type)",
        metavar="TOPIC",
    )
    socket_pose: str | None = option(
        None,
        "topic of the pose of the socket's marker body, TOPIC:BODY for one of rigid bodies,"
        " tf:PARENT/CHILD for a transform, FILE:BODY of a take, or none (default: found by type and"
        " name)",
        metavar="TOPIC",
    )
    pylon_pose: str | None = option(
        None,
        "topic of the pose of the pylon's marker body, TOPIC:BODY for one of rigid bodies,"
        " tf:PARENT/CHILD for a transform, FILE:BODY of a take, or none (default: found by type and"
        " name)",
        metavar="TOPIC",
    )
    clusters: str | None = option(
        None,
        "topic or table of the clusters' capacitances or stresses, or none (default: found by type"
        " and name)",
        metavar="TOPIC",
    )
    names: Sequence[str] = several(
        "clusters of an array or table without names, in its order, four capacitances each"
    )
    rate: float | None = option(
        None,
        "rate of triggers over the time that all sources share [Hz] (default:"
        f" {TriggerSettings.rate:g}, unless a trigger is given)",
        either="triggers",
        limits=RATES,
    )
    trigger: str | None = option(
        None, "topic whose stamps are the triggers", metavar="TOPIC", either="triggers"
    )
    offset: Sequence[str] = several(
        "what to add to the times of the table of wrench, socket_pose, pylon_pose or clusters, so"
        " that they count as those of the first table [s]; tap if both see one tap",
        metavar="SOURCE=S",
    )
    tap: str | None = option(
        None,
        "seconds since the start of each table in which the tap is (default: any)",
        metavar="T0:T1",
    )
    columns: Sequence[str] = several(
        "titles of columns of tables, for time, Fx to Mz, or a channel such as distal.0",
        metavar="WHAT=TITLE",
    )
    units: Sequence[str] = several(
        "units of tables, for time, force, moment, capacitance, stress or length; they override"
        " those of the titles",
        metavar="WHAT=UNIT",
    )
    row_rate: Sequence[str] = several(
        "rate of the rows of a source's table without times [Hz]", metavar="SOURCE=HZ"
    )
    delay: Iterable[str] = several(
        "delay of the stamps of wrench, socket_pose, pylon_pose or clusters behind the measurement"
        " [s]; auto finds it against the load, from a minute of brisk pushing",
        metavar="SOURCE=S",
    )
    wrench_of: WrenchOf | None = option(
        None,
        "whose force the wrench is: of the limb on the socket, as in a trial, or of the socket on"
        " the limb, which is negated (default: limb)",
    )
    tare: str | None = option(
        None,
        "span without load, since the first trigger [s], whose mean wrench is subtracted (default:"
        " none, for a load cell that is tared)",
        metavar="T0:T1",
    )
    mapping: Path | None = option(
        None,
        "a mapping.yaml with topics, windows, delays and the pose of the load cell in {S}",
        either="mapping",
    )
    like: Path | None = option(
        None,
        "an imported trial, whose mapping, socket and calibration are used again, with the delays"
        " that were found; whatever else is given replaces its own",
        metavar="TRIAL",
        either="mapping",
    )
    geometry: Path | None = option(
        None, "a socket.yaml (default: that of the trial to be like, or the package's own)"
    )
    calibration: Path | None = option(
        None, "a calibration.yaml (default: that of the trial to be like, or the package's own)"
    )


# The socket and its calibration.


@dataclass(frozen=True, kw_only=True)
class TileOptions(Options):
    """Options of `st.tile`."""

    unit: Literal["m", "cm", "mm", "in"] | None = option(
        None, "unit of the scan's lengths (default: inferred)"
    )
    body: str | None = option(None, "name or number of the body, if the file has several")
    proximal: str | None = option(
        None, "direction of the opening in the scan, such as +z or 0 0.1 1 (default: detected)"
    )
    anterior: str | None = option(None, "direction of the x axis of {S} in the scan")
    landmarks: Path | None = option(
        None, "YAML file of points known in the scan and in {S}", either="points"
    )
    clusters: Path | None = option(
        None, "YAML file of cluster positions in {S} or in the scan (default: the usual ones)"
    )
    place: int = option(
        0,
        "total number of clusters: given ones stay, the others are proposed where they are most"
        " informative for the force map; 0: none is proposed",
        limits=(0, 1000),
    )
    keep_out: Sequence[str] = several(_KEEP_OUT)
    bodies: Path | None = option(
        None, "a registered socket.yaml whose marker bodies are kept (default: nominal ones)"
    )


@dataclass(frozen=True, kw_only=True)
class RegistrationOptions(Options):
    """Options of `st.register`."""

    landmarks: Path = required("YAML file that assigns the markers and locates the landmarks")
    socket: Path = required("the socket.yaml to register")
    force: bool = option(
        False, "accept landmarks with large residuals, or a limb outside the socket"
    )


@dataclass(frozen=True, kw_only=True)
class CalibrationOptions(Options):
    """Options of `st.calibrate`."""

    cluster: str = required("name of the cluster")
    into: Path | None = option(None, "a calibration whose other clusters are kept")
    baseline: Sequence[Path] = several(
        "CSV files of unloaded readings before the bench run and, to correct its drift, after it"
    )
    columns: Sequence[str] = several(
        "header names of quantities (time, cycle, normal, shear_x, shear_y, c0 to c3), keyed by"
        " quantity",
        metavar="QUANTITY=HEADER",
    )
    units: Sequence[str] = several(
        "units that override the header's, keyed by quantity: Pa, kPa, MPa, N, kN; pF, fF, nF,"
        " counts of an FDC1004; s, ms",
        metavar="QUANTITY=UNIT",
    )
    area: float | None = option(
        None, "area that converts forces into stresses [m^2]", either="area"
    )
    geometry: Path | None = option(
        None, "a socket.yaml that supplies the area of the cluster's tile instead", either="area"
    )
    wiring: tuple[int, int, int, int] | None = option(
        None,
        "input of each channel (-x,+y), (+x,+y), (-x,-y), (+x,-y) (default: the existing"
        " cluster's, else 0, 1, 2, 3)",
        metavar="C",
    )
    drop_outliers: bool = option(False, "leave outliers out of the fit")
