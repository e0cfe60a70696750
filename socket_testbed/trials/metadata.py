"""Metadata of a trial (subject, socket, conditions), in the file `trial.yaml` of its folder."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_args

from msgspec import Meta

from socket_testbed.documents import convert, plain, read_document, refuse_unknown
from socket_testbed.errors import ConfigurationError, closest, naming
from socket_testbed.files import write_text
from socket_testbed.geometry.socket import Side
from socket_testbed.settings.testbed import MAX_MASS

METADATA_FILE = "trial.yaml"

NO_SIDE = (
    "no side is stated: the regions are left and right, not medial and lateral; state it with"
    " 'annotate TRIAL --side left|right'"
)
SIDES: tuple[Side, ...] = get_args(Side)
MASS_RANGE = (5.0, MAX_MASS)  # [kg]
_MASS: Any = Annotated[
    float, Meta(ge=MASS_RANGE[0], le=MASS_RANGE[1], description="the body mass [kg]")
]

_MAX_LENGTHS = {"notes": 2000}  # [characters]; 80 for other fields
_CODES = {"subject": "a code such as S01, never a name", "operator": "initials or a code"}
_HEADER = "# Metadata of this trial; the mass in kg. 'socket-testbed annotate' changes it.\n"


@dataclass(frozen=True, repr=False)
class TrialMetadata:
    """Metadata stated by a person; None for an unstated field.

    Whitespace in a text is collapsed to single spaces.
    """

    subject: str | None = None  # a code such as `S01`; never a name
    side: Side | None = None  # of the residual limb
    socket: str | None = None  # such as `PTB 3`
    liner: str | None = None  # or sock
    mass: float | None = None  # of the subject [kg]
    operator: str | None = None  # initials or a code
    protocol: str | None = None  # that the trial follows
    notes: str | None = None  # further remarks

    def __post_init__(self) -> None:
        for name, value in self.stated().items():
            object.__setattr__(self, name, _checked(name, value))

    def __repr__(self) -> str:
        stated = ", ".join(f"{name}={value!r}" for name, value in self.stated().items())
        return f"TrialMetadata({stated})"

    def stated(self) -> dict[str, Any]:
        """The stated values, by field."""
        return {name: value for name in FIELDS if (value := getattr(self, name)) is not None}

    def described(self) -> dict[str, str]:
        """The stated values as text with units, by field."""
        texts = {name: str(value) for name, value in self.stated().items()}
        return texts if self.mass is None else texts | {"mass": f"{self.mass:g} kg"}

    def columns(self) -> dict[str, str | float | None]:
        """All values by column name of a summary; None for an unstated field."""
        return {COLUMNS[name]: getattr(self, name) for name in FIELDS}


FIELDS = tuple(item.name for item in dataclasses.fields(TrialMetadata))
# In a summary, `notes` are those of the software.
COLUMNS = {name: name for name in FIELDS} | {"mass": "mass [kg]", "notes": "trial_notes"}


def _checked(name: str, value: Any) -> Any:
    if name == "mass":
        return convert(plain(value), _MASS, "mass")
    if not isinstance(value, str):
        raise ConfigurationError(f"{name} is {value}, not a text", "give a text, in quotes in YAML")
    text = " ".join(value.split())
    longest = _MAX_LENGTHS.get(name, 80)
    if not text:
        raise ConfigurationError(f"{name} is empty", "give a text or leave it out")
    if not text.isprintable():
        raise ConfigurationError(f"{name} holds a control character", "give printable text")
    if len(text) > longest:
        raise ConfigurationError(f"{name} has {len(text)} characters", f"give {longest} at most")
    if name in _CODES and " " in text:
        raise ConfigurationError(f"{name} is '{text}', with a space", f"give {_CODES[name]}")
    if name == "side" and text not in SIDES:
        raise ConfigurationError(f"side is '{text}'", closest(text, SIDES))
    return text


def read_metadata(path: Path) -> TrialMetadata:
    """Read the metadata of a trial from its `trial.yaml`."""
    given = read_document(path, dict[str, Any])
    refuse_unknown(given, FIELDS, str(path))
    with naming(path):
        return TrialMetadata(**given)


def write_metadata(metadata: TrialMetadata, path: Path) -> None:
    """Write the metadata to a `trial.yaml`, atomically: on failure, the older file stays."""
    write_text(path, metadata_text(metadata))


def metadata_text(metadata: TrialMetadata) -> str:
    """The text of a `trial.yaml`."""
    # JSON strings are quoted YAML strings: '007' and '1e3' stay strings.
    lines = [
        f"{name}: {json.dumps(value, ensure_ascii=False)}\n"
        for name, value in metadata.stated().items()
    ]
    return _HEADER + "".join(lines)


def change_metadata(
    metadata: TrialMetadata, changes: Mapping[str, Any], remove: Iterable[str] = ()
) -> TrialMetadata:
    """Metadata with some fields changed (None keeps a field) and others removed."""
    removed = dict.fromkeys(remove)
    for name in removed:
        if name not in FIELDS:
            raise ConfigurationError(f"remove is '{name}'", closest(name, FIELDS))
    given = {name: value for name, value in changes.items() if value is not None}
    return dataclasses.replace(metadata, **{**removed, **given})
