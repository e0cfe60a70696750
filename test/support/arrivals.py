"""What of a call arrives at the next layer, and what an option changes of it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from socket_testbed.__main__ import run
from socket_testbed.commands.arguments import Parser, add_options
from socket_testbed.commands.calls import CALLS
from socket_testbed.identification.checked import CheckedSamples
from socket_testbed.settings.fields import Settings
from socket_testbed.trials.segment import Segment, select_segment
from socket_testbed.trials.trial import Trial
from support import scene
from support.surveys import prior_by_hand, write_survey_file

PARAMETERS = """
estimator_node:
  ros__parameters:
    identification: {theta: 0.2}
    plateau: {least_force: 30.0}
    force_map: {length: 0.05}
"""

WITHOUT = "estimator_node: {ros__parameters: {identification: {leave_out: [Mz, distal.Fx]}}}"

_USUAL: dict[tuple[str, ...], dict[str, Any]] = {}  # what arrives of calls, by folder and call


@dataclass
class Stage:
    """Stand-ins for the next layer, and what arrives at them.

    Attributes:
        patch: Puts the stand-ins in their places.
        trial: A trial for functions that take one.
        seen: What has arrived, by name.
    """

    patch: pytest.MonkeyPatch
    trial: Trial
    seen: dict[str, Any] = field(default_factory=dict)

    def replace(self, place: str, stand_in: Any) -> None:
        """Put a stand-in at a place of the package, such as `api.models.fit`."""
        module, _, name = place.rpartition(".")
        self.patch.setattr(import_module(f"socket_testbed.{module}"), name, stand_in)

    def keep(self, place: str, *names: str, returned: Any = None) -> None:
        """Replace a function by one that keeps its arguments under these names, in their order.

        Keywords are kept under their own names; an empty name keeps nothing.
        """

        def kept(*given: Any, **named: Any) -> Any:
            arrived = dict(zip(names, given, strict=False)) | named
            self.seen |= {name: plain(value) for name, value in arrived.items() if name}
            return returned

        self.replace(place, kept)

    def usually(
        self, call: Sequence[str], arrives: Callable[[Sequence[str]], dict[str, Any]]
    ) -> dict[str, Any]:
        """What arrives of a call, which is made once for all tests of a module.

        Args:
            call: What identifies it, such as its words.
            arrives: Makes the call.
        """
        key = str(Path.cwd()), *call
        if key not in _USUAL:
            _USUAL[key] = arrives(call)
        return _USUAL[key]

    def watch(self, task: str) -> Callable[[int, int], None]:
        """Keep the progress of a task, see `Progress` of the API."""
        return lambda done, total: self.seen.update({task: (done, total)})

    def watch_trials(self) -> None:
        """Keep what trials are asked for: parts and channels; each named part is all of it."""

        def problems(trial: Trial, leave_out: Any = None) -> tuple[Any, ...]:
            self.seen["checked without"] = leave_out
            return ()

        def checked(trial: Trial, leave_out: tuple[str, ...] = ()) -> CheckedSamples:
            self.seen["sound without"] = leave_out
            return CheckedSamples(trial.samples(), trial.geometry, leave_out)

        def select(trial: Trial, specification: str | Segment, settings: Any) -> Segment:
            if isinstance(specification, Segment):
                return specification
            self.seen["part"] = specification
            self.seen["least force"] = settings.plateau.least_force
            self.seen["selected without"] = settings.identification.leave_out
            chosen = specification if specification[0].isdigit() else "all"
            return select_segment(trial.samples(), chosen, settings.plateau)

        for method in (problems, checked, select):
            self.patch.setattr(Trial, method.__name__, method)


def plain(value: Any) -> Any:
    """A value that can be compared: arrays as lists, settings as dictionaries, paths as texts.

    Paths in the working folder are relative to it.
    """
    match value:
        case str() | Path():
            return str(value).removeprefix(f"{Path.cwd()}/")
        case np.ndarray():
            return value.tolist()
        case Settings():
            return value.to_flat()
        case Mapping():
            return {key: plain(each) for key, each in value.items()}
        case list() | tuple():
            return type(value)(map(plain, value)) if type(value) in (list, tuple) else value
        case _:
            return value


_NOTHING = "nothing"


def changes(usual: Mapping[str, Any], found: Mapping[str, Any]) -> dict[str, Any]:
    """What arrived otherwise than usual, by name; `nothing` for what did not arrive at all."""
    names = dict.fromkeys((*usual, *found))
    pairs = {name: (usual.get(name, _NOTHING), found.get(name, _NOTHING)) for name in names}
    return {name: new for name, (old, new) in pairs.items() if old != new}


def write_files(folder: Path) -> None:
    """Files that options name: models of the trials `another` and `other`, a survey, settings."""
    scene.model(folder / "model.json")
    scene.model(folder / "other.json", "other")
    write_survey_file(folder / "survey.json", prior_by_hand(scene.geometry()))
    (folder / "params.yaml").write_text(PARAMETERS)
    (folder / "without.yaml").write_text(WITHOUT)


def call_verb(stage: Stage, *words: str) -> dict[str, Any]:
    """What arrives of a verb's call, which ends with the code that a stand-in expects, or 0."""
    stage.seen = {}
    code = run([*words])
    assert code == stage.seen.get("code", 0), words
    return stage.seen


def joined(verb: str, *options: Mapping[str, str]) -> list[str]:
    """The words of a call: those of its options, of which later ones replace earlier ones."""
    chosen: dict[str, str] = {}
    for each in options:
        chosen |= each
    return [verb, *(word for words in chosen.values() for word in words.split())]


def defaults_of_verb(verb: str) -> dict[str, Any]:
    """The options that a verb's parser knows, with their defaults; an empty list is None."""
    add_options(parser := Parser(), CALLS[verb])
    actions = [action for action in parser._actions if action.dest != "help"]
    return {action.dest: None if action.default == [] else action.default for action in actions}
