"""The controls of a trial that is played: play and pause, the timeline with its events, speed."""

from __future__ import annotations

import time

from viser import GuiEvent, GuiSliderHandle, ViserServer

from socket_testbed.viewer.source import Playback

_SPEEDS = {"0.1x": 0.1, "0.25x": 0.25, "0.5x": 0.5, "1x": 1.0, "2x": 2.0, "5x": 5.0, "20x": 20.0}
_STEP = 0.01  # [s]; of the timeline
_JUMP = 5.0  # [s]; by the arrow keys
_PERIOD = 0.2  # [s]; between movements of the timeline
_NAMED = 5  # events whose labels have room below the timeline
_CHOOSE = "go to an event"


class PlaybackPanel:
    """The controls of a trial that is played.

    The space bar plays and pauses, the arrow keys go 5 s back and forward.

    Args:
        server: Serves the page.
        playback: The trial.
    """

    def __init__(self, server: ViserServer, playback: Playback) -> None:
        self._playback = playback
        self._gui = gui = server.gui
        self._moved = 0.0  # [s]; when the timeline was last moved
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
        label = "Pause" if playback.playing else "Play"
        if self._play.label != label:
            self._play.label = label
        if self._extent() != self._known:  # more of the trial has been read
            self._known = self._extent()
            self._timeline.remove()
            self._timeline = self._make_timeline()
        position = round(min(playback.position, self._timeline.max), 2)
        now = time.monotonic()
        if self._timeline.value != position and now - self._moved >= _PERIOD:
            self._timeline.value = position  # type: ignore[misc]
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
        if self._playback.playing:
            self._playback.pause()
        else:
            self._playback.play()

    def _on_seek(self, event: GuiEvent[GuiSliderHandle[float]]) -> None:
        if event.client_id is not None:  # moved by a person
            self._playback.seek(event.target.value)

    def _on_event(self, _: object) -> None:
        number = self._events.options.index(self._events.value) - 1
        if number >= 0:
            at, _ = self._known[1][number]
            self._playback.seek(at)
            self._events.value = _CHOOSE  # type: ignore[misc]
