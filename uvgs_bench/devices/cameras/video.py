"""A video file as a camera."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uvgs_bench.devices.cameras.base import ClosingSource
from uvgs_bench.devices.clock import Clock
from uvgs_bench.errors import CaptureError
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.units import ns_from_s, s_from_ms

if TYPE_CHECKING:
    from uvgs_bench.devices.cameras.spec import CameraSpec

# Headers count frames from duration and rate, which may be off a little; less than this share is a broken file.
_WHOLE = 0.95


class VideoFile(ClosingSource):
    """Frames of a video in order, as BGR, stamped with their presentation time.

    Args:
        spec: The spec string, for messages.
        path: The file.
        video: An open ``cv2.VideoCapture``.
        frame_rate_hz: Frames per second by the file's header, or 0 when it does not say.
        length: Number of frames by the file's header, or None.
    """

    def __init__(self, spec: str, path: Path, video: Any, frame_rate_hz: float, length: int | None) -> None:
        super().__init__(spec, is_live=False, length=length)
        self._path = path
        self._video = video
        self._frame_rate_hz = frame_rate_hz
        self._next = 0
        self._last_ns = -1

    @classmethod
    def open(cls, spec: CameraSpec, _clock: Clock) -> VideoFile:
        """Open ``video:FILE``.

        Raises:
            CaptureError: The file is missing, no video, or has no frames.
            ConfigError: An option is given.
        """
        import cv2

        spec.check_options(())
        path = Path(spec.target)
        if not path.is_file():
            raise CaptureError("no such file, expected a video", spec.target or spec.text)
        video = cv2.VideoCapture(str(path))
        if not video.isOpened():
            video.release()
            raise CaptureError("is no video that can be read", str(path))
        count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        return cls(spec.text, path, video, float(video.get(cv2.CAP_PROP_FPS)), count if count > 0 else None)

    def grab(self) -> Capture | None:
        """The next frame, or None after the last.

        Raises:
            CaptureError: Not even one frame can be decoded, or far fewer than the header promises.
        """
        import cv2

        if self._video is None:
            return None
        position_ms = float(self._video.get(cv2.CAP_PROP_POS_MSEC))
        is_read, image = self._video.read()
        if not is_read:
            if self._next == 0:
                raise CaptureError("holds no frame that can be decoded", str(self._path))
            self.close()
            if self.length is not None and self._next < _WHOLE * self.length - 1:
                raise CaptureError(f"ends after {self._next} of {self.length} frames: truncated?", str(self._path))
            return None
        t_ns = ns_from_s(s_from_ms(position_ms))
        if t_ns <= self._last_ns:
            step_s = 1.0 / self._frame_rate_hz if self._frame_rate_hz > 0.0 else 0.0
            t_ns = self._last_ns + max(1, ns_from_s(step_s))
        self._last_ns = t_ns
        capture = Capture(np.ascontiguousarray(image), t_ns, f"{self._path.name}#{self._next}", self._next)
        self._next += 1
        return capture

    def close(self) -> None:
        """Release the file. Safe to call twice."""
        if self._video is not None:
            self._video.release()
            self._video = None
