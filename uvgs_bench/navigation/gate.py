"""Which measurements may be believed: far-off ones are refused, but never for good."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import s_from_ns

CHI2_99_6 = 16.8119
"""99 % of the chi-square law with 6 degrees of freedom; 13.2767 with 4, 11.3449 with 3."""

Decision = Literal["fused", "refused", "reopened"]


# How fast a drift of a wrong expectation may itself change: rad/s^2, m/s^2.
_BEND = np.repeat((0.5, 1.0), 3)


@dataclass(frozen=True, slots=True, eq=False)
class _Refused:
    t_ns: int
    residual: FloatArray
    noise: FloatArray


class InnovationGate:
    """A chi-square gate per source. Refused measurements that agree with one another open it again.

    A filter that is wrong refuses everything that is right. When several refused measurements in a row are off by the
    same, or by more and more at a steady rate, it is the filter that is wrong; wild ones never agree.

    Args:
        limit: Largest squared Mahalanobis distance that is believed; 6 degrees of freedom.
        reopen_after: After so many refusals in a row that agree, the next that agrees is believed, >= 1.
        memory_s: Refusals farther apart than this are not held against one another, s.

    Raises:
        ValueError: ``reopen_after`` is below 1, or the limit is not positive.
    """

    def __init__(self, limit: float = CHI2_99_6, reopen_after: int = 2, memory_s: float = 1.0) -> None:
        if reopen_after < 1 or not limit > 0.0:
            raise ValueError("a gate needs a positive limit and at least 1 refusal to reopen")
        self.limit = limit
        self.reopen_after = reopen_after
        self._memory_s = memory_s
        self._refused: dict[str, list[_Refused]] = {}
        self._agreeing: dict[str, int] = {}

    def judge(
        self, source: str, t_ns: int, distance: float, residual: FloatArray, noise: FloatArray, P: FloatArray
    ) -> Decision:
        """Decide on one measurement.

        Args:
            source: Who measured; each source has its own history.
            t_ns: Its instant, ns.
            distance: Squared Mahalanobis distance of the residual.
            residual: Measured minus expected, shape (6,), rotation first.
            noise: Covariance of the measurement, shape (6, 6).
            P: Covariance of the expected state, shape (15, 15): its velocity and gyroscope bias may carry the
                expectation off between two measurements.

        Returns:
            ``fused``: believe it; ``refused``: do not; ``reopened``: believe it, the expectation was wrong.
        """
        if distance <= self.limit:
            self._forget(source)
            return "fused"
        this = _Refused(t_ns, residual, noise)
        before = [old for old in self._refused.get(source, []) if abs(s_from_ns(t_ns - old.t_ns)) <= self._memory_s]
        agrees = bool(before) and (self._is_steady(before[-1], this, P) or self._is_drift(before, this))
        count = self._agreeing.get(source, 0) + 1 if agrees else 1
        if count > self.reopen_after:
            self._forget(source)
            return "reopened"
        self._refused[source] = [*before[-1:], this]
        self._agreeing[source] = count
        return "refused"

    def _forget(self, source: str) -> None:
        self._refused.pop(source, None)
        self._agreeing.pop(source, None)

    def _is_steady(self, before: _Refused, this: _Refused, P: FloatArray) -> bool:
        """Whether two refused measurements are off by the same."""
        apart_s = s_from_ns(this.t_ns - before.t_ns)
        allowed = this.noise + before.noise
        allowed[:3, :3] += P[12:, 12:] * apart_s**2
        allowed[3:, 3:] += P[3:6, 3:6] * apart_s**2
        return self._is_near(this.residual - before.residual, allowed)

    def _is_drift(self, before: list[_Refused], this: _Refused) -> bool:
        """Whether three refused measurements are off by more and more at a steady rate."""
        if len(before) < 2:
            return False
        first, second = before[-2:]
        apart_s, next_s = s_from_ns(second.t_ns - first.t_ns), s_from_ns(this.t_ns - second.t_ns)
        if apart_s <= 0.0 or next_s <= 0.0:
            return False
        share = next_s / apart_s
        expected = second.residual + share * (second.residual - first.residual)
        allowed = this.noise + (1.0 + share) ** 2 * second.noise + share**2 * first.noise
        allowed[np.diag_indices(6)] += (0.5 * _BEND * next_s * (apart_s + next_s)) ** 2
        return self._is_near(this.residual - expected, allowed)

    def _is_near(self, change: FloatArray, allowed: FloatArray) -> bool:
        return float(change @ np.linalg.solve(allowed, change)) <= self.limit
