"""The controller's clock against bench time, from questions whose way there and back is timed.

Source: the method of network clocks (D. L. Mills, RFC 5905): an answer's stamp lies between question and answer, its
best guess is the middle; a straight line through many gives offset and rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uvgs_bench.devices.clock import Clock
from uvgs_bench.devices.gantry import grbl_protocol as protocol
from uvgs_bench.devices.gantry.grbl_link import GrblLink
from uvgs_bench.errors import GantryError, GantryTimeout
from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import NS_PER_S, ns_from_s

_REPLY_S = 1.0
_BYTE_S = 10 / 115200
_FEWEST = 5
_US_PER_S = 1e6
# Exchanges that took this much longer than the quickest, in spreads of the quicker half, were held up on one way.
_HELD_UP = 4.0


@dataclass(frozen=True, slots=True)
class Exchange:
    """One question to the controller's clock.

    Args:
        asked_ns: Bench time when the question was sent, ns.
        heard_ns: Bench time when the first byte of the answer came, ns.
        controller_us: The controller's time when it got the question, us since its start.
    """

    asked_ns: int
    heard_ns: int
    controller_us: float


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


def ask_clock(link: GrblLink, clock: Clock) -> Exchange:
    """Ask a controller with a clock of its own what time it is.

    The answer's first byte counts, not its last: its length on the wire is no part of the way.

    Args:
        link: The conversation.
        clock: Bench time.

    Returns:
        The exchange.

    Raises:
        GantryTimeout: No whole answer came.
        GantryAlarm: An alarm came.
        GantryLost: The port vanished or the controller restarted.
    """
    asked_ns = clock.now_ns()
    link.wire.send_byte(protocol.POSITION)
    for item in link.received_until(asked_ns + ns_from_s(_REPLY_S)):
        if isinstance(item, protocol.Message) and item.name == "POS":
            heard_ns = clock.now_ns() - ns_from_s(_BYTE_S * (len(protocol.shown(item)) + 1))
            controller_us = protocol.read_stamp(item)
            if controller_us is not None:
                return Exchange(asked_ns, max(asked_ns, heard_ns), controller_us)
    raise GantryTimeout("the controller's clock did not answer", link.port)
