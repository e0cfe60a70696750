"""Many trials: found, done once, done again when anything changed, and none stops the others.

The trials here are folders with some bytes, and the work counts them: what is tested is when it
is done, not what.
"""

import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from support.batches import count, make_trial, own_column

from socket_testbed import batch
from socket_testbed.batch import (
    Job,
    JobStatus,
    Pool,
    Row,
    Task,
    execute,
    find_trials,
    plan_jobs,
    record_path,
    run_batch,
)
from socket_testbed.errors import ConfigurationError, TestbedError, TrialError

HERE = Pool(jobs=1)


@pytest.fixture
def study(tmp_path: Path) -> Path:
    folder = tmp_path / "study"
    for name in ("s02/hold", "s01/hold", "walk"):
        make_trial(folder / name, f"messages of {name}")
    return folder


@pytest.fixture
def task(tmp_path: Path) -> Task:
    return Task("count", tmp_path / "out", count, {"theta": 0.5})


def jobs_of(study: Path, task: Task, **files: Path) -> list[Job]:
    given = {f"--{name}": path for name, path in files.items()}
    return plan_jobs(find_trials(study), task.folder, ".json", given)


class Heard(list[str]):
    """Lines that were told."""

    def __call__(self, line: str) -> None:
        self.append(line)


def run(study: Path, task: Task, pool: Pool = HERE) -> tuple[list[str], Heard, Heard]:
    told, warned = Heard(), Heard()
    outcomes = run_batch(task, jobs_of(study, task), pool, told, warned)
    return [outcome.status.value for outcome in outcomes], told, warned


def test_trials_are_found_at_any_depth_by_their_paths(study: Path) -> None:
    make_trial(study / ".hidden" / "hold")
    make_trial(study / "walk" / "inner")
    (study / "notes").mkdir()
    (study / "s01" / "again").symlink_to(study / "s02")
    (study / "s02" / "loop").symlink_to(study)
    names = list(find_trials(study))
    assert names == sorted(names)
    # What is reached by a link has the link's name; a loop ends.
    assert {"s01/hold", "s02/hold", "walk", "s01/again/hold"} <= set(names)
    assert not any("hidden" in name or "inner" in name for name in names)
    assert len(names) < 20


def test_a_trial_and_no_folder_hold_no_trials(study: Path) -> None:
    assert find_trials(study / "walk") == {}
    assert find_trials(study / "walk" / "walk.mcap") == {}
    assert find_trials(study / "nowhere") == {}


def test_a_bag_without_metadata_or_without_storage_is_a_trial(study: Path) -> None:
    (study / "walk" / "metadata.yaml").unlink()
    (study / "s01" / "hold" / "hold.mcap").unlink()
    assert list(find_trials(study)) == ["s01/hold", "s02/hold", "walk"]


def test_trials_that_hold_nothing_are_passed_over_by_name(study: Path) -> None:
    for name in ("s01/hold", "walk"):
        shutil.copytree(study / name, study / f"{name}_2")
        (study / f"{name}_2" / "metadata.yaml").unlink()
        (study / f"{name}_2" / f"{Path(name).name}.mcap").write_bytes(b"")
    (study / "s02" / "hold" / "hold.mcap").write_bytes(b"")  # but its metadata.yaml lists more
    notes = Heard()
    assert list(find_trials(study, notes)) == ["s01/hold", "s02/hold", "walk"]
    assert [note.split()[0] for note in notes] == ["s01/hold_2", "walk_2"]
    assert all("holds nothing" in note for note in notes)


def test_what_is_done_is_skipped_and_the_summary_stays(study: Path, task: Task) -> None:
    first = run(study, task)
    table = (task.folder / "summary.csv").read_bytes()
    again = run(study, task)
    assert (first[0], again[0]) == (["ok"] * 3, ["skipped"] * 3)
    assert (task.folder / "summary.csv").read_bytes() == table
    assert first[2] == [f"note: {name}: cut short" for name in find_trials(study)] == again[2]
    forced = run(study, replace(task, again=True))
    assert forced[0] == ["ok"] * 3


