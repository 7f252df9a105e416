"""One file of a bag, open: through the library's reader, which knows the index, or record by record when it cannot.

A file is known by its first bytes, not by its name. Compression is undone wherever it is.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from uvgs_bench.errors import FormatError
from uvgs_bench.interop import bag_recovery as recovery
from uvgs_bench.interop.bag_framing import (
    BagChannel,
    Record,
    full_msgtype,
    needed_types,
    shown,
    unpack_file,
    zstd_module,
)
from uvgs_bench.interop.mcap_recovery import MCAP_MAGIC, mcap_compression, scan_mcap

_ZSTD = b"\x28\xb5\x2f\xfd"
# More lines than this about one file help nobody.
_MOST_REMARKS = 5


@dataclass(frozen=True, slots=True, eq=False)
class BagMessage:
    """A message as it stands in a bag.

    Args:
        channel: Where it belongs.
        log_ns: When it was recorded, by the recorder's clock, ns.
        raw: Its bytes, no longer compressed.
        file: The file it comes from.
    """

    channel: BagChannel
    log_ns: int
    raw: bytes
    file: BagFile

    def decode(self) -> Any:
        """Its fields, as attributes.

        Raises:
            FormatError: The bytes are none of its type.
        """
        return self.file.decode(self.channel, self.raw)


@dataclass(slots=True, eq=False)
class BagFile:
    """One file of a bag, open. Opened by ``open_bag_file``.

    Args:
        path: The file as the user knows it.
        kind: ``ROS 1``, ``ROS 2 mcap`` or ``ROS 2 sqlite3``.
        compression: Of its chunks, messages or itself; ``none``.
        counts: Messages by channel.
        remarks: What is wrong with it, a line each.
        span_ns: First and last of its own times, ns; None without messages.
    """

    path: Path
    kind: str
    compression: str
    counts: dict[BagChannel, int]
    remarks: list[str]
    span_ns: tuple[int, int] | None
    _read: Callable[[Collection[str]], Iterator[Record]]
    _close: Callable[[], None]
    _store: Any = field(default=None)

    def messages(self, topics: Collection[str] = ()) -> Iterator[BagMessage]:
        """Its messages in order of the bag's own times; of all topics when none is named."""
        report = _reporter(self.path, self.remarks)
        for channel, log_ns, raw in self._read(topics):
            whole = bytes(raw)
            if raw[:4] == _ZSTD:
                try:
                    whole = zstd_module().decompress(raw)
                except zstd_module().ZstdError as error:
                    report(f"a message of {channel.topic} cannot be unpacked: {one_line(error)}", -1)
                    continue
            yield BagMessage(channel, log_ns, whole, self)

    def decode(self, channel: BagChannel, raw: bytes) -> Any:
        """The fields of a message. Raises FormatError when the bytes are none of its type."""
        try:
            store = self.typestore
            if channel.wire == "ros1":
                return store.deserialize_ros1(raw, channel.msgtype)
            return store.deserialize_cdr(raw, channel.msgtype)
        except Exception as error:  # the library's decoders have no common base of errors
            raise FormatError(f"is no {channel.msgtype}: {one_line(error)}", str(self.path)) from None

    @property
    def typestore(self) -> Any:
        """The types its definitions say, completed by the standard ones."""
        if self._store is None:
            self._store = _typestore(tuple(self.counts))
        return self._store

    def close(self) -> None:
        """Release the file. Safe to call twice."""
        self._close()


def one_line(error: BaseException) -> str:
    """An error's words in one line."""
    return shown(str(error)) or "its bytes make no sense"


def open_bag_file(path: Path) -> BagFile:
    """Open one file.

    Args:
        path: The file.

    Returns:
        It, open.

    Raises:
        FormatError: It is no bag, or has nothing that can be read.
    """
    with path.open("rb") as file:
        start = file.read(16)
    if start.startswith(_ZSTD):
        return _open_packed(path)
    if start.startswith(recovery.ROS1_MAGIC):
        return _open_indexed(path, path, "ROS 1", recovery.scan_ros1)
    if start.startswith(MCAP_MAGIC):
        return _open_indexed(path, path, "ROS 2 mcap", scan_mcap)
    if start.startswith(recovery.SQLITE_MAGIC):
        return _open_indexed(path, path, "ROS 2 sqlite3", recovery.scan_sqlite)
    if start.startswith(b"#ROSBAG V"):
        raise FormatError(
            f"is a ROS bag of version {start[9:13].decode(errors='replace').strip()}, expected 2.0", str(path)
        )
    what = "is empty" if not start else f"begins with {start[:8]!r}"
    raise FormatError(f"is no ROS bag: it {what}, expected a ROS 1 bag, MCAP or SQLite", str(path))


