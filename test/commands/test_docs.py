"""Docs are true: the README's commands run, and its tables name what there is."""

import itertools
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from support import CHECKOUT
from support.verbs import program

from socket_testbed import __version__, clocks
from socket_testbed.commands.calls import CALLS
from socket_testbed.identification import (
    channel_check,
    courses,
    data_check,
    map_posterior,
    map_prior,
    plausibility,
    pressure,
    problem,
    sudden_changes,
    unit_check,
)
from socket_testbed.live.sources import check_sources
from socket_testbed.nodes import estimator_node, recorder_node
from socket_testbed.settings.identification import ForceMapSettings
from socket_testbed.settings.testbed import read_testbed
from socket_testbed.trials import events, raw_check
from socket_testbed.wire.topics import PUBLISHER_DEPTH, TOPICS, Service, Topic

DOCS = CHECKOUT / "docs"
PAGES = [CHECKOUT / "README.md", CHECKOUT / "CONTRIBUTING.md", *DOCS.glob("*.md")]


def commands(page: Path) -> list[str]:
    """The commands of a page that run anywhere, in their order, without comments."""
    blocks = re.findall(r"```bash\n(.*?)```", page.read_text(), flags=re.DOTALL)
    text = "".join(block for block in blocks if "make " not in block).replace("\\\n", "")
    text = text.replace(" examples/", f" {shlex.quote(str(CHECKOUT))}/examples/")
    lines = [re.sub(r"\s+#.*", "", line) for line in text.splitlines()]
    programs = shlex.quote(f"{Path(sys.executable).parent}/")
    return [line.replace(".venv/bin/", programs) for line in lines if line]


def run(script: list[str], folder: Path) -> str:
    """Run commands in a folder until one fails; returns what they print."""
    code, out, err = program("bash", "-euo", "pipefail", "-c", "\n".join(script), folder=folder)
    assert code == 0, err
    return out


