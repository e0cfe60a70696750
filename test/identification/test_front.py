"""What is dominated on a front and where it bends, on fronts with known answers."""

import csv
import dataclasses
import json

import numpy as np
import pytest
from matplotlib.image import imread
from support.pareto_cases import CHANNELS, made_up_front

from socket_testbed.errors import ConfigurationError
from socket_testbed.identification.pareto import (
    KNEE,
    LEAST_DEPTH,
    RESOLUTION,
    SENSOR_ONLY,
    WRENCH_ONLY,
    find_knee,
    find_non_dominated,
    front_document,
    write_fronts,
)
from socket_testbed.report.figures.style import save_figure
from socket_testbed.report.sections.fronts import pareto_figure


def kept(wrench, local, sound=None):
    wrench, local = np.array(wrench, dtype=float), np.array(local, dtype=float)
    sound = np.ones(len(wrench), dtype=bool) if sound is None else np.array(sound)
    return find_non_dominated(wrench, local, sound)


def knee_of(wrench, local):
    wrench, local = np.array(wrench, dtype=float), np.array(local, dtype=float)
    return find_knee(wrench, local, kept(wrench, local))


def dominated_by_definition(wrench, local, sound):
    """Every pair compared."""
    better = (wrench[:, None] <= wrench) & (local[:, None] <= local)
    better &= (wrench[:, None] < wrench) | (local[:, None] < local)
    return (better & sound[:, None]).any(axis=0)


def test_what_is_kept_is_what_the_definition_keeps():
    rng = np.random.default_rng(0)
    for count in (0, 1, 5, 60, 60, 60, 60):
        wrench, local = rng.integers(0, 12, (2, count)).astype(float)  # with ties of all kinds
        sound = rng.random(count) < 0.8
        wrench[~sound & (rng.random(count) < 0.5)] = np.nan
        found = find_non_dominated(wrench, local, sound)
        dominated = dominated_by_definition(wrench, local, sound)
        np.testing.assert_array_equal(found, sound & ~dominated)


@pytest.mark.parametrize("stretch", [(1.0, 1.0), (1e3, 1.0), (0.05, 7.0)])
def test_the_knee_of_a_hyperbola_is_where_its_slope_is_the_chord_s(stretch):
    x = np.geomspace(0.1, 10.0, 401)  # y = 1 / x: the slope is -1 at x = 1
    knee = knee_of(stretch[0] * x, stretch[1] / x)
    assert knee.index == 200
    assert knee.depth == pytest.approx(1.0 - 2.0 * 0.9 / 9.9)
    assert knee.span == pytest.approx((9.9 * stretch[0], 9.9 * stretch[1]))


def test_the_knee_is_the_non_dominated_solution_farthest_from_the_chord():
    rng = np.random.default_rng(5)
    x = np.sort(rng.uniform(0.0, 3.0, 50))
    y = 2.0 * np.exp(-3.0 * x)
    knee = knee_of([*x, 9.0, 3.0], [*y, 9.0, 8.0])  # two are dominated, and far from it
    chord = np.array([x[-1] - x[0], y[-1] - y[0]])
    distance = chord[0] * (y[0] - y) - chord[1] * (x[0] - x)
    assert knee.index == int(distance.argmax())
    assert knee.span == pytest.approx((np.ptp(x), np.ptp(y)))


@pytest.mark.parametrize(
    ("wrench", "local", "said"),
    [
        ([0.3], [0.4], "nothing to trade off"),
        ([0.3] * 4, [0.4] * 4, "nothing to trade off"),
        ([0.3, 0.3 + 0.9 * RESOLUTION], [0.5, 0.2], "nothing to trade off"),
        (np.linspace(0, 1, 9), 1.0 - np.linspace(0, 1, 9), "straight"),
        (np.linspace(0, 1, 9), 1.0 - np.linspace(0, 1, 9) ** 3, "straight"),  # bends outwards
        ([0.0, 1.0], [1.0, 0.0], "straight"),
        ([], [], "without flaw"),
    ],
    ids=["one", "equal", "upright", "line", "outwards", "ends", "none"],
)
def test_without_a_knee_it_is_said_why(wrench, local, said):
    knee = knee_of(wrench, local)
    assert knee.index is None
    assert not knee.depth >= LEAST_DEPTH
    assert knee.verdict.startswith("no knee") and said in knee.verdict


def test_a_front_marks_its_ends_and_its_knee():
    front = made_up_front()
    assert front.marks == {SENSOR_ONLY: 0, KNEE: 4, WRENCH_ONLY: 10}
    assert front.non_dominated.tolist() == [True] * 9 + [False] * 2
    assert front.worst_residual == pytest.approx(11e-12)


