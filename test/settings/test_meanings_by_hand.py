"""What a user reads of a parameter: its unit, what special values mean, and whole refusals."""

import re
from pathlib import Path
from typing import Any

import pytest

from socket_testbed.errors import ConfigurationError
from socket_testbed.settings import acquisition, identification, testbed

# Numbers with a unit; all others are counts, numbers of things, shares or texts.
UNITS = {
    "Hz": "trigger.rate load_cell.spi_clock load_cell.clock_in",
    "1/s": "cluster.sample_rate",
    "V": "load_cell.excitation",
    "s": """
        trigger.pulse trigger.edge_within cluster.bus_timeout cluster.latest load_cell.window
        load_cell.average_over load_cell.tare_duration mocap.stale mocap.window
        mocap.clock_uncertainty estimator.identification.pose_smoothing
        estimator.plateau.smoothing estimator.plateau.least_duration estimator.window.duration
        recorder.flush_period replay.tare align.wait align.tare_duration
        align.wrench.delay align.wrench.window align.wrench.stale
        align.socket_pose.delay align.socket_pose.window align.socket_pose.stale
        align.pylon_pose.delay align.pylon_pose.window align.pylon_pose.stale
        align.clusters.delay align.clusters.window align.clusters.stale
    """,
    "N, N m per mV/V": "load_cell.matrix",
    "N, N m": "load_cell.full_scale",
    "N": """
        load_cell.tare_force align.tare_force load_cell.tare_load align.tare_load
        estimator.plateau.force_change
        estimator.plateau.force_drift estimator.plateau.cluster_change
        estimator.plateau.cluster_drift estimator.plateau.least_force
        estimator.force_map.normal_deviation estimator.force_map.force_error
        estimator.force_map.cluster_error
    """,
    "N m": """
        load_cell.tare_moment align.tare_moment estimator.plateau.moment_change
        estimator.plateau.moment_drift
        estimator.force_map.moment_error
    """,
    "N/m": """
        estimator.identification.initial_stiffness estimator.identification.stiffness_difference
    """,
    "1/m": """
        estimator.identification.gate_sharpness estimator.identification.contact_sharpness
    """,
    "m": """
        estimator.identification.reference_position estimator.identification.rest_position_limit
        estimator.identification.rest_position_difference estimator.force_map.length
        estimator.force_map.arm align.wrench.translation
    """,
    "kg": "recorder.next.mass",
    "Pa": "load_cell.tare_pressure align.tare_pressure",
}


def descriptions() -> dict[str, str]:
    """Description by node and name, such as `trigger.rate`."""
    return {
        f"{node.removesuffix('_node')}.{name}": declared.metadata["description"]
        for node, settings in testbed.TestbedSettings().nodes().items()
        for name, declared in type(settings).flat().items()
    }


def test_parameters_have_their_units() -> None:
    found: dict[str, set[str]] = {}
    for name, text in descriptions().items():
        unit = re.search(r" \[([^]]+)\]$", text)
        assert unit is not None, name
        found.setdefault(unit[1], set()).add(name)
    del found["-"], found["1"]
    assert found == {unit: {*names.split()} for unit, names in UNITS.items()}


