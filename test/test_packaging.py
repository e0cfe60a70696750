"""The same sources as a colcon workspace, and as an installed package."""

import os
import re
import shutil
import sys
from importlib.metadata import distributions
from pathlib import Path

import pytest
from catkin_pkg.package import parse_package
from support.verbs import program

from socket_testbed import __version__

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
PATH = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
PACKAGES = ("socket_testbed", "socket_testbed_msgs")
SOURCES = (
    *("config", "launch", "msg_defs", "requirements", "resource", "socket_testbed", "test"),
    *("LICENSE", "colcon_defaults.yaml", "package.xml", "pyproject.toml", "setup.cfg", "setup.py"),
)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sources alone, as a clone has them."""
    folder = tmp_path_factory.mktemp("workspace")
    for name in SOURCES:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, folder / name)
    return folder


def call(workspace: Path, *words: str, **environment: str) -> str:
    prefixes = ("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH")
    variables = {name: os.environ.get(name, sys.prefix) for name in prefixes}
    variables |= {"PATH": PATH, **environment}
    code, out, err = program(*words, folder=workspace, **variables)
    assert code == 0, out + err
    return out + err


@pytest.mark.parametrize("folder", [".", "msg_defs"], ids=PACKAGES)
def test_a_package_is_described_as_ros_wants_it(folder: str) -> None:
    """In the place of xmllint, which fetches the schema: the reader of ROS checks the same."""
    warnings: list[str] = []
    package = parse_package(ROOT / folder / "package.xml", warnings=warnings)
    assert package.package_format == 3 and package.version == __version__ and not warnings
    assert package.urls and package.authors and package.licenses == ["Apache-2.0"]


@pytest.mark.parametrize(
    ("part", "more"),
    [("socket_testbed", []), ("socket_testbed/commands", ["D417"])],
    ids=["package", "commands"],
)
def test_docstrings_satisfy_ament(
    part: str, more: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """In the convention of Google, as ruff checks them; a verb describes only its own options."""
    pep257 = pytest.importorskip("ament_pep257.main")
    ignored = ["D105", "D107", "D205", "D401", *more]
    exclude = [] if more else [str(path) for path in (ROOT / part / "commands").glob("*.py")]
    words = ["--convention", "google", "--add-ignore", *ignored, "--exclude", *exclude]
    code = pep257.main([*words, "--", str(ROOT / part)])
    assert code == 0, capsys.readouterr()


@pytest.mark.skipif(not shutil.which("colcon", path=PATH), reason="colcon is missing")
def test_a_colcon_build_works_anywhere(workspace, tmp_path) -> None:
    call(workspace, "colcon", "build")
    # On a ROS installation our stand-in for tf2_msgs would hide the distribution's package.
    assert {path.name for path in (workspace / "install").iterdir() if path.is_dir()} == {*PACKAGES}
    prefix = workspace / "install" / "socket_testbed"
    programs = {path.name for path in (prefix / "lib" / "socket_testbed").iterdir()}
    assert {"estimator_node", "calibration_node", "replay_node", "recorder_node"} <= programs
    share = prefix / "share" / "socket_testbed"
    files = {"socket.yaml", "calibration.yaml", "testbed.rviz", "loopback.xml"}
    assert files <= {path.name for path in (share / "config").iterdir()}
    assert (share / "launch" / "replay.launch.py").is_file()

    # Away from the sources, the installed package finds its own files and messages.
    paths = [next((workspace / "install" / name).rglob("site-packages")) for name in PACKAGES]
    node = (prefix / "lib/socket_testbed/estimator_node").read_text()
    assert node.startswith("#!/usr/bin/env python3\n")  # in the active environment, not colcon's
    script = (
        "import sys, socket_testbed, socket_testbed_msgs.msg as m;"
        "print(socket_testbed.__file__, m.__file__);"
        "from socket_testbed.__main__ import run;"
        "sys.exit(run(['simulate', '-o', 'trial', '--duration', '10']))"
    )
    out = call(tmp_path, sys.executable, "-c", script, PYTHONPATH=":".join(map(str, paths)))
    assert all(str(path) in out for path in paths)
    assert (tmp_path / "trial" / "trial.mcap").is_file()


def test_a_wheel_holds_what_offline_verbs_need(workspace: Path, tmp_path: Path) -> None:
    """They work without ROS, which the graph asks for."""
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")
    build = ("--no-deps", "--no-build-isolation", "--no-index")
    call(workspace, *pip, "wheel", *build, "--wheel-dir", str(tmp_path), ".")
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name.startswith(f"socket_testbed-{__version__}-")
    site = tmp_path / "site"
    quick = ("--no-deps", "--no-index", "--no-compile")
    call(tmp_path, *pip, "install", *quick, "--target", str(site), str(wheel))
    (installed,) = distributions(name="socket_testbed", path=[str(site)])
    needed = {re.split(r"[^A-Za-z0-9]", line)[0] for line in installed.requires or ()}
    assert {"numpy", "qpsolvers", "rosbags", "matplotlib", "pandas"} <= needed
    script = (
        "import sys, socket_testbed;"
        "ros = ('rclpy', 'socket_testbed_msgs', 'geometry_msgs', 'std_msgs');"
        "sys.modules |= dict.fromkeys(ros);"  # they cannot be imported
        "print(socket_testbed.__file__);"
        "from socket_testbed.__main__ import run;"
        "failed = any([run(words.split()) for words in sys.argv[1:]]);"
        "sys.exit(failed or run(['replay', 'hold']) != 1)"
    )
    verbs = (
        "simulate -o hold --duration 40",
        "info hold",
        "fit hold -o hold.json",
        "evaluate hold --model hold.json",
        "report hold -o hold.html --thetas 3",
        "export hold -o hold.csv",
    )
    out = call(tmp_path, sys.executable, "-c", script, *verbs, PYTHONPATH=str(site))
    assert str(site) in out and "mean moment RMSE" in out
    assert "rclpy cannot be imported: run 'make setup'" in out
    assert (tmp_path / "hold.html").stat().st_size > 10_000
