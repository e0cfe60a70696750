"""Sound trials are good; a damaged copy says what to look at."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import socket_testbed as st
from socket_testbed.arrays import FloatArray
from socket_testbed.identification.data_check import check_data
from socket_testbed.samples import Samples, Status
from socket_testbed.simulation.limb import SCENARIOS, TISSUES

Damage = Callable[[Samples], None]
DISTAL = 3


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A trial of every scenario, on soft and on stiff tissue in turn."""
    folder = tmp_path_factory.mktemp("sound")
    for number, name in enumerate(SCENARIOS):
        st.simulate(folder / name, name, tissue=TISSUES[number % 2], seed=90 + number)
    return {name: folder / name for name in SCENARIOS}


def test_sound_trials_are_good(sound: dict[str, Path]) -> None:
    for path in sound.values():
        assert st.check_data(st.open_trial(path)) == ()


def scale(source: str, *columns: int, by: float) -> Damage:
    def damage(samples: Samples) -> None:
        values: FloatArray = getattr(samples, source)
        values[..., list(columns) or slice(None)] *= by

    return damage


def late(*sources: str, by: int) -> Damage:
    def damage(samples: Samples) -> None:
        for source in sources:
            values: FloatArray = getattr(samples, source)
            values[by:], values[:by] = values[:-by].copy(), values[0]

    return damage


def put(source: str, *place: object, value: float) -> Damage:
    def damage(samples: Samples) -> None:
        getattr(samples, source)[place] = value

    return damage


def noise(samples: Samples) -> None:
    samples.wrench[:] += np.random.default_rng(0).normal(0.0, 60.0, samples.wrench.shape)


def axes(samples: Samples) -> None:
    samples.position[:] = samples.position[:, [2, 1, 0]]


EVERY = slice(None)
DAMAGED: dict[str, tuple[str, Damage]] = {
    "negated": ("the wrench", scale("wrench", by=-1.0)),
    "kilonewtons": ("the wrench", scale("wrench", 3, 4, 5, by=1e-3)),
    "newton millimetres": ("the units", scale("wrench", 0, 1, 2, by=1e3)),
    "millimetres": ("the units", scale("position", by=1e3)),
    "other axes": ("the limb pose", axes),
    "late wrench": ("the clusters", late("wrench", by=20)),
    "late pose": ("the limb pose", late("position", "rotation", by=20)),
    "dead channel": ("Fz", put("wrench", EVERY, 5, value=0.0)),
    "missing channel": ("the wrench", put("wrench", EVERY, 5, value=np.nan)),
    "dead cluster": ("distal", put("local_forces", EVERY, DISTAL, value=0.0)),
    "missing cluster": ("distal", put("status", EVERY, DISTAL, value=Status.MISSING)),
    "frozen": ("Fz", put("wrench", slice(200, 300), 5, value=-200.0)),
    "noise": ("Fx", noise),
    "spike": ("single values", put("wrench", 50, 5, value=1e5)),
}


def test_damaged_copies_say_what_to_look_at(sound: dict[str, Path]) -> None:
    for path in (sound["static_hold"], sound["multi_direction"]):
        trial = st.open_trial(path)
        for name, (source, damage) in DAMAGED.items():
            samples = trial.samples()
            samples = replace(
                samples,
                **{part: getattr(samples, part).copy() for part in
                   ("wrench", "local_forces", "status", "position", "rotation")},
            )  # fmt: skip
            damage(samples)
            found = check_data(samples, trial.geometry)
            assert any(source in finding.source for finding in found), (name, found)
            assert all(str(finding).startswith("data: look at ") for finding in found)


def test_a_reversed_cluster_and_a_load_of_another_size_are_named(sound: dict[str, Path]) -> None:
    trial = st.open_trial(sound["protocol"])
    samples = trial.samples()
    samples.local_forces[:, 0] *= -1.0
    (found,) = check_data(samples, trial.geometry)
    assert found.source == samples.clusters[0] and "sign" in found.hint
    samples.local_forces[:, 0] *= -1.0
    (heavy,) = check_data(samples, trial.geometry, mass=5.0)
    assert "weights of the stated 5 kg" in heavy.fact


def test_without_poses_or_with_few_samples_it_says_so(sound: dict[str, Path]) -> None:
    trial = st.open_trial(sound["ramp"])
    samples = trial.samples()
    samples = replace(
        samples,
        position=np.full_like(samples.position, np.nan),
        rotation=np.full_like(samples.rotation, np.nan),
    )
    (found,) = check_data(samples, trial.geometry)
    assert found.source == "the limb pose" and "missing" in found.fact
    (few,) = check_data(samples[:20], trial.geometry)
    assert "20 samples are too few" in few.fact
