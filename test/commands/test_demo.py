"""The demo adapts to the machine; that it runs is seen by `make demo`."""

from pathlib import Path

import pytest

from socket_testbed.commands import demo
from socket_testbed.live.time_scale import MachineSpeed
from socket_testbed.trials.trial import Trial


@pytest.mark.parametrize(
    ("speed", "complete", "scales"),
    [
        (1.0, [1.0], [1.0]),
        (1.0, [0.4, 0.8, 0.95], [1.0, 0.5, 0.25]),
        (0.04, [0.0, 0.5], [0.25, 0.125]),
        (0.001, [0.5], [0.125]),
    ],
)
def test_it_records_slower_until_the_samples_are_complete(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    speed: float,
    complete: list[float],
    scales: list[float],
) -> None:
    tried = []

    def run_live(path: Path, seed: int, scale: float, log: Path) -> None:
        path.mkdir()
        tried.append(scale)

    fractions = iter(complete)
    monkeypatch.setattr(demo, "measure_speed", lambda: MachineSpeed(0.0, speed))
    monkeypatch.setattr(demo, "_run_live", run_live)
    monkeypatch.setattr(demo, "_complete", lambda trial: next(fractions))
    monkeypatch.setattr(demo, "summary", lambda path: "all there")
    monkeypatch.setattr(Trial, "samples", lambda trial: None)
    _, scale = demo._record(Trial(tmp_path / "trial"), 0, tmp_path / "log")
    assert tried == scales and scale == scales[-1]
    printed = capsys.readouterr().out
    assert ("this machine is busy" in printed) == (scales[0] < 1.0)
    assert printed.count("samples are complete: again at") == len(scales) - 1
