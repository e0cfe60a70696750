"""Where the report says that its files come from, and which tile it says has the peak."""

import hashlib
import platform
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy
from support import scene
from support.pages import MADE
from support.results_by_hand import tile

import socket_testbed as st
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.report import pressure, quality
from socket_testbed.results.pressure import TrialPressure
from socket_testbed.results.pressure_text import describe_pressure
from socket_testbed.results.report import Results
from socket_testbed.samples import Samples
from socket_testbed.trials.trial import Trial

GIVEN, STORED = "given on the command line", "stored in the trial"


@pytest.mark.parametrize(
    ("given", "origins"),
    [
        ((), (STORED, STORED)),
        (("socket",), (GIVEN, STORED)),
        (("calibration",), (STORED, GIVEN)),
        (("socket", "calibration"), (GIVEN, GIVEN)),
    ],
    ids=["stored", "socket", "calibration", "both"],
)
def test_each_file_has_its_origin_and_hash(
    given: tuple[str, ...], origins: tuple[str, str], report, scene_folder: Path
) -> None:
    files = {f"{name}_file": scene_folder.parent / f"{name}.yaml" for name in given}
    results = replace(report.results, trial=Trial(scene_folder, **files))
    rows = dict(quality.provenance(results, "by hand", MADE))
    for row, name, origin in zip(
        ("geometry", "calibration"), ("socket.yaml", "calibration.yaml"), origins, strict=True
    ):
        digest = hashlib.sha256((scene_folder / name).read_bytes()).hexdigest()[:16]
        assert rows[row] == f"{name}, {origin}, SHA-256 {digest}..."


def test_what_replaces_measurements_is_named(report, scene_folder: Path) -> None:
    trial = Trial(scene_folder, tare="1:2", unloaded=((0.0, 3.0),))
    rows = dict(quality.provenance(replace(report.results, trial=trial), "by hand", MADE))
    assert rows["tare"] == "1:2" and rows["unloaded"] == "[[0.0, 3.0]]"
    assert rows["load cell"] == "recorded" and rows["trial"] == "scene"
    assert rows["geometry, source"] == "a scene made by hand"
    assert rows["report made"] == "2026-02-03 04:05:06 UTC"


def test_versions_are_those_that_computed(report) -> None:
    rows = dict(quality.provenance(report.results, "by hand", MADE))
    assert rows["version of socket_testbed"] == st.__version__
    assert rows["version of numpy"] == np.__version__
    assert rows["version of scipy"] == scipy.__version__
    assert rows["Python"].startswith(f"{platform.python_version()} on ")


class _Moving(scene.HandMap):
    """The forces of the scene, but at its first sample `post_mid` has the highest pressure."""

    def estimate(self, samples: Samples) -> MapEstimate:
        found = super().estimate(samples)
        moved = found.normal_pressure.copy()
        moved[samples.stamps == scene.START, tile("post_mid")] = 50e3  # below the peak of 60 kPa
        return replace(found, normal_pressure=moved)


@pytest.fixture
def moving(report) -> TrialPressure:
    """Pressures whose highest tile changes over the segment."""
    socket = scene.geometry()
    force_map = _Moving(socket, tuple(socket.clusters))
    return replace(report.results.pressure.map, force_map=force_map).pressure()


def test_the_tile_named_is_the_peak_s(moving: TrialPressure) -> None:
    first = moving.outputs.estimate.normal_pressure[0]
    assert np.argmax(first) == tile("post_mid")
    assert describe_pressure(moving).endswith("The peak is on ant_mid at 12.00 s.")


def test_the_cards_name_the_peak_s_tile(report, moving: TrialPressure) -> None:
    results: Results = replace(report.results, pressure=moving)
    data = pressure.page_data(results)
    assert data["start"] == 12.0
    assert any("ant_mid" in str(card) or "mid_anterior" in str(card) for card in data["cards"])
    assert not any("post_mid" in str(card) for card in data["cards"])


# A segment of the trial, its peak [kPa] and when; that of the trial is 60 kPa at 12 s
PARTS = {
    "before the trial's peak": ("0:4", "30.0 kPa", 4.0, "; highest of the trial 60.0 at 12 s"),
    "after the trial's peak": ("18:22", "40.0 kPa", 18.0, "; highest of the trial 60.0 at 12 s"),
    "with the trial's peak": ("6:18", "60.0 kPa", 12.0, ""),
}


@pytest.mark.parametrize("case", PARTS)
def test_the_page_tells_peaks_of_part_and_trial(case: str, report) -> None:
    segment, value, when, highest = PARTS[case]
    found = st.pressure(report.results.trial, segment)
    data = pressure.page_data(replace(report.results, pressure=found))
    card = data["cards"][0]
    assert card["value"] == value
    assert card["words"] == f"anterior middle, measured by mid_anterior, in the segment{highest}"
    assert data["start"] == when
    shown = [moment for moment in data["moments"] if "words" in moment]
    assert [moment["words"] for moment in shown] == [f"at {when:.2f} s, the peak in the segment"]
    assert shown[0]["time"] == when
    assert shown[0]["pressure"][tile("ant_mid")] == pytest.approx(float(value.removesuffix(" kPa")))
    assert data["mean"]["words"] == f"mean over {found.segment}" and data["mean"]["time"] is None


def test_a_map_is_drawn_at_the_peak(report, moving: TrialPressure) -> None:
    drawn = pressure._overview(replace(report.results, pressure=moving)).data.set_index("tile")
    assert drawn["at the peak, 12.00 s [kPa]"]["post_mid"] == pytest.approx(37.5)
    assert drawn["at the peak, 12.00 s [kPa]"]["ant_mid"] == pytest.approx(60.0)
    assert drawn["mean over the segment [kPa]"]["post_mid"] == pytest.approx(25.0)
