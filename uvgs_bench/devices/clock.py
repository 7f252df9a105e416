"""The bench clock: what time it is and how to wait, real, simulated, or stepped from one wait to the next."""

from __future__ import annotations

import time
from typing import Protocol

from uvgs_bench.units import ns_from_s, s_from_ns


class Clock(Protocol):
    """Monotonic bench time."""

    def now_ns(self) -> int:
        """Monotonic bench time, ns."""
        ...

    def sleep(self, duration_s: float) -> None:
        """Wait for a duration of bench time, s."""
        ...


class RealClock:
    """The machine's monotonic clock."""

    def now_ns(self) -> int:
        """Monotonic time, ns."""
        return time.monotonic_ns()

    def sleep(self, duration_s: float) -> None:
        """Wait, s."""
        if duration_s > 0.0:
            time.sleep(duration_s)


class ScaledClock:
    """Bench time that runs ``speed`` times faster than real time.

    Args:
        speed: Factor, > 0.
    """

    def __init__(self, speed: float = 1.0) -> None:
        if not speed > 0.0:
            raise ValueError(f"speed must be positive, got {speed}")
        self.speed = speed
        self._start_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        """Bench time since construction, ns."""
        return ns_from_s(s_from_ns(time.monotonic_ns() - self._start_ns) * self.speed)

    def sleep(self, duration_s: float) -> None:
        """Wait for a duration of bench time, s."""
        if duration_s > 0.0:
            time.sleep(duration_s / self.speed)


class SteppedClock:
    """Bench time that moves only by waiting, so that a session takes no time and is the same every time.

    For devices simulated in this thread: nothing happens beside it.

    Args:
        speed: How much bench time a wait of one real second stands for, where a port waits in real time; > 0.
    """

    # Every look at the clock takes some time, so that a loop which waits for an instant by looking comes to its end.
    _LOOK_NS = 1000

    def __init__(self, speed: float = 25.0) -> None:
        if not speed > 0.0:
            raise ValueError(f"speed must be positive, got {speed}")
        self.speed = speed
        self._t_ns = 0

    def now_ns(self) -> int:
        """Bench time since construction, ns."""
        self._t_ns += self._LOOK_NS
        return self._t_ns

    def sleep(self, duration_s: float) -> None:
        """Let a duration of bench time pass, s."""
        if duration_s > 0.0:
            self._t_ns += ns_from_s(duration_s)
