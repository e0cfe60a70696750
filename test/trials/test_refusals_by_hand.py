"""Whole lines about segments, events, metadata, recomputed trials and stored files, by hand."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import scene
from support.problems import GEOMETRY, make_samples

from socket_testbed.errors import ConfigurationError, TestbedError, TrialError
from socket_testbed.samples import Samples
from socket_testbed.settings.acquisition import LoadCellSettings
from socket_testbed.settings.identification import PlateauSettings
from socket_testbed.trials import events, metadata, reprocess, segment, synchronise
from socket_testbed.trials.events import Event
from socket_testbed.trials.metadata import TrialMetadata, change_metadata
from socket_testbed.trials.synchronise import Measurements
from socket_testbed.trials.trial import Trial
from socket_testbed.wire import topics

SETTINGS = PlateauSettings()


def line(call: Callable[[], object], kind: type[TestbedError] = TestbedError) -> str:
    """The error of a call."""
    with pytest.raises(kind) as found:
        call()
    return str(found.value)


# --- segments and events


def samples(load: np.ndarray | float) -> Samples:
    """60 s at 4 Hz under this force along -z [N]."""
    wrench = np.zeros((240, 6))
    wrench[:, 5] = -np.asarray(load)
    return make_samples(np.zeros((240, 6)), wrench, {"a": np.zeros((240, 3))})


MOVING = samples(100.0 + 60.0 * np.sin(np.arange(240)) * (np.arange(240) >= 40))
MOVING.wrench[:40, 5] = 0.0  # 10 s without load


def select(specification: str, found: Samples = MOVING) -> segment.Segment:
    return segment.select_segment(found, specification, SETTINGS)


NAMED_SEGMENTS = "give plateau, hold, auto, all, T0:T1 in seconds, or event:A:B"
SEGMENTS: dict[str, tuple[str, Samples, str]] = {
    "misspelt": (
        *("platau", MOVING),
        f"unknown segment 'platau': did you mean 'plateau'? {NAMED_SEGMENTS}",
    ),
    "unknown": ("xyz", MOVING, f"unknown segment 'xyz': {NAMED_SEGMENTS}"),
    "reversed": (
        *("9:3", MOVING),
        "the segment is '9:3': give seconds as T0:T1, the earlier first, such as 12.5:60",
    ),
    "beyond": (
        *("80:90", MOVING),
        "the segment 80:90 s holds 0 samples: give seconds within 0:59.8",
    ),
    "one sample": (
        *("3:3.2", MOVING),
        "the segment 3:3.2 s holds 1 samples: give seconds within 0:59.8",
    ),
    "no hold": (
        *("hold", MOVING),
        "no hold of 5 s or more in the 59.8 s of the trial: give --segment 10.00:59.75 (the part"
        " under load), --segment auto, or other limits (plateau.*)",
    ),
    "no plateau": (
        *("plateau", samples(0.0)),
        "no plateau of 5 s or more in the 59.8 s of the trial: give --segment all or --segment"
        " T0:T1, or other limits (plateau.*)",
    ),
    "empty": ("all", MOVING[:0], "the trial holds no sample: record it again"),
}


@pytest.mark.parametrize("case", SEGMENTS)
def test_a_segment_is_refused_with_this_line(case: str) -> None:
    specification, found, expected = SEGMENTS[case]
    assert line(lambda: select(specification, found)) == expected


MARKED = [
    Event("placed", 11.0, "found"),
    Event("push", 15.0, "recorded"),
    Event("push", 20.0, "recorded"),
    Event("removed", 41.25, "found"),
]
ENDS: dict[str, tuple[Sequence[Event], str]] = {
    "event:plced:removed": (
        MARKED,
        "the trial has no event 'plced': did you mean 'placed'? it has placed (once), push (2"
        " times), removed (once)",
    ),
    "event:step:removed": (
        MARKED,
        "the trial has no event 'step': it has placed (once), push (2 times), removed (once)",
    ),
    "event:placed:removed": (
        [],
        "the trial has no event 'placed': it has none: mark events (mark LABEL), or give T0:T1",
    ),
    "event:push#3:removed": (
        MARKED,
        "the trial has no 'push#3': 'push' happens 2 times: give #1 to #2",
    ),
    "event:placed#0:removed": (
        MARKED,
        "the trial has no 'placed#0': 'placed' happens once: give #1 to #1",
    ),
    "event:removed:push": (MARKED, "no 'push' is after 41.25 s: the last 'push' is at 20.00 s"),
    "event:removed+2:push+1": (
        MARKED,
        "no 'push+1' is after 43.25 s: the last 'push' is at 20.00 s",
    ),
    "event:placed:9": (
        MARKED,
        "the segment 'event:placed:9' ends at 9.00 s, its start is at 11.00 s: give the earlier end"
        " first",
    ),
    "event:push": (
        MARKED,
        "the segment 'event:push' does not have two ends: give event:A:B, such as"
        " event:placed+5:removed-2 or event:push#2:80",
    ),
}


@pytest.mark.parametrize("specification", ENDS)
def test_ends_of_a_segment_are_refused_with_this_line(specification: str) -> None:
    known, expected = ENDS[specification]
    assert line(lambda: events.event_span(specification, known)) == expected


def test_a_label_has_its_rules() -> None:
    assert line(lambda: events.check_label("2nd")) == (
        "'2nd' is not a label of an event: begin with a letter; letters, digits, blanks, '_', '.'"
        " and hyphens before a letter may follow, such as 'heel-strike 2', 99 characters at most"
    )
    assert events.check_label("a" * 99) == "a" * 99
    assert line(lambda: events.check_label("a" * 100)).startswith("'aaa")
    assert line(lambda: events.check_label("push ")).startswith("'push ' is not a label")


def test_an_event_is_told_with_its_source() -> None:
    assert str(Event("push", 15.0, "recorded")) == "push at 15.00 s (recorded)"


@pytest.mark.parametrize(
    ("away", "kept"), [(0.9, False), (1.1, True), (-0.9, False), (-1.1, True)], ids=str
)
def test_a_tare_is_no_load(away: float, kept: bool) -> None:
    tared = Event(f"{topics.TARE} load_cell", 30.0, "recorded")
    placed = Event("placed", 30.0 + away, "found")
    found = events.join_events([tared], [placed])
    assert found == sorted([tared, *[placed] * kept], key=lambda event: event.time)


# --- metadata

FIELDS: dict[str, tuple[dict[str, Any], str]] = {
    "number": ({"socket": 3}, "socket is 3, not a text: give a text, in quotes in YAML"),
    "empty": ({"liner": "  "}, "liner is empty: give a text or leave it out"),
    "control": ({"notes": "a\x07"}, "notes holds a control character: give printable text"),
    "long": ({"protocol": "a" * 81}, "protocol has 81 characters: give 80 at most"),
    "long notes": ({"notes": "a" * 2001}, "notes has 2001 characters: give 2000 at most"),
    "name": (
        {"subject": "Jane Doe"},
        "subject is 'Jane Doe', with a space: give a code such as S01, never a name",
    ),
    "operator": (
        {"operator": "J D"},
        "operator is 'J D', with a space: give initials or a code",
    ),
    "side": ({"side": "rihgt"}, "side is 'rihgt': did you mean 'right'?"),
    "other side": ({"side": "both"}, "side is 'both': use one of left, right"),
    "light": ({"mass": 4.9}, "mass is 4.9: give a number from 5 to 400: the body mass [kg]"),
    "heavy": ({"mass": 401}, "mass is 401: give a number from 5 to 400: the body mass [kg]"),
    "no mass": (
        {"mass": "much"},
        "mass is 'much': give a number from 5 to 400: the body mass [kg]",
    ),
}


@pytest.mark.parametrize("case", FIELDS)
def test_a_field_is_refused_with_this_line(case: str) -> None:
    given, expected = FIELDS[case]
    assert line(lambda: TrialMetadata(**given), ConfigurationError) == expected


def test_fields_at_their_limits_are_taken() -> None:
    TrialMetadata(mass=5.0, protocol="a" * 80, notes="a" * 2000)
    assert TrialMetadata(mass=400.0, socket="PTB   3").socket == "PTB 3"


def test_a_field_that_is_removed_must_exist() -> None:
    assert line(lambda: change_metadata(TrialMetadata(), {}, ["mas"])) == (
        "remove is 'mas': did you mean 'mass'?"
    )
    before = TrialMetadata(subject="S01", mass=60.0)
    after = change_metadata(before, {"subject": None, "side": "left"}, ["mass", "side"])
    assert after == TrialMetadata(subject="S01", side="left")


def test_metadata_are_written_with_their_unit(tmp_path: Path) -> None:
    path = tmp_path / "trial.yaml"
    metadata.write_metadata(TrialMetadata(subject="007", mass=61.5), path)
    assert path.read_text().splitlines() == [
        "# Metadata of this trial; the mass in kg. 'socket-testbed annotate' changes it.",
        'subject: "007"',
        "mass: 61.5",
    ]
    assert metadata.read_metadata(path) == TrialMetadata(subject="007", mass=61.5)
    path.write_text("masss: 61.5\n")
    assert line(lambda: metadata.read_metadata(path)) == (
        f"{path}: unknown key 'masss': did you mean 'mass'?"
    )


# --- recomputed measurements

MATRIX = tuple(np.eye(6).ravel().tolist())
NO_MATRIX = LoadCellSettings()
CELL = replace(NO_MATRIX, matrix=MATRIX, full_scale=(500.0, 500.0, 1000.0, 20.0, 20.0, 20.0))


def measured(count: int = 9, fz: float = 15.0) -> Measurements:
    """One a second; a tare of 5 N was taken off Fz."""
    wrench, tares = np.zeros((count, 6)), np.zeros((count, 6))
    wrench[:, 5], tares[:, 5] = fz, 5.0
    rest = np.tile(np.eye(7)[6], (count, 1))
    return Measurements(
        np.arange(count) * 10**9, wrench, rest, rest, ("distal",), np.full((count, 1, 4), 5.0),
        np.zeros((count, 1, 4), np.uint8), np.zeros((count, 6)), tares,
        np.zeros(count, np.int64), {},
    )  # fmt: skip


def remade(
    given: LoadCellSettings | None, tare: str, recorded: LoadCellSettings = NO_MATRIX
) -> list[str]:
    notes: list[str] = []
    reprocess.remake_wrenches(measured(), recorded, given, tare, "s01", notes.append)
    return notes


def test_other_settings_than_recorded_have_this_line() -> None:
    """Ratios of zero are no 20 N."""
    assert line(lambda: remade(CELL, "recorded", CELL)) == (
        "s01: its testbed.yaml's load cell does not match the recorded wrenches: remove"
        " load_cell_node from that file: the ratios are then used as they are"
    )


def test_a_tare_without_its_matrix_has_this_line() -> None:
    assert line(lambda: remade(CELL, "recorded")) == (
        "s01: does not store the load cell's matrix, with which its tare was computed: give --tare"
        " as well: T0:T1 without load, or none"
    )
    assert len(remade(CELL, "none")) == 1


TARES = {
    "beyond": (
        lambda: remade(None, "20:30"),
        "s01: --tare 20:30 holds no wrench: give seconds since the first sample, from 0 to 8",
    ),
    "reversed": (
        lambda: reprocess.parse_tare("5:2"),
        "--tare is '5:2': give seconds as T0:T1, the earlier first, such as 12.5:60, or none,"
        " recorded",
    ),
    "three spans": (
        lambda: reprocess.check_unloaded(((0, 1), (2, 3), (4, 5))),
        "--unloaded has 3 spans: give one before, or one before and one after",
    ),
    "overlap": (
        lambda: reprocess.check_unloaded(((0, 5), (4, 8))),
        "--unloaded: 4:8 does not begin after 0:5: give the span before the load first, the one"
        " after it second",
    ),
    "no span": (
        lambda: reprocess.parse_unloaded(["5"]),
        "--unloaded is '5': give seconds as T0:T1, the earlier first, such as 12.5:60",
    ),
    "markers": (
        lambda: reprocess.refit_poses(
            replace(measured(), markers={"pylon": np.zeros((9, 4, 3))}),
            GEOMETRY, ("pylon",), "s01", lambda note: None,
        ),
        "s01: 4 markers of the pylon were recorded, and the geometry has 3: give the socket.yaml"
        " of this trial's marker bodies with --geometry",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", TARES)
def test_a_correction_is_refused_with_this_line(case: str) -> None:
    call, expected = TARES[case]
    assert line(call) == expected


def test_a_moving_load_is_no_tare() -> None:
    """0, 0 and 30 N along y in three seconds: 14.1 N."""
    given = measured()
    given.wrench[4, 4] = 30.0
    call = lambda: reprocess.remake_wrenches(  # noqa: E731
        given, NO_MATRIX, None, "2:4", "s01", lambda note: None
    )
    limit = NO_MATRIX.tare_force
    assert line(call) == (
        f"s01: --tare 2:4: Fy moves by 14.1 N (standard deviation), more than {limit:g} N: give a"
        " span without load, at rest"
    )


def test_a_loaded_span_names_a_better_one() -> None:
    """From 0 to 19 s 15 N, then 60 N."""
    given = measured(40)
    given.wrench[20:, 5] = 60.0
    call = lambda: reprocess.correct_measurements(  # noqa: E731
        given, [(25.0, 30.0)], scene.calibration(), 30.0, "s01", lambda note: None
    )
    assert line(call) == (
        "s01: 25:30 is not without load, the load cell measured 60 N there: give a span as at 0.0"
        " s, where it measured 15 N"
    )


@pytest.mark.parametrize(
    ("baseline", "unused"),
    [(4.0, "; the stored baseline is not used"), (None, "")],
    ids=["stored", "none"],
)
def test_two_loaded_spans_are_noted(baseline: float | None, unused: str) -> None:
    """Each with its own load, of which 30 N would be none."""
    given, notes, calibration = measured(fz=40.0), list[str](), scene.calibration()
    given.wrench[6:, 5] = 52.0
    own = calibration.clusters["distal"]
    stored = None if baseline is None else np.full(4, baseline)
    clusters = {"distal": replace(own, baseline=stored)}
    calibration = replace(calibration, clusters=clusters)
    reprocess.correct_measurements(
        given, [(0.0, 2.0), (6.0, 8.0)], calibration, 30.0, "s01", notes.append
    )
    assert notes == [
        "the load cell measured 40 N in 0:2, 52 N in 6:8: creep of the limb there counts as drift"
        f" of the clusters; give spans with the limb out of the socket{unused}",
        "distal drifted by +0.00 kPa normal, +0.00 and +0.00 kPa shear between the spans,"
        " corrected",
    ]


# --- what a bag lacks


def bag(*missing: topics.Topic) -> Any:
    """An open bag without messages on some topics."""
    types = {f"/{topic.name}": topic.type for topic in topics.TOPICS}
    counts = {name: 0 if name[1:] in {own.name for own in missing} else 9 for name in types}
    return SimpleNamespace(types=types, counts=counts, path=Path("s01"), blocks=lambda names: ())


LACKING = {
    topics.LOAD_CELL_RAW: (
        "s01: holds no 'load_cell/raw', so its wrenches cannot be recomputed: leave out --load-cell"
        " and --tare"
    ),
    topics.MARKERS: (
        "s01: holds no 'mocap/markers', so its poses cannot be refitted to other markers: give"
        " --geometry with the trial's own"
    ),
}


@pytest.mark.parametrize("topic", LACKING, ids=lambda topic: topic.name)
def test_what_a_correction_needs_has_this_line(topic: topics.Topic) -> None:
    call = lambda: synchronise.read_measurements(bag(topic), lambda note: None, [topic])  # noqa: E731
    assert line(call) == LACKING[topic]


def test_missing_positions_are_noted_first() -> None:
    """Then poses are not refitted either, and other topics are still required."""
    notes: list[str] = []
    given = bag(topics.PYLON_POSE, topics.LOAD_CELL_RAW, topics.MARKERS)
    more = [topics.MARKERS, topics.LOAD_CELL_RAW]
    found = line(lambda: synchronise.read_measurements(given, notes.append, more))
    assert found == LACKING[topics.LOAD_CELL_RAW]
    assert notes == ["the trial has no limb positions: a fit and the limb's motion need them"]


@pytest.mark.parametrize("size", [1.1e6, -1.1e6, 0.9e6], ids=["high", "low", "possible"])
def test_impossible_values_are_missing(size: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of a wrench, at the first of three stamps."""
    stamps = np.arange(3) * 10**9
    wrench = np.zeros((3, 6))
    wrench[0, :2] = size
    series: dict[Any, Any] = {
        (topics.TRIGGER, topics.TRIGGER.name): [stamps],
        (topics.WRENCH, topics.WRENCH.name): [stamps, wrench],
        (topics.CAPACITANCE, "a"): [stamps, np.full((3, 4), 5.0), np.zeros((3, 4), np.uint8)],
    }
    monkeypatch.setattr(synchronise, "_read_series", lambda bag, wanted, notify: dict(series))
    notes: list[str] = []
    found = synchronise.read_measurements(bag(), notes.append)
    if abs(size) < 1e6:
        assert notes == [] and found.wrench[0, 0] == size
        return
    assert np.isnan(found.wrench[0, :2]).all() and (found.wrench[1:] == 0.0).all()
    assert notes == [
        "load_cell/wrench holds 2 values beyond 1e+06, which count as missing: check the recording"
    ]


