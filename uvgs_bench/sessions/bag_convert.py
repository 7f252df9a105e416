"""Bags as bags of another container, compression or ROS; messages are kept, only their wrapping changes."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Collection, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uvgs_bench.errors import ConfigError, FormatError, UvgsError
from uvgs_bench.interop.bag_file import one_line
from uvgs_bench.interop.bags import open_bags
from uvgs_bench.interop.message_migration import Migration
from uvgs_bench.sessions.events import EventSink, Remark, StageAdvanced, StageFinished, StageStarted
from uvgs_bench.sessions.interruption import check_interruption
from uvgs_bench.units import NS_PER_S

if TYPE_CHECKING:
    from uvgs_bench.interop.bag_file import BagFile, BagMessage
    from uvgs_bench.interop.bag_framing import BagChannel

STAGE = "convert"
_TELL_EVERY = 50
# By whether it is ROS 2: first instant its formats have no place for, ns.
_LATEST_NS = {False: NS_PER_S * 2**32, True: 2**63}
# By ending of the target: format, and what may be asked of its compression.
_TARGETS = {
    ".bag": ("ROS 1", ("none", "bz2", "lz4")),
    ".mcap": ("mcap", ("none", "zstd")),
    ".db3": ("sqlite3", ("none",)),
    "": ("folder", ("none", "zstd", "messages", "file")),
}
COMPRESSIONS = ("none", "bz2", "lz4", "zstd", "messages", "file")
"""Names of compressions; ``messages`` and ``file`` are zstd of single messages and of whole files, in folders."""


@dataclass(frozen=True, slots=True)
class Converted:
    """What was written.

    Args:
        path: The new bag.
        kind: Its format.
        messages: Messages in it.
        topics: Messages by topic.
        remarks: What was damaged, lost on the way or left out.
    """

    path: Path
    kind: str
    messages: int
    topics: dict[str, int]
    remarks: tuple[str, ...]


def check_target(path: Path, compression: str, storage: str) -> None:
    """Refuse a target before the work.

    Args:
        path: The bag to write.
        compression: One of ``COMPRESSIONS``.
        storage: ``mcap`` or ``sqlite3``, for a folder.

    Raises:
        ConfigError: The ending is unknown, or the format has no such compression.
    """
    if path.suffix not in _TARGETS:
        raise ConfigError("expected an ending .bag, .mcap or .db3, or a folder without one", str(path))
    kind, known = _TARGETS[path.suffix]
    if compression not in known:
        raise ConfigError(f"{kind} has no compression '{compression}', expected one of: {', '.join(known)}", str(path))
    if kind == "folder" and storage == "sqlite3" and compression == "zstd":
        raise ConfigError("sqlite3 compresses messages or the file, not chunks: say messages or file", str(path))


def convert_bags(
    paths: Sequence[Path | str],
    target: Path,
    sink: EventSink,
    *,
    compression: str = "none",
    storage: str = "mcap",
    topics: Collection[str] = (),
    force: bool = False,
) -> Converted:
    """Write bags anew.

    Args:
        paths: Files or folders; several become one.
        target: ``*.bag`` is ROS 1, ``*.mcap`` and ``*.db3`` are ROS 2 files, a name without an ending a rosbag2 folder.
        sink: Told about progress, damage and what is lost.
        compression: One of ``COMPRESSIONS``.
        storage: ``mcap`` or ``sqlite3``, for a folder.
        topics: Only these; all when empty.
        force: Whether an existing bag may be replaced.

    Returns:
        What was written.

    Raises:
        FormatError: A bag cannot be read, or nothing of it can be written.
        ConfigError: The target exists or is impossible, or a topic is not there.
        UvgsError: It cannot be written.
    """
    check_target(target, compression, storage)
    if target.exists() and not force:
        raise ConfigError("exists already; use --force to replace it", str(target))
    if any(Path(path).resolve() == target.resolve() for path in paths):
        raise ConfigError("is the bag that is read; choose another name", str(target))
    with ExitStack() as stack:
        bags = stack.enter_context(open_bags(paths))
        if unknown := sorted(set(topics) - set(bags.counts)):
            raise ConfigError(f"no topic {unknown[0]}, expected of: {', '.join(bags.counts)}", "--topic")
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            room = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=".uvgs-convert-", dir=target.parent)))
            writing = _Writing(room / target.name, target.suffix, compression, storage)
            total = sum(count for topic, count in bags.counts.items() if not topics or topic in topics)
            sink(StageStarted(STAGE, total))
            stack.callback(writing.abandon)
            for done, message in enumerate(bags.messages(topics), 1):
                check_interruption()
                writing.write(message)
                if done % _TELL_EVERY == 0:
                    sink(StageAdvanced(STAGE, done, message.channel.topic))
            written = writing.close()
            remarks = (*bags.remarks, *writing.remarks)
            for text in remarks:
                sink(Remark("warning", text))
            if not writing.counts:
                raise FormatError("nothing could be written", str(target))
            _replace(written, target)
        except OSError as error:
            raise UvgsError(f"{target}: cannot be written: {error.strerror or error}") from None
    sink(StageFinished(STAGE, f"{sum(writing.counts.values())} messages"))
    kind = (
        "ROS 1" if target.suffix == ".bag" else f"ROS 2 {storage if not target.suffix else _TARGETS[target.suffix][0]}"
    )
    return Converted(target, kind, sum(writing.counts.values()), dict(sorted(writing.counts.items())), remarks)


def _replace(written: Path, target: Path) -> None:
    """Put the new bag in the place of the old one, which goes only now."""
    if target.is_dir():
        shutil.rmtree(target)
    elif target.exists() and written.is_dir():
        target.unlink()
    written.replace(target)


class _Writing:
    """A bag that is being written, and what is needed to fit messages into it."""

    def __init__(self, path: Path, suffix: str, compression: str, storage: str) -> None:
        self._is_ros2 = suffix != ".bag"
        self._path = path
        self._suffix = suffix
        self.counts: dict[str, int] = {}
        self.remarks: list[str] = []
        self._migrations: dict[int, Migration] = {}
        self._connections: dict[tuple[int, BagChannel], Any] = {}
        self._refused: set[BagChannel] = set()
        self._writer = self._open(compression, "sqlite3" if suffix == ".db3" else "mcap" if suffix else storage)

    def _open(self, compression: str, storage: str) -> Any:
        from rosbags import rosbag1, rosbag2
        from rosbags.rosbag2.enums import CompressionFormat, CompressionMode

        if not self._is_ros2:
            writer: Any = rosbag1.Writer(self._path)
            if compression != "none":
                writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
        else:
            plugin = rosbag2.StoragePlugin.SQLITE3 if storage == "sqlite3" else rosbag2.StoragePlugin.MCAP
            # The library writes folders; a file is taken out of one, and must bear its name.
            writer = rosbag2.Writer(self._path.with_suffix(""), version=9, storage_plugin=plugin)
            modes = {"zstd": CompressionMode.STORAGE, "messages": CompressionMode.MESSAGE, "file": CompressionMode.FILE}
            if compression in modes:
                writer.set_compression(modes[compression], CompressionFormat.ZSTD)
        writer.open()
        return writer

    def write(self, message: BagMessage) -> None:
        """Write a message, or leave it out when its type has no form in the target."""
        channel = message.channel
        if channel in self._refused:
            return
        try:
            connection, raw = self._fitted(message)
        except Exception as error:  # definitions of others may be anything
            self._refused.add(channel)
            self.remarks.append(f"{channel.topic} ({channel.msgtype}) is left out from here on: {one_line(error)}")
            return
        try:
            self._writer.write(connection, message.log_ns, raw)
        except sqlite3.Error as error:
            raise UvgsError(f"{self._path.name}: cannot be written: {one_line(error)}") from None
        self.counts[channel.topic] = self.counts.get(channel.topic, 0) + 1

    def _fitted(self, message: BagMessage) -> tuple[Any, Any]:
        """Where a message goes, and its bytes there."""
        channel, file = message.channel, message.file
        if not 0 <= message.log_ns < _LATEST_NS[self._is_ros2]:
            raise FormatError(f"has no place for the instant {message.log_ns} ns", channel.topic)
        is_same = (channel.wire == "cdr") == self._is_ros2
        raw: Any = message.raw
        if not is_same:
            migration = self._migration(file)
            fitted = migration.message(message.decode(), channel.msgtype)
            name, store = migration.name(channel.msgtype), migration.store
            raw = store.serialize_cdr(fitted, name) if self._is_ros2 else store.serialize_ros1(fitted, name)
        return self._connection(file, channel, is_same), raw

    def close(self) -> Path:
        """Finish it; the answer is the file or folder to move."""
        try:
            self._writer.close()
        except sqlite3.Error as error:
            raise UvgsError(f"{self._path.name}: cannot be written: {one_line(error)}") from None
        if not self._suffix or not self._is_ros2:
            return self._path
        folder = self._path.with_suffix("")
        return next(found for found in folder.iterdir() if found.suffix == self._suffix)

    def abandon(self) -> None:
        """Release the files when it was not finished; harmless when it was."""
        if self._is_ros2:
            self._writer.abort()
        elif self._writer.bio is not None:
            self._writer.bio.close()

    def _migration(self, file: BagFile) -> Migration:
        key = id(file)
        if key not in self._migrations:
            self._migrations[key] = Migration(file.typestore, is_to_ros2=self._is_ros2, tell=self.remarks.append)
        return self._migrations[key]

    def _connection(self, file: BagFile, channel: BagChannel, is_same: bool) -> Any:
        key = (id(file), channel)
        if key in self._connections:
            return self._connections[key]
        store = file.typestore if is_same else self._migration(file).store
        name = channel.msgtype if is_same else Migration.name(channel.msgtype)
        for known in self._connections.values():
            if known.topic == channel.topic and known.msgtype == name:
                self._connections[key] = known
                return known
        if self._is_ros2:
            found = self._writer.add_connection(
                channel.topic, name, typestore=store, offered_qos_profiles=_qos(channel.is_latched)
            )
        else:
            latching = 1 if channel.is_latched else None
            found = self._writer.add_connection(channel.topic, name, typestore=store, latching=latching)
        self._connections[key] = found
        return found


def _qos(is_latched: bool) -> list[Any]:
    """How rosbag2 says that late subscribers get the last message."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    if not is_latched:
        return []
    ever = QosTime(2147483647, 4294967295)
    kept = (QosHistory.UNKNOWN, 0, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL)
    return [Qos(*kept, ever, ever, QosLiveliness.AUTOMATIC, ever, False)]
