"""Straight motions with limited speed and acceleration, as a step generator makes them.

Lengths are in the controller's unit (mm, or deg for a rotary axis) and times in seconds; this file only does kinematics
and converts nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, sqrt

import numpy as np

from uvgs_bench.geometry import FloatArray, read_only

# Rounding of the roots below; slower than this, per s, is at rest.
_NO_SPEED = 1e-5


@dataclass(frozen=True, slots=True)
class Phase:
    """A part of a motion with constant acceleration.

    Args:
        start_s: When it begins, s.
        distance: Distance along the path at its begin.
        speed: Speed at its begin, per s.
        acceleration: Constant during the phase, per s^2.
    """

    start_s: float
    distance: float
    speed: float
    acceleration: float


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """One straight motion: at ``start`` until ``start_s``, at ``end`` from ``end_s``.

    Args:
        start_s: When it begins, s.
        end_s: When it is at rest, s.
        start: Axis positions at the begin, shape (A,).
        end: Axis positions at the end, shape (A,).
        unit: Unit vector of the path, shape (A,); zero when there is no path.
        acceleration: The limit along the path, per s^2.
        phases: The parts in order of time.
        exit_speed: Speed with which the next motion takes over at the end, per s; 0 at rest.
    """

    start_s: float
    end_s: float
    start: FloatArray
    end: FloatArray
    unit: FloatArray
    acceleration: float
    phases: tuple[Phase, ...]
    exit_speed: float = 0.0

    def along_path(self, t_s: float) -> tuple[float, float]:
        """Distance from the start and speed along the path at an instant.

        Args:
            t_s: The instant, s.

        Returns:
            (distance, speed per s); speed 0 before the begin and from the end on.
        """
        if t_s < self.start_s or not self.phases:
            return 0.0, 0.0
        if t_s >= self.end_s:
            return float(np.dot(self.end - self.start, self.unit)), 0.0
        phase = next(p for p in reversed(self.phases) if p.start_s <= t_s)
        dt = t_s - phase.start_s
        return (
            phase.distance + phase.speed * dt + 0.5 * phase.acceleration * dt * dt,
            phase.speed + phase.acceleration * dt,
        )

    def position(self, t_s: float) -> FloatArray:
        """Axis positions at an instant, shape (A,); exactly ``end`` from the end on."""
        if t_s >= self.end_s:
            return self.end
        return self.start + self.unit * self.along_path(t_s)[0]

    def velocity(self, t_s: float) -> FloatArray:
        """Axis velocities at an instant, shape (A,), per s."""
        return self.unit * self.along_path(t_s)[1]

    def braked(self, at_s: float) -> Motion:
        """The same motion, but decelerating from an instant on: to rest, or to the speed it has at its end by then.

        Args:
            at_s: When braking begins, s.

        Returns:
            The braked motion; unchanged when it is over by then.
        """
        if at_s >= self.end_s:
            return self
        at_s = max(at_s, self.start_s)
        distance, speed = self.along_path(at_s)
        kept = tuple(p for p in self.phases if p.start_s < at_s)
        stop = distance + 0.5 * speed * speed / self.acceleration
        phases = (*kept, Phase(at_s, distance, speed, -self.acceleration))
        length = float(np.dot(self.end - self.start, self.unit))
        if self.exit_speed > 0.0 and stop > length:
            left = sqrt(max(speed * speed - 2.0 * self.acceleration * (length - distance), 0.0))
            end_s = at_s + (speed - left) / self.acceleration
            return replace(self, end_s=end_s, phases=phases, exit_speed=left)
        return replace(
            self,
            end_s=at_s + speed / self.acceleration,
            end=read_only(self.start + self.unit * stop),
            phases=phases,
            exit_speed=0.0,
        )

    def going_on(self, at_s: float, speed_limit: float, exit_speed: float) -> Motion:
        """The same motion, planned anew from an instant on for another speed at its end.

        Args:
            at_s: The instant, s.
            speed_limit: Largest speed, per s.
            exit_speed: Wanted speed at the end, per s; what acceleration allows of it is taken.

        Returns:
            The new motion; unchanged when it is over by then.
        """
        if at_s >= self.end_s or not self.phases:
            return self
        at_s = max(at_s, self.start_s)
        distance, speed = self.along_path(at_s)
        kept = tuple(p for p in self.phases if p.start_s < at_s)
        length = float(np.dot(self.end - self.start, self.unit))
        phases, end_s, leaving = _ramps(
            at_s, distance, length, speed, exit_speed, max(speed_limit, speed), self.acceleration
        )
        return replace(self, end_s=end_s, phases=(*kept, *phases), exit_speed=leaving)

    def cut(self, at_s: float, end: FloatArray) -> Motion:
        """The same motion, standing still at ``end`` from an instant on, as when the step pulses cease."""
        return replace(self, end_s=min(self.end_s, max(at_s, self.start_s)), end=read_only(end), exit_speed=0.0)

    def ending_at(self, end: FloatArray) -> Motion:
        """The same motion with its end moved by less than a step, where the motor can rest."""
        return replace(self, end=read_only(end))


def path_limits(delta: FloatArray, speeds: FloatArray, accelerations: FloatArray) -> tuple[float, float]:
    """Largest speed and acceleration along a path so that no axis exceeds its own.

    Args:
        delta: The path, shape (A,).
        speeds: Largest speed per axis, shape (A,), per s.
        accelerations: Largest acceleration per axis, shape (A,), per s^2.

    Returns:
        (speed, acceleration) along the path; infinite for a path of length 0.
    """
    length = float(np.linalg.norm(delta))
    if length == 0.0:
        return inf, inf
    share = np.abs(delta) / length
    moving = share > 0.0
    return float(np.min(speeds[moving] / share[moving])), float(np.min(accelerations[moving] / share[moving]))


def trapezoid(start: FloatArray, end: FloatArray, start_s: float, speed: float, acceleration: float) -> Motion:
    """A motion from rest to rest: accelerate, cruise, decelerate; a triangle when the path is short.

    Args:
        start: Axis positions, shape (A,).
        end: Axis positions, shape (A,).
        start_s: When it begins, s.
        speed: Largest speed along the path, per s, > 0.
        acceleration: Acceleration along the path, per s^2, > 0.

    Returns:
        The motion.
    """
    delta = end - start
    length = float(np.linalg.norm(delta))
    if length == 0.0:
        return Motion(start_s, start_s, read_only(start), read_only(end), read_only(delta), inf, ())
    peak = min(speed, sqrt(length * acceleration))
    ramp_s, ramp = peak / acceleration, 0.5 * peak * peak / acceleration
    cruise_s = max(0.0, (length - 2.0 * ramp) / peak)
    brake_s = start_s + ramp_s + cruise_s
    phases = (
        Phase(start_s, 0.0, 0.0, acceleration),
        Phase(start_s + ramp_s, ramp, peak, 0.0),
        Phase(brake_s, length - ramp, peak, -acceleration),
    )
    return Motion(
        start_s, brake_s + ramp_s, read_only(start), read_only(end), read_only(delta / length), acceleration, phases
    )


def through(
    start: FloatArray,
    end: FloatArray,
    start_s: float,
    entry_speed: float,
    exit_speed: float,
    speed: float,
    acceleration: float,
) -> Motion:
    """A motion that begins and ends at given speeds: one of several that follow each other without a stop.

    Args:
        start: Axis positions, shape (A,).
        end: Axis positions, shape (A,).
        start_s: When it begins, s.
        entry_speed: Speed at the begin, per s.
        exit_speed: Wanted speed at the end, per s; what acceleration allows of it is taken.
        speed: Largest speed along the path, per s, > 0.
        acceleration: Acceleration along the path, per s^2, > 0.

    Returns:
        The motion.
    """
    delta = end - start
    length = float(np.linalg.norm(delta))
    if length == 0.0:
        return replace(trapezoid(start, end, start_s, speed, acceleration), exit_speed=exit_speed)
    top = max(speed, entry_speed)
    phases, end_s, leaving = _ramps(start_s, 0.0, length, entry_speed, exit_speed, top, acceleration)
    return Motion(
        start_s, end_s, read_only(start), read_only(end), read_only(delta / length), acceleration, phases, leaving
    )


def _ramps(
    start_s: float, distance: float, length: float, entry: float, leaving: float, top: float, acceleration: float
) -> tuple[tuple[Phase, ...], float, float]:
    """Speed up, cruise, slow down over what is left of a path: the parts, when it ends, and the speed there."""
    left = max(length - distance, 0.0)
    twice = 2.0 * acceleration
    leaving = min(leaving, sqrt(entry * entry + twice * left))
    # A speed that cannot be braked in time is kept as low as can be.
    leaving = max(leaving, sqrt(max(entry * entry - twice * left, 0.0)))
    leaving = 0.0 if leaving < _NO_SPEED else leaving
    peak = min(top, sqrt(max(acceleration * left + 0.5 * (entry * entry + leaving * leaving), 0.0)))
    peak = max(peak, entry, leaving)
    up, down = (peak * peak - entry * entry) / twice, (peak * peak - leaving * leaving) / twice
    cruise = max(left - up - down, 0.0)
    t1_s = start_s + (peak - entry) / acceleration
    t2_s = t1_s + (cruise / peak if peak > 0.0 else 0.0)
    phases = (
        Phase(start_s, distance, entry, acceleration),
        Phase(t1_s, distance + up, peak, 0.0),
        Phase(t2_s, distance + up + cruise, peak, -acceleration),
    )
    return phases, t2_s + (peak - leaving) / acceleration, leaving


def run_into(start: FloatArray, end: FloatArray, start_s: float, speed: float, acceleration: float) -> Motion:
    """A motion from rest that ends abruptly at full speed, as when a limit switch closes.

    Args:
        start: Axis positions, shape (A,).
        end: Axis positions, shape (A,).
        start_s: When it begins, s.
        speed: Speed along the path, per s, > 0.
        acceleration: Acceleration along the path, per s^2; infinite when it is already under way.

    Returns:
        The motion.
    """
    delta = end - start
    length = float(np.linalg.norm(delta))
    if length == 0.0:
        return trapezoid(start, end, start_s, speed, acceleration)
    peak = min(speed, sqrt(2.0 * length * acceleration))
    ramp_s, ramp = (0.0, 0.0) if acceleration == inf else (peak / acceleration, 0.5 * peak * peak / acceleration)
    cruise_s = max(0.0, (length - ramp) / peak)
    phases: tuple[Phase, ...] = (Phase(start_s + ramp_s, ramp, peak, 0.0),)
    if ramp_s > 0.0:
        phases = (Phase(start_s, 0.0, 0.0, acceleration), *phases)
    return Motion(
        start_s,
        start_s + ramp_s + cruise_s,
        read_only(start),
        read_only(end),
        read_only(delta / length),
        acceleration,
        phases,
    )
