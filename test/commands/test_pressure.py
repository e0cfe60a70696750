"""The verb `pressure`: its numbers are the API's, and those of plain numpy on the force map."""

import json
import math
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

import socket_testbed as st
from socket_testbed.__main__ import run
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import packaged
from socket_testbed.identification.pressure import TITLES, interval_end


@pytest.fixture(scope="module")
def hold(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pressure") / "hold"
    st.simulate(path, duration=40, seed=3)
    st.annotate(st.open_trial(path), side="right")
    return path


@pytest.fixture(scope="module")
def found(hold: Path) -> Any:
    return st.pressure(st.open_trial(hold), "10:20", share=2.0)


def test_the_outputs_are_those_of_plain_numpy_on_the_force_map(hold: Path, found) -> None:
    trial = st.open_trial(hold)
    mapped, geometry = st.force_map(trial, "10:20").estimate, trial.geometry
    forces = np.einsum("nij,kni->knj", geometry.rotations, mapped.forces)
    pressure = -forces[..., 2] / geometry.areas / 1e3  # [kPa]
    rest = math.fsum(geometry.areas)
    socket = found.regions.loc["socket"]
    held = np.where(pressure > 5.0, pressure, 0.0)
    push = np.maximum(-forces[..., 2], 0.0).mean(axis=0)
    expected = {
        "mean pressure [kPa]": (pressure.mean(axis=0) * geometry.areas).sum() / rest,
        "peak pressure [kPa]": pressure.max(),
        "pressure-time integral [kPa s]": np.trapezoid(held, mapped_times(trial), axis=0).mean(),
        "centre of pressure z [mm]": 1e3 * push @ geometry.anchors[:, 2] / push.sum(),
        "shear [kPa]": np.hypot(*forces[..., :2].mean(axis=0).sum(axis=0)) / rest / 1e3,
    }
    for title, value in expected.items():
        np.testing.assert_allclose(socket[title], value, rtol=1e-9, err_msg=title)

    axial = mapped.forces[..., 2].sum(axis=0)
    names = found.regions.index
    assert list(names[[0, 2, 4, 7, 13, 19]]) == [
        "anterior", "medial", "proximal", "anterior proximal", "medial proximal", "socket",
    ]  # fmt: skip
    for place in found.places[:19]:
        share = 100.0 * axial[place.tiles].sum() / axial.sum()
        assert found.outputs.regions.share.value[list(names).index(place.name)] == pytest.approx(
            share / 100.0
        )
        centre = geometry.anchors[place.tiles].mean(axis=0)
        if place.name.startswith("medial"):
            assert centre[1] > 0.0  # on a right leg medial is left


def test_under_a_cluster_it_is_what_the_raw_messages_say(hold: Path, found) -> None:
    """Read by the bag library alone, and calibrated by hand."""
    store, coefficients = raw_types(), yaml.safe_load((hold / "calibration.yaml").read_text())
    times, pressures = [], []
    with Reader(hold) as bag:
        for connection, _, data in bag.messages():
            if connection.topic.endswith("clusters/capacitance"):
                message = store.deserialize_cdr(data, connection.msgtype)
                times.append(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)
                pressures.append({c.name: c.capacitance.mean() for c in message.clusters})
    seconds = np.array(times) - times[0]
    span = np.flatnonzero((seconds >= 10.0) & (seconds <= 20.0))
    tiles = found.tiles.set_index("cluster")
    for name, cluster in coefficients["clusters"].items():
        offset, gain = cluster["normal"]
        measured = 1e-3 * (offset + gain * np.mean([pressures[i][name] for i in span]))
        row = tiles.loc[name]
        assert row["mean pressure low [kPa]"] < measured < row["mean pressure high [kPa]"]
        assert row["mean pressure [kPa]"] == pytest.approx(measured, abs=0.5)


def raw_types() -> Typestore:
    store = get_typestore(Stores.ROS2_JAZZY)
    for name in ("ClusterCapacitance", "ClusterCapacitanceArray"):
        text = packaged("msg", f"{name}.msg").read_text()
        store.register(get_types_from_msg(text, f"socket_testbed_msgs/msg/{name}"))
    return store


def mapped_times(trial) -> np.ndarray:
    samples = trial.samples()
    return samples.time[st.select_segment(samples, "10:20").rows]


def test_verb_api_and_files_give_the_same_numbers(hold: Path, found, tmp_path, capsys) -> None:
    options = [str(hold), "--segment", "10:20", "--share", "2"]
    assert run(["pressure", *options, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == found.document()

    assert run(["pressure", *options, "-o", str(tmp_path / "regions.parquet")]) == 0
    written = pd.read_parquet(tmp_path / "regions.parquet").set_index("region")
    pd.testing.assert_frame_equal(written[list(TITLES)], found.regions[list(TITLES)])
    assert run(["pressure", *options, "-o", str(tmp_path / "t.parquet"), "--over-time"]) == 0
    over_time = pd.read_parquet(tmp_path / "t.parquet").set_index("time [s]")
    pd.testing.assert_frame_equal(over_time, found.over_time())

    printed = capsys.readouterr().out
    socket = found.regions.loc["socket"]
    title = "mean pressure [kPa]"
    low, high = socket[interval_end(title, "low")], socket[interval_end(title, "high")]
    assert f"{socket[title]:.1f} ({low:.1f} to {high:.1f})" in printed


def test_export_and_evaluate_bring_the_same_outputs(hold: Path, tmp_path, capsys) -> None:
    found = st.pressure(st.open_trial(hold), "10:20")
    table, model = tmp_path / "e.parquet", tmp_path / "m.json"
    out = ["--segment", "10:20"]
    assert run(["export", str(hold), "-o", str(table), "--pressure", *out]) == 0
    written = pd.read_parquet(table).filter(like="pressure.")
    expected = found.over_time().add_prefix("pressure.")
    np.testing.assert_array_equal(written[list(expected)].to_numpy(), expected.to_numpy())

    st.fit(st.open_trial(hold), "10:20").save(model)
    capsys.readouterr()
    asked = ["evaluate", str(hold), "--model", str(model), *out, "--pressure"]
    assert run([*asked, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["pressure"] == found.document()
    assert run(asked) == 0
    assert "socket" in capsys.readouterr().out


def test_what_is_not_determined_is_never_bare(hold: Path, capsys) -> None:
    found = st.pressure(st.open_trial(hold), "10:20", share=0.01)
    assert found.regions["peak pressure [kPa]"].isna().all()
    assert found.regions["peak pressure high [kPa]"].notna().all()
    document = found.document()["regions"]["socket"]["peak pressure [kPa]"]
    assert document["value"] is None
    assert document["low"] < document["high"]
    assert run(["pressure", str(hold), "--segment", "10:20", "--share", "0.01"]) == 0
    assert "not determined (" in capsys.readouterr().out


def test_own_regions_by_name(hold: Path, tmp_path: Path) -> None:
    trial = st.open_trial(hold)
    own = {"tendon": ["distal", trial.geometry.names[7]]}
    given = st.pressure(trial, "10:20", regions=own, share=10.0).regions.loc["tendon"]
    copy = shutil.copytree(hold, tmp_path / "own")
    document = yaml.safe_load((copy / "socket.yaml").read_text()) | {"regions": own}
    (copy / "socket.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
    stored = st.pressure(st.open_trial(copy), "10:20", share=10.0).regions.loc["tendon"]
    pd.testing.assert_series_equal(given, stored)
    for wrong, says in (
        ({"a": []}, "no tiles"),
        ({"a": ["x"]}, "no tile 'x'"),
        ({"a": "distal"}, "no tiles"),
    ):
        with pytest.raises(ConfigurationError, match=says):
            st.pressure(trial, "10:20", regions=wrong)


def test_without_a_side_a_note_says_how_to_state_it(hold: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(hold, tmp_path / "sideless")
    (copy / "trial.yaml").unlink()
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always")
        found = st.pressure(st.open_trial(copy), "10:20")
    assert any("--side left|right" in str(note.message) for note in notes)
    assert "left proximal" in found.regions.index


def test_a_folder_of_trials_gives_a_table_each_and_a_summary(hold: Path, tmp_path: Path) -> None:
    trials = tmp_path / "trials"
    for name in ("one", "two"):
        shutil.copytree(hold, trials / name)
    out = ["-o", str(tmp_path / "out"), "--segment", "10:15", "--jobs", "1"]
    assert run(["pressure", str(trials), *out]) == 0
    summary = pd.read_csv(tmp_path / "out" / "summary.csv")
    assert len(summary) == 2
    assert summary["peak pressure high [kPa]"].notna().all()
    assert len([*(tmp_path / "out").glob("*.pressure.csv")]) == 2


def test_a_figure_is_that_of_the_api(hold: Path, tmp_path, capsys) -> None:
    figure = tmp_path / "map.png"
    drawing = ["--figure", str(figure), "--width", "88", "--no-title"]
    call = ["pressure", str(hold), "--segment", "10:11", *drawing]
    assert run(call) == 0
    assert f"written: {figure}" in capsys.readouterr().out
    own = st.pressure(st.open_trial(hold), "10:11")
    own.draw(tmp_path / "own.png", width=88, title=False)
    assert (tmp_path / "own.png").read_bytes() == figure.read_bytes()
    with pytest.raises(ConfigurationError, match="width of 120 mm"):
        own.draw(tmp_path / "other.png", width=120)
