"""Errors of a model that is known by hand, on the scene, wherever they are shown.

The model predicts constants, so its residuals are the measured swings plus an offset. A swing of
amplitude a has the rms a / sqrt(2) and the mean magnitude 0.636 a. Mx swings by 0.5 N m and, at a
lever of 0.15 m, with Fy by 1.5 N m: sqrt(0.125 + 1.125) = 1.118. My has the same and an offset of
1 N m: sqrt(2.25) = 1.5. Fz swings by 30 N with an offset of -40 N. Clusters without an offset are
off by their whole force, 1.06066 times its mean in the rms, with a sigma of 0.35355 times it.
"""

import io
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from rclpy.serialization import deserialize_message
from socket_testbed_msgs.msg import ContactModel
from support import scene

import socket_testbed as st
from socket_testbed.__main__ import run
from socket_testbed.identification.model_file import read_model
from socket_testbed.wire import messages

# unit, RMSE, MAE, sigma, skill, in the objective
ERRORS = {
    "Mx": ("N m", 1.1180, None, 1.1180, 0.0, True),
    "My": ("N m", 1.5, None, 1.1180, -0.34164, True),
    "Mz": ("N m", 0.21213, 0.19092, 0.21213, 0.0, True),
    "Fx": ("N", 7.0711, 6.3571, 7.0711, 0.0, True),
    "Fz": ("N", 45.2769, 40.0, 21.2132, -1.1344, True),
    "brim_lateral.Fz": ("N", 28.6378, 27.0, 9.5459, -2.0, True),
    "mid_anterior.Fz": ("N", 12.7279, 11.4551, 12.7279, 0.0, True),
    "posterior_distal.Fy": ("N", 11.4551, 10.8, 3.8184, -2.0, True),
    "distal.Fx": ("N", 1.9092, 1.8, 0.6364, -2.0, False),
}
KEYS = ("unit", "rmse", "mae", "sigma", "skill", "in_objective")
TITLES = ("unit", "RMSE", "MAE", "sigma", "skill", "in objective")
# mean of Mx, My, Mz; of Fx, Fy, Fz; the middle one of 11 local channels, in rising order 0.955,
# 0.955, 1.273, 4.773, 5.728, 7.637, 11.455, 12.728, 13.364, 23.865, 28.638
QUOTED = {
    "mean_moment_rmse [N m]": 0.94339,
    "mean_force_rmse [N]": 19.8064,
    "median_local_rmse [N]": 7.6368,
}


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return scene.model(tmp_path_factory.mktemp("models") / "model.json")


@pytest.fixture(scope="module")
def found(trial, model: Path) -> Any:
    return st.evaluate(trial, model, "all")


def check(row: dict[str, Any], names: tuple[str, ...], channel: str) -> None:
    for name, answer in zip(names, ERRORS[channel], strict=True):
        if isinstance(answer, float):
            assert row[name] == pytest.approx(answer, rel=1e-4, abs=1e-9), name
        elif answer is not None:
            assert row[name] == answer, name


@pytest.mark.parametrize("channel", ERRORS)
def test_the_table_holds_the_known_errors(channel: str, found: Any) -> None:
    check(found.to_dataframe().loc[channel].to_dict(), TITLES, channel)


@pytest.mark.parametrize("channel", ERRORS)
def test_the_document_holds_the_known_errors(channel: str, found: Any) -> None:
    rows = {row["name"]: row for row in found.document()["channels"]}
    check(rows[channel], KEYS, channel)


def test_the_document_quotes_the_paper_s_figures(found: Any) -> None:
    assert found.document()["in_objective"] == pytest.approx(QUOTED, rel=1e-4)


