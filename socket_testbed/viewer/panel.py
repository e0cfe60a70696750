"""The panels beside the scene: sensors, wrench, regions, and buttons or player controls."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from datetime import datetime
from html import escape
from typing import Any

import numpy as np
from viser import (
    GuiButtonHandle,
    GuiEvent,
    GuiHtmlHandle,
    GuiInputHandle,
    GuiSliderHandle,
    ViserServer,
    uplot,
)

from socket_testbed.arrays import FloatArray
from socket_testbed.errors import TestbedError
from socket_testbed.geometry.regions import Region
from socket_testbed.geometry.socket import HEIGHTS
from socket_testbed.identification.pressure import read_column
from socket_testbed.trials.metadata import SIDES
from socket_testbed.viewer.source import (
    HISTORY,
    Controls,
    Playback,
    Recording,
    RegionsNow,
    SensorState,
    Source,
)

_TEXTS_EVERY = 0.5  # [s]
_PLOTS_EVERY = 0.35  # [s]
_SILENT = 3.0  # [s]; a sensor that reported longer ago is silent
_SCARCE = 1e9  # [bytes] of free space
_BINS = 150  # of a plot's time, each with its smallest and largest value
_FILLS, _MARGIN = 0.3, 0.2  # [-]; of an axis by its values, and beside them
_LEAST = 0.5  # [N m, N]; beside the values of an axis
_NEWS = 2  # outcomes that are shown
_SPEEDS = {"0.1x": 0.1, "0.25x": 0.25, "0.5x": 0.5, "1x": 1.0, "2x": 2.0, "5x": 5.0, "20x": 20.0}
_STEP = 0.01  # [s]; of the timeline
_JUMP = 5.0  # [s]; by the arrow keys
_MOVED_EVERY = 0.2  # [s]; between movements of the timeline
_NAMED = 5  # events whose labels have room below the timeline
_CHOOSE = "go to an event"
_GREEN, _AMBER, _RED, _GREY = "#2b8a3e", "#b35c00", "#c92a2a", "#6b7280"
_MEASURED, _PREDICTED = "#1c5d99", "#e07b00"
_CHANNELS = ("Fx [N]", "Fy [N]", "Fz [N]", "Mx [N m]", "My [N m]", "Mz [N m]")
_ROWS = (3, 4, 5, 0, 1, 2)  # of the channels in a wrench [M; F]
_COLUMNS = {
    "mean pressure [kPa]": "mean<br>[kPa]",
    "peak pressure [kPa]": "peak<br>[kPa]",
    "contact area [cm^2]": "contact<br>[cm²]",
    "share of load [%]": "load<br>[%]",
}
_STYLE = (
    "<style>.tb{font-size:12px;padding:2px 10px}"
    ".tb table{width:100%;table-layout:fixed;border-collapse:collapse;font-size:11px;"
    "line-height:1.2}"
    ".tb td,.tb th{padding:1.5px 2px;text-align:right;font-weight:normal;vertical-align:top;"
    "white-space:nowrap;overflow:hidden;text-overflow:ellipsis}"
    ".tb td:first-child,.tb th:first-child,.tb .words{text-align:left}"
    ".tb td[colspan]{white-space:normal;padding-left:14px}"
    f".tb i{{color:{_GREY};font-size:9px;letter-spacing:-.4px}}"
    ".tb .row{border-top:1px solid rgba(128,128,128,.25)}"
    f".tb small{{color:{_GREY};font-size:10px}}.tb th{{color:{_GREY};font-size:10px}}</style>"
)


class Panel:
    """All that is beside the scene of a page."""

    def __init__(self, server: ViserServer, source: Source) -> None:
        gui = server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(350)
        data = gui.add_panel()
        with data.add_tab("Data"):
            self._sensors = gui.add_html("")
            self._plots = _Plots(server)
        data.dock_left()
        data.set_width(280)
        playback = source.playback
        self._playback = None if playback is None else _Player(server, playback)
        self._recording = gui.add_html("", visible=False)
        self._regions = gui.add_html("")
        self._buttons = Buttons(server, source) if playback is None else None
        self._next_texts = self._next_plots = -math.inf

    def update(self, source: Source) -> None:
        """Show how the source is now; called for every frame that is drawn."""
        if self._playback is not None:
            self._playback.update()
        now = time.monotonic()
        if now >= self._next_plots:
            self._next_plots = now + _PLOTS_EVERY
            self._plots.update(*source.wrenches())
        if now >= self._next_texts:
            self._next_texts = now + _TEXTS_EVERY
            recording = source.recording()
            _show(self._sensors, sensors_html(source.sensors()))
            _show(self._recording, recording_html(recording))
            if self._buttons is not None:
                self._buttons.update(recording)
            _show(self._regions, regions_html(source.regions()))


def _set(handle: Any, name: str, value: object) -> None:
    """Change a property: one that is so already is not sent again."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)


