"""Messages and stamps as a trial reads them, and its pressure outputs as text, by hand."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import scene
from support.wording import refused

from socket_testbed.errors import TrialError
from socket_testbed.identification.pressure import Quantity
from socket_testbed.identification.suspension import Suspension
from socket_testbed.results import pressure, pressure_text
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials import synchronise
from socket_testbed.trials.trial import Trial, _fingerprint
from socket_testbed.wire import cdr, messages, topics
from socket_testbed.wire.messages import Reader

SECOND = 10**9  # [ns]


# --- messages


def capacitances(names: list[str], stamp: int = 5) -> bytes:
    values = np.arange(4.0 * len(names)).reshape(-1, 4)
    return messages.capacitance_packer(names)(stamp, values, np.zeros((len(names), 4), np.uint8))


def test_clusters_that_share_a_name_are_missing() -> None:
    _, read = Reader(topics.CAPACITANCE).read(capacitances(["a", "b", "a"]))
    assert read.names == ("a", "b", "a")
    assert read.status.tolist() == [[2] * 4, [0] * 4, [2] * 4]
    assert np.isnan(read.capacitance[[0, 2]]).all()
    assert read.capacitance[1].tolist() == [4.0, 5.0, 6.0, 7.0]


def test_stresses_are_in_the_order_of_the_names() -> None:
    given = {"b": (np.array([1.0, 2.0, 3.0]), 3), "a": (np.array([4.0, 5.0, 6.0]), 0)}
    stress, status = messages.in_order(given, ["a", "none", "b"])
    np.testing.assert_array_equal(stress, [[4, 5, 6], [np.nan] * 3, [1, 2, 3]])
    assert status.tolist() == [0, 2, 3]
    assert messages.in_order({}, [])[0].shape == (0, 3)


def test_messages_of_several_layouts_are_read_in_parts() -> None:
    """Those that cannot be decoded are left out."""
    data = [
        capacitances(["a"], 10),
        capacitances(["a", "b"], 11),
        b"damaged",
        capacitances(["a"], 12),
    ]
    reader = Reader(topics.CAPACITANCE, "a bag")
    parts = {
        values.names: (places.tolist(), stamps.tolist(), values.capacitance.shape)
        for places, stamps, values in reader.parts(data)
    }
    assert parts == {("a",): ([0, 3], [10, 12], (2, 1, 4)), ("a", "b"): ([1], [11], (1, 2, 4))}
    (error,) = reader.refused
    start = "a bag: a message on clusters/capacitance cannot be decoded ("
    assert error.fact.startswith(start)
    assert error.hint == "check that it was recorded or sent with this version's messages"


def test_forgotten_layouts_are_read_again() -> None:
    data = [capacitances(["a"] * (1 + k % 12), k) for k in range(36)]
    reader = Reader(topics.CAPACITANCE)
    found = {int(s): len(v.names) for _, stamps, v in reader.parts(data) for s in stamps}
    assert found == {k: 1 + k % 12 for k in range(36)}
    assert [len(reader.read(own)[1].names) for own in data] == [1 + k % 12 for k in range(36)]


@pytest.mark.parametrize("kind", sorted(messages.VALUES))
def test_an_empty_message_has_values(kind: str) -> None:
    """Another program may send one: names, sequences and numbers are blank."""
    topic = next(topic for topic in topics.TOPICS if topic.type == kind)
    stamp, _ = Reader(topic).read(cdr.encode(cdr.make_message(kind), kind))
    assert stamp == 0


def test_large_messages_are_read_and_forgotten() -> None:
    """A layout takes 60 times the memory of its message: 4000 clusters' message is of 0.3 MB."""
    reader = Reader(topics.CAPACITANCE)
    for count in (3, 4000, 1000, 900):
        _, found = reader.read(capacitances([f"c{k}" for k in range(count)]))
        assert len(found.names) == count and found.capacitance[-1, -1] == 4.0 * count - 1.0
    assert sum(layout.dtype.itemsize for layout, _ in reader._known) <= 2**18


