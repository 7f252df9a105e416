"""Sensor files changed in place: values are replaced line by line, so that what people wrote beside them stays."""

from __future__ import annotations

import re
import tomllib
from dataclasses import asdict, fields
from pathlib import Path

from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.store.documents import parse_document, read_document, read_text, write_atomically
from uvgs_bench.store.toml_text import toml_text

_KEY = r"^[ \t]*{name}[ \t]*=[^#\n\[\"']*"


def update_sensor_file(path: Path, wanted: UvgsConfig) -> None:
    """Make a sensor file say certain parameters; a new file says only what differs from the built-in values.

    Args:
        path: The file; made when it is missing.
        wanted: The parameters.

    Raises:
        ConfigError: The file is no sensor file.
        UvgsError: It cannot be written.
    """
    if path.exists():
        before, text = read_document(path, UvgsConfig), read_text(path, "a sensor file")
    else:
        before, text = UvgsConfig(), "schema = 1\n"
    for item in fields(UvgsConfig):
        value = getattr(wanted, item.name)
        if value == getattr(before, item.name):
            continue
        line = toml_text({item.name: value}).strip()
        found = re.search(_KEY.format(name=item.name), text, re.MULTILINE)
        if found is None:
            text = f"{text.rstrip()}\n{line}\n"
        else:
            space = found[0][len(found[0].rstrip()) :]
            text = text[: found.start()] + line + space + text[found.end() :]
    _check_says(path, text, wanted)
    write_atomically(path, text)


def _check_says(path: Path, text: str, wanted: UvgsConfig) -> None:
    data = {key: value for key, value in tomllib.loads(text).items() if key != "schema"}
    assert asdict(parse_document(data, UvgsConfig, str(path))) == asdict(wanted), "the file must say what is wanted"
