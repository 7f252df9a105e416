"""From a procedure and an envelope to a checked plan: every station, every move, how far and how long."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from uvgs_bench.accuracy.observations import Role
from uvgs_bench.devices.gantry.axes import Axis, Envelope
from uvgs_bench.errors import ConfigError, EnvelopeError
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.sessions.pattern_trajectory import Motion, TrajectoryPattern
from uvgs_bench.sessions.patterns import axis_vector, position_key, si_from_file
from uvgs_bench.sessions.procedure import Procedure

# For time estimates only: a typical camera delivers 30 pictures per second.
_CAPTURE_S = 1.0 / 30.0
# A controller knows no smaller step than this, m or rad.
_AT_REST = 1e-9
_DEFAULT_OVERSHOOT_FILE_UNITS = 1.0
# A motion is checked at instants this far apart, s.
_CHECK_S = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Station:
    """One planned visit.

    Args:
        index: Number of the visit, from 0.
        waypoint: Number of the place in the procedure's written order, from 0.
        repeat: How often this waypoint was visited before.
        role: Whether its captures fit the registration or are judged by it.
        target: Machine axis positions, shape (A,), m or rad.
        via: Position the last move begins at, shape (A,), or None when the carriage may arrive from anywhere.
    """

    index: int
    waypoint: int
    repeat: int
    role: Role
    target: FloatArray
    via: FloatArray | None = None

    @property
    def path(self) -> tuple[FloatArray, ...]:
        """Positions to move to in order; the last is the target."""
        return (self.target,) if self.via is None else (self.via, self.target)


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A procedure on a bench, checked.

    Args:
        procedure: The procedure.
        stations: The visits in order.
        waypoint_count: Number of different places.
        distance_m: Length of all moves of linear axes, from home, m.
        duration_s: Estimated time after homing, s.
        plan_hash: SHA-256 of everything that decides where and when captures are taken.
        motion: The motion that follows the stations, or None.
    """

    procedure: Procedure
    stations: tuple[Station, ...]
    waypoint_count: int
    distance_m: float
    duration_s: float
    plan_hash: str
    motion: Motion | None = None

    @property
    def capture_count(self) -> int:
        """Number of planned captures; those in motion about."""
        moving = 0 if self.motion is None else self.motion.capture_count
        return len(self.stations) * self.procedure.captures_per_station + moving

    @property
    def register_waypoint_count(self) -> int:
        """Number of different places that fit the registration."""
        return len({station.waypoint for station in self.stations if station.role == "register"})


def plan(procedure: Procedure, envelope: Envelope) -> Plan:
    """Plan a procedure on a bench and check every point and every path.

    Args:
        procedure: The procedure.
        envelope: What the carriage may reach.

    Returns:
        The plan.

    Raises:
        EnvelopeError: A waypoint, an approach or a path between leaves the envelope; the message names the waypoint
            (as numbered in the procedure, from 0), the axis and the value.
        ConfigError: A key of the procedure does not fit the bench, or no waypoint is left to register or to judge.
    """
    try:
        stations = _stations(procedure, envelope)
        motion = _motion(procedure, envelope)
    except ConfigError as error:
        # A pattern does not know its file; name it here.
        if error.path or not procedure.path:
            raise
        raise ConfigError(str(error), procedure.path) from None
    try:
        distance_m, duration_s = _checked_moves(procedure, envelope, stations)
        if motion is not None:
            to_start_s = _check_motion(motion, envelope, stations[-1].target, procedure)
            duration_s += to_start_s + procedure.settle_s + motion.duration_s
            distance_m += motion.length_m
    except EnvelopeError as error:
        raise EnvelopeError(f"{procedure.path}: {error}" if procedure.path else str(error), error.axis) from None
    return Plan(
        procedure=procedure,
        stations=stations,
        waypoint_count=1 + max(station.waypoint for station in stations),
        distance_m=distance_m,
        duration_s=duration_s,
        plan_hash=_plan_hash(procedure, stations, motion),
        motion=motion,
    )


def home_position(envelope: Envelope) -> FloatArray:
    """Where homing is taken to end for checks and estimates: linear axes at their upper bound, rotary ones near 0.

    Args:
        envelope: What the carriage may reach.

    Returns:
        Positions, shape (A,), m or rad. The driver checks the true first move again.
    """
    return read_only(
        [axis.upper if axis.kind == "linear" else min(max(0.0, axis.lower), axis.upper) for axis in envelope.axes]
    )


