"""Every parameter of every node as a user finds it: default, range, choices, fixed or not.

Results of earlier trials depend on the defaults, and files of other machines on the ranges.
"""

from typing import Any

import pytest

from socket_testbed.documents import FINITE
from socket_testbed.settings import acquisition, fields, identification, testbed
from socket_testbed.settings.acquisition import averaging_span

# name = default, then lowest..highest, choices, `fixed` after the start, what `auto` stands for
TABLE = {
    "trigger_node": """
        source = 'gpio' of gpio timer topic fixed
        topic = '' fixed
        rate = 4.0 0.1..500
        enabled = True fixed
        wait_for = () fixed
        chip = 'pinctrl-rp1' fixed
        output_line = 17 0..1023 fixed
        input_line = 27 0..1023 fixed
        pulse = 0.0005 1e-05..0.1 fixed
        simulation = '' fixed
        edge_within = 0.001 1e-05..0.1 fixed
        scheduling.priority = 0 0..98 fixed
        scheduling.cores = () 0..1023 fixed
        scheduling.lock_memory = False fixed
    """,
    "cluster_node": """
        names = ('brim_lateral', 'mid_anterior', 'posterior_distal', 'distal') fixed
        chip = 'fdc1004' fixed
        buses = (1, 1, 1, 1) 0..255 fixed
        multiplexer = 112 0..119 fixed
        multiplexers = () 0..119 fixed
        channels = (0, 1, 2, 3) 0..7 fixed
        sample_rate = 400 1..100000 fixed
        simulation = '' fixed
        bus_timeout = 0.02 0.01..1 fixed
        latest = 0.05 0.001..1 fixed
    """,
    "load_cell_node": """
        tare_duration = 1.0 0.1..60
        tare_force = 2.0 0.001..1000
        tare_moment = 0.2 0.0001..100
        tare_load = 40.0 1..100000
        tare_pressure = 5000.0 100..1e+07
        tare_file = '' fixed
        device = '0.0' fixed
        spi_clock = 8000000.0 100000..2.5e+07 fixed
        channels = 6 6..8 fixed
        crc = 'ccitt' of ccitt ansi fixed
        inputs = (0, 1, 2, 3, 4, 5) 0..7 fixed
        data_ready_line = -1 -1..1023 fixed
        data_ready_chip = 'pinctrl-rp1' fixed
        clock_in = 8192000.0 300000..8.4e+06 fixed
        oversampling = 8192 128..16384 fixed
        gain = 1 1..128 fixed
        amplifier_gain = (34.0, 34.0, 34.0, 151.0, 151.0, 151.0) 1..10000 fixed
        excitation = 5.0 0.5..20 fixed
        sign = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0) -1..1 fixed
        matrix = () -1e+06..1e+06 fixed
        full_scale = () 0.001..100000 fixed
        simulation = '' fixed
        window = 0.02 0.001..1
        average_over = -1.0 -1..0.5
    """,
    "mocap_node": """
        server = '' fixed
        command_port = 1510 1..65535 fixed
        data_port = 1511 1..65535 fixed
        multicast = '' fixed
        interface = '' fixed
        bitstream = '4.1' fixed
        socket_body = 'socket' fixed
        pylon_body = 'pylon' fixed
        geometry = '' fixed
        stale = 0.05 0.001..1 fixed
        window = -1.0 -1..0.5
        clock_uncertainty = 0.002 1e-05..0.1 fixed
        record_takes = True
    """,
    "align_node": """
        tare_duration = 1.0 0.1..60
        tare_force = 2.0 0.001..1000
        tare_moment = 0.2 0.0001..100
        tare_load = 40.0 1..100000
        tare_pressure = 5000.0 100..1e+07
        tare_file = '' fixed
        wrench.delay = 0.0 -10..10
        wrench.method = 'line' of line mean last
        wrench.window = -1.0 -1..5
        wrench.stale = -1.0 -1..10
        wrench.topic = '' fixed
        wrench.of = 'limb' of limb socket
        wrench.rotation = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0) -1..1 fixed
        wrench.translation = (0.0, 0.0, 0.0) -2..2 fixed
        socket_pose.delay = 0.0 -10..10
        socket_pose.method = 'line' of line mean last
        socket_pose.window = -1.0 -1..5
        socket_pose.stale = -1.0 -1..10
        socket_pose.topic = '' fixed
        pylon_pose.delay = 0.0 -10..10
        pylon_pose.method = 'line' of line mean last
        pylon_pose.window = -1.0 -1..5
        pylon_pose.stale = -1.0 -1..10
        pylon_pose.topic = '' fixed
        clusters.delay = 0.0 -10..10
        clusters.method = 'line' of line mean last
        clusters.window = -1.0 -1..5
        clusters.stale = -1.0 -1..10
        clusters.topic = '' fixed
        clusters.names = () fixed
        wait = 0.3 0.01..10
        geometry = '' fixed
        calibration = '' fixed
    """,
    "calibration_node": """
        calibration = '' fixed
    """,
    "estimator_node": """
        geometry = '' fixed
        model = '' fixed
        auto_fit = True
        identification.variant = 'rigid_bias' of stiffness stiffness_bias rigid rigid_bias
        identification.theta = 0.5 0..1
        identification.weights = 'size' of size noise raw
        identification.gate_sharpness = 2000.0 1..1e+06
        identification.initial_stiffness = 3000.0 0..1e+07 auto 0
        identification.reference_position = () -10..10
        identification.rest_position_limit = 0.008 1e-05..0.1
        identification.smoothness = 0.001 0..1e+06
        identification.stiffness_difference = 1000.0 0.001..1e+07
        identification.rest_position_difference = 0.002 1e-06..0.1
        identification.contact_sharpness = 1000.0 1..1e+06
        identification.prior = 1.0 1e-09..1e+06
        identification.leave_out = ()
        identification.frames = 0 0..1e+07
        identification.pose_smoothing = 0.0 0..60
        identification.solver = 'osqp'
        identification.solver_tolerance = 1e-08 1e-12..0.01
        plateau.smoothing = 2.0 0.05..60
        plateau.force_change = 8.0 0.1..10000
        plateau.moment_change = 0.8 0.01..1000
        plateau.force_drift = 10.0 0.1..10000
        plateau.moment_drift = 1.0 0.01..1000
        plateau.cluster_change = 3.0 0.01..10000
        plateau.cluster_drift = 5.0 0.01..10000
        plateau.missing_fraction = 0.2 0..1
        plateau.least_force = 20.0 0..10000
        plateau.least_duration = 5.0 0.1..100000
        window.duration = 60.0 1..3600 fixed
        window.least_samples = 80 10..1e+06
        window.refit_after = 80 0..1e+06
        window.pending = 200 2..100000 fixed
        force_map.normal_deviation = 4.5 0.001..10000
        force_map.length = 0.08 0.001..1
        force_map.shear = 0.2 0.001..100
        force_map.length_spread = 0.5 0..1
        force_map.preload = 1.2 0.001..100
        force_map.bed = 0.5 0.001..100
        force_map.sinking = 1.4 0.001..100
        force_map.rotation = 0.15 0.001..100
        force_map.bed_shear = 0.15 0.001..10
        force_map.bed_variation = 0.7 0.001..10
        force_map.arm = 0.06 0.001..1
        force_map.drag = 0.1 -1..1
        force_map.drag_spread = 0.1 0..0.5
        force_map.share = 0.88 0.2..1
        force_map.share_spread = 0.07 0..0.3
        force_map.moment_error = 0.7 1e-06..100
        force_map.force_error = 4.0 1e-06..1000
        force_map.cluster_error = 0.3 1e-06..1000
        force_map.cluster_gain_error = 0.05 0..1
        force_map.cluster_error_spread = 1.0 0..3
        force_map.spread = 1.0 0..2
        force_map.draws = 64 1..1024
    """,
    "recorder_node": """
        directory = 'trials' fixed
        record = False fixed
        geometry = '' fixed
        calibration = '' fixed
        parameters = '' fixed
        metadata = '' fixed
        everything = False fixed
        beside = () fixed
        absent = () fixed
        next.name = ''
        next.subject = ''
        next.side = ''
        next.socket = ''
        next.liner = ''
        next.mass = 0.0 0..400
        next.operator = ''
        next.protocol = ''
        next.notes = ''
        flush_period = 1.0 0.05..60 fixed
    """,
    "replay_node": """
        trial = '' fixed
        namespace = '' fixed
        geometry = '' fixed
        load_cell = '' fixed
        tare = 'recorded' fixed
        rate = 1.0 0.001..10000 fixed
        loop = False fixed
        paused = False fixed
        measured_only = False fixed
        wait_for = () fixed
    """,
    "view_node": """
        geometry = '' fixed
        host = '127.0.0.1' fixed
        port = 8080 0..65535 fixed
        names = () fixed
        buttons = False fixed
    """,
}


