"""A camera that streams over the network: RTSP, or MJPEG and other video over HTTP."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from uvgs_bench.devices.cameras.base import ClosingSource
from uvgs_bench.devices.clock import Clock
from uvgs_bench.errors import CaptureError
from uvgs_bench.sensor.capture import Capture

if TYPE_CHECKING:
    from uvgs_bench.devices.cameras.spec import CameraSpec

_OPEN_MS = 8000.0
_READ_MS = 5000.0
# A frame that had to be waited for so long was not lying in a buffer.
_WAITED_S = 0.002
_MOST_BUFFERED = 120
# Datagrams that get lost leave grey bars in pictures; what waits in a buffer is old.
_ENVIRONMENT = {
    "OPENCV_FFMPEG_CAPTURE_OPTIONS": "rtsp_transport;tcp|fflags;nobuffer",
    "OPENCV_FFMPEG_LOGLEVEL": "-8",
}


class NetworkStream(ClosingSource):
    """Decoded frames of a stream, as BGR, stamped at their arrival: the delay of camera and network is not known.

    Args:
        spec: The spec string, for messages.
        video: An open ``cv2.VideoCapture``.
        clock: Stamps the captures.
    """

    def __init__(self, spec: str, video: Any, clock: Clock) -> None:
        super().__init__(spec, is_live=True, length=None)
        self._video = video
        self._clock = clock
        self._next = 0

    @classmethod
    def open(cls, spec: CameraSpec, clock: Clock) -> NetworkStream:
        """Open ``rtsp://HOST/STREAM``, ``http://...`` or ``https://...``.

        Raises:
            CaptureError: It is no address, nothing answers there, or it is no video.
        """
        name = without_password(spec.text)
        if not spec.target.startswith(f"{spec.scheme}://"):
            raise CaptureError(f"expected an address like {spec.scheme}://HOST/STREAM", name)
        import cv2

        limits = (cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, int(_OPEN_MS), cv2.CAP_PROP_READ_TIMEOUT_MSEC, int(_READ_MS))
        with _quiet_environment():
            video = cv2.VideoCapture(spec.target, cv2.CAP_FFMPEG, limits)
        if not video.isOpened():
            video.release()
            raise CaptureError("nothing answers there, or it is no video that can be decoded", name)
        return cls(name, video, clock)

    def grab(self) -> Capture:
        """Return a frame that was not yet there at the call; those that waited in a buffer are dropped.

        Raises:
            CaptureError: The stream ended or nothing comes.
        """
        for _ in range(_MOST_BUFFERED):
            began_s = time.monotonic()
            self._advance()
            if time.monotonic() - began_s >= _WAITED_S:
                break
        return self.next_capture()

    def next_capture(self) -> Capture:
        """The next frame of the stream.

        Raises:
            CaptureError: The stream ended or nothing comes.
        """
        self._advance()
        t_ns = self._clock.now_ns()
        is_read, image = self._video.retrieve()
        if not is_read:
            raise CaptureError("the stream delivered a frame that cannot be decoded", self.spec)
        capture = Capture(np.ascontiguousarray(image), t_ns, self.spec, self._next)
        self._next += 1
        return capture

    def close(self) -> None:
        """Hang up. Safe to call twice."""
        if self._video is not None:
            self._video.release()
            self._video = None

    def _advance(self) -> None:
        if self._video is None:
            raise CaptureError("the stream is closed", self.spec)
        if not self._video.grab():
            raise CaptureError("the stream ended, or nothing came for some seconds", self.spec)


@contextmanager
def _quiet_environment() -> Iterator[None]:
    """What OpenCV asks the environment about streams; files are not opened with it. What fails is said in our words."""
    import cv2

    added = {key: value for key, value in _ENVIRONMENT.items() if key not in os.environ}
    os.environ.update(added)
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)
        for key in added:
            del os.environ[key]


def without_password(address: str) -> str:
    """The address as it may be shown and stored: ``rtsp://user:***@host/stream``."""
    return re.sub(r"(//[^/@:]*):[^/@]*@", r"\1:***@", address)
