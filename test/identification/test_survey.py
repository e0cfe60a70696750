"""The joint map of a survey against dense conditioning, and its judgements worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student
from support.problems import GEOMETRY, make_samples

from socket_testbed.errors import IdentificationError
from socket_testbed.identification import survey
from socket_testbed.identification.contact import wrench_map
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.identification.map_prior import Prior, hypotheses
from socket_testbed.identification.survey import Donned, JointMap, JudgedPoint, match_loads, score
from socket_testbed.settings.identification import ForceMapSettings

ONE = ForceMapSettings(draws=1)
SOME = ForceMapSettings(draws=4)
TILES = len(GEOMETRY)
PLACES = ((0, 5, 9, 14), (2, 7, 11, 14), (1, 4, 12, 16))  # tile 14 has a cluster twice


def trials(count: int = 3, states: int = 5, seed: int = 0) -> list[Donned]:
    """Values without a physical meaning: what holds for the map holds for any values."""
    rng = np.random.default_rng(seed)
    load = np.array([1.0, 2.0, 0.0, 0.0, 0.0, -200.0])
    found = []
    for tiles in PLACES[:count]:
        wrench = load + rng.normal(0.0, [0.5, 0.5, 0.2, 2.0, 2.0, 5.0], (states, 6))
        forces = rng.normal(0.0, [1.0, 1.0, 3.0], (states, 4, 3)) - [0.0, 0.0, 6.0]
        found.append(Donned(tiles, np.hstack([wrench, forces.reshape(states, -1)])))
    return found


class Dense:
    """The equations of the module under one hypothesis, without any of its shortcuts."""

    def __init__(self, surveyed: list[Donned], change: float) -> None:
        (sizes,) = hypotheses(ONE, GEOMETRY.tile_share)
        self.K = Prior(GEOMETRY, tuple(GEOMETRY.clusters), sizes).covariance()
        in_socket = wrench_map(GEOMETRY.anchors).reshape(6, TILES, 3)
        self.onto_wrench = np.einsum("wni,nij->wnj", in_socket, GEOMETRY.rotations)
        self.onto_wrench = self.onto_wrench.reshape(6, -1) / sizes.share
        known = self.onto_wrench @ self.K @ self.onto_wrench.T
        known += 1e-3 * np.diag(np.diag(known))
        crossed = self.K @ self.onto_wrench.T
        self.changed = change**2 * (self.K - crossed @ np.linalg.solve(known, crossed.T))
        # Unknown forces: F, then G of every trial.
        count = len(surveyed)
        size = len(self.K)
        self.unknown = np.kron(np.diag([0.0, *[1.0] * count]), self.changed)
        self.unknown[:size, :size] = self.K
        rows, noise = [], []
        self.wrench_noise = [sizes.moment_error**2] * 3 + [sizes.force_error**2] * 3
        for number, trial in enumerate(surveyed):
            shares = np.zeros(count + 1)
            shares[[0, number + 1]] = 1.0
            own = np.vstack([self.onto_wrench, *(self.tile(tile) for tile in trial.tiles)])
            rows.append(np.kron(shares, own))
            noise += self.wrench_noise
            for tile in trial.tiles:
                signal = np.diag(self.K)[3 * tile : 3 * tile + 3]
                noise += [*sizes.cluster_error**2 + sizes.cluster_gain_error**2 * signal]
        self.H, self.R = np.vstack(rows), np.diag(noise)
        self.y = np.hstack([trial.values for trial in surveyed])

    def tile(self, tile: int) -> np.ndarray:
        return np.eye(3 * TILES)[3 * tile : 3 * tile + 3]

    def posterior(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means of the unknown forces, their covariance, and the squared amplitudes."""
        cross = self.unknown @ self.H.T
        total = self.H @ cross + self.R
        gain = np.linalg.solve(total, cross.T).T
        distance = np.einsum("sd,de,se->s", self.y, np.linalg.inv(total), self.y)
        scale = (2.0 + distance) / (2.0 + len(total) - 2.0)
        return self.y @ gain.T, self.unknown - gain @ cross.T, scale


