"""The verb `pareto`, with right and with wrong input."""

import csv
import dataclasses
import json

import pytest

from socket_testbed.__main__ import run as run_verb
from socket_testbed.api import tradeoff
from socket_testbed.identification.pareto import KNEE, SENSOR_ONLY, WRENCH_ONLY
from socket_testbed.settings.identification import PAPER_VARIANTS


def call(*words):
    """The verb as the command line calls it."""
    assert run_verb(["pareto", *(str(word) for word in words)]) == 0


def test_the_verb_prints_and_writes_both_fronts(hold, tmp_path, capsys):
    table, figure = tmp_path / "front.csv", tmp_path / "front.png"
    call(hold, "--thetas", 11, "-o", table, "--figure", figure)
    out = capsys.readouterr().out
    for text in (
        *PAPER_VARIANTS,
        SENSOR_ONLY,
        KNEE,
        WRENCH_ONLY,
        "[N m]",
        "of 11",
        "KKT",
        "plateau",
    ):
        assert text in out
    with table.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["theta [-]"] for row in rows] == 2 * [f"{i / 10:g}" for i in range(11)]
    assert all(float(row["KKT residual or gap [-]"]) <= 1e-8 for row in rows)
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert sorted(tmp_path.iterdir()) == [table, figure]


def test_the_verb_s_errors_are_those_of_fit_at_the_same_theta(hold, tmp_path, capsys):
    leave_out = ["--leave-out", "Mz", "distal.Fx"]
    call(hold, "--thetas", 3, "--segment", "20:40", "--smoothness", "1e-4", "--json", *leave_out)
    report = json.loads(capsys.readouterr().out)
    assert report["segment"]["kind"] == "span"
    model = tmp_path / "model.json"
    for front in report["fronts"]:
        words = ["fit", hold, "--segment", "20:40", "--smoothness", "1e-4", "--theta", "1"]
        words += ["--variant", front["variant"], "-o", model, "--replace", *leave_out]
        assert run_verb([str(word) for word in words]) == 0
        errors = json.loads(model.read_text())["quality"]["errors"]
        expected = {e["name"]: e["rmse"] for e in errors if e["in_objective"]}
        assert front["marks"][WRENCH_ONLY]["rmse"] == pytest.approx(expected, rel=1e-5, abs=1e-7)


def test_with_offsets_the_front_of_a_hold_collapses(hold, capsys):
    call(hold, "--thetas", 21, "--json")
    plain, bias = json.loads(capsys.readouterr().out)["fronts"]
    assert plain["knee"]["depth"] > 0.5
    assert max(bias["knee"]["span"]) < 0.05 * max(plain["knee"]["span"])


def test_flawed_solutions_are_named_with_their_thetas(hold, monkeypatch, capsys):
    solve = tradeoff.pareto_front

    def spoil(*args, **kwargs):
        flaws = ("not determined", "", "not certified", "not certified", "")
        fronts = solve(*args, **kwargs)
        return {v: dataclasses.replace(front, flaws=flaws) for v, front in fronts.items()}

    monkeypatch.setattr(tradeoff, "pareto_front", spoil)
    call(hold, "--thetas", 5)
    lines = capsys.readouterr().out.splitlines()
    rows = [line for line in lines if SENSOR_ONLY in line]
    assert len(rows) == 2 and all(row.endswith("-  not determined") for row in rows)
    assert sum("left out: 1 at theta 0: not determined" in line for line in lines) == 2
    assert sum("left out: 2 at theta 0.5 to 0.75: not certified" in line for line in lines) == 2
