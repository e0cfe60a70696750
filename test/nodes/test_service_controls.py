"""The buttons' services in a real graph: what came of each, and what is said where none answers."""

import threading
from collections.abc import Iterator

import pytest
import rclpy
from support import HANGS
from support.graph import Probe
from support.testbeds import LiveTestbed

from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.live.simulated_world import Simulation
from socket_testbed.nodes import service_controls
from socket_testbed.nodes.service_controls import ServiceControls
from socket_testbed.trials.metadata import TrialMetadata
from socket_testbed.trials.topics import RECORDED_TRIAL
from socket_testbed.trials.trial import Trial

pytestmark = pytest.mark.graph


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveTestbed]:
    record = tmp_path_factory.mktemp("controls") / "s01"
    with LiveTestbed(record, 10.0, Simulation("static_hold")) as live:
        yield live


@pytest.fixture(scope="module")
def controls(live: LiveTestbed) -> Iterator[ServiceControls]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service_controls, "_ANSWERS_WITHIN", HANGS)  # on a machine that others use
        yield ServiceControls(live.probe.node)


def test_a_trial_is_recorded_with_a_name_and_metadata_and_an_event(
    live: LiveTestbed, controls: ServiceControls
) -> None:
    announced = live.probe.listen(RECORDED_TRIAL)
    live.probe.wait(lambda: [m.data for m in announced][-1:] == ["s01"], "the first trial")
    with pytest.raises(TestbedError, match="s01 is being recorded: stop it first"):
        controls.record("stairs", {})
    assert "s01" in controls.stop_recording()
    with pytest.raises(TestbedError, match="trial's name"):
        controls.record("../stairs", {})
    with pytest.raises(TestbedError, match="did you mean 'left'"):
        controls.record("stairs", {"side": "lft"})
    with pytest.raises(ConfigurationError, match="mass is 'heavy'"):
        controls.record("stairs", {"mass": "heavy"})
    assert controls.record("stairs", {"subject": "S02", "mass": "70"}).endswith("s01_stairs")
    live.wait_for_triggers(5)
    assert controls.event("push") == "marked 'push' in the trial s01_stairs"
    live.wait_for_triggers(5)
    controls.stop_recording()
    assert live.testbed.record is not None
    trial = Trial(live.testbed.record.with_name("s01_stairs"))
    assert trial.metadata == TrialMetadata("S02", mass=70.0)
    (event,) = [event for event in trial.events() if event.label == "push"]
    assert 0.0 < event.time < trial.samples().time[-1] - trial.samples().time[0]


def test_events_that_are_marked_at_once_are_all_heard(
    live: LiveTestbed, controls: ServiceControls
) -> None:
    said: list[str] = []
    threads = [
        threading.Thread(target=lambda: said.append(controls.event("step"))) for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(HANGS)
    assert len(said) == 2 and all(line.startswith("marked 'step'") for line in said)


def test_the_testbed_is_tared_and_its_trigger_switched(
    live: LiveTestbed, controls: ServiceControls
) -> None:
    controls.trigger(False)
    live.wait_for("trigger_node", "WARN", "not enabled")
    controls.trigger(True)
    live.wait_for_triggers(3)

    def tared() -> bool:
        try:
            return controls.tare().startswith("tared")
        except TestbedError as error:
            assert "moves" in str(error)  # it is loaded just now
            return False

    live.probe.wait(tared, "a tare")
    live.probe.wait(lambda: abs(live.wrenches[-1].wrench.force.z) < 5.0, "the tare")


def test_what_does_not_answer_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service_controls, "_FOUND_WITHIN", 0.1)
    with Probe() as probe:
        nowhere = rclpy.create_node("page", namespace="/nowhere", context=probe.context)
        alone = ServiceControls(nowhere)
        with pytest.raises(TestbedError, match="nobody offers load_cell/tare: check that load_"):
            alone.tare()
        with pytest.raises(TestbedError, match="start 'run' with --record DIR, or 'record DIR'"):
            alone.record("stairs", {})
        nowhere.destroy_node()
