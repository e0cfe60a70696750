"""Summaries of a folder of trials by `fit`, `evaluate` and `pressure`, on the scene.

Both trials are the scene, whose forces are known; the second one is another subject's `walk`.
`evaluate` uses the scene's model made by hand, `fit` a fit made by hand.
"""

import functools
import io
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pyarrow.parquet
import pytest
from support import scene

import socket_testbed as st
from socket_testbed import api
from socket_testbed.__main__ import run
from socket_testbed.errors import IdentificationError
from socket_testbed.identification.channel_errors import ChannelErrors
from socket_testbed.identification.information import LoadShare

NAMES = ("s01/scene", "s02/walk")


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study")
    for name in NAMES:
        scene.write(folder / name)
    st.annotate(folder / NAMES[1], subject="S02", notes="left the room")
    return folder


class Batch:
    """What a verb on the folder printed and summarised."""

    def __init__(self, study: Path, output: Path, verb: str, *words: object) -> None:
        out, err = io.StringIO(), io.StringIO()
        call = [verb, str(study), "-o", str(output), "--jobs", "1", *map(str, words)]
        with redirect_stdout(out), redirect_stderr(err):
            self.code = run(call)
        self.lines, self.errors = out.getvalue().splitlines(), err.getvalue().splitlines()
        self.table = pd.read_csv(output / "summary.csv").set_index("trial")
        self.fields = pyarrow.parquet.read_schema(output / "summary.parquet")

    def unit(self, title: str) -> str:
        """The unit of a column in the Parquet file."""
        return self.fields.field(title).metadata[b"unit"].decode()


# --- evaluate


@pytest.fixture(scope="module")
def evaluated(study: Path, by_hand: None, tmp_path_factory: pytest.TempPathFactory) -> Batch:
    folder = tmp_path_factory.mktemp("evaluated")
    model = scene.model(folder / "model.json", "scene")
    words = ("--model", model, "--segment", "all", "--pressure")
    return Batch(study, folder / "out", "evaluate", *words)


# Errors of the scene's model, worked out in test_models.py; pressures as in `scene.ANSWERS`
EVALUATED: dict[str, Any] = {
    "status": "ok",
    "subject": "S01",
    "side": "right",
    "mass [kg]": 61.2,
    "data": "good",
    "samples": 96,
    "segment": "all",
    "segment_start [s]": 0.0,
    "segment_end [s]": 23.75,
    "model": "scene",
    "variant": "stiffness_bias",
    "theta [-]": 0.5,
    "in_sample": "yes",
    "mean_moment_rmse [N m]": 0.94339,
    "mean_force_rmse [N]": 19.8064,
    "median_local_rmse [N]": 7.6368,
    "median_wrench_skill [-]": 0.0,
    "median_local_skill [-]": -2.0,
    "My_rmse [N m]": 1.5,
    "My_sigma [N m]": 1.1180,
    "My_skill [-]": -0.34164,
    "Fz_rmse [N]": 45.2769,
    "Fz_mae [N]": 40.0,
    "Fz_sigma [N]": 21.2132,
    "Fz_skill [-]": -1.1344,
    "brim_lateral.Fz_rmse [N]": 28.6378,
    "brim_lateral.Fz_sigma [N]": 9.5459,
    "distal.Fx_rmse [N]": 1.9092,
    "peak pressure [kPa]": 60.0,
    "peak pressure low [kPa]": 57.55,
    "peak pressure high [kPa]": 62.45,
    "mean pressure [kPa]": 14.5348,
    "mean pressure low [kPa]": 12.7128,
    "mean pressure high [kPa]": 16.3567,
}


@pytest.mark.parametrize("title", EVALUATED)
def test_the_summary_holds_the_known_errors(title: str, evaluated: Batch) -> None:
    assert evaluated.code == 0, evaluated.errors
    value, known = evaluated.table.loc[NAMES[0], title], EVALUATED[title]
    if isinstance(known, float):
        assert value == pytest.approx(known, rel=1e-4, abs=1e-9)
    else:
        assert value == known


def test_another_trial_is_not_in_sample(evaluated: Batch) -> None:
    row = evaluated.table.loc[NAMES[1]]
    assert (row["in_sample"], row["subject"]) == ("no", "S02")
    assert row["trial_notes"] == "left the room" and pd.isna(row["notes"])


