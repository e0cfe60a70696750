"""What the buttons of the live page do: services of the running testbed, and events."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Any

from rcl_interfaces.srv import SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from socket_testbed import clocks
from socket_testbed.errors import ConfigurationError, TestbedError
from socket_testbed.nodes.event_marker import EventMarker
from socket_testbed.settings.testbed import NextTrialSettings
from socket_testbed.trials.events import check_label

_FOUND_WITHIN = 3.0  # [s]; for a service to be found
_ANSWERS_WITHIN = 5.0  # [s] of the testbed; a tare averages one
_FITS_WITHIN = 120.0  # [s]
_ASK_AGAIN = 2.5  # [s] of the testbed; the middleware can lose an answer
_LOOK = 0.02  # [s]

# Type of each service, and the node that offers it.
_SERVICES = {
    "load_cell/tare": (Trigger, "load_cell_node"),
    "estimator/fit": (Trigger, "estimator_node"),
    "trigger/enable": (SetBool, "trigger_node"),
    "recorder/record": (SetBool, "recorder_node"),
    "recorder_node/set_parameters_atomically": (SetParametersAtomically, "recorder_node"),
}


class ServiceControls:
    """Calls the services of the testbed in a node's namespace, from any thread but the node's.

    Each call returns what came of it in one line.

    Args:
        node: The node, which is spun elsewhere.

    Raises:
        TestbedError: From any call: if the service refuses, does not answer, or is not offered.
    """

    def __init__(self, node: Node) -> None:
        self._clients = {
            name: node.create_client(kind, name) for name, (kind, _) in _SERVICES.items()
        }
        self._marker = EventMarker(node, _wait)
        self._marking, self._recording = threading.Lock(), threading.Lock()

    def tare(self) -> str:
        """Take the present wrench as zero."""
        return self._ask("load_cell/tare", Trigger.Request())

    def fit(self) -> str:
        """Fit the contact model on the complete window."""
        return self._ask("estimator/fit", Trigger.Request())

    def trigger(self, on: bool) -> str:
        """Start or stop the triggers."""
        return self._ask("trigger/enable", SetBool.Request(data=on))

    def record(self, name: str, metadata: dict[str, str]) -> str:
        """Record a trial.

        Args:
            name: Its name; empty for the date and time.
            metadata: What is stated about it, by the fields of `TrialMetadata`, as text.
        """
        values: dict[str, Any] = {"name": name, **metadata}
        if "mass" in values:
            try:
                values["mass"] = float(values["mass"])
            except ValueError:
                raise ConfigurationError(
                    f"mass is '{values['mass']}'", "give the body mass in kg"
                ) from None
        wanted = NextTrialSettings().to_flat("next.")
        wanted |= {f"next.{field}": value for field, value in values.items()}
        request = SetParametersAtomically.Request(
            parameters=[
                Parameter(key, value=value).to_parameter_msg() for key, value in wanted.items()
            ]
        )
        with self._recording:  # what one browser sets is not for the trial of another
            result = self._call("recorder_node/set_parameters_atomically", request).result
            if not result.successful:
                raise _refusal(result.reason)
            return self._ask("recorder/record", SetBool.Request(data=True))

    def stop_recording(self) -> str:
        """Close the trial that is being recorded."""
        return self._ask("recorder/record", SetBool.Request(data=False))

    def event(self, label: str) -> str:
        """Mark an event with the time of this call, as the verb `mark` does."""
        called = time.monotonic()
        label = check_label(label)
        with self._marking:  # a later one waits, and keeps its time
            marked = self._marker.mark(label, called)
        where = f" in the trial {marked.trial}" if marked.trial else ""
        return "; ".join([f"marked '{label}'{where}", *marked.notes()])

    def _ask(self, name: str, request: Any) -> str:
        """Call a service that answers whether it did, and what it did or why not."""
        answer = self._call(name, request)
        if not answer.success:
            raise _refusal(answer.message)
        return str(answer.message)

    def _call(self, name: str, request: Any) -> Any:
        within, again = clocks.real(_ANSWERS_WITHIN), clocks.real(_ASK_AGAIN)
        if name == "estimator/fit":  # a second fit would take its time
            within = again = clocks.real(_FITS_WITHIN)
        client, (_, offered_by) = self._clients[name], _SERVICES[name]
        if not _wait(client.service_is_ready, _FOUND_WITHIN):
            hint = f"check that {offered_by} runs"
            if offered_by == "recorder_node":
                hint = "start 'run' with --record DIR, or 'record DIR' beside it"
            raise TestbedError(f"nobody offers {name}", hint)
        asked: list[Future] = []
        for _ in range(math.ceil(within / again)):
            asked.append(client.call_async(request))
            if _wait(lambda: any(future.done() for future in asked), again):
                break
        for future in asked:
            client.remove_pending_request(future)
        answers = [future.result() for future in asked if future.done()]
        if not answers:
            hint = f"see what {offered_by} reports"
            raise TestbedError(f"{name} has not answered within {within:g} s", hint)
        return answers[0]


def _wait(condition: Callable[[], bool], duration: float) -> bool:
    """Wait until a condition holds; returns whether it does within a duration [s]."""
    deadline = time.monotonic() + duration
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(_LOOK)
    return True


def _refusal(words: str) -> TestbedError:
    """What a service or a node said, fact and hint, as an error."""
    fact, _, hint = words.rpartition(": ")
    return TestbedError(fact, hint) if fact else TestbedError("refused", words)
