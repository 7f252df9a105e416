"""``stamps.csv``: the instants of a folder of pictures, one line per picture, beside them.

Columns: ``file`` (its name in the folder), ``t_ns`` (instant, ns), ``bayer`` (pattern of the mosaic it was developed
from, or empty), ``source`` (for people); others are ignored.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import cast, get_args

from uvgs_bench.errors import FormatError
from uvgs_bench.sensor.capture import BayerPattern

STAMP_FILE = "stamps.csv"
_COLUMNS = ("file", "t_ns", "bayer", "source")


@dataclass(frozen=True, slots=True)
class PictureStamp:
    """One line.

    Args:
        file: Name of the picture in the folder.
        t_ns: Its instant, ns.
        bayer: Pattern of the mosaic it was developed from, or None.
        source: Where it comes from, for people.
    """

    file: str
    t_ns: int
    bayer: BayerPattern | None = None
    source: str = ""


def stamps_text(stamps: Iterable[PictureStamp]) -> str:
    """The file for these pictures."""
    lines = (f"{stamp.file},{stamp.t_ns},{stamp.bayer or ''},{_quoted(stamp.source)}" for stamp in stamps)
    return "\n".join([",".join(_COLUMNS), *lines]) + "\n"


def _quoted(text: str) -> str:
    return '"' + text.replace('"', '""') + '"' if any(mark in text for mark in ',"\n') else text


def read_stamps(path: Path) -> tuple[PictureStamp, ...]:
    """Read the file.

    Args:
        path: It.

    Returns:
        Its lines in order; instants never run backwards.

    Raises:
        FormatError: It cannot be read, lacks a column, or a line is broken.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FormatError(f"cannot be read: {error}", str(path)) from None
    found: list[PictureStamp] = []
    for line, row in enumerate(rows, 2):
        name, stamp, bayer = row.get("file"), row.get("t_ns") or "", row.get("bayer") or None
        if not name or not stamp.lstrip("-").isdigit():
            raise FormatError(f"expected columns file and t_ns (whole ns), got '{name}' and '{stamp}'", str(path), line)
        if bayer is not None and bayer not in get_args(BayerPattern):
            raise FormatError(f"bayer: expected {' '.join(get_args(BayerPattern))} or nothing", str(path), line)
        if found and int(stamp) < found[-1].t_ns:
            raise FormatError("its t_ns is earlier than that of the line before", str(path), line)
        found.append(PictureStamp(name, int(stamp), cast("BayerPattern | None", bayer), row.get("source") or ""))
    if not found:
        raise FormatError(f"no line, expected columns {', '.join(_COLUMNS)}", str(path))
    return tuple(found)
