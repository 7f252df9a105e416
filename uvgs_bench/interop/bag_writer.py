"""Bags of poses: ``*.bag`` for ROS 1, ``*.mcap`` for ROS 2. ROS itself is not needed.

| topic | what |
|---|---|
| ``/uvgs/BEACON/pose`` | ``PoseWithCovarianceStamped``, one per fresh pose |
| ``/tf`` | the same as the beacon's frame under ``camera`` |
| ``/diagnostics`` | one status per capture and beacon, misses and held poses included, with stage and reason |
| ``/uvgs/camera_info`` | ``CameraInfo``, one per capture |
| ``/uvgs/image_raw`` | ``Image``, every picture as it was solved, when asked for |
| ``/uvgs/BEACON/image_annotated/compressed`` | what the sensor saw, when asked for |
| ``/loc/ar/registration``, ``/loc/ar/features`` | Astrobee's messages of the active beacon, when asked for |

Messages lie in a bag at the instant of their capture.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera import Lens
from uvgs_bench.errors import ConfigError
from uvgs_bench.interop import astrobee
from uvgs_bench.interop.bag_container import BagContainer, Channel, MessageKind
from uvgs_bench.interop.mcap_container import McapContainer
from uvgs_bench.interop.pose_messages import MessageMaker, ros_names, ros_store
from uvgs_bench.interop.ros1_container import Ros1Container
from uvgs_bench.interop.ros_messages import (
    camera_info_from_lens,
    compressed_from_image,
    message_fields_from_image,
)
from uvgs_bench.interop.trajectories import LineNote
from uvgs_bench.sensor.capture import Capture, ImageArray
from uvgs_bench.sensor.handover import Held
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate

Compression = Literal["none", "bz2", "zstd"]
Annotate = Callable[[Capture, PoseEstimate | Miss], ImageArray]

_COMPRESSIONS: dict[str, tuple[Compression, ...]] = {".bag": ("none", "bz2"), ".mcap": ("none", "zstd")}
BAG_ENDINGS = tuple(_COMPRESSIONS)
IMAGE_TOPIC = "/uvgs/image_raw"


@dataclass(frozen=True, slots=True, eq=False)
class BagContents:
    """What goes into a bag besides the answers.

    Args:
        lens: The camera's lens.
        beacons: The beacons by name.
        version: Of Astrobee's messages; None for none.
        has_images: Whether the pictures go in.
        annotate: Draws a capture with its outcome, BGR, by the beacon's name; empty for no pictures.
    """

    lens: Lens
    beacons: Mapping[str, Beacon]
    version: astrobee.Version | None = None
    has_images: bool = False
    annotate: Mapping[str, Annotate] = field(default_factory=dict)


class NewBag:
    """A bag that takes messages by topic and type; topics begin with their first message.

    Args:
        path: ``*.bag`` or ``*.mcap``.
        compression: Of its chunks.
        version: Of Astrobee's messages, or None when there will be none.
        force: Whether an existing file may be replaced.
        endings: Of them which are meant.

    Raises:
        ConfigError: The ending is another, the format has no such compression, or the file may not be replaced.
        UvgsError: It cannot be written.
    """

    def __init__(
        self,
        path: Path,
        *,
        compression: Compression = "none",
        version: astrobee.Version | None = None,
        force: bool = False,
        endings: Sequence[str] = BAG_ENDINGS,
    ) -> None:
        if path.suffix not in endings:
            raise ConfigError(f"unknown ending '{path.suffix}', expected {' or '.join(endings)}", str(path))
        known = _COMPRESSIONS[path.suffix]
        if compression not in known:
            raise ConfigError(
                f"a {path.suffix} file cannot be compressed by {compression}, but by {known[1]}", str(path)
            )
        self.path = path
        self._is_ros1 = path.suffix == ".bag"
        self._store = ros_store(is_ros1=self._is_ros1)
        if version is not None:
            astrobee.add_message_types(self._store, version)
        self.make = MessageMaker(self._store, is_ros1=self._is_ros1)
        kind: Any = Ros1Container if self._is_ros1 else McapContainer
        self._container: BagContainer = kind(path, force=force, compression=compression)
        self._channels: dict[str, Channel] = {}

    @property
    def paths(self) -> tuple[Path, ...]:
        """The bag."""
        return (self.path,)

    def write(self, topic: str, t_ns: int, message: Any) -> None:
        """Append a message. Raises UvgsError when the disk is full, FormatError for an impossible instant."""
        kind = message.__msgtype__
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._channels[topic] = self._container.add(topic, self._kind(kind))
        store = self._store
        payload = store.serialize_ros1(message, kind) if self._is_ros1 else store.serialize_cdr(message, kind)
        self._container.write(channel, t_ns, payload)

    def flush(self) -> None:
        """Put what waits on disk now, in a chunk of its own. Raises UvgsError when the disk is full."""
        self._container.flush()

    def hurry(self, is_hurried: bool) -> None:
        """Say whether messages come faster than they can be compressed; every chunk says its own compression."""
        self._container.is_hurried = is_hurried

    def close(self) -> None:
        """Write the end. Safe to call twice. Raises UvgsError when the disk is full."""
        self._container.close()

    def _kind(self, name: str) -> MessageKind:
        if self._is_ros1:
            return MessageKind(name, *self._store.generate_msgdef(name))
        definition, _ = self._store.generate_msgdef(name, ros_version=2)
        return MessageKind(name, definition, self._store.hash_rihs01(name))


class MessageSink(Protocol):
    """What takes messages: a bag, or a running ROS."""

    make: MessageMaker

    @property
    def paths(self) -> tuple[Path, ...]:
        """Files it writes."""
        ...

    def write(self, topic: str, t_ns: int, message: Any) -> None:
        """Take a message."""
        ...

    def close(self) -> None:
        """End it."""
        ...


class BagPoses:
    """The answers of a stream as messages, in a bag or in a running ROS.

    Args:
        bag: Takes them; closed with this.
        contents: What goes in besides.
    """

    def __init__(self, bag: MessageSink, contents: BagContents) -> None:
        self._contents = contents
        self._bag = bag
        self._words = ros_names(tuple(contents.beacons))
        self._info = camera_info_from_lens(contents.lens)
        self._last: Capture | None = None

    @property
    def paths(self) -> tuple[Path, ...]:
        """The bag."""
        return self._bag.paths

    def write(self, capture: Capture, outcome: Outcome | Held, note: LineNote) -> None:
        """Append the outcome of a capture for one beacon.

        Raises:
            UvgsError: The disk is full.
            FormatError: The format has no place for the capture's instant.
        """
        bag, make, t_ns = self._bag, self._bag.make, capture.t_ns
        if capture is not self._last:
            bag.write("/uvgs/camera_info", t_ns, make.camera_info(t_ns, self._info))
            if self._contents.has_images:
                bag.write(IMAGE_TOPIC, t_ns, make.image(t_ns, message_fields_from_image(capture.image)))
            self._last = capture
        told = outcome.miss if isinstance(outcome, Held) else outcome
        word = self._words[told.beacon]
        bag.write("/diagnostics", t_ns, make.diagnostics(capture, told.beacon, outcome, note))
        if isinstance(told, PoseEstimate):
            bag.write(f"/uvgs/{word}/pose", t_ns, make.pose(told))
            bag.write("/tf", t_ns, make.transform(told, word))
            if note.is_active:
                self._write_landmarks(told)
        annotate = self._contents.annotate.get(told.beacon)
        if annotate is not None:
            form, payload = compressed_from_image(annotate(capture, told), "jpeg")
            bag.write(f"/uvgs/{word}/image_annotated/compressed", t_ns, make.compressed(t_ns, form, payload))

    def close(self) -> None:
        """Write the end. Safe to call twice. Raises UvgsError when the disk is full."""
        self._bag.close()

    def _write_landmarks(self, estimate: PoseEstimate) -> None:
        version = self._contents.version
        if version is None:
            return
        make, t_ns = self._bag.make, estimate.t_ns
        registration = make.types[astrobee.REGISTRATION](make.header(t_ns, astrobee.FRAME_ID), 0)
        self._bag.write(astrobee.REGISTRATION_TOPIC, t_ns, registration)
        landmarks = astrobee.landmarks_from_pose(estimate, self._contents.beacons[estimate.beacon], self._contents.lens)
        message = astrobee.message_from_landmarks(make.types, make.header(t_ns, astrobee.FRAME_ID), landmarks, version)
        self._bag.write(astrobee.LANDMARKS_TOPIC, t_ns, message)