def test_a_finished_trial_is_told_with_its_errors(evaluated: Batch) -> None:
    assert evaluated.lines[0] == (
        "[1/2] s01/scene: ok, mean moment RMSE 0.943 N m, mean force RMSE 19.806 N, median local"
        " RMSE 7.637 N, median wrench skill 0.000, median local skill -2.000"
    )
    assert evaluated.lines[1].startswith("[2/2] s02/walk: ok, mean moment RMSE 0.943 N m")
    assert evaluated.lines[2].startswith("summary in ") and evaluated.errors == []


@pytest.mark.parametrize(
    ("title", "unit"),
    [
        ("mass [kg]", "kg"),
        ("segment_end [s]", "s"),
        ("My_rmse [N m]", "N m"),
        ("distal.Fz_mae [N]", "N"),
        ("My_skill [-]", "-"),
        ("peak pressure low [kPa]", "kPa"),
        ("contact area [cm^2]", "cm^2"),
        ("samples", ""),
    ],
)
def test_the_unit_is_in_the_parquet_file(title: str, unit: str, evaluated: Batch) -> None:
    assert evaluated.unit(title) == unit


# --- pressure


@pytest.fixture(scope="module")
def pressed(study: Path, by_hand: None, tmp_path_factory: pytest.TempPathFactory) -> Batch:
    output = tmp_path_factory.mktemp("pressed") / "out"
    return Batch(study, output, "pressure", "--segment", "all")


@pytest.mark.parametrize("title", scene.ANSWERS["socket"])
def test_the_summary_holds_the_known_pressures(title: str, pressed: Batch) -> None:
    """Those of the whole socket, with both ends of their intervals."""
    row = pressed.table.loc[NAMES[0]]
    name, unit = title.rsplit(" [", 1)
    titles = title, f"{name} low [{unit}", f"{name} high [{unit}"
    for own, known in zip(titles, scene.ANSWERS["socket"][title], strict=True):
        assert row[own] == pytest.approx(known, rel=1e-3, abs=1e-6), own


def test_the_summary_says_what_was_pressed(pressed: Batch) -> None:
    assert pressed.code == 0, pressed.errors
    row = pressed.table.loc[NAMES[1]]
    assert (row["status"], row["samples"], row["segment"]) == ("ok", 96, "all")
    assert row["threshold [kPa]"] == 5.0
    assert pressed.lines[1] == "[2/2] s02/walk: ok"


# --- fit


class HandFit:
    """Stands for a `TrialFit`: RMSE of 1 to 9, MAE of half, sigma of a quarter of that.

    On an unseen half the skills of moments and forces are 0.2 to 0.7, that of the cluster -0.5.
    The second trial has no unseen half.
    """

    channels = ("Mx", "My", "Mz", "Fx", "Fy", "Fz", "distal.Fx", "distal.Fy", "distal.Fz")

    def __init__(self, trial: Any) -> None:
        self.trial = trial
        self.segment = trial.select("2:20")

        def stage(stationarity: float, gap: float) -> Any:
            certificate = SimpleNamespace(stationarity=stationarity, gap=gap)
            return SimpleNamespace(certificate=certificate)

        self.fit = SimpleNamespace(
            errors=self._errors((0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.35, 0.3, 0.25)),
            samples=72,
            model=SimpleNamespace(variant="stiffness_bias"),
            settings=SimpleNamespace(theta=0.7),
            stage_one=stage(1e-9, 3e-9),
            stage_two=stage(2e-9, 1e-9),
            joint=None,
        )

    def _errors(self, skills: tuple[float, ...]) -> tuple[ChannelErrors, ...]:
        return tuple(
            ChannelErrors(
                name=name,
                unit="N m" if name[0] == "M" else "N",
                rmse=float(number),
                mae=0.5 * number,
                sigma=0.25 * number,
                skill=skill,
                samples=72,
                in_objective=name != "distal.Fx",
            )
            for number, (name, skill) in enumerate(zip(self.channels, skills, strict=True), start=1)
        )

    def load_shares(self) -> tuple[LoadShare, ...]:
        return (
            LoadShare("Fz", 0.1, 0.2, 0.7),
            LoadShare("force", 0.62, 0.3, 0.08),
            LoadShare("moment", 0.4, 0.5, 0.1),
        )

    def unseen_half(self) -> tuple[ChannelErrors, ...]:
        if self.trial.name == "walk":
            raise IdentificationError("too few samples", "give more")
        return self._errors((0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 9.0, -0.5, -0.5))

    def save(self, path: Path) -> None:
        path.write_text("{}")


