"""A follower behind ROS: a simulator or a robot that publishes its pose and takes velocities.

Commands go out as ``geometry_msgs/TwistStamped`` on ``/uvgs/follow/command``; its pose is heard on the topic that was
named, a ``PoseStamped``, ``PoseWithCovarianceStamped`` or ``nav_msgs/Odometry`` in any fixed frame of its own. Its body
axes are those of ROS: x forward, y left, z up.
"""

from __future__ import annotations

import threading
import time
from typing import Any, Literal, cast

import numpy as np

from uvgs_bench.devices.outside_link import OutsideLink
from uvgs_bench.devices.ros import RosDoor, RosMessages, open_ros
from uvgs_bench.errors import CaptureError, GantryError, GantryTimeout
from uvgs_bench.geometry import Pose

COMMAND_TOPIC = "/uvgs/follow/command"
_POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
)
_TWIST = "geometry_msgs/msg/TwistStamped"
_WAIT_S = 10.0
_SILENT_S = 1.5
_LOOK_S = 0.05
# Ours are those of a camera: x right, y down, z forward.
_OURS_FROM_ROS = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
_FROM_OUR_AXES = Pose(_OURS_FROM_ROS.T, np.zeros(3), "body", "body")


class RosLink(OutsideLink):
    """A follower that is told its velocity and heard on topics.

    Args:
        spec: ``ros1:/robot/pose`` or ``ros2:/robot/pose``.
        start: Where the session takes it to be at its first answer: ``world_from_body``.
        door: The node; the process's own when None.

    Raises:
        GantryError: This ROS is not there, or nobody publishes such a pose.
    """

    def __init__(self, spec: str, start: Pose, door: RosDoor | None = None) -> None:
        super().__init__(start)
        self._name = spec
        version, _, topic = spec.partition(":")
        try:
            self._door = open_ros(cast("Literal['ros1', 'ros2']", version)) if door is None else door
        except CaptureError as error:
            raise GantryError(str(error), spec) from None
        self._messages = RosMessages(self._door, camera_frame="base_link")
        self._heard = threading.Condition()
        self._newest: tuple[int, bytes] | None = None
        self._count = self._used = 0
        self._kind = self._wait_for_topic(topic)
        self._end = self._door.subscribe(topic, self._kind, self._take)

    def _wait_for_topic(self, topic: str) -> str:
        until_s = time.monotonic() + _WAIT_S
        while True:
            kind = self._door.topics().get(topic, "")
            if kind in _POSES:
                return kind
            if kind:
                raise GantryError(f"carries {kind}, expected one of {', '.join(_POSES)}", self._name)
            if time.monotonic() >= until_s:
                raise GantryError(f"nobody publishes it within {_WAIT_S:g} s", self._name)
            time.sleep(_LOOK_S)

    def _take(self, payload: bytes) -> None:
        with self._heard:
            self._count += 1
            self._newest = (self._count, payload)
            self._heard.notify_all()

    def _tell(self, until_ns: int) -> None:
        velocity, rate = self._command.twist_at(max(until_ns, self._command.t_ns))
        types = self._messages.make.types
        vector, twist = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Twist"]
        both = (vector(*(_OURS_FROM_ROS.T @ values).tolist()) for values in (velocity, rate))
        message = types[_TWIST](self._messages.make.header(self._door.now_ns()), twist(*both))
        self._messages.write(COMMAND_TOPIC, until_ns, message)

    def _ask(self, t_ns: int) -> Pose:
        self._tell(t_ns)
        with self._heard:
            if not self._heard.wait_for(lambda: self._count > self._used, _SILENT_S):
                raise GantryTimeout(f"no pose within {_SILENT_S:g} s", self._name)
            assert self._newest is not None
            self._used, payload = self._newest
        pose: Any = self._messages.read(self._kind, payload).pose
        pose = getattr(pose, "pose", pose)
        at, turn = pose.position, pose.orientation
        quaternion = [turn.x, turn.y, turn.z, turn.w]
        try:
            theirs = Pose.from_quaternion(quaternion, [at.x, at.y, at.z], "body", "body")
        except ValueError as error:
            raise GantryError(f"publishes no pose: {error}", self._name) from None
        return theirs @ _FROM_OUR_AXES

    def _let_go(self) -> None:
        self._end()
