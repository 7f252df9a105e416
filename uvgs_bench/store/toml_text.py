"""A small strict TOML writer: plain tables in, text out that ``tomllib`` reads back to the same values."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence


def toml_text(tables: Mapping[str, object]) -> str:
    """Write tables as TOML.

    Args:
        tables: Keys to bool, int, float, str, lists of these (nested too), tables, and lists of tables. A value of
            None is left out, since TOML has no word for it.

    Returns:
        The text, ending in a newline; floats are written so that they are read back to the same bits.

    Raises:
        TypeError: A value of another type; the message names its key.
    """
    lines: list[str] = []
    _write_table(tables, (), lines)
    return "\n".join(lines).lstrip("\n") + "\n"


def _write_table(table: Mapping[str, object], prefix: tuple[str, ...], lines: list[str]) -> None:
    later: list[tuple[str, object]] = []
    for key, value in table.items():
        if value is None:
            continue
        if isinstance(value, Mapping) or _is_list_of_tables(value):
            later.append((key, value))
        else:
            lines.append(f"{_key(key)} = {_value(value, (*prefix, key))}")
    for key, value in later:
        path = (*prefix, key)
        dotted = ".".join(_key(part) for part in path)
        if isinstance(value, Mapping):
            lines += ["", f"[{dotted}]"]
            _write_table(value, path, lines)
        else:
            assert isinstance(value, Sequence)
            for item in value:
                lines += ["", f"[[{dotted}]]"]
                _write_table(item, path, lines)


def _is_list_of_tables(value: object) -> bool:
    return isinstance(value, list | tuple) and len(value) > 0 and all(isinstance(item, Mapping) for item in value)


def _key(key: str) -> str:
    is_bare = key != "" and all(c.isascii() and (c.isalnum() or c in "-_") for c in key)
    return key if is_bare else _string(key)


def _string(text: str) -> str:
    clean = text.encode("utf-8", "replace").decode("utf-8")
    return json.dumps(clean, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value: object, path: tuple[str, ...]) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(float(value))
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(item, path) for item in value) + "]"
    raise TypeError(f"{'.'.join(path)}: {type(value).__name__} cannot be written as TOML")
