"""pyserial handler of ``sim://``: a serial port whose other end is a mock GRBL controller.

``sim://NAME`` is the controller of the live simulated bench of that name and keeps its time; ``sim://?speed=N`` is a
controller of its own with three axes of 200 mm, N times faster than real time. Opening resets the controller, as it
does for an Arduino.
"""

from __future__ import annotations

from math import inf
from urllib.parse import parse_qsl, urlsplit

from serial import PortNotOpenError, SerialBase, SerialException, to_bytes

from uvgs_bench.devices.clock import Clock, ScaledClock
from uvgs_bench.devices.sim.grbl_device import GrblDevice
from uvgs_bench.devices.sim.grbl_settings import metrology_settings
from uvgs_bench.units import s_from_ns

_LONGEST_NAP_S = 0.02


class Serial(SerialBase):  # type: ignore[misc]
    """The port. Bytes pass in bench time; ``timeout`` is real time, as for any port."""

    BAUDRATES = (115200,)
    is_open: bool

    def open(self) -> None:
        """Open the port and reset the controller. Raises SerialException for an unknown bench or option."""
        if self.is_open:
            raise SerialException("port is already open")
        self._clock, self._device = _other_end(str(self.port))
        self._speed = getattr(self._clock, "speed", 1.0)
        self._received = bytearray()
        self.is_open = True
        self._device.power_cycle(self._clock.now_ns())

    def close(self) -> None:
        """Close the port; the controller lives on."""
        self.is_open = False

    def _reconfigure_port(self) -> None:
        """Nothing to configure."""

    def _update_dtr_state(self) -> None:
        """A rising edge resets, as on an Arduino."""
        if self.dtr:
            self._device.power_cycle(self._clock.now_ns())

    def _update_rts_state(self) -> None:
        """Not wired."""

    @property
    def in_waiting(self) -> int:
        """Number of bytes that can be read now."""
        self._pump()
        return len(self._received)

    def read(self, size: int = 1) -> bytes:
        """Read up to ``size`` bytes, waiting for them no longer than ``timeout``."""
        wait_s = inf if self.timeout is None else self.timeout * self._speed
        begun_ns = self._clock.now_ns()
        while True:
            # The time is taken first: what has been sent by the deadline is received, however late this thread runs.
            left_s = wait_s - s_from_ns(self._clock.now_ns() - begun_ns)
            self._pump()
            if len(self._received) >= size or left_s <= 0.0:
                break
            event_ns = self._device.next_event_ns()
            if event_ns is not None:
                left_s = min(left_s, max(0.0, s_from_ns(event_ns - self._clock.now_ns())))
            self._clock.sleep(min(left_s, _LONGEST_NAP_S * self._speed))
        taken = bytes(self._received[:size])
        del self._received[:size]
        return taken

    def write(self, data: bytes) -> int:
        """Send bytes; they arrive at once."""
        if not self.is_open:
            raise PortNotOpenError
        for byte in to_bytes(data):
            self._device.receive(byte, self._clock.now_ns())
        return len(data)

    def flush(self) -> None:
        """Nothing is ever held back."""

    def reset_input_buffer(self) -> None:
        """Forget what was received and not read."""
        self._pump()
        self._received.clear()

    def reset_output_buffer(self) -> None:
        """Nothing is ever held back."""

    def _pump(self) -> None:
        if not self.is_open:
            raise PortNotOpenError
        self._received += self._device.take_output(self._clock.now_ns())


def _other_end(url: str) -> tuple[Clock, GrblDevice]:
    parts = urlsplit(url)
    options = dict(parse_qsl(parts.query, keep_blank_values=True))
    name = parts.netloc
    unknown = sorted(set(options) - (set() if name else {"speed"}))
    if unknown:
        known = "a named bench has none: it keeps its own time" if name else "speed=N"
        raise SerialException(f"unknown option {unknown[0]!r} in {url} ({known})")
    if name:
        from uvgs_bench.devices.sim.bench import simulated_bench

        try:
            bench = simulated_bench(name)
        except KeyError:
            raise SerialException(f"no simulated bench named {name!r} is running") from None
        return bench.clock, bench.device
    try:
        clock = ScaledClock(float(options.get("speed", "1")))
    except ValueError:
        raise SerialException(f"option speed of {url} must be a positive number") from None
    return clock, GrblDevice(settings=metrology_settings(), switches_mm=(0.0,) * 3, start_mm=(-50.0,) * 3)
