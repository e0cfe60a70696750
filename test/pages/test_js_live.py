"""The script of the served page: playing a trial, and the buttons of a running testbed.

The pages are opened as a browser opens them, against a server whose answers the tests set.
"""

import re
from typing import Any

import numpy as np
import pytest
from support.hand_made import hand_bars, hand_cards, hand_course, hand_moment, hand_socket
from support.hand_outputs import made_bars, made_cards, made_course, made_moment, made_socket
from support.tabs import LIVE_PAGE, STATIC, LostError, StatusError, Tab

from socket_testbed.pages.document import wrench_rows

TARE = "Tare the load cell? The limb must be out of the socket and nothing may touch it."
STOP = "Stop the measurement? No sensor is read until it is started again."
JSON = "application/json"


class Bench:
    """A server: what it answers, and what is asked of it."""

    def __init__(self, start: dict[str, Any], **now: Any) -> None:
        self.start, self.now = start, now
        self.reply: dict[str, Any] | Exception = {"said": "done"}
        self.failure: Exception | None = None  # of all questions for the state

    def __call__(self, path: str, body: Any) -> Any:
        if path == "do":
            if isinstance(self.reply, Exception):
                raise self.reply
            return self.reply
        if self.failure is not None:
            raise self.failure
        if path == "start":
            return self.start
        return {"moment": hand_moment()} | self.now


def trial(**changed: Any) -> Bench:
    """A trial of 40 s whose peak is at 12.5 s."""
    start = {
        "title": "hold",
        "facts": {"subject": "s01", "side": "left"},
        "socket": hand_socket(),
        "course": hand_course(),
        "start": 12.5,
        "end": 40.0,
    }
    return Bench(start | changed)


def running(buttons: bool = True, **now: Any) -> Bench:
    """A running testbed."""
    start = {
        "title": "live",
        "facts": {},
        "socket": hand_socket(),
        "live": True,
        "buttons": buttons,
        "metadata": {"subject": [], "side": ["", "left", "right"]},
    }
    return Bench(start, **now)


def opened(bench: Bench) -> Tab:
    return Tab(LIVE_PAGE, bench)


def shows(tab: Tab, *elements: str) -> list[bool]:
    return [not tab.get(element, "hidden") for element in elements]


def times(tab: Tab) -> list[float]:
    """The times that were asked for so far [s]."""
    asked = tab.requested
    assert asked[0] == "start" and all(path.startswith("now?t=") for path in asked[1:])
    return [float(path.removeprefix("now?t=")) for path in asked[1:]]


def settled(tab: Tab) -> float:
    """The last time that was asked for, once there was time to ask [s]."""
    tab.wait(0.2)
    return times(tab)[-1]


# --- a recorded trial


def test_trial_opens_at_its_start_and_rests() -> None:
    tab = opened(trial())
    assert tab.text("#title") == tab.evaluate("document.title") == "hold"
    assert tab.text("#facts") == "subject s01, side left"
    tab.wait(3.0)
    assert tab.requested == ["start", "now?t=12.5"]
    assert tab.text("#when") == "at 12.50 s"
    assert tab.picture("#map").heatmap().value(90.0, 60.0) == 20.0


@pytest.mark.parametrize(
    ("latency", "period"),
    [
        pytest.param(100, 0.15, id="quick: every 150 ms from question to question"),
        pytest.param(180, 0.2, id="slow: 20 ms after each answer"),
    ],
)
def test_slow_answers_slow_the_page(latency, period) -> None:
    tab = opened(running())
    tab.wait(0.16)
    tab.run(f"browser.latency = {latency}")
    before = len(tab.requested)
    tab.wait(20 * period)
    assert len(tab.requested) - before == pytest.approx(20, abs=1)


def test_trial_has_a_player_and_no_buttons() -> None:
    tab = opened(trial())
    assert shows(tab, "#player", "#cursor") == [True, True]
    assert shows(tab, "#buttons", "#trial", "#service") == [False, False, False]


