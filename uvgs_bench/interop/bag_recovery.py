"""Read bags record by record, without their index: for bags that were cut off, never closed, or have holes.

A scan yields what is whole and reports the rest, one line with its byte offset each. Of a chunk that the end of the
file cuts off, the messages before the cut are read; a chunk that is there in full but fails its own check is left out,
because which of its bytes are wrong cannot be known. Formats without checksums (plain and some LZ4 chunks of ROS 1,
SQLite) cannot show that bytes were changed within a message.

Source: ROS bag format 2.0; rosbag2's SQLite schema.
"""

from __future__ import annotations

import io
import re
import shutil
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

from uvgs_bench.errors import FormatError
from uvgs_bench.interop.bag_framing import (
    CUT_CHUNK,
    BagChannel,
    Record,
    Report,
    full_msgtype,
    in_order,
    skip_to,
    take,
    take_chunk,
    trusted,
    unpacked,
)
from uvgs_bench.units import NS_PER_S

ROS1_MAGIC = b"#ROSBAG V2.0\n"
SQLITE_MAGIC = b"SQLite format 3\x00"
# Headers of records hold a few short fields; a larger number is no length.
_MOST_HEADER = 1 << 20
# Where the index of a bag whose header is wrong is looked for.
_INDEX_BYTES = 1 << 23
# The field by which a record of a connection is found; writers put it first in the header, or behind the number.
_ROS1_CONNECTION = re.compile(rb"\x04\x00\x00\x00op=\x07")
_OP_FIRST, _CONN_FIRST = 4, 17
# After so many row numbers without a readable row a database has ended.
_MOST_MISSING_ROWS = 1000
# A chunk's header in either order of its fields that writers use.
_ROS1_CHUNK = re.compile(
    rb"[\x20-\x60]\x00\x00\x00(?:\x04\x00\x00\x00op=\x05|[\x0f-\x10]\x00\x00\x00compression=(?:none|bz2|lz4))",
    re.DOTALL,
)


def scan_ros1(path: Path, report: Report) -> Iterator[Record]:
    """All whole messages of a ROS 1 bag in the order of the file.

    Args:
        path: The bag.
        report: Told what cannot be read.

    Yields:
        Messages.
    """
    with path.open("rb") as file:
        size = path.stat().st_size
        channels = _ros1_index(file, size)
        file.seek(len(ROS1_MAGIC))
        start = file.tell()
        held: list[Record] = []
        while file.tell() < size:
            # Of what makes no sense the length of the record before may be the cause.
            resume, start = start + 1, file.tell()
            try:
                fields, length = _ros1_head(file, size)
                op = fields.get(b"op", b"")
                if op != b"\x05":
                    found = list(_ros1_record(op, fields, take(file, length, size), channels, start, report))
                    yield from in_order(held)
                    held = found
                    continue
                yield from in_order(held)
                held = []
                if length == 0 and fields.get(b"compression") == b"none":
                    # The chunk a recorder was writing when it stopped: its length was never filled in.
                    continue
                resume = start + 1
                payload, is_whole = take_chunk(file, length or size - file.tell(), size)
                held = _ros1_chunk(fields, payload, is_whole and length > 0, channels, start, report)
                if not is_whole:
                    raise FormatError(CUT_CHUNK)
            except (FormatError, struct.error) as error:
                yield from in_order(trusted(held, error))
                held = []
                report(str(error) or "makes no sense", start)
                if not skip_to(file, resume, _ROS1_CHUNK, size):
                    return
        yield from in_order(held)


def scan_sqlite(path: Path, report: Report) -> Iterator[Record]:
    """All readable messages of a ROS 2 database in the order of its rows.

    Args:
        path: The database.
        report: Told what cannot be read.

    Yields:
        Messages of topics the database names.
    """
    with ExitStack() as stack:
        if missing_bytes(path):
            path = _trimmed(path, Path(stack.enter_context(TemporaryDirectory(prefix="uvgs-bag-"))))
        base = stack.enter_context(closing(_database(path)))
        try:
            yield from _sqlite_rows(base, _sqlite_channels(base), report)
        except sqlite3.DatabaseError as error:
            report(f"its tables cannot be read: {error}", -1)


