"""Strict reading of documents people write: TOML and YAML into frozen dataclasses, unknown keys refused by name."""

from __future__ import annotations

import difflib
import os
import tempfile
import tomllib
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, TypeVar, Union, get_args, get_origin, get_type_hints

from uvgs_bench.errors import ConfigError, UvgsError

if TYPE_CHECKING:
    from pydantic import ValidationError

Document = TypeVar("Document")
SCHEMA_KEY = "schema"


def read_toml(path: Path) -> dict[str, object]:
    """Read a TOML file.

    Args:
        path: The file.

    Returns:
        Its tables.

    Raises:
        ConfigError: It is missing, unreadable or no TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError("no such file", str(path)) from None
    except IsADirectoryError:
        raise ConfigError("is a folder, expected a TOML file", str(path)) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot be read: {error}", str(path)) from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"not valid TOML: {error}", str(path)) from None


def read_document(path: Path, kind: type[Document], schema: int = 1) -> Document:
    """Read a TOML file strictly into a dataclass whose field names are the file's keys.

    Args:
        path: The file.
        kind: A dataclass; nested dataclasses, lists, tuples and literals are followed.
        schema: The schema version this program understands; the file's ``schema`` key must equal it.

    Returns:
        The instance.

    Raises:
        ConfigError: Missing file, unknown or missing key, wrong type, or a value the class refuses. The message names
            file and dotted key and proposes the nearest known key.
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

    _refuse_unknown_keys(data, kind, path, prefix)
    config = None if is_dataclass(kind) else ConfigDict(strict=False)
    try:
        return TypeAdapter(kind, config=config).validate_python(data)
    except ValidationError as error:
        raise ConfigError(*_first_complaint(error, path, prefix)) from None
    except (ValueError, TypeError, UvgsError) as error:
        raise ConfigError(str(error), path, prefix) from None


def _first_complaint(error: ValidationError, path: str, prefix: str) -> tuple[str, str, str]:
    complaint = error.errors()[0]
    key = ".".join(
        [prefix, *(str(part) for part in complaint["loc"])] if prefix else [str(p) for p in complaint["loc"]]
    )
    if complaint["type"] == "missing":
        return "this key is required", path, key
    message = complaint["msg"].removeprefix("Value error, ").removeprefix("Assertion failed, ")
    value = complaint.get("input")
    shown = "" if isinstance(value, dict | list) or complaint["type"] == "value_error" else f" (got {value!r})"
    return f"{message[:1].lower()}{message[1:]}{shown}", path, key


def _refuse_unknown_keys(data: object, kind: Any, path: str, prefix: str) -> None:
    """Walk data and type together; the first key no dataclass knows is an error that names the nearest known one."""
    for candidate in _alternatives(kind):
        if is_dataclass(candidate) and isinstance(data, dict):
            hints = get_type_hints(candidate)
            known = [field.name for field in fields(candidate) if field.init]
            for key, value in data.items():
                dotted = f"{prefix}.{key}" if prefix else str(key)
                if key not in known:
                    raise ConfigError(_unknown_key_message(str(key), known), path, dotted)
                _refuse_unknown_keys(value, hints[key], path, dotted)
            return
        origin, args = get_origin(candidate), get_args(candidate)
        if origin in (list, tuple) and isinstance(data, list) and args:
            inner = [args[0]] * len(data) if origin is list or args[-1] is Ellipsis else list(args)
            for i, (item, item_kind) in enumerate(zip(data, inner, strict=False)):
                _refuse_unknown_keys(item, item_kind, path, f"{prefix}.{i}" if prefix else str(i))
            return
        if origin is dict and isinstance(data, dict) and args:
            for key, value in data.items():
                _refuse_unknown_keys(value, args[1], path, f"{prefix}.{key}" if prefix else str(key))
            return


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


def required_keys(kind: type) -> list[str]:
    """Names of the fields of a dataclass that have no default."""
    if not is_dataclass(kind):
        raise TypeError(f"{kind} is no dataclass")
    return [f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING]


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