def test_two_testbeds_in_a_bag_have_this_line() -> None:
    types = {"/left/trigger": topics.TRIGGER.type, "/right/trigger": topics.TRIGGER.type}
    assert line(lambda: topics.match_topics(types, "s01")) == (
        "s01: two topics are a 'trigger': /left/trigger and /right/trigger: record one testbed per"
        " trial"
    )


def test_a_wrong_namespace_has_this_line() -> None:
    assert line(lambda: topics.full_namespace("2nd")) == (
        "'2nd' is not a namespace: give one such as /left, or /"
    )


# --- files of a trial


@pytest.fixture
def trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Trial:
    """A folder that counts as a trial, without any configuration."""
    monkeypatch.setattr(Trial, "open", lambda self: nullcontext())
    return Trial(tmp_path)


@pytest.mark.parametrize(
    ("name", "path"),
    [("socket.yaml", "geometry_path"), ("calibration.yaml", "calibration_path")],
    ids=["socket", "calibration"],
)
def test_missing_files_name_their_options(name: str, path: str, trial: Trial) -> None:
    assert line(lambda: getattr(trial, path), TrialError) == (
        f"{trial.path}: no {name} is stored in this trial: give the missing files with"
        " --geometry and --calibration"
    )


def test_a_part_of_a_trial_names_its_folder(trial: Trial) -> None:
    part = trial.path / "a.mcap"
    part.touch()
    assert line(lambda: Trial(part).geometry_path) == (
        f"{part}: no socket.yaml is stored in this trial: give the trial's folder, {trial.path}, or"
        " the missing files with --geometry and --calibration"
    )


