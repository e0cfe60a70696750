"""The panel in words and plots, its buttons, and the outputs by region of a running testbed."""

import math
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import HANGS
from support.ring_socket import ring_socket

from socket_testbed.errors import TestbedError
from socket_testbed.geometry.regions import all_regions
from socket_testbed.identification.force_map import ForceMap
from socket_testbed.identification.pressure import THRESHOLD, pressure_outputs
from socket_testbed.samples import Status
from socket_testbed.settings.identification import IdentificationSettings
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.trial import Trial
from socket_testbed.viewer.live_regions import LiveRegions
from socket_testbed.viewer.panel import (
    Panel,
    fitting,
    recording_html,
    regions_html,
    sensors_html,
    thinned,
)
from socket_testbed.viewer.server import PageServer
from socket_testbed.viewer.source import HISTORY, Recording, RegionsNow, SensorState


class Controls:
    """Buttons of no testbed: each call waits until it may go on, and may be refused."""

    def __init__(self) -> None:
        self.called: list[Any] = []
        self.begun = threading.Semaphore(0)
        self.go_on = threading.Event()
        self.go_on.set()
        self.refused: TestbedError | None = None

    def _do(self, *call: Any) -> str:
        self.called.append(call)
        self.begun.release()
        assert self.go_on.wait(HANGS)
        if self.refused:
            raise self.refused
        return f"done {call[0]}"

    def tare(self) -> str:
        return self._do("tare")

    def fit(self) -> str:
        return self._do("fit")

    def record(self, name: str, metadata: dict[str, str]) -> str:
        return self._do("record", name, metadata)

    def stop_recording(self) -> str:
        return self._do("stop")

    def event(self, label: str) -> str:
        return self._do("event", label)

    def trigger(self, on: bool) -> str:
        return self._do("trigger", on)


class Source:
    """What a page shows, as plain values."""

    geometry = ring_socket()
    playback = None

    def __init__(self, controls: Controls | None) -> None:
        self.controls = controls
        self.recorded = ""

    def instant(self) -> None:
        return None

    def wrenches(self) -> tuple[Any, Any, Any]:
        return np.arange(3.0), np.ones((3, 6)), np.zeros((3, 6))

    def sensors(self) -> list[SensorState]:
        return [SensorState("/load_cell_node", 0, "converts", 100.0, 0.2)]

    def recording(self) -> Recording:
        return Recording(self.recorded, 3.0, 5e9)

    def regions(self) -> None:
        return None

    def watched(self, on: bool) -> None:
        pass


@pytest.fixture(scope="module")
def server() -> Iterator[PageServer]:
    server = PageServer("127.0.0.1", 0)
    yield server
    server.close()


class Client:
    """A browser that notes what it is notified of."""

    def __init__(self) -> None:
        self.heard: list[tuple[str, str]] = []

    def add_notification(self, title: str, body: str, **how: Any) -> None:
        self.heard.append((title, body))


def press(panel: Panel, what: str, client: Client | None = None) -> None:
    """Press a button and wait for what comes of it."""
    assert panel._buttons is not None
    (callback,) = panel._buttons._buttons[what]._impl.update_cb
    callback(SimpleNamespace(client=client))


def show(panel: Panel, source: Source) -> None:
    """Show how a source is, however shortly ago that was done."""
    panel._next_texts = panel._next_plots = -math.inf
    panel.update(source)


def said(panel: Panel) -> str:
    assert panel._buttons is not None
    return str(panel._buttons._said.content)


def test_each_button_says_what_came_of_it(server: PageServer) -> None:
    controls, client = Controls(), Client()
    source = Source(controls)
    panel = Panel(server.viser, source)
    assert panel._buttons is not None
    panel._buttons._name.value = " stairs "
    panel._buttons._metadata["subject"].value = "S01"
    for what in ("tare", "fit", "trigger on", "trigger off", "event", "record", "stop"):
        press(panel, what, client)
    assert controls.called == [
        *(("tare",), ("fit",), ("trigger", True), ("trigger", False), ("event", "event")),
        *(("record", "stairs", {"subject": "S01"}), ("stop",)),
    ]
    assert client.heard[0] == ("tare", "done tare")
    controls.refused = TestbedError("an axis <b>moves</b>", "hold still")
    press(panel, "tare", client)
    assert client.heard[-1] == ("tare failed", "an axis <b>moves</b>: hold still")
    show(panel, source)
    assert "an axis &lt;b&gt;moves&lt;/b&gt;: hold still" in said(panel)


