"""The limb's motion beside the load: whose axes are wrong, which clusters are exchanged or late."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import scene
from support.problems import make_samples

from socket_testbed.calibration.model import read_calibration
from socket_testbed.files import packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.identification.data_check import check_data
from socket_testbed.identification.data_finding import DataFinding
from socket_testbed.identification.limb_motion import AXES, OPPOSITE, limb_motion, mirrored_forces
from socket_testbed.samples import Samples
from socket_testbed.simulation.trial import SimulatedTrial, simulate, write_simulated_trial
from socket_testbed.trials.trial import Trial

GEOMETRY = read_socket(packaged("config", "socket.yaml"))
ALL = slice(None)


@pytest.fixture(scope="module")
def simulated() -> SimulatedTrial:
    """Pushes, leaning and twists, then a hold: 60 s at 4 Hz."""
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    return simulate(GEOMETRY, calibration, "protocol", 60.0, 4.0, 3)


@pytest.fixture(scope="module")
def trial(simulated, tmp_path_factory: pytest.TempPathFactory) -> Trial:
    path = tmp_path_factory.mktemp("sound") / "trial"
    write_simulated_trial(simulated, path)
    return Trial(path)


def turn(values: np.ndarray, axes: np.ndarray, *places: int) -> np.ndarray:
    """Vectors whose x and y, in columns from each place on, have other axes."""
    values = values.copy()
    for place in places:
        values[:, place : place + 2] = values[:, place : place + 2] @ axes.T
    return values


def late(values: np.ndarray, seconds: float) -> np.ndarray:
    """Later by so many seconds, with the first ones in reverse before it: nothing stands still."""
    shift = round(4 * seconds)
    return np.concatenate([values[shift:0:-1], values[:-shift]])


def spiked(
    values: np.ndarray, size: float, column: int, rows: list[int] | None = None
) -> np.ndarray:
    rows = rows or [30, 77, 150]
    values = values.copy()
    values[rows, column] += size * np.array([1.0, -1.0, 1.0])[: len(rows)]
    return values


def stepped(values: np.ndarray, size: float, column: int) -> np.ndarray:
    values = values.copy()
    values[150:, column] += size
    return values


def test_a_sound_trial_is_good(trial: Trial) -> None:
    assert trial.problems() == ()


# --- through the files of a trial


def of_wrench(change: Callable[[np.ndarray], np.ndarray]) -> Callable:
    return lambda trial: replace(trial, wrench=change(trial.wrench))


def of_clusters(change: Callable[[dict], dict]) -> Callable:
    return lambda trial: replace(
        trial, capacitance={**trial.capacitance, **change(trial.capacitance)}
    )


def exchanged(one: str, other: str) -> Callable:
    return of_clusters(lambda read: {one: read[other], other: read[one]})


WRITTEN: dict[str, tuple[Callable, str, str]] = {
    **{
        name.replace(" ", "-"): (
            of_wrench(lambda wrench, axes=axes: turn(wrench, axes, 0, 3)),
            "the wrench",
            f"as if the horizontal axes of the moments were {name}",
        )
        for name, axes in AXES.items()
    },
    "negated-moments": (
        of_wrench(lambda wrench: wrench * np.repeat([-1.0, 1.0], 3)),
        "the wrench",
        "turned by 180 degrees, or the moments negated",
    ),
    "kilonewton-metres": (
        of_wrench(lambda wrench: wrench * np.repeat([1e-3, 1.0], 3)),
        "the wrench",
        "at a lever of 0.0",
    ),
    "late-wrench": (
        of_wrench(lambda wrench: late(wrench, 1.0)),
        "the limb pose",
        "early by 1.0 s against the moments of the load cell",
    ),
    "exchanged-1-2": (
        exchanged("brim_lateral", "mid_anterior"),
        "brim_lateral and mid_anterior",
        "as the limb's motion presses the other's tile",
    ),
    "exchanged-2-3": (
        exchanged("mid_anterior", "posterior_distal"),
        "mid_anterior and posterior_distal",
        "as the limb's motion presses the other's tile",
    ),
    "exchanged-3-4": (
        exchanged("posterior_distal", "distal"),
        "posterior_distal and distal",
        "as the limb's motion presses the other's tile",
    ),
    "exchanged-1-2-3": (
        of_clusters(
            lambda read: {
                "brim_lateral": read["mid_anterior"],
                "mid_anterior": read["posterior_distal"],
                "posterior_distal": read["brim_lateral"],
            }
        ),
        "brim_lateral, mid_anterior and posterior_distal",
        "each is pressed as the limb's motion presses the next one's tile, and the last as the",
    ),
    "exchanged-2-4-3": (
        of_clusters(
            lambda read: {
                "mid_anterior": read["distal"],
                "distal": read["posterior_distal"],
                "posterior_distal": read["mid_anterior"],
            }
        ),
        "mid_anterior, distal and posterior_distal",
        "each is pressed as the limb's motion presses the next one's tile, and the last as the",
    ),
    "late-cluster": (
        of_clusters(lambda read: {"mid_anterior": late(read["mid_anterior"], 5.0)}),
        "mid_anterior",
        "late by 5.",
    ),
    "spikes-of-force": (
        of_wrench(lambda wrench: spiked(wrench, 60.0, 3)),
        "the wrench",
        "3 single values jump and come back, such as Fx by ",
    ),
    "a-spike-of-force": (
        of_wrench(lambda wrench: spiked(wrench, -150.0, 5, [77])),
        "the wrench",
        "a single value jumps and comes back, Fz by 1",
    ),
    "a-step-of-force": (
        of_wrench(lambda wrench: stepped(wrench, 100.0, 5)),
        "the wrench",
        "it steps: Fz by ",
    ),
    "a-step-of-cluster": (
        of_clusters(lambda read: {"distal": stepped(read["distal"], 1.0, 1)}),
        "distal",
        "it steps: F",
    ),
    "Fx-negated": (
        of_wrench(lambda wrench: wrench * [1, 1, 1, -1, 1, 1]),
        "the wrench",
        "its horizontal forces have its moments only if their axes were left-handed (",
    ),
    "Fx-and-Fy-exchanged": (
        of_wrench(lambda wrench: wrench[:, [0, 1, 2, 4, 3, 5]]),
        "the wrench",
        "its horizontal forces have its moments only if their axes were exchanged",
    ),
    "spikes-of-cluster": (
        of_clusters(lambda read: {"distal": spiked(read["distal"], 0.3, 1)}),
        "distal",
        "single values jump and come back, such as F",
    ),
}


@pytest.mark.parametrize("case", WRITTEN)
def test_a_written_trial_names_its_source(simulated, tmp_path: Path, case: str) -> None:
    damage, source, fact = WRITTEN[case]
    write_simulated_trial(damage(simulated), tmp_path / "trial")
    (found,) = Trial(tmp_path / "trial").problems()
    assert found.source == source and fact in found.fact, found


def test_pushes_show_a_short_delay_of_a_cluster(tmp_path: Path) -> None:
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    pushed = simulate(GEOMETRY, calibration, "multi_direction", 60.0, 4.0, 3)
    write_simulated_trial(pushed, tmp_path / "sound")
    assert Trial(tmp_path / "sound").problems() == ()
    damage = of_clusters(lambda read: {"brim_lateral": late(read["brim_lateral"], 1.5)})
    write_simulated_trial(damage(pushed), tmp_path / "late")
    (found,) = Trial(tmp_path / "late").problems()
    assert found.source == "brim_lateral"
    assert found.fact == "late by 1.5 s against the limb's motion"


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
@pytest.mark.parametrize("scenario", ["protocol", "static_hold"])
def test_a_late_cluster_needs_no_pushes(tmp_path: Path, scenario: str, seed: int) -> None:
    """Late by 1.5 s, whether hands push the limb or the mass alone is placed and removed."""
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    made = simulate(GEOMETRY, calibration, scenario, 60.0, 4.0, seed)
    damage = of_clusters(lambda read: {"mid_anterior": late(read["mid_anterior"], 1.5)})
    write_simulated_trial(damage(made), tmp_path / "late")
    (found,) = Trial(tmp_path / "late").problems()
    assert found.source == "mid_anterior" and found.fact.startswith("late by 1."), found


def test_late_clusters_are_one_finding(trial: Trial) -> None:
    samples = trial.samples()
    (found,) = findings(replace(samples, local_forces=late(samples.local_forces, 2.0)))
    assert (found.source, found.fact) == ("the clusters", "late by 2.0 s against the limb's motion")


def test_a_late_cluster_is_not_an_exchanged_one(tmp_path: Path) -> None:
    """Late by 1.5 s, mid_anterior and distal fit each other's tiles better than their own at once.

    With the delay, mid_anterior fits its own tile better still.
    """
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    pushed = simulate(GEOMETRY, calibration, "multi_direction", 40.0, 10.0, 20)
    delay = 15  # samples
    damage = of_clusters(
        lambda read: {
            name: np.concatenate([values[delay:0:-1], values[:-delay]])
            for name, values in read.items()
            if name == "mid_anterior"
        }
    )
    write_simulated_trial(damage(pushed), tmp_path / "late")
    (found,) = Trial(tmp_path / "late").problems()
    assert found.source == "mid_anterior" and found.fact.startswith("late by 1.5 s")


# --- of poses, whose axes stand in socket.yaml


def findings(samples: Samples) -> list[DataFinding]:
    return [*check_data(samples, GEOMETRY)]


@pytest.mark.parametrize("name", AXES, ids=[name.replace(" ", "-") for name in AXES])
def test_wrong_axes_of_the_pose_are_named(trial: Trial, name: str) -> None:
    samples = trial.samples().centred()
    axes = AXES[name]
    spoiled = replace(
        samples,
        position=turn(samples.position, axes, 0),
        rotation=turn(samples.rotation, axes, 0),
    )
    (found,) = findings(spoiled)
    assert found.source in ("the limb pose", "the wrench or the limb pose"), found
    told = name if found.source == "the limb pose" else OPPOSITE[name]
    assert f"were {told}" in found.fact


def ramp(size: float) -> np.ndarray:
    return np.linspace(0.0, size, 240)


def normal_force(samples: Samples, column: int, change: np.ndarray) -> Samples:
    forces = samples.local_forces.copy()
    forces[:, column, 2] += change
    return replace(samples, local_forces=forces)


def moved(samples: Samples, change: np.ndarray) -> Samples:
    position = samples.position.copy()
    position[:, 0] += change
    return replace(samples, position=position)


NOISE = np.random.default_rng(5).normal(size=240)
SPOILED = {
    # 20 kPa on 9 cm^2 are 18 N
    "drifting-cluster": (
        lambda s: normal_force(s, 2, -ramp(18.0)),
        "posterior_distal",
        "it drifts by 20 kPa",
    ),
    "drifting-pose": (lambda s: moved(s, ramp(5e-3)), "the limb pose", "it drifts by 4."),
    "stepping-pose": (
        lambda s: moved(s, np.where(np.arange(240) < 150, 0.0, 8e-3)),
        "the limb pose",
        "it steps: x by 8",
    ),
    "noisy-pose": (lambda s: moved(s, 3e-3 * NOISE), "the limb pose", "its noise is 2.8 mm"),
    "noisy-cluster": (
        lambda s: normal_force(s, 3, 3.0 * NOISE),
        "distal",
        "its noise is 2.8 N, that of the others 0.0",
    ),
    "inch-pounds": (
        lambda s: replace(s, wrench=s.wrench * np.repeat([8.85, 1.0], 3)),
        "the wrench",
        "its horizontal forces have moments at a lever of 4.1 m",
    ),
}


@pytest.mark.parametrize("case", SPOILED)
def test_a_spoiled_source_is_named(trial: Trial, case: str) -> None:
    damage, source, fact = SPOILED[case]
    (found,) = findings(damage(trial.samples().centred()))
    assert found.source == source and found.fact.startswith(fact), found


def test_areas_in_another_unit_are_named(trial: Trial) -> None:
    """9 cm^2 given as 9 mm^2."""
    small = replace(GEOMETRY, areas=1e-2 * GEOMETRY.areas)
    found = check_data(trial.samples(), small)[0]
    assert found.source == "the socket" and found.fact.startswith("its tiles have 0.09 cm^2")


def test_a_jump_of_the_pose_is_named(trial: Trial) -> None:
    """Two exchanged markers turn the body by 0.3 rad: 17.2 degrees, less some motion."""
    samples = trial.samples().centred()
    rotation = samples.rotation.copy()
    rotation[100:140, 2] += 0.3
    (found,) = findings(replace(samples, rotation=rotation))
    assert found.source == "the limb pose" and found.fact == "it jumps by 17.1 deg at 25.00 s"


def test_spikes_of_the_pose_are_named(trial: Trial) -> None:
    samples = trial.samples()
    (found,) = findings(replace(samples, position=spiked(samples.position, 2e-3, 0)))
    assert found.source == "the limb pose"
    assert "3 single values jump and come back, such as x by 2 mm at" in found.fact


def test_a_small_single_spike_is_no_finding(trial: Trial) -> None:
    samples = trial.samples()
    wrench = samples.wrench.copy()
    wrench[77, 3] += 20.0
    assert findings(replace(samples, wrench=wrench)) == []


def test_a_load_that_others_feel_is_no_spike(trial: Trial) -> None:
    samples = trial.samples()
    wrench, forces = samples.wrench.copy(), samples.local_forces.copy()
    wrench[[30, 77, 150], 5] -= 60.0
    forces[[30, 77, 150], 3, 2] -= 8.0
    spoiled = replace(samples, wrench=wrench, local_forces=forces)
    assert not [each for each in findings(spoiled) if "come back" in each.fact]


def test_a_step_that_others_feel_is_none(trial: Trial) -> None:
    samples = trial.samples()
    wrench, forces = samples.wrench.copy(), samples.local_forces.copy()
    wrench[150:, 5] -= 100.0
    forces[150:, 3, 2] -= 8.0
    spoiled = replace(samples, wrench=wrench, local_forces=forces)
    assert not [each for each in findings(spoiled) if "steps" in each.fact]


@pytest.mark.parametrize("height", [0.3, -0.2], ids=["above", "below"])
@pytest.mark.parametrize(
    ("change", "mirrored"),
    [((1, 1, 1), False), ((-1, 1, 1), True), ((1, -1, 1), True)],
    ids=["as they are", "x mirrored", "y mirrored"],
)
def test_forces_have_their_moments_at_any_height(
    height: float, change: tuple[int, ...], mirrored: bool
) -> None:
    """A force at the height h has the moment h z x F, with either sign of h."""
    force = np.random.default_rng(1).normal(size=(60, 3))
    moment = height * np.cross([0.0, 0.0, 1.0], force)
    wrench = np.hstack([moment, force * change])
    _, other, own = mirrored_forces(make_samples(np.zeros((60, 6)), wrench, {}))
    assert (max(other, own), other > own) == (pytest.approx(1.0), mirrored)
    assert min(other, own) < 0.6


# --- units suppress what they cause, and nothing else


def test_a_wrong_unit_hides_only_its_effects(trial: Trial) -> None:
    samples = trial.samples()
    moments = replace(samples, wrench=samples.wrench * np.repeat([1e3, 1.0], 3))
    (unit,) = findings(moments)
    assert unit.source == "the units" and "newton millimetres" in unit.hint
    forces = moments.local_forces.copy()
    forces[100:140, 2] = forces[100, 2]
    sources = [each.source for each in findings(replace(moments, local_forces=forces))]
    assert sources == ["the units", *(f"posterior_distal.{axis}" for axis in ("Fx", "Fy", "Fz"))]


def test_millinewtons_of_all_channels_are_told_twice(trial: Trial) -> None:
    samples = trial.samples()
    found = findings(replace(samples, wrench=1e3 * samples.wrench))
    assert [each.source for each in found] == ["the units", "the units"]


def test_millimetres_are_told_once(trial: Trial) -> None:
    samples = trial.samples()
    (found,) = findings(replace(samples, position=1e3 * samples.position))
    assert found.source == "the units" and "millimetres" in found.hint


@pytest.mark.parametrize(("mass", "found"), [(80.0, True), (10.0, False)], ids=["kgf", "light"])
def test_kilogram_force_is_named_by_the_weight(trial: Trial, mass: float, found: bool) -> None:
    """277 N on a person of 80 kg, taken as 28 N: 0.036 weights; of 10 kg it would be 0.29."""
    samples = trial.samples()
    spoiled = replace(samples, wrench=samples.wrench / 9.81)
    facts = [each.fact for each in check_data(spoiled, GEOMETRY, mass=mass)]
    assert len(facts) == 1  # the clusters seem strong only because of the unit
    assert ("0.036 weights of the stated 80 kg" in facts[0]) is found


# --- by hand


def scene_motion(change: Callable[[Samples], Samples] = lambda samples: samples):
    geometry = scene.geometry()
    limb, tiles = scene.limb(), [*geometry.clusters.values()]
    forces = scene.forces_in_tiles(scene.STAMPS)[:, tiles].swapaxes(0, 1)
    pose = np.hstack([limb.translation, limb.rotation_vector()])
    named = dict(zip(geometry.clusters, forces, strict=True))
    return limb_motion(change(make_samples(pose, scene.wrench(), named)).centred(), geometry)


def test_springs_agree_with_themselves() -> None:
    """The scene's limb turns by moment over stiffness, 2 and 3 N m/deg, about x and y."""
    motion = scene_motion()
    name, gain = motion.axes_of_moment()
    # A turn by 30 degrees, the least one, takes 1 - cos 30 deg = 0.134 of the agreement of equal
    # springs, and of unequal ones a little less or more by its sense.
    assert name in ("turned by 30 degrees", "turned by -30 degrees")
    assert -0.134 < gain / motion.agreement < -0.12


def test_forces_that_follow_the_load_say_nothing() -> None:
    """All clusters of the scene follow the load exactly: nothing is left to compare."""
    motion = scene_motion()
    assert not motion.pressing.any()
    assert motion.exchanged()[1] == 0.0 and motion.axes_misfit() == 0.0


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda s: s[:29], id="few"),
        pytest.param(lambda s: replace(s, position=np.full_like(s.position, np.nan)), id="no-pose"),
        pytest.param(
            lambda s: replace(s, wrench=s.wrench * np.array([0.0, 1, 1, 1, 1, 1])), id="dead-moment"
        ),
    ],
)
def test_without_motion_nothing_is_known(change) -> None:
    assert scene_motion(change) is None
