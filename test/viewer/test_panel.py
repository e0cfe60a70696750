"""The panel in words and plots, and its buttons."""

import math
import threading
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import HANGS
from support.sources import StillSource

from socket_testbed.errors import TestbedError
from socket_testbed.viewer.page import PageServer
from socket_testbed.viewer.panel import Panel, fitting, recording_html, sensors_html, thinned
from socket_testbed.viewer.source import HISTORY, Recording, SensorState


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

    def __getattr__(self, name: str) -> Any:
        return lambda *given: self._do(name, *given)


class Source(StillSource):
    def __init__(self, controls: Controls | None) -> None:
        self.controls = controls
        self.recorded = ""

    def wrenches(self) -> tuple[Any, Any, Any]:
        return np.arange(3.0), np.ones((3, 6)), np.zeros((3, 6))

    def sensors(self) -> list[SensorState]:
        return [SensorState("/load_cell_node", 0, "converts", 100.0, 0.2)]

    def recording(self) -> Recording:
        return Recording(self.recorded, 3.0, 5e9)


@pytest.fixture(scope="module")
def server() -> Iterator[PageServer]:
    server = PageServer("127.0.0.1", 0)
    yield server
    server.close()


class Shown:
    """A panel of a source, and a browser that notes what it is notified of."""

    def __init__(self, server: PageServer, controls: Controls | None = None) -> None:
        self.source = Source(controls)
        self.panel = Panel(server.viser, self.source)
        assert self.panel._buttons is not None
        self.controls = self.panel._buttons
        self.buttons = self.controls._buttons
        self.heard: list[tuple[str, str]] = []

    def add_notification(self, title: str, body: str, **how: Any) -> None:
        self.heard.append((title, body))

    def press(self, what: str) -> None:
        """Press a button and wait for what comes of it."""
        (callback,) = self.buttons[what]._impl.update_cb
        callback(SimpleNamespace(client=self))

    def update(self) -> str:
        """Show how the source is, however shortly ago; returns what the buttons report."""
        self.panel._next_texts = self.panel._next_plots = -math.inf
        self.panel.update(self.source)
        return str(self.controls._said.content)


def test_each_button_says_what_came_of_it(server: PageServer) -> None:
    controls = Controls()
    shown = Shown(server, controls)
    shown.controls._name.value = " stairs "
    shown.controls._metadata["subject"].value = "S01"
    for what in ("tare", "fit", "trigger on", "trigger off", "event", "record", "stop"):
        shown.press(what)
    assert controls.called == [
        *(("tare",), ("fit",), ("trigger", True), ("trigger", False), ("event", "event")),
        *(("record", "stairs", {"subject": "S01"}), ("stop_recording",)),
    ]
    assert shown.heard[0] == ("tare", "done tare")
    controls.refused = TestbedError("an axis <b>moves</b>", "hold still")
    shown.press("tare")
    assert shown.heard[-1] == ("tare failed", "an axis <b>moves</b>: hold still")
    assert "an axis &lt;b&gt;moves&lt;/b&gt;: hold still" in shown.update()


def test_a_button_is_off_while_its_call_runs_but_events_go_on(server: PageServer) -> None:
    controls = Controls()
    shown = Shown(server, controls)
    buttons = shown.buttons
    controls.go_on.clear()
    calls = ("fit", "event", "event")
    threads = [threading.Thread(target=shown.press, args=(what,)) for what in calls]
    for thread in threads:
        thread.start()
    for _ in threads:
        assert controls.begun.acquire(timeout=HANGS)
    report = shown.update()
    assert "fit: 0 s" in report or "fit: 1 s" in report
    assert buttons["fit"].disabled and not buttons["event"].disabled
    assert not buttons["tare"].disabled
    shown.press("fit")  # of another browser, at the same moment
    assert [call[0] for call in controls.called].count("fit") == 1
    controls.go_on.set()
    for thread in threads:
        thread.join()
    assert not buttons["fit"].disabled


def test_record_and_stop_take_turns_and_a_page_without_controls_has_them_off(server) -> None:
    shown = Shown(server, Controls())
    for shown.source.recorded in ("", "s01", ""):
        shown.update()
        assert shown.buttons["record"].visible == (shown.source.recorded == "")
        assert shown.buttons["stop"].visible == (shown.source.recorded != "")
    off = Shown(server)
    for _ in range(2):
        assert all(button.disabled for button in off.buttons.values())
        off.press("tare")
        assert "the buttons are off" in off.update()


def test_what_has_not_changed_is_not_sent_again(server, monkeypatch) -> None:
    shown = Shown(server, Controls())
    shown.update()
    sent: list[Any] = []
    monkeypatch.setattr(server.viser.gui._websock_interface, "queue_message", sent.append)
    shown.update()
    assert not sent
    shown.source.recorded = "s01"
    shown.update()
    assert len(sent) == 3  # the line, and the two buttons


def test_sensors_are_described_and_a_silent_one_is_a_fault() -> None:
    fine = SensorState("/left/load_cell_node", 0, "spidev0.0 converts", 99.96, 0.4)
    fault = replace(fine, name="/cluster_node", level=2, words="no answer at 0x50 <script>")
    for sensors, words in (
        ([fine], ("all 1 are well", "100&nbsp;Hz")),
        ([fine, fault], ("1 of 2 need attention", "no answer at 0x50 &lt;script&gt;")),
        ([replace(fine, age=12.0)], ("1 of 1 need attention", "silent for 12 s")),
        ([], ("no data",)),
    ):
        text = sensors_html(sensors)
        assert all(each in text for each in words), text


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