def _open_packed(path: Path) -> BagFile:
    """A file compressed as a whole: unpacked beside nothing the user has, and removed when closed."""
    folder = tempfile.TemporaryDirectory(prefix="uvgs-bag-")
    try:
        unpacked = Path(folder.name) / (path.stem if Path(path.stem).suffix else f"{path.stem}.mcap")
        with path.open("rb") as source, unpacked.open("wb") as target:
            stopped = unpack_file(source, target)
        torn = f"{path}: cannot be unpacked to its end: {stopped}" if stopped else ""
        with unpacked.open("rb") as file:
            start = file.read(16)
        scans = {MCAP_MAGIC: ("ROS 2 mcap", scan_mcap), recovery.SQLITE_MAGIC: ("ROS 2 sqlite3", recovery.scan_sqlite)}
        known = next((found for magic, found in scans.items() if start.startswith(magic)), None)
        if known is None:
            raise FormatError(
                f"cannot be unpacked: {stopped}"
                if stopped
                else "holds no bag, expected MCAP or SQLite compressed with zstd",
                str(path),
            )
        opened = _open_indexed(unpacked, path, *known)
    except BaseException:
        folder.cleanup()
        raise
    if torn:
        opened.remarks.insert(0, torn)
    opened.compression = "zstd (file)"
    inner = opened._close

    def close() -> None:
        inner()
        folder.cleanup()

    opened._close = close
    return opened


Scan = Callable[[Path, Callable[[str, int], None]], Iterator[Record]]


