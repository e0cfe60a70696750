"""`record`: record the graph as a trial until Ctrl-C."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from socket_testbed.calibration.model import read_calibration
from socket_testbed.commands.options import add_metadata, metadata_of
from socket_testbed.commands.status_line import StatusLine
from socket_testbed.files import check_new_folder
from socket_testbed.geometry.socket import read_socket
from socket_testbed.live.processes import Graph
from socket_testbed.settings.testbed import RecorderSettings, read_testbed
from socket_testbed.trials.metadata import METADATA_FILE, write_metadata


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("directory", type=Path, metavar="DIR", help="folder of the new trial")
    for name in ("geometry", "calibration", "params"):
        parser.add_argument(
            f"--{name}", type=Path, metavar="FILE.yaml", help=f"{name} to store in the trial"
        )
    add_metadata(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Record until interrupted."""
    check_new_folder(options.directory)
    # What a trial is recorded with must be readable when it is worked on.
    for file, read in (
        (options.geometry, read_socket),
        (options.calibration, read_calibration),
        (options.params, read_testbed),
    ):
        if file is not None:
            read(file)
    metadata = metadata_of(options)
    settings = RecorderSettings(
        directory=str(options.directory.resolve()),
        record=True,
        geometry=_resolved(options.geometry),
        calibration=_resolved(options.calibration),
        parameters=_resolved(options.params),
    )
    disk = options.directory.resolve().parent
    with StatusLine(disk) as status, Graph(status.output, status.renew) as graph:
        if metadata.stated():
            stored = graph.folder / METADATA_FILE
            write_metadata(metadata, stored)
            settings = dataclasses.replace(settings, metadata=str(stored))
        graph.start("recorder_node", settings)
        status.say(f"recording {options.directory}; Ctrl-C ends it")
        try:
            status.follow()
            graph.wait("recorder_node")
        except KeyboardInterrupt:
            graph.stop()
    print(f"{options.directory}")


def _resolved(path: Path | None) -> str:
    return str(path.resolve()) if path else ""
