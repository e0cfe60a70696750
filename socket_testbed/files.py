"""Files: YAML documents read key by key, files of the package, atomic outputs."""

from __future__ import annotations

import errno
import math
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from socket_testbed.arrays import FloatArray
from socket_testbed.errors import ConfigurationError, likely


def packaged(folder: str, name: str) -> Path:
    """Path of a file that comes with the package: in the checkout, or where it was installed.

    Args:
        folder: `config` or `msg`.
        name: Name of the file.
    """
    here = Path(__file__).resolve()
    in_checkout = {"msg": "msg_defs/msg"}.get(folder, folder)
    candidates = [here.parents[1] / in_checkout / name]
    candidates += [parent / "share" / "socket_testbed" / folder / name for parent in here.parents]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise ConfigurationError(
        f"{folder}/{name} of the package is not installed", "install the package again"
    )


def refuse_existing(path: Path) -> None:
    """Refuse to write over something.

    Raises:
        ConfigurationError: If the path exists.
    """
    if path.exists():
        raise ConfigurationError(f"{path} exists already", "name another output or remove it")


def check_outputs(*paths: Path | None, replace: bool) -> None:
    """Refuse output files before any work: none replaces a file unless that is asked for.

    Args:
        paths: The files; None for one that is not wanted.
        replace: Whether files that exist are replaced.

    Raises:
        ConfigurationError: If one is a folder, exists, or lies in a folder that does not exist.
    """
    for path in filter(None, paths):
        if path.is_dir():
            raise ConfigurationError(
                f"{path} exists already as a folder", "name a file for the output"
            )
        if path.exists() and not replace:
            raise ConfigurationError(
                f"{path} exists already", "name another output, or replace it with --replace"
            )
        _require_parent(path)


def check_new_folder(path: Path) -> None:
    """Refuse a folder that exists, or that lies more than one folder below what exists.

    Raises:
        ConfigurationError: In these cases.
    """
    refuse_existing(path)
    if not path.parent.exists():
        _require_parent(path.parent)


def make_folder(path: Path) -> None:
    """Make a folder, and those above it, unless it exists.

    Raises:
        ConfigurationError: If it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"{path}: cannot be made ({error.strerror})", "name another folder"
        ) from None


def _require_parent(path: Path) -> None:
    """Refuse a path in a folder that does not exist: it may be mistyped."""
    parent = path.parent
    if not parent.is_dir():
        why = f"{parent} is not a folder" if parent.exists() else f"no such folder as {parent}"
        raise ConfigurationError(
            f"{path}: cannot be written ({why})", "correct the path, or make the folder first"
        )


def check_picture(path: Path) -> None:
    """Refuse a file whose suffix names no format of a picture.

    Raises:
        ConfigurationError: If it is neither `.png` nor `.pdf`.
    """
    if path.suffix.lower() not in _PICTURES:
        raise ConfigurationError(
            f"{path}: a picture cannot be a '{path.suffix}' file", "name a .png or .pdf file"
        )


@contextmanager
def atomic_output(path: Path, replace: bool = False) -> Iterator[Path]:
    """Write an output in a folder beside it; it gets its name only when it is complete.

    A file replaces an older one; a folder must not exist yet, unless it is to be replaced. Several
    processes may write the same output: each writes in a folder of its own, and the last one to
    finish wins, of folders the first unless they are replaced. What a killed process left is
    removed by the next one.

    Args:
        path: The output, a file or a folder.
        replace: Whether an older folder is replaced.

    Yields:
        The path to write to, with the same last part, in a folder that did not exist.

    Raises:
        ConfigurationError: If the output cannot be written, or its folder does not exist.
    """
    path = path.resolve()  # a link stays a link
    _require_parent(path)
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ConfigurationError(f"{path} is not an ordinary file", "name a file for the output")
    staging = None
    try:
        _remove_leftovers(path)
        prefix = f"{_staging_prefix(path)}{os.getpid()}."
        staging = Path(tempfile.mkdtemp(_PARTIAL, prefix, path.parent))
        yield staging / path.name
        _put(staging / path.name, path, replace)
    except OSError as error:
        raise ConfigurationError(
            f"{path}: cannot be written ({error.strerror or error})",
            "check the folder, its permissions and the space left",
        ) from None
    finally:
        if staging is not None:
            shutil.rmtree(staging, ignore_errors=True)


def _put(new: Path, path: Path, replace: bool) -> None:
    """Give an output its name; where a folder has it, that moves away first."""
    for number in count():
        try:
            new.replace(path)
            return
        except OSError as error:
            if error.errno not in {errno.ENOTEMPTY, errno.EEXIST}:
                raise
        if not replace:
            raise ConfigurationError(
                f"{path} exists already: another run wrote it meanwhile",
                "name another output or remove it",
            )
        with suppress(FileNotFoundError):  # another run moved it
            path.replace(new.with_name(f"older.{number}"))


_PARTIAL = ".partial"


def _staging_prefix(path: Path) -> str:
    """Start of the names of this machine's staging folders for an output; a process id follows."""
    return f".{path.name}.{platform.node()}-"


def _remove_leftovers(path: Path) -> None:
    """Remove the staging folders of processes of this machine that no longer run."""
    prefix = _staging_prefix(path)
    for entry in path.parent.iterdir():
        if entry.name.startswith(prefix) and entry.suffix == _PARTIAL:
            process = entry.name.removeprefix(prefix).partition(".")[0]
            if process.isdecimal() and not _runs(int(process)):
                shutil.rmtree(entry, ignore_errors=True)


