"""Every benchmark at its smallest size: it ends, and each of its rows has numbers."""

import re
import shlex
import sys
from pathlib import Path

import pytest
from support.verbs import program

pytestmark = pytest.mark.slow

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"

# The words of the smallest size, as in a shell, and the starts of rows with numbers.
SMALLEST = {
    "benchmark_alignment.py": (
        "--seeds 1 --duration 5",
        ("| 4 Hz | force |", "| 25 Hz | position |", "| 25 Hz | 50 ms |"),
    ),
    "benchmark_data_check.py": (
        "--trials ramp:soft --duration 40 --only 'wrench negated|Fz dead' --sound 1",
        ("ramp (soft): 2 of 2 damaged copies named,", "sound: 0 findings on"),
    ),
    "benchmark_drivers.py": (
        "--rate 20 --duration 1",
        ("clusters", "load cell", "motion capture", "physics"),
    ),
    "benchmark_fit.py": (
        "--quick --samples 100 --thetas 3 --scenarios static_hold",
        (
            *("ours, certified", "qpsolvers + OSQP", "scipy lsq_linear", "front of 3 thetas"),
            *("stiffness_bias", "rigid_bias"),
        ),
    ),
    "benchmark_force_map.py": (
        "--families 'friction bed' --seeds 100",
        ("update, n = 79", "update as a cluster drops out", "prior and gains", "friction bed"),
    ),
    "benchmark_live.py": (
        "--rate 10 --duration 4",
        ("bare relay", "estimator_node", "all nodes", "estimate  after the pulse: p50"),
    ),
    "benchmark_long_trials.py": (
        "0.2 --verbs info export",
        ("the bag library's iteration", "reading all samples", "info", "export"),
    ),
    "benchmark_survey.py": ("--seeds 400 --shares 0.1 --tissues soft", ("soft    10 %",)),
    "benchmark_survey_prior.py": ("--seeds 600 --shares 0.1 --tissues soft", ("soft    10 %",)),
    "benchmark_scans.py": ("--edges 8 --words '--rounds 0'", ("edges of 8 mm.stl: look",)),
    "benchmark_validation.py": (
        "--seeds 100 --duration 30",
        (
            "rigid_bias ",
            "linear regression on the pose ",
            "cluster  force map",
            "tiles    force map",
        ),
    ),
}


@pytest.mark.parametrize("script", sorted(path.name for path in BENCHMARKS.glob("benchmark_*.py")))
def test_a_benchmark_prints_a_row_for_each_measurement(script: str) -> None:
    path, (words, rows) = BENCHMARKS / script, SMALLEST[script]
    code, out, _ = program(sys.executable, path, "--help")
    assert code == 0 and out.startswith(f"usage: {script}")
    code, out, err = program(sys.executable, path, *shlex.split(words))
    assert code == 0, err
    for row in rows:
        found = re.findall(rf"^{re.escape(row)}.*\d.*$", out, re.MULTILINE)
        assert found and "nan" not in " ".join(found).split(), out
