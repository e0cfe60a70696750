"""The scene with known answers, as a trial on disk, with its forces known to the product."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from support import results_by_hand, scene
from support.pages import Page

import socket_testbed as st
from socket_testbed.results.report import Results
from socket_testbed.trials.trial import Trial


@pytest.fixture(scope="session")
def scene_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene as a trial, `scene`; nobody changes it."""
    return scene.write(tmp_path_factory.mktemp("scenes") / "scene")


@pytest.fixture(scope="module")
def by_hand() -> Iterator[None]:
    """The product's force map is the scene's, whose forces are known."""
    with pytest.MonkeyPatch.context() as patch:
        scene.stand_in(patch)
        yield


@pytest.fixture(scope="module")
def trial(scene_folder: Path, by_hand: None) -> Trial:
    """The scene opened by the product."""
    return Trial(scene_folder)


@dataclass(frozen=True)
class Report:
    """A report on the scene as its readers open it, and what it was written from."""

    page: Page
    files: Path  # the folder beside it
    results: Results
    progress: list[tuple[str, int, int]]  # task, steps done, and their number


@pytest.fixture(scope="module")
def report(trial: Trial, tmp_path_factory: pytest.TempPathFactory) -> Report:
    """The report on the scene: pressures over the whole trial, models of its first half."""
    path = tmp_path_factory.mktemp("report") / "scene.html"
    told: list[tuple[str, int, int]] = []
    with pytest.MonkeyPatch.context() as patch:
        results_by_hand.stand_in(patch)
        results = st.write_report(
            trial,
            path,
            "all",
            frames=results_by_hand.FRAMES,
            leave_out=("distal.Fx",),
            thetas=results_by_hand.THETAS,
            command="by hand",
            progress=lambda task: lambda done, total: told.append((task, done, total)),
        )
    files = path.with_name("scene_files")
    return Report(Page(path.read_text(encoding="utf-8")), files, results, told)
