"""Every reader of files on damaged files: a named error or finite numbers, in bounded time.

Seeded mutations of good files (`support.damage`). `DAMAGED_FILES=20` reads twenty times as many.
"""

import dataclasses
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapReader
from support.bags import rewrite
from support.benches import exact_bench, write_bench
from support.damage import NO_NUMBERS, damaged, no_number, numbers_of
from support.meshes import open_cone, scaled
from support.motive_takes import Written, write_take
from support.problems import SOCKET_TRIAD, make_case, random_pose, random_socket

import socket_testbed as st
from socket_testbed.calibration.bench_data import read_bench, read_unloaded
from socket_testbed.calibration.model import Calibration, read_calibration
from socket_testbed.drivers.load_cell.load_cell import Tare
from socket_testbed.errors import ConfigurationError, ScanError, TestbedError, TrialError
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import (
    ScanFrame,
    SocketGeometry,
    read_socket,
    socket_from_document,
    write_socket,
)
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.model_file import StoredModel, read_model, write_model
from socket_testbed.settings.testbed import TestbedSettings, read_testbed, write_testbed
from socket_testbed.simulation.trial import TRUTH_FILE, read_truth
from socket_testbed.socket_design.clusters import read_cluster_places
from socket_testbed.socket_design.landmarks import read_landmarks
from socket_testbed.socket_design.motive import read_motive_csv
from socket_testbed.socket_design.placement import place_by_landmarks
from socket_testbed.socket_design.scan_file import Scan, read_scan
from socket_testbed.trials.bag import BagReader, typestore
from socket_testbed.trials.events import read_events
from socket_testbed.trials.metadata import TrialMetadata, read_metadata, write_metadata
from socket_testbed.trials.synchronise import make_samples, read_measurements
from socket_testbed.trials.trial import Trial

MANY = int(os.environ.get("DAMAGED_FILES", "1"))
MEMORY = 64 * 2**20  # [bytes] more than before
LONGEST = 2.0  # [s] of processor for one file


@dataclass(frozen=True)
class Reader:
    """A reader of files.

    Attributes:
        file: Name of the good file, below the folder of the good ones.
        kind: What it is, for its damage.
        read: Reads it.
        files: Number of damaged files.
        missing: Whether NaN, or None, stands for what is missing.
        exact: Whether a number that is replaced by none is missed.
        protected: Whether checksums protect it: no number differs, whatever the damage.
    """

    file: str
    kind: str
    read: Callable[[Path], Any]
    files: int = 200
    missing: bool = False
    exact: bool = True
    protected: bool = False


@dataclass(frozen=True)
class Sampled:
    """What is computed from a trial: samples and the times of its events."""

    stamps: np.ndarray
    values: np.ndarray
    events: list[float]


@cache
def setup_of_trial() -> Trial:
    """A trial without a bag, for its geometry and calibration."""
    files = (packaged("config", "socket.yaml"), packaged("config", "calibration.yaml"))
    return Trial(Path("nowhere"), *files)


def sampled(bag: Path) -> Sampled:
    with BagReader(bag) as reader:
        measured = read_measurements(reader, lambda note: None)
        setup_of_trial()._require_clusters(measured.clusters)
        samples = make_samples(measured, setup_of_trial().calibration, setup_of_trial().geometry)
        events = read_events(reader, samples)
    return Sampled(samples.stamps, samples.values, [event.time for event in events])


def calibrated(path: Path) -> tuple[Calibration, list[np.ndarray]]:
    """A calibration and what it makes of capacitances."""
    calibration = read_calibration(path)
    capacitance, status = np.array([5.0, 5.2, 4.9, 5.1]), np.zeros(4, np.uint8)
    return calibration, [c.apply(capacitance, status)[0] for c in calibration.clusters.values()]


def used(stored: StoredModel) -> tuple[StoredModel, np.ndarray, np.ndarray]:
    """A model and what it predicts."""
    position = np.zeros((1, 6)) + stored.model.reference_pose
    return stored, stored.model.wrench(position), stored.model.wrench(position + 1e-3)