def test_trial_shows_course_cards_and_bars() -> None:
    bench = trial()
    bench.now = {"cards": hand_cards(), "bars": hand_bars()}
    tab = opened(bench)
    assert tab.picture("#course").layout["xaxis"]["range"] == [0, 40]
    assert tab.picture("#course").layout["shapes"][-1]["x0"] == 12.5
    assert tab.texts("h3")[:2] == ["Peak", "Data"]
    assert tab.texts(".said")[0] == "20.0 (10.0 to 40.1)"


@pytest.mark.parametrize(
    ("keys", "time"),
    [
        pytest.param(["ArrowRight"], 17.5, id="forward 5 s"),
        pytest.param(["ArrowLeft"], 7.5, id="back 5 s"),
        pytest.param(["ArrowRight"] * 6, 40.0, id="not beyond the end"),
        pytest.param(["ArrowLeft"] * 3, 0.0, id="not before the start"),
        pytest.param(["ArrowRight"] * 9 + ["ArrowLeft"], 35.0, id="back from the end"),
        pytest.param(["ArrowUp"], 12.5, id="another key"),
    ],
)
def test_arrow_keys_jump_5_s(keys, time) -> None:
    tab = opened(trial())
    for key in keys:
        tab.press(key)
    assert settled(tab) == time


@pytest.mark.parametrize("field", ["#speed", "#label"], ids=["select", "input"])
def test_keys_in_a_field_are_the_fields(field) -> None:
    tab = opened(trial())
    assert not any(tab.press(key, on=field) for key in ("ArrowRight", "ArrowLeft", " "))
    assert settled(tab) == 12.5 and tab.text("#play") == "Play"


@pytest.mark.parametrize("pressed", ["#play", "summary"], ids=["button", "summary"])
def test_focus_of_a_button_leaves_the_arrows(pressed) -> None:
    tab = opened(trial())
    tab.press("ArrowRight", on=pressed)
    assert settled(tab) == 17.5
    # The browser itself presses or unfolds it.
    assert not tab.press(" ", on=pressed)
    assert tab.text("#play") == "Play"


def test_space_plays_and_does_not_scroll() -> None:
    tab = opened(trial())
    assert tab.press(" ")
    assert tab.text("#play") == "Pause"
    assert tab.press(" ")
    assert tab.text("#play") == "Play"
    assert not tab.press("a")


@pytest.mark.parametrize(
    ("speed", "expected"),
    [(None, 13.5), ("0.1", 12.6), ("0.5", 13.0), ("2", 14.5), ("20", 32.5)],
    ids=["1 by default", "0.1", "0.5", "2", "20"],
)
def test_playing_takes_time_at_its_speed(speed, expected) -> None:
    tab = opened(trial())
    if speed:
        tab.choose("#speed", speed)
    tab.wait(2.0)
    tab.click("#play")
    tab.wait(1.0)
    tab.click("#play")
    rest = settled(tab)
    # A second more than 12.5 s at speed 1; the last picture is up to 150 ms old.
    factor = float(speed or 1)
    assert expected - 0.16 * factor < rest <= expected + 1e-9
    tab.wait(5.0)
    assert times(tab)[-1] == rest


def test_pictures_are_requested_every_150_ms() -> None:
    tab = opened(trial())
    tab.click("#play")
    tab.wait(0.16)
    before = len(times(tab))
    tab.wait(3.0)
    assert len(times(tab)) - before == 20


def test_play_stops_at_the_end_and_begins_anew() -> None:
    tab = opened(trial())
    tab.choose("#speed", "20")
    tab.click("#play")
    tab.wait(5.0)
    assert times(tab)[-1] == 40.0 and tab.text("#play") == "Play"
    assert max(times(tab)) == 40.0
    count = len(times(tab))
    tab.wait(5.0)
    assert len(times(tab)) == count
    tab.click("#play")
    assert tab.text("#play") == "Pause"
    tab.wait(0.3)
    assert 0.0 <= times(tab)[count] <= 20.0 * 0.3


def test_events_are_listed_and_sought() -> None:
    tab = opened(trial())
    assert tab.options("#events") == ["go to", "10.00 s: push", "25.00 s: a<b"]
    tab.choose("#events", "25.00 s: a<b")
    assert settled(tab) == 25.0
    tab.choose("#events", "10.00 s: push")
    assert settled(tab) == 10.0
    tab.press("ArrowRight")
    tab.choose("#events", "go to")
    assert settled(tab) == 15.0


