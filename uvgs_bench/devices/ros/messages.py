"""Messages of a running ROS: made and read by the same code that writes and reads bags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from uvgs_bench.devices.ros.door import RosDoor
from uvgs_bench.interop import astrobee
from uvgs_bench.interop.pose_messages import CAMERA_FRAME, MessageMaker, ros_store


class RosMessages:
    """Takes messages as a bag does, and publishes them.

    Args:
        door: The node.
        version: Of Astrobee's messages, or None.
        camera_frame: Name of the camera's frame.
    """

    def __init__(
        self, door: RosDoor, *, version: astrobee.Version | None = None, camera_frame: str = CAMERA_FRAME
    ) -> None:
        self._door = door
        self._store = ros_store(is_ros1=door.is_ros1)
        if version is not None:
            astrobee.add_message_types(self._store, version)
        self.make = MessageMaker(self._store, is_ros1=door.is_ros1, camera_frame=camera_frame)
        self._definitions: dict[str, str] = {}

    @property
    def paths(self) -> tuple[Path, ...]:
        """No file is written."""
        return ()

    def write(self, topic: str, _t_ns: int, message: Any) -> None:
        """Publish a message."""
        kind, store = message.__msgtype__, self._store
        if kind not in self._definitions:
            self._definitions[kind] = store.generate_msgdef(kind)[0] if self._door.is_ros1 else ""
        payload = store.serialize_ros1(message, kind) if self._door.is_ros1 else store.serialize_cdr(message, kind)
        self._door.publish(topic, kind, bytes(payload), self._definitions[kind])

    def read(self, msgtype: str, payload: bytes) -> Any:
        """The message of serialised bytes."""
        store = self._store
        read = store.deserialize_ros1 if self._door.is_ros1 else store.deserialize_cdr
        return read(payload, msgtype)

    def close(self) -> None:
        """The node stays: others use it."""