def _show(handle: GuiHtmlHandle, text: str) -> None:
    """Show a text; an empty one takes no space."""
    text = text and f'<div class="tb">{_STYLE}{text}</div>'
    _set(handle, "content", text)
    _set(handle, "visible", bool(text))


def sensors_html(sensors: Sequence[SensorState]) -> str:
    """The state of the data in a line, and of every sensor in a row."""
    if not sensors:
        return f'<b style="color:{_AMBER}">no data from the testbed</b>'
    rows, bad = [], 0
    for sensor in sensors:
        level, words = sensor.level, sensor.words
        if sensor.age > _SILENT:
            level, words = 2, f"silent for {sensor.age:.0f} s; it said: {words}"
        bad += level > 0
        rate = f"{sensor.rate:.3g}&nbsp;Hz" if math.isfinite(sensor.rate) else ""
        name = sensor.name.lstrip("/").removesuffix("_node").replace("_", " ")
        healthy = "" if level else escape(words)  # a fault gets a row of its own
        rows.append(
            f'<tr class="row"><td>{_mark(level)}&nbsp;{escape(name)}</td>'
            f'<td class="words" title="{healthy}">{healthy}</td><td>{rate}</td>'
            f"<td>{max(sensor.age, 0.0):.0f}&nbsp;s</td></tr>"
        )
        if level:
            rows.append(f'<tr><td colspan="4">{escape(words)}</td></tr>')
    state = f"{bad} of {len(sensors)} need attention" if bad else f"all {len(sensors)} are well"
    head = (
        '<colgroup><col style="width:34%"><col><col style="width:19%"><col style="width:11%">'
        "</colgroup><tr><th></th><th></th><th>rate</th><th>age</th></tr>"
    )
    return f"<b>{_mark(2 if bad else 0)} Data: {state}</b><table>{head}{''.join(rows)}</table>"


def _mark(level: int) -> str:
    """A level as a sign of its own shape and colour."""
    sign, colour = (("●", _GREEN), ("▲", _AMBER), ("■", _RED))[min(level, 2)]
    return f'<span style="color:{colour}">{sign}</span>'


def recording_html(recording: Recording | None) -> str:
    """The trial that is being recorded, since when, and the free space."""
    if recording is None:
        return ""
    minutes, seconds = divmod(int(recording.elapsed), 60)
    text = (
        f'<b><span style="color:{_RED}">●</span> recording {escape(recording.trial)}</b>'
        f" {minutes}:{seconds:02d}"
        if recording.trial
        else "nothing is being recorded"
    )
    if math.isfinite(recording.free):
        colour = f' style="color:{_RED}"' if recording.free < _SCARCE else ""
        text += f"<span{colour}>, {recording.free * 1e-9:.1f} GB free</span>"
    return text