def test_one_trial_gives_the_ordinary_map() -> None:
    (trial,) = trials(1)
    names = tuple(GEOMETRY.clusters)
    placed = replace(GEOMETRY, clusters=dict(zip(names, trial.tiles, strict=True)))
    samples = make_samples(
        np.zeros((5, 3)),
        trial.values[:, :6],
        dict(zip(names, np.swapaxes(trial.forces, 0, 1), strict=True)),
    )
    ordinary = ForceMap(placed, names, SOME, trial=samples).estimate(samples)
    found = JointMap(GEOMETRY, [trial], SOME)
    field = found.field(0)
    in_socket = np.einsum("nij,snj->sni", GEOMETRY.rotations, field.forces)
    np.testing.assert_allclose(in_socket, ordinary.forces, atol=1e-8)
    pressure_sd = field.deviations[..., 2] / GEOMETRY.areas
    np.testing.assert_allclose(pressure_sd, ordinary.normal_pressure_standard_deviation, rtol=1e-7)
    assert found.change == 0.0


@pytest.mark.parametrize("change", [0.0, 0.3], ids=["same donning", "other donnings"])
def test_fields_are_those_of_dense_conditioning(change: float) -> None:
    surveyed = trials()
    joint = JointMap(GEOMETRY, surveyed, ONE, (change,))
    dense = Dense(surveyed, change)
    means, covariance, scale = dense.posterior()
    size = 3 * TILES
    for trial in (None, 0, 2):
        shares = np.zeros(4)
        shares[[0] if trial is None else [0, trial + 1]] = 1.0
        pick = np.kron(shares, np.eye(size))
        field = joint.field(trial)
        np.testing.assert_allclose(field.forces.reshape(5, -1), means @ pick.T, atol=1e-7)
        expected = scale[:, None] * np.diag(pick @ covariance @ pick.T)
        np.testing.assert_allclose(field.deviations.reshape(5, -1) ** 2, expected, atol=1e-6)
    changed = scale.mean() * np.diag(dense.changed).mean()
    assert joint.changed_square() == pytest.approx(changed)
    assert joint.change == pytest.approx(np.sqrt(changed / np.mean(means[:, :size] ** 2)))


def test_donnings_without_change_are_alike() -> None:
    joint = JointMap(GEOMETRY, trials(), SOME, (0.0,))
    np.testing.assert_array_equal(joint.field(0).forces, joint.field(None).forces)
    np.testing.assert_array_equal(joint.field(1).deviations, joint.field(2).deviations)


def test_the_order_of_trials_does_not_matter() -> None:
    surveyed = trials()
    one, two = (
        JointMap(GEOMETRY, [surveyed[i] for i in order], SOME) for order in ([0, 1, 2], [2, 0, 1])
    )
    np.testing.assert_allclose(one.field(1).forces, two.field(2).forces, atol=1e-7)
    np.testing.assert_allclose(one.field().deviations, two.field().deviations, atol=1e-7)
    np.testing.assert_allclose(one.probabilities, two.probabilities, atol=1e-9)


def test_evidence_tells_how_much_donnings_change() -> None:
    """Repeats in place that agree, and repeats that differ by half of their forces."""
    (first,) = trials(1)
    rng = np.random.default_rng(3)
    alike = Donned(first.tiles, first.values + rng.normal(0.0, 0.05, first.values.shape))
    changed = first.values.copy()
    changed[:, 6:] *= rng.choice([0.5, 1.5], (1, 12))
    settings = ForceMapSettings(draws=8)
    assert JointMap(GEOMETRY, [first, alike], settings).change < 0.1
    assert JointMap(GEOMETRY, [first, Donned(first.tiles, changed)], settings).change > 0.2


def test_weights_average_the_evidence_over_trials() -> None:
    """Two trials: hypotheses by 4^(0.6 / 2) = 1.5157 to 1, epsilons by 12 to 4 and 1 to 3."""
    found = survey._weights(np.log([[12.0, 4.0], [1.0, 3.0]]), 2)
    likelier = 1.5157166 / 2.5157166
    by_hand = [[0.75 * likelier, 0.25 * likelier], [0.25 * (1 - likelier), 0.75 * (1 - likelier)]]
    np.testing.assert_allclose(found, by_hand, rtol=1e-6)
    unlikely = survey._weights(np.log([[1.0, 1e-3]]), 1)
    np.testing.assert_array_equal(unlikely, [[1.0, 0.0]])


