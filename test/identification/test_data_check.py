"""Sound trials are good; damaged ones say what to look at, are refused, or propose a cut."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.problems import make_case, make_samples, random_socket
from support.wording import refused

import socket_testbed as st
from socket_testbed.errors import IdentificationError
from socket_testbed.identification import plausibility
from socket_testbed.identification.checked import CheckedSamples
from socket_testbed.identification.data_check import check_data
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.samples import Status
from socket_testbed.simulation.limb import SCENARIOS, TISSUES
from socket_testbed.trials.trial import Trial

ALL = slice(None)


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A trial of every scenario, on soft and on stiff tissue in turn."""
    folder = tmp_path_factory.mktemp("sound")
    for number, name in enumerate(SCENARIOS):
        st.simulate(folder / name, name, tissue=TISSUES[number % 2], seed=90 + number)
    return {name: folder / name for name in SCENARIOS}


@pytest.fixture(scope="module")
def opened(sound: dict[str, Path]) -> dict[str, Trial]:
    """The same trials, whose samples no test changes."""
    return {name: st.open_trial(path) for name, path in sound.items()}


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_sound_trials_are_good(opened, scenario: str) -> None:
    assert st.check_data(opened[scenario]) == ()


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_a_cluster_unlike_the_others_is_named(opened, scenario: str) -> None:
    trial = opened[scenario]
    samples = trial.samples()
    offset = np.zeros_like(samples.local_forces)
    offset[:, 0, 2] = 35e3 * trial.geometry.areas[0]
    spoilt = replace(samples, local_forces=samples.local_forces - offset)
    (found,) = check_data(spoilt, trial.geometry)
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
    "missing channel": ("Fz", ("wrench",), put(np.nan, ALL, 5)),
    "dead cluster": ("distal", ("local_forces",), put(0.0, ALL, 3)),
    "missing cluster": ("distal", ("status",), put(Status.MISSING, ALL, 3)),
    "frozen": ("Fz", ("wrench",), put(-200.0, slice(200, 300), 5)),
    "noise": ("Fx", ("wrench",), lambda v: v + np.random.default_rng(0).normal(0, 60, v.shape)),
    "spike": ("single values", ("wrench",), put(1e5, 50, 5)),
}


@pytest.mark.parametrize("scenario", ["static_hold", "multi_direction"])
@pytest.mark.parametrize(
    ("source", "parts", "damage"), DAMAGED.values(), ids=[n.replace(" ", "-") for n in DAMAGED]
)
def test_a_damaged_copy_says_what_to_look_at(opened, scenario, source, parts, damage) -> None:
    trial = opened[scenario]
    samples = trial.samples()
    arrays = {part: damage(getattr(samples, part)) for part in parts}
    found = check_data(replace(samples, **arrays), trial.geometry)
    assert any(source in finding.source for finding in found), found
    assert all(str(finding).startswith("data: check ") for finding in found)


def test_a_pose_that_jumps_delays_nobody(tmp_path: Path) -> None:
    """Two markers are exchanged after 42 s: compared with the load, the pose seems 10 s early."""
    trial = st.simulate(tmp_path / "t", "multi_direction", tissue="stiff", duration=60, seed=2)
    samples = trial.samples()
    position = samples.position.copy()
    position[samples.time >= samples.time[0] + 42.0] += [0.0, 0.02, 0.02]
    (finding,) = check_data(replace(samples, position=position), trial.geometry)
    assert finding.source == "the limb pose"
    assert "it jumps by 28.3 mm at 42.00 s" in finding.fact


def test_a_finding_hides_no_unrelated_one(opened) -> None:
    trial = opened["protocol"]
    samples = trial.samples()
    pose = {"position": late(samples.position), "rotation": late(samples.rotation)}
    turned = replace(samples, wrench=-samples.wrench)

    def found(damaged) -> list[tuple[str, str]]:
        return [(each.source, each.hint) for each in check_data(damaged, trial.geometry)]

    (wrench, _), (limb, hint), *_ = found(replace(turned, **pose))
    assert (wrench, limb) == ("the wrench", "the limb pose") and "clocks" in hint
    (clusters, hint), (limb, _), *_ = found(replace(samples, wrench=late(samples.wrench)))
    assert (clusters, limb) == ("the clusters", "the limb pose") and "clocks" in hint
    forces = samples.local_forces.copy()
    forces[:, 0] *= -1.0
    (wrench, _), (cluster, hint), *_ = found(replace(turned, local_forces=forces))
    assert (wrench, cluster) == ("the wrench", samples.clusters[0]) and "normal channel" in hint
    hold = opened["static_hold"].samples()[200:400]  # the load hardly changes
    assert found(hold) == []
    assert [source for source, _ in found(replace(hold, wrench=-hold.wrench))] == ["the wrench"]


