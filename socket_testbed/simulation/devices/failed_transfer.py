"""Single transfers that fail on a bus that is otherwise well, as interference makes them."""

from __future__ import annotations

import errno
from dataclasses import dataclass

from socket_testbed import clocks


@dataclass
class FailedTransfer:
    """A single transfer that fails, on a bus that is otherwise well.

    Attributes:
        number: The errno of its error, such as `errno.EIO`.
        after: Number of transfers on the bus that still succeed before it [1].
        executed: Whether the chips receive and answer it before the error, as when the controller
            gives up at the last bit; otherwise nothing reaches the wires.
        takes: Time until the error [s].
    """

    number: int
    after: int = 0
    executed: bool = False
    takes: float = 0.0

    def error(self) -> OSError:
        """The error that the transfer raises."""
        return OSError(self.number, f"{errno.errorcode[self.number]} (simulated)")


def next_failure(failing: list[FailedTransfer]) -> FailedTransfer | None:
    """The failure of the present transfer, if it is to fail, after the time that it takes.

    Args:
        failing: The transfers that are to fail, in their order; the first is counted down, and
            removed when its turn has come.
    """
    if not failing:
        return None
    if failing[0].after > 0:
        failing[0].after -= 1
        return None
    failed = failing.pop(0)
    clocks.sleep(failed.takes)
    return failed
