"""The controller's clock against bench time, from questions whose way there and back is timed.

Source: the method of network clocks (D. L. Mills, RFC 5905): an answer's stamp lies between question and answer, its
best guess is the middle; a straight line through many gives offset and rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uvgs_bench.devices.gantry.gantry import StampedPosition
from uvgs_bench.devices.gantry.grbl_link import Exchange
from uvgs_bench.errors import GantryError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import NS_PER_S, ns_from_s

_SIGMAS = 3.0
# The largest error of rate that is thinkable: a ceramic resonator is off by half of it.
_RESONATOR = 0.01
_FEWEST = 5
_US_PER_S = 1e6
# Exchanges that took this much longer than the quickest, in spreads of the quicker half, were held up on one way.
_HELD_UP = 4.0


@dataclass(frozen=True, slots=True)
class ClockFit:
    """Bench time from the controller's.

    Args:
        reference_us: The controller's time in the middle of the exchanges, us.
        reference_ns: Bench time then, ns.
        rate: Bench seconds per controller second.
        offset_sigma_s: Doubt of ``reference_ns``, standard deviation, s; holds while both ways are alike on average.
        rate_sigma: Doubt of the rate, standard deviation.
        bound_s: Beyond this the offset cannot be off, whatever the ways are like, s: half of the quickest exchange.
        used_count: Exchanges that were used; the others were held up.
    """

    reference_us: float
    reference_ns: int
    rate: float
    offset_sigma_s: float
    rate_sigma: float
    bound_s: float
    used_count: int

    def bench_ns(self, controller_us: float) -> int:
        """Bench time of an instant of the controller, ns."""
        return self.reference_ns + ns_from_s((controller_us - self.reference_us) / _US_PER_S * self.rate)

    def sigma_s(self, controller_us: float) -> float:
        """Doubt of ``bench_ns`` at an instant of the controller, standard deviation, s."""
        away_s = (controller_us - self.reference_us) / _US_PER_S
        return float(np.hypot(self.offset_sigma_s, away_s * self.rate_sigma))


def fit_clock(exchanges: Sequence[Exchange]) -> ClockFit:
    """Fit offset and rate of the controller's clock.

    Args:
        exchanges: Questions and answers over some seconds or more.

    Returns:
        The fit.

    Raises:
        GantryError: Fewer than five exchanges, or all at one instant.
    """
    if len(exchanges) < _FEWEST:
        raise GantryError(f"a clock needs {_FEWEST} exchanges or more, got {len(exchanges)}")
    asked = np.array([e.asked_ns for e in exchanges], dtype=np.int64)
    trip_s: FloatArray = (np.array([e.heard_ns for e in exchanges], dtype=np.int64) - asked) / NS_PER_S
    quicker = np.sort(trip_s)[: max(_FEWEST, len(trip_s) // 2)]
    kept = trip_s <= quicker[0] + _HELD_UP * max(float(np.ptp(quicker)), 1e-6)
    controller_us = np.array([e.controller_us for e in exchanges])[kept]
    # From the first question on, so that no digit of the nanoseconds is lost.
    since_s = (asked[kept] - asked[0]) / NS_PER_S + 0.5 * trip_s[kept]
    middle_us = float(controller_us.mean())
    x = (controller_us - middle_us) / _US_PER_S
    square, n = float(x @ x), int(kept.sum())
    if n < _FEWEST or square == 0.0:
        raise GantryError("the exchanges with the controller's clock are all at one instant, or all were held up")
    rate = float(x @ since_s) / square
    residual = since_s - since_s.mean() - rate * x
    sigma = float(np.sqrt(residual @ residual / (n - 2)))
    return ClockFit(
        reference_us=middle_us,
        reference_ns=int(asked[0]) + ns_from_s(float(since_s.mean())),
        rate=rate,
        offset_sigma_s=sigma / float(np.sqrt(n)),
        rate_sigma=sigma / float(np.sqrt(square)),
        bound_s=0.5 * float(trip_s[kept].min()),
        used_count=n,
    )


class PositionRecord:
    """Positions as they are reported; at the end with the controller's own times, which know no delay of the line."""

    def __init__(self) -> None:
        self.positions: list[StampedPosition] = []
        self._exchanges: list[Exchange | None] = []

    def add(self, asked_ns: int, heard_ns: int, position: FloatArray, exchange: Exchange | None) -> None:
        """Keep one.

        Args:
            asked_ns: Bench time of the question, ns.
            heard_ns: Bench time of the answer, ns.
            position: Machine axis positions, shape (A,), m or rad.
            exchange: What the controller's clock said, or None.
        """
        self.positions.append(StampedPosition.between(asked_ns, heard_ns, position))
        self._exchanges.append(exchange)

    def finish(self) -> None:
        """Take the controller's times where it told them; no doubt grows by that.

        Every answer bounds every instant: it was written after its question and before it was heard, and the
        controller's clock says how far the instants are apart, within three deviations of its fitted rate.

        Source: the bounds of a remote clock by K. Marzullo, 1984, without its vote: no answer lies.
        """
        said = [exchange for exchange in self._exchanges if exchange is not None]
        if len(said) < len(self._exchanges) or not said:
            return
        lowest, highest = 1.0 - _RESONATOR, 1.0 + _RESONATOR
        try:
            fit = fit_clock(said)
        except GantryError:
            pass
        else:
            lowest = max(lowest, fit.rate - _SIGMAS * fit.rate_sigma)
            highest = min(highest, fit.rate + _SIGMAS * fit.rate_sigma)
        told_ns = np.array([e.controller_us for e in said]) * (NS_PER_S / _US_PER_S)
        origin_ns = said[0].asked_ns
        asked = np.array([float(e.asked_ns - origin_ns) for e in said])
        heard = np.array([float(e.heard_ns - origin_ns) for e in said])
        apart = told_ns[:, None] - told_ns
        slow, fast = lowest * apart, highest * apart
        early = (asked + np.minimum(slow, fast)).max(axis=1)
        late = (heard + np.maximum(slow, fast)).min(axis=1)
        for i, stamped in enumerate(self.positions):
            doubt_ns = int(np.ceil(0.5 * (late[i] - early[i])))
            if 0 <= doubt_ns < stamped.doubt_ns:
                t_ns = origin_ns + round(0.5 * float(early[i] + late[i]))
                self.positions[i] = replace(stamped, t_ns=t_ns, doubt_ns=doubt_ns)
