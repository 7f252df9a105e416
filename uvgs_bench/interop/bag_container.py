"""What the files of ROS 1 and ROS 2 bags have in common when they are written: chunks, and a disk that may fill up.

Messages gather in memory and go to disk as a chunk when it is large or a second long, so that a program that is killed
loses a second. When the disk is full, what does not fit is cut off, the index of the rest is written where it fits,
and one line says so: the file stays a bag.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from array import array
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from uvgs_bench.errors import ConfigError, FormatError, UvgsError
from uvgs_bench.units import NS_PER_S

_CHUNK_BYTES = 1 << 20
_CHUNK_NS = NS_PER_S


@dataclass(frozen=True, slots=True)
class MessageKind:
    """A type of messages as a bag describes it.

    Args:
        name: ``package/msg/Name``.
        definition: Its text with those of the types in it.
        digest: ROS 1: MD5 sum; ROS 2: RIHS01 hash.
    """

    name: str
    definition: str
    digest: str


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic in a bag.

    Args:
        number: Its number in the file.
        topic: Its name.
        kind: Its messages.
    """

    number: int
    topic: str
    kind: MessageKind


class Chunk:
    """Records that wait for being written.

    Args:
        number: How many chunks came before.
    """

    __slots__ = ("data", "end_ns", "index", "number", "start_ns")

    def __init__(self, number: int) -> None:
        self.number = number
        self.data = BytesIO()
        self.start_ns = self.end_ns = 0
        # By channel: instant and offset, one after the other.
        self.index: dict[int, array[int]] = {}

    def note(self, channel: int, t_ns: int) -> None:
        """Remember that the next record is a message."""
        is_first = not self.index
        self.start_ns = t_ns if is_first else min(self.start_ns, t_ns)
        self.end_ns = t_ns if is_first else max(self.end_ns, t_ns)
        self.index.setdefault(channel, array("Q")).extend((t_ns, self.data.tell()))

    @property
    def is_full(self) -> bool:
        """Whether it should be written now."""
        return self.data.tell() >= _CHUNK_BYTES or self.end_ns - self.start_ns >= _CHUNK_NS


class BagContainer(ABC):
    """A bag that is being written.

    Args:
        path: The file.
        force: Whether an existing file may be replaced.

    Raises:
        ConfigError: It exists and may not be replaced.
        UvgsError: It cannot be written.
    """

    latest_ns = 0
    """Latest instant the format has a place for, ns."""
    is_hurried = False
    """Set while messages come faster than chunks are compressed: then they are written as they are."""

    def __init__(self, path: Path, *, force: bool = False) -> None:
        if path.exists() and not force:
            raise ConfigError("exists already; use --force to replace it", str(path))
        self.path = path
        self.channels: list[Channel] = []
        self._chunk = Chunk(0)
        self._good_bytes = 0
        self._is_open = True
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # Without a buffer: after a failure it is known what the file holds.
            self._file = os.open(path, os.O_CREAT | os.O_RDWR | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise UvgsError(f"{path}: cannot be written: {error.strerror or error}") from None
        self._guarded(self._put_start)

    def add(self, topic: str, kind: MessageKind) -> Channel:
        """Begin a topic.

        Args:
            topic: Its name.
            kind: Its messages.

        Returns:
            What ``write`` wants.
        """
        channel = Channel(len(self.channels), topic, kind)
        self.channels.append(channel)
        self._put_channel(channel, self._chunk.data)
        return channel

    def write(self, channel: Channel, t_ns: int, payload: bytes | memoryview) -> None:
        """Append a message.

        Args:
            channel: Its topic.
            t_ns: Its instant, ns.
            payload: The serialized message.

        Raises:
            FormatError: The format has no place for the instant.
            UvgsError: The disk is full; the file ends before this chunk and is closed.
        """
        if not 0 <= t_ns <= self.latest_ns:
            raise FormatError(f"has no place for the instant {t_ns} ns", str(self.path))
        if not self._is_open:
            raise UvgsError(f"{self.path}: was closed before, nothing more can be written")
        self._chunk.note(channel.number, t_ns)
        self._put_message(channel, t_ns, payload, self._chunk.data)
        if self._chunk.is_full:
            self._guarded(self._flush)

    def flush(self) -> None:
        """Put what waits on disk now. Raises UvgsError when the disk is full."""
        if self._is_open:
            self._guarded(self._flush)

    def close(self) -> None:
        """Write what waits and the index. Safe to call twice. Raises UvgsError when the disk is full."""
        if self._is_open:
            self._guarded(self._finish)
            self._shut()

    def _finish(self) -> None:
        self._flush()
        self._put_end()

    def _flush(self) -> None:
        if self._chunk.data.tell():
            self._put_chunk(self._chunk)
            self._good_bytes = os.lseek(self._file, 0, os.SEEK_CUR)
            self._chunk = Chunk(self._chunk.number + 1)

    def _guarded(self, work: object) -> None:
        assert callable(work)
        try:
            work()
        except OSError as error:
            self._rescue()
            raise UvgsError(
                f"{self.path}: cannot be written: {error.strerror or error}; it ends where there was no more room"
            ) from None

    def _rescue(self) -> None:
        """Cut off what is torn, then the index if it fits."""
        try:
            os.ftruncate(self._file, self._good_bytes)
            os.lseek(self._file, self._good_bytes, os.SEEK_SET)
            self._put_end()
        except OSError:
            # Whole chunks without an index can still be read by a reader that scans.
            with suppress(OSError):
                os.ftruncate(self._file, self._good_bytes)
        self._shut()

    def _shut(self) -> None:
        if self._is_open:
            self._is_open = False
            os.close(self._file)

    def _put(self, payload: bytes | memoryview) -> None:
        """All of it or an OSError."""
        left = memoryview(payload).cast("B")
        while left:
            left = left[os.write(self._file, left) :]

    def _at(self) -> int:
        return os.lseek(self._file, 0, os.SEEK_CUR)

    @abstractmethod
    def _put_start(self) -> None:
        """Write what comes before the first chunk."""

    @abstractmethod
    def _put_channel(self, channel: Channel, to: BytesIO) -> None:
        """Append the records of a topic."""

    @abstractmethod
    def _put_message(self, channel: Channel, t_ns: int, payload: bytes | memoryview, to: BytesIO) -> None:
        """Append the record of a message."""

    @abstractmethod
    def _put_chunk(self, chunk: Chunk) -> None:
        """Write a chunk and what follows it; remember what the end needs of it once it is whole."""

    @abstractmethod
    def _put_end(self) -> None:
        """Write what comes after the last whole chunk."""
