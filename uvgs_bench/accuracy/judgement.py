"""The verdict: every limit against its figure and interval, and what the reader must be told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from uvgs_bench.accuracy.pose_error import ErrorTable
from uvgs_bench.accuracy.registration import Registration
from uvgs_bench.accuracy.statistics import AccuracySummary, Availability

Verdict = Literal["pass", "fail", "inconclusive"]
Bound = Literal["max", "min"]
LimitUnit = Literal["mm", "deg", "percent"]

QUANTITIES: dict[str, tuple[str, str, LimitUnit]] = {
    "position_rms_mm": ("position", "rms", "mm"),
    "position_p95_mm": ("position", "p95", "mm"),
    "position_max_mm": ("position", "max", "mm"),
    "lateral_rms_mm": ("lateral", "rms", "mm"),
    "depth_rms_mm": ("depth", "rms", "mm"),
    "position_bias_mm": ("position", "bias", "mm"),
    "attitude_rms_deg": ("attitude", "rms", "deg"),
    "attitude_p95_deg": ("attitude", "p95", "deg"),
    "attitude_max_deg": ("attitude", "max", "deg"),
    "availability_percent": ("availability", "fraction", "percent"),
}
"""Quantity a limit may name -> component, statistic, unit."""


@dataclass(frozen=True, slots=True)
class Limit:
    """What a procedure asks for.

    Args:
        quantity: One of ``QUANTITIES``.
        bound: Whether the value is the largest (``max``) or smallest (``min``) allowed.
        value: The limit, in its unit.
        unit: ``mm``, ``deg`` or ``percent``, as the quantity's name says.

    Raises:
        ValueError: Unknown quantity, or a unit that is not the quantity's.
    """

    quantity: str
    bound: Bound
    value: float
    unit: LimitUnit

    def __post_init__(self) -> None:
        if self.quantity not in QUANTITIES:
            raise ValueError(f"unknown quantity '{self.quantity}', expected one of {', '.join(QUANTITIES)}")
        if self.unit != QUANTITIES[self.quantity][2]:
            raise ValueError(f"{self.quantity} is in {QUANTITIES[self.quantity][2]}, not in {self.unit}")

    @classmethod
    def of(cls, quantity: str, value: float) -> Limit:
        """The limit a procedure file means by ``quantity = value``: availability is a minimum, the rest are maxima.

        Args:
            quantity: One of ``QUANTITIES``.
            value: The limit in the unit of the quantity's name.

        Returns:
            The limit.

        Raises:
            ValueError: Unknown quantity.
        """
        unit = QUANTITIES[quantity][2] if quantity in QUANTITIES else "mm"
        return cls(quantity, "min" if quantity == "availability_percent" else "max", value, unit)


@dataclass(frozen=True, slots=True)
class LimitVerdict:
    """One limit, judged.

    Args:
        limit: The limit.
        value: The figure found, in the limit's unit; NaN when there is none.
        low: Lower end of its 95 % interval, in the limit's unit.
        high: Upper end; inf when the data cannot bound it.
        n: Number of stations behind it.
        verdict: ``pass`` when the whole interval is inside the limit, ``fail`` when it is outside, else
            ``inconclusive``.
        reason: One line for people.
    """

    limit: Limit
    value: float
    low: float
    high: float
    n: int
    verdict: Verdict
    reason: str


@dataclass(frozen=True, slots=True)
class Alert:
    """Something the reader must know.

    Args:
        level: ``note``, ``warning`` or ``error``.
        text: One line.
    """

    level: Literal["note", "warning", "error"]
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """Everything a report says about accuracy.

    Args:
        registration: The registration, or None when there can be none (``alerts`` say why).
        in_sample_table: Errors of the captures the registration was fitted on (optimistic), or None.
        table: Errors of the captures that judge, or None.
        in_sample_summary: Figures of ``in_sample_table``, or None; never judged against limits.
        summary: Figures of ``table``, or None.
        availability: Over all captures of the run.
        verdicts: One per limit, in the order given.
        verdict: ``fail`` if any limit fails, else ``inconclusive`` if any is or there are none, else ``pass``.
        alerts: What the reader must know, worst first.
        split: How the captures were parted into fitting and judging, one line.
    """

    registration: Registration | None
    in_sample_table: ErrorTable | None
    table: ErrorTable | None
    in_sample_summary: AccuracySummary | None
    summary: AccuracySummary | None
    availability: Availability
    verdicts: tuple[LimitVerdict, ...]
    verdict: Verdict
    alerts: tuple[Alert, ...]
    split: str