def test_a_damaged_message_is_refused() -> None:
    with refused(TrialError, "this graph: a message on trigger cannot be decoded ("):
        Reader(topics.TRIGGER).read(b"no message")


@pytest.mark.parametrize(
    ("topic", "content", "why"),
    [
        (topics.LOCAL_FORCES, {"forces": [None] * 3}, "3 forces for 2 names"),
        (topics.FORCE_MAP, {"forces": [None] * 2}, "0 standard_deviations for 2 names"),
        (topics.REGIONS, {"mean": [0.0] * 2, "mean_low": [0.0]}, "1 mean_low for 2 names"),
    ],
    ids=["forces", "map", "regions"],
)
def test_arrays_of_unequal_lengths_are_refused(
    topic: topics.Topic, content: dict[str, Any], why: str
) -> None:
    """The names are of two tiles."""
    message = cdr.make_message(topic.type, names=["a", "b"], **content)
    data = cdr.encode(message, topic.type)
    with refused(TrialError, f"this graph: a message on {topic.name} cannot be decoded ({why})"):
        Reader(topic).read(data)


def test_a_stamp_of_a_second_s_nanoseconds_is_refused() -> None:
    """It is no time, and could not be passed on: its seconds could overflow."""
    stamp = {"sec": 2**31 - 1, "nanosec": 2**32 - 1}
    message = cdr.make_message(topics.TRIGGER.type, header={"stamp": stamp})
    with refused(TrialError, "this graph: a message on trigger cannot be decoded (its stamp has"):
        Reader(topics.TRIGGER).read(cdr.encode(message, topics.TRIGGER.type))


@pytest.mark.parametrize("counts", [(3, 0), (0, 3), (0, 0)], ids=["last", "first", "both"])
def test_a_body_without_markers_is_packed(counts: tuple[int, int]) -> None:
    seen = [np.full((count, 3), 0.25) for count in counts]
    data = messages.markers_packer(dict(zip("ab", counts, strict=True)))(7, seen)
    stamp, found = Reader(topics.MARKERS).read(data)
    assert stamp == 7 and [name for name, _ in found] == ["a", "b"]
    assert [markers.tolist() for _, markers in found] == [markers.tolist() for markers in seen]


def test_raw_ratios_are_read_in_millivolts_per_volt() -> None:
    pack = messages.load_cell_raw_packer()
    tare = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    stamp, read = Reader(topics.LOAD_CELL_RAW).read(pack(7, np.arange(6.0), tare, 3, 0))
    assert stamp == 7 and read.tared == 3
    assert read.ratios.tolist() == pytest.approx([0, 1, 2, 3, 4, 5])
    assert read.tare.tolist() == [1, 2, 3, 4, 5, 6]


