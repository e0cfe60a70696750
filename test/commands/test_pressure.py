"""The verb `pressure`: its numbers are the API's, and those of plain numpy on the force map."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from matplotlib.image import imread
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from support.bags import edited
from support.verbs import call

import socket_testbed as st
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import packaged
from socket_testbed.identification.pressure import interval_end


@pytest.fixture(scope="module")
def found(hold: Path) -> Any:
    return st.pressure(st.open_trial(hold), "20:30", share=0.01)


CLUSTERS = ["brim_lateral", "mid_anterior", "posterior_distal", "distal"]


@pytest.fixture(scope="module")
def measured(hold: Path) -> dict[str, float]:
    """Mean pressures under the clusters [kPa], read by the bag library and calibrated by hand."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name in ("ClusterCapacitance", "ClusterCapacitanceArray"):
        text = packaged("msg", f"{name}.msg").read_text()
        store.register(get_types_from_msg(text, f"socket_testbed_msgs/msg/{name}"))
    coefficients = yaml.safe_load((hold / "calibration.yaml").read_text())
    times, pressures = [], []
    with Reader(hold) as bag:
        for connection, _, data in bag.messages():
            if connection.topic.endswith("clusters/capacitance"):
                message = store.deserialize_cdr(data, connection.msgtype)
                times.append(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)
                pressures.append({c.name: c.capacitance.mean() for c in message.clusters})
    seconds = np.array(times) - times[0]
    span = np.flatnonzero((seconds >= 20.0) & (seconds <= 30.0))
    means = {}
    for name, cluster in coefficients["clusters"].items():
        offset, gain = cluster["normal"]
        means[name] = 1e-3 * (offset + gain * np.mean([pressures[i][name] for i in span]))
    assert {*means} == {*CLUSTERS}
    return means


@pytest.mark.parametrize("name", CLUSTERS)
def test_a_cluster_s_pressure_is_what_it_measured(
    name: str, measured: dict[str, float], found: Any
) -> None:
    row = found.tiles.set_index("cluster").loc[name]
    assert row["mean pressure low [kPa]"] < measured[name] < row["mean pressure high [kPa]"]
    assert row["mean pressure [kPa]"] == pytest.approx(measured[name], rel=0.06)


def test_the_verb_shows_what_the_api_gives(hold, found, tmp_path, capsys) -> None:
    """In words, and in a figure of the width that was asked for."""
    figure = tmp_path / "map.png"
    words = ["pressure", hold, "--segment", "20:30", "--share", "0.01"]
    words += ["--figure", figure, "--width", 88, "--no-title"]
    code, out, _ = call(capsys, *words)
    socket, title = found.regions.loc["socket"], "mean pressure [kPa]"
    low, high = socket[interval_end(title, "low")], socket[interval_end(title, "high")]
    assert code == 0 and f"{socket[title]:.1f} ({low:.1f} to {high:.1f}, uncertain)" in out
    assert imread(figure).shape[1] == pytest.approx(88 / 25.4 * 300, abs=1.0)


def test_own_regions_are_given_or_stored(hold: Path, tmp_path: Path) -> None:
    trial = st.open_trial(hold)
    own = {"tendon": ["distal", trial.geometry.names[7]]}
    given = st.pressure(trial, "20:30", regions=own).regions.loc["tendon"]
    copy = edited(hold, tmp_path / "own", lambda document: document.update(regions=own))
    stored = st.pressure(st.open_trial(copy), "20:30").regions.loc["tendon"]
    pd.testing.assert_series_equal(given, stored)


def test_a_region_of_unknown_tiles_is_refused(hold: Path) -> None:
    with pytest.raises(ConfigurationError, match="no tile 'x'"):
        st.pressure(st.open_trial(hold), "20:30", regions={"a": ["x"]})


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of one trial with cycles, and with too many regions for a figure."""
    folder = tmp_path_factory.mktemp("walked")
    plain = st.simulate(folder / "plain", "ramp", duration=130, seed=1)
    own = {f"region {number}": ["distal"] for number in range(7)}
    (folder / "trials").mkdir()
    edited(plain.path, folder / "trials" / "ramp", lambda document: document.update(regions=own))
    return folder / "trials"


@pytest.mark.slow
def test_cycles_are_written_as_the_api_gives_them(walked: Path, tmp_path: Path, capsys) -> None:
    trial = st.open_trial(walked / "ramp")
    words = ("--segment", "all", "--cycles", "placed", "-o", tmp_path / "c.csv")
    words += ("--figure", tmp_path / "c.png")
    code, out, err = call(capsys, "pressure", trial.path, *words, "--json")
    assert code == 0 and "4 cycles from each 'placed'" in err and json.loads(out)["regions"]
    table = pd.read_csv(tmp_path / "c.csv", index_col=0)
    every = st.pressure(trial, "all").over_time()["socket.mean pressure [kPa]"]
    expected = st.cycles(trial, every.to_frame()).mean[:, 0]
    assert np.allclose(table["socket.mean pressure mean [kPa]"], expected)


@pytest.mark.slow
def test_a_folder_gives_a_summary(walked: Path, tmp_path: Path, capsys) -> None:
    for name in ("one", "two"):
        shutil.copytree(walked / "ramp", tmp_path / "trials" / name)
    words = ("-o", tmp_path / "out", "--segment", "20:25", "--jobs", 1)
    assert call(capsys, "pressure", tmp_path / "trials", *words)[0] == 0
    summary = pd.read_csv(tmp_path / "out" / "summary.csv")
    assert len(summary) == len([*(tmp_path / "out").glob("*.pressure.csv")]) == 2
    assert summary["peak pressure high [kPa]"].notna().all()