def described(name: str, item: Any) -> str:
    """A line of the table, from the product."""
    limits = item.metadata
    low, high = limits["low"], limits["high"]
    parts = [f"{name} = {item.default!r}"]
    parts += [] if high - low > FINITE else [f"{low:g}..{high:g}"]
    parts += ["of", *limits["choices"]] if limits["choices"] else []
    parts += ["fixed"] * limits["fixed"]
    parts += [] if limits["auto"] is None else [f"auto {limits['auto']:g}"]
    return " ".join(parts)


@pytest.mark.parametrize("node", TABLE)
def test_parameters_have_their_defaults_and_ranges(node: str) -> None:
    """The scheduling of all nodes that measure is that of the trigger node."""
    kind = type(testbed.TestbedSettings().nodes()[node])
    found = [described(*item) for item in kind.flat().items()]
    if node != "trigger_node":
        found = [line for line in found if not line.startswith("scheduling.")]
    assert found == [line.strip() for line in TABLE[node].strip().splitlines()]


def test_nodes_are_all_in_the_table() -> None:
    assert [*testbed.TestbedSettings().nodes()] == [*TABLE]


def test_variants_and_weights_have_their_names() -> None:
    assert identification.VARIANTS == ["stiffness", "stiffness_bias", "rigid", "rigid_bias"]
    assert identification.PAPER_VARIANTS == ("stiffness", "stiffness_bias")
    assert identification.BIAS_VARIANTS == ["stiffness_bias", "rigid_bias"]
    assert identification.MIN_SHARE == 0.2
    assert (acquisition.MAX_TARE, acquisition.MAX_STALE, acquisition.READY_TIMEOUT) == (60, 1, 60)


