"""Sound trials are good; a damaged copy says what to look at."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import socket_testbed as st
from socket_testbed.identification.data_check import check_data
from socket_testbed.samples import Status
from socket_testbed.simulation.limb import SCENARIOS, TISSUES

Damage = dict[str, Callable[[np.ndarray], np.ndarray]]
ALL = slice(None)


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


def late(values: np.ndarray, by: int = 20) -> np.ndarray:
    return np.concatenate([np.repeat(values[:1], by, axis=0), values[:-by]])


def noisy(values: np.ndarray) -> np.ndarray:
    return values + np.random.default_rng(0).normal(0.0, 60.0, values.shape)


def put(values: np.ndarray, value: float, *place: slice | int) -> np.ndarray:
    values = values.copy()
    values[place] = value
    return values


# By damage: where to look, and what becomes of each array.
DAMAGED: dict[str, tuple[str, Damage]] = {
    "negated": ("the wrench", {"wrench": np.negative}),
    "kilonewtons": ("the wrench", {"wrench": lambda v: v * [1, 1, 1, 1e-3, 1e-3, 1e-3]}),
    "newton millimetres": ("the units", {"wrench": lambda v: v * [1e3, 1e3, 1e3, 1, 1, 1]}),
    "millimetres": ("the units", {"position": lambda v: 1e3 * v}),
    "other axes": ("the limb pose", {"position": lambda v: v[:, [2, 1, 0]]}),
    "late wrench": ("the clusters", {"wrench": late}),
    "late pose": ("the limb pose", {"position": late, "rotation": late}),
    "dead channel": ("Fz", {"wrench": lambda v: put(v, 0.0, ALL, 5)}),
    "missing channel": ("the wrench", {"wrench": lambda v: put(v, np.nan, ALL, 5)}),
    "dead cluster": ("distal", {"local_forces": lambda v: put(v, 0.0, ALL, 3)}),
    "missing cluster": ("distal", {"status": lambda v: put(v, Status.MISSING, ALL, 3)}),
    "frozen": ("Fz", {"wrench": lambda v: put(v, -200.0, slice(200, 300), 5)}),
    "noise": ("Fx", {"wrench": noisy}),
    "spike": ("single values", {"wrench": lambda v: put(v, 1e5, 50, 5)}),
}


def test_damaged_copies_say_what_to_look_at(sound: dict[str, Path]) -> None:
    for path in (sound["static_hold"], sound["multi_direction"]):
        trial = st.open_trial(path)
        samples = trial.samples()
        for name, (source, damage) in DAMAGED.items():
            arrays = {part: change(getattr(samples, part)) for part, change in damage.items()}
            found = check_data(replace(samples, **arrays), trial.geometry)
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


def test_a_cluster_that_disagrees_with_the_others_is_named(sound: dict[str, Path]) -> None:
    for path in sound.values():
        trial = st.open_trial(path)
        forces = trial.samples().local_forces.copy()
        forces[:, 0, 2] -= 25e3 * trial.geometry.areas[0]
        (found,) = check_data(replace(trial.samples(), local_forces=forces), trial.geometry)
        assert found.source == trial.samples().clusters[0] and "the others" in found.fact
