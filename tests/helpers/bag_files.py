"""Bags for tests: the same messages in every container."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from uvgs_bench.camera import Lens
from uvgs_bench.interop.ros_messages import camera_info_from_lens, compressed_from_image, message_fields_from_image

ROS1_KINDS = ("ros1", "ros1-bz2", "ros1-lz4")
ROS2_KINDS = (
    "mcap",
    "mcap-zstd",
    "mcap-dir",
    "mcap-message",
    "mcap-file",
    "mcap-file-lone",
    "db3",
    "db3-dir",
    "db3-message",
    "db3-file",
    "dir-without-metadata",
)
KINDS = ROS1_KINDS + ROS2_KINDS


@dataclass(frozen=True)
class Note:
    """One message to write: fields besides the header by name, or how to make one from the type store."""

    topic: str
    msgtype: str
    stamp_ns: int
    fields: dict[str, Any]
    log_ns: int | None = None
    frame: str = "cam"


def image_note(image: np.ndarray, stamp_ns: int, topic: str = "/cam/image_raw", log_ns: int | None = None) -> Note:
    fields = message_fields_from_image(image)
    names = ("height", "width", "encoding", "is_bigendian", "step", "data")
    return Note(topic, "sensor_msgs/msg/Image", stamp_ns, {name: getattr(fields, name) for name in names}, log_ns)


def png_note(image: np.ndarray, stamp_ns: int, topic: str = "/cam/image_raw/compressed") -> Note:
    image_format, data = compressed_from_image(image)
    return Note(topic, "sensor_msgs/msg/CompressedImage", stamp_ns, {"format": image_format, "data": data})


def camera_info_note(lens: Lens, stamp_ns: int, topic: str = "/cam/camera_info", **changes: Any) -> Note:
    said = camera_info_from_lens(lens)
    fields = {name: getattr(said, name) for name in ("height", "width", "distortion_model")}
    fields |= {name: np.array(getattr(said, name), dtype=np.float64) for name in "dkrp"}
    return Note(topic, "sensor_msgs/msg/CameraInfo", stamp_ns, fields | changes)


def write_bag(folder: Path, kind: str, notes: Sequence[Note], name: str = "a", **options: Any) -> Path:
    """Write the notes as a bag of a kind; the answer is what a user would name."""
    from rosbags.typesys import Stores, get_typestore

    folder.mkdir(parents=True, exist_ok=True)
    is_ros1 = kind in ROS1_KINDS
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    options.pop("types", lambda _store: None)(store)
    path = folder / (f"{name}.bag" if is_ros1 else name)
    writer = _writer(path, kind, **options)
    with writer:
        connections: dict[str, Any] = {}
        for note in notes:
            if note.topic not in connections:
                connections[note.topic] = writer.add_connection(note.topic, note.msgtype, typestore=store)
            message = _message(store, note, is_ros1)
            raw = (store.serialize_ros1 if is_ros1 else store.serialize_cdr)(message, note.msgtype)
            writer.write(connections[note.topic], note.stamp_ns if note.log_ns is None else note.log_ns, raw)
    if kind in ("mcap", "mcap-zstd", "db3", "mcap-file-lone"):
        return next(found for found in path.iterdir() if found.name != "metadata.yaml")
    if kind == "dir-without-metadata":
        (path / "metadata.yaml").unlink()
    return path


def _writer(path: Path, kind: str, **options: Any) -> Any:
    from rosbags import rosbag1, rosbag2
    from rosbags.rosbag2.enums import CompressionFormat, CompressionMode

    if kind in ROS1_KINDS:
        path.unlink(missing_ok=True)
        writer: Any = rosbag1.Writer(path)
        if "-" in kind:
            writer.set_compression(rosbag1.Writer.CompressionFormat[kind.partition("-")[2].upper()])
        writer.chunk_threshold = options.get("chunk_bytes", writer.chunk_threshold)
        return writer
    shutil.rmtree(path, ignore_errors=True)
    plugin = rosbag2.StoragePlugin.SQLITE3 if kind.startswith("db3") else rosbag2.StoragePlugin.MCAP
    writer = rosbag2.Writer(path, version=options.get("version", 9), storage_plugin=plugin)
    word = kind.split("-")[1] if "-" in kind else ""
    mode = {"zstd": CompressionMode.STORAGE, "message": CompressionMode.MESSAGE, "file": CompressionMode.FILE}.get(word)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    return writer


def _message(store: Any, note: Note, is_ros1: bool) -> Any:
    time = store.types["builtin_interfaces/msg/Time"](*divmod(note.stamp_ns, 10**9))
    header = store.types["std_msgs/msg/Header"]
    stamped = header(0, time, note.frame) if is_ros1 else header(time, note.frame)
    kind = store.types[note.msgtype]
    fields: dict[str, Any] = {}
    for name in kind.__dataclass_fields__:
        if name == "header":
            fields[name] = stamped
        elif name in note.fields or name.lower() in note.fields:
            value = note.fields.get(name, note.fields.get(name.lower()))
            fields[name] = value(store) if callable(value) else value
        elif name == "roi":
            fields[name] = store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        elif name in ("binning_x", "binning_y"):
            fields[name] = 0
        elif name != "__msgtype__":
            raise AssertionError(f"{note.msgtype} wants {name}")
    return kind(**fields)
