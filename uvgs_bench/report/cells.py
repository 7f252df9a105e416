"""What stands in one cell of a report: words, a number, an interval, a verdict; raw and as shown."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

ABSENT = "–"
State = Literal["pass", "fail", "inconclusive", "none"]
Data = dict[str, object]


def shown_number(value: float | None, decimals: int) -> str:
    """A number as people read it.

    Args:
        value: The number; None and NaN mean that there is none.
        decimals: Digits after the point.

    Returns:
        Fixed-point text; a dash for an absent number, an infinity sign for an unbounded one.
    """
    if value is None or math.isnan(value):
        return ABSENT
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    text = f"{value:.{decimals}f}"
    # A rounded "-0.000" claims a sign the digits do not carry.
    return text[1:] if text.startswith("-") and not text.strip("-0.") else text


def decimals_for(half_widths: Iterable[float | None], *, default: int = 3, most: int = 6) -> int:
    """Digits after the point that give the typical uncertainty two significant digits.

    Args:
        half_widths: Half widths of the intervals (or the numbers themselves), in the unit shown.
        default: What to use when none is finite and positive.
        most: Upper bound.

    Returns:
        Digits after the point, 0 to ``most``.
    """
    usable = sorted(w for w in half_widths if w is not None and math.isfinite(w) and w > 0.0)
    if not usable:
        return default
    return max(0, min(most, 1 - math.floor(math.log10(usable[len(usable) // 2]))))


def strict(value: float | None) -> float | None:
    """A value strict JSON can carry: what is not finite becomes None."""
    return None if value is None or not math.isfinite(value) else float(value)


@dataclass(frozen=True, slots=True)
class Number:
    """A number with its unit.

    Args:
        value: The raw number, or None when there is none.
        decimals: Digits shown after the point.
        unit: Unit as printed, empty for none.
    """

    value: float | None
    decimals: int
    unit: str = ""

    @property
    def shown(self) -> str:
        """The digits, without unit."""
        return shown_number(self.value, self.decimals)

    def data(self) -> Data:
        """Plain values for rendering and export."""
        return {"kind": "number", "value": strict(self.value), "shown": self.shown, "unit": self.unit}


@dataclass(frozen=True, slots=True)
class Interval:
    """An interval with its unit.

    Args:
        low: Lower end; None when unknown, -inf when unbounded.
        high: Upper end; None when unknown, inf when unbounded.
        decimals: Digits shown after the point.
        unit: Unit as printed.
    """

    low: float | None
    high: float | None
    decimals: int
    unit: str = ""

    @property
    def shown(self) -> str:
        """Both ends, without unit; a dash when neither is known."""
        low, high = shown_number(self.low, self.decimals), shown_number(self.high, self.decimals)
        return ABSENT if low == high == ABSENT else f"{low} … {high}"

    def data(self) -> Data:
        """Plain values for rendering and export."""
        ends = {"low": strict(self.low), "high": strict(self.high)}
        return {"kind": "interval", **ends, "shown": self.shown, "unit": self.unit}


@dataclass(frozen=True, slots=True)
class Measured:
    """A number with its interval in one cell; both in the same unit."""

    number: Number
    interval: Interval

    @property
    def shown(self) -> str:
        """The number, then its interval in brackets."""
        return f"{self.number.shown} [{self.interval.shown}]"

    def data(self) -> Data:
        """Plain values for rendering and export."""
        return {"kind": "measured", "number": self.number.data(), "interval": self.interval.data(), "shown": self.shown}


@dataclass(frozen=True, slots=True)
class Mark:
    """A verdict in one word; colour only repeats what the word says."""

    state: State
    word: str = ""

    @property
    def shown(self) -> str:
        """The word."""
        return self.word or {"none": "not judged"}.get(self.state, self.state)

    def data(self) -> Data:
        """Plain values for rendering and export."""
        return {"kind": "mark", "state": self.state, "shown": self.shown}


Cell = str | Number | Interval | Measured | Mark


def cell_data(cell: Cell) -> Data:
    """Plain values of a table cell."""
    return {"kind": "text", "shown": cell} if isinstance(cell, str) else cell.data()
