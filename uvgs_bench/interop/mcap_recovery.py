"""Read MCAP files record by record, without their summary; ``bag_recovery`` says how.

Source: MCAP specification, version 0.
"""

from __future__ import annotations

import io
import re
import struct
from binascii import crc32
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from uvgs_bench.errors import FormatError
from uvgs_bench.interop.bag_framing import (
    CUT,
    CUT_CHUNK,
    BagChannel,
    Record,
    Report,
    check_room,
    full_msgtype,
    in_order,
    skip_to,
    take,
    take_chunk,
    trusted,
    unpacked,
)

MCAP_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END, _FIRST_PRIVATE = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F, 0x10
# Opcode, a length below 2^40, two times, sizes below 2^40, checksum, one of the known compressions.
_MCAP_CHUNK = re.compile(
    rb"\x06.{5}\x00\x00\x00.{8}.{8}.{5}\x00\x00\x00.{4}"
    rb"(?:\x00\x00\x00\x00.{5}\x00\x00\x00[\x03-\x05]"
    rb"|\x03\x00\x00\x00lz4.{5}\x00\x00\x00\x04\x22\x4d\x18"
    rb"|\x04\x00\x00\x00zstd.{5}\x00\x00\x00\x28\xb5\x2f\xfd)",
    re.DOTALL,
)
_WIRES = {("cdr", "ros2msg"): ("cdr", "msg"), ("cdr", "ros2idl"): ("cdr", "idl"), ("cdr", "omgidl"): ("cdr", "idl")}
_WIRES |= {("cdr", ""): ("cdr", "msg"), ("ros1", "ros1msg"): ("ros1", "msg")}


def scan_mcap(path: Path, report: Report) -> Iterator[Record]:
    """All whole messages of an MCAP file in the order of the file.

    Args:
        path: The file.
        report: Told what cannot be read.

    Yields:
        Messages of ROS 2 (CDR) and ROS 1; others are reported once by channel.
    """
    tables = _McapTables({}, {}, report)
    with path.open("rb") as file:
        size = path.stat().st_size
        _read_summary(file, size, tables)
        file.seek(len(MCAP_MAGIC))
        is_closed = False
        start = file.tell()
        held: list[Record] = []
        while file.tell() < size and not is_closed:
            # Of what makes no sense the length of the record before may be the cause.
            resume, start = start + 1, file.tell()
            try:
                op, length = struct.unpack("<BQ", take(file, 9, size))
                if op in (_FOOTER, _DATA_END):
                    is_closed = True
                elif op == _CHUNK:
                    yield from in_order(held)
                    held = []
                    resume = start + 1
                    payload, is_whole = take_chunk(file, length, size)
                    held = _mcap_chunk(payload, is_whole, tables, start)
                    if not is_whole:
                        raise FormatError(CUT_CHUNK)
                elif op in (_SCHEMA, _CHANNEL, _MESSAGE):
                    found = list(_mcap_record(op, take(file, length, size), tables, start))
                    yield from in_order(held)
                    held = found
                elif 0 < op < _FIRST_PRIVATE or op >= 0x80:
                    check_room(file, length, size)
                    file.seek(length, io.SEEK_CUR)
                else:
                    raise FormatError("holds no record")
            except (FormatError, struct.error, UnicodeDecodeError) as error:
                yield from in_order(trusted(held, error))
                held = []
                report(str(error) or "makes no sense", start)
                if not skip_to(file, resume, _MCAP_CHUNK, size):
                    return
        yield from in_order(held)
        if not is_closed:
            report("ends without its closing record", size)


