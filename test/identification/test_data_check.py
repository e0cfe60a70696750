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
from socket_testbed.identification.data_check import check_data
from socket_testbed.identification.fit import fit_contact_model
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
    "missing channel": ("Fz", ("wrench",), put(np.nan, ALL, 5)),
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


def test_a_finding_hides_no_other_that_it_does_not_cause(sound: dict[str, Path]) -> None:
    trial = st.open_trial(sound["protocol"])
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
    hold = st.open_trial(sound["static_hold"]).samples()[200:400]  # the load hardly changes
    assert found(hold) == []
    assert [source for source, _ in found(replace(hold, wrench=-hold.wrench))] == ["the wrench"]


def test_a_reversed_cluster_another_size_and_few_samples_are_named(sound: dict[str, Path]) -> None:
    trial = st.open_trial(sound["protocol"])
    samples = trial.samples()
    (heavy,) = check_data(samples, trial.geometry, mass=5.0)
    assert "weights of the stated 5 kg" in heavy.fact
    (few,) = check_data(samples[:20], trial.geometry)
    assert "20 samples are too few" in few.fact
    spoilt = replace(samples, wrench=samples.wrench * [1, 1, 1e4, 1, 1, 1])
    assert check_data(spoilt, trial.geometry)
    assert not check_data(spoilt, trial.geometry, leave_out=("Mz",))
    wrench, status = samples.wrench * [1, 1, np.nan, 1, 1, 1], samples.status.copy()
    status[:, 0] = Status.MISSING
    dead = replace(samples, wrench=wrench, status=status)
    found = check_data(dead, trial.geometry)
    assert {finding.source for finding in found} == {"Mz", samples.clusters[0]}
    assert not check_data(dead, trial.geometry, leave_out=("Mz", *samples.channels[6:9]))
    clipped = samples.wrench.copy()
    clipped[::4, 3] = low = clipped[:, 3].min()
    (found,) = check_data(replace(samples, wrench=clipped), trial.geometry)
    assert found.source == "Fx" and f"are at one end, {low:.3g} N" in found.fact
    samples.local_forces[:, 0] *= -1.0
    (found,) = check_data(samples, trial.geometry)
    assert found.source == samples.clusters[0] and "sign" in found.hint


def test_an_intermittent_cluster_does_not_blame_the_wrench_nor_a_short_trial_a_clock(sound) -> None:
    trial = st.open_trial(sound["static_hold"])
    hold = trial.samples()[90:200]
    hold.status[::3, hold.clusters.index("distal")] = Status.OUT_OF_RANGE
    (found,) = check_data(hold, trial.geometry)
    assert found.source == "distal" and "missing or out of range" in found.fact
    trial = st.open_trial(sound["multi_direction"])
    for short in (trial.samples()[:152:4], trial.samples()[:31]):
        assert not [f for f in check_data(short, trial.geometry) if "clocks" in f.hint]


def test_spikes_do_not_hide_each_other_and_spoil_neither_fit_nor_pressure(sound) -> None:
    trial = st.open_trial(sound["protocol"])
    rows = trial.select("hold", trial.estimator).rows
    good = st.fit(trial, segment="hold").to_dataframe()["RMSE"]
    for places, force in (([0], -2e3), ([5, 90], -2e3), (range(10, 90, 10), -3e3)):
        spoilt = st.open_trial(sound["protocol"])
        spoilt.samples().wrench[[rows.start + place for place in places], 5] = force
        assert any("single values" in finding.source for finding in spoilt.problems())
        found = st.fit(spoilt, segment="hold").to_dataframe()["RMSE"]
        np.testing.assert_allclose(found, good, rtol=0.1)
        peaks = (st.pressure(t, "hold").regions.loc["socket"].iloc[0] for t in (trial, spoilt))
        assert abs(np.subtract(*peaks)) < 0.5
    tapped = st.open_trial(sound["protocol"])  # a load that clusters feel, too, is none
    tapped.samples().wrench[rows.start + 20] *= 4.0
    tapped.samples().local_forces[rows.start + 20] *= 2.5
    assert not plausibility.find_outliers(tapped.samples(), tapped.geometry).rows.any()


def test_a_trial_without_clusters_is_checked(sound: dict[str, Path]) -> None:
    trial = st.open_trial(sound["protocol"])
    samples = trial.samples()
    forces, status = samples.local_forces[:, :0], samples.status[:, :0]
    bare = replace(samples, clusters=(), local_forces=forces, status=status)
    assert check_data(bare, trial.geometry) == ()


# --- Samples that no limb in a socket gives


LOAD = 200.0  # [N]


