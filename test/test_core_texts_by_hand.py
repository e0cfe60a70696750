"""Whole lines of batches, files, documents and the socket: what is wrong, and what to do."""

import json
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from support import scene

from socket_testbed import batch, documents, errors, files
from socket_testbed.batch import Job, Row, Task, plan_jobs, run_batch
from socket_testbed.errors import ConfigurationError, TestbedError, TrialError
from socket_testbed.geometry.marker_bodies import body_fault
from socket_testbed.geometry.pose import check_rotation
from socket_testbed.geometry.socket import read_socket, socket_from_document, write_socket
from socket_testbed.trials.trial import Trial


def line(call: Callable[[], object]) -> str:
    """The error of a call."""
    with pytest.raises(TestbedError) as found:
        call()
    return str(found.value)


# --- a batch of trials

FIGURES: Row = {
    "mean_force_rmse [N]": 1.23456, "median_skill [-]": 0.5, "mean_moment_rmse [N m]": None,
    "samples": 41, "Fz_rmse [N]": 9.0,
}  # fmt: skip


def worked(job: Job) -> Row:
    """Writes the output, with a note twice and another one; `bad` fails, `bug` has an error."""
    if job.name == "bad":
        raise TrialError(f"{job.trial.path}: is bad", "record it again")
    if job.name == "bug":
        raise ZeroDivisionError("oh\nno")
    for note in ("late", "late", "wet"):
        job.trial.note(note)
    job.output.write_text("{}")
    return {**FIGURES}


def run(tmp_path: Path, names: list[str], **changes: Any) -> tuple[list[str], list[str], str]:
    """Lines of finished trials, warnings, and the error at the end of a batch."""
    for name in names:
        (tmp_path / "trials" / name).mkdir(parents=True, exist_ok=True)
    trials = {name: Trial(tmp_path / "trials" / name) for name in names}
    task = replace(Task("judge", tmp_path / "out", worked), **changes)
    lines, warned = list[str](), list[str]()
    try:
        run_batch(task, plan_jobs(trials, task.folder, ".json", {}), lines.append, warned.append, 1)
    except TestbedError as error:
        return lines, warned, str(error)
    return lines, warned, ""


def test_a_batch_says_what_became_of_each(tmp_path: Path) -> None:
    began = time.perf_counter()
    lines, warned, error = run(tmp_path, ["good", "bug", "bad"])
    elapsed = time.perf_counter() - began
    out, trials = tmp_path / "out", tmp_path / "trials"
    bug = f"{trials}/bug: unexpected ZeroDivisionError: oh no: run 'judge' on this trial alone"
    bad = f"{trials}/bad: is bad: record it again"
    assert lines == [
        "[1/3] good: ok, mean force RMSE 1.235 N, median skill 0.500",
        f"[2/3] bug: failed: {bug}",
        f"[3/3] bad: failed: {bad}",
        f"summary in {out}/summary.csv and summary.parquet",
    ]
    assert warned == ["note: good: late; wet", f"bad: {bad}", f"bug: {bug}"]
    assert error == ("2 of 3 trials failed: fix them and run it again: finished trials are kept")
    table = pd.read_csv(out / "summary.csv", index_col="trial")
    assert table["status"].to_dict() == {"good": "ok", "bug": "failed", "bad": "failed"}
    assert table["notes"]["good"] == "late; wet" and table["error"]["bad"] == bad
    assert 0.0 <= table["computing_time [s]"]["good"] <= elapsed


def test_a_finished_trial_keeps_its_figures_and_notes(tmp_path: Path) -> None:
    first = run(tmp_path, ["good"])
    lines, warned, _ = run(tmp_path, ["good"])
    assert lines[0] == "[1/1] good: skipped, mean force RMSE 1.235 N, median skill 0.500"
    assert warned == first[1] == ["note: good: late; wet"]
    table = pd.read_csv(tmp_path / "out" / "summary.csv", index_col="trial")
    assert table["status"]["good"] == "ok" and table["samples"]["good"] == 41
    assert run(tmp_path, ["good"], again=True)[0][0].startswith("[1/1] good: ok, ")