def test_slider_and_time_line_are_sought() -> None:
    tab = opened(trial())
    tab.type("#cursor", 33.25)
    assert settled(tab) == 33.25
    tab.send("#course", "plotly_click", {"points": [{"x": 2.5}]})
    assert settled(tab) == 2.5


def test_hidden_page_requests_nothing() -> None:
    tab = opened(trial())
    tab.run("document.hidden = true")
    tab.press("ArrowRight")
    tab.wait(3.0)
    assert times(tab) == [12.5]
    tab.run("document.hidden = false")
    assert settled(tab) == 17.5


# --- a running testbed


def test_testbed_is_asked_every_150_ms() -> None:
    tab = opened(running())
    tab.wait(0.01)
    tab.wait(3.0)
    assert tab.requested == ["start", *["now"] * 21]


def test_testbed_has_buttons_and_no_player() -> None:
    tab = opened(running())
    assert shows(tab, "#buttons", "#trial", "#service") == [True, True, True]
    assert shows(tab, "#player", "#cursor") == [False, False]


def test_without_controls_the_buttons_are_hidden() -> None:
    tab = opened(running(buttons=False))
    assert shows(tab, "#buttons", "#trial", "#service") == [False, False, False]


def test_time_line_of_a_testbed_seeks_nothing() -> None:
    tab = opened(running(course=hand_course()))
    tab.send("#course", "plotly_click", {"points": [{"x": 2.5}]})
    tab.press("ArrowRight")
    tab.wait(1.0)
    assert set(tab.requested) == {"start", "now"}


def test_newest_state_replaces_the_last() -> None:
    bench = running(cards=hand_cards(), course=hand_course())
    tab = opened(bench)
    assert tab.texts("h3")[:2] == ["Peak", "Data"]
    bench.now = {"cards": hand_cards()[1:], "course": hand_course(time=[5.0, 10.0, 35.0])}
    bench.now |= {"moment": hand_moment(time=30.0, pressure=[0.0, 60.0, 0.0, 0.0, 0.0])}
    tab.wait(0.2)
    assert tab.texts("h3")[0] == "Data" and tab.text("#when") == "at 30.00 s"
    assert tab.picture("#map").heatmap().value(90.0, 60.0) == 60.0
    assert tab.picture("#course").layout["xaxis"]["range"] == [5, 35]


@pytest.mark.parametrize(
    ("button", "question"), [("tare", TARE), ("trigger-off", STOP)], ids=["tare", "stop"]
)
def test_dangerous_buttons_ask_before_they_act(button, question) -> None:
    tab = opened(running())
    tab.run("browser.agrees = false")
    tab.click(f"#{button}")
    assert tab.doings == [["confirm", question]]
    assert tab.text("#said") == ""
    tab.run("browser.agrees = true")
    tab.click(f"#{button}")
    assert tab.doings[1:] == [["confirm", question], ["POST", "do", JSON, {"do": button}]]
    assert tab.text("#said") == f"{button}: done"


@pytest.mark.parametrize("button", ["fit", "trigger-on"])
def test_harmless_buttons_act_at_once(button) -> None:
    tab = opened(running())
    tab.click(f"#{button}")
    assert tab.doings == [["POST", "do", JSON, {"do": button}]]
    assert tab.text("#said") == f"{button}: done"


def test_mark_sends_its_label() -> None:
    tab = opened(running())
    tab.click("#mark")
    tab.type("#label", "step")
    tab.click("#mark")
    assert tab.doings == [
        ["POST", "do", JSON, {"do": "mark", "label": "event"}],
        ["POST", "do", JSON, {"do": "mark", "label": "step"}],
    ]


