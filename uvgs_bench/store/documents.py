"""Strict reading of documents people write: TOML and YAML into frozen dataclasses, unknown keys refused by name."""

from __future__ import annotations

import difflib
import math
import os
import re
import tempfile
import tomllib
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, TypeVar, Union, get_args, get_origin, get_type_hints

from uvgs_bench.errors import ConfigError, UnreadableDocument, UvgsError

if TYPE_CHECKING:
    from pydantic import ValidationError

Document = TypeVar("Document")
SCHEMA_KEY = "schema"

_SCALARS: dict[object, str] = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}
_TYPE_NAME = re.compile(r"str|int|float|bool|\w+\[.*\]")
_INSTANCE = re.compile(r"a dictionary or an instance of \w+")


def read_toml(path: Path) -> dict[str, object]:
    """Read a TOML file.

    Args:
        path: The file.

    Returns:
        Its tables.

    Raises:
        UnreadableDocument: It is missing or unreadable.
        ConfigError: It is no TOML.
    """
    try:
        return tomllib.loads(read_text(path, "a TOML file"))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"not valid TOML: {error}", str(path)) from None


def read_text(path: Path, expected: str) -> str:
    """Read a whole UTF-8 file, with or without a byte order mark.

    Args:
        path: The file.
        expected: What it should be, for messages.

    Returns:
        Its text.

    Raises:
        UnreadableDocument: It is missing, a folder, not permitted, or not text.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise UnreadableDocument("no such file", str(path)) from None
    except IsADirectoryError:
        raise UnreadableDocument(f"is a folder, expected {expected}", str(path)) from None
    except UnicodeDecodeError:
        raise UnreadableDocument(f"is no text, expected {expected}", str(path)) from None
    except OSError as error:
        raise UnreadableDocument(f"cannot be read: {error.strerror or error}", str(path)) from None


def read_document(path: Path, kind: type[Document], schema: int = 1) -> Document:
    """Read a TOML file strictly into a dataclass whose field names are the file's keys.

    Args:
        path: The file.
        kind: A dataclass; nested dataclasses, lists, tuples and literals are followed.
        schema: The schema version this program understands; the file's ``schema`` key must equal it.

    Returns:
        The instance.

    Raises:
        UnreadableDocument: The file is missing or unreadable.
        ConfigError: Unknown or missing key, wrong type, or a value the class refuses. The message names file and
            dotted key and proposes the nearest known key.
    """
    data = read_toml(path)
    found = data.pop(SCHEMA_KEY, None)
    if found != schema:
        said = "is missing" if found is None else f"is {found!r}"
        raise ConfigError(f"{said}, expected {schema}", str(path), SCHEMA_KEY)
    return parse_document(data, kind, str(path))


def parse_document(data: object, kind: type[Document], path: str, prefix: str = "") -> Document:
    """Turn read tables strictly into a dataclass.

    Args:
        data: Tables as read.
        kind: The dataclass.
        path: The file, for messages.
        prefix: Dotted key of these tables within the file, for messages.

    Returns:
        The instance.

    Raises:
        ConfigError: As ``read_document``.
    """
    from pydantic import ConfigDict, TypeAdapter, ValidationError

    _check_keys_and_numbers(data, kind, path, prefix)
    config = None if is_dataclass(kind) else ConfigDict(strict=False)
    try:
        return TypeAdapter(kind, config=config).validate_python(data)
    except ValidationError as error:
        raise ConfigError(*_first_complaint(error, path, prefix)) from None
    except (ValueError, TypeError, UvgsError) as error:
        raise ConfigError(str(error), path, prefix) from None


def _first_complaint(error: ValidationError, path: str, prefix: str) -> tuple[str, str, str]:
    complaint = error.errors()[0]
    # Where several types are allowed, pydantic puts the type it tried into the location.
    place = [part for part in complaint["loc"] if isinstance(part, int) or not _TYPE_NAME.fullmatch(part)]
    is_short_list = complaint["type"] == "missing" and bool(place) and isinstance(place[-1], int)
    key = ".".join([prefix] * bool(prefix) + [str(part) for part in (place[:-1] if is_short_list else place)])
    if is_short_list:
        return f"the list has only {place[-1]} entries, that is too few", path, key
    if complaint["type"] == "missing":
        return "this key is required", path, key
    message = complaint["msg"].removeprefix("Value error, ").removeprefix("Assertion failed, ")
    for theirs, ours in (("a valid tuple", "a list"), ("a valid list", "a list"), ("a valid dictionary", "a table")):
        message = message.replace(theirs, ours)
    message = _INSTANCE.sub("a table", message)
    first = message[:1].lower() if message[1:2].islower() else message[:1]
    value = complaint.get("input")
    shown = "" if isinstance(value, dict | list) or complaint["type"] == "value_error" else f" (got {value!r})"
    return f"{first}{message[1:]}{shown}", path, key


def _check_keys_and_numbers(data: object, kind: Any, path: str, prefix: str) -> None:
    """Walk data and type together and refuse what pydantic would let pass.

    The first key no dataclass knows is an error that names the nearest known one; so is a text or a truth value where
    a number is meant, and a number that is not finite.
    """
    _check_scalar(data, _alternatives(kind), path, prefix)
    for candidate in _alternatives(kind):
        if is_dataclass(candidate) and isinstance(data, dict):
            hints = get_type_hints(candidate)
            known = [field.name for field in fields(candidate) if field.init]
            for key, value in data.items():
                dotted = f"{prefix}.{key}" if prefix else str(key)
                if key not in known:
                    raise ConfigError(_unknown_key_message(str(key), known), path, dotted)
                _check_keys_and_numbers(value, hints[key], path, dotted)
            return
        origin, args = get_origin(candidate), get_args(candidate)
        if origin in (list, tuple) and isinstance(data, list) and args:
            inner = [args[0]] * len(data) if origin is list or args[-1] is Ellipsis else list(args)
            for i, (item, item_kind) in enumerate(zip(data, inner, strict=False)):
                _check_keys_and_numbers(item, item_kind, path, f"{prefix}.{i}" if prefix else str(i))
            return
        if origin is dict and isinstance(data, dict) and args:
            for key, value in data.items():
                _check_keys_and_numbers(value, args[1], path, f"{prefix}.{key}" if prefix else str(key))
            return


def _check_scalar(data: object, kinds: list[Any], path: str, key: str) -> None:
    if isinstance(data, float) and not math.isfinite(data):
        raise ConfigError(f"must be finite, got {data}", path, key)
    expected = [_SCALARS[kind] for kind in kinds if kind in _SCALARS]
    if len(expected) < len(kinds) or str in kinds:
        return
    if isinstance(data, str) or isinstance(data, bool) != (bool in kinds):
        shown = str(data).lower() if isinstance(data, bool) else repr(data)
        raise ConfigError(f"expected {' or '.join(expected)}, got {shown}", path, key)


def _alternatives(kind: Any) -> list[Any]:
    if get_origin(kind) in (Union, UnionType):
        return [option for option in get_args(kind) if option is not NoneType]
    return [kind]


def _unknown_key_message(key: str, known: list[str]) -> str:
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.6)
    if not near:
        stem = key.rsplit("_", 1)[0]
        near = [name for name in known if name.rsplit("_", 1)[0] == stem][:1]
    hint = f", did you mean '{near[0]}'?" if near else f", expected one of: {', '.join(known)}"
    return f"unknown key{hint}"


def check_writable(path: Path, *, force: bool) -> None:
    """Refuse an output file before the work it is to hold, not after.

    Args:
        path: The file; its folder need not exist yet.
        force: Whether an existing file may be replaced.

    Raises:
        ConfigError: The file exists and may not be replaced, or is a folder.
        UvgsError: Its folder cannot be written.
    """
    if path.is_dir():
        raise ConfigError("is a folder, expected the name of a file", str(path))
    if path.exists() and not force:
        raise ConfigError("exists already; use --force to replace it", str(path))
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not folder.is_dir():
        raise UvgsError(f"{path}: cannot be written: {folder} is no folder")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise UvgsError(f"{path}: cannot be written: no permission to write in {folder}")


def write_atomically(path: Path, text: str | bytes, *, force: bool = True) -> None:
    """Write a whole file or nothing: to a temporary neighbour, flushed to disk, then renamed.

    Args:
        path: The file; its folder is created.
        text: What to write; text is UTF-8.
        force: Whether an existing file may be replaced.

    Raises:
        ConfigError: The file exists and may not be replaced.
        UvgsError: The disk is full or the folder cannot be written.
    """
    if path.exists() and not force:
        raise ConfigError("exists already; use --force to replace it", str(path))
    payload = text.encode("utf-8") if isinstance(text, str) else text
    temporary = ""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(payload)
            stream.flush()
            os.fsync(stream.fileno())
        Path(temporary).chmod(0o644)
        os.replace(temporary, path)
    except OSError as error:
        if temporary:
            Path(temporary).unlink(missing_ok=True)
        raise UvgsError(f"{path}: cannot be written: {error.strerror or error}") from None
