"""Settings of all nodes as one tree, and their file `testbed.yaml`.

Nodes declare their parameters from these classes under the same dotted names. The defaults are
defined only here, in `acquisition.py` and in `identification.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from socket_testbed.documents import dump_yaml
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import write_text
from socket_testbed.settings.acquisition import (
    ClusterSettings,
    LoadCellSettings,
    MocapSettings,
    TriggerSettings,
)
from socket_testbed.settings.alignment import NONE, OWN, AlignSettings
from socket_testbed.settings.fields import Settings, fixed, setting
from socket_testbed.settings.identification import (
    ForceMapSettings,
    IdentificationSettings,
    PlateauSettings,
    check_solver,
)
from socket_testbed.settings.parameter_file import read_parameters


@dataclass(frozen=True)
class WindowSettings(Settings):
    """The samples used for fits while a trial runs."""

    duration: float = fixed(60.0, "length of the window of recent samples [s]", 1.0, 3600.0)
    least_samples: int = setting(80, "steady samples before an automatic fit [1]", 10, 1000000)
    refit_after: int = setting(80, "new samples before the next fit; 0: never [1]", 0, 1000000)
    pending: int = fixed(200, "stamps kept while waiting for their measurements [1]", 2, 100000)


@dataclass(frozen=True)
class EstimatorSettings(Settings):
    """Parameters of the estimator node."""

    geometry: str = fixed("", "path of socket.yaml; empty: the package's own [-]")
    model: str = fixed("", "path of a fitted model to start from; empty: none [-]")
    auto_fit: bool = setting(True, "fit once there is enough steady data [-]")
    identification: IdentificationSettings = IdentificationSettings()
    plateau: PlateauSettings = PlateauSettings()
    window: WindowSettings = WindowSettings()
    force_map: ForceMapSettings = field(default_factory=ForceMapSettings)


@dataclass(frozen=True)
class CalibrationNodeSettings(Settings):
    """Parameters of the calibration node."""

    calibration: str = fixed("", "path of calibration.yaml; empty: the package's own [-]")


_FORBIDDEN = ',<>:"/\\|?*'  # a comma ends Motive's commands; Windows forbids the rest in names
MAX_MASS = 400.0  # [kg]; of the subject
_MAX_NAME_LENGTH = 200  # [bytes]


def check_take_name(name: str, what: str = "the trial's name") -> str:
    """Refuse a trial's name that is not valid for a take in Motive; returns a valid one.

    Args:
        name: The name, without a folder.
        what: How errors call the name.

    Raises:
        ConfigurationError: If the name is empty or longer than 200 bytes, begins or ends with a
            dot or a blank, or holds a character that Motive or Windows forbids.
    """
    hint = f"give letters, digits, blanks, '-', '_' and '.', {_MAX_NAME_LENGTH} bytes at most"
    shown = ascii(name if len(name) <= 40 else f"{name[:40]}...")
    if not name.isprintable() or set(name) & set(_FORBIDDEN):
        raise ConfigurationError(f"{what} {shown} cannot be that of a take", hint)
    if not name.strip(". ") or name[0] in ". " or name[-1] in ". ":
        fact = f"{what} {shown} begins or ends with a '.' or a blank, or is empty"
        raise ConfigurationError(fact, hint)
    if len(name.encode()) > _MAX_NAME_LENGTH:
        raise ConfigurationError(f"{what} {shown} has {len(name.encode())} bytes", hint)
    return name


@dataclass(frozen=True)
class NextTrialSettings(Settings):
    """The next trial to record; the recorder clears these when it starts."""

    name: str = setting("", "name of the trial; empty: the date and time [-]")
    subject: str = setting("", "code of the subject, such as S01 [-]")
    side: str = setting("", "side of the residual limb, left or right [-]")
    socket: str = setting("", "the socket, such as PTB 3 [-]")
    liner: str = setting("", "liner or sock [-]")
    mass: float = setting(0.0, "body mass of the subject; 0: not stated [kg]", 0.0, MAX_MASS)
    operator: str = setting("", "initials or a code of the operator [-]")
    protocol: str = setting("", "the protocol of the trial [-]")
    notes: str = setting("", "further notes [-]")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.name:
            check_take_name(self.name, "name: the trial's name")


@dataclass(frozen=True)
class RecorderSettings(Settings):
    """Parameters of the recorder node."""

    directory: str = fixed("trials", "folder of the trials, or of the one trial [-]")
    record: bool = fixed(False, "record from the start, into `directory` itself [-]")
    geometry: str = fixed("", "path of socket.yaml to store; empty: the package's own [-]")
    calibration: str = fixed("", "path of calibration.yaml to store; empty: the package's own [-]")
    parameters: str = fixed("", "path of the testbed.yaml to store; empty: the package's own [-]")
    metadata: str = fixed("", "path of a trial.yaml as template for every trial; empty: none [-]")
    everything: bool = fixed(False, "also record the maps, which a replay recomputes [-]")
    beside: tuple[str, ...] = fixed((), "topics of other programs to record as well [-]")
    absent: tuple[str, ...] = fixed((), "topics that this testbed does not measure [-]")
    next: NextTrialSettings = NextTrialSettings()
    flush_period: float = fixed(1.0, "longest time before data is on the disk [s]", 0.05, 60.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.record:
            check_take_name(Path(self.directory).absolute().name)


@dataclass(frozen=True)
class ReplaySettings(Settings):
    """Parameters of the replay node."""

    trial: str = fixed("", "path of the trial [-]")
    namespace: str = fixed("", "namespace to publish in, such as /left; empty: as recorded [-]")
    geometry: str = fixed("", "path of socket.yaml, for all poses; empty: the trial's own [-]")
    load_cell: str = fixed("", "path of testbed.yaml for the wrenches; empty: the trial's own [-]")
    tare: str = fixed("recorded", "tare of the wrenches: recorded, none, or T0:T1 without load [s]")
    rate: float = fixed(1.0, "speed of the replay relative to the recording [-]", 1e-3, 1e4)
    loop: bool = fixed(False, "restart at the end [-]")
    paused: bool = fixed(False, "start paused; see the service replay/pause [-]")
    measured_only: bool = fixed(False, "leave out topics that other nodes recompute [-]")
    wait_for: tuple[str, ...] = fixed((), "nodes that must be ready before the first message [-]")


@dataclass(frozen=True)
class ViewSettings(Settings):
    """Parameters of the view node."""

    geometry: str = fixed("", "path of socket.yaml; empty: the package's own [-]")
    host: str = fixed("127.0.0.1", "address to serve the page on [-]")
    port: int = fixed(8080, "port of the page; 0: any free port [1]", 0, 65535)
    names: tuple[str, ...] = fixed((), "further host names accepted for the page [-]")
    buttons: bool = fixed(False, "allow the buttons if other machines can see the page [-]")


@dataclass(frozen=True)
class TestbedSettings(Settings):
    """Settings of the testbed, one field per node."""

    __test__ = False

    trigger_node: TriggerSettings = field(default_factory=TriggerSettings)
    cluster_node: ClusterSettings = field(default_factory=ClusterSettings)
    load_cell_node: LoadCellSettings = field(default_factory=LoadCellSettings)
    mocap_node: MocapSettings = field(default_factory=MocapSettings)
    align_node: AlignSettings = field(default_factory=AlignSettings)
    calibration_node: CalibrationNodeSettings = field(default_factory=CalibrationNodeSettings)
    estimator_node: EstimatorSettings = field(default_factory=EstimatorSettings)
    recorder_node: RecorderSettings = field(default_factory=RecorderSettings)
    replay_node: ReplaySettings = field(default_factory=ReplaySettings)
    view_node: ViewSettings = field(default_factory=ViewSettings)

    def nodes(self) -> dict[str, Settings]:
        """Settings of each node by its name, such as `trigger_node`."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    @property
    def cluster_names(self) -> tuple[str, ...]:
        """Names of the clusters, measured by own chips or another driver; empty without any."""
        clusters = self.align_node.clusters
        if clusters.topic == NONE:
            return ()
        own = self.cluster_node.names
        return clusters.names or own if clusters.is_foreign else own

    @property
    def own_nodes(self) -> tuple[str, ...]:
        """The nodes of own drivers whose measurements no other driver makes."""
        align = self.align_node
        poses = align.socket_pose.topic, align.pylon_pose.topic
        own = {
            "cluster_node": align.clusters.topic == OWN,
            "load_cell_node": align.wrench.topic == OWN,
            "mocap_node": poses == (OWN, OWN),
        }
        return tuple(name for name, is_own in own.items() if is_own)