def _open_indexed(path: Path, known_as: Path, kind: str, scan: Scan) -> BagFile:
    """Through the library's reader, which knows the index; record by record when it cannot."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    if kind == "ROS 2 sqlite3" and (missing := recovery.missing_bytes(path)):
        # SQLite reads zeros behind the end of a file, and they would be taken for pixels.
        return _open_scanned(path, known_as, kind, scan, f"{missing} bytes at its end are missing")
    try:
        reader: Any = Reader1(path) if kind == "ROS 1" else Reader2(path)
        reader.open()
    except Exception as error:  # broken bags raise whatever their bytes lead to
        return _open_scanned(path, known_as, kind, scan, one_line(error))
    try:
        channels = {_key(found): _channel(found, kind) for found in reader.connections}
    except FormatError as error:
        reader.close()
        return _open_scanned(path, known_as, kind, scan, one_line(error))
    counts: dict[BagChannel, int] = {}
    for found in reader.connections:
        counts[channels[_key(found)]] = counts.get(channels[_key(found)], 0) + found.msgcount
    remarks = recovery.sqlite_remarks(path, known_as) if kind == "ROS 2 sqlite3" else []

    def read(topics: Collection[str]) -> Iterator[Record]:
        wanted = [found for found in reader.connections if not topics or found.topic in topics]
        if not wanted:
            return
        last_ns, same, count = -1, 0, 0
        try:
            for found, log_ns, raw in reader.messages(connections=wanted):
                same = same + 1 if log_ns == last_ns else 1
                last_ns = log_ns
                count += 1
                yield channels[_key(found)], log_ns, raw
        except Exception as error:  # as above
            remarks.append(
                f"{known_as}: breaks off in its index ({one_line(error)}); the rest is read record by record"
            )
        else:
            if count != (said := sum(found.msgcount for found in wanted)):
                remarks.append(f"{known_as}: its index says {said} messages, but {count} are there")
            return
        for channel, log_ns, raw in scan(path, _reporter(known_as, remarks)):
            if topics and channel.topic not in topics:
                continue
            if log_ns == last_ns and same > 0:
                same -= 1
            elif log_ns >= last_ns:
                yield channel, log_ns, raw

    def close() -> None:
        if reader.bio if kind == "ROS 1" else reader.is_open:
            reader.close()

    span_ns = (int(reader.start_time), int(reader.end_time) - 1) if reader.message_count else None
    return BagFile(known_as, kind, _compression(path, kind, reader), counts, remarks, span_ns, read, close)


def _open_scanned(path: Path, known_as: Path, kind: str, scan: Scan, reason: str) -> BagFile:
    counts: dict[BagChannel, int] = {}
    remarks = [f"{known_as}: is read record by record, because its index cannot be used: {reason}"]
    first_ns = last_ns = None
    for channel, log_ns, _ in scan(path, _reporter(known_as, remarks)):
        counts[channel] = counts.get(channel, 0) + 1
        first_ns = log_ns if first_ns is None else min(first_ns, log_ns)
        last_ns = log_ns if last_ns is None else max(last_ns, log_ns)
    if first_ns is None or last_ns is None:
        told = "; ".join(text.removeprefix(f"{known_as}: ") for text in remarks[1:3])
        raise FormatError(f"has no message that can be read: {reason}{'; ' if told else ''}{told}", str(known_as))

    def read(topics: Collection[str]) -> Iterator[Record]:
        # What is wrong was said when the messages were counted.
        for record in scan(path, lambda _text, _offset: None):
            if not topics or record[0].topic in topics:
                yield record

    return BagFile(known_as, kind, "unknown", counts, remarks, (first_ns, last_ns), read, lambda: None)


def _reporter(path: Path, remarks: list[str]) -> Callable[[str, int], None]:
    count = 0

    def report(text: str, offset: int) -> None:
        nonlocal count
        count += 1
        if count <= _MOST_REMARKS:
            remarks.append(f"{path}{f':{offset}' if offset >= 0 else ''}: {shown(text)}")
        elif count == _MOST_REMARKS + 1:
            remarks.append(f"{path}: and more of that kind")

    return report


def _key(connection: Any) -> int:
    return int(connection.id)


def _channel(connection: Any, kind: str) -> BagChannel:
    is_ros1 = kind == "ROS 1"
    form = connection.msgdef.format.name
    is_latched = (
        connection.ext.latching == 1
        if is_ros1
        else any(qos.durability.name == "TRANSIENT_LOCAL" for qos in connection.ext.offered_qos_profiles)
    )
    return BagChannel(
        connection.topic,
        full_msgtype(connection.msgtype),
        "ros1" if is_ros1 else "cdr",
        "" if form == "NONE" else connection.msgdef.data,
        "idl" if form == "IDL" else "msg",
        is_latched,
    )


def _compression(path: Path, kind: str, reader: Any) -> str:
    try:
        if kind == "ROS 1":
            return recovery.ros1_compression(path, [int(info.pos) for info in reader.chunk_infos])
        if kind == "ROS 2 mcap":
            chunks = [int(chunk.chunk_start_offset) for chunk in reader.storage.chunks]
            if found := mcap_compression(path, chunks):
                return found
        _, _, raw = next(iter(reader.messages()), (None, 0, b""))
    except Exception:  # what is broken is told when the messages are read
        return "unknown"
    return "zstd (messages)" if raw[:4] == _ZSTD else "none"


def _typestore(channels: tuple[BagChannel, ...]) -> Any:
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    types: dict[str, Any] = {}
    is_complete = True
    for channel in channels:
        try:
            if not channel.definition:
                is_complete = False
            elif channel.definition_kind == "msg":
                types.update(get_types_from_msg(channel.definition, channel.msgtype))
            else:
                for text in re.split(r"^={80}\nIDL: .*\n", channel.definition, flags=re.MULTILINE):
                    types.update(get_types_from_idl(text) if text.strip() else {})
        except Exception:  # a definition nobody can read; the standard ones may do
            is_complete = False
    if not is_complete:
        wires = {channel.wire for channel in channels}
        standard = get_typestore(Stores.ROS1_NOETIC if wires == {"ros1"} else Stores.ROS2_HUMBLE).fielddefs
        types = needed_types((channel.msgtype for channel in channels), {**standard, **types})
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store
