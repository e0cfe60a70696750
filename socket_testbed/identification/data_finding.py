"""A defect of a trial's data, as every check of it reports one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

GOOD, CHECK = "data: good", "data: check "
LEAST_CHECKED = 30
Kind: TypeAlias = Literal["still", "quaternions", "capacity", ""]


@dataclass(frozen=True)
class DataFinding:
    """A defect of a trial's data.

    Attributes:
        source: Where to look, such as `the wrench`, `the limb pose`, the name of a cluster or of
            a channel.
        fact: The defect in words, with its numbers and their units.
        hint: What to check.
        kind: Of a defect that explains others: `still`, a reading that does not change;
            `quaternions` in another order; `capacity`, a load above the load cell's. Empty for any
            other.
    """

    source: str
    fact: str
    hint: str
    kind: Kind = ""

    def __str__(self) -> str:
        return f"{CHECK}{self.source}: {self.fact}; {self.hint}"
