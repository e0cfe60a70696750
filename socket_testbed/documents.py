"""Documents: YAML and JSON files, checked against types that declare their fields."""

from __future__ import annotations

import codecs
import math
import os
import re
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import count, repeat
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeAlias, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
import yaml
from msgspec import Meta, inspect

from socket_testbed.errors import ConfigurationError, closest

T = TypeVar("T")
Text: TypeAlias = str | int | float  # YAML parses a name such as 12 as a number
FINITE = sys.float_info.max

_MAX_SIZE = 2**24  # [bytes]
_MAX_VALUES = 200_000  # in a YAML document, aliases counted with their content
_MAX_DEPTH = 50  # [levels]; the C parser overflows its stack at about ten thousand
_MAX_SHOWN = 60  # [characters] of a value in an error


class Document(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """A mapping in a document; its fields declare names, types and ranges."""


class FieldError(ValueError):
    """A fact and a hint, raised in a `Document`'s `__post_init__`; `convert` adds the place."""


def read_document(path: Path, kind: type[T]) -> T:
    """Read a YAML file; an empty one is an empty mapping.

    Args:
        path: The file, UTF-8 text of 16 MiB at most.
        kind: The type of the content, such as a subclass of `Document`.

    Raises:
        ConfigurationError: If the file cannot be read, is not YAML, or does not have the type.
    """
    data = load_yaml(path)
    return convert({} if data is None else data, kind, str(path))


def convert(data: Any, kind: type[T], where: str = "", strict: bool = True) -> T:
    """Validate data against a `Document` or any other type that msgspec supports.

    Args:
        data: The data, as of a YAML or JSON document: mappings, lists, texts, numbers, None.
        kind: The type that it must have.
        where: How errors name the data, such as a file and a field.
        strict: Whether a text such as `1e-8` is refused where a number is declared.

    Raises:
        ConfigurationError: If the data does not have the type; it names the innermost wrong part.
    """
    try:
        return msgspec.convert(data, kind, strict=strict)
    except msgspec.ValidationError as error:
        raise _explain(error, data, kind, where, strict) from None


def check_number(value: Any, where: str, low: float = -FINITE, high: float = FINITE) -> float:
    """A finite number within [low, high]; integers are accepted.

    Args:
        value: The value, as a user gave it; NumPy scalars are numbers.
        where: How errors name the value, such as `--duration`.
        low: The least value allowed, in the value's unit.
        high: The largest value allowed, in the value's unit.

    Raises:
        ConfigurationError: If the value is no number or is not within the limits.
    """
    kind: Any = Annotated[float, Meta(ge=low, le=high)]
    return float(convert(plain(value), kind, where))


def check_whole(value: Any, where: str, low: int = 0, high: int = sys.maxsize) -> int:
    """A whole number within [low, high].

    Args:
        value: The value, as a user gave it; NumPy scalars are numbers.
        where: How errors name the value, such as `--seed`.
        low: The least value allowed.
        high: The largest value allowed.

    Raises:
        ConfigurationError: If the value is no whole number or is not within the limits.
    """
    wrong = f"{where} is {shown(plain(value))}", f"give {_number_within(True, low, high)}"
    try:
        number = check_number(value, where)
    except ConfigurationError:
        raise ConfigurationError(*wrong) from None
    if not number.is_integer() or not low <= number <= high:
        raise ConfigurationError(*wrong)
    return int(number)


def path_of(value: object, what: str) -> Path:
    """The path that a user gave.

    Args:
        value: A text or a path.
        what: What it is the path of, for the error, such as `the trial`.

    Raises:
        ConfigurationError: If it is neither, or an empty text.
    """
    if isinstance(value, str | os.PathLike) and str(value):
        return Path(value)
    raise ConfigurationError(f"{what} is {described(value)}", "give a path, as a text or a Path")


def texts_of(value: object, what: str) -> list[str]:
    """The texts that a user gave: several, or a single one.

    Args:
        value: A text, or several of them.
        what: What they are, for the error, such as `remove`.

    Raises:
        ConfigurationError: If it is anything else.
    """
    if isinstance(value, str):
        return [value]
    listed: list[Any] = [*value] if isinstance(value, Iterable) else [value]
    for each in listed:
        if not isinstance(each, str):
            raise ConfigurationError(f"{what} holds {described(each)}", "give texts")
    return listed


def mapping_of(value: object, what: str, hint: str) -> Mapping[Any, Any]:
    """The mapping that a user gave.

    Args:
        value: The mapping.
        what: What it is, for the error, such as `regions`.
        hint: An example of one.

    Raises:
        ConfigurationError: If it is none.
    """
    if isinstance(value, Mapping):
        return value
    raise ConfigurationError(f"{what} is {described(value)}, not a mapping", hint)


def check_kind(value: object, kinds: type | tuple[type, ...], what: str, hint: str) -> None:
    """Refuse a value of another kind than expected.

    Args:
        value: The value, as a user gave it.
        kinds: The kinds that it may have.
        what: What it is, for the error, such as `the settings`.
        hint: What to give instead.

    Raises:
        ConfigurationError: If it is of another kind.
    """
    if not isinstance(value, kinds):
        raise ConfigurationError(f"{what} is {described(value)}", hint)


def described(value: object) -> str:
    """A value of a call in words for an error: a number or text itself, else its kind."""
    if isinstance(value, str):
        return shown(value) if value else "an empty text"
    if value is None or isinstance(value, bool | int | float):
        return str(value)
    if isinstance(value, list | tuple):
        return f"a {type(value).__name__} of {len(value)}"
    return f"of the kind {type(value).__name__}"


def refuse_unknown(keys: Iterable[str], known: Collection[str], where: str) -> None:
    """Refuse unknown keys.

    Args:
        keys: The keys of a mapping.
        known: The keys that it may have.
        where: How errors name the mapping, such as a file and a field.

    Raises:
        ConfigurationError: If a key is unknown; its hint is a similar known key, or all of them.
    """
    for key in keys:
        if key not in known:
            raise ConfigurationError(f"{where}: unknown key '{key}'", closest(key, known))


def plain(value: Any) -> Any:
    """A value with NumPy scalars and arrays, and tuples, as Python numbers and lists."""
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return value.tolist() if hasattr(value, "tolist") else value


# --- errors


def _explain(
    error: msgspec.ValidationError, data: Any, kind: Any, where: str, strict: bool
) -> ConfigurationError:
    """An error for the user: the innermost invalid part, and a hint from its type."""
    for step, value, own in _parts(data, kind):
        try:
            msgspec.convert(value, own, strict=strict)
        except msgspec.ValidationError as inner:
            named = f"{where}[{step}]" if isinstance(step, int) else f"{where}: {step}".lstrip(": ")
            return _explain(inner, value, own, named, strict)
    if isinstance(error.__cause__, FieldError):
        fact, hint = error.__cause__.args
        return ConfigurationError(f"{where}: {fact}", hint)
    for fields in filter(None, map(_fields, _alternatives(kind) if isinstance(data, dict) else ())):
        refuse_unknown(data, [field.name for field in fields], where)
        for field in fields:
            if field.required and field.name not in data:
                return ConfigurationError(
                    f"{where}: '{field.name}' is missing", f"add '{field.name}: ...'"
                )
    return ConfigurationError(f"{where} is {shown(data)}", _hint(inspect.type_info(kind), data))


def _parts(data: Any, kind: Any) -> list[tuple[str | int, Any, Any]]:
    """The entries or items of the data, each with its declared type."""
    for each in _alternatives(kind):
        origin, types = get_origin(each), get_args(each)
        if isinstance(data, dict) and origin is dict:
            return [(key, value, types[1]) for key, value in data.items()]
        if isinstance(data, dict) and _fields(each):
            hints = get_type_hints(each, include_extras=True)
            return [(key, value, hints[key]) for key, value in data.items() if key in hints]
        if isinstance(data, list | tuple) and origin in (list, tuple):
            own = repeat(types[0]) if origin is list or types[-1] is ... else types
            return [*zip(count(), data, own, strict=False)]
    return []


def _alternatives(kind: Any) -> list[Any]:
    """The members of a union, without their constraints."""
    if get_origin(kind) is Annotated:
        return _alternatives(get_args(kind)[0])
    if get_origin(kind) in (Union, UnionType):
        return [each for one in get_args(kind) for each in _alternatives(one)]
    return [kind]


def _fields(kind: Any) -> Sequence[inspect.Field]:
    """The fields of a document or dataclass; empty for other types."""
    return getattr(inspect.type_info(kind), "fields", ())


_NUMBER_TYPES = (inspect.FloatType, inspect.IntType)


def _hint(expected: Any, value: Any) -> str:
    """The hint for a wrong value: its expected type."""
    if isinstance(expected, inspect.Metadata):
        about = (expected.extra_json_schema or {}).get("description", "")
        return f"{_hint(expected.type, value)}: {about}"
    if isinstance(expected, inspect.LiteralType):
        return closest(str(value), [str(each) for each in expected.values])
    types = getattr(expected, "types", (expected,))
    if any(isinstance(each, inspect.StrType) for each in types):  # a `Text`
        types = [each for each in types if not isinstance(each, _NUMBER_TYPES)]
    return f"give {' or '.join(filter(None, map(_type_name, types)))}"


def _type_name(expected: Any) -> str:
    """The name of a type in a hint."""
    if isinstance(expected, _NUMBER_TYPES):
        return _number_within(isinstance(expected, inspect.IntType), expected.ge, expected.le)
    if isinstance(expected, inspect.LiteralType):
        return " or ".join(map(str, expected.values))
    if isinstance(expected, inspect.TupleType):
        below = expected.item_types[0]
        inner = f" lists of {len(below.item_types)}" if isinstance(below, type(expected)) else ""
        return f"a list of {len(expected.item_types)}{inner}"
    if high := getattr(expected, "max_length", None):
        low = expected.min_length
        return f"a list of {high}" if low == high else f"a list of {low} to {high}"
    return _TYPE_NAMES.get(type(expected), "'key: value' lines")


def _number_within(whole: bool, low: float | None, high: float | None) -> str:
    """A number in a hint, with those of its limits that are not merely the largest of their type.

    Args:
        whole: Whether it is a whole number.
        low: The least value allowed; None for any.
        high: The largest value allowed; None for any.
    """
    largest = sys.maxsize if whole else FINITE
    has_low = low is not None and low > -largest
    has_high = high is not None and high < largest
    if has_low and has_high:
        return f"a {'whole ' * whole}number from {low:g} to {high:g}"
    if not has_low and not has_high:
        return f"a {'whole ' * whole}number that is finite"
    limit = f"at least {low:g}" if has_low else f"at most {high:g}"
    return f"a {'whole' if whole else 'finite'} number of {limit}"


_TYPE_NAMES: dict[Any, str] = {
    inspect.StrType: "a text, in quotes",
    inspect.BoolType: "true or false",
    inspect.DateTimeType: "a date and time with its zone",
    inspect.ListType: "a list",
    inspect.VarTupleType: "a list",
    inspect.NoneType: "",
}


def shown(value: Any) -> str:
    """A value from a file as shown in an error, of 60 characters at most."""
    if value is None:
        return "empty"
    if isinstance(value, dict):
        return "a mapping" if value else "an empty mapping"
    if isinstance(value, list | tuple):
        return f"a list of {len(value)}"
    text = str(value)
    text = text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."
    return f"'{text}'" if isinstance(value, str) else text


# --- YAML


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """YAML with numbers as in YAML 1.2 and no dates; keys are unique strings."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[str, Any]:
        """A mapping."""
        mapping: dict[str, Any] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise _fault("a key is not a word", key)
            if key.value in mapping:
                raise _fault(f"the key {shown(key.value)} is repeated", key)
            mapping[key.value] = self.construct_object(value, deep=True)
        return mapping


_Loader.yaml_implicit_resolvers = {
    first: [each for each in resolvers if each[0].rpartition(":")[2] in {"bool", "null"}]
    for first, resolvers in _Loader.yaml_implicit_resolvers.items()
}
for _kind, _pattern in {
    "int": r"[-+]?(0|[1-9][0-9]{0,18})$",  # 1:30, 010 and 1_000 are texts
    "float": r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?$|[-+]?[0-9]+[eE][-+]?[0-9]+$"
    r"|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$",
}.items():
    _tag = f"tag:yaml.org,2002:{_kind}"
    _Loader.add_implicit_resolver(_tag, re.compile(_pattern), list("-+.0123456789"))


class _Dumper(yaml.SafeDumper):
    """Quotes the texts that the loader above would read as numbers, such as 2e1."""


_Dumper.yaml_implicit_resolvers = {
    first: [*_Loader.yaml_implicit_resolvers.get(first, ()), *resolvers]
    for first, resolvers in yaml.SafeDumper.yaml_implicit_resolvers.items()
}


def dump_yaml(document: Any, **options: Any) -> str:
    """The YAML text of a document, in its order; options as in `yaml.dump`."""
    return str(yaml.dump(document, Dumper=_Dumper, sort_keys=False, **options))


def load_yaml(path: Path) -> Any:
    """Read a YAML file within bounded memory and time; None for an empty one.

    Keys are unique texts. As in YAML 1.2, `1:30`, `010` and a date are texts.

    Raises:
        ConfigurationError: If the file cannot be read or is not YAML, is nested too deep, has
            tags, or expands to more than 200 000 values.
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


def _refuse_bombs(text: str) -> None:
    """Refuse YAML that is nested too deep, has tags, or expands too far through aliases."""
    if re.search("^%TAG", text, re.MULTILINE):  # the C parser takes quadratic time on these
        raise yaml.MarkedYAMLError(None, None, "holds a directive %TAG", None)
    above: list[tuple[str | None, int]] = []  # anchor, values before it
    sizes: dict[str | None, int] = {}  # [values] by anchor
    values = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.CollectionEndEvent):
            anchor, before = above.pop()
            sizes[anchor] = values - before
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise _fault("an alias stands for nothing before it", event)
            values += sizes[event.anchor]
        elif isinstance(event, yaml.NodeEvent):
            if event.tag is not None:  # type: ignore[attr-defined]
                raise _fault("tags are not supported", event)
            if isinstance(event, yaml.CollectionStartEvent):
                above.append((event.anchor, values))
            else:
                sizes[event.anchor] = 1
            values += 1
        if len(above) > _MAX_DEPTH:
            raise _fault("lists or mappings are too deep", event)
        if values > _MAX_VALUES:
            raise _fault(f"holds more than {_MAX_VALUES} values", event)


