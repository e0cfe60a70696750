"""Trials recorded with a wrong load cell, tare or marker model, or drift: repaired when read."""

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.bags import copying, rewrite
from support.problems import GEOMETRY
from support.verbs import call
from support.wording import refused

import socket_testbed as st
from socket_testbed.errors import CalibrationError, ConfigurationError, TestbedError, TrialError
from socket_testbed.geometry.marker_bodies import fit_body
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import SocketGeometry, write_socket
from socket_testbed.samples import Samples
from socket_testbed.settings.acquisition import LoadCellSettings
from socket_testbed.settings.testbed import TestbedSettings, read_testbed, write_testbed
from socket_testbed.trials import reprocess, synchronise
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.trial import Trial
from socket_testbed.wire.cdr import decode, stamp_of
from socket_testbed.wire.messages import load_cell_raw_packer, pose_packer, wrench_packer
from socket_testbed.wire.topics import LOAD_CELL_RAW, MARKERS

WRONG = {"sign": (1.0, -1.0, 1.0, 1.0, 1.0, 1.0), "excitation": 4.0, "inputs": (1, 0, 2, 3, 4, 5)}


def measured_of(trial: Path) -> synchronise.Measurements:
    with BagReader(trial) as bag:
        return synchronise.read_measurements(bag, lambda note: None, more=(LOAD_CELL_RAW, MARKERS))


def recorded_as(hold: Path, path: Path, packed: dict[str, Callable[[int, int], bytes]]) -> Path:
    """A copy of the hold; what packs a message of its stamp and row replaces those of a topic."""
    stamps = measured_of(hold).stamps.tolist()
    with copying(hold, path) as (old, new):
        for raw in old.messages():
            data = raw.data
            if pack := packed.get(raw.topic):
                stamp = stamp_of(decode(data, raw.type))
                data = pack(stamp, stamps.index(stamp))
            new.write(raw.topic, raw.time, data)
    return path


def store(settings: LoadCellSettings, path: Path) -> Path:
    nodes = dataclasses.replace(TestbedSettings(), load_cell_node=settings).nodes()
    write_testbed({"load_cell_node": nodes["load_cell_node"]}, path)
    return path


@pytest.fixture(scope="module")
def right(hold: Path) -> LoadCellSettings:
    return read_testbed(hold / "testbed.yaml").load_cell_node