def _runs(process: int) -> bool:
    """Whether a process of this machine runs; on Windows, where asking would end it, assumed."""
    if os.name == "nt":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is another user's
        pass
    return True


_PICTURES = (".png", ".pdf")
WIDTHS = (88, 180)  # [mm]; of a figure: a column of a paper, and its page
_FLOAT = re.compile(r"[-+]?(\.\d+|\d+(\.\d*)?)[eE][-+]?\d+$")


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """YAML as ROS reads it: 1e-3 is a number; a repeated key is an error."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """A mapping, with every key once."""
        seen: set[str] = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key '{key.value}' is repeated", key.start_mark
                )
            seen.add(key.value)
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping


_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789"))


def closest(word: str, known: Collection[str]) -> str:
    """A hint for an unknown word: the likely one, or the list of the known ones."""
    return likely(word, known) or "use one of " + (", ".join(sorted(known)) or "(none)")


class Section:
    """A mapping of a document whose fields are taken one by one.

    Args:
        data: The mapping.
        where: What names it in an error: the file and the field.

    Raises:
        ConfigurationError: If the data is no mapping, or, from any method, if a field is
            missing, unknown, or has a wrong type, shape or range.
    """

    def __init__(self, data: Any, where: str) -> None:
        if not isinstance(data, dict):
            raise ConfigurationError(
                f"{where}: a mapping is expected, not {_kind(data)}", "write 'key: value' lines"
            )
        self.where = where
        self._data = {str(key): value for key, value in data.items()}

    def expect(self, known: Collection[str]) -> Section:
        """Refuse every key that is not known."""
        for key in self._data:
            if key not in known:
                raise ConfigurationError(f"{self.where}: unknown key '{key}'", closest(key, known))
        return self

    def names(self) -> tuple[str, ...]:
        """The keys, in the order of the document."""
        return tuple(self._data)

    def take(self, key: str) -> Any:
        """The raw value of a required key."""
        if key not in self._data:
            raise ConfigurationError(f"{self.where}: '{key}' is missing", f"add '{key}: ...'")
        return self._data[key]

    def section(self, key: str) -> Section:
        """A mapping below this one."""
        return Section(self.take(key), f"{self.where}: {key}")

    def sections(self, key: str) -> Iterator[tuple[str, Section]]:
        """The mappings below a mapping of this one, with their names."""
        parent = self.section(key)
        for name in parent.names():
            yield name, parent.section(name)

    def text(self, key: str) -> str:
        """A string."""
        value = self.take(key)
        if not isinstance(value, str | int | float) or isinstance(value, bool):
            raise self._wrong(key, value, "a text")
        return str(value)

    def number(self, key: str, low: float = -math.inf, high: float = math.inf) -> float:
        """A finite number within [low, high]."""
        return check_number(self.take(key), f"{self.where}: {key}", low, high)

    def array(
        self,
        key: str,
        shape: tuple[int, ...],
        finite: bool = True,
        limit: float = math.inf,
    ) -> FloatArray:
        """An array of numbers of a given shape; null is NaN, where that is allowed."""
        value = self.take(key)
        try:
            array = np.array(value, dtype=float)
        except (TypeError, ValueError):
            raise self._wrong(key, value, f"numbers of shape {_shape(shape)}") from None
        if array.shape != shape:
            raise ConfigurationError(
                f"{self.where}: {key} has the shape {_shape(array.shape)}",
                f"give numbers of shape {_shape(shape)}",
            )
        if finite and not np.isfinite(array).all():
            raise ConfigurationError(
                f"{self.where}: {key} holds a value that is not finite", "give finite numbers"
            )
        if np.abs(array).max(initial=0.0) > limit:
            raise ConfigurationError(
                f"{self.where}: {key} holds {np.abs(array).max():g}, more than {limit:g}",
                "check the value and its unit",
            )
        return array

    def _wrong(self, key: str, value: Any, want: str) -> ConfigurationError:
        return ConfigurationError(f"{self.where}: {key} is {_kind(value)}", f"give {want} instead")


def check_number(value: Any, where: str, low: float = -math.inf, high: float = math.inf) -> float:
    """A finite number within [low, high]; whole numbers count as numbers.

    Raises:
        ConfigurationError: Otherwise, naming `where`.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigurationError(f"{where} is {_kind(value)}", "give a number instead")
    if not math.isfinite(value):
        raise ConfigurationError(f"{where} is {value}", "give a finite number")
    if not low <= value <= high:
        raise ConfigurationError(
            f"{where} is {value:g}, outside [{low:g}, {high:g}]", "check the value and its unit"
        )
    return float(value)


def read_document(path: Path) -> Section:
    """Read a YAML file as a mapping.

    Raises:
        ConfigurationError: If the file is missing, unreadable, not YAML or no mapping.
    """
    try:
        with path.open(encoding="utf-8") as stream:
            data = yaml.load(stream, Loader=_Loader)
            return Section({} if data is None else data, str(path))
    except FileNotFoundError:
        raise ConfigurationError(f"{path}: no such file", "check the path") from None
    except UnicodeDecodeError:
        raise ConfigurationError(f"{path}: is not UTF-8 text", "give a YAML file") from None
    except OSError as error:
        raise ConfigurationError(
            f"{path}: cannot be read ({error.strerror or error})", "give a file that can be read"
        ) from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" at line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "not YAML"
        raise ConfigurationError(f"{path}: {problem}{line}", "correct the YAML there") from None


def _kind(value: Any) -> str:
    if value is None:
        return "empty"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list):
        return "a list"
    return f"'{value}'"


def _shape(shape: tuple[int, ...]) -> str:
    return "x".join(str(size) for size in shape) or "one number"