def _fault(problem: str, place: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(None, None, problem, place.start_mark)


# --- JSON and text

LFS_POINTER = b"version https://git-lfs"  # the start of what Git leaves of a file not fetched
IS_LFS_POINTER = "is a Git LFS pointer, not the file itself"
GET_LFS = "fetch the content with 'git lfs pull'"
# Starts of files that people give in place of another file: what they are, and what to do.
_OTHER_FILES = {
    LFS_POINTER: (IS_LFS_POINTER, GET_LFS),
    b"\x1f\x8b\x08": ("is compressed with gzip", "unpack it with 'gunzip'"),
    b"\xfd7zXZ\0": ("is compressed with xz", "unpack it with 'unxz'"),
    b"\x04\x22\x4d\x18": ("is compressed with lz4", "unpack it with 'unlz4'"),
    b"7z\xbc\xaf\x27\x1c": ("is a 7z archive", "unpack it"),
    b"Rar!\x1a\x07": ("is a RAR archive", "unpack it"),
    b"PK\x03\x04": ("is a ZIP archive", "unpack it"),
    b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1": (
        "is a workbook or document of an Office program",
        "save a table as CSV, anything else as text",
    ),
    b"%PDF-": ("is a PDF document", "give the file that it was made from"),
}
_WORKBOOK = "is a workbook of a spreadsheet program", "save its table as CSV"
_WORKBOOK_PARTS = (b"[Content_Types].xml", b"opendocument.spreadsheet", b"xl/")
_BZIP2 = re.compile(rb"BZh\d1AY&SY")
_TAR = re.compile(rb".{257}ustar", re.DOTALL)
OTHER_FILE_START = 512  # [bytes]; what `other_file` looks at


