"""GigE Vision and USB3 Vision cameras through the system's Aravis library (Debian: gir1.2-aravis-0.8, python3-gi)."""

from __future__ import annotations

import importlib.util
import sys
import time
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from uvgs_bench.devices.cameras.base import ClosingSource
from uvgs_bench.devices.cameras.source import Setting
from uvgs_bench.devices.clock import Clock
from uvgs_bench.devices.system_packages import find_package
from uvgs_bench.errors import CaptureError, ConfigError
from uvgs_bench.sensor.capture import BayerPattern, Capture, ImageArray
from uvgs_bench.sensor.mosaic import develop
from uvgs_bench.units import ms_from_s, ns_from_s, s_from_ms

if TYPE_CHECKING:
    from uvgs_bench.devices.cameras.spec import CameraSpec

_OPTIONS = ("width", "height", "fps", "exposure_ms", "gain_db", "format")
_BUFFERS = 8
_TIMEOUT_S = 3.0
_US_PER_S = 1e6
# Name of the pixel format: bits, and the mosaic of colours.
_FORMATS: dict[str, tuple[int, BayerPattern | None]] = {
    "Mono8": (8, None),
    "Mono10": (10, None),
    "Mono12": (12, None),
    "Mono16": (16, None),
    "BayerRG8": (8, "rggb"),
    "BayerBG8": (8, "bggr"),
    "BayerGR8": (8, "grbg"),
    "BayerGB8": (8, "gbrg"),
}


