"""Damaged tables, scans and bags: a named error, or finite numbers. Documents: test_documents."""

import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as draw
from rosbags.rosbag2 import StoragePlugin
from support.bags import rewrite, written_by_rosbags
from support.benches import exact_bench, write_bench
from support.damage import damaged, numbers_of, without_a_number
from support.meshes import open_cone, scaled
from support.problems import SOCKET_TRIAD, random_pose
from support.takes import Written, write_take
from support.wording import refused

import socket_testbed as st
from socket_testbed.calibration.bench_data import read_bench
from socket_testbed.drivers.clusters.i2c import BusError
from socket_testbed.errors import ScanError, TestbedError
from socket_testbed.files import packaged
from socket_testbed.socket_design.motive import read_motive_csv
from socket_testbed.socket_design.scan_file import Scan, read_scan
from socket_testbed.trials.bag import BagReader
from socket_testbed.trials.trial import Trial
from socket_testbed.trials.truth import TRUTH_FILE, read_truth

MEMORY = 64 * 2**20  # [bytes] more than before


def sampled(bag: Path) -> dict[str, Any]:
    configuration = (packaged("config", "socket.yaml"), packaged("config", "calibration.yaml"))
    trial = Trial(bag, *configuration)
    samples = trial.samples()
    events = [event.time for event in trial.events()]
    return {"stamps": samples.stamps, "values": samples.values, "events": events}