def test_a_button_is_off_while_its_call_runs_but_events_go_on(server: PageServer) -> None:
    controls = Controls()
    source = Source(controls)
    panel = Panel(server.viser, source)
    assert panel._buttons is not None
    buttons = panel._buttons._buttons
    controls.go_on.clear()
    threads = [
        threading.Thread(target=press, args=(panel, what)) for what in ("fit", "event", "event")
    ]
    for thread in threads:
        thread.start()
    for _ in threads:
        assert controls.begun.acquire(timeout=HANGS)
    show(panel, source)
    assert buttons["fit"].disabled and not buttons["event"].disabled
    assert not buttons["tare"].disabled
    assert "fit: 0 s" in said(panel) or "fit: 1 s" in said(panel)
    press(panel, "fit")  # of another browser, at the same moment
    assert [call[0] for call in controls.called].count("fit") == 1
    controls.go_on.set()
    for thread in threads:
        thread.join()
    assert not buttons["fit"].disabled


def test_record_and_stop_take_turns_and_a_page_without_controls_has_them_off(
    server: PageServer,
) -> None:
    source = Source(Controls())
    panel = Panel(server.viser, source)
    assert panel._buttons is not None
    buttons = panel._buttons._buttons
    for source.recorded in ("", "s01", ""):
        show(panel, source)
        assert buttons["record"].visible == (source.recorded == "")
        assert buttons["stop"].visible == (source.recorded != "")
    off = Panel(server.viser, Source(None))
    assert off._buttons is not None
    assert all(button.disabled for button in off._buttons._buttons.values())
    press(off, "tare")
    show(off, Source(None))
    assert all(button.disabled for button in off._buttons._buttons.values())
    assert "the buttons are off" in said(off)


