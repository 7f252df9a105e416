"""A time-parameterised path through places: trapezoidal legs, corners cut by a stated radius, waits, exact limits.

A trajectory is a list of pieces of constant acceleration, so that positions, velocities and accelerations are exact at
every instant. A corner is cut by a parabola that leaves one leg and joins the next at the blend radius from the corner;
its velocity lies between those of the two legs, so that a speed limit held on both is held in the corner.

Source: R. P. Paul, Robot Manipulators, chapter 5 (linear segments with parabolic blends).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uvgs_bench.geometry import FloatArray, read_only

# A leg shorter than this (m or rad) is none.
_NO_LENGTH = 1e-12
# Share by which two unit directions must agree to count as one line.
_STRAIGHT = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class PathPoint:
    """A place of a path.

    Args:
        position: Coordinates, shape (n,), m or rad.
        dwell_s: Wait there at rest, s; a corner with a wait is not cut.
        blend: Distance from the place, m (rad where only angles move), at which the path leaves its leg; 0 = go there
            and stop. It is shortened to half of the shorter leg; a place where the path turns by more than 90 deg, or
            changes from moving to turning, is always gone to. The path passes within 0.36 ``blend`` of the place.

    Raises:
        ValueError: A value that is not finite, or negative.
    """

    position: FloatArray
    dwell_s: float = 0.0
    blend: float = 0.0

    def __post_init__(self) -> None:
        position = read_only(self.position, (-1,))
        if not np.isfinite(position).all():
            raise ValueError("the coordinates of a place must be finite")
        if not 0.0 <= self.dwell_s < np.inf:
            raise ValueError(f"dwell_s must not be negative, got {self.dwell_s}")
        if not 0.0 <= self.blend < np.inf:
            raise ValueError(f"blend must not be negative, got {self.blend}")
        object.__setattr__(self, "position", position)


@dataclass(frozen=True, slots=True, eq=False)
class MotionLimits:
    """What no instant of a trajectory exceeds.

    Args:
        speed: Largest speed along the path, m/s.
        turning_speed: Largest speed where only angles move, rad/s.
        axis_speed: Largest speed of each coordinate, shape (n,), m/s or rad/s.
        axis_acceleration: Largest acceleration of each coordinate, shape (n,), m/s^2 or rad/s^2.
        is_rotary: Which coordinates are angles, shape (n,).

    Raises:
        ValueError: A limit that is not positive, or shapes that differ.
    """

    speed: float
    turning_speed: float
    axis_speed: FloatArray
    axis_acceleration: FloatArray
    is_rotary: NDArray[np.bool_]

    def __post_init__(self) -> None:
        is_rotary = np.array(self.is_rotary, dtype=bool)
        is_rotary.flags.writeable = False
        object.__setattr__(self, "is_rotary", is_rotary)
        for name in ("axis_speed", "axis_acceleration"):
            values = read_only(getattr(self, name), is_rotary.shape)
            if not (values > 0.0).all():
                raise ValueError(f"{name} must be positive")
            object.__setattr__(self, name, values)
        if not (self.speed > 0.0 and self.turning_speed > 0.0):
            raise ValueError("speed and turning_speed must be positive")

    @classmethod
    def rigid(
        cls,
        speed_mps: float,
        acceleration_mps2: float,
        turning_speed_radps: float = 0.2,
        turning_acceleration_radps2: float = 0.2,
    ) -> MotionLimits:
        """Limits of the six coordinates of ``rigid.rigid_state``: x, y, z, yaw, pitch, roll.

        Args:
            speed_mps: Largest speed along the path, m/s.
            acceleration_mps2: Largest acceleration of each of x, y, z, m/s^2.
            turning_speed_radps: Largest rate of each angle, rad/s.
            turning_acceleration_radps2: Largest acceleration of each angle, rad/s^2.

        Returns:
            The limits.
        """
        ones = np.ones(3)
        return cls(
            speed_mps,
            turning_speed_radps,
            np.concatenate((speed_mps * ones, turning_speed_radps * ones)),
            np.concatenate((acceleration_mps2 * ones, turning_acceleration_radps2 * ones)),
            np.arange(6) >= 3,
        )


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryState:
    """A trajectory at one instant.

    Args:
        position: Coordinates, shape (n,), m or rad.
        velocity: Their rates, shape (n,), m/s or rad/s.
        acceleration: Their second rates, shape (n,), m/s^2 or rad/s^2.
        place: Number of the place that was reached or passed last, from 0.
    """

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    place: int

    @property
    def is_moving(self) -> bool:
        """Whether any coordinate changes."""
        return bool(self.velocity.any() or self.acceleration.any())


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """A path in time, as pieces of constant acceleration. It rests at its first place before 0 s and at its last after.

    Args:
        begin_s: When each piece begins, shape (m,), s, ascending from 0.
        duration_s: When the last piece ends, s.
        position: Coordinates at the beginning of each piece, shape (m, n), m or rad.
        velocity: Rates there, shape (m, n).
        acceleration: Second rates of each piece, shape (m, n).
        place: Number of the place reached or passed last, shape (m,).
        last: Where it ends, shape (n,).
        last_place: Number of its last place.
    """

    begin_s: FloatArray
    duration_s: float
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    place: NDArray[np.int64]
    last: FloatArray
    last_place: int

    def state_at(self, t_s: float) -> TrajectoryState:
        """Where it is, how fast, and how it accelerates.

        Args:
            t_s: Time since the start, s; any finite number.

        Returns:
            The state.
        """
        zero = np.zeros(self.last.shape)
        if t_s < 0.0 or t_s >= self.duration_s:
            is_over = t_s >= self.duration_s
            place = self.last_place if is_over else 0
            start = self.position[0] if len(self.position) else self.last
            return TrajectoryState(self.last if is_over else start, zero, zero, place)
        i = int(np.searchsorted(self.begin_s, t_s, side="right")) - 1
        dt = t_s - float(self.begin_s[i])
        p, v, a = self.position[i], self.velocity[i], self.acceleration[i]
        return TrajectoryState(p + (v + 0.5 * dt * a) * dt, v + dt * a, a, int(self.place[i]))

    def positions_at(self, t_s: ArrayLike) -> FloatArray:
        """Coordinates at many instants.

        Args:
            t_s: Times since the start, shape (k,), s.

        Returns:
            Coordinates, shape (k, n), m or rad.
        """
        t = np.clip(np.asarray(t_s, dtype=np.float64), 0.0, self.duration_s)
        if not len(self.begin_s):
            return np.tile(self.last, (len(t), 1))
        i = np.maximum(np.searchsorted(self.begin_s, t, side="right") - 1, 0)
        dt = (t - self.begin_s[i])[:, None]
        out: FloatArray = self.position[i] + (self.velocity[i] + 0.5 * dt * self.acceleration[i]) * dt
        out[t >= self.duration_s] = self.last
        return out


def plan_trajectory(points: Sequence[PathPoint], limits: MotionLimits) -> Trajectory:
    """The quickest trajectory of this kind through places, within limits; it begins and ends at rest.

    Args:
        points: At least one place; neighbours may coincide.
        limits: What no instant exceeds.

    Returns:
        The trajectory.

    Raises:
        ValueError: No place, or places whose number of coordinates is not that of the limits.
    """
    if not points:
        raise ValueError("a trajectory needs at least one place")
    n = len(limits.is_rotary)
    if any(len(point.position) != n for point in points):
        raise ValueError(f"every place needs {n} coordinates")
    legs = [_Leg.between(a.position, b.position, limits) for a, b in itertools.pairwise(points)]
    radius, speed = _corners(points, legs, limits)
    pieces = _Pieces(points[0].position)
    for i, point in enumerate(points):
        if i > 0 and legs[i - 1].length > 0.0:
            leg = legs[i - 1]
            run = max(leg.length - radius[i - 1] - radius[i], 0.0)
            pieces.run(leg, run, speed[i - 1], speed[i], i - 1)
        if radius[i] > 0.0:
            pieces.blend(legs[i - 1], legs[i], radius[i], speed[i], i - 1)
        elif speed[i] == 0.0:
            pieces.arrive(point.position)
        if point.dwell_s > 0.0:
            pieces.wait(point.dwell_s, i)
    return pieces.done(points[-1].position, len(points) - 1)


@dataclass(frozen=True, slots=True, eq=False)
class _Leg:
    """A straight line between places: coordinates per unit of path, its length, and what is allowed along it."""

    direction: FloatArray
    length: float
    is_turn: bool
    speed: float
    acceleration: float

    @classmethod
    def between(cls, start: FloatArray, end: FloatArray, limits: MotionLimits) -> _Leg:
        step = end - start
        linear = float(np.linalg.norm(step[~limits.is_rotary]))
        is_turn = linear <= _NO_LENGTH
        length = float(np.linalg.norm(step)) if is_turn else linear
        if length <= _NO_LENGTH:
            return cls(np.zeros(len(step)), 0.0, True, np.inf, np.inf)
        u = step / length
        size = np.maximum(np.abs(u), 1e-300)
        speed = min(limits.turning_speed if is_turn else limits.speed, float((limits.axis_speed / size).min()))
        return cls(u, length, is_turn, speed, float((limits.axis_acceleration / size).min()))


def _corners(
    points: Sequence[PathPoint], legs: Sequence[_Leg], limits: MotionLimits
) -> tuple[list[float], list[float]]:
    """Blend radius and speed at each place, such that every leg can go from the one speed to the other."""
    count = len(points)
    radius, speed = [0.0] * count, [0.0] * count
    for i in range(1, count - 1):
        before, after = legs[i - 1], legs[i]
        if points[i].dwell_s > 0.0 or 0.0 in (before.length, after.length) or before.is_turn != after.is_turn:
            continue
        change = np.abs(after.direction - before.direction)
        top = min(before.speed, after.speed)
        if float(change.max()) <= _STRAIGHT:
            speed[i] = top
            continue
        part = slice(None) if before.is_turn else ~limits.is_rotary
        is_back = float(before.direction[part] @ after.direction[part]) < -_STRAIGHT
        r = min(points[i].blend, 0.5 * before.length, 0.5 * after.length)
        if r <= _NO_LENGTH or is_back:
            continue
        # The parabola takes 2 r / c at the speed c, and changes the velocity by c times the change of direction.
        allowed = float((limits.axis_acceleration / np.maximum(change, 1e-300)).min())
        radius[i], speed[i] = r, min(top, float(np.sqrt(2.0 * r * allowed)))
    for order in (range(1, count), range(count - 2, -1, -1)):
        for i in order:
            j = i - 1 if order.step > 0 else i + 1
            leg = legs[min(i, j)]
            run = max(leg.length - radius[i] - radius[j], 0.0)
            reach = np.sqrt(speed[j] ** 2 + 2.0 * leg.acceleration * run) if run > 0.0 else speed[j]
            speed[i] = min(speed[i], float(reach))
    return [r if c > 0.0 else 0.0 for r, c in zip(radius, speed, strict=True)], speed


class _Pieces:
    """Pieces as they are laid one after another."""

    def __init__(self, start: FloatArray) -> None:
        self._here = np.array(start)
        self._now_s = 0.0
        self._rows: list[tuple[float, FloatArray, FloatArray, FloatArray, int]] = []

    def run(self, leg: _Leg, length: float, first: float, last: float, place: int) -> None:
        """A straight run that speeds up, keeps its speed, and slows down."""
        a = leg.acceleration
        peak = min(leg.speed, float(np.sqrt(a * length + 0.5 * (first * first + last * last))))
        peak = max(peak, first, last)
        up, down = (peak * peak - first * first) / (2.0 * a), (peak * peak - last * last) / (2.0 * a)
        level = max(length - up - down, 0.0)
        self._add((peak - first) / a, leg.direction * first, leg.direction * a, place)
        if level > 0.0:
            self._add(level / peak, leg.direction * peak, np.zeros_like(leg.direction), place)
        self._add((peak - last) / a, leg.direction * peak, -leg.direction * a, place)

    def blend(self, before: _Leg, after: _Leg, radius: float, speed: float, place: int) -> None:
        """A parabola from one leg to the next."""
        duration_s = 2.0 * radius / speed
        change = (after.direction - before.direction) * (speed / duration_s)
        self._add(0.5 * duration_s, before.direction * speed, change, place)
        self._add(0.5 * duration_s, 0.5 * (before.direction + after.direction) * speed, change, place + 1)

    def wait(self, duration_s: float, place: int) -> None:
        zero = np.zeros_like(self._here)
        self._add(duration_s, zero, zero, place)

    def arrive(self, position: FloatArray) -> None:
        """Take away what rounding has gathered."""
        self._here = np.array(position)

    def done(self, last: FloatArray, last_place: int) -> Trajectory:
        n = len(self._here)
        rows = self._rows
        return Trajectory(
            begin_s=read_only([row[0] for row in rows], (-1,)),
            duration_s=self._now_s,
            position=read_only(np.array([row[1] for row in rows]).reshape(-1, n)),
            velocity=read_only(np.array([row[2] for row in rows]).reshape(-1, n)),
            acceleration=read_only(np.array([row[3] for row in rows]).reshape(-1, n)),
            place=np.array([row[4] for row in rows], dtype=np.int64),
            last=read_only(last, (n,)),
            last_place=last_place,
        )

    def _add(self, duration_s: float, velocity: FloatArray, acceleration: FloatArray, place: int) -> None:
        if duration_s <= 0.0:
            return
        self._rows.append((self._now_s, self._here, velocity, acceleration, place))
        self._here = self._here + (velocity + 0.5 * duration_s * acceleration) * duration_s
        self._now_s += duration_s
