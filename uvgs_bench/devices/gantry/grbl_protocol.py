"""The words of GRBL's serial protocol: what a received line is, and how a move is written. No port, no time.

Source: the GRBL 1.1 interface description and recorded conversations with grbl 1.1h and grblHAL.
"""

from __future__ import annotations

import re
from binascii import crc_hqx
from collections.abc import Sequence
from dataclasses import dataclass
from math import floor, isfinite
from typing import Literal

import numpy as np

from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.units import MM_PER_M, S_PER_MIN, deg_from_rad, m_from_mm, mm_from_m, rad_from_deg

RESET = 0x18
STATUS = 0x3F
HOLD = 0x21
JOG_CANCEL = 0x85
POSITION = 0xF0
"""Asks our own firmware for its time and step counters."""
_PLACE_FIELDS = 9
LONGEST_LINE = 80
"""Characters a controller's line buffer holds, its terminator included."""

REPORT_STEP = 0.0005
"""Half the last digit of a reported position, mm or deg."""


@dataclass(frozen=True, slots=True)
class Reply:
    """The one answer to a line: ``ok`` (code 0) or ``error:N``."""

    code: int


@dataclass(frozen=True, slots=True)
class Alarm:
    """``ALARM:N``."""

    code: int


@dataclass(frozen=True, slots=True)
class Welcome:
    """The controller has started: after power-up, a reset, or leaving the check mode."""

    text: str


@dataclass(frozen=True, slots=True)
class Setting:
    """``$N=value``."""

    number: str
    value: str


@dataclass(frozen=True, slots=True)
class Message:
    """A bracketed line, ``[NAME:text]``."""

    name: str
    text: str


@dataclass(frozen=True, slots=True)
class Unknown:
    """A line that is none of the others."""

    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """A status report.

    Args:
        activity: The state word without its number, for example ``Hold``.
        substate: Its number as text, or empty.
        machine: Machine position in mm or deg, or None when the report has the work position.
        work: Work position in mm or deg, or None.
        offset: Work offset in mm or deg, or None when this report leaves it out.
        fields: Every other field as text.
    """

    activity: str
    substate: str
    machine: FloatArray | None
    work: FloatArray | None
    offset: FloatArray | None
    fields: dict[str, str]


Received = Reply | Alarm | Welcome | Setting | Message | Report | Unknown

_WELCOME = re.compile(r"^(Grbl|GrblHAL|grblHAL) \S+ .*\[.*help\]", re.IGNORECASE)
_SETTING = re.compile(r"^\$(N?\d+)=(.*)$")
_MESSAGE = re.compile(r"^\[([A-Z][A-Z0-9. ]*):?(.*)\]$")
_NUMBERED = re.compile(r"^(error|ALARM):(\d+)$")
_ACTIVITIES = frozenset(
    {"Idle", "Run", "Hold", "Jog", "Alarm", "Door", "Check", "Home", "Sleep", "Tool", "ConfigAlarm"}
)
_POSITIONS = {"MPos": "machine", "WPos": "work", "WCO": "offset"}


def read_received(line: str) -> Received:
    """Say what a received line is.

    Args:
        line: The line without its end.

    Returns:
        Its meaning; ``Unknown`` for anything malformed, so that noise on the wire never becomes a position.
    """
    text = line.strip()
    if text == "ok":
        return Reply(0)
    if match := _NUMBERED.match(text):
        code = int(match.group(2))
        return Reply(code) if match.group(1) == "error" else Alarm(code)
    if text.startswith("<") and text.endswith(">"):
        return _read_report(text)
    if _WELCOME.match(text):
        return Welcome(text)
    if match := _SETTING.match(text):
        return Setting(match.group(1), match.group(2))
    if match := _MESSAGE.match(text):
        return Message(match.group(1), match.group(2))
    return Unknown(line)


def may_follow_homing(received: Received) -> bool:
    """Whether something can come during a homing cycle.

    ``$H`` with one bit turned over is ``$X``: the lock is released, a message says so, an ``ok`` follows, and the
    controller is idle wherever it was switched on.
    """
    return not isinstance(received, Unknown) and not (isinstance(received, Message) and "nlock" in received.text)


