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


def test_under_a_cluster_it_is_what_the_raw_messages_say(hold: Path, found) -> None:
    """Read by the bag library alone, and calibrated by hand."""
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
    tiles = found.tiles.set_index("cluster")
    for name, cluster in coefficients["clusters"].items():
        offset, gain = cluster["normal"]
        measured = 1e-3 * (offset + gain * np.mean([pressures[i][name] for i in span]))
        row = tiles.loc[name]
        assert row["mean pressure low [kPa]"] < measured < row["mean pressure high [kPa]"]
        assert row["mean pressure [kPa]"] == pytest.approx(measured, rel=0.06)


def test_the_verb_prints_writes_and_draws_what_the_api_gives(hold, found, tmp_path, capsys) -> None:
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
    with pytest.raises(ConfigurationError, match="no tile 'x'"):
        st.pressure(trial, "20:30", regions={"a": ["x"]})


@pytest.mark.slow
def test_cycles_are_written_and_drawn_and_a_folder_gives_a_summary(tmp_path: Path, capsys) -> None:
    plain = st.simulate(tmp_path / "plain", "ramp", duration=130, seed=1)
    own = {f"region {number}": ["distal"] for number in range(7)}  # too many for a figure
    (tmp_path / "trials").mkdir()
    copy = edited(plain.path, tmp_path / "trials" / "ramp", lambda d: d.update(regions=own))
    trial = st.open_trial(copy)
    words = ("--segment", "all", "--cycles", "placed", "-o", tmp_path / "c.csv")
    words += ("--figure", tmp_path / "c.png")
    code, out, err = call(capsys, "pressure", trial.path, *words, "--json")
    assert code == 0 and "4 cycles from each 'placed'" in err and json.loads(out)["regions"]
    table = pd.read_csv(tmp_path / "c.csv", index_col=0)
    every = st.pressure(trial, "all").over_time()["socket.mean pressure [kPa]"]
    expected = st.cycles(trial, every.to_frame()).mean[:, 0]
    assert np.allclose(table["socket.mean pressure mean [kPa]"], expected)

    shutil.copytree(trial.path, tmp_path / "trials" / "two")
    words = ("-o", tmp_path / "out", "--segment", "20:25", "--jobs", 1)
    assert call(capsys, "pressure", tmp_path / "trials", *words)[0] == 0
    summary = pd.read_csv(tmp_path / "out" / "summary.csv")
    assert len(summary) == len([*(tmp_path / "out").glob("*.pressure.csv")]) == 2
    assert summary["peak pressure high [kPa]"].notna().all()
