"""Files: YAML documents read key by key, files of the package, atomic outputs."""

from __future__ import annotations

import errno
import json
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
_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*)$")
_FLOAT = re.compile(
    r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?$|[-+]?[0-9]+[eE][-+]?[0-9]+$"
    r"|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$"
)


_LARGEST_DOCUMENT = 2**24  # [bytes]
_MOST_VALUES = 200_000  # of a YAML document, aliases counted as what they stand for
_LARGEST_INTEGER = 2**63  # of ROS, and of arrays
_SHOWN = 60  # [characters] of a value in an error
_DEEPEST = 50  # [levels]; the C parser of YAML overruns its stack at some ten thousand


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """YAML with 1e-3 as a number, and 1:30, 010 and 1_000 as none; a repeated key is an error."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """A value; whatever a value that is none leads to, the error names its line."""
        try:
            value = super().construct_object(node, deep)
            if isinstance(value, int) and abs(value) > _LARGEST_INTEGER:
                raise OverflowError
            return value
        except yaml.YAMLError:
            raise
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
            written = node.value if isinstance(node, yaml.ScalarNode) else "this"
            kind = node.tag.rpartition(":")[2]
            raise yaml.constructor.ConstructorError(
                None, None, f"'{_shown(written)}' is no {kind}", node.start_mark
            ) from None

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """A mapping, with every key once."""
        seen: set[str] = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(
                    None, None, "a key is not a word", key.start_mark
                )
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key '{_shown(key.value)}' is repeated", key.start_mark
                )
            seen.add(key.value)
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        if len({str(key) for key in mapping}) < len(seen - {"<<"}):  # 1 and +1, say
            raise yaml.constructor.ConstructorError(
                None, None, "two keys are the same", node.start_mark
            )
        return mapping


_NUMBERS = {"tag:yaml.org,2002:int": _INTEGER, "tag:yaml.org,2002:float": _FLOAT}
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in _NUMBERS]
    for first, resolvers in _Loader.yaml_implicit_resolvers.items()
}
for _tag, _pattern in _NUMBERS.items():
    _Loader.add_implicit_resolver(_tag, _pattern, list("-+.0123456789"))


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

    def texts(self, key: str) -> list[str]:
        """A list of strings."""
        value = self.take(key)
        if not isinstance(value, list):
            raise self._wrong(key, value, "a list of texts")
        entries = Section(dict(enumerate(value)), f"{self.where}: {key}")
        return [entries.text(name) for name in entries.names()]

    def integer(self, key: str, low: int = 0, high: int = 2**63) -> int:
        """A whole number within [low, high], with all its digits."""
        value = self.take(key)
        check_number(value, f"{self.where}: {key}", low, high)
        if not isinstance(value, int):
            raise self._wrong(key, value, "a whole number")
        return value

    def flag(self, key: str) -> bool:
        """True or false."""
        value = self.take(key)
        if not isinstance(value, bool):
            raise self._wrong(key, value, "true or false")
        return value

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
            written = np.array(value, dtype=object)
        except (OverflowError, TypeError, ValueError):
            raise self._wrong(key, value, f"numbers of shape {_shape(shape)}") from None
        if any(isinstance(entry, bool | str) for entry in written.flat):
            raise self._wrong(key, value, f"numbers of shape {_shape(shape)}")
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
    try:
        number = float(value)
    except OverflowError:  # an integer of hundreds of digits
        number = math.inf
    if not math.isfinite(number):
        raise ConfigurationError(f"{where} is {_shown(value)}", "give a finite number")
    if not low <= number <= high:
        raise ConfigurationError(
            f"{where} is {number:g}, outside [{low:g}, {high:g}]", "check the value and its unit"
        )
    return number


def read_document(path: Path) -> Section:
    """Read a YAML file as a mapping.

    Raises:
        ConfigurationError: If the file is missing, unreadable, not YAML or no mapping.
    """
    data = load_yaml(path)
    return Section({} if data is None else data, str(path))


def load_yaml(path: Path) -> Any:
    """Read a YAML file; what it takes of memory and time is bounded.

    Raises:
        ConfigurationError: If the file is missing, unreadable, not YAML, too large or too deep.
    """
    text = read_text(path)
    try:
        _refuse_bombs(text)
        return yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f" at line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "not YAML"
        raise ConfigurationError(f"{path}: {problem}{line}", "correct the YAML there") from None


def read_text(path: Path, kind: str = "a file") -> str:
    """Read a document of UTF-8 text.

    Args:
        path: The file.
        kind: What it is, for an error, such as `a model`.

    Raises:
        ConfigurationError: If the file is missing, unreadable, too large or no such text.
    """
    try:
        with path.open("rb") as stream:
            content = stream.read(_LARGEST_DOCUMENT + 1)
    except FileNotFoundError:
        missing = f"no such {kind.removeprefix('a ')}"
        raise ConfigurationError(f"{path}: {missing}", "check the path") from None
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})",
            "give a file that can be read",
        ) from None
    if len(content) > _LARGEST_DOCUMENT:
        raise ConfigurationError(
            f"{path}: is larger than {_LARGEST_DOCUMENT // 2**20} MiB", "check that it is this file"
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        what = "UTF-8 text" if kind == "a file" else f"{kind} (not UTF-8 text)"
        raise ConfigurationError(f"{path}: is not {what}", "save it as text in UTF-8") from None


def _refuse_bombs(text: str) -> None:
    """Refuse a YAML text that is deep, or whose aliases stand for themselves or for very much."""
    if re.search("^%TAG", text, re.MULTILINE):  # the C parser compares each with all before it
        raise yaml.MarkedYAMLError(None, None, "holds a directive %TAG", None)
    open_anchors: list[tuple[str | None, int]] = []
    sizes: dict[str | None, int] = {}  # [values] of what an anchor names, where that is complete
    values = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.AliasEvent):
            if event.anchor in dict(open_anchors):
                raise _refused("an alias stands for what it is in", event)
            values += sizes.get(event.anchor, 0)
        elif isinstance(event, yaml.ScalarEvent):
            values += 1
            sizes[event.anchor] = 1
        elif isinstance(event, yaml.CollectionStartEvent):
            open_anchors.append((event.anchor, values))
            values += 1
            if len(open_anchors) > _DEEPEST:
                raise _refused("lists or mappings are too deep", event)
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_anchors.pop()
            sizes[anchor] = values - before
        if values > _MOST_VALUES:
            raise _refused(f"holds more than {_MOST_VALUES} values", event)


def _refused(problem: str, event: yaml.Event) -> yaml.MarkedYAMLError:
    mark: Any = event.start_mark
    return yaml.MarkedYAMLError(None, None, problem, mark)


def load_json(path: Path, kind: str) -> Any:
    """Read a JSON file; every number in it is finite.

    Args:
        path: The file.
        kind: What it is, for an error, such as `a model`.

    Raises:
        ConfigurationError: If the file is missing, unreadable, not JSON, too large or too deep.
    """
    text = read_text(path, kind)
    try:
        return json.loads(text, parse_float=decimal, parse_constant=decimal)
    except (RecursionError, ValueError) as error:
        problem = str(error) if isinstance(error, json.JSONDecodeError) else "not JSON"
        raise ConfigurationError(f"{path}: is not {kind} ({problem})", "make it again") from None


_DECIMAL = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", flags=re.ASCII)


def decimal(text: str) -> float:
    """A finite number from its decimal digits; not from nan, 1_000 or the digits of other scripts.

    Raises:
        ValueError: If the text is no such number.
    """
    number = float(text) if _DECIMAL.fullmatch(text) else math.nan
    if not math.isfinite(number):
        raise ValueError(f"'{_shown(text)}' is no number")
    return number


def _kind(value: Any) -> str:
    if value is None:
        return "empty"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list):
        return "a list"
    return f"'{_shown(value)}'"


def _shown(value: Any) -> str:
    """A value of a file as an error shows it."""
    text = str(value)
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "..."


def _shape(shape: tuple[int, ...]) -> str:
    return "x".join(str(size) for size in shape) or "one number"