def regions_html(found: RegionsNow | None) -> str:
    """The standard outputs of the socket, its sectors and heights, and the user's own regions."""
    if found is None:
        return ""
    quantities = [read_column(found.outputs, title) for title in _COLUMNS]
    certain = [quantity.certain() for quantity in quantities]
    rows = []
    for number, place in enumerate(found.places):
        if _is_part(place, found.places):
            continue
        cells = []
        for quantity, known in zip(quantities, certain, strict=True):
            value, low, high = (q[number] for q in (quantity.value, quantity.low, quantity.high))
            if not math.isfinite(value):
                cells.append("<td>-</td>")
                continue
            pale, word = ("", "") if known[number] else (' style="opacity:.6"', " uncertain")
            reach = f"{_digits(low)} to {_digits(high)}{word}"
            cells.append(f"<td{pale}>{_digits(value)}<br><small>{reach}</small></td>")
        rows.append(f'<tr class="row"><td>{escape(place.name)}</td>{"".join(cells)}</tr>')
    head = "".join(f"<th>{title}</th>" for title in _COLUMNS.values())
    widths = '<colgroup><col style="width:19%"></colgroup>'
    return (
        f"<b>Regions at {found.time:.1f} s</b> <small>value, 95 % interval</small>"
        f"<table>{widths}<tr><th></th>{head}</tr>{rows[-1]}{''.join(rows[:-1])}</table>"
    )