@pytest.fixture(scope="module")
def miswired(hold: Path, right: LoadCellSettings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The hold recorded with another matrix, wrong wiring and a tare under load."""
    rng = np.random.default_rng(4)
    matrix = np.array(right.matrix) * (1.0 + 0.1 * rng.normal(size=36))
    wrong = dataclasses.replace(right, matrix=tuple(matrix), **WRONG)
    ratios = measured_of(hold).ratios[:, WRONG["inputs"]] * WRONG["sign"] * right.excitation / 4.0
    # The matrix gives [F; M] over the ratios in mV/V.
    wrench = np.roll(ratios @ matrix.reshape(6, 6).T, 3, axis=1)
    tare, pack_raw, pack_wrench = wrench[100], load_cell_raw_packer(), wrench_packer()
    path = recorded_as(
        hold,
        tmp_path_factory.mktemp("trials") / "miswired",
        {
            "/load_cell/wrench": lambda stamp, row: pack_wrench(stamp, wrench[row] - tare),
            "/load_cell/raw": lambda stamp, row: pack_raw(stamp, ratios[row], tare, 0, 0),
        },
    )
    store(wrong, path / "testbed.yaml")
    return path


def bare(trial: Path, path: Path, name: str = "testbed.yaml") -> Path:
    """A copy of a trial without one of its files."""
    shutil.copytree(trial, path)
    (path / name).unlink()
    return path


@pytest.fixture(scope="module")
def true(hold: Path) -> Samples:
    """What the right load cell measured."""
    return Trial(hold).samples()


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_wrong_load_cell_matters(miswired: Path, true: Samples) -> None:
    assert np.abs(Trial(miswired).samples().wrench - true.wrench).max() > 100.0


@pytest.mark.parametrize("tare", ["none", "0:5", "recorded"])
def test_a_wrong_load_cell_is_repaired(
    tare: str, miswired: Path, true: Samples, right: LoadCellSettings, tmp_path: Path
) -> None:
    """The recorded tare was of the hundredth sample's ratios: it is by the new matrix, too."""
    unloaded = true.wrench[true.time <= 5.0].mean(axis=0)
    offset = {"none": np.zeros(6), "0:5": unloaded, "recorded": true.wrench[100]}[tare]
    file, before = store(right, tmp_path / "right.yaml"), contents(miswired)
    notes: list[str] = []
    trial = st.open_trial(miswired, load_cell=file, tare=tare, notify=notes.append)
    np.testing.assert_allclose(trial.samples().wrench, true.wrench - offset, rtol=0, atol=1e-9)
    assert ("with the tare 0:5: Mx" in notes[0]) == (tare == "0:5")
    assert contents(miswired) == before


def test_ratios_without_settings_stay(
    hold: Path, true: Samples, right: LoadCellSettings, tmp_path: Path
) -> None:
    """Without stored settings a new matrix applies to the ratios as they are."""
    path = bare(hold, tmp_path / "hold")
    doubled = dataclasses.replace(right, matrix=tuple(2.0 * np.array(right.matrix)))
    file = store(doubled, tmp_path / "doubled.yaml")
    wrench = Trial(path, load_cell_file=file).samples().wrench
    np.testing.assert_allclose(wrench, 2.0 * true.wrench, rtol=1e-12, atol=1e-9)


def test_a_tare_alone_needs_no_matrix(hold: Path, true: Samples, tmp_path: Path) -> None:
    path = bare(hold, tmp_path / "hold")
    unloaded = true.wrench[true.time <= 5.0].mean(axis=0)
    wrench = Trial(path, tare="0:5").samples().wrench
    np.testing.assert_allclose(wrench, true.wrench - unloaded, rtol=1e-12, atol=1e-9)


@pytest.fixture(scope="module")
def repairs(
    hold: Path, miswired: Path, right: LoadCellSettings, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A folder of trials that cannot be repaired by its file `right.yaml`."""
    folder = tmp_path_factory.mktemp("repairs")
    store(right, folder / "right.yaml")
    rewrite(hold, folder / "old", lambda name, m: None if name == "/load_cell/raw" else m)
    bare(miswired, folder / "unknown")
    store(right, bare(miswired, folder / "other") / "testbed.yaml")
    (folder / "hold").symlink_to(hold)
    return folder


@pytest.mark.parametrize(
    ("name", "tare", "says"),
    [
        ("old", "none", "old: holds no 'load_cell/raw'"),
        ("unknown", "", "does not store the load cell's matrix"),
        ("other", "", "load cell does not match the recorded wrenches"),
        ("hold", "100:110", "holds no wrench: give seconds since the first sample"),
        ("hold", "0:30", "--tare 0:30: Fz moves by"),
    ],
    ids=["no ratios", "unknown matrix", "other matrix", "tare after the end", "tare under load"],
)
def test_what_cannot_be_repaired_is_refused(name: str, tare: str, says: str, repairs: Path) -> None:
    given = {"tare": tare} if tare else {"load_cell_file": repairs / "right.yaml"}
    with refused(TestbedError, says):
        Trial(repairs / name, **given).samples()


def test_a_model_remembers_its_trial_s_repairs(
    hold: Path, right: LoadCellSettings, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A model is fitted again if they change."""
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "hold").symlink_to(hold)
    file, model = store(right, tmp_path / "right.yaml"), tmp_path / "models" / "hold.json"
    words = ["fit", tmp_path / "study", "-o", model.parent, "--jobs", "1"]
    words += ["--tare", "0:5", "--unloaded", "0:3"]

    def assert_fit(state: str, *given: object) -> None:
        _, out, err = call(capsys, *words, *given)
        assert f"hold: {state}" in out and "recomputed from load_cell/raw" in err

    assert_fit("ok, ")
    assert_fit("skipped")
    assert_fit("ok, ", "--load-cell", file)
    trial = json.loads(model.read_text())["trial"]
    found = trial["tare"], trial["load_cell"], trial["unloaded"]
    assert found == ("0:5", str(file), [[0.0, 3.0]])
    assert "fitted with --unloaded" in call(capsys, "evaluate", hold, "--model", model)[2]


def recorded_with(hold: Path, path: Path, wrong: SocketGeometry) -> Path:
    """The hold as the node would record it that knows other markers of the socket."""
    pose = fit_body(wrong.socket_markers, measured_of(hold).markers["socket"][:, :3]).pose
    rows, pack = pose.vector, pose_packer()
    recorded_as(hold, path, {"/mocap/socket/pose": lambda stamp, row: pack(stamp, rows[row])})
    write_socket(wrong, path / "socket.yaml")
    return path


def moved_marker(by: float) -> SocketGeometry:
    markers = GEOMETRY.socket_markers.copy()
    markers[1, 0] += by
    return dataclasses.replace(GEOMETRY, socket_markers=markers)


@pytest.mark.parametrize("by", [0.005, 0.001], ids=["5 mm", "1 mm"])
def test_a_marker_that_was_registered_wrong_is_repaired(hold, tmp_path, by) -> None:
    """Wrong by 5 mm it has no pose, by 1 mm a wrong one."""
    path, notes = recorded_with(hold, tmp_path / "trial", moved_marker(by)), []
    file, true = hold / "socket.yaml", Trial(hold).measurements()
    trial = st.open_trial(path, geometry=file, notify=notes.append)
    found = trial.measurements()
    np.testing.assert_array_equal(found.pylon, true.pylon)
    right = recorded_with(hold, tmp_path / "right", GEOMETRY)
    np.testing.assert_allclose(found.socket, Trial(right).measurements().socket, atol=1e-12)
    missing = int(np.isnan(found.socket[:, 0]).sum())
    text = f"socket: poses refitted to the recorded markers: {240 - missing} of 240 found, "
    assert len(notes) == 1 and notes[0].startswith(text)
    recorded = Trial(path).measurements().socket
    if by > 0.002:
        assert np.isnan(recorded).all() and f" refused, {240 - missing} new" in notes[0]
    else:
        shift = 1e3 * np.linalg.norm(found.socket[:, :3] - recorded[:, :3], axis=1)
        assert f"moved by {np.nanmedian(shift):.3g} mm and " in notes[0]
    # The recorded means have less noise than a frame's markers have.
    shift = trial.samples().position - Trial(hold).samples().position
    assert np.nanmax(np.abs(shift)) < 2e-4


def test_a_body_s_frame_moves_no_limb(hold: Path, tmp_path: Path) -> None:
    turn = Pose.from_quaternion(np.array([0.02, -0.03, 0.05]), np.array([0.2, -0.1, 0.3, 0.9]))
    markers, body = turn.apply(GEOMETRY.socket_markers), GEOMETRY.socket_body @ turn.inverse()
    other = dataclasses.replace(GEOMETRY, socket_markers=markers, socket_body=body)
    write_socket(other, tmp_path / "other.yaml")
    found, wanted = (Trial(hold, *given).samples() for given in ((tmp_path / "other.yaml",), ()))
    off = np.abs(found.position - wanted.position)
    assert np.isfinite(off).mean() > 0.95 and np.nanmax(off) < 2e-4


def test_poses_stay_without_markers(hold: Path, tmp_path: Path) -> None:
    other, notes = tmp_path / "other.yaml", []
    write_socket(moved_marker(0.005), other)
    unknown = bare(hold, tmp_path / "unknown", "socket.yaml")
    found = Trial(unknown, other, notify=notes.append).measurements()
    np.testing.assert_array_equal(found.socket, Trial(hold).measurements().socket)
    assert len(notes) == 1 and notes[0].startswith("the poses stay as recorded, with unknown")


# --- drift of the clusters, by spans without load


@pytest.fixture
def measured(hold: Path) -> synchronise.Measurements:
    """The trial's measurements; its first and last 10 s made to be without load."""
    found = Trial(hold).measurements()
    rest = (found.time < 10.0) | (found.time > found.time[-1] - 10.0)
    capacitance = found.capacitance.copy()
    capacitance[rest] = np.array([5.1, 5.2, 5.0, 5.3])
    return dataclasses.replace(found, capacitance=capacitance)


def correct(trial: Trial, measured: synchronise.Measurements) -> synchronise.Measurements:
    """The correction of `Trial.measurements`, of any measurements."""
    least, notify = trial.estimator.plateau.least_force, trial.notify or (lambda note: None)
    return reprocess.correct_measurements(
        measured, trial.unloaded, trial.calibration, least, str(trial.path), notify
    )


def test_drift_between_spans_is_taken_off(hold: Path, measured: synchronise.Measurements) -> None:
    time, notes = measured.time, []
    end = time[-1]
    # A span is that of its samples, wherever it ends.
    trial = Trial(hold, notify=notes.append, unloaded=((0.0, 8.0), (end - 8.0, end + 500.0)))
    drift = 0.2 * (time - 4.0) / (end - 8.0)
    drifted = dataclasses.replace(measured, capacitance=measured.capacitance + drift[:, None, None])
    corrected = correct(trial, drifted)
    inner = (time > 8.0) & (time < end - 8.0)
    found, true = (each.capacitance[inner] for each in (corrected, measured))
    np.testing.assert_allclose(found, true, atol=0.003)  # what was not measured stays so
    (loaded,), drifts = notes[:1], notes[1:]
    assert "measured 92 N in 0:8, 92 N in 51.75:" in loaded
    assert len(drifts) == 4 and all("more than 1 kPa" in note for note in drifts)


def with_baselines(trial: Trial) -> Trial:
    """The trial with a baseline of 5 pF in the calibration of every cluster."""
    clusters = {
        name: dataclasses.replace(cluster, baseline=np.full(4, 5.0))
        for name, cluster in trial.calibration.clusters.items()
    }
    trial.__dict__["calibration"] = dataclasses.replace(trial.calibration, clusters=clusters)
    return trial


def test_a_baseline_takes_off_earlier_drift(hold: Path, measured: synchronise.Measurements) -> None:
    """A baseline is of a cluster that bears nothing: not even the pylon's weight."""
    trial = with_baselines(Trial(hold, unloaded=((0.0, 8.0),)))
    wrench = np.where(measured.time[:, None] <= 8.0, 0.0, measured.wrench)
    corrected = correct(trial, dataclasses.replace(measured, wrench=wrench))
    np.testing.assert_allclose(corrected.capacitance[3], np.full((4, 4), 5.0))
    end, notes = measured.time[-1], []
    spans = ((0.0, 8.0), (end - 8.0, end))
    trial = with_baselines(Trial(hold, notify=notes.append, unloaded=spans))
    corrected = correct(trial, measured)
    assert "load cell measured 92 N in 0:8" in notes[0] and "baseline" in notes[0]
    expected = correct(Trial(hold, unloaded=spans), measured)
    np.testing.assert_array_equal(corrected.capacitance, expected.capacitance)


@pytest.mark.parametrize(
    "spans", [((25.0, 30.0),), ((0.0, 5.0), (25.0, 30.0))], ids=["first", "second"]
)
def test_a_span_under_load_is_refused(spans: tuple, hold: Path) -> None:
    with refused(TrialError, "25:30 is not without load", "279 N there: ", " 92 N"):
        Trial(hold, unloaded=spans).samples()


def test_a_dead_channel_hides_no_load(hold: Path, measured: synchronise.Measurements) -> None:
    dead = dataclasses.replace(measured, wrench=measured.wrench * [1, 1, 1, np.nan, 1, 1])
    with refused(TrialError, "25:30 is not without load"):
        correct(Trial(hold, unloaded=((25.0, 30.0),)), dead)


def test_a_span_without_samples_is_refused(hold: Path, measured: synchronise.Measurements) -> None:
    with refused(CalibrationError, "from 900 s to 901 s", "too few"):
        correct(Trial(hold, unloaded=((900.0, 901.0),)), measured)


def test_one_span_corrects_no_cluster_without_baseline(hold: Path) -> None:
    notes: list[str] = []
    Trial(hold, notify=notes.append, unloaded=((0.0, 3.0),)).samples()
    assert len(notes) == 2 and "distal is not corrected: give a second span" in notes[1]


@pytest.mark.parametrize(
    "spans",
    [["8:2"], ["nan:1"], ["0:1", "2:3", "4:5"], ["0:5", "3:8"]],
    ids=["reversed", "not a number", "three", "overlapping"],
)
def test_wrong_spans_are_refused(spans: list[str], hold: Path) -> None:
    with refused(ConfigurationError, "--unloaded"):
        Trial(hold, unloaded=reprocess.parse_unloaded(spans))
