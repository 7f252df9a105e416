"""ROS 1 bags, written: format 2.0, plain or bz2.

LZ4 is left out: Debian's rosbag reads only one of its many framings.

Source: ROS wiki, Bags/Format/2.0.
"""

from __future__ import annotations

import bz2
import os
import struct
from io import BytesIO
from pathlib import Path
from typing import Literal

from uvgs_bench.interop.bag_container import BagContainer, Channel, Chunk
from uvgs_bench.units import NS_PER_S

_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = (struct.pack("<B", op) for op in range(2, 8))
_HEADER_BYTES = 4096
_MAGIC = b"#ROSBAG V2.0\n"

Fields = dict[str, bytes]


class Ros1Container(BagContainer):
    """A ROS 1 bag that is being written.

    Args:
        path: The file.
        force: Whether an existing file may be replaced.
        compression: Of its chunks.

    Raises:
        ConfigError: It exists and may not be replaced.
        UvgsError: It cannot be written.
    """

    latest_ns = NS_PER_S * 2**32 - 1

    def __init__(self, path: Path, *, force: bool = False, compression: Literal["none", "bz2"] = "none") -> None:
        self._compression = compression
        # Of every whole chunk: where it starts, its first and last instant, messages by channel.
        self._chunks: list[tuple[int, int, int, dict[int, int]]] = []
        super().__init__(path, force=force)

    def _put_start(self) -> None:
        self._put(_MAGIC + self._bag_header(0, 0, 0))
        self._good_bytes = self._at()

    def _put_channel(self, channel: Channel, to: BytesIO) -> None:
        to.write(_connection(channel))

    def _put_message(self, channel: Channel, t_ns: int, payload: bytes | memoryview, to: BytesIO) -> None:
        to.write(_head({"op": _MESSAGE, "conn": _u32(channel.number), "time": _time(t_ns)}))
        to.write(_u32(len(payload)))
        to.write(payload)

    def _put_chunk(self, chunk: Chunk) -> None:
        at, plain = self._at(), chunk.data.getbuffer()
        compression = "none" if self.is_hurried else self._compression
        packed = bz2.compress(plain) if compression == "bz2" else plain
        self._put(_head({"op": _CHUNK, "compression": compression.encode(), "size": _u32(len(plain))}))
        self._put(_u32(len(packed)))
        self._put(packed)
        tail = BytesIO()
        for number, entries in chunk.index.items():
            rows = b"".join(_time(t) + _u32(offset) for t, offset in zip(entries[::2], entries[1::2], strict=True))
            count = len(entries) // 2
            tail.write(_head({"op": _INDEX, "ver": _u32(1), "conn": _u32(number), "count": _u32(count)}))
            tail.write(_u32(len(rows)) + rows)
        self._put(tail.getvalue())
        counts = {number: len(entries) // 2 for number, entries in chunk.index.items()}
        self._chunks.append((at, chunk.start_ns, chunk.end_ns, counts))

    def _put_end(self) -> None:
        index_at = self._at()
        tail = BytesIO()
        for channel in self.channels:
            tail.write(_connection(channel))
        for at, start_ns, end_ns, counts in self._chunks:
            head = {
                "op": _CHUNK_INFO,
                "ver": _u32(1),
                "chunk_pos": struct.pack("<Q", at),
                "start_time": _time(start_ns),
                "end_time": _time(end_ns),
                "count": _u32(len(counts)),
            }
            rows = b"".join(_u32(number) + _u32(count) for number, count in counts.items())
            tail.write(_head(head) + _u32(len(rows)) + rows)
        self._put(tail.getvalue())
        os.lseek(self._file, len(_MAGIC), os.SEEK_SET)
        self._put(self._bag_header(index_at, len(self.channels), len(self._chunks)))

    @staticmethod
    def _bag_header(index_at: int, channels: int, chunks: int) -> bytes:
        head = _head(
            {
                "op": _BAG,
                "index_pos": struct.pack("<Q", index_at),
                "conn_count": _u32(channels),
                "chunk_count": _u32(chunks),
            }
        )
        padding = _HEADER_BYTES - len(head) - 4
        return head + _u32(padding) + b" " * padding


def _connection(channel: Channel) -> bytes:
    package, _, name = channel.kind.name.partition("/msg/")
    body = _fields(
        {
            "topic": channel.topic.encode(),
            "type": f"{package}/{name}".encode(),
            "md5sum": channel.kind.digest.encode(),
            "message_definition": channel.kind.definition.encode(),
        }
    )
    head = _head({"op": _CONNECTION, "conn": _u32(channel.number), "topic": channel.topic.encode()})
    return head + _u32(len(body)) + body


def _head(fields: Fields) -> bytes:
    body = _fields(fields)
    return _u32(len(body)) + body


def _fields(fields: Fields) -> bytes:
    return b"".join(_u32(len(name) + 1 + len(value)) + name.encode() + b"=" + value for name, value in fields.items())


def _u32(value: int) -> bytes:
    return struct.pack("<I", value)


def _time(t_ns: int) -> bytes:
    return struct.pack("<II", *divmod(t_ns, NS_PER_S))
