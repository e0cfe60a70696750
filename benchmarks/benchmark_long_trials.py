"""What reading a long trial takes, beside the bag library's own way through the raw messages.

The trial is a simulated static hold of 10 s at 100 Hz that is repeated, with its stamps going on,
for 10 minutes (60 take some minutes more). The floor: rosbags goes through the raw messages of the
five topics that samples are made of, and decodes none. Reading: `Trial.samples()`. Both are
measured without the start of Python; the verbs, each on all of the trial, with it. Seconds are of
the processor, memory is the peak of the process, and each is a process of its own.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from machine import apart
from rosbags.rosbag2 import Reader

from socket_testbed.calibration.model import read_calibration
from socket_testbed.files import CONFIGURATION_FILES, packaged
from socket_testbed.geometry.socket import read_socket
from socket_testbed.simulation.trial import simulate, write_simulated_trial
from socket_testbed.trials.bag import BagReader, BagWriter, required_topics
from socket_testbed.trials.trial import Trial
from socket_testbed.wire.cdr import Layout
from socket_testbed.wire.topics import match_topics

RATE = 100.0  # [Hz]
PIECE = 10.0  # [s]
VERBS = ("info", "fit", "evaluate", "pressure", "export", "report")


def repeat(source: Path, target: Path, times: int) -> None:
    """Write the messages of a trial again and again, their stamps going on."""
    with BagReader(source) as bag, BagWriter(target) as writer:
        for topic, name in match_topics(bag.types, str(source)).items():
            writer.add_topic(name, topic)
        raws = [(raw, Layout(raw.data, raw.type)) for raw in bag.messages()]
        for number in range(times):
            later = number * round(PIECE)
            for raw, layout in raws:
                content = bytearray(raw.data)
                record = layout.record(content)
                assert record is not None
                record["header"]["stamp"]["sec"] += later
                writer.write(raw.topic, raw.time + later * 10**9, bytes(content))
    for name in CONFIGURATION_FILES:
        shutil.copy(source / name, target)


def iterate(path: Path) -> None:
    """Go through the raw messages with the library alone."""
    with BagReader(path) as bag:
        topics = {name for topic, name in required_topics(bag).items() if topic.required}
    (file,) = path.glob("*.mcap")
    with Reader(file) as reader:
        for _ in reader.messages([c for c in reader.connections if c.topic in topics]):
            pass


def read(path: Path) -> None:
    """Read all samples."""
    Trial(path).samples()


def verb(words: list[str]) -> tuple[float, float]:
    """Seconds of the processor and peak memory [MB] of a verb."""
    command = [sys.executable, "-m", "socket_testbed", *words]
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    if os.waitstatus_to_exitcode(status) != 0:
        raise SystemExit(f"{words[0]} failed")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "minutes", nargs="*", type=float, default=[10.0], help="lengths of the trial (10)"
    )
    parser.add_argument("--verbs", nargs="+", choices=VERBS, default=VERBS, help="(all)")
    options = parser.parse_args()
    if 60.0 * min(options.minutes) < PIECE:
        parser.error(f"a trial is shorter than {PIECE:g} s: give at least {PIECE / 60.0:.3f}")
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    geometry = read_socket(packaged("config", "socket.yaml"))
    calibration = read_calibration(packaged("config", "calibration.yaml"))
    with tempfile.TemporaryDirectory() as folder:
        piece = Path(folder) / "piece"
        trial = simulate(geometry, calibration, "static_hold", PIECE, RATE, seed=0)
        write_simulated_trial(trial, piece)
        for length in options.minutes:
            path = Path(folder) / f"{length:g}min"
            repeat(piece, path, round(60.0 * length / PIECE))
            print(f"{length:g} min at {RATE:g} Hz  processor  / floor  / reading   memory")
            floor = apart(iterate, path)
            reading = apart(read, path)
            model = path.with_suffix(".json")
            words = {
                "info": [],
                "fit": ["--segment", "all", "-o", str(model)],
                "evaluate": ["--segment", "all", "--model", str(model)],
                "pressure": ["--segment", "all"],
                "export": ["-o", str(path.with_suffix(".parquet"))],
                "report": ["--segment", "all", "-o", str(path.with_suffix(".html"))],
            }
            rows = {"the bag library's iteration": floor, "reading all samples": reading}
            for name, (seconds, memory) in rows.items():
                show(name, seconds, memory, floor[0], reading[0])
            for name in options.verbs:
                show(name, *verb([name, str(path), *words[name]]), floor[0], reading[0])


def show(name: str, seconds: float, memory: float, floor: float, reading: float) -> None:
    """Print a row."""
    ratios = f"{seconds / floor:8.2f} {seconds / reading:9.2f}"
    print(f"{name:28s} {seconds:6.2f} s {ratios} {memory:9.0f} MB", flush=True)


if __name__ == "__main__":
    main()