def test_a_tare_under_load_is_named(opened) -> None:
    """With the mass on, 278 N, the load cell was tared: without it, it reads 187 N of pull."""
    trial = opened["static_hold"]
    samples = trial.samples()
    tared = replace(samples, wrench=samples.wrench - samples.wrench[len(samples) // 2])
    found = check_data(tared, trial.geometry)[0]
    assert found.source == "the wrench" and found.fact.startswith("it pulls at the socket with 18")


@pytest.mark.parametrize(
    ("mass", "text"),
    [
        pytest.param(5.0, "weights of the stated 5 kg", id="too-light"),
        pytest.param(1e5, "weights of the stated 100000 kg", id="too-heavy"),
    ],
)
def test_a_mass_unlike_the_load_is_named(opened, mass: float, text: str) -> None:
    trial = opened["protocol"]
    (found,) = check_data(trial.samples(), trial.geometry, mass=mass)
    assert text in found.fact


def test_few_samples_are_named(opened) -> None:
    trial = opened["protocol"]
    (few,) = check_data(trial.samples()[:20], trial.geometry)
    assert "20 samples are too few" in few.fact


def test_a_channel_that_is_left_out_is_unchecked(opened) -> None:
    trial = opened["protocol"]
    samples = trial.samples()
    spoilt = replace(samples, wrench=samples.wrench * [1, 1, 1e4, 1, 1, 1])
    assert check_data(spoilt, trial.geometry)
    assert not check_data(spoilt, trial.geometry, leave_out=("Mz",))


def test_a_dead_channel_may_be_left_out(opened) -> None:
    trial = opened["protocol"]
    samples = trial.samples()
    wrench, status = samples.wrench * [1, 1, np.nan, 1, 1, 1], samples.status.copy()
    status[:, 0] = Status.MISSING
    dead = replace(samples, wrench=wrench, status=status)
    found = check_data(dead, trial.geometry)
    assert {finding.source for finding in found} == {"Mz", samples.clusters[0]}
    assert not check_data(dead, trial.geometry, leave_out=("Mz", *samples.channels[6:9]))


@pytest.mark.parametrize("end", ["min", "max"])
def test_a_clipped_channel_is_named(opened, end: str) -> None:
    trial = opened["protocol"]
    samples = trial.samples()
    clipped = samples.wrench.copy()
    clipped[::4, 3] = limit = getattr(clipped[:, 3], end)()
    (found,) = check_data(replace(samples, wrench=clipped), trial.geometry)
    assert found.source == "Fx" and f"are at one end, {limit:.3g} N" in found.fact


def test_a_reversed_cluster_is_named(opened) -> None:
    trial = opened["protocol"]
    samples = trial.samples()
    forces = samples.local_forces.copy()
    forces[:, 0] *= -1.0
    (found,) = check_data(replace(samples, local_forces=forces), trial.geometry)
    assert found.source == samples.clusters[0] and "sign" in found.hint


def test_an_intermittent_cluster_does_not_blame_the_wrench(opened) -> None:
    trial = opened["static_hold"]
    hold = trial.samples()[90:200]
    status = hold.status.copy()
    status[::3, hold.clusters.index("distal")] = Status.OUT_OF_RANGE
    (found,) = check_data(replace(hold, status=status), trial.geometry)
    assert found.source == "distal" and "missing or out of range" in found.fact


@pytest.mark.parametrize("rows", [np.s_[:152:4], np.s_[:31]], ids=["slow", "short"])
def test_few_samples_do_not_blame_a_clock(opened, rows: slice) -> None:
    trial = opened["multi_direction"]
    short = trial.samples()[rows]
    assert not [f for f in check_data(short, trial.geometry) if "clocks" in f.hint]


@pytest.fixture(scope="module")
def results_of_hold(opened) -> tuple[np.ndarray, float]:
    """The errors of a fit to the hold, and the pressure there."""
    trial = opened["protocol"]
    errors = st.fit(trial, segment="hold").to_dataframe()["RMSE"]
    return errors, st.pressure(trial, "hold").regions.loc["socket"].iloc[0]


@pytest.mark.parametrize(
    ("places", "force"),
    [
        pytest.param([0], -2e3, id="one"),
        pytest.param([5, 90], -2e3, id="two"),
        pytest.param(range(10, 90, 10), -3e3, id="eight"),
    ],
)
def test_spikes_spoil_neither_fit_nor_pressure(sound, results_of_hold, places, force) -> None:
    """They do not hide each other."""
    errors, pressure = results_of_hold
    rows = st.open_trial(sound["protocol"]).select("hold").rows
    spoilt = st.open_trial(sound["protocol"])
    spoilt.samples().wrench[[rows.start + place for place in places], 5] = force
    assert any("single values" in finding.source for finding in spoilt.problems())
    found = st.fit(spoilt, segment="hold").to_dataframe()["RMSE"]
    np.testing.assert_allclose(found, errors, rtol=0.1)
    assert abs(st.pressure(spoilt, "hold").regions.loc["socket"].iloc[0] - pressure) < 0.5


def test_a_load_that_clusters_feel_is_no_outlier(sound) -> None:
    tapped = st.open_trial(sound["protocol"])
    row = tapped.select("hold", tapped.estimator).rows.start + 20
    tapped.samples().wrench[row] *= 4.0
    tapped.samples().local_forces[row] *= 2.5
    assert not plausibility.find_outliers(tapped.samples(), tapped.geometry).rows.any()


def test_a_trial_without_clusters_is_checked(sound: dict[str, Path]) -> None:
    trial = st.open_trial(sound["protocol"])
    samples = trial.samples()
    forces, status = samples.local_forces[:, :0], samples.status[:, :0]
    bare = replace(samples, clusters=(), local_forces=forces, status=status)
    assert check_data(bare, trial.geometry) == ()


# --- Samples that no limb in a socket gives


LOAD = 200.0  # [N]
TENSION = np.array([0.0, 0.0, 150.0])  # [N], of an offset


@pytest.mark.parametrize(
    ("array", "column", "names"),
    [
        pytest.param("wrench", np.s_[:, 3:], ("F", "likely in millinewtons"), id="force"),
        pytest.param("wrench", np.s_[:], ("M", "likely in newton millimetres"), id="wrench"),
        pytest.param("local_forces", np.s_[:], ("cluster_", "likely in millinewtons"), id="local"),
    ],
)
def test_another_unit_is_refused(array, column, names) -> None:
    geometry, _, samples, _ = make_case(3)
    getattr(samples, array)[column] *= 1000.0
    with refused(IdentificationError, *names):
        CheckedSamples(samples, geometry).part()


@pytest.mark.parametrize("size", [1e-4, 0.0], ids=["tiny", "zero"])
def test_a_wrench_without_a_load_is_refused(size: float) -> None:
    geometry, _, samples, settings = make_case(2)
    samples.wrench[:] = size
    with refused(IdentificationError, "holds no load"):
        fit_contact_model(samples, geometry, settings)
    settings = replace(settings, leave_out=("Mx", "My", "Mz", "Fx", "Fy", "Fz"))
    assert fit_contact_model(samples, geometry, settings).samples == len(samples)


@pytest.mark.parametrize(
    ("array", "place", "value", "name"),
    [
        pytest.param("wrench", (17, 4), 2e3, "Fy has an outlier", id="wrench"),
        pytest.param(
            "local_forces", (17, 1, 2), -1e9, "cluster_1.Fz has an outlier", id="local-force"
        ),
        pytest.param("position", (17, 1), -1e9, "limb position has an outlier", id="position"),
    ],
)
def test_an_outlier_is_left_out_and_noted(array, place, value, name) -> None:
    """With its channel and time."""
    geometry, _, sound, settings = make_case(4)
    without = fit_contact_model(sound[np.arange(len(sound)) != 17], geometry, settings).model
    samples = make_case(4)[2]
    getattr(samples, array)[place] = value
    outliers = plausibility.find_outliers(samples, geometry)
    (note,) = plausibility.outlier_notes(samples, outliers)
    assert note.startswith(name) and "at 4.25 s" in note and note.endswith("left out")
    found = fit_contact_model(CheckedSamples(samples, geometry).part(), geometry, settings)
    assert max(error.rmse for error in found.errors) < 100.0
    assert array == "local_forces" or (found.model.stiffness == without.stiffness).all()


def test_many_outliers_are_refused() -> None:
    geometry, _, samples, settings = make_case(4)
    samples.wrench[::8, 3] = 1e9
    with refused(IdentificationError, "5 of 40 samples are outliers: Fx has 5"):
        CheckedSamples(samples, geometry).part()
    settings = replace(settings, leave_out=("Fx",))  # then it drops no sample
    sound = CheckedSamples(samples, geometry, settings.leave_out).part()
    assert fit_contact_model(sound, geometry, settings).samples == len(samples)


GEOMETRY = random_socket(np.random.default_rng(3))


def loaded():
    """A steady load, with every cluster pressed by a tenth of it."""
    rng = np.random.default_rng(4)
    wrench = rng.normal([1.0, -2.0, 0.5, 3.0, -5.0, -LOAD], 0.3, (100, 6))
    forces = rng.normal([2.0, -1.0, -0.1 * LOAD], 0.3, (len(GEOMETRY.clusters), 100, 3))
    named = dict(zip(GEOMETRY.clusters, forces, strict=True))
    return make_samples(rng.normal(0.0, 1e-4, (100, 3)), wrench, named)


def scaled(samples, column, axis, factor):
    forces = samples.local_forces.copy()
    forces[:, column, axis] *= factor
    return replace(samples, local_forces=forces)


def found(samples) -> list[str]:
    return [proposal.channel for proposal in plausibility.find_implausible(samples, GEOMETRY)]


def test_a_negated_wrench_is_noted() -> None:
    samples = loaded()
    negated = replace(samples, wrench=-samples.wrench)
    note = plausibility.sign_note(negated, GEOMETRY) or ""
    assert "wrench looks negated" in note and "200 N" in note and "3 of 3 clusters" in note


@pytest.mark.parametrize(
    ("share", "noted"),
    [pytest.param(0.9, False, id="lighter"), pytest.param(1.1, True, id="heavier")],
)
def test_a_hanging_prosthesis_is_no_negated_wrench(share: float, noted: bool) -> None:
    samples = loaded()
    wrench = samples.wrench * (-share * plausibility.HANGING_WEIGHT / LOAD)
    note = plausibility.sign_note(replace(samples, wrench=wrench), GEOMETRY)
    assert (note is not None) == noted


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda s: {"local_forces": -s.local_forces}, id="clusters-pulled"),
        pytest.param(
            lambda s: {"wrench": -s.wrench, "local_forces": s.local_forces + TENSION},
            id="clusters-with-an-offset",
        ),
        pytest.param(lambda s: {"status": np.full_like(s.status, 2)}, id="clusters-unread"),
    ],
)
def test_doubtful_clusters_negate_no_wrench(change) -> None:
    samples = loaded()
    negated = replace(samples, wrench=-samples.wrench)
    assert plausibility.sign_note(replace(negated, **change(samples)), GEOMETRY) is None