@pytest.fixture(scope="module")
def readme_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The README's commands, followed twice in a folder such as people have."""
    folder = tmp_path_factory.mktemp("Projekt Schäfte")
    for _ in range(2):
        assert "mean moment RMSE" in run(commands(PAGES[0]), folder)
    return folder


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("page", [p for p in PAGES if commands(p)], ids=lambda page: page.name)
def test_commands_of_a_page_run(page: Path, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """A page that begins as the README does, such as with its scan, goes on where that ran."""
    known, script = commands(PAGES[0]), commands(page)
    left = list(itertools.dropwhile(known.__contains__, script))
    if left != script:
        tmp_path = request.getfixturevalue("readme_folder")
    run(left, tmp_path)


# --- the pages name what there is


def test_the_readme_names_targets_that_exist() -> None:
    targets = re.findall(r"^([a-z]+):", (CHECKOUT / "Makefile").read_text(), flags=re.MULTILINE)
    readme = PAGES[0].read_text()
    assert set(re.findall(r"(?:^|`)make ([a-z]+)", readme, flags=re.MULTILINE)) <= set(targets)


def test_the_readme_names_every_verb() -> None:
    rows = PAGES[0].read_text().partition("| for | verbs")[2].partition("\n\n")[0]
    assert set(re.findall(r"`([a-z]+)`", rows)) == set(CALLS)


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_the_conventions_name_every_topic(topic: Topic) -> None:
    conventions = (DOCS / "conventions.md").read_text()
    package, _, name = topic.type.split("/")
    assert re.search(rf"`{topic.name}`.*\| {package}/{name} \|", conventions)


def test_the_conventions_name_every_service() -> None:
    conventions = (DOCS / "conventions.md").read_text()
    rows = conventions.partition("| service | type | effect |")[2].partition("\n\n")[0]
    named = re.findall(r"^\| `(\S+)` \| std_srvs/", rows, flags=re.MULTILINE)
    assert sorted(named) == sorted(Service)


def test_the_example_of_other_sensors_is_read(tmp_path: Path) -> None:
    (text,) = re.findall(r"```yaml\n(.*?)```", (DOCS / "foreign-live.md").read_text(), re.DOTALL)
    example = (CHECKOUT / "config" / "testbed.yaml").read_text()
    commented = re.sub("^# ", "", example[example.index("# align_node:") :], flags=re.MULTILINE)
    for name, content in (("page", text), ("example", commented)):
        (tmp_path / name).write_text(content)
        settings = read_testbed(tmp_path / name)
        check_sources(settings.align_node)
        assert settings.align_node.wrench.topic == "/ft_sensor/wrench"
        assert "load_cell_node" not in settings.own_nodes


PLACES = re.findall(r"`(\S+\.py): ([^`]+)`", (DOCS / "paper.md").read_text())


def test_the_paper_s_page_names_many_functions() -> None:
    assert len(PLACES) > 20


@pytest.mark.parametrize(("name", "listed"), PLACES, ids=[": ".join(place) for place in PLACES])
def test_the_paper_s_page_names_functions_that_exist(name: str, listed: str) -> None:
    (file,) = (CHECKOUT / "socket_testbed").rglob(name)
    for defined in listed.split(", "):
        assert re.search(rf"(def|class) {defined.rpartition('.')[2]}\b", file.read_text())


# --- the pages' numbers are those of the code


NUMBERS = {
    "faults": (
        f"retries after {clocks._MIN_WAIT} s, then after up to {clocks._MAX_WAIT} s",
        f"no data at the recorder for {recorder_node._SILENCE_TIMEOUT:g} s",
        f"correlation below {courses.REVERSED}; sound",
        f"varies by {courses.LOCAL_SHARE[1]:g} times their share of the load (by area), or is"
        f" {courses.MAX_BORNE:g} times the load",
        f"a lever below {1e3 * unit_check.MIN_LEVER:g} mm",
        f"below {unit_check.LOAD_RANGE[0]:g} or above {unit_check.LOAD_RANGE[1]:g} body weights",
        f"a lag above {courses.MAX_LAG} s",
        f"a lag above {courses.MAX_POSE_LAG} s",
        f"behind load and pose at a lag above {courses.MAX_CLUSTER_LAG} s",
        f"correlate by {courses.MIN_AXES_GAIN} more in other axes",
        f"an input with {raw_check.NOISE_RATIO:g} times the noise",
        f"{raw_check.MAX_REPEATED:.0%} of the readings of a source repeat",
        f"{1e3 * sudden_changes.POSE_JUMPS[0]:g} mm or {sudden_changes.POSE_JUMPS[1]} rad",
        f"turns by {np.degrees(unit_check.MAX_ROTATION):.0f} degrees",
        f"mean pressure {data_check.INNOVATIONS[1]} sigma above or {-data_check.INNOVATIONS[0]}"
        " below",
        f"{1e-3 * data_check.LOCAL_VARIATION:g} kPa for a single tile's own",
        f"{channel_check.MAX_MISSING:.0%} missing, no change for {channel_check.MAX_STILL:g} s,"
        f" {channel_check.MAX_CLIPPED:.0%} at one end",
        f"noise above {channel_check.MAX_NOISE['N']:g} N or {channel_check.MAX_NOISE['N m']:g} N m",
    ),
    "conventions": (
        f"volatile with depth {PUBLISHER_DEPTH}",
        f"dark red at {1e-3 * estimator_node._MAX_PRESSURE:g} kPa",
        f"vanish after {estimator_node._LIFETIME} s",
        f"{1e9 / estimator_node._REGIONS_PERIOD:g} Hz, only with a subscriber",
        f"up to {1e9 / estimator_node._PICTURE_PERIOD:g} Hz",
    ),
    "fitting": (
        f"fewer than {problem.MIN_SAMPLES} with a wrench",
        f"below {plausibility.MIN_FORCE:g} N and {plausibility.MIN_MOMENT:g} N m throughout",
        f"above {1e-3 * plausibility.MAX_FORCE:g} kN, {plausibility.MAX_MOMENT:g} N m, or"
        f" {1e-6 * plausibility.MAX_STRESS:g} MPa on a cluster",
        f"refused above {plausibility.MAX_OUTLIERS:.0%}",
        f"wrench above {plausibility.HANGING_WEIGHT:g} N towards proximal",
    ),
    "view": (f"greyest at {pressure._GREYEST:g} times",),
    "pressure": (
        f"above {1e-3 * pressure.THRESHOLD:g} kPa (`--threshold`)",
        f"from {pressure._DRAWS} joint draws",
        f"widened by {pressure._PEAK_WIDENING:g}",
        f"+- {map_prior._TILE_SHARE_SPREAD:.0%}, or {ForceMapSettings.share:.0%} +-"
        f" {ForceMapSettings.share_spread:.0%} if the file",
    ),
    "segments": (
        f"rises above {events._RISE_SHARE:.0%} of the way",
        f"falls below {events._FALL_SHARE:.0%}.",
        f"above {events._STANCE_SHARE:.0%} of the way",
    ),
    "force_map": (
        f"draws {ForceMapSettings.draws} hypotheses",
        f"evidence to the power {map_posterior.EVIDENCE_POWER:g}",
        f"+- {map_prior._TILE_SHARE_SPREAD:g} (`tile_share`",
    ),
}


@pytest.mark.parametrize(
    ("page", "number"), [(page, number) for page in NUMBERS for number in NUMBERS[page]]
)
def test_a_page_s_number_is_the_code_s(page: str, number: str) -> None:
    text = (DOCS / f"{page}.md").read_text()
    assert number in re.sub(r"(?<=\d) %", "%", " ".join(text.split()))


# --- links, programs and versions


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_to_its_heading(page: Path) -> None:
    for target in re.findall(r"\]\(([^):]+)\)", page.read_text()):
        path, _, anchor = target.partition("#")
        found = page.parent / path if path else page
        assert found.exists(), target
        text = re.sub(r"```.*?```", "", found.read_text(), flags=re.DOTALL) if anchor else ""
        headings = re.findall(r"^#+ (.+)$", text.lower(), flags=re.MULTILINE)
        anchors = [re.sub(r"[^\w -]", "", each).replace(" ", "-") for each in headings]
        assert not anchor or anchor in anchors, target


def test_the_map_names_what_exists() -> None:
    page = (CHECKOUT / "CONTRIBUTING.md").read_text()
    shown = [path for path in CHECKOUT.iterdir() if not path.name.startswith(".")]
    known = {path.name for top in shown for path in (top, *top.rglob("*"))}
    named = {name.rstrip("/") for name in re.findall(r"[a-z0-9_]+\.py\b|[a-z0-9_]+/(?= )", page)}
    assert named and not named - known
    text = page + (DOCS / "data_flow.svg").read_text()
    for name in re.findall(r"(?:[a-z0-9_]+/)+(?:[a-z0-9_]+\.(?:py|md)\b|(?=</text>))", text):
        assert any((top / name).exists() for top in (CHECKOUT / "socket_testbed", CHECKOUT)), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_s_programs_compile(page: Path) -> None:
    """test_api.py runs the README's first."""
    for code in re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL):
        compile(code, page.name, "exec")


@pytest.mark.parametrize(
    "name", ["package.xml", "msg_defs/package.xml", "CITATION.cff", "CHANGELOG.md"]
)
def test_one_version_stands_everywhere(name: str) -> None:
    assert re.search(rf"[>:[] ?{__version__}[<\n\]]", (CHECKOUT / name).read_text())
