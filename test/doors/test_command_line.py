"""Words of a command line and the options that a verb is given."""

from pathlib import Path
from typing import Any

import pytest

from socket_testbed.__main__ import _parse

PARSED: dict[str, dict[str, Any]] = {
    "fit hold -o m.json": {"trial": Path("hold"), "output": Path("m.json"), "segment": "plateau"},
    "fit hold -o m --theta 0.25": {"theta": 0.25, "variant": None, "replace": False},
    "fit hold -o m --leave-out Mz distal.Fx --replace": {
        "leave_out": ["Mz", "distal.Fx"],
        "replace": True,
    },
    "fit hold -o m --initial-stiffness auto": {"initial_stiffness": "auto"},
    "fit hold -o m --initial-stiffness 2e3": {"initial_stiffness": 2000.0},
    "fit hold -o m --frames 7": {"frames": 7},
    "export hold -o a.csv --about 0 0.1 -0.2": {"about": [0.0, 0.1, -0.2]},
    "calibrate a.csv b.csv -o c --cluster x --wiring 2 3 0 1": {
        "bench": [Path("a.csv"), Path("b.csv")],
        "wiring": [2, 3, 0, 1],
        "limit": 10.0,
    },
    "compare a b --by-region": {"trial": [Path("a"), Path("b")], "by_region": True},
    "compare --condition gel=a --condition sock=b": {"condition": ["gel=a", "sock=b"]},
    "pressure hold --figure f.png --no-title --width 88": {
        "figure": Path("f.png"),
        "title": False,
        "width": 88,
    },
    "simulate -o x --scenario ramp --seed 3": {"scenario": "ramp", "seed": 3, "like_paper": False},
    "annotate a b --remove mass --remove side": {
        "trial": [Path("a"), Path("b")],
        "remove": ["mass", "side"],
    },
    "mark push": {"label": "push", "namespace": "/"},
    "view": {"trial": None},
}


@pytest.mark.parametrize("line", PARSED)
def test_words_become_options(line: str) -> None:
    found = vars(_parse(line.split()))
    assert found["verb"] == line.split(maxsplit=1)[0]
    for name, value in PARSED[line].items():
        own = found[name]
        assert ([*own] if isinstance(value, list) else own) == value, name


WRONG = {
    "fit hold": "-o",
    "fit -o m": "TRIAL",
    "calibrate a.csv -o c": "--cluster",
    "export hold -o a.csv --about 0 0": "3 arguments",
    "calibrate a.csv -o c --cluster x --wiring 0 1 2": "4 arguments",
    "calibrate a.csv -o c --cluster x --area 1e-3 --geometry s.yaml": "not allowed with",
    "pressure hold --width 100": "invalid choice",
    "simulate -o x --scenario rmap": "invalid choice",
    "fit hold -o m --theta much": "invalid float",
    "fit hold -o m --frames 1.5": "invalid int",
    "pressure hold --over-time --cycles step": "not allowed with",
    "nonsense": "unknown verb",
}


@pytest.mark.parametrize("line", WRONG)
def test_wrong_words_are_named(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        _parse(line.split())
    assert ended.value.code == 2
    assert WRONG[line] in capsys.readouterr().err


HELP = {
    "fit": ["-o FILE", "--theta ", "(default: 0.5)"],
    "export": ["--about M M M"],
    "pressure": ["--no-title", "--width {88,180}"],
    "tile": ["--height MM", "--size MM", "(default: 80)"],
}


@pytest.mark.parametrize("verb", HELP)
def test_help_shows_units_and_defaults(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        _parse([verb, "--help"])
    assert ended.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    for words in HELP[verb]:
        assert words in shown, words
