"""Made-up trials and the work on them, which a worker process imports in no time."""

import json
import os
from pathlib import Path

from socket_testbed.batch import Job, Row
from socket_testbed.errors import TrialError


def make_trial(path: Path, content: str = "messages") -> Path:
    path.mkdir(parents=True)
    (path / "metadata.yaml").write_text("rosbag2")
    (path / f"{path.name}.mcap").write_text(content)
    return path


def count(job: Job) -> Row:
    """The work: the size of the trial, or the failure that its content asks for."""
    content = (job.trial.path / f"{job.trial.name}.mcap").read_text()
    if content == "wrong":
        raise TrialError(f"{job.trial.path}: is wrong", "record it again")
    if content == "bug":
        raise ZeroDivisionError("oh\nno")
    if content == "stop":
        raise KeyboardInterrupt
    if content == "deadly":
        os._exit(1)
    assert job.trial.notify is not None
    job.trial.notify("cut short")
    job.output.parent.mkdir(parents=True, exist_ok=True)
    job.output.write_text(content)
    return {"size [byte]": len(content)}


def own_column(job: Job) -> Row:
    """The work: a column that no other trial has, and one without any value."""
    job.output.parent.mkdir(parents=True, exist_ok=True)
    job.output.write_text(json.dumps(job.name))
    return {f"{job.name}_rmse [N]": 0.1, "constant_skill [-]": None}