def test_a_missing_channel_is_as_if_unmeasured() -> None:
    surveyed = trials(2)
    values = surveyed[1].values.copy()
    values[2, 6 + 9 : 6 + 12] = np.nan  # the last cluster, once
    without = Donned(surveyed[1].tiles[:3], values[:, : 6 + 9])
    gaps = JointMap(GEOMETRY, [surveyed[0], Donned(surveyed[1].tiles, values)], SOME)
    less = JointMap(GEOMETRY, [surveyed[0], without], SOME)
    np.testing.assert_allclose(gaps.field(1).forces, less.field(1).forces, atol=1e-8)


def test_a_left_out_tile_is_predicted_from_the_others() -> None:
    """Tile 14 has a cluster in two trials, which are left out together."""
    surveyed = trials()
    joint = JointMap(GEOMETRY, surveyed, ONE, (0.3,))
    squared, expected = joint.left_out()[sorted({t for p in PLACES for t in p}).index(14)]
    dense = Dense(surveyed, 0.3)
    own = np.array([6 + 9, 6 + 10, 6 + 11])
    own = np.concatenate([own, 18 + own])
    others = np.setdiff1d(np.arange(len(dense.H)), own)
    total = dense.H @ dense.unknown @ dense.H.T + dense.R
    gain = np.linalg.solve(total[np.ix_(others, others)], total[np.ix_(others, own)]).T
    left = total[np.ix_(own, own)] - gain @ total[np.ix_(others, own)]
    residuals = dense.y[:, own] - dense.y[:, others] @ gain.T
    assert squared == pytest.approx((residuals**2).sum())
    assert expected == pytest.approx(dense.posterior()[2].sum() * np.trace(left))


def test_next_places_are_those_of_dense_conditioning() -> None:
    surveyed, change = trials(2), 0.3
    joint = JointMap(GEOMETRY, surveyed, ONE, (change,))
    allowed = np.ones(TILES, dtype=bool)
    allowed[[tile for trial in surveyed for tile in trial.tiles]] = False
    chosen, ratio = joint.place_next(2, allowed)

    def remaining(tiles: tuple[int, ...]) -> float:
        values = np.zeros((5, 6 + 3 * len(tiles)))  # they do not matter
        dense = Dense([*surveyed, Donned(tiles, values)], change)
        return float(np.diag(dense.posterior()[1])[: 3 * TILES].sum())

    before = float(np.diag(Dense(surveyed, change).posterior()[1])[: 3 * TILES].sum())
    single = {int(tile): remaining((int(tile),)) for tile in np.flatnonzero(allowed)}
    assert chosen[0] == min(single, key=lambda tile: single[tile])
    pairs = {t: remaining((int(chosen[0]), t)) for t in single if t != chosen[0]}
    assert chosen[1] == min(pairs, key=lambda tile: pairs[tile])
    assert ratio == pytest.approx(np.sqrt(pairs[int(chosen[1])] / before), rel=1e-6)


def test_like_loads_are_found_by_their_wrench() -> None:
    """Moments count by an arm of 0.1 m; 190 N is 5 % off, 100 N no like load."""
    first = np.zeros((3, 6))
    first[:, 5] = [-200.0, -100.0, -400.0]
    second = np.zeros((3, 6))
    second[:, 5] = [-410.0, -190.0, -200.0]
    second[2, 0] = 2.0  # N m, as much as 20 N
    rows, mismatch = match_loads([first, second], 0.1)
    np.testing.assert_array_equal(rows, [[0, 2], [1, 0]])
    np.testing.assert_allclose(mismatch, [0.05, 0.025])


@pytest.mark.parametrize(
    ("counts", "rows"),
    [((3, 5), [[0, 1, 2], [0, 1, 2]]), ((5, 3), [[0, 1, 2], [0, 1, 2]])],
    ids=["longer second", "longer first"],
)
def test_states_are_spread_over_the_first_trial(
    counts: tuple[int, int], rows: list[list[int]]
) -> None:
    """-100, -200, ... N; loads of -400 and -500 N are in one of the trials alone."""
    wrenches = []
    for count in counts:
        wrench = np.zeros((count, 6))
        wrench[:, 5] = -100.0 * np.arange(1, count + 1)
        wrenches.append(wrench)
    np.testing.assert_array_equal(match_loads(wrenches, 0.1)[0], rows)


