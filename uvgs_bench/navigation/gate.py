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


@dataclass(frozen=True, slots=True, eq=False)
class _Refused:
    t_ns: int
    residual: FloatArray
    noise: FloatArray
    count: int


class InnovationGate:
    """A chi-square gate per source. Refused measurements that agree with one another open it again.

    A filter that is wrong refuses everything that is right. When several refused measurements in a row say the same,
    it is the filter that is wrong; single wild ones never agree.

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
        self._last: dict[str, _Refused] = {}

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
            self._last.pop(source, None)
            return "fused"
        before, count = self._last.get(source), 1
        if before is not None:
            apart_s = abs(s_from_ns(t_ns - before.t_ns))
            if apart_s <= self._memory_s:
                change = residual - before.residual
                allowed = noise + before.noise
                allowed[:3, :3] += P[12:, 12:] * apart_s**2
                allowed[3:, 3:] += P[3:6, 3:6] * apart_s**2
                if float(change @ np.linalg.solve(allowed, change)) <= self.limit:
                    count = before.count + 1
        if count > self.reopen_after:
            self._last.pop(source, None)
            return "reopened"
        self._last[source] = _Refused(t_ns, residual, noise, count)
        return "refused"
