"""The examples run as a user runs them, and find what is true."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from support import CHECKOUT
from support.verbs import program

sys.path.insert(0, str(CHECKOUT / "scripts"))
import gallery

PAGE = (CHECKOUT / "docs" / "examples.md").read_text()
NUMBER = r"(-?\d+(?:\.\d+)?)"


def numbers(pattern: str, printed: str) -> list[float]:
    """The numbers at each `#` of the first line that has this form."""
    found = re.search(re.escape(pattern).replace(r"\#", NUMBER), printed)
    assert found, printed
    return [float(number) for number in found.groups()]


def own_regions(printed: str) -> None:
    for name in ("patellar tendon", "popliteal", "distal quarter"):
        mean, low, high, true = numbers(f"{name}: # kPa (# to #), in truth # kPa", printed)
        assert low <= true <= high and mean == pytest.approx(true, abs=1.5)


def two_sockets(printed: str) -> None:
    assert re.search(r"^socket +\d", printed, flags=re.MULTILINE)


def pressure_limit(printed: str) -> None:
    peaks = re.findall(rf"limit exceeded: (\w+), {NUMBER} kPa", printed)
    assert len(peaks) == 10 and {side for side, _ in peaks} == {"posterior"}
    assert all(float(peak) > 10.0 for _, peak in peaks)


def to_opensim(printed: str) -> None:
    # 9.3 kg hang throughout; 19 kg go and come in two cosines: 91.2 + 186.4 / 2 = 184.4 N
    assert numbers("mean vertical force: # N", printed) == [pytest.approx(-184.4, abs=3.0)]
    assert "600 samples of 6 markers" in printed


def calibrate_cluster(printed: str) -> None:
    # 1 / (0.05 pF/kPa)
    assert numbers("capacitance: # kPa/pF", printed) == [pytest.approx(20.0, abs=0.1)]


def repair_trial(printed: str) -> None:
    assert "check mid_anterior and posterior_distal" in printed
    assert "findings after the repair: 0" in printed
    (wrong,) = numbers("as recorded: # kPa", printed)
    (repaired,) = numbers("repaired: # kPa", printed)
    (true,) = numbers("in truth: # kPa", printed)
    assert abs(repaired - true) < 0.5 < abs(wrong - true)


def many_trials(printed: str) -> None:
    assert re.findall(r"^s\d\d", printed, flags=re.MULTILINE) == ["s00", "s01", "s02", "s03"]


def own_law(printed: str) -> None:
    own, published, default, constant = (
        numbers(f"{name}: RMSE of Fz # N", printed)[0]
        for name in ("hardening", "stiffness_bias", "rigid_bias", "constant")
    )
    assert default < own < published < constant


def cycles(printed: str) -> None:
    assert "4 cycles from each 'placed' to the next one, 30.00 s" in printed
    (by_hand,) = numbers("by hand: # kPa s", printed)
    (package,) = numbers("by the package: # kPa s", printed)
    assert package == pytest.approx(by_hand, rel=0.01)


def long_table(printed: str) -> None:
    pairs = re.findall(rf"^S0\d +{NUMBER} +{NUMBER}$", printed, flags=re.MULTILINE)
    (difference,) = numbers("stiff - soft: # kPa", printed)
    assert len(pairs) == 4
    by_hand = sum(float(stiff) - float(soft) for soft, stiff in pairs) / 4
    assert difference == pytest.approx(by_hand, abs=0.1)


JUDGED = (
    own_regions, two_sockets, pressure_limit, to_opensim, calibrate_cluster,
    repair_trial, many_trials, own_law, cycles, long_table,
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.graph
@pytest.mark.timeout(300)
@pytest.mark.parametrize("judged", JUDGED, ids=lambda judged: judged.__name__)
def test_an_example_finds_what_is_true(judged, tmp_path: Path) -> None:
    script = CHECKOUT / "examples" / f"{judged.__name__}.py"
    code, out, err = program(sys.executable, script, folder=tmp_path, MPLBACKEND="agg")
    assert code == 0, err
    judged(out)
    picture = CHECKOUT / "docs" / "examples" / f"{judged.__name__}.png"
    assert (tmp_path / picture.name).is_file() == picture.is_file()


@pytest.mark.parametrize("name", gallery.NAMES)
def test_the_page_shows_each_example(name: str) -> None:
    assert f"## {name}\n\n[{name}.py](../examples/{name}.py): {gallery.question(name)}\n" in PAGE


def test_every_example_is_listed_and_judged() -> None:
    scripts = {path.stem for path in (CHECKOUT / "examples").glob("*.py")} - {"socket_scan"}
    assert scripts == {*gallery.NAMES} == {judged.__name__ for judged in JUDGED}


def test_pictures_of_examples_are_small() -> None:
    sizes = [path.stat().st_size for path in (CHECKOUT / "docs" / "examples").iterdir()]
    assert sizes and max(sizes) < 60_000


def test_a_broken_link_is_named(tmp_path: Path) -> None:
    import check_links

    page = tmp_path / "page.md"
    page.write_text("# One\n\n[a](#one) [b](#two) [c](gone.md) [d](http://x) `[e](f.md)`\n")
    assert check_links.broken_links(page) == ["#two", "gone.md"]


def test_the_documents_have_no_broken_link() -> None:
    words = [sys.executable, str(CHECKOUT / "scripts" / "check_links.py")]
    done = subprocess.run(words, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
