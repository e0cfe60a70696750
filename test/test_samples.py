"""Samples by hand: names and units of channels, masks, magnitudes, and the table's columns."""

import numpy as np
import pytest

from socket_testbed import samples as of_samples
from socket_testbed.samples import Samples, Status

NAN = float("nan")
CLUSTERS = ("brim", "distal")


@pytest.fixture
def samples() -> Samples:
    """Four samples at 4 Hz; each value tells its row and its column."""
    row = np.arange(4.0)[:, None]
    return Samples(
        stamps=np.int64(10**18) + 250_000_000 * np.arange(4),
        position=row + [0.1, 0.2, 0.3],
        rotation=0.01 * row * [0.0, 0.0, 1.0],
        wrench=10.0 * row + np.arange(6.0),
        clusters=CLUSTERS,
        local_forces=(100.0 * row + np.arange(6.0)).reshape(4, 2, 3),
        status=np.array([[0, 0], [0, 1], [3, 0], [0, 2]], dtype=np.uint8),
    )


def test_channels_begin_with_the_moments(samples: Samples) -> None:
    wrench = ("Mx", "My", "Mz", "Fx", "Fy", "Fz")
    brim, distal = ("brim.Fx", "brim.Fy", "brim.Fz"), ("distal.Fx", "distal.Fy", "distal.Fz")
    assert samples.channels == (*wrench, *brim, *distal)
    assert samples.titles[2:7] == ["Mz [N m]", "Fx [N]", "Fy [N]", "Fz [N]", "brim.Fx [N]"]


@pytest.mark.parametrize(
    ("name", "unit"),
    [("Mx", "N m"), ("Fz", "N"), ("distal.Fx", "N"), ("Medial.Fz", "N"), ("a.Mz", "N m")],
)
def test_a_channel_has_its_unit(name: str, unit: str) -> None:
    assert of_samples.channel_unit(name) == unit


def test_values_are_in_the_channels_order(samples: Samples) -> None:
    assert samples.values[1].tolist() == [10, 11, 12, 13, 14, 15, 100, 101, 102, 103, 104, 105]


def test_no_samples_have_no_values(samples: Samples) -> None:
    none = samples[:0]
    assert none.values.shape == none.trusted_values.shape == (0, 12)
    assert none.without(["Fz"]).values.shape == (0, 12) and none.to_dataframe().shape[0] == 0


def test_untrusted_forces_are_unknown(samples: Samples) -> None:
    """Neither extrapolated (row 2, brim) nor saturated or missing ones (rows 1 and 3, distal)."""
    known = np.isfinite(samples.trusted_forces).all(axis=2)
    assert known.tolist() == [[True, True], [True, False], [False, True], [True, False]]
    assert samples.trusted_values[0].tolist() == samples.values[0].tolist()


def test_a_complete_sample_has_every_value(samples: Samples) -> None:
    """Extrapolated forces are values."""
    assert samples.complete.tolist() == [True, False, True, False]
    samples.position[0, 1], samples.wrench[2, 0] = NAN, NAN
    assert samples.complete.tolist() == [False] * 4


def test_states_are_of_every_source(samples: Samples) -> None:
    samples.wrench[1, 0], samples.rotation[2, 0] = NAN, NAN
    states = samples.states
    assert [*states] == ["wrench", "limb position", "brim", "distal"]
    assert states["wrench"].tolist() == [0, 2, 0, 0]
    assert states["limb position"].tolist() == [0, 0, 2, 0]
    assert states["distal"].tolist() == [0, 1, 0, 2]


def test_a_dead_channel_is_not_required(samples: Samples) -> None:
    samples.wrench[:, 1], samples.wrench[2, 5], samples.wrench[3] = NAN, NAN, NAN
    assert samples.has_wrench.tolist() == [True, True, False, False]
    samples.position[0, 0] = NAN
    assert samples.has_pose_and_wrench.tolist() == [False, True, False, False]
    samples.wrench[:] = NAN
    assert not samples.has_wrench.any()


def test_load_is_at_least_its_limit(samples: Samples) -> None:
    samples.wrench[:, 3:] = [[3.0, 0.0, 4.0], [0.0, 0.0, 4.9], [0.0, 5.1, 0.0], [9.0, 0.0, 0.0]]
    samples.position[3] = NAN
    assert samples.under_load(5.0).tolist() == [True, False, True, False]


def test_left_out_channels_are_blank(samples: Samples) -> None:
    left = samples.without(("My", "distal.Fz"))
    unknown = np.isnan(left.values)
    assert unknown[:, [1, 11]].all() and unknown.sum() == 8
    assert samples.counted(("My", "distal.Fz")).tolist() == [
        *[True, False, True, True, True, True],
        *[True, True, True, True, True, False],
    ]


