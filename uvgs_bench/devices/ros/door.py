"""What ROS is to the rest of the program, and the one connection a process has to it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any, Literal, Protocol

ParameterValue = bool | int | float | str | list[float]
"""A value ROS can keep."""

DOORS: dict[str, str] = {
    "ros1": "uvgs_bench.devices.ros.rospy_door:RospyDoor",
    "ros2": "uvgs_bench.devices.ros.rclpy_door:RclpyDoor",
}
"""Version -> ``module:Class``."""

_open: dict[str, RosDoor] = {}


class RosDoor(Protocol):
    """A node of ROS.

    Contract: message types are named as ROS 2 names them, ``package/msg/Type``, in both versions. ``take`` and
    ``check`` are called in threads of the middleware and must return at once. After ``close`` nothing is called any
    more.
    """

    @property
    def name(self) -> str:
        """The node's full name."""
        ...

    @property
    def is_ros1(self) -> bool:
        """Whether messages are serialised as ROS 1 does, else as CDR."""
        ...

    @property
    def is_alive(self) -> bool:
        """Whether ROS is still there: the node is not shut down, its master answers."""
        ...

    def now_ns(self) -> int:
        """ROS time, ns: the clock of message stamps."""
        ...

    def topics(self) -> dict[str, str]:
        """Topics that somebody publishes, and their types."""
        ...

    def subscribe(self, topic: str, msgtype: str, take: Callable[[bytes], None]) -> Callable[[], None]:
        """Hand every message of a topic to ``take``, the newest where it is late; the answer ends it."""
        ...

    def publish(self, topic: str, msgtype: str, payload: bytes, definition: str) -> None:
        """Publish a serialised message; the first on a topic advertises it. Types this ROS lacks are said once."""
        ...

    def offer_parameters(
        self, values: Mapping[str, ParameterValue], check: Callable[[dict[str, ParameterValue]], str | None]
    ) -> None:
        """Let parameters be changed from outside: ``check`` takes the changed ones or answers why not."""
        ...

    def warn(self, text: str) -> None:
        """Say something in ROS's log."""
        ...

    def close(self) -> None:
        """Leave. Safe to call twice."""
        ...


def open_ros(version: Literal["ros1", "ros2"], name: str = "uvgs", arguments: Sequence[str] = ()) -> RosDoor:
    """The process's node; made at the first call.

    Args:
        version: ``ros1`` or ``ros2``.
        name: Name of the node.
        arguments: Arguments of ROS itself: remappings such as ``image:=/cam``, or what follows ``--ros-args``.

    Returns:
        The open door; later calls get the same.

    Raises:
        CaptureError: This ROS is not installed or not sourced, or there is no master.
    """
    known = _open.get(version)
    if known is not None and known.is_alive:
        return known
    module, _, kind = DOORS[version].partition(":")
    made: Any = getattr(import_module(module), kind)
    door: RosDoor = made(name, arguments)
    _open[version] = door
    return door
