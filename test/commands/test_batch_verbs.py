"""`fit` and `evaluate` on a folder of trials, as users call them."""

import json
import os
import shutil
import signal
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
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


# --- the command itself, in parallel; failed and skipped trials: test_batch.py


@dataclass
class Parallel:
    """Models that the command fitted in two processes, and what it printed."""

    models: Path
    code: int
    out: str
    err: str


@pytest.fixture(scope="module")
def parallel(study: Path, tmp_path_factory: pytest.TempPathFactory) -> Parallel:
    models = tmp_path_factory.mktemp("batch") / "models"
    return Parallel(models, *program(*COMMAND, *FIT, study, "-o", models, "--jobs", 2))


def test_each_finished_trial_is_a_line(parallel: Parallel) -> None:
    assert parallel.out.count(": ok, mean moment RMSE 0.") == 2 and "Warning" not in parallel.err


def test_failed_trials_are_named_last(parallel: Parallel) -> None:
    *_, named, last = parallel.err.splitlines()
    assert named.startswith(f"{BROKEN}: ") and "hold.mcap" in named and "truncated" in named
    assert last.startswith("socket-testbed fit: error: 1 of 3 trials failed")
    assert parallel.code == 1


def test_models_are_those_of_single_calls(parallel: Parallel, one_by_one: Path) -> None:
    assert_models(parallel.models, one_by_one)


@pytest.fixture
def row(parallel: Parallel) -> pd.Series:
    """What the summary says of a trial."""
    return pd.read_csv(parallel.models / "summary.csv").set_index("trial").loc["walk"]


def test_the_summary_holds_the_model_s_figures(parallel: Parallel, row: pd.Series) -> None:
    model = json.loads((parallel.models / "walk.json").read_text())
    quality = model["quality"]
    assert (row["samples"], row["theta [-]"]) == (quality["samples"], model["settings"]["theta"])
    assert f"{row['segment']} {row['segment_start [s]']:.2f} s" in model["segment"]
    for error in quality["errors"]:
        assert row[f"{error['name']}_rmse [{error['unit']}]"] == error["rmse"]
    assert row["kkt_residual [-]"] < 1e-8


def test_the_summary_holds_skills_on_the_unseen_half(study: Path, row: pd.Series) -> None:
    unseen = [e.skill for e in st.fit(study / "walk", variant=VARIANT).unseen_half()]
    found = row["median_wrench_skill_unseen_half [-]"]
    assert found == pytest.approx(np.nanmedian(unseen[:6]))


def test_another_body_mass_is_fitted_again(
    parallel: Parallel, study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The data check compares the load with it."""
    models = shutil.copytree(parallel.models, tmp_path / "models")
    st.annotate(study / "walk", mass=5.0)
    _, out, _ = call(capsys, *FIT, study, "-o", models, "--jobs", 1)
    st.annotate(study / "walk", remove=["mass"])
    assert out.count(": ok") == 1


@pytest.mark.parametrize(
    ("kind", "model", "in_sample"),
    [("own", "s01/hold", "yes"), ("crossed", "walk", "no")],
    ids=["own", "crossed"],
)
def test_trials_are_judged_by_the_given_models(
    kind: str, model: str, in_sample: str, study: Path, one_by_one: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Each by its own of a folder, or all by one."""
    models = one_by_one if kind == "own" else one_by_one / f"{model}.json"
    words = ["--jobs", 1, "--model", models, "-o", tmp_path / kind]
    code, _, err = call(capsys, "evaluate", study, *words)
    assert code == 1 and err.count("1 of 3 trials failed") == 1
    trial = st.open_trial(study / "s01/hold")
    expected = st.evaluate(trial, one_by_one / f"{model}.json").document()
    assert expected == json.loads((tmp_path / kind / "s01/hold.errors.json").read_text())
    row = pd.read_csv(tmp_path / kind / "summary.csv").set_index("trial").loc["s01/hold"]
    assert row["model"] == model.rpartition("/")[2]
    assert row["in_sample"] == in_sample


@pytest.fixture
def many(study: Path, tmp_path: Path) -> Path:
    """Enough trials to be in their midst for sure."""
    for number in range(5):
        shutil.copytree(study / "walk", tmp_path / "study" / f"walk_{number}")
    return tmp_path / "study"


@pytest.mark.slow
def test_ctrl_c_leaves_what_is_finished(
    many: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["fit", str(many), "-o", str(tmp_path / "models"), "--jobs"]
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


@pytest.mark.slow
def test_a_kill_leaves_no_worker(many: Path, tmp_path: Path) -> None:
    words = ["fit", str(many), "-o", str(tmp_path / "models"), "--jobs", "2"]
    with subprocess.Popen([*COMMAND, *words], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline()
        process.kill()
        # The pipe closes when the last process that holds it has ended.
        process.communicate(timeout=HANGS)


@pytest.mark.slow
def test_a_dask_cluster_of_two_workers_takes_over(study, one_by_one, tmp_path, capsys) -> None:
    from distributed import LocalCluster

    folder = tmp_path / "models"
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        words = [*FIT, study, "-o", folder, "--dask", cluster.scheduler_address]
        code, out, err = call(capsys, *words)
        assert code == 1 and out.count(": ok") == 2 and "1 of 3 trials failed" in err
    assert_models(folder, one_by_one)
