"""The pictures of a ROS bag as a camera: ROS 1 bags, ROS 2 bags in SQLite or MCAP."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from uvgs_bench.devices.cameras.base import ClosingSource
from uvgs_bench.devices.cameras.images import decode_image
from uvgs_bench.devices.cameras.spec import did_you_mean
from uvgs_bench.devices.clock import Clock
from uvgs_bench.errors import CaptureError, ConfigError
from uvgs_bench.sensor.capture import Capture, ImageArray
from uvgs_bench.units import NS_PER_S

if TYPE_CHECKING:
    from uvgs_bench.devices.cameras.spec import CameraSpec

_KINDS = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
# By encoding: bytes of a channel, channels, and whether red comes first.
_ENCODINGS: dict[str, tuple[int, int, bool]] = {
    "mono8": (1, 1, False),
    "8UC1": (1, 1, False),
    "mono16": (2, 1, False),
    "16UC1": (2, 1, False),
    "bgr8": (1, 3, False),
    "8UC3": (1, 3, False),
    "rgb8": (1, 3, True),
    "bgra8": (1, 4, False),
    "rgba8": (1, 4, True),
}
_ZSTD = b"\x28\xb5\x2f\xfd"


class BagImages(ClosingSource):
    """Image messages of one topic in order, stamped as their headers say.

    Args:
        spec: The spec string, for messages.
        path: The bag.
        reader: An open ``rosbags.highlevel.AnyReader``.
        topic: The topic.
    """

    def __init__(self, spec: str, path: Path, reader: Any, topic: str) -> None:
        self._connections = [found for found in reader.connections if found.topic == topic]
        super().__init__(spec, is_live=False, length=sum(found.msgcount for found in self._connections))
        self._path = path
        self._reader: Any | None = reader
        self._topic = topic
        self._messages: Iterator[Any] = iter(reader.messages(connections=self._connections))
        self._next = 0
        self._last_ns = -1

    @classmethod
    def open(cls, spec: CameraSpec, _clock: Clock) -> BagImages:
        """Open ``bag:FILE``, with the option ``topic`` where the bag has several topics of images.

        Raises:
            CaptureError: The file is missing, is no bag, or holds no images.
            ConfigError: An option is unknown, the topic is none of the bag's, or one must be chosen.
        """
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        spec.check_options(("topic",))
        path = Path(spec.target)
        if not spec.target or not path.exists():
            raise CaptureError("no such file, expected a ROS bag", spec.target or spec.text)
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        try:
            reader.open()
        except Exception as error:  # the reader has no common base of errors, and broken bags raise many
            raise CaptureError(f"is no ROS bag that can be read: {_line(error)}", str(path)) from None
        try:
            topic = _chosen_topic(reader, spec, path)
        except (CaptureError, ConfigError):
            reader.close()
            raise
        return cls(spec.text, path, reader, topic)

    def grab(self) -> Capture | None:
        """The next image, or None after the last.

        Raises:
            CaptureError: A message is broken, of an unknown encoding, or earlier than the one before.
        """
        if self._reader is None:
            return None
        name = f"{self._path.name}{self._topic}#{self._next}"
        try:
            connection, _, raw = next(self._messages)
            message = _message(self._reader, connection, bytes(raw))
        except StopIteration:
            self.close()
            return None
        except Exception as error:  # as above
            raise CaptureError(f"cannot be read: {_line(error)}", name) from None
        stamp = message.header.stamp
        t_ns = int(stamp.sec) * NS_PER_S + int(stamp.nanosec)
        if t_ns < self._last_ns:
            raise CaptureError("its header stamp is earlier than that of the image before", name)
        self._last_ns = t_ns
        is_packed = _normal(connection.msgtype) == _KINDS[1]
        image = decode_image(bytes(message.data), name) if is_packed else _pixels(message, name)
        capture = Capture(image, t_ns, name, self._next)
        self._next += 1
        return capture

    def close(self) -> None:
        """Release the file. Safe to call twice."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None


def _chosen_topic(reader: Any, spec: CameraSpec, path: Path) -> str:
    topics: list[str] = sorted({found.topic for found in reader.connections if _normal(found.msgtype) in _KINDS})
    if not topics:
        kinds = sorted({found.msgtype for found in reader.connections})
        raise CaptureError(f"holds no images, only {', '.join(kinds) or 'nothing'}", str(path))
    wanted = spec.options.get("topic", "")
    if not wanted:
        if len(topics) > 1:
            raise ConfigError(f"several topics of images, say ?topic= one of: {', '.join(topics)}", spec.text)
        return topics[0]
    if wanted not in topics:
        raise ConfigError(f"no topic '{wanted}' of images{did_you_mean(wanted, tuple(topics))}", spec.text)
    return wanted


def _message(reader: Any, connection: Any, raw: bytes) -> Any:
    """A message, unpacked first where each message was compressed on its own."""
    if raw.startswith(_ZSTD):
        # The reader's own dependency: part of the standard library from Python 3.14 on.
        module = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
        raw = import_module(module).decompress(raw)
    store, msgtype = reader.typestore, _normal(connection.msgtype)
    return store.deserialize_cdr(raw, msgtype) if reader.is2 else store.deserialize_ros1(raw, msgtype)


def _normal(msgtype: str) -> str:
    """A type name with its middle part, which some writers leave out."""
    package, _, name = msgtype.rpartition("/")
    return msgtype if package.endswith("/msg") else f"{package}/msg/{name}"


def _pixels(message: Any, name: str) -> ImageArray:
    """The pixels of a raw image, mono or BGR."""
    known = _ENCODINGS.get(message.encoding)
    if known is None:
        raise CaptureError(f"has encoding '{message.encoding}', expected one of {', '.join(_ENCODINGS)}", name)
    size, channels, is_red_first = known
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, dtype=np.uint8)
    used = width * channels * size
    if width < 1 or height < 1 or step < used or data.size < height * step:
        said = f"{width}x{height} px of {message.encoding} in rows of {step} bytes"
        raise CaptureError(f"says {said}, but holds {data.size} bytes", name)
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :used])
    kind = np.dtype(np.uint8 if size == 1 else ">u2" if message.is_bigendian else "<u2")
    image: Any = rows.view(kind).reshape(height, width, channels)
    image = image[:, :, 2::-1] if is_red_first else image[:, :, :3]
    plain = image[:, :, 0] if channels == 1 else image
    return cast("ImageArray", np.ascontiguousarray(plain, dtype=np.uint8 if size == 1 else np.uint16))


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