def move_duration_s(axes: Sequence[Axis], start: FloatArray, end: FloatArray, procedure: Procedure) -> float:
    """Duration of one straight move from rest to rest with trapezoidal speed.

    Args:
        axes: The axes.
        start: Positions, shape (A,), m or rad.
        end: Positions, shape (A,), m or rad.
        procedure: Gives the feed.

    Returns:
        Duration, s; 0 when nothing moves.
    """
    step = np.abs(end - start)
    is_linear = np.array([axis.kind == "linear" for axis in axes])
    linear_m, rotary_rad = float(np.linalg.norm(step[is_linear])), float(np.linalg.norm(step[~is_linear]))
    length, feed = (linear_m, procedure.feed_mps) if linear_m > 0.0 else (rotary_rad, procedure.feed_radps or np.inf)
    moving = step > _AT_REST
    if not moving.any():
        return 0.0
    share = step / length
    speed = min(feed, float(np.min(np.array([axis.max_speed for axis in axes])[moving] / share[moving])))
    acceleration = float(np.min(np.array([axis.acceleration for axis in axes])[moving] / share[moving]))
    if length >= speed * speed / acceleration:
        return length / speed + speed / acceleration
    return 2.0 * float(np.sqrt(length / acceleration))


def _stations(procedure: Procedure, envelope: Envelope) -> tuple[Station, ...]:
    axes = envelope.axes
    # Places and choices draw from generators of their own, so that a larger count of one leaves the other as it was.
    place_rng, order_rng, role_rng = np.random.default_rng(procedure.seed).spawn(3)
    grid = procedure.pattern.points(axes, place_rng) + _origin(procedure, envelope)
    waypoints = grid.reshape(-1, len(axes))
    registers = _register_waypoints(procedure, waypoints, role_rng)
    overshoot = _overshoot(procedure, axes)
    visits: list[int] = []
    for _ in range(procedure.repeats):
        for waypoint in _visiting_order(procedure, grid.shape[:-1], order_rng):
            if procedure.reference_every and visits and len(visits) % (procedure.reference_every + 1) == 0:
                visits.append(visits[0])
            visits.append(waypoint)
    seen = [0] * len(waypoints)
    stations = []
    for index, waypoint in enumerate(visits):
        target = read_only(waypoints[waypoint])
        stations.append(
            Station(
                index=index,
                waypoint=waypoint,
                repeat=seen[waypoint],
                role="register" if waypoint in registers else "judge",
                target=target,
                via=None if overshoot is None else read_only(target + overshoot),
            )
        )
        seen[waypoint] += 1
    return tuple(stations)


def _origin(procedure: Procedure, envelope: Envelope) -> FloatArray:
    """What positions of the procedure are relative to, shape (A,), m or rad."""
    if procedure.origin == "centre":
        return np.array([0.5 * (axis.lower + axis.upper) for axis in envelope.axes])
    return np.zeros(len(envelope.axes))


def _motion(procedure: Procedure, envelope: Envelope) -> Motion | None:
    pattern = procedure.pattern
    if not isinstance(pattern, TrajectoryPattern):
        return None
    return pattern.motion(envelope.axes, _origin(procedure, envelope), procedure.feed_mps, procedure.feed_radps)


def _check_motion(motion: Motion, envelope: Envelope, start: FloatArray, procedure: Procedure) -> float:
    """Check every place of a motion, the ways between as they are cut, and the way to it; how long the last takes, s.

    What corrections at waits may add is checked when they are made: the driver refuses what leaves the envelope.
    """
    for number, point in zip(motion.numbers, motion.points, strict=True):
        try:
            envelope.check_point(point.position)
        except EnvelopeError as error:
            raise EnvelopeError(f"place {number} of the path: {error}", error.axis) from None
    first = motion.points[0].position
    try:
        envelope.check_path(start, first)
        if envelope.keep_out:
            path = motion.trajectory()
            instants = np.arange(0.0, path.duration_s + _CHECK_S, _CHECK_S)
            for a, b in pairwise(path.positions_at(instants)):
                envelope.check_path(a, b)
    except EnvelopeError as error:
        raise EnvelopeError(f"on the path: {error}", error.axis) from None
    return move_duration_s(envelope.axes, start, first, procedure)


def _visiting_order(procedure: Procedure, shape: tuple[int, ...], rng: np.random.Generator) -> list[int]:
    numbers = np.arange(int(np.prod(shape))).reshape(shape)
    if procedure.order == "shuffled":
        return [int(i) for i in rng.permutation(numbers.ravel())]
    if procedure.order == "serpentine":
        return _serpentine(numbers)
    return [int(i) for i in numbers.ravel()]