MEANINGS = {
    "trigger.edge_within": "longest delay of the edge after the pulse [s]",
    "trigger.pulse": "length of the pulse [s]",
    "trigger.scheduling.lock_memory": (
        "lock the node's memory, so that it is never swapped out [-]"
    ),
    "load_cell.device": "bus and chip select N.M of /dev/spidevN.M [-]",
    "mocap.stale": "largest gap between frames around a trigger, and timeout for them [s]",
    "mocap.data_port": "data port of Motive, for multicast [1]",
    "estimator.identification.variant": (
        "the law: stiffness as published, rigid by the limb's pose; _bias with offsets [-]"
    ),
    "estimator.identification.weights": (
        "weights of the channels within a group: by size, by noise, or equal (raw) [-]"
    ),
    "estimator.identification.rest_position_limit": (
        "largest distance of a rest position from q_ref, per axis [m]"
    ),
    "estimator.identification.gate_sharpness": "sharpness alpha of the gate [1/m]",
    "estimator.plateau.force_change": (
        "difference of the mean force that counts as a change of load [N]"
    ),
    "estimator.plateau.force_drift": "largest spread of the mean force within a plateau [N]",
    "estimator.plateau.least_duration": "shortest plateau [s]",
    "estimator.plateau.least_force": (
        "smallest mean force; unloaded data gives no information on contact [N]"
    ),
    "estimator.window.least_samples": "steady samples before an automatic fit [1]",
    "estimator.force_map.sinking": (
        "forces of a bed of springs as the limb sinks, relative to normal_deviation [-]"
    ),
    "estimator.force_map.drag": (
        "distal force on a tile by friction, relative to its normal force [-]"
    ),
    "estimator.force_map.spread": (
        "deviation of log(size) of shear, preload, bed, sinking, rotation, bed_shear and"
        " bed_variation [-]"
    ),
    "recorder.next.side": "side of the residual limb, left or right [-]",
    "recorder.next.subject": "code of the subject, such as S01 [-]",
    "recorder.everything": "also record the maps, which a replay recomputes [-]",
    "replay.rate": "speed of the replay relative to the recording [-]",
    "trigger.simulation": "folder of a simulated world; empty: the hardware [-]",
    "trigger.scheduling.priority": "real-time priority; 0: none [1]",
    "trigger.scheduling.cores": "cores to run on; empty: all [1]",
    "trigger.input_line": "line wired to output_line, whose edge is timestamped [1]",
    "cluster.multiplexer": "I2C address of the clusters' multiplexer; 0: none [1]",
    "cluster.multiplexers": (
        "address of each cluster's multiplexer, if they differ; empty: multiplexer for all [1]"
    ),
    "cluster.sample_rate": (
        "conversions per chip, shared by its inputs; FDC1004: 100, 200, 400 [1/s]"
    ),
    "load_cell.crc": (
        "polynomial of the converter's checksum: ccitt (0x1021) or ansi (0x8005) [-]"
    ),
    "load_cell.channels": "channels of the converter: 6 (M06) or 8 (M08) [1]",
    "load_cell.data_ready_line": (
        "GPIO line of DRDY, whose edges timestamp the conversions; -1: none [1]"
    ),
    "load_cell.oversampling": "oversampling ratio; rate = clock_in / 2 / oversampling [1]",
    "load_cell.sign": "sign of each bridge, 1 or -1 [-]",
    "load_cell.matrix": (
        "calibration matrix of the maker, row by row, Fx to Mz over the bridges [N, N m per mV/V]"
    ),
    "load_cell.full_scale": "full scale of Fx Fy Fz Mx My Mz [N, N m]",
    "load_cell.window": ("minimum span of a wrench's conversions, a quarter after the trigger [s]"),
    "load_cell.average_over": (
        "span centred on a trigger to average its wrench, if the window is shorter; negative: the"
        " trigger's period, at most 0.25; 0: the window alone [s]"
    ),
    "mocap.window": (
        "span of frames centred on a trigger to average for its pose; negative: the trigger's"
        " period, at most 0.25; 0: between the two frames around it [s]"
    ),
    "mocap.multicast": "multicast group, such as 239.255.42.99; empty: unicast [-]",
    "estimator.identification.initial_stiffness": (
        "stiffness k0 of every spring in Stage 1; auto or 0: from the trial's slope [N/m]"
    ),
    "estimator.identification.reference_position": (
        "q_ref, centre of the box of rest positions; empty: the mean position [m]"
    ),
    "estimator.identification.theta": (
        "weight of the wrench against the clusters, on normalised errors [-]"
    ),
    "estimator.identification.frames": (
        "samples from the segment's start that offline fits use; 0: all [1]"
    ),
    "estimator.identification.pose_smoothing": (
        "centred window of the mean pose in offline fits; 0: none [s]"
    ),
    "estimator.window.refit_after": "new samples before the next fit; 0: never [1]",
    "estimator.force_map.draws": (
        "hypotheses drawn from these distributions; 1: the given values only [1]"
    ),
    "recorder.next.name": "name of the trial; empty: the date and time [-]",
    "recorder.next.mass": "body mass of the subject; 0: not stated [kg]",
    "replay.namespace": "namespace to publish in, such as /left; empty: as recorded [-]",
    "replay.tare": "tare of the wrenches: recorded, none, or T0:T1 without load [s]",
    "view.port": "port of the page; 0: any free port [1]",
}