def _read_report(text: str) -> Report | Unknown:
    state, *rest = text[1:-1].split("|")
    activity, _, substate = state.partition(":")
    if activity not in _ACTIVITIES:
        return Unknown(text)
    positions: dict[str, FloatArray] = {}
    fields: dict[str, str] = {}
    for part in rest:
        name, _, value = part.partition(":")
        if name in _POSITIONS:
            try:
                numbers = [float(number) for number in value.split(",")]
            except ValueError:
                return Unknown(text)
            if not all(isfinite(number) for number in numbers):
                return Unknown(text)
            positions[_POSITIONS[name]] = read_only(numbers)
        else:
            fields[name] = value
    if not activity.isalpha() or not ("machine" in positions or "work" in positions):
        return Unknown(text)
    return Report(activity, substate, positions.get("machine"), positions.get("work"), positions.get("offset"), fields)


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Our firmware's position report: all of one instant, and proven whole by its checksum.

    Args:
        activity: The controller's word.
        substate: What follows it after a colon, or empty.
        controller_us: When the question arrived, us since the controller's start.
        steps: Step counters, shape (A,).
        age_us: Time since the last step, us.
        homed: Letters of the homed axes.
        flags: As in ``firmware/PROTOCOL.md``.
        boot: Number of the controller's start.
    """

    activity: str
    substate: str
    controller_us: float
    steps: FloatArray
    age_us: float
    homed: str
    flags: str
    boot: int


def read_place(message: Message) -> Place | None:
    """The position report ``[POS:...*CRC]``, or None when it is damaged.

    Source: ``firmware/PROTOCOL.md``: CRC-16/CCITT-FALSE of everything between the bracket and the star.
    """
    text, _, check = f"{message.name}:{message.text}".rpartition("*")
    fields = text.split("|")
    if len(fields) != _PLACE_FIELDS or f"{crc_hqx(text.encode('latin-1', 'replace'), 0xFFFF):04X}" != check:
        return None
    activity, _, substate = fields[1].partition(":")
    homed, flags = (field.replace("-", "") for field in fields[6:8])
    try:
        t_us, age_us, boot = (int(fields[i]) for i in (2, 4, 8))
        steps = read_only([float(int(count)) for count in fields[3].split(",")])
    except ValueError:
        # One damaged line in 65536 has the checksum of a whole one.
        return None
    return Place(activity, substate, float(t_us), steps, float(age_us), homed, flags, boot)


def shown(received: Received) -> str:
    """Something received as a line for people."""
    match received:
        case Reply(code):
            return f"error:{code}" if code else "ok"
        case Alarm(code):
            return f"ALARM:{code}"
        case Setting(number, value):
            return f"${number}={value}"
        case Message(name, text):
            return f"[{name}:{text}]"
        case Report():
            places = {"MPos": received.machine, "WPos": received.work, "WCO": received.offset}
            told = [f"{name}:{','.join(f'{v:.3f}' for v in at)}" for name, at in places.items() if at is not None]
            state = received.activity + (f":{received.substate}" if received.substate else "")
            return "<" + "|".join([state, *told, *(f"{name}:{text}" for name, text in received.fields.items())]) + ">"
        case Welcome(text) | Unknown(text):
            return text


def controller_from_si(axes: Sequence[Axis], position: FloatArray) -> FloatArray:
    """Axis positions as the controller counts them.

    Args:
        axes: The axes.
        position: Axis positions, shape (A,), m or rad.

    Returns:
        Shape (A,), mm or deg.
    """
    return np.array(
        [
            mm_from_m(float(value)) if axis.kind == "linear" else deg_from_rad(float(value))
            for axis, value in zip(axes, position, strict=True)
        ]
    )


def si_from_controller(axes: Sequence[Axis], position: FloatArray) -> FloatArray:
    """Axis positions in m or rad from the controller's mm or deg, shape (A,)."""
    return read_only(
        [
            m_from_mm(float(value)) if axis.kind == "linear" else rad_from_deg(float(value))
            for axis, value in zip(axes, position, strict=True)
        ]
    )


@dataclass(frozen=True, slots=True)
class PathPlan:
    """How long a straight move takes and which feed makes it so.

    Args:
        feed_per_min: Feed along the path as the controller counts it: norm over all axes, mm and deg alike, per minute.
        duration_s: From rest to rest, s.
    """

    feed_per_min: float
    duration_s: float


