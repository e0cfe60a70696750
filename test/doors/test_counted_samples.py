"""The number of samples that a result is of: those in the objective, or with a wrench and a pose.

The scene of 96 samples lacks the limb position in six of them, the wrench in another.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import results_by_hand, scene
from support.wording import refused

import socket_testbed as st
from socket_testbed import api
from socket_testbed.commands import results
from socket_testbed.errors import IdentificationError
from socket_testbed.identification.channel_errors import evaluate
from socket_testbed.results import tradeoff
from socket_testbed.samples import Samples
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial


@pytest.fixture(scope="module")
def lacking(scene_folder: Path) -> Trial:
    """The scene with some poses and a wrench missing."""
    trial = Trial(scene_folder)
    measured, samples = trial.measurements_and_samples()
    position, wrench = samples.position.copy(), samples.wrench.copy()
    position[10:16] = np.nan
    wrench[20, 5] = np.nan
    trial._kept.read = measured, replace(samples, position=position, wrench=wrench)
    return trial


def test_the_paper_counts_samples_of_the_objective(
    lacking: Trial, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fit(trial: Trial, segment: Segment, samples: Samples, settings: Any) -> api.TrialFit:
        used = samples[samples.has_pose_and_wrench]
        made = results_by_hand.fit_by_hand(used, trial.geometry, settings)
        made = replace(made, errors=evaluate(used, made.model))
        return api.TrialFit(trial, segment, made)

    monkeypatch.setattr(tradeoff, "fit_segment", fit)
    monkeypatch.setattr(tradeoff, "pareto_front", results_by_hand.fronts_by_hand)
    found = st.paper(lacking, "all")
    assert found.samples == found.document()["samples"] == 89
    remark = found.table.loc["RMSE of Mx [N m]", ("", "remark")]
    assert remark.endswith("; 96 samples, 1000 in the paper") and "4.00 Hz" not in remark
    half = st.paper(lacking, "0:11.75").table.loc["RMSE of Mx [N m]", ("", "remark")]
    assert half.endswith("; 48 samples, 1000 in the paper")
    results._show_paper(found)
    assert capsys.readouterr().out.startswith("scene: all 0.00 s to 23.75 s, 89 samples\n")


@pytest.mark.parametrize(
    ("segment", "count"),
    [("all", 89), ("0:2.25", 10), ("2:6", 10)],
    ids=["all", "complete", "some"],
)
def test_an_evaluation_counts_poses_with_a_wrench(
    segment: str, count: int, lacking: Trial, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = st.evaluate(lacking, scene.model(tmp_path / "model.json"), segment)
    assert found.samples == found.document()["samples"] == count
    results._show_evaluation(found, {})
    assert capsys.readouterr().out.splitlines()[0].endswith(f", {count} samples")
    assert results._evaluation_row(found)["samples"] == count


def test_an_evaluation_without_a_pose_is_refused(lacking: Trial, tmp_path: Path) -> None:
    with refused(IdentificationError, "none of the 6 samples has a limb position"):
        st.evaluate(lacking, scene.model(tmp_path / "model.json"), "2.5:3.75")
