"""The configurations of RViz and PlotJuggler name topics that exist, with their types and fields.

Neither program runs here: each file must parse and name nothing that is not there.
"""

from importlib import import_module
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from socket_testbed.files import packaged
from socket_testbed.settings.acquisition import ClusterSettings
from socket_testbed.trials.topics import PRESSURE_MAP, STRESS, TOPICS, WRENCH

BY_NAME = {f"/{topic.name.lstrip('/')}": topic for topic in TOPICS}
SHOWN = {  # what a display of RViz shows
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "rviz_default_plugins/Wrench": "geometry_msgs/msg/WrenchStamped",
}


def test_rviz_shows_frames_map_and_wrenches() -> None:
    manager = yaml.safe_load(packaged("config", "testbed.rviz").read_text())[
        "Visualization Manager"
    ]
    displays = manager["Displays"]
    assert all(display["Enabled"] and display["Value"] for display in displays)
    shown = {d["Topic"]["Value"]: SHOWN[d["Class"]] for d in displays if "Topic" in d}
    assert set(shown) == {"/estimate/pressure_map", "/load_cell/wrench", "/estimate/wrench"}
    for name, kind in shown.items():
        assert BY_NAME[name].type == kind
    for display in displays:
        if "Topic" in display:
            assert display["Topic"]["Reliability Policy"] == "Reliable"
            assert display["Topic"]["Durability Policy"] == "Volatile"
    assert "rviz_default_plugins/TF" in {display["Class"] for display in displays}
    assert manager["Global Options"]["Fixed Frame"] == "load_cell"
    (picture,) = (d for d in displays if d["Class"].endswith("MarkerArray"))
    assert picture["Topic"]["Value"] == f"/{PRESSURE_MAP.name}"
    assert set(picture["Namespaces"]) == {"tiles", "forces"}


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


@pytest.fixture(scope="module")
def layout() -> ElementTree.Element:
    return ElementTree.fromstring(packaged("config", "plotjuggler_layout.xml").read_text())


def curves(layout: ElementTree.Element) -> list[str]:
    return [curve.attrib["name"] for curve in layout.iter("curve")]


def test_plotjuggler_s_curves_are_fields_of_the_topics_that_it_selects(
    layout: ElementTree.Element,
) -> None:
    selected = {topic.attrib["name"] for topic in layout.iter("topic")}
    for name in curves(layout):
        (topic,) = (t for t in selected if name.startswith(f"{t}/"))
        assert field_type(BY_NAME[topic].type, name.removeprefix(f"{topic}/")) == "double"


def test_plotjuggler_draws_six_channels_twice_and_every_cluster(
    layout: ElementTree.Element,
) -> None:
    found = set(curves(layout))
    for kind in ("force", "torque"):
        for axis in "xyz":
            pair = {f"/{name}/wrench/{kind}/{axis}" for name in (WRENCH.name, "estimate/wrench")}
            assert pair <= found
            plots = [{curve.get("name") for curve in plot} for plot in layout.iter("plot")]
            assert any(pair <= names for names in plots), "beside each other"
    titles = [area.attrib["name"] for area in layout.iter("DockArea")]
    for i, name in enumerate(ClusterSettings().names):
        assert f"{name} [Pa]" in titles
        for field in ("normal", "shear_x", "shear_y"):
            assert f"/{STRESS.name}/clusters[{i}]/{field}" in found
    for splitter in layout.iter("DockSplitter"):
        assert int(splitter.attrib["count"]) == len(splitter)
