"""The files of a public forge parse, and what they call exists."""

import re
import shlex
import shutil
from pathlib import Path

import pytest
import yaml
from support import CHECKOUT
from support.verbs import program

WORKFLOWS = sorted((CHECKOUT / ".github" / "workflows").glob("*.yml"))
TEMPLATES = sorted((CHECKOUT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
HOOKS = CHECKOUT / ".pre-commit-config.yaml"
MAKEFILE = (CHECKOUT / "Makefile").read_text()


def read(path: Path) -> dict:
    return yaml.safe_load(path.read_text())


def hooks() -> list[dict]:
    (local,) = read(HOOKS)["repos"]
    assert local["repo"] == "local"
    return local["hooks"]


def steps(workflow: Path) -> list[dict]:
    return [step for job in read(workflow)["jobs"].values() for step in job["steps"]]


COMMANDS = [step["run"] for path in WORKFLOWS for step in steps(path) if "run" in step]
COMMANDS += [hook["entry"] for hook in hooks()]


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_exists(command: str) -> None:
    program, *words = shlex.split(command)
    if program == "make":
        assert all(re.search(rf"^{word}:", MAKEFILE, flags=re.MULTILINE) for word in words)
    else:
        files = [word for word in (program, *words) if "/" in word and word[0] != "-"]
        assert files and all((CHECKOUT / file).exists() for file in files)


def test_the_tests_run_on_every_python() -> None:
    job = read(CHECKOUT / ".github" / "workflows" / "tests.yml")["jobs"]["tests"]
    promised = re.search(
        r'python_requires=">=3.(\d+),<3.(\d+)"', (CHECKOUT / "setup.py").read_text()
    )
    versions = [f"3.{minor}" for minor in range(*map(int, promised.groups()))]
    assert job["strategy"]["matrix"]["python"] == versions
    assert [step["run"] for step in job["steps"] if "run" in step] == ["bash .ci/run"]


def test_the_oldest_libraries_are_the_lower_bounds(tmp_path: Path) -> None:
    """Each bound of the requirements, such as `numpy>=1.26,<3`, is one exact version."""
    shutil.copytree(CHECKOUT / "requirements", tmp_path / "requirements")
    shutil.copy(CHECKOUT / "Makefile", tmp_path)
    _, _, errors = program("make", "-C", str(tmp_path), "build/oldest.txt")
    made = (tmp_path / "build" / "oldest.txt").read_text().splitlines()
    stated = (CHECKOUT / "requirements" / "runtime.txt").read_text().splitlines()
    bounds = [re.match(r"[\w.-]+>=[\d.]+", line) for line in stated]
    assert made == [bound[0].replace(">=", "==") for bound in bounds if bound], errors
    job = read(CHECKOUT / ".github" / "workflows" / "tests.yml")["jobs"]["oldest"]
    assert [step["run"] for step in job["steps"] if "run" in step] == ["make oldest"]


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: path.stem)
def test_a_template_can_be_filled_in(path: Path) -> None:
    form = read(path)
    assert form["name"] and form["description"]
    assert all(part["attributes"]["label"] for part in form["body"])


def test_a_bug_states_trial_and_testbed() -> None:
    text = (CHECKOUT / ".github" / "ISSUE_TEMPLATE" / "bug.yml").read_text()
    assert "socket-testbed info TRIAL" in text and "socket-testbed doctor" in text


def test_the_hooks_are_the_linters_of_make() -> None:
    lint = MAKEFILE.partition("lint: setup\n")[2].partition("\n\n#")[0]
    linters = {line.split()[0] for line in lint.splitlines() if line.startswith("\t$(BIN)")}
    called = {hook["entry"].split()[0].replace(".venv/bin", "$(BIN)") for hook in hooks()}
    assert called == linters
    assert all(hook["language"] == "system" for hook in hooks())
