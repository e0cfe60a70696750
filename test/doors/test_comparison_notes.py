"""What a comparison says besides its numbers: legs, loads, times and what may be compared."""

import inspect
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import scene

import socket_testbed as st
from socket_testbed.api import comparison
from socket_testbed.api.trials import unique_names
from socket_testbed.errors import ConfigurationError
from socket_testbed.results import comparing
from socket_testbed.results.comparison import Comparison
from socket_testbed.simulation.limb import SCENARIOS, TISSUES
from socket_testbed.trials.trial import Trial

# --- legs

# Mean pressures of three tiles of a column: anterior (16 + 40 + 15) / 3, right (30 - 1 + 6) / 3 and
# left (8 * 16 + 2 * 9 + 4.5 * 9) / 34 kPa. The right column is lateral on a right leg.
RIGHT_COLUMN, LEFT_COLUMN, ANTERIOR = 11.6667, 5.48529, 23.6667


@pytest.fixture(scope="module")
def compared(trial: Trial, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Compares the scene on a right leg with itself on a leg of any side, by region."""
    found = {}
    for side in ("left", "right", None):
        other = scene.write(tmp_path_factory.mktemp("other") / "other", side=side)  # type: ignore[arg-type]
        found[side] = st.compare(trial, other, segment="all", by_region=True)
    return found.__getitem__


def means(found: Comparison, region: str) -> list[float]:
    rows = found.to_dataframe().query("part == 'regions' and quantity == 'mean pressure'")
    return rows.set_index("name").loc[region, "value"].tolist()


@pytest.mark.parametrize(
    ("region", "first", "second"),
    [
        ("medial", LEFT_COLUMN, RIGHT_COLUMN),
        ("lateral", RIGHT_COLUMN, LEFT_COLUMN),
        ("lateral proximal", 30.0, 8.0),
        ("anterior", ANTERIOR, ANTERIOR),
    ],
)
def test_a_left_leg_is_compared_by_anatomy(
    region: str, first: float, second: float, compared: Any
) -> None:
    assert means(compared("left"), region) == pytest.approx([first, second], rel=1e-5)


@pytest.mark.parametrize(
    ("region", "value"),
    [("left", LEFT_COLUMN), ("right", RIGHT_COLUMN), ("right proximal", 30.0)],
)
def test_an_unstated_leg_is_compared_by_side(region: str, value: float, compared: Any) -> None:
    assert means(compared(None), region) == pytest.approx([value, value], rel=1e-5)
    assert "medial" not in set(compared(None).to_dataframe()["name"])


def test_notes_name_the_legs(compared: Any) -> None:
    (note,) = compared("left").notes
    assert note.startswith("left and right legs are compared: medial with medial")
    (note,) = compared(None).notes
    assert note.startswith("other: ")
    assert compared("left").side is None and compared("right").side == "right"
    assert compared("right").notes == ()


def test_regions_alone_have_no_tiles(compared: Any) -> None:
    found = compared("right")
    assert "tiles" not in set(found.to_dataframe()["part"]) and found.geometry is None
    assert repr(found) == "Comparison(trials scene, other; 23 regions)"


# --- notes on load and time


def noted(
    force: float = 100.0,
    time: float = 20.0,
    sides: Any = ("right", "right"),
    subjects: Any = ("S01", "S01"),
    freedom: int = 0,
) -> list[str]:
    """Notes on two trials of one socket, the first with 100 N and 20 s."""
    trials = [
        SimpleNamespace(
            metadata=SimpleNamespace(side=side, subject=subject),
            geometry=SimpleNamespace(regions={"shared": (0,), "own": (1,)}),
        )
        for side, subject in zip(sides, subjects, strict=True)
    ]
    found: Any = [
        SimpleNamespace(trial=trial, places=[], outputs=SimpleNamespace(integrated=seconds))
        for trial, seconds in zip(trials, (20.0, time), strict=True)
    ]
    rows: Any = [
        {
            ("regions", "shared", "mean pressure [kPa]"): {"value": 1.0},
            ("regions", "own", "mean pressure [kPa]"): {"value": 1.0},
            **{
                ("wrench", f"F{axis}", "mean [N]"): {"value": share * size}
                for axis, share in zip("xyz", (0.6, 0.0, -0.8), strict=True)
            },
        }
        for size in (100.0, force)
    ]
    return [*comparing._notes(found, ["a", "b"], rows, True, freedom)]


LOAD = (
    "the mean force is {} N in b and 100 N in a: differences in pressure include that of the load"
)
TIME = "the pressure-time integral covers {} s in b and 20.0 s in a: the times differ"


@pytest.mark.parametrize(
    ("force", "note"),
    [(111.0, [LOAD.format(111)]), (89.0, [LOAD.format(89)]), (109.0, []), (91.0, [])],
    ids=["more", "less", "a little more", "a little less"],
)
def test_loads_that_differ_by_a_tenth_are_noted(force: float, note: list[str]) -> None:
    assert noted(force=force) == note


@pytest.mark.parametrize(
    ("time", "note"),
    [(21.1, [TIME.format("21.1")]), (18.9, [TIME.format("18.9")]), (20.9, []), (19.1, [])],
    ids=["more", "less", "a little more", "a little less"],
)
def test_times_that_differ_by_a_twentieth_are_noted(time: float, note: list[str]) -> None:
    assert noted(time=time) == note


@pytest.mark.parametrize(
    ("subjects", "words"),
    [
        (("S01", "S01"), []),
        (("S01", "S02"), ["several limbs: "]),
        ((None, None), ["no subject is stated: "]),
        ((None, "S01"), ["several limbs: "]),
    ],
    ids=["one", "two", "unstated", "half stated"],
)
def test_repeated_trials_note_their_limbs(subjects: Any, words: list[str]) -> None:
    explained, *others = noted(subjects=subjects, freedom=2)
    assert "(degrees of freedom: 2)" in explained
    assert [note[: len(word)] for note, word in zip(others, words, strict=True)] == words


# --- what may be compared


@pytest.mark.parametrize(
    ("count", "refused"), [(1, True), (2, False), (13, False), (200, False), (201, True)], ids=str
)
def test_two_to_200_items_are_compared(count: int, refused: bool, tmp_path: Path) -> None:
    folders = [tmp_path / str(number) for number in range(count)]
    for folder in folders:
        folder.mkdir()
    if refused:
        with pytest.raises(ConfigurationError, match=f"trials to compare: {count}"):
            comparison.open_compared(folders, None)
    else:
        trials, numbers = comparison.open_compared(folders, None)
        assert [trial.path for trial in trials] == folders
        assert numbers.tolist() == [*range(count)]


def test_conditions_number_their_trials(tmp_path: Path) -> None:
    for name in "abc":
        (tmp_path / name).mkdir()
    given = {"gel": [tmp_path / "b"], "sock": [tmp_path / "a", tmp_path / "c"]}
    trials, numbers = comparison.open_compared((), given)
    assert [trial.name for trial in trials] == ["b", "a", "c"]
    assert numbers.tolist() == [0, 1, 1]


@pytest.mark.parametrize(
    ("items", "conditions", "fact"),
    [
        (["a"], {"x": ["b"]}, "1 trials and also conditions"),
        ([], {"x": ["a"], "y": []}, "the condition 'y' has no trial"),
        ([], {"x": ["a"]}, "conditions to compare: 1"),
        (["a", "m.json"], None, "compare takes trials"),
        (["a", "s.YAML"], None, "compare takes trials"),
        (["a", "a"], None, "is given twice"),
    ],
    ids=["both", "empty", "one", "model", "socket", "twice"],
)
def test_a_wrong_choice_is_refused(
    items: list[str], conditions: Any, fact: str, tmp_path: Path
) -> None:
    for name in "ab":
        (tmp_path / name).mkdir()
    groups = conditions and {
        name: [tmp_path / item for item in own] for name, own in conditions.items()
    }
    with pytest.raises(ConfigurationError, match=fact):
        comparison.open_compared([tmp_path / item for item in items], groups)


def test_trials_of_one_name_are_told_apart() -> None:
    """By as many folders as that takes."""
    trials: Any = [SimpleNamespace(path=Path(path)) for path in ("/x/a/hold", "/x/b/hold")]
    assert unique_names(trials) == ("a/hold", "b/hold")
    assert unique_names(trials[:1]) == ("hold",)


# --- limits of other verbs


@pytest.mark.parametrize(
    ("choices", "fact"),
    [
        ({"scenario": "rmap"}, "unknown scenario 'rmap'"),
        ({"tissue": "sfot"}, "unknown tissue 'sfot'"),
        ({"duration": 0.5}, "--duration"),
        ({"duration": 36001.0}, "--duration"),
        ({"rate": 0.05}, "--rate"),
        ({"rate": 1001.0}, "--rate"),
        ({"seed": -1}, "--seed"),
        ({"donning": -1}, "--donning"),
        ({"donning": 1, "donning_share": 1.1}, "--donning-share"),
        ({"donning_share": 0.2}, "--donning-share is 0.2, but no donning is given"),
        ({"duration": 1.0, "rate": 1.5}, "--duration times --rate"),
        ({"duration": 1001.0, "rate": 1000.0}, "--duration times --rate"),
    ],
)
def test_a_simulation_has_limits(choices: dict[str, Any], fact: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=fact):
        st.simulate(tmp_path / "new", **choices)
    assert not (tmp_path / "new").exists()


def test_a_simulation_is_as_stated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The paper's errors with their own calibration, and nothing else of it by default."""
    made: list[tuple[Any, ...]] = []
    monkeypatch.setattr(
        "socket_testbed.simulation.trial.simulate",
        lambda *given, **more: made.append((*given[2:], more["tissue"], given[1])),
    )
    monkeypatch.setattr(
        "socket_testbed.simulation.trial.write_simulated_trial",
        lambda made, folder, *files: folder.mkdir(),
    )
    st.simulate(tmp_path / "a", "ramp", duration=30, rate=2.0, seed=3)
    st.simulate(tmp_path / "b", tissue="stiff", like_paper=True)
    plain, paper = made
    assert plain[:6] == ("ramp", 30, 2.0, 3, None, "soft")
    assert paper[:4] == ("static_hold", 120.0, 4.0, 0) and paper[5] == "stiff"
    assert paper[4].force_creep == 4.0 and paper[4].moment_creep == 0.9
    ranges = [np.ptp(next(iter(each[6].clusters.values())).mean_range) for each in made]
    assert ranges[1] > ranges[0]


DEFAULTS = {
    **dict.fromkeys(("fit", "evaluate", "force_map", "pressure", "pareto", "paper"), "plateau"),
    **dict.fromkeys(("compare", "write_report"), "plateau"),
    **dict.fromkeys(("cycles", "validate", "export"), "all"),
}


@pytest.mark.parametrize("verb", DEFAULTS)
def test_a_verb_has_its_usual_segment(verb: str) -> None:
    given = inspect.signature(getattr(st, verb)).parameters
    assert given["segment"].default == DEFAULTS[verb]


def test_scenarios_and_tissues_have_their_names() -> None:
    assert SCENARIOS == ("static_hold", "ramp", "multi_direction", "protocol")
    assert TISSUES == ("soft", "stiff")


def test_metadata_is_kept_unless_given(tmp_path: Path) -> None:
    folder = scene.write(tmp_path / "trial")
    found = st.annotate(folder, mass=70.5, liner="gel", remove=["socket"])
    assert found.columns() | {"trial_notes": None} == {
        "subject": "S01", "side": "right", "socket": None, "liner": "gel", "mass [kg]": 70.5,
        "operator": None, "protocol": None, "trial_notes": None,
    }  # fmt: skip
    assert st.annotate(folder) == found