def _sqlite_rows(base: sqlite3.Connection, channels: dict[int, BagChannel], report: Report) -> Iterator[Record]:
    query = "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? ORDER BY id"
    last, missing, lost = 0, 0, 0
    strange: set[int] = set()
    while missing < _MOST_MISSING_ROWS:
        try:
            for row, topic, log_ns, data in base.execute(query, (last + missing,)):
                last, lost, missing = row, lost + missing, 0
                if topic in channels and isinstance(data, bytes) and isinstance(log_ns, int):
                    yield channels[topic], log_ns, data
                elif topic not in strange:
                    strange.add(topic)
                    report(f"messages of topic number {topic}, which it does not name, are left out", -1)
            break
        except sqlite3.DatabaseError as error:
            if missing == 0:
                report(f"row {last + 1} of its messages cannot be read: {error}", -1)
            missing += 1
    if lost:
        report(f"{lost} rows of its messages cannot be read", -1)


def _database(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)


def missing_bytes(path: Path) -> int:
    """How many bytes shorter a database is than its header says; 0 when it is whole or does not say."""
    page, count = _sqlite_pages(path)
    return max(0, page * count - path.stat().st_size)


def _sqlite_pages(path: Path) -> tuple[int, int]:
    with path.open("rb") as file:
        head = file.read(100).ljust(100, b"\0")
    (page,) = struct.unpack_from(">H", head, 16)
    changed, count = struct.unpack_from(">II", head, 24)
    (valid_for,) = struct.unpack_from(">I", head, 92)
    return (65536 if page == 1 else page), (count if changed == valid_for else 0)


def _trimmed(path: Path, folder: Path) -> Path:
    """A copy that ends with its last whole page and says so: SQLite reads zeros behind the end of a file."""
    copy = folder / "trimmed.db3"
    page, _ = _sqlite_pages(path)
    with path.open("rb") as source, copy.open("wb") as target:
        shutil.copyfileobj(source, target, 1 << 20)
        whole = target.tell() // max(page, 1)
        target.truncate(whole * page)
        if whole:
            target.seek(28)
            target.write(struct.pack(">I", whole))
    return copy


def sqlite_remarks(path: Path, shown: Path) -> list[str]:
    """What a database that opens does not say by itself: messages nobody can name, and rows still in its journal.

    Args:
        path: The database.
        shown: Its name for people.

    Returns:
        Lines.
    """
    found = []
    base = _database(path)
    try:
        query = "SELECT count(*) FROM messages WHERE topic_id NOT IN (SELECT id FROM topics)"
        (count,) = base.execute(query).fetchone()
        if count:
            found.append(f"{shown}: {count} messages belong to topics it does not name; left out")
    except sqlite3.DatabaseError as error:
        found.append(f"{shown}: its tables are damaged: {error}")
    finally:
        base.close()
    journal = path.with_name(f"{path.name}-wal")
    if journal.is_file() and journal.stat().st_size:
        found.append(f"{shown}: its last messages may still be in {journal.name}, which is not read")
    return found


