"""Ports for tests of the GRBL driver: the mock controller with a spied wire, and a port that answers from a table."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
import serial

from uvgs_bench.devices.clock import ScaledClock, SteppedClock
from uvgs_bench.devices.gantry import Axis, Envelope
from uvgs_bench.devices.gantry.grbl import GrblGantry
from uvgs_bench.devices.sim import bench as sim_bench
from uvgs_bench.devices.sim.grbl_device import GrblDevice

SPEED = 400.0
WELCOME = b"\r\nGrbl 1.1h ['$' for help]\r\n"


def linear_axes(travel_m: float = 0.2, max_speed: float = 0.05) -> tuple[Axis, ...]:
    return tuple(
        Axis(name, "linear", direction, -travel_m, 0.0, max_speed, 0.2)
        for name, direction in zip("XYZ", np.eye(3), strict=True)
    )


class Spy:
    """The wire log as a list; ``on_event`` is called with the number of each event and may raise."""

    def __init__(self) -> None:
        self.events: list[tuple[int, str, str]] = []
        self.on_event: Callable[[int, str, str], None] = lambda _number, _direction, _text: None

    def __call__(self, t_ns: int, direction: str, text: str) -> None:
        self.events.append((t_ns, direction, text))
        self.on_event(len(self.events), direction, text)

    def sent(self) -> list[str]:
        return [text for _, direction, text in self.events if direction == ">"]

    def moves(self) -> list[str]:
        return [text for text in self.sent() if "F" in text]


class MockGantry:
    """A driver open on a mock controller."""

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        device: GrblDevice | None = None,
        envelope: Envelope | None = None,
        homing_timeout_s: float = 120.0,
    ) -> None:
        self.envelope = envelope or Envelope(linear_axes())
        self.device = device or GrblDevice.for_axes(self.envelope.axes)
        self.clock = SteppedClock()
        self.spy = Spy()
        monkeypatch.setitem(sim_bench._live, "mock", SimpleNamespace(clock=self.clock, device=self.device))
        self.gantry = GrblGantry.open(
            "sim://mock", self.envelope, clock=self.clock, log=self.spy, homing_timeout_s=homing_timeout_s
        )

    def type_behind_its_back(self, line: str) -> None:
        for byte in line.encode() + b"\n":
            self.device.receive(byte, self.clock.now_ns())


class TablePort:
    """A port that answers each written line or byte from a function, at once."""

    def __init__(self, answer: Callable[[bytes], bytes], greeting: bytes = WELCOME) -> None:
        self.answer = answer
        self.pending = bytearray(greeting)
        self.line = bytearray()
        self.is_gone = False

    @property
    def in_waiting(self) -> int:
        return len(self.pending)

    def read(self, size: int) -> bytes:
        if self.is_gone:
            raise serial.SerialException("device reports readiness to read but returned no data")
        taken = bytes(self.pending[:size])
        del self.pending[:size]
        return taken

    def write(self, data: bytes) -> int:
        if self.is_gone:
            raise OSError(5, "Input/output error")
        for value in data:
            if value in (0x18, 0x3F, 0x21, 0x85):
                self.pending += self.answer(bytes([value]))
            elif value == 0x0A:
                self.pending += self.answer(bytes(self.line))
                self.line.clear()
            else:
                self.line.append(value)
        return len(data)

    def close(self) -> None:
        pass


def open_table(
    monkeypatch: pytest.MonkeyPatch, port: TablePort, axes: tuple[Axis, ...] | None = None
) -> tuple[GrblGantry, Spy]:
    monkeypatch.setattr(serial, "serial_for_url", lambda *_args, **_options: port)
    spy = Spy()
    gantry = GrblGantry.open("table", Envelope(axes or linear_axes()), clock=ScaledClock(SPEED), log=spy)
    return gantry, spy
