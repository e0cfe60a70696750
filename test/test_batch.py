"""Many trials, here folders of bytes: found, done once or when changed, and none stops another."""

import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from support.batches import count

from socket_testbed.batch import Job, Row, Task, plan_jobs, run_batch
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.trials.bag import find_trials
from socket_testbed.trials.trial import Trial


def make_trial(path: Path, content: str = "messages") -> Path:
    path.mkdir(parents=True)
    (path / "metadata.yaml").write_text("rosbag2")
    (path / f"{path.name}.mcap").write_text(content)
    return path


NAMES = ["s01/hold", "s02/hold", "walk"]


@pytest.fixture
def study(tmp_path: Path) -> Path:
    for name in NAMES:
        make_trial(tmp_path / "study" / name, f"messages of {name}")
    return tmp_path / "study"


@pytest.fixture
def task(tmp_path: Path) -> Task:
    return Task("count", tmp_path / "out", count, {"theta": 0.5})


def run(study: Path, task: Task, processes: int = 1, **more: object) -> tuple[list[str], list[str]]:
    """States of the trials as they are printed, and warnings."""
    files = {"calibration": file} if (file := study / "calibration.yaml").exists() else {}
    trials = {name: Trial(path) for name, path in find_trials(study).items()}
    jobs = plan_jobs(trials, task.folder, ".json", files)
    lines, warned = [], []
    try:
        run_batch(task, jobs, lines.append, warned.append, processes, **more)
    finally:
        states = [line.split("] ")[1] for line in lines if line.startswith("[")]
    return [state.split(": ")[1] for state in sorted(states)], warned


def table_of(task: Task) -> pd.DataFrame:
    return pd.read_csv(task.folder / "summary.csv", dtype={"subject": str}).set_index("trial")


def test_trials_are_found_at_any_depth(study: Path) -> None:
    make_trial(study / ".hidden" / "hold")
    make_trial(study / "walk" / "inner")
    (study / "walk" / "metadata.yaml").unlink()  # a broken bag is a trial all the same
    (study / "s02" / "loop").symlink_to(study)
    empty = shutil.copytree(study / "s01/hold", study / "walk_2")
    (empty / "metadata.yaml").unlink()
    (empty / "hold.mcap").write_bytes(b"")
    notes: list[str] = []
    names = list(find_trials(study, notes.append))
    assert names == sorted(names) and len(names) < 20
    assert {*NAMES} <= set(names)
    assert not any(part in name for name in names for part in ("hidden", "inner", "walk_2"))
    assert notes[0].startswith("walk_2 is left out")
    assert find_trials(study / "walk") == find_trials(study / "nowhere") == {}


def test_finished_trials_are_skipped(study: Path, task: Task) -> None:
    assert run(study, task) == (["ok"] * 3, [f"note: {name}: cut short" for name in NAMES])
    first = (task.folder / "summary.csv").read_bytes()
    assert run(study, task)[0] == ["skipped"] * 3
    assert (task.folder / "summary.csv").read_bytes() == first
    assert (task.folder / "summary.parquet").is_file()
    assert run(study, replace(task, again=True))[0] == ["ok"] * 3


def test_metadata_of_skipped_trials_are_read_anew(study: Path, task: Task) -> None:
    run(study, task)
    (study / "walk" / "trial.yaml").write_text('subject: "007"\nmass: 70\n')
    assert run(study, task)[0] == ["skipped"] * 3
    assert table_of(task)["subject"].dropna().to_dict() == {"walk": "007"}
    assert table_of(task)["mass [kg]"].dropna().to_dict() == {"walk": 70.0}