def test_the_verb_writes_the_same_document(
    scene_folder: Path, model: Path, by_hand: None, found: Any
) -> None:
    out = io.StringIO()
    with redirect_stdout(out):
        assert run(["evaluate", str(scene_folder), "--model", str(model), "--segment", "all"]) == 0
    printed = [" ".join(line.split()) for line in out.getvalue().splitlines()]
    assert "channel unit RMSE MAE sigma skill" in printed
    assert "My N m 1.500 1.214 1.118 -0.34" in printed
    assert "Fz N 45.277 40.000 21.213 -1.13" in printed
    assert "brim_lateral.Fz N 28.638 27.000 9.546 -2.00" in printed
    assert "distal.Fx N 1.909 1.800 0.636 -2.00 not in objective" in printed
    assert (
        "mean moment RMSE 0.943 N m, mean force RMSE 19.806 N, median local RMSE 7.637 N, of the"
        " channels in the objective"
    ) in printed
    assert "median skill of the wrench 0.00, of the local forces -2.00" in printed
    assert not any("in-sample" in line for line in printed)


@pytest.mark.parametrize(("name", "in_sample"), [("scene", True), ("another", False)])
def test_errors_on_the_own_trial_are_in_sample(
    name: str, in_sample: bool, trial, tmp_path: Path
) -> None:
    found = st.evaluate(trial, scene.model(tmp_path / "model.json", name), "all")
    assert found.in_sample is in_sample
    assert found.document()["in_sample"] is in_sample


def test_predictions_are_exported_as_they_are(
    scene_folder: Path, model: Path, tmp_path: Path
) -> None:
    st.export(scene_folder, tmp_path / "a.csv", "12:12.5", model=model)
    row = pd.read_csv(tmp_path / "a.csv").iloc[0]
    answers = {"Mx [N m]": 0.55, "My [N m]": 1.1, "Fx [N]": 14.0, "Fz [N]": -100.0}
    answers |= {"mid_anterior.Fx [N]": -2.7, "mid_anterior.Fz [N]": -36.0, "distal.Fz [N]": 0.0}
    for title, answer in answers.items():
        assert row[f"predicted.{title}"] == pytest.approx(answer), title


def test_the_message_holds_the_model(model: Path) -> None:
    message = deserialize_message(messages.model_message(read_model(model)), ContactModel)
    assert message.variant == "stiffness_bias" and tuple(message.names) == scene.TILES
    torque, force = message.wrench_bias.torque, message.wrench_bias.force
    assert (torque.x, torque.y, torque.z) == (0.55, 1.1, 0.5)
    assert (force.x, force.y, force.z) == (14.0, 3.0, -100.0)
    rmse = message.wrench_rmse
    assert (rmse.torque.x, rmse.torque.z, rmse.force.x, rmse.force.z) == (0.1, 0.3, 1.0, 3.0)
    assert message.bias_names == ["mid_anterior"]
    bias = message.force_bias[0]
    assert (bias.x, bias.y, bias.z) == (-2.7, 3.6, -36.0)
    assert message.samples == 96 and message.solver_status == "made by hand"
    assert message.header.stamp.sec == 1_800_000_023
    assert message.header.stamp.nanosec == 750_000_000


# --- what `info` says of the trial


@pytest.fixture(scope="module")
def described(scene_folder: Path) -> list[str]:
    out = io.StringIO()
    with redirect_stdout(out), redirect_stderr(out):
        assert run(["info", str(scene_folder)]) == 0
    return [" ".join(line.split()) for line in out.getvalue().splitlines()]


@pytest.mark.parametrize(
    "line",
    [
        "/load_cell/wrench geometry_msgs/msg/WrenchStamped 96 4.00",
        "96 samples at 4.00 Hz in 23.75 s, 96 with a wrench and a limb position; gaps longer than"
        " 1.5 periods: 0",
        "event placed (found): 6.68 s",
        "event removed (found): 18.43 s",
        "subject S01",
        "side right",
        "mass 61.2 kg",
        "socket: a scene made by hand; 12 tiles",
        "calibration: made by hand (2026-01-01)",
        "note: data: good",
    ],
    ids=["topic", "samples", "placed", "removed", "subject", "side", "mass", "socket",
         "calibration", "data"],
)  # fmt: skip
def test_info_describes_the_scene(line: str, described: list[str]) -> None:
    assert line in described


def test_info_heads_its_columns(described: list[str]) -> None:
    assert "topic type messages Hz" in described
    assert (
        "measurement missing [1] missing [%] longest [s] saturated [1] out of range [1]"
        in described
    )
    assert "Standard deviation of the noise of a single sample, along each axis" in described