def test_unlike_loads_are_refused() -> None:
    first, second = np.zeros((2, 1, 6))
    first[0, 5], second[0, 5] = -200.0, -300.0
    with pytest.raises(IdentificationError, match="trial 2: the nearest differs by 50 %"):
        match_loads([first, second], 0.1)


def point(tile: int, measured: float, estimated: float, rival: float = 0.0) -> JudgedPoint:
    """A point at one state with normal forces only; map and sensor explain 2 N."""
    column = np.array([[0.0, 0.0, 1.0]])
    return JudgedPoint(
        trial=0,
        other=1,
        cluster=0,
        tile=tile,
        distance=0.05,
        measured=measured * column,
        estimated=estimated * column,
        deviations=np.full((1, 3), 2.0),
        rival=rival * column,
        expected=8.0,
        mapped=6.0,
    )


def test_a_score_worked_out_by_hand() -> None:
    """Compressions 8 and 6 N, estimated 11 and 5 N: RMS sqrt(10 / 100), bias 2 of 14 N."""
    found = score([point(0, -8.0, -11.0), point(1, -6.0, -5.0, rival=-6.0)])
    assert found.values == 6
    assert found.error == pytest.approx(np.sqrt(0.1))
    assert found.rival == pytest.approx(0.8)
    assert found.bias == pytest.approx(2.0 / 14.0)
    # 3 N is 1.5 deviations, 1 N half a deviation, the tangential ones are exact.
    assert found.coverage == pytest.approx((5 / 6, 5 / 6, 1.0))


def test_a_ratio_and_its_jackknife_by_hand() -> None:
    """3 + 6 over 2 + 1: without the first 6, without the second 1.5."""
    found, error, freedom = survey._ratio(np.array([3.0, 6.0]), np.array([2.0, 1.0]))
    assert found == pytest.approx(3.0)
    assert error == pytest.approx(np.log(2.0))  # half the difference of log 6 and log 1.5
    assert freedom == 1


def test_an_interval_adds_the_model_s_own_error() -> None:
    found = survey._root((4.0, 0.4, 7), 0.01)
    reach = np.exp(student.ppf(0.975, 7) * np.hypot(0.2, 0.15))
    assert found.value == pytest.approx(0.2)
    assert (found.low, found.high) == pytest.approx((0.2 / reach, 0.2 * reach))


def test_repeats_tell_what_the_map_is_not_to_blame_for() -> None:
    """A cluster left in place reads 10 and 8 N; the map is off by 3 of 6 N elsewhere."""
    places = [(0, 5), (0, 7)]
    forces = [[-10.0, -6.0], [-8.0, -6.0]]
    column = np.array([0.0, 0.0, 1.0])
    donned = [
        Donned(tiles, np.hstack([np.zeros(6), *(f * column for f in pair)])[None])
        for tiles, pair in zip(places, forces, strict=True)
    ]
    points = [point(5, -6.0, -9.0), point(7, -6.0, -9.0)]
    share = survey._explained(donned, points, survey._sums(points))
    assert survey.repeats_by_tile(donned)[1] == 1
    # 82 is the mean of 100 and 64.
    assert survey.repeated_difference(donned) == pytest.approx(2.0 / np.sqrt(82.0))
    assert share.value == pytest.approx((4.0 / 82.0) / (9.0 / 36.0))


def test_repeats_explain_no_more_than_all() -> None:
    """Clusters left in place differ by 4 of 10 and 6 N, more than the map does by 1 of 6 N."""
    donned = [
        Donned((0, 1), np.array([[*[0.0] * 6, 0.0, 0.0, -load, 0.0, 0.0, -load - 1.0]]))
        for load in (10.0, 6.0)
    ]
    points = [point(5, -6.0, -7.0), point(7, -6.0, -7.0)]
    share = survey._explained(donned, points, survey._sums(points))
    assert share.value == share.high == 1.0
    assert share.low <= 1.0


