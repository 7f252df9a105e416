"""Limits, and how a figure with its interval is held against them.

A limit is met when the whole interval is inside it and missed when the whole interval is outside; else the data do not
tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from uvgs_bench.accuracy.clusters import Estimate
from uvgs_bench.accuracy.quantities import Quantity
from uvgs_bench.accuracy.quantity_catalogue import LIMITABLE
from uvgs_bench.accuracy.statistics import AccuracySummary, Availability
from uvgs_bench.units import deg_from_rad, mm_from_m, ms_from_s

Verdict = Literal["pass", "fail", "inconclusive"]
Bound = Literal["max", "min"]
LimitUnit = Literal["mm", "deg", "percent", "ms"]

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
    **{name: ("quantity", key, unit) for name, (key, unit) in LIMITABLE.items()},
}
"""Quantity a limit may name -> component, statistic, unit; of component ``quantity`` the statistic is its key."""
_FACTORS: dict[LimitUnit, float] = {
    "mm": mm_from_m(1.0),
    "deg": deg_from_rad(1.0),
    "percent": 100.0,
    "ms": ms_from_s(1.0),
}


@dataclass(frozen=True, slots=True)
class Limit:
    """What a procedure asks for.

    Args:
        quantity: One of ``QUANTITIES``.
        bound: Whether the value is the largest (``max``) or smallest (``min``) allowed.
        value: The limit, in its unit.
        unit: ``mm``, ``deg``, ``percent`` or ``ms``, as the quantity's name says.

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


def limit_verdict(
    limit: Limit, summary: AccuracySummary | None, found: Availability, named: Sequence[Quantity]
) -> LimitVerdict:
    """Hold one limit against its figure.

    Args:
        limit: The limit.
        summary: Figures of the captures that judge, or None when there are none.
        found: Availability over the whole run.
        named: Named figures of the captures that judge.

    Returns:
        The verdict with its reason.
    """
    component, statistic, unit = QUANTITIES[limit.quantity]
    raw = Estimate(float("nan"), 0.0, float("inf"), 0, 0, "no errors to judge")
    if component == "availability":
        raw = found.fraction
    elif component == "quantity":
        raw = next((_magnitude(q.estimate) for q in named if q.key == statistic and not q.group), raw)
    elif summary is not None:
        raw = getattr(summary.components[component], statistic)
    estimate = raw.scaled(_FACTORS[unit])
    verdict, reason = _compared(limit, estimate)
    return LimitVerdict(limit, estimate.value, estimate.low, estimate.high, estimate.station_count, verdict, reason)


def _magnitude(found: Estimate) -> Estimate:
    """The absolute value of a signed figure: a limit bounds it on both sides."""
    low = 0.0 if found.low <= 0.0 <= found.high else min(abs(found.low), abs(found.high))
    return replace(found, value=abs(found.value), low=low, high=max(abs(found.low), abs(found.high)))


def _compared(limit: Limit, found: Estimate) -> tuple[Verdict, str]:
    if not np.isfinite(found.value):
        return "inconclusive", found.note or "no figure"
    interval = f"95 % interval {found.low:.4g} to {found.high:.4g} {limit.unit}"
    if limit.bound == "max":
        inside, outside = found.high <= limit.value, found.low > limit.value
    else:
        inside, outside = found.low >= limit.value, found.high < limit.value
    if inside:
        return "pass", f"{interval} is within the limit"
    if outside:
        if np.isinf(found.high):
            return "fail", f"at least {found.low:.4g} {limit.unit} is beyond the limit"
        return "fail", f"{interval} is beyond the limit"
    if found.note:
        return "inconclusive", found.note
    return "inconclusive", f"{interval} straddles the limit: more stations would narrow it"
