"""Exported samples, read back by the programs they are for."""

from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore
from scipy.io import loadmat
from scipy.spatial.distance import pdist
from support.bags import rewrite

import socket_testbed as st
from socket_testbed.calibration.bench_data import STRESSES
from socket_testbed.identification.fit import evaluate
from socket_testbed.identification.model_file import read_model
from socket_testbed.samples import WRENCH_CHANNELS, Status
from socket_testbed.tables import matlab_names, write_table
from socket_testbed.trials.cdr import stamp_of
from socket_testbed.trials.trial import Trial

SHIFT = 123_456_789  # [ns]; no stamp is a round number that a float could hold


@pytest.fixture(scope="module")
def gappy(hold: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trial with drop-outs of every kind, and stamps that need all of 64 bits."""
    first = int(Trial(hold).samples().stamps[0])

    def spoil(topic: str, message):
        stamp = stamp_of(message)
        second = (stamp - first) // 1_000_000_000
        if (second, topic) in {(3, "/load_cell/wrench"), (7, "/mocap/pylon/pose")}:
            return None
        if topic == "/clusters/capacitance":
            if second == 5:
                return None
            if second == 9:
                message.clusters[1].status = np.array([0, 1, 0, 0], dtype=np.uint8)
            if second == 11:
                message.clusters[2].capacitance = np.array([np.nan, 4.0, 4.0, 4.0])
            if second == 13:
                message.clusters.pop()
        message.header.stamp.nanosec += SHIFT
        return message

    return rewrite(hold, tmp_path_factory.mktemp("gappy") / "gappy", spoil)


def read_back(path: Path) -> dict[str, np.ndarray]:
    """Columns by their titles, whatever the format."""
    if path.suffix == ".mat":
        content = loadmat(path, simplify_cells=True)
        units = content["units"]
        return {f"{name} [{unit}]": content[name] for name, unit in units.items()}
    table = pd.read_csv(path) if path.suffix == ".csv" else pd.read_parquet(path)
    return {name: table[name].to_numpy() for name in table.columns}


def title(name: str, unit: str, suffix: str) -> str:
    return f"{name.replace('.', '_') if suffix == '.mat' else name} [{unit}]"


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".mat"])
def test_samples_are_read_back_as_they_are(suffix, gappy, tmp_path) -> None:
    path = tmp_path / f"out{suffix}"
    st.export(gappy, path)
    columns, trial = read_back(path), Trial(gappy)
    samples, stamps = trial.samples(), columns["stamp [ns]"]
    assert stamps.dtype == np.int64 and np.array_equal(stamps, samples.stamps)
    assert np.all(stamps % 1000 == SHIFT % 1000)

    def assert_column(name: str, unit: str, expected: np.ndarray) -> None:
        # Exactly: to the last bit, and NaN where there was no value.
        np.testing.assert_array_equal(columns[title(name, unit, suffix)], expected, name)

    assert_column("time", "s", samples.time)
    for i, name in enumerate(WRENCH_CHANNELS):
        assert_column(name, "N m" if name[0] == "M" else "N", samples.wrench[:, i])
    for i, axis in enumerate("xyz"):
        assert_column(f"q_{axis}", "m", samples.position[:, i])
        assert_column(f"phi_{axis}", "rad", samples.rotation[:, i])
    for k, cluster in enumerate(samples.clusters):
        assert_column(f"{cluster}.status", "-", samples.status[:, k])
        for i, axis in enumerate("xyz"):
            assert_column(f"{cluster}.F{axis}", "N", samples.local_forces[:, k, i])
        # By the calibration, capacitances give the stress, and this times the area the force.
        stress = np.stack([columns[title(f"{cluster}.{axis}", "Pa", suffix)] for axis in STRESSES])
        force = trial.geometry.cluster_force(cluster, stress.T)
        np.testing.assert_allclose(force, samples.local_forces[:, k], rtol=1e-9)
        own = [columns[title(f"{cluster}.C{i}", "pF", suffix)] for i in range(4)]
        capacitance = np.stack(own, axis=-1)
        usable = samples.status[:, k] == Status.OK
        none = np.zeros(capacitance[usable].shape, dtype=np.uint8)
        expected, _ = trial.calibration.clusters[cluster].apply(capacitance[usable], none)
        np.testing.assert_allclose(stress.T[usable], expected, rtol=1e-9)
    # Every kind of drop-out is there, or the test shows nothing.
    assert np.isnan(samples.wrench[:, 0]).any() and set(np.unique(samples.status)) >= {0, 1, 2}
    assert len(columns) == 2 + 6 + 6 + 4 * (4 + 1 + 3 + 3)
    for field in pq.read_schema(path) if suffix == ".parquet" else ():
        assert field.name.endswith(f" [{field.metadata[b'unit'].decode()}]")


def test_predictions_have_the_errors_that_evaluate_finds(gappy, hold_model, tmp_path) -> None:
    path = tmp_path / "out.parquet"
    st.export(gappy, path, "all", hold_model)
    columns, trusted = read_back(path), Trial(gappy).samples().trusted_values
    errors = evaluate(Trial(gappy).samples(), read_model(hold_model).model)
    for error, measured in zip(errors, trusted.T, strict=True):
        residual = columns[f"predicted.{error.name} [{error.unit}]"] - measured
        assert np.sqrt(np.nanmean(residual**2)) == pytest.approx(error.rmse, rel=1e-12)
    engaged = st.evaluate(st.open_trial(gappy), hold_model, "all").engagement()
    for name, values in engaged.columns("springs.").items():
        np.testing.assert_array_equal(columns[name], values)


def test_any_name_and_number_survives(tmp_path: Path) -> None:
    values = np.array([0.1, np.nan, 1e-300, np.nextafter(1.0, 2.0), -1.7976931348623157e308])
    large = np.array([2**62 + 1, -1, 0, 1, 2**53 + 1])
    for suffix in (".csv", ".parquet", ".mat"):
        path = tmp_path / f"out{suffix}"
        write_table(pd.DataFrame({'a "quoted", name [N m]': values, "large [ns]": large}), path)
        found = list(read_back(path).values())
        np.testing.assert_array_equal(found[0], values)
        np.testing.assert_array_equal(found[1], large)
        assert found[1].dtype == np.int64
    names = matlab_names(["a.b", "a_b", "7", "units", "c" * 70, "c" * 71])
    assert len(set(names)) == 6 and "units" not in names
    assert all(name.isidentifier() and len(name) <= 63 for name in names)


def test_gait_laboratories_read_loads_and_markers(hold: Path, tmp_path: Path) -> None:
    samples, knee = Trial(hold).samples()[40:81], (0.02, -0.01, 0.4)
    for name in ("loads.mot", "markers.trc", "trial.c3d", "knee.sto"):
        st.export(hold, tmp_path / name, "10:20", about=knee if name == "knee.sto" else None)
    text = (tmp_path / "loads.mot").read_text().splitlines()
    assert {"nRows=41", "nColumns=10"} < {*text[:5]} and text[5] == "endheader"
    tables = (tmp_path / "loads.mot", tmp_path / "knee.sto")
    loads, moved = (pd.read_csv(path, sep="\t", skiprows=6) for path in tables)
    assert loads["time"].iloc[[0, -1]].tolist() == [10.0, 20.0]
    forces = loads[[f"socket_force_v{axis}" for axis in "xyz"]]
    torques = [f"socket_torque_{axis}" for axis in "xyz"]
    np.testing.assert_allclose(np.hstack([loads[torques], forces]), samples.wrench, atol=1e-6)
    # The same loads with moments about a point, at which OpenSim applies the force.
    lever = moved[[f"socket_force_p{axis}" for axis in "xyz"]].to_numpy()
    np.testing.assert_allclose(lever, np.tile(knee, (41, 1)))
    about = moved[torques] + np.cross(lever, forces)
    np.testing.assert_allclose(about, loads[torques], atol=1e-5)
    table = st.export(hold, tmp_path / "knee.csv", segment="10:20", about=knee)
    np.testing.assert_allclose(table["My [N m]"], moved["socket_torque_y"], atol=1e-6)

    markers = pd.read_csv(tmp_path / "markers.trc", sep="\t", skiprows=5, header=None)
    c3d = ezc3d.c3d(str(tmp_path / "trial.c3d"))
    points = c3d["data"]["points"][:3].transpose(2, 1, 0).reshape(41, -1)
    np.testing.assert_allclose(points, markers.to_numpy()[:, 2:], atol=1e-3)
    np.testing.assert_allclose(c3d["data"]["analogs"][0].T, samples.wrench, rtol=1e-6, atol=1e-5)
    # The triad of the socket is that of its rigid body, moved [mm].
    triads = points[0].reshape(-1, 3)[:3], 1e3 * Trial(hold).geometry.socket_markers
    np.testing.assert_allclose(*map(pdist, triads), atol=1.0)


def test_a_gap_keeps_its_time_as_empty_frames(hold: Path, tmp_path: Path) -> None:
    samples = Trial(hold).samples()
    lost = range(int(samples.stamps[80]), int(samples.stamps[100]))
    cut = rewrite(hold, tmp_path / "cut", lambda _, m: None if stamp_of(m) in lost else m)
    st.export(cut, tmp_path / "cut.c3d", "all")
    wrench = ezc3d.c3d(str(tmp_path / "cut.c3d"))["data"]["analogs"][0].T
    assert np.isnan(wrench[80:100]).all() and len(wrench) == len(samples)
    for part in (np.s_[:80], np.s_[100:]):
        np.testing.assert_allclose(wrench[part], samples.wrench[part], rtol=1e-6, atol=1e-5)


def test_markers_stay_with_their_samples_if_the_others_begin_later(hold: Path, tmp_path: Path):
    first = Trial(hold).samples().stamps[0]

    def late(topic: str, message):
        return message if topic == "/mocap/markers" or stamp_of(message) > first else None

    trials = hold, rewrite(hold, tmp_path / "late", late)
    whole, rest = (st.export(trial, tmp_path / f"{trial.name}.trc") for trial in trials)
    np.testing.assert_array_equal(whole.iloc[1:], rest)


def test_plotting_tools_read_standard_messages_by_their_names(hold: Path, tmp_path: Path) -> None:
    path = tmp_path / "hold.mcap"
    table = st.export(hold, path, segment="10:20", pressure=True)
    samples = Trial(hold).samples()[40:81]
    types = get_typestore(Stores.ROS2_JAZZY)
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None and "socket_testbed" not in schema.name
            read = types.deserialize_cdr(message.data, schema.name)
            found.setdefault(channel.topic, []).append((message.log_time, read))
    for topic, title in (
        ("/distal/normal_Pa", "distal.normal [Pa]"),
        ("/pressure/socket/peak_pressure_kPa", "pressure.socket.peak pressure [kPa]"),
    ):
        stamps, values = zip(*((time, message.data) for time, message in found[topic]), strict=True)
        assert list(stamps) == samples.stamps.tolist(), topic
        np.testing.assert_array_equal(values, table[title])
    forces = [(m.wrench.force.x, m.wrench.force.z) for _, m in found["/load_cell/wrench"]]
    np.testing.assert_array_equal(forces, samples.wrench[:, [3, 5]])
    assert found["/mocap/socket/pose"][0][1].header.frame_id == "world"