def plan_path(axes: Sequence[Axis], delta: FloatArray, speed: float) -> PathPlan:
    """Feed and duration of a straight move, with no axis faster than it may be.

    Args:
        axes: The axes.
        delta: The move, shape (A,), m or rad, not zero.
        speed: Speed along the linear part, m/s; along the rotary part when there is no linear one, rad/s; > 0.

    Returns:
        The plan; the feed is rounded down.
    """
    is_linear = np.array([axis.kind == "linear" for axis in axes])
    linear, rotary = float(np.linalg.norm(delta[is_linear])), float(np.linalg.norm(delta[~is_linear]))
    cruise_s = (linear or rotary) / speed
    fastest = max(abs(d) / axis.max_speed for axis, d in zip(axes, delta, strict=True))
    cruise_s = max(cruise_s, fastest)
    # All axes share the shape of the speed over time; the slowest of the ramps counts.
    ramp_s = max(abs(d) / cruise_s / axis.acceleration for axis, d in zip(axes, delta, strict=True))
    duration_s = cruise_s + ramp_s if ramp_s <= cruise_s else 2.0 * (ramp_s * cruise_s) ** 0.5
    length = float(np.linalg.norm(controller_from_si(axes, delta)))
    feed = length / cruise_s * S_PER_MIN
    return PathPlan(floor(feed * MM_PER_M) / MM_PER_M, duration_s)


def write_move(
    axes: Sequence[Axis], position: FloatArray, feed_per_min: float, *, style: Literal["jog", "line"] = "jog"
) -> str:
    """A move to absolute machine positions.

    Args:
        axes: The axes.
        position: Machine axis positions, shape (A,), m or rad.
        feed_per_min: Feed along the path, mm/min or deg/min, > 0.
        style: ``jog`` (``$J=``, refused safely when it cannot be) or ``line`` (``G1``).

    Returns:
        The line without its end.

    Raises:
        ValueError: The line would not fit the controller's buffer, or the feed rounds to nothing.
    """
    if not feed_per_min >= 1.0 / MM_PER_M:
        raise ValueError(f"a feed of {feed_per_min} per minute is too slow to be written")
    # Adding 0.0 turns -0.0 into 0.0.
    words = "".join(
        f"{axis.name}{round(float(value), 4) + 0.0:.4f}"
        for axis, value in zip(axes, controller_from_si(axes, position), strict=True)
    )
    start = "$J=G21G90G53" if style == "jog" else "G21G90G53G1"
    line = f"{start}{words}F{feed_per_min:.3f}"
    check_line(line)
    return line


_HARMLESS = re.compile(r"^(\$|\$\$|\$#|\$G|\$I|\$N|\$S|\$P|\$L|\$E|\$\d+=-?[\d.]+)$")


def is_harmless(line: str) -> bool:
    """Whether a line asks or sets something and moves nothing, in any dialect."""
    return _HARMLESS.match(line) is not None


def sealed(number: int, line: str) -> str:
    """A line with its number and checksum, for firmware that refuses damaged lines and does not run one twice.

    Args:
        number: Of the line, one more than that of the line before.
        line: Without its end.

    Returns:
        The line as sent.

    Source: ``firmware/PROTOCOL.md``, numbered lines and checksums: CRC-8, polynomial 0x07, start 0.
    """
    text = f"N{number} {line}"
    check = 0
    for byte in text.encode("ascii"):
        check ^= byte
        for _ in range(8):
            check = (check << 1) ^ (0x07 if check & 0x80 else 0)
            check &= 0xFF
    return f"{text}*{check:02X}"


def check_line(line: str) -> None:
    """Refuse a line the controller would drop or misread.

    Args:
        line: Without its end.

    Raises:
        ValueError: Too long, or with characters outside printable ASCII.
    """
    if len(line) + 1 > LONGEST_LINE:
        raise ValueError(f"the line {line!r} has {len(line)} characters; a controller takes {LONGEST_LINE - 1}")
    if not all(" " <= character <= "~" for character in line):
        raise ValueError(f"the line {line!r} has characters outside printable ASCII")