@pytest.mark.parametrize("name", MEANINGS)
def test_special_values_have_their_meaning(name: str) -> None:
    assert descriptions()[name] == MEANINGS[name]


def line(kind: Any, **given: Any) -> str:
    with pytest.raises(ConfigurationError) as found:
        kind(**given)
    return str(found.value)


def test_a_long_pulse_has_this_line() -> None:
    """At most half of a period."""
    assert acquisition.MAX_PULSE == 0.5
    assert line(acquisition.TriggerSettings, pulse=0.0101, rate=50.0) == (
        "a pulse of 0.0101 s is too long for 50 Hz: set pulse to 0.01 s or less"
    )
    acquisition.TriggerSettings(pulse=0.01, rate=50.0)


def test_a_position_has_three_coordinates() -> None:
    assert line(identification.IdentificationSettings, reference_position=(0.0, 0.1)) == (
        "reference_position has 2 numbers: give x, y and z in m, or none for the mean limb position"
    )
    identification.IdentificationSettings(reference_position=(0.0, 0.1, 0.2))


def test_a_missing_solver_has_this_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("qpsolvers.available_solvers", ["clarabel", "quadprog"])
    monkeypatch.setattr("sys.executable", "/usr/bin/python3")
    assert line(identification.check_solver, solver="quadprg") == (
        "solver 'quadprg' is not installed: did you mean 'quadprog'?"
    )
    assert line(identification.check_solver, solver="osqp") == (
        "solver 'osqp' is not installed: install requirements/runtime.txt for /usr/bin/python3, or"
        " use one of clarabel, quadprog"
    )


FILES = {
    "trigger_node: {ros__parameters: {rate: 600}}": (
        "trigger_node: rate is 600: give a number from 0.1 to 500: rate of the trigger [Hz]"
    ),
    "tigger_node: {ros__parameters: {}}": (
        "unknown key 'tigger_node': did you mean 'trigger_node'?"
    ),
    "trigger_node: {ros__parameters: {rat: 4}}": (
        "trigger_node: unknown key 'rat': did you mean 'rate'?"
    ),
    "estimator_node: {ros__parameters: {plateau: {least_force: -1}}}": (
        "estimator_node: plateau.least_force is -1: give a number from 0 to 10000: smallest mean"
        " force; unloaded data gives no information on contact [N]"
    ),
    "trigger_node: {rate: 4}": (
        "trigger_node/rate is not a mapping: write 'ros__parameters:' below the name of a node,"
        " then its parameters"
    ),
}


@pytest.mark.parametrize("text", FILES)
def test_a_parameter_file_is_refused_with_this_line(text: str, tmp_path: Path) -> None:
    path = tmp_path / "testbed.yaml"
    path.write_text(text)
    assert line(testbed.read_testbed, path=path) == f"{path}: {FILES[text]}"


def test_settings_of_one_run_are_not_stored(tmp_path: Path) -> None:
    own = testbed.RecorderSettings(directory="here", record=True, flush_period=2.0, metadata="a")
    trigger = acquisition.TriggerSettings(simulation="world", wait_for=("a",), rate=5.0)
    path = tmp_path / "testbed.yaml"
    testbed.write_testbed({"recorder_node": own, "trigger_node": trigger}, path)
    found = testbed.read_testbed(path)
    assert found.recorder_node == testbed.RecorderSettings(flush_period=2.0)
    assert found.trigger_node == acquisition.TriggerSettings(rate=5.0)


def test_choices_come_before_a_file_s_and_the_stored(tmp_path: Path) -> None:
    usual = testbed.EstimatorSettings()
    stored = testbed.estimator_settings(usual, {"theta": 0.25, "frames": 9})
    assert (stored.identification.theta, stored.identification.frames) == (0.25, 9)
    kept = testbed.estimator_settings(stored, {"frames": 7})
    assert (kept.identification.theta, kept.identification.frames) == (0.25, 7)
    path = tmp_path / "testbed.yaml"
    path.write_text("estimator_node: {ros__parameters: {identification: {frames: 3}}}")
    other = testbed.estimator_settings(stored, {"theta": 0.75}, path)
    assert (other.identification.theta, other.identification.frames) == (0.75, 3)