def test_record_sends_name_and_metadata() -> None:
    tab = opened(running())
    assert tab.texts("#metadata")[0].startswith("trial ")
    names = tab.get("#metadata", "children.map((label) => label.textContent)")
    assert names == ["trial ", "subject ", "side leftright"]  # a select contains its choices
    fields = "children.map((label) => label.children[0].tagName)"
    assert tab.get("#metadata", fields) == ["INPUT", "INPUT", "SELECT"]
    field = "browser.find('#metadata').children[{}].children[0].value = '{}'"
    tab.run(field.format(0, "  walk 3 "))
    tab.run(field.format(1, "s01"))
    tab.run(field.format(2, "right"))
    tab.click("#record")
    expected = {"do": "record", "trial": "walk 3", "subject": "s01", "side": "right"}
    assert tab.doings == [["POST", "do", JSON, expected]]
    assert tab.text("#said") == "record: done"


def test_record_button_stops_while_recording() -> None:
    bench = running(recording={"on": False, "words": "nothing is being recorded"})
    tab = opened(bench)
    assert tab.text("#record") == "● Record"
    assert tab.text("#recording") == "nothing is being recorded"
    bench.now = {"recording": {"on": True, "words": "recording walk for 0:03"}}
    tab.wait(0.2)
    assert tab.text("#record") == "■ Stop recording"
    assert tab.text("#recording") == "recording walk for 0:03"
    tab.click("#record")
    assert tab.doings[0][3]["do"] == "stop recording"
    bench.now = {"recording": {"on": False, "words": ""}}
    tab.wait(0.2)
    tab.click("#record")
    assert tab.text("#record") == "● Record" and tab.doings[1][3]["do"] == "record"


@pytest.mark.parametrize(
    ("reply", "said", "look"),
    [
        pytest.param({"said": "fitted"}, "fit: fitted", "", id="success"),
        pytest.param({"said": "<b>: no", "failed": True}, "fit: <b>: no", "failed", id="refusal"),
        pytest.param(StatusError(400, "too long"), "fit failed: too long", "failed", id="status"),
        pytest.param(LostError(), "fit failed: Failed to fetch", "failed", id="lost"),
    ],
)
def test_page_says_what_came_of_a_button(reply, said, look) -> None:
    bench = running()
    bench.reply = reply
    tab = opened(bench)
    tab.click("#fit")
    assert tab.get("#said", "texts") == ["fit …", said]
    assert tab.get("#said", "className") == look


def test_success_after_a_failure_is_no_failure() -> None:
    bench = running()
    bench.reply = {"said": "the load cell is loaded", "failed": True}
    tab = opened(bench)
    tab.click("#tare")
    bench.reply = {"said": "done"}
    tab.click("#tare")
    assert (tab.text("#said"), tab.get("#said", "className")) == ("tare: done", "")


def test_sensors_and_wrench_are_tables() -> None:
    sensors = [["●", "clock", "<b>late</b>", "4 Hz"], ["■", "load cell", "silent", ""]]
    wrench = wrench_rows(1.5 * (-1.0) ** np.arange(6), np.full(6, np.nan))
    tab = opened(running(sensors=sensors, wrench=wrench))
    assert tab.rows("#sensors") == sensors
    assert tab.rows("#wrench") == [
        ["", "measured", "predicted"],
        ["Mx [N m]", "1.50", "none"],
        ["My [N m]", "-1.50", "none"],
        ["Mz [N m]", "1.50", "none"],
        ["Fx [N]", "-1.50", "none"],
        ["Fy [N]", "1.50", "none"],
        ["Fz [N]", "-1.50", "none"],
    ]


def test_tables_are_replaced_by_the_newest() -> None:
    bench = running(sensors=[["●", "clock", "fine", "4 Hz"], ["●", "mocap", "fine", "4 Hz"]])
    tab = opened(bench)
    bench.now = {"sensors": [["■", "clock", "silent", ""]]}
    tab.wait(0.2)
    assert tab.rows("#sensors") == [["■", "clock", "silent", ""]]


def test_trial_without_sensors_shows_its_wrench() -> None:
    bench = trial()
    bench.now = {"wrench": [["", "measured", "predicted"], ["Fz [N]", "1.00", "none"]]}
    tab = opened(bench)
    assert tab.rows("#wrench")[1] == ["Fz [N]", "1.00", "none"] and not tab.rows("#sensors")


