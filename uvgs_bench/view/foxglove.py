"""The newest captures for Foxglove, Lichtblick and whoever else speaks their protocol; needs the extra ``live``.

| topic | message |
|---|---|
| ``/uvgs/image`` | ``CompressedImage`` (JPEG) |
| ``/uvgs/annotations`` | ``ImageAnnotations``: LEDs with names, axes, runner-up, dropped blobs |
| ``/uvgs/pose`` | ``PoseInFrame`` of the active beacon in the camera's frame, fresh ones only |
| ``/tf`` | ``FrameTransforms``: camera to every beacon with a fresh pose |
| ``/uvgs/camera_info`` | ``CameraCalibration``, of lenses they know |
| ``/uvgs/state`` | everything else as JSON, as the page gets it |

The protocol cannot know who connects: any program of this machine and any page of its browsers may look. Nothing can be
changed through it.
"""

from __future__ import annotations

import threading
from typing import Any

from uvgs_bench.errors import ConfigError
from uvgs_bench.interop.ros_messages import camera_info_from_lens
from uvgs_bench.units import NS_PER_S
from uvgs_bench.view.broadcast import Broadcast
from uvgs_bench.view.packet import Packet, encode_jpeg

_HOST = "127.0.0.1"
_LOOK_S = 0.5
_CAMERA = "camera"
# Their names of lenses; others are not sent rather than drawn wrongly.
_MODELS = {"plumb_bob": "plumb_bob", "rational_polynomial": "rational_polynomial", "equidistant": "kannala_brandt"}
_LED, _DROPPED, _OTHER = (0.35, 0.86, 0.35), (1.0, 0.55, 0.16), (0.9, 0.31, 0.9)
_AXES = ((1.0, 0.24, 0.24), (0.24, 0.86, 0.24), (0.24, 0.55, 1.0))