def test_wrong_metadata_are_left_out_with_a_note(trial: Trial) -> None:
    path = trial.path / "trial.yaml"
    path.write_text("mass: 1\n")
    assert trial.metadata == TrialMetadata()
    assert trial.notes == [
        f"the metadata are left out: {path}: mass is 1: give a number from 5 to 400: the"
        " body mass [kg]"
    ]


def test_unknown_markers_leave_the_poses(trial: Trial, tmp_path: Path) -> None:
    (trial.path / "socket.yaml").write_text("- 1\n")
    other = replace(trial, socket_file=tmp_path / "other.yaml")
    assert other.remade == ()
    assert other.notes == [
        f"the poses stay as recorded, with unknown markers: {trial.path}/socket.yaml is a list of"
        " 1: give 'key: value' lines"
    ]


def test_a_cluster_on_no_tile_has_this_line(trial: Trial) -> None:
    geometry = scene.geometry()
    kept = {name: tile for name, tile in geometry.clusters.items() if name != "brim_lateral"}
    geometry = replace(geometry, clusters=kept)
    vars(trial).update(calibration=scene.calibration(), geometry=geometry)
    assert line(lambda: trial._require_clusters(["brim_lateral"]), TrialError) == (
        f"the cluster 'brim_lateral' of the trial {trial.path} is on no tile of the socket (which"
        " has mid_anterior, posterior_distal, distal): give the socket.yaml of this trial with"
        " --geometry"
    )


def test_corrections_are_those_of_the_trial(tmp_path: Path) -> None:
    made = Trial(tmp_path, unloaded=((0.0, 1.0),), tare="none", load_cell_file=Path("t.yaml"))
    assert made.replaced == {"unloaded": [[0.0, 1.0]], "tare": "none", "load_cell": "t.yaml"}
    assert Trial(tmp_path).replaced == {"unloaded": [], "tare": "recorded", "load_cell": "recorded"}
    assert made.remade == (topics.LOAD_CELL_RAW,) and Trial(tmp_path).remade == ()