@pytest.mark.parametrize("make", [running, trial], ids=["testbed", "trial"])
def test_lost_server_is_named_until_it_answers(make) -> None:
    bench = make()
    tab = opened(bench)
    bench.failure = LostError()
    tab.press("ArrowRight")
    tab.wait(0.2)
    expected = "no answer from the testbed (Failed to fetch): is the program still running?"
    assert (tab.text("#said"), tab.get("#said", "className")) == (expected, "failed")
    count = len(tab.requested)
    tab.wait(1.9)
    assert len(tab.requested) == count  # it waits for two seconds
    tab.wait(0.3)
    assert len(tab.requested) == count + 1
    bench.failure = None
    tab.wait(2.3)
    assert (tab.text("#said"), tab.get("#said", "className")) == ("", "")


@pytest.mark.parametrize(
    ("failure", "reason"),
    [
        (LostError(), "Failed to fetch"),
        (StatusError(503, "the page is closed\n"), "the page is closed"),
    ],
    ids=["lost", "closed"],
)
@pytest.mark.parametrize("begun", [False, True], ids=["start", "later"])
def test_a_failed_request_is_asked_again(failure: Exception, reason: str, begun: bool) -> None:
    """The page of a trial stayed at 'loading', and a status of 503 was an error in JSON."""
    bench = trial()
    bench.failure = None if begun else failure
    tab = opened(bench)
    bench.failure = failure
    tab.press("ArrowRight")
    tab.wait(0.2)
    expected = f"no answer from the testbed ({reason}): is the program still running?"
    assert (tab.text("#said"), tab.get("#said", "className")) == (expected, "failed")
    bench.failure = None
    tab.wait(2.3)
    assert (tab.text("#title"), tab.text("#said")) == ("hold", "")


@pytest.mark.parametrize("lost", [False, True], ids=["from the start", "after a loss"])
def test_what_a_button_said_stays(lost) -> None:
    bench = running()
    tab = opened(bench)
    bench.failure = LostError() if lost else None
    tab.wait(0.2)
    bench.failure = None
    tab.wait(3.0)
    tab.click("#fit")
    tab.wait(1.0)
    assert tab.text("#said") == "fit: done"


# --- the page itself


def test_buttons_say_what_they_do() -> None:
    tab = opened(running())
    names = ("play", "record", "mark", "tare", "fit", "trigger-off", "trigger-on")
    assert {name: tab.text(f"#{name}") for name in names} == {
        "play": "Play",
        "record": "● Record",
        "mark": "⚑ Mark",
        "tare": "Tare",
        "fit": "Fit the contact model",
        "trigger-off": "Stop the measurement",
        "trigger-on": "Start the measurement",
    }
    assert tab.options("#speed") == ["0.1", "0.25", "0.5", "1", "2", "5", "20"]


@pytest.mark.parametrize(
    "name",
    [
        *("card", "bad", "interval", "failed", "legend", "full", "grey"),
        *("bar-row", "track", "bar", "whisker", "said"),
    ],
)
def test_what_scripts_make_has_a_style(name) -> None:
    style = (STATIC / "page.css").read_text(encoding="utf-8")
    assert re.search(rf"[.]{name}\b(?!-)", style)


# --- what the documents say


def test_page_draws_what_the_documents_say() -> None:
    bench = trial(socket=made_socket(), course=made_course())
    bench.now = {
        "moment": made_moment(),
        "cards": made_cards(" at this moment"),
        "bars": made_bars(),
    }
    tab = opened(bench)
    highest, angle, height = tab.picture("#map").heatmap().highest()
    # 40 kPa at 90 degrees and 50 mm above the end; the grid is 12 degrees x 11 mm.
    assert highest == pytest.approx(40.0, rel=0.1)
    assert (angle, height) == (pytest.approx(90.0, abs=7.0), pytest.approx(50.0, abs=6.0))
    assert tab.texts("h3")[:3] == ["Peak at this moment", "Elsewhere at this moment", "Data"]
    assert tab.texts("strong")[:3] == ["40.0 kPa", "40.0 kPa", "good"]
    assert tab.texts(".said")[0] == "15.0 (12.0 to 18.0)"
    assert tab.options("#events") == ["go to", "10.00 s: push"]
