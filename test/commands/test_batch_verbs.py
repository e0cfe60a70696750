"""`fit` and `evaluate` on a folder of trials, as users call them."""

import json
import os
import shutil
import signal
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from distributed import LocalCluster
from support import HANGS
from support.verbs import COMMAND, call, program

import socket_testbed as st

pytestmark = pytest.mark.graph  # worker processes, interrupted and killed

GOOD = ("s01/hold", "walk")
BROKEN = "s01/broken"
VARIANT = "stiffness_bias"  # fits at once
FIT = ("fit", "--variant", VARIANT)


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two tiny simulated trials and one that is broken."""
    folder = tmp_path_factory.mktemp("batch") / "study"
    folder.mkdir()
    for seed, name in enumerate(GOOD):
        st.simulate(folder / name, duration=30, seed=seed)
    shutil.copytree(folder / GOOD[0], folder / BROKEN)
    os.truncate(folder / BROKEN / "hold.mcap", 10_000)
    return folder


@pytest.fixture(scope="module")
def one_by_one(study: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("batch") / "single"
    for name in GOOD:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        st.fit(st.open_trial(study / name), variant=VARIANT).save(folder / f"{name}.json")
    return folder


def assert_models(folder: Path, expected: Path) -> None:
    found = {p.relative_to(folder).as_posix() for p in folder.rglob("*.json")}
    names = [f"{name}.json" for name in GOOD]
    assert {name for name in found if not name.startswith(".")} == set(names)
    for name in names:
        assert (folder / name).read_bytes() == (expected / name).read_bytes(), name


def test_the_summary_holds_the_figures_of_single_calls(one_by_one, study, tmp_path, capsys):
    """In parallel, by the command itself; failed and skipped trials: test_batch.py."""
    models = tmp_path / "models"
    code, out, err = program(*COMMAND, *FIT, study, "-o", models, "--jobs", 2)
    assert code == 1 and out.count(": ok, mean moment RMSE 0.") == 2 and "Warning" not in err
    *_, named, last = err.splitlines()
    assert named.startswith(f"{BROKEN}: ") and "hold.mcap" in named and "truncated" in named
    assert last.startswith("socket-testbed fit: error: 1 of 3 trials failed")
    assert_models(models, one_by_one)
    row = pd.read_csv(models / "summary.csv").set_index("trial").loc["walk"]
    model = json.loads((models / "walk.json").read_text())
    quality = model["quality"]
    assert (row["samples"], row["theta [-]"]) == (quality["samples"], model["settings"]["theta"])
    assert f"{row['segment']} {row['segment_start [s]']:.2f} s" in model["segment"]
    for error in quality["errors"]:
        assert row[f"{error['name']}_rmse [{error['unit']}]"] == error["rmse"]
    unseen = [e.skill for e in st.fit(study / "walk", variant=VARIANT).unseen_half()]
    found = row["median_wrench_skill_unseen_half [-]"]
    assert found == pytest.approx(np.nanmedian(unseen[:6]))
    assert row["kkt_residual [-]"] < 1e-8
    st.annotate(study / "walk", mass=5.0)  # with which the data check compares the load
    _, out, _ = call(capsys, *FIT, study, "-o", models, "--jobs", 1)
    assert out.count(": ok") == 1
    st.annotate(study / "walk", remove=["mass"])


def test_trials_are_judged_by_own_models_or_all_by_one(study, one_by_one, tmp_path, capsys) -> None:
    for name, models, model in (
        ("own", one_by_one, "s01/hold"),
        ("crossed", one_by_one / "walk.json", "walk"),
    ):
        words = ["--jobs", 1, "--model", models, "-o", tmp_path / name]
        code, _, err = call(capsys, "evaluate", study, *words)
        assert code == 1 and err.count("1 of 3 trials failed") == 1
        trial = st.open_trial(study / "s01/hold")
        expected = st.evaluate(trial, one_by_one / f"{model}.json").document()
        assert expected == json.loads((tmp_path / name / "s01/hold.errors.json").read_text())
        row = pd.read_csv(tmp_path / name / "summary.csv").set_index("trial").loc["s01/hold"]
        assert row["model"] == model.rpartition("/")[2]
        assert row["in_sample"] == ("yes" if name == "own" else "no")


@pytest.mark.slow
def test_ctrl_c_leaves_what_is_finished_and_a_kill_no_worker(study, tmp_path, capsys) -> None:
    for number in range(5):  # enough to be in their midst for sure
        shutil.copytree(study / "walk", tmp_path / "study" / f"walk_{number}")
    words = ["fit", str(tmp_path / "study"), "-o", str(tmp_path / "models"), "--jobs"]
    with subprocess.Popen(
        [*COMMAND, *words, "2"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,  # a terminal sends Ctrl-C to all processes of the group
    ) as process:  # fmt: skip
        assert process.stdout is not None and process.stderr is not None
        assert ": ok" in process.stdout.readline()
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(HANGS) == 130
        assert process.stderr.read() == "socket-testbed fit: interrupted\n"
    table = pd.read_csv(tmp_path / "models" / "summary.csv").set_index("trial")
    finished = int((table["status"] == "ok").sum())
    assert 1 <= finished < 5 and set(table["status"]) == {"ok", "not reached"}
    code, out, _ = call(capsys, *words, 1)
    # What a worker had finished but not yet told, is done as well.
    assert code == 0 and finished <= out.count(": skipped") < 5
    assert out.count(": skipped") + out.count(": ok") == 5
    words[3] = str(tmp_path / "others")
    with subprocess.Popen([*COMMAND, *words, "2"], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline()
        process.kill()
        # The pipe closes when the last process that holds it has ended.
        process.communicate(timeout=HANGS)


@pytest.mark.slow
def test_a_dask_cluster_of_two_workers_takes_over(study, one_by_one, tmp_path, capsys) -> None:
    folder = tmp_path / "models"
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        words = [*FIT, study, "-o", folder, "--dask", cluster.scheduler_address]
        code, out, err = call(capsys, *words)
        assert code == 1 and out.count(": ok") == 2 and "1 of 3 trials failed" in err
    assert_models(folder, one_by_one)
