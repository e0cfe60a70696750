"""The topics of the testbed: names, types, and whether a trial needs them; names of services."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from socket_testbed.errors import ConfigurationError, TrialError


@dataclass(frozen=True)
class Topic:
    """A topic of the testbed.

    Attributes:
        name: Its name, relative to the namespace of the testbed, or absolute (`/diagnostics`).
        type: Its message type, as `package/msg/Type`.
        required: Whether the offline analysis of a trial needs it.
        computed: Whether a node computes it from measured topics.
        unrecorded: Whether it is left out of trials: large, and can be recomputed from them.
        latched: Whether late subscribers get the last message (transient local).
    """

    name: str
    type: str
    required: bool = False
    computed: bool = False
    unrecorded: bool = False
    latched: bool = False

    @property
    def depth(self) -> int:
        """Queue of a publisher [messages]."""
        return 1 if self.latched else PUBLISHER_DEPTH


TRIGGER = Topic("trigger", "socket_testbed_msgs/msg/Trigger", required=True)
CAPACITANCE = Topic(
    "clusters/capacitance", "socket_testbed_msgs/msg/ClusterCapacitanceArray", required=True
)
WRENCH = Topic("load_cell/wrench", "geometry_msgs/msg/WrenchStamped", required=True)
LOAD_CELL_RAW = Topic("load_cell/raw", "socket_testbed_msgs/msg/LoadCellRaw")
SOCKET_POSE = Topic("mocap/socket/pose", "geometry_msgs/msg/PoseStamped", required=True)
PYLON_POSE = Topic("mocap/pylon/pose", "geometry_msgs/msg/PoseStamped", required=True)
POSES = {"socket": SOCKET_POSE, "pylon": PYLON_POSE}  # by body
MARKERS = Topic("mocap/markers", "socket_testbed_msgs/msg/RigidBodyMarkersArray")
EVENT = Topic("event", "socket_testbed_msgs/msg/Event")
TARE = "tare"  # first word in the label of a tare event
STRESS = Topic("clusters/stress", "socket_testbed_msgs/msg/ClusterStressArray", computed=True)
ESTIMATED_WRENCH = Topic("estimate/wrench", "geometry_msgs/msg/WrenchStamped", computed=True)
LOCAL_FORCES = Topic(
    "estimate/local_forces", "socket_testbed_msgs/msg/LocalForceArray", computed=True
)
FORCE_MAP = Topic(
    "estimate/force_map", "socket_testbed_msgs/msg/ForceMap", computed=True, unrecorded=True
)
REGIONS = Topic(
    "estimate/regions", "socket_testbed_msgs/msg/RegionPressures", computed=True, unrecorded=True
)
PARAMETERS = Topic(
    "estimate/parameters", "socket_testbed_msgs/msg/ContactModel", computed=True, latched=True
)
PRESSURE_MAP = Topic(
    "estimate/pressure_map", "visualization_msgs/msg/MarkerArray", computed=True, unrecorded=True
)
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", computed=True)

TOPICS = (
    *(TRIGGER, CAPACITANCE, WRENCH, LOAD_CELL_RAW, SOCKET_POSE, PYLON_POSE, MARKERS, EVENT, STRESS),
    *(ESTIMATED_WRENCH, LOCAL_FORCES, FORCE_MAP, REGIONS, PARAMETERS, PRESSURE_MAP, DIAGNOSTICS),
)
REQUIRED = tuple(topic for topic in TOPICS if topic.required)


class Service(StrEnum):
    """Names of the services, relative to the namespace of the testbed."""

    TARE = "load_cell/tare"
    FORCE_TARE = "load_cell/force_tare"
    FIT = "estimator/fit"
    ENABLE_TRIGGER = "trigger/enable"
    RECORD = "recorder/record"
    PAUSE_REPLAY = "replay/pause"


PUBLISHER_DEPTH = 100  # [messages]; of all publishers except latched ones

# Time of a replay, or of a simulation that runs slower than real time; then nodes use it.
CLOCK = Topic("/clock", "rosgraph_msgs/msg/Clock")

# Transforms for RViz and others. They follow from the poses and the geometry in a trial, so they
# are not recorded, and a replay recomputes them. Each testbed has its own, in the namespace of its
# other topics.
TF = Topic("tf", "tf2_msgs/msg/TFMessage")
TF_STATIC = Topic("tf_static", "tf2_msgs/msg/TFMessage", latched=True)

# Name of the trial being recorded; empty if none. Not a measurement, so not recorded.
RECORDED_TRIAL = Topic("recorder/trial", "std_msgs/msg/String", latched=True)


def match_topics(types: Mapping[str, str], where: str) -> dict[Topic, str]:
    """The bag's full name of each topic of the testbed, in any namespace.

    Another program's topic whose name ends like the testbed's, with another type, does not count
    beside the testbed's.

    Args:
        types: Message types of the bag, as `package/msg/Type`, by full name of the topic.
        where: Names the bag in errors.

    Returns:
        The full names by topic; topics that the bag lacks are left out.

    Raises:
        TrialError: If a topic is in two namespaces.
    """
    found: dict[Topic, str] = {}
    for name, kind in types.items():
        for topic in TOPICS:
            inside = not topic.name.startswith("/") and name.endswith(f"/{topic.name}")
            if name == topic.name or inside:
                other = found.get(topic)
                if other and kind != topic.type:
                    continue
                if other and types[other] == topic.type:
                    raise TrialError(
                        f"{where}: two topics are a '{topic.name}': {other} and {name}",
                        "record one testbed per trial",
                    )
                found[topic] = name
    return found


def namespace_of(name: str, topic: Topic) -> str:
    """Namespace of a topic in a graph, such as /lab for /lab/trigger; empty for none.

    Args:
        name: The topic's full name in the graph.
        topic: The topic.
    """
    return name.removesuffix(topic.name).rstrip("/")


def full_name(name: str, namespace: str) -> str:
    """An absolute name in the graph, such as /left/trigger for trigger in /left.

    Args:
        name: Name relative to the namespace; one that begins with `/` is returned as it is.
        namespace: The namespace, absolute; empty or `/` for none.
    """
    return name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"


def full_namespace(given: str) -> str:
    """An absolute ROS namespace, such as /left for left.

    Raises:
        ConfigurationError: If ROS does not accept it.
    """
    namespace = "/" + given.strip("/")
    if not re.fullmatch(r"/|(/[A-Za-z_][A-Za-z0-9_]*)+", namespace):
        raise ConfigurationError(f"'{given}' is not a namespace", "give one such as /left, or /")
    return namespace