def test_rows_are_chosen_from_every_array(samples: Samples) -> None:
    chosen = samples[1:3]
    assert len(chosen) == 2 and chosen.clusters == CLUSTERS
    assert chosen.wrench[:, 0].tolist() == [10.0, 20.0]
    assert chosen.time.tolist() == [0.0, 0.25]
    assert samples.time.tolist() == [0.0, 0.25, 0.5, 0.75]


def test_rotations_are_since_their_mean(samples: Samples) -> None:
    """0, 10, 20 and 30 mrad about z: 15 mrad in the mean."""
    assert samples.attitude == pytest.approx([0.0, 0.0, 0.015])
    centred = samples.centred().rotation
    np.testing.assert_allclose(centred[:, 2], [-0.015, -0.005, 0.005, 0.015], atol=1e-12)
    samples.position[:] = NAN
    assert samples.attitude.tolist() == [0.0, 0.0, 0.0]


def test_the_right_rotation_comes_first() -> None:
    """A quarter turn about x, then one about z: z goes to -y, and -y to x."""
    quarter = 0.5 * np.pi
    rotation = np.array([[0.0, 0.0, quarter], [NAN, 0.0, 0.0]])
    found = of_samples.turned(rotation, np.array([quarter, 0.0, 0.0]))
    third = 2.0 * np.pi / 3.0 / np.sqrt(3.0)  # a third of a turn about (1, 1, 1)
    np.testing.assert_allclose(found[0], [third, third, third])
    assert np.isnan(found[1]).all()


def test_a_moment_depends_on_its_point() -> None:
    """10 N along y at 0.5 m along x are 5 N m about z."""
    wrench = np.array([[0.0, 0.0, 7.0, 0.0, 10.0, 0.0]])
    assert of_samples.moments_about(wrench, [0.5, 0.0, 0.0])[0].tolist() == [0, 0, 2, 0, 10, 0]
    assert of_samples.moments_about(wrench, None) is wrench


def test_the_force_is_without_dead_channels() -> None:
    wrench = np.array([[9.0, 9.0, 9.0, 3.0, NAN, 4.0], [9.0, 9.0, 9.0, NAN, NAN, 4.0]])
    found = of_samples.force_magnitude(wrench)
    assert found[0] == 5.0 and np.isnan(found[1])
    assert np.isnan(of_samples.force_magnitude(np.full((2, 6), NAN))).all()


def test_mean_and_sigma_are_of_whole_vectors() -> None:
    """The mean of (6, 0, 0) and (0, 8, 0) is (3, 4, 0); their sizes are 7 +- 1."""
    vectors = np.array([[6.0, 0.0, 0.0], [NAN, 9.0, 9.0], [0.0, 8.0, 0.0]])
    assert of_samples.mean_and_sigma(vectors) == pytest.approx((5.0, 1.0))
    assert np.isnan(of_samples.mean_and_sigma(vectors[1:2])).all()


def test_the_table_has_units_and_order(samples: Samples) -> None:
    table = samples.to_dataframe()
    assert [*table.columns] == [
        *("Mx [N m]", "My [N m]", "Mz [N m]", "Fx [N]", "Fy [N]", "Fz [N]"),
        *("q_x [m]", "q_y [m]", "q_z [m]", "phi_x [rad]", "phi_y [rad]", "phi_z [rad]"),
        *("brim.Fx [N]", "brim.Fy [N]", "brim.Fz [N]", "brim.status [-]"),
        *("distal.Fx [N]", "distal.Fy [N]", "distal.Fz [N]", "distal.status [-]"),
    ]
    assert table.index.name == "time [s]"
    expected = [20, 21, 22, 23, 24, 25, 2.1, 2.2, 2.3, 0, 0, 0.02, 200, 201, 202, 3, 203, 204, 205]
    assert table.loc[0.5].tolist() == pytest.approx([*expected, 0])


def test_statuses_have_their_numbers() -> None:
    """They are in messages, tables and files."""
    assert {status.name: int(status) for status in Status} == {
        "OK": 0,
        "SATURATED": 1,
        "MISSING": 2,
        "OUT_OF_RANGE": 3,
    }


def test_a_replaced_wrench_leaves_the_rest(samples: Samples) -> None:
    missing = np.zeros((4, 12), dtype=bool)
    missing[2, 7] = True
    blanked = samples.blanked(missing)
    assert np.isnan(blanked.local_forces[2, 0, 1]) and np.isnan(blanked.values).sum() == 1
    assert np.isnan(samples.values).sum() == 0
