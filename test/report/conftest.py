"""What the tests of the report share: results and pages are computed once."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from support.bags import rewrite
from support.pages import NASTY, THETAS

from socket_testbed.identification.model_file import read_model
from socket_testbed.results.report import Results, compute_results
from socket_testbed.trials.metadata import METADATA_FILE, TrialMetadata, write_metadata
from socket_testbed.trials.trial import Trial


@pytest.fixture(scope="session")
def results(hold: Path, hold_model: Path) -> Results:
    """The results of the hold, with a model that was given."""
    trial = Trial(hold)
    return compute_results(trial, "plateau", trial.estimator, THETAS, read_model(hold_model))


@pytest.fixture(scope="session")
def spoilt(hold: Path, tmp_path_factory) -> Path:
    """The hold with one cluster of a nasty name, gaps, drop-outs and an implausible channel."""
    count = 0

    def spoil(topic: str, message):
        nonlocal count
        count += topic == "/trigger"
        if 100 <= count < 108:
            return None  # a gap
        if topic == "/load_cell/wrench" and count % 20 == 0:
            message.wrench.torque.z = float("nan")
        if topic == "/clusters/capacitance":
            message.clusters = [message.clusters[3]]
            message.clusters[0].name = NASTY
            state = 2 if count % 10 == 0 else 0
            message.clusters[0].status = np.full(4, state, dtype=np.uint8)
        return message

    path = rewrite(hold, tmp_path_factory.mktemp("spoilt") / NASTY, spoil)
    for name, more in (("socket.yaml", None), ("calibration.yaml", [5e5, 0, 0, 0, 0, 0])):
        document = yaml.safe_load((path / name).read_text())
        cluster = document["clusters"]["distal"]
        document["clusters"] = {NASTY: cluster}
        if more:
            cluster["shear_x"] = more  # 450 N on a tile
        (path / name).write_text(yaml.safe_dump(document))
    write_metadata(TrialMetadata(side="left", notes=NASTY), path / METADATA_FILE)
    return path
