"""The only home of conversion factors: SI inside the program, millimetres and degrees in files and on the terminal."""

from __future__ import annotations

from math import pi
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Number = TypeVar("Number", float, NDArray[np.float64])

MM_PER_M = 1000.0
RAD_PER_DEG = pi / 180.0
NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000
S_PER_MIN = 60.0
S_PER_DAY = 86400.0
MM_PER_INCH = 25.4


def m_from_mm(value_mm: Number) -> Number:
    """Metres from millimetres."""
    return value_mm / MM_PER_M


def mm_from_m(value_m: Number) -> Number:
    """Millimetres from metres."""
    return value_m * MM_PER_M


def m2_from_mm2(value_mm2: Number) -> Number:
    """Square metres from square millimetres."""
    return value_mm2 / (MM_PER_M * MM_PER_M)


def mm2_from_m2(value_m2: Number) -> Number:
    """Square millimetres from square metres."""
    return value_m2 * (MM_PER_M * MM_PER_M)


def rad_from_deg(value_deg: Number) -> Number:
    """Radians from degrees."""
    return value_deg * RAD_PER_DEG


def deg_from_rad(value_rad: Number) -> Number:
    """Degrees from radians."""
    return value_rad / RAD_PER_DEG


def mrad_from_rad(value_rad: Number) -> Number:
    """Milliradians from radians."""
    return value_rad * MM_PER_M


def rad_from_mrad(value_mrad: Number) -> Number:
    """Radians from milliradians."""
    return value_mrad / MM_PER_M


def mps_from_mm_min(value_mm_min: Number) -> Number:
    """Metres per second from millimetres per minute (G-code feed)."""
    return value_mm_min / (MM_PER_M * S_PER_MIN)


def s_from_ns(value_ns: int) -> float:
    """Seconds from nanoseconds."""
    return value_ns / NS_PER_S


def ns_from_s(value_s: float) -> int:
    """Nanoseconds from seconds, rounded to the nearest."""
    return round(value_s * NS_PER_S)


def ms_from_s(value_s: Number) -> Number:
    """Milliseconds from seconds."""
    return value_s * MM_PER_M


def s_from_ms(value_ms: Number) -> Number:
    """Seconds from milliseconds."""
    return value_ms / MM_PER_M


def us_from_s(value_s: float) -> float:
    """Microseconds from seconds."""
    return value_s * MM_PER_M * MM_PER_M


def radps_from_deg_min(value_deg_min: Number) -> Number:
    """Radians per second from degrees per minute (feed of a rotary axis)."""
    return value_deg_min * (RAD_PER_DEG / S_PER_MIN)


def percent_from_fraction(value: Number) -> Number:
    """Percent from a fraction of one."""
    return value * 100.0


def fraction_from_percent(value_percent: Number) -> Number:
    """A fraction of one from percent."""
    return value_percent / 100.0