def other_file(start: bytes) -> tuple[str, str] | None:
    """What a file is that holds something else than text or measurements, such as an archive.

    Args:
        start: The first bytes of the file, `OTHER_FILE_START` of them if it has as many.

    Returns:
        What it is, such as `is a ZIP archive`, and what to do; None for any other file.
    """
    if start.startswith(b"PK\x03\x04") and any(part in start for part in _WORKBOOK_PARTS):
        return _WORKBOOK
    if _BZIP2.match(start):
        return "is compressed with bzip2", "unpack it with 'bunzip2'"
    if _TAR.match(start):
        return "is a tar archive", "unpack it with 'tar -xf'"
    found = (known for begin, known in _OTHER_FILES.items() if start.startswith(begin))
    return next(found, None)


def load_json(path: Path, kind: str, again: str = "make it again") -> Any:
    """Read a JSON file with finite numbers.

    Args:
        path: The file, UTF-8 text of 16 MiB at most.
        kind: How errors call the file, with its article, such as `a model`.
        again: What to do if it is not JSON.

    Raises:
        ConfigurationError: If the file cannot be read, or is not JSON.
    """
    try:
        return msgspec.json.decode(read_text(path, kind))
    except (RecursionError, msgspec.DecodeError) as error:
        raise ConfigurationError(f"{path}: is not {kind} ({error})", again) from None


