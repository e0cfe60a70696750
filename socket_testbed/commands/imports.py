"""`import`: a trial from other laboratories' topics or tables."""

from __future__ import annotations

from socket_testbed import api
from socket_testbed.commands import calls
from socket_testbed.commands.calls import takes
from socket_testbed.commands.running import print_note
from socket_testbed.settings.options import ImportOptions, given


@takes(calls.Import)
def import_(call: calls.Import) -> None:
    """Make a trial from other sensors' topics or tables."""
    options = given(call, ImportOptions)
    trial = api.import_trial(call.source, call.output, **options, notify=print_note)
    samples = trial.samples()
    print(
        f"{call.output}: {len(samples)} samples in {samples.time[-1]:.2f} s,"
        f" {len(samples.clusters)} clusters; see 'info {call.output}'"
    )