def put_in_an_older_one(trial: Path, output: Path) -> None:
    shutil.rmtree(trial)
    (trial.parent / ".older" / "walk").rename(trial)


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(
            lambda trial, output: (trial / "walk.mcap").write_text("MESSAGES of walk"),
            id="of-the-same-size",
        ),
        pytest.param(
            lambda trial, output: (trial / "trial.yaml").write_text("mass: 71\nsubject: A"),
            id="metadata",
        ),
        pytest.param(lambda trial, output: output.unlink(), id="output-removed"),
        pytest.param(put_in_an_older_one, id="an-older-one"),
    ],
)
def test_a_trial_is_done_again_when_changed(study: Path, task: Task, change) -> None:
    task = replace(task, metadata=("mass",))
    trial, output = study / "walk", task.folder / "walk.json"
    make_trial(study / ".older" / "walk", "old")
    run(study, task)
    change(trial, output)
    assert run(study, task)[0] == ["skipped", "skipped", "ok"]
    assert output.read_text() == (trial / "walk.mcap").read_text()


def test_every_trial_is_done_with_other_overrides(study: Path, task: Task) -> None:
    run(study, task)
    file = study / "calibration.yaml"
    file.write_text("1")
    assert run(study, task)[0] == ["ok"] * 3
    file.write_text("22")
    assert run(study, task)[0] == ["ok"] * 3
    file.unlink()
    assert run(study, task)[0] == ["ok"] * 3


def test_every_trial_is_done_with_other_settings(study: Path, task: Task) -> None:
    run(study, task)
    assert run(study, replace(task, settings={"theta": 0.7}))[0] == ["ok"] * 3


@pytest.mark.parametrize("with_ours", [False, True], ids=["before-ours", "after-ours"])
def test_somebody_s_file_is_replaced_on_request(study: Path, task: Task, with_ours: bool) -> None:
    task.folder.mkdir()
    if with_ours:
        run(study, task)
    (task.folder / "walk.json").write_text("of somebody")
    with pytest.raises(TrialError, match="1 of 3 trials failed"):
        run(study, task)
    assert (task.folder / "walk.json").read_text() == "of somebody"
    assert "exists already" in table_of(task)["error"]["walk"]
    assert run(study, replace(task, replace=True))[0] == ["skipped", "skipped", "ok"]


def test_one_that_fails_stops_no_other(study: Path, task: Task) -> None:
    """And leaves no older result."""
    run(study, task)
    (study / "s01" / "hold" / "hold.mcap").write_text("wrong")
    (study / "s02" / "hold" / "hold.mcap").write_text("bug")
    with pytest.raises(TrialError, match="2 of 3 trials failed"):
        run(study, task)
    assert not (task.folder / "s01" / "hold.json").exists()
    table = table_of(task)
    assert table["status"].tolist() == ["failed", "failed", "ok"]
    assert table["error"]["s01/hold"] == f"{study}/s01/hold: is wrong: record it again"
    assert "unexpected ZeroDivisionError: oh no" in table["error"]["s02/hold"]


@pytest.mark.parametrize("verb", ["count", "other"])
def test_another_verb_s_summary_stays(study: Path, task: Task, verb: str) -> None:
    """Unless it is to be replaced."""
    other = replace(task, verb="other", replace=True)
    run(study, task)
    run(study, other)
    again = task if verb == "count" else replace(other, replace=False)
    with pytest.raises(ConfigurationError, match=r"summary\.csv exists already"):
        run(study, again)


def written_and_interrupted(job: Job) -> Row:
    count(job)
    raise KeyboardInterrupt


def test_an_interruption_keeps_complete_results(study: Path, task: Task) -> None:
    mcap = study / "s02" / "hold" / "hold.mcap"
    mcap.write_text("stop")
    with pytest.raises(KeyboardInterrupt):
        run(study, task)
    assert table_of(task)["status"].tolist() == ["ok", "not reached", "not reached"]
    mcap.write_text("messages")
    with pytest.raises(KeyboardInterrupt):  # an output without its record is ours all the same
        run(study, replace(task, work=written_and_interrupted))
    assert run(study, task)[0] == ["skipped", "ok", "ok"]


@pytest.mark.slow
def test_a_dead_worker_costs_its_own_trial(study: Path, task: Task) -> None:
    (study / "s02" / "hold" / "hold.mcap").write_text("deadly")
    with pytest.raises(TrialError, match="1 of 3 trials failed"):
        run(study, task, processes=2)
    assert table_of(task)["status"].tolist() == ["ok", "failed", "ok"]
    assert "its worker failed" in table_of(task)["error"]["s02/hold"]
