"""A mock of our own firmware as far as the driver uses it: numbered lines with checksums, and the position report.

Simplified against ``firmware/PROTOCOL.md``: no measured moves, triggers, stamps, emergency stop or heartbeat.
"""

from __future__ import annotations

from binascii import crc_hqx
from typing import Any

import numpy as np

from uvgs_bench.devices.gantry.grbl_protocol import sealed
from uvgs_bench.devices.sim.grbl_device import GrblDevice
from uvgs_bench.units import s_from_ns, us_from_s

_POSITION = 0xF0


class UvgsDevice(GrblDevice):
    """The mock controller with our firmware's additions. Arguments as for ``GrblDevice``.

    Attributes:
        clock_rate: Controller seconds per bench second: a resonator is off by some parts in a thousand.
    """

    clock_rate = 1.0

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self._begin()
        self._boot = 0
        self._sequence = 0
        super().__init__(*arguments, **options)

    def power_cycle(self, t_ns: int) -> None:
        """Reset as opening the port does; the boot number counts."""
        self._begin()
        self._boot += 1
        super().power_cycle(t_ns)

    def receive(self, byte: int, t_ns: int) -> None:
        """Take one byte from the host."""
        if byte == _POSITION:
            self._advance(s_from_ns(t_ns))
            self._send(self._position_report())
        elif byte in (0x0A, 0x0D):
            line = bytes(self._held)
            self._held.clear()
            self._line_came(line, t_ns)
        elif byte in (0x18, 0x21, 0x3F, 0x7E) or byte > 0x7F:
            if byte == 0x18:
                self._begin()
            super().receive(byte, t_ns)
        else:
            self._held.append(byte)

    def _begin(self) -> None:
        self._held = bytearray()
        self._number: int | None = None
        self._last_reply = ""

    def _line_came(self, line: bytes, t_ns: int) -> None:
        text, star, _ = line.decode("latin-1").rpartition("*")
        if not star:
            self._pass_on(line, t_ns)
            return
        number, _, inner = text.removeprefix("N").partition(" ")
        if not number.isdigit() or sealed(int(number), inner).encode("latin-1") != line:
            self._answer("error:60", t_ns)
        elif int(number) == self._number:
            self._answer(self._last_reply, t_ns)
        elif self._number is not None and int(number) != self._number + 1:
            self._answer("error:61", t_ns)
        else:
            self._number = int(number)
            self._pass_on(inner.encode("latin-1"), t_ns)

    def _pass_on(self, line: bytes, t_ns: int) -> None:
        for value in line + b"\n":
            super().receive(value, t_ns)

    def _answer(self, reply: str, t_ns: int) -> None:
        self._advance(s_from_ns(t_ns))
        self._send(reply)

    def _send(self, line: str) -> None:
        if line == "ok" or line.startswith("error:"):
            self._last_reply = line
        super()._send(line)

    def _answer_query(self, text: str) -> None:
        super()._answer_query(text)
        if text == "I":
            self._send("[FIRMWARE:uvgs_gantry]")
            self._send(f"[BOOT:{self._boot},button]")

    def _position_report(self) -> str:
        moving = self._planner.motors.moving is not None
        steps = np.rint(self._planner.position() * self.steps_per_mm).astype(int)
        homed = "-" if self.state == "Alarm" else self.letters
        fields = (
            str(self._sequence), self.state, str(int(us_from_s(self._planner.now_s * self.clock_rate))),
            ",".join(map(str, steps)), "0" if moving else "100000", "-", homed, "M" if moving else "-", str(self._boot),
        )  # fmt: skip
        self._sequence = (self._sequence + 1) % 65536
        body = "POS:" + "|".join(fields)
        return f"[{body}*{crc_hqx(body.encode('ascii'), 0xFFFF):04X}]"