def test_a_front_averages_over_the_channels_of_each_kind():
    front = made_up_front()
    growth = 1.0 + front.theta
    np.testing.assert_allclose(front.moment_rmse, 1.0 * growth)
    np.testing.assert_allclose(front.force_rmse, 2.5 * growth)
    np.testing.assert_allclose(front.local_rmse, 5.0 * growth)
    assert np.isnan(made_up_front(channels=CHANNELS[1:]).moment_rmse).all()


def test_a_flawed_solution_bears_no_mark_and_no_certificate():
    flaws = {0: "not determined", 4: "not certified", 8: "not certified", 10: "not certified"}
    front = made_up_front(flaws=flaws)
    assert front.sound.tolist() == [i not in flaws for i in range(11)]
    assert not front.non_dominated[[0, 4, 8, 10]].any()
    assert set(front.marks) == {KNEE} and front.marks[KNEE] in (3, 5)
    assert front.worst_residual == pytest.approx(10e-12)
    nothing = made_up_front(flaws=dict.fromkeys(range(11), "not certified"))
    assert nothing.marks == {} and np.isnan(nothing.worst_residual)


def test_the_table_is_the_fronts(tmp_path):
    fronts = [made_up_front(), made_up_front("stiffness_bias", 0.1, {3: "not certified"})]
    write_fronts(fronts, tmp_path / "front.csv")
    with (tmp_path / "front.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 22
    assert {"theta [-]", "RMSE Mx [N m]", "RMSE distal.Fz [N]", "mean force RMSE [N]"} <= set(
        rows[0]
    )
    assert [row["variant"] for row in rows[::11]] == ["stiffness", "stiffness_bias"]
    assert [row["mark"] for row in rows[:11] if row["mark"]] == [SENSOR_ONLY, KNEE, WRENCH_ONLY]
    for row, theta, error in zip(rows, fronts[0].theta, fronts[0].wrench_error, strict=False):
        assert float(row["theta [-]"]) == pytest.approx(theta)
        assert float(row["wrench error [-]"]) == pytest.approx(error, rel=1e-9)
    assert [row["non-dominated"] for row in rows[:11]] == ["1"] * 9 + ["0"] * 2
    assert rows[14]["flaw"] == "not certified"
    assert rows[14]["wrench error [-]"] == rows[14]["RMSE Mx [N m]"] == ""


def test_a_front_is_valid_json_even_where_nothing_was_found():
    flaws = dict.fromkeys(range(11), "not certified")
    for front in (made_up_front(), made_up_front(flaws=flaws)):
        document = json.loads(json.dumps(front_document(front), allow_nan=False))
        assert len(document["solutions"]) == 11
        assert document["marks"].keys() == front.marks.keys()
    assert document["knee"]["theta"] is None
    assert document["solutions"][0]["flaw"] == "not certified"
    assert document["solutions"][0]["rmse"]["Mx"] is None


def test_the_figure_shows_every_sound_solution_of_both_fronts(tmp_path):
    fronts = [made_up_front(flaws={3: "not determined"}), made_up_front("stiffness_bias", 1e-3)]
    path = tmp_path / "front.png"
    figure = pareto_figure(fronts, "two fronts")
    save_figure(figure, path)
    (axes,) = figure.axes
    assert axes.get_xscale() == axes.get_yscale() == "log"
    assert "J_w" in axes.get_xlabel() and "[-]" in axes.get_xlabel()
    shown = {(float(x), float(y)) for line in axes.lines for x, y in line.get_xydata()}
    expected = {
        (float(x), float(y))
        for front in fronts
        for x, y in zip(
            front.wrench_error[front.sound], front.local_error[front.sound], strict=True
        )
    }
    assert shown == expected
    faint = [line.get_xydata().tolist() for line in axes.lines if line.get_alpha()]
    assert faint == [
        np.stack([f.wrench_error[9:], f.local_error[9:]], axis=1).tolist() for f in fronts
    ]
    image = imread(path)
    assert image.shape[1] > 900 and image[..., :3].mean() > 0.8 and image[..., :3].std() > 0.05
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("errors", ["none", "zero"])
def test_the_figure_of_nothing_is_a_figure(tmp_path, errors):
    front = made_up_front(flaws=dict.fromkeys(range(11), "not certified"))
    if errors == "zero":  # for which a logarithmic axis has no place
        front = dataclasses.replace(made_up_front(), wrench_error=np.zeros(11))
    save_figure(pareto_figure([front], "nothing"), tmp_path / "front.pdf")
    assert (tmp_path / "front.pdf").read_bytes().startswith(b"%PDF")


def test_what_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    for write in (
        lambda path: write_fronts([made_up_front()], path),
        lambda path: save_figure(pareto_figure([made_up_front()], "front"), path),
    ):
        with pytest.raises(ConfigurationError, match="cannot be written"):
            write(tmp_path / "file" / "front.png")
