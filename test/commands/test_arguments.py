"""What is typed on the command line: mistakes, lists, completion."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from socket_testbed.__main__ import run
from socket_testbed.commands.arguments import Parser, add_options, release_paths


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ([], "VERB"),
        (["fitt"], "unknown verb 'fitt': did you mean 'fit'?"),
        (["nothing"], "use one of demo, run, doctor"),
        (["fit"], "required: TRIAL, -o/--output: see 'socket-testbed fit --help'"),
        (["fit", "t", "-o"], "-o/--output: expected one argument"),
        (["fit", "t", "-o", "m", "--varant", "rigid"], "--varant: did you mean '--variant'?"),
        (["fit", "t", "--outptu", "m"], "--outptu: did you mean '--output'?"),
        (["fit", "t", "-o", "m", "--variant", "rigd"], "did you mean 'rigid'?"),
        (["info", "t", "u"], "not understood: u"),
        (["--verson"], "--verson: did you mean '--version'?"),
    ],
)
def test_a_mistake_is_one_line_with_the_likely_word(words, named, capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        run(words)
    error = capsys.readouterr().err
    assert ended.value.code == 2
    assert named in error and error.count("\n") == 1 and "usage:" not in error


@pytest.mark.parametrize("option", ["-V", "--version"])
def test_the_version_is_printed(option: str, capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        run([option])
    assert ended.value.code == 0 and capsys.readouterr().out.startswith("socket_testbed 0.")


@pytest.mark.parametrize(
    "words",
    [
        ["--leave-out", "Mz", "distal.Fx", "HOLD"],
        ["--leave-out", "Mz,distal.Fx", "HOLD"],
        ["--leave-out", "Mz", "--leave-out", "distal.Fx", "HOLD"],
        ["HOLD", "--leave-out", "Mz", "distal.Fx"],
    ],
)
def test_channels_that_are_left_out_leave_the_trial(words, hold, tmp_path, capsys) -> None:
    words = [word.replace("HOLD", str(hold)) for word in words]
    assert run(["fit", "-o", str(tmp_path / "m.json"), "--segment", "20:30", *words]) == 0
    assert capsys.readouterr().out.count("not in objective") == 2


def test_what_names_a_path_is_none_of_a_list_s_values(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hold").mkdir()
    released = ["hold", "other/walk", "--leave-out", "Mz", "--json"]
    for verb, words, expected in (
        ("validate.validate", ["--leave-out", "Mz", "hold", "other/walk", "--json"], released),
        ("models.fit", ["hold", "--leave-out", "Mz", "distal.Fq", "-o", "m"], None),
        ("calibrate.calibrate", ["--columns", "normal=N/mm2", "c0=C/0"], None),
        ("calibrate.calibrate", ["--baseline", "hold", "hold"], None),
    ):
        parser = Parser()
        add_options(parser, f"commands.{verb}")
        assert release_paths(words, parser) == (expected or words)


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("socket-testbed ev", {"evaluate"}),
        ("socket-testbed fit --leave", {"--leave-out"}),
        ("socket-testbed simulate --tissue s", {"soft", "stiff"}),
    ],
)
def test_the_shell_completes_verbs_options_and_choices(
    line: str, offered: set[str], tmp_path: Path
) -> None:
    answer = tmp_path / "answer"
    shell = {"COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE": "1"}
    shell["_ARGCOMPLETE_STDOUT_FILENAME"] = str(answer)
    subprocess.run(
        [sys.executable, "-m", "socket_testbed"],
        check=True,
        env={**os.environ, **shell, "_ARGCOMPLETE_IFS": "\n"},
    )
    assert {word.strip() for word in answer.read_text().split("\n")} == offered
