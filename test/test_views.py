"""The configurations of RViz, PlotJuggler and Foxglove name topics that exist, and their fields.

None of them runs here: each file must parse and name nothing that is not there.
"""

import json
import re
from importlib import import_module
from typing import Any
from xml.etree import ElementTree

import yaml

from socket_testbed.files import packaged
from socket_testbed.trials.topics import TOPICS

BY_NAME = {f"/{topic.name.lstrip('/')}": topic for topic in TOPICS}
SHOWN = {  # what a display of RViz shows
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "rviz_default_plugins/Wrench": "geometry_msgs/msg/WrenchStamped",
}


def field_type(kind: str, path: str) -> str:
    """Type of a field of a message, by the words between its slashes."""
    for word in path.split("/"):
        package, _, name = kind.rpartition("/")
        message: Any = getattr(import_module(f"{package.removesuffix('/msg')}.msg"), name)
        field, _, index = word.partition("[")
        kind = message.get_fields_and_field_types()[field]
        if index:
            kind = kind.removeprefix("sequence<").removesuffix(">")
    return kind


def test_rviz_shows_frames_map_and_wrenches() -> None:
    document = yaml.safe_load(packaged("config", "testbed.rviz").read_text())
    manager = document["Visualization Manager"]
    shown = {d["Topic"]["Value"]: d for d in manager["Displays"] if "Topic" in d}
    assert set(shown) == {"/estimate/pressure_map", "/load_cell/wrench", "/estimate/wrench"}
    for name, display in shown.items():
        assert BY_NAME[name].type == SHOWN[display["Class"]]
    assert manager["Global Options"]["Fixed Frame"] == "load_cell"


def test_plotjuggler_and_foxglove_draw_fields_of_topics_that_there_are() -> None:
    layout = ElementTree.fromstring(packaged("config", "plotjuggler_layout.xml").read_text())
    selected = {topic.attrib["name"] for topic in layout.iter("topic")}
    for name in (curve.attrib["name"] for curve in layout.iter("curve")):
        (topic,) = (t for t in selected if name.startswith(f"{t}/"))
        assert field_type(BY_NAME[topic].type, name.removeprefix(f"{topic}/")) == "double"

    foxglove = json.loads(packaged("config", "foxglove_layout.json").read_text())
    panels = foxglove["configById"]
    assert set(re.findall(r'"([\w]+![\w]+)"', json.dumps(foxglove["layout"]))) == set(panels)
    for panel in panels.values():
        for curve in panel.get("paths", ()):
            topic, _, field = curve["value"].removeprefix("/").partition(".")
            plain = re.sub(r"\[:\]\{.*\}", "[0]", field).replace(".", "/")
            assert field_type(BY_NAME[f"/{topic}"].type, plain) == "double", curve
        for named in ("topicPath", "topicToRender"):
            assert panel.get(named, "/trigger") in BY_NAME
        assert set(panel.get("topics", ())) <= set(BY_NAME)
