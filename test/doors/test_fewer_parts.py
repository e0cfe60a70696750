"""Every verb on a trial without some of its sources: it works, or one line says what it lacks."""

from pathlib import Path

import pytest
from support.foreign import simulate_foreign
from support.verbs import call, refused

import socket_testbed as st
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket

POSES = {"socket_pose": "none", "pylon_pose": "none"}
KINDS = {
    "no clusters": {"clusters": "none"},
    "no poses": POSES,
    "one pose": {"socket_pose": "none"},
    "clusters alone": POSES | {"wrench": "none"},
    "wrench alone": POSES | {"clusters": "none"},
    "poses alone": {"wrench": "none", "clusters": "none"},
}


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Trials of a foreign bag with some of its sources, and a model of all."""
    path = tmp_path_factory.mktemp("parts")
    simulate_foreign(path / "bag", "protocol", 30.0, 1, rate=5.0)
    names = [*read_socket(packaged("config", "socket.yaml")).clusters]
    for name, without in {"all": {}, **KINDS}.items():
        trial = st.import_trial(
            path / "bag", path / name, names=names, notify=lambda note: None, **without
        )
        if name == "all":
            st.fit(trial, "all").save(path / "model.yaml")
    return {name: path / name for name in KINDS}


NO_POSE = "samples has a limb position, which {} needs: record the poses of"
NO_WRENCH = "samples has a wrench, which {} needs: record the load cell"
NEITHER = "has a limb position or a wrench, which {} needs"
NO_PLATEAU = "the trial has no wrench, whose force tells a plateau: give --segment all"
NOTHING = "no sample of the segment has a wrench or a trusted cluster"
ALL = ("--segment", "all")

# By kind and verb, what its one line says; verbs that are not named work.
REFUSALS = {
    "no clusters": {},
    "no poses": dict.fromkeys(("fit", "evaluate", "validate", "report"), NO_POSE),
    "one pose": dict.fromkeys(("fit", "evaluate", "validate", "report"), NO_POSE),
    "clusters alone": {
        "evaluate": NO_POSE, "fit": NEITHER, "validate": NEITHER, "report": NEITHER,
    },
    "wrench alone": dict.fromkeys(("fit", "evaluate", "validate", "report"), NO_POSE),
    "poses alone": {
        **dict.fromkeys(("fit", "validate", "report"), NO_WRENCH),
        **dict.fromkeys(("pressure", "map"), NOTHING),
        "evaluate": "which predictions are compared with: choose another segment, or record",
    },
}  # fmt: skip
WHO = {"fit": "a fit", "report": "a fit", "evaluate": "a prediction", "validate": "a validation"}
VERBS = ("info", "export", "pressure", "map", "fit", "evaluate", "validate", "report")


def words(verb: str, folder: Path, trial: Path) -> list[object]:
    more: dict[str, list[object]] = {
        "export": ["-o", folder / "samples.csv"],
        "pressure": [*ALL],
        "map": [*ALL, "-o", folder / "map.csv"],
        "fit": [*ALL, "-o", folder / "model.yaml"],
        "evaluate": [*ALL, "--model", trial.parent / "model.yaml"],
        "report": [*ALL, "-o", folder / "report.html"],
    }
    return [trial, *more.get(verb, [])]


@pytest.mark.parametrize(
    ("kind", "verb"),
    [
        pytest.param(kind, verb, marks=[pytest.mark.slow] if verb not in REFUSALS[kind] else [])
        if verb == "report"
        else (kind, verb)
        for kind in KINDS
        for verb in VERBS
    ],
)  # fmt: skip
def test_a_verb_on_fewer_parts(
    trials: dict[str, Path],
    kind: str,
    verb: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given = words(verb, tmp_path, trials[kind])
    said = REFUSALS[kind].get(verb)
    if said is not None:
        refused(capsys, verb, *given, named=[said.format(WHO.get(verb, ""))])
        assert not [*tmp_path.iterdir()]
        return
    code, out, err = call(capsys, verb, *given)
    assert code == 0, err
    assert "Traceback" not in err and out


@pytest.mark.parametrize("verb", ["pressure", "map", "fit", "report"])
def test_no_plateau_without_a_wrench(
    trials: dict[str, Path], verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [word for word in words(verb, tmp_path, trials["clusters alone"]) if word not in ALL]
    refused(capsys, verb, *given, named=[NO_PLATEAU])


def test_no_clusters_are_one_finding(
    trials: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    _, _, err = call(capsys, "export", trials["no clusters"], "-o", trials["no clusters"] / "x.csv")
    notes = [line for line in err.splitlines() if "no message contains" in line]
    assert len(notes) == 1 and "the clusters: no message contains any of the 4" in notes[0]
