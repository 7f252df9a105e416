"""A USB or built-in camera through Video4Linux."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uvgs_bench.devices.cameras.base import ClosingSource
from uvgs_bench.devices.cameras.source import Setting
from uvgs_bench.devices.clock import Clock
from uvgs_bench.errors import CaptureError, ConfigError
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.units import NS_PER_S, ms_from_s, ns_from_s, s_from_ms

if TYPE_CHECKING:
    from uvgs_bench.devices.cameras.spec import CameraSpec

# The driver keeps up to four finished frames; one more may have begun its exposure before the call.
_QUEUED_FRAMES = 5
# A driver stamp further than this from now is on another clock and tells nothing about freshness.
_PLAUSIBLE_NS = 10 * NS_PER_S
# Video4Linux counts exposures in steps of 100 us, and calls the manual mode 1.
_EXPOSURE_STEP_S = 1e-4
_MANUAL = 1.0
# The range is not told through OpenCV: one step, and what 30 frames per second leave.
_EXPOSURE_LIMITS_S = (_EXPOSURE_STEP_S, 0.033)
# Sensors take a new exposure over between frames, and one frame is on its way.
_SETTLING_CAPTURES = 2
_OPTIONS = ("width", "height", "fps", "fourcc", "exposure_ms", "gain", "white_balance_k")


class UvcCamera(ClosingSource):
    """A live camera. Frames that waited in the driver are dropped, so that a capture was exposed after the call.

    Args:
        spec: The spec string, for messages.
        device: An open ``cv2.VideoCapture``.
        clock: Stamps the captures at their arrival.
    """

    def __init__(self, spec: str, device: Any, clock: Clock) -> None:
        super().__init__(spec, is_live=True, length=None)
        self._device = device
        self._clock = clock
        self._next = 0
        self._settings: tuple[Setting, ...] = ()

    @classmethod
    def open(cls, spec: CameraSpec, clock: Clock) -> UvcCamera:
        """Open ``uvc:0`` or ``uvc:/dev/video0``.

        Options: ``width``, ``height`` (px), ``fps``, ``fourcc`` (``YUYV``, ``MJPG``, ``GREY``), ``exposure_ms``,
        ``gain`` (the driver's own scale) and ``white_balance_k``; naming one of the last three switches the camera's
        own automatic of it off.

        Raises:
            CaptureError: There is no such device, it cannot be opened, or it has no such picture size.
            ConfigError: An option is unknown or no number.
        """
        import cv2

        spec.check_options(_OPTIONS)
        path = Path(f"/dev/video{spec.target}" if spec.target.isdigit() else spec.target or "/dev/video0")
        if not path.exists():
            there = " ".join(sorted(str(found) for found in Path("/dev").glob("video*"))) or "none"
            raise CaptureError(f"no such camera {path}; cameras found: {there}", spec.text)
        asked, fourcc = spec.numbers(words=("fourcc",)), spec.options.get("fourcc")
        if fourcc is not None and (len(fourcc) != 4 or not fourcc.isascii()):
            raise ConfigError(f"expected fourcc as four letters like MJPG, got '{fourcc}'", spec.text)
        device = cv2.VideoCapture(str(path), cv2.CAP_V4L2)
        if not device.isOpened():
            device.release()
            raise CaptureError(f"{path} cannot be opened: busy, no permission, or no video device", spec.text)
        camera = cls(spec.text, device, clock)
        try:
            camera.configure(asked, fourcc)
        except CaptureError:
            device.release()
            raise
        return camera

    def configure(self, asked: dict[str, float], fourcc: str | None = None) -> None:
        """Set what was asked for, in the order drivers need it, and read it back.

        Args:
            asked: Value by option name, in the option's unit.
            fourcc: Pixel format of four letters, or None.

        Raises:
            CaptureError: The camera has no such picture size.
        """
        import cv2

        device = self._device
        if fourcc is not None:
            # The size that a driver offers depends on the format.
            device.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*fourcc))
        sizes = {"width": cv2.CAP_PROP_FRAME_WIDTH, "height": cv2.CAP_PROP_FRAME_HEIGHT}
        for name in sizes.keys() & asked.keys():
            device.set(sizes[name], asked[name])
        for name in sizes.keys() & asked.keys():
            if (have := int(device.get(sizes[name]))) != int(asked[name]):
                raise CaptureError(f"the camera offers {name} {have} px instead of {asked[name]:g} px", self.spec)
        found = []
        if "fps" in asked:
            device.set(cv2.CAP_PROP_FPS, asked["fps"])
            found.append(Setting("fps", asked["fps"], _said(device, cv2.CAP_PROP_FPS)))
        if "exposure_ms" in asked:
            device.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL)
            device.set(cv2.CAP_PROP_EXPOSURE, round(s_from_ms(asked["exposure_ms"]) / _EXPOSURE_STEP_S))
            steps = _said(device, cv2.CAP_PROP_EXPOSURE)
            got = None if steps is None else ms_from_s(steps * _EXPOSURE_STEP_S)
            found.append(Setting("exposure_ms", asked["exposure_ms"], got, "ms"))
        if "gain" in asked:
            device.set(cv2.CAP_PROP_GAIN, asked["gain"])
            found.append(Setting("gain", asked["gain"], _said(device, cv2.CAP_PROP_GAIN)))
        if "white_balance_k" in asked:
            device.set(cv2.CAP_PROP_AUTO_WB, 0.0)
            device.set(cv2.CAP_PROP_WB_TEMPERATURE, asked["white_balance_k"])
            got = _said(device, cv2.CAP_PROP_WB_TEMPERATURE)
            found.append(Setting("white_balance_k", asked["white_balance_k"], got, "K"))
        self._settings = tuple(found)

    @property
    def settings(self) -> tuple[Setting, ...]:
        """What was asked for by options, and what the camera says it is."""
        return self._settings

    def grab(self) -> Capture:
        """Expose and return a capture.

        Raises:
            CaptureError: The camera stopped delivering.
        """
        import cv2

        if self._device is None:
            raise CaptureError("the camera is closed", self.spec)
        called_ns = time.monotonic_ns()
        for _ in range(_QUEUED_FRAMES):
            self._advance()
            stamp_ns = ns_from_s(s_from_ms(float(self._device.get(cv2.CAP_PROP_POS_MSEC))))
            if abs(stamp_ns - called_ns) < _PLAUSIBLE_NS and stamp_ns >= called_ns:
                break
        # The frame stamped after the call may have begun before it; the one after that did not.
        return self.next_capture()

    def next_capture(self) -> Capture:
        """The next frame the driver has, exposed before or after the call.

        Raises:
            CaptureError: The camera stopped delivering.
        """
        import cv2

        if self._device is None:
            raise CaptureError("the camera is closed", self.spec)
        self._advance()
        t_ns = self._clock.now_ns()
        stamp_ns = ns_from_s(s_from_ms(float(self._device.get(cv2.CAP_PROP_POS_MSEC))))
        waited_ns = time.monotonic_ns() - stamp_ns
        if 0 <= waited_ns < _PLAUSIBLE_NS:
            t_ns -= waited_ns
        is_read, image = self._device.retrieve()
        if not is_read:
            raise CaptureError("the camera delivered a frame that cannot be decoded", self.spec)
        capture = Capture(np.ascontiguousarray(image), t_ns, self.spec, self._next)
        self._next += 1
        return capture

    @property
    def exposure_s(self) -> float:
        """The exposure as the driver says it, s.

        Raises:
            CaptureError: The camera is closed or does not say.
        """
        import cv2

        if self._device is None:
            raise CaptureError("the camera is closed", self.spec)
        steps = float(self._device.get(cv2.CAP_PROP_EXPOSURE))
        if not steps > 0.0:
            raise CaptureError("the camera does not say its exposure", self.spec)
        return steps * _EXPOSURE_STEP_S

    @property
    def exposure_limits_s(self) -> tuple[float, float]:
        """Shortest and longest exposure asked for, s."""
        return _EXPOSURE_LIMITS_S

    @property
    def full_scale_dn(self) -> float:
        """Pictures are of 8 bit."""
        return 255.0

    @property
    def settling_captures(self) -> int:
        """How many captures after a change may still be taken with the old exposure."""
        return _SETTLING_CAPTURES

    def set_exposure_s(self, exposure_s: float) -> float:
        """Switch the camera's own automatic exposure off and ask for an exposure; the gain is left alone.

        Args:
            exposure_s: Wanted exposure, s; rounded to steps of 0.1 ms.

        Returns:
            What the driver says it took, s.

        Raises:
            CaptureError: The camera is closed, keeps its own exposure, or does not say what it took.
        """
        import cv2

        if self._device is None:
            raise CaptureError("the camera is closed", self.spec)
        shortest_s, longest_s = _EXPOSURE_LIMITS_S
        steps = round(min(max(exposure_s, shortest_s), longest_s) / _EXPOSURE_STEP_S)
        for name, value in ((cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL), (cv2.CAP_PROP_EXPOSURE, float(steps))):
            if not self._device.set(name, value):
                what = "be set" if name == cv2.CAP_PROP_EXPOSURE else "be taken from its own automatic"
                raise CaptureError(f"the exposure of this camera cannot {what}", self.spec)
        return self.exposure_s

    def _advance(self) -> None:
        if not self._device.grab():
            raise CaptureError("the camera stopped delivering frames", self.spec)

    def close(self) -> None:
        """Release the device. Safe to call twice."""
        if self._device is not None:
            self._device.release()
            self._device = None


def _said(device: Any, name: int) -> float | None:
    """What the driver says; OpenCV answers -1, and 0 for most that the driver does not have."""
    value = float(device.get(name))
    return value if value >= 0.0 else None