def read_text(
    path: Path,
    kind: str = "a file",
    largest: int = _MAX_SIZE,
    codes: Sequence[str] = ("utf-8-sig",),
) -> str:
    """Read text of limited size, usually in UTF-8; a byte-order mark is left out.

    Args:
        path: The file.
        kind: How errors call the file, with its article, such as `a model`.
        largest: The largest size allowed [bytes].
        codes: Encodings that it may have, of which the first that fits counts; UTF-16 only with
            its byte-order mark.

    Raises:
        ConfigurationError: If the file is missing, unreadable or too large, is not UTF-8, or is
            something else that is known, such as a Git LFS pointer, an archive or a workbook.
    """
    try:
        with path.open("rb") as stream:
            content = stream.read(largest + 1)
        if other := other_file(content[:OTHER_FILE_START]):
            raise ConfigurationError(f"{path}: {other[0]}", other[1])
        if len(content) > largest:
            raise ValueError(f"larger than {largest // 2**20} MiB")
        return _decoded(content, codes)
    except FileNotFoundError:
        fact, hint = f"no such {kind.removeprefix('a ')}", "check the path"
    except UnicodeDecodeError:
        what = "UTF-8 text" if kind == "a file" else f"{kind} (not UTF-8 text)"
        fact, hint = f"is not {what}", "save it as text in UTF-8"
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        fact, hint = f"cannot be read ({reason})", f"check that it is {kind}"
    raise ConfigurationError(f"{path}: {fact}", hint)


