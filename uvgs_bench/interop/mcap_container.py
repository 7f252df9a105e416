"""ROS 2 bags in MCAP, written: one file, plain or with zstd, with the metadata of rosbag2 version 9 inside.

Source: mcap.dev, MCAP format specification; rosbag2 metadata version 9.
"""

from __future__ import annotations

import struct
import sys
from importlib import import_module
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any, Literal
from zlib import crc32

from uvgs_bench import __version__
from uvgs_bench.interop.bag_container import BagContainer, Channel, Chunk
from uvgs_bench.units import NS_PER_S

_MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = range(1, 7)
_MESSAGE_INDEX, _CHUNK_INDEX, _STATISTICS, _METADATA, _METADATA_INDEX = 0x07, 0x08, 0x0B, 0x0C, 0x0D
_SUMMARY_OFFSET, _DATA_END = 0x0E, 0x0F
# Pictures are mostly dark: more effort gains little.
_LEVEL = 1


class McapContainer(BagContainer):
    """An MCAP file that is being written.

    Args:
        path: The file.
        force: Whether an existing file may be replaced.
        compression: Of its chunks.

    Raises:
        ConfigError: It exists and may not be replaced.
        UvgsError: It cannot be written.
    """

    latest_ns = NS_PER_S * 2**31 - 1

    def __init__(self, path: Path, *, force: bool = False, compression: Literal["none", "zstd"] = "none") -> None:
        # The reader's own dependency: part of the standard library from Python 3.14 on.
        name = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
        self._zstd: Any | None = import_module(name) if compression == "zstd" else None
        self._schemas: dict[str, int] = {}
        self._sequence: list[int] = []
        self._counts: list[int] = []
        self._chunks: list[bytes] = []
        self._start_ns = self._end_ns = 0
        super().__init__(path, force=force)

    def _put_start(self) -> None:
        self._put(_MAGIC + _record(_HEADER, _text("ros2") + _text(f"uvgs_bench-{__version__}")))
        self._good_bytes = self._at()

    def _put_channel(self, channel: Channel, to: BytesIO) -> None:
        if channel.kind.name not in self._schemas:
            self._schemas[channel.kind.name] = len(self._schemas) + 1
            to.write(self._schema(channel))
        self._sequence.append(0)
        self._counts.append(0)
        to.write(self._channel(channel))

    def _put_message(self, channel: Channel, t_ns: int, payload: bytes | memoryview, to: BytesIO) -> None:
        number = channel.number
        to.write(struct.pack("<BQHIQQ", _MESSAGE, len(payload) + 22, number, self._sequence[number], t_ns, t_ns))
        to.write(payload)
        self._sequence[number] += 1

    def _put_chunk(self, chunk: Chunk) -> None:
        at, plain = self._at(), chunk.data.getbuffer()
        zstd = None if self.is_hurried else self._zstd
        name = "zstd" if zstd else ""
        packed = zstd.compress(plain, _LEVEL) if zstd else plain
        head = struct.pack("<QQQI", chunk.start_ns, chunk.end_ns, len(plain), crc32(plain)) + _text(name)
        self._put(struct.pack("<BQ", _CHUNK, len(head) + 8 + len(packed)) + head + struct.pack("<Q", len(packed)))
        self._put(packed)
        index_at = self._at()
        tail, offsets = BytesIO(), b""
        for number, entries in chunk.index.items():
            offsets += struct.pack("<HQ", number, index_at + tail.tell())
            rows = entries.tobytes() if sys.byteorder == "little" else struct.pack(f"<{len(entries)}Q", *entries)
            tail.write(_record(_MESSAGE_INDEX, struct.pack("<HI", number, len(rows)) + rows))
        self._put(tail.getvalue())
        self._chunks.append(
            struct.pack("<QQQQ", chunk.start_ns, chunk.end_ns, at, index_at - at)
            + struct.pack("<I", len(offsets)) + offsets
            + struct.pack("<Q", tail.tell()) + _text(name)
            + struct.pack("<QQ", len(packed), len(plain))
        )  # fmt: skip
        if chunk.index:
            is_first = not any(self._counts)
            self._start_ns = chunk.start_ns if is_first else min(self._start_ns, chunk.start_ns)
            self._end_ns = chunk.end_ns if is_first else max(self._end_ns, chunk.end_ns)
        for number, entries in chunk.index.items():
            self._counts[number] += len(entries) // 2

    def _put_end(self) -> None:
        at = self._at()
        metadata = _text("rosbag2") + _map({"serialized_metadata": self._rosbag2()})
        data = _record(_METADATA, metadata)
        data_end = _record(_DATA_END, struct.pack("<I", 0))
        summary_at = at + len(data) + len(data_end)
        seen: set[str] = set()
        schemas = [self._schema(c) for c in self.channels if not (c.kind.name in seen or seen.add(c.kind.name))]  # type: ignore[func-returns-value]
        counts = b"".join(struct.pack("<HQ", number, count) for number, count in enumerate(self._counts))
        statistics = struct.pack(
            "<QHIIIIQQI", sum(self._counts), len(schemas), len(self.channels), 0, 1, len(self._chunks),
            self._start_ns, self._end_ns, len(counts),
        )  # fmt: skip
        groups = (
            (_SCHEMA, b"".join(schemas)),
            (_CHANNEL, b"".join(self._channel(channel) for channel in self.channels)),
            (_STATISTICS, _record(_STATISTICS, statistics + counts)),
            (_CHUNK_INDEX, b"".join(_record(_CHUNK_INDEX, chunk) for chunk in self._chunks)),
            (_METADATA_INDEX, _record(_METADATA_INDEX, struct.pack("<QQ", at, len(data)) + _text("rosbag2"))),
        )
        summary, offsets = b"", b""
        for operation, group in groups:
            if group:
                place = struct.pack("<BQQ", operation, summary_at + len(summary), len(group))
                offsets += _record(_SUMMARY_OFFSET, place)
                summary += group
        footer = struct.pack("<BQQQ", _FOOTER, 20, summary_at, summary_at + len(summary))
        checked = summary + offsets + footer
        self._put(data + data_end + checked + struct.pack("<I", crc32(checked)) + _MAGIC)

    def _schema(self, channel: Channel) -> bytes:
        kind = channel.kind
        number = struct.pack("<H", self._schemas[kind.name])
        return _record(_SCHEMA, number + _text(kind.name) + _text("ros2msg") + _text(kind.definition))

    def _channel(self, channel: Channel) -> bytes:
        head = struct.pack("<HH", channel.number, self._schemas[channel.kind.name])
        named = _text(channel.topic) + _text("cdr")
        return _record(_CHANNEL, head + named + _map({"offered_qos_profiles": ""}))

    def _rosbag2(self) -> str:
        from ruamel.yaml import YAML

        count, duration = sum(self._counts), {"nanoseconds": self._end_ns - self._start_ns}
        start = {"nanoseconds_since_epoch": self._start_ns}
        name = self.path.name
        topics = [
            {
                "topic_metadata": {
                    "name": channel.topic,
                    "type": channel.kind.name,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [],
                    "type_description_hash": channel.kind.digest,
                },
                "message_count": count,
            }
            for channel, count in zip(self.channels, self._counts, strict=True)
        ]
        document = {
            "version": 9,
            "storage_identifier": "mcap",
            "relative_file_paths": [name],
            "duration": duration,
            "starting_time": start,
            "message_count": count,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": name, "starting_time": start, "duration": duration, "message_count": count}],
            "custom_data": None,
            "ros_distro": "uvgs_bench",
        }
        yaml = YAML(typ="safe", pure=True)
        yaml.default_flow_style = False
        stream = StringIO()
        yaml.dump(document, stream)
        return stream.getvalue().strip()


def _record(operation: int, body: bytes) -> bytes:
    return struct.pack("<BQ", operation, len(body)) + body


def _text(value: str) -> bytes:
    payload = value.encode()
    return struct.pack("<I", len(payload)) + payload


def _map(values: dict[str, str]) -> bytes:
    body = b"".join(_text(key) + _text(value) for key, value in values.items())
    return struct.pack("<I", len(body)) + body