class FoxgloveServer:
    """The open server.

    Args:
        broadcast: What it sends.
        port: Its port; 0 takes a free one.

    Raises:
        ConfigError: The package is missing, or the port is taken.
    """

    def __init__(self, broadcast: Broadcast, port: int) -> None:
        try:
            import foxglove
            from foxglove import channels
        except ImportError:
            raise ConfigError("needs the package foxglove-sdk: pip install 'uvgs-bench[live]'", "--foxglove") from None
        self._broadcast = broadcast
        # Kept: what belongs to a context that is gone is sent to nobody.
        context = self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(name="uvgs", host=_HOST, port=port, context=context)
        except (RuntimeError, OSError) as error:
            raise ConfigError(f"cannot serve there: {error}; name another port", f"--foxglove-port {port}") from None
        self._image = channels.CompressedImageChannel("/uvgs/image", context=context)
        self._annotations = channels.ImageAnnotationsChannel("/uvgs/annotations", context=context)
        self._pose = channels.PoseInFrameChannel("/uvgs/pose", context=context)
        self._transforms = channels.FrameTransformsChannel("/tf", context=context)
        self._camera = channels.CameraCalibrationChannel("/uvgs/camera_info", context=context)
        self._state = foxglove.Channel("/uvgs/state", message_encoding="json", context=context)
        self._is_closed = threading.Event()
        self._thread = threading.Thread(target=self._work, name="foxglove", daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """Where to connect to."""
        return f"ws://{_HOST}:{self._server.port}"

    def close(self) -> None:
        """End it. Safe to call twice."""
        if not self._is_closed.is_set():
            self._is_closed.set()
            self._thread.join()
            self._server.stop()

    def _work(self) -> None:
        channels = (self._image, self._annotations, self._pose, self._transforms, self._camera, self._state)
        number = 0
        while not self._is_closed.is_set():
            if not any(channel.has_sinks() for channel in channels):
                self._is_closed.wait(_LOOK_S)
                continue
            with self._broadcast.listening():
                packet = self._broadcast.wait_newer(number, _LOOK_S)
            if packet is not None:
                number = packet.number
                self._send(packet)
            elif self._broadcast.is_over:
                self._is_closed.wait(_LOOK_S)

    def _send(self, packet: Packet) -> None:
        from foxglove import messages as fox

        capture = packet.shown.capture
        t_ns = capture.t_ns
        stamp = fox.Timestamp(t_ns // NS_PER_S, t_ns % NS_PER_S)
        jpeg = packet.jpeg if packet.is_full_size else encode_jpeg(capture, None)
        image = fox.CompressedImage(timestamp=stamp, frame_id=_CAMERA, data=jpeg, format="jpeg")
        self._image.log(image, log_time=t_ns)
        self._annotations.log(_annotations(packet, stamp, self._names()), log_time=t_ns)
        transforms = []
        for line in packet.shown.lines:
            if line.status != "ok" or line.pose is None:
                continue
            x, y, z = line.pose.t_m.tolist()
            qx, qy, qz, qw = line.pose.quaternion_xyzw().tolist()
            turn = fox.Quaternion(x=qx, y=qy, z=qz, w=qw)
            place = fox.Vector3(x=x, y=y, z=z)
            transforms.append(
                fox.FrameTransform(
                    timestamp=stamp, parent_frame_id=_CAMERA, child_frame_id=line.name, translation=place, rotation=turn
                )
            )
            if line.is_active:
                pose = fox.Pose(position=place, orientation=turn)
                self._pose.log(fox.PoseInFrame(timestamp=stamp, frame_id=_CAMERA, pose=pose), log_time=t_ns)
        if transforms:
            self._transforms.log(fox.FrameTransforms(transforms=transforms), log_time=t_ns)
        self._send_camera(stamp, t_ns)
        left_out = ("past", "zooms")
        self._state.log({key: value for key, value in packet.data.items() if key not in left_out}, log_time=t_ns)

    def _send_camera(self, stamp: Any, t_ns: int) -> None:
        from foxglove import messages as fox

        uvgs = next(iter(self._broadcast.sensors.values()), None)
        if uvgs is None:
            return
        info = camera_info_from_lens(uvgs.calibration.lens)
        if info.distortion_model not in _MODELS:
            return
        calibration = fox.CameraCalibration(
            timestamp=stamp,
            frame_id=_CAMERA,
            width=info.width,
            height=info.height,
            distortion_model=_MODELS[info.distortion_model],
            D=list(info.d),
            K=list(info.k),
            R=list(info.r),
            P=list(info.p),
        )
        self._camera.log(calibration, log_time=t_ns)

    def _names(self) -> dict[str, list[str]]:
        return {name: [led.name for led in uvgs.beacon.leds] for name, uvgs in self._broadcast.sensors.items()}


def _annotations(packet: Packet, stamp: Any, names: dict[str, list[str]]) -> Any:
    """What the page draws over the picture, from the same data."""
    from foxglove import messages as fox

    def colour(rgb: tuple[float, float, float]) -> Any:
        return fox.Color(r=rgb[0], g=rgb[1], b=rgb[2], a=1.0)

    def point(px: Any) -> Any:
        # There the first pixel begins at 0; here its centre is 0.
        return fox.Point2(x=px[0] + 0.5, y=px[1] + 0.5)

    def text(px: Any, words: str, rgb: tuple[float, float, float]) -> Any:
        return fox.TextAnnotation(
            position=point((px[0] + 6, px[1] - 6)), text=words, font_size=14, text_color=colour(rgb)
        )

    def lines(kind: Any, pixels: Any, rgb: tuple[float, float, float]) -> Any:
        return fox.PointsAnnotation(
            type=kind, points=[point(px) for px in pixels], outline_color=colour(rgb), thickness=1.5
        )

    kinds = fox.PointsAnnotationType
    points, circles, texts = [], [], []
    data: Any = packet.data
    for blob in data["blobs"]:
        x0, y0, x1, y1 = blob["box_px"]
        rgb = _DROPPED if blob["dropped"] else _LED
        corners = ((x0 - 3, y0 - 3), (x1 + 3, y0 - 3), (x1 + 3, y1 + 3), (x0 - 3, y1 + 3))
        points.append(lines(kinds.LineLoop, corners, rgb))
        if blob["dropped"]:
            texts.append(text((x1, y1), blob["dropped"], rgb))
    for beacon in data["beacons"]:
        for name, px in zip(names.get(beacon["name"], ()), beacon["led_px"] or (), strict=False):
            if px is not None:
                texts.append(text(px, name, (1.0, 1.0, 1.0)))
        marks = beacon["marks"]
        if marks is None:
            continue
        circles += [
            fox.CircleAnnotation(position=point(px), diameter=12, thickness=1.5, outline_color=colour(_OTHER))
            for px in marks["runner_up_px"] or ()
            if px is not None
        ]
        origin, *ends = marks["axes_px"]
        points += [
            lines(kinds.LineList, (origin, end), rgb)
            for end, rgb in zip(ends, _AXES, strict=True)
            if origin is not None and end is not None
        ]
    return fox.ImageAnnotations(timestamp=stamp, circles=circles, points=points, texts=texts)
