"""The file of a model: what it keeps, what it must not hold, and which samples it has seen."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import scene

from socket_testbed.errors import ConfigurationError
from socket_testbed.identification import model_file
from socket_testbed.identification.channel_errors import ChannelErrors
from socket_testbed.identification.fit import FittedModel
from socket_testbed.identification.model_file import read_model

NAN = float("nan")
GEOMETRY = scene.geometry()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return scene.model(tmp_path / "model.json")


@pytest.fixture
def stored(path: Path) -> FittedModel:
    return read_model(path, GEOMETRY)


def changed(path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    return path


def test_a_model_keeps_its_fit(stored: FittedModel) -> None:
    assert (stored.samples, stored.trial, stored.status) == (96, "another", "made by hand")
    assert (stored.first_stamp, stored.last_stamp) == (scene.STAMPS[0], scene.STAMPS[-1])
    assert stored.segment == "all 0.00 s to 23.75 s" and stored.fingerprint == ""
    assert stored.wrench_rmse.tolist() == [0.1, 0.2, 0.3, 1.0, 2.0, 3.0]
    assert stored.settings.leave_out == ("distal.Fx",) and stored.errors == ()
    assert stored.model.wrench_bias.tolist() == [0.55, 1.1, 0.5, 14.0, 3.0, -100.0]
    assert stored.model.force_bias["mid_anterior"].tolist() == [-2.7, 3.6, -36.0]
    assert stored.model.sharpness == 2000.0 and stored.model.frame == "{S}"
    assert stored.model.cluster_points == GEOMETRY.clusters
    assert repr(stored) == "FittedModel(stiffness_bias of another, 96 samples, 12 tiles)"


def test_a_rigid_model_is_in_tiles(stored: FittedModel) -> None:
    assert replace(stored.model, variant="rigid").frame == "the tile's frame"


def test_a_dead_channel_has_no_rmse(path: Path) -> None:
    changed(path, lambda d: d["quality"]["wrench_rmse"].__setitem__(2, None))
    found = read_model(path).wrench_rmse
    assert np.isnan(found[2]) and np.isfinite(np.delete(found, 2)).all()


def test_stored_errors_come_back(path: Path) -> None:
    error = ChannelErrors("Mz", "N m", 1.0, 0.5, 0.25, NAN, 9, False)
    record = model_file.record(error)
    assert record["skill"] is None and record["rmse"] == 1.0
    changed(path, lambda d: d["quality"].__setitem__("errors", [record]))
    (found,) = read_model(path).errors
    assert replace(found, skill=0.0) == replace(error, skill=0.0) and np.isnan(found.skill)


def test_quoted_figures_have_units() -> None:
    errors = [
        ChannelErrors("Mx", "N m", 1.0, 0.5, 0.25, 0.9, 9, True),
        ChannelErrors("Fx", "N", 2.0, 0.5, 0.25, 0.9, 9, True),
    ]
    assert model_file.quoted_figures(errors) == {
        "mean_moment_rmse [N m]": 1.0,
        "mean_force_rmse [N]": 2.0,
        "median_local_rmse [N]": None,
    }


USED = {
    # fingerprint of the model, trial, its fingerprint, rows of the samples
    "its own": ("f1", "renamed", "f1", [*range(10, 20)]),
    "another": ("f1", "another", "f2", []),
    "older, its own": ("", "another", "f2", [*range(10, 20)]),
    "older, another": ("", "renamed", "", []),
}


@pytest.mark.parametrize("case", USED)
def test_seen_samples_are_of_its_trial(case: str, stored: FittedModel) -> None:
    own, trial, fingerprint, rows = USED[case]
    stamps = scene.STAMPS
    model = replace(
        stored, fingerprint=own, first_stamp=int(stamps[10]), last_stamp=int(stamps[19])
    )
    limb, count = scene.limb(), len(stamps)
    samples = model_samples(limb.translation, limb.rotation_vector(), count)
    assert np.flatnonzero(model.used(trial, fingerprint, samples)).tolist() == rows
    elsewhere = replace(model, last_stamp=int(stamps[19]) + 1)
    assert not elsewhere.used(trial, fingerprint, samples).any()


def model_samples(position: np.ndarray, rotation: np.ndarray, count: int):
    from support.problems import make_samples

    samples = make_samples(np.hstack([position, rotation]), np.zeros((count, 6)), {})
    return replace(samples, stamps=scene.STAMPS)


SOCKETS = {
    "the same": (lambda g: g, ""),
    "another place": (
        lambda g: replace(g, anchors=g.anchors + 0.01),
        "the model of another was fitted on another socket (12 tiles) than the one that it is used"
        " on (12 tiles)",
    ),
    "another tile": (
        lambda g: replace(g, clusters=g.clusters | {"distal": 8}),
        "distal had another tile or area in the socket of the model of another",
    ),
    "another area": (
        lambda g: replace(g, areas=np.where(np.arange(12) == 10, 8e-4, g.areas)),
        "distal had another tile or area",
    ),
    "an area without a cluster": (
        lambda g: replace(g, areas=np.where(np.arange(12) == 0, 8e-4, g.areas)),
        "",
    ),
    "fewer clusters": (lambda g: replace(g, clusters={"distal": 10}), ""),
}


@pytest.mark.parametrize("case", SOCKETS)
def test_a_model_belongs_to_its_socket(case: str, path: Path) -> None:
    change, fact = SOCKETS[case]
    if not fact:
        read_model(path, change(GEOMETRY))
        return
    with pytest.raises(ConfigurationError) as refusal:
        read_model(path, change(GEOMETRY))
    assert fact in refusal.value.fact


def parameter(name: str, value: Any) -> Callable[[dict[str, Any]], object]:
    return lambda d: d["parameters"].__setitem__(name, value)


REFUSED: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "another format": (
        lambda d: d.__setitem__("format", "socket_testbed model 9"),
        "is of the format",
    ),
    "no format": (lambda d: d.pop("format"), "is not a model"),
    "an unknown cluster": (
        parameter("clusters", ["heel"]),
        "parameters: clusters: no cluster 'heel'",
    ),
    "an offset of another": (
        parameter("force_bias", {"heel": [0.0, 0.0, 0.0]}),
        "parameters: force_bias",
    ),
    "too few tiles": (
        parameter("stiffness", [[0.0] * 3] * 11),
        "parameters: stiffness has 11 rows for 12 tiles",
    ),
    "too few rests": (
        parameter("rest_positions", [[0.0] * 3] * 13),
        "parameters: rest_positions has 13 rows for 12 tiles",
    ),
    "a negative stiffness": (parameter("stiffness", [[-1.1, 0.0, 0.0]] * 12), "stiffness"),
    "millimetres": (parameter("rest_positions", [[10.1, 0.0, 0.0]] * 12), "rest_positions"),
    "a sharpness below one": (parameter("sharpness", 0.9), "sharpness"),
    "five channels": (parameter("wrench_bias", [0.0] * 5), "wrench_bias"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_broken_model_is_refused(case: str, path: Path) -> None:
    change, fact = REFUSED[case]
    with pytest.raises(ConfigurationError) as refusal:
        read_model(changed(path, change))
    assert fact in refusal.value.fact and "model.json" in refusal.value.fact


@pytest.mark.parametrize(
    "change",
    [
        parameter("stiffness", [[-1.0, 1e9, 0.0]] * 12),
        parameter("rest_positions", [[10.0, -10.0, 0.0]] * 12),
        parameter("sharpness", 1.0),
        parameter("parameter_factor", 3),
    ],
    ids=["stiffness", "rest", "sharpness", "older"],
)
def test_values_at_their_limits_are_read(change, path: Path) -> None:
    read_model(changed(path, change))
