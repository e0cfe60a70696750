"""A defect of a trial's data, as every check of it reports one."""

from __future__ import annotations

from dataclasses import dataclass

GOOD, CHECK = "data: good", "data: check "
LEAST_CHECKED = 30
STILL = "not change for"  # words of a finding
WRITE_QUATERNIONS = "give quaternions as"  # start of the hint of a finding


@dataclass(frozen=True)
class DataFinding:
    """A defect of a trial's data.

    Attributes:
        source: Where to look, such as `the wrench`, `the limb pose`, the name of a cluster or of
            a channel.
        fact: The defect in words, with its numbers and their units.
        hint: What to check.
    """

    source: str
    fact: str
    hint: str

    def __str__(self) -> str:
        return f"{CHECK}{self.source}: {self.fact}; {self.hint}"