def test_metadata_show_up_without_a_result_being_made_again(study: Path, task: Task) -> None:
    run(study, task)
    summary = task.folder / "summary.csv"
    assert pd.read_csv(summary)["subject"].isna().all()
    (study / "walk" / "trial.yaml").write_text('subject: "007"\nmass: 70\n')
    (study / "s02" / "hold" / "trial.yaml").write_text("side: lft")
    again, _, warned = run(study, task)
    assert again == ["skipped"] * 3
    assert any("s02/hold" in line and "did you mean 'left'" in line for line in warned)
    table = pd.read_csv(summary, dtype={"subject": str}).set_index("trial")
    assert table["subject"].dropna().to_dict() == {"walk": "007"}
    assert table["mass [kg]"].dropna().to_dict() == {"walk": 70.0}
    assert pd.read_parquet(task.folder / "summary.parquet")["subject"].tolist()[2] == "007"
    # A result that shows the metadata is another matter.
    shown = replace(task, metadata=("side", "mass"))
    assert run(study, shown)[0] == ["ok"] * 3
    (study / "walk" / "trial.yaml").write_text('subject: "008"\nmass: 70\n')
    assert run(study, shown)[0] == ["skipped"] * 3
    (study / "walk" / "trial.yaml").write_text('subject: "008"\nmass: 71\n')
    statuses, told, _ = run(study, shown)
    assert statuses == ["skipped", "skipped", "ok"]
    assert any("walk: ok again (changed: metadata mass)" in line for line in told)


def change_trial(study: Path, task: Task, job: Job) -> tuple[Task, Job]:
    file = job.trial.path / "hold.mcap"
    times = file.stat()
    file.write_text("other messages")
    os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))  # as a copy with its old date
    return task, job


def add_to_trial(study: Path, task: Task, job: Job) -> tuple[Task, Job]:
    (job.trial.path / "testbed.yaml").write_text("estimator_node: {}")
    return task, job


def change_setting(study: Path, task: Task, job: Job) -> tuple[Task, Job]:
    return replace(task, settings={"theta": 0.7}), job


def change_calibration(study: Path, task: Task, job: Job) -> tuple[Task, Job]:
    (study / "calibration.yaml").write_text("other coefficients")
    return task, job


def drop_calibration(study: Path, task: Task, job: Job) -> tuple[Task, Job]:
    return task, jobs_of(study, task)[0]


def spoil_output(study: Path, task: Task, job: Job) -> tuple[Task, Job]:
    job.output.write_text("another model")
    return task, job


def remove_output(study: Path, task: Task, job: Job) -> tuple[Task, Job]:
    job.output.unlink()
    return task, job


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (change_trial, ("trial/hold.mcap",)),
        (add_to_trial, ("trial/testbed.yaml",)),
        (change_setting, ("setting theta",)),
        (change_calibration, ("--calibration",)),
        (drop_calibration, ("--calibration",)),
        (spoil_output, ("the output",)),
        (remove_output, ("the output",)),
    ],
)
def test_whatever_changed_is_named_and_the_work_done_again(change, named, study, task) -> None:
    (study / "calibration.yaml").write_text("coefficients")
    job = jobs_of(study, task, calibration=study / "calibration.yaml")[0]
    assert execute(task, job).status is JobStatus.OK
    assert execute(task, job).status is JobStatus.SKIPPED
    changed_task, changed_job = change(study, task, job)
    outcome = execute(changed_task, changed_job)
    assert (outcome.status, outcome.changed) == (JobStatus.OK, named)
    assert changed_job.output.read_text() == (job.trial.path / "hold.mcap").read_text()
    assert execute(changed_task, changed_job).status is JobStatus.SKIPPED


def test_another_version_of_the_software_does_it_again(study, task, monkeypatch) -> None:
    job = jobs_of(study, task)[0]
    software = {**batch._software()}
    assert len(software["socket_testbed"]) == 64
    execute(task, job)
    monkeypatch.setattr(batch, "_software", lambda: {**software, "scipy": "0.1"})
    assert execute(task, job).changed == ("scipy",)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"inputs": {}}'])
def test_a_torn_record_is_none(text: str, study: Path, task: Task) -> None:
    job = jobs_of(study, task)[0]
    execute(task, job)
    record_path(task, job).write_text(text)
    assert execute(task, job).status is JobStatus.OK
    assert execute(task, job).status is JobStatus.SKIPPED


def test_an_older_result_does_not_pass_for_one_that_failed(study: Path, task: Task) -> None:
    job = jobs_of(study, task)[0]
    execute(task, job)
    (job.trial.path / "hold.mcap").write_text("wrong")
    for _ in range(2):
        assert execute(task, job).status is JobStatus.FAILED
        assert not job.output.exists()


def test_one_that_fails_does_not_stop_the_others(study: Path, task: Task) -> None:
    (study / "s01" / "hold" / "hold.mcap").write_text("wrong")
    (study / "s02" / "hold" / "hold.mcap").write_text("bug")
    told, warned = Heard(), Heard()
    with pytest.raises(TrialError, match="2 of 3 trials failed"):
        run_batch(task, jobs_of(study, task), HERE, told, warned)
    assert len(told) == 4 and told[2].startswith("[3/3] walk: ok")
    assert warned[1:] == [
        f"s01/hold: {study}/s01/hold: is wrong: record it again",
        f"s02/hold: {study}/s02/hold: unexpected ZeroDivisionError: oh no: run 'count' on this"
        " trial alone and report what it says",
    ]
    table = pd.read_csv(task.folder / "summary.csv")
    assert table["status"].tolist() == ["failed", "failed", "ok"]
    assert table["error"].notna().tolist() == [True, True, False]
    assert table["size [byte]"].tolist()[2] == len("messages of walk")