def test_bodies_have_their_own_markers() -> None:
    pack = messages.markers_packer({"socket": 3, "pylon": 1})
    own = [np.arange(9.0).reshape(3, 3), np.array([[7.0, 8.0, 9.0]])]
    _, read = Reader(topics.MARKERS).read(pack(1, own))
    assert [name for name, _ in read] == ["socket", "pylon"]
    for (_, found), expected in zip(read, own, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_a_vector_is_named_by_its_axes() -> None:
    assert messages.named(np.array([1.0, 2.0, 3.0])) == {"x": 1.0, "y": 2.0, "z": 3.0}
    assert messages.named(np.arange(4.0)) == {"x": 0.0, "y": 1.0, "z": 2.0, "w": 3.0}


# --- names in a graph


@pytest.mark.parametrize(
    ("name", "namespace", "full"),
    [
        ("trigger", "/", "/trigger"),
        ("trigger", "", "/trigger"),
        ("trigger", "/left", "/left/trigger"),
        ("trigger", "/left/", "/left/trigger"),
        ("/a/b", "/left", "/a/b"),
    ],
)
def test_a_name_is_in_its_namespace(name: str, namespace: str, full: str) -> None:
    assert topics.full_name(name, namespace) == full


@pytest.mark.parametrize(
    ("given", "full"), [("left", "/left"), ("/", "/"), ("", "/"), ("/a/b_1/", "/a/b_1")]
)
def test_a_namespace_is_absolute(given: str, full: str) -> None:
    assert topics.full_namespace(given) == full


@pytest.mark.parametrize("given", ["1a", "a b", "a//b", "a/1"])
def test_a_wrong_namespace_is_refused(given: str) -> None:
    with pytest.raises(Exception, match="is not a namespace: give one such as /left, or /"):
        topics.full_namespace(given)


def test_a_topic_s_namespace_is_what_stands_before_it() -> None:
    assert topics.namespace_of("/lab/trigger", topics.TRIGGER) == "/lab"
    assert topics.namespace_of("/mocap/socket/pose", topics.SOCKET_POSE) == ""


def test_a_topic_in_two_namespaces_is_refused() -> None:
    kinds = dict.fromkeys(["/a/event", "/b/event"], topics.EVENT.type)
    with refused(TrialError, "s01: two topics are a 'event': /a/event and /b/event: record one"):
        topics.match_topics(kinds, "s01")


# --- stamps

Series = dict[tuple[topics.Topic, str], list[Any]]


def series(**own: list[float]) -> Series:
    """Columns of topics by their stamps [s]."""
    by_name = {topic.name.rpartition("/")[2]: topic for topic in (topics.WRENCH, topics.TRIGGER)}
    return {
        (by_name[name], by_name[name].name): [(1e9 * np.array(stamps)).astype(np.int64)]
        for name, stamps in own.items()
    }


DAY = 24 * 3600.0


@pytest.mark.parametrize(("apart", "lost"), [(DAY, 0), (DAY + 1.0, 1)], ids=["a day", "more"])
def test_stamps_a_day_off_are_left_out(apart: float, lost: int) -> None:
    notes: list[str] = []
    own = series(wrench=[0.0, 1.0, 1.0 + apart], trigger=[0.0, 1.0, 1.0])
    synchronise._drop_strays(own, notes.append)
    assert len(own[topics.WRENCH, "load_cell/wrench"][0]) == 3 - lost
    words = "stamps that are days from the others are left out: load_cell/wrench (1)"
    assert notes == [words] * lost


def test_jumps_and_doubles_are_noted_for_all_topics() -> None:
    own = series(wrench=[5.0, 7.0, 6.0, 6.0], trigger=[5.0, 7.0, 6.0, 6.0])
    names = "load_cell/wrench, trigger"
    assert [*synchronise._stamp_notes(own)] == [
        f"the stamps of {names} jump back, once (from 2.00 s to 1.00 s); samples are in the order"
        " of their stamps: check the clock of the recording",
        f"the stamps of {names} are doubled, once (at 1.00 s): 1 earlier values are replaced by"
        " later ones",
    ]


def test_the_last_of_doubled_values_counts() -> None:
    own = [np.array([3, 1, 3]), np.array([[1.0], [2.0], [4.0]]), np.array([[0], [1], [3]], "u1")]
    values, status = synchronise._rows(own, np.array([1, 2, 3]))
    np.testing.assert_array_equal(values, [[2.0], [np.nan], [4.0]])
    assert status.tolist() == [[1], [2], [3]]


def test_markers_count_up_to_the_last_seen() -> None:
    seen = np.full((3, 5, 3), np.nan)
    assert synchronise.marker_count(seen) == 0
    seen[2, 3, 1] = 1.0
    assert synchronise.marker_count(seen) == 4


# --- pressure outputs as text


def test_columns_are_place_by_place() -> None:
    values = {"mean [kPa]": np.array([[1.0, 2.0], [3.0, 4.0]]), "peak [kPa]": np.zeros((2, 2))}
    found = pressure.by_place(["a", "b"], values)
    assert [*found] == ["a.mean [kPa]", "a.peak [kPa]", "b.mean [kPa]", "b.peak [kPa]"]
    assert found["b.mean [kPa]"].tolist() == [2.0, 4.0]


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        scene.stand_in(patch)
        trial = Trial(scene.write(tmp_path_factory.mktemp("scenes") / "scene"))
        yield pressure.map_trial(trial, EstimatorSettings())


def test_the_course_holds_the_peak_besides(mapped: Any) -> None:
    """Five of 96 samples, the peak at row 48, and row 7."""
    found = mapped.course(5, [7])
    rows = (found.samples.stamps - scene.START) // 250_000_000
    assert rows.tolist() == [0, 7, 23, 47, 48, 71, 95]
    assert found.regions.peak.value.shape == (1,)
    assert found.regions.peak.value[0] == pytest.approx(60e3)


@pytest.mark.parametrize(("threshold", "area"), [(5e3, 27.0), (17e3, 15.65625)])
def test_contact_is_above_the_threshold(threshold: float, area: float, mapped: Any) -> None:
    """At 17 kPa `ant_mid` (40) is always in contact; the others at factors above 17/16, 17/15.

    These hold in 45 and 41 of 96 samples; of ten draws, one is 1.96 kPa higher and one lower.
    """
    found = mapped.outputs(threshold=1e-3 * threshold)
    names = [place.name for place in mapped.places]
    own = found.regions.area.value[names.index("anterior")]
    assert 1e4 * own == pytest.approx(area, abs=2.0 if threshold > 5e3 else 1e-9)
    assert found.threshold == threshold


def test_contact_is_told_with_its_threshold(mapped: Any) -> None:
    over = mapped.pressure(7.5)
    assert over.contact == "in contact: above 7.5 kPa; the integrals cover 23.8 s"
    assert over.peak_time == 12.0 and over.time[[0, -1]].tolist() == [0.0, 23.75]


def test_an_unknown_stiffness_says_why() -> None:
    class Moving(Suspension):
        def __init__(self) -> None: ...

        def outputs(self) -> dict[str, Quantity]:
            nan = np.float64("nan")
            return {
                "pistoning [mm]": Quantity(*map(np.float64, (3.0, 2.5, 3.5, 3.0))),
                "stiffness Fx [N/mm]": Quantity(nan, nan, nan, nan),
            }

    found = pressure_text.limb_cells(Moving(), share=0.5)
    assert found["pistoning [mm]"].startswith("3.00 (2.50 to 3.50")
    assert found["stiffness Fx [N/mm]"] == (
        "\N{EN DASH} (the load does not change in every direction)"
    )


# --- what a trial keeps


def test_a_trial_s_corrections_are_listed(tmp_path: Path) -> None:
    plain = Trial(tmp_path / "s01")
    assert plain.replaced == {"unloaded": [], "tare": "recorded", "load_cell": "recorded"}
    assert plain.name == "s01" and repr(plain) == f"Trial({str(tmp_path / 's01')!r})"
    assert plain.remade == ()
    other = Trial(tmp_path, tare="0:5", unloaded=((0.0, 1.0),), load_cell_file=Path("a.yaml"))
    assert other.replaced == {"unloaded": [[0.0, 1.0]], "tare": "0:5", "load_cell": "a.yaml"}
    assert other.remade == (topics.LOAD_CELL_RAW,)


def test_a_fingerprint_is_of_the_first_half_minute(tmp_path: Path) -> None:
    folder = scene.write(tmp_path / "scene")
    first = Trial(folder)
    assert len(first.fingerprint) == 16 and first.fingerprint == Trial(folder).fingerprint


def test_a_fingerprint_ends_at_half_a_minute() -> None:
    """A reading at 30 s counts, one at 30.25 s does not."""

    def at(*times: float, changed: float = -1.0) -> str:
        readings = [[2.0 + (time == changed)] * 4 for time in times]
        measured: Any = SimpleNamespace(time=np.array(times), capacitance=np.array(readings))
        return _fingerprint(measured)

    whole = at(0.0, 30.0, 30.25)
    assert at(0.0, 30.0) == at(0.0, 30.0, 30.25, changed=30.25) == whole
    assert at(0.0) != whole and at(0.0, 30.0, 30.25, changed=30.0) != whole
