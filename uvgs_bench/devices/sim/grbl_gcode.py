"""The G-code a mock GRBL 1.1 understands, refused with the numbers the real one gives.

Understood: G0 G1 G4 G17 G20 G21 G40 G49 G53 G54 G90 G91 G94, M2 M3 M4 M5 M8 M9 M30, F S T N P and the axis letters.
Everything else (arcs, probing, stored offsets) is refused as unsupported, error 20; so work offsets are always 0.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import MM_PER_INCH

_WORD = re.compile(r"([A-Z])([+-]?(?:\d+\.?\d*|\.\d+))?")
_GROUPS = {
    "G0": "motion", "G1": "motion",
    "G4": "once", "G53": "once",
    "G17": "plane", "G90": "distance", "G91": "distance", "G94": "feed", "G20": "units", "G21": "units",
    "G40": "cutter", "G49": "length", "G54": "system",
    "M2": "stop", "M30": "stop", "M3": "spindle", "M4": "spindle", "M5": "spindle", "M8": "coolant", "M9": "coolant",
}  # fmt: skip
_JOG_WORDS = {"G20", "G21", "G90", "G91", "G53"}
_NEVER_NEGATIVE = "FNPST"
LINE_CHARACTERS = 79
OVERLONG = "\x00"
"""Stands for a line that did not fit the line buffer."""


class Refused(Exception):
    """A line was refused.

    Args:
        code: The error number.
    """

    def __init__(self, code: int) -> None:
        super().__init__(f"error:{code}")
        self.code = code


@dataclass(frozen=True, slots=True)
class Modal:
    """What the parser remembers between lines. Feed in mm/min, spindle in rpm."""

    motion: str = "G0"
    units: str = "G21"
    distance: str = "G90"
    spindle: str = "M5"
    coolant: str = "M9"
    tool: int = 0
    feed_mm_min: float = 0.0
    spindle_rpm: float = 0.0

    def report(self) -> str:
        """The text of ``$G``."""
        feed = self.feed_mm_min / (MM_PER_INCH if self.units == "G20" else 1.0)
        return (
            f"[GC:{self.motion} G54 G17 {self.units} {self.distance} G94 {self.spindle} {self.coolant} "
            f"T{self.tool} F{feed:.0f} S{self.spindle_rpm:.0f}]"
        )

    @property
    def output_rpm(self) -> float:
        """What the spindle pin puts out, rpm."""
        return 0.0 if self.spindle == "M5" else self.spindle_rpm


@dataclass(frozen=True, slots=True, eq=False)
class Action:
    """What a line asks for.

    Args:
        modal: The parser's memory after the line.
        target: Machine positions to go to, shape (A,), mm or deg, or None.
        feed_mm_min: Feed along the path, mm/min; None for a rapid.
        dwell_s: Time to wait after all motion, s, or None.
    """

    modal: Modal
    target: FloatArray | None = None
    feed_mm_min: float | None = None
    dwell_s: float | None = None


def read_line(line: str, modal: Modal, letters: Sequence[str], position: FloatArray, *, is_jog: bool = False) -> Action:
    """Read one line, upper case and without blanks or comments.

    Args:
        line: The line; for a jog what follows ``$J=``.
        modal: The parser's memory.
        letters: Axis letters in order.
        position: Where the line starts from, machine positions, shape (A,), mm or deg.
        is_jog: Whether the jog rules hold: own feed, few words, memory untouched.

    Returns:
        The action.

    Raises:
        Refused: With the real controller's number.
    """
    codes, values = _words(line, letters)
    for code, group in codes.items():
        if is_jog and code not in _JOG_WORDS:
            raise Refused(16)
        modal = _with_code(modal, group, code)
    scale = MM_PER_INCH if modal.units == "G20" else 1.0
    if "F" in values:
        modal = replace(modal, feed_mm_min=values["F"] * scale)
    if "S" in values:
        modal = replace(modal, spindle_rpm=values["S"])
    if "T" in values:
        modal = replace(modal, tool=int(values["T"]))
    if is_jog and "F" not in values:
        raise Refused(22)
    dwell_s = _dwell(codes, values)
    moved = [letter for letter in letters if letter in values]
    if is_jog and not moved:
        raise Refused(26)
    if "M2" in codes or "M30" in codes:
        modal = Modal(tool=modal.tool, feed_mm_min=modal.feed_mm_min, spindle_rpm=modal.spindle_rpm)
    if not moved:
        return Action(modal, dwell_s=dwell_s)
    if dwell_s is not None:
        raise Refused(31)
    is_rapid = modal.motion == "G0" and not is_jog
    if not is_rapid and modal.feed_mm_min <= 0.0:
        raise Refused(22)
    target = np.array(position, dtype=np.float64)
    for i, letter in enumerate(letters):
        if letter in values:
            value = values[letter] * scale
            target[i] = target[i] + value if modal.distance == "G91" and "G53" not in codes else value
    return Action(modal, target, None if is_rapid else modal.feed_mm_min)


def _words(line: str, letters: Sequence[str]) -> tuple[dict[str, str], dict[str, float]]:
    codes: dict[str, str] = {}
    values: dict[str, float] = {}
    at = 0
    while at < len(line):
        match = _WORD.match(line, at)
        if match is None:
            raise Refused(1)
        letter, number = match.group(1), match.group(2)
        if number is None:
            raise Refused(2)
        at = match.end()
        value = float(number)
        if letter in "GM":
            _add_code(f"{letter}{value:g}", codes)
        elif letter not in _NEVER_NEGATIVE and letter not in letters:
            raise Refused(36 if letter in "IJKLR" else 20)
        elif letter in values:
            raise Refused(25)
        elif letter in _NEVER_NEGATIVE and value < 0.0:
            raise Refused(4)
        else:
            values[letter] = value
    return codes, values


def _add_code(code: str, codes: dict[str, str]) -> None:
    group = _GROUPS.get(code)
    if group is None:
        raise Refused(20)
    if group in codes.values():
        raise Refused(21)
    codes[code] = group


def _with_code(modal: Modal, group: str, code: str) -> Modal:
    match group:
        case "motion":
            return replace(modal, motion=code)
        case "units":
            return replace(modal, units=code)
        case "distance":
            return replace(modal, distance=code)
        case "spindle":
            return replace(modal, spindle=code)
        case "coolant":
            return replace(modal, coolant=code)
    return modal


def _dwell(codes: dict[str, str], values: dict[str, float]) -> float | None:
    if "G4" not in codes:
        if "P" in values:
            raise Refused(36)
        return None
    if "P" not in values:
        raise Refused(28)
    return values["P"]


class LineReader:
    """Assembles lines as the firmware does: blanks and comments do not count, CR and LF each end one."""

    def __init__(self) -> None:
        self._text = ""
        self._comment = ""
        self._is_overlong = False

    def push(self, byte: int) -> str | None:
        """Take one character.

        Args:
            byte: Its code.

        Returns:
            The line in upper case when it ended, ``OVERLONG`` for one that did not fit, otherwise None.
        """
        character = chr(byte)
        if character in "\r\n":
            line = OVERLONG if self._is_overlong else self._text
            self._text, self._comment, self._is_overlong = "", "", False
            return line
        if self._comment:
            if self._comment == "(" and character == ")":
                self._comment = ""
        elif character in "(;":
            self._comment = character
        elif character > " " and character != "/":
            self._is_overlong = self._is_overlong or len(self._text) >= LINE_CHARACTERS
            if not self._is_overlong:
                self._text += character.upper()
        return None