def test_without_repeats_the_model_tells_the_share() -> None:
    points = [point(5, -6.0, -9.0), point(7, -6.0, -9.0)]
    donned = [Donned((5,), np.zeros((1, 9))), Donned((7,), np.zeros((1, 9)))]
    share = survey._explained(donned, points, survey._sums(points))
    assert survey.repeats_by_tile(donned)[1] == 0
    assert np.isnan(survey.repeated_difference(donned))
    assert share.value == pytest.approx(0.25)  # 8 expected, 6 of the map


def test_judged_error_scales_with_what_was_measured() -> None:
    """Twice the differences and forces: the same error; the ratio estimate by its equation."""
    surveyed = trials()
    joint = JointMap(GEOMETRY, surveyed, SOME)
    singles = [JointMap(GEOMETRY, [trial], SOME) for trial in surveyed]
    found = survey.judge(GEOMETRY, surveyed, joint, singles)
    tiles = {(each.trial, each.tile) for each in found.points}
    assert (0, 14) not in tiles  # that is a repeat
    anchors = GEOMETRY.anchors
    for each in found.points:  # from the nearest cluster of the trial whose map is judged
        apart = [np.linalg.norm(anchors[each.tile] - anchors[own]) for own in PLACES[each.trial]]
        assert each.distance == pytest.approx(min(apart)) and max(apart) > 1.2 * min(apart)
    assert found.repeats == 1
    assert len(found.points) == 22  # 2 x 4 for the third, 3 + 4 for each of the others
    c2 = sum(each.squared for each in found.points) / sum(each.expected for each in found.points)
    own = of_own = 0.0
    for number, trial in enumerate(surveyed):
        bare = [tile for tile in range(TILES) if tile not in trial.tiles]
        single = singles[number].field(0)
        own += (single.deviations[:, bare] ** 2).sum()
        of_own += (joint.field(number).forces[:, bare] ** 2).sum()
    assert found.error.value == pytest.approx(np.sqrt(c2 * own / of_own))
    left_out = joint.left_out().sum(axis=0)
    bare = [tile for tile in range(TILES) if not any(tile in places for places in PLACES)]
    fields = [joint.field(number) for number in range(3)]
    shown = sum((field.forces[:, bare] ** 2).sum() for field in fields)
    stated = sum((field.deviations[:, bare] ** 2).sum() for field in fields)
    expected = np.sqrt(left_out[0] / left_out[1] * stated / shown)
    assert found.completed.value == pytest.approx(expected)


def test_what_a_map_follows_of_its_donning_counts_twice() -> None:
    """Its own change and, where clusters show it, the missing change to the other donning."""
    surveyed, change = trials(2), 0.3
    joint = JointMap(GEOMETRY, surveyed, ONE, (change,))
    singles = [JointMap(GEOMETRY, [trial], ONE) for trial in surveyed]
    found = survey.judge(GEOMETRY, surveyed, joint, singles)
    (point,) = (each for each in found.points if (each.trial, each.tile) == (0, 7))
    alone = Dense(surveyed[:1], 0.0)
    gain = np.linalg.solve(alone.H @ alone.unknown @ alone.H.T + alone.R, alone.H @ alone.unknown)
    size = 3 * TILES
    both = Dense(surveyed, change)
    followed = alone.H[:, :size] @ both.changed
    rows = np.arange(21, 24)  # of tile 7
    covariance = (gain.T[rows] * followed[:, rows].T).sum()
    scale = both.posterior()[2].mean()
    sensor = joint.sensor_variances(7).sum()
    expected = 5 * (2.0 * scale * covariance + sensor)
    assert point.expected - point.mapped == pytest.approx(expected)
    column = 6 + 3  # tile 7 is the second cluster of the second trial
    noise = np.diag(both.R)[18 + column : 18 + column + 3]
    assert sensor == pytest.approx(scale * noise.sum())


def test_clusters_that_never_moved_judge_nothing() -> None:
    one, two, _ = trials()
    still = [one, Donned(one.tiles, two.values)]
    joint = JointMap(GEOMETRY, still, ONE)
    singles = [JointMap(GEOMETRY, [trial], ONE) for trial in still]
    with pytest.raises(IdentificationError, match="on the same tiles"):
        survey.judge(GEOMETRY, still, joint, singles)