def _digits(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 9.95 else f"{value:.1f}"


def _is_part(place: Region, places: Sequence[Region]) -> bool:
    """Whether a region is a sector's part at a height."""
    sector, _, height = place.name.partition(" ")
    return height in HEIGHTS and any(sector == other.name for other in places)


class _Plots:
    """The six channels of the wrench, measured and predicted, each on a scale of its own."""

    def __init__(self, server: ViserServer) -> None:
        server.gui.add_html(
            f'<div class="tb">{_STYLE}<b style="color:{_MEASURED}">● measured</b>&emsp;'
            f'<b style="color:{_PREDICTED}">● predicted</b></div>'
        )
        nothing = (np.zeros(1), np.full(1, np.nan), np.full(1, np.nan))
        font = "10px sans-serif"
        self._plots = [
            server.gui.add_uplot(
                nothing,
                series=(
                    uplot.Series(label="t"),
                    _dots("measured", _MEASURED, 4.0),
                    _dots("predicted", _PREDICTED, 2.0),
                ),
                scales=_scales((0.0, 1.0)),
                axes=(
                    uplot.Axis(show=channel == _CHANNELS[-1], size=22, font=font, gap=2),
                    uplot.Axis(
                        size=40,
                        space=18,
                        font=font,
                        gap=2,
                        label=channel,
                        labelFont=font,
                        labelSize=14,
                    ),
                ),
                legend=uplot.Legend(show=False),
                cursor=uplot.Cursor(show=False),
                height=90 if channel == _CHANNELS[-1] else 70,
                padding=(6, 8, 4, 0),
            )
            for channel in _CHANNELS
        ]
        self._ranges = [(0.0, 0.0)] * len(_CHANNELS)
        self._end = math.nan

    def update(self, at: FloatArray, measured: FloatArray, predicted: FloatArray) -> None:
        """Show the last wrenches, unless they are shown."""
        end = float(at[-1]) if len(at) else math.nan
        if not len(at) or end == self._end:
            return
        self._end = end
        shown, values = thinned(at, np.hstack([measured, predicted]))
        for number, (plot, row) in enumerate(zip(self._plots, _ROWS, strict=True)):
            pair = values[:, [row, row + 6]]
            span = fitting(pair, self._ranges[number])
            if span != self._ranges[number]:
                self._ranges[number] = span
                plot.scales = _scales(span)
            plot.data = (shown, *pair.T)


def _scales(span: tuple[float, float]) -> dict[str, uplot.Scale]:
    # uPlot finds no range of its own where the first value is missing.
    return {"x": uplot.Scale(time=False), "y": uplot.Scale(range=span)}


def fitting(values: FloatArray, span: tuple[float, float]) -> tuple[float, float]:
    """The range of an axis for some values: the one that it has, while they fit and fill it."""
    known = values[np.isfinite(values)]
    if not len(known):
        return span
    low, high = float(known.min()), float(known.max())
    if span[0] <= low and high <= span[1] and high - low >= _FILLS * (span[1] - span[0]):
        return span
    margin = max(_MARGIN * (high - low), _LEAST)
    return low - margin, high + margin


def _dots(label: str, colour: str, size: float) -> uplot.Series:
    """A series as dots: a line would bridge missing values."""
    points = uplot.Series_Points(show=True, size=size, width=0, stroke=colour, fill=colour)
    return uplot.Series(label=label, stroke="transparent", width=0, points=points)


def thinned(at: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The smallest and the largest value in each of `_BINS` parts of the time.

    Times (N,) [s] and values (N, c) become (M,) and (M, c) with M at most about 2 * `_BINS`; fewer
    stay as they are. A part without a value is NaN.
    """
    if len(at) <= 2 * _BINS:
        return at, values
    bins = np.floor(at * (_BINS / HISTORY)).astype(np.int64)  # fixed in time: nothing flickers
    starts = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
    low = np.fmin.reduceat(values, starts, axis=0)
    high = np.fmax.reduceat(values, starts, axis=0)
    times = np.add.outer(bins[starts], [0.0, 0.5]) * (HISTORY / _BINS)
    return times.reshape(-1), np.stack([low, high], axis=1).reshape(-1, values.shape[1])


class Buttons:
    """The buttons of a running testbed; each reports its outcome."""

    def __init__(self, server: ViserServer, source: Source) -> None:
        self._server = server
        self._gui = gui = server.gui
        self._controls = controls = source.controls
        self._lock = threading.Lock()
        self._running: dict[str, float] = {}  # since when [s], by what is done
        self._news: list[str] = []
        self._recorded: bool | None = None
        self._buttons: dict[str, GuiButtonHandle] = {}
        self._said = gui.add_html("")
        self._label = gui.add_text("event", "event")
        self._button("Mark event", "event", lambda c: c.event(self._label.value))
        self._name = gui.add_text("trial", "", hint="its name; empty: the date and time")
        self._button("Record", "record", self._start)
        self._button("Stop recording", "stop", lambda c: c.stop_recording())
        with gui.add_folder("Metadata of the trial", expand_by_default=False):
            self._metadata: dict[str, GuiInputHandle[str]] = {
                "subject": gui.add_text("subject", "", hint="a code such as S01"),
                "side": gui.add_dropdown("side", ("", *SIDES)),
                **{name: gui.add_text(name, "") for name in ("socket", "liner")},
                "mass": gui.add_text("mass [kg]", ""),
                **{name: gui.add_text(name, "") for name in ("operator", "protocol")},
                "notes": gui.add_text("notes", "", multiline=True),
            }
        self._button("Tare", "tare", lambda c: c.tare())
        self._button("Fit", "fit", lambda c: c.fit())
        self._button("Trigger on", "trigger on", lambda c: c.trigger(True))
        self._button("Trigger off", "trigger off", lambda c: c.trigger(False))
        if controls is None:
            self._news = ["the buttons are off: this page only shows"]
        self.update(None)

    def update(self, recording: Recording | None) -> None:
        """Show running calls, and the one of record and stop that has an effect."""
        if self._controls is not None and recording is not None:
            recorded = bool(recording.trial)
            if recorded != self._recorded:
                self._recorded = recorded
                self._grey()
        now = time.monotonic()
        with self._lock:
            lines = [f"{escape(what)}: {now - t:.0f} s …" for what, t in self._running.items()]
            lines += reversed(self._news)
        _show(self._said, "<br>".join(lines))

    def _button(self, label: str, what: str, act: Callable[[Controls], str]) -> None:
        button = self._gui.add_button(label, disabled=self._controls is None)
        button.on_click(lambda event: self._pressed(event, what, act))
        self._buttons[what] = button

    def _start(self, controls: Controls) -> str:
        stated = {name: field.value.strip() for name, field in self._metadata.items()}
        given = {name: value for name, value in stated.items() if value}
        return controls.record(self._name.value.strip(), given)

    def _pressed(
        self, event: GuiEvent[GuiButtonHandle], what: str, act: Callable[[Controls], str]
    ) -> None:
        """Call the service of a button, in a thread of its own."""
        if self._controls is None:
            return
        with self._lock:
            if what in self._running and what != "event":
                return
            self._running[what] = time.monotonic()
        self._grey()
        try:
            outcome, failed = act(self._controls), False
        except TestbedError as error:
            outcome, failed = str(error), True
        with self._lock:
            self._running.pop(what, None)
            clock = datetime.now().strftime("%H:%M:%S")
            line = f"{clock} {escape(what)}: {escape(outcome)}"
            self._news.append(f'<span style="color:{_RED}">{line}</span>' if failed else line)
            del self._news[:-_NEWS]
        self._grey()
        if event.client is not None:
            event.client.add_notification(
                f"{what} failed" if failed else what,
                outcome,
                auto_close_seconds=None if failed else 5.0,
                color="red" if failed else "green",
            )

    def _grey(self) -> None:
        """Grey out the buttons whose call runs, and show of record and stop the one with effect."""
        without_effect = {None: "", True: "record", False: "stop"}[self._recorded]
        for what, button in self._buttons.items():
            _set(button, "visible", what != without_effect)
            _set(button, "disabled", what in self._running and what != "event")


class _Player:
    """The controls of a trial that is played.

    The space bar plays and pauses, the arrow keys go 5 s back and forward.
    """

    def __init__(self, server: ViserServer, playback: Playback) -> None:
        self._playback = playback
        self._gui = gui = server.gui
        self._moved = -math.inf  # [s]; when the timeline was last moved
        with gui.add_folder("Trial") as self._folder:
            self._play = gui.add_button("Play", hint="the space bar does the same", order=0)
            self._events = gui.add_dropdown("event", (_CHOOSE,), order=2)
            self._speed = gui.add_dropdown("speed", tuple(_SPEEDS), initial_value="1x", order=3)
        self._known = self._extent()
        self._timeline = self._make_timeline()
        self._play.on_click(lambda _: self._toggle())
        self._events.on_update(self._on_event)
        self._speed.on_update(lambda _: playback.set_speed(_SPEEDS[self._speed.value]))
        gui.add_command("Play or pause", hotkey="space").on_trigger(lambda _: self._toggle())
        back = gui.add_command("Back by 5 s", hotkey="arrowleft")
        back.on_trigger(lambda _: playback.seek(playback.position - _JUMP))
        forward = gui.add_command("Forward by 5 s", hotkey="arrowright")
        forward.on_trigger(lambda _: playback.seek(playback.position + _JUMP))

    def update(self) -> None:
        """Show how the trial is played; called for every frame that is drawn."""
        playback = self._playback
        _set(self._play, "label", "Pause" if playback.playing else "Play")
        if self._extent() != self._known:  # more of the trial has been read
            self._known = self._extent()
            self._timeline.remove()
            self._timeline = self._make_timeline()
        now = time.monotonic()
        if now - self._moved >= _MOVED_EVERY:
            _set(self._timeline, "value", round(min(playback.position, self._timeline.max), 2))
            self._moved = now

    def _extent(self) -> tuple[float, tuple[tuple[float, str], ...]]:
        return self._playback.duration, tuple(self._playback.events)

    def _make_timeline(self) -> GuiSliderHandle[float]:
        """The timeline with the events as marks, those with room with their labels."""
        duration, events = self._known
        self._events.options = (_CHOOSE, *(f"{at:.2f} s: {label}" for at, label in events))
        named = len(events) <= _NAMED
        with self._folder:
            timeline = self._gui.add_slider(
                "time [s]",
                min=0.0,
                max=max(round(duration, 2), _STEP),
                step=_STEP,
                initial_value=0.0,
                marks=tuple((at, label) if named else at for at, label in events),
                order=1,
            )
        timeline.on_update(self._on_seek)
        return timeline

    def _toggle(self) -> None:
        (self._playback.pause if self._playback.playing else self._playback.play)()

    def _on_seek(self, event: GuiEvent[GuiSliderHandle[float]]) -> None:
        if event.client_id is not None:  # moved by a person
            self._playback.seek(event.target.value)

    def _on_event(self, _: object) -> None:
        number = self._events.options.index(self._events.value) - 1
        if number >= 0:
            at, _ = self._known[1][number]
            self._playback.seek(at)
            self._events.value = _CHOOSE  # type: ignore[misc]
