"""Sound trials are good; a damaged copy says what to look at."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import socket_testbed as st
from socket_testbed.identification.data_check import check_data
from socket_testbed.samples import Status
from socket_testbed.simulation.limb import SCENARIOS, TISSUES

ALL = slice(None)


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A trial of every scenario, on soft and on stiff tissue in turn."""
    folder = tmp_path_factory.mktemp("sound")
    for number, name in enumerate(SCENARIOS):
        st.simulate(folder / name, name, tissue=TISSUES[number % 2], seed=90 + number)
    return {name: folder / name for name in SCENARIOS}


def test_sound_trials_are_good_but_for_a_cluster_that_disagrees_with_the_others(sound) -> None:
    for path in sound.values():
        trial = st.open_trial(path)
        assert st.check_data(trial) == ()
        samples = trial.samples()
        samples.local_forces[:, 0, 2] -= 25e3 * trial.geometry.areas[0]
        (found,) = check_data(samples, trial.geometry)
        assert found.source == samples.clusters[0] and "the others" in found.fact


def late(values: np.ndarray, by: int = 20) -> np.ndarray:
    return np.concatenate([np.repeat(values[:1], by, axis=0), values[:-by]])


def put(value: float, *place: slice | int):
    def damage(values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[place] = value
        return values

    return damage


# By damage: where to look, the arrays, and what becomes of them.
DAMAGED = {
    "negated": ("the wrench", ("wrench",), np.negative),
    "kilonewtons": ("the wrench", ("wrench",), lambda v: v * np.repeat([1, 1e-3], 3)),
    "lever": ("the wrench", ("wrench",), lambda v: v + 200.0 * (np.arange(6) == 0)),
    "newton millimetres": ("the units", ("wrench",), lambda v: v * np.repeat([1e3, 1], 3)),
    "millimetres": ("the units", ("position",), lambda v: 1e3 * v),
    "other axes": ("the limb pose", ("position",), lambda v: v[:, [2, 1, 0]]),
    "late wrench": ("the clusters", ("wrench",), late),
    "late pose": ("the limb pose", ("position", "rotation"), late),
    "no pose": ("the limb pose", ("position", "rotation"), put(np.nan, ALL)),
    "dead channel": ("Fz", ("wrench",), put(0.0, ALL, 5)),
    "missing channel": ("the wrench", ("wrench",), put(np.nan, ALL, 5)),
    "dead cluster": ("distal", ("local_forces",), put(0.0, ALL, 3)),
    "missing cluster": ("distal", ("status",), put(Status.MISSING, ALL, 3)),
    "frozen": ("Fz", ("wrench",), put(-200.0, slice(200, 300), 5)),
    "noise": ("Fx", ("wrench",), lambda v: v + np.random.default_rng(0).normal(0, 60, v.shape)),
    "spike": ("single values", ("wrench",), put(1e5, 50, 5)),
}


def test_damaged_copies_say_what_to_look_at(sound: dict[str, Path]) -> None:
    for path in (sound["static_hold"], sound["multi_direction"]):
        trial = st.open_trial(path)
        samples = trial.samples()
        for name, (source, parts, damage) in DAMAGED.items():
            arrays = {part: damage(getattr(samples, part)) for part in parts}
            found = check_data(replace(samples, **arrays), trial.geometry)
            assert any(source in finding.source for finding in found), (name, found)
            assert all(str(finding).startswith("data: look at ") for finding in found)


def test_a_reversed_cluster_another_size_and_few_samples_are_named(sound: dict[str, Path]) -> None:
    trial = st.open_trial(sound["protocol"])
    samples = trial.samples()
    (heavy,) = check_data(samples, trial.geometry, mass=5.0)
    assert "weights of the stated 5 kg" in heavy.fact
    (few,) = check_data(samples[:20], trial.geometry)
    assert "20 samples are too few" in few.fact
    samples.local_forces[:, 0] *= -1.0
    (found,) = check_data(samples, trial.geometry)
    assert found.source == samples.clusters[0] and "sign" in found.hint