def _decoded(content: bytes, codes: Sequence[str]) -> str:
    """Text in the first encoding that fits."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) and "utf-16" in codes:
        return content.decode("utf-16")
    *others, last = [code for code in codes if code != "utf-16"]
    for code in others:
        with suppress(UnicodeDecodeError):
            return content.decode(code)
    return content.decode(last)


_STATED_SEPARATOR = re.compile(r'\s*"?sep=(.)"?[;,\t ]*(?:\r\n|\r|\n|$)', flags=re.IGNORECASE)
SEPARATORS = ",;\t"
"""Separators of the columns of a table of text, the usual one first."""


def split_separator(text: str) -> tuple[str, str]:
    """The separator of a table's columns, and the text without the line that states it.

    Spreadsheet programs state it as `sep=;` in the first line, which is left blank, so that the
    numbers of the lines stay. If none is stated, or the next line does not have it, it is the one
    of `SEPARATORS` that is most frequent in the first line that is not blank.

    Args:
        text: The table, such as the content of a CSV file.
    """
    stated = _STATED_SEPARATOR.match(text)
    if stated:
        text = re.sub(r"[^\r\n]", "", stated[0]) + text[stated.end() :]
    first = re.split(r"[\r\n]", text.lstrip(), maxsplit=1)[0]
    if stated and stated[1] in first:
        return stated[1], text
    return max(SEPARATORS, key=first.count), text


_DECIMAL = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", flags=re.ASCII)


def decimal(text: str) -> float:
    """A finite number from decimal digits, such as `-1.5e3`.

    Raises:
        ValueError: If the text is anything else, such as `nan`, `1_000` or ` 1`.
    """
    number = float(text) if _DECIMAL.fullmatch(text) else float("nan")
    if not abs(number) <= FINITE:
        raise ValueError(f"{shown(text)} is not a number")
    return number


def finite_or_null(value: Any) -> Any:
    """A value for JSON: NaN and infinity become None, and tuples lists, in which they do too."""
    if isinstance(value, tuple):
        return [*map(finite_or_null, value)]
    return None if isinstance(value, float) and not math.isfinite(value) else value
