"""Poses as Astrobee's localizer wants them: ``ff_msgs/VisualLandmarks``, and which of them it drops without a word.

What the AR-tag node of Astrobee puts into these messages, and so this program does too:

- A ``CameraRegistration`` with the stamp of the picture comes first, then the landmarks with the same stamp.
- ``u, v`` are in UNDISTORTED_C: pixels freed of the distortion, counted from the optical axis; not raw pixels.
- ``pose`` is the camera in the dock's frame: the inverse of what this program calls camera_from_beacon.
- ``frame_id`` is ``dock/body``, ``camera_id`` is 0. Here the beacon's frame stands for the dock's.
- The graph localizer refuses messages with fewer than five landmarks as it is shipped: a beacon of four LEDs needs
  ``min_num_matches_per_measurement`` lowered to 4.

There are two versions of the message, and a subscriber of the one cannot read the other.

Source: nasa/astrobee: communications/ff_msgs/msg; localization/marker_tracking; localization/graph_localizer;
astrobee/config/graph_localizer.config; localization/camera/src/camera_params.cc.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera import Lens
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.units import NS_PER_S

Version = Literal["v1", "v2"]

LANDMARKS = "ff_msgs/msg/VisualLandmarks"
LANDMARK = "ff_msgs/msg/VisualLandmark"
REGISTRATION = "ff_msgs/msg/CameraRegistration"
LANDMARKS_TOPIC = "/loc/ar/features"
REGISTRATION_TOPIC = "/loc/ar/registration"
FRAME_ID = "dock/body"

_LANDMARK_TEXT = "float32 x\nfloat32 y\nfloat32 z\nfloat32 u\nfloat32 v\n"
_LANDMARKS_TEXT = (
    "std_msgs/Header header\nuint32 camera_id\ngeometry_msgs/Pose pose\nff_msgs/VisualLandmark[] landmarks\n"
)
_REGISTRATION_TEXT = "std_msgs/Header header\nuint32 camera_id\n"

ROS1_MD5: dict[tuple[str, Version], str] = {
    (LANDMARK, "v1"): "4bd50de08103ca6ff668a9a06eab900c",
    (LANDMARK, "v2"): "4bd50de08103ca6ff668a9a06eab900c",
    (LANDMARKS, "v1"): "bc9fc09f69d7758225ed41ee26f6375e",
    (LANDMARKS, "v2"): "89d9108122ec0461f2fbec962106761a",
    (REGISTRATION, "v1"): "39570521afd2f2ad2728a757c58cee99",
    (REGISTRATION, "v2"): "39570521afd2f2ad2728a757c58cee99",
}
"""Sums by which ROS 1 tells messages apart."""


@dataclass(frozen=True, slots=True)
class LocalizerSettings:
    """What Astrobee's graph localizer asks of a message, as it is shipped (``graph_localizer.config``).

    Args:
        min_landmarks: ``min_num_matches_per_measurement`` of the AR tags.
        max_error_px: ``max_valid_projection_error``: a landmark farther off than this gives no factor, px.
    """

    min_landmarks: int = 5
    max_error_px: float = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class VisualLandmarks:
    """One message as numbers, also one that makes no sense.

    Args:
        t_ns: Stamp of its header, ns.
        position_m: Camera in the dock's frame, shape (3,), m.
        quaternion_xyzw: Its rotation, shape (4,), scalar last.
        points_m: Landmarks in the dock's frame, shape (n, 3), m.
        undistorted_px: The same in UNDISTORTED_C, shape (n, 2), px.
        frame_id: Name of the dock's frame.
        camera_id: Number of the camera.
        runtime_s: How long the sensor took, s; None in the older version.
    """

    t_ns: int
    position_m: FloatArray
    quaternion_xyzw: FloatArray
    points_m: FloatArray
    undistorted_px: FloatArray
    frame_id: str = FRAME_ID
    camera_id: int = 0
    runtime_s: float | None = None

    def dock_from_camera(self) -> Pose | None:
        """The pose, with the beacon's frame for the dock's; None when its numbers are no pose."""
        try:
            return Pose.from_quaternion(self.quaternion_xyzw, self.position_m, "beacon", "camera")
        except ValueError:
            return None


def undistorted_from_raw(lens: Lens, px: ArrayLike) -> FloatArray:
    """Raw pixels in UNDISTORTED_C.

    Args:
        lens: The lens.
        px: Raw pixels, shape (n, 2), px.

    Returns:
        Pixels freed of the distortion, counted from the optical axis, shape (n, 2), px; NaN where the lens has no ray
        or the ray does not point forwards.

    Source: camera_params.cc: UNDISTORTED_C = (fx X/Z, fy Y/Z).
    """
    rays = lens.unproject(px)
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = np.where(rays[:, 2:] > 0.0, rays[:, :2] / rays[:, 2:], np.nan)
    return read_only(plane * (lens.fx_px, lens.fy_px))


def landmarks_from_pose(estimate: PoseEstimate, beacon: Beacon, lens: Lens) -> VisualLandmarks:
    """The message of a pose.

    Args:
        estimate: The pose.
        beacon: Its beacon.
        lens: The lens it was seen through.

    Returns:
        The message with every LED that was seen.
    """
    pose = estimate.camera_from_beacon.inverse()
    px = undistorted_from_raw(lens, estimate.led_px)
    seen = np.isfinite(px).all(axis=1)
    return VisualLandmarks(
        estimate.t_ns,
        pose.t_m,
        pose.quaternion_xyzw(),
        read_only(beacon.positions_m[seen]),
        read_only(px[seen]),
        runtime_s=sum(estimate.stage_s.values()),
    )


def why_dropped(message: VisualLandmarks, settings: LocalizerSettings | None = None) -> str | None:
    """Why the localizer would drop a message.

    Args:
        message: The message.
        settings: The localizer's, as shipped when None.

    Returns:
        The reason in one line, or None when it would be used.
    """
    wanted = LocalizerSettings() if settings is None else settings
    count = len(message.points_m)
    if count < wanted.min_landmarks:
        return (
            f"{count} landmarks, but the localizer ignores messages with fewer than {wanted.min_landmarks} "
            "(min_num_matches_per_measurement)"
        )
    if message.dock_from_camera() is None:
        return "its pose is no pose: the quaternion is zero, or a number is not finite"
    if not (np.isfinite(message.points_m).all() and np.isfinite(message.undistorted_px).all()):
        return "a landmark is not finite"
    return None


def landmark_errors_px(message: VisualLandmarks, fx_px: float, fy_px: float) -> FloatArray:
    """How far each landmark lies from where the message's own pose puts it.

    Large errors show raw pixels taken for undistorted ones, a pose that was not inverted, or another camera.

    Args:
        message: The message.
        fx_px: Focal length of its camera along columns, px.
        fy_px: Along rows, px.

    Returns:
        Distances, shape (n,), px; inf where the pose puts the landmark behind the camera; NaN without a pose.
    """
    pose = message.dock_from_camera()
    if pose is None:
        return read_only(np.full(len(message.points_m), np.nan))
    points = pose.inverse().apply(message.points_m)
    with np.errstate(divide="ignore", invalid="ignore"):
        px = points[:, :2] / points[:, 2:] * (fx_px, fy_px)
    distance = np.linalg.norm(px - message.undistorted_px, axis=1)
    return read_only(np.where(points[:, 2] > 0.0, distance, np.inf))


def add_message_types(store: Any, version: Version) -> None:
    """Teach a ``rosbags`` type store the messages.

    Args:
        store: The type store, of ROS 1 or ROS 2.
        version: ``v1``, or ``v2`` with the field ``runtime``.
    """
    from rosbags.typesys import get_types_from_msg

    text = _LANDMARKS_TEXT + ("float32 runtime\n" if version == "v2" else "")
    store.register(
        {
            **get_types_from_msg(_LANDMARK_TEXT, LANDMARK),
            **get_types_from_msg(text, LANDMARKS),
            **get_types_from_msg(_REGISTRATION_TEXT, REGISTRATION),
        }
    )


def message_from_landmarks(types: Any, header: Any, landmarks: VisualLandmarks, version: Version) -> Any:
    """The message itself.

    Args:
        types: ``types`` of a type store that knows the messages.
        header: Its header.
        landmarks: The numbers.
        version: As the type store was taught.

    Returns:
        A ``VisualLandmarks`` message.
    """
    point, quaternion = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Quaternion"]
    pose = types["geometry_msgs/msg/Pose"](
        point(*landmarks.position_m.tolist()), quaternion(*landmarks.quaternion_xyzw.tolist())
    )
    rows = np.column_stack([landmarks.points_m, landmarks.undistorted_px]).tolist()
    last = [landmarks.runtime_s or 0.0] if version == "v2" else []
    return types[LANDMARKS](header, landmarks.camera_id, pose, [types[LANDMARK](*row) for row in rows], *last)


def landmarks_from_message(message: Any) -> VisualLandmarks:
    """The numbers of a message of either version.

    Args:
        message: A deserialized ``VisualLandmarks`` message.

    Returns:
        Its numbers, whether they make sense or not.
    """
    position, turn, stamp = message.pose.position, message.pose.orientation, message.header.stamp
    rows = np.array([(m.x, m.y, m.z, m.u, m.v) for m in message.landmarks], dtype=np.float64).reshape(-1, 5)
    return VisualLandmarks(
        int(stamp.sec) * NS_PER_S + int(stamp.nanosec),
        read_only([position.x, position.y, position.z]),
        read_only([turn.x, turn.y, turn.z, turn.w]),
        read_only(rows[:, :3]),
        read_only(rows[:, 3:]),
        str(message.header.frame_id),
        int(message.camera_id),
        float(message.runtime) if hasattr(message, "runtime") else None,
    )
