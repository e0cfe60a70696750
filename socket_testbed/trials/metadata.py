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
from socket_testbed.settings.options import Side
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

    Whitespace in a text is collapsed to single spaces. Texts have at most 80 characters, notes
    2000.

    Attributes:
        subject: A code such as `S01`, without spaces; never a name.
        side: Side of the residual limb, `left` or `right`.
        socket: The socket, such as `PTB 3`.
        liner: The liner or sock.
        mass: Body mass of the subject, within `MASS_RANGE` [kg].
        operator: Initials or a code of the person who ran the trial, without spaces.
        protocol: The protocol that the trial follows.
        notes: Further remarks.

    Raises:
        ConfigurationError: If a value has another type, is empty, too long or out of range, or
            holds a control character.
    """

    subject: str | None = None
    side: Side | None = None
    socket: str | None = None
    liner: str | None = None
    mass: float | None = None
    operator: str | None = None
    protocol: str | None = None
    notes: str | None = None

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
    """Read the metadata of a trial from its `trial.yaml`.

    Raises:
        ConfigurationError: If the file is missing, holds an unknown field or an invalid value.
    """
    given = read_document(path, dict[str, Any])
    refuse_unknown(given, FIELDS, str(path))
    with naming(path):
        return TrialMetadata(**given)


def write_metadata(metadata: TrialMetadata, path: Path) -> None:
    """Write the metadata to a `trial.yaml`, atomically: on failure, the older file stays.

    Args:
        metadata: The metadata; unstated fields are left out of the file.
        path: The file, `trial.yaml` in the trial's folder.
    """
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
    """Metadata with some fields changed and others removed.

    Args:
        metadata: The metadata so far, which stay as they are.
        changes: New values by field, as in `TrialMetadata`; None keeps a field.
        remove: Fields that become unstated, unless also changed.

    Raises:
        ConfigurationError: If a field to remove does not exist, or a value is invalid.
    """
    removed = dict.fromkeys(remove)
    for name in removed:
        if name not in FIELDS:
            raise ConfigurationError(f"remove is '{name}'", closest(name, FIELDS))
    given = {name: value for name, value in changes.items() if value is not None}
    return dataclasses.replace(metadata, **{**removed, **given})
