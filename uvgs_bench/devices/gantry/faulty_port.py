"""A bad line on purpose: a layer between the driver and any port that loses, damages and delays what passes.

``fault+ADDRESS?drop=0.001&seed=7`` stands before any address the driver opens, a device file or a pyserial URL. Every
option is a probability from 0 to 1 and 0 when left out, all drawn from one ``seed``:

- ``drop``, ``corrupt``: that a byte is lost, or has one bit turned over; both directions.
- ``delay``: that a line, in either direction, is held back by up to a second; the order stays.
- ``reset``: that the controller is restarted (a pulse on DTR, as a loose plug makes) when something is sent.
- ``alarm``: that ``ALARM:1`` comes when something is sent, as from a limit switch that catches noise.
- ``unplug``: that the port is gone from then on when something is sent.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, fields
from typing import Any
from urllib.parse import parse_qsl, urlencode

import numpy as np
from serial import SerialException

from uvgs_bench.devices.clock import Clock
from uvgs_bench.errors import ConfigError
from uvgs_bench.units import ns_from_s

PREFIX = "fault+"
_LONGEST_DELAY_S = 1.0


@dataclass(frozen=True, slots=True)
class Faults:
    """How bad the line is; probabilities from 0 to 1.

    Args:
        drop: That a byte is lost.
        corrupt: That a byte has one bit turned over.
        delay: That a line is held back by up to a second.
        reset: That the controller restarts when something is sent.
        alarm: That an alarm comes when something is sent.
        unplug: That the port vanishes when something is sent.
        seed: Seed of all of it.
    """

    drop: float = 0.0
    corrupt: float = 0.0
    delay: float = 0.0
    reset: float = 0.0
    alarm: float = 0.0
    unplug: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name != "seed" and not 0.0 <= value <= 1.0:
                raise ConfigError(f"a probability is from 0 to 1, got {value:g}", key=item.name)
        if self.seed < 0:
            raise ConfigError(f"a seed is not negative, got {self.seed}", key="seed")


def split_address(address: str) -> tuple[str, Faults | None]:
    """The address below the fault layer, and the faults; options that are no faults stay with the address.

    Args:
        address: As the user wrote it.

    Returns:
        The address to open and the faults, or None where the address names no fault layer.

    Raises:
        ConfigError: A value is no number or no probability.
    """
    if not address.startswith(PREFIX):
        return address, None
    inner, _, query = address.removeprefix(PREFIX).partition("?")
    known = {item.name for item in fields(Faults)}
    rest: list[tuple[str, str]] = []
    values: dict[str, Any] = {}
    for name, text in parse_qsl(query, keep_blank_values=True):
        if name not in known:
            rest.append((name, text))
            continue
        try:
            values[name] = int(text) if name == "seed" else float(text)
        except ValueError:
            raise ConfigError(f"expected a number, got {text!r}", address, name) from None
    if rest and "://" not in inner:
        raise ConfigError(f"unknown fault, expected one of {', '.join(sorted(known))}", address, rest[0][0])
    return inner + ("?" + urlencode(rest) if rest else ""), Faults(**values)


class FaultyPort:
    """A port seen through the faults. Only what the driver uses of a port is here.

    Args:
        port: The open port.
        faults: How bad the line is.
        clock: Bench time, for delays.
    """

    def __init__(self, port: Any, faults: Faults, clock: Clock) -> None:
        self._port = port
        self._faults = faults
        self._clock = clock
        self._rng = np.random.default_rng(faults.seed)
        self._to_controller: deque[tuple[int, bytes]] = deque()
        self._to_host: deque[tuple[int, int]] = deque()
        self._line_due_ns = 0
        self._is_gone = False

    @property
    def in_waiting(self) -> int:
        """Number of bytes that can be read now."""
        self._pump()
        now_ns = self._clock.now_ns()
        return sum(due_ns <= now_ns for due_ns, _ in self._to_host)

    def read(self, size: int = 1) -> bytes:
        """Read up to ``size`` bytes, waiting for them as the port below does. Raises SerialException when unplugged."""
        self._pump()
        taken = self._due(size)
        if not taken:
            self._take(self._port.read(size))
            self._pump()
            taken = self._due(size)
        return taken

    def write(self, data: bytes) -> int:
        """Send bytes through the faults. Raises SerialException when unplugged."""
        self._pump()
        if self._happens(self._faults.unplug):
            self._is_gone = True
            self._check_plugged()
        if self._happens(self._faults.reset):
            self._port.dtr = False
            self._port.dtr = True
        if self._happens(self._faults.alarm):
            self._to_host.extend((self._line_due_ns, value) for value in b"\r\nALARM:1\r\n")
        last_ns = self._to_controller[-1][0] if self._to_controller else 0
        self._to_controller.append((max(last_ns, self._due_ns()), self._damaged(data)))
        self._pump()
        return len(data)

    def close(self) -> None:
        """Release the port below."""
        self._port.close()

    def _check_plugged(self) -> None:
        if self._is_gone:
            raise SerialException("unplugged by the fault layer")

    def _happens(self, probability: float) -> bool:
        return probability > 0.0 and bool(self._rng.random() < probability)

    def _due_ns(self) -> int:
        """When what passes now arrives."""
        late_s = _LONGEST_DELAY_S * float(self._rng.random()) if self._happens(self._faults.delay) else 0.0
        return self._clock.now_ns() + ns_from_s(late_s)

    def _damaged(self, data: bytes) -> bytes:
        faults = self._faults
        if not data or (faults.drop == 0.0 and faults.corrupt == 0.0):
            return data
        values = np.frombuffer(data, dtype=np.uint8).copy()
        is_hit = self._rng.random(values.size) < faults.corrupt
        bits = self._rng.integers(0, 8, values.size)
        values[is_hit] ^= (1 << bits[is_hit]).astype(np.uint8)
        return values[self._rng.random(values.size) >= faults.drop].tobytes()

    def _take(self, data: bytes) -> None:
        for value in self._damaged(data):
            if self._faults.delay == 0.0:
                self._line_due_ns = self._clock.now_ns()
            self._to_host.append((self._line_due_ns, value))
            if value == 0x0A:
                self._line_due_ns = max(self._line_due_ns, self._due_ns())

    def _due(self, size: int) -> bytes:
        now_ns = self._clock.now_ns()
        taken = bytearray()
        while self._to_host and self._to_host[0][0] <= now_ns and len(taken) < size:
            taken.append(self._to_host.popleft()[1])
        return bytes(taken)

    def _pump(self) -> None:
        self._check_plugged()
        now_ns = self._clock.now_ns()
        while self._to_controller and self._to_controller[0][0] <= now_ns:
            self._port.write(self._to_controller.popleft()[1])
        waiting = self._port.in_waiting
        if waiting:
            self._take(self._port.read(waiting))
