"""What a model adds to an exported table: predictions and engaged springs, against hand values.

About the knee k, KNEE x F = (-0.2, 7.6, 0.2) N m of the predicted force (14, 3, -100) N is taken
off the predicted moment, (0.55, 1.1, 0.5) N m.
"""

from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from support import results_by_hand, scene

import socket_testbed as st

KNEE = (0.02, -0.01, 0.4)  # [m]
AT_CELL = {"Mx [N m]": 0.55, "My [N m]": 1.1, "Mz [N m]": 0.5}
AT_KNEE = {"Mx [N m]": 0.75, "My [N m]": -6.5, "Mz [N m]": 0.3}
FORCES = {
    **{"Fx [N]": 14.0, "Fy [N]": 3.0, "Fz [N]": -100.0},
    **{"mid_anterior.Fx [N]": -2.7, "mid_anterior.Fy [N]": 3.6, "mid_anterior.Fz [N]": -36.0},
    **{"distal.Fx [N]": 0.0, "distal.Fz [N]": 0.0},
}


@pytest.mark.parametrize(
    ("about", "moments"), [(None, AT_CELL), (KNEE, AT_KNEE)], ids=["cell", "knee"]
)
def test_predictions_are_about_the_given_point(
    about: tuple[float, float, float] | None,
    moments: dict[str, float],
    scene_folder: Path,
    tmp_path: Path,
) -> None:
    model = st.read_model(scene.model(tmp_path / "model.json"))
    st.export(scene_folder, tmp_path / "a.csv", "12:12.5", model=model, about=about)
    row = pd.read_csv(tmp_path / "a.csv").iloc[0]
    for title, answer in {**moments, **FORCES}.items():
        assert row[f"predicted.{title}"] == pytest.approx(answer), title


def test_engaged_springs_are_those_of_the_segment(scene_folder: Path, tmp_path: Path) -> None:
    """One of 36 springs always, another until the swing along x exceeds 0.6, after 13 s."""
    stored = st.read_model(scene.model(tmp_path / "model.json"))
    springs = results_by_hand.paper_model(scene.geometry(), "stiffness")
    st.export(scene_folder, tmp_path / "a.csv", "12.75:13.5", model=replace(stored, model=springs))
    table = pd.read_csv(tmp_path / "a.csv")
    assert table["time [s]"].tolist() == [12.75, 13.0, 13.25, 13.5]
    assert table["springs.engaged [1]"].tolist() == [2.0, 2.0, 1.0, 1.0]
    shares = table["springs.engaged_share [-]"].tolist()
    assert shares == pytest.approx([1 / 18, 1 / 18, 1 / 36, 1 / 36])


def test_engaged_springs_follow_the_averaged_pose(scene_folder: Path, tmp_path: Path) -> None:
    """Over 2 s a swing of 12 s keeps 95.5 %: the spring is engaged until 13.3 s."""
    stored = st.read_model(scene.model(tmp_path / "model.json"))
    springs = results_by_hand.paper_model(scene.geometry(), "stiffness")
    settings = replace(stored.settings, pose_smoothing=2.0)
    model = replace(stored, model=springs, settings=settings)
    st.export(scene_folder, tmp_path / "a.csv", "12.75:13.5", model=model)
    engaged = pd.read_csv(tmp_path / "a.csv")["springs.engaged [1]"].tolist()
    assert engaged == [2.0, 2.0, 2.0, 1.0]
