"""The changes that `make mutants` makes: each kind, one at a time, and none that nobody can see."""

import ast
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "scripts"))
from mutations import find_sites

SOURCE = '''"""A module of 3 low words."""

from typing import TYPE_CHECKING

__all__ = ["shown"]
LIMIT: float = 0.5  # at import
if TYPE_CHECKING:
    LIMIT = 7.0


def shown(low: int = 3, *, unit: "N" = "x [N]") -> "A title":
    """Of 5 values."""
    if low < -2.0 and unit is not None:
        raise ValueError(f"{low} is below {1 + 1}", "give 4")
    size = max(low, LIMIT) * (low + 1)  # a comment with + and *
    return [size, low][0], (low, size), f"mean {size} m", not unit


def __repr__():
    return "x"
'''


def test_each_site_is_changed_alone(tmp_path):
    (tmp_path / "module.py").write_text(SOURCE)
    source, original = SOURCE.encode(), ast.dump(ast.parse(SOURCE))
    mutants = [each for site in find_sites(tmp_path, "module.py") for each in site]
    changed = [mutant.apply(source).decode() for mutant in mutants]
    assert len(set(changed)) == len(changed)
    assert all(ast.dump(ast.parse(text)) != original for text in changed)
    old, new = SOURCE.splitlines(), [text.splitlines() for text in changed]
    found = {b for text in new for a, b in zip(old, text, strict=True) if a != b}
    head, test = 'def shown(low: int = {}, *, unit: "N" = {}) -> "A title":', "    if {}:"
    made = "    size = {}  # a comment with + and *"
    back = '    return [size, low][{}], {}, f"{} {{size}} m", {}'
    kept = (0, "(low, size)", "mean", "not unit")
    assert found == {
        *(f"LIMIT: float = {value}  # at import" for value in ("5.0", "1.5", "0.0")),
        *(head.format(value, '"x [N]"') for value in (30, 4, 0)),
        head.format(3, '"y [N]"'),
        *(
            test.format(condition)
            for condition in (
                "not (low < -2.0 and unit is not None)",
                "low < -2.0 or unit is not None",
                "low <= -2.0 and unit is not None",
                "low > -2.0 and unit is not None",
                "low < 2.0 and unit is not None",
                "low < -20.0 and unit is not None",
                "low < -3.0 and unit is not None",
                "low < -0.0 and unit is not None",
                "low < -2.0 and unit is None",
            )
        ),
        *(
            made.format(value)
            for value in (
                "max(low, LIMIT) / (low + 1)",
                "min(low, LIMIT) * (low + 1)",
                "max(low, LIMIT) * (low - 1)",
                "max(low, LIMIT) * (low + 10)",
                "max(low, LIMIT) * (low + 2)",
                "max(low, LIMIT) * (low + 0)",
            )
        ),
        back.format(1, *kept[1:]),
        back.format(0, "(size, low)", *kept[2:]),
        back.format(*kept[:2], "peak", kept[3]),
        back.format(*kept[:3], " unit"),
    }
    once = {source[: m.start].count(b"\n") + 1 for m in mutants if m.once}
    assert once == {6, 11}  # a constant and the defaults