def test_what_has_not_changed_is_not_sent_again(
    server: PageServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = Source(Controls())
    panel = Panel(server.viser, source)
    show(panel, source)
    sent: list[Any] = []
    monkeypatch.setattr(server.viser.gui._websock_interface, "queue_message", sent.append)
    show(panel, source)
    assert not sent
    source.recorded = "s01"
    show(panel, source)
    assert len(sent) == 3  # the line, and the two buttons


def test_sensors_are_said_in_words_and_a_silent_one_is_a_fault() -> None:
    fine = SensorState("/left/load_cell_node", 0, "spidev0.0 converts", 99.96, 0.4)
    assert "all 1 are well" in sensors_html([fine])
    assert "100&nbsp;Hz" in sensors_html([fine])
    fault = replace(fine, name="/cluster_node", level=2, words="no answer at 0x50 <script>")
    text = sensors_html([fine, fault])
    assert "1 of 2 need attention" in text and "no answer at 0x50 &lt;script&gt;" in text
    text = sensors_html([replace(fine, age=12.0)])
    assert "1 of 1 need attention" in text and "silent for 12 s" in text
    assert "nothing is heard" in sensors_html([])


def test_the_recording_s_name_time_and_free_space_are_shown() -> None:
    text = recording_html(Recording("s<01>", 75.0, 4.2e9))
    assert "s&lt;01&gt;" in text and "1:15" in text and "4.2 GB free" in text
    assert "free" not in recording_html(Recording("s01", 75.0, math.nan))
    assert "nothing is being recorded" in recording_html(Recording("", 0.0, 4.2e9))
    assert not recording_html(None)


def test_thinned_plots_keep_extremes_gaps_and_what_is_little() -> None:
    rng = np.random.default_rng(3)
    at = 100.0 + np.arange(0.0, HISTORY, 0.01)
    values = rng.normal(size=(len(at), 2))
    values[700, 0] = 50.0  # one sample alone
    gone = (at > 110.0) & (at < 112.0)
    values[gone, 1] = np.nan
    shown, found = thinned(at, values)
    assert len(shown) < 400 and (np.diff(shown) > 0).all()
    assert found[:, 0].max() == 50.0
    assert np.nanmin(found, axis=0) == pytest.approx(np.nanmin(values, axis=0))
    assert np.isnan(found[(shown > 110.2) & (shown < 111.8), 1]).all()
    assert np.isfinite(found[:, 0]).all()
    later = thinned(at[30:], values[30:])  # a moment later, the same parts
    same = np.isin(later[0], shown)
    assert same.mean() > 0.99
    few = thinned(at[:200], values[:200])
    assert few[0] is not None and len(few[0]) == 200


def test_an_axis_keeps_its_range_while_values_fit_and_fill_it() -> None:
    span = fitting(np.array([[np.nan, 10.0], [30.0, np.nan]]), (0.0, 0.0))
    assert span[0] < 10.0 and span[1] > 30.0
    assert fitting(np.array([12.0, 29.0, np.nan]), span) == span
    assert fitting(np.full((4, 2), np.nan), span) == span
    low, high = fitting(np.array([20.0, 21.0]), span)
    assert span[0] < low < 20.0 and 21.0 < high < span[1]
    assert fitting(np.array([5.0]), (low, high))[0] < 5.0


@pytest.fixture(scope="module")
def sample(hold: Path) -> tuple[Trial, Any]:
    trial = Trial(hold)
    return trial, trial.samples()[100:101]


def stresses_of(trial: Trial, sample: Any) -> dict[str, tuple[np.ndarray, int]]:
    """The clusters' stresses that give the forces of a sample."""
    geometry = trial.geometry
    return {
        name: (force_to_stress(geometry, name, sample.local_forces[0, k]), int(sample.status[0, k]))
        for k, name in enumerate(sample.clusters)
    }


def force_to_stress(geometry: Any, name: str, force: np.ndarray) -> np.ndarray:
    unit = np.array([geometry.cluster_force(name, axis) for axis in np.eye(3)])
    return np.linalg.solve(unit.T, force)


def test_live_outputs_are_those_of_pressure_for_the_same_sample(sample: tuple[Trial, Any]) -> None:
    trial, one = sample
    geometry = trial.geometry
    live = LiveRegions(geometry)
    stresses = stresses_of(trial, one)
    found = live.outputs(7.0, one.wrench[0], stresses)
    places = all_regions(geometry)
    expected = pressure_outputs(
        ForceMap(geometry, one.clusters), one, geometry, places, THRESHOLD
    ).regions
    assert found is not None and found.time == 7.0
    for name in ("mean", "peak", "area", "share"):
        ours, theirs = getattr(found.outputs, name), getattr(expected, name)
        np.testing.assert_allclose(ours.value, theirs.value, rtol=1e-9)
        np.testing.assert_allclose(ours.high, theirs.high, rtol=1e-9)
    text = regions_html(found)
    assert "socket" in text and "undetermined" in text and "anterior proximal" not in text
    assert f"{expected.peak.value[-1] * 1e-3:.0f}" in text


def test_live_outputs_follow_the_estimator_and_leave_out_what_cannot_be(
    sample: tuple[Trial, Any],
) -> None:
    trial, one = sample
    live = LiveRegions(trial.geometry)
    stresses = stresses_of(trial, one)

    def peak(found: RegionsNow | None) -> float:
        assert found is not None
        return float(found.outputs.peak.high[-1])

    usual = peak(live.outputs(0.0, one.wrench[0], stresses))
    name = one.clusters[0]
    without = peak(live.outputs(0.0, one.wrench[0], stresses | {name: (np.full(3, np.nan), 2)}))
    assert without != usual
    absurd = stresses | {name: (np.full(3, 1e9), int(Status.OK))}
    assert peak(live.outputs(0.0, one.wrench[0], absurd)) == pytest.approx(without)
    channels = tuple(f"{name}.{axis}" for axis in ("Fx", "Fy", "Fz"))
    live.settings = EstimatorSettings(identification=IdentificationSettings(leave_out=channels))
    assert peak(live.outputs(0.0, one.wrench[0], stresses)) == pytest.approx(without)
    missing = {name: (np.full(3, np.nan), int(Status.MISSING)) for name in one.clusters}
    assert live.outputs(0.0, np.full(6, np.nan), missing) is None
