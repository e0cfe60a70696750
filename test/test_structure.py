"""The structure that CONTRIBUTING promises, read from the imports."""

import ast
import re
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path
from pkgutil import resolve_name

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]
PACKAGE, DOCS = CHECKOUT / "socket_testbed", CHECKOUT / "docs"
FILES = sorted(PACKAGE.rglob("*.py"))

# From the ground up: a module imports from its own layer or from those below it.
LAYERS = (
    ("arrays", "errors", "clocks", "rotations", "version"),
    ("cells", "documents", "files", "samples", "tables"),
    ("settings", "geometry"),
    ("alignment", "drivers", "calibration", "identification", "socket_design", "wire"),
    ("trials",),
    ("figures",),
    ("results",),
    ("pages",),
    ("batch", "simulation", "report"),
    ("live",),
    ("api",),
    ("nodes",),
    ("commands",),
    ("__main__",),
)
LAYER_OF = {name: level for level, names in enumerate(LAYERS) for name in names}
ROS = ("rclpy", "rcl_interfaces", "builtin_interfaces", "launch", "tf2_ros")


def top(module: str) -> str:
    """The file or folder of the package that a module is in."""
    return module.split(".")[1]


def imports(tree: ast.AST) -> set[str]:
    """Absolute names of the modules that a file imports, and of what it imports from them."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"a relative import: {ast.unparse(node)}"
            found |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


@pytest.fixture(scope="module")
def imported() -> dict[str, set[str]]:
    """What each module of the package imports, by the module's name."""
    return {
        ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): imports(
            ast.parse(path.read_text())
        )
        for path in FILES
    }


def test_imports_point_one_way(imported: dict[str, set[str]]) -> None:
    upward = [
        f"{own} imports {name}"
        for own, names in imported.items()
        for name in names
        if own != "socket_testbed.__init__"
        and name.startswith("socket_testbed.")
        and LAYER_OF[top(name)] > LAYER_OF[top(own)]
    ]
    assert not upward


def test_no_imports_go_round_in_a_circle(imported: dict[str, set[str]]) -> None:
    """Not even those inside a function, or for types alone."""
    TopologicalSorter({own: names & set(imported) for own, names in imported.items()}).prepare()


def test_only_nodes_import_ros(imported: dict[str, set[str]]) -> None:
    for own, names in imported.items():
        packages = {name.split(".")[0] for name in names}
        ros = [name for name in packages if name in ROS or name.endswith(("_msgs", "_srvs"))]
        assert not ros or top(own) == "nodes", (own, ros)


def test_the_api_defines_no_result() -> None:
    """Pages and reports, which the API imports, show results: these lie below all three."""
    for path in (PACKAGE / "api").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            bases = node.bases if isinstance(node, ast.ClassDef) else []
            assert "Result" not in map(ast.unparse, bases), (path, node)


@pytest.mark.parametrize("folder", ["benchmarks", "examples", "launch"])
def test_what_programs_outside_the_package_import_is_there(folder: str) -> None:
    for path in (PACKAGE.parent / folder).glob("*.py"):
        for name in imports(ast.parse(path.read_text())):
            assert not name.startswith("socket_testbed.") or resolve_name(name), path


BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
PAGES = ("README.md", "CONTRIBUTING.md", *(f"docs/{each.name}" for each in DOCS.glob("*.md")))


@pytest.mark.parametrize("page", PAGES)
def test_programs_in_the_documents_are_formatted(page: str) -> None:
    for program in BLOCK.findall((CHECKOUT / page).read_text(encoding="utf-8")):
        words = [sys.executable, "-m", "ruff", "format", "--diff", "-"]
        done = subprocess.run(words, check=False, input=program, text=True, capture_output=True)
        assert done.returncode == 0, done.stdout
