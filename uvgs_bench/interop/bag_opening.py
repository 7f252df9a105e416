"""Open one file of a bag: by its index where there is a good one, record by record where not.

A file is known by its first bytes, not by its name. Compression is undone wherever it is.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Collection, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

from uvgs_bench.errors import FormatError
from uvgs_bench.interop import bag_recovery as recovery
from uvgs_bench.interop.bag_file import ZSTD, BagFile, one_line, reporter
from uvgs_bench.interop.bag_framing import BagChannel, Record, full_msgtype, shown, unpack_file
from uvgs_bench.interop.mcap_recovery import MCAP_MAGIC, mcap_compression, scan_mcap

Scan = Callable[[Path, Callable[[str, int], None]], Iterator[Record]]


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
    if start.startswith(ZSTD):
        return _open_packed(path)
    if start.startswith(recovery.ROS1_MAGIC):
        return _open_indexed(path, path, "ROS 1", recovery.scan_ros1)
    if start.startswith(MCAP_MAGIC):
        return _open_indexed(path, path, "ROS 2 mcap", scan_mcap)
    if start.startswith(recovery.SQLITE_MAGIC):
        return _open_indexed(path, path, "ROS 2 sqlite3", recovery.scan_sqlite)
    if start.startswith(b"#ROSBAG V"):
        raise FormatError(
            f"is a ROS bag of version {shown(start[9:13].decode('ascii', 'replace'))}, expected 2.0", str(path)
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
    span_ns = (int(reader.start_time), int(reader.end_time) - 1) if reader.message_count else None
    compression = _compression(path, kind, reader, scan)
    if _is_in_order(kind, reader):
        # An hour of pictures has a chunk each: reading on from chunk to chunk needs no index in memory.
        reader.close()
        reading = _InOrder(path, known_as, scan, counts, remarks)
        return BagFile(known_as, kind, compression, counts, remarks, span_ns, reading.read, lambda: None)
    merging = _ByIndex(path, known_as, scan, reader, channels, remarks)
    return BagFile(known_as, kind, compression, counts, remarks, span_ns, merging.read, merging.close)


def _is_in_order(kind: str, reader: Any) -> bool:
    """Whether the chunks of a bag follow one another in time as they do in the file."""
    if kind == "ROS 1":
        spans = sorted((info.pos, info.start_time, info.end_time - 1) for info in reader.chunk_infos)
    elif kind == "ROS 2 mcap":
        chunks = reader.storage.chunks
        spans = sorted(
            (c.chunk_start_offset, c.message_start_time, c.message_end_time) for c in chunks if c.channel_count
        )
    else:
        return False
    return bool(spans) and all(before[2] <= after[1] for before, after in pairwise(spans))


class _InOrder:
    """Messages from chunk to chunk as they are in the file, under the channels its index knows."""

    def __init__(
        self, path: Path, known_as: Path, scan: Scan, counts: dict[BagChannel, int], remarks: list[str]
    ) -> None:
        self._path, self._known_as, self._scan, self._remarks = path, known_as, scan, remarks
        self._counts = counts
        self._channels = {(channel.topic, channel.msgtype): channel for channel in counts}

    def read(self, topics: Collection[str]) -> Iterator[Record]:
        """Messages of the topics, of all when empty."""
        said = sum(count for channel, count in self._counts.items() if not topics or channel.topic in topics)
        count = 0
        if said == 0:
            return
        for channel, log_ns, raw in self._scan(self._path, reporter(self._known_as, self._remarks)):
            if not topics or channel.topic in topics:
                count += 1
                yield self._channels.get((channel.topic, channel.msgtype), channel), log_ns, raw
        _compare(said, count, self._known_as, self._remarks)


class _ByIndex:
    """Messages in order of time through the library's reader; what comes after a broken place, record by record."""

    def __init__(
        self,
        path: Path,
        known_as: Path,
        scan: Scan,
        reader: Any,
        channels: dict[int, BagChannel],
        remarks: list[str],
    ) -> None:
        self._path, self._known_as, self._scan, self._remarks = path, known_as, scan, remarks
        self._reader = reader
        self._channels = channels
        self._is_open = True

    def read(self, topics: Collection[str]) -> Iterator[Record]:
        """Messages of the topics, of all when empty."""
        wanted = [found for found in self._reader.connections if not topics or found.topic in topics]
        if not wanted:
            return
        last_ns, same, count = -1, 0, 0
        try:
            for found, log_ns, raw in self._reader.messages(connections=wanted):
                same = same + 1 if log_ns == last_ns else 1
                last_ns = log_ns
                count += 1
                yield self._channels[_key(found)], log_ns, raw
        except Exception as error:  # broken bags raise whatever their bytes lead to
            self._remarks.append(
                f"{self._known_as}: breaks off in its index ({one_line(error)}); the rest is read record by record"
            )
        else:
            _compare(sum(found.msgcount for found in wanted), count, self._known_as, self._remarks)
            return
        for channel, log_ns, raw in self._scan(self._path, reporter(self._known_as, self._remarks)):
            if topics and channel.topic not in topics:
                continue
            if log_ns == last_ns and same > 0:
                same -= 1
            elif log_ns >= last_ns:
                yield channel, log_ns, raw

    def close(self) -> None:
        """Release the file. Safe to call twice."""
        if self._is_open:
            self._is_open = False
            self._reader.close()


def _compare(said: int, count: int, path: Path, remarks: list[str]) -> None:
    text = f"{path}: its index says {said} messages, but {count} are there"
    if count != said and text not in remarks:
        remarks.append(text)


def _open_scanned(path: Path, known_as: Path, kind: str, scan: Scan, reason: str) -> BagFile:
    counts: dict[BagChannel, int] = {}
    remarks = [f"{known_as}: is read record by record, because its index cannot be used: {reason}"]
    first_ns = last_ns = None
    for channel, log_ns, _ in scan(path, reporter(known_as, remarks)):
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
        connection.digest,
    )


def _compression(path: Path, kind: str, reader: Any, scan: Scan) -> str:
    try:
        if kind == "ROS 1":
            return recovery.ros1_compression(path, [int(info.pos) for info in reader.chunk_infos])
        if kind == "ROS 2 mcap":
            chunks = [int(chunk.chunk_start_offset) for chunk in reader.storage.chunks]
            if found := mcap_compression(path, chunks):
                return found
        # Not through the reader, which prepares all chunks before the first message.
        _, _, raw = next(scan(path, lambda _text, _offset: None), (None, 0, b""))
    except Exception:  # what is broken is told when the messages are read
        return "unknown"
    return "zstd (messages)" if raw[:4] == ZSTD else "none"