@pytest.mark.parametrize(
    ("wanted", "period", "span"),
    [(0.1, 4.0, 0.1), (0.0, 4.0, 0.0), (-1.0, 0.2, 0.2), (-1.0, 4.0, 0.25), (-1.0, 0.0, 0.0)],
)
def test_a_wrench_is_averaged_over_the_period(wanted: float, period: float, span: float) -> None:
    """At most a quarter of a second."""
    assert averaging_span(wanted, period) == span


def test_auto_stands_for_zero() -> None:
    own = identification.IdentificationSettings(initial_stiffness="auto")  # type: ignore[arg-type]
    assert own.initial_stiffness == 0.0
    assert identification.IdentificationSettings(initial_stiffness=0.0) == own


def test_each_cluster_has_its_place_on_the_bus() -> None:
    own = acquisition.ClusterSettings(names=("a", "b"), buses=(1, 3), channels=(0, 5))
    assert own.each_multiplexer == (0x70, 0x70) and own.places == [(1, 0x70, 0), (3, 0x70, 5)]
    own = acquisition.ClusterSettings(
        names=("a", "b"), buses=(1, 3), channels=(0, 5), multiplexers=(0x71, 0x72)
    )
    assert own.places == [(1, 0x71, 0), (3, 0x72, 5)]


def test_an_empty_list_has_a_type_in_ros() -> None:
    found = fields.parameter_values(testbed.ReplaySettings(rate=2.0))
    assert found["wait_for"] == [""] and found["rate"] == 2.0
    assert testbed.ReplaySettings(wait_for=("a",)).to_flat("x.")["x.wait_for"] == ["a"]


def test_a_retired_switch_is_accepted_while_off() -> None:
    kind = identification.IdentificationSettings
    assert kind.from_flat({"noise_correction": False, "theta": 0.2}, "here").theta == 0.2
    for value in (True, 0):
        with pytest.raises(Exception, match="unknown key 'noise_correction'"):
            kind.from_flat({"noise_correction": value}, "here")


def test_a_setting_that_nothing_reads_is_accepted() -> None:
    kind = identification.IdentificationSettings
    old = {"wrench_sharpness": [100.0, 20.0], "theta": 0.2}
    assert kind.from_flat(old, "here") == kind(theta=0.2)


def test_help_tells_default_range_and_choices() -> None:
    entry = fields._entry("rate", testbed.ReplaySettings.flat()["rate"])
    assert " ".join(entry.split()) == (
        "rate: speed of the replay relative to the recording [-]; default 1.0; from 0.001 to 10000."
    )
    source = acquisition.TriggerSettings.flat()["source"]
    assert fields._explained(source).endswith("default 'gpio'; one of 'gpio', 'timer', 'topic'")
    inputs = acquisition.LoadCellSettings.flat()["inputs"]
    assert fields._explained(inputs).endswith("; each from 0 to 7")
    open_ended = fields.setting(2.0, "a length [m]", low=1.0)
    assert fields._explained(open_ended) == "a length [m]; default 2.0; at least 1"
    below = fields.setting((2.0,), "lengths [m]", high=3.0)
    assert fields._explained(below) == "lengths [m]; default (2.0,); each at most 3"
    nested = fields._explained(acquisition.SchedulingSettings())
    assert nested == "nested settings, a `SchedulingSettings`"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (".a", "begins or ends with a '.' or a blank, or is empty"),
        ("a.", "begins or ends"),
        ("ü" * 101, "has 202 bytes: give letters, digits, blanks, '-', '_' and '.', 200 bytes at"),
        ("x" * 41 + "?", f"the trial's name '{'x' * 40}...' cannot be that of a take"),
    ],
    ids=["first", "last", "long", "shortened"],
)
def test_a_take_s_name_is_refused_in_words(name: str, words: str) -> None:
    with pytest.raises(Exception) as caught:
        testbed.check_take_name(name)
    assert words in str(caught.value)
    assert testbed.check_take_name("x" * 200) == "x" * 200
