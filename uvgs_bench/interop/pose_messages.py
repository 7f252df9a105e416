"""The sensor's answers as ROS messages: pose with covariance, transform, diagnostics.

The camera's frame is called ``camera`` (z forward, x right), that of a beacon by the beacon's name. Poses and
transforms are camera_from_beacon, so ``frame_id`` is ``camera`` and the beacon is the child. Only fresh poses become
poses: a miss, or a pose that is held, is a warning in the diagnostics, never silence.

ROS's covariance is of the position and of a rotation about fixed axes of ``frame_id``, translation first; the sensor's
is of a twist (omega, v) on the left, rotation first. They are not each other's permutation: ``dt = v + omega x t``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.interop.ros_messages import CameraInfoFields, ImageFields
from uvgs_bench.interop.trajectories import LineNote
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.handover import Held
from uvgs_bench.sensor.outcome import Outcome, PoseEstimate
from uvgs_bench.units import NS_PER_S, s_from_ns

CAMERA_FRAME = "camera"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
TEXT = "std_msgs/msg/String"
_OK, _WARN = 0, 1


def ros_covariance(estimate: PoseEstimate) -> FloatArray:
    """The covariance of a pose as ``geometry_msgs/PoseWithCovariance`` has it.

    Args:
        estimate: The pose.

    Returns:
        Covariance of x, y, z and of the rotation about the fixed x, y, z of the camera, shape (6, 6), m and rad.
    """
    x, y, z = estimate.camera_from_beacon.t_m
    J = np.zeros((6, 6))
    # dt = v + omega x t = v - [t]x omega
    J[:3, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    J[:3, 3:] = J[3:, :3] = np.eye(3)
    return read_only(J @ estimate.covariance @ J.T)


def ros_names(names: Sequence[str]) -> dict[str, str]:
    """A name for topics and frames for each of several texts: letters, digits, underscores, all different."""
    found: dict[str, str] = {}
    for name in names:
        word = re.sub(r"\W", "_", name, flags=re.ASCII)
        word = word if re.match(r"[A-Za-z]", word) else f"b_{word}"
        base, number = word, 1
        while word in found.values() or word == CAMERA_FRAME:
            number += 1
            word = f"{base}_{number}"
        found[name] = word
    return found


def ros_store(*, is_ros1: bool) -> Any:
    """A type store of ``rosbags`` that knows every message written here.

    Args:
        is_ros1: For ROS 1, else for ROS 2 (Jazzy).

    Returns:
        The store.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY)
    if TRANSFORMS not in store.types:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", TRANSFORMS))
    return store


