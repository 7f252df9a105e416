"""Replays written conversations with a GRBL controller against a simulated one, line by line.

Format: ``# scene``, then ``ms > line sent``, ``ms >! 0xNN`` real-time byte, ``ms < line received`` or ``(empty line)``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from uvgs_bench.devices.gantry.grbl_protocol import Report, read_received
from uvgs_bench.units import NS_PER_MS

_EVENT = re.compile(r"^\s*(\d+) (>!|>|<) ?(.*)$")

# A reply may come this much later than written: recordings have the latency of a pseudo-terminal, 20 to 40 ms.
LATE_MS = 150
# Positions while moving: 5 mm/s, the feed of most recorded moves, times 20 ms of latency.
MOVING_MM = 0.1
# Reported speed while moving: 12 mm/s^2 along a path times 20 ms, in mm/min, and the rounding down.
MOVING_MM_MIN = 16.0


class Device(Protocol):
    """A simulated controller: the mock, or a board that runs the firmware."""

    def receive(self, byte: int, t_ns: int) -> None: ...

    def take_output(self, t_ns: int) -> bytes: ...


@dataclass
class Exchange:
    """What the host sent at an instant and what it must receive before it sends again."""

    line_number: int
    t_ms: int
    data: bytes
    expected: list[str] = field(default_factory=list)


def read_scenes(path: Path) -> dict[str, list[Exchange]]:
    """Scenes by name, in order."""
    scenes: dict[str, list[Exchange]] = {}
    scene: list[Exchange] = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if line.startswith("# "):
            scene = scenes.setdefault(line[2:], [])
        elif match := _EVENT.match(line):
            t_ms, kind, text = int(match.group(1)), match.group(2), match.group(3)
            if kind == "<":
                scene[-1].expected.append("" if text == "(empty line)" else text)
            elif kind == ">!":
                scene.append(Exchange(number, t_ms, bytes([int(text, 16)])))
            else:
                data = text.strip().replace("\\r\\n", "\r\n").encode("ascii")
                scene.append(Exchange(number, t_ms, data if data.endswith(b"\n") else data + b"\n"))
    return scenes


def replay(exchanges: list[Exchange], device: Device) -> list[str]:
    """Send everything at its time; the differences, one text each."""
    differences: list[str] = []
    for index, exchange in enumerate(exchanges):
        t_ns = exchange.t_ms * NS_PER_MS
        for byte in exchange.data:
            device.receive(byte, t_ns)
        following = exchanges[index + 1].t_ms if index + 1 < len(exchanges) else exchange.t_ms + 1000
        received = _lines(device.take_output((following - 1) * NS_PER_MS))
        for late_ms in range(0, LATE_MS, 5):
            if len(received) >= len(exchange.expected):
                break
            received += _lines(device.take_output((following + late_ms) * NS_PER_MS))
        if len(received) != len(exchange.expected) or not all(map(is_same, exchange.expected, received)):
            differences.append(
                f"line {exchange.line_number}: sent {exchange.data!r}, expected {exchange.expected}, got {received}"
            )
    return differences


def is_same(expected: str, received: str) -> bool:
    """Whether two lines say the same; numbers that depend on the instant may differ within the tolerances above."""
    if expected == received:
        return True
    one, other = read_received(expected), read_received(received)
    if not (isinstance(one, Report) and isinstance(other, Report)):
        return False
    if (one.activity, one.substate, list(one.fields)) != (other.activity, other.substate, list(other.fields)):
        return False
    if (one.offset is None) != (other.offset is None) or (one.machine is None) != (other.machine is None):
        return False
    is_moving = one.activity in ("Run", "Jog")
    for name in set(one.fields) - {"FS"}:
        if one.fields[name] != other.fields[name]:
            return False
    feeds = [float(report.fields["FS"].split(",")[0]) for report in (one, other)]
    if abs(feeds[0] - feeds[1]) > (MOVING_MM_MIN if is_moving else 0.0):
        return False
    assert one.machine is not None
    assert other.machine is not None
    for a, b in zip(one.machine, other.machine, strict=True):
        # Where a motion was broken off depends on the instant; a commanded place is a whole tenth and must be exact.
        is_commanded = not is_moving and abs(a * 10 - round(a * 10)) < 1e-6
        if abs(a - b) > (0.0 if is_commanded else MOVING_MM):
            return False
    return True


def _lines(data: bytes) -> list[str]:
    return data.decode("ascii").replace("\r\n", "\n").split("\n")[:-1]