READERS = {
    "socket": Reader("socket.yaml", "yaml", read_socket, 350),
    "calibration": Reader("calibration.yaml", "yaml", calibrated, 500, missing=True),
    "testbed": Reader("testbed.yaml", "yaml", read_testbed, 400),
    "clusters": Reader("clusters.yaml", "yaml", read_cluster_places, 300, missing=True),
    "landmarks of a take": Reader("take_landmarks.yaml", "yaml", read_landmarks, 300),
    "landmarks of a scan": Reader(
        "landmarks.yaml", "yaml", lambda path: place_by_landmarks(path, 1e-3), 300
    ),
    "trial.yaml": Reader("trial.yaml", "yaml", read_metadata, 300, missing=True),
    "tare": Reader("tare.json", "yaml", lambda path: Tare(str(path)).no_load[0], 300),
    "model": Reader("model.json", "json", lambda path: used(read_model(path)), 400, missing=True),
    "bench": Reader("bench.csv", "text", lambda path: read_bench(path, {}, {}), 300, missing=True),
    "unloaded": Reader("bench.csv", "text", lambda path: read_unloaded(path, {}, {}), 200),
    "take": Reader("take.csv", "text", read_motive_csv, 400, missing=True),
    "stl": Reader("scan.stl", "binary", read_scan, 200),
    "text stl": Reader("text/scan.stl", "text", read_scan, 120),
    "ply": Reader("scan.ply", "binary", read_scan, 200),
    "text ply": Reader("text/scan.ply", "text", read_scan, 200),
    "obj": Reader("scan.obj", "text", read_scan, 200),
    "mcap": Reader(
        "bag/bag.mcap",
        "binary",
        lambda path: sampled(path.parent),
        120,
        missing=True,
        protected=True,
    ),
    "mcap alone": Reader("bag/bag.mcap", "binary", sampled, 150, missing=True, protected=True),
    "sqlite": Reader("old/old.db3", "binary", lambda path: sampled(path.parent), 200, missing=True),
    "metadata.yaml": Reader(
        "bag/metadata.yaml",
        "yaml",
        lambda path: sampled(path.parent),
        120,
        missing=True,
        exact=False,
        protected=True,
    ),
    "truth": Reader(
        f"truth/{TRUTH_FILE}",
        "binary",
        lambda path: read_truth(path.parent),
        100,
        missing=True,
        protected=True,
    ),
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One good file for every reader, each small."""
    folder = tmp_path_factory.mktemp("good")
    rng = np.random.default_rng(0)
    geometry = random_socket(rng)
    scan = ScanFrame(1e-3, random_pose(rng))
    write_socket(dataclasses.replace(geometry, scan=scan), folder / "socket.yaml")
    shutil.copy(packaged("config", "calibration.yaml"), folder / "calibration.yaml")
    write_testbed(TestbedSettings().nodes(), folder / "testbed.yaml")
    write_metadata(TrialMetadata(subject="S01", side="left", mass=81.5), folder / "trial.yaml")
    _write_landmarks(rng, geometry, folder)
    Tare(str(folder / "tare.json")).set(rng.normal(0.0, 0.1, 6), 10**18)
    geometry, _, samples, settings = make_case(0)
    fit = fit_contact_model(samples, geometry, settings)
    rigid = {
        "reference_pose": rng.normal(0.0, 1e-3, 6),
        "wrench_slope": rng.normal(0.0, 10.0, (6, 6)),
        "parameter_factor": rng.normal(0.0, 1.0, (6, len(geometry), 2)),
    }
    fit = dataclasses.replace(
        fit, model=dataclasses.replace(fit.model, variant="rigid_bias", **rigid)
    )
    trial = {"name": "hold", "unloaded": [[0.5, 2.5]]}
    write_model(fit, geometry, trial, "plateau", folder / "model.json")
    write_bench(folder / "bench.csv", exact_bench()[np.arange(0, len(exact_bench()), 40)])
    poses = random_pose(rng, 1.0, 6)
    corners = np.array([poses.apply(np.tile(point, (6, 1))) for point in SOCKET_TRIAD])
    markers = {f"Socket:Marker{i}": corners[i] for i in range(3)}
    write_take(Written(markers, {}, {"Socket": poses}), folder / "take.csv")
    _write_scans(folder)
    _write_bags(folder)
    return folder


def _write_landmarks(rng: np.random.Generator, geometry: SocketGeometry, folder: Path) -> None:
    points = rng.uniform(-0.1, 0.1, (4, 3))
    frame = geometry.rotations[0].tolist()
    clusters = {
        "distal": {"point": points[0].tolist()},
        "brim": {"anchor": points[1].tolist(), "frame": frame},
    }
    landmarks = {
        f"mark_{i}": {"scan": (1e3 * point).tolist(), "load_cell": point.tolist()}
        for i, point in enumerate(points)
    }
    side = {f"point_{i}": point.tolist() for i, point in enumerate(points)}
    bodies = {"socket": ["s1", "s2", "s3"], "pylon": {"rigid_body": "Pylon"}}
    limb = {f"limb_{name}": point for name, point in side.items()}
    for name, document in (
        ("clusters.yaml", {"clusters": clusters}),
        ("landmarks.yaml", {"landmarks": landmarks}),
        ("take_landmarks.yaml", {"bodies": bodies, "load_cell": side, "limb": limb}),
    ):
        (folder / name).write_text(yaml.safe_dump(document, sort_keys=False))


def _write_scans(folder: Path) -> None:
    mesh = scaled(open_cone(0.04, 0.06, 0.2, 0.03), 1000.0)
    (folder / "text").mkdir()
    (folder / "scan.stl").write_bytes(mesh.export(file_type="stl"))
    (folder / "scan.ply").write_bytes(mesh.export(file_type="ply"))
    (folder / "scan.obj").write_text(mesh.export(file_type="obj"))
    (folder / "text/scan.stl").write_text(trimesh.exchange.stl.export_stl_ascii(mesh))
    (folder / "text/scan.ply").write_bytes(mesh.export(file_type="ply", encoding="ascii"))


def _write_bags(folder: Path) -> None:
    st.simulate(folder / "hold", "static_hold", duration=2.0)
    (folder / "bag").mkdir()
    shutil.copy(folder / "hold/hold.mcap", folder / "bag/bag.mcap")
    text = (folder / "hold/metadata.yaml").read_text()
    (folder / "bag/metadata.yaml").write_text(text.replace("hold.mcap", "bag.mcap"))
    (folder / "truth").mkdir()
    shutil.copy(folder / "hold" / TRUTH_FILE, folder / "truth")
    connections: dict[str, Any] = {}
    with (
        BagReader(folder / "hold") as source,
        Writer(folder / "old", version=8, storage_plugin=StoragePlugin.SQLITE3) as target,
    ):
        for name, kind in source.types.items():
            connections[name] = target.add_connection(name, kind, typestore=typestore())
        for raw in source.messages():
            target.write(connections[raw.topic], raw.time, raw.data)


@dataclass
class Outcome:
    """What came of the damaged files of a reader."""

    read: int = 0
    refused: int = 0
    faults: dict[str, list[str]] = dataclasses.field(default_factory=dict)

    def fault(self, what: str, detail: str) -> None:
        self.faults.setdefault(what, []).append(detail)


@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_is_a_named_error_or_gives_finite_numbers(
    name: str, good: Path, tmp_path: Path
) -> None:
    reader, rng = READERS[name], np.random.default_rng(list(name.encode()))
    content = (good / reader.file).read_bytes()
    outcome = Outcome()
    file = _copy_of(good / reader.file, tmp_path)
    sound = reader.read(file)
    assert np.isfinite(numbers_of(sound)).all() or reader.missing
    before = _memory(reset=True)
    for number in range(reader.files * MANY):
        exact = reader.exact and number % 2 == 0 and reader.kind in NO_NUMBERS
        mutated = (no_number if exact else damaged)(rng, content, reader.kind)
        file.write_bytes(mutated)
        _try(reader, file, outcome, number, sound if exact or reader.protected else None)
        if outcome.faults and len(outcome.faults) > 40:
            break
    more = _memory() - before
    print(f"\n{name}: {outcome.read} read, {outcome.refused} refused, {more / 2**20:.0f} MiB more")
    assert not outcome.faults, outcome.faults
    assert more < MEMORY


def _copy_of(file: Path, folder: Path) -> Path:
    """A copy of a file with all beside it in the same folder, if that is a bag."""
    target = folder / "files"
    if file.suffix in {".mcap", ".db3"} or file.name == "metadata.yaml":
        shutil.copytree(file.parent, target)
    else:
        target.mkdir()
        shutil.copy(file, target)
    return target / file.name


def _try(reader: Reader, file: Path, outcome: Outcome, number: int, sound: Any) -> None:
    """Read one file; with what the sound one holds, another number is a fault."""
    start = time.process_time()
    try:
        found = reader.read(file)
    except TestbedError as error:
        outcome.refused += 1
        if not str(error).isprintable() or len(str(error)) > 5000:
            outcome.fault("error", f"{number}: {str(error)[:100]!r}")
    except Exception as error:
        outcome.fault(f"{type(error).__name__}: {str(error)[:80]}", str(number))
    else:
        outcome.read += 1
        numbers = numbers_of(found)
        if np.isinf(numbers).any() or (np.isnan(numbers).any() and not reader.missing):
            outcome.fault("not finite", str(number))
        if sound is not None and not _none_differs(found, sound):
            outcome.fault("another number", str(number))
    if time.process_time() - start > LONGEST:
        outcome.fault("slow", f"{number}: {time.process_time() - start:.1f} s")


def _none_differs(found: Any, sound: Any) -> bool:
    """Whether all numbers are those of the sound file, or missing."""
    if isinstance(found, Scan):  # a scan is repaired: no corner lies elsewhere
        return bool(np.abs(found.mesh.vertices).max() < 0.21)
    if isinstance(found, Sampled):  # a recording that was cut short has fewer rows
        rows = np.searchsorted(sound.stamps, found.stamps)
        if not np.isin(found.stamps, sound.stamps).all():
            return False
        numbers, expected = found.values, sound.values[rows]
    else:
        numbers, expected = numbers_of(found), numbers_of(sound)
    if numbers.shape != expected.shape:
        return False
    known = ~np.isnan(numbers)
    return bool(np.isclose(numbers[known], expected[known], rtol=1e-12, atol=0.0).all())


def _memory(reset: bool = False) -> int:
    """Largest memory of this process since it was last reset [bytes]; reset: what it has now."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return 1024 * int(status["VmHWM"].split()[0])


def test_an_error_is_one_printable_line_whatever_a_file_holds() -> None:
    error = TestbedError("a\x1b[2J\udc80b\nc" + 10**6 * "x", "hint\0")
    assert str(error).isprintable() and len(str(error)) < 3000
    assert error.fact.startswith("a\N{REPLACEMENT CHARACTER}[2J")


@pytest.mark.parametrize(
    ("file", "read"), [("take.csv", read_motive_csv), ("bench.csv", READERS["bench"].read)]
)
def test_an_open_quote_does_not_swallow_the_lines_behind_it(
    file: str, read: Callable[[Path], Any], good: Path, tmp_path: Path
) -> None:
    *lines, end = (good / file).read_text().splitlines()
    cells = lines[-3].split(",")
    lines[-3] = ",".join([*cells[:-1], f'"{cells[-1]}'])
    (tmp_path / file).write_text("\n".join([*lines, end]) + "\n")
    with pytest.raises(TestbedError, match="line"):
        read(tmp_path / file)


def test_a_recorded_number_that_changed_on_the_disk_is_an_error(good: Path, tmp_path: Path) -> None:
    content = bytearray((good / "bag/bag.mcap").read_bytes())
    reader = McapReader(good / "bag/bag.mcap")
    reader.open()
    chunk = reader.chunks[0]
    reader.close()
    content[chunk.chunk_start_offset + chunk.chunk_length - 60] ^= 1
    (tmp_path / "bag.mcap").write_bytes(content)
    with pytest.raises(TrialError, match="checksum"):
        sampled(tmp_path / "bag.mcap")


def test_a_value_that_no_sensor_reads_is_missing_and_noted(good: Path, tmp_path: Path) -> None:
    def change(topic: str, message: Any) -> Any:
        if topic.endswith("wrench"):
            message.wrench.force.z = 1e200
        return message

    notes: list[str] = []
    with BagReader(rewrite(good / "hold", tmp_path / "hold", change)) as bag:
        measured = read_measurements(bag, notes.append)
    assert np.isnan(measured.wrench[:, 5]).all() and np.isfinite(measured.wrench[:, :5]).all()
    assert any("holds 8 values beyond 1e+06" in note for note in notes)


def test_a_damaged_truth_is_named(good: Path, tmp_path: Path) -> None:
    content = (good / "truth" / TRUTH_FILE).read_bytes()
    for damage in (content[:-30], content[:200] + b"x" + content[201:], b""):
        (tmp_path / TRUTH_FILE).write_bytes(damage)
        with pytest.raises(TrialError, match=f"{TRUTH_FILE}: is damaged"):
            read_truth(tmp_path)


def test_a_face_of_an_obj_names_no_vertex_beyond_all_numbers(good: Path, tmp_path: Path) -> None:
    (tmp_path / "scan.obj").write_text((good / "scan.obj").read_text() + f"f 1 2 {'9' * 40}\n")
    with pytest.raises(ScanError, match="is not a vertex or a face"):
        read_scan(tmp_path / "scan.obj")


def test_a_damaged_normal_of_a_text_stl_writes_no_traceback(
    good: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = (good / "text/scan.stl").read_text()
    (tmp_path / "scan.stl").write_text(text.replace("facet normal", "facet normal x", 1))
    read_scan(tmp_path / "scan.stl")
    assert not caplog.records


FOUR_BILLION = 4_000_000_000
_VERTEX = "property float x\nproperty float y\nproperty float z\n"
_FACE = "property list uchar int vertex_indices\n"
_LONG_FACE = "element face 1\nproperty list uint int vertex_indices\n"
CLAIMS = {
    "count.stl": bytes(80) + b"\xff" * 4 + bytes(200),
    "vertices.ply": ("binary_little_endian", f"element vertex {FOUR_BILLION}\n{_VERTEX}", 100),
    "faces.ply": (
        "binary_little_endian",
        f"element vertex 3\n{_VERTEX}element face {FOUR_BILLION}\n{_FACE}",
        36,
    ),
    "corners.ply": ("binary_little_endian", f"element vertex 3\n{_VERTEX}{_LONG_FACE}", 36),
    "text.ply": ("ascii", f"element vertex {FOUR_BILLION}\n{_VERTEX}", 0),
    "groups.obj": b"".join(b"g %d\n" % i for i in range(50_000)) + b"f 1 2 3\n",
}


@pytest.mark.parametrize("name", CLAIMS)
def test_a_scan_that_claims_more_than_it_holds_takes_no_memory(name: str, tmp_path: Path) -> None:
    content = CLAIMS[name]
    if isinstance(content, tuple):
        kind, elements, size = content
        header = f"ply\nformat {kind} 1.0\n{elements}end_header\n"
        content = header.encode() + bytes(size) + b"\xff" * 4
    (tmp_path / name).write_bytes(content)
    before, start = _memory(reset=True), time.process_time()
    with pytest.raises(ScanError):
        read_scan(tmp_path / name)
    assert _memory() - before < MEMORY
    assert time.process_time() - start < LONGEST


def test_a_socket_of_thousands_of_tiles_takes_no_memory_of_their_square(tmp_path: Path) -> None:
    frame = np.eye(3).tolist()
    tiles = {
        f"t{i}": {"anchor": [1e-3 * (i % 60), 1e-3 * (i // 60), 0.0], "frame": frame, "area": 1e-4}
        for i in range(3000)
    }
    tiles["t2999"]["anchor"] = tiles["t7"]["anchor"]
    document = {"tiles": tiles, "neighbours": [], "clusters": {}, "bodies": {}}
    document["bodies"] = {
        name: {"markers": SOCKET_TRIAD.tolist(), key: {"rotation": frame, "translation": [0, 0, 0]}}
        for name, key in (("socket", "in_load_cell"), ("pylon", "limb_in_body"))
    }
    before = _memory(reset=True)
    with pytest.raises(ConfigurationError, match="is at the same place as t"):
        socket_from_document(document, "socket.yaml")
    assert _memory() - before < MEMORY