def ros1_compression(path: Path, chunks: list[int]) -> str:
    """Names of the compressions of chunks at these offsets, at most a hundred of them looked at."""
    kinds: dict[str, None] = {}
    size = path.stat().st_size
    with path.open("rb") as file:
        for offset in chunks[:: max(1, len(chunks) // 100)]:
            file.seek(offset)
            fields, _ = _ros1_head(file, size)
            kinds[fields.get(b"compression", b"none").decode("ascii", "replace")] = None
    return ", ".join(kinds) or "none"


def _sqlite_channels(base: sqlite3.Connection) -> dict[int, BagChannel]:
    definitions: dict[str, tuple[str, str]] = {}
    try:
        for name, kind, text in base.execute(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        ):
            definitions[name] = (str(text), "idl" if "idl" in str(kind) else "msg")
    except sqlite3.DatabaseError:
        pass  # older recorders wrote no definitions
    channels = {}
    for number, topic, name in base.execute("SELECT id, name, type FROM topics").fetchall():
        # What is no name stays out; its messages are then told.
        with suppress(FormatError):
            definition = definitions.get(name, ("", "msg"))
            channels[number] = BagChannel(str(topic), full_msgtype(str(name)), "cdr", *definition)
    return channels


def _ros1_fields(header: bytes, offset: int) -> dict[bytes, bytes]:
    fields = {}
    at = 0
    while at < len(header):
        (length,) = struct.unpack_from("<I", header, at)
        name, equals, value = header[at + 4 : at + 4 + length].partition(b"=")
        if not equals or at + 4 + length > len(header):
            raise FormatError("holds no record")
        fields[name] = value
        at += 4 + length
    return fields


def _ros1_head(file: BinaryIO, size: int) -> tuple[dict[bytes, bytes], int]:
    start = file.tell()
    (length,) = struct.unpack("<I", take(file, 4, size))
    if not 0 < length <= _MOST_HEADER:
        raise FormatError("holds no record")
    fields = _ros1_fields(take(file, length, size), start)
    (data_length,) = struct.unpack("<I", take(file, 4, size))
    return fields, data_length


def _ros1_index(file: BinaryIO, size: int) -> dict[int, BagChannel]:
    """The connections its index names, as far as there is one: their records in a lost chunk are then not missed."""
    channels: dict[int, BagChannel] = {}
    file.seek(len(ROS1_MAGIC))
    start = 0
    with suppress(FormatError, struct.error):
        head, _ = _ros1_head(file, size)
        (start,) = struct.unpack("<Q", head.get(b"index_pos", b""))
    while 0 < start < size and (end := _ros1_connection(file, start, size, channels)):
        start = end
    if not channels:
        # Bytes are missing, so the index is not where the header says; it is near the end.
        first = max(0, size - _INDEX_BYTES)
        file.seek(first)
        for found in _ROS1_CONNECTION.finditer(file.read()):
            for before in (_OP_FIRST, _CONN_FIRST):
                _ros1_connection(file, first + found.start() - before, size, channels)
    return channels


def _ros1_connection(file: BinaryIO, start: int, size: int, channels: dict[int, BagChannel]) -> int:
    """Read a record of a connection; the answer is where it ends, or 0 when there is none."""
    with suppress(FormatError, struct.error):
        file.seek(max(0, start))
        fields, length = _ros1_head(file, size)
        if fields.get(b"op") == b"\x07":
            list(_ros1_record(b"\x07", fields, take(file, length, size), channels, 0, lambda _text, _offset: None))
            return file.tell()
    return 0


def _ros1_record(
    op: bytes, fields: dict[bytes, bytes], data: bytes, channels: dict[int, BagChannel], offset: int, report: Report
) -> Iterator[Record]:
    if op == b"\x07":
        (number,) = struct.unpack("<I", fields.get(b"conn", b""))
        said = _ros1_fields(data, offset)
        topic = fields.get(b"topic", said.get(b"topic", b"")).decode("utf-8", "replace")
        # As ROS itself and the library's reader do.
        topic = re.sub("/+", "/", topic)
        name = said.get(b"type", b"").decode("utf-8", "replace")
        text = said.get(b"message_definition", b"").decode("utf-8", "replace")
        is_latched = said.get(b"latching") == b"1"
        digest = said.get(b"md5sum", b"").decode("ascii", "replace")
        channels[number] = BagChannel(topic, full_msgtype(name), "ros1", text, "msg", is_latched, digest)
    elif op == b"\x02":
        (number,) = struct.unpack("<I", fields.get(b"conn", b""))
        sec, nanosec = struct.unpack("<II", fields.get(b"time", b""))
        if number in channels:
            yield channels[number], sec * NS_PER_S + nanosec, data
        else:
            report(f"a message of connection {number}, which it does not name, is left out", offset)
    elif op not in (b"\x03", b"\x04", b"\x06"):
        raise FormatError("holds no record")


def _ros1_chunk(
    fields: dict[bytes, bytes],
    payload: bytes,
    is_whole: bool,
    channels: dict[int, BagChannel],
    offset: int,
    report: Report,
) -> list[Record]:
    kind = fields.get(b"compression", b"").decode("ascii", "replace")
    data, is_done = (payload, is_whole) if kind == "none" else unpacked(kind, payload)
    if is_whole and not is_done:
        report(f"a chunk cannot be unpacked ({kind})", offset)
        return []
    inner = io.BytesIO(data)
    found: list[Record] = []
    try:
        while inner.tell() < len(data):
            record, length = _ros1_head(inner, len(data))
            found += _ros1_record(
                record.get(b"op", b""), record, take(inner, length, len(data)), channels, offset, report
            )
    except (FormatError, struct.error) as error:
        found = trusted(found, error, is_cut=not is_whole)
        if is_whole:
            report(f"a chunk is broken: {error}", offset)
    return found
