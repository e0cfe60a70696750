"""Documents: what stands in a field is read, or refused by its name with a hint."""

import dataclasses
import gzip
import io
import json
import zipfile
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as draw
from msgspec import Meta
from support.damage import DELETE, changed, numbers_of
from support.problems import make_case, random_pose, random_socket
from support.wording import check_line, refused

from socket_testbed import documents
from socket_testbed.calibration.bench_data import read_bench
from socket_testbed.calibration.model import read_calibration
from socket_testbed.drivers.load_cell.load_cell import Tare
from socket_testbed.errors import ConfigurationError, RegistrationError, TestbedError
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import ScanFrame, read_socket
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.model_file import read_model, write_model
from socket_testbed.settings.testbed import TestbedSettings, read_testbed
from socket_testbed.socket_design.clusters import read_cluster_places
from socket_testbed.socket_design.design import place_by_landmarks
from socket_testbed.socket_design.motive import read_motive_csv
from socket_testbed.socket_design.registration import read_landmarks
from socket_testbed.socket_design.scan_file import read_scan
from socket_testbed.trials.metadata import read_metadata
from socket_testbed.trials.trial import Trial
from socket_testbed.trials.truth import read_truth


class Lamp(documents.Document):
    power: Annotated[float, Meta(ge=0.0, le=100.0, description="what it takes [W]")]
    colour: Literal["red", "green"] = "red"
    names: list[documents.Text] = []  # noqa: RUF012
    at: tuple[tuple[float, float], tuple[float, float]] | None = None
    inside: "dict[str, Lamp]" = {}  # noqa: RUF012


WRONG: dict[str, tuple[Any, str]] = {
    "missing": ({}, "lamp: 'power' is missing: add 'power: ...'"),
    "unknown-key": (
        {"power": 1, "colur": "red"},
        "lamp: unknown key 'colur': did you mean 'colour'?",
    ),
    "too-large": (
        {"power": 101},
        "lamp: power is 101: give a number from 0 to 100: what it takes [W]",
    ),
    "too-small": (
        {"power": -1},
        "lamp: power is -1: give a number from 0 to 100: what it takes [W]",
    ),
    "unknown-word": (
        {"power": 1, "colour": "rad"},
        "lamp: colour is 'rad': did you mean 'red'?",
    ),
    "no-text": (
        {"power": 1, "names": ["a", []]},
        "lamp: names[1] is a list of 0: give a text, in quotes",
    ),
    "no-list": ({"power": 1, "at": [1, 2]}, "lamp: at[0] is 1: give a list of 2"),
    "deep-inside": (
        {"power": 1, "inside": {"a": {"power": 1, "inside": {"c": {}}}}},
        "a: inside: c: 'power' is",
    ),
}


@pytest.mark.parametrize(("data", "error"), WRONG.values(), ids=WRONG)
def test_an_error_names_what_belongs_in_a_field(data: Any, error: str) -> None:
    with refused(ConfigurationError, error):
        documents.convert(data, Lamp, "lamp")


def workbook(*names: str) -> bytes:
    """An archive of files, as spreadsheet programs save their workbooks."""
    with zipfile.ZipFile(content := io.BytesIO(), "w") as new:
        for name in names:
            new.writestr(name, "<xml/>")
    return content.getvalue()


OTHERS: dict[str, tuple[bytes, str]] = {
    "pointer": (
        b"version https://git-lfs.github.com/spec/v1\noid sha256:1\nsize 3\n",
        "is a Git LFS pointer, not the file itself: fetch the content with 'git lfs pull'",
    ),
    "xlsx": (
        workbook("[Content_Types].xml", "xl/workbook.xml"),
        "is a workbook of a spreadsheet program: save its table as CSV",
    ),
    "xlsx, other order": (
        workbook("docProps/app.xml", "xl/workbook.xml"),
        "is a workbook of a spreadsheet program: save its table as CSV",
    ),
    "xls": (
        b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(600),
        "is a workbook or document of an Office program: save a table as CSV, anything else as"
        " text",
    ),
    "zip": (workbook("a.csv"), "is a ZIP archive: unpack it"),
    "gzip": (gzip.compress(b"a"), "is compressed with gzip: unpack it with 'gunzip'"),
    "pdf": (b"%PDF-1.7\n", "is a PDF document: give the file that it was made from"),
}
READERS: dict[str, Callable[[Path], Any]] = {
    "socket.yaml": read_socket,
    "calibration.yaml": read_calibration,
    "testbed.yaml": read_testbed,
    "trial.yaml": read_metadata,
    "landmarks.yaml": read_landmarks,
    "model.json": read_model,
    "bench.csv": lambda path: read_bench(path, {}, {}),
    "take.csv": read_motive_csv,
    "scan.stl": lambda path: read_scan(path, "mm"),
}


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("kind", OTHERS)
def test_a_file_of_another_kind_is_named(name: str, kind: str, tmp_path: Path) -> None:
    content, line = OTHERS[kind]
    (path := tmp_path / name).write_bytes(content)
    with pytest.raises(TestbedError) as found:
        READERS[name](path)
    assert str(found.value) == f"{path}: {line}"