def test_a_wrench_without_a_load_and_another_unit_are_refused():
    for array, column, names in (
        ("wrench", np.s_[:, 3:], ("F", "likely in millinewtons")),
        ("wrench", np.s_[:], ("M", "likely in newton millimetres")),
        ("local_forces", np.s_[:], ("cluster_", "likely in millinewtons")),
    ):
        geometry, _, samples, settings = make_case(3)
        getattr(samples, array)[column] *= 1000.0
        with refused(IdentificationError, *names):
            fit_contact_model(samples, geometry, settings)
    geometry, _, samples, settings = make_case(2)
    for wrench in (1e-4, 0.0):
        samples.wrench[:] = wrench
        with refused(IdentificationError, "holds no load"):
            fit_contact_model(samples, geometry, settings)
    settings = replace(settings, leave_out=("Mx", "My", "Mz", "Fx", "Fy", "Fz"))
    assert fit_contact_model(samples, geometry, settings).samples == len(samples)


def test_an_outlier_is_left_out_and_noted_with_channel_and_time_and_many_are_refused():
    geometry, _, sound, settings = make_case(4)
    without = fit_contact_model(sound[np.arange(len(sound)) != 17], geometry, settings).model
    for array, place, value, name in (
        ("wrench", (17, 4), 2e3, "Fy has an outlier"),
        ("local_forces", (17, 1, 2), -1e9, "cluster_1.Fz has an outlier"),
        ("position", (17, 1), -1e9, "limb position has an outlier"),
    ):
        samples = make_case(4)[2]
        getattr(samples, array)[place] = value
        outliers = plausibility.find_outliers(samples, geometry)
        (note,) = plausibility.outlier_notes(samples, outliers)
        assert note.startswith(name) and "at 4.25 s" in note and note.endswith("left out")
        found = fit_contact_model(samples, geometry, settings)
        assert max(error.rmse for error in found.errors) < 100.0
        assert array == "local_forces" or (found.model.stiffness == without.stiffness).all()
    sound.wrench[::8, 3] = 1e9
    with refused(IdentificationError, "5 of 40 samples are outliers: Fx has 5"):
        fit_contact_model(sound, geometry, settings)
    settings = replace(settings, leave_out=("Fx",))  # then it drops no sample
    assert fit_contact_model(sound, geometry, settings).samples == len(sound)


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


def test_a_negated_wrench_is_noted_on_clear_evidence_alone():
    samples = loaded()
    negated = replace(samples, wrench=-samples.wrench)
    note = plausibility.sign_note(negated, GEOMETRY) or ""
    assert "wrench looks negated" in note and "200 N" in note and "3 of 3 clusters" in note
    hanging = replace(samples, wrench=samples.wrench * (-0.9 * plausibility.HANGING_WEIGHT / LOAD))
    pulled = replace(negated, local_forces=-samples.local_forces)
    shifted = samples.local_forces + np.array([0.0, 0.0, 150.0])
    offset = replace(samples, local_forces=shifted)
    unread = replace(negated, status=np.full_like(samples.status, 2))
    for doubtful in (hanging, pulled, offset, unread):
        assert plausibility.sign_note(doubtful, GEOMETRY) is None


def test_what_exceeds_the_load_pulls_or_has_no_lever_is_proposed_with_its_numbers():
    samples = loaded()
    assert found(samples) == []
    load = np.median(np.linalg.norm(samples.wrench[:, 3:], axis=1))
    for axis in range(3):
        size = np.median(np.abs(samples.local_forces[:, 1, axis]))
        assert found(scaled(samples, 1, axis, 0.99 * load / size)) == []
        large = scaled(samples, 1, axis, 10.0 * load / size)
        (proposal,) = plausibility.find_implausible(large, GEOMETRY)
        assert proposal.channel == f"cluster_1.F{'xyz'[axis]}" and "10 times" in proposal.reason
    unloaded = replace(samples, wrench=samples.wrench * (0.9 * plausibility.MIN_LOAD / LOAD))
    assert found(scaled(unloaded, 1, 0, 1e4)) == []  # nothing is too large for no load
    pulled = scaled(samples, 2, 2, -1.0)  # as much tension as there was compression
    assert found(pulled) == ["cluster_2.Fz"]
    assert found(scaled(samples, 2, 2, -0.9 * plausibility.MIN_TENSION / (0.1 * LOAD))) == []
    reach = np.linalg.norm(GEOMETRY.anchors, axis=1).max()
    for share, expected in ((0.99, []), (1.01, ["My"])):
        samples.wrench[:, 1] = -share * plausibility.LEVER_FACTOR * reach * load
        assert found(samples) == expected
