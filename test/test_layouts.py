"""Layouts of RViz, PlotJuggler and Foxglove: each names topics and fields that exist."""

import json
import re
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from socket_testbed.files import packaged
from socket_testbed.wire.cdr import fields_of
from socket_testbed.wire.topics import TOPICS

TYPES = {f"/{topic.name.lstrip('/')}": topic.type for topic in TOPICS}


def field_type(path: str) -> str:
    """Type of the field at a path, such as /load_cell/wrench/wrench/force/x."""
    topic = max((name for name in TYPES if path.startswith(f"{name}/")), key=len)
    kind = TYPES[topic]
    for word in path.removeprefix(f"{topic}/").split("/"):
        kind = {field.name: field.type for field in fields_of(kind)}[word.partition("[")[0]]
    return kind


def test_rviz_shows_topics_by_displays_of_their_types() -> None:
    document = yaml.safe_load(packaged("config", "testbed.rviz").read_text())
    displays = document["Visualization Manager"]["Displays"]
    shown = {d["Topic"]["Value"]: d["Class"].rpartition("/")[2] for d in displays if "Topic" in d}
    assert len(shown) == 3 and all(display in TYPES[topic] for topic, display in shown.items())


def test_plotjuggler_draws_numbers_of_topics_it_selects() -> None:
    layout = ElementTree.fromstring(packaged("config", "plotjuggler_layout.xml").read_text())
    selected, curves = ({e.attrib["name"] for e in layout.iter(k)} for k in ("topic", "curve"))
    assert curves and selected <= set(TYPES)
    for curve in curves:
        assert any(curve.startswith(f"{topic}/") for topic in selected)
        assert field_type(curve) == "float64", curve


@pytest.fixture
def foxglove() -> dict[str, Any]:
    return json.loads(packaged("config", "foxglove_layout.json").read_text())


def test_foxglove_shows_each_of_its_panels(foxglove: dict[str, Any]) -> None:
    shown = set(re.findall(r'"(\w+!\w+)"', json.dumps(foxglove["layout"])))
    assert shown == set(foxglove["configById"])


def test_foxglove_draws_numbers_of_known_topics(foxglove: dict[str, Any]) -> None:
    for panel in foxglove["configById"].values():
        for curve in panel.get("paths", ()):
            assert field_type(curve["value"].replace(".", "/")) == "float64", curve
        named = {panel.get(key, "/trigger") for key in ("topicPath", "topicToRender")}
        assert named | set(panel.get("topics", ())) <= set(TYPES)