def mcap_compression(path: Path, chunks: list[int]) -> str:
    """Names of the compressions of chunks at these offsets, at most a hundred of them looked at; empty when none is."""
    kinds: dict[str, None] = {}
    with path.open("rb") as file:
        for offset in chunks[:: max(1, len(chunks) // 100)]:
            file.seek(offset + 9)
            (name,), _ = _strings(file.read(64), 28, 1)
            kinds[name.decode("ascii", "replace") or "none"] = None
    return ", ".join(kinds) if set(kinds) != {"none"} else ""


@dataclass(frozen=True, slots=True)
class _McapTables:
    schemas: dict[int, tuple[str, str, str]]
    channels: dict[int, BagChannel | None]
    report: Report


def _read_summary(file: BinaryIO, size: int, tables: _McapTables) -> None:
    """The channels its summary names, as far as there is one: their records in a lost chunk are then not missed."""
    try:
        file.seek(max(0, size - 37))
        op, _, start, _, _ = struct.unpack("<BQQQI", take(file, 29, size))
        if op != _FOOTER or file.read(8) != MCAP_MAGIC or not 0 < start < size:
            return
        file.seek(start)
        while file.tell() < size - 37:
            op, length = struct.unpack("<BQ", take(file, 9, size))
            record = take(file, length, size)
            if op in (_SCHEMA, _CHANNEL):
                list(_mcap_record(op, record, tables, start))
    except (FormatError, struct.error, UnicodeDecodeError):
        pass  # the summary is what may be broken


def _strings(data: bytes | memoryview, at: int, count: int) -> tuple[list[bytes], int]:
    found = []
    for _ in range(count):
        (length,) = struct.unpack_from("<I", data, at)
        if at + 4 + length > len(data):
            raise FormatError("holds no record")
        found.append(bytes(data[at + 4 : at + 4 + length]))
        at += 4 + length
    return found, at


def _mcap_record(op: int, data: bytes | memoryview, tables: _McapTables, offset: int) -> Iterator[Record]:
    if op == _SCHEMA:
        (number,) = struct.unpack_from("<H", data)
        said, _ = _strings(data, 2, 3)
        tables.schemas[number] = (said[0].decode(), said[1].decode(), said[2].decode("utf-8", "replace"))
    elif op == _CHANNEL:
        number, schema = struct.unpack_from("<HH", data)
        (topic, encoding), _ = _strings(data, 4, 2)
        name, kind, text = tables.schemas.get(schema, ("", "", ""))
        wire = _WIRES.get((encoding.decode(), kind))
        if wire is not None:
            tables.channels[number] = BagChannel(topic.decode(), full_msgtype(name), wire[0], text, wire[1])
        elif number not in tables.channels:
            tables.channels[number] = None
            what = encoding.decode("utf-8", "replace") or "unknown"
            tables.report(f"topic {topic.decode('utf-8', 'replace')} holds {what} messages, not ROS ones", offset)
    else:
        number, _, log_ns, _ = struct.unpack_from("<HIQQ", data)
        channel = tables.channels.get(number)
        if channel is not None:
            yield channel, log_ns, bytes(data[22:])
        elif number not in tables.channels:
            tables.report(f"messages of channel {number}, which it does not name, are left out", offset)
            tables.channels[number] = None


def _mcap_chunk(payload: bytes, is_whole: bool, tables: _McapTables, offset: int) -> list[Record]:
    _, _, unpacked_size, checksum = struct.unpack_from("<QQQI", payload)
    (kind_bytes,), at = _strings(payload, 28, 1)
    (length,) = struct.unpack_from("<Q", payload, at)
    kind = kind_bytes.decode("ascii", "replace")
    data, is_done = memoryview(payload)[at + 8 : at + 8 + length], is_whole
    if kind:
        whole, is_done = unpacked(kind, bytes(data))
        data = memoryview(whole)
    is_good = is_done and len(data) == unpacked_size and (checksum == 0 or checksum == crc32(data))
    if is_whole and not is_good:
        tables.report(f"a chunk fails its check ({kind or 'not compressed'})", offset)
        return []
    found: list[Record] = []
    at = 0
    try:
        while at < len(data):
            if at + 9 > len(data):
                raise FormatError(CUT)
            op, length = struct.unpack_from("<BQ", data, at)
            at += 9 + length
            if at > len(data):
                raise FormatError(CUT)
            if op in (_SCHEMA, _CHANNEL, _MESSAGE):
                found += _mcap_record(op, data[at - length : at], tables, offset)
            elif op == 0 or _FIRST_PRIVATE <= op < 0x80:
                raise FormatError("holds no record")
    except (FormatError, struct.error, UnicodeDecodeError) as error:
        found = trusted(found, error, is_cut=not is_whole)
        if is_whole:
            tables.report(f"a chunk is broken: {error}", offset)
    return found
