"""The motors of a mock controller, with the motions they made, so that the past can be asked too."""

from __future__ import annotations

from bisect import bisect_right

from uvgs_bench.devices.sim.grbl_motion import Motion, trapezoid
from uvgs_bench.geometry import FloatArray

_KEPT_MOTIONS = 4096


class Motors:
    """Motor positions over time, in mm or deg, in a coordinate in which nothing ever jumps.

    Args:
        start: Positions before the first motion, shape (A,).
    """

    def __init__(self, start: FloatArray) -> None:
        self.moving: Motion | None = None
        self._motions: list[Motion] = [trapezoid(start, start, 0.0, 1.0, 1.0)]
        # How many rests there were before each motion, the one it begins from not counted.
        self._rests: list[int] = [-1]
        self._dropped = 0

    def begin(self, motion: Motion) -> None:
        """Start a motion where the last one ended."""
        self.moving = motion
        self._rests.append(self._rests[-1] + (self._motions[-1].exit_speed == 0.0))
        self._motions.append(motion)
        if len(self._motions) > 2 * _KEPT_MOTIONS:
            del self._motions[:_KEPT_MOTIONS]
            del self._rests[:_KEPT_MOTIONS]
            self._dropped += _KEPT_MOTIONS

    def amend(self, motion: Motion) -> None:
        """Replace the motion under way, which was braked or planned anew."""
        self._motions[-1] = motion
        self.moving = motion

    def halt(self, at_s: float, end: FloatArray) -> None:
        """Stand still from an instant on, abruptly; nothing when at rest."""
        if self.moving is not None:
            self._motions[-1] = self.moving.cut(at_s, end)
            self.moving = None

    def finish(self) -> None:
        """Take the motion under way as over."""
        self.moving = None

    def position(self, t_s: float) -> FloatArray:
        """Positions at an instant, shape (A,)."""
        return self._motions[self._index(t_s)].position(t_s)

    def velocity(self, t_s: float) -> FloatArray:
        """Velocities at an instant, shape (A,), per s."""
        return self._motions[self._index(t_s)].velocity(t_s)

    def number(self, t_s: float) -> int:
        """Number of the motion that began last by an instant, from 0."""
        return self._dropped + self._index(t_s)

    def start(self, number: int) -> FloatArray:
        """Where a motion began, shape (A,); of one that is forgotten, where the oldest known one began."""
        return self._motions[max(0, number - self._dropped)].start

    def stops_count(self, t_s: float) -> int:
        """How many times the motors have come to rest by an instant."""
        index = self._index(t_s)
        motion = self._motions[index]
        return self._rests[index] + (t_s >= motion.end_s and motion.exit_speed == 0.0)

    def _index(self, t_s: float) -> int:
        return max(0, bisect_right(self._motions, t_s, key=lambda motion: motion.start_s) - 1)