# By reader: the good file; whether its numbers are text; whether NaN stands for what is missing;
# whether checksums protect it, so that no number differs whatever the damage.
READERS: dict[str, tuple[str, Callable[[Path], Any], bool, bool, bool]] = {
    "bench": ("bench.csv", lambda path: read_bench(path, {}, {}), True, True, False),
    "take": ("take.csv", read_motive_csv, True, True, False),
    "stl": ("scan.stl", read_scan, False, False, False),
    "text stl": ("text/scan.stl", read_scan, True, False, False),
    "ply": ("scan.ply", read_scan, False, False, False),
    "obj": ("scan.obj", read_scan, True, False, False),
    "mcap": ("bag/hold.mcap", lambda path: sampled(path.parent), False, True, True),
    "mcap alone": ("bag/hold.mcap", sampled, False, True, True),
    "sqlite": ("old/old.db3", lambda path: sampled(path.parent), False, True, False),
    "metadata.yaml": ("bag/metadata.yaml", lambda path: sampled(path.parent), False, True, True),
    "truth": (f"truth/{TRUTH_FILE}", lambda path: read_truth(path.parent), False, True, True),
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One good file for every reader, each small."""
    folder = tmp_path_factory.mktemp("good")
    write_bench(folder / "bench.csv", exact_bench()[np.arange(0, len(exact_bench()), 40)])
    poses = random_pose(np.random.default_rng(0), 1.0, 6)
    corners = np.array([poses.apply(np.tile(point, (6, 1))) for point in SOCKET_TRIAD])
    markers = {f"Socket:Marker{i}": corners[i] for i in range(3)}
    write_take(Written(markers, {}, {"Socket": poses}), folder / "take.csv")
    mesh = scaled(open_cone(0.04, 0.06, 0.2, 0.03), 1000.0)
    (folder / "text").mkdir()
    (folder / "scan.stl").write_bytes(mesh.export(file_type="stl"))
    (folder / "scan.ply").write_bytes(mesh.export(file_type="ply"))
    (folder / "scan.obj").write_text(mesh.export(file_type="obj"))
    (folder / "text/scan.stl").write_text(trimesh.exchange.stl.export_stl_ascii(mesh))
    st.simulate(folder / "hold", "static_hold", duration=2.0)
    for name, files in {"bag": ("hold.mcap", "metadata.yaml"), "truth": (TRUTH_FILE,)}.items():
        (folder / name).mkdir()
        for file in files:
            shutil.copy(folder / "hold" / file, folder / name)
    with BagReader(folder / "hold") as source:
        written_by_rosbags(source.messages(), folder / "old", StoragePlugin.SQLITE3)
    return folder


@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_gives_no_wrong_number(name, good, tmp_path) -> None:
    """It is a named error, or gives finite numbers."""
    file, read, is_text, missing, protected = READERS[name]
    content = (good / file).read_bytes()
    shutil.copytree((good / file).parent, tmp_path / "files")
    spoilt = tmp_path / "files" / Path(file).name
    sound = read(spoilt)
    assert np.isfinite(numbers_of(sound)).all() or missing

    @given(data=draw.data())
    @settings(max_examples=80, deadline=None, derandomize=True, database=None)
    def check(data: draw.DataObject) -> None:
        exact = is_text and data.draw(draw.booleans())
        spoilt.write_bytes((without_a_number if exact else damaged)(data, content))
        try:
            found = read(spoilt)
        except TestbedError as error:
            assert str(error).isprintable() and len(str(error)) < 5000
            return
        numbers = numbers_of(found)
        assert not np.isinf(numbers).any() and (missing or not np.isnan(numbers).any())
        assert not (exact or protected) or none_differs(found, sound)

    check()


def none_differs(found: Any, sound: Any) -> bool:
    """Whether all numbers are those of the sound file, or missing."""
    if isinstance(found, Scan):  # a scan is repaired: no corner lies elsewhere
        return bool(np.abs(found.mesh.vertices).max() < 0.21)
    if isinstance(found, dict):  # a recording that was cut short has fewer rows
        rows = np.searchsorted(sound["stamps"], found["stamps"])
        if not np.isin(found["stamps"], sound["stamps"]).all():
            return False
        numbers, expected = found["values"], sound["values"][rows]
    else:
        numbers, expected = numbers_of(found), numbers_of(sound)
    if numbers.shape != expected.shape:
        return False
    known = ~np.isnan(numbers)
    return bool(np.isclose(numbers[known], expected[known], rtol=1e-12, atol=0.0).all())


def test_an_error_is_one_printable_line() -> None:
    error = TestbedError("a\x1b[2J\udc80b\nc" + 10**6 * "x", "hint\0")
    assert str(error).isprintable() and len(str(error)) < 3000
    assert error.fact.startswith("a\N{REPLACEMENT CHARACTER}[2J")


def test_an_error_comes_back_from_a_process() -> None:
    found = pickle.loads(pickle.dumps(BusError("no answer", "check the wires", 0x50)))
    assert type(found) is BusError and str(found) == "no answer: check the wires"
    assert found.address == 0x50


@pytest.mark.parametrize("name", ["take", "bench"])
def test_an_open_quote_swallows_no_lines(name: str, good: Path, tmp_path: Path) -> None:
    file, read, *_ = READERS[name]
    *lines, end = (good / file).read_text().splitlines()
    cells = lines[-3].split(",")
    lines[-3] = ",".join([*cells[:-1], f'"{cells[-1]}'])
    (tmp_path / file).write_text("\n".join([*lines, end]) + "\n")
    with refused(TestbedError, "line"):
        read(tmp_path / file)


@pytest.mark.parametrize("value", [1e200, -1e200], ids=["positive", "negative"])
def test_a_value_that_no_sensor_reads_is_missing(value, good: Path, tmp_path: Path) -> None:
    def change(topic: str, message: Any) -> Any:
        if topic.endswith("wrench"):
            message.wrench.force.z = value
        return message

    trial = Trial(rewrite(good / "hold", tmp_path / "hold", change))
    measured = trial.measurements()
    assert np.isnan(measured.wrench[:, 5]).all() and np.isfinite(measured.wrench[:, :5]).all()
    assert any("holds 8 values beyond 1e+06" in note for note in trial.notes)


FOUR_BILLION = 4_000_000_000
_VERTEX = "property float x\nproperty float y\nproperty float z\n"
_LONG_FACE = "element face 1\nproperty list uint int vertex_indices\n"
_HEADER = "ply\nformat {} 1.0\nelement vertex {}\n" + _VERTEX + "{}end_header\n"
_BINARY = "binary_little_endian"
CLAIMS = {
    "count.stl": bytes(80) + b"\xff" * 4 + bytes(200),
    "corners.ply": _HEADER.format(_BINARY, 3, _LONG_FACE).encode() + bytes(36) + b"\xff" * 4,
    "groups.obj": b"".join(b"g %d\n" % i for i in range(50_000)) + b"f 1 2 3\n",
    "text.ply": _HEADER.format("ascii", FOUR_BILLION, "").encode(),
}


def memory() -> int:
    """Largest memory of this process since it was last reset [bytes]."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])


@pytest.mark.parametrize(("name", "content"), CLAIMS.items(), ids=CLAIMS)
def test_a_scan_that_claims_much_takes_no_memory(name, content, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    Path("/proc/self/clear_refs").write_text("5")
    before = memory()
    with pytest.raises(ScanError):
        read_scan(tmp_path / name)
    assert memory() - before < MEMORY