def test_an_input_is_the_file_of_the_trial_s_name(tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    (single := tmp_path / "m.json").touch()
    given = {"model": tmp_path / "models", "params": single}
    (job,) = plan_jobs({"s01/hold": Trial(tmp_path)}, tmp_path / "out", ".p.csv", given)
    assert job.files == {"model": tmp_path / "models" / "s01" / "hold.json", "params": single}
    assert job.output == tmp_path / "out" / "s01" / "hold.p.csv"


def test_a_dead_worker_has_this_line(monkeypatch: pytest.MonkeyPatch) -> None:
    future: Future[Any] = Future()
    future.set_exception(MemoryError("too large"))
    sizes: list[Any] = []

    @contextmanager
    def executor(processes: int, dask: str | None) -> Any:
        sizes.append((processes, dask))
        yield SimpleNamespace(submit=lambda *given: future)

    monkeypatch.setattr(batch, "_executor", executor)
    monkeypatch.setattr("joblib.cpu_count", lambda: 6)
    job = Job("s01", Trial(Path("trials/s01")), Path("out"))
    task: Any = None
    ((name, row),) = batch._run_jobs(task, [job], None, None)
    assert name == "s01" and row == {
        "status": "failed",
        "error": "trials/s01: its worker failed (MemoryError: too large): check that it has this"
        " package and enough memory, or give fewer --jobs",
    }
    assert sizes == [(1, None)]


def test_dask_that_is_missing_has_this_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert line(batch._executor(2, "tcp://a:1").__enter__) == (
        "--dask: Dask is not installed: run 'pip install -r requirements/dask.txt'"
    )


def test_a_silent_scheduler_has_this_line(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def client(address: str, timeout: str) -> None:
        asked.append((address, timeout))
        raise OSError("timed out")

    monkeypatch.setitem(sys.modules, "distributed", SimpleNamespace(Client=client))
    assert line(batch._executor(2, "tcp://a:1").__enter__) == (
        "--dask tcp://a:1: no scheduler with a worker answers (timed out): give the address of a"
        " running one, such as tcp://host:8786"
    )
    assert asked == [("tcp://a:1", "15s")]


# --- files


def test_outputs_are_refused_with_these_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (file := tmp_path / "a.csv").touch()
    new = tmp_path / "nowhere" / "b.csv"
    path_hint = "correct the path, or make the folder first"
    assert line(lambda: files.check_outputs(None, file, replace=False)) == (
        f"{file} exists already: name another output, or replace it with --replace (in Python,"
        " replace=True)"
    )
    assert line(lambda: files.check_outputs(tmp_path, replace=True)) == (
        f"{tmp_path} exists already as a folder: name a file"
    )
    assert line(lambda: files.check_outputs(new, replace=True)) == (
        f"{new}: cannot be written (no such folder as {new.parent}): {path_hint}"
    )
    assert line(lambda: files.check_outputs(file / "b.csv", replace=True)) == (
        f"{file}/b.csv: cannot be written ({file} is not a folder): {path_hint}"
    )
    assert line(lambda: files.check_new_folder(tmp_path)) == (
        f"{tmp_path} exists already: name another output or remove it"
    )
    assert line(lambda: files.make_folder(file / "b")) == (
        f"{file}/b: cannot be made (Not a directory): name another folder, a part of its"
        " path is a file"
    )
    monkeypatch.setattr("os.access", lambda path, mode: mode != os.W_OK)
    assert line(lambda: files.check_outputs(tmp_path / "b.csv", replace=True)) == (
        f"{tmp_path}/b.csv: cannot be written (no permission to write in {tmp_path}): name another"
        " folder"
    )


def test_a_failed_write_leaves_the_older_file(tmp_path: Path) -> None:
    (path := tmp_path / "a.csv").write_text("older")

    def fail(number: int) -> None:
        with files.atomic_output(path) as staging:
            staging.write_text("half")
            raise OSError(number, os.strerror(number))

    assert line(lambda: fail(28)) == (
        f"{path}: cannot be written (No space left on device): make space"
    )
    assert path.read_text() == "older" and [*tmp_path.iterdir()] == [path]
    files.write_text(path, "newer")
    assert path.read_text() == "newer"


def test_a_file_that_came_meanwhile_has_this_line(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    files.check_outputs(path, replace=False)
    path.write_text("another's")
    assert line(lambda: files.write_text(path, "ours")) == (
        f"{path} exists already: another run wrote it meanwhile: name another output or remove it"
    )
    files.check_outputs(path, replace=True)
    files.write_text(path, "ours")
    assert path.read_text() == "ours"


def test_no_device_is_an_output(tmp_path: Path) -> None:
    os.mkfifo(path := tmp_path / "pipe")
    assert line(lambda: files.write_text(path, "")) == (
        f"{path} is not an ordinary file: name a file for the output"
    )


def test_formats_are_refused_with_these_lines() -> None:
    assert line(lambda: files.check_suffix(Path("a.txt"), files.TABLES, "table")) == (
        "a.txt: '.txt' is not the format of a table: name a .csv, .parquet or .mat file"
    )
    assert line(lambda: files.packaged("config", "none.yaml")) == (
        "config/none.yaml of the package is not installed: install the package again"
    )


# --- documents


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("a: [", "correct the YAML there"),
        ("a: 1\na: 2", "the key 'a' is repeated at line 2: correct the YAML there"),
        ("? [a]\n: 1", "a key is not a word at line 1: correct the YAML there"),
        ("a: !!int 1", "tags are not supported at line 1: correct the YAML there"),
        ("b: 1\na: *b", "an alias stands for nothing before it at line 2: correct the YAML there"),
        ("%TAG ! tag:a:\n--- {}", "holds a directive %TAG: correct the YAML there"),
        (
            "a: " + "[" * 60 + "]" * 60,
            "lists or mappings are too deep at line 1: correct the YAML there",
        ),
    ],
    ids=["open", "repeated", "key", "tag", "alias", "directive", "deep"],
)
def test_yaml_is_refused_with_this_line(text: str, error: str, tmp_path: Path) -> None:
    (path := tmp_path / "a.yaml").write_text(text)
    found = line(lambda: documents.load_yaml(path))
    assert found.startswith(f"{path}: ") and found.endswith(error)
    if error != "correct the YAML there":
        assert found == f"{path}: {error}"


def test_json_is_refused_with_this_line(tmp_path: Path) -> None:
    (path := tmp_path / "m.json").write_text("[1, ]")
    assert line(lambda: documents.load_json(path, "a model")).startswith(
        f"{path}: is not a model (JSON is malformed: "
    )
    assert line(lambda: documents.load_json(path, "a model")).endswith("): make it again")


def test_long_values_are_cut() -> None:
    assert documents.shown("x" * 60) == f"'{'x' * 60}'"
    assert documents.shown("x" * 61) == f"'{'x' * 60}...'"


# --- errors

WORDS = {
    "similar": (lambda: errors.closest("thetta", ["theta", "rate"]), "did you mean 'theta'?"),
    "unlike": (lambda: errors.closest("xyz", ["rate", "base"]), "use one of base, rate"),
    "none": (lambda: errors.closest("xyz", []), "use one of (none)"),
    "few": (lambda: errors.listed(["a", "b"], 2), "a, b"),
    "many": (lambda: errors.listed(["a", "b", "c", "d"], 2), "a, b and 2 more"),
    "first": (lambda: errors.first_of(["a", "b", "c"]), "a (and 2 more)"),
    "only": (lambda: errors.first_of(["a"]), "a"),
    "option": (lambda: errors.option_of("load_cell"), "--load-cell"),
}


@pytest.mark.parametrize("case", WORDS)
def test_parts_of_errors_are_worded(case: str) -> None:
    call, text = WORDS[case]
    assert call() == text


def test_an_error_begins_with_its_place() -> None:
    def fail(*kinds: Any) -> None:
        with errors.naming("a.yaml", *kinds):
            raise ConfigurationError("theta\nis 2", "give 0 to 1")

    assert line(fail) == "a.yaml: theta is 2: give 0 to 1"
    assert line(lambda: fail(TrialError)) == "theta is 2: give 0 to 1"
    assert errors.fact_and_hint("a.yaml: theta is 2: give 0 to 1") == (
        "a.yaml: theta is 2",
        "give 0 to 1",
    )
    assert errors.fact_and_hint("all") == ("all", "")


LINES = {
    "brackets": ("no answer (every bit reads 0: ground?): check it", 38),
    "quotes": ("a: write 'theta: 1' again", 1),
    "apostrophe": ("the cell's rail: unload Fx's bridge", 15),
    "only brackets": ("not one (see: there)", 20),
}


@pytest.mark.parametrize(("text", "colon"), LINES.values(), ids=LINES)
def test_a_hint_begins_after_the_last_colon(text: str, colon: int) -> None:
    assert errors.fact_and_hint(text) == (text[:colon], text[colon + 2 :])


def test_joined_faults_say_each_hint_once() -> None:
    lines = ["a: no answer: check its plug", "b: no answer: check its plug", "late", "late"]
    assert errors.joined(lines) == "a: no answer; b: no answer; late: check its plug"
    assert errors.joined(["full: make space", "late: wait"]) == "full; late: make space; wait"
    assert errors.joined(["late"]) == "late"


# --- the socket's file

SOCKET = scene.geometry()


def at(*place: Any, value: Any) -> Callable[[Any], None]:
    """Puts a value into a place of the document."""

    def change(document: Any) -> None:
        for step in place[:-1]:
            document = document[step]
        document[place[-1]] = value

    return change


def first_frame(document: Any) -> None:
    document["tiles"]["ant_mid"]["frame"][0][0] += 0.01


SOCKETS: dict[str, tuple[Callable[[Any], None], str]] = {
    "unknown tile": (
        at("clusters", "distal", value="post_ned"),
        "clusters: distal: no tile 'post_ned': did you mean 'post_end'?",
    ),
    "two on a tile": (
        at("clusters", "distal", value="ant_mid"),
        "clusters: two clusters are on 'ant_mid': give each its own tile",
    ),
    "same place": (
        at("tiles", "left_prox", "anchor", value=SOCKET.anchors[0].tolist()),
        "tiles: ant_prox: is at the same place as left_prox: remove one of them",
    ),
    "far": (
        at("tiles", "ant_prox", "anchor", value=[0.05, 0.0, 0.60]),
        "tiles: ant_prox: is 396 mm from all others: correct its anchor, in m",
    ),
    "no pair": (
        at("neighbours", 0, value=["ant_mid", "ant_mid"]),
        "neighbours: ['ant_mid', 'ant_mid'] is not a pair: give two different tiles",
    ),
    "three neighbours": (
        at("neighbours", 0, value=["ant_mid", "ant_prox", "left_prox"]),
        "neighbours[0] is a list of 3: give a list of 2",
    ),
    "standard region": (
        at("regions", value={"anterior": ["ant_mid"]}),
        "regions: anterior is the name of a standard region: choose another",
    ),
    "no tiles": (
        at("regions", value={"heel": []}),
        "regions: heel has no tiles: write 'heel: [TILE, TILE]'",
    ),
    "tile twice": (
        at("regions", value={"heel": ["ant_mid", "ant_mid"]}),
        "regions: heel holds a tile twice: name each tile once",
    ),
    "area": (
        at("tiles", "ant_mid", "area", value=9e4),
        "tiles: ant_mid: area is 90000.0: give a number from 1e-08 to 0.05: the area [m^2]",
    ),
    "turned": (
        at("clusters", "distal", value={"tile": "post_end", "turned": 400.0}),
        "clusters: distal: turned is 400.0: give a number from -360 to 360: the angle [deg]",
    ),
    "frame": (
        first_frame,
        "tiles: ant_mid: frame is not a right-handed orthonormal frame (off by 0.01): give columns"
        " x, y, z of unit length with y = z x x",
    ),
    "few markers": (
        at("bodies", "socket", "markers", value=[[0, 0, 0], [0.1, 0, 0]]),
        "bodies: socket: markers is a list of 2: give a list of 3 to 8",
    ),
    "markers in a line": (
        at("bodies", "pylon", "markers", value=[[0, 0, 0], [0.1, 0, 0], [0.3, 0, 0]]),
        "bodies: pylon: markers: the markers are on one line: move a marker 2 mm or more away"
        " from the line",
    ),
}


@pytest.mark.parametrize("case", SOCKETS)
def test_a_socket_is_refused_with_this_line(case: str) -> None:
    change, expected = SOCKETS[case]
    document = json.loads(json.dumps(SOCKET.to_document()))
    document.setdefault("regions", {})
    change(document)
    assert line(lambda: socket_from_document(document, "socket.yaml")) == f"socket.yaml: {expected}"


def test_two_tiles_of_a_name_have_this_line(tmp_path: Path) -> None:
    names = ("ant_prox", "ant_prox", *SOCKET.names[2:])
    path = tmp_path / "socket.yaml"
    assert line(lambda: write_socket(replace(SOCKET, names=names), path)) == (
        f"{path}: two tiles would be called 'ant_prox': give the cluster another name"
    )


def test_a_missing_cluster_has_this_line() -> None:
    assert line(lambda: SOCKET.require(["heel"], "the samples")) == (
        "the cluster 'heel' of the samples is on no tile of the socket (which has brim_lateral,"
        " mid_anterior, posterior_distal, distal): give the socket.yaml of these clusters, or"
        " correct the name"
    )


def test_a_socket_s_file_explains_its_entries(tmp_path: Path) -> None:
    path = tmp_path / "socket.yaml"
    write_socket(SOCKET, path)
    assert path.read_text().splitlines()[:10] == [
        "# Geometry of the socket in the frame of the load cell, {S}. Lengths in m, areas in m^2.",
        "# frame: rows of R = [x y z], which maps the tile's frame to {S}; z is the inward normal"
        " of the",
        "# surface, x the tangent towards the proximal end, y = z x x.",
        "# source: origin of the tiles; scan: its unit [m] and the pose of its frame in {S}.",
        "# tile_share: share of the inner wall's area that the tiles cover.",
        "# clusters: the tile under each; turned: from the tile's x to the cluster's, about z"
        " [deg].",
        "# regions: your own, each a list of tiles; they may overlap.",
        "# bodies: the markers of each in its own frame; in_load_cell: the socket body's pose in"
        " {S};",
        "# limb_in_body: the limb's pose in the pylon's body, its origin being the lumped mass;",
        "# registration: origin of their registration; without it they are nominal.",
    ]
    assert read_socket(path).same_tiles(SOCKET)


TRIAD = np.array([[0.0, 0, 0], [0.08, 0, 0], [0, 0.05, 0]])
BODIES = {
    "near": (
        TRIAD * [1.0, 0.1, 1.0],
        ("markers 1 and 3 are 5.0 mm apart", "move them 10 mm apart or more"),
    ),
    "alike": (
        np.array([[0.0, 0, 0], [0.08, 0, 0], [0.04, 0.05, 0]]),
        (
            "the markers look alike with labels 1, 2 exchanged, so swapped labels cannot be found",
            "move one of them until all its distances differ by 4 mm or more",
        ),
    ),
    "good": (TRIAD, None),
}


@pytest.mark.parametrize("case", BODIES)
def test_a_body_s_fault_has_this_line(case: str) -> None:
    found, fault = BODIES[case]
    assert body_fault(found) == fault


def test_a_frame_says_how_far_it_is_off() -> None:
    rows: Any = ((1.0, 0.0, 0.0), (0.0, 1.1, 0.0), (0.0, 0.0, 1.0))
    with pytest.raises(documents.FieldError) as found:
        check_rotation(rows, "frame")
    assert found.value.args == (
        "frame is not a right-handed orthonormal frame (off by 0.2)",
        "give columns x, y, z of unit length with y = z x x",
    )
