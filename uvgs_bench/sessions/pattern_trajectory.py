"""The pattern ``trajectory``: places at rest that register the bench, and a motion through a path that is judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from math import inf

import numpy as np

from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.navigation.trajectory import MotionLimits, PathPoint, Trajectory, plan_trajectory
from uvgs_bench.sessions.patterns import AxisValues, axis_vector
from uvgs_bench.units import m_from_mm, rad_from_deg

# A controller that is told pieces keeps up only while it has some speed and acceleration to spare.
_SPEED_SHARE, _ACCELERATION_SHARE = 0.9, 0.5
# How far ahead pieces are told, s: what is told can be braked within it.
LOOK_AHEAD_S = 0.3
_MOST_LAPS, _MOST_HZ = 1000, 200.0


@dataclass(frozen=True, slots=True)
class TrajectoryPattern:
    """A path through places, driven without a stop but where it dwells, and a box of places at rest around it.

    Args:
        path: Its places by axis and unit, at least two.
        blend_mm: How far before a place the path leaves its leg; 0 goes there and stops.
        dwell_s: Wait at each place, s; a place with a wait is not cut. One number for all, or one for each place.
        laps: How often the path is driven.
        captures_hz: Captures per second while it moves.
        around: Half sizes of the box of places at rest, by axis and unit: its corners, the middles of its faces and
            its centre, which is that of the path; an axis left out stays at the centre.
        beacons: The beacon to look at from each place on, by name; for benches with several. Empty: the bench's own.
        hold_s: How long the last valid pose stands in for a miss, flagged, with several beacons, s.
        correct: Whether the pose that is read at each wait corrects the rest of the path.
        correction_limit_mm: No single correction is larger than this in any axis.
        acceleration_mm_s2: Acceleration of linear axes; half of what the axes may when absent.
        acceleration_deg_s2: Acceleration of rotary axes; half of what the axes may when absent.
    """

    path: list[AxisValues]
    around: AxisValues
    blend_mm: float = 0.0
    dwell_s: float | list[float] = 0.0
    laps: int = 1
    captures_hz: float = 10.0
    beacons: list[str] = field(default_factory=list)
    hold_s: float = 2.0
    correct: bool = False
    correction_limit_mm: float = 10.0
    acceleration_mm_s2: float | None = None
    acceleration_deg_s2: float | None = None

    def points(self, axes: Sequence[Axis], rng: np.random.Generator) -> FloatArray:
        """The places at rest; see ``Pattern``."""
        path = self._path(axes)
        half = axis_vector(self.around, axes, "trajectory.around", default=0.0)
        used = np.flatnonzero(half)
        if len(used) == 0:
            raise ConfigError("must name at least one axis and not 0", key="trajectory.around")
        centre = 0.5 * (path.min(axis=0) + path.max(axis=0))
        signs = [np.zeros(len(axes))]
        for corner in product((-1.0, 1.0), repeat=len(used)):
            sign = np.zeros(len(axes))
            sign[used] = corner
            signs.append(sign)
        if len(used) > 1:
            for axis, side in product(used, (-1.0, 1.0)):
                sign = np.zeros(len(axes))
                sign[axis] = side
                signs.append(sign)
        return np.asarray(centre + np.array(signs) * half)

    def motion(
        self,
        axes: Sequence[Axis],
        offset: FloatArray,
        feed_mps: float,
        feed_radps: float | None,
    ) -> Motion:
        """The motion through the path, to be driven after the places at rest.

        Args:
            axes: The axes in the controller's order.
            offset: What positions are relative to, machine positions, shape (A,), m or rad.
            feed_mps: Speed along the path, m/s.
            feed_radps: Speed where only rotary axes move, rad/s, or None for the axis' largest.

        Returns:
            The motion; slower than the feed where the axes or the look-ahead of the controller demand it.

        Raises:
            ConfigError: A key that cannot be meant.
        """
        one_lap = self._path(axes) + offset
        dwells = self._dwells(len(one_lap))
        if self.beacons and len(self.beacons) != len(one_lap):
            raise ConfigError(f"needs one for each of the {len(one_lap)} places", key="trajectory.beacons")
        for key, value, most in (("laps", self.laps, _MOST_LAPS), ("captures_hz", self.captures_hz, _MOST_HZ)):
            if not 0 < value <= most:
                raise ConfigError(f"must be above 0 and at most {most:g}, got {value}", key=f"trajectory.{key}")
        for key, number in (
            ("blend_mm", self.blend_mm),
            ("correction_limit_mm", self.correction_limit_mm),
            ("hold_s", self.hold_s),
        ):
            if not 0.0 <= number < inf:
                raise ConfigError(f"must not be negative, got {number}", key=f"trajectory.{key}")
        if self.correct and not all(dwells):
            raise ConfigError("corrections are taken at waits: every place needs dwell_s", key="trajectory.correct")
        is_closed = bool(np.allclose(one_lap[0], one_lap[-1], rtol=0.0, atol=1e-9))
        points: list[PathPoint] = []
        numbers: list[int] = []
        for _ in range(self.laps):
            for i, (place, dwell_s) in enumerate(zip(one_lap, dwells, strict=True)):
                # The end of a closed lap is the begin of the next.
                if is_closed and points and i == 0:
                    continue
                points.append(PathPoint(place, dwell_s, m_from_mm(self.blend_mm)))
                numbers.append(i)
        return Motion(
            tuple(points),
            tuple(numbers),
            self._limits(axes, feed_mps, feed_radps),
            self.captures_hz,
            tuple(self.beacons),
            m_from_mm(self.correction_limit_mm) if self.correct else None,
            self.hold_s,
        )

    def _path(self, axes: Sequence[Axis]) -> FloatArray:
        if len(self.path) < 2:
            raise ConfigError(f"needs at least 2 places, got {len(self.path)}", key="trajectory.path")
        return np.array([axis_vector(values, axes, f"trajectory.path.{i}") for i, values in enumerate(self.path)])

    def _dwells(self, count: int) -> list[float]:
        dwells = self.dwell_s if isinstance(self.dwell_s, list) else [self.dwell_s] * count
        if len(dwells) != count:
            raise ConfigError(f"needs one number, or one for each of the {count} places", key="trajectory.dwell_s")
        for dwell_s in dwells:
            if not 0.0 <= dwell_s < inf:
                raise ConfigError(f"must not be negative, got {dwell_s}", key="trajectory.dwell_s")
        return dwells

    def _limits(self, axes: Sequence[Axis], feed_mps: float, feed_radps: float | None) -> MotionLimits:
        is_rotary = np.array([axis.kind == "rotary" for axis in axes])
        acceleration = np.array([_ACCELERATION_SHARE * axis.acceleration for axis in axes])
        for key, given, mask in (
            ("acceleration_mm_s2", self.acceleration_mm_s2, ~is_rotary),
            ("acceleration_deg_s2", self.acceleration_deg_s2, is_rotary),
        ):
            if given is None:
                continue
            if not 0.0 < given < inf:
                raise ConfigError(f"must be positive, got {given}", key=f"trajectory.{key}")
            value = m_from_mm(given) if key == "acceleration_mm_s2" else rad_from_deg(given)
            acceleration[mask] = np.minimum(acceleration[mask], value)
        # What is told ahead must be long enough to brake in.
        speed = np.array(
            [min(_SPEED_SHARE * axis.max_speed, axis.acceleration * LOOK_AHEAD_S) for axis in axes], dtype=np.float64
        )
        fastest = float(speed[is_rotary].min()) if is_rotary.any() else 1.0
        turning = fastest if feed_radps is None else feed_radps
        return MotionLimits(feed_mps, turning, speed, acceleration, is_rotary)


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A motion of a plan: machine positions, with everything that is decided before it begins.

    Args:
        points: Its places in the order of driving.
        numbers: Which place of the procedure's path each is, from 0.
        limits: What no instant exceeds.
        captures_hz: Captures per second.
        beacons: The beacon to look at from each place of the procedure's path on, by name; empty: the bench's own.
        correction_limit_m: Largest correction at a wait, per axis, m; None when there are none.
        hold_s: How long the last valid pose stands in for a miss, s.
    """

    points: tuple[PathPoint, ...]
    numbers: tuple[int, ...]
    limits: MotionLimits
    captures_hz: float
    beacons: tuple[str, ...] = ()
    correction_limit_m: float | None = None
    hold_s: float = 0.0

    def trajectory(self) -> Trajectory:
        """The motion in time; it begins and ends at rest."""
        return plan_trajectory(self.points, self.limits)

    @property
    def duration_s(self) -> float:
        """How long it takes, s."""
        return self.trajectory().duration_s

    @property
    def capture_count(self) -> int:
        """About how many captures are taken."""
        return round(self.duration_s * self.captures_hz)

    @property
    def length_m(self) -> float:
        """Length of the path of the linear axes without cut corners, m."""
        places = np.array([point.position for point in self.points])[:, ~self.limits.is_rotary]
        return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