@pytest.mark.parametrize("name", ["socket.yaml", "calibration.yaml", "testbed.yaml"])
def test_a_pointer_among_a_trial_s_files_is_named(name: str, tmp_path: Path) -> None:
    """Of files that Git LFS has not fetched."""
    (tmp_path / name).write_bytes(OTHERS["pointer"][0])
    trial = Trial(tmp_path)
    read = {
        "socket.yaml": lambda: trial.geometry,
        "calibration.yaml": lambda: trial.calibration,
        "testbed.yaml": lambda: trial.estimator,
    }[name]
    with pytest.raises(TestbedError) as found:
        read()
    assert str(found.value) == f"{tmp_path / name}: {OTHERS['pointer'][1]}"


def test_a_pointer_as_ground_truth_is_named(tmp_path: Path) -> None:
    (tmp_path / "ground_truth.npz").write_bytes(OTHERS["pointer"][0])
    with pytest.raises(TestbedError) as found:
        read_truth(tmp_path)
    assert str(found.value) == f"{tmp_path / 'ground_truth.npz'}: {OTHERS['pointer'][1]}"


def test_a_whole_number_is_a_float_or_text() -> None:
    """As the field asks."""
    lamp = documents.convert({"power": 2, "names": [12, "a"]}, Lamp, "lamp")
    assert isinstance(lamp.power, float) and [str(name) for name in lamp.names] == ["12", "a"]


@pytest.mark.parametrize("half", [np.float32(0.5), np.array(0.5)], ids=["scalar", "array"])
def test_a_number_of_numpy_is_a_number(half: Any) -> None:
    assert documents.check_number(half, "x") == 0.5


# --- YAML

MANY_ALIASES = "a: &a [" + "x, " * 999 + "]\nb: [" + "*a, " * 999 + "]"
BAD_YAML = {
    "list-as-key": ("? [a, b]", "a key is not a word at line 1"),
    "tag": ("a: !!int 1", "tags are not supported at line 1"),
    "alias-of-itself": ("a: &b {c: *b}", "an alias stands for nothing before it"),
    # Once a segmentation fault; from PyYAML 6.0.4 on its parser may refuse it first.
    "far-too-deep": ("a: " + "[" * 100_000, "at line 1"),
    "too-deep": ("a: " + "[" * 60, "too deep"),
    "many-aliases": (MANY_ALIASES, "holds more than 200000 values"),
    "directive": ("%TAG !a! tag:a:\n" * 9 + "--- {}", "holds a directive %TAG"),
    "key-again": ("a: 1\na: 2", "the key 'a' is repeated at line 2"),
    "control-characters": ("\0\x80", "YAML"),
    "too-large": ("x" * (2**24 + 1), "larger than 16 MiB"),
}


@pytest.mark.parametrize("name", BAD_YAML)
def test_bad_yaml_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    path, (text, problem) = tmp_path / "damaged.yaml", BAD_YAML[name]
    path.write_text(text, encoding="utf-8")
    with refused(ConfigurationError, str(path), problem) as caught:
        documents.load_yaml(path)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        pytest.param("damaged.yaml", "UTF-8", id="bytes"),
        pytest.param("none.yaml", "check the path", id="no-file"),
        pytest.param("", "cannot", id="folder"),
    ],
)
def test_what_is_no_text_is_refused(name: str, problem: str, tmp_path: Path) -> None:
    (tmp_path / "damaged.yaml").write_bytes(bytes(range(256)))
    with refused(ConfigurationError, str(tmp_path / name), problem):
        documents.load_yaml(tmp_path / name)


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("[" * 10_000, id="too-deep"),
        pytest.param('{"a": NaN}', id="nan"),
        pytest.param('{"a": 1e999}', id="infinite"),
    ],
)
def test_bad_json_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "model.json").write_text(text)
    with refused(ConfigurationError, "is not a model"):
        documents.load_json(tmp_path / "model.json", "a model")