def _serpentine(numbers: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> list[int]:
    """Rows one after the other, each beginning where the one before ended."""
    if numbers.ndim == 1:
        return [int(i) for i in numbers]
    out: list[int] = []
    for i, part in enumerate(numbers):
        inner = _serpentine(part)
        out += inner[::-1] if i % 2 else inner
    return out


def _register_waypoints(procedure: Procedure, waypoints: FloatArray, rng: np.random.Generator) -> frozenset[int]:
    n, rule = len(waypoints), procedure.register
    if isinstance(rule, tuple):
        for number in rule:
            if not 0 <= number < n:
                raise procedure.error(f"waypoint {number} does not exist, there are 0 to {n - 1}", "register")
        chosen = frozenset(rule)
    elif rule == "corners":
        chosen = _corners(waypoints)
    else:
        fraction = 1.0 / 3.0 if rule == "every_third" else float(rule)
        chosen = _spread_choice(n, max(1, round(fraction * n)), rng)
    if not chosen or len(chosen) == n:
        left = "to judge" if chosen else "to fit the registration"
        raise procedure.error(f"no waypoint is left {left}: of {n}, {len(chosen)} register", "register")
    return chosen


def _spread_choice(n: int, count: int, rng: np.random.Generator) -> frozenset[int]:
    """One waypoint out of each of ``count`` consecutive groups: a fixed step would fall in line with a grid's rows."""
    edges = np.linspace(0, n, count + 1).round().astype(int)
    return frozenset(int(rng.integers(low, high)) for low, high in pairwise(edges) if high > low)


def _corners(waypoints: FloatArray) -> frozenset[int]:
    """The waypoint nearest to each corner of the box around all; axes that do not move have no corners."""
    lower, upper = waypoints.min(axis=0), waypoints.max(axis=0)
    moving = upper - lower > 1e-9
    unit = (waypoints[:, moving] - lower[moving]) / (upper - lower)[moving]
    count = unit.shape[1]
    corners = np.array([[(i >> bit) & 1 for bit in range(count)] for i in range(2**count)], dtype=np.float64)
    return frozenset(int(np.argmin(np.linalg.norm(unit - corner, axis=1))) for corner in corners)


def _overshoot(procedure: Procedure, axes: Sequence[Axis]) -> FloatArray | None:
    """Where the last move begins relative to the target, shape (A,), m or rad; None without an approach."""
    if procedure.approach == "none":
        return None
    given = axis_vector(procedure.overshoot, axes, "approach.overshoot", default=0.0)
    out = np.empty(len(axes))
    for i, axis in enumerate(axes):
        key = position_key(axis)
        if key not in procedure.overshoot:
            out[i] = max(si_from_file(axis, _DEFAULT_OVERSHOOT_FILE_UNITS), 2.0 * axis.backlash)
        elif given[i] <= axis.backlash:
            raise procedure.error(
                f"must be more than the backlash of axis {axis.name}, {axis.described(axis.backlash)}",
                f"approach.overshoot.{key}",
            )
        else:
            out[i] = given[i]
    return -out if procedure.approach == "from_below" else out


def _checked_moves(procedure: Procedure, envelope: Envelope, stations: Sequence[Station]) -> tuple[float, float]:
    is_linear = np.array([axis.kind == "linear" for axis in envelope.axes])
    here, before = home_position(envelope), "home"
    distance_m = duration_s = 0.0
    for station in stations:
        name = f"waypoint {station.waypoint}"
        for position in station.path:
            what = name if position is station.target else f"the approach to {name}"
            try:
                envelope.check_point(position)
            except EnvelopeError as error:
                raise EnvelopeError(f"{what}: {error}", error.axis) from None
            try:
                envelope.check_path(here, position)
            except EnvelopeError as error:
                raise EnvelopeError(f"from {before} to {what}: {error}", error.axis) from None
            distance_m += float(np.linalg.norm((position - here)[is_linear]))
            duration_s += move_duration_s(envelope.axes, here, position, procedure)
            here, before = position, what
        duration_s += procedure.settle_s + procedure.captures_per_station * _CAPTURE_S
    return distance_m, duration_s


def _plan_hash(procedure: Procedure, stations: Sequence[Station], motion: Motion | None) -> str:
    said: dict[str, object] = {
        "feed_mps": procedure.feed_mps,
        "feed_radps": procedure.feed_radps,
        "settle_s": procedure.settle_s,
        "captures": procedure.captures_per_station,
        "stations": [[s.waypoint, s.repeat, s.role, *(p.tolist() for p in s.path)] for s in stations],
    }
    if motion is not None:
        said["motion"] = [[p.position.tolist(), p.dwell_s, p.blend] for p in motion.points]
        said["captures_hz"], said["beacons"] = motion.captures_hz, motion.beacons
        said["correction_limit_m"] = motion.correction_limit_m
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()
