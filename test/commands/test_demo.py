"""The demo adapts to the machine; that it runs is seen by `make demo`."""

import pytest
from support.wording import refused

from socket_testbed.commands import demo
from socket_testbed.errors import TrialError
from socket_testbed.live.simulated_world import MachineSpeed
from socket_testbed.trials.trial import Trial


def test_it_records_slower_until_the_samples_are_complete(tmp_path, monkeypatch, hold) -> None:
    tried: list[float] = []
    # Where the nodes come up late, what there is of the protocol is whole but short.
    assert demo._complete(Trial(hold)) == pytest.approx(240 / (10.0 * 54.0))
    monkeypatch.setattr(demo, "_run_live", lambda path, seed, scale, log: tried.append(scale))
    monkeypatch.setattr(demo, "summary", lambda path: "all there")
    monkeypatch.setattr(Trial, "samples", lambda trial: None)
    for speed, complete, scales in (
        (1.0, [0.4, 0.8, 0.95], [1.0, 0.5, 0.25]),
        # At the slowest again and again, as a busy moment may pass; then with what there is.
        (0.04, [0.1, 0.2, 0.3, 0.4, 0.5], [0.25, 0.125, 0.0625, 0.0625, 0.0625]),
    ):
        tried.clear()
        monkeypatch.setattr(demo, "measure_speed", lambda speed=speed: MachineSpeed(0.0, speed))
        monkeypatch.setattr(demo, "_complete", lambda trial, left=complete: left.pop(0))
        _, scale = demo._record(Trial(tmp_path / "trial"), 0, tmp_path)
        assert tried == scales and scale == scales[-1]
    monkeypatch.setattr(demo, "_complete", lambda trial: 0.0)
    with refused(TrialError, "only 0%", "at a sixteenth of real time"):
        demo._record(Trial(tmp_path), 0, tmp_path)