@pytest.mark.parametrize("text", ["1e-3", "1E-3", "+1.0e-3", ".001", "1.e-3"])
def test_a_number_is_what_ros_reads(text: str, tmp_path: Path) -> None:
    path = tmp_path / "number.yaml"
    path.write_text(f"power: &a {text}\ninside: {{007: {{power: *a}}}}")
    lamp = documents.read_document(path, Lamp)
    assert lamp.power == lamp.inside["007"].power == 1e-3


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("1:30", id="sexagesimal"),
        pytest.param("010", id="octal"),
        pytest.param("1_000", id="underscore"),
        pytest.param("'1.5'", id="text"),
        pytest.param("true", id="boolean"),
        pytest.param("9" * 18 + "x", id="digits-and-a-letter"),
        pytest.param("2026-01-01", id="date"),
        pytest.param("9" * 30, id="30-digits"),
        pytest.param(".nan", id="nan"),
    ],
)
def test_what_only_yaml_1_1_reads_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "number.yaml"
    path.write_text(f"power: {text}")
    with refused(ConfigurationError, "power is ", "give a number"):
        documents.read_document(path, Lamp)


# --- every reader


@cache
def good_documents() -> dict[str, tuple[Any, Callable[[Path], Any]]]:
    rng = np.random.default_rng(0)
    geometry = dataclasses.replace(random_socket(rng), scan=ScanFrame(1e-3, random_pose(rng)))
    points = {f"mark_{i}": [0.01 * i, 0.05, 0.03 * (i % 2)] for i in range(4)}
    landmarks = {
        "bodies": {"socket": ["s1", "s2", "s3"], "pylon": {"rigid_body": "Pylon"}},
        "load_cell": points,
        "limb": {f"limb_{name}": point for name, point in points.items()},
    }
    scanned = {n: {"scan": [1e3 * x for x in p], "load_cell": p} for n, p in points.items()}
    anchor = {"anchor": [0.0, 0.0, 0.1], "frame": np.eye(3).tolist()}
    places = {"clusters": {"distal": {"point": [0.0, 0.0, 0.1]}, "brim": anchor}}
    nodes = TestbedSettings().nodes().items()
    testbed = {name: {"ros__parameters": node.to_flat()} for name, node in nodes}
    calibration = yaml.safe_load(packaged("config", "calibration.yaml").read_text())
    return {
        "socket": (geometry.to_document(), read_socket),
        "calibration": (calibration | {"date": "2026-01-01"}, read_calibration),
        "testbed": (testbed, read_testbed),
        "landmarks": (landmarks, read_landmarks),
        "clusters": (places, read_cluster_places),
        "placement": ({"landmarks": scanned}, lambda path: place_by_landmarks(path, 1e-3)),
        "trial": ({"subject": "S01", "side": "left", "mass": 81.5}, read_metadata),
        "tare": (
            {"offsets_mV_per_V": [0.1, -0.2, 0.0, 0.3, 0.1, 0.2], "time": "2026-01-01T10:00:00Z"},
            lambda path: Tare(str(path), "").no_load,
        ),
        "model": (None, read_model),
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("documents")


@cache
def model(folder: Path) -> Any:
    geometry, _, samples, chosen = make_case(0)
    fit = fit_contact_model(samples, geometry, chosen)
    named = dataclasses.replace(fit, trial="hold", unloaded=((0.5, 2.5),), segment="plateau")
    write_model(named, folder / "good.json")
    return json.loads((folder / "good.json").read_text())


def places(document: Any, above: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    pairs = document.items() if isinstance(document, dict) else enumerate(document)
    for key, value in pairs:
        yield (*above, key)
        if isinstance(value, dict | list):
            yield from places(value, (*above, key))


_SCALARS = (
    draw.none()
    | draw.booleans()
    | draw.floats()
    | draw.sampled_from((0, -1, 7, 2**70, 1e9, -1e-3, 1e300))
    | draw.text("ab1.e-: '#[{é\n", max_size=6)
)
VALUES = (
    _SCALARS
    | draw.lists(_SCALARS, max_size=4)
    | draw.dictionaries(draw.text("ab", min_size=1), _SCALARS, max_size=2)
)


@pytest.mark.long
@pytest.mark.parametrize("name", good_documents())
@given(data=draw.data())
@settings(max_examples=120, deadline=None, derandomize=True, database=None)
def test_a_field_is_read_or_refused_by_name(name, folder, data) -> None:
    document, read = good_documents()[name]
    document = model(folder) if document is None else document
    place = data.draw(draw.sampled_from([*places(document)]))
    value = data.draw(VALUES | draw.just(DELETE) if isinstance(place[-1], str) else VALUES)
    path = folder / f"{name}.yaml"
    wrong = changed(document, place, value)
    dump = json.dumps if name == "model" else partial(yaml.dump, Dumper=yaml.CSafeDumper)
    path.write_text(dump(wrong))
    try:
        found = read(path)
    except TestbedError as error:
        check_line(str(error), str(path))
        fields = [key for key in place if isinstance(key, str)][-2:]
        # NaN is no JSON, and landmarks do not fit, whatever the field.
        if "is not a model" not in error.fact and not isinstance(error, RegistrationError):
            assert any(field in error.fact for field in fields)
    else:
        known = numbers_of(found)
        assert np.isfinite(known[~np.isnan(known)]).all()