@pytest.fixture(scope="module")
def fitted(study: Path, by_hand: None, tmp_path_factory: pytest.TempPathFactory) -> Batch:
    @functools.wraps(api.fit)
    def made(trial: Any, **options: Any) -> HandFit:
        return HandFit(trial)

    output = tmp_path_factory.mktemp("fitted") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(api, "fit", made)
        return Batch(study, output, "fit")


FITTED: dict[str, Any] = {
    "status": "ok",
    "samples": 72,
    "segment": "span",
    "segment_start [s]": 2.0,
    "segment_end [s]": 20.0,
    "variant": "stiffness_bias",
    "theta [-]": 0.7,
    "force_on_springs [-]": 0.62,
    "kkt_residual [-]": 2e-9,
    "duality_gap [-]": 3e-9,
    "mean_moment_rmse [N m]": 2.0,  # of 1, 2, 3
    "mean_force_rmse [N]": 5.0,  # of 4, 5, 6
    "median_local_rmse [N]": 8.5,  # of 8 and 9: distal.Fx is not in the objective
    "median_wrench_skill_in_sample [-]": 0.65,
    "median_local_skill_in_sample [-]": 0.275,
    "median_wrench_skill_unseen_half [-]": 0.45,
    "median_local_skill_unseen_half [-]": -0.5,
    "Mz_rmse [N m]": 3.0,
    "Mz_mae [N m]": 1.5,
    "Mz_sigma [N m]": 0.75,
    "Mz_skill [-]": 0.7,
    "distal.Fz_rmse [N]": 9.0,
    "distal.Fz_skill [-]": 0.25,
}


@pytest.mark.parametrize("title", FITTED)
def test_the_summary_holds_the_known_fit(title: str, fitted: Batch) -> None:
    assert fitted.code == 0, fitted.errors
    value, known = fitted.table.loc[NAMES[0], title], FITTED[title]
    assert value == (pytest.approx(known) if isinstance(known, float) else known)


def test_an_unknown_skill_is_empty_and_noted(fitted: Batch) -> None:
    row = fitted.table.loc[NAMES[1]]
    assert pd.isna(row["median_wrench_skill_unseen_half [-]"])
    assert row["median_wrench_skill_in_sample [-]"] == pytest.approx(0.65)
    note = "no skill on an unseen half: too few samples: give more"
    assert row["notes"] == note
    assert fitted.errors == [f"note: s02/walk: {note}"]


def test_a_fit_is_told_with_its_skills(fitted: Batch) -> None:
    assert fitted.lines[0] == (
        "[1/2] s01/scene: ok, mean moment RMSE 2.000 N m, mean force RMSE 5.000 N, median local"
        " RMSE 8.500 N, median wrench skill in sample 0.650, median local skill in sample 0.275,"
        " median wrench skill unseen half 0.450, median local skill unseen half -0.500"
    )


def test_a_failed_trial_stops_no_other(study: Path, by_hand: None, tmp_path: Path) -> None:
    @functools.wraps(api.fit)
    def made(trial: Any, **options: Any) -> HandFit:
        if trial.name == "scene":
            raise IdentificationError("the load never changes", "load the limb")
        return HandFit(trial)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(api, "fit", made)
        batch = Batch(study, tmp_path / "out", "fit")
    assert batch.code == 1
    assert batch.table["status"].to_dict() == {"s01/scene": "failed", "s02/walk": "ok"}
    assert batch.table.loc["s01/scene", "error"] == "the load never changes: load the limb"
    assert batch.table.loc["s01/scene", "subject"] == "S01"
    assert batch.lines[0] == "[1/2] s01/scene: failed: the load never changes: load the limb"
    assert "s01/scene: the load never changes: load the limb" in batch.errors
    assert any("1 of 2 trials failed" in line for line in batch.errors)