def test_an_interruption_keeps_what_is_finished(study: Path, task: Task) -> None:
    (study / "s02" / "hold" / "hold.mcap").write_text("stop")
    with pytest.raises(KeyboardInterrupt):
        run(study, task)
    table = pd.read_csv(task.folder / "summary.csv")
    assert table["status"].tolist() == ["ok", "not reached", "not reached"]
    (study / "s02" / "hold" / "hold.mcap").write_text("messages")
    assert run(study, task)[0] == ["skipped", "ok", "ok"]


def test_an_interruption_after_an_output_leaves_nothing_to_replace(study, task) -> None:
    def write_and_stop(job: Job) -> Row:
        count(job)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(study, replace(task, work=write_and_stop))
    assert run(study, task)[0] == ["ok"] * 3


def test_an_interruption_before_anything_leaves_the_older_summary(study, task) -> None:
    run(study, task)
    table = (task.folder / "summary.csv").read_bytes()
    (study / "s01" / "hold" / "hold.mcap").write_text("stop")
    with pytest.raises(KeyboardInterrupt):
        run(study, task)
    assert (task.folder / "summary.csv").read_bytes() == table


@pytest.mark.slow
def test_a_worker_that_dies_costs_its_own_trial_only(study: Path, task: Task) -> None:
    (study / "s02" / "hold" / "hold.mcap").write_text("deadly")
    with pytest.raises(TrialError, match="1 of 3 trials failed"):
        run(study, task, Pool(jobs=2))
    table = pd.read_csv(task.folder / "summary.csv")
    assert table["status"].tolist() == ["ok", "failed", "ok"]
    assert "its worker failed" in table["error"][1] and "\n" not in table["error"][1]


def test_files_that_it_did_not_write_stay_unless_they_are_to_be_replaced(study, task) -> None:
    task.folder.mkdir()
    (task.folder / "walk.json").write_text("of somebody")
    with pytest.raises(TrialError, match="1 of 3 trials failed"):
        run(study, task)
    assert (task.folder / "walk.json").read_text() == "of somebody"
    table = pd.read_csv(task.folder / "summary.csv")
    assert "exists already" in table["error"].dropna().item()
    assert run(study, replace(task, replace=True))[0] == ["skipped", "skipped", "ok"]
    shutil.rmtree(task.folder / ".done")
    with pytest.raises(ConfigurationError, match=r"summary.csv exists already"):
        run(study, task)


def test_a_second_run_on_a_folder_is_refused_while_the_first_works(study, task) -> None:
    def meanwhile(line: str) -> None:
        if line.startswith("["):
            with pytest.raises(ConfigurationError, match="another run of 'count' works on"):
                run(study, task)

    run_batch(task, jobs_of(study, task)[:1], HERE, meanwhile, Heard())
    assert run(study, task)[0] == ["skipped", "ok", "ok"]


def test_the_folder_of_another_verb_or_a_file_is_refused(study: Path, task: Task) -> None:
    run(study, task)
    with pytest.raises(ConfigurationError, match="holds what 'count' wrote"):
        run(study, replace(task, verb="fit"))
    shutil.rmtree(task.folder)
    task.folder.write_text("")
    with pytest.raises(ConfigurationError, match="is not a folder"):
        run(study, task)


def test_tables_of_trials_with_other_columns_become_one(study: Path, task: Task) -> None:
    mixed = replace(task, work=own_column)
    run(study, mixed)
    table = pd.read_parquet(task.folder / "summary.parquet")
    assert list(table.columns)[:3] == ["trial", "status", "error"]
    own = [f"{name}_rmse [N]" for name in find_trials(study)]
    assert set(own) <= set(table.columns)
    values = table.set_index("trial")[own]
    assert values.notna().to_numpy().tolist() == [
        [row == column for column in range(3)] for row in range(3)
    ]


def test_an_unreachable_or_missing_dask_is_one_line(study, task, monkeypatch) -> None:
    pool = Pool(dask="tcp://127.0.0.1:1")
    monkeypatch.setattr("socket_testbed.batch._PATIENCE", "100ms")
    with pytest.raises(TestbedError, match="no scheduler with a worker answers"):
        run(study, task, pool)
    with pytest.raises(TestbedError, match="no scheduler with a worker answers"):
        run(study, task, Pool(dask="nonsense://"))
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(TestbedError, match="Dask is not installed"):
        run(study, task, pool)
    assert not (task.folder / "summary.csv").exists()
