"""The delay of a source behind the load, from signals whose delay is known."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.foreign import CAPACITANCES, LIMB, SOCKET, WRENCH, pushes, simulate_foreign
from support.wording import refused

from socket_testbed.alignment.align import Series
from socket_testbed.alignment.delay import Delay, find_delay
from socket_testbed.alignment.series import ClusterSeries, PoseSeries, WrenchSeries
from socket_testbed.errors import TrialError
from socket_testbed.files import packaged
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.socket import read_socket
from socket_testbed.trials import foreign
from socket_testbed.trials.bag import BagReader

START = 1_700_000_000_000_000_000  # [ns]
COMPLIANCE = 1e-4 * np.array([[1.0, 0.2, 0.0], [0.1, 2.0, 0.3], [0.0, 0.5, 1.0]])  # [m/N]


def stamps(time: np.ndarray) -> np.ndarray:
    return START + np.round(1e9 * time).astype(np.int64)


def wrench(duration: float = 60.0, late: float = 0.0) -> WrenchSeries:
    time = np.arange(0.0, duration, 0.002)
    random = np.random.default_rng(1)
    values = np.hstack([0.03 * pushes(time), pushes(time)])
    return WrenchSeries(stamps(time + late), values + random.normal(0.0, 0.1, values.shape))


def pose(lag: float = 0.0, late: float = 0.0, duration: float = 60.0) -> PoseSeries:
    """A body that the pushes move, after a lag, with 0.1 mm of noise."""
    time = np.arange(0.0, duration, 0.0125)
    random = np.random.default_rng(2)
    moved = pushes(time - lag) @ COMPLIANCE + random.normal(0.0, 1e-4, (len(time), 3))
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1))
    turns[:, :2] = 0.5 * moved[:, :2]
    return PoseSeries(stamps(time + late), moved, turns)


def clusters(late: float = 0.0) -> ClusterSeries:
    """Capacitances at 20 Hz, of which one is dead."""
    time = np.arange(0.0, 60.0, 0.05)
    values = np.repeat(5.0 + 1e-3 * pushes(time) @ COMPLIANCE * 1e4, 2, axis=1)
    values = np.hstack([values, np.full((len(time), 2), np.nan)]).reshape(-1, 2, 4)
    values += np.random.default_rng(3).normal(0.0, 2e-4, values.shape)
    return ClusterSeries(stamps(time + late), ("a", "b"), values)


SHIFTED: dict[str, tuple[WrenchSeries, PoseSeries | ClusterSeries, float]] = {
    "pose late": (wrench(), pose(late=0.02), 0.02),
    "load late": (wrench(late=0.02), pose(), -0.02),
    "clusters late": (wrench(), clusters(late=0.02), 0.02),
    "in step": (wrench(), pose(), 0.0),
    "long": (wrench(), pose(late=0.31), 0.31),
}


@pytest.mark.parametrize("case", SHIFTED)
def test_a_delay_is_found_within_three_milliseconds(case: str) -> None:
    load, source, expected = SHIFTED[case]
    found = find_delay(load, source)
    assert found.delay == pytest.approx(expected, abs=0.003)
    assert found.low - 0.001 < expected < found.high + 0.001
    assert found.high - found.low < 0.01
    assert 0.5 < found.agreement <= 1.0


def test_intervals_hold_the_delay() -> None:
    """Of 25 noisy poses 22 or more; of intervals of one standard error, 17 would."""
    load, own = wrench(30.0), pose(late=0.02, duration=30.0)
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(own.times), 1))
    random = np.random.default_rng(5)
    hits = 0
    for _ in range(25):
        noisy = own.positions + random.normal(0.0, 1.5e-3, own.positions.shape)
        found = find_delay(load, PoseSeries(own.times, noisy, upright))
        hits += found.low < 0.02 < found.high
    assert hits >= 22


def test_a_moving_socket_is_taken_away() -> None:
    """The limb seen in the world moves with the socket, which follows another course."""
    own = pose(late=0.02)
    time = (own.times - START) * 1e-9
    swing = np.column_stack([0.2 * np.sin(0.9 * time), 0.1 * np.cos(5.0 * time), 0.0 * time])
    turn = np.column_stack([0.0 * time, 0.0 * time, 0.3 * np.sin(3.0 * time)])
    socket = Pose(Rotation.from_rotvec(turn).as_matrix(), swing)
    limb = socket @ Pose.from_vector(np.hstack([own.positions, own.quaternions]))
    seen = [PoseSeries(own.times, p.vector[:, :3], p.vector[:, 3:]) for p in (socket, limb)]
    found = find_delay(wrench(), seen[1], seen[0])
    assert found.delay == pytest.approx(0.02, abs=0.003)


def test_the_load_behind_the_source() -> None:
    assert Delay(0.02, 0.019, 0.022, 0.9).reversed == Delay(-0.02, -0.022, -0.019, 0.9)
    assert str(Delay(0.02, 0.019, 0.0224, 0.9)) == "20.0 ms (19.0 to 22.4 ms)"


def test_delays_in_a_row_add_up() -> None:
    """100 ms more, with an interval as wide as before."""
    found = Delay(0.02, 0.01, 0.04, 0.9).later(0.1)
    assert (found.delay, found.low, found.high) == pytest.approx((0.12, 0.11, 0.14))
    assert found.agreement == 0.9


def unrelated() -> PoseSeries:
    own = pose()
    noise = np.random.default_rng(4).normal(0.0, 1e-3, own.positions.shape)
    return PoseSeries(own.times, noise, np.tile([0.0, 0.0, 0.0, 1.0], (len(noise), 1)))


def still() -> PoseSeries:
    own = pose()
    return PoseSeries(own.times, 0.0 * own.positions, own.quaternions * [0.0, 0.0, 0.0, 1.0])


LITTLE: dict[str, tuple[Series, str]] = {
    "short": (pose(duration=12.0), "share 12 s, and a delay needs 21 s"),
    "empty": (pose(duration=0.0), "share 0 s"),
    "unrelated": (unrelated(), "the load does not tell the delay"),
    "too long": (pose(late=0.7), "the load does not tell the delay"),
    "too early": (pose(late=-0.7), "the load does not tell the delay"),
    "still": (still(), "the source does not change"),
}


@pytest.mark.parametrize("case", LITTLE)
def test_too_little_is_refused(case: str) -> None:
    source, words = LITTLE[case]
    assert not isinstance(source, WrenchSeries)
    with refused(TrialError, words, "state the delay"):
        find_delay(wrench(), source)


@pytest.mark.slow
def test_a_simulated_minute_of_pushing(tmp_path: Path) -> None:
    """The wrench is 20 ms late, and 0 to 3 ms more; tissue creeps and slips."""
    simulate_foreign(tmp_path / "bag", "protocol", 124.0, 1, pace=10.0)
    names: dict[foreign.Source, str] = {
        "wrench": WRENCH, "socket_pose": SOCKET, "pylon_pose": LIMB, "clusters": CAPACITANCES,
    }  # fmt: skip
    with BagReader(tmp_path / "bag") as bag:
        received = foreign.read_messages(bag, names)
    geometry = read_socket(packaged("config", "socket.yaml"))
    series = {
        name: foreign.read_source(name, topic, received, [*geometry.clusters]).series
        for name, topic in names.items()
    }
    minute = [first_minute(series[name]) for name in names]
    load, socket, limb, held = minute
    assert isinstance(load, WrenchSeries) and isinstance(held, ClusterSeries)
    assert isinstance(socket, PoseSeries) and isinstance(limb, PoseSeries)
    for found in (find_delay(load, limb, socket), find_delay(load, held)):
        assert found.delay == pytest.approx(-0.0215, abs=0.003)
        assert found.low - 0.001 < -0.0215 < found.high + 0.001


def first_minute(series: Series) -> Series:
    count = int(np.searchsorted(series.times, series.times[0] + 60_000_000_000))
    rows = slice(0, count)
    if isinstance(series, PoseSeries):
        return PoseSeries(series.times[rows], series.positions[rows], series.quaternions[rows])
    if isinstance(series, WrenchSeries):
        return WrenchSeries(series.times[rows], series.values[rows])
    return ClusterSeries(series.times[rows], series.clusters, series.values[rows])
