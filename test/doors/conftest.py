"""The scene with known answers, as a trial on disk, with its forces known to the product."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from support import scene

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