def test_plausible_samples_propose_nothing() -> None:
    assert found(loaded()) == []


@pytest.mark.parametrize("axis", range(3), ids="xyz")
def test_a_local_force_beyond_the_load_is_proposed(axis: int) -> None:
    samples = loaded()
    load = np.median(np.linalg.norm(samples.wrench[:, 3:], axis=1))
    size = np.median(np.abs(samples.local_forces[:, 1, axis]))
    assert found(scaled(samples, 1, axis, 0.99 * load / size)) == []
    assert found(scaled(samples, 1, axis, 1.01 * load / size)) == [f"cluster_1.F{'xyz'[axis]}"]
    large = scaled(samples, 1, axis, 10.0 * load / size)
    (proposal,) = plausibility.find_implausible(large, GEOMETRY)
    assert proposal.channel == f"cluster_1.F{'xyz'[axis]}" and "10 times" in proposal.reason


@pytest.mark.parametrize(
    ("share", "expected"),
    [pytest.param(0.9, [], id="below"), pytest.param(1.1, ["cluster_1.Fx"], id="above")],
)
def test_nothing_is_too_large_for_no_load(share: float, expected: list[str]) -> None:
    samples = loaded()
    unloaded = replace(samples, wrench=samples.wrench * (share * plausibility.MIN_LOAD / LOAD))
    assert found(scaled(unloaded, 1, 0, 1e4)) == expected


@pytest.mark.parametrize(
    ("tension", "expected"),
    [
        pytest.param(0.1 * LOAD, ["cluster_2.Fz"], id="as-much-as-compression"),
        pytest.param(1.1 * plausibility.MIN_TENSION, ["cluster_2.Fz"], id="above-the-least"),
        pytest.param(0.9 * plausibility.MIN_TENSION, [], id="below-the-least"),
    ],
)
def test_a_wall_that_pulls_is_proposed(tension: float, expected: list[str]) -> None:
    assert found(scaled(loaded(), 2, 2, -tension / (0.1 * LOAD))) == expected


@pytest.mark.parametrize(
    ("share", "expected"),
    [pytest.param(0.99, [], id="below"), pytest.param(1.01, ["My"], id="above")],
)
def test_a_moment_without_a_lever_is_proposed(share: float, expected: list[str]) -> None:
    samples = loaded()
    load = np.median(np.linalg.norm(samples.wrench[:, 3:], axis=1))
    reach = np.linalg.norm(GEOMETRY.anchors, axis=1).max()
    samples.wrench[:, 1] = -share * plausibility.LEVER_FACTOR * reach * load
    assert found(samples) == expected
