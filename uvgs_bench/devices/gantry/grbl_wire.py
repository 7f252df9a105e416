"""The serial line to a GRBL controller: bytes in, lines out, all of it logged, a vanished port told from silence."""

from __future__ import annotations

import errno
from collections.abc import Callable
from typing import Any, TypeVar

import serial

from uvgs_bench.devices.clock import Clock
from uvgs_bench.devices.gantry.faulty_port import FaultyPort, split_address
from uvgs_bench.devices.gantry.gantry import WireLog
from uvgs_bench.devices.gantry.grbl_protocol import check_line
from uvgs_bench.errors import GantryError, GantryLost

_SIMULATED_PORTS = "uvgs_bench.devices.sim"
"""Where pyserial finds ``sim://``: a name, not an import, since real devices do not know their twins."""

_READ_S = 0.002
_WRITE_S = 2.0
_LONGEST_LINE = 2048

_Result = TypeVar("_Result")


class GrblWire:
    """An open port.

    A read looks at the time before it takes what has arrived, so that on a busy machine a controller that answered
    never looks silent.

    Args:
        address: A device file or a pyserial URL; with ``fault+`` before it, seen through a layer of faults.
        clock: Bench time.
        log: Called for everything on the wire.

    Raises:
        GantryError: The port cannot be opened.
        ConfigError: The faults make no sense.
    """

    def __init__(self, address: str, *, clock: Clock, log: WireLog) -> None:
        self.address = address
        self.is_lost = False
        self._clock = clock
        self._log = log
        self._buffer = bytearray()
        if _SIMULATED_PORTS not in serial.protocol_handler_packages:
            serial.protocol_handler_packages.append(_SIMULATED_PORTS)
        inner, faults = split_address(address)
        try:
            self._port: Any = serial.serial_for_url(
                inner, baudrate=115200, timeout=_READ_S, write_timeout=_WRITE_S, exclusive=True
            )
        except (serial.SerialException, OSError, ValueError) as error:
            raise GantryError(_why_not_open(error), address) from None
        if faults is not None:
            self._port = FaultyPort(self._port, faults, clock)

    @property
    def has_input(self) -> bool:
        """Whether something has come that was not read. Raises GantryLost."""
        return bool(self._buffer) or self._on_port(lambda: int(self._port.in_waiting)) > 0

    def remark(self, text: str) -> None:
        """Put a remark into the log."""
        self._log(self._clock.now_ns(), "#", text)

    def send_line(self, line: str) -> None:
        """Send a line and its end in one write. Raises GantryLost, and ValueError for a line that must not be sent."""
        check_line(line)
        self._log(self._clock.now_ns(), ">", line)
        self._on_port(lambda: self._port.write(line.encode("ascii") + b"\n"))

    def send_byte(self, byte: int) -> None:
        """Send a real-time byte. Raises GantryLost."""
        self._log(self._clock.now_ns(), ">!", f"0x{byte:02X}")
        self._on_port(lambda: self._port.write(bytes([byte])))

    def read_line(self, deadline_ns: int) -> str | None:
        """The next received line that is not empty.

        Args:
            deadline_ns: Bench time until which to wait, ns.

        Returns:
            The line without its end, or None when none came.

        Raises:
            GantryLost: The port vanished.
            GantryError: Bytes come without any line end.
        """
        while True:
            while (end := self._buffer.find(b"\n")) >= 0:
                line = self._buffer[:end].decode("ascii", errors="replace").strip()
                del self._buffer[: end + 1]
                if line:
                    self._log(self._clock.now_ns(), "<", line)
                    return line
            if len(self._buffer) > _LONGEST_LINE:
                raise GantryError("received bytes without line ends; expected GRBL at 115200 baud", self.address)
            is_late = self._clock.now_ns() >= deadline_ns
            self._buffer += self._on_port(lambda: self._port.read(self._port.in_waiting or 1))
            if is_late and b"\n" not in self._buffer:
                return None

    def close(self) -> None:
        """Release the port. Safe to call twice."""
        try:
            self._port.close()
        except (serial.SerialException, OSError):
            self.is_lost = True

    def _on_port(self, action: Callable[[], _Result]) -> _Result:
        try:
            return action()
        except (serial.SerialException, OSError, TypeError) as error:
            # pyserial raises TypeError when its file descriptor was closed under it.
            self.is_lost = True
            self.remark(f"port lost: {error}")
            raise GantryLost("the port vanished; the position is lost", self.address) from None


def _why_not_open(error: Exception) -> str:
    number = getattr(error, "errno", None)
    if number == errno.ENOENT:
        return "no such port; is the controller plugged in? `uvgs doctor` lists the ports"
    if number in (errno.EACCES, errno.EPERM):
        return "no permission to open the port; is the user in the group that owns it (dialout)?"
    if number in (errno.EBUSY, errno.EAGAIN):
        return "the port is in use by another program"
    # Pyserial keeps no number when a file or a null device refuses the settings of a line.
    if number == errno.EISDIR or "configure port" in str(error):
        return "is no serial port; `uvgs doctor` lists the ports"
    return f"the port cannot be opened: {' '.join(str(error).split())}"
