"""What is typed on the command line: mistakes, lists, completion."""

from pathlib import Path

import pytest

from socket_testbed.__main__ import run
from socket_testbed.commands.arguments import Parser, add_options, release_paths

MISTAKES = {
    "": "VERB",
    "fitt": "unknown verb 'fitt': did you mean 'fit'?",
    "fit": "required: TRIAL, -o/--output: see 'socket-testbed fit --help'",
    "fit t -o m --varant rigid": "--varant: did you mean '--variant'?",
    "fit t -o m --variant rigd": "did you mean 'rigid'?",
    "fit t -o m --jobs 2 --dask a": "--dask: not allowed with",
    "pareto t --variant rigid": "unknown option --variant",
}


def test_a_mistake_is_one_line_with_the_likely_word(capsys) -> None:
    for line, named in MISTAKES.items():
        with pytest.raises(SystemExit) as ended:
            run(line.split())
        error = capsys.readouterr().err
        assert ended.value.code == 2
        assert named in error and error.count("\n") == 1 and "usage:" not in error


def parser_of(verb: str) -> Parser:
    parser = Parser(prog=verb)
    add_options(parser, f"commands.results.{verb}")
    return parser


def test_options_are_those_of_the_signature() -> None:
    """Types, defaults and descriptions of the API, by hand for one verb."""
    parser = parser_of("pareto")
    options = {option.dest: option for option in parser._actions}
    assert options["segment"].default == "plateau" and options["thetas"].default == 101
    assert options["thetas"].type is int and options["smoothness"].type is float
    assert options["weights"].choices == ("size", "noise", "raw")
    assert options["params"].type is Path and options["trial"].option_strings == []
    text = "weight of the smoothness over neighbouring tiles (default: 0.001)"  # of `fit`
    assert text in " ".join(parser.format_help().split())
    given = vars(parser.parse_args(["t", "--initial-stiffness", "auto", "--pose-smoothing", "1"]))
    assert given["initial_stiffness"] == "auto" and given["pose_smoothing"] == 1.0
    assert given["replace"] is False


def test_a_list_takes_no_path_and_may_be_given_in_parts(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hold").mkdir()
    parser = parser_of("fit")
    for line in (
        "--leave-out Mz distal.Fx hold",
        "--leave-out Mz,distal.Fx hold",
        "--leave-out Mz --leave-out distal.Fx hold",
        "hold --leave-out Mz distal.Fx",
    ):
        options = parser.parse_args(["-o", "m", *release_paths(line.split(), parser)])
        assert options.leave_out == ["Mz", "distal.Fx"] and options.trial == Path("hold")
