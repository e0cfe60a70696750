"""Exported samples, read back by the programs they are for."""

from dataclasses import dataclass
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
from socket_testbed.identification.channel_errors import evaluate
from socket_testbed.identification.model_file import read_model
from socket_testbed.samples import WRENCH_CHANNELS, Samples, Status
from socket_testbed.tables import matlab_names, write_table
from socket_testbed.trials.trial import Trial
from socket_testbed.wire.cdr import stamp_of

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


Columns = dict[str, np.ndarray]
SUFFIXES = [".csv", ".parquet", ".mat"]
CLUSTERS = ["brim_lateral", "mid_anterior", "posterior_distal", "distal"]


@pytest.fixture(scope="module")
def gappy_trial(gappy: Path) -> Trial:
    """The trial with drop-outs, opened by the product."""
    return Trial(gappy)


@pytest.fixture(scope="module")
def samples(gappy_trial: Trial) -> Samples:
    """Samples with every kind of drop-out, or the tests show nothing."""
    samples = gappy_trial.samples()
    assert np.isnan(samples.wrench[:, 0]).any() and set(np.unique(samples.status)) >= {0, 1, 2}
    return samples


@pytest.fixture(scope="module", params=SUFFIXES)
def exported(
    request: pytest.FixtureRequest, gappy: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The samples with drop-outs as a file of each format."""
    path = tmp_path_factory.mktemp("exported") / f"out{request.param}"
    st.export(gappy, path)
    return path


@pytest.fixture(scope="module")
def columns(exported: Path) -> Columns:
    return read_back(exported)


def test_stamps_are_read_back_exactly(columns: Columns, samples: Samples) -> None:
    stamps = columns["stamp [ns]"]
    assert stamps.dtype == np.int64 and np.array_equal(stamps, samples.stamps)
    assert np.all(stamps % 1000 == SHIFT % 1000)
    np.testing.assert_array_equal(columns["time [s]"], samples.time)


def test_a_table_has_all_columns(columns: Columns) -> None:
    assert len(columns) == 2 + 6 + 6 + 4 * (4 + 1 + 3 + 3)


@pytest.mark.parametrize("channel", WRENCH_CHANNELS)
def test_a_wrench_is_read_back_exactly(channel: str, columns: Columns, samples: Samples) -> None:
    """To the last bit, and NaN where there was no value."""
    unit = "N m" if channel[0] == "M" else "N"
    measured = samples.wrench[:, WRENCH_CHANNELS.index(channel)]
    np.testing.assert_array_equal(columns[f"{channel} [{unit}]"], measured)


@pytest.mark.parametrize("axis", [0, 1, 2], ids=["x", "y", "z"])
def test_a_pose_is_read_back_exactly(axis: int, columns: Columns, samples: Samples) -> None:
    """To the last bit, and NaN where there was no value."""
    name = "xyz"[axis]
    np.testing.assert_array_equal(columns[f"q_{name} [m]"], samples.position[:, axis])
    np.testing.assert_array_equal(columns[f"phi_{name} [rad]"], samples.rotation[:, axis])


@pytest.mark.parametrize("cluster", CLUSTERS)
def test_local_forces_are_read_back_exactly(
    cluster: str, exported: Path, columns: Columns, samples: Samples
) -> None:
    """To the last bit, and NaN where there was no value."""
    k, suffix = samples.clusters.index(cluster), exported.suffix
    status = columns[title(f"{cluster}.status", "-", suffix)]
    np.testing.assert_array_equal(status, samples.status[:, k])
    own = [columns[title(f"{cluster}.F{axis}", "N", suffix)] for axis in "xyz"]
    np.testing.assert_array_equal(np.stack(own, axis=-1), samples.local_forces[:, k])


@pytest.mark.parametrize("cluster", CLUSTERS)
def test_exported_capacitances_give_stress_and_force(
    cluster: str, exported: Path, columns: Columns, samples: Samples, gappy_trial: Trial
) -> None:
    """By the calibration capacitances give the stress; this times the area is the force."""
    k, suffix = samples.clusters.index(cluster), exported.suffix
    named = [columns[title(f"{cluster}.{axis}", "Pa", suffix)] for axis in STRESSES]
    stress = np.stack(named, axis=-1)
    force = gappy_trial.geometry.cluster_force(cluster, stress)
    np.testing.assert_allclose(force, samples.local_forces[:, k], rtol=1e-9)
    own = [columns[title(f"{cluster}.C{i}", "pF", suffix)] for i in range(4)]
    usable = samples.status[:, k] == Status.OK
    capacitance = np.stack(own, axis=-1)[usable]
    none = np.zeros(capacitance.shape, dtype=np.uint8)
    expected, _ = gappy_trial.calibration.clusters[cluster].apply(capacitance, none)
    np.testing.assert_allclose(stress[usable], expected, rtol=1e-9)


def test_parquet_fields_carry_their_units(gappy: Path, tmp_path: Path) -> None:
    path = tmp_path / "out.parquet"
    st.export(gappy, path)
    for field in pq.read_schema(path):
        assert field.name.endswith(f" [{field.metadata[b'unit'].decode()}]")


def test_predictions_have_the_errors_of_evaluate(
    gappy: Path, gappy_trial: Trial, hold_model: Path, tmp_path: Path
) -> None:
    path = tmp_path / "out.parquet"
    st.export(gappy, path, "all", hold_model)
    columns, trusted = read_back(path), gappy_trial.samples().trusted_values
    errors = evaluate(gappy_trial.samples(), read_model(hold_model).model)
    for error, measured in zip(errors, trusted.T, strict=True):
        residual = columns[f"predicted.{error.name} [{error.unit}]"] - measured
        assert np.sqrt(np.nanmean(residual**2)) == pytest.approx(error.rmse, rel=1e-12)
    engaged = st.evaluate(st.open_trial(gappy), hold_model, "all").engagement()
    for name, values in engaged.columns("springs.").items():
        np.testing.assert_array_equal(columns[name], values)


def test_springs_share_the_time_of_the_segment(hold: Path, hold_model: Path) -> None:
    """The shares of all springs are the mean number of engaged ones, which differ in time."""
    trial = st.open_trial(hold)
    means = []
    for segment in ("all", (0.0, 2.0)):
        found = st.evaluate(trial, hold_model, segment)
        engaged = found.engagement()
        assert len(engaged.engaged) == len(trial.samples())
        means.append(np.nanmean(engaged.engaged[found.segment.rows]))
        assert engaged.time_share.sum() == pytest.approx(means[-1])
    assert abs(means[0] - means[1]) > 0.5


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_any_number_is_read_back_exactly(suffix: str, tmp_path: Path) -> None:
    values = np.array([0.1, np.nan, 1e-300, np.nextafter(1.0, 2.0), -1.7976931348623157e308])
    large = np.array([2**62 + 1, -1, 0, 1, 2**53 + 1])
    path = tmp_path / f"out{suffix}"
    write_table(pd.DataFrame({'a "quoted", name [N m]': values, "large [ns]": large}), path)
    found = list(read_back(path).values())
    np.testing.assert_array_equal(found[0], values)
    np.testing.assert_array_equal(found[1], large)
    assert found[1].dtype == np.int64


def test_matlab_takes_any_name() -> None:
    names = matlab_names(["a.b", "a_b", "7", "units", "c" * 70, "c" * 71])
    assert len(set(names)) == 6 and "units" not in names
    assert all(name.isidentifier() and len(name) <= 63 for name in names)


# --- files for gait laboratories

KNEE = (0.02, -0.01, 0.4)  # [m]
FORCES = [f"socket_force_v{axis}" for axis in "xyz"]
TORQUES = [f"socket_torque_{axis}" for axis in "xyz"]


@pytest.fixture(scope="module")
def laboratory(hold: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The hold from 10 s to 20 s, 41 samples, in the formats of gait laboratories."""
    folder = tmp_path_factory.mktemp("laboratory")
    for name in ("loads.mot", "markers.trc", "trial.c3d"):
        st.export(hold, folder / name, "10:20")
    st.export(hold, folder / "knee.sto", "10:20", about=KNEE)
    return folder


@pytest.fixture(scope="module")
def part(hold: Path) -> Samples:
    """The samples that the laboratory's files hold."""
    return Trial(hold).samples()[40:81]


def loads_of(path: Path) -> pd.DataFrame:
    return pd.read_csv(path, sep="\t", skiprows=6)


def points_of(folder: Path) -> np.ndarray:
    """The markers of the C3D file, coordinates by sample [mm]."""
    file = ezc3d.c3d(str(folder / "trial.c3d"))
    return file["data"]["points"][:3].transpose(2, 1, 0).reshape(41, -1)


def test_opensim_reads_the_measured_loads(laboratory: Path, part: Samples) -> None:
    text = (laboratory / "loads.mot").read_text().splitlines()
    assert {"nRows=41", "nColumns=10"} < {*text[:5]} and text[5] == "endheader"
    loads = loads_of(laboratory / "loads.mot")
    assert loads["time"].iloc[[0, -1]].tolist() == [10.0, 20.0]
    np.testing.assert_allclose(np.hstack([loads[TORQUES], loads[FORCES]]), part.wrench, atol=1e-6)


def test_loads_about_a_point_are_equivalent(laboratory: Path, hold: Path, tmp_path: Path) -> None:
    """Their moments are about the point, at which OpenSim applies the force."""
    loads, moved = (loads_of(laboratory / name) for name in ("loads.mot", "knee.sto"))
    lever = moved[[f"socket_force_p{axis}" for axis in "xyz"]].to_numpy()
    np.testing.assert_allclose(lever, np.tile(KNEE, (41, 1)))
    about = moved[TORQUES] + np.cross(lever, loads[FORCES])
    np.testing.assert_allclose(about, loads[TORQUES], atol=1e-5)
    table = st.export(hold, tmp_path / "knee.csv", segment="10:20", about=KNEE)
    np.testing.assert_allclose(table["My [N m]"], moved["socket_torque_y"], atol=1e-6)


def test_c3d_holds_the_measured_wrench(laboratory: Path, part: Samples) -> None:
    wrench = ezc3d.c3d(str(laboratory / "trial.c3d"))["data"]["analogs"][0].T
    np.testing.assert_allclose(wrench, part.wrench, rtol=1e-6, atol=1e-5)


def test_c3d_and_opensim_hold_the_same_markers(laboratory: Path) -> None:
    markers = pd.read_csv(laboratory / "markers.trc", sep="\t", skiprows=5, header=None)
    np.testing.assert_allclose(points_of(laboratory), markers.to_numpy()[:, 2:], atol=1e-3)


def test_exported_markers_form_the_socket_s_triad(laboratory: Path, hold: Path) -> None:
    """As in its rigid body, moved [mm]."""
    triads = points_of(laboratory)[0].reshape(-1, 3)[:3], 1e3 * Trial(hold).geometry.socket_markers
    np.testing.assert_allclose(*map(pdist, triads), atol=1.0)


def test_a_gap_keeps_its_time_as_empty_frames(hold: Path, tmp_path: Path) -> None:
    samples = Trial(hold).samples()
    lost = range(int(samples.stamps[80]), int(samples.stamps[100]))
    cut = rewrite(hold, tmp_path / "cut", lambda _, m: None if stamp_of(m) in lost else m)
    st.export(cut, tmp_path / "cut.c3d", "all")
    wrench = ezc3d.c3d(str(tmp_path / "cut.c3d"))["data"]["analogs"][0].T
    assert np.isnan(wrench[80:100]).all() and len(wrench) == len(samples)
    kept = np.r_[:80, 100 : len(samples)]
    np.testing.assert_allclose(wrench[kept], samples.wrench[kept], rtol=1e-6, atol=1e-5)


def test_markers_stay_with_their_samples(hold: Path, tmp_path: Path) -> None:
    """If all other topics begin later."""
    first = Trial(hold).samples().stamps[0]

    def late(topic: str, message):
        return message if topic == "/mocap/markers" or stamp_of(message) > first else None

    trials = hold, rewrite(hold, tmp_path / "late", late)
    whole, rest = (st.export(trial, tmp_path / f"{trial.name}.trc") for trial in trials)
    np.testing.assert_array_equal(whole.iloc[1:], rest)


# --- standard messages for plotting tools


@dataclass
class Standard:
    """An exported bag: its table, and by topic the time and content of each message."""

    table: pd.DataFrame
    messages: dict[str, list[tuple[int, Any]]]


@pytest.fixture(scope="module")
def standard(hold: Path, tmp_path_factory: pytest.TempPathFactory) -> Standard:
    """The hold from 10 s to 20 s in standard messages, as the bag library reads them."""
    path = tmp_path_factory.mktemp("standard") / "hold.mcap"
    table = st.export(hold, path, segment="10:20", pressure=True)
    types = get_typestore(Stores.ROS2_JAZZY)
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None and "socket_testbed" not in schema.name
            read = types.deserialize_cdr(message.data, schema.name)
            found.setdefault(channel.topic, []).append((message.log_time, read))
    return Standard(table, found)


@pytest.mark.parametrize(
    ("topic", "column"),
    [
        ("/distal/normal_Pa", "distal.normal [Pa]"),
        ("/pressure/socket/peak_pressure_kPa", "pressure.socket.peak pressure [kPa]"),
    ],
    ids=["stress", "pressure"],
)
def test_a_standard_bag_holds_a_column(
    topic: str, column: str, standard: Standard, part: Samples
) -> None:
    own = standard.messages[topic]
    assert [time for time, _ in own] == part.stamps.tolist()
    np.testing.assert_array_equal([message.data for _, message in own], standard.table[column])


def test_a_standard_bag_holds_the_wrench(standard: Standard, part: Samples) -> None:
    wrenches = [message.wrench for _, message in standard.messages["/load_cell/wrench"]]
    forces = [(wrench.force.x, wrench.force.z) for wrench in wrenches]
    np.testing.assert_array_equal(forces, part.wrench[:, [3, 5]])


def test_a_standard_bag_names_the_poses_frame(standard: Standard) -> None:
    assert standard.messages["/mocap/socket/pose"][0][1].header.frame_id == "world"