class AravisCamera(ClosingSource):
    """A live machine-vision camera, stamped at mid-exposure: arrival of the frame less half of the exposure.

    Args:
        spec: The spec with its options.
        aravis: The module of the bindings.
        camera: An open ``Aravis.Camera``.
        clock: Stamps the captures.

    Raises:
        CaptureError: The camera refuses a setting or does not start.
        ConfigError: An option is no number.
    """

    def __init__(self, spec: CameraSpec, aravis: Any, camera: Any, clock: Clock) -> None:
        super().__init__(spec.text, is_live=True, length=None)
        self._aravis, self._camera, self._clock = aravis, camera, clock
        self._next = 0
        self._settings = self._configure(spec)
        self._bits, self._bayer = _FORMATS[camera.get_pixel_format_as_string()]
        self._exposure_s = float(camera.get_exposure_time()) / _US_PER_S
        self._stream: Any = camera.create_stream(None, None)
        if self._stream is None:
            raise CaptureError("no stream can be opened; another program may be using the camera", spec.text)
        for _ in range(_BUFFERS):
            self._stream.push_buffer(aravis.Buffer.new_allocate(camera.get_payload()))
        camera.start_acquisition()

    @classmethod
    def open(cls, spec: CameraSpec, clock: Clock) -> AravisCamera:
        """Open ``aravis:ID``, or ``aravis:`` for the only camera there is.

        Options: ``width``, ``height`` (px), ``fps``, ``exposure_ms``, ``gain_db`` and ``format`` (``Mono8``,
        ``Mono12``, ``BayerRG8`` ...). ``aravis:Fake_1`` is the library's own fake camera.

        Raises:
            CaptureError: Aravis is not installed, or there is no such camera.
            ConfigError: An option is unknown or no number.
        """
        spec.check_options(_OPTIONS)
        aravis = _bindings(spec.text)
        if spec.target.startswith("Fake"):
            aravis.enable_interface("Fake")
        aravis.update_device_list()
        there = [aravis.get_device_id(k) for k in range(aravis.get_n_devices())]
        if spec.target not in there and (spec.target or len(there) != 1):
            raise CaptureError(f"no such camera; Aravis finds: {', '.join(there) or 'none'}", spec.text)
        try:
            camera = aravis.Camera.new(spec.target or there[0])
            return cls(spec, aravis, camera, clock)
        except _glib_error() as error:
            raise CaptureError(f"cannot be opened: {error}", spec.text) from None

    def grab(self) -> Capture:
        """Return a frame whose exposure began after the call; those that waited are dropped.

        Raises:
            CaptureError: The camera stopped delivering.
        """
        called_ns = self._clock.now_ns()
        while True:
            capture = self.next_capture()
            if capture.t_ns - ns_from_s(0.5 * self._exposure_s) >= called_ns:
                return capture

    def next_capture(self) -> Capture:
        """The next whole frame, exposed before or after the call; frames with lost packets are skipped.

        Raises:
            CaptureError: The camera stopped delivering.
        """
        if self._stream is None:
            raise CaptureError("the camera is closed", self.spec)
        until_s = time.monotonic() + _TIMEOUT_S
        while time.monotonic() < until_s:
            buffer = self._stream.timeout_pop_buffer(int(_TIMEOUT_S * _US_PER_S))
            if buffer is None:
                break
            try:
                if buffer.get_status() == self._aravis.BufferStatus.SUCCESS:
                    return self._capture(buffer)
            finally:
                self._stream.push_buffer(buffer)
        raise CaptureError(f"no whole frame within {_TIMEOUT_S:g} s: unplugged, or packets are lost", self.spec)

    def _capture(self, buffer: Any) -> Capture:
        waited_ns = max(0, time.time_ns() - buffer.get_system_timestamp())
        t_ns = self._clock.now_ns() - waited_ns - ns_from_s(0.5 * self._exposure_s)
        shape = (buffer.get_image_height(), buffer.get_image_width())
        kind = np.dtype(np.uint8 if self._bits == 8 else "<u2")
        pixels = np.frombuffer(buffer.get_data(), kind, count=shape[0] * shape[1]).reshape(shape)
        image: ImageArray = pixels.copy() if self._bayer is None else develop(pixels, self._bayer)
        full = float((1 << self._bits) - 1) if self._bits > 8 else None
        capture = Capture(image, t_ns, self.spec, self._next, self._exposure_s, self._bayer, full)
        self._next += 1
        return capture

    @property
    def settings(self) -> tuple[Setting, ...]:
        """What was asked for by options, and what the camera says it is."""
        return self._settings

    @property
    def exposure_s(self) -> float:
        """The exposure as the camera says it, s."""
        return float(self._camera.get_exposure_time()) / _US_PER_S

    @property
    def exposure_limits_s(self) -> tuple[float, float]:
        """Shortest and longest exposure the camera offers, s."""
        shortest_us, longest_us = self._camera.get_exposure_time_bounds()
        return shortest_us / _US_PER_S, longest_us / _US_PER_S

    @property
    def full_scale_dn(self) -> float:
        """Largest value of a pixel."""
        return float((1 << self._bits) - 1)

    @property
    def settling_captures(self) -> int:
        """Frames on their way when the exposure is changed."""
        return 2

    def set_exposure_s(self, exposure_s: float) -> float:
        """Ask for an exposure.

        Args:
            exposure_s: Wanted exposure, s; kept to the limits.

        Returns:
            What the camera took, s.

        Raises:
            CaptureError: The camera refuses or is closed.
        """
        if self._stream is None:
            raise CaptureError("the camera is closed", self.spec)
        shortest_s, longest_s = self.exposure_limits_s
        try:
            if self._camera.is_exposure_auto_available():
                self._camera.set_exposure_time_auto(self._aravis.Auto.OFF)
            self._camera.set_exposure_time(min(max(exposure_s, shortest_s), longest_s) * _US_PER_S)
            self._exposure_s = self.exposure_s
        except _glib_error() as error:
            raise CaptureError(f"the exposure cannot be set: {error}", self.spec) from None
        return self._exposure_s

    def close(self) -> None:
        """Stop and release the camera. Safe to call twice."""
        if self._stream is not None:
            self._stream = None
            try:
                self._camera.stop_acquisition()
            except _glib_error():
                pass  # An unplugged camera cannot be told to stop.
            self._camera = None

    def _configure(self, spec: CameraSpec) -> tuple[Setting, ...]:
        camera, asked = self._camera, spec.numbers(words=("format",))
        wanted = spec.options.get("format")
        if wanted is not None:
            if wanted not in _FORMATS:
                raise ConfigError(f"expected format as one of {', '.join(_FORMATS)}, got '{wanted}'", self.spec)
            if wanted not in camera.dup_available_pixel_formats_as_strings():
                raise CaptureError(f"the camera has no format {wanted}", self.spec)
            camera.set_pixel_format_from_string(wanted)
        elif camera.get_pixel_format_as_string() not in _FORMATS:
            camera.set_pixel_format_from_string("Mono8")
        if "width" in asked or "height" in asked:
            _, _, width_px, height_px = _region(camera)
            size = int(asked.get("width", width_px)), int(asked.get("height", height_px))
            camera.set_region(0, 0, *size)
            if (got := _region(camera)[2:]) != size:
                raise CaptureError(f"the camera offers {got[0]}x{got[1]} px instead of {size[0]}x{size[1]}", self.spec)
        found = []
        if "fps" in asked:
            camera.set_frame_rate(asked["fps"])
            found.append(Setting("fps", asked["fps"], float(camera.get_frame_rate())))
        if "exposure_ms" in asked:
            if camera.is_exposure_auto_available():
                camera.set_exposure_time_auto(self._aravis.Auto.OFF)
            camera.set_exposure_time(s_from_ms(asked["exposure_ms"]) * _US_PER_S)
            got_ms = ms_from_s(float(camera.get_exposure_time()) / _US_PER_S)
            found.append(Setting("exposure_ms", asked["exposure_ms"], got_ms, "ms"))
        if "gain_db" in asked:
            if camera.is_gain_auto_available():
                camera.set_gain_auto(self._aravis.Auto.OFF)
            camera.set_gain(asked["gain_db"])
            found.append(Setting("gain_db", asked["gain_db"], float(camera.get_gain()), "dB"))
        return tuple(found)


def _region(camera: Any) -> tuple[int, int, int, int]:
    region = camera.get_region()
    return region.x, region.y, region.width, region.height


def _bindings(spec: str) -> Any:
    try:
        if "gi" not in sys.modules:
            # Only this package is taken from there, not the system's older numpy.
            found = find_package("gi")
            if found is None or found.loader is None:
                raise ImportError("no module gi")
            module = importlib.util.module_from_spec(found)
            sys.modules["gi"] = module
            found.loader.exec_module(module)
        _module("gi").require_version("Aravis", "0.8")
        return _module("gi.repository.Aravis")
    except (ImportError, ValueError) as error:
        sys.modules.pop("gi", None)
        raise CaptureError(
            "needs the system's Aravis: apt install gir1.2-aravis-0.8 python3-gi, "
            f"with the Python they were built for ({error})",
            spec,
        ) from None


def _glib_error() -> type[Exception]:
    error: type[Exception] = _module("gi.repository.GLib").Error
    return error


def _module(name: str) -> Any:
    with warnings.catch_warnings():
        # The bindings' importer is of an old kind.
        warnings.simplefilter("ignore", ImportWarning)
        return importlib.import_module(name)
