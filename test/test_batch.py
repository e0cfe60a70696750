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


def test_trials_are_found_at_any_depth_by_their_paths(study: Path) -> None:
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


def test_finished_trials_are_skipped_and_metadata_are_read_anew(study: Path, task: Task) -> None:
    assert run(study, task) == (["ok"] * 3, [f"note: {name}: cut short" for name in NAMES])
    first = (task.folder / "summary.csv").read_bytes()
    assert run(study, task)[0] == ["skipped"] * 3
    assert (task.folder / "summary.csv").read_bytes() == first
    assert (task.folder / "summary.parquet").is_file()
    assert run(study, replace(task, again=True))[0] == ["ok"] * 3
    (study / "walk" / "trial.yaml").write_text('subject: "007"\nmass: 70\n')
    assert run(study, task)[0] == ["skipped"] * 3
    assert table_of(task)["subject"].dropna().to_dict() == {"walk": "007"}
    assert table_of(task)["mass [kg]"].dropna().to_dict() == {"walk": 70.0}


def test_a_trial_is_done_again_when_anything_changed(study: Path, task: Task) -> None:
    task = replace(task, metadata=("mass",))
    trial, output = study / "walk", task.folder / "walk.json"
    older = make_trial(study / ".older" / "walk", "old")
    run(study, task)
    for change in (
        lambda: (trial / "walk.mcap").write_text("MESSAGES of walk"),  # of the same size
        lambda: (trial / "trial.yaml").write_text("mass: 71\nsubject: A"),
        output.unlink,
        lambda: (shutil.rmtree(trial), older.rename(trial)),  # an older one
    ):
        change()
        assert run(study, task)[0] == ["skipped", "skipped", "ok"]
        assert output.read_text() == (trial / "walk.mcap").read_text()
    file = study / "calibration.yaml"  # overrides and settings concern all trials
    for change in (lambda: file.write_text("1"), lambda: file.write_text("22"), file.unlink):
        change()
        assert run(study, task)[0] == ["ok"] * 3
    assert run(study, replace(task, settings={"theta": 0.7}))[0] == ["ok"] * 3


def test_one_that_fails_stops_no_other_and_leaves_no_older_result(study: Path, task: Task) -> None:
    task.folder.mkdir()
    for content in ("of somebody", "of somebody again"):  # before there was ours, and after
        (task.folder / "walk.json").write_text(content)
        with pytest.raises(TrialError, match="1 of 3 trials failed"):
            run(study, task)
        assert (task.folder / "walk.json").read_text() == content
        assert "exists already" in table_of(task)["error"]["walk"]
        assert run(study, replace(task, replace=True))[0] == ["skipped", "skipped", "ok"]
    (study / "s01" / "hold" / "hold.mcap").write_text("wrong")
    (study / "s02" / "hold" / "hold.mcap").write_text("bug")
    with pytest.raises(TrialError, match="2 of 3 trials failed"):
        run(study, task)
    assert not (task.folder / "s01" / "hold.json").exists()
    table = table_of(task)
    assert table["status"].tolist() == ["failed", "failed", "ok"]
    assert table["error"]["s01/hold"] == f"{study}/s01/hold: is wrong: record it again"
    assert "unexpected ZeroDivisionError: oh no" in table["error"]["s02/hold"]


def test_the_summary_of_another_verb_is_replaced_on_request_alone(study: Path, task: Task) -> None:
    other = replace(task, verb="other", replace=True)
    run(study, task)
    run(study, other)
    for again in (task, replace(other, replace=False)):
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
def test_a_worker_that_dies_costs_its_own_trial_only(study: Path, task: Task) -> None:
    (study / "s02" / "hold" / "hold.mcap").write_text("deadly")
    with pytest.raises(TrialError, match="1 of 3 trials failed"):
        run(study, task, processes=2)
    assert table_of(task)["status"].tolist() == ["ok", "failed", "ok"]
    assert "its worker failed" in table_of(task)["error"]["s02/hold"]