# These belong to a single run on one machine and are not stored with a trial.
_RUN_SPECIFIC = (
    *("geometry", "calibration", "parameters", "model", "simulation", "tare_file"),
    *("directory", "record", "wait_for", "metadata"),
)


def read_testbed(
    path: Path, defaults: TestbedSettings | None = None, namespace: str = "/"
) -> TestbedSettings:
    """Read `testbed.yaml`: node parameters in the ROS format, one section per node.

    Unlike ROS, this refuses undeclared keys. Sections for any node (`/**`) give their parameters to
    every node that has them.

    Args:
        path: The file; an empty one gives the defaults.
        defaults: Settings of the nodes that the file does not name; None for those of the classes.
            A node that the file names does not use them: its other fields have the classes'
            defaults.
        namespace: Absolute namespace of the nodes.

    Raises:
        ConfigurationError: If the file cannot be read, a key or a value is wrong, or it holds only
            nodes of other namespaces.
    """
    defaults = defaults or TestbedSettings()
    nodes = defaults.nodes()
    known = {name: type(settings).flat() for name, settings in nodes.items()}
    given: dict[str, Any] = {}
    for node, (values, named) in read_parameters(path, known, namespace).items():
        others = {} if named else nodes[node].to_flat()
        given[node] = type(nodes[node]).from_flat(others | values, f"{path}: {node}")
    return replace(defaults, **given)


def estimator_settings(
    stored: EstimatorSettings, overrides: Mapping[str, Any], params: Path | None = None
) -> EstimatorSettings:
    """Settings stored with a trial, or those of a `testbed.yaml`, with what a call overrides.

    Args:
        stored: The settings stored with the trial.
        overrides: Fields of `IdentificationSettings` by name, see `Options.overrides`.
        params: A `testbed.yaml` whose estimator node replaces the stored settings; None for these.

    Raises:
        ConfigurationError: If the file, an override, or the name of the solver is wrong.
    """
    settings = stored if params is None else read_testbed(params).estimator_node
    chosen = replace(settings.identification, **overrides)
    if params is not None or "solver" in overrides:
        check_solver(chosen.solver)
    return replace(settings, identification=chosen)


def write_testbed(nodes: dict[str, Settings], path: Path) -> None:
    """Write settings by node name as a `testbed.yaml` for other runs and machines.

    An empty list is left out where it is the default: ROS does not know its type. Values that
    belong to a single run, such as paths of files, are left out too.

    Args:
        nodes: Settings by node name, such as `trigger_node`.
        path: The file; an existing one is replaced.
    """
    document = {}
    for node, settings in nodes.items():
        usual = type(settings)().to_flat()
        written = {
            name: value
            for name, value in settings.to_flat().items()
            if name not in _RUN_SPECIFIC and not value == usual[name] == []
        }
        document[node] = {"ros__parameters": written}
    write_text(path, dump_yaml(document))
