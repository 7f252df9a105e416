"""The framing that bag formats share: bytes that may end too early, chunks that may not unpack, places to go on.

Also what a scan hands out: channels and messages, before anything is decoded.
"""

from __future__ import annotations

import bz2
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, BinaryIO

from uvgs_bench.errors import FormatError

CUT, CUT_CHUNK = "ends in the middle of a record", "ends in the middle of a chunk"
"""What is said where a file ends too early, as against bytes that make no sense."""

Report = Callable[[str, int], None]
"""Takes what is wrong and at which byte."""

# A compressed chunk is unpacked in memory; recorders write some MB.
_MOST_CHUNK = 1 << 30
_PIECE = 1 << 16
_NAME = re.compile(r"[\x21-\x7e]{1,300}")
_LONGEST_SHOWN = 200


@dataclass(frozen=True, slots=True)
class BagChannel:
    """One stream of messages of a bag.

    Args:
        topic: Its topic.
        msgtype: Its type, ``package/msg/Name``.
        wire: How messages are serialised: ``ros1`` or ``cdr``.
        definition: Text of the definition; empty when the bag has none.
        definition_kind: ``msg`` or ``idl``.
        is_latched: Whether late subscribers got the last message.
        digest: MD5 sum (ROS 1) or RIHS01 hash (ROS 2) of the definition; empty when the bag has none.

    Raises:
        FormatError: Topic or type are no names; a damaged bag may say anything.
    """

    topic: str
    msgtype: str
    wire: str
    definition: str = ""
    definition_kind: str = "msg"
    is_latched: bool = False
    digest: str = ""

    def __post_init__(self) -> None:
        for what, name in (("topic", self.topic), ("type", self.msgtype)):
            if not _NAME.fullmatch(name):
                raise FormatError(f"a {what} is named '{shown(name)}'")


Record = tuple[BagChannel, int, bytes]
"""A message: its channel, the bag's own time (ns), its bytes."""


def shown(text: str) -> str:
    """A text from a file that may be damaged, fit for one line of a terminal."""
    plain = " ".join("".join(mark if mark.isprintable() else " " for mark in text).split())
    return plain if len(plain) <= _LONGEST_SHOWN else plain[:_LONGEST_SHOWN] + "..."


def full_msgtype(name: str) -> str:
    """A type name with its middle part, which ROS 1 and some writers leave out."""
    package, _, short = name.rpartition("/")
    return name if not package or package.endswith("/msg") else f"{package}/msg/{short}"


def needed_types(names: Iterable[str], definitions: Mapping[str, Any]) -> dict[str, Any]:
    """The definitions of types and of all types in them; to teach a type store all it knows takes a tenth of a second.

    Args:
        names: Types.
        definitions: ``fielddefs`` of a type store.

    Returns:
        As ``definitions``; types it does not know are left out.
    """
    found: dict[str, Any] = {}
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        if name in found or name not in definitions:
            continue
        found[name] = definitions[name]
        for _, kind in definitions[name][1]:
            inner = kind[1][0] if kind[0].name in ("ARRAY", "SEQUENCE") else kind
            if inner[0].name == "NAME":
                waiting.append(inner[1])
    return found


def zstd_module() -> Any:
    """The module for zstd: part of the standard library from Python 3.14 on, before a dependency of rosbags."""
    return import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")


def take(file: BinaryIO, length: int, size: int) -> bytes:
    """So many bytes of a file of that size. Raises FormatError when it ends before them."""
    check_room(file, length, size)
    return file.read(length)


def check_room(file: BinaryIO, length: int, size: int) -> None:
    """Raises FormatError when a file of that size ends before so many bytes more; what nobody writes is no length."""
    if file.tell() + length > size:
        raise FormatError(CUT if length <= _MOST_CHUNK else "holds no record")


def in_order(found: list[Record]) -> list[Record]:
    """Messages of a chunk by their times."""
    return sorted(found, key=lambda record: record[1])


def trusted(found: list[Record], error: Exception, *, is_cut: bool = True) -> list[Record]:
    """Messages before something that is no record.

    Args:
        found: The messages in the order of the file.
        error: What was wrong behind them.
        is_cut: Whether bytes may be missing there.

    Returns:
        All of them where the bytes just end; else without the last, whose length, and so its content, may be wrong.
    """
    return found if is_cut and str(error) in (CUT, CUT_CHUNK) else found[:-1]


def take_chunk(file: BinaryIO, length: int, size: int) -> tuple[bytes, bool]:
    """What is there of a chunk, and whether that is all of it."""
    start = file.tell()
    if min(length, size - start) > _MOST_CHUNK:
        raise FormatError(f"says a chunk of {length} bytes")
    payload = file.read(length)
    return payload, len(payload) == length


def skip_to(file: BinaryIO, start: int, pattern: re.Pattern[bytes], size: int) -> bool:
    """Go to the next place that looks like the start of a chunk; False when there is none."""
    position, tail = start, b""
    file.seek(start)
    while piece := file.read(1 << 22):
        window = tail + piece
        for found in pattern.finditer(window):
            at = position - len(tail) + found.start()
            if at >= start:
                file.seek(at)
                return True
        position += len(piece)
        tail = window[-128:]
    file.seek(size)
    return False


def unpacked(kind: str, payload: bytes) -> tuple[bytes, bool]:
    """What can be unpacked of a compressed chunk, and whether its end was reached."""
    makers: dict[str, Callable[[], Any]] = {
        "bz2": bz2.BZ2Decompressor,
        "lz4": lambda: import_module("lz4.frame").LZ4FrameDecompressor(),
        "zstd": lambda: zstd_module().ZstdDecompressor(),
    }
    if kind not in makers:
        return b"", False
    parts = []
    decoder = makers[kind]()
    try:
        for i in range(0, len(payload), _PIECE):
            piece = payload[i : i + _PIECE]
            while piece:
                if decoder.eof:
                    # Frames may follow one another.
                    decoder = makers[kind]()
                parts.append(decoder.decompress(piece))
                piece = decoder.unused_data if decoder.eof else b""
    except Exception:  # three libraries, three kinds of error, one meaning
        return b"".join(parts), False
    return b"".join(parts), bool(decoder.eof)


def unpack_file(source: BinaryIO, target: BinaryIO) -> str:
    """Undo zstd over a whole file, as far as it goes.

    Args:
        source: The compressed file.
        target: Where to.

    Returns:
        What stopped it before the end, or empty.
    """
    zstd = zstd_module()
    decoder = zstd.ZstdDecompressor()
    try:
        while piece := source.read(1 << 20):
            while piece:
                if decoder.eof:
                    # Frames may follow one another.
                    decoder = zstd.ZstdDecompressor()
                target.write(decoder.decompress(piece))
                piece = decoder.unused_data if decoder.eof else b""
    except zstd.ZstdError as error:
        return " ".join(str(error).split())
    return "" if decoder.eof else "it ends too early"
