"""ROS messages of navigation and plain values: readings of an inertial unit, poses with doubt, odometry.

ROS's covariance of a pose is that of the position, then of a rotation about the fixed axes of ``frame_id``; ours of a
place has the rotation first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from uvgs_bench.errors import FormatError
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.navigation.states import NavigationState
from uvgs_bench.units import NS_PER_S

IMU = "sensor_msgs/msg/Imu"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
POSES = (POSE_WITH_COVARIANCE, ODOMETRY, POSE_STAMPED)
"""Types that carry a pose, the best first."""

_SWAP = np.array([3, 4, 5, 0, 1, 2])


@dataclass(frozen=True, slots=True, eq=False)
class StampedPose:
    """A pose as a message has it.

    Args:
        t_ns: Its stamp, ns.
        frame_id: The frame it stands in.
        position_m: Position, shape (3,), m.
        quaternion_xyzw: Attitude, shape (4,), scalar last.
        covariance: Of rotation (left, fixed axes, rad), then position (m), shape (6, 6); None when the message states
            none, which ROS writes as zeros.
    """

    t_ns: int
    frame_id: str
    position_m: FloatArray
    quaternion_xyzw: FloatArray
    covariance: FloatArray | None

    def pose(self, target: str, source: str) -> Pose:
        """The pose between frames of ours. Raises ValueError for a quaternion that is none."""
        return Pose.from_quaternion(self.quaternion_xyzw, self.position_m, target, source)


def stamp_ns(message: Any) -> int:
    """The instant in a message's header, ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def reading_from_imu(message: Any) -> tuple[int, FloatArray, FloatArray]:
    """Instant (ns), specific force (3,) (m/s^2) and rate (3,) (rad/s) of a ``sensor_msgs/Imu``.

    Raises:
        FormatError: A value is not finite, or the message says that it has no such reading.
    """
    a, w = message.linear_acceleration, message.angular_velocity
    values = np.array([a.x, a.y, a.z, w.x, w.y, w.z], dtype=np.float64)
    for name in ("linear_acceleration", "angular_velocity"):
        # ROS: a first element of -1 means that the unit does not measure this.
        if float(np.asarray(getattr(message, f"{name}_covariance"))[0]) == -1.0:
            raise FormatError(f"its messages say that they hold no {name}")
    if not np.isfinite(values).all():
        raise FormatError("a reading is not finite")
    return stamp_ns(message), values[:3], values[3:]


def pose_from_message(message: Any, kind: str) -> StampedPose:
    """The pose of a message of one of ``POSES``.

    Raises:
        FormatError: A value is not finite, or the covariance is none.
    """
    doubted = message.pose if kind != POSE_STAMPED else None
    pose = message.pose if doubted is None else doubted.pose
    p, q = pose.position, pose.orientation
    position = np.array([p.x, p.y, p.z], dtype=np.float64)
    quaternion = np.array([q.x, q.y, q.z, q.w], dtype=np.float64)
    if not (np.isfinite(position).all() and np.isfinite(quaternion).all()) or not quaternion.any():
        raise FormatError("a pose is not finite, or its quaternion is zero")
    covariance = None
    if doubted is not None:
        matrix = np.array(doubted.covariance, dtype=np.float64).reshape(6, 6)
        matrix = 0.5 * (matrix + matrix.T)[np.ix_(_SWAP, _SWAP)]
        if matrix.any():
            if not np.isfinite(matrix).all() or float(np.linalg.eigvalsh(matrix)[0]) <= 0.0:
                raise FormatError("a covariance is not positive definite")
            covariance = read_only(matrix)
    return StampedPose(
        stamp_ns(message), message.header.frame_id, read_only(position), read_only(quaternion), covariance
    )


def odometry_from_state(types: Any, header: Any, state: NavigationState) -> Any:
    """A ``nav_msgs/Odometry`` of a state: pose in the world, velocity in axes of the body, both with covariance.

    Args:
        types: Types of the store, by name.
        header: The header, ``frame_id`` the world.
        state: The state.

    Returns:
        The message; the angular velocity is not part of a state and stays zero with a covariance of -1.
    """
    pose, R = state.world_from_body, state.world_from_body.R
    point = types["geometry_msgs/msg/Point"](*pose.t_m.tolist())
    turn = types["geometry_msgs/msg/Quaternion"](*pose.quaternion_xyzw().tolist())
    place = state.place_covariance[np.ix_(_SWAP, _SWAP)]
    plain = types["geometry_msgs/msg/Pose"](point, turn)
    doubted = types["geometry_msgs/msg/PoseWithCovariance"](plain, place.ravel().copy())
    vector = types["geometry_msgs/msg/Vector3"]
    twist = types["geometry_msgs/msg/Twist"](vector(*(R.T @ state.velocity_mps).tolist()), vector(0.0, 0.0, 0.0))
    spread = np.zeros((6, 6))
    spread[:3, :3] = R.T @ state.covariance[3:6, 3:6] @ R
    spread[3, 3] = -1.0
    moving = types["geometry_msgs/msg/TwistWithCovariance"](twist, spread.ravel().copy())
    return types[ODOMETRY](header, "body", doubted, moving)