class MessageMaker:
    """Makes messages of one ROS version.

    Args:
        store: The type store.
        is_ros1: Whether it is of ROS 1.
        camera_frame: Name of the camera's frame.
    """

    def __init__(self, store: Any, *, is_ros1: bool, camera_frame: str = CAMERA_FRAME) -> None:
        self.types: Any = store.types
        self._frame = camera_frame
        self._seq = [0] if is_ros1 else []

    def header(self, t_ns: int, frame_id: str | None = None) -> Any:
        """A header; in the camera's frame unless told otherwise."""
        stamp = self.types["builtin_interfaces/msg/Time"](*divmod(t_ns, NS_PER_S))
        return self.types["std_msgs/msg/Header"](*self._seq, stamp, self._frame if frame_id is None else frame_id)

    def pose(self, estimate: PoseEstimate) -> Any:
        """A ``PoseWithCovarianceStamped``."""
        types, pose = self.types, estimate.camera_from_beacon
        point = types["geometry_msgs/msg/Point"](*pose.t_m.tolist())
        turn = types["geometry_msgs/msg/Quaternion"](*pose.quaternion_xyzw().tolist())
        plain = types["geometry_msgs/msg/Pose"](point, turn)
        doubted = types["geometry_msgs/msg/PoseWithCovariance"](plain, ros_covariance(estimate).ravel().copy())
        return types[POSE](self.header(estimate.t_ns), doubted)

    def transform(self, estimate: PoseEstimate, child: str) -> Any:
        """A ``TFMessage`` with the beacon as the camera's child."""
        types, pose = self.types, estimate.camera_from_beacon
        shift = types["geometry_msgs/msg/Vector3"](*pose.t_m.tolist())
        turn = types["geometry_msgs/msg/Quaternion"](*pose.quaternion_xyzw().tolist())
        moved = types["geometry_msgs/msg/Transform"](shift, turn)
        stamped = types["geometry_msgs/msg/TransformStamped"](self.header(estimate.t_ns), child, moved)
        return types[TRANSFORMS]([stamped])

    def diagnostics(self, capture: Capture, beacon: str, outcome: Outcome | Held, note: LineNote) -> Any:
        """A ``DiagnosticArray`` with one status: what became of this capture for this beacon, and why."""
        types = self.types
        level, said, facts = _told(outcome)
        head = {"index": capture.index, "source": capture.source, "is_active": note.is_active}
        tail: dict[str, object] = {"flags": " ".join((*getattr(outcome, "flags", ()), *note.flags))}
        if note.switched:
            tail["switched"] = note.switched
        if capture.exposure_s is not None:
            tail["exposure_s"] = capture.exposure_s
        if note.next_exposure_s is not None:
            tail |= {"next_exposure_s": note.next_exposure_s, "exposure_reason": note.exposure_reason}
        pair = types["diagnostic_msgs/msg/KeyValue"]
        values = [pair(key, _shown(value)) for key, value in (head | facts | tail).items()]
        status = types["diagnostic_msgs/msg/DiagnosticStatus"](level, f"uvgs: {beacon}", said, "", values)
        return types[DIAGNOSTICS](self.header(capture.t_ns, ""), [status])

    def camera_info(self, t_ns: int, fields: CameraInfoFields) -> Any:
        """A ``CameraInfo``."""
        region = self.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        arrays = (np.array(values, dtype=np.float64) for values in (fields.d, fields.k, fields.r, fields.p))
        head = self.header(t_ns), fields.height, fields.width, fields.distortion_model
        return self.types[CAMERA_INFO](*head, *arrays, 0, 0, region)

    def image(self, t_ns: int, fields: ImageFields) -> Any:
        """An ``Image``."""
        head = self.header(t_ns), fields.height, fields.width, fields.encoding
        return self.types[IMAGE](*head, fields.is_bigendian, fields.step, fields.data)

    def compressed(self, t_ns: int, form: str, payload: np.ndarray[tuple[int], np.dtype[np.uint8]]) -> Any:
        """A ``CompressedImage``."""
        return self.types[COMPRESSED](self.header(t_ns), form, payload)

    def text(self, text: str) -> Any:
        """A ``String``."""
        return self.types[TEXT](text)


def _told(outcome: Outcome | Held) -> tuple[int, str, dict[str, object]]:
    """Level, sentence and facts of an outcome."""
    if isinstance(outcome, PoseEstimate):
        facts = {"status": "ok", "rms_px": outcome.rms_px, "margin": outcome.margin, "blob_count": outcome.blob_count}
        return _OK, "pose", facts
    miss = outcome.miss if isinstance(outcome, Held) else outcome
    facts = {"status": "miss", "stage": miss.stage, "reason": miss.reason, "detail": miss.detail}
    facts["blob_count"] = miss.blob_count
    said = f"{miss.stage}/{miss.reason}: {miss.detail}"
    if isinstance(outcome, Held):
        pose = outcome.last.camera_from_beacon
        age_s = s_from_ns(outcome.age_ns)
        held = {"held_age_s": age_s, "held_t_ns": outcome.last.t_ns}
        held |= {"held_t_m": pose.t_m.tolist(), "held_q_xyzw": pose.quaternion_xyzw().tolist()}
        return _WARN, f"held for {age_s:.3f} s, {said}", facts | {"status": "held"} | held
    return _WARN, said, facts


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return value if isinstance(value, str) else repr(value)
