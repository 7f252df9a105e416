"""An Intel RealSense camera: its left infrared imager, with the projector off (extra ``realsense``)."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import numpy as np

from uvgs_bench.devices.cameras.base import ClosingSource
from uvgs_bench.devices.cameras.source import Setting
from uvgs_bench.devices.clock import Clock
from uvgs_bench.errors import CaptureError, ConfigError
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.units import ms_from_s, ns_from_s, s_from_ms

if TYPE_CHECKING:
    from uvgs_bench.devices.cameras.spec import CameraSpec

_OPTIONS = ("width", "height", "fps", "exposure_ms", "gain", "imager")
_TIMEOUT_MS = 3000
# The infrared imagers count their exposure in microseconds, the colour imager in steps of 100.
_STEPS_PER_S = {False: 1e6, True: 1e4}


class RealSenseCamera(ClosingSource):
    """A live infrared or colour imager, stamped at its arrival less half of the exposure.

    Args:
        spec: The spec string, for messages.
        pipeline: A started ``pyrealsense2.pipeline``.
        sensor: The ``pyrealsense2.sensor`` whose exposure is set.
        names: The module's ``option`` enumeration.
        is_colour: Whether frames are BGR instead of mono.
        clock: Stamps the captures.
        asked: Options of the spec as numbers.
    """

    def __init__(
        self, spec: str, pipeline: Any, sensor: Any, names: Any, is_colour: bool, clock: Clock, asked: dict[str, float]
    ) -> None:
        super().__init__(spec, is_live=True, length=None)
        self._pipeline, self._sensor, self._names, self._clock = pipeline, sensor, names, clock
        self._is_colour = is_colour
        self._steps_per_s = _STEPS_PER_S[is_colour]
        self._next = 0
        found = []
        if "exposure_ms" in asked:
            got_ms = ms_from_s(self.set_exposure_s(s_from_ms(asked["exposure_ms"])))
            found.append(Setting("exposure_ms", asked["exposure_ms"], got_ms, "ms"))
        if "gain" in asked:
            sensor.set_option(names.gain, asked["gain"])
            found.append(Setting("gain", asked["gain"], float(sensor.get_option(names.gain))))
        self._settings = tuple(found)

    @classmethod
    def open(cls, spec: CameraSpec, clock: Clock) -> RealSenseCamera:
        """Open ``realsense:SERIAL``, or ``realsense:`` for the first camera.

        Options: ``width``, ``height`` (px), ``fps``, ``exposure_ms``, ``gain`` and ``imager`` (``infrared`` or
        ``color``).

        Raises:
            CaptureError: The package is not installed, there is no such camera, or it has no such picture.
            ConfigError: An option is unknown or no number.
        """
        spec.check_options(_OPTIONS)
        asked, imager = spec.numbers(words=("imager",)), spec.options.get("imager", "infrared")
        if imager not in ("infrared", "color"):
            raise ConfigError(f"expected imager as infrared or color, got '{imager}'", spec.text)
        is_colour = imager == "color"
        try:
            rs: Any = importlib.import_module("pyrealsense2")
        except ImportError:
            raise CaptureError("needs the extra 'realsense': pip install 'uvgs-bench[realsense]'", spec.text) from None
        there = [device.get_info(rs.camera_info.serial_number) for device in rs.context().query_devices()]
        if not there or (spec.target and spec.target not in there):
            raise CaptureError(f"no such RealSense camera; found: {', '.join(there) or 'none'}", spec.text)
        config = rs.config()
        config.enable_device(spec.target or there[0])
        size = int(asked.get("width", 1280)), int(asked.get("height", 720))
        stream, pixels = (rs.stream.color, rs.format.bgr8) if is_colour else (rs.stream.infrared, rs.format.y8)
        config.enable_stream(stream, 0 if is_colour else 1, *size, pixels, int(asked.get("fps", 30)))
        pipeline = rs.pipeline()
        try:
            profile = pipeline.start(config)
            device = profile.get_device()
            sensor = device.first_color_sensor() if is_colour else device.first_depth_sensor()
            if not is_colour and sensor.supports(rs.option.emitter_enabled):
                # The projector's dots are thousands of small bright lights.
                sensor.set_option(rs.option.emitter_enabled, 0)
            return cls(spec.text, pipeline, sensor, rs.option, is_colour, clock, asked)
        except RuntimeError as error:
            raise CaptureError(f"cannot be started: {error}", spec.text) from None

    def grab(self) -> Capture:
        """Return a frame whose exposure began after the call.

        Raises:
            CaptureError: The camera stopped delivering.
        """
        called_ns = self._clock.now_ns()
        while True:
            capture = self.next_capture()
            if capture.t_ns - ns_from_s(0.5 * (capture.exposure_s or 0.0)) >= called_ns:
                return capture

    def next_capture(self) -> Capture:
        """The next frame, exposed before or after the call.

        Raises:
            CaptureError: The camera stopped delivering.
        """
        if self._pipeline is None:
            raise CaptureError("the camera is closed", self.spec)
        try:
            frames = self._pipeline.wait_for_frames(_TIMEOUT_MS)
        except RuntimeError as error:
            raise CaptureError(f"stopped delivering: {error}", self.spec) from None
        frame = frames.get_color_frame() if self._is_colour else frames.get_infrared_frame(1)
        exposure_s = self.exposure_s
        t_ns = self._clock.now_ns() - ns_from_s(0.5 * exposure_s)
        capture = Capture(np.array(frame.get_data(), dtype=np.uint8), t_ns, self.spec, self._next, exposure_s)
        self._next += 1
        return capture

    @property
    def settings(self) -> tuple[Setting, ...]:
        """What was asked for by options, and what the camera says it is."""
        return self._settings

    @property
    def exposure_s(self) -> float:
        """The exposure as the camera says it, s."""
        return float(self._sensor.get_option(self._names.exposure)) / self._steps_per_s

    @property
    def exposure_limits_s(self) -> tuple[float, float]:
        """Shortest and longest exposure the camera offers, s."""
        limits = self._sensor.get_option_range(self._names.exposure)
        return float(limits.min) / self._steps_per_s, float(limits.max) / self._steps_per_s

    @property
    def full_scale_dn(self) -> float:
        """Pictures are of 8 bit."""
        return 255.0

    @property
    def settling_captures(self) -> int:
        """Frames on their way when the exposure is changed."""
        return 2

    def set_exposure_s(self, exposure_s: float) -> float:
        """Switch the automatic exposure off and ask for an exposure.

        Args:
            exposure_s: Wanted exposure, s; kept to the limits.

        Returns:
            What the camera took, s.

        Raises:
            CaptureError: The camera refuses.
        """
        shortest_s, longest_s = self.exposure_limits_s
        try:
            self._sensor.set_option(self._names.enable_auto_exposure, 0)
            self._sensor.set_option(
                self._names.exposure, min(max(exposure_s, shortest_s), longest_s) * self._steps_per_s
            )
        except RuntimeError as error:
            raise CaptureError(f"the exposure cannot be set: {error}", self.spec) from None
        return self.exposure_s

    def close(self) -> None:
        """Stop the camera. Safe to call twice."""
        if self._pipeline is not None:
            pipeline, self._pipeline = self._pipeline, None
            pipeline.stop()
