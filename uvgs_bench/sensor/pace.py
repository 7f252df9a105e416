"""Taking fewer captures than come: a sensor that is slower than its camera, or shall seem so."""

from __future__ import annotations

from uvgs_bench.units import ns_from_s

# A camera's captures come not quite evenly; one that is early by this share of the period is the one that is meant.
_EARLY = 0.1


class Pace:
    """Which captures are taken, so that there are no more than so many a second.

    Args:
        rate_hz: Captures per second; 0 takes all.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = ns_from_s(1.0 / rate_hz) if rate_hz > 0.0 else 0
        self._due_ns: int | None = None

    def takes(self, t_ns: int) -> bool:
        """Whether the capture of an instant, ns, is taken; to be asked for every capture in order of time."""
        if self._due_ns is None or t_ns < self._due_ns - 2 * self._period_ns:
            # The first, or the clock began anew.
            self._due_ns = t_ns + self._period_ns
            return True
        if t_ns < self._due_ns - _EARLY * self._period_ns:
            return False
        is_regular = t_ns < self._due_ns + self._period_ns
        self._due_ns = (self._due_ns if is_regular else t_ns) + self._period_ns
        return True
